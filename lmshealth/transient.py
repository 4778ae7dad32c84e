"""Free vibration in the frequency domain: what a stretch of it transforms to.

The discrete Fourier transform of a stretch of a decaying mode is exactly a transient that has the
mode's pole, its size given by the state at the beginning less the state at the end: no window, no
leakage, no correction for short records.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft

from lmshealth.arrays import ComplexArray, FloatArray

# Degree of the polynomial, over the band, of what leaks into it from outside.
_DEGREE = 2
# Directions in which the base of that leakage is thinner than this are dropped.
_THIN = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Stretches of one length in a band of the frequency domain.

    Attributes
    ----------
    frequency : ndarray
        Fourier frequencies in Hz, shape ``(n_ordinates,)``.
    ordinates : ndarray of complex
        Transform, scaled so that its squared magnitude is the one-sided periodogram, shape
        ``(n_segments, n_ordinates, n_channels)``.
    duration : float
        Length of each stretch in s.
    sample_rate : float
        In Hz.
    base : ndarray of complex
        Orthonormal base of what leaks into the band from outside, ``(n_ordinates, n_base)``.
    """

    frequency: FloatArray
    ordinates: np.ndarray
    duration: float
    sample_rate: float
    base: np.ndarray

    @property
    def stacked(self) -> FloatArray:
        """Real above imaginary parts, shape ``(2 n_ordinates, n_channels, n_segments)``."""
        y = np.concatenate([self.ordinates.real, self.ordinates.imag], axis=1)
        return np.asarray(np.moveaxis(y, 0, -1))


def make_block(samples: FloatArray, sample_rate: float, low: float, high: float) -> Block:
    """Transform stretches of one length.

    A linear trend is taken out exactly: over a record it has a pole at zero frequency. A constant
    is nothing at Fourier frequencies.

    Parameters
    ----------
    samples : ndarray
        Shape ``(n_segments, n_samples, n_channels)``.
    sample_rate : float
        In Hz.
    low, high : float
        Band in Hz.
    """
    n = samples.shape[1]
    frequency = np.arange(1, (n + 1) // 2) * (sample_rate / n)
    band = (frequency >= low) & (frequency <= high)
    ordinates = fft.rfft(samples, axis=1)[:, 1 : (n + 1) // 2][:, band]
    frequency = frequency[band]
    place = np.linspace(-1, 1, frequency.size)
    leaks = np.polynomial.legendre.legvander(place, _DEGREE).astype(complex)
    trend = 1 / (1 - np.exp(-2j * np.pi * frequency / sample_rate))
    leaks = np.concatenate([leaks, trend[:, None]], axis=1)
    leaks /= np.linalg.norm(leaks, axis=0)
    base, size, _ = np.linalg.svd(leaks, full_matrices=False)
    return Block(
        frequency=frequency,
        ordinates=ordinates * np.sqrt(2 / (n * sample_rate)),
        duration=n / sample_rate,
        sample_rate=sample_rate,
        base=base[:, size > _THIN * size[0]],
    )


def stack(values: np.ndarray) -> FloatArray:
    """Put real above imaginary parts."""
    return np.concatenate([values.real, values.imag], axis=0)


def transient(block: Block, f: FloatArray, zeta: FloatArray) -> np.ndarray:
    """Transform decays at positive frequencies, up to a constant, without derivatives.

    Parameters
    ----------
    block : Block
        Where.
    f, zeta : ndarray
        Natural frequencies in Hz and damping ratios, shape ``(n,)``.

    Returns
    -------
    ndarray of complex
        Shape ``(n_ordinates, n)``.
    """
    exponent = 2 * np.pi * f * (-zeta + 1j * np.sqrt(1 - zeta**2)) / block.sample_rate
    back = np.exp(-2j * np.pi * block.frequency / block.sample_rate)
    return np.asarray(1 / (1 - np.exp(exponent) * back[:, None]))


def pole_columns(block: Block, f: FloatArray, zeta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Transform decaying cosines and sines, up to a constant, with derivatives.

    Samples Re(a ρⁿ) transform to c/(1 − ρ z⁻¹) + c*/(1 − ρ* z⁻¹) with c = a (1 − ρᴺ)/2, because
    z⁻ᴺ = 1 at Fourier frequencies.

    Parameters
    ----------
    block : Block
        Where.
    f, zeta : ndarray
        Natural frequencies in Hz and damping ratios, shape ``(n_modes,)``.

    Returns
    -------
    columns : ndarray
        Of the real and the imaginary part of each c, shape ``(n_modes, 2 n_ordinates, 2)``.
    slopes : ndarray
        Their derivatives by ln f and ln ζ, shape ``(2, n_modes, 2 n_ordinates, 2)``.
    """
    back = np.exp(-2j * np.pi * block.frequency / block.sample_rate)
    omega, root = 2 * np.pi * f / block.sample_rate, np.sqrt(1 - zeta**2)
    exponent = omega * (-zeta + 1j * root)
    pole = np.exp(exponent)
    turns = pole * np.array([exponent, -omega * zeta * (1 + 1j * zeta / root)])
    # This scale makes sizes of order one for a decay as long as the record.
    scale = 1 / (block.sample_rate * block.duration)
    up = scale / (1 - pole[:, None] * back)
    down = scale / (1 - pole.conj()[:, None] * back)
    d_up = back * up**2 / scale * turns[..., None]
    d_down = back * down**2 / scale * turns.conj()[..., None]

    def pair(up: ComplexArray, down: ComplexArray) -> FloatArray:
        both = np.stack([up + down, 1j * (up - down)], axis=-1)
        return np.concatenate([both.real, both.imag], axis=-2)

    return pair(up, down), pair(d_up, d_down)
