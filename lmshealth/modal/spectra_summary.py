"""Spectra of a log in bins, with what the fit of its modes expects there, for figures."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from lmshealth._arrays import ComplexArray, FloatArray, freeze
from lmshealth.modal.ambient.cluster_modes import FittedSpectrum
from lmshealth.modal.modes import Modes
from lmshealth.signal.spectra import CrossSpectrum, LogSpectra, Spectrum
from lmshealth.signal.waterfall import bin_density

# Bins have at least so many ordinates of a segment, which average their scatter, but are not wider
# than this share of the half-power bandwidth of a mode.
_ORDINATES, _SHARE = 4.0, 0.35
_LEAST_BINS = 8
# Ratio of the ends of a band from which on bins are of equal width in ln f.
WIDE = 6.0
# Ordinates per channel that the matrices of singular values average at least.
_PER_CHANNEL = 2


@dataclass(frozen=True, slots=True, eq=False)
class SpectraSummary:
    """Spectra of a log in bins of a band.

    Levels are 10 lg of a density in (m/s²)²/Hz, of a displacement that of its second derivative, in
    half precision: steps of at most 0.1 dB. NaN marks a bin without a value.
    """

    channels: tuple[str, ...]
    derived: tuple[bool, ...]  # whether a channel is a displacement
    low: float  # low, high: ends of the band in Hz
    high: float
    level: NDArray[np.float16]  # measured, (n_channels, n_bins)
    fitted: NDArray[np.float16]  # expectation by the fit, where a mode was sought, likewise
    singular: NDArray[np.float16]  # of the cross-spectral matrix, descending, (n_values, n_bins)
    count: NDArray[np.float16]  # ordinates of single segments in each bin, (n_bins,)
    velocities: tuple[float, ...] = ()  # of its segments in m/s

    def __post_init__(self) -> None:
        n, bins = len(self.channels), self.count.size
        freeze(self, ("level fitted", n, bins), ("singular", len(self.singular), bins))

    @property
    def edges(self) -> FloatArray:
        """Edges of the bins in Hz, shape ``(n_bins + 1,)``."""
        wide = self.high > WIDE * self.low > 0
        return (np.geomspace if wide else np.linspace)(self.low, self.high, self.count.size + 1)


def summarise(
    spectra: LogSpectra,
    fitted: Sequence[FittedSpectrum],
    modes: Modes,
    band: tuple[float, float],
    most_bins: int,
    *,
    n_singular: int = 0,
) -> SpectraSummary:
    """Average the spectra of a log, and their expectation, in bins of a band in Hz.

    Sinusoids that were subtracted from the samples are added again, each in its bin. Of several
    channels the first ``n_singular`` singular values are returned.
    """
    low, high = band
    high = min(high, max(float(s.frequency[-1]) for s in spectra.spectra))
    n_bins = most_bins
    if not high > WIDE * low > 0:
        widths = 2 * modes.damping_ratio * modes.frequency
        width = min(_ORDINATES / spectra.duration, _SHARE * float(widths.min(initial=np.inf)))
        n_bins = int(np.clip((high - low) / width, _LEAST_BINS, most_bins))
    nothing = np.full((len(spectra.channels), n_bins), np.nan, dtype=np.float16)
    empty = SpectraSummary(
        spectra.channels, tuple(source == "delta_e" for source in spectra.sources),
        low, high, nothing, nothing, nothing[:0], nothing[0],
    )  # fmt: skip
    edges = empty.edges
    weight = np.array([s.observed for s in spectra.spectra])
    matrix = np.average([_binned(s, edges) for s in spectra.spectra], axis=0, weights=weight)
    count = weight.sum() * np.diff(edges)
    level = _decibel(np.diagonal(matrix, axis1=1, axis2=2).real.T)
    expected = np.full_like(level, np.nan)
    for fit in fitted:
        rows = [spectra.channels.index(name) for name in fit.channels]
        own = _decibel(_expected(fit, edges))
        expected[rows] = np.where(np.isnan(own), expected[rows], own)
    singular = _singular_values(matrix, float(np.median(count)), n_singular)
    shown = count.clip(1, 6e4).astype(np.float16)
    moving = {round(abs(s.velocity), 4) for s in spectra.spectra if np.isfinite(s.velocity)}
    return replace(
        empty, level=level, fitted=expected, singular=singular, count=shown,
        velocities=tuple(sorted(moving)),
    )  # fmt: skip


def _binned(spectrum: CrossSpectrum, edges: FloatArray) -> ComplexArray:
    """Average the matrices within bins, shape ``(n_bins, n_channels, n_channels)``."""
    n = spectrum.matrix.shape[1]
    cut = spectrum.band(edges[0] - 1 / spectrum.duration, edges[-1] + 2 / spectrum.duration)
    binned = np.zeros((edges.size - 1, n, n), dtype=complex)
    if not cut.frequency.size:
        return binned
    parts = cut.matrix.reshape(cut.frequency.size, -1)
    for k in range(n * n):
        for part, unit in ((parts[:, k].real, 1.0), (parts[:, k].imag, 1j)):
            one = Spectrum(cut.frequency, part.copy(), cut.duration, cut.velocity)
            binned[:, k // n, k % n] += unit * bin_density(one, edges)
    for channel, frequency, amplitude in cut.lines:
        k = int(np.searchsorted(edges, frequency)) - 1
        if 0 <= k < len(binned):
            power = amplitude**2 / 2 / spectrum.count
            binned[k, channel, channel] += power / (edges[k + 1] - edges[k])
    return binned


def _expected(fit: FittedSpectrum, edges: FloatArray) -> FloatArray:
    """Average the expected density of each channel in the bins that the fit covers; else NaN."""
    frequency = fit.spectrum.frequency
    density = np.diagonal(fit.expected, axis1=1, axis2=2).real.T * fit.unit[:, None] ** 2
    known = np.isfinite(density[0])
    covered = (edges[:-1] >= frequency[0]) & (edges[1:] <= frequency[-1])
    rows = []
    for row in density:
        whole = np.interp(frequency, frequency[known], row[known])
        one = Spectrum(frequency, whole, fit.spectrum.duration, np.nan)
        rows.append(np.where(covered, bin_density(one, edges), np.nan))
    return np.array(rows)


def _singular_values(matrix: ComplexArray, count: float, most: int) -> NDArray[np.float16]:
    """Return levels of the singular values of means over bins of ``count`` ordinates."""
    n = matrix.shape[1]
    if n == 1 or not most:
        return np.empty((0, len(matrix)), dtype=np.float16)
    size = max(1, int(np.ceil(_PER_CHANNEL * n / count)))
    mean = uniform_filter1d(matrix.real, size, axis=0) + 1j * uniform_filter1d(
        matrix.imag, size, axis=0
    )
    return _decibel(np.linalg.eigvalsh(mean)[:, ::-1][:, :most].T)


def _decibel(density: FloatArray) -> NDArray[np.float16]:
    """Return levels; NaN where the density is not positive."""
    positive = np.where(density > 0, density, np.nan)
    return np.asarray(10 * np.log10(positive), dtype=np.float16)
