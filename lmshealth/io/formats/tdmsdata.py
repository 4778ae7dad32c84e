"""The samples of a TDMS segment, block by block.

npTDMS knows where they are and scales them, but decodes whole chunks: in a file that was
defragmented or has interleaved channels, a chunk is as long as the recording.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from typing import IO, Any, NamedTuple

import numpy as np

from lmshealth.io.refusal import Unusable

# Bytes that are looked at in one go.
_BLOCK = 1 << 20
_LARGEST_DAQMX = 32 << 20
_INTERLEAVED, _BIG_ENDIAN = 1 << 5, 1 << 6


class _Part(NamedTuple):
    """What a chunk holds of one channel; ``dtype`` is None where it is not wanted."""

    path: str
    dtype: np.dtype[Any] | None
    size: int


def raw_samples(
    stream: IO[bytes], segment: Any, paths: Collection[str]
) -> Iterator[tuple[str, Any]]:
    """Read the samples of a segment.

    Parameters
    ----------
    stream : IO
        The file.
    segment : nptdms.tdms_segment.TdmsSegment
        What npTDMS knows about the segment.
    paths : collection of str
        The wanted channels.

    Yields
    ------
    str
        A channel.
    nptdms.base_segment.RawChannelDataChunk
        Its next samples, not scaled yet.

    Raises
    ------
    Unusable
        With reason ``too-large`` for a large chunk that only npTDMS can decode.
    """
    from nptdms.base_segment import RawChannelDataChunk

    objects = [item for item in segment.ordered_objects if item.has_data]
    if any(item.scaler_data_types is not None for item in objects):
        yield from _daqmx(stream, segment, paths)
    elif any(item.path in paths for item in objects):
        for path, values in _plain(stream, segment, objects, paths):
            yield path, RawChannelDataChunk.channel_data(values)


def _daqmx(stream: IO[bytes], segment: Any, paths: Collection[str]) -> Iterator[tuple[str, Any]]:
    """Let npTDMS decode the counts of acquisition cards, which come in short chunks."""
    size = segment.next_segment_pos - segment.data_position
    if size > _LARGEST_DAQMX * segment.num_chunks:
        raise Unusable(
            "too-large",
            f"raw counts of DAQmx in chunks of more than {_LARGEST_DAQMX} bytes; "
            "export the channels as numbers, or split the recording",
        )
    for chunk in segment.read_raw_data(stream):
        yield from (item for item in chunk.channel_data.items() if item[0] in paths)


def _plain(
    stream: IO[bytes], segment: Any, objects: Sequence[Any], paths: Collection[str]
) -> Iterator[tuple[str, np.ndarray]]:
    """Read chunk after chunk; interleaved channels are chunks of one sample each."""
    order = ">" if segment.toc_mask & _BIG_ENDIAN else "<"
    interleaved = bool(segment.toc_mask & _INTERLEAVED)
    whole = [
        _Part(
            item.path,
            item.data_type.nptype.newbyteorder(order) if item.path in paths else None,
            item.data_type.size if interleaved else item.data_size,
        )
        for item in objects
    ]
    at, size = segment.data_position, segment.next_segment_pos - segment.data_position
    width = sum(part.size for part in whole) or 1
    yield from _chunks(stream, at, size // width, whole)
    # npTDMS tells how many samples a shorter last chunk has.
    if size % width and not interleaved:
        counts = segment.final_chunk_lengths_override
        last = [
            part._replace(size=counts.get(part.path, 0) * (item.data_type.size or 0))
            for part, item in zip(whole, objects, strict=True)
        ]
        yield from _chunks(stream, at + size // width * width, 1, last)


def _chunks(
    stream: IO[bytes], at: int, n_chunks: int, parts: Sequence[_Part]
) -> Iterator[tuple[str, np.ndarray]]:
    """Read chunks that follow each other: many small ones, or a large one, in several reads."""
    width = sum(part.size for part in parts)
    if width > _BLOCK:
        for part in list(parts) * n_chunks:
            if part.dtype is not None:
                yield from _stretch(stream, at, part)
            at += part.size
        return
    stream.seek(at)
    left = n_chunks * width
    while width and (block := stream.read(min(_BLOCK // width * width, left))):
        left -= len(block)
        rows = np.frombuffer(block, dtype=np.uint8).reshape(-1, width)
        stop = 0
        for part in parts:
            stop += part.size
            if part.dtype is not None:
                # A copy: what is kept must not keep the samples of all channels.
                yield part.path, rows[:, stop - part.size : stop].view(part.dtype).flatten()


def _stretch(stream: IO[bytes], at: int, part: _Part) -> Iterator[tuple[str, np.ndarray]]:
    """Read the samples of one channel that stand together."""
    stream.seek(at)
    left = part.size
    while block := stream.read(min(_BLOCK, left)):
        left -= len(block)
        yield part.path, np.frombuffer(block, dtype=part.dtype)
