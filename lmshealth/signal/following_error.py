"""The following error: what the paper reads of it, and what the control loop leaves of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal

from lmshealth._arrays import FloatArray, freeze
from lmshealth.errors import BadLog
from lmshealth.io.log import Channel, Log
from lmshealth.signal.harmonics import Harmonics, decompose
from lmshealth.signal.segments import (
    Part,
    Segment,
    find_segments,
    nominal_velocity,
    select_segments,
)

COUNT = 100
# Six counts of the paper's encoder, in m.
FLOOR = 30e-9
# Hz: a servo works below its crossover, and modes of guide and mounts stand above.
_LOOP_BAND = (1.0, 40.0)
# Periods of its lower end that a stretch must hold: a line takes the slower ones away.
_LOOP_PERIODS = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class FollowingError:
    """Reading of one following-error channel of a log.

    Attributes
    ----------
    channel : str
        Its name.
    velocity : float
        Set velocity in m/s; NaN where unknown or where the log has several.
    duration : float
        Seconds that the statistics are taken from.
    lowest, highest, std, mean : float
        Of all samples, in m.
    harmonics : Harmonics
        Of the longest stretch without gaps, of a longer one than a minute at 20 kHz of its first
        part.
    kept : ndarray
        Indices of the strongest harmonics, strongest first, shape ``(n_kept,)``.
    floor : float
        Harmonics up to this amplitude in m are left out of what counts as above it.
    """

    channel: str
    velocity: float
    duration: float
    lowest: float
    highest: float
    std: float
    mean: float
    harmonics: Harmonics
    kept: np.ndarray[tuple[int], np.dtype[np.intp]]
    floor: float

    def __post_init__(self) -> None:
        freeze(self)

    @property
    def above(self) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
        """Indices of the kept harmonics above the floor, strongest first."""
        return self.kept[self.harmonics.amplitude[self.kept] > self.floor]

    @property
    def max_magnitude(self) -> float:
        """Amplitude of the strongest harmonic in m."""
        return float(self.harmonics.amplitude[self.kept[0]])

    @property
    def band(self) -> tuple[float, float]:
        """Lowest and highest frequency of the kept harmonics in Hz."""
        return self._span(self.kept)

    @property
    def band_above(self) -> tuple[float, float]:
        """The same of those above the floor; NaN where there are none."""
        return self._span(self.above)

    @property
    def share_explained(self) -> float:
        """Share of the variance of the transformed stretch that the kept harmonics rebuild."""
        return self._share(self.kept)

    @property
    def share_explained_above(self) -> float:
        """The same of those above the floor."""
        return self._share(self.above)

    def rebuilt(self) -> FloatArray:
        """Rebuild Δe in m from the kept harmonics above the floor, shape ``(n_samples,)``."""
        return self.harmonics.rebuild(self.above)

    def _span(self, index: np.ndarray[tuple[int], np.dtype[np.intp]]) -> tuple[float, float]:
        if index.size == 0:
            return float("nan"), float("nan")
        frequency = self.harmonics.frequency[index]
        return float(frequency.min()), float(frequency.max())

    def _share(self, index: np.ndarray[tuple[int], np.dtype[np.intp]]) -> float:
        power = self.harmonics.power
        return float(power[index].sum() / power.sum())


def read_error(
    log: Log, *, count: int = COUNT, floor: float = FLOOR, part: Part = "record"
) -> tuple[FollowingError, ...]:
    """Read the following error of a log.

    Parameters
    ----------
    log : Log
        With at least one displacement channel.
    count : int
        How many of the strongest harmonics are kept.
    floor : float
        In m.
    part : str
        Which stretches of the log; see `select_segments`.

    Returns
    -------
    tuple of FollowingError
        One per displacement channel.

    Raises
    ------
    BadLog
        With reason ``no-delta-e`` without such a channel, ``too-short`` where the longest stretch
        has fewer harmonics than are to be kept, or as `select_segments` does.

    References
    ----------
    Piscalov2021
    """
    channels = [channel for channel in log.channels if channel.kind == "displacement"]
    if not channels:
        there = ", ".join(channel.name for channel in log.channels)
        raise BadLog(
            log.name, "no-delta-e", f"no usable delta_e channel; there: {there}; needed delta_e_um"
        )
    segments = select_segments(log, part)
    longest = max(segments, key=lambda segment: segment.stop - segment.start)
    n, needed = longest.stop - longest.start, 2 * count + 1
    if n < needed:
        raise BadLog(
            log.name,
            "too-short",
            f"the longest stretch has {n / log.sample_rate:.3g} s; {count} harmonics need "
            f"{needed / log.sample_rate:.3g} s: record longer or lower --count",
        )

    velocity = nominal_velocity(log)
    readings = []
    for channel in channels:
        lowest, highest, mean, std = _statistics(channel, segments)
        harmonics = decompose(channel.values[longest.start : longest.stop], log.sample_rate)
        readings.append(
            FollowingError(
                channel=channel.name,
                velocity=velocity,
                duration=sum(s.stop - s.start for s in segments) / log.sample_rate,
                lowest=lowest,
                highest=highest,
                std=std,
                mean=mean,
                harmonics=harmonics,
                kept=harmonics.strongest(count),
                floor=floor,
            )
        )
    return tuple(readings)


def loop_error(log: Log) -> float | None:
    """Measure the following error from 1 to 40 Hz: what the control loop leaves.

    It tells a retuned servo from wear. In this band the loop gain alone decides how much of a
    disturbance is left: a retuning moves it by tens of per cent or more, while wear shifts modes
    that stand above. Disturbances change with velocity, so that only logs of one velocity compare.

    Parameters
    ----------
    log : Log
        Stretches of constant velocity of two seconds or more are used, as for modes, each less
        its line.

    Returns
    -------
    float or None
        Root of the mean square in m, stretches weighted by their durations, several channels
        alike. None where no channel tells the following error, no stretch resolves 1 Hz, or the
        sample rate does not show 40 Hz.
    """
    low, high = _LOOP_BAND
    channels = [channel for channel in log.channels if channel.kind == "displacement"]
    segments = find_segments(log, _LOOP_PERIODS / low)
    if not channels or not segments or log.sample_rate <= 2 * high:
        return None
    weights = [s.stop - s.start for s in segments]
    squares = [
        np.average(
            [_mean_square(c.values[s.start : s.stop], log.sample_rate) for s in segments],
            weights=weights,
        )
        for c in channels
    ]
    return float(np.sqrt(np.mean(squares)))


def _mean_square(values: FloatArray, sample_rate: float) -> float:
    """Mean square of what a stretch holds in the loop's band.

    The window keeps drift below the band and lines above it from leaking in.
    """
    frequency, density = signal.periodogram(
        values, sample_rate, window="hann", detrend=signal.detrend, scaling="density"
    )
    inside = (frequency >= _LOOP_BAND[0]) & (frequency <= _LOOP_BAND[1])
    return float(density[inside].sum() * sample_rate / values.size)


def _statistics(channel: Channel, segments: Sequence[Segment]) -> tuple[float, float, float, float]:
    """Minimum, maximum, mean and standard deviation of all samples, one stretch at a time."""
    size, low, high, mean, var = np.array(
        [
            (x.size, x.min(), x.max(), x.mean(), x.var())
            for x in (channel.values[s.start : s.stop] for s in segments)
        ]
    ).T
    total = float(np.average(mean, weights=size))
    scatter = float(np.average(var + (mean - total) ** 2, weights=size))
    return float(low.min()), float(high.max()), total, float(np.sqrt(scatter))
