"""Files written byte by byte: layouts, sizes and damage that no library writes."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np

MAT_ORDERS = {"<": b"\x00\x01IM", ">": b"\x01\x00MI"}


def element(kind: int, data: bytes, order: str = "<") -> bytes:
    """Write a data element of a MAT-file, padded to 8 bytes."""
    return struct.pack(order + "II", kind, len(data)) + data + bytes(-len(data) % 8)


def array(
    kind: int,
    sizes: tuple[int, ...],
    name: bytes = b"delta_e_um",
    content: bytes = b"",
    order: str = "<",
) -> bytes:
    """Write an array of a class of MATLAB with anything as its content."""
    return element(
        14,
        element(6, struct.pack(order + "II", kind, 0), order)
        + element(5, struct.pack(f"{order}{len(sizes)}i", *sizes), order)
        + element(1, name, order)
        + content,
        order,
    )


def fields(*names: bytes) -> bytes:
    """Write the names of a struct's fields."""
    return element(5, struct.pack("<i", 8)) + element(1, b"".join(n.ljust(8, b"\0") for n in names))


def pack(variable: bytes, packed: bool = True, order: str = "<") -> bytes:
    """Compress a variable, which is not padded then."""
    data = zlib.compress(variable, 1)
    return struct.pack(order + "II", 15, len(data)) + data if packed else variable


def mat_file(path: Path, *variables: bytes, order: str = "<") -> Path:
    """Write a MAT-file."""
    head = b"MATLAB 5.0 MAT-file, hand-made".ljust(124) + MAT_ORDERS[order]
    path.write_bytes(head + b"".join(variables))
    return path


def tdms_segment(
    channels: Mapping[str, np.ndarray],
    *,
    order: Literal["<", ">"] = "<",
    interleaved: bool = False,
    n_chunks: int = 1,
    extra: bytes = b"",
) -> bytes:
    """Write a segment of a TDMS-file with channels of equal length in a group called log."""
    swapped = {k: v.astype(v.dtype.newbyteorder(order)) for k, v in channels.items()}
    meta = struct.pack(order + "I", len(channels))
    for name, values in channels.items():
        path = f"/'log'/'{name}'".encode()
        meta += struct.pack(order + "I", len(path)) + path
        kind = {"i2": 2, "f4": 9, "f8": 10}[values.dtype.str[1:]]
        meta += struct.pack(order + "IIIQI", 20, kind, 1, values.size // n_chunks, 0)
    if interleaved:
        samples = np.rec.fromarrays(list(swapped.values())).tobytes()
    else:
        rows = [values.reshape(n_chunks, -1) for values in swapped.values()]
        samples = b"".join(row[k].tobytes() for k in range(n_chunks) for row in rows)
    samples += extra
    contents = 0b1110 | 0x20 * interleaved | 0x40 * (order == ">")
    rest = struct.pack(order + "IQQ", 4713, len(meta) + len(samples), len(meta))
    return b"TDSm" + struct.pack("<I", contents) + rest + meta + samples


def uff_set(
    body: bytes,
    n: int,
    *,
    name: str = "delta_e_um",
    ordinate: int = 4,
    spacing: int = 1,
    binary: str = "",
) -> bytes:
    """Write a time record of a universal file with anything as its numbers.

    ``binary`` is the number of bytes that the header claims.
    """
    number = "    58" + (f"b     1     2          11{binary:>12}" if binary else "")
    axis = "    0    0    0 NONE                 "
    records = [
        "    -1", number, name, "NONE", "01-Mar-26 08:30:00", "NONE", "NONE",
        "    1         0    0         0 NONE               1   1 NONE               0   0",
        f"{ordinate:10}{n:10}{spacing:10}  0.00000e+00  5.00000e-05  0.00000e+00",
        f"        17{axis}s", f"         0{axis}NONE", f"         0{axis}NONE",
        f"         0{axis}NONE",
    ]  # fmt: skip
    return "".join(f"{record}\n" for record in records).encode() + body + b"    -1\n"
