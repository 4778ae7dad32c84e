"""Samples of a column: in memory up to a minute of a log, beyond it in a temporary file."""

import os
import tempfile
import weakref
from collections.abc import Iterator
from typing import IO, ClassVar, cast

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


def received(file: str) -> Samples:
    """Return the samples of a file that is about to be deleted: mapped, or of long ones open."""
    size = os.path.getsize(file) // 8
    if size <= MINUTE:
        # Windows does not delete a file that is mapped.
        is_mapped = size and os.name != "nt"
        return np.asarray(np.memmap(file, float, "c")) if is_mapped else np.fromfile(file, float)
    flags = os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_TEMPORARY", 0)
    return Stored(os.fdopen(os.open(file, flags), "rb"), size)


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


def count(ranges: IntArray) -> int:
    """Return the number of samples in half-open ranges, ``(n_ranges, 2)``, that do not overlap."""
    return int(np.sum(ranges[:, 1] - ranges[:, 0]))


def smallest_step(values: FloatArray) -> float:
    """Return the smallest difference of two levels of samples ``(n,)``; 0 where there is none."""
    apart = np.diff(np.unique(values[np.isfinite(values)]))
    return float(apart.min()) if apart.size else 0.0


class Spool:
    """Collects the samples of one column in blocks; the number expected saves copies.

    The temporary file of a long column has no name and is deleted with the `Stored` of it. In the
    process that reads for others every column has a file ``name`` in ``folder``.
    """

    folder: ClassVar[str] = ""

    def __init__(self, expected: int = 0) -> None:
        self._memory = np.empty(expected if expected <= MINUTE and not Spool.folder else 0)
        self._file: IO[bytes] | None = None
        self.size, self.name = 0, ""
        if Spool.folder:
            handle, self.name = tempfile.mkstemp(dir=Spool.folder)
            os.close(handle)  # a file may have a thousand columns

    def append(self, block: np.ndarray) -> None:
        """Add the next samples, ``(n,)``, of any numeric type; a full disk is ``too-large``."""
        start, self.size = self.size, self.size + block.size
        # Damaged bytes may be a signalling NaN, which warns when it is widened.
        with np.errstate(invalid="ignore"):
            if self.size > MINUTE or self.name:
                self._write(self._memory[:start], np.ascontiguousarray(block, dtype=np.float64))
                return
            if self.size > self._memory.size:
                grown = np.empty(max(self.size, 2 * start))
                grown[:start] = self._memory[:start]
                self._memory = grown
            self._memory[start : self.size] = block

    def samples(self) -> Samples:
        """Return all samples."""
        if self.name:
            return cast(Samples, self)  # a place for the file
        if self._file is None:
            return self._memory[: self.size]
        self._file.flush()
        return Stored(self._file, self.size)

    def _write(self, *parts: FloatArray) -> None:
        try:
            if self.name:
                with open(self.name, "ab") as file:
                    file.write(parts[-1].data)
                return
            if self._file is None:
                self._file = tempfile.TemporaryFile(prefix="lmshealth-")  # noqa: SIM115
            for values in parts:
                self._file.write(values.data)
        except OSError as error:
            found = f"{8 * self.size} bytes of a column do not fit into {tempfile.gettempdir()}"
            needed = "set TMPDIR to a folder on a larger disk"
            raise Unusable("too-large", f"{found} ({error.strerror}); {needed}") from error
        self._memory = np.empty(0)


def as_samples(values: np.ndarray) -> Samples:
    """Take a column that is in memory, shape ``(n,)``; a long one is put on disk."""
    if values.size <= MINUTE and values.dtype == np.float64 and not Spool.folder:
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
    spool = Spool(stop - start)
    for _, values in blocks(samples, start, stop):
        # A damaged float may be so large that its SI value is infinite: missing, no warning.
        with np.errstate(over="ignore", invalid="ignore"):
            scaled = values * factor
            missing = ~(np.abs(scaled) < limit)
        if missing.any():
            scaled[missing] = np.nan
        spool.append(scaled)
    return spool.samples()
