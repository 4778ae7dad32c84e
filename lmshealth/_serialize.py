"""Results as bytes and back, by the types of their fields.

Nothing in the bytes names a type or is ever run: what comes back is what the reader asked for, or
nothing. Floats keep all their bits, NaN and infinity too; moments keep their offset from UTC.
"""

from __future__ import annotations

import hashlib
import zlib
from importlib.metadata import version
from typing import Any

import msgspec
import numpy as np

VERSION = version("lmshealth")
"""Of the package, a part of the names of what it makes; asking anew takes a millisecond."""

# What an array may hold: bool, numbers, text and moments. Objects would be addresses in memory.
_KINDS = "biufcUMm"
# Fast; most of what is kept are draws, whose digits no level makes smaller.
_LEVEL = 1
_MOST_BYTES = 2**31


def pack(value: Any) -> bytes:
    """Turn dataclasses, structs, arrays, moments and plain values into bytes.

    Raises
    ------
    TypeError
        If something among it is none of these.
    """
    return zlib.compress(_plain(value), _LEVEL)


def unpack(content: bytes, kind: Any) -> Any:
    """Rebuild what was packed.

    Parameters
    ----------
    content : bytes
        From `pack`, or from somewhere that is not to be trusted.
    kind : type
        What it has to be: a dataclass or struct, or a union that msgspec can tell apart. Arrays
        come back read-only, in the order of C.

    Raises
    ------
    ValueError
        If it is not that.
    """
    try:
        inflater = zlib.decompressobj()
        plain = inflater.decompress(content, _MOST_BYTES)
        if not inflater.eof:
            raise ValueError(f"cut off, or more than {_MOST_BYTES} bytes")
        return msgspec.convert(msgspec.msgpack.decode(plain), kind, dec_hook=_revive)
    except Exception as error:  # types check themselves, and foreign bytes may break any of them
        raise ValueError(f"these bytes are no {kind}: {error}") from error


def fingerprint(*values: Any) -> str:
    """Give the SHA-256 of values: of what a result depends on, it is the result's name."""
    return hashlib.sha256(_plain(values)).hexdigest()


def _plain(value: Any) -> bytes:
    # By way of plain values, because MessagePack itself would move every moment to UTC.
    plain = msgspec.to_builtins(value, builtin_types=(bytes,), enc_hook=_replace)
    return msgspec.msgpack.encode(plain)


def _replace(value: Any) -> Any:
    """Put plain values in the place of what numpy has."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray) and value.dtype.kind in _KINDS:
        return [value.dtype.str, value.shape, value.tobytes()]
    raise TypeError(f"a {type(value).__name__} cannot be packed")


def _revive(kind: type, value: Any) -> Any:
    """Rebuild an array."""
    dtype, shape, content = value
    array = np.frombuffer(content, np.dtype(dtype)).reshape(shape).copy()
    if array.dtype.kind not in _KINDS:
        raise ValueError(f"an array of {array.dtype}")
    array.setflags(write=False)
    return array
