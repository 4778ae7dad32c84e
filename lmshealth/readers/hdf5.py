"""HDF5: one dataset per column at the root, root attributes as metadata.

Nothing outside the file is touched: links, external storage and virtual datasets are refused.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np

from lmshealth.arrays import FloatArray
from lmshealth.readers.columns import ColumnMap
from lmshealth.readers.metadata import KEYS
from lmshealth.readers.raw import Format, Raw, check_size, not_numeric, wanted
from lmshealth.readers.trouble import Unusable

_MAGIC = b"\x89HDF\r\n\x1a\n"

# Global heap of the HDF5 file format: signature, version 1, three zeros, size of the collection
# (8 bytes); then objects with index (2), references (2), reserved (4), size (8).
_HEAP = b"GCOL\x01\x00\x00\x00"
_HEADER = 16
_BLOCK = 1 << 18
# A damaged length may claim gigabytes; HDF5 itself keeps no attribute above 64 KiB in its header.
_LONGEST_TEXT = 1 << 16


def _load(path: Path, columns: ColumnMap) -> Raw:
    import h5py

    _check_heaps(path)
    # "best-effort": archives often live on file systems that know no locks.
    with h5py.File(path, "r", locking="best-effort") as file:
        names = list(file)
        chosen = {name: _dataset(file, name) for name in wanted(names, columns)}
        decoded = 8 * sum(dataset.size for dataset in chosen.values())
        check_size(decoded, path.stat().st_size)
        read = {name: _float64(dataset) for name, dataset in chosen.items()}
        metadata = {key: _attribute(file, key) for key in KEYS if key in file.attrs}
    return Raw(read, metadata, tuple(names))


def _check_heaps(path: Path) -> None:
    """Refuse a damaged heap of strings, on which the HDF5 library never returns.

    The library walks a heap by the sizes its objects claim, and stands still at a claim of zero
    (HDFGroup/hdf5 issue 1707; still so in 2.0.0). Text attributes are kept in such heaps.
    """
    with (
        path.open("rb", buffering=0) as stream,
        mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data,
    ):
        for start in _heaps(stream, len(data)):
            stop = start + int.from_bytes(data[start + 8 : start + _HEADER], "little")
            stop = min(stop, len(data))
            at = start + _HEADER
            while at + _HEADER <= stop:
                index = int.from_bytes(data[at : at + 2], "little")
                size = int.from_bytes(data[at + 8 : at + _HEADER], "little")
                # Free space (index 0) counts its header, an object does not.
                step = size if index == 0 else _HEADER + -(-size // 8) * 8
                if step < _HEADER or at + step > stop:
                    raise Unusable(
                        "corrupt", f"damaged heap of strings at byte {at}; copy the file again"
                    )
                at += step


def _heaps(stream: FileIO, size: int) -> Iterator[int]:
    """Find where heaps begin, block by block; three times as fast as searching the whole file."""
    block = bytearray(_BLOCK)
    words = np.frombuffer(block, dtype="<u4")
    # However a heap is aligned, its first bytes hold one of these words whole.
    inside = [int.from_bytes(_HEAP[k : k + 4], "little") for k in range(4)]
    for at in range(0, size, _BLOCK - len(_HEAP)):
        stream.seek(at)
        n_read = stream.readinto(block)
        if not any((words == word).any() for word in inside):
            continue
        start = block.find(_HEAP, 0, n_read)
        while start >= 0:
            yield at + start
            start = block.find(_HEAP, start + 1, n_read)


def _dataset(file: Any, name: str) -> Any:
    """Open a column after looking at it from outside.

    Raises
    ------
    Unusable
        With reason ``escapes`` if its samples are elsewhere, ``columns`` if it is no series of
        numbers, ``corrupt`` if it was never written completely.
    """
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
    _check_written(item, name)
    return item


def _check_written(dataset: Any, name: str) -> None:
    """Refuse what a crashed recorder never wrote; HDF5 would read it as zeros."""
    if dataset.size == 0 or dataset.chunks is None:
        needed, found = int(dataset.size > 0), int(dataset.id.get_storage_size() > 0)
    else:
        needed, found = -(-dataset.size // dataset.chunks[0]), dataset.id.get_num_chunks()
    if found < needed:
        raise Unusable("corrupt", f"column {name!r}: {found} of {needed} blocks were ever written")


def _float64(dataset: Any) -> FloatArray:
    return np.asarray(dataset[()], dtype=np.float64)


def _attribute(file: Any, key: str) -> str:
    """Read an attribute as text, whatever plain type the exporter gave it."""
    import h5py

    attribute = file.attrs.get_id(key)
    # Looked at before it is read: the library crashes on damaged types of other classes.
    plain = h5py.h5t.TypeStringID, h5py.h5t.TypeIntegerID, h5py.h5t.TypeFloatID, h5py.h5t.TypeEnumID
    kind = attribute.get_type()
    is_plain = isinstance(kind, plain) and kind.get_size() <= _LONGEST_TEXT
    if not is_plain or attribute.shape not in ((), (1,)):
        raise Unusable("metadata", f"{key} is no single text or number; write it as text")
    value = np.asarray(file.attrs[key]).reshape(-1)[0]
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    if isinstance(value, np.bool_):
        return "true" if value else "false"
    return str(value)


HDF5 = Format("HDF5", (".h5", ".hdf5"), lambda head: head.startswith(_MAGIC), _load)
