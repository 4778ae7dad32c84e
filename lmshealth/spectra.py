"""From samples to FFT ordinates: segments, periodograms, their expectation, and lines."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import fft

from lmshealth.arrays import FloatArray
from lmshealth.logs import Channel, Log

# Setpoint changes below this share of its largest value count as constant velocity.
_VELOCITY_TOLERANCE = 1e-3
# The second difference of a displacement reaches over this part of the shortest period.
_LAG_PERIODS = 8.0


@dataclass(frozen=True, slots=True)
class Segment:
    """A stretch of a log without gaps and at one set velocity.

    Attributes
    ----------
    start, stop : int
        Half-open range of samples.
    velocity : float
        Set velocity in m/s; NaN where the log has no set point.
    """

    start: int
    stop: int
    velocity: float


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

    def sine(self, first: int, last: int) -> tuple[float, float]:
        """Frequency in Hz and amplitude of a sine within some ordinates: Σ I = A² T / 2."""
        ordinates = self.periodogram[first:last]
        amplitude = np.sqrt(2 * ordinates.sum() / self.duration)
        return float(self.frequency[first + int(np.argmax(ordinates))]), float(amplitude)


def find_segments(log: Log, shortest: float) -> tuple[Segment, ...]:
    """Cut a log into stretches without gaps and at constant set velocity.

    Parameters
    ----------
    log : Log
        Without a set point each gap-free piece is one segment.
    shortest : float
        Segments below this many seconds are left out.

    Returns
    -------
    tuple of Segment
        In order of time; empty if nothing is long enough.
    """
    found = []
    for start, stop in log.pieces:
        if log.reference_velocity is None:
            found.append(Segment(start, stop, float("nan")))
        else:
            found += _constant_velocity(log.reference_velocity[start:stop], start)
    n_least = max(8, round(shortest * log.sample_rate))
    return tuple(segment for segment in found if segment.stop - segment.start >= n_least)


def _constant_velocity(velocity: FloatArray, offset: int) -> list[Segment]:
    scale = float(np.max(np.abs(velocity), initial=0.0))
    # A record at rest throughout (ambient vibration) is one segment of velocity zero.
    moving = np.abs(velocity) > _VELOCITY_TOLERANCE * scale if scale > 0 else velocity == velocity
    # Steps are taken over 1 ms or so of samples: one sample of a slow ramp looks constant.
    lag = max(1, min(20, velocity.size // 4))
    change = np.abs(velocity[lag:] - velocity[:-lag]) > _VELOCITY_TOLERANCE * max(scale, 1e-12)
    steady = moving.copy()
    for shift in (0, lag):
        steady[shift : shift + change.size] &= ~change
    edges = np.flatnonzero(np.diff(np.concatenate([[0], steady.astype(int), [0]])))
    return [
        Segment(offset + a, offset + b, float(np.mean(velocity[a:b])))
        for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
    ]


def periodogram(
    channel: Channel, segment: Segment, sample_rate: float, top: float = np.inf
) -> Spectrum:
    """Compute the one-sided periodogram of a channel as acceleration.

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
    x = channel.values[segment.start : segment.stop]
    lag = 0
    if channel.kind == "displacement":
        lag = max(1, int(sample_rate / (_LAG_PERIODS * top)))
        x = (x[2 * lag :] - 2 * x[lag:-lag] + x[: -2 * lag]) * sample_rate**2
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
    # The difference over L samples has gain (2 fs sin(ωL/2fs))², the second derivative ω²; the
    # former vanishes at fs/L, eight times the top.
    half = np.pi * frequency / sample_rate
    gain = np.abs(np.sin(lag * half)).clip(1e-6)
    return replace(spectrum, periodogram=power * (half / gain) ** 4).band(0.0, 4 * top)


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
