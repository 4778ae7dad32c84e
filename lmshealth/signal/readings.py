"""Direct readings of a record: its harmonics, the following error, levels of accelerations.

README.md, "Harmonics", "Following error" and "Levels".
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from scipy import fft

from lmshealth._private.arrays import FloatArray, ReadOnly, freeze
from lmshealth.errors import BadLog, BadQuestion
from lmshealth.io.buffers import blocks
from lmshealth.io.log import Channel, Log
from lmshealth.signal import constants
from lmshealth.signal.segments import (
    Part,
    Segment,
    distinct_velocities,
    find_segments,
    nominal_velocity,
    select_channels,
    select_phases,
    select_segments,
)
from lmshealth.stage.description import Stage

Indices = np.ndarray[tuple[int], np.dtype[np.intp]]


@dataclass(frozen=True, slots=True, eq=False)
class Harmonics:
    """A record as its mean and a sum of cosines, A cos(2πft + φ) with t from its first sample.

    Frequencies in Hz, ascending from 1 / duration (s), amplitudes in the record's unit and phases
    in rad have the shape ``(n_harmonics,)``; `size` is the number of samples.
    """

    mean: float
    frequency: FloatArray
    amplitude: FloatArray
    phase: FloatArray
    duration: float
    size: int

    def __post_init__(self) -> None:
        freeze(self, ("amplitude phase", *self.frequency.shape))

    @property
    def power(self) -> FloatArray:
        """Mean square of each harmonic; their sum is the variance (Parseval)."""
        power = self.amplitude**2 / 2
        if self.size % 2 == 0:
            # At half the sample rate a cosine of phase 0 or π is ± A at every sample.
            power[-1] *= 2
        return power

    def strongest(self, count: int) -> Indices:
        """Return the indices of the strongest harmonics, at most ``count``, strongest first."""
        return np.argsort(-self.amplitude, kind="stable")[:count]

    def between(self, low: float, high: float) -> slice:
        """Return the harmonics strictly between two frequencies in Hz."""
        first = np.searchsorted(self.frequency, low, side="right")
        return slice(int(first), int(np.searchsorted(self.frequency, high)))

    def span(self, kept: Indices) -> tuple[float, float]:
        """Return lowest and highest frequency in Hz of some harmonics, NaN without any."""
        own = self.frequency[kept]
        return (float(own.min()), float(own.max())) if own.size else (float("nan"), float("nan"))

    def share(self, kept: Indices) -> float:
        """Return the share of the variance in some harmonics."""
        power = self.power
        return float(power[kept].sum() / power.sum())


def decompose(values: FloatArray, sample_rate: float) -> Harmonics:
    """Decompose a gap-free record, at least two samples ``(n_samples,)``, into its harmonics."""
    n = values.size
    mean = float(values.mean())
    transform = fft.rfft(values - mean)[1:]
    amplitude: FloatArray = np.abs(transform) * (2 / n)
    if n % 2 == 0:
        amplitude[-1] /= 2
    return Harmonics(
        mean=mean,
        frequency=np.arange(1, n // 2 + 1, dtype=np.float64) * (sample_rate / n),
        amplitude=amplitude,
        phase=np.angle(transform),
        duration=n / sample_rate,
        size=n,
    )


# Following error


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
    motion phase, see `select_segments`. `BadQuestion` if the count is below 1. `BadLog`:
    ``too-short`` where the longest segment has fewer than ``count`` harmonics, or as
    `select_channels` and `select_segments` do.
    """
    if count < 1:
        raise BadQuestion(f"count = {count}: needed is at least 1 harmonic")
    channels = select_channels(log, "displacement")
    phases, segments = select_phases(log, part), select_segments(log, part)
    longest = max(segments, key=lambda segment: segment.stop - segment.start)
    n, needed = longest.stop - longest.start, 2 * count + 1
    if n < needed:
        found = f"the longest segment has {n / log.sample_rate:.3g} s"
        needs = f"{count} harmonics need {needed / log.sample_rate:.3g} s"
        raise BadLog(log.name, "too-short", f"{found}; {needs}: record longer or lower --count")
    velocity = nominal_velocity(log)
    duration = sum(s.stop - s.start for s in phases) / log.sample_rate
    readings = []
    for channel in channels:
        harmonics = decompose(channel.values[longest.start : longest.stop], log.sample_rate)
        kept, statistics = harmonics.strongest(count), _statistics(channel, phases)
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
    x = np.linspace(-1.0, 1.0, values.size)
    residual = values - np.polynomial.Polynomial.fit(x, values, 1)(x)
    # The window prevents leakage of drift below the band and of lines above it.
    window = np.hanning(values.size + 1)[:-1]
    power = 2 * np.abs(np.fft.rfft(residual * window)) ** 2 / np.sum(window**2)
    frequency = np.fft.rfftfreq(values.size, 1 / sample_rate)
    low, high = constants.LOOP_BAND
    return float(np.sum(power[(frequency >= low) & (frequency <= high)]) / values.size)


def _statistics(channel: Channel, segments: Sequence[Segment]) -> tuple[float, float, float, float]:
    """Return minimum, maximum, standard deviation and mean of all samples."""
    parts = (x for s in segments for _, x in blocks(channel.values, s.start, s.stop))
    moments = [(x.size, x.min(), x.max(), x.mean(), x.var()) for x in parts]
    size, low, high, mean, var = np.array(moments).T
    total = float(np.average(mean, weights=size))
    scatter = float(np.average(var + (mean - total) ** 2, weights=size))
    return float(low.min()), float(high.max()), float(np.sqrt(scatter)), total


# Levels of accelerations

BandKind = Literal["mode", "grid", "health", "watch"]


@dataclass(frozen=True, slots=True)
class FrequencyBand:
    """A frequency band with one level, its ends in Hz.

    The name is that of the mode or the band in Hz, the same in all logs; `placed_by` is the source
    of the frequency of a mode: ``identified`` in this log, or ``stage``.
    """

    name: str
    kind: BandKind
    low: float
    high: float
    placed_by: str = ""


@dataclass(frozen=True, slots=True)
class Magnitude:
    """Levels of one accelerometer of one log in a band."""

    log: str
    stage: str  # identity of the machine, empty where unknown
    velocity: float  # set velocity in m/s, NaN where unknown
    channel: str
    band: FrequencyBand
    # magnitude, frequency, resolution: amplitude in m/s² and frequency in Hz of the strongest
    # harmonic of the longest segment, and the spacing of its harmonics in Hz.
    magnitude: float
    frequency: float
    resolution: float
    # rms, dof: of all segments, in m/s², and the degrees of freedom of the mean square: two
    # per harmonic.
    rms: float
    dof: int

    @property
    def level(self) -> float:
        """Level in m/s² compared between velocities: magnitude, for wide bands the RMS."""
        return self.rms if self.band.kind in ("health", "watch") else self.magnitude


@dataclass(frozen=True, slots=True)
class Growth:
    """Regression of a level on velocity: ln level = constant + slope · ln velocity.

    The standard deviation of the slope is that of the residuals, and the p value, of no growth, is
    one-sided by Student's t; NaN with fewer than two velocities or three logs.
    """

    stage: str
    channel: str
    band: str
    n_logs: int
    n_velocities: int
    slope: float
    slope_std: float
    p_value: float

    @property
    def grows(self) -> bool | None:
        """Whether the slope is significantly positive; None where it is unknown."""
        return None if np.isnan(self.p_value) else self.p_value < constants.SIGNIFICANCE


def choose_bands(
    stage: Stage | None, found: Mapping[str, float] | None, span: tuple[float, float] | None
) -> tuple[FrequencyBand, ...]:
    """Choose the bands: modes and bands of the description, or a grid without one.

    Modes have the natural frequencies in Hz that were found in this log, by name, or else those of
    the description; the span in Hz is that of modes or grid frequencies. The order is modes or grid
    ascending in frequency, then health band, then watched bands. `BadQuestion` without any band.
    """
    bands = _bands(stage, found, span)
    if not bands:
        low, high = span or constants.LEVEL_BAND_RANGE
        raise BadQuestion(
            f"no mode, nor a multiple of {constants.LEVEL_BAND_SPACING:g} Hz without a description,"
            f" lies in {low:g} to {high:g} Hz: choose a wider band"
        )
    return bands


def _bands(
    stage: Stage | None, found: Mapping[str, float] | None, span: tuple[float, float] | None
) -> tuple[FrequencyBand, ...]:
    """Return the bands of `choose_bands`, which may be none."""
    if stage is None:
        step = constants.LEVEL_BAND_SPACING
        low, high = span or constants.LEVEL_BAND_RANGE
        grid = step * np.arange(max(1, np.ceil(low / step)), np.floor(high / step) + 1)
        return tuple(
            FrequencyBand(f"{f:g} Hz", "grid", f - step / 2, f + step / 2) for f in grid.tolist()
        )
    health = stage.description.health_band_hz
    wide: list[tuple[BandKind, float, float]] = [] if health is None else [("health", *health)]
    wide += [("watch", band.low_hz, band.high_hz) for band in stage.description.watch]
    return (
        *_mode_bands(stage, found or {}, span),
        *(FrequencyBand(f"{low:g}-{high:g} Hz", kind, low, high) for kind, low, high in wide),
    )


def _mode_bands(
    stage: Stage, found: Mapping[str, float], span: tuple[float, float] | None
) -> list[FrequencyBand]:
    """Return the bands of the modes; overlapping ones are split in the middle."""
    low, high = span or (0.0, np.inf)
    places = sorted(
        (found.get(mode.name, mode.frequency_hz), mode.damping_ratio, mode.name)
        for mode in stage.modes
        if low <= mode.frequency_hz <= high
    )
    middles = [(a + b) / 2 for (a, *_), (b, *_) in pairwise(places)]
    ends = pairwise([-np.inf, *middles, np.inf])
    bands = []
    for (f, damping, name), (least, most) in zip(places, ends, strict=False):
        below = max(f * (1 - constants.MODE_BAND_HALF_WIDTH * damping), least)
        above = min(f * (1 + constants.MODE_BAND_HALF_WIDTH * damping), most)
        source = "identified" if name in found else "stage"
        bands.append(FrequencyBand(name, "mode", below, above, source))
    return bands


def read_magnitudes(
    log: Log, bands: Iterable[FrequencyBand], *, part: Part = "record"
) -> tuple[Magnitude, ...]:
    """Measure the levels of every accelerometer of a log in every band [Piscalov2021].

    Bands above half the sample rate are omitted; `part` is a motion phase, see `select_segments`.
    The result is ordered channel by channel. `BadLog`: ``sample-rate`` where no band is below half
    of it, ``too-short`` where a band holds fewer than three harmonics, or as `select_channels` and
    `select_segments` do.
    """
    channels = select_channels(log, "acceleration")
    segments = select_segments(log, part)
    usable = _usable(log, bands, max(s.stop - s.start for s in segments))
    stage, velocity = log.metadata.stage or "", nominal_velocity(log)
    found: list[Magnitude] = []
    for channel in channels:
        read = zip(usable, _read(channel, log.sample_rate, segments, usable), strict=True)
        found += [Magnitude(log.name, stage, velocity, channel.name, band, *r) for band, r in read]
    return tuple(found)


def _usable(log: Log, bands: Iterable[FrequencyBand], longest: int) -> list[FrequencyBand]:
    asked = tuple(bands)
    usable = [band for band in asked if band.high < log.sample_rate / 2]
    if not usable:
        lowest = min(band.high for band in asked)
        found = f"a sample rate of {log.sample_rate:g} Hz covers none of the bands"
        raise BadLog(log.name, "sample-rate", f"{found}; needed is more than {2 * lowest:.4g} Hz")
    narrowest = min(band.high - band.low for band in usable)
    needed, seconds = constants.LEAST_ORDINATES / narrowest, longest / log.sample_rate
    if seconds < needed:
        needs = f"a band of {narrowest:.3g} Hz needs {needed:.3g} s"
        raise BadLog(log.name, "too-short", f"the longest segment has {seconds:.3g} s; {needs}")
    return usable


def _read(
    channel: Channel, sample_rate: float, segments: Sequence[Segment], bands: list[FrequencyBand]
) -> list[tuple[float, float, float, float, int]]:
    """Return the last five fields of `Magnitude` in all bands, the longest segment first."""
    ordered = sorted(segments, key=lambda s: s.start - s.stop)
    strongest: list[tuple[float, float, float]] = []
    total, seconds = np.zeros((2, len(bands)))
    dof = np.zeros(len(bands), dtype=int)
    for segment in ordered:
        if segment.stop - segment.start < 2:
            continue
        harmonics = decompose(channel.values[segment.start : segment.stop], sample_rate)
        inside = [harmonics.between(band.low, band.high) for band in bands]
        if not strongest:
            for own in inside:
                at = own.start + int(np.argmax(harmonics.amplitude[own]))
                peak = float(harmonics.amplitude[at]), float(harmonics.frequency[at])
                strongest.append((*peak, 1 / harmonics.duration))
        for i, own in enumerate(inside):
            # Segments too short for the band are omitted.
            if own.stop - own.start >= constants.LEAST_ORDINATES - 1:
                total[i] += harmonics.duration * float(harmonics.power[own].sum())
                seconds[i] += harmonics.duration
                dof[i] += 2 * (own.stop - own.start)
    rms = np.sqrt(total / seconds)
    return [(*best, r, n) for best, r, n in zip(strongest, rms.tolist(), dof.tolist(), strict=True)]


def find_growth(magnitudes: Iterable[Magnitude]) -> tuple[Growth, ...]:
    """Fit the growth of every machine, accelerometer and band over logs of known velocity."""
    groups: dict[tuple[str, str, str], list[tuple[float, float]]] = {}
    for m in magnitudes:
        points = groups.setdefault((m.stage, m.channel, m.band.name), [])
        if m.velocity > 0 and m.level > 0:
            points.append((float(np.log(m.velocity)), float(np.log(m.level))))
    return tuple(_growth(*key, points) for key, points in groups.items())


def _growth(stage: str, channel: str, band: str, points: list[tuple[float, float]]) -> Growth:
    from scipy.stats import linregress  # late: half a second

    x, y = np.array(points).reshape(-1, 2).T
    n_velocities = len(distinct_velocities(np.exp(x)))
    slope = std = p_value = float("nan")
    if n_velocities > 1:
        line = linregress(x, y, alternative="greater")
        slope = float(line.slope)
        if x.size > 2:
            std, p_value = float(line.stderr), float(line.pvalue)
    return Growth(stage, channel, band, x.size, n_velocities, slope, std, p_value)
