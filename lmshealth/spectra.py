"""From samples to FFT ordinates: periodograms and their expectation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import fft

from lmshealth.arrays import FloatArray
from lmshealth.logs import Channel
from lmshealth.segments import Segment

# The second difference of a displacement reaches over this part of the shortest period.
_LAG_PERIODS = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class Spectrum:
    """Periodogram of one channel over one segment, as acceleration.

    Attributes
    ----------
    frequency : ndarray
        Fourier frequencies in Hz, shape ``(n_ordinates,)``.
    periodogram : ndarray
        One-sided periodogram in (m/s²)²/Hz: for a stationary signal each ordinate is
        exponentially distributed about the power spectral density, shape ``(n_ordinates,)``.
    duration : float
        Length of the segment in s.
    velocity : float
        Set velocity in m/s, NaN where unknown.
    """

    frequency: FloatArray
    periodogram: FloatArray
    duration: float
    velocity: float

    def __post_init__(self) -> None:
        if self.frequency.shape != self.periodogram.shape:
            raise ValueError("frequency and periodogram differ in shape")
        self.frequency.setflags(write=False)
        self.periodogram.setflags(write=False)

    def band(self, low: float, high: float) -> Spectrum:
        """Cut out the ordinates from low to high Hz."""
        first, last = np.searchsorted(self.frequency, [low, high])
        cut = slice(int(first), int(last))
        return Spectrum(self.frequency[cut], self.periodogram[cut], self.duration, self.velocity)

    def density(self, low: float, high: float) -> tuple[float, int]:
        """Mean ordinate from low to high Hz and its degrees of freedom, two per ordinate."""
        cut = self.band(low, high).periodogram
        return float(cut.mean()) if cut.size else float("nan"), 2 * cut.size

    def sine(self, first: int, last: int) -> tuple[float, float]:
        """Frequency in Hz and amplitude of a sine within some ordinates: Σ I = A² T / 2."""
        ordinates = self.periodogram[first:last]
        amplitude = np.sqrt(2 * ordinates.sum() / self.duration)
        return float(self.frequency[first + int(np.argmax(ordinates))]), float(amplitude)


def periodogram(
    channel: Channel, segment: Segment, sample_rate: float, top: float = np.inf
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

    Returns
    -------
    Spectrum
        From the first Fourier frequency up to just below Nyquist, for a displacement up to
        four times ``top`` if that is lower.
    """
    x, lag = as_acceleration(channel, segment, sample_rate, top)
    n = x.size
    ramp = np.arange(n) - (n - 1) / 2
    x = x - x.mean() - ramp * (ramp @ x / (ramp @ ramp))
    last = (n - 1) // 2
    transform = fft.rfft(x)[1 : last + 1]
    frequency: FloatArray = np.arange(1, last + 1, dtype=np.float64) * (sample_rate / n)
    squared = transform.real**2 + transform.imag**2
    power = 2 / (n * sample_rate) * squared
    spectrum = Spectrum(frequency, power, n / sample_rate, segment.velocity)
    if lag == 0:
        return spectrum
    power = power * lag_gain(frequency, lag, sample_rate) ** 2
    return replace(spectrum, periodogram=power).band(0.0, 4 * top)


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
    return (x[2 * lag :] - 2 * x[lag:-lag] + x[: -2 * lag]) * sample_rate**2, lag


def lag_gain(frequency: FloatArray, lag: int, sample_rate: float) -> FloatArray:
    """Amplitude of the second derivative over that of the second difference over L samples.

    The latter has gain (2 fs sin(ωL/2fs))², the former ω²; the difference vanishes at fs/L, eight
    times the top of its band.
    """
    half = np.pi * frequency / sample_rate
    return np.asarray((half / np.abs(np.sin(lag * half)).clip(1e-6)) ** 2)


def periodogram_kernel(frequency: FloatArray, duration: float, fine: FloatArray) -> FloatArray:
    """Weights that turn a power spectral density into the expected periodogram.

    A record of length T sees the density convolved with the Fejér kernel
    T sinc²(T (f - f')); rows are normalised so that a constant density stays itself.

    Parameters
    ----------
    frequency : ndarray
        Where the periodogram is expected, in Hz, shape ``(n,)``.
    duration : float
        T in s.
    fine : ndarray
        Equispaced frequencies at which the density is given, shape ``(m,)``.

    Returns
    -------
    ndarray
        Shape ``(n, m)``.

    References
    ----------
    Sykulski2019
    """
    weights = np.sinc(duration * (frequency[:, None] - fine[None, :])) ** 2
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))
