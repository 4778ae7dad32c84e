"""Tests of faulty recordings."""

import numpy as np
import pytest
from scipy.signal import periodogram

from models.dynamics.stages import STAGES
from models.errors import UnknownFault
from models.lives.faults import FAULTS, fault_named
from models.recordings.recording import COLUMNS, record


@pytest.fixture(scope="module")
def clean():
    """Return four clean seconds of stage Y."""
    return record(STAGES["lms-y"], seconds=4.0, rng=np.random.default_rng(7))


def struck(clean, name, seed=1):
    """Return the columns of the recording with a fault."""
    return fault_named(name)(clean, np.random.default_rng(seed)).columns


@pytest.mark.slow
def test_dropped_samples_leave_holes_in_the_time(clean):
    """Rows are gone, the time column jumps there, and what is left is unchanged."""
    columns = struck(clean, "dropped-samples")
    step = np.diff(columns["time_s"]) * 20000.0
    assert np.count_nonzero(step > 1.5) >= 1
    kept = np.round(columns["time_s"] * 20000.0).astype(int)
    assert kept.size < 80000
    for name in COLUMNS:
        np.testing.assert_array_equal(columns[name], clean.columns[name][kept])


def test_clipped_channel_dwells_at_its_ends(clean):
    """A good part of the samples stands exactly at the two ends."""
    values = struck(clean, "clipped-channel")["acc_pitch_m_s2"]
    assert np.mean(np.abs(values) == np.abs(values).max()) > 0.05


def test_dead_channel_is_constant(clean):
    """One value, and not a round one."""
    values = struck(clean, "dead-channel")["acc_pitch_m_s2"]
    assert np.all(values == values[0])
    assert values[0] != 0


def test_wrong_gain_is_the_one_of_g(clean):
    """The channel is 9.80665 times too small."""
    ratio = (
        clean.columns["acc_pitch_m_s2"].std() / struck(clean, "wrong-gain")["acc_pitch_m_s2"].std()
    )
    assert ratio == pytest.approx(9.80665, rel=1e-5)


def test_hum_stands_at_fifty_hertz_in_all_signals(clean):
    """The strongest line of every struck signal is the mains, three times the signal's rms."""
    columns = struck(clean, "mains-hum")
    for name in ("delta_e_um", "acc_feed_m_s2", "acc_pitch_m_s2"):
        added = columns[name].astype(float) - clean.columns[name]
        hertz, density = periodogram(added, 20000.0)
        assert hertz[density.argmax()] == 50.0
        assert added.std() == pytest.approx(3 * clean.columns[name].std(), rel=0.05)


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_drawn_by_the_seed_and_leave_the_original(clean, name):
    """A fault is a function of its seed and changes a copy."""
    before = {key: values.copy() for key, values in clean.columns.items()}
    first, again = struck(clean, name), struck(clean, name)
    for key in first:
        np.testing.assert_array_equal(first[key], again[key])
    for key, values in before.items():
        np.testing.assert_array_equal(values, clean.columns[key])
    assert any(not np.array_equal(first[key], before[key]) for key in before)


def test_unknown_fault_is_named():
    """An unknown fault lists the known ones."""
    with pytest.raises(UnknownFault, match="wrong-gain"):
        fault_named("gremlins")
