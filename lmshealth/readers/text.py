"""Text that streams by: looked at on its way for what no table of numbers holds."""

from __future__ import annotations

from collections.abc import Iterator
from io import BufferedIOBase

from lmshealth.readers.raw import check_size
from lmshealth.readers.trouble import Unusable

# A row of numbers is never so long; where line ends are missing, a line is the whole file.
LONGEST_LINE = 1 << 20
# An open quote makes one field of all rows behind it.
LONGEST_BLOCK = 64 << 20


class Text:
    """A text file, read forwards by lines and then by blocks, and never held whole.

    Parameters
    ----------
    stream : BufferedIOBase
        Bytes of the text, unpacked; can be sought.
    stored : int
        Bytes on disk, which bound what they may be unpacked to.
    """

    def __init__(self, stream: BufferedIOBase, stored: int) -> None:
        self._stream = stream
        self._stored = stored
        self.n_fields = 0
        self._delimiter = b","
        self.seek(0)

    def seek(self, position: int) -> None:
        """Go to the beginning of a line, which `position` gave."""
        self._stream.seek(position)
        self.position = position
        # What stands behind the last line feed.
        self._tail = b""
        self._handed_over = 0

    def rows_begin(self, n_fields: int, delimiter: str) -> None:
        """Note that only rows follow, and what is a whole one."""
        self.n_fields = n_fields
        self._delimiter = delimiter.encode()

    def rows_end(self) -> None:
        """Note that what was read so far makes whole rows."""
        self._handed_over = 0

    def line(self) -> bytes:
        """Read a line with its end; empty when there is none.

        Raises
        ------
        Unusable
            As `read` does.
        """
        return self._looked_at(self._stream.readline(LONGEST_LINE + 1))

    def read(self, size: int = -1) -> bytes:
        """Read a block of at most ``size`` bytes; empty when there is none.

        Raises
        ------
        Unusable
            With reason ``corrupt`` for a NUL byte, for lines or rows without end and for an end in
            the middle of a row, ``too-large`` for more than the file can honestly hold.
        """
        block = self._looked_at(self._stream.read(size))
        if not block:
            self._check_end()
        self._handed_over += len(block)
        if self._handed_over > LONGEST_BLOCK:
            raise Unusable(
                "corrupt",
                f"no row ends in {LONGEST_BLOCK} bytes before byte {self.position}; "
                "needed shorter rows, and a second quote to every quote",
            )
        return block

    def __iter__(self) -> Iterator[bytes]:
        """Give the lines; pandas takes nothing for a file that has none."""
        return iter(self.line, b"")

    def _looked_at(self, block: bytes) -> bytes:
        if b"\0" in block:
            at = self.position + block.index(0)
            raise Unusable("corrupt", f"NUL byte at offset {at}; needed UTF-8 text")
        self.position += len(block)
        check_size(self.position, self._stored)
        end = block.rfind(b"\n") + 1
        self._tail = block[end:] if end else self._tail + block
        if len(self._tail) > LONGEST_LINE:
            start = self.position - len(self._tail)
            raise Unusable(
                "corrupt",
                f"the line at offset {start} is longer than {LONGEST_LINE} bytes; "
                "needed one row per line",
            )
        return block

    def _check_end(self) -> None:
        """Refuse a file that was cut in the middle of a row: its last number is a part of one."""
        if not self._tail or self._tail.endswith(b"\r"):
            return
        n_found = self._tail.count(self._delimiter) + 1
        if n_found < self.n_fields:
            raise Unusable(
                "corrupt",
                f"the last row is cut off: {n_found} of {self.n_fields} fields; "
                "copy the file again",
            )
