"""The log contract: from the columns and metadata of any format to a `Log` in SI units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from lmshealth.io.buffers import Samples, Stored, in_unit
from lmshealth.io.channel_checks import ABSURD, check_signal, missing_stretches
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.log import Channel, ChannelKind, Log, Refusal
from lmshealth.io.metadata import parse_metadata
from lmshealth.io.raw import Raw
from lmshealth.io.refusal import Unusable, listed
from lmshealth.io.set_point import set_velocity
from lmshealth.io.time_axis import IntArray, pieces, time_axis
from lmshealth.io.units import Role, Signal

_NEEDED = "needed delta_e_um or acc_<name>_m_s2 (or another unit of the contract)"
_MEASURED: tuple[Role, ...] = ("displacement", "acceleration", "current")
_DYNAMIC = ("displacement", "acceleration")


@dataclass(frozen=True, slots=True, eq=False)
class _Series:
    """A column in SI units, shape ``(n_samples,)``; what is no measurement reads as NaN."""

    signal: Signal
    values: Samples


def to_log(
    raw: Raw, columns: ColumnMap, overrides: Mapping[str, str], *, name: str, digest: str
) -> Log:
    """Apply the log contract.

    Parameters
    ----------
    raw : Raw
        What a format handed over.
    columns : ColumnMap
        Contract names and units of the columns; constants that override the file's metadata.
    overrides : mapping of str to str
        The manifest's row: overrides both.
    name : str
        The log, as the user knows it.
    digest : str
        SHA-256 of the file's content.

    Returns
    -------
    Log
        Its ``refused`` names the channels that cannot be used, and the stretches that were left
        out (reason ``gaps``, channel the one they are missing from).

    Raises
    ------
    Unusable
        With the reasons ``metadata``, ``columns``, ``unit``, ``empty``, ``time``, ``no-signal``.
    """
    given = raw.metadata | columns.constants() | _said(overrides)
    metadata, rate = parse_metadata(given)
    series = _series(raw, columns)
    time = _first(series, "time")
    axis = time_axis(None if time is None else time.values, rate)
    refused = [replace(refusal, log=name) for refusal in raw.refused]
    if axis.note:
        refused.append(Refusal(name, "gaps", axis.note, channel="time_s"))
    channels, missing = _usable_channels(series, name, refused)
    reference = _first(series, "reference_velocity") or _first(series, "reference_position")
    gone = _reference_missing(reference, name, refused)
    n_samples = series[0].values.size
    ranges = pieces(n_samples, missing if gone is None else [*missing, gone], axis.breaks)
    if not ranges:
        raise Unusable("no-signal", f"no two samples in a row are complete; {_why(refused)}")
    velocity = None
    if reference is not None and gone is not None:
        velocity = reference.values
        if reference.signal.role == "reference_position":
            velocity = set_velocity(velocity, ranges, axis.sample_rate)
    return Log(
        name=name,
        digest=digest,
        metadata=metadata,
        sample_rate=axis.sample_rate,
        channels=channels,
        reference_velocity=velocity,
        pieces=ranges,
        refused=tuple(refused),
    )


def _said(overrides: Mapping[str, str]) -> dict[str, str]:
    """Keep what a row says; an empty cell says nothing."""
    return {key: value for key, value in overrides.items() if value.strip()}


def _series(raw: Raw, columns: ColumnMap) -> list[_Series]:
    """Name the columns, convert them to SI and compare their lengths."""
    there = f"there: {listed(raw.present)}"
    hint = f"; {raw.hint}" if raw.hint else ""
    left_out = {refusal.channel for refusal in raw.refused}
    if absent := sorted(set(columns.columns.values()) - set(raw.columns) - left_out):
        raise Unusable("columns", f"the column map needs {listed(absent)}; {there}{hint}")
    series = []
    for source, values in raw.columns.items():
        target = columns.target(source)
        if target is None:
            continue
        try:
            signal = columns.signal(target)
        except Unusable as error:
            raise Unusable(error.reason, f"{error.detail}; {there}") from error
        limit = np.inf if signal.role == "time" else ABSURD
        if isinstance(values, Stored):
            series.append(_Series(signal, values.scaled(signal.factor, limit)))
        else:
            series.append(_Series(signal, in_unit(values, signal.factor, limit)))
    names = [item.signal.name for item in series]
    if twice := sorted({item for item in names if names.count(item) > 1}):
        raise Unusable("columns", f"{listed(twice)} comes in more than one unit; {there}")
    if not any(item.signal.role in _DYNAMIC for item in series):
        hint += "" if columns.columns else "; a column map (--columns) translates other names"
        raise Unusable("columns", f"no signal: {_NEEDED}; {there}{hint}")
    _check_lengths(series)
    return series


def _check_lengths(series: list[_Series]) -> None:
    lengths = {item.signal.name: item.values.size for item in series}
    if len(set(lengths.values())) > 1:
        found = listed(f"{name} {size}" for name, size in lengths.items())
        raise Unusable("columns", f"columns differ in length ({found}); needed one length")
    if min(lengths.values()) < 2:
        raise Unusable("empty", f"{min(lengths.values())} samples; needed at least 2")


def _first(series: list[_Series], role: Role) -> _Series | None:
    return next((item for item in series if item.signal.role == role), None)


def _usable_channels(
    series: list[_Series], name: str, refused: list[Refusal]
) -> tuple[tuple[Channel, ...], list[IntArray]]:
    """Keep the channels that can be used, and tell where each of them misses samples."""
    missing = []
    channels = []
    for item in series:
        if item.signal.role not in _MEASURED:
            continue
        try:
            gone, note = missing_stretches(item.values)
            check_signal(item.values)
        except Unusable as error:
            refused.append(Refusal(name, error.reason, error.detail, channel=item.signal.name))
            continue
        if note:
            refused.append(Refusal(name, "gaps", note, channel=item.signal.name))
        missing.append(gone)
        channels.append(Channel(item.signal.name, cast(ChannelKind, item.signal.role), item.values))
    if not any(channel.kind in _DYNAMIC for channel in channels):
        raise Unusable("no-signal", f"no usable channel is left: {_why(refused)}")
    return tuple(channels), missing


def _why(refused: list[Refusal]) -> str:
    return "; ".join(f"{item.channel}: {item.reason}, {item.detail}" for item in refused)


def _reference_missing(
    reference: _Series | None, name: str, refused: list[Refusal]
) -> IntArray | None:
    """Tell where the set point is unknown; None when there is none that can be used."""
    if reference is None:
        return None
    try:
        gone, note = missing_stretches(reference.values)
    except Unusable as error:
        refused.append(Refusal(name, error.reason, error.detail, channel=reference.signal.name))
        return None
    if note:
        refused.append(Refusal(name, "gaps", note, channel=reference.signal.name))
    return gone
