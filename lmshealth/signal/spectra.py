"""From samples to FFT ordinates: periodograms and their expectation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import fft
from scipy.stats import gamma

from lmshealth._arrays import BoolArray, ComplexArray, FloatArray, freeze
from lmshealth.io.buffers import MINUTE
from lmshealth.io.log import Channel
from lmshealth.signal.segments import Segment
from lmshealth.signal.tone_removal import remove_sinusoids

# The second difference of a displacement reaches over this part of the shortest period.
_LAG_PERIODS = 8.0
# Set velocities closer than this are one.
_SAME_VELOCITY = 0.01
# From so many samples on a few at the end are given up for the sake of a fast transform.
_LONG = 1 << 14
# A resonance is no line if it is so many ordinates wide.
_TOLD_APART = 8.0
# Parts of a stretch that is cut have at least so many samples: only they are averaged.
_LEAST_PART = MINUTE // 2
# A line keeps its phase for about a thousand periods: so wide it is, as a share of its frequency.
WANDER = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Spectrum:
    """Periodogram of one channel as acceleration, over one segment or the mean over several.

    Attributes
    ----------
    frequency : ndarray
        Fourier frequencies in Hz, shape ``(n_ordinates,)``.
    periodogram : ndarray
        One-sided periodogram in (m/s²)²/Hz: for a stationary signal each ordinate over the power
        spectral density is the mean of ``count`` exponential variables, shape ``(n_ordinates,)``.
    duration : float
        Length of a segment in s.
    velocity : float
        Set velocity in m/s, NaN where unknown.
    count : int
        Number of segments of this length whose mean it is.
    """

    frequency: FloatArray
    periodogram: FloatArray
    duration: float
    velocity: float
    count: int = 1

    def __post_init__(self) -> None:
        if self.frequency.shape != self.periodogram.shape:
            raise ValueError("frequency and periodogram differ in shape")
        self.frequency.setflags(write=False)
        self.periodogram.setflags(write=False)

    @property
    def observed(self) -> float:
        """Time in s that all its segments last together."""
        return self.count * self.duration

    def band(self, low: float, high: float) -> Spectrum:
        """Cut out the ordinates from low to high Hz."""
        first, last = np.searchsorted(self.frequency, [low, high])
        cut = slice(int(first), int(last))
        return replace(self, frequency=self.frequency[cut], periodogram=self.periodogram[cut])

    def near(self, line: float) -> slice:
        """Ordinates that a line may reach: it wanders, and its foot is two ordinates wide."""
        return _near(self.frequency, self.duration, line)

    def clear_of(self, lines: Sequence[float]) -> BoolArray:
        """Tell which ordinates no line at one of these frequencies reaches."""
        clear = np.ones(self.frequency.size, dtype=bool)
        for line in lines:
            clear[self.near(line)] = False
        return clear

    def density(self, low: float, high: float) -> tuple[float, int]:
        """Mean ordinate from low to high Hz and its degrees of freedom, 2 count per ordinate."""
        cut = self.band(low, high).periodogram
        return float(cut.mean()) if cut.size else float("nan"), 2 * self.count * cut.size

    def sine(self, first: int, last: int) -> tuple[float, float]:
        """Frequency in Hz and amplitude of a sine within some ordinates: Σ I = A² T / 2."""
        ordinates = self.periodogram[first:last]
        amplitude = np.sqrt(2 * ordinates.sum() / self.duration)
        return float(self.frequency[first + int(np.argmax(ordinates))]), float(amplitude)


@dataclass(frozen=True, slots=True, eq=False)
class CrossSpectrum:
    """All channels as acceleration over one segment, or the mean over several of one length.

    Attributes
    ----------
    frequency : ndarray
        Fourier frequencies in Hz, shape ``(n_ordinates,)``.
    matrix : ndarray
        F F*, F the transforms of all channels scaled so that its diagonal holds their one-sided
        periodograms in (m/s²)²/Hz, shape ``(n_ordinates, n_channels, n_channels)``.
    duration : float
        Length of a segment in s.
    velocity : float
        Set velocity in m/s, NaN where unknown.
    free : ndarray of bool
        Ordinates at which no strong line stood, shape ``(n_ordinates,)``.
    lines : tuple of (int, float, float)
        Of each line that was taken out the index of its channel, frequency in Hz and amplitude in
        m/s².
    count : int
        Number of segments of this length whose mean it is.
    """

    frequency: FloatArray
    matrix: ComplexArray
    duration: float
    velocity: float
    free: BoolArray
    lines: tuple[tuple[int, float, float], ...] = ()
    count: int = 1

    def __post_init__(self) -> None:
        if self.matrix.shape[:1] != self.frequency.shape:
            raise ValueError("frequency and matrix differ in length")
        freeze(self)

    @property
    def observed(self) -> float:
        """Time in s that all its segments last together."""
        return self.count * self.duration

    def band(self, low: float, high: float) -> CrossSpectrum:
        """Cut out the ordinates from low to high Hz."""
        first, last = np.searchsorted(self.frequency, [low, high])
        cut = slice(int(first), int(last))
        return replace(
            self,
            frequency=self.frequency[cut],
            matrix=self.matrix[cut],
            free=self.free[cut],
            lines=tuple(line for line in self.lines if low <= line[1] < high),
        )

    def without(self, lines: Sequence[float]) -> CrossSpectrum:
        """Give up the ordinates that lines at these frequencies in Hz may reach."""
        free = self.free.copy()
        for line in lines:
            free[_near(self.frequency, self.duration, line)] = False
        return replace(self, free=free)

    def channel(self, index: int) -> Spectrum:
        """Give the spectrum of one channel."""
        own = self.matrix[:, index, index].real.copy()
        return Spectrum(self.frequency, own, self.duration, self.velocity, self.count)


def _near(frequency: FloatArray, duration: float, line: float) -> slice:
    half = max(WANDER * line, 2 / duration)
    first, last = np.searchsorted(frequency, [line - half, line + half])
    return slice(int(first), int(last))


def median_ordinate(count: int) -> float:
    """Median of the mean of so many exponential variables."""
    return float(gamma.ppf(0.5, count)) / count


class ResonanceRange(NamedTuple):
    """Where resonances may stand, in Hz, and the least damping ratio that they may have."""

    low: float
    high: float
    damping_ratio: float

    def like_lines(self, frequency: FloatArray, duration: float) -> BoolArray:
        """Tell at which frequencies a segment does not tell them from lines."""
        width = 2 * self.damping_ratio * frequency * duration
        within = (frequency >= self.low) & (frequency <= self.high)
        return np.asarray(within & (width < _TOLD_APART))


ANY_RESONANCE = (ResonanceRange(0.0, np.inf, 0.005),)


def cross_spectra(
    channels: Sequence[Channel],
    segments: Sequence[Segment],
    sample_rate: float,
    top: float,
    *,
    ceiling: float = np.inf,
    resonances: Sequence[ResonanceRange] = ANY_RESONANCE,
) -> tuple[CrossSpectrum, ...]:
    """Transform all channels segment by segment, and average the parts of long stretches.

    Parts of one length and one set velocity have the same expectation, and the likelihood needs
    no more of them than their mean. Short moves stay apart: a line that differs between them is
    then masked in each where it stands.

    Parameters
    ----------
    channels : sequence of Channel
        Displacements or accelerations.
    segments : sequence of Segment
        Which samples.
    sample_rate : float
        In Hz.
    top, ceiling : float
        In Hz, as in `periodogram`.
    resonances : sequence of Resonances
        Where resonances may stand: in a segment too short to tell them from lines nothing is
        taken out there.

    Returns
    -------
    tuple of CrossSpectrum
        Each at the place of its first segment.
    """
    return tuple(
        _mean(
            _cross_spectrum(channels, part, sample_rate, (top, ceiling), resonances)
            for part in group
        )
        for group in _exchangeable(segments)
    )


def _cross_spectrum(
    channels: Sequence[Channel],
    segment: Segment,
    sample_rate: float,
    reach: tuple[float, float],
    resonances: Sequence[ResonanceRange],
) -> CrossSpectrum:
    top, ceiling = reach
    parts = [as_acceleration(channel, segment, sample_rate, top) for channel in channels]
    # A second difference has no values at the ends: there the others are cut, too.
    short = max(lag for _, lag in parts)
    n = segment.stop - segment.start - 2 * short
    if n > _LONG:
        # A length with a large prime factor costs ten times as much; that less is never 1 %.
        n = fft.prev_fast_len(n)
    if short:
        ceiling = min(ceiling, 4 * top)
    frequency = _frequencies(n, sample_rate, ceiling)
    transforms = np.empty((frequency.size, len(channels)), dtype=complex)
    for c, (x, lag) in enumerate(parts):
        x = x[short - lag : n + short - lag]
        transforms[:, c] = _transform(x, lag, frequency, sample_rate)
    spared = np.any([r.like_lines(frequency, n / sample_rate) for r in resonances], axis=0)
    transforms, free, tones = remove_sinusoids(transforms, n / sample_rate, spared)
    step = sample_rate / n
    lines = tuple(
        # Σ I = A² T / 2 over the ordinates of a sine.
        (tone.channel, (tone.ordinate + 1) * step, float(np.sqrt(2 * tone.power * step)))
        for tone in tones
    )
    matrix = transforms[:, :, None] * transforms[:, None].conj()
    return CrossSpectrum(frequency, matrix, n / sample_rate, segment.velocity, free, lines)


def _frequencies(n: int, sample_rate: float, ceiling: float) -> FloatArray:
    """Fourier frequencies in Hz from the first to just below Nyquist or the ceiling."""
    frequency = np.arange(1, (n - 1) // 2 + 1, dtype=np.float64) * (sample_rate / n)
    # A copy: a view would keep what it is cut from.
    return frequency[: np.searchsorted(frequency, ceiling)].copy()


def _exchangeable(segments: Sequence[Segment]) -> list[list[Segment]]:
    """Group long segments of one length and one set velocity, whatever its direction."""
    groups: list[list[Segment]] = []
    long: list[list[Segment]] = []
    for segment in segments:
        if segment.stop - segment.start < _LEAST_PART:
            groups.append([segment])
            continue
        group = next((group for group in long if _same(group[0], segment)), None)
        if group is None:
            groups.append([segment])
            long.append(groups[-1])
        else:
            group.append(segment)
    return groups


def _same(one: Segment, other: Segment) -> bool:
    speed, another = abs(one.velocity), abs(other.velocity)
    alike = np.isclose(speed, another, rtol=_SAME_VELOCITY, atol=0.0, equal_nan=True)
    return one.stop - one.start == other.stop - other.start and bool(alike)


def _mean(spectra: Iterator[CrossSpectrum]) -> CrossSpectrum:
    first = next(spectra)
    total, free, lines, count = first.matrix, first.free, first.lines, 1
    for spectrum in spectra:
        total, count = total + spectrum.matrix, count + 1
        free, lines = free & spectrum.free, (*lines, *spectrum.lines)
    return replace(first, matrix=total / count, free=free, lines=lines, count=count)


def periodogram(
    channel: Channel,
    segment: Segment,
    sample_rate: float,
    top: float = np.inf,
    *,
    ceiling: float = np.inf,
) -> Spectrum:
    """Compute the one-sided periodogram of a channel as acceleration.

    Mean and straight trend are taken out first, so that they do not leak into the band. With them
    goes the share 3/(πk)² of white noise, and up to 6/(πk)² of the amplitude of a sine, at the
    k-th ordinate: below 10⁻⁶ from the 780th on.

    A displacement is differenced twice before the transform rather than multiplied by ω² after
    it: differencing first keeps its large slow part from leaking into the band of the modes. The
    difference reaches over as many samples as the top of the band allows, because between
    neighbouring samples it would raise the fast noise so far that this leaks instead.

    Parameters
    ----------
    channel : Channel
        Displacement or acceleration.
    segment : Segment
        Which samples.
    sample_rate : float
        In Hz.
    top : float
        Highest frequency of interest in Hz; of a displacement nothing is given far above it.
        By default all are, at the price of that leakage.
    ceiling : float
        Ordinates from here on are left out, in Hz.

    Returns
    -------
    Spectrum
        From the first Fourier frequency up to just below Nyquist or the ceiling, for a
        displacement up to four times ``top`` if that is lower.
    """
    x, lag = as_acceleration(channel, segment, sample_rate, top)
    if lag:
        ceiling = min(ceiling, 4 * top)
    frequency = _frequencies(x.size, sample_rate, ceiling)
    transform = _transform(x, lag, frequency, sample_rate)
    power = transform.real**2 + transform.imag**2
    return Spectrum(frequency, power, x.size / sample_rate, segment.velocity)


def _transform(x: FloatArray, lag: int, frequency: FloatArray, sample_rate: float) -> ComplexArray:
    """Transform what `as_acceleration` gives; the squared magnitude is the periodogram."""
    transform: ComplexArray = fft.rfft(_without_trend(x))[1 : frequency.size + 1]
    transform *= np.sqrt(2 / (x.size * sample_rate))
    if lag:
        transform *= lag_gain(frequency, lag, sample_rate)
    return transform


def _without_trend(x: FloatArray) -> FloatArray:
    ramp = np.arange(x.size, dtype=np.float64)
    ramp -= (x.size - 1) / 2
    slope = ramp @ x / (ramp @ ramp)
    rest: FloatArray = x - x.mean()
    ramp *= slope
    rest -= ramp
    return rest


def as_acceleration(
    channel: Channel, segment: Segment, sample_rate: float, top: float
) -> tuple[FloatArray, int]:
    """Cut out a segment; of a displacement take the second difference.

    Returns
    -------
    values : ndarray
        In m/s² but for `lag_gain`, shape ``(n,)``.
    lag : int
        Samples that the difference reaches over; 0 for an acceleration.
    """
    x = channel.values[segment.start : segment.stop]
    if channel.kind != "displacement":
        return x, 0
    lag = max(1, int(sample_rate / (_LAG_PERIODS * top)))
    # In place: of a long segment each intermediate array would be as large as a minute of samples.
    difference: FloatArray = x[2 * lag :] + x[: -2 * lag]
    difference -= x[lag:-lag]
    difference -= x[lag:-lag]
    difference *= sample_rate**2
    return difference, lag


def lag_gain(frequency: FloatArray, lag: int, sample_rate: float) -> FloatArray:
    """Amplitude of the second derivative over that of the second difference over L samples.

    The latter has gain (2 fs sin(ωL/2fs))², the former ω²; the difference vanishes at fs/L, eight
    times the top of its band.
    """
    half = np.pi * frequency / sample_rate
    return np.asarray((half / np.abs(np.sin(lag * half)).clip(1e-6)) ** 2)
