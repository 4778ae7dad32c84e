"""Where decoded blocks of a column go: to memory up to a minute of a log, beyond it to disk."""

from __future__ import annotations

import tempfile
from typing import IO

import numpy as np

from lmshealth.arrays import FloatArray
from lmshealth.readers.trouble import Unusable
from lmshealth.samples import MINUTE, Samples, Stored


class Spool:
    """Takes the samples of one column in blocks.

    The temporary file of a long column has no name and is gone with the last `Stored` of it.
    """

    def __init__(self) -> None:
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
        values = np.asarray(block, dtype=np.float64)
        self._size += values.size
        self._parts.append(values)
        if self._file is not None or self._size > MINUTE:
            self._write()

    def samples(self) -> Samples:
        """Give everything that was taken."""
        if self._file is not None:
            self._file.flush()
            return Stored(self._file, self._size)
        if len(self._parts) != 1:
            self._parts = [np.concatenate(self._parts) if self._parts else np.empty(0)]
        return self._parts[0]

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
