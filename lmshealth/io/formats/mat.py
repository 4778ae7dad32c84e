"""MAT-files of version 5: variables, fields of structs, columns of matrices, as MATLAB names them.

The elements are parsed here, and every size is checked against the element around it, because
`scipy.io.loadmat` ends the Python process with a segmentation fault on damaged headers (3 % of
single flipped bits in the first 64 bytes of an uncompressed variable; scipy 1.17), and allocates
what text and cells claim before it finds that they are not there. One variable is held in memory.
"""

import re
import struct
import zlib
from collections.abc import Iterator
from io import SEEK_END
from math import prod
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from lmshealth.io import constants
from lmshealth.io.buffers import Samples, as_samples
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.content import Content, Format, check_memory, check_size, not_numeric
from lmshealth.io.metadata import KEYS
from lmshealth.io.refusal import Unusable, corrupt, listed, repeated

_HEADER, _TAG = 128, 8
_ORDERS = {b"\x00\x01IM": "<", b"\x01\x00MI": ">"}
_HDF5_INSIDE = (b"\x00\x02IM", b"\x02\x00MI")
# Bytes of a variable that hold its name.
_PEEK = 1 << 10

# Types of data elements. Whatever the class of an array, MATLAB stores its numbers in the smallest
# type that holds them.
_INT8, _INT32, _UINT32, _MATRIX, _COMPRESSED = 1, 5, 6, 14, 15
_TYPES = dict(zip((1, 2, 3, 4, 5, 6, 7, 9, 12, 13), "bBhHiIfdqQ", strict=True))
_ENCODINGS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
# Classes of arrays.
_STRUCT, _CHAR, _OPAQUE = 2, 4, 17
_NUMERIC = range(6, 16)
_OBJECT = "an object or a function (save plain arrays or structs)"
_OTHERS = {1: "cells", 3: _OBJECT, 5: "a sparse matrix", 16: _OBJECT, 17: _OBJECT}
_COMPLEX = 1 << 11


class _Variable(NamedTuple):
    """A variable: name, whether compressed, start and bytes in the file, bytes without its tag."""

    name: str
    packed: bool
    start: int
    stored: int
    size: int


class _Array(NamedTuple):
    """An array that is no struct, called as in MATLAB, which stores column after column.

    ``what`` is its kind in words; ``values`` are the numbers as stored, shape ``(prod(shape),)``.
    """

    name: str
    shape: tuple[int, ...]
    what: str = "numbers"
    values: np.ndarray | None = None
    text: str | None = None


def _load(path: Path, columns: ColumnMap, max_memory: float) -> Content:
    with path.open("rb") as stream:
        version = stream.read(_HEADER)[-4:]
        if version in _HDF5_INSIDE:
            needed = "save it in MATLAB with the option -v7"
            raise Unusable("format", f"MAT-file of version 7.3; {needed}")
        try:
            return _read(stream, _ORDERS[version], columns, max_memory)
        except (struct.error, zlib.error) as error:
            raise corrupt("a variable is cut off or damaged") from error


def _read(stream: IO[bytes], order: str, columns: ColumnMap, max_memory: float) -> Content:
    read: dict[str, Samples] = {}
    metadata: dict[str, str] = {}
    present: list[str] = []
    n_samples, stored = 0, stream.seek(0, SEEK_END)
    variables = list(_variables(stream, order, stored))
    names = [variable.name for variable in variables]
    chosen = _chosen(names, columns)
    wanted = [variable for variable in variables if variable.name in chosen]
    inside = columns.mat.variable is not None
    for array in _signals(stream, order, wanted, max_memory, inside=inside):
        present.append(array.name)
        if columns.target(array.name) is not None:
            if array.values is None:
                raise not_numeric(array.name, array.what)
            if array.values.size not in array.shape:
                raise not_numeric(array.name, f"numbers of shape {array.shape}")
            n_samples += array.values.size
            # MATLAB stores whole numbers in fewer bytes than they take here.
            check_size(8 * n_samples, stored)
            read[array.name] = as_samples(array.values)
        elif array.name in KEYS:
            metadata[array.name] = _text(array)
    present += [name for name in names if name and name not in chosen]
    return Content(read, metadata, tuple(present))


def _variables(stream: IO[bytes], order: str, end: int) -> Iterator[_Variable]:
    """Find the variables by their tags, and read their names."""
    at = _HEADER
    while at < end:
        stream.seek(at)
        kind, size = struct.unpack(order + "II", stream.read(_TAG))
        packed = kind == _COMPRESSED
        start, stored = at + _TAG, size
        at = start + stored
        if at > end:
            raise corrupt("the last variable is cut off")
        head = stream.read(min(stored, _PEEK))
        if packed:
            head = zlib.decompressobj().decompress(head, _PEEK)
            kind, size = struct.unpack_from(order + "II", head)
            head = head[_TAG:]
        if kind != _MATRIX:
            raise corrupt(f"no variable begins at byte {start - _TAG}")
        # Objects of newer classes have no name, and neither have empty variables.
        name = _head(_elements(memoryview(head), order), order)[2] if head else ""
        yield _Variable(name, packed, start, stored, size)


def _chosen(names: list[str], columns: ColumnMap) -> set[str]:
    """Choose the variables that hold the log."""
    if columns.mat.variable is not None:
        chosen = {columns.mat.variable}
        if columns.mat.variable not in names:
            detail = f"the column map needs the variable {columns.mat.variable}; there: "
            raise Unusable("columns", detail + listed(names))
    else:
        roots = {re.split(r"[.({]", source)[0] for source in columns.columns.values()}
        known = roots | set(KEYS)
        chosen = {name for name in names if name and (name in known or columns.target(name))}
    if twice := repeated(name for name in names if name in chosen):
        raise Unusable("columns", f"the file holds {listed(twice)} more than once")
    return chosen


def _signals(
    stream: IO[bytes], order: str, variables: list[_Variable], max_memory: float, *, inside: bool
) -> Iterator[_Array]:
    """Yield the arrays of variables, matrices column by column, unless they take too much memory.

    With ``inside`` the fields of a struct are called without the name of the variable.
    """
    stored = stream.seek(0, SEEK_END)
    unpacked = n_columns = 0
    for variable in variables:
        unpacked += _TAG + variable.size
        check_size(unpacked, stored)
        check_memory(f"variable {variable.name[:80]!r}", _TAG + variable.size, max_memory)
        name = "" if inside else variable.name
        for k, array in enumerate(_arrays(_content(stream, variable), order, variable.name, name)):
            columns = _columns(array)
            n_columns += len(columns)
            if k + n_columns > constants.MOST_ARRAYS:
                detail = f"more than {constants.MOST_ARRAYS} arrays; save the log by itself"
                raise Unusable("columns", detail)
            yield from columns


def _content(stream: IO[bytes], variable: _Variable) -> memoryview:
    """Read a variable without its tag."""
    stream.seek(variable.start)
    stored = stream.read(variable.stored)
    if not variable.packed:
        return memoryview(stored)
    inflater, size = zlib.decompressobj(), _TAG + variable.size
    content = inflater.decompress(stored, size + 1)
    # The checksum is that of the whole variable.
    if len(content) != size or not inflater.eof:
        raise corrupt(f"the variable at byte {variable.start} is cut off or damaged")
    return memoryview(content)[_TAG:]


def _columns(array: _Array) -> list[_Array]:
    """Split a matrix of signals into its columns; any other array stays whole."""
    values, shape = array.values, array.shape
    is_matrix = len(shape) == 2 and 1 not in shape and shape[1] <= constants.MOST_COLUMNS
    if values is None or not is_matrix:
        return [array]
    return [
        _Array(f"{array.name}(:,{k + 1})", (shape[0], 1), values=column)
        for k, column in enumerate(values.reshape(shape[::-1]))
    ]


def _text(array: _Array) -> str:
    """Read a single number or line of text."""
    if array.values is not None and array.values.size == 1:
        value = array.values[0].item()
        # An integer may be stored as one or not.
        return str(int(value) if float(value).is_integer() else value)
    if array.text is not None and (not prod(array.shape) or array.shape[0] == 1):
        return array.text
    raise Unusable("metadata", f"{array.name} is no single text or number; write it as text")


Elements = Iterator[tuple[int, memoryview]]


def _elements(view: memoryview, order: str) -> Elements:
    """Split the content of a variable into its data elements: type and content of each."""
    at, stop = 0, len(view)
    while at < stop:
        kind, size = struct.unpack_from(order + "II", view, at)
        if kind >> 16:  # up to four bytes are inside the tag itself
            start, after, kind, size = at + 4, at + _TAG, kind & 0xFFFF, kind >> 16
        else:
            start = at + _TAG
            after = start + size + (0 if kind == _MATRIX else -size % 8)
        # The last element need not be padded.
        at = min(after, stop)
        if start + size > at:
            raise corrupt("an element of a variable is cut off")
        yield kind, view[start : start + size]


def _next(elements: Elements, *kinds: int) -> tuple[int, memoryview]:
    """Return the next element, which must be of one of some types."""
    kind, content = next(elements, (0, memoryview(b"")))
    if kind not in kinds:
        raise corrupt("a variable is cut off or damaged")
    return kind, content


def _integers(elements: Elements, order: str) -> tuple[int, ...]:
    _, content = _next(elements, _INT32)
    return struct.unpack_from(f"{order}{len(content) // 4}i", content)


def _head(elements: Elements, order: str) -> tuple[int, tuple[int, ...], str, bool]:
    """Read class, shape, name, and whether complex; objects of newer classes have but a class."""
    word, _ = struct.unpack(order + "II", _next(elements, _UINT32)[1])
    kind = word & 0xFF
    if kind == _OPAQUE:
        return kind, (), "", False
    shape = _integers(elements, order)
    if not 1 <= len(shape) <= constants.DEEPEST or min(shape) < 0:
        raise corrupt("a variable has impossible dimensions")
    name = str(_next(elements, _INT8)[1], "latin-1")
    return kind, shape, name, bool(word & _COMPLEX)


def _arrays(
    view: memoryview, order: str, name: str, prefix: str, depth: int = 0
) -> Iterator[_Array]:
    """Yield all arrays of a matrix that are no structs; the prefix names fields of a struct."""
    if not len(view):
        yield _Array(name, (0, 0), values=np.empty(0))
        return
    if depth > constants.DEEPEST:
        raise corrupt(f"{name[:80]!r} is nested deeper than {constants.DEEPEST}")
    elements = _elements(view, order)
    kind, shape, _, is_complex = _head(elements, order)
    if kind == _STRUCT:
        for label, field in _fields(elements, order, prefix, shape, len(view)):
            yield from _arrays(field, order, label, label, depth + 1)
    elif kind in _OTHERS:
        yield _Array(name, shape, _OTHERS[kind])
    elif kind == _CHAR:
        stored, content = _next(elements, *_ENCODINGS)
        encoding = _ENCODINGS[stored]
        if encoding in ("utf-16", "utf-32"):
            encoding += "-le" if order == "<" else "-be"
        yield _Array(name, shape, "text", text=str(content, encoding))
    elif kind in _NUMERIC:
        stored, content = _next(elements, *_TYPES)
        dtype = np.dtype(order + _TYPES[stored])
        if len(content) != prod(shape) * dtype.itemsize:
            raise corrupt(f"{name[:80]!r} is cut off")
        what = "complex numbers" if is_complex else "numbers"
        values = None if is_complex else np.frombuffer(content, dtype=dtype)
        yield _Array(name, shape, what, values)
    else:
        raise corrupt(f"{name[:80]!r} is of the unknown class {kind}")


def _fields(
    elements: Elements, order: str, name: str, shape: tuple[int, ...], size: int
) -> Iterator[tuple[str, memoryview]]:
    """Yield name and content of the fields of a struct, entry after entry."""
    length, (_, names) = sum(_integers(elements, order)), _next(elements, _INT8)
    if not 1 <= length <= _PEEK or len(names) % length:
        raise corrupt("a struct has impossible fields")
    parts = (names[k : k + length] for k in range(0, len(names), length))
    fields = [str(part, "latin-1").split("\0")[0] for part in parts]
    n_items = prod(shape)
    if n_items * len(fields) * _TAG > size:
        raise corrupt(f"{name[:80]!r} is cut off")
    for k in range(n_items if fields else 0):
        whole = name if n_items == 1 else f"{name}({k + 1})"
        for field in fields:
            yield f"{whole}.{field}" if whole else field, _next(elements, _MATRIX)[1]


def _sniff(head: bytes) -> bool:
    version = head[_HEADER - 4 : _HEADER]
    return version in _ORDERS or (version in _HDF5_INSIDE and head.startswith(b"MATLAB"))


MAT = Format("MAT", (".mat",), _sniff, _load)
