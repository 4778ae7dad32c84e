"""Delimited text: leading ``# key: value`` lines, a header line, rows of numbers."""

from __future__ import annotations

import csv
import gzip
import re
import threading
import warnings
from collections.abc import Callable
from functools import partial
from io import BufferedIOBase
from pathlib import Path
from typing import Any

import numpy as np

from lmshealth.readers.columns import ColumnMap, CsvLayout
from lmshealth.readers.raw import Format, Raw, not_numeric, wanted
from lmshealth.readers.spool import spools
from lmshealth.readers.text import Text
from lmshealth.readers.trouble import Unusable, listed
from lmshealth.samples import MINUTE, Samples

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


def _load_plain(path: Path, columns: ColumnMap) -> Raw:
    with path.open("rb") as stream:
        return parse_text(stream, path.stat().st_size, columns)


def _load_gzip(path: Path, columns: ColumnMap) -> Raw:
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
