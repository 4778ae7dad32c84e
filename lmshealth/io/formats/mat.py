"""MAT: variables, fields of structs and columns of matrices, each by the name MATLAB calls it."""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterable, Iterator
from dataclasses import replace
from math import prod
from pathlib import Path
from typing import IO, NamedTuple

from lmshealth.io.buffers import Samples, spools
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.matbytes import PackedBytes, PlainBytes, cut_off
from lmshealth.io.formats.matwalk import (
    COMPRESSED,
    MATRIX,
    NUMBERS,
    TAG,
    TEXT,
    Array,
    Walker,
)
from lmshealth.io.metadata import KEYS
from lmshealth.io.raw import Format, Raw, check_size, not_numeric
from lmshealth.io.refusal import Unusable, listed

_HEADER = 128
_ORDERS = {b"\x00\x01IM": "<", b"\x01\x00MI": ">"}
_HDF5_INSIDE = (b"\x00\x02IM", b"\x02\x00MI")
# A matrix with more columns than this is no table of signals.
_MOST_COLUMNS = 1000
# What has more arrays is no log, and would fill the memory with their names.
_MOST_ARRAYS = 20_000


class _Variable(NamedTuple):
    """A variable where it stands in the file, with its tag."""

    name: str
    packed: bool
    start: int
    size: int


def _load(path: Path, columns: ColumnMap, max_memory: float) -> Raw:
    with path.open("rb") as stream:
        order = _order(stream)
        variables = list(_variables(stream, order))
        names = [variable.name for variable in variables]
        chosen = _chosen(names, columns)
        if twice := sorted({name for name in chosen if names.count(name) > 1}):
            raise Unusable("columns", f"the file holds {listed(twice)} more than once")
        wanted = [variable for variable in variables if variable.name in chosen]
        arrays = _arrays(stream, order, wanted, columns.mat.variable)
        raw = _raw(arrays, columns, os.fstat(stream.fileno()).st_size)
    others = tuple(name for name in names if name and name not in chosen)
    return replace(raw, present=raw.present + others)


def _order(stream: IO[bytes]) -> str:
    """Tell the order of bytes; refuse the version that is something else inside."""
    version = stream.read(_HEADER)[-4:]
    if version in _HDF5_INSIDE:
        raise Unusable("format", "MAT-file of version 7.3; save it in MATLAB with the option -v7")
    return _ORDERS[version]


def _variables(stream: IO[bytes], order: str) -> Iterator[_Variable]:
    """Find the variables by their tags, and read their names.

    Raises
    ------
    Unusable
        With reason ``corrupt`` where the file ends before its variables do.
    """
    end = os.fstat(stream.fileno()).st_size
    at = _HEADER
    while at < end:
        if at + TAG > end:
            raise cut_off(at)
        stream.seek(at)
        kind, size = struct.unpack(order + "II", stream.read(TAG))
        if kind not in (COMPRESSED, MATRIX):
            raise Unusable("corrupt", f"no variable begins at byte {at}; copy the file again")
        if at + TAG + size > end:
            raise cut_off(at)
        found = _Variable("", kind == COMPRESSED, at, TAG + size)
        yield found._replace(name=_walker(stream, order, found).name())
        at += TAG + size


def _walker(stream: IO[bytes], order: str, variable: _Variable) -> Walker:
    if not variable.packed:
        stream.seek(variable.start)
        return Walker(PlainBytes(stream), order)
    stream.seek(variable.start + TAG)
    return Walker(PackedBytes(stream, variable.size - TAG), order)


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


def _arrays(
    stream: IO[bytes], order: str, variables: Iterable[_Variable], inside: str | None
) -> Iterator[Array]:
    """Give the arrays of variables; inside one variable without its name."""
    end = os.fstat(stream.fileno()).st_size
    unpacked = 0
    for variable in variables:
        walker = _walker(stream, order, variable)
        unpacked += walker.size
        check_size(unpacked, end)
        yield from walker.arrays(variable.name, inside=variable.name == inside)


def _raw(arrays: Iterable[Array], columns: ColumnMap, size: int) -> Raw:
    """Read what is wanted of the arrays of a file of ``size`` bytes."""
    n_samples = 0
    read: dict[str, Samples] = {}
    metadata: dict[str, str] = {}
    present: list[str] = []
    for k, array in enumerate(arrays):
        for name, n in _columns(array):
            present.append(name)
            if columns.target(name) is not None:
                _check_series(array, name, n)
                n_samples += n
                # MATLAB stores whole numbers in fewer bytes than they take here.
                check_size(8 * n_samples, size)
                read[name] = _samples(array, n)
            elif name in KEYS:
                metadata[name] = _text(array, name)
            elif array.what == NUMBERS:
                array.skip(n)
        if k + len(present) > _MOST_ARRAYS:
            raise Unusable("columns", f"more than {_MOST_ARRAYS} arrays; save the log by itself")
    return Raw(read, metadata, tuple(present))


def _columns(array: Array) -> Iterator[tuple[str, int]]:
    """Give the columns of a matrix, or an array itself, with their numbers of entries."""
    n_columns = array.shape[1] if len(array.shape) == 2 and 1 not in array.shape else None
    if array.what != NUMBERS or n_columns is None or n_columns > _MOST_COLUMNS:
        yield array.name, prod(array.shape)
        return
    for k in range(n_columns):
        yield f"{array.name}(:,{k + 1})", array.shape[0]


def _check_series(array: Array, name: str, n: int) -> None:
    if array.what != NUMBERS:
        raise not_numeric(name, array.what)
    if n not in array.shape:
        raise not_numeric(name, f"numbers of shape {array.shape}")


def _samples(array: Array, n: int) -> Samples:
    with spools([array.name], expected=n) as taken:
        for block in array.numbers(n):
            taken[array.name].append(block)
        return taken[array.name].samples()


def _text(array: Array, key: str) -> str:
    """Read a single number or line of text."""
    n = prod(array.shape)
    if array.what == NUMBERS and n == 1:
        value = next(array.numbers(1)).item()
        # An integer may be stored as one or not.
        return str(int(value) if float(value).is_integer() else value)
    if array.what == TEXT and (n == 0 or array.shape[0] == 1):
        return array.text()
    raise Unusable("metadata", f"{key} is no single text or number; write it as text")


def _sniff(head: bytes) -> bool:
    version = head[_HEADER - 4 : _HEADER]
    return version in _ORDERS or (version in _HDF5_INSIDE and head.startswith(b"MATLAB"))


MAT = Format("MAT", (".mat",), _sniff, _load)
