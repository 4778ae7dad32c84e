"""Serialise results to bytes by the types of their fields, and their fingerprints.

The bytes name no type and are never executed. Floats keep all their bits, NaN and infinity too;
dates keep their offset from UTC. Seeds depend on the input and the step, not on the order of work.
"""

import hashlib
import zlib
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

import msgspec
import numpy as np

VERSION = version("lmshealth")
"""Version of the package, a part of the cache's keys; reading it takes a millisecond."""

# Kinds of arrays: bool, numbers, text and dates. Objects would be addresses in memory.
_KINDS = "biufcUMm"
# Fast; most results are draws, whose digits no level compresses.
_LEVEL = 1
_MOST_BYTES = 2**31


def pack(value: Any) -> bytes:
    """Serialise dataclasses, structs, arrays, dates and plain values; `TypeError` for others."""
    return zlib.compress(_plain(value), _LEVEL)


def unpack(content: bytes, kind: Any) -> Any:
    """Rebuild a serialised value of a type, from `pack` or from an untrusted source.

    The type is a dataclass or struct, or a union that msgspec can distinguish; `ValueError` if it
    is another. Arrays are read-only, in C order.
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
    """Return the SHA-256 of values: the key of a result that depends on them."""
    return hashlib.sha256(_plain(values)).hexdigest()


def _plain(value: Any) -> bytes:
    # By way of plain values, because MessagePack itself would convert every date to UTC.
    plain = msgspec.to_builtins(value, builtin_types=(bytes,), enc_hook=_replace)
    return msgspec.msgpack.encode(plain)


def _replace(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray) and value.dtype.kind in _KINDS:
        return [value.dtype.str, value.shape, value.tobytes()]
    raise TypeError(f"a {type(value).__name__} cannot be packed")


def _revive(kind: type, value: Any) -> Any:
    dtype, shape, content = value
    array = np.frombuffer(content, np.dtype(dtype)).reshape(shape).copy()
    if array.dtype.kind not in _KINDS:
        raise ValueError(f"an array of {array.dtype}")
    array.setflags(write=False)
    return array


def stream(seed: int | Sequence[int], *steps: int) -> np.random.SeedSequence:
    """Return the random stream of a step of the computation."""
    return np.random.SeedSequence([*np.atleast_1d(seed).tolist(), *steps])


def seed_of(seed: int, *inputs: str) -> tuple[int, int]:
    """Derive the seed of a computation from the user's seed and a hash of its inputs."""
    digest = hashlib.sha256("\n".join(inputs).encode()).hexdigest()
    return seed, int(digest[:12], 16)
