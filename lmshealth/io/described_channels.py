"""Channels that carry their unit beside their name (TDMS, UFF58): which are read, and as what."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from lmshealth.io.column_map import ColumnMap
from lmshealth.io.log import Refusal
from lmshealth.io.refusal import Unusable, listed
from lmshealth.io.time_axis import AGREEMENT
from lmshealth.io.units import acceleration_unit, parse_column, role_of, unit_key


@dataclass(frozen=True, slots=True)
class Described:
    """What a file says about one of its channels.

    Attributes
    ----------
    name : str
        As in the file; what a column map calls it by.
    unit : str
        As in the file; empty where it says none.
    rate : float or None
        Sample rate in Hz; None where the channel says none.
    acceleration : bool
        Whether the file calls it an acceleration, whatever its unit.
    """

    name: str
    unit: str
    rate: float | None = None
    acceleration: bool = False


@dataclass(frozen=True, slots=True)
class Chosen:
    """Which channels make the log.

    Attributes
    ----------
    columns : dict of str to int
        Name as a column of the log to the place among the channels of the file.
    rate : float or None
        Their sample rate in Hz.
    refused : tuple of Refusal
        Wanted channels of another sample rate.
    """

    columns: dict[str, int]
    rate: float | None
    refused: tuple[Refusal, ...]

    @property
    def metadata(self) -> dict[str, str]:
        """Give the sample rate as metadata of the log."""
        # 999.9999999999999 Hz is an artefact of the division.
        return {} if self.rate is None else {"sample_rate_hz": f"{self.rate:.10g}"}


def choose(channels: Sequence[Described], columns: ColumnMap) -> Chosen:
    """Choose the channels of one sample rate that the contract or the column map ask for.

    Without ``[columns]`` every channel whose unit is an acceleration is read as ``acc_<name>``;
    with it, the named ones and those that keep the contract.

    Parameters
    ----------
    channels : sequence of Described
        All channels of a file.
    columns : ColumnMap
        What the user said about them.

    Raises
    ------
    Unusable
        With reason ``columns`` where two channels would be one column, ``unit`` where a name
        contradicts the unit beside it.
    """
    found: dict[str, int] = {}
    for place, channel in enumerate(channels):
        column = _column(channel, columns)
        if column is None:
            continue
        if column in found:
            both = listed([channels[found[column]].name, channel.name])
            raise Unusable(
                "columns", f"{both} would both be read as {column}; rename them or map one of them"
            )
        found[column] = place
    rate = _most_common(channels[place].rate for place in found.values())
    kept = {name: k for name, k in found.items() if _agree(channels[k].rate, rate)}
    refused = tuple(
        Refusal(
            "",
            "time",
            f"sampled at {channels[k].rate:.6g} Hz, the log at {rate:.6g} Hz; "
            "keep channels of one rate in one log",
            channel=name,
        )
        for name, k in found.items()
        if name not in kept
    )
    return Chosen(kept, rate, refused)


def present(channels: Iterable[Described]) -> tuple[str, ...]:
    """Name all channels with their units, for messages."""
    return tuple(f"{c.name} [{c.unit}]" if c.unit else c.name for c in channels)


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
    """Complete a name of the contract by the unit beside it; the two must not contradict."""
    unit = unit_key(channel.unit)
    if unit is None or channel.name in columns.units:
        return channel.name
    try:
        own = parse_column(channel.name)
    except Unusable:
        return f"{channel.name}_{unit}"
    if parse_column(own.name, unit).factor != own.factor:
        raise Unusable(
            "unit", f"channel {channel.name!r} has the unit {channel.unit!r} beside its name"
        )
    return channel.name


def _most_common(rates: Iterable[float | None]) -> float | None:
    """Find the rate of most channels, of several the highest; None where no channel says one."""
    counts = Counter(rate for rate in rates if rate is not None)
    return max(counts, key=lambda rate: (counts[rate], rate)) if counts else None


def _agree(rate: float | None, other: float | None) -> bool:
    return rate is None or other is None or abs(rate / other - 1) <= AGREEMENT
