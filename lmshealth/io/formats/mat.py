"""MAT-files of version 5: variables, fields of structs, columns of matrices, as MATLAB names them.

Structs of Siemens Testlab state names, units and sample rates of their channels.

`scipy.io.loadmat` ends its process on damaged headers, and allocates what text and cells claim
before it finds that they are not there: it works in a process of its own. One variable is held in
memory.
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
from lmshealth.io.buffers import Samples, as_samples
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.formats.content import Content, Format, check_memory, check_size, not_numeric
from lmshealth.io.formats.unit_channels import Described, choose, rate_of
from lmshealth.io.metadata import KEYS
from lmshealth.io.refusal import Unusable, corrupt, listed, repeated

_HEADER = 128
# Text of two bytes by version 5 in its two orders of bytes.
_TEXT = {b"\x00\x01IM": "utf-16-le", b"\x01\x00MI": "utf-16-be"}
_HDF5_INSIDE = (b"\x00\x02IM", b"\x02\x00MI")
_OBJECT = "an object or a function (save plain arrays or structs)"
# Classes that hold no numbers, as `scipy.io.whosmat` names them.
_OTHERS = dict.fromkeys(("function", "object", "opaque"), _OBJECT)
_OTHERS |= {"cell": "cells", "char": "text", "sparse": "a sparse matrix"}


def _load(path: Path, columns: ColumnMap, max_memory: float) -> Content:
    matlab: Any = import_module("scipy.io.matlab")  # its types know no streams
    with path.open("rb") as stream:
        version = stream.read(_HEADER)[-4:]
    if version in _HDF5_INSIDE:
        needed = "save it in MATLAB with the option -v7"
        raise Unusable("format", f"MAT-file of version 7.3; {needed}")
    variables = _variables(path)
    names = [name for name, _, _ in variables]
    chosen = _chosen(names, columns)
    stored, n_samples = path.stat().st_size, 0
    if not chosen - set(KEYS) and (channels := _testlab(path, variables, max_memory)):
        found, content = choose([channel for channel, _ in channels], columns)
        samples = {name: as_samples(channels[k][1]) for name, k in found.items()}
        return replace(content, columns=samples)
    read: dict[str, Samples] = {}
    metadata: dict[str, str] = {}
    present: list[str] = []
    for variable, shape, kind in variables:
        if variable not in chosen:
            continue
        _check_claim(variable, shape, kind, stored, max_memory)
        options = {"variable_names": [variable], "uint16_codec": _TEXT[version]}
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
            elif name in KEYS:
                metadata[name] = _text(name, array)
    present += [name for name in names if name not in chosen]
    return Content(read, metadata, tuple(present))


def _variables(path: Path) -> list[tuple[str, tuple[int, ...], str]]:
    """List name, shape and class of each variable with a name."""
    matlab: Any = import_module("scipy.io.matlab")
    try:
        found: list[tuple[str, tuple[int, ...], str]] = matlab.whosmat(path, appendmat=False)
    except TypeError:  # of an object of a newer class, which has no shape
        found = []
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
    if kind in _OTHERS and name not in KEYS:
        raise not_numeric(name, _OTHERS[kind])
    if min(shape, default=0) < 0:
        raise corrupt(f"variable {name[:80]!r} has impossible dimensions")
    check_size(8 * prod(shape), stored)
    check_memory(f"variable {name[:80]!r}", 8 * prod(shape), max_memory)


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
        chosen = {name for name in names if name in known or columns.target(name)}
    if twice := repeated(name for name in names if name in chosen):
        raise Unusable("columns", f"the file holds {listed(twice)} more than once")
    return chosen


def _testlab(
    path: Path, variables: list[tuple[str, tuple[int, ...], str]], max_memory: float
) -> list[tuple[Described, np.ndarray]]:
    """Read the time records that Siemens Testlab exports: structs of x_values and y_values.

    Values are in the unit that the struct states, ``(n_samples,)`` each.
    """
    matlab: Any = import_module("scipy.io.matlab")
    channels: list[tuple[Described, np.ndarray]] = []
    for variable, shape, kind in variables:
        if kind != "struct" or shape != (1, 1):
            continue
        _check_claim(variable, shape, kind, path.stat().st_size, max_memory)
        struct = matlab.loadmat(path, appendmat=False, variable_names=[variable])[variable]
        values = _inside(struct, "y_values", "values")
        step, start = (_inside(struct, "x_values", key) for key in ("increment", "start_value"))
        if values is None or step is None or values.dtype.kind not in "fiu" or values.ndim != 2:
            continue
        columns = values.reshape(-1, 1) if 1 in values.shape else values
        label = _inside(struct, "y_values", "quantity", "label")
        stated = _inside(struct, "function_record", "name")
        names = (
            [] if stated is None else [str(np.ravel(one)[0]) for one in stated.ravel() if one.size]
        )
        if len(names) != columns.shape[1]:
            names = [f"{variable}:{k + 1}" for k in range(columns.shape[1])]
        unit = str(label.ravel()[0]) if label is not None and label.size else ""
        begin = 0.0 if start is None or not start.size else float(start.ravel()[0])
        rate = rate_of(float(step.ravel()[0])) if step.size else None
        for k, name in enumerate(names):
            channels.append(
                (Described(name, unit, rate, start=begin, size=len(columns)), columns[:, k])
            )
    return channels


def _inside(struct: Any, *names: str) -> Any:
    """Return a field of structs in structs; None where there is none."""
    for name in names:
        if not struct.size or name not in (struct.dtype.names or ()):
            return None
        struct = struct.ravel()[0][name]
    return struct


def _arrays(values: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Yield all arrays of a variable: fields of structs, entry after entry, columns of matrices."""
    is_number = values.dtype.kind in "fiu"
    if getattr(values.dtype, "names", None) and not _is_object(values):
        entries = values.ravel("F")
        for k, entry in enumerate(entries):
            whole = name if entries.size == 1 else f"{name}({k + 1})"
            for field in values.dtype.names:
                yield from _arrays(entry[field], f"{whole}.{field}" if whole else field)
    elif is_number and values.ndim == 2 and 1 not in values.shape and values.size:
        if values.shape[1] > constants.MOST_COLUMNS:
            yield name, values
            return
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
    if found is None and values.size not in values.shape:
        found = f"numbers of shape {values.shape}"
    if found is not None:
        raise not_numeric(name, found)
    series: np.ndarray = values.ravel()
    return series


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
    raise Unusable("metadata", f"{name} is no single text or number; write it as text")


def _sniff(head: bytes) -> bool:
    version = head[_HEADER - 4 : _HEADER]
    return version in _TEXT or (version in _HDF5_INSIDE and head.startswith(b"MATLAB"))


MAT = Format("MAT", (".mat",), _sniff, _load, library="scipy.io")
