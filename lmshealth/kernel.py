"""The expected periodogram of a short record: the density seen through the record's length."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import fft

from lmshealth.arrays import BoolArray, ComplexArray, FloatArray
from lmshealth.spectra import CrossSpectrum, Spectrum


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
