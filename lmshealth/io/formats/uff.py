"""UFF58: functions at nodal degrees of freedom in ASCII or binary, of which time records count."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from lmshealth.io.buffers import Samples, blocks, spools
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.described_channels import Described, choose, present
from lmshealth.io.formats.uffsets import DataSet, functions, not_kept, numbers
from lmshealth.io.raw import Format, Raw, missing_library, not_numeric
from lmshealth.io.refusal import Unusable

_START = re.compile(rb"\s*-1[ \t]*\r?\n[ \t]*\d+")
_END = b"    -1\n"

_TIME_RESPONSE = 1
_UNKNOWN = 0
_TIME, _ACCELERATION = 17, 12
_REAL = (2, 4)
_SECONDS = ("", "none", "s", "sec", "second", "seconds")
_UNEVEN, _EVEN = 0, 1
_LITTLE = 1

Header = dict[str, Any]


def _load(path: Path, columns: ColumnMap, max_memory: float) -> Raw:
    with path.open("rb") as stream:
        sets = list(functions(stream))
        headers = _headers(sets)
        names = _names(headers, sets)
        described = [_describe(header, name) for header, name in zip(headers, names, strict=True)]
        chosen = choose(described, columns)
        read: dict[str, Samples] = {}
        stamps: dict[str, Samples] = {}
        for name, k in chosen.columns.items():
            x, read[name] = _record(stream, sets[k], headers[k], name)
            if headers[k]["abscissa_spacing"] == _UNEVEN:
                stamps[name] = x
    if stamps:
        read["time_s"] = _common(stamps, read)
    return Raw(read, chosen.metadata, present(described), chosen.refused)


def _headers(sets: Sequence[DataSet]) -> list[Header]:
    """Read headers with pyuff, which gets them without the samples: it reads whole files."""
    try:
        import pyuff
    except ImportError as error:
        raise missing_library("UFF58", "pyuff") from error
    with tempfile.TemporaryDirectory(prefix="lmshealth-") as folder:
        path = Path(folder) / "headers.uff"
        path.write_bytes(b"".join(found.header + _END for found in sets))
        file = pyuff.UFF(str(path))
        if file.get_n_sets() != len(sets):
            raise Unusable("corrupt", "a header looks like the end of a data set; export it again")
        return [_header(file, k, found.place) for k, found in enumerate(sets)]


def _header(file: Any, k: int, place: int) -> Header:
    try:
        return dict(file.read_sets(k, header_only=True))
    except Exception as error:  # pyuff raises nothing more specific
        raise not_kept(place) from error


def _names(headers: Sequence[Header], sets: Sequence[DataSet]) -> list[str]:
    """Call the data sets by the first entry of their headers that tells all of them apart."""
    for entry in (
        lambda header: header["id1"],
        lambda header: header["rsp_ent_name"],
        lambda header: header["ordinate_axis_lab"],
        lambda header: f"{header['rsp_node']}{header['rsp_dir']:+d}",
    ):
        names = [str(entry(header)).strip() for header in headers]
        if len(set(names)) == len(names) and not {"", "NONE"} & set(names):
            return names
    return [f"set {found.place}" for found in sets]


def _describe(header: Header, name: str) -> Described:
    """Describe a data set; what is no time record of real numbers has no unit of a signal."""
    unit = header["ordinate_axis_units_lab"].strip()
    unit = "" if unit == "NONE" else unit
    if not _is_time_record(header):
        return Described(name, f"{unit}, no time record: function type {header['func_type']}")
    acceleration = header["ordinate_spec_data_type"] == _ACCELERATION
    if acceleration:
        # pyuff cannot read a superscript two in the Windows encoding.
        unit = unit.replace("\ufffd", "2")
    return Described(name, unit, _rate(header), acceleration)


def _is_time_record(header: Header) -> bool:
    kind = header["func_type"]
    over_time = kind == _TIME_RESPONSE or (
        kind == _UNKNOWN and header["abscissa_spec_data_type"] == _TIME
    )
    return over_time and header["ord_data_type"] in _REAL


def _rate(header: Header) -> float | None:
    """Turn the interval in s into a rate in Hz; None where the record has time stamps instead."""
    interval = header["abscissa_inc"]
    if header["abscissa_spacing"] == _UNEVEN or not 1e-12 < interval < 1e9:
        return None
    return 1 / float(interval)


def _record(
    stream: IO[bytes], found: DataSet, header: Header, name: str
) -> tuple[Samples, Samples]:
    """Read the abscissa, where it is stored, and the ordinate of one time record.

    Raises
    ------
    Unusable
        With the reasons ``columns``, ``unit`` and ``corrupt``.
    """
    if not _is_time_record(header):
        raise not_numeric(name, f"no time record but the function type {header['func_type']}")
    unit = header["abscissa_axis_units_lab"].strip()
    if unit.lower() not in _SECONDS:
        raise Unusable("unit", f"the abscissa of {name!r} is in {unit!r}; needed s")
    if header["abscissa_spacing"] not in (_UNEVEN, _EVEN):
        raise not_kept(found.place)
    uneven = header["abscissa_spacing"] == _UNEVEN
    little = header.get("byte_ordering") == _LITTLE
    n, ordinate = header["num_pts"], header["ord_data_type"]
    with spools("xy", expected=n) as taken:
        for values in numbers(stream, found, ordinate=ordinate, uneven=uneven, little=little):
            if uneven:
                taken["x"].append(values[::2])
            taken["y"].append(values[1::2] if uneven else values)
        if taken["y"].size != n:
            raise Unusable("corrupt", f"{name!r}: {taken['y'].size} of {n} samples are there")
        return taken["x"].samples(), taken["y"].samples()


def _common(stamps: dict[str, Samples], read: dict[str, Samples]) -> Samples:
    """Find the time stamps that all records share."""
    first = next(iter(stamps.values()))
    if len(stamps) < len(read) or not all(_equal(x, first) for x in stamps.values()):
        raise Unusable("time", "the records have different time stamps; needed the same for all")
    return first


def _equal(one: Samples, other: Samples) -> bool:
    return one.size == other.size and all(
        np.array_equal(part, other[at : at + part.size]) for at, part in blocks(one)
    )


UFF = Format("UFF58", (".uff", ".unv"), lambda head: _START.match(head) is not None, _load)
