"""HDF5: one dataset per column at the root, root attributes as metadata.

Nothing outside the file is read: links, external storage and virtual datasets are refused. The
library ends its process by a signal on damaged filters, loops on a damaged heap of strings
(HDFGroup/hdf5 issue 1707; still so in 2.0.0), and allocates what a text claims: it works in a
process of its own.
"""

from pathlib import Path
from typing import Any

import numpy as np

from lmshealth.io import constants
from lmshealth.io.buffers import BLOCK, Spool
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.content import Content, Format, check_size, not_numeric, wanted
from lmshealth.io.metadata import KEYS, as_text
from lmshealth.io.refusal import Unusable, corrupt

_MAGIC = b"\x89HDF\r\n\x1a\n"


def _load(path: Path, columns: ColumnMap, max_memory: float) -> Content:
    import h5py

    # A lock would need permission to write, or a file system that has locks.
    with h5py.File(path, "r", locking=False) as file:
        # A name that is no text comes as bytes.
        names = [n.decode("utf-8", "replace") if isinstance(n, bytes) else n for n in file]
        chosen = {name: _dataset(file, name) for name in wanted(names, columns)}
        metadata = {key: _attribute(file, key) for key in KEYS if key in file.attrs}
        check_size(8 * sum(dataset.size for dataset in chosen.values()), path.stat().st_size)
        taken = {name: Spool(dataset.size) for name, dataset in chosen.items()}
        for name, dataset in chosen.items():
            # In parts of whole chunks: each is unpacked only once.
            chunk = dataset.chunks[0] if dataset.chunks else 1
            step = -(-BLOCK // chunk) * chunk
            for start in range(0, dataset.size, step):
                values = dataset[start : start + step]
                _check_blocks(dataset, values, start)
                taken[name].append(values)
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
    # Before its shape, for which the library may open the files of a virtual one.
    if item.id.get_create_plist().get_layout() == h5py.h5d.VIRTUAL or item.external:
        raise Unusable("escapes", f"column {name!r} keeps its samples in another file")
    # Kind "O" would be strings or object references: never loaded.
    if item.dtype.kind not in "fiu" or item.ndim != 1:
        raise not_numeric(name, f"{item.dtype} of shape {item.shape}")
    # HDF5 reads blocks that a crashed recorder never wrote as zeros. More than are needed are there
    # where the size is damaged.
    needed, found = int(item.size > 0), int(item.id.get_storage_size() > 0)
    if item.size > 0 and item.chunks is not None:
        needed, found = -(-item.size // item.chunks[0]), item.id.get_num_chunks()
    if found != needed:
        raise Unusable("corrupt", f"column {name!r}: {found} of {needed} blocks were ever written")
    _check_header(item, name)
    return item


def _check_header(item: Any, name: str) -> None:
    """Refuse (``corrupt``) contradictions in a header without checksum: samples would be wrong."""
    import h5py

    properties, kind = item.id.get_create_plist(), item.id.get_type()
    filters = [properties.get_filter(k) for k in range(properties.get_nfilters())]
    of_shuffle = [f[2][:1] for f in filters if f[0] == h5py.h5z.FILTER_SHUFFLE]
    is_odd = item.dtype.kind == "f" and kind != h5py.h5t.py_create(item.dtype)
    if is_odd or any(size != (item.dtype.itemsize,) for size in of_shuffle):
        raise corrupt(f"column {name!r} has a damaged type or filter")
    if item.chunks is None:
        return
    # Only compression may be left out, of a block that it does not shorten.
    always = (h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32)
    mask = sum(1 << k for k, one in enumerate(filters) if one[0] in always)
    whole = item.chunks[0] * item.dtype.itemsize
    whole += 4 * any(one[0] == h5py.h5z.FILTER_FLETCHER32 for one in filters)
    for start in range(0, item.size, item.chunks[0]):
        # One that is not found is read as zeros.
        block = item.id.get_chunk_info_by_coord((start,))
        skipped = block.filter_mask
        if not block.size or skipped & mask or (skipped and block.size != whole):
            raise corrupt(f"column {name!r} has blocks that are not where they belong")


def _check_blocks(item: Any, values: np.ndarray, at: int) -> None:
    """Refuse (``corrupt``) compressed blocks that are read as zeros and are stored as more.

    The library does so where it finds no block because a key of its index is damaged.
    """
    if item.chunks is None or item.compression is None:
        return
    n = item.chunks[0]
    filled = np.logical_or.reduceat(values != 0, np.arange(0, values.size, n))
    for k in np.flatnonzero(~filled):
        stored = item.id.get_chunk_info_by_coord((at + int(k) * n,)).size
        # Zeros shrink to a few bytes.
        if stored > max(64, n * item.dtype.itemsize // 10):
            raise corrupt(f"{stored} bytes of samples from {at + int(k) * n} on are read as zeros")


def _attribute(file: Any, key: str) -> str:
    """Read an attribute of any plain type as text."""
    import h5py

    attribute = file.attrs.get_id(key)
    # Its type is checked before it is read: the library crashes on damaged types of other classes.
    plain = h5py.h5t.TypeStringID, h5py.h5t.TypeIntegerID, h5py.h5t.TypeFloatID, h5py.h5t.TypeEnumID
    kind = attribute.get_type()
    if kind.get_size() > constants.LONGEST_ATTRIBUTE:
        most = constants.LONGEST_ATTRIBUTE
        raise Unusable("metadata", f"{key} claims {kind.get_size()} bytes; at most {most} are read")
    if not isinstance(kind, plain) or attribute.shape not in ((), (1,)):
        raise Unusable("metadata", f"{key} is no single text or number; write it as text")
    value = np.asarray(file.attrs[key]).reshape(-1)[0]
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return as_text(value)


HDF5 = Format("HDF5", (".h5", ".hdf5"), lambda head: head.startswith(_MAGIC), _load, library="h5py")
