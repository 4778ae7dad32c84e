"""Following error: statistics and harmonics, and its RMS in the band of the control loop."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lmshealth._private.arrays import FloatArray, ReadOnly
from lmshealth.errors import BadLog
from lmshealth.io.log import Channel, Log
from lmshealth.signal import constants
from lmshealth.signal.harmonics import Harmonics, Indices, decompose
from lmshealth.signal.segments import (
    Part,
    Segment,
    find_segments,
    nominal_velocity,
    select_channels,
    select_segments,
)


@dataclass(frozen=True, slots=True, eq=False)
class FollowingError(ReadOnly):
    """Statistics and harmonics of one following-error channel of a log."""

    channel: str
    velocity: float  # set velocity in m/s; NaN where unknown or where the log has several
    # duration, lowest, highest, std, mean: total duration in s, and statistics of all samples
    # in m.
    duration: float
    lowest: float
    highest: float
    std: float
    mean: float
    harmonics: Harmonics  # of the longest gap-free segment, at most of a minute at 20 kHz
    kept: Indices  # indices of the strongest harmonics, strongest first, shape ``(n_kept,)``
    floor: float  # amplitude in m above which a harmonic is no noise

    @property
    def above(self) -> Indices:
        """Indices of the kept harmonics above the floor, strongest first."""
        return self.kept[self.harmonics.amplitude[self.kept] > self.floor]

    @property
    def max_magnitude(self) -> float:
        """Amplitude of the strongest harmonic in m."""
        return float(self.harmonics.amplitude[self.kept[0]])


def read_error(
    log: Log,
    *,
    count: int = constants.N_HARMONICS,
    floor: float = constants.ENCODER_FLOOR,
    part: Part = "record",
) -> tuple[FollowingError, ...]:
    """Analyse the following error of a log, one reading per displacement channel [Piscalov2021].

    The `count` strongest harmonics are kept; those up to the floor in m are noise. `part` is a
    motion phase, see `select_segments`. `BadLog`: ``too-short`` where the longest segment has fewer
    than ``count`` harmonics, or as `select_channels` and `select_segments` do.
    """
    channels = select_channels(log, "displacement")
    segments = select_segments(log, part)
    longest = max(segments, key=lambda segment: segment.stop - segment.start)
    n, needed = longest.stop - longest.start, 2 * count + 1
    if n < needed:
        found = f"the longest segment has {n / log.sample_rate:.3g} s"
        needs = f"{count} harmonics need {needed / log.sample_rate:.3g} s"
        raise BadLog(log.name, "too-short", f"{found}; {needs}: record longer or lower --count")
    velocity = nominal_velocity(log)
    duration = sum(s.stop - s.start for s in segments) / log.sample_rate
    readings = []
    for channel in channels:
        harmonics = decompose(channel.values[longest.start : longest.stop], log.sample_rate)
        kept, statistics = harmonics.strongest(count), _statistics(channel, segments)
        readings.append(
            FollowingError(channel.name, velocity, duration, *statistics, harmonics, kept, floor)
        )
    return tuple(readings)


def loop_error(log: Log) -> float | None:
    """Measure the RMS following error in m from 1 to 40 Hz, which depends on the servo tuning.

    Segments of constant velocity of two seconds or more are detrended and weighted by duration,
    channels equally. Disturbances depend on velocity: only logs of one velocity are comparable.
    None without a displacement channel, such a segment, or a sample rate above 80 Hz.
    """
    low, high = constants.LOOP_BAND
    channels = [channel for channel in log.channels if channel.kind == "displacement"]
    segments = find_segments(log, constants.LOOP_PERIODS / low)
    if not channels or not segments or log.sample_rate <= 2 * high:
        return None
    squares = [
        [_mean_square(c.values[s.start : s.stop], log.sample_rate) for s in segments]
        for c in channels
    ]
    mean = [np.average(own, weights=[s.stop - s.start for s in segments]) for own in squares]
    return float(np.sqrt(np.mean(mean)))


def _mean_square(values: FloatArray, sample_rate: float) -> float:
    """Return the mean square of a segment in the band of the loop."""
    from scipy.signal import detrend, periodogram  # late: it imports scipy.stats, half a second

    # The window prevents leakage of drift below the band and of lines above it.
    frequency, density = periodogram(values, sample_rate, "hann", detrend=detrend)
    low, high = constants.LOOP_BAND
    inside = (frequency >= low) & (frequency <= high)
    return float(np.sum(density[inside]) * sample_rate / values.size)


def _statistics(channel: Channel, segments: Sequence[Segment]) -> tuple[float, float, float, float]:
    """Return minimum, maximum, standard deviation and mean of all samples."""
    parts = (channel.values[s.start : s.stop] for s in segments)
    moments = [(x.size, x.min(), x.max(), x.mean(), x.var()) for x in parts]
    size, low, high, mean, var = np.array(moments).T
    total = float(np.average(mean, weights=size))
    scatter = float(np.average(var + (mean - total) ** 2, weights=size))
    return float(low.min()), float(high.max()), float(np.sqrt(scatter)), total
