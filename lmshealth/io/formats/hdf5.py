"""HDF5: one dataset per column at the root, root attributes as metadata.

Nothing outside the file is opened: links, external storage and virtual datasets are refused. The
HDF5 library loops without end on a damaged heap of strings (HDFGroup/hdf5 issue 1707; still so in
2.0.0), clears as many bytes as a text claims, up to 4 GB, before it looks for the text, and crashes
Python at its end after a virtual dataset that cannot be opened. `Guarded` checks what the library
reads before it gets it.
"""

from __future__ import annotations

from io import SEEK_END, FileIO
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lmshealth.io import constants
from lmshealth.io.buffers import BLOCK, MINUTE, Spool
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.content import Content, Format, check_size, not_numeric, wanted
from lmshealth.io.metadata import KEYS, as_text
from lmshealth.io.refusal import Unusable, corrupt

_MAGIC = b"\x89HDF\r\n\x1a\n"
# Version 1 of a heap of strings, and the bytes of its header and of each object's.
_HEAP = b"GCOL\1\0\0\0"
_HEADER = 16
# Layout of a virtual dataset without files; the files of others are listed in a heap.
_NO_FILES = b"\x04\x03" + 8 * b"\xff" + bytes(4)


class Guarded(FileIO):
    """A file for h5py's driver of Python files that checks heaps of strings.

    Each heap is checked when the library reads it: to search the file for heaps takes half as long
    as to read it. ``now`` is what is read: ``columns`` are opened, ``texts`` are read, or
    ``samples``; ``trouble`` why bytes were withheld from the library, which then fails with an
    error of its own.
    """

    now: Literal["columns", "texts", "samples"] = "columns"
    trouble: Unusable | None = None

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._headers: list[bytes] = []

    def readinto(self, buffer: Any) -> int:
        """Read for the library; zeros in the place of damaged bytes."""
        if self.now == "samples":
            return super().readinto(buffer)
        start = self.tell()
        n_read = super().readinto(buffer)
        content = bytes(buffer)
        is_heap = content.startswith(_HEAP)
        if self.now == "columns":
            self._headers.append(content)
        if self.trouble is None and self.now == "columns" and (is_heap or _NO_FILES in content):
            self.trouble = Unusable("escapes", "a column keeps its samples in other files")
        elif self.trouble is None and is_heap:
            self.trouble = self._damage(start)
        if self.trouble is not None:
            buffer[:] = bytes(len(buffer))
        return n_read

    def claimed_length(self, key: str) -> int:
        """How long a text of variable length says it is; 0 in layouts with checksums."""
        for content in self._headers:
            at = content.find(key.encode() + b"\0")
            # Sizes of name, type and shape, then these, each filled up to 8 bytes.
            if at >= 8 and content[at - 8] == 1:
                sizes = np.frombuffer(content, "<u2", 3, at - 6).astype(int)
                start = at + int((-(-sizes // 8) * 8).sum())
                return int.from_bytes(content[start : start + 4], "little")
        return 0

    def _damage(self, start: int) -> Unusable | None:
        """Follow the objects of a heap as the library does."""
        self.seek(start)
        heap = self.read(constants.LARGEST_HEAP)
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
                return corrupt(f"damaged heap of strings at byte {start + at}")
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
    # A name that is no text comes as bytes.
    names = [n.decode("utf-8", "replace") if isinstance(n, bytes) else n for n in file]
    chosen = {name: _dataset(file, name) for name in wanted(names, columns)}
    stream.now = "texts"
    metadata = {key: _attribute(file, stream, key) for key in KEYS if key in file.attrs}
    stored = stream.seek(0, SEEK_END)
    check_size(8 * sum(dataset.size for dataset in chosen.values()), stored)
    stream.now = "samples"
    taken = {name: Spool() for name in chosen}
    for name, dataset in chosen.items():
        # Beyond a minute in parts of whole chunks: each is unpacked only once.
        step = max(1, dataset.size)
        if dataset.size > MINUTE:
            chunk = dataset.chunks[0] if dataset.chunks else 1
            step = -(-BLOCK // chunk) * chunk
        for start in range(0, dataset.size, step):
            taken[name].append(dataset[start : start + step])
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
    needed, found = int(item.size > 0), int(item.id.get_storage_size() > 0)
    if item.size > 0 and item.chunks is not None:
        needed, found = -(-item.size // item.chunks[0]), item.id.get_num_chunks()
    if found < needed:
        raise Unusable("corrupt", f"column {name!r}: {found} of {needed} blocks were ever written")
    return item


def _attribute(file: Any, stream: Guarded, key: str) -> str:
    """Read an attribute of any plain type as text."""
    import h5py

    attribute = file.attrs.get_id(key)
    # Its type is checked before it is read: the library crashes on damaged types of other classes.
    plain = h5py.h5t.TypeStringID, h5py.h5t.TypeIntegerID, h5py.h5t.TypeFloatID, h5py.h5t.TypeEnumID
    kind = attribute.get_type()
    is_variable = isinstance(kind, h5py.h5t.TypeStringID) and kind.is_variable_str()
    length = stream.claimed_length(key) if is_variable else kind.get_size()
    if length > constants.LONGEST_ATTRIBUTE:
        most = constants.LONGEST_ATTRIBUTE
        raise Unusable("metadata", f"{key} claims {length} bytes; at most {most} are read")
    if not isinstance(kind, plain) or attribute.shape not in ((), (1,)):
        raise Unusable("metadata", f"{key} is no single text or number; write it as text")
    value = np.asarray(file.attrs[key]).reshape(-1)[0]
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return as_text(value)


HDF5 = Format("HDF5", (".h5", ".hdf5"), lambda head: head.startswith(_MAGIC), _load)
