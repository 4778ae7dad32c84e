"""What the likelihood is given: ordinates of all channels, averaged where nothing is lost.

The expected periodogram of a short record: the density seen through the record's length.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft

from lmshealth._arrays import BoolArray, ComplexArray, FloatArray
from lmshealth.signal.spectra import CrossSpectrum, Spectrum


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

    def expect(self, density: ComplexArray | FloatArray) -> ComplexArray:
        """Give the expected ordinates, shape ``(..., n)``, of densities ``(..., n_grid)``."""
        return np.asarray(self._convolve(density)[..., self.place] / self.norm)

    def spread(self, values: ComplexArray) -> ComplexArray:
        """Transpose of `expect`: from ordinates, ``(..., n)``, onto the grid, ``(..., n_grid)``."""
        on_grid = np.zeros((*values.shape[:-1], self.grid.size), dtype=complex)
        on_grid[..., self.place] = values / self.norm
        return self._convolve(on_grid)

    def _convolve(self, values: ComplexArray | FloatArray) -> ComplexArray:
        size = self.transform.size
        turned = fft.fft(values, size, axis=-1) * self.transform
        return np.asarray(fft.ifft(turned, size, axis=-1)[..., : self.grid.size])


def make_kernel(
    spectrum: Spectrum | CrossSpectrum, keep: BoolArray, finer: int, margin: int
) -> Kernel:
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
        The grid reaches so many Fourier frequencies beyond the band.
    """
    first, last = np.rint(spectrum.frequency[[0, -1]] * spectrum.duration).astype(int).tolist()
    index = np.arange(max((first - margin) * finer, 1), (last + margin) * finer)
    size = 2 * fft.next_fast_len(index.size)
    # Even about its centre: its transform is real.
    off = np.minimum(np.arange(size), size - np.arange(size))
    transform = fft.fft(np.sinc(off / finer) ** 2).real
    kernel = Kernel(
        grid=index / (finer * spectrum.duration),
        place=np.arange(first, last + 1)[keep] * finer - index[0],
        transform=transform,
        norm=np.ones(int(keep.sum())),
    )
    return replace(kernel, norm=kernel.expect(np.ones(index.size)).real)


# Below this many half-power bandwidths times duration the expected periodogram replaces the
# density: the record no longer resolves the resonance. Many segments are surer than one, and
# their common bias shows the more: they need as many times more.
_RESOLVED = 20.0
# The density is sampled this finely per half-power bandwidth; the kernel itself asks for two
# samples per Fourier bin, and its tails end this many bins outside the band.
_SAMPLES_PER_BANDWIDTH = 12
_MARGIN_BINS = 20
_LEAST_BINS = 12.0


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Ordinates of segments of one length within the band, each a mean of some neighbours.

    Attributes
    ----------
    frequency : ndarray
        Mean frequency in Hz, shape ``(n,)``.
    matrix : ndarray
        Means of F F*, F the transform of all channels, shape ``(n, n_channels, n_channels)``.
    count : ndarray
        How many ordinates of single segments each mean is of, shape ``(n,)``.
    kernel : Kernel or None
        Density to expected periodogram; None where they are the same.
    """

    frequency: FloatArray
    matrix: ComplexArray
    count: FloatArray
    kernel: Kernel | None

    @property
    def grid(self) -> FloatArray:
        """Where the density is evaluated, in Hz, shape ``(n_grid,)``."""
        return self.frequency if self.kernel is None else self.kernel.grid

    def smear(self, density: ComplexArray) -> ComplexArray:
        """Turn densities on the grid, frequency last, into expectations."""
        return density if self.kernel is None else self.kernel.expect(density)


def make_block(
    spectra: Sequence[CrossSpectrum],
    keep: Sequence[BoolArray],
    bandwidth: float,
    *,
    near: Sequence[float] | None = None,
) -> Block:
    """Prepare the ordinates of segments of one length for the likelihood.

    It needs of each frequency the mean over the spectra that are kept there, and their number.

    Parameters
    ----------
    spectra : sequence of CrossSpectrum
        Of the same frequencies, cut to the band.
    keep : sequence of ndarray of bool
        Ordinates of each that hold no line, shape ``(n_ordinates,)``.
    bandwidth : float
        Smallest half-power bandwidth 2ζf expected, in Hz: decides whether the record resolves it.
    near : sequence of float, optional
        Resonances in Hz: neighbours are averaged where the density hardly changes between them.
        By default none are.
    """
    first = spectra[0]
    count = np.zeros(first.frequency.size)
    total = np.zeros_like(first.matrix)
    for spectrum, mask in zip(spectra, keep, strict=True):
        count += spectrum.count * mask
        total += (spectrum.count * mask)[:, None, None] * spectrum.matrix
    kept: BoolArray = count > 0
    frequency, count, total = first.frequency[kept], count[kept], total[kept]
    resolution = bandwidth * first.duration
    n_segments = sum(spectrum.count for spectrum in spectra)
    if resolution < _RESOLVED * n_segments:
        finer = int(np.clip(np.ceil(_SAMPLES_PER_BANDWIDTH / resolution), 2, 12))
        kernel = make_kernel(first, kept, finer, _MARGIN_BINS)
        return Block(frequency, total / count[:, None, None], count, kernel)
    if near is not None:
        fine = _bins_per_bandwidth(n_segments * resolution) / bandwidth
        starts = _bins(first.frequency, near, bandwidth, fine)[kept]
        starts = np.flatnonzero(np.diff(starts, prepend=-1))
        weight = np.add.reduceat(count, starts)
        frequency = np.add.reduceat(count * frequency, starts) / weight
        total, count = np.add.reduceat(total, starts, axis=0), weight
    return Block(frequency, total / count[:, None, None], count, None)


def _bins(
    frequency: FloatArray, near: Sequence[float], bandwidth: float, fine: float
) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """Give each ordinate the number of its bin: ``fine`` of them per Hz at a resonance.

    On its flank, at x half bandwidths, the logarithm of the density changes over x half
    bandwidths: bins may be as much wider.
    """
    distance = np.min([np.abs(frequency - f) for f in near], axis=0) / (bandwidth / 2)
    step = frequency[1] - frequency[0]
    return np.asarray(np.cumsum(fine * step / np.hypot(1.0, distance)), dtype=np.intp)


def _bins_per_bandwidth(resolution: float) -> float:
    """How finely a resonance must be sampled when neighbours are averaged.

    The mean over a bin of the r-th part of the half-power bandwidth is below the peak by the share
    1/(3r²), and the damping too wide by as much, of which the standard deviation is
    (π B T)^-½; a thirtieth of it does not matter.
    """
    return max(_LEAST_BINS, float(np.sqrt(12.0 * np.sqrt(np.pi * resolution))))
