"""Tests of the reference profiles."""

from typing import Any

import numpy as np
import pytest

from models.errors import BadParameter
from models.recordings.motion_profile import Profile

RATE = 20000.0


def sampled(profile):
    """Return the whole move at 20 kHz and its times."""
    time = np.arange(round(profile.seconds * RATE)) / RATE
    return time, profile.sampled(time)


@pytest.mark.parametrize("velocity", [0.001, 0.020, 0.083, 0.100, 0.400])
def test_limits_are_kept_and_the_set_velocity_is_reached(velocity):
    """Velocity, acceleration and jerk keep their limits; there and back ends at the start."""
    profile = Profile(velocity, 0.28 if velocity > 0.05 else 5 * velocity, strokes=2)
    _, (position, speed, acceleration, jerk) = sampled(profile)
    assert np.abs(speed).max() == pytest.approx(velocity)
    assert np.abs(acceleration).max() <= profile.acceleration * (1 + 1e-9)
    assert np.abs(jerk).max() <= profile.jerk * (1 + 1e-9)
    assert np.ptp(position) == pytest.approx(profile.stroke)
    assert position[-1] == pytest.approx(position[0], abs=1e-12)


def test_fast_moves_reach_the_acceleration_of_the_paper():
    """From 100 mm/s on the acceleration is 5000 mm/s², as in all moves of the paper."""
    for velocity in (0.1, 0.2, 0.4):
        _, (_, _, acceleration, _) = sampled(Profile(velocity, 0.28))
        assert acceleration.max() == pytest.approx(5.0)


def test_derivatives_belong_together():
    """Position, velocity and acceleration are each the integral of the next."""
    _, (position, speed, acceleration, jerk) = sampled(Profile(0.2, 0.1))
    for whole, part in ((position, speed), (speed, acceleration), (acceleration, jerk)):
        summed = whole[0] + np.concatenate([[0], np.cumsum((part[1:] + part[:-1]) / 2)]) / RATE
        # Trapezia err where the jerk steps, by half a sample of it.
        assert np.abs(summed - whole).max() < 0.05 * max(np.abs(whole).max(), 1e-3)


def test_outside_the_move_the_reference_stands():
    """Before the first stroke and after the last nothing moves."""
    profile = Profile(0.1, 0.2)
    before, after = profile.sampled(np.array([-1.0, profile.seconds + 1.0])).T
    np.testing.assert_allclose(before, [-0.1, 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(after, [0.1, 0, 0, 0], atol=1e-12)


def test_durations_add_up():
    """The set velocity holds for the stroke less the two ramps."""
    profile = Profile(0.4, 0.28, dwell=0.25, strokes=3)
    time, (_, speed, _, _) = sampled(profile)
    held = np.count_nonzero(np.abs(np.abs(speed) - 0.4) < 1e-12) / RATE
    assert held == pytest.approx(3 * profile.constant_s, abs=6 / RATE)
    assert time.size == pytest.approx(RATE * profile.seconds, abs=1)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("velocity", -0.1),
        ("stroke", 0.01),
        ("jerk", float("nan")),
        ("dwell", -1.0),
        ("dwell", float("inf")),
        ("strokes", 0),
        ("strokes", 1001),
        ("acceleration", 0.0),
    ],
)
def test_impossible_profiles_are_refused(field, value):
    """What cannot be driven is named."""
    wanted = {"velocity": 0.4, "stroke": 0.28, field: value}
    with pytest.raises(BadParameter, match=field):
        Profile(**wanted)


def test_moves_end_within_a_day():
    """Dwells and crawls of more than a day are refused, just less is driven."""
    cases: tuple[dict[str, Any], ...] = (
        {"dwell": 86400.0}, {"velocity": 3e-6}, {"dwell": 900.0, "strokes": 100},
    )  # fmt: skip
    for wanted in cases:
        with pytest.raises(BadParameter, match=r"duration of all strokes.* at most 86400 s"):
            Profile(**{"velocity": 0.4, "stroke": 0.28, **wanted})
    assert Profile(0.4, 0.28, dwell=86000.0).seconds == pytest.approx(86400, rel=0.01)
