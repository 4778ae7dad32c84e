"""Delimited text: leading ``# key: value`` lines, names of the columns, rows of numbers.

pandas reads the rows in blocks of whole lines, which are checked before: pandas accepts rows that
are cut off, and allocates without bound for lines and quotes that do not end.
"""

import codecs
import math
import re
import threading
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lmshealth.io import constants
from lmshealth.io.buffers import Samples, Spool
from lmshealth.io.column_map import ColumnMap, Segments
from lmshealth.io.formats.content import (
    GZIP,
    Content,
    Format,
    SinceFirst,
    choose,
    describe,
    not_numeric,
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
# Bytes per block, at most those of the longest line; rows, fewer of wide tables, of which a block
# stays in the processor's cache.
_BLOCK, _ROWS, _FIELDS = 1 << 18, 1 << 16, 1 << 18
_NO_ROWS = "a header line and no rows; needed rows"
# Lines of further headers, which are no rows.
_MAY_BE_MIXED = re.compile(rb"\n[A-Za-z*\r\n]")
_NO_ROW = re.compile(rb"^(?:[A-Za-z*][^\n]*|[ \t\r]*)\n", re.MULTILINE)
# Message of pandas for a row with too many fields.
_LONG_ROW = re.compile(r"in line (\d+), saw (\d+)")
# Most bytes of text behind the rows: rates, counts and ends that exporters write there.
_TRAILER = 1 << 12
# Between the parts of a number, of which the last is its decimals or its exponent.
_PARTS = re.compile(r"[.,:eE]")
_WORD = re.compile(r"[^\W\d_]{3}")
# Control characters that no text has, in its first lines; all of a file is searched for the first.
_CONTROL = re.compile(rb"[\x00-\x08\x0e-\x19]")


def encoding_of(head: bytes) -> str:
    """Return the encoding of a text: UTF-8 or UTF-16, or a statistical guess."""
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
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
    """A text file, read by lines and then by blocks of whole lines, and checked on the way."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self.position = 0  # bytes that were read
        self.trailer = ""  # what is left out behind the rows

    def read(self, size: int = 0) -> bytes:
        """Read so many bytes, and on to the end of a line; empty at the end of the file.

        `Unusable` (``corrupt``) for a NUL byte, other control characters in single lines, and a
        line without end.
        """
        block: bytes = self._stream.read(size) if size else b""
        block += self._stream.readline(constants.LONGEST_LINE + 1)
        odd = None if size and b"\0" not in block else _CONTROL.search(block)
        if odd:
            what = "NUL byte" if odd[0] == b"\0" else f"control character 0x{odd[0].hex()}"
            at = self.position + odd.start()
            raise Unusable("corrupt", f"{what} at offset {at}; needed text")
        last = block.rfind(b"\n", 0, -1) + 1
        if len(block) - last > constants.LONGEST_LINE:
            found = f"the line at offset {self.position + last} is longer than"
            detail = f"{found} {constants.LONGEST_LINE} bytes; needed one row per line"
            raise Unusable("corrupt", detail)
        self.position += len(block)
        return block

    def rows(self, dialect: Dialect) -> Iterator[bytes]:
        """Yield blocks of rows, without headers between them and lines of text behind them.

        `Unusable` (``corrupt``) for rows without end and for an end inside a row.
        """
        self._stream.seek(0)
        self.position, self.trailer = 0, ""
        header = [self.read() for _ in range(dialect.start)]
        blocks = iter(partial(self.read, _BLOCK), b"")
        if dialect.segments:
            blocks = _without_headers(blocks, header, dialect, dialect.segments)
        held, n_quotes = list[bytes](), 0
        for block in blocks:
            # A field in quotes may go on in the next block; the end of the rows is judged at once.
            if held and len(block) >= _TRAILER and not n_quotes % 2:
                yield b"".join(held)
                held.clear()
            held.append(block)
            n_quotes += block.count(b'"') if b'"' in block else 0  # to count takes long
            if sum(map(len, held)) > constants.LONGEST_BLOCK:
                found = f"no row ends in {constants.LONGEST_BLOCK} bytes before byte"
                needed = "needed shorter rows, and a second quote to every quote"
                raise Unusable("corrupt", f"{found} {self.position}; {needed}")
        rows = self._without_text(b"".join(held), dialect)
        end = rows[rows.rfind(b"\n") + 1 :]
        if end and _is_cut(rows[-_TRAILER:], dialect):
            self.trailer = "the last row ends inside its last number, left out"
            rows, end = rows[: -len(end)], b""
        if rows:
            yield rows
        n_found = len(fields_of(end.decode(errors="replace"), dialect.delimiter))
        n_fields = len(dialect.channels)
        if end and not end.endswith(b"\r") and n_found < n_fields:
            raise corrupt(f"the last row is cut off: {n_found} of {n_fields} fields")

    def _without_text(self, block: bytes, dialect: Dialect) -> bytes:
        """Leave out the lines of text behind the last row."""
        start = max(0, len(block) - _TRAILER)
        lines = block[start:].splitlines(keepends=True)
        kept = len(lines)
        while kept and (not lines[kept - 1].strip() or _is_remark(lines[kept - 1], dialect)):
            kept -= 1
        texts = [line for line in lines[kept:] if line.strip()]
        row = lines[kept - 1].decode("latin-1").strip() if kept else ""
        # A block that is text to its beginning has no rows; rows may begin with text, too.
        if not texts or _WORD.match(row) or (start and kept < 2):
            return block
        if n_lines := sum(not line.startswith(b"EOF") for line in texts):
            self.trailer = f"{n_lines} lines of text behind the rows left out"
        return block[: len(block) - sum(map(len, lines[kept:]))]


def _is_remark(line: bytes, dialect: Dialect) -> bool:
    """Return whether a line is a remark or begins with words; a word alone may be damage."""
    text = line.decode("latin-1").strip()
    if text.startswith(("#", "EOF")):
        return True
    first = (fields_of(text, dialect.delimiter) or [""])[0]
    several = len(dialect.channels) > 1 or len(text.split()) > 1
    return bool(_WORD.match(first)) and several and not is_number_or_moment(first)


def _is_cut(rows: bytes, dialect: Dialect) -> bool:
    """Return whether the last number of the last row has fewer digits than all above it have."""
    # The first row is not counted. -6.133e-0 may be the beginning of -6.133e-05.
    fields = (fields_of(row.decode("latin-1"), dialect.delimiter) for row in rows.split(b"\n")[1:])
    full = [own[-1].strip(' "') for own in fields if len(own) == len(dialect.channels)]
    parts = [_PARTS.split(text.lstrip("+-")) for text in full if text]
    if len(parts) < 5 or not full[-1]:  # of fewer rows a complete one may well be the shortest
        return False
    *others, own = parts
    alike = [len(one[-1]) for one in others if len(one) == len(own)]
    is_short = len("".join(own)) < min(len("".join(one)) for one in others)
    return is_short or len(own[-1]) < min(alike, default=0)


def _without_headers(
    blocks: Iterable[bytes], header: Sequence[bytes], dialect: Dialect, segments: Segments
) -> Iterator[bytes]:
    """Yield blocks without the headers of later segments; the first one is given."""
    # `Unusable` (``format``) for segments without one column of times, which places them in
    # time, with or without headers of their own, and for segments of other columns.
    mark = dialect.delimiter.encode()
    pairs = (line.rstrip().removeprefix(_BOM).partition(mark) for line in header)
    keys = {key: value for key, _, value in pairs}
    same = b"|".join(re.escape(key.encode()) for key in segments.same)
    value = rb"(?:" + re.escape(mark) + rb"([^\n]*)|\r?$)"
    shared = re.compile(rb"^(" + same + rb")" + value, re.MULTILINE)
    is_timed = [channel.name for channel in dialect.channels].count("time") == 1
    sizes = re.findall(rb"\d+", keys.get(segments.rows.encode(), b""))
    n_left = math.inf if is_timed or not sizes else max(map(int, sizes))
    needed = f"needed {segments.needed}, and the same channels in all segments"
    n_lines = len(header)
    for block in blocks:
        rows, found = block, ""
        if _MAY_BE_MIXED.search(b"\n" + block):  # it is quick; most blocks are rows alone
            rows = _NO_ROW.sub(b"", block)
            for match in shared.finditer(block):
                key, stated = match[1], (match[2] or b"").rstrip()
                if not found and (keys.get(key) != stated or not is_timed):
                    line = n_lines + block.count(b"\n", 0, match.start()) + 1
                    found = f"{key.decode()} {stated.decode('cp1252')}"
        n_lines += block.count(b"\n")
        n_left -= rows.count(b"\n")
        if not found and n_left < 0:
            line, found = n_lines + int(n_left) + 1, f"more rows than {segments.rows} states"
        if found:
            raise Unusable("format", f"line {line}: a further segment, {found}; {needed}")
        yield rows


def _load(path: Path, columns: ColumnMap, max_memory: float) -> Content:
    with path.open("rb") as stream:
        # Any text may be a table.
        if foreign := describe(stream.read(_HEAD_BYTES), path):
            raise Unusable("format", foreign)
        stream.seek(0)
        return parse_text(stream, columns)


def parse_text(stream: Any, columns: ColumnMap) -> Content:
    """Read delimited text of any dialect, block by block.

    What is wrong is refused as ``empty``, ``corrupt``, ``metadata``, ``format`` or ``columns``.
    """
    encoding = columns.csv.encoding or encoding_of(stream.read(_HEAD_BYTES))
    encoding = codecs.lookup(encoding).name  # of several spellings
    guessed = [f"{encoding} text"] if encoding != "utf-8" else []
    if encoding.startswith("utf-16"):
        stream, encoding = codecs.EncodedFile(stream, "utf-8", encoding), "utf-8"
    stream.seek(0)
    text, lines = Text(stream), list[str]()
    while text.position < _HEAD_BYTES and len(lines) < _HEAD_LINES and (line := text.read()):
        lines.append(line.removeprefix(_BOM).decode(encoding, "replace"))
    dialect = stated_dialect(lines, columns) or find_dialect(lines, columns)
    guessed += dialect.guessed
    chosen, content = choose(dialect.channels, columns)
    metadata, samples = content.metadata | dialect.metadata, dict[str, Samples]()
    if chosen:
        samples = _numbers(text, chosen, dialect, columns)
        guessed += [text.trailer] if text.trailer else []
    elif not (dialect.has_rows or columns.csv.delimiter) and len(lines) > dialect.start:
        detail = "text without rows of numbers; needed a line of names and rows of samples"
        raise Unusable("format", detail)
    elif dialect.segments:  # segments that cannot be read are named before names
        for _ in text.rows(dialect):
            pass
    return replace(content, columns=samples, metadata=metadata, guessed=tuple(guessed))


class _File:
    """A file for pandas, which takes blocks of any size."""

    def __init__(self, blocks: Iterator[bytes]) -> None:
        self._blocks = blocks

    def read(self, size: int = -1) -> bytes:
        """Return the next block; empty at the end."""
        return next(self._blocks, b"")

    def __iter__(self) -> Iterator[bytes]:
        return self._blocks  # pandas requires it of a file


def _numbers(
    text: Text, places: dict[str, int], dialect: Dialect, columns: ColumnMap
) -> dict[str, Samples]:
    """Read the wanted columns, ``(n_rows,)`` each, NaN where a field is empty."""
    # Moments are read in the columns of times only, since the first of them. Empty lines are
    # left out where time stamps place the rows, and at the end.
    import pandas as pd

    times = {name: SinceFirst(name, columns) for name in places if columns.is_time(name)}
    n_fields = len(dialect.channels)

    def read(times: Mapping[str, SinceFirst], **options: Any) -> dict[str, Samples]:
        tables = pd.read_csv(
            _File(text.rows(dialect)),  # type: ignore[call-overload]
            sep=r"\s+" if dialect.delimiter == " " else dialect.delimiter,
            decimal=dialect.decimal,
            # Numbers are ASCII in every encoding that comes here.
            encoding_errors="replace",
            header=None,
            names=list(range(n_fields)),
            index_col=False,
            # A block is small enough as a whole.
            low_memory=False,
            # Time stamps place the other rows; without them an empty row is a missing sample.
            skip_blank_lines=any(map(columns.is_time, places)),
            chunksize=max(1, min(_ROWS, _FIELDS // n_fields)),
            **options,
        )
        with tables:
            return _spooled(tables, places, times)

    with _WARNINGS, warnings.catch_warnings():
        # A row longer than the header is a warning in pandas and a loss of data here.
        warnings.simplefilter("error", pd.errors.ParserWarning)
        with suppress(ValueError, pd.errors.ParserWarning):
            return read({}, dtype=dict.fromkeys(places.values(), np.float64))
        try:
            # Half as fast, but accepts blanks and locates the fault.
            return read(times, skipinitialspace=True)
        except pd.errors.EmptyDataError as error:
            raise Unusable("empty", _NO_ROWS) from error
        except (pd.errors.ParserError, pd.errors.ParserWarning, UnicodeDecodeError) as error:
            if found := _LONG_ROW.search(str(error)):
                detail = f"row {found[1]} has {found[2]} fields, the first line {n_fields}"
                raise corrupt(detail) from error
            raise Unusable("corrupt", f"rows cannot be read: {error}") from error


def _spooled(
    tables: Iterable[Any], places: dict[str, int], times: Mapping[str, SinceFirst]
) -> dict[str, Samples]:
    """Collect the columns of tables, block by block; empty rows at the end are left out."""
    import pandas as pd

    taken = {name: Spool() for name in places}
    n_rows = n_blank = 0
    for table in tables:
        n_used = len(table)
        if n_used and table.iloc[-1].isna().all():
            n_used = int(np.flatnonzero([True, *table.notna().any(axis=1)])[-1])
        for name, place in places.items():
            values = table[place]
            is_number = values.dtype.kind in "fiu"
            if not is_number and name not in times:
                raise not_numeric(name, _first_text(values.tolist(), n_rows))
            if not is_number:
                words = values.astype(str).str.replace(",", ".")
                # A few other texts do not make moments of numbers.
                n_numbers = pd.to_numeric(words, errors="coerce").notna().sum()
                if n_numbers > values.notna().sum() / 2:
                    raise not_numeric(name, _first_text(words.tolist(), n_rows))
            numbers = values.to_numpy() if is_number else times[name].parse(values)
            if n_used:
                taken[name].append(np.full(n_blank, np.nan))
                taken[name].append(numbers[:n_used])
        n_rows += len(table)
        n_blank = len(table) - n_used + (0 if n_used else n_blank)
    if n_rows == n_blank:
        raise Unusable("empty", _NO_ROWS)
    return {name: spool.samples() for name, spool in taken.items()}


def _first_text(values: list[object], n_before: int) -> str:
    """Quote the first field that is no number, with its row."""
    for i, value in enumerate(values):
        try:
            float(value)  # type: ignore[arg-type]
        except (TypeError, ValueError):
            return f"{str(value)[:40]!r} in row {n_before + i + 1}"
    return "text"


def _is_text(head: bytes) -> bool:
    """Return whether a file may begin so."""
    is_binary = head.startswith((GZIP, b"PAR1", b"\x89HDF"))
    return encoding_of(head).startswith("utf-16") or not (b"\0" in head or is_binary)


CSV = Format("CSV", (".csv", ".lvm"), _is_text, _load)
