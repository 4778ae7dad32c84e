"""Read one log: from a file of any format to a `Log` in SI units that keeps the log contract."""

import hashlib
import stat
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from lmshealth._private.arrays import IntArray
from lmshealth.errors import BadLog
from lmshealth.io import channel_checks as checks
from lmshealth.io import constants
from lmshealth.io import time_axis as timing
from lmshealth.io.buffers import Samples, count, in_unit
from lmshealth.io.column_map import ColumnMap, ColumnsGiven, Role, Signal, column_map
from lmshealth.io.consistency import compare
from lmshealth.io.formats.content import Content, frequency_column, over_frequency
from lmshealth.io.formats.registry import load
from lmshealth.io.log import Channel, ChannelKind, Log, Metadata, Refusal, as_text, parse_metadata
from lmshealth.io.refusal import Unusable, listed, nearest, repeated, shown, visible
from lmshealth.io.time_axis import Ranges, TimeAxis

_NEEDED = "needed delta_e_um or acc_<name>_m_s2 (or another unit of the contract)"
_MEASURED: tuple[Role, ...] = ("displacement", "acceleration", "current")
_DYNAMIC = ("displacement", "acceleration")
_REFERENCES: tuple[Role, ...] = ("reference_velocity", "reference_position")


def read_log(
    path: str | Path,
    *,
    columns: ColumnsGiven | None = None,
    overrides: Mapping[str, object] | None = None,
    name: str | None = None,
    max_memory: float = constants.MAX_MEMORY,
    latest: datetime | None = None,
) -> Log:
    """Read a log.

    Parameters
    ----------
    path : str or Path
        The file; its suffix names the format and its content must agree.
    columns : ColumnMap, mapping, str or Path, optional
        How an export is read: a column map, its tables as in the file (``{"columns": {"delta_e_um":
        "PE(0)"}}``), or its file. By default the columns are those of the log contract.
    overrides : mapping of str to object, optional
        Metadata of a manifest, which override those of the file and the column map. Values are
        text, numbers or dates; empty ones and None override nothing.
    name : str, optional
        Name of the log in results; by default the path.
    max_memory : float, optional
        Most memory in bytes that decoding one variable (MAT), data set (UFF58) or segment (TDMS)
        may take; a log that needs more is refused with reason ``too-large``.
    latest : datetime, optional
        Latest moment of recording; a later one is refused with reason ``future``. By default a day
        from now.

    Returns
    -------
    Log
        In SI units. Its ``refused`` lists the channels that cannot be used, and the ranges that
        were left out (reason ``gaps``).

    Raises
    ------
    BadLog
        For every fault of the file; ``lmshealth/report/REFUSALS.md`` lists the reasons.
    BadTable
        For a column map that breaks its contract.

    Examples
    --------
    A log is a table with units in the names of its columns:

    >>> import lmshealth
    >>> rows = ["# sample_rate_hz: 1000", "# stage: AX-3-Y", "delta_e_um,acc_pitch_g"]
    >>> rows += [f"{0.01 * (k % 7)},{0.002 * (k % 5)}" for k in range(2000)]
    >>> with open("log.csv", "w") as file:
    ...     print(*rows, sep=chr(10), file=file)
    >>> log = lmshealth.read_log("log.csv")
    >>> log.metadata.stage, log.sample_rate
    ('AX-3-Y', 1000.0)
    >>> [(channel.name, channel.kind) for channel in log.channels]
    [('delta_e', 'displacement'), ('acc_pitch', 'acceleration')]
    >>> print(f"{log.channels[0].values.max():.2g} m, {log.channels[1].values.max():.3g} m/s²")
    6e-08 m, 0.0785 m/s²
    """
    label = shown(path) if name is None else name
    digest = content_digest(path, name=label)
    used = column_map(columns)
    try:
        content = load(Path(path), used, max_memory)
        given = {k: as_text(own) for k, own in (overrides or {}).items() if own is not None}
        filled_in = {key: text for key, text in given.items() if text.strip()}
        stated = content.metadata | used.constants() | filled_in
        return _to_log(content, used, parse_metadata(stated, latest), name=label, digest=digest)
    except Unusable as error:
        raise BadLog(label, error.reason, error.detail) from error


def content_digest(path: str | Path, *, name: str | None = None) -> str:
    """Return the SHA-256 of a file's content; the name is for messages, by default the path.

    `BadLog` (``missing-file``, or ``empty``: empty files are no copies of each other) if there is
    no content.
    """
    label = shown(path) if name is None else name
    try:
        found = Path(path).stat()
        # Opening a named pipe would wait until somebody writes to it.
        if not stat.S_ISREG(found.st_mode):
            folder = stat.S_ISDIR(found.st_mode)
            other = "is a folder; name its files, or give it to `lmshealth run`"
            raise BadLog(label, "missing-file", other if folder else "is no regular file")
        if not found.st_size:
            raise BadLog(label, "empty", "0 bytes; copy the file again")
        with Path(path).open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or visible(str(error))
        raise BadLog(label, "missing-file", f"cannot be opened: {why}") from error


def require_identity(log: Log, *, odometer: bool = True) -> None:
    """Require the metadata that tracking needs; `BadLog` (``metadata``) names the missing keys.

    Without ``odometer`` a log needs none: its description counts days.
    """
    own = log.metadata
    given: dict[str, Any] = {"stage": own.stage, "recorded_at": own.recorded_at}
    given |= {"travel_km": own.travel} if odometer else {}
    if absent := [key for key, value in given.items() if value is None]:
        needed = "needed in the file's metadata or in manifest.csv"
        raise BadLog(log.name, "metadata", f"{', '.join(absent)} not given; {needed}")


class _Series(NamedTuple):
    """A column in SI units, shape ``(n_samples,)``; NaN where a sample is missing."""

    signal: Signal
    values: Samples


def _to_log(
    content: Content,
    layout: ColumnMap,
    parsed: tuple[Metadata, float | None],
    *,
    name: str,
    digest: str,
) -> Log:
    """Apply the log contract to the content of a file, with its metadata and sample rate."""
    metadata, rate = parsed
    series = _series(content, layout)
    stamps = next((one.values for one in series if one.signal.role == "time"), None)
    axis, added = timing.time_axis(stamps, rate).completed()
    # Missing samples are inserted where time lacks them, and those of a set point are interpolated.
    series = [
        _Series(signal, timing.with_dropped(values, added, linear=signal.role in _REFERENCES))
        for signal, values in series
    ]
    refused = [*content.refused, *_listed("time_s", {"gaps": axis.note})]
    missing, channels = [axis.lost], list[Channel]()
    for signal, values in series:
        if signal.role in _MEASURED and (read := _measured(signal, values, axis, added, refused)):
            channels.append(Channel(signal.name, cast(ChannelKind, signal.role), read[0]))
            missing.append(read[1])
    if not any(channel.kind in _DYNAMIC for channel in channels):
        raise Unusable("no-signal", f"no usable channel is left: {_why(refused)}")
    references = [one for role in _REFERENCES for one in series if one.signal.role == role]
    gone = None
    while references and (gone := _missing(*references[0], refused)) is None:
        del references[0]
    reference = references[0] if references else None
    missing += [] if gone is None else [gone]
    # A set point over a rate that varies is no witness of one rate.
    witness = {} if axis.clocks else {one.signal.role: one.values for one in references}
    position, velocity = map(witness.get, reversed(_REFERENCES))
    measured = [channel.values for channel in channels]
    found = compare(position, velocity, metadata.velocity, measured, axis.sample_rate, axis.breaks)
    for why, channel_name, note in found.notes:
        refused += _listed(channel_name, {why: note})
    breaks = np.union1d(axis.breaks, found.dropped)
    ranges = timing.pieces(channels[0].values.size, [*missing, found.repeated], breaks)
    if not ranges:
        raise Unusable("no-signal", f"no two samples in a row are complete; {_why(refused)}")
    channels = _without_copies(channels, ranges, refused)
    set_point = reference.values if reference else None
    if axis.clocks:
        channels, set_point, ranges = _at_one_rate(channels, set_point, ranges, axis)
    if reference and set_point is not None and reference.signal.role == "reference_position":
        set_point = timing.set_velocity(set_point, ranges, axis.sample_rate)
    return Log(
        name=name,
        digest=digest,
        metadata=metadata,
        sample_rate=axis.sample_rate,
        channels=tuple(channels),
        reference_velocity=set_point,
        pieces=ranges,
        refused=tuple(replace(refusal, log=name) for refusal in refused),
        guessed=content.guessed,
    )


def _series(content: Content, columns: ColumnMap) -> list[_Series]:
    """Name the columns, convert them to SI and compare their lengths."""
    there = f"there: {listed(content.present)}"
    hint = f"; read with {', '.join(content.guessed)}" if content.guessed else ""
    left_out = {refusal.channel for refusal in content.refused}
    if absent := sorted(set(columns.columns.values()) - set(content.columns) - left_out):
        near = nearest(absent, content.present)
        raise Unusable("columns", f"the column map needs {listed(absent)}; there: {near}{hint}")
    series = []
    starts = {source: content.late.get(source, 0) for source in content.columns}
    begin = max(starts.values(), default=0)
    end = min((first + content.columns[source].size for source, first in starts.items()), default=0)
    for source, first in starts.items():
        # Taken out: a log of hundreds of channels is in memory once.
        values = content.columns.pop(source)
        target = columns.target(source)
        if target is None:
            continue
        try:
            signal = columns.signal(target)
        except Unusable as error:
            raise Unusable(error.reason, f"{error.detail}; {there}") from error
        limit = np.inf if signal.role == "time" else constants.LARGEST_MAGNITUDE
        # Channels that start later than others are used where all have samples.
        common = (begin - first, max(end - first, begin - first)) if content.late else None
        series.append(_Series(signal, in_unit(values, signal.factor, limit, common)))
    if twice := repeated(item.signal.name for item in series):
        raise Unusable("columns", f"{listed(twice)} comes in more than one unit; {there}")
    _check_signals({item.signal.role for item in series}, content.present, columns, there + hint)
    lengths = {item.signal.name: item.values.size for item in series}
    if len(set(lengths.values())) > 1:
        found = listed(f"{name} {size}" for name, size in lengths.items())
        raise Unusable("columns", f"columns differ in length ({found}); needed one length")
    if (shortest := min(lengths.values())) < constants.SHORTEST_PIECE:
        raise Unusable("empty", f"{shortest} samples; needed at least {constants.SHORTEST_PIECE}")
    return series


def _check_signals(
    roles: set[Role], present: Sequence[str], columns: ColumnMap, there: str
) -> None:
    """Require a signal over time; a column map may name one beside a measured frequency."""
    has_signal = bool(roles & set(_DYNAMIC))
    is_certain = has_signal and ("time" in roles or bool(columns.columns))
    if not is_certain and (axis := frequency_column(present)):
        raise over_frequency(axis)
    if not has_signal:
        step = "" if columns.columns else "; a column map (--columns) translates other names"
        raise Unusable("columns", f"no signal: {_NEEDED}; {there}{step}")


def _missing(signal: Signal, values: Samples, refused: list[Refusal]) -> IntArray | None:
    """Find the missing samples of a set point; None if it cannot be used, which is refused."""
    try:
        gone, note = checks.missing_ranges(values)
    except Unusable as error:
        refused += _listed(signal.name, {error.reason: error.detail})
        return None
    refused += _listed(signal.name, {"gaps": note})
    return gone


def _measured(
    signal: Signal, values: Samples, axis: TimeAxis, added: IntArray, refused: list[Refusal]
) -> tuple[Samples, IntArray] | None:
    """Check the samples of a channel, and repair what is repaired exactly."""
    # Return its samples and the ranges that remain missing; None if it cannot be used. What
    # was found is added to ``refused``.
    notes = dict[str, str]()
    try:
        gone, notes["gaps"] = checks.missing_ranges(values, added)
        rough = checks.check_signal(values)
        values, notes["unwrapped"] = checks.unwrapped(values, gone, rough)
        if signal.role in _DYNAMIC:
            rough = checks.roughness(values) if notes["unwrapped"] else rough
            checks.check_sign(values, rough)
            notes["levels"] = checks.coarse_levels(values)
            if (bad := checks.spikes(values, gone, rough, axis.breaks)).size:
                found = f"{count(bad)} samples are no part of the signal"
                notes["spikes"] = f"{found}, and count as missing"
            gone = np.concatenate([gone, bad])
            gone = gone[np.argsort(gone[:, 0], kind="stable")]
    except Unusable as error:
        refused += _listed(signal.name, {error.reason: error.detail})
        return None
    values, left = checks.filled(values, gone, axis.breaks)
    open_ones = f"{len(left)} of {len(gone)} ranges are not filled" if left.size else ""
    if notes["gaps"] and not np.array_equal(gone, added):  # time_s has a note of those
        notes["gaps"] += f"; {open_ones or 'they are filled by linear prediction'}"
    else:
        notes["gaps"] = open_ones
    refused += _listed(signal.name, notes)
    return values, left


def _at_one_rate(
    channels: list[Channel], reference: Samples | None, ranges: Ranges, axis: TimeAxis
) -> tuple[list[Channel], Samples | None, Ranges]:
    """Resample channels and set point of a varying rate; return them with their pieces."""
    columns = [(channel.values, True) for channel in channels]
    columns += [] if reference is None else [(reference, False)]
    read, ranges = timing.resampled(columns, ranges, axis)
    if not ranges:
        raise Unusable("time", f"{axis.note}; the pieces are too short for that")
    channels = [replace(one, values=own) for one, own in zip(channels, read, strict=False)]
    return channels, None if reference is None else read[-1], ranges


def _without_copies(
    channels: list[Channel], ranges: Ranges, refused: list[Refusal]
) -> list[Channel]:
    """Leave out channels of vibration that are combinations of the others, which are refused."""
    dynamic = [channel for channel in channels if channel.kind in _DYNAMIC]
    order = checks.independent([c.values for c in dynamic], ranges, len(dynamic))
    copies = [channel for k, channel in enumerate(dynamic) if k not in order]
    others = listed(dynamic[k].name for k in sorted(order))
    detail = f"is a multiple or combination of {others}; check whether a sensor is recorded twice"
    for copy in copies:
        refused += _listed(copy.name, {"dependent": detail})
    rest = [one for one in channels if one.kind == "acceleration" and one not in copies]
    for k, axes in checks.magnitudes([one.values for one in rest], ranges).items():
        what = f"is the magnitude of {listed(rest[j].name for j in axes)}, which are used"
        refused += _listed(rest[k].name, {"dependent": what})
        copies.append(rest[k])
    return [channel for channel in channels if channel not in copies]


def _listed(channel: str, found: Mapping[str, str]) -> list[Refusal]:
    """Make refusals of a channel by reason and detail; the name of the log is added later."""
    return [Refusal("", why, detail, channel=channel) for why, detail in found.items() if detail]


def _why(refused: list[Refusal]) -> str:
    return "; ".join(f"{item.channel}: {item.reason}, {item.detail}" for item in refused)
