"""Delimited text: leading ``# key: value`` lines, a header line, rows of numbers.

pandas reads the rows from a stream that checks the text before pandas does: pandas accepts rows
that are cut off, and allocates without bound for lines and quotes that do not end.
"""

from __future__ import annotations

import csv
import gzip
import re
import threading
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from io import BufferedIOBase
from pathlib import Path
from typing import Any

import numpy as np

from lmshealth.io import constants
from lmshealth.io.buffers import Samples, Spool
from lmshealth.io.column_map import ColumnMap, CsvLayout
from lmshealth.io.formats.content import Content, Format, check_size, not_numeric, wanted
from lmshealth.io.refusal import Unusable, corrupt

# The filters of warnings belong to the process, which threads share.
_WARNINGS = threading.Lock()
_GZIP_MAGIC = b"\x1f\x8b"
_BOM = b"\xef\xbb\xbf"
# Delimiters of exports, and the number of lines in which the column names are searched.
_DELIMITERS, _HEAD = ",;\t| ", 100
# Rows per block, fewer of wide tables: a block stays in the processor's cache.
_ROWS = 1 << 16
_FIELDS = 1 << 18
_NO_ROWS = "a header line and no rows; needed rows"
# Message of pandas for a row with too many fields.
_LONG_ROW = re.compile(r"in line (\d+), saw (\d+)")


class Text:
    """A text file, read by lines and then by blocks, and checked on the way.

    The stream is seekable and decompressed; ``stored`` bytes on disk limit its size. From
    ``position`` on, the byte that is read next, every row has ``n_fields`` (0 where no rows have
    begun); ``pending`` counts the bytes since the last complete row.
    """

    def __init__(self, stream: BufferedIOBase, stored: int, delimiter: str) -> None:
        self._stream = stream
        self._stored = stored
        self._delimiter = delimiter.encode()
        self.n_fields = 0
        self.seek(0)

    def seek(self, position: int) -> None:
        """Go to the beginning of a line, a former `position`."""
        self._stream.seek(position)
        self.position = position
        self.pending = 0
        self._tail = b""  # bytes after the last line feed

    def line(self) -> bytes:
        """Read a line with its end, with the checks of `read`; empty at the end of the file."""
        return self._checked(self._stream.readline(constants.LONGEST_LINE + 1))

    def read(self, size: int = -1) -> bytes:
        """Read a block of at most ``size`` bytes; empty at the end of the file.

        `Unusable`: ``corrupt`` for a NUL byte, for lines or rows without end and for an end inside
        a row, ``too-large`` for more than the file can honestly hold.
        """
        block = self._checked(self._stream.read(size))
        if not block and self._tail and not self._tail.endswith(b"\r"):
            # The last number of a file that ends inside a row may be incomplete.
            n_found = self._tail.count(self._delimiter) + 1
            if n_found < self.n_fields:
                raise corrupt(f"the last row is cut off: {n_found} of {self.n_fields} fields")
        self.pending += len(block)
        if self.pending > constants.LONGEST_BLOCK:
            found = f"no row ends in {constants.LONGEST_BLOCK} bytes before byte {self.position}"
            needed = "needed shorter rows, and a second quote to every quote"
            raise Unusable("corrupt", f"{found}; {needed}")
        return block

    def __iter__(self) -> Iterator[bytes]:
        """Iterate over lines; pandas requires it of a file."""
        return iter(self.line, b"")

    def _checked(self, block: bytes) -> bytes:
        if b"\0" in block:
            at = self.position + block.index(0)
            raise Unusable("corrupt", f"NUL byte at offset {at}; needed UTF-8 text")
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
    opened = gzip.open if path.name.lower().endswith(".gz") else open
    with opened(path, "rb") as stream:
        return parse_text(stream, path.stat().st_size, columns)


def parse_text(stream: Any, stored: int, columns: ColumnMap) -> Content:
    """Read delimited UTF-8 text, with or without byte order mark, block by block.

    What is wrong is refused as ``empty``, ``corrupt``, ``too-large``, ``metadata`` or ``columns``.
    """
    layout = columns.csv
    text = Text(stream, stored, layout.delimiter)
    # The skipped lines may be in any encoding.
    text.seek(len(_BOM) if text.line().startswith(_BOM) else 0)
    for _ in range(layout.skip_rows):
        text.line()
    metadata = _leading_lines(text)
    names = _header(text, layout)
    place = {name: k for k, name in enumerate(names)}
    places = {name: place[name] for name in wanted(names, columns)}
    if not places:
        return Content({}, metadata, tuple(names), hint=_hint(text, columns))
    text.n_fields = len(names)
    return Content(_numbers(text, places, layout), metadata, tuple(names))


def _line(text: Text) -> str:
    """Read a line before the rows."""
    start = text.position
    line = text.line()
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError as error:
        what = f"byte {line[error.start]:#04x} at offset {start + error.start}"
        raise Unusable("corrupt", f"{what} is not UTF-8; save the file as UTF-8") from error


def _leading_lines(text: Text) -> dict[str, str]:
    """Read the leading ``# key: value`` lines; those without a colon are remarks."""
    metadata: dict[str, str] = {}
    start = text.position
    while line := _line(text):
        if line.strip() and not line.startswith("#"):
            break
        key, colon, value = line.lstrip("# \t").partition(":")
        key, value = key.strip(), value.strip()
        if colon and metadata.setdefault(key, value) != value:
            both = f"{metadata[key]!r} and {value!r}"
            raise Unusable("metadata", f"{key} is given twice, as {both}; keep one")
        if len(metadata) > constants.MOST_KEYS:
            found = f"more than {constants.MOST_KEYS} lines of metadata"
            raise Unusable("metadata", f"{found}; keep those that a log needs")
        start = text.position
    text.seek(start)
    return metadata


def _header(text: Text, layout: CsvLayout) -> list[str]:
    """Name the columns; the text stays at its position when no header line does it."""
    start = text.position
    line = _line(text).rstrip("\r\n")
    if not line:
        raise Unusable("empty", "no header line and no rows; needed a header line and rows")
    try:
        fields = next(csv.reader([line], delimiter=layout.delimiter), [])
    except csv.Error as error:
        raise Unusable("corrupt", f"header line cannot be read: {error}") from error
    if layout.header is True:
        return [field.strip() for field in fields]
    text.seek(start)
    if layout.header is False:
        return [str(i) for i in range(len(fields))]
    if len(layout.header) != len(fields):
        found = f"[csv] header names {len(layout.header)} columns"
        raise Unusable("columns", f"{found}, the first row has {len(fields)}")
    return list(layout.header)


def _hint(text: Text, columns: ColumnMap) -> str:
    """Suggest ``[csv]`` keys for a file whose header names no wanted column."""
    layout = columns.csv
    if layout.header is not True:
        return ""
    text.seek(0)
    head = b"".join(text.line() for _ in range(_HEAD)).removeprefix(_BOM).decode(errors="replace")
    lines = head.splitlines()
    # Leading "# key: value" lines before the header are not skipped, other lines are.
    n_skip = 0
    for n_before, line in enumerate(lines):
        fitting = [d for d in (layout.delimiter, *_DELIMITERS) if _names(line, d, columns)]
        if fitting:
            wrong = [] if fitting[0] == layout.delimiter else [f'delimiter = "{fitting[0]}"']
            if not n_skip <= layout.skip_rows <= n_before:
                wrong.append(f"skip_rows = {n_skip}")
            keys = " and ".join(wrong).replace("\t", "\\t")
            return f"line {n_before + 1} names them: set {keys} under [csv] of the column map"
        if line.strip() and not line.startswith("#"):
            n_skip = n_before + 1
    rows = [s for s in lines[layout.skip_rows :] if s.strip() and not s.startswith("#")]
    if rows and any(_is_row(rows[0], delimiter) for delimiter in (layout.delimiter, *_DELIMITERS)):
        keys = 'set header = false under [csv] and name the columns "0", "1", … under [columns]'
        return f"the first line holds only numbers: if no line names the columns, {keys}"
    fits = "do skip_rows and delimiter under [csv] of the column map fit the file?"
    return fits if columns.columns else ""


def _names(line: str, delimiter: str, columns: ColumnMap) -> bool:
    """Return whether a line names the wanted columns; without a column map, any of the contract."""
    fields = {field.strip().strip('"') for field in line.split(delimiter)}
    if columns.columns:
        return set(columns.columns.values()) <= fields
    return any(columns.target(field) is not None for field in fields)


def _is_row(line: str, delimiter: str) -> bool:
    """Return whether all fields of a line are numbers."""
    try:
        return bool([float(field.replace(",", ".")) for field in line.split(delimiter)])
    except ValueError:
        return False


def _numbers(text: Text, places: dict[str, int], layout: CsvLayout) -> dict[str, Samples]:
    """Read the wanted columns, ``(n_rows,)`` each, NaN where a field is empty."""
    import pandas as pd

    start = text.position
    # Before 3.1 pandas drops an extra field of the first row of a block (pandas-dev/pandas pull
    # request 66944): a spare column receives it.
    major, minor = pd.__version__.split(".")[:2]
    n_spare = int((int(major), int(minor)) < (3, 1))
    read = partial(
        pd.read_csv,
        text,
        sep=layout.delimiter,
        decimal=layout.decimal,
        header=None,
        names=list(range(text.n_fields + n_spare)),
        index_col=False,
        # A block is small enough as a whole.
        low_memory=False,
        chunksize=max(1, min(_ROWS, _FIELDS // text.n_fields)),
    )
    with _WARNINGS, warnings.catch_warnings():
        # A row longer than the header is a warning in pandas and a loss of data here.
        warnings.simplefilter("error", pd.errors.ParserWarning)
        try:
            numbers = dict.fromkeys(places.values(), np.float64)
            return _spooled(partial(read, dtype=numbers), text, places)
        except (ValueError, pd.errors.ParserWarning):
            # Half as fast, but accepts blanks and locates the fault.
            text.seek(start)
        try:
            return _spooled(partial(read, skipinitialspace=True), text, places)
        except pd.errors.EmptyDataError as error:
            raise Unusable("empty", _NO_ROWS) from error
        except (pd.errors.ParserError, pd.errors.ParserWarning, UnicodeDecodeError) as error:
            if found := _LONG_ROW.search(str(error)):
                raise _too_long(found[1], found[2], text.n_fields) from error
            raise Unusable("corrupt", f"rows cannot be read: {error}") from error


def _spooled(read: Callable[[], Any], text: Text, places: dict[str, int]) -> dict[str, Samples]:
    """Read the rows block by block."""
    n_rows = 0
    taken = {name: Spool() for name in places}
    with read() as blocks:
        for table in blocks:
            text.pending = 0
            for extra in table.columns[text.n_fields :]:
                filled = table[extra].notna().to_numpy()
                if filled.any():
                    n_found = f"{text.n_fields + 1} or more"
                    raise _too_long(n_rows + int(filled.argmax()) + 1, n_found, text.n_fields)
            for name, place in places.items():
                if table[place].dtype.kind not in "fiu":
                    raise not_numeric(name, _first_text(table[place].tolist(), n_rows))
                taken[name].append(table[place].to_numpy())
            n_rows += len(table)
    if not n_rows:
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
            found = f"{str(value)[:40]!r} in row {n_before + i + 1}"
            hint = ' (for decimal commas set decimal = "," under [csv] of the column map)'
            return found + (hint if _is_row(str(value), ";") else "")
    return "text"


_BINARY = (_GZIP_MAGIC, b"PAR1", b"\x89HDF")
CSV = Format(
    "CSV", (".csv",), lambda head: b"\0" not in head and not head.startswith(_BINARY), _load
)
CSV_GZ = Format("gzipped CSV", (".csv.gz",), lambda head: head.startswith(_GZIP_MAGIC), _load)
