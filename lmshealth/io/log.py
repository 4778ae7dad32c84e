"""A log: the samples of one recording of one stage in SI units, its metadata, its refusals."""

from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Literal

import numpy as np

from lmshealth._private.arrays import freeze
from lmshealth._private.result import Result
from lmshealth.io import constants
from lmshealth.io.buffers import Samples
from lmshealth.io.covariates import covariates

ChannelKind = Literal["displacement", "acceleration", "current"]
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
