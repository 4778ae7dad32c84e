"""Tests of simulated logs."""

import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter, periodogram

from models.dynamics.plant import OUTPUTS
from models.dynamics.quantities import Number
from models.dynamics.stages import NOMINAL, STAGES
from models.errors import BadParameter
from models.recordings.recording import (
    COLUMNS,
    SAMPLE_RATE_HZ,
    move_velocity,
    record,
    sample_count,
    signal_to_noise,
    spectrum,
)


@pytest.fixture(scope="module")
def log_y():
    """Return 20 s of stage Y."""
    return record(STAGES["lms-y"], seconds=20.0, rng=np.random.default_rng(3))


@pytest.mark.slow
def test_columns_are_complete_and_single_precision(log_y):
    """All contract columns are there, as float32 of one length."""
    assert tuple(log_y.columns) == COLUMNS
    assert {v.dtype for v in log_y.columns.values()} == {np.dtype("float32")}
    assert {v.size for v in log_y.columns.values()} == {400000}


def test_following_error_is_counted(log_y):
    """Δe holds whole encoder counts of 4.8828125 nm."""
    counts = log_y.columns["delta_e_um"].astype(float) / 4.8828125e-3
    np.testing.assert_array_equal(counts, np.round(counts))


def test_signals_have_the_size_of_the_paper(log_y):
    """Δe scatters as in Table 3 at 10 mm/s, accelerations as the lines of Table 7 add up to."""
    std = {name: float(values.std()) for name, values in log_y.columns.items()}
    assert 0.6 < std["delta_e_um"] < 1.35
    assert 0.005 < std["acc_feed_m_s2"] < 0.1
    assert 0.005 < std["acc_pitch_m_s2"] < 0.1


def test_friction_costs_current(log_y):
    """At constant velocity the motor's mean force is the guide's friction."""
    force = 12.9 * float(log_y.columns["current_a"].mean())
    assert force == pytest.approx(STAGES["lms-y"].friction.value, rel=0.01)


def test_accelerometers_end_at_their_range():
    """A sensor of small range clips."""
    narrow = replace(STAGES["lms-y"], acc_range=Number(0.01, "m/s²", "our choice"))
    values = record(narrow, seconds=1.0, rng=np.random.default_rng(0)).columns["acc_pitch_m_s2"]
    assert np.abs(values).max() == np.float32(0.01)


def test_set_point_moves_at_its_velocity(log_y):
    """The reference position is the integral of the reference velocity."""
    position = log_y.columns["reference_position_mm"].astype(float)
    assert (position[-1] - position[0]) / (399999 / SAMPLE_RATE_HZ) == pytest.approx(10.0)
    assert np.all(log_y.columns["reference_velocity_mm_s"] == 10.0)


@pytest.mark.parametrize("signal", ["delta_e", "acc_feed", "acc_pitch"])
def test_spectrum_of_the_record_is_the_analytic_one(log_y, signal):
    """Between 110 and 148 Hz periodograms average to the state space's spectral density."""
    index = OUTPUTS.index(signal)
    unit = 1e-6 if signal == "delta_e" else 1.0
    values = log_y.columns[COLUMNS[index]].astype(float) * unit
    hertz, density = periodogram(values, SAMPLE_RATE_HZ, window="hann")
    band = (hertz > 110) & (hertz < 148)
    ratio = density[band] / spectrum(STAGES["lms-y"], hertz[band])[:, index]
    assert ratio.mean() == pytest.approx(1.0, abs=4.5 * np.sqrt(1.94 / ratio.size))


def test_same_seed_same_log_other_seed_other_log():
    """A record is a function of its seed."""
    first, again, other = (
        record(STAGES["lms-x"], seconds=1.0, rng=np.random.default_rng(seed)) for seed in (1, 1, 2)
    )
    for name in COLUMNS:
        np.testing.assert_array_equal(first.columns[name], again.columns[name])
    assert np.any(first.columns["acc_feed_m_s2"] != other.columns["acc_feed_m_s2"])


def test_sensors_see_the_modes():
    """Modal SNR of roll and pitch in acc_pitch, of pitch and yaw in acc_feed, reaches 30."""
    for name, stage in STAGES.items():
        ratio = signal_to_noise(stage, NOMINAL)
        assert min(ratio["roll"]["acc_pitch"], ratio["pitch"]["acc_pitch"]) > 30, name
        assert min(ratio["pitch"]["acc_feed"], ratio["yaw"]["acc_feed"]) > 30, name


@pytest.mark.slow
def test_simulation_costs_no_more_than_its_filters():
    """Twenty seconds cost a bounded multiple of one first-order filter over as many samples."""
    noise = np.random.default_rng(0).standard_normal(400000)
    pole = np.array([0.99 + 0.1j])

    def cost(work):
        start = time.process_time()
        work()
        return time.process_time() - start

    peer = min(cost(lambda: lfilter([1.0], [1.0, -pole[0]], noise)) for _ in range(3))
    record(STAGES["lms-y"], seconds=1.0, rng=np.random.default_rng(0))  # imports, caches
    rng = np.random.default_rng(0)
    ours = min(cost(lambda: record(STAGES["lms-y"], seconds=20.0, rng=rng)) for _ in range(2))
    # 38 filters of that kind, 17 noises, products and sensors: 110 measured.
    assert ours < 200 * peer


def test_long_log_moves_slower():
    """A log longer than the travel allows lowers the velocity."""
    stage = STAGES["lms-x"]
    assert move_velocity(stage, 20.0) == 0.010
    assert move_velocity(stage, 60.0) == pytest.approx(0.285 / 60)


@pytest.mark.parametrize("seconds", [0.0, -1.0, 580.0, 1e9, float("nan"), float("inf")])
def test_impossible_duration_is_refused(seconds):
    """No time, a crawl, and what is no number raise."""
    with pytest.raises(BadParameter, match="seconds"):
        move_velocity(STAGES["lms-x"], seconds)


@pytest.mark.parametrize("velocity", [0.0, 4e-4, float("nan"), float("inf")])
def test_impossible_velocity_is_refused(velocity):
    """A crawl, and what is no number, raise."""
    with pytest.raises(BadParameter, match="velocity"):
        move_velocity(STAGES["lms-x"], 20.0, velocity)


def test_samples_of_the_shortest_and_longest_log():
    """From 200 samples to twelve million; beyond, both ends are named."""
    assert sample_count(0.01) == 200
    assert sample_count(600.0) == 12_000_000
    for seconds in (0.0099, 600.1):
        with pytest.raises(BadParameter, match=f"seconds is {seconds}; needed: 0.01 to 600 s"):
            sample_count(seconds)


def test_the_shortest_log_can_be_recorded():
    """Two hundred samples, all finite, in every column."""
    columns = record(STAGES["lms-y"], seconds=0.01, rng=np.random.default_rng(0)).columns
    assert {values.size for values in columns.values()} == {200}
    assert all(np.isfinite(values).all() for values in columns.values())
