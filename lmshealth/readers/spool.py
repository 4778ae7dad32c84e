"""Where decoded blocks of a column go: to memory up to a minute of a log, beyond it to disk."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import IO

import numpy as np

from lmshealth.arrays import FloatArray
from lmshealth.readers.trouble import Unusable
from lmshealth.samples import MINUTE, Samples, Stored


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
