"""CSV and gzipped CSV: leading ``# key: value`` lines, a header line, rows of numbers."""

from __future__ import annotations

import csv
import gzip
import io
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lmshealth.arrays import FloatArray
from lmshealth.readers.columns import ColumnMap, CsvLayout
from lmshealth.readers.raw import Format, Raw, check_size, not_numeric, wanted
from lmshealth.readers.trouble import Unusable, listed

_GZIP_MAGIC = b"\x1f\x8b"
_BLOCK = 1 << 20
_BOM = b"\xef\xbb\xbf"


def _load_plain(path: Path, columns: ColumnMap) -> Raw:
    size = path.stat().st_size
    check_size(size, size)
    return parse_text(path.read_bytes(), columns)


def _load_gzip(path: Path, columns: ColumnMap) -> Raw:
    stored = path.stat().st_size
    # Unpacked block by block, so that a bomb is stopped before it fills the memory.
    blocks: list[bytes] = []
    decoded = 0
    with gzip.open(path, "rb") as stream:
        while block := stream.read(_BLOCK):
            decoded += len(block)
            check_size(decoded, stored)
            blocks.append(block)
    return parse_text(b"".join(blocks), columns)


def parse_text(data: bytes, columns: ColumnMap) -> Raw:
    """Read delimited text.

    Parameters
    ----------
    data : bytes
        UTF-8 text, with or without byte order mark.
    columns : ColumnMap
        Wanted columns and the layout.

    Raises
    ------
    Unusable
        With the reasons ``empty``, ``corrupt``, ``metadata`` and ``columns``.
    """
    if b"\0" in data:
        raise Unusable("corrupt", f"NUL byte at offset {data.index(0)}; needed UTF-8 text")
    layout = columns.csv
    start = _skip(data, layout.skip_rows)
    metadata, start = _leading_lines(data, start)
    names, start = _header(data, start, layout)
    chosen = wanted(names, columns)
    if twice := sorted({name for name in chosen if names.count(name) > 1}):
        raise Unusable("columns", f"the header names {listed(twice)} more than once")
    if not chosen:
        return Raw({}, metadata, tuple(names))
    _check_last_line(data, start, len(names), layout.delimiter)
    table = _numbers(data, start, names, chosen, layout.delimiter)
    return Raw(table, metadata, tuple(names))


def _line(data: bytes, start: int) -> tuple[str, int]:
    """Give the line that begins at ``start`` and where the next one begins."""
    end = data.find(b"\n", start)
    end = len(data) if end < 0 else end + 1
    try:
        return data[start:end].decode("utf-8").rstrip("\r\n"), end
    except UnicodeDecodeError as error:
        raise Unusable(
            "corrupt",
            f"byte {data[start + error.start]:#04x} at offset {start + error.start} is not UTF-8; "
            "save the file as UTF-8",
        ) from error


def _skip(data: bytes, n_lines: int) -> int:
    """Give the offset behind the first lines, which may be in any encoding."""
    start = len(_BOM) if data.startswith(_BOM) else 0
    for _ in range(n_lines):
        end = data.find(b"\n", start)
        if end < 0:
            return len(data)
        start = end + 1
    return start


def _leading_lines(data: bytes, start: int) -> tuple[dict[str, str], int]:
    """Read the leading ``# key: value`` lines; those without a colon are remarks."""
    metadata: dict[str, str] = {}
    while start < len(data):
        line, following = _line(data, start)
        if line.strip() and not line.startswith("#"):
            break
        key, colon, value = line.lstrip("# \t").partition(":")
        key, value = key.strip(), value.strip()
        if colon and metadata.setdefault(key, value) != value:
            raise Unusable(
                "metadata", f"{key} is given twice, as {metadata[key]!r} and {value!r}; keep one"
            )
        start = following
    return metadata, start


def _header(data: bytes, start: int, layout: CsvLayout) -> tuple[list[str], int]:
    """Name the columns; the offset stays where it is when no line of the file does it."""
    if start >= len(data):
        raise Unusable("empty", "no header line and no rows; needed a header line and rows")
    line, following = _line(data, start)
    try:
        fields = next(csv.reader([line], delimiter=layout.delimiter), [])
    except csv.Error as error:
        raise Unusable("corrupt", f"header line cannot be read: {error}") from error
    if layout.header is True:
        return [field.strip() for field in fields], following
    if layout.header is False:
        return [str(i) for i in range(len(fields))], start
    if len(layout.header) != len(fields):
        raise Unusable(
            "columns",
            f"[csv] header names {len(layout.header)} columns, the first row has {len(fields)}",
        )
    return list(layout.header), start


def _check_last_line(data: bytes, start: int, n_fields: int, delimiter: str) -> None:
    """Refuse a file that was cut in the middle of a row; pandas would fill the row with NaN."""
    if start >= len(data):
        raise Unusable("empty", "a header line and no rows; needed rows")
    if data.endswith((b"\n", b"\r")):
        return
    last = data[max(data.rfind(b"\n"), start - 1) + 1 :]
    n_found = last.count(delimiter.encode()) + 1
    if n_found < n_fields:
        raise Unusable(
            "corrupt",
            f"the last row is cut off: {n_found} of {n_fields} fields; copy the file again",
        )


def _numbers(
    data: bytes, start: int, names: list[str], chosen: list[str], delimiter: str
) -> dict[str, FloatArray]:
    """Read the wanted columns from ``start`` on, ``(n_rows,)`` each, NaN where a field is empty."""
    import pandas as pd

    read = partial(
        pd.read_csv, sep=delimiter, header=None, names=list(range(len(names))), index_col=False
    )
    places = {name: names.index(name) for name in chosen}
    with warnings.catch_warnings():
        # A row longer than the header is a warning in pandas and a loss of data here.
        warnings.simplefilter("error", pd.errors.ParserWarning)
        # Columns that are not wanted may hold anything.
        warnings.simplefilter("ignore", pd.errors.DtypeWarning)
        try:
            numbers = dict.fromkeys(places.values(), np.float64)
            table: Any = read(_from(data, start), dtype=numbers)
        except (ValueError, pd.errors.ParserWarning):
            # Takes twice as long, understands blanks, and knows what is wrong.
            table = _carefully(read, _from(data, start))
    for name, place in places.items():
        if table[place].dtype.kind not in "fiu":
            raise not_numeric(name, _first_text(table[place].tolist()))
    return {name: np.array(table[place], dtype=np.float64) for name, place in places.items()}


def _from(data: bytes, start: int) -> io.BytesIO:
    """Open bytes at an offset, without copying them."""
    stream = io.BytesIO(data)
    stream.seek(start)
    return stream


def _carefully(read: Callable[..., Any], stream: io.BytesIO) -> Any:
    """Read rows as whole columns, or say why that cannot be done."""
    import pandas as pd

    try:
        return read(stream, low_memory=False, skipinitialspace=True)
    except (pd.errors.ParserError, pd.errors.ParserWarning, UnicodeDecodeError) as error:
        raise Unusable("corrupt", f"rows cannot be read: {error}") from error


def _first_text(values: list[object]) -> str:
    """Quote the first field that is no number, with its row."""
    for i, value in enumerate(values):
        try:
            float(value)  # type: ignore[arg-type]
        except (TypeError, ValueError):
            return f"{str(value)[:40]!r} in row {i + 1}"
    return "text"


def _sniff_text(head: bytes) -> bool:
    return b"\0" not in head and not head.startswith((_GZIP_MAGIC, b"PAR1", b"\x89HDF"))


CSV = Format("CSV", (".csv",), _sniff_text, _load_plain)
CSV_GZ = Format("gzipped CSV", (".csv.gz",), lambda head: head.startswith(_GZIP_MAGIC), _load_gzip)
