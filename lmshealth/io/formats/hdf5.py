"""HDF5: one dataset per column at the root, root attributes as metadata.

Nothing outside the file is opened: links, external storage and virtual datasets are refused. The
HDF5 library loops without end on a damaged heap of strings (HDFGroup/hdf5 issue 1707; still so in
2.0.0), allocates as many bytes as a damaged attribute claims, and crashes Python at its end after a
virtual dataset that cannot be opened. `Guarded` checks what the library reads before it gets it.
"""

from __future__ import annotations

import re
import struct
from io import FileIO
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lmshealth.io import constants
from lmshealth.io.buffers import BLOCK, MINUTE, Spool, spools
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.content import Content, Format, check_size, not_numeric, wanted
from lmshealth.io.metadata import KEYS
from lmshealth.io.refusal import Unusable

_MAGIC = b"\x89HDF\r\n\x1a\n"
# Version 1 of a heap of strings, and the bytes of its header and of each object's.
_HEAP = b"GCOL\1\0\0\0"
_HEADER = 16
# Layout of a virtual dataset that lists no files; one that lists some does it in a heap.
_NO_FILES = b"\x04\x03" + 8 * b"\xff" + bytes(4)
# Attribute messages: version, bytes before the name, and what the sizes of name, type and space
# are rounded up to. The sizes are at byte 2; a text begins with its length (4), heap and object.
_LONGEST_MESSAGE = 512
_MESSAGES = ((1, 8, 8), (2, 8, 1), (3, 9, 1))


class Guarded(FileIO):
    """A file for h5py's driver of Python files that checks heaps and text attributes.

    Each heap is checked when the library reads it: to search the file for heaps takes half as long
    as to read it.

    Parameters
    ----------
    path : Path
        The file.

    Attributes
    ----------
    now : str
        Content that is read: ``columns`` are opened, ``texts`` are read, or ``samples``.
    trouble : Unusable or None
        Why bytes were withheld from the library, which then fails with an error of its own.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.size = path.stat().st_size
        self.now: Literal["columns", "texts", "samples"] = "columns"
        self.trouble: Unusable | None = None
        self._read: list[tuple[int, int]] = []

    def readinto(self, buffer: Any) -> int:
        """Read for the library; zeros in the place of damaged bytes."""
        if self.now == "samples":
            return super().readinto(buffer)
        start = self.tell()
        n_read = super().readinto(buffer)
        content = bytes(buffer)
        self._read.append((start, start + n_read))
        self.trouble = self.trouble or self._trouble(start, content)
        if self.trouble is not None:
            buffer[:] = bytes(len(buffer))
        return n_read

    def claimed(self, attribute: str) -> int:
        """Return the bytes that the library allocates when it reads a text attribute."""
        most = 0
        name = attribute.encode() + b"\0"
        for start, stop in self._read:
            # A message may continue where another read began.
            content = self._bytes(start, stop + _LONGEST_MESSAGE)
            for found in re.finditer(re.escape(name), content):
                at = start + found.start()
                most = max(most, *(self._length(at, len(name), *kind) for kind in _MESSAGES))
        return most

    def _length(self, at: int, size: int, version: int, header: int, unit: int) -> int:
        """Read the length of a text from the message around its name; 0 if it is none."""
        message = self._bytes(at - header, at + _LONGEST_MESSAGE)
        sizes = struct.unpack_from("<3H", message, 2)
        if message[0] != version or sizes[0] != size:
            return 0
        data = header + sum(-(-size // unit) * unit for size in sizes)
        return int.from_bytes(message[data : data + 4], "little")

    def _bytes(self, start: int, stop: int) -> bytes:
        self.seek(max(start, 0))
        return self.read(stop - max(start, 0))

    def _trouble(self, start: int, content: bytes) -> Unusable | None:
        is_heap = content.startswith(_HEAP)
        if self.now == "columns" and (is_heap or _NO_FILES in content):
            return Unusable("escapes", "a column keeps its samples in other files")
        return self._damage(start) if is_heap else None

    def _damage(self, start: int) -> Unusable | None:
        """Follow the objects of a heap as the library does."""
        heap = self._bytes(start, start + constants.LARGEST_HEAP)
        size = int.from_bytes(heap[8:_HEADER], "little")
        if size > len(heap):
            return Unusable("corrupt", f"heap of strings of {size} bytes at byte {start}")
        at = _HEADER
        while at + _HEADER <= size:
            claimed = int.from_bytes(heap[at + 8 : at + _HEADER], "little")
            # Free space (index 0) counts its header, an object does not.
            free = heap[at : at + 2] == bytes(2)
            step = claimed if free else _HEADER + -(-claimed // 8) * 8
            if step < _HEADER or at + step > size:
                return Unusable(
                    "corrupt", f"damaged heap of strings at byte {start + at}; copy the file again"
                )
            at += step
        return None


def _load(path: Path, columns: ColumnMap, max_memory: float) -> Content:
    import h5py

    with Guarded(path) as stream:
        try:
            with h5py.File(stream, "r") as file:
                return _content(file, stream, columns)
        except Exception:
            if stream.trouble is None:
                raise
        raise stream.trouble


def _content(file: Any, stream: Guarded, columns: ColumnMap) -> Content:
    names = list(file)
    chosen = {name: _dataset(file, name) for name in wanted(names, columns)}
    stream.now = "texts"
    metadata = {key: _attribute(file, stream, key) for key in KEYS if key in file.attrs}
    check_size(8 * sum(dataset.size for dataset in chosen.values()), stream.size)
    stream.now = "samples"
    with spools(chosen) as taken:
        for name, dataset in chosen.items():
            _read(dataset, taken[name])
    read = {name: spool.samples() for name, spool in taken.items()}
    return Content(read, metadata, tuple(names))


def _dataset(file: Any, name: str) -> Any:
    """Open a column, and check that it is complete and in this file."""
    import h5py

    if not isinstance(file.get(name, getlink=True), h5py.HardLink):
        raise Unusable("escapes", f"column {name!r} is a link; needed a dataset in this file")
    item = file[name]
    if not isinstance(item, h5py.Dataset):
        raise not_numeric(name, "a group")
    # Kind "O" would be strings or object references: never loaded.
    if item.dtype.kind not in "fiu" or item.ndim != 1:
        raise not_numeric(name, f"{item.dtype} of shape {item.shape}")
    if item.is_virtual or item.external:
        raise Unusable("escapes", f"column {name!r} keeps its samples in another file")
    # HDF5 reads blocks that a crashed recorder never wrote as zeros.
    if item.size == 0 or item.chunks is None:
        needed, found = int(item.size > 0), int(item.id.get_storage_size() > 0)
    else:
        needed, found = -(-item.size // item.chunks[0]), item.id.get_num_chunks()
    if found < needed:
        raise Unusable("corrupt", f"column {name!r}: {found} of {needed} blocks were ever written")
    return item


def _read(dataset: Any, spool: Spool) -> None:
    """Read a column, beyond a minute in stretches of whole chunks: each is unpacked only once."""
    chunk = 1 if dataset.chunks is None else dataset.chunks[0]
    step = max(1, dataset.size) if dataset.size <= MINUTE else -(-BLOCK // chunk) * chunk
    for start in range(0, dataset.size, step):
        spool.append(dataset[start : start + step])


def _attribute(file: Any, stream: Guarded, key: str) -> str:
    """Read an attribute of any plain type as text."""
    import h5py

    attribute = file.attrs.get_id(key)
    # Its type is checked before it is read: the library crashes on damaged types of other classes.
    plain = h5py.h5t.TypeStringID, h5py.h5t.TypeIntegerID, h5py.h5t.TypeFloatID, h5py.h5t.TypeEnumID
    kind = attribute.get_type()
    is_plain = isinstance(kind, plain) and kind.get_size() <= constants.LONGEST_ATTRIBUTE
    if not is_plain or attribute.shape not in ((), (1,)):
        raise Unusable("metadata", f"{key} is no single text or number; write it as text")
    if isinstance(kind, h5py.h5t.TypeStringID) and kind.is_variable_str():
        claimed = stream.claimed(key)
        if claimed > constants.LONGEST_ATTRIBUTE:
            raise Unusable("corrupt", f"{key} claims a text of {claimed} bytes")
    value = np.asarray(file.attrs[key]).reshape(-1)[0]
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    if isinstance(value, np.bool_):
        return "true" if value else "false"
    return str(value)


HDF5 = Format("HDF5", (".h5", ".hdf5"), lambda head: head.startswith(_MAGIC), _load)
