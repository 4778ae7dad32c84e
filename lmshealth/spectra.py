"""From samples to FFT ordinates: periodograms, their means over parts, and their expectation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft
from scipy.stats import gamma

from lmshealth.arrays import BoolArray, FloatArray
from lmshealth.logs import Channel
from lmshealth.samples import MINUTE
from lmshealth.segments import Segment

# The second difference of a displacement reaches over this part of the shortest period.
_LAG_PERIODS = 8.0
# Set velocities closer than this are one.
_SAME_VELOCITY = 0.01
# A line keeps its phase for about a thousand periods: so wide it is, as a share of its frequency.
WANDER = 1e-3
# Parts of a stretch that is cut have at least so many samples: only they are averaged.
_LEAST_PART = MINUTE // 2


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
        half = max(WANDER * line, 2 / self.duration)
        first, last = np.searchsorted(self.frequency, [line - half, line + half])
        return slice(int(first), int(last))

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
class View:
    """All of one channel in the frequency domain.

    Attributes
    ----------
    channel, source : str
        Name, and ``acc`` or ``delta_e``.
    spectra : tuple of Spectrum
        Of its segments, or means over several.
    lines : tuple of float
        Frequencies in Hz at which a line stands, known beforehand: they are masked.
    """

    channel: str
    source: str
    spectra: tuple[Spectrum, ...]
    lines: tuple[float, ...] = ()

    def band(self, low: float, high: float) -> View:
        """Cut out the ordinates from low to high Hz."""
        return replace(self, spectra=tuple(s.band(low, high) for s in self.spectra))


def average_spectra(
    channel: Channel,
    segments: Sequence[Segment],
    sample_rate: float,
    top: float,
    *,
    ceiling: float = np.inf,
) -> tuple[Spectrum, ...]:
    """Transform the segments of a channel one by one, and average the parts of long stretches.

    Parts of one length and one set velocity have the same expected periodogram, and the
    likelihood needs no more of them than their mean. Short moves stay apart: a line that differs
    between them is then masked in each where it stands.

    Parameters
    ----------
    channel : Channel
        Displacement or acceleration.
    segments : sequence of Segment
        Which samples.
    sample_rate : float
        In Hz.
    top, ceiling : float
        In Hz, as in `periodogram`.

    Returns
    -------
    tuple of Spectrum
        Each at the place of its first segment.
    """
    return tuple(
        _mean(periodogram(channel, part, sample_rate, top, ceiling=ceiling) for part in group)
        for group in _exchangeable(segments)
    )


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


def _mean(spectra: Iterator[Spectrum]) -> Spectrum:
    first = next(spectra)
    total, count = first.periodogram, 1
    for spectrum in spectra:
        total, count = total + spectrum.periodogram, count + 1
    return replace(first, periodogram=total / count, count=count)


def median_ordinate(count: int) -> float:
    """Median of the mean of so many exponential variables."""
    return float(gamma.ppf(0.5, count)) / count


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
    n = x.size
    x = _without_trend(x)
    if lag:
        ceiling = min(ceiling, 4 * top)
    frequency: FloatArray = np.arange(1, (n - 1) // 2 + 1, dtype=np.float64) * (sample_rate / n)
    # A copy: a view would keep what it is cut from.
    frequency = frequency[: np.searchsorted(frequency, ceiling)].copy()
    transform = fft.rfft(x)[1 : frequency.size + 1]
    power = 2 / (n * sample_rate) * (transform.real**2 + transform.imag**2)
    if lag:
        power = power * lag_gain(frequency, lag, sample_rate) ** 2
    return Spectrum(frequency, power, n / sample_rate, segment.velocity)


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


@dataclass(frozen=True, slots=True, eq=False)
class Kernel:
    """Turns a power spectral density into the expected periodogram.

    A record of length T sees the density convolved with the Fejér kernel T sinc²(T (f - f')).
    Where the density is given at multiples of 1/(rT), the Fourier frequencies are every r-th of
    them, and the transform of the kernel does it. Weights are normalised so that a constant
    density stays itself.

    Attributes
    ----------
    grid : ndarray
        Where the density is given, in Hz, shape ``(n_grid,)``.
    place : ndarray of int
        Where on the grid the expected ordinates stand, shape ``(n,)``.
    transform : ndarray
        Of the kernel about its centre, long enough for the whole grid.
    norm : ndarray
        Sum of the weights of each ordinate, shape ``(n,)``.

    References
    ----------
    Sykulski2019
    """

    grid: FloatArray
    place: np.ndarray[tuple[int], np.dtype[np.intp]]
    transform: FloatArray
    norm: FloatArray

    def expect(self, density: FloatArray) -> FloatArray:
        """Give the expected ordinates, shape ``(..., n)``, of densities ``(..., n_grid)``."""
        return np.asarray(self._convolve(density)[..., self.place] / self.norm)

    def spread(self, values: FloatArray) -> FloatArray:
        """Transpose of `expect`: from the ordinates, ``(n,)``, onto the grid, ``(n_grid,)``."""
        on_grid = np.zeros(self.grid.size)
        on_grid[self.place] = values / self.norm
        return self._convolve(on_grid)

    def _convolve(self, values: FloatArray) -> FloatArray:
        size = 2 * (self.transform.size - 1)
        turned = fft.rfft(values, size, axis=-1) * self.transform
        return np.asarray(fft.irfft(turned, size, axis=-1)[..., : self.grid.size])


def make_kernel(spectrum: Spectrum, keep: BoolArray, finer: int, margin: int) -> Kernel:
    """Prepare the expected periodogram of some ordinates of a spectrum.

    Parameters
    ----------
    spectrum : Spectrum
        A band of Fourier frequencies.
    keep : ndarray of bool
        Which ordinates are asked for, shape ``(n_ordinates,)``.
    finer : int
        So many frequencies of the grid per Fourier frequency.
    margin : int
        The grid reaches so many Fourier frequencies beyond the band, at least one.
    """
    first, last = np.rint(spectrum.frequency[[0, -1]] * spectrum.duration).astype(int).tolist()
    index = np.arange(max((first - margin) * finer, 1), (last + margin) * finer)
    size = 2 * fft.next_fast_len(index.size, real=True)
    off = np.arange(size // 2 + 1)
    # Even about its centre: its transform is real, a cosine transform.
    transform = fft.dct(np.sinc(off / finer) ** 2, type=1)
    kernel = Kernel(
        grid=index / (finer * spectrum.duration),
        place=np.arange(first, last + 1)[keep] * finer - index[0],
        transform=transform,
        norm=np.ones(int(keep.sum())),
    )
    return replace(kernel, norm=kernel.expect(np.ones(index.size)))
