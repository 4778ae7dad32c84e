"""MAT: variables, fields of structs and columns of matrices, each by the name MATLAB calls it.

What scipy is given has been walked through before: it trusts the sizes that a file claims.
"""

from __future__ import annotations

import io
import mmap
import re
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lmshealth.arrays import FloatArray
from lmshealth.readers.columns import ColumnMap
from lmshealth.readers.matwalk import (
    COMPRESSED,
    HEADER,
    MATRIX,
    TAG,
    Walker,
    cut_off,
)
from lmshealth.readers.metadata import KEYS
from lmshealth.readers.raw import Format, Raw, check_size, not_numeric
from lmshealth.readers.trouble import Unusable, listed

_ORDERS = {b"\x00\x01IM": "<", b"\x01\x00MI": ">"}
_HDF5_INSIDE = (b"\x00\x02IM", b"\x02\x00MI")
# Type, dimensions and name of a variable; MATLAB's names have 63 characters at most.
_PEEK = 512
# A matrix with more columns than this is no table of signals.
_MOST_COLUMNS = 1000


class _Element(NamedTuple):
    """A variable where it stands in the file, with its tag."""

    name: str
    kind: int
    start: int
    size: int


def _load(path: Path, columns: ColumnMap) -> Raw:
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as file:
        order = _order(file)
        elements = list(_elements(file, order))
        names = [element.name for element in elements]
        chosen = _chosen(names, columns)
        if twice := sorted({name for name in chosen if names.count(name) > 1}):
            raise Unusable("columns", f"the file holds {listed(twice)} more than once")
        values = _values(file, order, [e for e in elements if e.name in chosen], path)
    leaves = dict(_leaves(values, chosen, columns.mat.variable))
    read = {name: _float64(name, leaves[name]) for name in leaves if columns.target(name)}
    metadata = {key: _text(key, leaves[key]) for key in KEYS if key in leaves}
    others = [name for name in names if name and name not in chosen]
    return Raw(read, metadata, (*leaves, *others))


def _order(file: mmap.mmap) -> str:
    """Tell the order of bytes; refuse the version that is something else inside."""
    version = file[HEADER - 4 : HEADER]
    if version in _HDF5_INSIDE:
        raise Unusable("format", "MAT-file of version 7.3; save it in MATLAB with the option -v7")
    return _ORDERS[version]


def _elements(file: mmap.mmap, order: str) -> Iterator[_Element]:
    """Find the variables by their tags, without unpacking them.

    Raises
    ------
    Unusable
        With reason ``corrupt`` where the file ends before its variables do.
    """
    at = HEADER
    while at < len(file):
        if at + TAG > len(file):
            raise cut_off(at)
        kind, size = struct.unpack(order + "II", file[at : at + TAG])
        if kind not in (COMPRESSED, MATRIX):
            raise Unusable("corrupt", f"no variable begins at byte {at}; copy the file again")
        if at + TAG + size > len(file):
            raise cut_off(at)
        yield _Element(_name(file, order, at, kind, size), kind, at, TAG + size)
        at += TAG + size


def _name(file: mmap.mmap, order: str, at: int, kind: int, size: int) -> str:
    """Read the name of a variable from its first bytes; empty where it has none."""
    stop = at + TAG + size
    if kind == COMPRESSED:
        begin = zlib.decompressobj().decompress(file[at + TAG : min(stop, at + _PEEK)], _PEEK)
    else:
        begin = file[at : min(stop, at + _PEEK)]
    return Walker(begin, order, partial=True).name()


def _chosen(names: list[str], columns: ColumnMap) -> set[str]:
    """Choose the variables that hold the log."""
    if columns.mat.variable is not None:
        if columns.mat.variable not in names:
            raise Unusable(
                "columns",
                f"the column map needs the variable {columns.mat.variable}; there: {listed(names)}",
            )
        return {columns.mat.variable}
    roots = {re.split(r"[.({]", source)[0] for source in columns.columns.values()}
    known = roots | set(KEYS)
    return {name for name in names if name and (name in known or columns.target(name))}


def _values(file: mmap.mmap, order: str, elements: list[_Element], path: Path) -> dict[str, Any]:
    """Read variables with scipy, after each of them has been walked through."""
    from scipy.io import loadmat

    values: dict[str, Any] = {}
    plain = [element for element in elements if element.kind == MATRIX]
    with memoryview(file) as view:
        for element in plain:
            with view[element.start : element.start + element.size] as part:
                Walker(part, order).check(element.name)
    if plain:
        values |= loadmat(str(path), variable_names=[element.name for element in plain])
    total = 0
    for element in elements:
        if element.kind == COMPRESSED:
            unpacked = _unpacked(file, order, element, total)
            total += len(unpacked)
            Walker(unpacked, order).check(element.name)
            one: Any = io.BytesIO(file[:HEADER] + unpacked)
            del unpacked
            values |= loadmat(one)
    return values


def _unpacked(file: mmap.mmap, order: str, element: _Element, before: int) -> bytes:
    """Unpack a variable; with those before it, it must stay within bounded memory."""
    packed = file[element.start + TAG : element.start + element.size]
    claim = TAG + _claim(packed, order)
    check_size(before + claim, len(file))
    unpacker = zlib.decompressobj()
    # One byte more than claimed makes zlib go on to its checksum.
    plain = unpacker.decompress(packed, claim + 1)
    if len(plain) != claim or not unpacker.eof:
        raise Unusable("corrupt", f"variable {element.name!r} is damaged; copy the file again")
    return plain


def _claim(packed: bytes, order: str) -> int:
    """Read how many bytes a compressed variable says it has."""
    tag = zlib.decompressobj().decompress(packed, TAG)
    kind, size = struct.unpack(order + "II", tag)
    if kind != MATRIX:
        raise Unusable("corrupt", "what is compressed is no variable; copy the file again")
    return int(size)


def _leaves(
    values: dict[str, Any], chosen: set[str], variable: str | None
) -> Iterator[tuple[str, Any]]:
    """Give the arrays by the names MATLAB has for them; inside ``variable`` without its name."""
    for name in values:
        if name in chosen:
            is_struct = values[name].dtype.names is not None
            yield from _named("" if name == variable and is_struct else name, values[name])


def _named(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if value.dtype.names is not None:
        for k, item in enumerate(value.flat):
            whole = name if value.size == 1 else f"{name}({k + 1})"
            for field in value.dtype.names:
                yield from _named(f"{whole}.{field}" if whole else field, item[field])
    elif value.ndim == 2 and 1 not in value.shape and value.shape[1] <= _MOST_COLUMNS:
        for k in range(value.shape[1]):
            yield f"{name}(:,{k + 1})", value[:, k]
    else:
        yield name, value


def _float64(name: str, value: Any) -> FloatArray:
    if value.dtype.kind not in "fiu" or value.size != max(value.shape, default=1):
        raise not_numeric(name, f"{value.dtype} of shape {value.shape}")
    return np.asarray(value, dtype=np.float64).ravel()


def _text(key: str, value: Any) -> str:
    """Read a single number or line of text."""
    if value.size == 1 and value.dtype.kind in "fiuU":
        return str(value.item())
    if value.size == 0 and value.dtype.kind == "U":
        return ""
    raise Unusable("metadata", f"{key} is no single text or number; write it as text")


def _sniff(head: bytes) -> bool:
    version = head[HEADER - 4 : HEADER]
    return version in _ORDERS or (version in _HDF5_INSIDE and head.startswith(b"MATLAB"))


MAT = Format("MAT", (".mat",), _sniff, _load)
