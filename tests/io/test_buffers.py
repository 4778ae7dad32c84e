"""Samples: a file is sliced as an array is, in its unit, and blocks are all of it."""

from __future__ import annotations

import errno
import tempfile

import numpy as np
import pytest

from lmshealth.io.buffers import BLOCK, MINUTE, Spool, Stored, as_samples, blocks, in_unit
from lmshealth.io.refusal import Unusable


def stored(values: np.ndarray) -> Stored:
    """Put samples into a file."""
    file = tempfile.TemporaryFile()  # noqa: SIM115
    values.tofile(file)
    file.flush()
    return Stored(file, values.size)


@pytest.mark.parametrize(
    "stretch", [slice(0, 10), slice(3, 7), slice(None), slice(-3, None), slice(5, 5), slice(8, 2)]
)
def test_slices_are_those_of_an_array(stretch: slice) -> None:
    """Every stretch of consecutive samples is the array's, in any order of asking."""
    values = np.random.default_rng(0).normal(size=10)
    on_disk = stored(values)
    for _ in range(2):
        np.testing.assert_array_equal(on_disk[stretch], values[stretch])


def test_no_sample_is_passed_over() -> None:
    """A step is refused rather than ignored."""
    with pytest.raises(ValueError, match="step is 2"):
        stored(np.arange(4.0))[::2]


def test_samples_on_disk_are_converted() -> None:
    """The factor multiplies, and what reaches the limit is NaN."""
    scaled = in_unit(stored(np.array([1.0, -2.0, 3000.0, np.inf])), 2e-3, 5.0)
    np.testing.assert_allclose(scaled[:], [2e-3, -4e-3, np.nan, np.nan])


def test_what_overflows_is_missing() -> None:
    """A damaged float becomes NaN without a warning, and the given array stays as it is."""
    values = np.array([1.0, 1e308, np.nan, -np.inf])
    np.testing.assert_array_equal(in_unit(values, 1e3, np.inf), [1e3, np.nan, np.nan, np.nan])
    assert values[1] == 1e308


@pytest.mark.parametrize("size", [0, 1, BLOCK, BLOCK + 1, 3 * BLOCK - 7])
@pytest.mark.parametrize("overlap", [0, 2])
def test_blocks_are_all_of_it(size: int, overlap: int) -> None:
    """Blocks without their overlap are the samples, each at its index; none is tiny."""
    values = np.arange(float(size))
    parts = []
    for at, block in blocks(values, overlap=overlap):
        assert block[0] == at
        parts.append(block[overlap if at else 0 :])
        assert parts[-1].size >= min(size, BLOCK // 2)
        assert parts[-1].size <= 1.5 * BLOCK
    np.testing.assert_array_equal(np.concatenate([np.empty(0), *parts]), values)


def test_blocks_of_a_stretch_stay_in_it() -> None:
    """A range is read from its start to its stop, also with an overlap."""
    values = np.arange(3.0 * BLOCK)
    found = [block for _, block in blocks(values, 5, 2 * BLOCK, overlap=1)]
    assert found[0][0] == 5
    assert found[-1][-1] == 2 * BLOCK - 1


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


def test_a_short_column_is_not_copied():
    """A column that is in memory is handed on as it is; other types are widened."""
    values = np.arange(5.0)
    assert as_samples(values) is values
    np.testing.assert_array_equal(as_samples(values.astype("<i2"))[:], values)


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

    def close(self):
        """Close."""


def test_a_full_disk_is_refused_with_the_next_step(monkeypatch):
    """The column's bytes, the folder and TMPDIR are named."""
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda **_: Full())
    with pytest.raises(Unusable, match=r"96\d+ bytes .*No space left.*TMPDIR") as caught:
        filled(MINUTE + 1)
    assert caught.value.reason == "too-large"
