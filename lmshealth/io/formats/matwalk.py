"""The arrays in a variable of a MAT-file of version 5, none of whose sizes is believed unseen."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from math import prod
from typing import NamedTuple

import numpy as np

from lmshealth.io.formats.matbytes import PlainBytes, cut_off
from lmshealth.io.refusal import Unusable

TAG = 8
MATRIX, COMPRESSED = 14, 15
NUMBERS, TEXT = "numbers", "text"

_INT8, _INT32, _UINT32 = 1, 5, 6
# Whatever the class of an array, MATLAB stores its numbers in the smallest type that holds them.
_TYPES = dict(zip((1, 2, 3, 4, 5, 6, 7, 9, 12, 13), "bBhHiIfdqQ", strict=True))
_ENCODINGS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
_STRUCT, _CHAR, _OPAQUE = 2, 4, 17
_NUMERIC = range(6, 16)
_OBJECT = "an object or a function (save plain arrays or structs)"
_OTHERS = {1: "cells", 3: _OBJECT, 5: "a sparse matrix", 16: _OBJECT, 17: _OBJECT}
_COMPLEX = 1 << 11
_DEEPEST = 32
_MOST_DIMENSIONS = 32
# Names and short text are read whole.
_LONGEST = 1 << 20
_LONGEST_NAME = 64
_BLOCK = 1 << 20


class _Element(NamedTuple):
    """A data element whose tag is read: its type, its size, and where the next one begins."""

    kind: int
    size: int
    after: int


@dataclass(frozen=True, slots=True, eq=False)
class Array:
    """An array whose content comes next: it is read before the walk goes on, or never.

    Attributes
    ----------
    name : str
        As MATLAB calls it.
    shape : tuple of int
        As in MATLAB, whose arrays are stored column after column.
    what : str
        What it holds: `NUMBERS`, `TEXT`, or words for a message.
    """

    name: str
    shape: tuple[int, ...]
    what: str
    _source: PlainBytes
    _order: str
    _kind: int = 0
    _size: int = 0

    def numbers(self, n: int) -> Iterator[np.ndarray]:
        """Read the next ``n`` numbers in blocks, as they are stored."""
        dtype = np.dtype(self._order + _TYPES[self._kind])
        left = n * dtype.itemsize
        while left > 0:
            block = self._source.read(min(left, _BLOCK))
            left -= len(block)
            yield np.frombuffer(block, dtype=dtype)

    def skip(self, n: int) -> None:
        """Pass over the next ``n`` numbers."""
        self._source.skip(n * struct.calcsize("=" + _TYPES[self._kind]))

    def text(self) -> str:
        """Read text."""
        if self._size > _LONGEST:
            raise cut_off(self._source.at)
        encoding = _ENCODINGS[self._kind]
        if encoding in ("utf-16", "utf-32"):
            encoding += "-le" if self._order == "<" else "-be"
        return str(self._source.read(self._size), encoding)


class Walker:
    """Walks through one variable.

    Parameters
    ----------
    source : PlainBytes
        Its bytes, with its tag.
    order : str
        Order of bytes as `struct` writes it.

    Attributes
    ----------
    size : int
        Number of bytes that the variable claims to have.

    Raises
    ------
    Unusable
        With reason ``corrupt`` for something else than a variable.
    """

    def __init__(self, source: PlainBytes, order: str) -> None:
        self._source = source
        self._order = order
        kind, size = struct.unpack(order + "II", source.read(TAG))
        if kind != MATRIX:
            raise Unusable("corrupt", "what is compressed is no variable; copy the file again")
        self.size = TAG + size

    def name(self) -> str:
        """Read the variable's name; empty for those without, which no map can mean."""
        if self.size == TAG or self._flags(self.size)[0] == _OPAQUE:
            return ""
        self._shape(self.size)
        return self._name(self.size)

    def arrays(self, name: str, *, inside: bool) -> Iterator[Array]:
        """Give all arrays that are no structs.

        Parameters
        ----------
        name : str
            Of the variable.
        inside : bool
            Whether the fields of a struct are called without the name of the variable.

        Raises
        ------
        Unusable
            With reason ``corrupt`` where sizes contradict each other.
        """
        yield from self._matrix(name, self.size, 0, inside=inside)
        self._go(self.size)
        self._source.finish()

    def _go(self, at: int) -> None:
        self._source.skip(at - self._source.at)

    def _element(self, stop: int) -> _Element:
        """Read the tag of a data element, which ends at ``stop`` or before."""
        at = self._source.at
        if at + TAG > stop:
            raise cut_off(at)
        (kind,) = struct.unpack(self._order + "I", self._source.read(4))
        if kind >> 16:  # up to four bytes stand inside the tag itself
            kind, size, after = kind & 0xFFFF, kind >> 16, at + TAG
        else:
            (size,) = struct.unpack(self._order + "I", self._source.read(4))
            after = at + TAG + size + (0 if kind == MATRIX else -size % 8)
        # The last element need not be padded.
        after = min(after, stop)
        if self._source.at + size > after:
            raise cut_off(at)
        return _Element(kind, size, after)

    def _read(self, stop: int, kind: int) -> bytes:
        """Read a short data element of a type."""
        found = self._element(stop)
        if found.kind != kind or found.size > _LONGEST:
            raise cut_off(self._source.at)
        content = self._source.read(found.size)
        self._go(found.after)
        return content

    def _integers(self, stop: int) -> tuple[int, ...]:
        content = self._read(stop, _INT32)
        return struct.unpack(f"{self._order}{len(content) // 4}i", content)

    def _flags(self, stop: int) -> tuple[int, bool]:
        """Read class, and whether complex."""
        content = self._read(stop, _UINT32)
        if len(content) != 8:
            raise Unusable("corrupt", "a variable does not say its class; copy the file again")
        (word,) = struct.unpack_from(self._order + "I", content)
        return word & 0xFF, bool(word & _COMPLEX)

    def _shape(self, stop: int) -> tuple[int, ...]:
        sizes = self._integers(stop)
        if not 1 <= len(sizes) <= _MOST_DIMENSIONS or min(sizes) < 0:
            raise Unusable("corrupt", "a variable of impossible dimensions; copy the file again")
        return sizes

    def _name(self, stop: int) -> str:
        return str(self._read(stop, _INT8), "latin-1")

    def _matrix(self, name: str, stop: int, depth: int, *, inside: bool = False) -> Iterator[Array]:
        if self._source.at == stop:
            yield Array(name, (0, 0), NUMBERS, self._source, self._order)
            return
        if depth > _DEEPEST:
            raise Unusable("corrupt", f"{name[:80]!r} is nested deeper than {_DEEPEST}")
        kind, is_complex = self._flags(stop)
        shape: tuple[int, ...] = ()
        # Objects of newer classes have other parts.
        if kind != _OPAQUE:
            shape = self._shape(stop)
            self._name(stop)
        if kind == _STRUCT:
            yield from self._struct("" if inside else name, prod(shape), stop, depth)
        elif kind in _OTHERS:
            yield Array(name, shape, _OTHERS[kind], self._source, self._order)
        elif kind == _CHAR:
            content = self._content(stop, _ENCODINGS)
            yield Array(name, shape, TEXT, self._source, self._order, content.kind, content.size)
        elif kind in _NUMERIC:
            content = self._content(stop, _TYPES)
            if content.size != prod(shape) * struct.calcsize("=" + _TYPES[content.kind]):
                raise cut_off(self._source.at)
            what = "complex numbers" if is_complex else NUMBERS
            yield Array(name, shape, what, self._source, self._order, content.kind, content.size)
        else:
            raise Unusable("corrupt", f"{name[:80]!r} is of the unknown class {kind}")

    def _content(self, stop: int, kinds: dict[int, str]) -> _Element:
        found = self._element(stop)
        if found.kind not in kinds:
            raise cut_off(self._source.at)
        return found

    def _struct(self, name: str, n_items: int, stop: int, depth: int) -> Iterator[Array]:
        fields = self._fields(stop)
        if n_items * len(fields) * TAG > stop - self._source.at:
            raise cut_off(self._source.at)
        for k in range(n_items if fields else 0):
            whole = name if n_items == 1 else f"{name}({k + 1})"
            for field in fields:
                found = self._element(stop)
                if found.kind != MATRIX:
                    raise cut_off(self._source.at)
                label = f"{whole}.{field}" if whole else field
                yield from self._matrix(label, self._source.at + found.size, depth + 1)
                self._go(found.after)

    def _fields(self, stop: int) -> list[str]:
        """Read the names of a struct's fields."""
        length = sum(self._integers(stop))
        names = self._read(stop, _INT8)
        if not 1 <= length <= _LONGEST_NAME or len(names) % length:
            raise Unusable("corrupt", "a struct of impossible fields; copy the file again")
        return [
            str(names[k : k + length].split(b"\0")[0], "latin-1")
            for k in range(0, len(names), length)
        ]
