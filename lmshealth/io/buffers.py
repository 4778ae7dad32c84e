"""Samples of a column: in memory up to a minute of a log, beyond it in a temporary file."""

import tempfile
import weakref
from collections.abc import Callable, Iterator
from typing import IO, ClassVar, cast

import numpy as np

from lmshealth._arrays import FloatArray
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
    """Collects the samples of one column in blocks, without a copy if their number is expected.

    The temporary file of a long column has no name and is deleted with the `Stored` of it. Where
    ``send`` is set, in the process that reads for others, blocks go there and are not kept.
    """

    send: "ClassVar[Callable[[Spool, np.ndarray], None] | None]" = None

    def __init__(self, expected: int = 0) -> None:
        # Of a column in memory: its first samples, and what is more than expected.
        self._whole = np.empty(expected if expected <= MINUTE and Spool.send is None else 0)
        self._filled = 0
        self._parts: list[FloatArray] = []
        self._stored: Stored | None = None
        self.expected = self._whole.size if Spool.send is None else expected
        self.size = 0

    def append(self, block: np.ndarray) -> None:
        """Add the next samples, ``(n,)``, of any numeric type; a full disk is ``too-large``."""
        if Spool.send is not None:
            Spool.send(self, block)
            return
        start, self.size = self.size, self.size + block.size
        # Damaged bytes may be a signalling NaN, which warns when it is widened.
        with np.errstate(invalid="ignore"):
            if self.size <= self._whole.size:
                self._whole[start : self.size] = block
                self._filled = self.size
            else:
                self._parts.append(np.asarray(block, dtype=np.float64))
        if self._stored is not None or self.size > MINUTE:
            self._write()

    def samples(self) -> Samples:
        """Return all samples."""
        if Spool.send is not None:
            return cast(Samples, self)  # a place for what was sent
        if self._stored is not None:
            self._stored.file.flush()
            self._stored.size = self.size
            return self._stored
        if len(self._parts) == 1 and not self._filled:
            return self._parts[0]
        if self._parts or self._filled < self._whole.size:
            self._parts = [np.concatenate([self._whole[: self._filled], *self._parts])]
            self._filled = 0
            return self._parts[0]
        return self._whole

    def _write(self) -> None:
        try:
            if self._stored is None:
                file = tempfile.TemporaryFile(prefix="lmshealth-")  # noqa: SIM115
                self._stored = Stored(file, 0)
            for values in (self._whole[: self._filled], *self._parts):
                self._stored.file.write(np.ascontiguousarray(values).data)
        except OSError as error:
            found = f"{8 * self.size} bytes of a column do not fit into {tempfile.gettempdir()}"
            needed = "set TMPDIR to a folder on a larger disk"
            raise Unusable("too-large", f"{found} ({error.strerror}); {needed}") from error
        self._whole, self._filled = np.empty(0), 0
        self._parts.clear()


def as_samples(values: np.ndarray) -> Samples:
    """Take a column that is in memory, shape ``(n,)``; a long one is put on disk."""
    spool = Spool()
    spool.append(values)
    return spool.samples()


def in_unit(samples: Samples, factor: float, limit: float) -> Samples:
    """Multiply samples by a factor, and set those from the limit (in SI units) on to NaN."""
    spool = Spool(samples.size)
    for _, values in blocks(samples):
        # A damaged float may be so large that its SI value is infinite: missing, no warning.
        with np.errstate(over="ignore", invalid="ignore"):
            scaled = values * factor
            scaled[~(np.abs(scaled) < limit)] = np.nan
        spool.append(scaled)
    return spool.samples()
