"""Files of instruments: TDMS, Renishaw laser (.rtx), SINUMERIK trace (.xml).

npTDMS reads the samples of TDMS chunk by chunk. It accepts files that are cut off, follows an index
file instead of the log, and loops over damaged counts of scales: these are checked here before. The
others state no units: a column map names the channels. Both were taken from public readers.
"""

import logging
import re
import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import ParseError, iterparse

import numpy as np

from lmshealth.io import constants
from lmshealth.io.buffers import Samples, Spool, as_samples
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
)
from lmshealth.io.log import as_text, metadata_keys
from lmshealth.io.refusal import Unusable, corrupt, listed

_MAGIC = b"TDSm"
# Lead-in of a segment: tag, table of contents, version, length of the rest, offset of its samples.
_LEAD_IN = 28
_BIG_ENDIAN = 1 << 6
_NEVER_FINISHED = (1 << 64) - 1
_N_SCALES = "NI_Number_Of_Scales"
_SCALE = re.compile(r"NI_Scale\[(\d{1,18})\d*\]")
# Start time of a channel whose start was never set.
_EPOCH = np.datetime64("1904-01-01", "us")
# Properties of the clock of a channel.
_CLOCK = ("wf_increment", "wf_start_time", "wf_start_offset")
_UNLIKE = "segments of the channels differ in start or increment; split them"


class _Part(NamedTuple):
    """Number of samples of a channel at the end of a segment, and its clock there."""

    n_values: int
    increment: Any  # as this and the offset are in the file
    start: np.datetime64 | None
    offset: Any


def _load_tdms(path: Path, columns: ColumnMap, max_memory: float) -> Content:
    with library("TDMS", "npTDMS"):
        from nptdms import TdmsFile
        from nptdms.log import log_manager
    # npTDMS prints on standard error where it guesses; here a guess is an error of the file.
    log_manager.set_level(logging.ERROR)
    segments = _segments(path)
    # A chunk of interleaved samples is read and split, and may be the whole segment.
    check_memory("a segment of samples", 2 * max(segments, default=0), max_memory)
    # Given a path, npTDMS would read the index of a *.tdms_index in its folder.
    with path.open("rb") as stream, TdmsFile.open(stream) as file:
        channels = [channel for group in file.groups() for channel in group.channels()]
        _check_sizes(channels, sum(segments))
        _check_scales(one.properties for one in (file, *file.groups(), *channels))
        parts = _parts(path)
        chosen, content = choose(_described(channels, parts), columns)
        wanted = {name: channels[k] for name, k in chosen.items()}
        times = {name: SinceFirst(name, columns) for name, one in wanted.items()
                 if one.dtype.kind == "M" and columns.is_time(name)}  # fmt: skip
        read = _read(file, wanted, times, path.stat().st_size)
        is_timed = any(map(columns.is_time, read))
        stamps = None if is_timed else _stamps([parts[c.path] for c in wanted.values()])
        if stamps is not None and content.late:
            raise Unusable("time", _UNLIKE)
        starts = [since.first for since in times.values()]
        starts += [channel.properties.get("wf_start_time") for channel in wanted.values()]
        given = {key: file.properties.get(key) for key in metadata_keys()}
    start = next((s for s in starts if isinstance(s, np.datetime64) and s > _EPOCH), None)
    metadata = {} if start is None else {"recorded_at": as_text(start)}
    # The increment of a channel is that of its last segment.
    metadata |= content.metadata if stamps is None else {}
    metadata |= {key: as_text(value) for key, value in given.items() if value is not None}
    read |= {} if stamps is None else {"time_s": stamps}
    return replace(content, columns=read, metadata=metadata)


def _segments(path: Path) -> list[int]:
    """Follow the segments to the end of the file, and list the bytes of their samples."""
    # What is refused as ``corrupt`` is where npTDMS would stop reading, and ignore the rest.
    size, at = path.stat().st_size, 0
    found: list[int] = []
    with path.open("rb") as stream:
        while at < size:
            stream.seek(at)
            lead_in = stream.read(_LEAD_IN)
            where = f"at byte {at} of {size}, after {len(found)} whole segments,"
            if not lead_in.startswith(_MAGIC):
                raise corrupt(f"{where} no segment begins")
            if len(lead_in) < _LEAD_IN:
                raise corrupt(f"{where} the file is cut off")
            order = ">" if lead_in[4] & _BIG_ENDIAN else "<"
            rest, samples = struct.unpack(order + "QQ", lead_in[12:])
            if rest == _NEVER_FINISHED:
                raise Unusable("corrupt", f"{where} is a segment that was never finished")
            if samples > rest or at + _LEAD_IN + rest > size:
                raise Unusable("corrupt", f"{where} a segment of {rest} bytes is cut off")
            at += _LEAD_IN + rest
            found.append(rest - samples)
    return found


def _parts(path: Path) -> dict[str, list[_Part]]:
    """Read the clock of each channel in each segment, by the path of the channel."""
    # npTDMS keeps the properties of the last segment. Segments of one clock are joined.
    from nptdms.reader import TdmsReader

    found: dict[str, list[_Part]] = {}

    class Reader(TdmsReader):  # type: ignore[misc]
        """Collect the properties at the end of each segment."""

        def _update_object_properties(self, properties: object) -> None:
            super()._update_object_properties(properties)
            for name, own in self.object_metadata.items():
                increment, start, offset = map(own.properties.get, _CLOCK)
                known = hasattr(start, "as_datetime64") and start.as_datetime64("us") > _EPOCH
                moment = start.as_datetime64("ns") if known else None
                part = _Part(own.num_values, increment, moment, offset)
                parts = found.setdefault(name, [])
                if parts and parts[-1][1:] == part[1:]:
                    parts.pop()
                parts.append(part)

    with path.open("rb") as stream:
        Reader(stream).read_metadata()
    return found


def _stamps(channels: Sequence[Sequence[_Part]]) -> Samples | None:
    """Make time stamps in s where segments state another ``wf_increment``, or a gap by their start.

    None where one clock runs through all segments; `Unusable` (``time``) where channels differ.
    """
    clocks = [_clock(parts) for parts in channels]
    if all(len(clock) < 2 for clock in clocks):
        return None
    if any(clock != clocks[0] for clock in clocks):
        raise Unusable("time", _UNLIKE)
    spool = Spool()
    for start, interval, n in clocks[0]:
        spool.append(start + interval * np.arange(n))
    return spool.samples()


def _starts(parts: Mapping[str, Sequence[_Part]]) -> dict[str, float | None]:
    """Return the time in s of the first sample of each channel since that of the earliest."""
    # None for a channel that states none.
    first = {name: own[0] for name, own in parts.items() if own}
    moments = {name: part.start for name, part in first.items() if part.start is not None}
    earliest = min(moments.values(), default=None)
    found: dict[str, float | None] = dict.fromkeys(first)
    for name in moments or first:
        offset = first[name].offset
        since = float((moments[name] - earliest) / np.timedelta64(1, "s")) if moments else 0.0
        start = since + (float(offset) if isinstance(offset, int | float) else 0.0)
        found[name] = start if np.isfinite(start) else None
    return found


def _clock(parts: Sequence[_Part]) -> list[tuple[float, float, int]]:
    """Join segments of one clock; return start in s, interval in s and number of samples of each.

    Empty where an increment is missing.
    """
    clock: list[tuple[float, float, int]] = []
    end, last = 0.0, 0
    first = before = parts[0].start if parts else None
    for n_total, stated, moment, _ in parts:
        rate, n = rate_of(stated), n_total - last
        if rate is None:
            return []
        start = end
        if first is not None and moment not in (None, before):
            at = float((moment - first) / np.timedelta64(1, "s"))
            # Start times are rounded to 1 µs.
            start = at if abs(at - end) * rate > constants.JITTER else end
        if clock and start == end and clock[-1][1] == 1 / rate:
            clock[-1] = *clock[-1][:2], clock[-1][2] + n
        elif n:
            clock.append((start, 1 / rate, n))
        end, last, before = start + n / rate, n_total, moment
    return clock


def _check_sizes(channels: Sequence[Any], n_bytes: int) -> None:
    """Refuse channels that claim another number of samples than the segments hold."""
    sizes = [(getattr(one.data_type, "size", None), len(one)) for one in channels if len(one)]
    # Text, and raw counts of several channels in one, have no size of their own.
    claimed = sum(size * n for size, n in sizes if size is not None)
    if claimed != n_bytes and all(size is not None for size, _ in sizes):
        raise Unusable("corrupt", f"channels of {claimed} bytes in {n_bytes} bytes of samples")


def _check_scales(objects: Iterable[Mapping[str, object]]) -> None:
    """Refuse a damaged count of scales or coefficients, over which npTDMS would loop for hours."""
    for properties in objects:
        for key, value in properties.items():
            scale = _SCALE.match(key)
            is_count = key == _N_SCALES or (scale and key.endswith("_Size"))
            many = is_count and not (isinstance(value, int) and value <= constants.MOST_SCALES)
            if many or (scale and int(scale[1]) > constants.MOST_SCALES):
                detail = f"{listed([key])} is {str(value)[:20]!r}; export it again"
                raise Unusable("corrupt", detail)


def _described(channels: Sequence[Any], parts: Mapping[str, Sequence[_Part]]) -> list[Described]:
    """Describe the channels; the group is named where the channel alone is ambiguous."""
    names = Counter(channel.name for channel in channels)
    starts = _starts(parts)
    return [
        Described(
            channel.name if names[channel.name] == 1 else f"{channel.group_name}/{channel.name}",
            str(channel.properties.get("unit_string", "")),
            rate_of(channel.properties.get("wf_increment")),
            start=starts.get(channel.path),
            size=len(channel),
            moments=channel.dtype.kind == "M",
        )
        for channel in channels
    ]


def _read(
    file: Any, wanted: dict[str, Any], times: Mapping[str, SinceFirst], stored: int
) -> dict[str, Samples]:
    """Read the wanted channels in one pass, each of shape ``(n_samples,)``."""
    for name, channel in wanted.items():
        if name not in times and channel.dtype.kind not in "fiu":
            raise not_numeric(name, f"values of type {channel.dtype}")
    sizes = {name: len(channel) for name, channel in wanted.items()}
    check_size(8 * sum(sizes.values()), stored)
    parts = (
        (name, samples[:])
        for chunk in (file.data_chunks() if wanted else ())
        for name, channel in wanted.items()
        if len(samples := chunk[channel.group_name][channel.name])
    )
    read = collected(dict.fromkeys(wanted, 0), parts, times)
    for name, samples in read.items():
        if samples.size != sizes[name]:
            found = f"{samples.size} of {sizes[name]} samples are there"
            raise Unusable("corrupt", f"{name}: {found}")
    return read


TDMS = Format("TDMS", (".tdms",), begins(_MAGIC), _load_tdms)


# Renishaw laser, SINUMERIK trace

_RTX, _RTX_DATA, _RTX_END = b"HEADER::", b"Data:\r\n", b"EOF::"
_RTX_HEADER = 1 << 16
_ROWS = 1 << 14  # per block
# A control writes its largest counts where a signal has no value.
_NO_VALUE = 9.2e18


def _load_rtx(path: Path, columns: ColumnMap, max_memory: float) -> Content:
    """Read the lines of the header, and float64 values up to the end mark."""
    data = path.read_bytes()
    start = data.find(_RTX_DATA, 0, _RTX_HEADER)
    end = data.rfind(_RTX_END)
    if start < 0 or end < start:
        raise corrupt("needed a line 'Data:' and the mark 'EOF::' at the end")
    lines = data[:start].decode("utf-8", "replace").splitlines()
    header = dict(line.split(": ", 1) for line in lines if ": " in line)
    start += len(_RTX_DATA)
    if (end - start) % 8:
        raise corrupt(f"{end - start} bytes of data are no whole number of float64 values")
    rate = header.get("Actual sample rate", header.get("Sample rate", ""))
    chosen, content = choose([Described("data", "")], columns)
    values = as_samples(np.frombuffer(data[start:end], dtype="<f8"))
    metadata = {"sample_rate_hz": rate.strip()} if rate.strip() else {}
    return replace(content, columns=dict.fromkeys(chosen, values), metadata=metadata)


def _load_trace(path: Path, columns: ColumnMap, max_memory: float) -> Content:
    """Read the signals of a trace: records with a time and a value of each signal, or some."""
    names, spools, n_rows = list[str](), dict[str, Spool](), 0
    records, content = _records(path, names), Content({}, {}, ())
    while rows := list(islice(records, _ROWS)):
        table = np.array(rows)
        table[np.abs(table) > _NO_VALUE] = np.nan
        channels = [Described("time", "s"), *(Described(name, "") for name in names)]
        chosen, content = choose(channels, columns)
        for name, k in chosen.items():
            spools.setdefault(name, Spool()).append(table[:, k])
        n_rows += len(rows)
        check_size(8 * n_rows * len(spools), path.stat().st_size)
    if not n_rows:
        detail = "an XML file with no records (rec) of a trace; `lmshealth frf` reads responses"
        raise Unusable("columns", detail)
    return replace(content, columns={name: one.samples() for name, one in spools.items()})


def _records(path: Path, names: list[str]) -> Iterator[list[float]]:
    """Yield time and values of each record; the signals, which come before, add their names."""
    try:
        for _, element in iterparse(path):  # noqa: S314 (expat bounds entities)
            if element.tag == "dataSignal":
                # Its description, else its path in the control.
                own = element.attrib
                described = own.get("description", "").removesuffix("(64 bit)").strip()
                names.append(described or own.get("name", own.get("key", "")))
            if element.tag == "rec":
                keys = "time", *(f"f{k}" for k in range(1, len(names) + 1))
                yield [float(element.attrib.get(key, "nan")) for key in keys]
            element.clear()
    except (ParseError, ValueError) as error:
        raise corrupt(f"the trace cannot be read: {error}") from error


RTX = Format("Renishaw laser", (".rtx",), begins(_RTX), _load_rtx)
_XML = begins(b"<?xml", b"<trace", blanks=b"\xef\xbb\xbf \r\n\t")
TRACE = Format("SINUMERIK trace", (".xml",), _XML, _load_trace)
