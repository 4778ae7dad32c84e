"""Samples of a signal: in memory, or of long records in a file, and read stretch by stretch."""

from __future__ import annotations

import weakref
from collections.abc import Iterator
from copy import copy
from typing import IO

import numpy as np

from lmshealth.arrays import FloatArray

# A minute at 20 kHz: columns that are longer stay on disk.
MINUTE = 1_200_000
# What is looked at in one go: small enough that its temporaries stay in the processor's cache.
BLOCK = 1 << 18


class Stored:
    """Samples in a file of float64, sliced as an array is.

    Parameters
    ----------
    file : IO
        Open for reading; closed with the last view of it.
    size : int
        Number of samples.
    """

    def __init__(self, file: IO[bytes], size: int) -> None:
        self._file = file
        self._factor, self._limit = 1.0, np.inf
        self._viewed: Stored | None = None
        self.size = size
        weakref.finalize(self, file.close)

    def __getitem__(self, stretch: slice) -> FloatArray:
        """Read consecutive samples, shape ``(n,)``."""
        start, stop, step = stretch.indices(self.size)
        if step != 1:
            raise ValueError(f"step is {step}, needed consecutive samples")
        self._file.seek(8 * start)
        values = np.fromfile(self._file, dtype=np.float64, count=max(stop - start, 0))
        return in_unit(values, self._factor, self._limit)

    def scaled(self, factor: float, limit: float) -> Stored:
        """View the samples times a factor; from a limit on they are no measurements but NaN."""
        view = copy(self)
        view._factor, view._limit, view._viewed = self._factor * factor, limit, self
        return view


Samples = FloatArray | Stored


def in_unit(values: FloatArray, factor: float, limit: float) -> FloatArray:
    """Multiply samples, and make NaN of what reaches the limit or is no number.

    Parameters
    ----------
    values : ndarray
        Shape ``(n,)``; left as it is.
    factor : float
        SI value of one.
    limit : float
        In SI units.
    """
    # A damaged float can be so large that its SI value is infinite: missing, not a warning.
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = values * factor
        missing = ~(np.abs(scaled) < limit)
    if missing.any():
        scaled[missing] = np.nan
    return scaled


def blocks(
    samples: Samples, start: int = 0, stop: int | None = None, *, overlap: int = 0
) -> Iterator[tuple[int, FloatArray]]:
    """Read samples block by block, each with the place of its first sample.

    Parameters
    ----------
    samples : ndarray or Stored
        Shape ``(n_samples,)``.
    start, stop : int, optional
        Half-open range; by default all.
    overlap : int
        So many samples of the block before are repeated at the beginning of each but the first.
    """
    end = samples.size if stop is None else stop
    at = start
    while at < end:
        # Never a remainder so short that a difference over it has no samples.
        following = at + BLOCK if end - at > 1.5 * BLOCK else end
        begin = max(start, at - overlap)
        yield begin, samples[begin:following]
        at = following
