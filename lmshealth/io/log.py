"""A log: the samples of one recording of one stage in SI units, its metadata, its refusals."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from typing import Literal

import numpy as np

from lmshealth._arrays import expect_shape, freeze
from lmshealth.io.buffers import Samples

ChannelKind = Literal["displacement", "acceleration", "current"]


@dataclass(frozen=True, slots=True)
class Refusal:
    """A log, channel, stretch or mode that was not analysed: one row of ``refused.csv``."""

    log: str
    reason: str
    detail: str
    channel: str = ""
    mode: str = ""
    source: str = ""


@dataclass(frozen=True, slots=True)
class Metadata:
    """Metadata of a log.

    Attributes
    ----------
    stage : str or None
        Identity of the physical machine.
    recorded_at : datetime or None
        Time of the recording, with time zone.
    travel : float or None
        Odometer in m.
    covariates : dict of str to float
        Values of ``temperature_c``, ``payload_kg`` and ``position_mm``: they move frequencies
        without wear.
    servo_id : str or None
        Tuning of the control loop.
    baseline : bool or None
        Whether the log belongs to the baseline; None where nothing is declared.
    description : str or None
        Stage description that the manifest names for this log.
    velocity : float or None
        Set velocity in m/s, for logs without a set point.
    """

    stage: str | None = None
    recorded_at: datetime | None = None
    travel: float | None = None
    covariates: dict[str, float] = field(default_factory=dict)
    servo_id: str | None = None
    baseline: bool | None = None
    description: str | None = None
    velocity: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Channel:
    """One signal of a log.

    Attributes
    ----------
    name : str
        Column name without its unit (``delta_e``, ``acc_feed``, ``current``).
    kind : str
        Physical quantity: ``displacement`` (m), ``acceleration`` (m/s²) or ``current`` (A).
    values : ndarray or Stored
        Samples in SI units, shape ``(n_samples,)``; NaN where a sample is missing. Those of a long
        record are on disk: read a stretch of them by ``values[start:stop]``.
    """

    name: str
    kind: ChannelKind
    values: Samples

    def __post_init__(self) -> None:
        if isinstance(self.values, np.ndarray):
            expect_shape("values", self.values, (self.values.size,))
        freeze(self)


@dataclass(frozen=True, slots=True, eq=False)
class Log:
    """One recording of one stage, in SI units.

    Attributes
    ----------
    name : str
        Path as the user gave it.
    digest : str
        SHA-256 of the file's content.
    metadata : Metadata
    sample_rate : float
        In Hz.
    channels : tuple of Channel
        Usable signals, all of the same length.
    reference_velocity : ndarray, Stored or None
        Set point in m/s, shape ``(n_samples,)``; NaN where it is missing.
    pieces : tuple of (int, int)
        Half-open sample ranges without gaps; the whole range when nothing is missing.
    refused : tuple of Refusal
        Channels that were left out, and stretches of those that were not.
    """

    name: str
    digest: str
    metadata: Metadata
    sample_rate: float
    channels: tuple[Channel, ...]
    reference_velocity: Samples | None
    pieces: tuple[tuple[int, int], ...]
    refused: tuple[Refusal, ...]

    def __post_init__(self) -> None:
        if self.sample_rate <= 0 or not np.isfinite(self.sample_rate):
            raise ValueError(f"sample_rate is {self.sample_rate}, needed a positive number")
        sizes = {channel.values.size for channel in self.channels}
        if len(sizes) > 1:
            raise ValueError(f"channels have lengths {sorted(sizes)}, needed one length")
        freeze(self)
