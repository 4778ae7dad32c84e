"""The bytes of one variable of a MAT-file, read forwards and unpacked on the way."""

from __future__ import annotations

import os
import zlib
from typing import IO

from lmshealth.io.refusal import Unusable

# Bytes that are unpacked, or passed over, in one go.
_BLOCK = 1 << 16


def cut_off(at: int) -> Unusable:
    """Say that something is larger than what holds it."""
    return Unusable("corrupt", f"what begins at byte {at} is cut off; copy the file again")


def _damaged() -> Unusable:
    return Unusable("corrupt", "a compressed variable is damaged; copy the file again")


class PlainBytes:
    """Reads a variable that is not compressed.

    Parameters
    ----------
    stream : IO
        At the first byte of the variable.

    Attributes
    ----------
    at : int
        Bytes of the variable that are behind.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self.at = 0

    def read(self, n: int) -> bytes:
        """Read the next ``n`` bytes.

        Raises
        ------
        Unusable
            With reason ``corrupt`` where the file has fewer.
        """
        data = self._next(n)
        if len(data) < n:
            raise cut_off(self.at)
        self.at += n
        return data

    def skip(self, n: int) -> None:
        """Pass over the next ``n`` bytes."""
        self._stream.seek(n, os.SEEK_CUR)
        self.at += n

    def finish(self) -> None:
        """Check what can be checked only at the end of the variable."""

    def _next(self, n: int) -> bytes:
        return self._stream.read(n)


class PackedBytes(PlainBytes):
    """Unpacks a compressed variable.

    Parameters
    ----------
    stream : IO
        At the first packed byte.
    size : int
        Number of packed bytes.
    """

    def __init__(self, stream: IO[bytes], size: int) -> None:
        super().__init__(stream)
        self._left = size
        self._unpacker = zlib.decompressobj()

    def skip(self, n: int) -> None:
        """Unpack the next ``n`` bytes for nothing."""
        stop = self.at + n
        while self.at < stop:
            self.read(min(_BLOCK, stop - self.at))

    def finish(self) -> None:
        """Check that nothing is left; what follows the last byte is the checksum.

        Raises
        ------
        Unusable
            With reason ``corrupt``.
        """
        if self._next(1) or not self._unpacker.eof:
            raise _damaged()

    def _next(self, n: int) -> bytes:
        parts = []
        while n > 0 and not self._unpacker.eof:
            packed = self._unpacker.unconsumed_tail
            if not packed:
                packed = self._stream.read(min(_BLOCK, self._left))
                self._left -= len(packed)
            try:
                part = self._unpacker.decompress(packed, n)
            except zlib.error as error:
                raise _damaged() from error
            if not part and not packed:
                break
            parts.append(part)
            n -= len(part)
        return b"".join(parts)
