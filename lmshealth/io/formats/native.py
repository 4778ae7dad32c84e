"""Formats of native libraries: HDF5, Parquet, MAT. They read in a process of their own.

HDF5: one dataset per column at the root, root attributes as metadata. Nothing outside the file is
read: links, external storage and virtual datasets are refused. The library ends its process by a
signal on damaged filters, loops on a damaged heap of strings (HDFGroup/hdf5 issue 1707; still so in
2.0.0), and allocates what a text claims.

Parquet: columns, and the key/value metadata of the schema.

MAT-files of version 5: variables, fields of structs, columns of matrices, as MATLAB names them.
Structs of Siemens Testlab state names, units and sample rates of their channels.
`scipy.io.loadmat` ends its process on damaged headers, and allocates what text and cells claim
before it finds that they are not there. One variable is held in memory.
"""

import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from importlib import import_module
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from lmshealth.io import constants
from lmshealth.io.buffers import BLOCK, MINUTE, Samples, as_samples
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.content import (
    Content,
    Described,
    Format,
    SinceFirst,
    begins,
    check_memory,
    check_size,
    choose,
    collected,
    library,
    not_numeric,
    rate_of,
    wanted,
)
from lmshealth.io.log import as_text, metadata_keys
from lmshealth.io.refusal import Unusable, corrupt, listed, repeated

_HDF5 = b"\x89HDF\r\n\x1a\n"


def _load_hdf5(path: Path, columns: ColumnMap, max_memory: float) -> Content:
    import h5py

    # A lock would need permission to write, or a file system that has locks.
    with h5py.File(path, "r", locking=False) as file:
        # A name that is no text comes as bytes.
        names = [n.decode("utf-8", "replace") if isinstance(n, bytes) else n for n in file]
        chosen = {name: _dataset(file, name) for name in wanted(names, columns)}
        metadata = {key: _attribute(file, key) for key in metadata_keys() if key in file.attrs}
        sizes = {name: dataset.size for name, dataset in chosen.items()}
        check_size(8 * sum(sizes.values()), path.stat().st_size)
        parts = ((name, part) for name, own in chosen.items() for part in _parts(own))
        return Content(collected(sizes, parts, {}), metadata, tuple(names))


def _parts(dataset: Any) -> Iterator[np.ndarray]:
    """Read a column in parts of whole chunks: each is unpacked only once."""
    chunk = dataset.chunks[0] if dataset.chunks else 1
    step = -(-BLOCK // chunk) * chunk
    for start in range(0, dataset.size, step):
        values = dataset[start : start + step]
        _check_blocks(dataset, values, start)
        yield values


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
    """Refuse (``corrupt``) compressed blocks that are read as zeros and are stored as more."""
    # The library does so where it finds no block because a key of its index is damaged.
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
    if attribute.get_space().get_simple_extent_type() == h5py.h5s.NULL:
        return ""
    # Its type is checked before it is read: the library crashes on damaged types of other classes.
    plain = h5py.h5t.TypeStringID, h5py.h5t.TypeIntegerID, h5py.h5t.TypeFloatID, h5py.h5t.TypeEnumID
    kind = attribute.get_type()
    if (size := kind.get_size()) > (most := constants.LONGEST_ATTRIBUTE):
        raise Unusable("metadata", f"{key} claims {size} bytes; at most {most} are read")
    if not isinstance(kind, plain) or attribute.shape not in ((), (1,)):
        raise _no_single(key)
    value = np.asarray(file.attrs[key]).reshape(-1)[0]
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else as_text(value)


def _no_single(key: str) -> Unusable:
    return Unusable("metadata", f"{key} is no single text or number; write it as text")


_PARQUET = b"PAR1"
# Bytes of each column of the file that are read ahead.
_BUFFER = 1 << 20
# Written by the libraries for themselves.
_LIBRARY_KEYS = frozenset({b"pandas", b"ARROW:schema"})


def _load_parquet(path: Path, columns: ColumnMap, max_memory: float) -> Content:
    with library("Parquet", "pyarrow"):
        import pyarrow as pa
        import pyarrow.parquet as pq
    # With pre_buffer, or without a buffer's size, a whole row group is held, which may be the file.
    with pq.ParquetFile(
        path, pre_buffer=False, buffer_size=_BUFFER, page_checksum_verification=True
    ) as file:
        schema, n_rows = file.schema_arrow, file.metadata.num_rows
        chosen = wanted(schema.names, columns)
        times: dict[str, SinceFirst] = {}
        for name in chosen:
            kind: Any = schema.field(name).type
            if pa.types.is_timestamp(kind) and columns.is_time(name):
                times[name] = SinceFirst(name, columns)
            elif not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
                raise not_numeric(name, f"values of type {kind}")
        check_size(8 * n_rows * len(chosen), path.stat().st_size)
        pairs = (pair for pair in (schema.metadata or {}).items() if pair[0] not in _LIBRARY_KEYS)
        metadata = dict([text.decode("utf-8", "replace") for text in pair] for pair in pairs)
        # Up to a minute at once, beyond it in blocks; nulls become NaN.
        size = max(1, n_rows) if n_rows <= MINUTE else BLOCK
        batches = file.iter_batches(size, columns=chosen, use_threads=False) if chosen else ()
        parts = (
            (name, batch.column(name).to_numpy(zero_copy_only=False))
            for batch in batches
            for name in chosen
        )
        read = collected(dict.fromkeys(chosen, n_rows), parts, times)
    return Content(read, metadata, tuple(schema.names))


_MAT_HEADER = 128
# Text of two bytes by version 5 in its two orders of bytes.
_TEXT_OF = {b"\x00\x01IM": "utf-16-le", b"\x01\x00MI": "utf-16-be"}
_HDF5_INSIDE = (b"\x00\x02IM", b"\x02\x00MI")
_OBJECT = "an object or a function (save plain arrays or structs)"
# Classes that hold no numbers, as `scipy.io.whosmat` names them.
_OTHERS = dict.fromkeys(("function", "object", "opaque"), _OBJECT)
_OTHERS |= {"cell": "cells", "char": "text", "sparse": "a sparse matrix"}


def _load_mat(path: Path, columns: ColumnMap, max_memory: float) -> Content:
    matlab: Any = import_module("scipy.io.matlab")  # its types know no streams
    with path.open("rb") as stream:
        version = stream.read(_MAT_HEADER)[-4:]
    if version in _HDF5_INSIDE:
        detail = "MAT-file of version 7.3; save it in MATLAB with the option -v7"
        raise Unusable("format", detail)
    variables = _variables(path)
    names = [name for name, _, _ in variables]
    chosen = _chosen(names, columns)
    stored, n_samples = path.stat().st_size, 0
    if not chosen - set(metadata_keys()) and (channels := _testlab(path, variables, max_memory)):
        found, content = choose([channel for channel, _ in channels], columns)
        samples = {name: as_samples(channels[k][1]) for name, k in found.items()}
        return replace(content, columns=samples)
    read, metadata, present = dict[str, Samples](), dict[str, str](), list[str]()
    for variable, shape, kind in variables:
        if variable not in chosen:
            continue
        _check_claim(variable, shape, kind, stored, max_memory)
        options = {"variable_names": [variable], "uint16_codec": _TEXT_OF[version]}
        values = matlab.loadmat(path, appendmat=False, **options)[variable]
        is_struct = getattr(values.dtype, "names", None) is not None
        prefix = "" if is_struct and columns.mat.variable is not None else variable
        for name, array in _arrays(values, prefix):
            present.append(name)
            if len(present) > constants.MOST_ARRAYS:
                detail = f"more than {constants.MOST_ARRAYS} arrays; save the log by itself"
                raise Unusable("columns", detail)
            if columns.target(name) is not None:
                n_samples += array.size
                # MATLAB stores whole numbers in fewer bytes than they take here.
                check_size(8 * n_samples, stored)
                read[name] = as_samples(_series(name, array))
            elif name in metadata_keys():
                metadata[name] = _text(name, array)
    present += [name for name in names if name not in chosen]
    return Content(read, metadata, tuple(present))


def _variables(path: Path) -> list[tuple[str, tuple[int, ...], str]]:
    """List name, shape and class of each variable with a name."""
    matlab: Any = import_module("scipy.io.matlab")
    found: list[tuple[str, tuple[int, ...], str]] = []
    try:
        found += matlab.whosmat(path, appendmat=False)
    except TypeError:  # of an object of a newer class, which has no shape
        with path.open("rb") as stream:
            parts = matlab.varmats_from_mat(stream)
        for _, part in parts:
            with suppress(TypeError):
                found += matlab.whosmat(part)
    return found


def _check_claim(
    name: str, shape: tuple[int, ...], kind: str, stored: int, max_memory: float
) -> None:
    """Refuse a variable by its header, before memory is taken for it."""
    if kind in _OTHERS and name not in metadata_keys():
        raise not_numeric(name, _OTHERS[kind])
    if min(shape, default=0) < 0:
        raise corrupt(f"variable {name[:80]!r} has impossible dimensions")
    check_size(8 * prod(shape), stored)
    check_memory(f"variable {name[:80]!r}", 8 * prod(shape), max_memory)


def _chosen(names: list[str], columns: ColumnMap) -> set[str]:
    """Choose the variables that hold the log."""
    roots = {re.split(r"[.({]", source)[0] for source in columns.columns.values()}
    known = roots | set(metadata_keys())
    chosen = {name for name in names if name in known or columns.target(name)}
    if (variable := columns.mat.variable) is not None:
        chosen = {variable}
        if variable not in names:
            detail = f"the column map needs the variable {variable}; there: {listed(names)}"
            raise Unusable("columns", detail)
    if twice := repeated(name for name in names if name in chosen):
        raise Unusable("columns", f"the file holds {listed(twice)} more than once")
    return chosen


def _testlab(
    path: Path, variables: list[tuple[str, tuple[int, ...], str]], max_memory: float
) -> list[tuple[Described, np.ndarray]]:
    """Read the time records that Siemens Testlab exports: structs of x_values and y_values."""
    # Values are in the unit that the struct states, ``(n_samples,)`` each.
    matlab: Any = import_module("scipy.io.matlab")
    channels: list[tuple[Described, np.ndarray]] = []
    for variable, shape, kind in variables:
        if kind != "struct" or shape != (1, 1):
            continue
        _check_claim(variable, shape, kind, path.stat().st_size, max_memory)
        struct = matlab.loadmat(path, appendmat=False, variable_names=[variable])[variable]
        values = _inside(struct, "y_values", "values")
        has_step = _inside(struct, "x_values", "increment") is not None
        if values is None or not has_step or values.dtype.kind not in "fiu" or values.ndim != 2:
            continue
        columns = values.reshape(-1, 1) if 1 in values.shape else values
        stated = _inside(struct, "function_record", "name")
        cells = () if stated is None else stated.ravel()
        names = [str(np.ravel(one)[0]) for one in cells if one.size]
        if len(names) != columns.shape[1]:
            names = [f"{variable}:{k + 1}" for k in range(columns.shape[1])]
        unit = str(_first(struct, "y_values", "quantity", "label", default=""))
        start = float(_first(struct, "x_values", "start_value", default=0.0))
        rate = rate_of(float(_first(struct, "x_values", "increment", default=0.0)))
        for name, own in zip(names, columns.T, strict=True):
            channels.append((Described(name, unit, rate, start=start, size=own.size), own))
    return channels


def _inside(struct: Any, *names: str) -> Any:
    """Return a field of structs in structs; None where there is none."""
    for name in names:
        if not struct.size or name not in (struct.dtype.names or ()):
            return None
        struct = struct.ravel()[0][name]
    return struct


def _first(struct: Any, *names: str, default: object) -> Any:
    """Return the first entry of such a field, by default another."""
    found = _inside(struct, *names)
    return default if found is None or not found.size else found.ravel()[0]


def _arrays(values: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Yield all arrays of a variable: fields of structs, entry after entry, columns of matrices."""
    is_number = values.dtype.kind in "fiu"
    is_matrix = is_number and values.ndim == 2 and 1 not in values.shape and values.size
    if getattr(values.dtype, "names", None) and not _is_object(values):
        entries = values.ravel("F")
        for k, entry in enumerate(entries):
            whole = name if entries.size == 1 else f"{name}({k + 1})"
            for field in values.dtype.names:
                yield from _arrays(entry[field], f"{whole}.{field}" if whole else field)
    elif is_matrix and values.shape[1] <= constants.MOST_COLUMNS:
        for k in range(values.shape[1]):
            yield f"{name}(:,{k + 1})", values[:, k]
    elif values.size or not is_number:
        yield name, values


def _is_object(values: Any) -> bool:
    from scipy.io.matlab import MatlabFunction, MatlabObject, MatlabOpaque

    return isinstance(values, MatlabFunction | MatlabObject | MatlabOpaque)


def _series(name: str, values: Any) -> np.ndarray:
    """Return numbers, one per sample, in shape ``(n_samples,)``; refuse everything else."""
    from scipy.sparse import issparse

    kinds = {"U": "text", "c": "complex numbers", "O": "cells"}
    found = "a sparse matrix" if issparse(values) else kinds.get(values.dtype.kind)
    found = _OBJECT if _is_object(values) else found
    if found or values.size not in values.shape:
        raise not_numeric(name, found or f"numbers of shape {values.shape}")
    return np.asarray(values.ravel())


def _text(name: str, values: Any) -> str:
    """Read a single number or line of text."""
    if values.dtype.kind == "U" and values.size <= 1:
        text = str(values.item()) if values.size else ""
        if "\ufffd" in text:
            found = "holds letters of one byte that are not ASCII; save it in MATLAB 7 or later"
            raise Unusable("metadata", f"{name} {found}")
        return text
    if values.dtype.kind in "fiu" and values.size == 1:
        value = values.item()
        # An integer may be stored as one or not.
        return str(int(value) if float(value).is_integer() else value)
    raise _no_single(name)


def _is_mat(head: bytes) -> bool:
    version = head[_MAT_HEADER - 4 : _MAT_HEADER]
    return version in _TEXT_OF or (version in _HDF5_INSIDE and head.startswith(b"MATLAB"))


HDF5 = Format("HDF5", (".h5", ".hdf5"), begins(_HDF5), _load_hdf5, "h5py")
PARQUET = Format("Parquet", (".parquet",), begins(_PARQUET), _load_parquet, "pyarrow.parquet")
MAT = Format("MAT", (".mat",), _is_mat, _load_mat, "scipy.io")
