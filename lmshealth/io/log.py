"""A log: the samples of one recording of one stage in SI units, its metadata, its refusals."""

from dataclasses import dataclass, field
from datetime import datetime
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from lmshealth._arrays import freeze
from lmshealth._result import Result
from lmshealth.errors import BadLog
from lmshealth.io.buffers import Samples

ChannelKind = Literal["displacement", "acceleration", "current"]
_SUFFIXES = {"displacement": "m", "acceleration": "m_s2", "current": "a"}
SI_UNITS = {"displacement": "m", "acceleration": "m/s²", "current": "A"}


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
    """Metadata of a log; None where nothing is stated."""

    stage: str | None = None  # identity of the physical machine
    recorded_at: datetime | None = None  # with time zone
    travel: float | None = None  # odometer in m
    # Of ``temperature_c``, ``payload_kg`` and ``position_mm``: they move frequencies without wear.
    covariates: dict[str, float] = field(default_factory=dict)
    servo_id: str | None = None  # tuning of the control loop
    baseline: bool | None = None  # whether the log belongs to the baseline
    description: str | None = None  # stage description that the manifest names for this log
    velocity: float | None = None  # set velocity in m/s, for logs without a set point


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
        if self.sample_rate <= 0 or not np.isfinite(self.sample_rate):
            raise ValueError(f"sample_rate is {self.sample_rate}, needed a positive number")
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

    def to_sep005(self) -> list[dict[str, object]]:
        """Return the channels as SEP005 dictionaries: SI units, NaN where a sample is missing.

        `BadLog` (``time``) for a record that is interrupted: SEP005 has one rate and start.
        """
        if any(end == start for (_, end), (start, _) in pairwise(self.pieces)):
            detail = "the record is interrupted, which SEP005 cannot state; export its parts"
            raise BadLog(self.name, "time", detail)
        stated: dict[str, object] = {"fs": self.sample_rate}
        if (moment := self.metadata.recorded_at) is not None:
            stated["start_timestamp"] = moment.isoformat(sep=" ")
        return [
            {"data": c.values[:].copy(), "name": c.name, "unit_str": SI_UNITS[c.kind], **stated}
            for c in self.channels
        ]
