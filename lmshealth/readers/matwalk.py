"""The tags of a MAT-file of version 5: checked before anything believes the sizes they claim."""

from __future__ import annotations

import struct
from math import prod
from typing import NamedTuple

from lmshealth.readers.trouble import Unusable

HEADER = 128
TAG = 8
MATRIX, COMPRESSED = 14, 15

_INT8, _INT32, _UINT32 = 1, 5, 6
# Integers, floats, and text in UTF-8, UTF-16 and UTF-32; numbers 8, 10 and 11 do not exist.
_PLAIN = frozenset({1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 16, 17, 18})
_CELL, _STRUCT, _CHAR = 1, 2, 4
_NUMERIC = range(6, 16)
_REFUSED = {3: "an object", 5: "a sparse matrix", 16: "a function", 17: "an object"}
_COMPLEX = 1 << 11
_DEEPEST = 32
_MOST_DIMENSIONS = 32


class _Data(NamedTuple):
    """One data element: its type, where its bytes are, and where the next one begins."""

    kind: int
    start: int
    stop: int
    after: int


def cut_off(at: int) -> Unusable:
    """Say that something is larger than what holds it."""
    return Unusable("corrupt", f"what begins at byte {at} is cut off; copy the file again")


class Walker:
    """Walks through one uncompressed variable.

    Parameters
    ----------
    data : bytes or memoryview
        The variable with its tag.
    order : str
        Order of bytes as `struct` writes it.
    partial : bool
        Whether these are only its first bytes.
    """

    def __init__(self, data: bytes | memoryview, order: str, *, partial: bool = False) -> None:
        self._data = data
        self._order = order
        self._partial = partial

    def name(self) -> str:
        """Read the variable's name; empty for those without, which no map can mean."""
        outer = self._element(0, len(self._data))
        if outer.start == outer.stop:
            return ""
        kind, _, at = self._flags(outer)
        if kind == 17:  # objects of newer classes say their names elsewhere
            return ""
        _, at = self._dimensions(at, outer.stop)
        found = self._element(at, outer.stop)
        return str(self._data[found.start : found.stop], "latin-1")

    def check(self, name: str) -> None:
        """Refuse what scipy must not be given.

        Raises
        ------
        Unusable
            With reason ``columns`` for objects, functions and sparse matrices, with reason
            ``corrupt`` where sizes contradict each other.
        """
        outer = self._element(0, len(self._data))
        if outer.kind != MATRIX or outer.after != len(self._data):
            raise cut_off(0)
        self._matrix(outer, name, 0)

    def _element(self, at: int, stop: int) -> _Data:
        """Read the tag of a data element inside ``stop``."""
        if at + TAG > stop:
            raise cut_off(at)
        first, size = struct.unpack_from(self._order + "II", self._data, at)
        if first >> 16:  # up to four bytes stand inside the tag itself
            kind, size, start = first & 0xFFFF, first >> 16, at + 4
            after = at + TAG
            if size > 4:
                raise cut_off(at)
        else:
            kind, start = first, at + TAG
            padding = 0 if kind == MATRIX else -size % 8
            after = start + size + padding
        if self._partial:
            return _Data(kind, start, min(start + size, stop), min(after, stop))
        if start + size > stop:
            raise cut_off(at)
        return _Data(kind, start, start + size, min(after, stop))

    def _integers(self, data: _Data) -> tuple[int, ...]:
        count = (data.stop - data.start) // 4
        return struct.unpack_from(f"{self._order}{count}i", self._data, data.start)

    def _flags(self, outer: _Data) -> tuple[int, bool, int]:
        """Read class, whether complex, and where the dimensions begin."""
        data = self._element(outer.start, outer.stop)
        if data.kind != _UINT32 or data.stop - data.start != 8:
            raise Unusable("corrupt", "a variable does not say its class; copy the file again")
        (word,) = struct.unpack_from(self._order + "I", self._data, data.start)
        return word & 0xFF, bool(word & _COMPLEX), data.after

    def _dimensions(self, at: int, stop: int) -> tuple[int, int]:
        """Read the number of entries, and where the name begins."""
        data = self._element(at, stop)
        sizes = self._integers(data)
        if data.kind != _INT32 or not 1 <= len(sizes) <= _MOST_DIMENSIONS or min(sizes) < 0:
            raise Unusable("corrupt", f"impossible dimensions at byte {at}; copy the file again")
        return prod(sizes), data.after

    def _matrix(self, outer: _Data, name: str, depth: int) -> None:
        if outer.start == outer.stop:
            return
        if depth > _DEEPEST:
            raise Unusable("corrupt", f"variable {name!r} is nested deeper than {_DEEPEST}")
        kind, is_complex, at = self._flags(outer)
        if kind in _REFUSED:
            raise Unusable(
                "columns", f"variable {name!r} holds {_REFUSED[kind]}; save plain arrays or structs"
            )
        n_entries, at = self._dimensions(at, outer.stop)
        label = self._element(at, outer.stop)
        if label.kind != _INT8:
            raise cut_off(at)
        if kind in (_CELL, _STRUCT):
            n_fields, at = 1, label.after
            if kind == _STRUCT:
                n_fields, at = self._fields(at, outer.stop)
            self._children(n_entries * n_fields, at, outer.stop, name, depth)
        elif kind == _CHAR or kind in _NUMERIC:
            at = label.after
            for _ in range(2 if is_complex else 1):
                at = self._values(n_entries, at, outer.stop)
        else:
            raise Unusable("corrupt", f"variable {name!r} is of the unknown class {kind}")

    def _fields(self, at: int, stop: int) -> tuple[int, int]:
        """Count the fields of a struct, and tell where their values begin."""
        length = self._element(at, stop)
        sizes = self._integers(length)
        names = self._element(length.after, stop)
        n_bytes = names.stop - names.start
        if length.kind != _INT32 or len(sizes) != 1 or sizes[0] < 1 or n_bytes % sizes[0]:
            raise Unusable("corrupt", f"impossible fields at byte {at}; copy the file again")
        return n_bytes // sizes[0], names.after

    def _children(self, count: int, at: int, stop: int, name: str, depth: int) -> None:
        if count * TAG > stop - at:
            raise cut_off(at)
        for _ in range(count):
            child = self._element(at, stop)
            if child.kind != MATRIX:
                raise Unusable("corrupt", f"no array at byte {at} of {name!r}; copy the file again")
            self._matrix(child, name, depth + 1)
            at = child.after

    def _values(self, n_entries: int, at: int, stop: int) -> int:
        """Check numbers or characters; an entry takes a byte at least."""
        data = self._element(at, stop)
        if data.kind not in _PLAIN or n_entries > data.stop - data.start:
            raise cut_off(at)
        return data.after
