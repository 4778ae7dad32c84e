"""Delimited text: leading ``# key: value`` lines, names of the columns, rows of numbers.

pandas reads the rows from a stream that checks the text before pandas does: pandas accepts rows
that are cut off, and allocates without bound for lines and quotes that do not end.
"""

import codecs
import math
import re
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import IO, Any

import numpy as np

from lmshealth.io import constants
from lmshealth.io.buffers import Samples, Spool
from lmshealth.io.column_map import ColumnMap, Segments
from lmshealth.io.formats.content import (
    GZIP,
    Content,
    Format,
    SinceFirst,
    check_size,
    choose,
    describe,
    not_numeric,
    parse_moments,
)
from lmshealth.io.formats.dialect import (
    Dialect,
    fields_of,
    find_dialect,
    is_number_or_moment,
    stated_dialect,
)
from lmshealth.io.refusal import Unusable, corrupt

# The filters of warnings belong to the process, which threads share.
_WARNINGS = threading.Lock()
_BOM = b"\xef\xbb\xbf"
# First bytes and lines from which the dialect is found.
_HEAD_BYTES, _HEAD_LINES = 1 << 17, 400
# Rows per block, fewer of wide tables: a block stays in the processor's cache.
_ROWS = 1 << 16
_FIELDS = 1 << 18
_NO_ROWS = "a header line and no rows; needed rows"
# Lines of further headers, which are no rows.
_MAY_BE_MIXED = re.compile(rb"\n[A-Za-z*\r\n]")
_NO_ROW = re.compile(rb"^(?:[A-Za-z*][^\n]*|[ \t\r]*)\n", re.MULTILINE)
# Message of pandas for a row with too many fields.
_LONG_ROW = re.compile(r"in line (\d+), saw (\d+)")
# Most bytes of text behind the rows: rates, counts and ends that exporters write there.
_TRAILER = 1 << 12
_WORD = re.compile(r"[^\W\d_]{3}")


def encoding_of(head: bytes) -> str:
    """Return the encoding of a text: its byte order mark, UTF-8, or a statistical guess."""
    marks = {codecs.BOM_UTF32_LE: "utf-32", codecs.BOM_UTF32_BE: "utf-32"}
    marks |= {codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}
    if marked := next((name for mark, name in marks.items() if head.startswith(mark)), None):
        return marked
    # Without a mark: Latin letters in two bytes each, of which one is zero.
    for first, name in ((1, "utf-16-le"), (0, "utf-16-be")):
        if len(head) > 3 and any(head) and head[first::2].count(0) > 0.9 * len(head[first::2]):
            return name
    try:
        codecs.getincrementaldecoder("utf-8-sig")().decode(head)
        return "utf-8"
    except UnicodeDecodeError:
        from charset_normalizer import from_bytes

        found = from_bytes(head).best()
    # µ, ° and ² are these bytes in the Windows code page of Western Europe.
    western = found is None or any(mark in head for mark in b"\xb5\xb0\xb2")
    return "cp1252" if western or found is None else found.encoding


class Text:
    """A text file, read by lines and then by blocks, and checked on the way.

    The stream is decompressed; ``stored`` bytes on disk limit its size. From ``position`` on, the
    byte that is read next, every row has ``n_fields`` (0 where no rows have begun); ``pending``
    counts the bytes since the last complete row.
    """

    def __init__(self, stream: Any, stored: int) -> None:
        self._stream = stream
        self._stored = stored
        self.begin()

    def begin(self, n_lines: int = 0, delimiter: str = ",", n_fields: int = 0) -> None:
        """Go behind the first lines, from where on rows are expected."""
        self._stream.seek(0)
        self.position = self.pending = self.n_fields = 0
        self.trailer = ""  # what is left out behind the rows
        self._tail = b""  # bytes after the last line feed
        self._ahead = b""  # the block that is read next
        for _ in range(n_lines):
            self.line()
        self._delimiter, self.n_fields = delimiter, n_fields

    def line(self) -> bytes:
        """Read a line with its end, with the checks of `read`; empty at the end of the file."""
        return self._checked(self._stream.readline(constants.LONGEST_LINE + 1))

    def read(self, size: int = -1) -> bytes:
        """Read a block of at most ``size`` bytes; empty at the end of the file.

        `Unusable`: ``corrupt`` for a NUL byte, for lines or rows without end and for an end inside
        a row, ``too-large`` for more than the file can hold.
        """
        block, self._ahead = self._ahead or self._stream.read(size), self._stream.read(size)
        while 0 < len(self._ahead) < _TRAILER and (more := self._stream.read(size)):
            self._ahead += more
        if len(self._ahead) < _TRAILER:  # the last block
            block, self._ahead = block + self._ahead, b""
            block = self._rows(block)
        block = self._checked(block)
        if not block and self._tail and not self._tail.endswith(b"\r"):
            # The last number of a file that ends inside a row may be incomplete.
            n_found = len(fields_of(self._tail.decode(errors="replace"), self._delimiter))
            if n_found < self.n_fields:
                raise corrupt(f"the last row is cut off: {n_found} of {self.n_fields} fields")
        self.pending += len(block)
        if self.pending > constants.LONGEST_BLOCK:
            found = f"no row ends in {constants.LONGEST_BLOCK} bytes before byte {self.position}"
            needed = "needed shorter rows, and a second quote to every quote"
            raise Unusable("corrupt", f"{found}; {needed}")
        return block

    def _rows(self, block: bytes) -> bytes:
        """Leave out the lines of text behind the last row."""
        start = max(0, len(block) - _TRAILER)
        lines = block[start:].splitlines(keepends=True)
        kept = len(lines)
        while kept and (not lines[kept - 1].strip() or self._is_text(lines[kept - 1])):
            kept -= 1
        texts = [line for line in lines[kept:] if line.strip()]
        row = lines[kept - 1].decode("latin-1").strip() if kept else ""
        # A block that is text to its beginning has no rows; rows may begin with text, too.
        if not self.n_fields or not texts or _WORD.match(row) or (start and kept < 2):
            return block
        if n_lines := sum(not line.startswith(b"EOF") for line in texts):
            self.trailer = f"{n_lines} lines of text behind the rows left out"
        return block[: len(block) - sum(map(len, lines[kept:]))]

    def _is_text(self, line: bytes) -> bool:
        """Return whether a line is a remark or begins with a word; a word alone may be damage."""
        text = line.decode("latin-1").strip()
        if text.startswith(("#", "EOF")):
            return True
        first = (fields_of(text, self._delimiter) or [""])[0]
        several = self.n_fields > 1 or len(text.split()) > 1
        is_word = _WORD.match(first) and not is_number_or_moment(first)
        return bool(is_word) and several and "\0" not in text

    def __iter__(self) -> Iterator[bytes]:
        """Iterate over lines; pandas requires it of a file."""
        return iter(self.line, b"")

    def _checked(self, block: bytes) -> bytes:
        if b"\0" in block:
            at = self.position + block.index(0)
            raise Unusable("corrupt", f"NUL byte at offset {at}; needed text")
        self.position += len(block)
        check_size(self.position, self._stored)
        end = block.rfind(b"\n") + 1
        self._tail = block[end:] if end else self._tail + block
        if len(self._tail) > constants.LONGEST_LINE:
            start = self.position - len(self._tail)
            too_long = f"is longer than {constants.LONGEST_LINE} bytes; needed one row per line"
            raise Unusable("corrupt", f"the line at offset {start} {too_long}")
        return block


def _load(path: Path, columns: ColumnMap, max_memory: float) -> Content:
    with path.open("rb") as stream:
        # Any text may be a table.
        if foreign := describe(stream.read(_HEAD_BYTES), path):
            raise Unusable("format", foreign)
        stream.seek(0)
        return parse_text(stream, path.stat().st_size, columns)


def parse_text(stream: Any, stored: int, columns: ColumnMap) -> Content:
    """Read delimited text of any dialect, block by block.

    What is wrong is refused as ``empty``, ``corrupt``, ``too-large``, ``metadata`` or ``columns``.
    """
    start = stream.read(_HEAD_BYTES)
    encoding = columns.csv.encoding or encoding_of(start)
    guessed = [f"{encoding} text"] if encoding != "utf-8" else []
    if encoding.startswith(("utf-16", "utf-32")):
        stream, stored = codecs.EncodedFile(stream, "utf-8", encoding), 4 * stored
        encoding = "utf-8"
    text = Text(stream, stored)
    lines = _head(text, encoding)
    dialect = stated_dialect(lines, columns) or find_dialect(lines, columns)
    if dialect.segments:
        text = Text(_SegmentStream(stream, dialect, dialect.segments), stored)
    guessed += dialect.guessed
    chosen, content = choose(dialect.channels, columns)
    metadata, samples = content.metadata | dialect.metadata, dict[str, Samples]()
    if chosen:
        times = {name: SinceFirst(name, columns) for name in chosen if columns.is_time(name)}
        samples = _numbers(text, chosen, dialect, times)
        guessed += [text.trailer] if text.trailer else []
    elif not (dialect.has_rows or columns.csv.delimiter) and len(lines) > dialect.start:
        detail = "text without rows of numbers; needed a line of names and rows of samples"
        raise Unusable("format", detail)
    elif dialect.segments:  # segments that cannot be read are named before names
        text.begin(dialect.start)
        while text.read(_HEAD_BYTES):
            pass
    return replace(content, columns=samples, metadata=metadata, guessed=tuple(guessed))


class _SegmentStream:
    """A text of several segments, of which `read` leaves out the headers of later ones.

    `Unusable` (``format``) for segments without one column of times, which places them in time,
    with or without headers of their own, and for segments of other columns.
    """

    def __init__(self, stream: IO[bytes], dialect: Dialect, segments: Segments) -> None:
        self._stream, self._segments = stream, segments
        self.readline = stream.readline
        stream.seek(0)
        header = [stream.readline(constants.LONGEST_LINE).rstrip() for _ in range(dialect.start)]
        delimiter = dialect.delimiter.encode()
        pairs = (line.removeprefix(_BOM).partition(delimiter) for line in header)
        self._keys = {key: value for key, _, value in pairs}
        same = b"|".join(re.escape(key.encode()) for key in segments.same)
        value = rb"(?:" + re.escape(delimiter) + rb"([^\n]*)|\r?$)"
        self._shared = re.compile(rb"^(" + same + rb")" + value, re.MULTILINE)
        self._is_timed = [channel.name for channel in dialect.channels].count("time") == 1
        self.seek(0)

    def seek(self, position: int) -> None:
        """Go to the beginning."""
        self._stream.seek(position)
        sizes = re.findall(rb"\d+", self._keys.get(self._segments.rows.encode(), b""))
        self._n_left = math.inf if self._is_timed or not sizes else max(map(int, sizes))

    def read(self, size: int) -> bytes:
        """Read rows of about so many bytes."""
        rows = b""
        while not rows and (block := self._stream.read(size)):
            block += self.readline(constants.LONGEST_LINE)
            rows = block
            if _MAY_BE_MIXED.search(b"\n" + block):  # it is quick; most blocks are rows alone
                rows = _NO_ROW.sub(b"", block)
                for match in self._shared.finditer(block):
                    key, value = match[1], (match[2] or b"").rstrip()
                    if self._keys.get(key) != value or not self._is_timed:
                        text = f"{key.decode()} {value.decode('cp1252')}"
                        raise self._refusal(-block.count(b"\n", match.start()), text)
            if self._n_left < math.inf:
                self._n_left -= rows.count(b"\n")
            if self._n_left < 0:
                found = f"more rows than {self._segments.rows} states"
                raise self._refusal(int(self._n_left), found)
        return rows

    def _refusal(self, n_more: int, found: str) -> Unusable:
        """Name a line by its distance from the present one."""
        end = self._stream.tell()
        self._stream.seek(0)
        line = self._stream.read(end).count(b"\n") + n_more + 1
        needed = f"needed {self._segments.needed}, and the same channels in all segments"
        return Unusable("format", f"line {line}: a further segment, {found}; {needed}")


def _head(text: Text, encoding: str) -> list[str]:
    """Read the first lines."""
    head: list[str] = []
    while text.position < _HEAD_BYTES and len(head) < _HEAD_LINES and (line := text.line()):
        head.append(line.removeprefix(_BOM).decode(encoding, "replace"))
    return head


@cache
def _is_old_pandas() -> bool:
    """Return whether pandas is older than 3.1."""
    major, minor = version("pandas").split(".")[:2]
    return (int(major), int(minor)) < (3, 1)


def _numbers(
    text: Text, places: dict[str, int], dialect: Dialect, times: Mapping[str, SinceFirst]
) -> dict[str, Samples]:
    """Read the wanted columns, ``(n_rows,)`` each, NaN where a field is empty.

    Moments are read in the columns of times only, since the first of them.
    Empty lines are left out where time stamps place the rows, and at the end.
    """
    import pandas as pd

    begin = partial(text.begin, dialect.start, dialect.delimiter, len(dialect.channels))
    begin()
    # Before 3.1 pandas drops an extra field of the first row of a block (pandas-dev/pandas pull
    # request 66944): a spare column receives it. It also rounds the last digits of numbers.
    n_spare = int(_is_old_pandas())
    read = partial(
        pd.read_csv,
        text,
        sep=r"\s+" if dialect.delimiter == " " else dialect.delimiter,
        decimal=dialect.decimal,
        # Numbers are ASCII in every encoding that comes here.
        encoding_errors="replace",
        header=None,
        names=list(range(text.n_fields + n_spare)),
        float_precision="round_trip" if _is_old_pandas() else None,
        index_col=False,
        # A block is small enough as a whole.
        low_memory=False,
        # Time stamps place the other rows; without them an empty row is a missing sample.
        skip_blank_lines=bool(times),
        chunksize=max(1, min(_ROWS, _FIELDS // text.n_fields)),
    )
    with _WARNINGS, warnings.catch_warnings():
        # A row longer than the header is a warning in pandas and a loss of data here.
        warnings.simplefilter("error", pd.errors.ParserWarning)
        try:
            numbers = dict.fromkeys(places.values(), np.float64)
            return _spooled(partial(read, dtype=numbers), text, places, {})
        except (ValueError, pd.errors.ParserWarning):
            # Half as fast, but accepts blanks and locates the fault.
            begin()
        try:
            return _spooled(partial(read, skipinitialspace=True), text, places, times)
        except pd.errors.EmptyDataError as error:
            raise Unusable("empty", _NO_ROWS) from error
        except (pd.errors.ParserError, pd.errors.ParserWarning, UnicodeDecodeError) as error:
            if found := _LONG_ROW.search(str(error)):
                raise _too_long(found[1], found[2], text.n_fields) from error
            raise Unusable("corrupt", f"rows cannot be read: {error}") from error


def _spooled(
    read: Callable[[], Any], text: Text, places: dict[str, int], times: Mapping[str, SinceFirst]
) -> dict[str, Samples]:
    """Read the rows block by block."""
    n_rows = n_blank = 0
    taken = {name: Spool() for name in places}
    with read() as tables:
        for table in tables:
            text.pending = 0
            for extra in table.columns[text.n_fields :]:
                filled = table[extra].notna().to_numpy()
                if filled.any():
                    n_found = f"{text.n_fields + 1} or more"
                    raise _too_long(n_rows + int(filled.argmax()) + 1, n_found, text.n_fields)
            n_used = len(table)
            if n_used and table.iloc[-1].isna().all():
                n_used = int(np.flatnonzero([True, *table.notna().any(axis=1)])[-1])
            for name, place in places.items():
                values = table[place]
                is_number = values.dtype.kind in "fiu"
                if not is_number and name not in times:
                    raise not_numeric(name, _first_text(values.tolist(), n_rows))
                numbers = values.to_numpy() if is_number else times[name](parse_moments(values))
                if n_used:
                    taken[name].append(np.full(n_blank, np.nan))
                    taken[name].append(numbers[:n_used])
            n_rows += len(table)
            n_blank = len(table) - n_used + (0 if n_used else n_blank)
    if n_rows == n_blank:
        raise Unusable("empty", _NO_ROWS)
    return {name: spool.samples() for name, spool in taken.items()}


def _too_long(row: object, found: str, needed: int) -> Unusable:
    return corrupt(f"row {row} has {found} fields, the first line {needed}")


def _first_text(values: list[object], n_before: int) -> str:
    """Quote the first field that is no number, with its row."""
    for i, value in enumerate(values):
        try:
            float(value)  # type: ignore[arg-type]
        except (TypeError, ValueError):
            return f"{str(value)[:40]!r} in row {n_before + i + 1}"
    return "text"


_BINARY = (GZIP, b"PAR1", b"\x89HDF")


def _is_text(head: bytes) -> bool:
    """Return whether a file may begin so."""
    return (
        encoding_of(head).startswith(("utf-16", "utf-32")) or b"\0" not in head
    ) and not head.startswith(_BINARY)


CSV = Format("CSV", (".csv", ".lvm"), _is_text, _load)
