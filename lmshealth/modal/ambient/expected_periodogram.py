"""Data of the likelihood: mean ordinates of the segments, and the expected periodogram.

Ordinates of segments of one length are averaged, and neighbours where the density hardly changes
between them. A record that does not resolve a resonance shows the density convolved with the
Fejér kernel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lmshealth._private.arrays import BoolArray, ComplexArray, FloatArray
from lmshealth.signal.spectra import CrossSpectrum

# Half-power bandwidths times duration below which the expected periodogram replaces the density,
# per segment: the bias of many is common, and their scatter smaller.
_RESOLVED = 20.0
# Samples of the density per half-power bandwidth; at least two per Fourier frequency. The grid
# ends so many Fourier frequencies outside the band.
_SAMPLES_PER_BANDWIDTH, _LEAST_FINER, _MOST_FINER = 12, 2, 12
_MARGIN = 20
# Least bins per half-power bandwidth where neighbours are averaged.
_LEAST_BINS = 12.0


@dataclass(frozen=True, slots=True, eq=False)
class Kernel:
    """Convolution from a power spectral density to the expected periodogram [Sykulski2019].

    A record of length T shows the density convolved with the Fejér kernel T sinc²(T (f - f')). With
    the density at multiples of 1/(rT) every r-th one is a Fourier frequency. The weights are
    normalised so that a constant density is unchanged.
    """

    grid: FloatArray  # frequencies of the density in Hz, (n_grid,)
    place: NDArray[np.intp]  # of the ordinates in the grid, (n,)
    transform: FloatArray  # of the kernel, zero-padded to twice the grid
    norm: FloatArray  # sum of the weights of each ordinate, (n,)

    def expect(self, density: ComplexArray | FloatArray) -> ComplexArray:
        """Return expected ordinates, shape ``(..., n)``, of densities ``(..., n_grid)``."""
        return np.asarray(self._convolve(density)[..., self.place] / self.norm)

    def spread(self, values: ComplexArray) -> ComplexArray:
        """Apply the transpose of `expect` to ordinates ``(..., n)``; shape ``(..., n_grid)``."""
        on_grid = np.zeros((*values.shape[:-1], self.grid.size), dtype=complex)
        on_grid[..., self.place] = values / self.norm
        return self._convolve(on_grid)

    def _convolve(self, values: ComplexArray | FloatArray) -> ComplexArray:
        size = self.transform.size
        product = fft.fft(values, size, axis=-1) * self.transform
        return np.asarray(fft.ifft(product, size, axis=-1)[..., : self.grid.size])


def make_kernel(
    frequency: FloatArray, duration: float, keep: BoolArray, finer: int, margin: int
) -> Kernel:
    """Prepare the expected periodogram of some Fourier frequencies of a record.

    In Hz and s; ``keep`` selects ordinates, shape ``(n_ordinates,)``; the grid has ``finer``
    frequencies per Fourier frequency and ends ``margin`` Fourier frequencies outside the band.
    """
    first, last = np.rint(frequency[[0, -1]] * duration).astype(int).tolist()
    index = np.arange(max((first - margin) * finer, 1), (last + margin) * finer)
    size = 2 * fft.next_fast_len(index.size)
    # Even about its centre: its transform is real.
    off = np.minimum(np.arange(size), size - np.arange(size))
    transform = fft.fft(np.sinc(off / finer) ** 2).real
    kernel = Kernel(
        grid=index / (finer * duration),
        place=np.arange(first, last + 1)[keep] * finer - index[0],
        transform=transform,
        norm=np.ones(int(keep.sum())),
    )
    return replace(kernel, norm=kernel.expect(np.ones(index.size)).real)


@dataclass(frozen=True, slots=True, eq=False)
class MeanOrdinates:
    """Mean ordinates of segments of one length in a band."""

    frequency: FloatArray  # mean in Hz, (n,)
    matrix: ComplexArray  # F F*, F the transform of all channels, (n, n_channels, n_channels)
    count: FloatArray  # ordinates of single segments in each mean, (n,)
    kernel: Kernel | None  # None where density and expected periodogram are equal
    foreign: ComplexArray | None = None  # expectation of what no mode causes, as the matrix

    @property
    def grid(self) -> FloatArray:
        """Frequencies of the density in Hz, shape ``(n_grid,)``."""
        return self.frequency if self.kernel is None else self.kernel.grid

    def smear(self, density: ComplexArray) -> ComplexArray:
        """Return the expectation of densities on the grid, frequency last."""
        return density if self.kernel is None else self.kernel.expect(density)


def average_ordinates(
    spectra: Sequence[CrossSpectrum],
    keep: Sequence[BoolArray],
    bandwidth: float,
    *,
    near: Sequence[float] | None = None,
) -> MeanOrdinates:
    """Average the ordinates of segments of one length.

    ``keep`` selects the ordinates of each without lines; ``bandwidth``, the smallest 2ζf expected,
    decides whether the record resolves it. Neighbours are averaged as far as the density between
    resonances ``near`` is constant; without these none are. Frequencies are in Hz.
    """
    first = spectra[0]
    count = np.zeros(first.frequency.size)
    total = np.zeros_like(first.matrix)
    for spectrum, mask in zip(spectra, keep, strict=True):
        count += spectrum.count * mask
        total += (spectrum.count * mask)[:, None, None] * spectrum.matrix
    kept: BoolArray = count > 0
    frequency, count, total = first.frequency[kept], count[kept], total[kept]
    foreign = None
    if first.foreign is not None:
        columns = first.foreign[kept]
        foreign = np.asarray(columns @ np.swapaxes(columns.conj(), 1, 2))
    resolution = bandwidth * first.duration
    n_segments = sum(spectrum.count for spectrum in spectra)
    if resolution < _RESOLVED * n_segments:
        finer = np.clip(np.ceil(_SAMPLES_PER_BANDWIDTH / resolution), _LEAST_FINER, _MOST_FINER)
        kernel = make_kernel(first.frequency, first.duration, kept, int(finer), _MARGIN)
        return MeanOrdinates(frequency, total / count[:, None, None], count, kernel, foreign)
    if near is not None:
        # The mean over the r-th part of the half-power bandwidth B is below the peak by the share
        # 1/(3r²), and the damping too large by as much. Its standard deviation is (π B T)^-½; a
        # thirtieth of it is allowed.
        unbiased = float(np.sqrt(12.0 * np.sqrt(np.pi * (n_segments * resolution))))
        fine = max(_LEAST_BINS, unbiased) / bandwidth
        starts = _bins(first.frequency, near, bandwidth, fine)[kept]
        starts = np.flatnonzero(np.diff(starts, prepend=-1))
        weight = np.add.reduceat(count, starts)
        if foreign is not None:
            foreign = np.add.reduceat(count[:, None, None] * foreign, starts, axis=0)
            foreign = foreign / weight[:, None, None]
        frequency = np.add.reduceat(count * frequency, starts) / weight
        total, count = np.add.reduceat(total, starts, axis=0), weight
    return MeanOrdinates(frequency, total / count[:, None, None], count, None, foreign)


def _bins(
    frequency: FloatArray, near: Sequence[float], bandwidth: float, fine: float
) -> NDArray[np.intp]:
    """Return the bin of each ordinate; ``fine`` bins per Hz at a resonance."""
    # At x half bandwidths from a resonance the logarithm of the density varies over x of them.
    distance = np.min([np.abs(frequency - f) for f in near], axis=0) / (bandwidth / 2)
    step = frequency[1] - frequency[0]
    return np.asarray(np.cumsum(fine * step / np.hypot(1.0, distance)), dtype=np.intp)
