"""Channels with their unit in a field of the file (TDMS, UFF58): which are read, and as what."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from lmshealth.io import constants
from lmshealth.io.column_map import ColumnMap, acceleration_unit, parse_column, role_of, unit_key
from lmshealth.io.log import Refusal
from lmshealth.io.refusal import Unusable, listed


@dataclass(frozen=True, slots=True)
class Described:
    """Description of a channel in a file.

    Attributes
    ----------
    name : str
        As in the file and in a column map.
    unit : str
        As in the file; empty where there is none.
    rate : float or None
        Sample rate in Hz; None where there is none.
    acceleration : bool
        Whether the file calls it an acceleration, whatever its unit.
    """

    name: str
    unit: str
    rate: float | None = None
    acceleration: bool = False


@dataclass(frozen=True, slots=True)
class Chosen:
    """Channels that make the log.

    Attributes
    ----------
    columns : dict of str to int
        Name as a column of the log to the index among the channels of the file.
    metadata : dict of str to str
        Their sample rate, where there is one.
    refused : tuple of Refusal
        Wanted channels of another sample rate.
    """

    columns: dict[str, int]
    metadata: dict[str, str]
    refused: tuple[Refusal, ...]


def choose(channels: Sequence[Described], columns: ColumnMap) -> Chosen:
    """Choose the channels of one sample rate that the contract or the column map names.

    Without ``[columns]`` every channel whose unit is an acceleration is read as ``acc_<name>``;
    with it, the named ones and those that keep the contract.

    Raises
    ------
    Unusable
        With reason ``columns`` where two channels would be one column, ``unit`` where a name
        contradicts the unit of its channel.
    """
    found: dict[str, int] = {}
    for k, channel in enumerate(channels):
        column = _column(channel, columns)
        if column in found:
            both = listed([channels[found[column]].name, channel.name])
            raise Unusable(
                "columns", f"{both} would both be read as {column}; rename them or map one of them"
            )
        if column is not None:
            found[column] = k
    rate = _most_common(channels[k].rate for k in found.values())
    if rate is None:
        return Chosen(found, {}, ())
    kept, refused = {}, []
    for name, k in found.items():
        own = channels[k].rate
        if own is None or abs(own / rate - 1) <= constants.AGREEMENT:
            kept[name] = k
            continue
        detail = f"sampled at {own:.6g} Hz, the log at {rate:.6g} Hz; "
        detail += "keep channels of one rate in one log"
        refused.append(Refusal("", "time", detail, channel=name))
    # 999.9999999999999 Hz is an artefact of the division.
    return Chosen(kept, {"sample_rate_hz": f"{rate:.10g}"}, tuple(refused))


def present(channels: Iterable[Described]) -> tuple[str, ...]:
    """List all channels with their units, for messages."""
    return tuple(f"{c.name} [{c.unit}]" if c.unit else c.name for c in channels)


def rate_of(interval: object) -> float | None:
    """Convert an interval in s to a sample rate in Hz; None for an impossible one."""
    if not isinstance(interval, int | float) or not 1e-12 < interval < 1e9:
        return None
    return 1 / float(interval)


def _column(channel: Described, columns: ColumnMap) -> str | None:
    """Name a channel as a column of the log; None if it is not to be read."""
    if channel.name in columns.columns.values():
        return channel.name
    if role_of(channel.name) is not None:
        column = _with_unit(channel, columns)
    else:
        unit = acceleration_unit(channel.unit)
        if columns.columns or (unit is None and not channel.acceleration):
            return None
        column = "acc_" + re.sub(r"\W+", "_", channel.name).strip("_")
        if unit is not None and column not in columns.units:
            column = f"{column}_{unit}"
    return column if columns.target(column) is not None else None


def _with_unit(channel: Described, columns: ColumnMap) -> str:
    """Complete a name of the contract by the unit of its channel; the two must agree."""
    unit = unit_key(channel.unit)
    if unit is None or channel.name in columns.units:
        return channel.name
    try:
        own = parse_column(channel.name)
    except Unusable:
        return f"{channel.name}_{unit}"
    if parse_column(own.name, unit).factor != own.factor:
        raise Unusable(
            "unit", f"channel {channel.name!r} has the unit {channel.unit!r}; they must agree"
        )
    return channel.name


def _most_common(rates: Iterable[float | None]) -> float | None:
    """Return the rate of most channels, of several the highest; None where no channel has one."""
    counts = Counter(rate for rate in rates if rate is not None)
    return max(counts, key=lambda rate: (counts[rate], rate)) if counts else None
