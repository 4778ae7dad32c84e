"""Samples of a column: in memory up to a minute of a log, beyond it in a temporary file."""

import tempfile
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import IO, ClassVar

import numpy as np

from lmshealth._private.arrays import BoolArray, FloatArray, IntArray
from lmshealth.io.refusal import Unusable

# A minute at 20 kHz: longer columns stay on disk.
MINUTE = 1_200_000
# Samples per block: small enough that temporary arrays stay in the processor's cache.
BLOCK = 1 << 18


class Stored:
    """Samples in a file of float64, sliced as an array is; the file closes with them."""

    def __init__(self, file: IO[bytes], size: int) -> None:
        self.file = file
        self.size = size
        weakref.finalize(self, file.close)

    def __getitem__(self, stretch: slice) -> FloatArray:
        """Read consecutive samples, shape ``(n,)``."""
        start, stop, step = stretch.indices(self.size)
        if step != 1:
            raise ValueError(f"step is {step}, needed consecutive samples")
        self.file.seek(8 * start)
        return np.fromfile(self.file, dtype=np.float64, count=max(stop - start, 0))


Samples = FloatArray | Stored
NO_RANGES: IntArray = np.empty((0, 2), dtype=np.int64)


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


def places(size: int, length: int) -> list[int]:
    """Return the starts of eight stretches of a length, evenly over a record of a size."""
    starts = np.linspace(0, max(0, size - length), 8).astype(int)
    return sorted(set(starts.tolist()))


def runs(marked: BoolArray, at: int = 0) -> IntArray:
    """Return the half-open ranges of marked samples, ``(n_ranges, 2)``; ``at`` is the first."""
    edges = np.diff(marked.view(np.int8), prepend=0, append=0)
    return np.flatnonzero(edges).reshape(-1, 2) + at


def smallest_step(values: FloatArray) -> float:
    """Return the smallest difference of two levels of samples ``(n,)``; 0 where there is none."""
    apart = np.diff(np.unique(values[np.isfinite(values)]))
    return float(apart.min()) if apart.size else 0.0


class Spool:
    """Collects the samples of one column in blocks.

    The temporary file of a long column has no name and is deleted with the `Stored` of it. Where a
    ``folder`` is set, in the process that reads for others, every column is a file in it.
    """

    folder: ClassVar[Path | None] = None

    def __init__(self) -> None:
        self._most = MINUTE if Spool.folder is None else -1  # samples in memory
        self._blocks = [np.empty(0)]
        self._file: IO[bytes] | None = None
        self.size = 0

    def append(self, block: np.ndarray) -> None:
        """Add the next samples, ``(n,)``, of any numeric type; a full disk is ``too-large``."""
        self.size += block.size
        # Damaged bytes may be a signalling NaN, which warns when it is widened.
        with np.errstate(invalid="ignore"):
            self._blocks.append(np.array(block, np.float64, order="C"))
        if self.size > self._most:
            self._write()

    def samples(self) -> Samples:
        """Return all samples."""
        if self.size <= self._most:
            self._blocks = [np.concatenate(self._blocks)]
            return self._blocks[0]
        file = self._write()
        file.flush()
        return Stored(file, self.size)

    def _write(self) -> IO[bytes]:
        """Move the blocks to the file."""
        try:
            self._file = self._file or _new_file(Spool.folder)
            for values in self._blocks:
                self._file.write(values.data)
        except OSError as error:
            found = f"{8 * self.size} bytes of a column do not fit into {tempfile.gettempdir()}"
            needed = "set TMPDIR to a folder on a larger disk"
            raise Unusable("too-large", f"{found} ({error.strerror}); {needed}") from error
        self._blocks.clear()
        return self._file


def _new_file(folder: Path | None) -> IO[bytes]:
    """Open a temporary file, which has the number of its place in a folder as its name."""
    if folder is None:
        return tempfile.TemporaryFile(prefix="lmshealth-")
    return (folder / str(len(list(folder.iterdir())))).open("w+b")


def as_samples(values: np.ndarray | Stored) -> Samples:
    """Take a column, shape ``(n,)``: a short one into memory, a long one on disk."""
    if isinstance(values, Stored):
        return values if Spool.folder or values.size > MINUTE else values[:]
    if values.size <= MINUTE and values.dtype == np.float64 and Spool.folder is None:
        return values
    spool = Spool()
    spool.append(values)
    return spool.samples()


def in_unit(
    samples: Samples, factor: float, limit: float, part: tuple[int, int] | None = None
) -> Samples:
    """Multiply samples by a factor, and set those from the limit (in SI units) on to NaN.

    All samples are taken, or those of a half-open range.
    """
    start, stop = part or (0, samples.size)
    spool = Spool()
    for _, values in blocks(samples, start, stop):
        # A damaged float may be so large that its SI value is infinite: missing, no warning.
        with np.errstate(over="ignore", invalid="ignore"):
            scaled = values * factor
            missing = ~(np.abs(scaled) < limit)
        if missing.any():
            scaled[missing] = np.nan
        spool.append(scaled)
    return spool.samples()
