"""The set velocity from a set position: exact, and not broken by the steps positions come in."""

import numpy as np
import pytest

from lmshealth.io.buffers import BLOCK, Stored
from lmshealth.io.set_point import set_velocity
from lmshealth.signal.segments import find_phases
from tests.signals import make_log

RATE = 20_000.0


def stroke(speed, rate=RATE):
    """Velocity of a stroke there and back with rests, and its position."""
    ramp = np.arange(0, speed, 10.0 / rate)
    rest, top = np.zeros(round(0.3 * rate)), np.full(round(0.5 * rate), speed)
    there = np.concatenate([ramp, top, ramp[::-1]])
    velocity = np.concatenate([rest, there, rest, -there, rest])
    return velocity, np.cumsum(velocity) / rate


STEPS = {
    "exact": lambda x: x,
    "float32 in mm": lambda x: (1e3 * x).astype(np.float32) / 1e3,
    "float32 at 300 mm": lambda x: (1e3 * (x + 0.3)).astype(np.float32) / 1e3,
    "1 um": lambda x: np.round(x, 6),
    "0.1 um": lambda x: np.round(x, 7),
    "1 nm": lambda x: np.round(x, 9),
}


@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.parametrize("speed", [0.005, 0.1, 0.4])
def test_steps_do_not_break_a_stroke(steps, speed):
    """Both constant stretches are found whole but for 40 ms, at their speed."""
    _, position = stroke(speed)
    rounded = np.asarray(STEPS[steps](position), dtype=np.float64)
    velocity = set_velocity(rounded, ((0, rounded.size),), RATE)
    log = make_log({"acc_a": np.zeros(rounded.size)}, RATE, velocity=velocity)
    constant = [p for p in find_phases(log) if p.kind == "constant" and p.stop - p.start > 400]
    assert [p.velocity for p in constant] == pytest.approx([speed, -speed], rel=1e-3)
    assert all(0.45 < (p.stop - p.start) / RATE < 0.51 for p in constant)


def test_neighbouring_differences_would_break_it():
    """The negative control: in steps of 1 um the plain difference leaves no stretch whole."""
    _, position = stroke(0.1)
    plain = np.gradient(np.round(position, 6), 1 / RATE)
    log = make_log({"acc_a": np.zeros(position.size)}, RATE, velocity=plain)
    longest = max(p.stop - p.start for p in find_phases(log) if p.kind == "constant")
    assert longest < 0.45 * RATE


def test_an_exact_position_gives_the_central_difference():
    """Without steps nothing is smoothed."""
    _, position = stroke(0.1)
    velocity = set_velocity(position, ((0, position.size),), RATE)
    np.testing.assert_allclose(velocity, np.gradient(position, 1 / RATE), atol=1e-12)


def test_gaps_stay_open():
    """Outside the pieces there is no velocity, and no difference is taken across a gap."""
    position = np.arange(100.0)
    position[50:] += 1000.0
    velocity = set_velocity(position, ((0, 40), (50, 90)), 10.0)
    assert np.isnan(velocity[40:50]).all() and np.isnan(velocity[90:]).all()
    np.testing.assert_allclose(velocity[0:40], 10.0)
    np.testing.assert_allclose(velocity[50:90], 10.0)


def test_blocks_do_not_show():
    """A long position gives the velocity of the same position at once, at every edge."""
    position = np.cumsum(np.sin(np.arange(6 * BLOCK) / 1e5)) / RATE
    velocity = set_velocity(position, ((0, position.size),), RATE)
    assert isinstance(velocity, Stored)
    expected = np.gradient(position, 1 / RATE)
    np.testing.assert_allclose(velocity[0 : velocity.size], expected, atol=1e-9)
