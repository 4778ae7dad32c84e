"""Channels with their unit in a field of the file (TDMS, UFF58): which are read, and as what."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from lmshealth.io import constants
from lmshealth.io.column_map import ColumnMap, parse_column, role_of, unit_key
from lmshealth.io.formats.content import Content
from lmshealth.io.log import Refusal
from lmshealth.io.refusal import Unusable, listed

# Names that exporters give to the column of times.
_TIME = re.compile(r"(time|zeit|temps|tiempo|tempo|t|x_value|timestamp)\b", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Described:
    """Name and unit of a channel as in the file, empty where there is none.

    ``rate`` is its sample rate in Hz, ``start`` the time in s of its first sample; ``acceleration``
    whether the file calls it one, whatever its unit.
    """

    name: str
    unit: str
    rate: float | None = None
    acceleration: bool = False
    start: float = 0.0


def choose(channels: Sequence[Described], columns: ColumnMap) -> tuple[dict[str, int], Content]:
    """Choose the channels of one sample rate that the contract or the column map names.

    Return the index in the file of each by its name as a column of the log, and a content that has
    their sample rate, the names of all channels, and refusals, but no samples. Channels of another
    rate or start are refused.

    Without ``[columns]`` every channel whose unit is an acceleration is read as ``acc_<name>``;
    with it, the named ones and those that keep the contract. Two channels that would be one column
    are refused as ``columns``, a name that contradicts the unit of its channel as ``unit``.
    """
    named = [(column, k) for k, c in enumerate(channels) if (column := _column(c, columns))]
    if len(named) > constants.MOST_COLUMNS:
        found = f"{len(named)} columns of signals, at most {constants.MOST_COLUMNS} are read"
        raise Unusable("columns", f"{found}; name those of the log in a column map (--columns)")
    # Each group of channels may have times of its own: those of the chosen rate are read.
    counts = Counter(
        own
        for column, k in named
        if (own := channels[k].rate) is not None and role_of(column) != "time"
    )
    rate = max(counts, key=lambda rate: (counts[rate], rate), default=None)
    alike = [k for _, k in named if rate is None or _agree(channels[k].rate or rate, rate)]
    starts = [channels[k].start for k in alike]
    start = max(starts, key=starts.count, default=0.0)
    kept: dict[str, int] = {}
    refused: dict[str, Refusal] = {}
    for column, k in named:
        late, own = channels[k].start - start, channels[k].rate
        if k in alike and (rate is None or abs(late) * rate <= 0.5):
            if column in kept and (role_of(column) != "time" or own is None):
                both = listed([channels[kept[column]].name, channels[k].name])
                detail = f"{both} would both be read as {column}; rename them or map one of them"
                raise Unusable("columns", detail)
            kept.setdefault(column, k)
        elif role_of(column) != "time":
            detail = f"sampled at {own or rate:.6g} Hz, the log at {rate:.6g} Hz; "
            if k in alike:
                detail = f"starts {late:.6g} s after the other channels; "
            detail += "keep channels of one rate and start in one log"
            refused[column] = Refusal("", "time", detail, channel=column)
    # 999.9999999999999 Hz is an artefact of the division.
    metadata = {} if rate is None else {"sample_rate_hz": f"{rate:.10g}"}
    present = tuple(f"{c.name} [{c.unit}]" if c.unit else c.name for c in channels)
    return kept, Content({}, metadata, present, tuple(refused.values()))


def _agree(one: float, other: float) -> bool:
    """Return whether two sample rates agree."""
    return abs(one / other - 1) <= constants.AGREEMENT


def rate_of(interval: object) -> float | None:
    """Convert an interval in s to a sample rate in Hz; None for an impossible one."""
    if not isinstance(interval, int | float) or not 1e-12 < interval < 1e9:
        return None
    return 1 / float(interval)


def _column(channel: Described, columns: ColumnMap) -> str | None:
    """Name a channel as a column of the log; None if it is not to be read."""
    if channel.name in columns.columns.values():
        return channel.name
    if role_of(channel.name) is None and columns.target(channel.name) is not None:
        return channel.name
    if role_of(channel.name) is not None:
        column = _with_unit(channel, columns)
    else:
        time = unit_key(channel.unit, "time")
        if time and channel.rate is None and _TIME.match(channel.name):
            return f"time_{time}" if columns.target(f"time_{time}") is not None else None
        unit = unit_key(channel.unit, "acceleration")
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
        detail = f"channel {channel.name!r} has the unit {channel.unit!r}; they must agree"
        raise Unusable("unit", detail)
    return channel.name
