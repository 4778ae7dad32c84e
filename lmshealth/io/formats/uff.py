"""UFF58: time records and frequency responses at nodal degrees of freedom, in ASCII or binary.

pyuff reads the lines of a data set 58. Data sets are found here: pyuff drops one that is cut off,
and pairs tags wrongly where a line of another data set ends like one.
"""

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path
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
# Most bytes of a header, and those that fill up a block of numbers.
_HEADER, _FILL = 4096, b"\0 \r\n\x1a"
# Behind the last row of text: its last number may be followed by none.
_BLANKS = b" " * 19
_SINGLE = (2, 5)  # types of the ordinate of single precision

# Date in the third line of a header.
_DATE = re.compile(r"(\d\d?)-([A-Za-z]{3})-(?:\d\d)?(\d\d)\s+(\d\d?):(\d\d):(\d\d)")

# Bytes of memory for a byte of the file and of the data set that is read.
_FILE_MEMORY, _SET_MEMORY = 3, 16

Header = dict[str, Any]


def _load(path: Path, columns: ColumnMap, max_memory: float) -> Content:
    sets, others = _read_sets(path, max_memory)
    headers = [one.header for one in sets]
    names = _names(headers)
    if not set(columns.columns.values()) & set(names) and not any(map(_is_time_record, headers)):
        raise _no_time_records(headers, names, others)
    described = [_describe(*named) for named in zip(headers, names, _dates(headers), strict=True)]
    chosen, content = choose(described, columns)
    read, stamps, n_stamped = dict[str, Samples](), None, 0
    for name, k in chosen.items():
        if not _is_time_record(headers[k]):
            kind = headers[k]["func_type"]
            raise not_numeric(name, f"no time record but the function type {kind}")
        time, values = sets[k].numbers(name, _SECONDS, max_memory)
        read[name] = as_samples(values)
        if headers[k]["abscissa_spacing"] == _UNEVEN:
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
    kinds = (_RESPONSE, _COHERENCE)
    sets = [one for one in _read_sets(path, max_memory)[0] if one.header["func_type"] in kinds]
    for one, name in zip(sets, _names([one.header for one in sets]), strict=True):
        header = one.header
        coherence = header["func_type"] == _COHERENCE
        if header["ord_data_type"] not in (_REAL if coherence else _COMPLEX):
            raise not_numeric(name, "no complex numbers: export real and imaginary parts")
        axis, values = one.numbers(name, _HERTZ, max_memory)
        output, force = (_dof(header, role) for role in ("rsp", "ref"))
        if output == force == "0":
            output, force = name, ""
        units = [header[f"{side}_axis_units_lab"].strip() for side in ("ordinate", "orddenom")]
        unit = "/".join(f"({text})" for text in units if text not in ("", "NONE"))
        functions.append(Function(output, force, axis, values.astype(complex), coherence, unit))
    return functions


def _dof(header: Header, role: str) -> str:
    """Name a degree of freedom by its node and direction, as 12+Z."""
    code = header[f"{role}_dir"]
    axis = _DIRECTIONS[abs(code)] if abs(code) < len(_DIRECTIONS) else str(abs(code))
    return f"{header[f'{role}_node']}" + (f"{'+' if code > 0 else '-'}{axis}" if code else "")


class _DataSet(NamedTuple):
    """A data set 58: its lines, and what pyuff reads of its header.

    The header has the place among all data sets, too, from 1.
    """

    lines: bytes
    header: Header

    def numbers(
        self, name: str, units: Sequence[str], max_memory: float
    ) -> tuple[FloatArray, np.ndarray]:
        """Read abscissa and ordinate, ``(n_samples,)`` each.

        The abscissa must be in one of the units, of which the third is quoted.
        """
        unit, n = self.header["abscissa_axis_units_lab"].strip(), self.header["num_pts"]
        if unit.lower() not in units:
            raise Unusable("unit", f"the abscissa of {name!r} is in {unit!r}; needed {units[2]}")
        if self.header["abscissa_spacing"] not in (_UNEVEN, _EVEN):
            raise _malformed(self.header["place"])
        check_memory(f"data set {name[:80]!r}", _SET_MEMORY * len(self.lines), max_memory)
        read = _parsed(self.lines, self.header["place"])
        x, values = read["x"], read["data"]
        behind = [values[n:], x[n:]] if self.header["abscissa_spacing"] == _UNEVEN else [values[n:]]
        if n < 1 or values.size < n or any(map(np.any, behind)):  # zeros are padding
            raise Unusable("corrupt", f"{name!r}: {values.size} of {n} samples are there")
        return x[:n], values[:n]


def _parsed(lines: bytes, place: int, *, header_only: bool = False) -> Header:
    """Let pyuff read a data set, or its header."""
    from pyuff.datasets.dataset_58 import _extract58

    try:
        return {"place": place, **_extract58(b"    -1\n" + lines, header_only=header_only)}
    except Exception as error:  # pyuff raises nothing more specific
        raise _malformed(place) from error


def _read_sets(path: Path, max_memory: float) -> tuple[list[_DataSet], list[int]]:
    """Find the data sets 58 of a file and read their headers; list the numbers of the others."""
    with library("UFF58", "pyuff"):
        import pyuff  # noqa: F401
    check_memory("the file", _FILE_MEMORY * path.stat().st_size, max_memory)
    every = list(_data_sets(path.read_bytes()))
    found = [(place, lines) for place, number, lines in every if number == _FUNCTION]
    sets = [_DataSet(lines, _parsed(lines, place, header_only=True)) for place, lines in found]
    return sets, sorted({number for _, number, _ in every} - {_FUNCTION})


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
        is_binary = is_function and content[at + 6 : at + 7].lower() == b"b"
        n_bytes, is_counted = _binary_size(content[at : at + _HEADER]) if is_binary else (0, False)
        # Samples may contain the bytes of a tag.
        after = at + is_counted * n_bytes
        end = (_BINARY_END if is_binary else _END).search(content, after)
        if end is None:
            raise corrupt("the last data set is cut off")
        lines = content[at : end.start()] if is_function else b""
        if is_function and lines.count(b"\n") < 1 + _N_RECORDS:
            raise _malformed(place)
        if is_binary and (is_counted or not lines[n_bytes:].strip(_FILL)):
            lines = lines[:n_bytes]
        yield place, int(number[0]), lines if is_binary else lines.rstrip(_FILL) + _BLANKS
        at = end.end()
    if content[at:].strip(b" \t\r\n\x1a"):
        raise corrupt(f"no data set begins at byte {at}")


def _binary_size(lines: bytes) -> tuple[int, bool]:
    """Return the bytes of a data set of binary numbers by its header, and whether that counts them.

    The largest number where the header is malformed.
    """
    head = lines.splitlines(keepends=True)[: 1 + _N_RECORDS]
    try:
        kind, n, spacing = (int(head[7][k : k + 10]) for k in (0, 10, 20))
        n_numbers = n * (1 + (kind in _COMPLEX) + (spacing == _UNEVEN))
        n_bytes = n_numbers * (4 if kind in _SINGLE else 8)
        return sum(map(len, head)) + n_bytes, 0 < n_bytes == int(lines[31:43])
    except (IndexError, ValueError):
        return len(lines), False


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
    """Describe a data set; all but time records of real numbers have no unit of a signal."""
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
