"""Dialect of delimited text: encoding, delimiter, decimal mark, names and units of the columns.

All of it is found from the first lines of the file, unless the column map states it, or a layout
(`layouts/*.toml`, and those of the user) recognises a header of a program.
"""

import csv
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import cache, partial
from pathlib import Path
from statistics import median
from typing import NamedTuple

from lmshealth.io import constants
from lmshealth.io.column_map import (
    DELIMITER,
    SI_TIMES,
    ColumnMap,
    CsvLayout,
    Layout,
    Segments,
    StartMoment,
    load_layouts,
    unit_key,
)
from lmshealth.io.formats.content import Described, rate_of
from lmshealth.io.log import metadata_keys, moment_after
from lmshealth.io.refusal import Unusable, corrupt, listed

# Delimiters in the order in which equal candidates are preferred; a blank is any run of them.
_DELIMITERS = ",;\t| :"
_MARKS = {"\t": "tabs", " ": "blanks"}
# Lines from which a candidate is judged, and the least share of their characters that are numbers.
_JUDGED, _LEAST_SHARE = 100, 0.3
_EMPTY = r"|nan|na|n/a|null|-|[+-]?inf"
_NUMBER = {
    mark: re.compile(rf"[+-]?({body})(e[+-]?\d+)?{_EMPTY}", re.IGNORECASE)
    for mark, body in ((".", r"\d+\.?\d*|\.\d+"), (",", r"\d+(,\d+)?"))
}
# Number of a column in its name.
_INDEX = re.compile(r"\d{1,6}", re.ASCII)
# Numbers with marks between thousands: certainly, and possibly.
_THOUSANDS = re.compile(r"[+-]?\d{1,3}((,\d{3})+\.\d+|(\.\d{3})+,\d+|([,.]\d{3}){2,})")
_MAYBE_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")
_DATE = r"\d{4}-\d\d-\d\d|\d{1,2}[./]\d{1,2}[./]\d{4}"
_CLOCK = r"\d{1,2}:\d\d(:\d\d([.,]\d+)?)?"
_MOMENT = re.compile(rf"({_DATE})([T ]\s*{_CLOCK})?\s*(Z|[+-]\d\d:?\d\d)?|{_CLOCK}")
_REMARK = re.compile(r"\s*(#+|%+|//)\s*")
_UNIT_BEHIND = re.compile(r"(?P<name>.*\S)\s*[\[(](?P<unit>[^\[\]()]*)[\])]\s*")
# First fields of a line of names or units above rows that have no such field.
_KEY = re.compile(
    r"(\w+[ _])?(signals?|channels?|names?|units?)|kanal(name)?|einheit(en)?", re.IGNORECASE
)
_KEYED = re.compile(r"[^\t,;|]*:(\s|$)")
_MICRO = str.maketrans("µμ", "uu")
_OTHER_UNITS = frozenset(
    "min h V mV Volt Volts N Nm °C C K Hz kHz % ° deg rad rpm 1/min - counts inc W bar".split()  # noqa: SIM905
)
# Key of a moment without a time zone, which is no metadatum of a log.
LOCAL_TIME = "local_time"
_FILETIME_EPOCH = datetime(1601, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class Dialect:
    """How a text is read: marks, a channel for each field of a row, and where the rows begin.

    ``start`` counts the lines before the rows; ``guessed`` lists what neither the log contract nor
    the column map states; ``has_rows`` is whether the first lines hold any row of numbers.
    """

    delimiter: str
    decimal: str
    channels: tuple[Described, ...]
    start: int
    metadata: dict[str, str] = field(default_factory=dict)
    guessed: tuple[str, ...] = ()
    has_rows: bool = True
    segments: Segments | None = None


class _Rows(NamedTuple):
    """Rows found with a delimiter and a decimal mark; better ones compare greater."""

    share: float  # of the characters of fields that are in numbers or moments
    several: bool  # whether a row has more than one field
    order: int  # preference among equals
    first: int  # line of the first row
    n_fields: int
    delimiter: str
    decimal: str


def find_dialect(lines: Sequence[str], columns: ColumnMap) -> Dialect:
    """Find marks, names, units and the first row from the first lines of a text.

    `Unusable`: ``empty`` without names or rows, ``corrupt`` where row and names differ in number,
    ``columns`` where the text can be read in two ways, ``metadata`` for a key of the
    contract with two values.
    """
    layout = columns.csv
    skip = layout.skip_rows or 0
    metadata, begin = _leading(lines, skip)
    if begin == len(lines):
        raise Unusable("empty", "no header line and no rows; needed a header line and rows")
    found = max(_candidates(lines, skip, layout), default=None)
    if found is None:
        delimiter, decimal = layout.delimiter or ",", layout.decimal or "."
        n_fields = len(fields_of(lines[begin], delimiter))
        found = _Rows(0.0, False, 0, begin + 1, n_fields, delimiter, decimal)
    if found.share:
        found = found._replace(first=_first_like(lines, skip, found))
    # A spreadsheet fills leading lines up to the number of columns.
    metadata = {key: value.rstrip(f"{found.delimiter} ") for key, value in metadata.items()}
    above = lines[skip : found.first]
    if layout.delimiter is None and layout.decimal is None:
        _check_thousands(lines[found.first :], found.delimiter)
    _check_no_row_before(above, found)
    n_first = len(fields_of(lines[found.first], found.delimiter)) if found.share else 0
    names, units, where = _names(lines, skip, found, max(n_first, found.n_fields), columns)
    guessed = _guessed(found, layout, where, begin)
    channels = tuple(_described(*pair, columns) for pair in zip(names, units, strict=True))
    marks, has_rows = (found.delimiter, found.decimal), found.share > 0
    return Dialect(*marks, channels, found.first, metadata, guessed, has_rows)


def stated_dialect(lines: Sequence[str], columns: ColumnMap) -> Dialect | None:
    """Read the dialect from the header of a text by its layout; None where none recognises it.

    `Unusable`: ``format`` where several recognise it, ``corrupt`` for a header without what its
    layout needs, ``metadata`` for a moment of another format.
    """
    text = "\n".join(line.rstrip("\r\n") for line in lines)
    layouts = {one.name: one for one in (*_shipped(), *columns.layouts)}
    fitting = [one for one in layouts.values() if one.recognises(text)]
    if not fitting:
        return None
    layout = fitting[0]
    if len(fitting) > 1:
        step = "give recognise of one of them a further line"
        raise Unusable("format", f"{listed(x.name for x in fitting)} are its layouts; {step}")
    end = re.search(layout.rows_after, text, re.MULTILINE)
    if end is None:
        raise corrupt(f"is a {layout.name} without a line {layout.rows_after!r} before its rows")
    start = text.count("\n", 0, end.end()) + (not end[0].endswith("\n"))
    header, rows = "\n".join(text.split("\n")[:start]), text.split("\n")[start:]
    if absent := [key for key in layout.required if f"\n{key}" not in f"\n{header}"]:
        raise corrupt(f"is a {layout.name} without a line {listed(absent)} before its rows")
    delimiter = _value(layout.delimiter, header) or " "
    delimiter = chr(int(delimiter)) if re.fullmatch(r"\d{1,3}", delimiter) else delimiter
    decimal = columns.csv.decimal or _value(layout.decimal, header)
    if not decimal:
        _check_thousands(rows, delimiter)
        # The numbers of the first row may be whole.
        decimal = "," if delimiter != "," and any("," in row for row in rows) else "."
    quoted = any('"' in row for row in rows)
    if len(delimiter) != 1 or decimal not in (".", ",") or (delimiter == decimal and not quoted):
        marks = f"the delimiter {delimiter[:9]!r}, the decimal mark {decimal[:9]!r}"
        raise corrupt(f"its header has {marks}")
    row = fields_of(rows[0], delimiter) if rows else []
    channels = _channels(layout, header, delimiter, row, columns)
    found = {key: _value(pattern, header) for key, pattern in layout.metadata.items()}
    metadata = {key: value.strip() for key, value in found.items() if value.strip()}
    if layout.start and "recorded_at" not in columns.metadata:
        metadata |= _start(layout.start, header)
    return Dialect(delimiter, decimal, channels, start, metadata, segments=layout.segments)


def fields_of(line: str, delimiter: str) -> list[str]:
    """Split a line; a blank as delimiter stands for any run of blanks and tabs."""
    if delimiter == " ":
        return line.split()
    try:
        text = [line.rstrip("\r\n")]
        return next(csv.reader(text, delimiter=delimiter, skipinitialspace=True), [])
    except csv.Error as error:
        raise corrupt(f"a line cannot be split: {error}") from error


def is_number_or_moment(word: str) -> bool:
    """Return whether a field of a row may be one, also an empty field."""
    kinds = (*_NUMBER.values(), _MOMENT, _THOUSANDS)
    return any(kind.fullmatch(word) for kind in kinds)


def _leading(lines: Sequence[str], skip: int) -> tuple[dict[str, str], int]:
    """Read the leading lines ``# key: value``, and return the line at which they end."""
    metadata: dict[str, str] = {}
    for k, line in enumerate(lines[skip:], skip):
        if line.strip().strip(_DELIMITERS) and not line.startswith("#"):
            return metadata, k
        key, colon, value = (part.strip() for part in line.lstrip("# \t").partition(":"))
        if colon and metadata.setdefault(key, value) != value and key in metadata_keys():
            both = f"{metadata[key]!r} and {value!r}"
            raise Unusable("metadata", f"{key} is given twice, as {both}; keep one")
    return metadata, len(lines)


def _candidates(lines: Sequence[str], skip: int, layout: CsvLayout) -> Iterator[_Rows]:
    """Yield the rows that each delimiter and decimal mark find."""
    used = [(k, line) for k, line in enumerate(lines[skip:], skip)
            if line.strip() and not line.startswith("#")]  # fmt: skip
    for order, delimiter in enumerate(layout.delimiter or _DELIMITERS):
        split = [(k, fields_of(line, delimiter)) for k, line in used]
        for decimal in layout.decimal or ".,":
            # Numbers with the delimiter in them are quoted.
            fits = delimiter != decimal or any('"' in line for line in lines)
            if fits and (first := _first_row(split, _NUMBER[decimal])) is not None:
                k, fields = split[first]
                judged = [_share(own, _NUMBER[decimal]) for _, own in split[first:][:_JUDGED]]
                share = round(sum(judged) / len(judged), 2)
                rank = -2 * order - (decimal == ",")
                n = len(fields) - (len(fields) > 1 and not fields[-1].strip())
                yield _Rows(share, n > 1, rank, k, n, delimiter, decimal)


def _first_row(split: Sequence[tuple[int, list[str]]], number: re.Pattern[str]) -> int | None:
    """Find the first line of numbers with as many fields as most such lines."""
    # Lines of keys and values, and of numbered channels, have fewer numbers than half of the
    # rows.
    shares = [_share(fields, number) for _, fields in split]
    sizes = {k: len(split[k][1]) for k, share in enumerate(shares) if share > _LEAST_SHARE}
    each = [*sizes.values()]
    most = max(each, key=each.count, default=0)
    rows = [k for k, size in sizes.items() if size == most]
    usual = median(shares[k] for k in rows) if rows else 0.0
    return next((k for k in rows if shares[k] > usual / 2), None)


def _first_like(lines: Sequence[str], skip: int, found: _Rows) -> int:
    """Find the first row below the names: its texts may be longer than those of later rows."""

    def kinds(line: str) -> list[bool | None]:
        """Return which fields are numbers or moments; None for an empty one."""
        words = [one.strip(" \t\r\n-") for one in fields_of(line, found.delimiter)]
        return [is_number_or_moment(word) if word else None for word in words]

    usual, first = kinds(lines[found.first]), found.first
    for k in range(found.first - 1, skip - 1, -1):
        own = kinds(lines[k])
        if lines[k].startswith("#") or (False in own and True not in own):
            break
        # A line of a header may begin with a key where rows have a number or nothing.
        if len(own) != len(usual) or own[0] != usual[0] or True not in own:
            continue
        if not any(there and one is False for one, there in zip(own, usual, strict=True)):
            first = k
    return first


def _share(fields: Sequence[str], number: re.Pattern[str]) -> float:
    """Return the share of the characters of fields that are in numbers or moments."""
    words = [word for one in fields if (word := one.strip())]
    if not any(number.fullmatch(word) or _THOUSANDS.fullmatch(word) for word in words):
        return 0.0
    kinds = number, _MOMENT, _THOUSANDS
    fitting = sum(len(word) for word in words if any(kind.fullmatch(word) for kind in kinds))
    return fitting / sum(map(len, words))


def _heads(lines: Sequence[str], skip: int, found: _Rows) -> Iterator[tuple[int, list[str]]]:
    """Yield lines that may name the columns, the nearest to the rows first."""
    for k in range(len(lines) - 1, skip - 1, -1):
        text = _REMARK.sub("", lines[k], count=1)
        remark = text != lines[k]
        # A key with its value, not a name above the rows; of these a colon may be the delimiter.
        keyed = (remark or k + 1 < len(lines)) and found.delimiter != ":" and _KEYED.match(text)
        for delimiter in (found.delimiter, *_DELIMITERS) if text.strip() and not keyed else ():
            fields = [one.strip() for one in fields_of(text, delimiter)]
            n = len(fields) - (len(fields) == found.n_fields + 1 and not fields[-1])
            if n == found.n_fields + 1 and _KEY.fullmatch(fields[0]):
                fields, n = fields[1:], n - 1
            # A remark names several columns; a line of one field is a title of several.
            if n == found.n_fields and not (remark and n == 1):
                yield k, fields[:n]
                break
            if delimiter == found.delimiter and n > 1 and not remark:
                yield k, fields


def _check_no_row_before(lines: Sequence[str], found: _Rows) -> None:
    """Require that the line before the first row is no row of another length."""
    last = next((line for line in reversed(lines) if line.strip()), "")
    fields = fields_of(last, found.delimiter)
    if not last.startswith("#") and _share(fields, _NUMBER[found.decimal]) > _LEAST_SHARE:
        step = "or set skip_rows under [csv] of the column map"
        raise corrupt(f"row 1 has {len(fields)} fields, the next {found.n_fields}; {step}")


def _check_thousands(lines: Sequence[str], delimiter: str) -> None:
    """Refuse rows whose commas or points may be decimal marks or marks between thousands."""
    words = [word.strip() for line in lines for word in fields_of(line, delimiter)]
    if sure := next(filter(_THOUSANDS.fullmatch, words), None):
        raise Unusable("columns", f"{sure!r} has marks between thousands; export without them")
    marked = [word for word in words if "," in word]
    if marked and all(map(_MAYBE_THOUSANDS.fullmatch, marked)):
        step = 'if these are decimals set decimal = "," under [csv] of the column map'
        raise Unusable("columns", f"{marked[0]!r} may have a mark between thousands; {step}")


def _names(
    lines: Sequence[str], skip: int, found: _Rows, most: int, columns: ColumnMap
) -> tuple[list[str], list[str], int | None]:
    """Name the columns, with their units, and return the line of the names, if there is one."""
    # A row has ``most`` fields, of which the last may be empty and without a name.
    n, header = found.n_fields, columns.csv.header
    if isinstance(header, list):
        if len(header) != n:
            detail = f"[csv] header names {len(header)} columns, the first row has {n}"
            raise Unusable("columns", detail)
        return list(header), [""] * n, None
    mapped = set(columns.columns.values())
    unnamed = header is False or (mapped and all(map(str.isdecimal, mapped)))
    heads = [] if unnamed else list(_heads(lines[: found.first], skip, found))
    if not heads:
        return [str(i) for i in range(n)], [""] * n, None
    # Names differ; a line of the names that the column map has needs no other sign.
    own = [one for one in heads if mapped and mapped <= set(one[1])]
    unlike = [one for one in heads if all(one[1]) and len(set(one[1])) == len(one[1])]
    unlike = [one for one in unlike if not all(map(_is_unit, one[1]))] or unlike
    own += sorted(unlike, key=lambda one: sum(map(str.isdecimal, one[1])))
    where, names = (own or heads)[0]
    if n and not n <= len(names) <= most:
        found_there = f"row 1 has {n} fields, the line of names {len(names)}"
        raise corrupt(f"{found_there}; or list the names by header under [csv] of the column map")
    k = heads.index((where, names))
    # Below the names, or else in any other line.
    others = [fields for _, fields in (*heads[max(k - 1, 0) : k], *heads) if fields is not names]
    fitting = (one for one in others if len(one) == len(names) and all(map(_is_unit, one)))
    units = next(filter(any, fitting), [""] * len(names))
    bare = (word.strip(" []()") for word in units)
    return names, ["" if _KEY.fullmatch(word) else word for word in bare], where


def _is_unit(word: str) -> bool:
    """Return whether a field of a line of units may be one; it may be empty."""
    bare = word.strip(" []()")
    bare = "" if _KEY.fullmatch(bare) else bare
    return not bare or bare in _OTHER_UNITS or unit_key(bare) is not None


def _described(name: str, unit: str, columns: ColumnMap) -> Described:
    """Describe a column; a unit in brackets behind its name is its unit."""
    behind = _UNIT_BEHIND.fullmatch(name)
    if name in columns.columns.values():
        return Described(name, unit)
    if unit or behind is None or not _is_unit(behind["unit"]):
        return Described(name.translate(_MICRO), unit)
    return Described(behind["name"], behind["unit"])


def _guessed(found: _Rows, layout: CsvLayout, where: int | None, begin: int) -> tuple[str, ...]:
    """List what differs from the log contract without being stated by the column map."""
    guessed = []
    if layout.delimiter is None and found.delimiter != ",":
        guessed.append(f"{_MARKS.get(found.delimiter, repr(found.delimiter))} between fields")
    if layout.decimal is None and found.decimal != ".":
        guessed.append("decimal commas")
    if where is not None and where != begin:
        guessed.append(f"names in line {where + 1}")
    if where is None and layout.header is None:
        guessed.append('no line of names (the columns are "0", "1", ...)')
    return tuple(guessed)


@cache
def _shipped() -> tuple[Layout, ...]:
    return load_layouts(Path(__file__).parent / "layouts")


def _value(pattern: str | None, header: str) -> str:
    """Return what the last match of a pattern finds, or a text as it is; empty where nothing."""
    if pattern is None or not re.compile(pattern).groups:
        return pattern or ""
    found = [*re.finditer(pattern, header, re.MULTILINE)][-1:]
    return "".join(match[match.re.groups] or "" for match in found)


def _cells(pattern: str | None, header: str, delimiter: str, n: int) -> list[str]:
    """Return what a pattern finds for each of ``n`` columns, or in a longer row for each field."""
    if pattern and "column" in re.compile(pattern).groupindex:
        found = {int(m["column"]): (m[m.re.groups] or "").strip()
                 for m in re.finditer(pattern, header, re.MULTILINE)
                 if _INDEX.fullmatch(m["column"])}  # fmt: skip
        first = int(0 not in found)  # columns are counted from 0 or 1
        return [found.get(k + first, "") for k in range(n)]
    row = [one.strip() for one in fields_of(_value(pattern, header), delimiter)]
    if len(row) == 1 < n:
        return row * n
    while row and not row[-1]:
        row.pop()
    return row + [""] * (n - len(row))


def _channels(
    layout: Layout, header: str, delimiter: str, row: Sequence[str], columns: ColumnMap
) -> tuple[Described, ...]:
    """Describe the columns of a first row: times, and channels with unit, rate and start."""
    mark = re.escape(delimiter)
    patterns = layout.names, layout.units, layout.interval, layout.offset
    named, *others = (pattern and pattern.replace(DELIMITER, mark) for pattern in patterns)
    rows = partial(_cells, header=header, delimiter=delimiter)
    # A row of names may be longer than the rows; other names are as many as the fields.
    names = rows(named, n=0)
    if named and not names and "(?P<column>" not in named:
        raise corrupt(f"its header has no row of names, {layout.names!r}")
    names = names or rows(named, n=len(row))
    units, intervals, offsets = (rows(pattern, n=len(names)) for pattern in others)
    time, channels = layout.time, list[Described]()
    timed = [k for k, name in enumerate(names)
             if time and name == time.name and all(row[k : k + 1])]  # fmt: skip
    for k in reversed(range(len(names))):
        if time and k in timed:
            # One of several has the rate and the start of the channel behind it.
            own = channels[-1] if len(timed) > 1 and channels else Described("", "")
            if len(timed) > 1 and own.rate is None:
                raise corrupt(f"its header has no interval of samples for the column {own.name!r}")
            channels.append(Described("time", time.unit, own.rate, start=own.start))
            continue
        interval, name = _number(intervals[k]), names[k] or str(k)
        rate = rate_of(interval and interval * SI_TIMES[layout.interval_unit])
        # One column of times places the samples of all channels.
        start = 0.0 if len(timed) == 1 else _number(offsets[k]) or 0.0
        unit = re.split(r"[\[\]()]", units[k].strip(" []()"))[0]  # "[g]", "g (Acceleration)"
        one = Described(name, unit.strip()) if layout.units else _described(name, "", columns)
        channels.append(replace(one, rate=rate, start=start))
    return tuple(reversed(channels))


def _start(start: StartMoment, header: str) -> dict[str, str]:
    """Return the moment of the first sample as metadata; local time where there is no time zone."""
    parts = [_value(pattern, header).strip() for pattern in start.find]
    text = " ".join(parts)
    if not all(parts):
        return {}
    try:
        if start.format == "filetime":
            ticks = int(text) // 10
            moment = moment_after(_FILETIME_EPOCH, ticks, timedelta(microseconds=1))
            return {"recorded_at": moment} if ticks else {}
        if start.format == "unix":
            return {"recorded_at": moment_after(constants.FIRST_MOMENT, float(text))}
        if start.format != "iso":
            found = datetime.strptime(text, start.format)
        else:
            found = datetime.fromisoformat(text.replace("/", "-").replace(",", "."))
    except (ValueError, OverflowError, re.error) as error:
        step = "correct the format of its layout, or set recorded_at by a column map"
        raise Unusable("metadata", f"starts at {text!r}, no {start.format}; {step}") from error
    return {"recorded_at" if found.tzinfo else LOCAL_TIME: found.isoformat()}


def _number(text: str) -> float | None:
    """Read a finite number with a decimal point or comma; None for any other text."""
    try:
        found = float(text.replace(",", "."))
    except ValueError:
        return None
    return found if math.isfinite(found) else None
