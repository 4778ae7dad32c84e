"""Where the data sets of a universal file are, and the numbers in them, read block by block."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import IO, Any

import numpy as np

from lmshealth._arrays import FloatArray
from lmshealth.io.refusal import Unusable

FUNCTION = 58
# Bytes of a body that are looked at in one go.
_BLOCK = 1 << 20
_TAG = b"    -1"
_BLANK = b" \t\r\n\x1a"
# Lines have 80 characters; binary data may go on for long without a line end.
_LONGEST_LINE = 1 << 16
_N_RECORDS = 11
# Some exporters begin a new line after binary data.
_AFTER_BINARY = re.compile(rb"\r?\n?    -1[ \t]*(\r|\n|\Z)")
_N_BYTES = slice(31, 43)

# Widths of the numbers in a line, by type of the ordinate and whether the abscissa is uneven.
_WIDTHS = {
    (2, False): (13,) * 6,
    (2, True): (13,) * 6,
    (4, False): (20,) * 4,
    (4, True): (13, 20, 13, 20),
}
_BINARY = {2: "f4", 4: "f8"}


@dataclass(frozen=True, slots=True)
class DataSet:
    """A function at nodal degrees of freedom.

    Attributes
    ----------
    place : int
        Among all data sets of the file, from 1.
    header : bytes
        Tag, number and eleven records, as they stand in the file.
    binary : bool
        Whether the numbers are binary.
    start, stop : int
        Bytes of the file that the numbers take.
    """

    place: int
    header: bytes
    binary: bool
    start: int
    stop: int


def functions(stream: IO[bytes]) -> Iterator[DataSet]:
    """Find the data sets 58, and check that all data sets are whole.

    Raises
    ------
    Unusable
        With reason ``corrupt`` where tags or numbers of data sets are damaged or cut off.
    """
    place = 0
    stream.seek(0)
    while line := stream.readline(_LONGEST_LINE):
        if not line.strip(_BLANK):
            continue
        if not _is_tag(line):
            at = stream.tell() - len(line)
            raise Unusable("corrupt", f"no data set begins at byte {at}; copy the file again")
        place += 1
        found = _data_set(stream, line, place)
        if found is not None:
            yield found


def _data_set(stream: IO[bytes], tag: bytes, place: int) -> DataSet | None:
    """Read a data set's header and pass over its body; None for other data sets than 58."""
    number = stream.readline(_LONGEST_LINE)
    if not number.strip(_BLANK):
        raise _cut_off()
    try:
        kind = int(number[:6])
    except ValueError:
        kind = 0
    if kind <= 0:
        raise Unusable("corrupt", f"data set {place} has no number; copy the file again")
    if kind != FUNCTION:
        _end(stream)
        return None
    records = [stream.readline(_LONGEST_LINE) for _ in range(_N_RECORDS)]
    if any(_is_tag(record) for record in records):
        raise not_kept(place)
    start = stream.tell()
    binary = number[6:7].lower() == b"b"
    stop = _claimed_end(stream, number) if binary else None
    if stop is None:
        stream.seek(start)
        stop = _end(stream, binary=binary)
    return DataSet(place, b"".join([tag, number, *records]), binary, start, stop)


def not_kept(place: int) -> Unusable:
    """Say that a data set is not what its number says."""
    return Unusable("corrupt", f"data set {place} does not keep the format 58; export it again")


def _is_tag(line: bytes) -> bool:
    return line.rstrip(_BLANK) == _TAG


def _cut_off() -> Unusable:
    return Unusable("corrupt", "the last data set is cut off; copy the file again")


def _claimed_end(stream: IO[bytes], number: bytes) -> int | None:
    """Find the end of binary data where the header says it is; None if it is not there.

    Binary data may look like a tag by chance; but not every program says their number of bytes.
    """
    claim = number[_N_BYTES].strip()
    if not claim.isdigit():
        return None
    stop = stream.tell() + int(claim)
    stream.seek(stop)
    found = _AFTER_BINARY.match(stream.read(100))
    if found is None:
        return None
    stream.seek(stop + found.end())
    return stop


def _end(stream: IO[bytes], *, binary: bool = False) -> int:
    """Find the end of a data set by its tag, and go behind it."""
    while line := stream.readline(_LONGEST_LINE):
        if _is_tag(line) or (binary and line.rstrip(_BLANK).endswith(_TAG)):
            return stream.tell() - len(line) + line.rindex(_TAG)
    raise _cut_off()


def numbers(
    stream: IO[bytes], found: DataSet, *, ordinate: int, uneven: bool, little: bool
) -> Iterator[np.ndarray]:
    """Read the numbers of a data set block by block, each of shape ``(n,)``.

    Parameters
    ----------
    stream : IO
        The file.
    found : DataSet
        One of its data sets.
    ordinate : int
        Type of the ordinate: 2 for single, 4 for double precision.
    uneven : bool
        Whether the numbers are pairs of abscissa and ordinate; pairs are kept together.
    little : bool
        Whether binary numbers begin with their lowest byte.

    Raises
    ------
    Unusable
        With reason ``corrupt``.
    """
    if found.binary:
        dtype = np.dtype(_BINARY[ordinate]).newbyteorder("<" if little else ">")
        yield from _binary(stream, found, dtype)
        return
    rest = np.empty(0)
    for lines in _lines(stream, found):
        try:
            values = np.append(rest, _fields(lines, _WIDTHS[ordinate, uneven]))
        except ValueError as error:
            raise not_kept(found.place) from error
        whole = values.size - (values.size % 2 if uneven else 0)
        rest = values[whole:]
        yield values[:whole]


def _binary(stream: IO[bytes], found: DataSet, dtype: np.dtype[Any]) -> Iterator[np.ndarray]:
    """Read binary numbers; a line end behind them does not make a number."""
    whole = (found.stop - found.start) // dtype.itemsize * dtype.itemsize
    stream.seek(found.start)
    while block := stream.read(min(_BLOCK, found.start + whole - stream.tell())):
        yield np.frombuffer(block, dtype=dtype)


def _lines(stream: IO[bytes], found: DataSet) -> Iterator[list[bytes]]:
    """Read whole lines, about a block at a time."""
    stream.seek(found.start)
    while block := stream.read(max(0, min(_BLOCK, found.stop - stream.tell()))):
        if stream.tell() < found.stop:
            block += stream.readline(_LONGEST_LINE)
        yield block.splitlines()


def _fields(lines: Sequence[bytes], widths: Sequence[int]) -> FloatArray:
    """Read numbers that stand in columns, with or without blanks between them, shape ``(n,)``."""
    length = sum(widths)
    text = b"".join([line.ljust(length)[:length] for line in lines])
    table = np.frombuffer(text, dtype=np.uint8).reshape(len(lines), length)
    values = np.empty((len(lines), len(widths)))
    given = np.empty(values.shape, dtype=bool)
    for k, (width, stop) in enumerate(zip(widths, accumulate(widths), strict=True)):
        field = table[:, stop - width : stop]
        # The last line need not be full.
        given[:, k] = (field != ord(" ")).any(axis=1)
        values[given[:, k], k] = field[given[:, k]].view(f"S{width}").ravel().astype(np.float64)
    return values[given]
