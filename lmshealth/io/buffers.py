"""Samples of a signal: in memory, or of long records in a file, and read stretch by stretch.

Where decoded blocks of a column go: to memory up to a minute of a log, beyond it to disk.
"""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from copy import copy
from typing import IO

import numpy as np

from lmshealth._arrays import FloatArray
from lmshealth.io.refusal import Unusable

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


class Spool:
    """Takes the samples of one column in blocks.

    The temporary file of a long column has no name and is gone with the last `Stored` of it.

    Parameters
    ----------
    expected : int
        Number of samples, where it is known: up to a minute of them need not be joined then.
    """

    def __init__(self, expected: int = 0) -> None:
        self._memory = np.empty(expected if 0 < expected <= MINUTE else 0)
        self._parts: list[FloatArray] = []
        self._size = 0
        self._file: IO[bytes] | None = None

    @property
    def size(self) -> int:
        """Samples taken so far."""
        return self._size

    def append(self, block: np.ndarray) -> None:
        """Take the next samples, shape ``(n,)``, of any type of numbers.

        Raises
        ------
        Unusable
            With reason ``too-large`` where the disk is full.
        """
        start, self._size = self._size, self._size + block.size
        if self._size <= self._memory.size:
            # Damaged bytes may be a NaN that complains when it is widened.
            with np.errstate(invalid="ignore"):
                self._memory[start : self._size] = block
            return
        if self._memory.size:
            self._parts, self._memory = [self._memory[:start]], np.empty(0)
        with np.errstate(invalid="ignore"):
            self._parts.append(np.asarray(block, dtype=np.float64))
        if self._file is not None or self._size > MINUTE:
            self._write()

    def samples(self) -> Samples:
        """Give everything that was taken."""
        if self._file is not None:
            self._file.flush()
            return Stored(self._file, self._size)
        if self._memory.size:
            return self._memory[: self._size]
        if len(self._parts) != 1:
            self._parts = [np.concatenate(self._parts) if self._parts else np.empty(0)]
        return self._parts[0]

    def close(self) -> None:
        """Give up the file of what was taken and will not be asked for."""
        if self._file is not None:
            self._file.close()

    def _write(self) -> None:
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(prefix="lmshealth-")  # noqa: SIM115
            for values in self._parts:
                self._file.write(np.ascontiguousarray(values).data)
        except OSError as error:
            raise Unusable(
                "too-large",
                f"{8 * self._size} bytes of a column do not fit into {tempfile.gettempdir()} "
                f"({error.strerror}); set TMPDIR to a folder on a larger disk",
            ) from error
        self._parts.clear()


@contextmanager
def spools(names: Iterable[str], *, expected: int = 0) -> Iterator[dict[str, Spool]]:
    """Make a spool for each column; where reading fails, their files are closed.

    Parameters
    ----------
    names : iterable of str
        The columns.
    expected : int
        Number of samples of each, where it is known.
    """
    opened = {name: Spool(expected) for name in names}
    try:
        yield opened
    except BaseException:
        for spool in opened.values():
            spool.close()
        raise
