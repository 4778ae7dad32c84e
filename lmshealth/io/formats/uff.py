"""UFF58: time records and frequency responses at nodal degrees of freedom, in ASCII or binary.

pyuff reads the headers. It drops a data set that is cut off, pairs tags wrongly where a line of
another data set ends like one, and needs 11 times the processor time and 10 times the memory for
binary samples (2 and 6 times for ASCII): data sets are found and samples decoded here.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator, Sequence
from itertools import accumulate
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from lmshealth._arrays import ComplexArray, FloatArray
from lmshealth.io.buffers import Samples, as_samples, blocks
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.content import Content, Format, check_memory, library, not_numeric
from lmshealth.io.formats.unit_channels import Described, choose, present, rate_of
from lmshealth.io.refusal import Unusable, corrupt

_START = re.compile(rb"\s*-1[ \t]*\r?\n[ \t]*\d+")
_TAG = b"    -1"
_BLANK = b" \t\r\n\x1a"
# Lines have 80 characters; binary data may have no line end for long.
_LONGEST_LINE = 1 << 16
_FUNCTION, _N_RECORDS = 58, 11
# Some exporters begin a new line after binary data.
_AFTER_BINARY = re.compile(rb"\r?\n?    -1[ \t]*(\r|\n|\Z)")
_N_BYTES = slice(31, 43)

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
_LITTLE = 1

# Widths of the numbers in a line by type of the ordinate, with and without an abscissa.
_WIDTHS: dict[int, tuple[int, ...]] = {2: (13,) * 6, 4: (20,) * 4, 5: (13,) * 6, 6: (20,) * 4}
_UNEVEN_WIDTHS = _WIDTHS | {4: (13, 20, 13, 20), 6: (13, 20, 20)}
_BINARY = {2: "f4", 4: "f8", 5: "f4", 6: "f8"}
# Bytes of memory for a byte of ASCII: the text, its lines, the fields of a column, the numbers.
_ASCII_MEMORY = 4

_CUT_OFF = "the last data set is cut off"

Header = dict[str, Any]


class _DataSet(NamedTuple):
    """A function at nodal degrees of freedom: its place among all data sets, from 1.

    ``head`` are tag, number and eleven records as in the file; ``start`` and ``stop`` the bytes of
    its numbers; ``header`` is what pyuff reads from the records.
    """

    place: int
    head: bytes
    binary: bool
    start: int
    stop: int
    header: Header


def _load(path: Path, columns: ColumnMap, max_memory: float) -> Content:
    with path.open("rb") as stream:
        sets = _with_headers(list(_data_sets(stream)))
        described = [_describe(*named) for named in zip(sets, _names(sets), strict=True)]
        chosen = choose(described, columns)
        read: dict[str, Samples] = {}
        stamps: dict[str, Samples] = {}
        for name, k in chosen.columns.items():
            if not _is_time_record(sets[k].header):
                kind = sets[k].header["func_type"]
                raise not_numeric(name, f"no time record but the function type {kind}")
            values = _numbers(stream, sets[k], name, max_memory, _SECONDS)
            read[name] = as_samples(values[:, -1])
            if values.shape[1] == 2:
                stamps[name] = as_samples(values[:, 0])
    if stamps:
        first = next(iter(stamps.values()))
        if len(stamps) < len(read) or not all(_equal(x, first) for x in stamps.values()):
            detail = "the records have different time stamps; needed the same for all"
            raise Unusable("time", detail)
        read["time_s"] = first
    return Content(read, chosen.metadata, present(described), chosen.refused)


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
    with path.open("rb") as stream:
        sets = _with_headers(list(_data_sets(stream)))
        used = [one for one in sets if one.header["func_type"] in (_RESPONSE, _COHERENCE)]
        for one, name in zip(used, _names(used), strict=True):
            header = one.header
            coherence = header["func_type"] == _COHERENCE
            if header["ord_data_type"] not in (_REAL if coherence else _COMPLEX):
                raise not_numeric(name, "no complex numbers: export real and imaginary parts")
            values = _numbers(stream, one, name, max_memory, _HERTZ)
            if header["abscissa_spacing"] == _EVEN:
                axis = header["abscissa_min"] + header["abscissa_inc"] * np.arange(len(values))
                values = np.column_stack([axis, values])
            complete = values[:, 1].astype(np.complex128)
            if not coherence:
                complete += 1j * values[:, 2]
            dof = [_dof(header, role) for role in ("rsp", "ref")]
            if dof[0] == dof[1] == "0":
                dof = [name, ""]
            unit = [header[f"{axis}_axis_units_lab"].strip() for axis in ("ordinate", "orddenom")]
            text = "/".join(f"({u})" for u in unit if u not in ("", "NONE"))
            functions.append(Function(dof[0], dof[1], values[:, 0], complete, coherence, text))
    return functions


def _dof(header: Header, role: str) -> str:
    """Name a degree of freedom by its node and direction, as 12+Z."""
    code = header[f"{role}_dir"]
    axis = _DIRECTIONS[abs(code)] if abs(code) < len(_DIRECTIONS) else str(abs(code))
    return f"{header[f'{role}_node']}" + (f"{'+' if code > 0 else '-'}{axis}" if code else "")


def _data_sets(stream: IO[bytes]) -> Iterator[_DataSet]:
    """Find the data sets 58, and check that the tags and numbers of all data sets are whole."""
    place = 0
    while tag := stream.readline(_LONGEST_LINE):
        if not tag.strip(_BLANK):
            continue
        if not _is_tag(tag):
            at = stream.tell() - len(tag)
            raise corrupt(f"no data set begins at byte {at}")
        place += 1
        number = stream.readline(_LONGEST_LINE)
        if not number.strip(_BLANK):
            raise corrupt(_CUT_OFF)
        if not number[:6].strip().isdigit() or not int(number[:6]):
            raise corrupt(f"data set {place} has no number")
        if int(number[:6]) != _FUNCTION:
            _end(stream)
            continue
        records = [stream.readline(_LONGEST_LINE) for _ in range(_N_RECORDS)]
        if any(_is_tag(record) for record in records):
            raise _malformed(place)
        start = stream.tell()
        binary = number[6:7].lower() == b"b"
        stop = _claimed_end(stream, number) if binary else None
        if stop is None:
            stream.seek(start)
            stop = _end(stream, binary=binary)
        yield _DataSet(place, b"".join([tag, number, *records]), binary, start, stop, {})


def _malformed(place: int) -> Unusable:
    return Unusable("corrupt", f"data set {place} does not keep the format 58; export it again")


def _is_tag(line: bytes) -> bool:
    return line.rstrip(_BLANK) == _TAG


def _claimed_end(stream: IO[bytes], number: bytes) -> int | None:
    """Find the end of binary data by the number of bytes in the header; None if it is wrong.

    Binary data may contain a tag by chance; but not every program writes their number of bytes.
    """
    claim = number[_N_BYTES].strip()
    if not claim.isdigit():
        return None
    stop = stream.tell() + int(claim)
    stream.seek(stop)
    found = _AFTER_BINARY.match(stream.read(100))
    if found is None:
        return None
    stream.seek(stop + found.end())
    return stop


def _end(stream: IO[bytes], *, binary: bool = False) -> int:
    """Find the end of a data set by its tag, and go behind it."""
    while line := stream.readline(_LONGEST_LINE):
        if _is_tag(line) or (binary and line.rstrip(_BLANK).endswith(_TAG)):
            return stream.tell() - len(line) + line.rindex(_TAG)
    raise corrupt(_CUT_OFF)


def _with_headers(sets: Sequence[_DataSet]) -> list[_DataSet]:
    """Read the headers with pyuff, which gets a file without the samples."""
    with library("UFF58", "pyuff"):
        import pyuff
    with tempfile.TemporaryDirectory(prefix="lmshealth-") as folder:
        path = Path(folder) / "headers.uff"
        path.write_bytes(b"".join(found.head + _TAG + b"\n" for found in sets))
        file = pyuff.UFF(str(path))
        if file.get_n_sets() != len(sets):
            raise Unusable("corrupt", "a header contains the tag of a data set; export it again")
        read: list[_DataSet] = []
        for k, found in enumerate(sets):
            try:
                read.append(found._replace(header=file.read_sets(k, header_only=True)))
            except Exception as error:  # pyuff raises nothing more specific
                raise _malformed(found.place) from error
        return read


def _names(sets: Sequence[_DataSet]) -> list[str]:
    """Name the data sets by the first entry of their headers that distinguishes all of them."""
    for entry in ("{id1}", "{rsp_ent_name}", "{ordinate_axis_lab}", "{rsp_node}{rsp_dir:+d}"):
        names = [entry.format(**found.header).strip() for found in sets]
        if len(set(names)) == len(names) and not {"", "NONE"} & set(names):
            return names
    return [f"set {found.place}" for found in sets]


def _describe(found: _DataSet, name: str) -> Described:
    """Describe a data set; all but time records of real numbers have no unit of a signal."""
    header = found.header
    unit = header["ordinate_axis_units_lab"].strip()
    unit = "" if unit == "NONE" else unit
    if not _is_time_record(header):
        return Described(name, f"{unit}, no time record: function type {header['func_type']}")
    acceleration = header["ordinate_spec_data_type"] == _ACCELERATION
    if acceleration:
        # pyuff cannot read a superscript two in the Windows encoding.
        unit = unit.replace("\ufffd", "2")
    uneven = header["abscissa_spacing"] == _UNEVEN
    rate = None if uneven else rate_of(header["abscissa_inc"])
    return Described(name, unit, rate, acceleration)


def _is_time_record(header: Header) -> bool:
    kind = header["func_type"]
    of_unknown = kind == _UNKNOWN and header["abscissa_spec_data_type"] == _TIME
    return (kind == _TIME_RESPONSE or of_unknown) and header["ord_data_type"] in _REAL


def _numbers(
    stream: IO[bytes], found: _DataSet, name: str, max_memory: float, units: Sequence[str]
) -> FloatArray:
    """Read the numbers of a data set, a row per point: abscissa (if uneven), then the ordinate.

    The abscissa must be in one of the units, of which the third is quoted.
    """
    header = found.header
    unit = header["abscissa_axis_units_lab"].strip()
    if unit.lower() not in units:
        raise Unusable("unit", f"the abscissa of {name!r} is in {unit!r}; needed {units[2]}")
    ordinate, spacing, n = header["ord_data_type"], header["abscissa_spacing"], header["num_pts"]
    if spacing not in (_UNEVEN, _EVEN):
        raise _malformed(found.place)
    size = found.stop - found.start
    needed = size * (1 if found.binary else _ASCII_MEMORY)
    check_memory(f"data set {name[:80]!r}", needed, max_memory)
    stream.seek(found.start)
    body = stream.read(size)
    if found.binary:
        order = "<" if header.get("byte_ordering") == _LITTLE else ">"
        dtype = np.dtype(order + _BINARY[ordinate])
        # A line end behind the numbers makes no number.
        values: np.ndarray = np.frombuffer(body, dtype, count=len(body) // dtype.itemsize)
    else:
        try:
            values = _fields(body, (_UNEVEN_WIDTHS if spacing == _UNEVEN else _WIDTHS)[ordinate])
        except ValueError as error:
            raise _malformed(found.place) from error
    width = (spacing == _UNEVEN) + (2 if ordinate in _COMPLEX else 1)
    n_found = values.size // width
    if n_found != n:
        raise Unusable("corrupt", f"{name!r}: {n_found} of {n} samples are there")
    return values[: n * width].reshape(n, width)


def _fields(body: bytes, widths: Sequence[int]) -> FloatArray:
    """Read numbers in columns, with or without blanks between them, shape ``(n,)``."""
    length = sum(widths)
    lines = body.splitlines()
    text = b"".join([line.ljust(length)[:length] for line in lines])
    table = np.frombuffer(text, dtype=np.uint8).reshape(len(lines), length)
    values = np.empty((len(lines), len(widths)))
    given = np.empty(values.shape, dtype=bool)
    for k, (width, stop) in enumerate(zip(widths, accumulate(widths), strict=True)):
        field = table[:, stop - width : stop]
        # The last line need not be full.
        given[:, k] = (field != ord(" ")).any(axis=1)
        values[given[:, k], k] = field[given[:, k]].view(f"S{width}").ravel().astype(np.float64)
    return values[given]


def _equal(one: Samples, other: Samples) -> bool:
    return one.size == other.size and all(
        np.array_equal(part, other[at : at + part.size]) for at, part in blocks(one)
    )


UFF = Format("UFF58", (".uff", ".unv"), lambda head: _START.match(head) is not None, _load)
