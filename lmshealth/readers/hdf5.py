"""HDF5: one dataset per column at the root, root attributes as metadata.

Nothing outside the file is touched: links, external storage and virtual datasets are refused.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lmshealth.readers.columns import ColumnMap
from lmshealth.readers.heaps import Guarded
from lmshealth.readers.metadata import KEYS
from lmshealth.readers.raw import Format, Raw, check_size, not_numeric, wanted
from lmshealth.readers.spool import Spool, spools
from lmshealth.readers.trouble import Unusable
from lmshealth.samples import BLOCK, MINUTE

_MAGIC = b"\x89HDF\r\n\x1a\n"
# A damaged length may claim gigabytes; HDF5 itself keeps no attribute above 64 KiB in its header.
_LONGEST_TEXT = 1 << 16


def _load(path: Path, columns: ColumnMap) -> Raw:
    import h5py

    with Guarded(path) as stream:
        try:
            with h5py.File(stream, "r") as file:
                return _read(file, stream, columns)
        except Exception:
            if stream.trouble is None:
                raise
        raise stream.trouble


def _read(file: Any, stream: Guarded, columns: ColumnMap) -> Raw:
    names = list(file)
    chosen = {name: _dataset(file, name) for name in wanted(names, columns)}
    stream.now = "texts"
    metadata = {key: _attribute(file, stream, key) for key in KEYS if key in file.attrs}
    check_size(8 * sum(dataset.size for dataset in chosen.values()), stream.size)
    stream.now = "samples"
    with spools(chosen) as taken:
        for name, dataset in chosen.items():
            _take(dataset, taken[name])
    read = {name: spool.samples() for name, spool in taken.items()}
    return Raw(read, metadata, tuple(names))


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


def _take(dataset: Any, spool: Spool) -> None:
    """Read a column, beyond a minute in stretches of whole chunks: each is unpacked only once."""
    chunk = 1 if dataset.chunks is None else dataset.chunks[0]
    step = max(1, dataset.size) if dataset.size <= MINUTE else -(-BLOCK // chunk) * chunk
    for start in range(0, dataset.size, step):
        spool.append(dataset[start : start + step])


def _attribute(file: Any, stream: Guarded, key: str) -> str:
    """Read an attribute as text, whatever plain type the exporter gave it."""
    import h5py

    attribute = file.attrs.get_id(key)
    # Looked at before it is read: the library crashes on damaged types of other classes.
    plain = h5py.h5t.TypeStringID, h5py.h5t.TypeIntegerID, h5py.h5t.TypeFloatID, h5py.h5t.TypeEnumID
    kind = attribute.get_type()
    is_plain = isinstance(kind, plain) and kind.get_size() <= _LONGEST_TEXT
    if not is_plain or attribute.shape not in ((), (1,)):
        raise Unusable("metadata", f"{key} is no single text or number; write it as text")
    if isinstance(kind, h5py.h5t.TypeStringID) and kind.is_variable_str():
        claimed = stream.claimed(key)
        if claimed > _LONGEST_TEXT:
            raise Unusable("corrupt", f"{key} claims a text of {claimed} bytes")
    value = np.asarray(file.attrs[key]).reshape(-1)[0]
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    if isinstance(value, np.bool_):
        return "true" if value else "false"
    return str(value)


HDF5 = Format("HDF5", (".h5", ".hdf5"), lambda head: head.startswith(_MAGIC), _load)
