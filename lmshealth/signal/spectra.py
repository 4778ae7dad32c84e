"""Periodograms and cross spectra of segments, as acceleration, without strong tones.

README.md, "Spectra".
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import minimum_filter1d
from scipy.special import gammaincinv, spherical_jn

from lmshealth._private.arrays import BoolArray, ComplexArray, FloatArray, freeze
from lmshealth.io.buffers import MINUTE
from lmshealth.io.log import Channel
from lmshealth.signal import constants
from lmshealth.signal.segments import Segment

# Distances in ordinates of the surroundings whose median a peak is compared with.
_SURROUNDINGS = (3, 4, 5, 6, 7, 8)
# Numbers of Legendre polynomials of the varying amplitude. The fewest are used whose residual
# around the sinusoid is at most _FIT_RATIO times that of the most. Amplitude and phase of a line
# vary over seconds, those of a mode faster: _TERMS_PER_SECOND describe the line only.
_TERMS, _FIT_RATIO, _TERMS_PER_SECOND = (4, 8, 12, 16, 24), 1.5, 0.6
# Half-width of the fit, and distances of the near and far surroundings, in ordinates.
_REACH, _NEAR, _FAR = 400, 10, 40
_MOST_SINUSOIDS, _MOST_ROUNDS = 30, 4
# Sinusoids fitted together, strongest first; peaks this close to a stronger one belong to it.
_TOGETHER, _PEAK_WIDTH = 6, 4
# Skirt of a sinusoid relative to the level below which it is not subtracted.
_SKIRT = 0.05


class Sinusoid(NamedTuple):
    """A removed sinusoid: the channel that shows it most clearly, and its fractional ordinate.

    ``power`` is its one-sided periodogram summed over ordinates.
    """

    channel: int
    ordinate: float
    power: float


def remove_sinusoids(
    transforms: ComplexArray, duration: float, protected: BoolArray
) -> tuple[ComplexArray, BoolArray, tuple[Sinusoid, ...]]:
    """Remove the strong sinusoids of a segment from its transforms.

    Transforms are of all channels at consecutive Fourier frequencies, ``(n_ordinates,
    n_channels)``; the duration of the segment is in s; ``protected`` are ordinates of possible
    resonances as narrow as a sinusoid, ``(n_ordinates,)``. The result is the transforms without
    sinusoids (at their ordinates noise is removed as well), the ordinates without a sinusoid,
    ``(n_ordinates,)``, and the sinusoids.
    """
    free = np.ones(len(transforms), dtype=bool)
    if len(transforms) < 3 * _FAR:
        return transforms, free, ()
    # Time counted from the middle of the segment changes the sign of every other ordinate.
    sign = np.where(np.arange(len(transforms)) % 2, -1.0, 1.0)[:, None]
    rest = transforms * sign
    choice = tuple(k for k in _TERMS if k <= max(_TERMS[0], _TERMS_PER_SECOND * duration))
    removed: list[Sinusoid] = []
    for _ in range(_MOST_ROUNDS):
        peaks = [k for k in _peaks(_filled(rest, free)) if free[k] and not protected[k]]
        found = _remove(rest, free, peaks, choice)
        removed += found
        if not found:
            break
    return rest * sign, free, tuple(removed)


def _remove(
    rest: ComplexArray, free: BoolArray, peaks: list[int], choice: tuple[int, ...]
) -> list[Sinusoid]:
    """Remove the peaks that are sinusoids from ``rest`` and ``free``, in place."""
    removed = []
    for at in peaks:
        near = slice(max(0, at - _REACH), min(at + _REACH + 1, len(rest)))
        # Others within reach are fitted, too.
        others = [k for k in peaks if k != at and near.start <= k < near.stop and free[k]]
        places = np.array([_peak_ordinate(rest, k) for k in (at, *others[: _TOGETHER - 1])])
        found = _fit(rest[near], places - near.start, choice)
        if found is None:
            continue
        size, fitted, level = found
        terms = len(size)
        # Of sinusoids too close to each other, as of a comb, one may exceed the sum of all.
        if _residual_power(rest[near] - fitted, level) > _residual_power(rest[near], level):
            continue
        power = np.sum(np.abs(fitted) ** 2, axis=0)
        channel = int(np.argmax(power / level))
        # Less the expected power of the noise.
        own = max(0.0, float(power[channel] - terms * level[channel]))
        removed.append(Sinusoid(channel, float(places[0]), own))
        # Its skirt falls with the square of the distance.
        reach = max(_REACH, int(np.sqrt(np.max(power / level) / _SKIRT) / np.pi))
        if reach > _REACH:
            near = slice(max(0, at - reach), min(at + reach + 1, len(rest)))
            fitted = _basis(near, places[0], terms) @ size
        rest[near] -= fitted
        width = _half_width(terms)
        free[max(0, at - width) : at + width + 1] = False
    return removed


def _filled(rest: ComplexArray, free: BoolArray) -> FloatArray:
    """Return the power, replaced by that of the surroundings where a sinusoid was removed."""
    power = rest.real**2 + rest.imag**2
    edges = np.flatnonzero(np.diff(np.concatenate([[1], free, [1]])))
    for first, last in edges.reshape(-1, 2).tolist():
        around = np.r_[max(0, first - _NEAR) : first, last : last + _NEAR]
        power[first:last] = np.median(power[around[around < len(power)]], axis=0)
    return power


def _peaks(power: FloatArray) -> list[int]:
    """List the ordinates far above their surroundings, of neighbours the highest."""
    contrast = _contrast(power).max(axis=1)
    suspects = np.flatnonzero(contrast > constants.SINUSOID_CONTRAST)
    peaks: list[int] = []
    for at in suspects[np.argsort(-power[suspects].max(axis=1), kind="stable")].tolist():
        if all(abs(at - peak) > _PEAK_WIDTH for peak in peaks):
            peaks.append(at)
    return peaks[:_MOST_SINUSOIDS]


def _peak_ordinate(rest: ComplexArray, at: int) -> float:
    """Interpolate the ordinate of a sinusoid from three transforms."""
    # At δ above its highest ordinate they are proportional to 1/δ, 1/(1 - δ) and -1/(1 + δ).
    below, own, above = rest[[max(0, at - 1), at, min(at + 1, len(rest) - 1)]]
    channel = int(np.argmax(np.abs(own)))
    ratio = float(((above - below)[channel] / own[channel]).real)
    return at + ratio / (1 + float(np.hypot(1, ratio)))


def _contrast(power: FloatArray) -> FloatArray:
    """Return the ratio of each ordinate to the median of its surroundings, if that is large."""
    # The minimum, which is cheaper, bounds the median from below: few ordinates need the median.
    n, first, last = len(power), _SURROUNDINGS[0], _SURROUNDINGS[-1]
    width = last - first + 1
    least = minimum_filter1d(power, width, axis=0)
    centre = first + width // 2
    place = np.arange(n)
    below, above = np.maximum(place - centre, 0), np.minimum(place + centre, n - 1)
    contrast = power / np.minimum(least[below], least[above]).clip(1e-300)
    at, channel = np.nonzero(contrast > constants.SINUSOID_CONTRAST)
    around = np.abs(at[:, None] + np.array([k for b in _SURROUNDINGS for k in (-b, b)]))
    around = np.where(around < n, around, 2 * (n - 1) - around)
    level = np.median(power[around, channel[:, None]], axis=1)
    contrast[at, channel] = power[at, channel] / level.clip(1e-300)
    return np.asarray(contrast)


def _fit(
    rest: ComplexArray, places: FloatArray, choice: tuple[int, ...]
) -> tuple[ComplexArray, ComplexArray, FloatArray] | None:
    """Fit several sinusoids by the fewest polynomials of a choice that suffice."""
    # Coefficients of the first one, ``(n_terms, n_channels)``, its part of ``rest``, and
    # power of its surroundings, ``(n_channels,)``; None where no polynomial explains it.
    apart = np.abs(np.arange(len(rest)) - places[:, None])
    widest = _half_width(choice[-1])
    # Around the other sinusoids the noise is fitted, too.
    alone = (apart[1:] > widest).all(axis=0)

    def left(after: ComplexArray, inner: int, outer: int) -> FloatArray:
        there = alone & (apart[0] > inner) & (apart[0] <= outer)
        if not there.any():
            return np.full(rest.shape[1], np.nan)
        # A channel may be without a signal in this segment.
        return np.asarray(np.median(np.abs(after[there]) ** 2, axis=0) / np.log(2)).clip(1e-300)

    bases = [_basis(slice(0, len(rest)), place, choice[-1]) for place in places]

    real = np.ascontiguousarray(rest).view(np.float64)

    def fit(terms: int) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        basis = np.hstack([one[:, :terms] for one in bases])
        size = np.linalg.lstsq(basis, real, rcond=None)[0]
        after = np.ascontiguousarray(real - basis @ size).view(np.complex128)
        first = np.ascontiguousarray(size[:terms]).view(np.complex128)
        return first, np.asarray(bases[0][:, :terms] @ first), after

    most, own, after = fit(choice[-1])
    level = left(after, widest, widest + _NEAR)
    far = left(after, widest + _NEAR, widest + _FAR)
    channel = int(np.argmax(np.sum(np.abs(most) ** 2, axis=0) / level))
    if not level[channel] <= constants.SINUSOID_RESIDUAL * far[channel]:
        return None
    for terms in choice[:-1]:
        fewer, part, after = fit(terms)
        width = _half_width(terms)
        if (left(after, width, width + _NEAR) <= _FIT_RATIO * level).all():
            return fewer, part, level
    return most, own, level


def _residual_power(rest: ComplexArray, level: FloatArray) -> float:
    return float(np.sum(np.abs(rest) ** 2 / level))


def _half_width(terms: int) -> int:
    return terms // 2 + 1


def _basis(ordinates: slice, place: float, terms: int) -> FloatArray:
    """Return the transforms of the Legendre polynomials, ``(n_ordinates, n_terms)``."""
    off = np.arange(ordinates.start, ordinates.stop) - place
    basis = spherical_jn(np.arange(terms), np.pi * np.abs(off)[:, None])
    basis[:, 1::2] *= np.sign(off)[:, None]
    return np.asarray(basis)


# Spectra

# Shortest period over the lag of the second difference of a displacement.
_LAG_PERIODS = 8.0
# Samples that fit into the processor's cache. Longer segments lose a few at their end for a fast
# transform.
_LONG = 1 << 14
# Only segments of at least this many samples are averaged: the parts of a long segment.
_LEAST_PART = MINUTE // 2


@dataclass(frozen=True, eq=False)
class CrossSpectrum:
    """Transforms of all channels as acceleration over one segment, or several of one length.

    Matrices of many channels are formed where they are needed, for a band or some directions.
    """

    frequency: FloatArray  # Fourier frequencies in Hz, shape ``(n_ordinates,)``
    # F of each segment in (m/s²)/Hz^½, ``(count, n_ordinates, n_channels)``
    transforms: ComplexArray
    duration: float  # of a segment in s
    velocity: float  # set velocity in m/s, NaN where unknown
    free: BoolArray  # ordinates without a removed or masked line, shape ``(n_ordinates,)``
    # Index of the channel, frequency in Hz and amplitude in m/s² of each removed sinusoid.
    lines: tuple[tuple[int, float, float], ...] = ()
    # Columns G of the expectation G G* of what no mode causes, (n_ordinates, n_channels, n)
    foreign: ComplexArray | None = None

    def __post_init__(self) -> None:
        n = self.transforms.shape
        freeze(self, ("transforms", n[0], self.frequency.size, n[2]))

    @cached_property
    def matrix(self) -> ComplexArray:
        """F F*, its mean over the segments, ``(n_ordinates, n_channels, n_channels)``.

        Its diagonal holds the one-sided periodograms in (m/s²)²/Hz: the power spectral density
        times the mean of ``count`` exponential variables.
        """
        rows = np.moveaxis(self.transforms, 0, -1)
        matrix = np.asarray(rows @ np.swapaxes(rows.conj(), 1, 2) / self.count)
        matrix.flags.writeable = False
        return matrix

    @property
    def count(self) -> int:
        """Number of averaged segments."""
        return len(self.transforms)

    @property
    def observed(self) -> float:
        """Total duration of its segments in s."""
        return self.count * self.duration

    def band(self, low: float, high: float) -> Self:
        """Return the ordinates from low to high Hz."""
        first, last = np.searchsorted(self.frequency, [low, high])
        cut = slice(int(first), int(last))
        return replace(
            self,
            frequency=self.frequency[cut],
            transforms=self.transforms[:, cut],
            free=self.free[cut],
            lines=tuple(line for line in self.lines if low <= line[1] < high),
            foreign=None if self.foreign is None else self.foreign[cut],
        )

    def project(self, basis: FloatArray) -> Self:
        """Return the spectrum of other signals, basisᵀ x of the channels x."""
        foreign = None if self.foreign is None else basis.T @ self.foreign
        return replace(self, transforms=self.transforms @ basis, lines=(), foreign=foreign)

    def sums(self, parts: Sequence[NDArray[np.intp]]) -> ComplexArray:
        """Sum F F* over parts of the ordinates and the segments, ``(n_parts, n, n)``."""
        n = self.transforms.shape[2]
        rows = (self.transforms[:, part].reshape(-1, n) for part in parts)
        return np.array([row.T @ row.conj() for row in rows]).reshape(-1, n, n)

    def without(self, lines: Sequence[float]) -> Self:
        """Mask lines at these frequencies in Hz: their width, at least two ordinates to a side."""
        free = self.free.copy()
        for line in lines:
            half = max(constants.LINE_WIDTH * line, 2 / self.duration)
            first, last = np.searchsorted(self.frequency, [line - half, line + half])
            free[first:last] = False
        return replace(self, free=free)

    def without_band(self, low: float, high: float) -> Self:
        """Mask the ordinates from low to high Hz."""
        return replace(self, free=self.free & ((self.frequency < low) | (self.frequency > high)))

    def with_foreign(self, expected: Callable[[FloatArray], ComplexArray]) -> Self:
        """Add columns of an expectation, a function of frequency in Hz, to those of ``foreign``."""
        there = [] if self.foreign is None else [self.foreign]
        return replace(self, foreign=np.concatenate([*there, expected(self.frequency)], axis=2))

    def powers(self) -> FloatArray:
        """Return the periodograms of all channels, shape ``(n_ordinates, n_channels)``."""
        return np.asarray(np.mean(np.abs(self.transforms) ** 2, axis=0))


@dataclass(frozen=True, slots=True, eq=False)
class LogSpectra:
    """Cross spectra of the segments of a log, or means over several.

    `sources` are ``acc`` or ``delta_e`` of each channel.
    """

    channels: tuple[str, ...]
    sources: tuple[str, ...]
    spectra: tuple[CrossSpectrum, ...]

    @property
    def source(self) -> str:
        """Source of all channels, or ``joint``."""
        return self.sources[0] if len(set(self.sources)) == 1 else "joint"

    @property
    def duration(self) -> float:
        """Duration of the longest segment in s."""
        return self.longest.duration

    @property
    def longest(self) -> CrossSpectrum:
        """The spectrum with the longest segments."""
        return max(self.spectra, key=lambda spectrum: spectrum.duration)

    @property
    def removed_lines(self) -> list[tuple[str, float, float]]:
        """Channel, frequency in Hz and amplitude in m/s² of lines subtracted from the samples."""
        return [(self.channels[c], f, a) for s in self.spectra for c, f, a in s.lines]

    def each(self, change: Callable[[CrossSpectrum], CrossSpectrum]) -> Self:
        """Return the spectra after a change of each of them."""
        return replace(self, spectra=tuple(map(change, self.spectra)))

    def select(self, kept: Sequence[int]) -> Self:
        """Return some of the channels."""
        if [*kept] == [*range(len(self.channels))]:  # a copy would be as large as the log
            return self
        spectra = tuple(
            replace(
                s,
                transforms=s.transforms[:, :, kept],
                lines=tuple((kept.index(c), f, a) for c, f, a in s.lines if c in kept),
                foreign=None if s.foreign is None else s.foreign[:, kept],
            )
            for s in self.spectra
        )
        channels, sources = (tuple(x[c] for c in kept) for x in (self.channels, self.sources))
        return replace(self, channels=channels, sources=sources, spectra=spectra)


def median_ordinate(count: int) -> float:
    """Return the median of the mean of ``count`` exponential variables of mean 1."""
    return float(gammaincinv(count, 0.5)) / count


class ResonanceRange(NamedTuple):
    """Range of possible resonances in Hz, and their least damping ratio."""

    low: float
    high: float
    damping_ratio: float

    def unresolved(self, frequency: FloatArray, duration: float) -> BoolArray:
        """Return the frequencies at which a segment cannot distinguish them from sinusoids."""
        width = 2 * self.damping_ratio * frequency * duration
        within = (frequency >= self.low) & (frequency <= self.high)
        return np.asarray(within & (width < constants.DISTINCT_WIDTH))


ANY_RESONANCE = (ResonanceRange(0.0, np.inf, constants.LEAST_EXPECTED_DAMPING),)


def cross_spectra(
    channels: Sequence[Channel],
    segments: Sequence[Segment],
    sample_rate: float,
    top: float,
    *,
    ceiling: float = np.inf,
    resonances: Sequence[ResonanceRange] = ANY_RESONANCE,
) -> tuple[CrossSpectrum, ...]:
    """Transform all channels segment by segment, and average the parts of long segments.

    Parts of one length and set velocity have the same expectation: their mean is a sufficient
    statistic. Short moves stay separate, so that a line is masked in each at its own frequency.

    Channels are displacements or accelerations; sample rate, top and ceiling are in Hz, as in
    `transform_segment`. Where a segment does not resolve possible resonances no sinusoid is
    removed. Segments that have no ordinate, as of a log that ends right after a stop, are omitted.
    """
    lag = _lag(sample_rate, top) if any(c.kind == "displacement" for c in channels) else 0
    segments = [s for s in segments if s.stop - s.start > 2 * lag + 2]
    options: dict[str, Any] = {"ceiling": ceiling, "resonances": resonances}
    transform = partial(transform_segment, channels, sample_rate=sample_rate, top=top, **options)
    return tuple(_mean(map(transform, group)) for group in _exchangeable(segments))


def transform_segment(
    channels: Sequence[Channel],
    segment: Segment,
    sample_rate: float,
    top: float,
    *,
    ceiling: float = np.inf,
    resonances: Sequence[ResonanceRange] = ANY_RESONANCE,
) -> CrossSpectrum:
    """Transform one segment of all channels as acceleration; arguments as in `cross_spectra`.

    Mean and linear trend are removed. Of a displacement the second difference is transformed,
    over a lag that the top of the band permits, so that neither its large slow part nor its
    amplified fast noise leaks into the band. Ordinates reach from the first Fourier frequency to
    below Nyquist, the ceiling, and with a displacement four times ``top``, all in Hz.
    """
    parts = [as_acceleration(channel, segment, sample_rate, top) for channel in channels]
    # A second difference has no values at the ends; the other channels are cut there, too.
    short = max(lag for _, lag in parts)
    n = segment.stop - segment.start - 2 * short
    if n > _LONG:
        # A length with a large prime factor takes ten times as long; the loss is below 1 %.
        n = fft.prev_fast_len(n)
    if short:
        ceiling = min(ceiling, 4 * top)
    # From the first to below Nyquist or the ceiling.
    frequency = np.arange(1, (n - 1) // 2 + 1, dtype=np.float64) * (sample_rate / n)
    frequency = frequency[frequency < ceiling]
    transforms = np.empty((frequency.size, len(channels)), dtype=complex)
    for c, (x, lag) in enumerate(parts):
        transforms[:, c] = transform_detrended(x[short - lag : n + short - lag], frequency.size)
        if lag:
            transforms[:, c] *= lag_gain(frequency, lag, sample_rate)
    transforms *= np.sqrt(2 / (n * sample_rate))
    duration = n / sample_rate
    protected = np.any([r.unresolved(frequency, duration) for r in resonances], axis=0)
    rest, free, sinusoids = remove_sinusoids(transforms, duration, protected)
    lines = tuple(
        # Σ I = A² T / 2 over the ordinates of a sine.
        (one.channel, (one.ordinate + 1) / duration, float(np.sqrt(2 * one.power / duration)))
        for one in sinusoids
    )
    return CrossSpectrum(frequency, rest[None], duration, segment.velocity, free, lines)


def _exchangeable(segments: Sequence[Segment]) -> list[list[Segment]]:
    """Group long segments of one length and one set speed."""
    groups: list[list[Segment]] = []
    for segment in segments:
        size, speed = segment.stop - segment.start, abs(segment.velocity)
        for group in groups if size >= _LEAST_PART else ():
            first = group[0]
            speeds = abs(first.velocity), speed
            alike = np.isclose(*speeds, rtol=constants.SAME_VELOCITY, atol=0.0, equal_nan=True)
            if first.stop - first.start == size and alike:
                group.append(segment)
                break
        else:
            groups.append([segment])
    return groups


def _mean(spectra: Iterator[CrossSpectrum]) -> CrossSpectrum:
    every = list(spectra)
    return replace(
        every[0],
        transforms=np.concatenate([one.transforms for one in every]),
        free=np.all([one.free for one in every], axis=0),
        lines=tuple(line for one in every for line in one.lines),
    )


def transform_detrended(x: FloatArray, n_ordinates: int) -> ComplexArray:
    """Transform samples without their mean and linear trend: the first ordinates, but the zeroth.

    Of a long segment the transforms of every m-th sample, which fit into the processor's cache, are
    combined by Horner's rule.
    """
    n, centre = x.size, (x.size - 1) / 2
    turn = np.exp(-2j * np.pi / n * np.arange(1, n_ordinates + 1))
    most = max(1, n // max(_LONG, 2 * n_ordinates))
    m = max(m for m in range(1, most + 1) if n % m == 0)
    x = x - x[0]  # a channel without a signal has a transform of exactly zero
    parts = fft.rfft(x.reshape(-1, m), axis=0)[1 : n_ordinates + 1]
    transform: ComplexArray = parts[:, -1]
    for k in range(m - 2, -1, -1):
        transform = transform * turn + parts[:, k]
    blocks = ((first, x[first : first + _LONG]) for first in range(0, n, _LONG))
    moment = sum(float((np.arange(own.size) + (first - centre)) @ own) for first, own in blocks)
    # Σ k exp(-iθk) = n / (exp(-iθ) - 1)
    transform = transform - moment / ((n**2 - 1) / 12) / (turn - 1)
    return transform


def as_acceleration(
    channel: Channel, segment: Segment, sample_rate: float, top: float
) -> tuple[FloatArray, int]:
    """Return a segment of a channel, or of a displacement its second difference; and its lag.

    The values, ``(n,)``, are in m/s² up to `lag_gain`; the lag in samples is 0 for an acceleration.
    """
    x = channel.values[segment.start : segment.stop]
    if channel.kind != "displacement":
        return x, 0
    lag = _lag(sample_rate, top)
    # In place: each intermediate array would be as large as the segment.
    difference: FloatArray = x[2 * lag :] + x[: -2 * lag]
    difference -= x[lag:-lag]
    difference -= x[lag:-lag]
    difference *= sample_rate**2
    return difference, lag


def _lag(sample_rate: float, top: float) -> int:
    """Return the lag of second differences in samples that the top of a band in Hz permits."""
    return max(1, int(sample_rate / (_LAG_PERIODS * top)))


def lag_gain(frequency: FloatArray, lag: int, sample_rate: float) -> FloatArray:
    """Return the gain of the second derivative, ω², over that of the second difference.

    The latter is (2 fs sin(ωL/2fs))² for a lag of L samples; it vanishes at fs/L, eight times the
    top of the band.
    """
    half = np.pi * frequency / sample_rate
    return np.asarray((half / np.abs(np.sin(lag * half)).clip(1e-6)) ** 2)
