"""Tests of recordings with transients."""

from dataclasses import replace

import numpy as np
import pytest

from models.dynamics.modal_coordinates import diagonalise, frequency_response
from models.dynamics.plant import INPUTS, OUTPUTS, closed_loop
from models.dynamics.stages import NOMINAL, STAGES
from models.errors import BadParameter
from models.recordings.disturbances import drawn_orders
from models.recordings.motion_profile import Profile
from models.recordings.recording import COLUMNS, record
from models.recordings.strokes import (
    VELOCITIES,
    _lead_in_s,
    commanded,
    commands,
    full_stroke,
    record_strokes,
)

STAGE = STAGES["lms-y"]


def strokes(velocity, seed=0, **options):
    """Return a recording of one full stroke of stage Y."""
    rng = np.random.default_rng(seed)
    return record_strokes(STAGE, profile=full_stroke(STAGE, velocity), rng=rng, **options)


@pytest.mark.slow
def test_columns_are_those_of_any_log():
    """A stroke is written like a move at constant velocity."""
    recording = strokes(0.1, seconds=1.0)
    assert tuple(recording.columns) == COLUMNS
    assert {values.size for values in recording.columns.values()} == {20000}


@pytest.mark.slow
def test_fast_strokes_fit_into_the_window_slow_ones_fill_it():
    """At 20 mm/s four seconds are constant velocity, at 100 mm/s a whole stroke."""
    slow = strokes(0.020).columns["reference_velocity_mm_s"]
    fast = strokes(0.100).columns["reference_velocity_mm_s"]
    assert np.all(slow == 20.0)
    assert fast[0] == fast[-1] == 0.0
    assert fast.max() == 100.0


@pytest.mark.slow
def test_transients_make_the_error_of_fast_moves():
    """The error of a stroke at 100 mm/s peaks while it accelerates, not at constant velocity."""
    columns = strokes(0.100).columns
    steady = np.abs(np.gradient(columns["reference_velocity_mm_s"])) < 1e-6
    late = np.convolve(~steady, np.ones(16000), mode="full")[: steady.size] < 0.5
    error = np.abs(columns["delta_e_um"])
    assert error[~late].max() > 5 * error[late].max()


@pytest.mark.slow
def test_slow_strokes_have_the_scatter_of_a_constant_move():
    """Without transients a window of a stroke is the stationary record of the same velocity."""
    stroke = [strokes(0.010, seed).columns for seed in range(6)]
    steady = [
        record(STAGE, seconds=4.0, rng=np.random.default_rng(100 + seed)).columns
        for seed in range(6)
    ]
    for name in ("delta_e_um", "current_a", "acc_feed_m_s2", "acc_pitch_m_s2"):
        first, second = (
            np.sqrt(np.mean([np.var(columns[name]) for columns in group]))
            for group in (stroke, steady)
        )
        # Δe and the current have some thirty independent values in four seconds.
        assert first / second == pytest.approx(1.0, abs=0.3), name
        means = [np.mean([np.mean(c[name]) for c in group]) for group in (stroke, steady)]
        assert abs(means[0] - means[1]) < second


def test_acceleration_is_felt_by_the_accelerometer_along_the_feed():
    """The platform's accelerometer reads the reference's 5 m/s² while the stage accelerates."""
    columns = strokes(0.4).columns
    speed = columns["reference_velocity_mm_s"].astype(float) * 1e-3
    commanded = np.gradient(speed) * 20000.0
    pushed = commanded > 4.9
    read = columns["acc_feed_m_s2"][pushed].mean()
    assert read == pytest.approx(commanded[pushed].mean(), rel=0.1)
    current = columns["current_a"][pushed].mean()
    wanted = (STAGE.moving_mass.value * 5.0 + STAGE.friction.value) / 12.9
    assert current == pytest.approx(wanted, rel=0.15)


def test_feedforward_takes_most_of_the_acceleration_off_the_loop():
    """With feedforward a slow change of acceleration leaves a fraction of the error."""
    response = frequency_response(diagonalise(closed_loop(STAGE)), np.array([1.0, 2.0]))
    error = response[:, OUTPUTS.index("delta_e")]
    alone = np.abs(error[:, INPUTS.index("reference_acceleration")])
    helped = error[:, INPUTS.index("reference_acceleration")] + error[
        :, INPUTS.index("feedforward_current")
    ] * (STAGE.moving_mass.value / 12.9)
    assert np.all(np.abs(helped) < 0.1 * alone)


def opened(profile, time):
    """Return what a move does to the outputs in a window (time, s) that may open within it."""
    lead = round(_lead_in_s(profile, float(time[0])) * 20000)
    early = time[0] - np.arange(lead, 0, -1) / 20000
    reference = profile.sampled(np.concatenate([early, time]))
    drawn = drawn_orders(STAGE, np.random.default_rng(3))
    return commanded(STAGE, NOMINAL, reference, drawn)[:, lead:]


@pytest.mark.parametrize(
    ("velocity", "strokes", "dwell", "cut"),
    [(0.4, 2, 0.5, 0.55), (0.4, 2, 0.5, 0.3), (0.4, 9, 0.0, 1.0), (0.1, 1, 0.5, 0.5)],
)
def test_a_short_window_is_the_middle_of_a_long_one(velocity, strokes, dwell, cut):
    """Wherever a window opens, within a transient or after it, it shows what a longer one shows."""
    profile = replace(full_stroke(STAGE, velocity), strokes=strokes, dwell=dwell)
    middle = (profile.seconds - dwell) / 2
    long = np.arange(round((profile.seconds + 1.0) * 20000)) / 20000 - 0.5
    inside = np.abs(long - middle) < cut / 2
    whole, short = (opened(profile, time) for time in (long, long[inside]))
    # Friction turns round in no time, but the integrator meets what compensation leaves slowly.
    for row, scale in zip(whole[:, inside] - short, np.abs(whole).max(axis=1), strict=True):
        assert np.abs(row).max() < 2e-3 * scale


def test_commands_rest_before_the_move():
    """A standing reference commands nothing."""
    assert not commands(STAGE, NOMINAL, np.zeros((4, 10))).any()


@pytest.mark.slow
def test_error_grows_from_slow_to_fast_and_x_follows_better():
    """Standard deviations grow from 1 to 100 mm/s and X stays below Y, as in Table 3."""
    spread = {
        name: [
            record_strokes(stage, profile=full_stroke(stage, v), rng=np.random.default_rng(1))
            .columns["delta_e_um"]
            .std()
            for v in VELOCITIES
        ]
        for name, stage in STAGES.items()
    }
    for values in spread.values():
        assert np.all(np.diff(values[:6]) > 0)
    assert np.all(np.array(spread["lms-x"]) < np.array(spread["lms-y"]))


def test_impossible_windows_and_strokes_are_refused():
    """No time, and a stroke longer than the travel, raise."""
    with pytest.raises(BadParameter, match="seconds"):
        strokes(0.1, seconds=0.0)
    with pytest.raises(BadParameter, match="stroke"):
        record_strokes(STAGE, profile=Profile(0.1, 0.5), rng=np.random.default_rng(0))
