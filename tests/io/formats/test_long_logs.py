"""Long logs: samples on disk give the same log and the same results as samples in memory."""

import h5py
import numpy as np
import pytest

from lmshealth.io import buffers as samples
from lmshealth.io import buffers as spool
from lmshealth.io.buffers import Stored
from lmshealth.io.reading import read_log
from lmshealth.signal import segments
from lmshealth.signal.readings import choose_bands, read_error, read_magnitudes
from lmshealth.signal.segments import find_phases

RATE = 1000.0


def write(path):
    """Write strokes with a gap in time, missing samples, a flat channel and a set position."""
    rng = np.random.default_rng(0)
    speed = np.concatenate([np.zeros(3000), np.full(9000, 100.0), np.zeros(2000)] * 2)
    n = speed.size
    time = np.arange(n) / RATE
    time[20_000:] += 5 / RATE
    feed = rng.normal(size=n)
    feed[5000:5010] = np.nan
    feed[17_000] = 1e300
    with h5py.File(path, "w") as file:
        file["time_s"] = time
        file["delta_e_um"] = rng.normal(size=n)
        file["acc_feed_m_s2"] = feed
        file["acc_flat_m_s2"] = np.zeros(n)
        file["reference_position_mm"] = np.cumsum(speed) / RATE
    return path


@pytest.fixture(params=[500, 1000, 4096])
def both(request, tmp_path, monkeypatch):
    """Read a log in memory, and with little memory in blocks of some samples."""
    path = write(tmp_path / "log.h5")
    whole = read_log(path)
    monkeypatch.setattr(spool, "MINUTE", 1000)
    monkeypatch.setattr(samples, "BLOCK", request.param)
    stored = read_log(path)
    assert all(isinstance(channel.values, Stored) for channel in stored.channels)
    return whole, stored


def test_the_log_is_the_same(both):
    """Pieces, refusals, samples and set velocity do not depend on where samples are kept."""
    whole, stored = both
    assert stored.pieces == whole.pieces
    assert stored.refused == whole.refused
    assert [c.name for c in stored.channels] == [c.name for c in whole.channels]
    for one, other in zip(whole.channels, stored.channels, strict=True):
        np.testing.assert_array_equal(one.values, other.values[:])
    np.testing.assert_allclose(whole.reference_velocity, stored.reference_velocity[:], atol=1e-12)
    one, other = ([(p.start, p.stop, p.kind) for p in find_phases(log)] for log in both)
    assert one == other


def test_the_readings_are_the_same(both):
    """Statistics, harmonics and magnitudes do not depend on where samples are kept."""
    whole, stored = both
    (one,), (other,) = read_error(whole), read_error(stored)
    assert (one.lowest, one.highest) == (other.lowest, other.highest)
    assert other.std == pytest.approx(one.std, rel=1e-12)
    np.testing.assert_array_equal(one.kept, other.kept)
    bands = choose_bands(None, None, (10.0, 400.0))
    for a, b in zip(read_magnitudes(whole, bands), read_magnitudes(stored, bands), strict=True):
        assert (a.magnitude, a.rms, a.dof) == (b.magnitude, b.rms, b.dof)


def test_statistics_are_those_of_all_parts(tmp_path, monkeypatch):
    """A record cut into parts keeps its minimum, maximum, mean and standard deviation."""
    path = tmp_path / "log.h5"
    values = np.random.default_rng(1).normal(2.0, 3.0, size=10_000)
    with h5py.File(path, "w") as file:
        file["delta_e_um"] = values
        file.attrs["sample_rate_hz"] = RATE
    monkeypatch.setattr(segments, "MINUTE", 3000)
    (reading,) = read_error(read_log(path))
    assert reading.duration == pytest.approx(10.0)
    assert reading.mean == pytest.approx(1e-6 * values.mean(), rel=1e-12)
    assert reading.std == pytest.approx(1e-6 * values.std(), rel=1e-12)
    assert reading.harmonics.size == 2500
