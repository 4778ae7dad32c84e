"""A log: the samples of one recording of one stage in SI units, its metadata, its refusals."""

import math
import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, date, datetime, timedelta
from functools import cache
from typing import Any, Literal

import numpy as np

from lmshealth._private import load_plug_ins
from lmshealth._private.arrays import freeze
from lmshealth._private.result import Result
from lmshealth.io import constants
from lmshealth.io.buffers import Samples
from lmshealth.io.refusal import Unusable

GROUP = "lmshealth.covariates"
"""Group of entry points: each names a tuple of key, least and largest value."""

Key = tuple[str, float, float]

SHIPPED = ("temperature_c", "payload_kg", "position_mm")
OTHER_KEYS = (
    *("stage", "recorded_at", "travel_km", "sample_rate_hz"),
    *("servo_id", "baseline", "description", "velocity_mm_s"),
)
"""Keys of metadata that are no covariate."""


@cache
def covariates() -> Mapping[str, tuple[float, float]]:
    """Return the range of each covariate by its key, which ends with its unit.

    They are found on first use: a package that offers one may import this one.
    """
    shipped = [(key, *constants.RANGES[key]) for key in SHIPPED]
    return {
        key: (low, high) for key, low, high in load_plug_ins(GROUP, "covariate", shipped, _checked)
    }


@cache
def metadata_keys() -> tuple[str, ...]:
    """Return the keys of the metadata of a log."""
    first = OTHER_KEYS.index("servo_id")
    return (*OTHER_KEYS[:first], *covariates(), *OTHER_KEYS[first:])


def _checked(given: Any, others: Sequence[Key]) -> Key:
    """Return a covariate of another package; `TypeError` or `ValueError` if it is none."""
    if not isinstance(given, tuple) or len(given) != 3:
        raise TypeError(f"it is {given!r}, needed a tuple of key, least and largest value")
    key, low, high = given[0], float(given[1]), float(given[2])
    if not (isinstance(key, str) and re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)+", key)):
        raise ValueError(f"its key is {key!r}, needed small letters with a unit: humidity_percent")
    if key in (*OTHER_KEYS, *(own for own, *_ in others)):
        raise ValueError(f"its key {key!r} is known already; needed another")
    most = constants.LARGEST_NUMBER
    if not -most <= low < high <= most:
        raise ValueError(f"its range is {low:g} to {high:g}, needed ascending finite numbers")
    return key, low, high


ChannelKind = Literal["displacement", "acceleration", "current"]
# Logs

_SUFFIXES = {"displacement": "m", "acceleration": "m_s2", "current": "a"}
SI_UNITS = {"displacement": "m", "acceleration": "m/s²", "current": "A"}
MOMENTS = f"from {constants.FIRST_MOMENT.date()} on, before {constants.LAST_MOMENT.date()}"
"""Range of the moments of logs, for messages."""


def expect_possible(key: str, value: float) -> None:
    """Require a number of metadata or tables in the range of its key; `ValueError` names both."""
    if not low_high(key)[0] <= value <= low_high(key)[1]:
        raise ValueError(f"{key} is {value:g}, needed {possible(key)}")


def possible(key: str) -> str:
    """Return the range of the numbers of a key, for messages."""
    return "a number from {:g} to {:g}".format(*low_high(key))


def low_high(key: str) -> tuple[float, float]:
    """Return the range of the numbers of a key."""
    most = constants.LARGEST_NUMBER
    known = constants.RANGES.get(key) or covariates().get(key)
    return known or (-most, most)


def expect_moment(moment: datetime) -> None:
    """Require a moment with a time zone in the range of `constants`, or raise `ValueError`."""
    zoned = isinstance(moment, datetime) and moment.tzinfo is not None
    if not zoned or not constants.FIRST_MOMENT <= moment < constants.LAST_MOMENT:
        found = f"{moment}, a {type(moment).__name__}"
        raise ValueError(f"recorded_at is {found}; needed a moment with a time zone, {MOMENTS}")


@dataclass(frozen=True, slots=True)
class Refusal:
    """A log, channel, part or mode that was not analysed: one row of ``refused.csv``."""

    log: str
    reason: str
    detail: str
    channel: str = ""
    mode: str = ""
    source: str = ""
    # Of a refused mode in Hz.
    frequency: float | None = field(default=None, compare=False, kw_only=True)
    # Of a log as a whole in an archive, as far as it is known.
    machine: str = field(default="", compare=False, kw_only=True)
    # Whether the log was declared as baseline.
    baseline: bool = field(default=False, compare=False, kw_only=True)


# Reasons of warnings among the refusals of a log, which name a channel: it is used nevertheless.
# Each with the flag of the modes that it shows, or of all where the channel is the time or a set
# point; empty where the fault is repaired, or what it concerns is left out.
WARNINGS = {
    "gaps": "",
    "unwrapped": "",
    "spikes": "",
    "levels": "levels",
    "rate": "rate",
    "dropped": "",
    "repeated": "",
}


@dataclass(frozen=True, slots=True)
class Notice:
    """What the reader of a result must take into account: one row of ``warnings.csv``.

    Severities: of a ``note`` the result takes account; a ``caution`` may make it wrong or old; what
    is ``serious`` withholds it, or makes it unreliable.
    """

    code: str
    severity: Literal["note", "caution", "serious"]
    where: str  # mode, parameter or file; empty for the whole machine
    what: str  # a sentence
    to_do: str = ""  # a sentence

    def __str__(self) -> str:
        return f"{self.what} {self.to_do}".rstrip()


@dataclass(frozen=True, slots=True)
class Metadata:
    """Metadata of a log; None where nothing is stated.

    `ValueError` for moments and numbers out of the ranges of `constants`.
    """

    stage: str | None = None  # identity of the physical machine
    recorded_at: datetime | None = None  # with time zone
    travel: float | None = None  # odometer in m
    # Of ``temperature_c``, ``payload_kg`` and ``position_mm``: they move frequencies without wear.
    covariates: dict[str, float] = field(default_factory=dict)
    servo_id: str | None = None  # tuning of the control loop
    baseline: bool | None = None  # whether the log belongs to the baseline
    description: str | None = None  # stage description that the manifest names for this log
    velocity: float | None = None  # set velocity in m/s, for logs without a set point

    def __post_init__(self) -> None:
        if self.recorded_at is not None:
            freeze(self)
            expect_moment(self.recorded_at)
        numbers = dict(self.covariates)
        numbers |= {} if self.travel is None else {"travel_km": self.travel / 1e3}
        numbers |= {} if self.velocity is None else {"velocity_mm_s": self.velocity * 1e3}
        for key, value in numbers.items():
            expect_possible(key, value)


@dataclass(frozen=True, slots=True, eq=False)
class Channel:
    """One signal of a log."""

    name: str  # column name without its unit (``delta_e``, ``acc_feed``, ``current``)
    kind: ChannelKind  # physical quantity, in m, m/s² or A
    # Samples in SI units, shape ``(n_samples,)``; NaN where a sample is missing. Those of a long
    # record are on disk: read a part of them by ``values[start:stop]``.
    values: Samples

    def __post_init__(self) -> None:
        if isinstance(self.values, np.ndarray):
            freeze(self, ("values", self.values.size))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Log(Result):
    """One recording of one stage, in SI units."""

    name: str  # path as the user gave it
    digest: str  # SHA-256 of the file's content
    metadata: Metadata
    sample_rate: float  # in Hz
    channels: tuple[Channel, ...]  # usable signals, all of the same length
    reference_velocity: Samples | None  # set point in m/s, ``(n_samples,)``; NaN where missing
    pieces: tuple[tuple[int, int], ...]  # half-open sample ranges without gaps
    refused: tuple[Refusal, ...]  # channels that were left out, and parts of others
    guessed: tuple[str, ...] = ()  # of the layout: what neither file nor column map states

    def __post_init__(self) -> None:
        expect_possible("sample_rate_hz", self.sample_rate)
        sizes = {channel.values.size for channel in self.channels}
        if len(sizes) > 1:
            raise ValueError(f"channels have lengths {sorted(sizes)}, needed one length")
        freeze(self)

    def title(self) -> str:
        """Return name, duration, rate, machine, moment and odometer."""
        own, n = self.metadata, max((one.values.size for one in self.channels), default=0)
        parts = [f"Log {self.name}: {n / self.sample_rate:.6g} s at {self.sample_rate:g} Hz"]
        parts += [str(part) for part in (own.stage, own.recorded_at) if part is not None]
        return ", ".join(parts) + ("" if own.travel is None else f", {own.travel / 1000:g} km")

    def to_columns(self) -> dict[str, Any]:
        """Return time in s and all samples in SI units; a long log may not fit into memory."""
        n = max((one.values.size for one in self.channels), default=0)
        samples = {f"{c.name}_{_SUFFIXES[c.kind]}": c.values[:n] for c in self.channels}
        if self.reference_velocity is not None:
            samples["reference_velocity_m_s"] = self.reference_velocity[:n]
        return {"time_s": np.arange(n) / self.sample_rate, **samples}

    def digest_columns(self) -> dict[str, Any]:
        """Return the channels."""
        names = [one.name for one in self.channels]
        kinds = [one.kind for one in self.channels]
        return {"channel": names, "kind": kinds, "unit": [SI_UNITS[kind] for kind in kinds]}


# Metadata as text

# Characters that no name has, as a class of regular expressions: control and bidirectional ones,
# and those that nobody sees (soft hyphens, fillers, byte order marks, tags, selectors of variants).
INVISIBLE = (
    "\x00-\x1f\x7f-\x9f\xad\u034f\u061c\u115f\u1160\u17b4\u17b5\u180b-\u180f\u200b-\u200f"
    "\u2028-\u202e\u2060-\u206f\u3164\ufe00-\ufe0f\ufeff\uffa0\ufff0-\ufffb\ufffe\uffff"
    "\U000e0000-\U000e0fff\U000f0000-\U0010ffff"
)
# As people and programs write them.
BOOLEANS = {"true": True, "1": True, "yes": True, "false": False, "0": False, "no": False}


def parse_metadata(
    text: Mapping[str, str], latest: datetime | None = None
) -> tuple[Metadata, float | None]:
    """Convert the metadata of a log; unknown keys and empty values are ignored.

    The sample rate in Hz is returned beside the rest. `Unusable` (``metadata``, or ``future`` for a
    moment after `latest`, see `parse_moment`) names key and value.
    """
    given = {key: text[key].strip() for key in metadata_keys() if text.get(key, "").strip()}
    travel, velocity = _number(given, "travel_km"), _number(given, "velocity_mm_s")
    if (flag := given.get("baseline", "").lower()) and flag not in BOOLEANS:
        raise _bad(given, "baseline", "true or false")
    return Metadata(
        stage=parse_name(given, "stage"),
        recorded_at=parse_moment(given, latest),
        travel=None if travel is None else 1e3 * travel,
        covariates={
            key: value for key in covariates() if (value := _number(given, key)) is not None
        },
        servo_id=parse_name(given, "servo_id"),
        baseline=BOOLEANS.get(flag),
        description=parse_name(given, "description"),
        velocity=None if velocity is None else 1e-3 * velocity,
    ), _number(given, "sample_rate_hz")


def _bad(given: Mapping[str, str], key: str, needed: str) -> Unusable:
    return Unusable("metadata", f"{key} is {given[key][:80]!a}, needed {needed}")


def parse_name(given: Mapping[str, str], key: str) -> str | None:
    """Read a name; None where there is none. Very long ones are refused, and invisible characters.

    Names are normalised (NFC): systems differ in how they write an accented letter, and one
    machine must not become two.
    """
    name = given.get(key)
    if not name:
        return None
    is_odd = not name.isprintable() or re.search(f"[{INVISIBLE}]", name)
    if is_odd or len(name) > constants.LONGEST_NAME:
        raise _bad(given, key, f"printable text of at most {constants.LONGEST_NAME} characters")
    return unicodedata.normalize("NFC", name)


def utc_day(moment: datetime) -> date:
    """Return the day of a moment in UTC, in which silences and days without a log are counted."""
    return moment.astimezone(UTC).date()


def parse_moment(given: Mapping[str, str], latest: datetime | None = None) -> datetime | None:
    """Read ``recorded_at``; None where it is not given.

    `Unusable`: ``metadata`` without date or time zone, or out of the range of `constants`;
    ``future`` for one after `latest`, by default a day from now.
    """
    if not given.get("recorded_at"):
        return None
    try:
        moment = datetime.fromisoformat(given["recorded_at"])
        expect_moment(moment)
    except ValueError as error:
        needed = f"ISO 8601 with a time zone, {MOMENTS}, such as 2026-03-01T08:30:00+01:00"
        raise _bad(given, "recorded_at", needed) from error
    if is_future(moment, latest):
        what = f"recorded_at is {given['recorded_at'][:80]!a}, in the future"
        raise Unusable("future", f"{what}; correct it, or set --allow-future")
    return moment


def is_future(moment: datetime | None, latest: datetime | None = None) -> bool:
    """Return whether a log of a moment was recorded after `latest`, by default a day from now."""
    now = max(datetime.now(UTC), constants.MADE)
    return moment is not None and moment > (latest or now + constants.FUTURE)


def _number(given: Mapping[str, str], key: str) -> float | None:
    """Read a number in the range of its key; None where it is not given."""
    if key not in given:
        return None
    try:
        # Python reads 1_000 as a number; no exporter means that.
        value = math.nan if "_" in given[key] else float(given[key])
        expect_possible(key, value)
    except ValueError as error:
        raise _bad(given, key, possible(key)) from error
    return value


def moment_after(epoch: datetime, count: float, unit: timedelta = timedelta(seconds=1)) -> str:
    """Write a moment after an epoch; `parse_moment` refuses what is out of the calendar."""
    try:
        return (epoch + count * unit).isoformat()
    except OverflowError:
        return f"{count:g} times {unit.total_seconds():g} s after {epoch.date()}"


def as_text(value: object) -> str:
    """Write a value of a file or a column map as the text that `parse_metadata` reads."""
    if isinstance(value, bool | np.bool_):
        return "true" if value else "false"
    if isinstance(value, np.datetime64):  # of TDMS, in UTC
        return f"{np.datetime_as_string(value, unit='us')}+00:00"
    return value.isoformat() if isinstance(value, date) else str(value)
