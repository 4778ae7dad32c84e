"""UFF58: time records and frequency responses at nodal degrees of freedom, in ASCII or binary.

pyuff reads the data sets 58 from a copy that holds no others: it drops a data set that is cut off,
and pairs tags wrongly where a line of another data set ends like one.
"""

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from lmshealth._private.arrays import ComplexArray, FloatArray
from lmshealth.io.buffers import Samples, as_samples
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.content import (
    Content,
    Described,
    Format,
    check_memory,
    choose,
    foreign,
    library,
    not_numeric,
    rate_of,
)
from lmshealth.io.refusal import Unusable, corrupt, listed

_START = re.compile(rb"\s*-1[ \t]*\r?\n[ \t]*\d+")
_BEGIN = re.compile(rb"[\s\x1a]*?^    -1[ \t]*\r?\n", re.MULTILINE)
_END = re.compile(rb"^    -1[ \t\x1a]*(?:\r?\n|\Z)", re.MULTILINE)
# Binary numbers need not end with their line.
_BINARY_END = re.compile(rb"    -1[ \t\x1a]*(?:\r|\n|\Z)")
_TAG = b"    -1\n"
_FUNCTION, _N_RECORDS = 58, 11

# Codes of the headers.
_TIME_RESPONSE, _UNKNOWN = 1, 0
_TIME, _ACCELERATION = 17, 12
_RESPONSE, _COHERENCE = 4, 6
_REAL, _COMPLEX = (2, 4), (5, 6)
# Names in a header of degrees of freedom by their code; rotations are 4 to 6.
_DIRECTIONS = ("", "X", "Y", "Z", "RX", "RY", "RZ")
_HERTZ = ("", "none", "Hz", "hz", "hertz", "1/s")
_SECONDS = ("", "none", "s", "sec", "second", "seconds")
_UNEVEN, _EVEN = 0, 1
# Most bytes of a header, and those that fill up a block of binary numbers.
_HEADER, _FILL = 4096, b"\0 \r\n\x1a"
# Columns of the values in a row by type of the ordinate and spacing of the abscissa; those of
# single precision take 13 each.
_SINGLE = (2, 5)
_WIDTHS: dict[tuple[int, int], tuple[int, ...]] = {(4, _EVEN): (20,) * 4, (6, _EVEN): (20,) * 4}
_WIDTHS |= {(4, _UNEVEN): (13, 20) * 2, (6, _UNEVEN): (13, 20, 20)}

# Date in the third line of a header.
_DATE = re.compile(r"(\d\d?)-([A-Za-z]{3})-(?:\d\d)?(\d\d)\s+(\d\d?):(\d\d):(\d\d)")

# Bytes of memory for a byte of the file and of the data set that is read.
_FILE_MEMORY, _SET_MEMORY = 3, 16

Header = dict[str, Any]


def _load(path: Path, columns: ColumnMap, max_memory: float) -> Content:
    with TemporaryDirectory(prefix="lmshealth-") as folder:
        file = _File(path, Path(folder), max_memory)
        names = _names(file.headers)
        asked = set(columns.columns.values()) & set(names)
        if not asked and not any(map(_is_time_record, file.headers)):
            raise _no_time_records(file.headers, names, file.others)
        dates = _dates(file.headers)
        described = [_describe(*named) for named in zip(file.headers, names, dates, strict=True)]
        chosen, content = choose(described, columns)
        read, stamps, n_stamped = dict[str, Samples](), None, 0
        for name, k in chosen.items():
            header = file.headers[k]
            if not _is_time_record(header):
                kind = header["func_type"]
                raise not_numeric(name, f"no time record but the function type {kind}")
            time, values = file.numbers(k, name, _SECONDS)
            read[name] = as_samples(values)
            if header["abscissa_spacing"] == _UNEVEN:
                stamps = time if stamps is None else stamps
                n_stamped += np.array_equal(time, stamps)
    if stamps is not None:
        if n_stamped < len(read):
            detail = "the records have different time stamps; needed the same for all"
            raise Unusable("time", detail)
        read["time_s"] = as_samples(stamps)
    return replace(content, columns=read)


class Function(NamedTuple):
    """A frequency response or a coherence, with the degrees of freedom of output and input."""

    output: str
    input: str
    frequency: FloatArray  # in Hz, (n_lines,)
    values: ComplexArray  # (n_lines,)
    coherence: bool
    unit: str


def load_functions(path: Path, max_memory: float) -> list[Function]:
    """Read the frequency responses and coherences of a file; the unit is as the file has it."""
    functions = []
    with TemporaryDirectory(prefix="lmshealth-") as folder:
        file = _File(path, Path(folder), max_memory)
        kinds = (_RESPONSE, _COHERENCE)
        used = [k for k, header in enumerate(file.headers) if header["func_type"] in kinds]
        names = _names([file.headers[k] for k in used])
        for k, name in zip(used, names, strict=True):
            header = file.headers[k]
            coherence = header["func_type"] == _COHERENCE
            if header["ord_data_type"] not in (_REAL if coherence else _COMPLEX):
                raise not_numeric(name, "no complex numbers: export real and imaginary parts")
            axis, values = file.numbers(k, name, _HERTZ)
            output, force = (_dof(header, role) for role in ("rsp", "ref"))
            if output == force == "0":
                output, force = name, ""
            units = [header[f"{side}_axis_units_lab"].strip() for side in ("ordinate", "orddenom")]
            unit = "/".join(f"({one})" for one in units if one not in ("", "NONE"))
            values = values.astype(complex)
            functions.append(Function(output, force, axis, values, coherence, unit))
    return functions


def _dof(header: Header, role: str) -> str:
    """Name a degree of freedom by its node and direction, as 12+Z."""
    code = header[f"{role}_dir"]
    axis = _DIRECTIONS[abs(code)] if abs(code) < len(_DIRECTIONS) else str(abs(code))
    return f"{header[f'{role}_node']}" + (f"{'+' if code > 0 else '-'}{axis}" if code else "")


class _File:
    """The data sets 58 of a file, and what pyuff reads of their headers.

    ``headers`` have the place of the data set among all data sets, too, from 1; ``others`` are the
    numbers of the other data sets.
    """

    def __init__(self, path: Path, folder: Path, max_memory: float) -> None:
        with library("UFF58", "pyuff"):
            import pyuff
        check_memory("the file", _FILE_MEMORY * path.stat().st_size, max_memory)
        self._max_memory = max_memory
        every = list(_data_sets(path.read_bytes()))
        found = {place: lines for place, number, lines in every if number == _FUNCTION}
        self.others = sorted({number for _, number, _ in every} - {_FUNCTION})
        self._sizes = [len(lines) for lines in found.values()]
        copy = folder / "functions.uff"
        with copy.open("wb") as stream:
            stream.writelines(_TAG + _without_padding(lines) + _TAG for lines in found.values())
        self._file = pyuff.UFF(str(copy))
        if self._file.get_n_sets() != len(found):
            raise Unusable("corrupt", "a header contains the tag of a data set; export it again")
        self.headers: list[Header] = [{"place": place} for place in found]
        for k, header in enumerate(self.headers):
            header |= self._read(k, header_only=True)

    def _read(self, k: int, *, header_only: bool = False) -> Header:
        try:
            read: Header = self._file.read_sets(k, header_only=header_only)
            return read
        except Exception as error:  # pyuff raises nothing more specific
            raise _malformed(self.headers[k]["place"]) from error

    def numbers(self, k: int, name: str, units: Sequence[str]) -> tuple[FloatArray, np.ndarray]:
        """Read abscissa and ordinate of a data set, ``(n_samples,)`` each.

        The abscissa must be in one of the units, of which the third is quoted.
        """
        header = self.headers[k]
        unit = header["abscissa_axis_units_lab"].strip()
        if unit.lower() not in units:
            raise Unusable("unit", f"the abscissa of {name!r} is in {unit!r}; needed {units[2]}")
        if header["abscissa_spacing"] not in (_UNEVEN, _EVEN):
            raise _malformed(header["place"])
        check_memory(f"data set {name[:80]!r}", _SET_MEMORY * self._sizes[k], self._max_memory)
        read = self._read(k)
        n_found, n = read["data"].size, header["num_pts"]
        if n_found != n:
            raise Unusable("corrupt", f"{name!r}: {n_found} of {n} samples are there")
        return read["x"], read["data"]


def _data_sets(content: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Find the data sets and check that all are whole: place, number, and lines of those of 58."""
    at = place = 0
    while begin := _BEGIN.match(content, at):
        place, at = place + 1, begin.end()
        number = content[at : at + 6].splitlines()
        if at == len(content):
            raise corrupt("the last data set is cut off")
        if not number[0].strip().isdigit() or not int(number[0]):
            raise corrupt(f"data set {place} has no number")
        is_function = int(number[0]) == _FUNCTION
        is_binary = is_function and _is_binary(content[at : at + 7])
        layout = _layout(content[at : at + _HEADER]) if is_binary else None
        # Samples may contain the bytes of a tag.
        after = at + layout.end if layout and layout.is_counted else at
        end = (_BINARY_END if is_binary else _END).search(content, after)
        if end is None:
            raise corrupt("the last data set is cut off")
        lines = content[at : end.start()] if is_function else b""
        if is_function and lines.count(b"\n") < 1 + _N_RECORDS:
            raise _malformed(place)
        yield place, int(number[0]), lines
        at = end.end()
    if content[at:].strip(b" \t\r\n\x1a"):
        raise corrupt(f"no data set begins at byte {at}")


class _Layout(NamedTuple):
    """How the header of a data set states that its values are stored.

    ``widths`` are the columns of the values in a row of text. ``is_counted`` is whether a header of
    binary numbers states that they take the bytes up to ``end``.
    """

    start: int
    end: int
    n_values: int
    widths: tuple[int, ...]
    is_counted: bool


def _layout(lines: bytes) -> _Layout | None:
    """Read the layout of a data set 58 from its header; None where that is malformed."""
    head = lines.splitlines(keepends=True)[: 1 + _N_RECORDS]
    start = sum(map(len, head))
    try:
        kind, n, spacing = (int(head[7][k : k + 10]) for k in (0, 10, 20))
        n *= 1 + (kind in _COMPLEX) + (spacing == _UNEVEN)
        n_bytes = n * (4 if kind in _SINGLE else 8)
        is_counted = _is_binary(lines) and int(lines[31:43]) == n_bytes
    except (IndexError, ValueError):
        return None
    widths = (13,) * 6 if kind in _SINGLE else _WIDTHS.get((kind, spacing), ())
    return _Layout(start, start + n_bytes, n, widths, is_counted) if n > 0 and widths else None


def _without_padding(lines: bytes) -> bytes:
    """Leave out what follows the stated number of samples of a data set, if it is padding.

    Padding are zeros and blanks, and of binary numbers any bytes where the header states the number
    of bytes without them. Other data sets stay as they are, and are refused by their number.
    """
    if (layout := _layout(lines)) is None:
        return lines
    if _is_binary(lines):
        is_padding = layout.is_counted or not lines[layout.end :].strip(_FILL)
        is_whole = len(lines) >= layout.end
        return lines[: layout.end] + b"\n" if is_padding and is_whole else lines
    rows = lines[layout.start :].splitlines()
    n_whole, last = divmod(layout.n_values - 1, len(layout.widths))
    width = sum(layout.widths[: last + 1])
    end, after = rows[n_whole : n_whole + 1], rows[n_whole + 1 :]
    try:
        padding = b" ".join([*(row[width:] for row in end), *after])
        if any(float(word) != 0 for word in padding.split()):
            return lines
    except ValueError:
        return lines
    rows = [*rows[:n_whole], *(row[:width] for row in end)]
    return lines[: layout.start] + b"".join(row + b"\n" for row in rows)


def _is_binary(lines: bytes) -> bool:
    return lines[6:7].lower() == b"b"


def _malformed(place: int) -> Unusable:
    return Unusable("corrupt", f"data set {place} does not keep the format 58; export it again")


def _no_time_records(
    headers: Sequence[Header], names: Sequence[str], others: Sequence[int]
) -> Unusable:
    """Return the refusal of a file of other functions, or of a geometry."""
    needed = "needed acceleration over time (data sets 58, function type 1)"
    kinds = sorted({header["func_type"] for header in headers})
    if kinds:
        known = foreign("uff_functions")
        text = listed(f"function type {k} ({known.get(str(k), 'another')})" for k in kinds)
        found = f"holds no time record but {text}: {listed(names)}"
        if _RESPONSE in kinds:
            needed += "; `lmshealth frf` reads frequency responses"
        return Unusable("columns", f"{found}; {needed}")
    known = foreign("uff_sets")
    text = listed(f"{number} ({known.get(str(number), 'another')})" for number in others)
    return Unusable("format", f"holds the data sets {text}, and no measured functions; {needed}")


def _names(headers: Sequence[Header]) -> list[str]:
    """Name data sets by the first entry of their headers that distinguishes all of them."""
    for entry in ("{id1}", "{rsp_ent_name}", "{ordinate_axis_lab}", "{rsp_node}{rsp_dir:+d}"):
        names = [entry.format(**header).strip() for header in headers]
        if len(set(names)) == len(names) and not {"", "NONE"} & set(names):
            return names
    return [f"set {header['place']}" for header in headers]


def _dates(headers: Sequence[Header]) -> list[float]:
    """Return the dates of data sets in s since the first, zeros where they are those of one record.

    A header dates the record, or when it was written: dates that differ by less than the record
    takes do not order the samples of two channels.
    """
    found = [_DATE.search(header["id3"]) for header in headers]
    lengths = [header["num_pts"] * header["abscissa_inc"] for header in headers]
    moments = list[datetime]()
    with suppress(ValueError):
        moments = [datetime.strptime(" ".join(m.groups()), "%d %b %y %H %M %S") for m in found if m]
    since = [(moment - moments[0]).total_seconds() for moment in moments]
    is_stated = len(since) == len(headers) > 0 and min(lengths) > 0
    apart = is_stated and max(since) - min(since) > max(lengths)
    return since if apart else [0.0] * len(headers)


def _describe(header: Header, name: str, date: float) -> Described:
    """Describe a data set; all but time records of real numbers have no unit of a signal.

    The date is that of `_dates`.
    """
    unit = header["ordinate_axis_units_lab"].strip()
    unit = "" if unit == "NONE" else unit
    if not _is_time_record(header):
        return Described(name, f"{unit}, no time record: function type {header['func_type']}")
    if acceleration := header["ordinate_spec_data_type"] == _ACCELERATION:
        # pyuff cannot read a superscript two in the Windows encoding.
        unit = unit.replace("\ufffd", "2")
    uneven = header["abscissa_spacing"] == _UNEVEN
    rate = None if uneven else rate_of(header["abscissa_inc"])
    start = date + (0.0 if uneven else float(header["abscissa_min"]))
    return Described(name, unit, rate, acceleration, start, header["num_pts"])


def _is_time_record(header: Header) -> bool:
    kind = header["func_type"]
    of_unknown = kind == _UNKNOWN and header["abscissa_spec_data_type"] == _TIME
    return (kind == _TIME_RESPONSE or of_unknown) and header["ord_data_type"] in _REAL


UFF = Format("UFF58", (".uff", ".unv"), lambda head: _START.match(head) is not None, _load)
