"""Delimited text: leading ``# key: value`` lines, a header line, rows of numbers.

Text that streams by: looked at on its way for what no table of numbers holds.
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

from lmshealth.io.buffers import MINUTE, Samples, spools
from lmshealth.io.column_map import ColumnMap, CsvLayout
from lmshealth.io.raw import Format, Raw, check_size, not_numeric, wanted
from lmshealth.io.refusal import Unusable, listed

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


# What becomes of warnings is a setting of the process, which threads share.
_WARNINGS = threading.Lock()
_GZIP_MAGIC = b"\x1f\x8b"
# What separates columns in exports, and in how many first lines their names are looked for.
_DELIMITERS, _HEAD = ",;\t| ", 100
_BOM = b"\xef\xbb\xbf"
# Rows are read so many at a time, and fewer of wide tables: what they take stays in the cache.
_ROWS = 1 << 16
_FIELDS = 1 << 18
# What pandas says of a row with more fields than it was told.
_LONG_ROW = re.compile(r"in line (\d+), saw (\d+)")


def _load_plain(path: Path, columns: ColumnMap, max_memory: float) -> Raw:
    with path.open("rb") as stream:
        return parse_text(stream, path.stat().st_size, columns)


def _load_gzip(path: Path, columns: ColumnMap, max_memory: float) -> Raw:
    with gzip.open(path, "rb") as stream:
        return parse_text(stream, path.stat().st_size, columns)


def parse_text(stream: BufferedIOBase, stored: int, columns: ColumnMap) -> Raw:
    """Read delimited text block by block.

    Parameters
    ----------
    stream : BufferedIOBase
        UTF-8 text, with or without byte order mark.
    stored : int
        Bytes on disk.
    columns : ColumnMap
        Wanted columns and the layout.

    Raises
    ------
    Unusable
        With the reasons ``empty``, ``corrupt``, ``too-large``, ``metadata`` and ``columns``.
    """
    layout = columns.csv
    text = Text(stream, stored)
    _skip(text, layout.skip_rows)
    metadata = _leading_lines(text)
    names = _header(text, layout)
    chosen = wanted(names, columns)
    if twice := sorted({name for name in chosen if names.count(name) > 1}):
        raise Unusable("columns", f"the header names {listed(twice)} more than once")
    if not chosen:
        return Raw({}, metadata, tuple(names), hint=_hint(text, columns))
    places = {name: names.index(name) for name in chosen}
    return Raw(_numbers(text, len(names), places, layout.delimiter), metadata, tuple(names))


def _line(text: Text) -> str:
    """Read a line of the head."""
    start = text.position
    line = text.line()
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError as error:
        raise Unusable(
            "corrupt",
            f"byte {line[error.start]:#04x} at offset {start + error.start} is not UTF-8; "
            "save the file as UTF-8",
        ) from error


def _skip(text: Text, n_lines: int) -> None:
    """Pass over the byte order mark and the first lines, which may be in any encoding."""
    first = text.line()
    text.seek(len(_BOM) if first.startswith(_BOM) else 0)
    for _ in range(n_lines):
        text.line()


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
            raise Unusable(
                "metadata", f"{key} is given twice, as {metadata[key]!r} and {value!r}; keep one"
            )
        start = text.position
    text.seek(start)
    return metadata


def _header(text: Text, layout: CsvLayout) -> list[str]:
    """Name the columns; the text stays where it is when no line of the file does it."""
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
        raise Unusable(
            "columns",
            f"[csv] header names {len(layout.header)} columns, the first row has {len(fields)}",
        )
    return list(layout.header)


def _hint(text: Text, columns: ColumnMap) -> str:
    """Say what under ``[csv]`` may not fit a file whose header names nothing that is wanted."""
    layout = columns.csv
    if layout.header is not True:
        return ""
    text.seek(0)
    head = b"".join(text.line() for _ in range(_HEAD)).removeprefix(_BOM).decode(errors="replace")
    # Leading "# key: value" lines stand before the header; only what else does is to be skipped.
    n_skip = 0
    for n_before, line in enumerate(head.splitlines()):
        fitting = [d for d in (layout.delimiter, *_DELIMITERS) if _names(line, d, columns)]
        if fitting:
            wrong = [] if fitting[0] == layout.delimiter else [f'delimiter = "{fitting[0]}"']
            if not n_skip <= layout.skip_rows <= n_before:
                wrong.append(f"skip_rows = {n_skip}")
            what = " and ".join(wrong).replace("\t", "\\t")
            return f"line {n_before + 1} names them: set {what} under [csv] of the column map"
        if line.strip() and not line.startswith("#"):
            n_skip = n_before + 1
    fits = "do skip_rows and delimiter under [csv] of the column map fit the file?"
    return fits if columns.columns else ""


def _names(line: str, delimiter: str, columns: ColumnMap) -> bool:
    """Tell whether a line names the wanted columns; without a column map, any of the contract."""
    fields = {field.strip().strip('"') for field in line.split(delimiter)}
    if columns.columns:
        return set(columns.columns.values()) <= fields
    return any(columns.target(field) is not None for field in fields)


def _numbers(
    text: Text, n_fields: int, places: dict[str, int], delimiter: str
) -> dict[str, Samples]:
    """Read the wanted columns, ``(n_rows,)`` each, NaN where a field is empty."""
    import pandas as pd

    start = text.position
    text.rows_begin(n_fields, delimiter)
    read = partial(
        pd.read_csv,
        text,
        sep=delimiter,
        header=None,
        names=list(range(n_fields + _spare(pd.__version__))),
        index_col=False,
        # A block is small enough as a whole.
        low_memory=False,
        chunksize=max(1, min(_ROWS, _FIELDS // n_fields)),
    )
    with _WARNINGS, warnings.catch_warnings():
        # A row longer than the header is a warning in pandas and a loss of data here.
        warnings.simplefilter("error", pd.errors.ParserWarning)
        try:
            numbers = dict.fromkeys(places.values(), np.float64)
            return _spooled(partial(read, dtype=numbers), text, places)
        except (ValueError, pd.errors.ParserWarning):
            # Takes twice as long, understands blanks, and knows what is wrong.
            text.seek(start)
            return _carefully(partial(read, skipinitialspace=True), text, places)


def _spooled(read: Callable[[], Any], text: Text, places: dict[str, int]) -> dict[str, Samples]:
    """Take the rows block by block."""
    n_rows = 0
    # How many rows there are nobody knows: memory for a minute is taken as it is filled.
    with spools(places, expected=MINUTE) as taken, read() as blocks:
        for table in blocks:
            text.rows_end()
            _check_width(table, text.n_fields, n_rows)
            for name, place in places.items():
                if table[place].dtype.kind not in "fiu":
                    raise not_numeric(name, _first_text(table[place].tolist(), n_rows))
                taken[name].append(table[place].to_numpy())
            n_rows += len(table)
    if not n_rows:
        raise Unusable("empty", "a header line and no rows; needed rows")
    return {name: spool.samples() for name, spool in taken.items()}


def _carefully(read: Callable[[], Any], text: Text, places: dict[str, int]) -> dict[str, Samples]:
    """Take the rows as whole blocks, or say why that cannot be done."""
    import pandas as pd

    try:
        return _spooled(read, text, places)
    except pd.errors.EmptyDataError as error:
        raise Unusable("empty", "a header line and no rows; needed rows") from error
    except (pd.errors.ParserError, pd.errors.ParserWarning, UnicodeDecodeError) as error:
        if found := _LONG_ROW.search(str(error)):
            raise Unusable("corrupt", _too_long(found[1], found[2], text.n_fields)) from error
        raise Unusable("corrupt", f"rows cannot be read: {error}") from error


def _spare(pandas_version: str) -> int:
    """Give the number of columns more than the header has, for what a row may have too much.

    Before 3.1 pandas drops it from the first row of a block (pandas-dev/pandas pull request 66944).
    """
    major, minor = pandas_version.split(".")[:2]
    return int((int(major), int(minor)) < (3, 1))


def _check_width(table: Any, n_fields: int, n_before: int) -> None:
    """Refuse rows with something in a spare column."""
    for place in table.columns[n_fields:]:
        spilled = table[place].notna().to_numpy()
        if spilled.any():
            row = n_before + int(spilled.argmax()) + 1
            raise Unusable("corrupt", _too_long(row, f"{n_fields + 1} or more", n_fields))


def _too_long(row: object, found: str, needed: int) -> str:
    return f"row {row} has {found} fields, the first line {needed}; copy the file again"


def _first_text(values: list[object], n_before: int) -> str:
    """Quote the first field that is no number, with its row."""
    for i, value in enumerate(values):
        try:
            float(value)  # type: ignore[arg-type]
        except (TypeError, ValueError):
            return f"{str(value)[:40]!r} in row {n_before + i + 1}"
    return "text"


def _sniff_text(head: bytes) -> bool:
    return b"\0" not in head and not head.startswith((_GZIP_MAGIC, b"PAR1", b"\x89HDF"))


CSV = Format("CSV", (".csv",), _sniff_text, _load_plain)
CSV_GZ = Format("gzipped CSV", (".csv.gz",), lambda head: head.startswith(_GZIP_MAGIC), _load_gzip)
