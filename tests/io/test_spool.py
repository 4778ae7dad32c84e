"""The spool: short columns stay in memory, long ones go to a file that leaves no trace."""

import errno
import tempfile

import numpy as np
import pytest

from lmshealth.io.buffers import MINUTE, Spool, Stored
from lmshealth.io.refusal import Unusable


def filled(size, step=100_000):
    """Fill a spool in blocks."""
    spool = Spool()
    for start in range(0, size, step):
        spool.append(np.arange(start, min(start + step, size)))
    return spool


@pytest.mark.parametrize("size", [0, 7, 100_000, MINUTE, MINUTE + 1, 2 * MINUTE + 33])
def test_what_goes_in_comes_out(size):
    """Any length in any blocks of any type comes back as float64."""
    spool = filled(size)
    samples = spool.samples()
    assert spool.size == samples.size == size
    assert isinstance(samples, Stored) == (size > MINUTE)
    values = samples[0:size]
    assert values.dtype == np.float64
    np.testing.assert_array_equal(values, np.arange(size))


def test_one_block_is_not_copied():
    """A column that comes at once is handed on as it is."""
    values = np.arange(5.0)
    spool = Spool()
    spool.append(values)
    assert spool.samples() is values


def test_no_file_is_left(tmp_path, monkeypatch):
    """The temporary file has no name even while it is used."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    samples = filled(MINUTE + 1).samples()
    assert list(tmp_path.iterdir()) == []
    assert samples[MINUTE : MINUTE + 1] == MINUTE


class Full:
    """A file on a disk without room."""

    def write(self, data):
        """Fail as the system does."""
        raise OSError(errno.ENOSPC, "No space left on device")


def test_a_full_disk_is_said_with_the_next_step(monkeypatch):
    """The column's bytes, the folder and TMPDIR are named."""
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda **_: Full())
    with pytest.raises(Unusable, match=r"96\d+ bytes .*No space left.*TMPDIR") as caught:
        filled(MINUTE + 1)
    assert caught.value.reason == "too-large"


@pytest.mark.parametrize("expected", [10, 300_000, 250_000, 2 * MINUTE])
def test_a_wrong_expectation_costs_no_sample(expected):
    """Whatever number of samples a file claims, those that come are kept, and only those."""
    spool = Spool(expected)
    for start in range(0, 250_000, 100_000):
        spool.append(np.arange(start, min(start + 100_000, 250_000)))
    np.testing.assert_array_equal(spool.samples()[0:250_000], np.arange(250_000))
    assert spool.samples().size == 250_000
