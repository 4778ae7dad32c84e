"""Samples of a column: in memory up to a minute of a log, beyond it in a temporary file."""

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

# A minute at 20 kHz: longer columns stay on disk.
MINUTE = 1_200_000
# Samples per block: small enough that temporary arrays stay in the processor's cache.
BLOCK = 1 << 18


class Stored:
    """Samples in a file of float64, sliced as an array is; the file closes with the last view."""

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
        """View the samples times a factor, as NaN from the limit on."""
        view = copy(self)
        view._factor, view._limit, view._viewed = self._factor * factor, limit, self
        return view


Samples = FloatArray | Stored


def in_unit(values: FloatArray, factor: float, limit: float) -> FloatArray:
    """Multiply samples by a factor, and set those from the limit (in SI units) on to NaN."""
    # A damaged float may be so large that its SI value is infinite: missing, without a warning.
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = values * factor
        missing = ~(np.abs(scaled) < limit)
    if missing.any():
        scaled[missing] = np.nan
    return scaled


def blocks(
    samples: Samples, start: int = 0, stop: int | None = None, *, overlap: int = 0
) -> Iterator[tuple[int, FloatArray]]:
    """Read samples block by block, each with the index of its first sample.

    The half-open range is all samples by default; ``overlap`` samples of the block before are
    repeated at the beginning of each block but the first.
    """
    end = samples.size if stop is None else stop
    at = start
    while at < end:
        # No remainder so short that a difference over it has no samples.
        following = at + BLOCK if end - at > 1.5 * BLOCK else end
        begin = max(start, at - overlap)
        yield begin, samples[begin:following]
        at = following


class Spool:
    """Collects the samples of one column in blocks.

    The temporary file of a long column has no name and is deleted with the last `Stored` of it.
    """

    def __init__(self) -> None:
        self._parts: list[FloatArray] = []
        self._file: IO[bytes] | None = None
        self.size = 0

    def append(self, block: np.ndarray) -> None:
        """Add the next samples, ``(n,)``, of any numeric type; a full disk is ``too-large``."""
        self.size += block.size
        # Damaged bytes may be a signalling NaN, which warns when it is widened.
        with np.errstate(invalid="ignore"):
            self._parts.append(np.asarray(block, dtype=np.float64))
        if self._file is not None or self.size > MINUTE:
            self._write()

    def samples(self) -> Samples:
        """Return all samples."""
        if self._file is not None:
            self._file.flush()
            return Stored(self._file, self.size)
        if len(self._parts) != 1:
            self._parts = [np.concatenate(self._parts) if self._parts else np.empty(0)]
        return self._parts[0]

    def close(self) -> None:
        """Discard the samples."""
        if self._file is not None:
            self._file.close()

    def _write(self) -> None:
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(prefix="lmshealth-")  # noqa: SIM115
            for values in self._parts:
                self._file.write(np.ascontiguousarray(values).data)
        except OSError as error:
            found = f"{8 * self.size} bytes of a column do not fit into {tempfile.gettempdir()}"
            needed = "set TMPDIR to a folder on a larger disk"
            raise Unusable("too-large", f"{found} ({error.strerror}); {needed}") from error
        self._parts.clear()


def as_samples(values: np.ndarray) -> Samples:
    """Take a column that is in memory, shape ``(n,)``; a long one is put on disk."""
    spool = Spool()
    spool.append(values)
    return spool.samples()


@contextmanager
def spools(names: Iterable[str]) -> Iterator[dict[str, Spool]]:
    """Make a spool for each column; where reading fails, their files are closed."""
    opened = {name: Spool() for name in names}
    try:
        yield opened
    except BaseException:
        for spool in opened.values():
            spool.close()
        raise
