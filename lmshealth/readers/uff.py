"""UFF58: functions at nodal degrees of freedom in ASCII or binary, of which time records count."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lmshealth.arrays import FloatArray
from lmshealth.readers.channels import Described, choose, present
from lmshealth.readers.columns import ColumnMap
from lmshealth.readers.raw import Format, Raw, check_size, missing_library, not_numeric
from lmshealth.readers.trouble import Unusable

_START = re.compile(rb"\s*-1[ \t]*\r?\n[ \t]*\d+")
_END = b"    -1"
_BLANK = b" \t\r\n\x1a"
_LONGEST_TAIL = 4096
# pyuff holds text as bytes, as lines and as Python floats at once.
_BYTES_PER_BYTE = 8

_FUNCTION = 58
_TIME_RESPONSE = 1
_UNKNOWN = 0
_TIME, _ACCELERATION = 17, 12
_REAL = (2, 4)
_SECONDS = ("", "none", "s", "sec", "second", "seconds")
_UNEVEN = 0


def _load(path: Path, columns: ColumnMap) -> Raw:
    try:
        import pyuff
    except ImportError as error:
        raise missing_library("UFF58", "pyuff") from error
    size = path.stat().st_size
    check_size(_BYTES_PER_BYTE * size, size)
    _check_end(path, size)
    file = pyuff.UFF(str(path))
    kinds = [int(kind) for kind in file.get_set_types()]
    if not all(kinds):
        raise Unusable("corrupt", f"data set {kinds.index(0) + 1} of {len(kinds)} has no number")
    places = [k for k, kind in enumerate(kinds) if kind == _FUNCTION]
    headers = [_set(file, k, header_only=True) for k in places]
    described = _described(headers, places)
    chosen = choose(described, columns)
    uneven = False
    read: dict[str, FloatArray] = {}
    stamps: dict[str, FloatArray] = {}
    for name, k in chosen.columns.items():
        record = _record(file, places[k], name)
        read[name] = record["data"]
        if record["abscissa_spacing"] == _UNEVEN:
            uneven = True
            stamps[name] = record["x"]
    if uneven:
        read["time_s"] = _common(stamps, read)
    return Raw(read, chosen.metadata, present(described), chosen.refused)


def _check_end(path: Path, size: int) -> None:
    """Refuse a file whose last data set is cut off; pyuff would pass over that data set."""
    with path.open("rb") as stream:
        stream.seek(max(0, size - _LONGEST_TAIL))
        tail = stream.read().rstrip(_BLANK)
    before = tail.removesuffix(_END)
    if before == tail or before.rstrip(_BLANK).endswith(_END):
        raise Unusable("corrupt", "the last data set is cut off; copy the file again")


def _set(file: Any, place: int, *, header_only: bool) -> dict[str, Any]:
    """Read one data set."""
    try:
        return dict(file.read_sets(place, header_only=header_only))
    except Exception as error:  # pyuff raises nothing more specific
        raise Unusable(
            "corrupt", f"data set {place + 1} does not keep the format 58; export it again"
        ) from error


def _described(headers: Sequence[dict[str, Any]], places: Sequence[int]) -> list[Described]:
    names = _names(headers, places)
    return [_describe(header, name) for header, name in zip(headers, names, strict=True)]


def _names(headers: Sequence[dict[str, Any]], places: Sequence[int]) -> list[str]:
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
    return [f"set {place + 1}" for place in places]


def _describe(header: dict[str, Any], name: str) -> Described:
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


def _is_time_record(header: dict[str, Any]) -> bool:
    kind = header["func_type"]
    over_time = kind == _TIME_RESPONSE or (
        kind == _UNKNOWN and header["abscissa_spec_data_type"] == _TIME
    )
    return over_time and header["ord_data_type"] in _REAL


def _rate(header: dict[str, Any]) -> float | None:
    """Turn the interval in s into a rate in Hz; None where the record has time stamps instead."""
    interval = header["abscissa_inc"]
    if header["abscissa_spacing"] == _UNEVEN or not 1e-12 < interval < 1e9:
        return None
    return 1 / float(interval)


def _record(file: Any, place: int, name: str) -> dict[str, Any]:
    """Read one time record and check that it is all there.

    Raises
    ------
    Unusable
        With the reasons ``columns``, ``unit`` and ``corrupt``.
    """
    record = _set(file, place, header_only=False)
    if not _is_time_record(record):
        raise not_numeric(name, f"no time record but the function type {record['func_type']}")
    unit = record["abscissa_axis_units_lab"].strip()
    if unit.lower() not in _SECONDS:
        raise Unusable("unit", f"the abscissa of {name!r} is in {unit!r}; needed s")
    found, promised = record["data"].size, record["num_pts"]
    if found != promised:
        raise Unusable("corrupt", f"{name!r}: {found} of {promised} samples are there")
    return record


def _common(stamps: dict[str, FloatArray], read: dict[str, FloatArray]) -> FloatArray:
    """Find the time stamps that all records share."""
    first = next(iter(stamps.values()))
    if len(stamps) < len(read) or not all(np.array_equal(x, first) for x in stamps.values()):
        raise Unusable("time", "the records have different time stamps; needed the same for all")
    return first


UFF = Format("UFF58", (".uff", ".unv"), lambda head: _START.match(head) is not None, _load)
