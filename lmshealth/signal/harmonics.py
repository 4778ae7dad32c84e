"""Harmonics of a record: calibrated amplitudes and phases (README.md, "Harmonics")."""

from dataclasses import dataclass

import numpy as np
from scipy import fft

from lmshealth._private.arrays import FloatArray, freeze

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
