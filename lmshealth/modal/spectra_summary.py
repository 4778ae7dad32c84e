"""Spectra of logs in bins for figures: of one with the fit of its modes, and of all of a life."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from lmshealth._private.arrays import ComplexArray, FloatArray, freeze
from lmshealth.modal.ambient.cluster_modes import FittedSpectrum
from lmshealth.modal.modes import Modes
from lmshealth.signal.spectra import CrossSpectrum, LogSpectra
from lmshealth.signal.spectral_lines import Line
from lmshealth.stage.description import Stage

# Bins have at least so many ordinates of a segment, which average their scatter, but are not wider
# than this share of the half-power bandwidth of a mode.
_ORDINATES, _SHARE = 4.0, 0.35
_LEAST_BINS = 8
# Ratio of the ends of a band from which on bins are of equal width in ln f.
WIDE = 6.0
# Ordinates per channel that the matrices of singular values average at least.
_PER_CHANNEL = 2
# Bins of a waterfall, and the share of a channel's median below which power is rounding.
WATERFALL_BINS, _LEAST_SHARE = 160, 1e-9


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

    @property
    def centres(self) -> FloatArray:
        """Centres of the bins in Hz, shape ``(n_bins,)``."""
        return (self.edges[1:] + self.edges[:-1]) / 2


def density(level: NDArray[np.floating]) -> FloatArray:
    """Convert levels of a summary to densities in (m/s²)²/Hz, of the same shape."""
    return np.asarray(10 ** (level.astype(float) / 10))


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
    parts = [_binned(s, edges, whole=n_singular > 0) for s in spectra.spectra]
    # Short segments may have no ordinates at low frequencies.
    known = weight @ [_covered(s, edges) for s in spectra.spectra]
    total: ComplexArray = np.tensordot(weight, parts, 1)
    matrix = total / np.where(known > 0, known, 1.0)[:, None, None]
    count = known * np.diff(edges)
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


def _binned(spectrum: CrossSpectrum, edges: FloatArray, *, whole: bool) -> ComplexArray:
    """Average the matrices, or their diagonals, within bins: ``(n_bins, n_channels, n_channels)``.

    They are zero where the spectrum has no ordinates. Row by row: the matrices of many channels at
    all ordinates would not fit into memory.
    """
    n = spectrum.transforms.shape[2]
    cut = spectrum.band(edges[0] - 1 / spectrum.duration, edges[-1] + 2 / spectrum.duration)
    binned = np.zeros((edges.size - 1, n, n), dtype=complex)
    if not cut.frequency.size:
        return binned
    for i in range(n):
        columns = range(n) if whole else [i]
        row = cut.transforms[:, :, i, None] * cut.transforms[:, :, columns].conj()
        for j, part in zip(columns, row.mean(axis=0).T, strict=True):
            for own, unit in ((part.real, 1.0), (part.imag, 1j)):
                binned[:, i, j] += unit * bin_density(cut, own, edges)
    covered = _covered(spectrum, edges)
    for channel, frequency, amplitude in cut.lines:
        k = int(np.searchsorted(edges, frequency)) - 1
        if 0 <= k < len(binned):
            power = covered[k] * amplitude**2 / 2 / spectrum.count
            binned[k, channel, channel] += power / (edges[k + 1] - edges[k])
    return binned


def _covered(spectrum: CrossSpectrum, edges: FloatArray) -> FloatArray:
    """Return the share of each bin that the ordinates of a spectrum cover, shape ``(n_bins,)``."""
    half = 0.5 / spectrum.duration
    within = edges.clip(spectrum.frequency[0] - half, spectrum.frequency[-1] + half)
    return np.asarray(np.diff(within) / np.diff(edges))


def _expected(fit: FittedSpectrum, edges: FloatArray) -> FloatArray:
    """Average the expected density of each channel in the bins that the fit covers; else NaN."""
    frequency = fit.spectrum.frequency
    density = fit.density.T * fit.unit[:, None] ** 2
    known = np.isfinite(density[0])
    covered = (edges[:-1] >= frequency[0]) & (edges[1:] <= frequency[-1])
    rows = []
    for row in density:
        whole = np.interp(frequency, frequency[known], row[known])
        rows.append(np.where(covered, bin_density(fit.spectrum, whole, edges), np.nan))
    return np.array(rows)


def bin_density(spectrum: CrossSpectrum, density: FloatArray, edges: FloatArray) -> FloatArray:
    """Average a density at the ordinates of a spectrum within bins, shape ``(n_bins,)``.

    An ordinate is the density within half a spacing: narrow bins have a value, and power is kept.
    """
    half = 0.5 / spectrum.duration
    places = np.append(spectrum.frequency - half, spectrum.frequency[-1] + half)
    return _mean_density(places, density / spectrum.duration, edges)


def _mean_density(places: FloatArray, power: FloatArray, edges: FloatArray) -> FloatArray:
    """Return the mean density within edges of power that lies between places, all in Hz."""
    below = np.append(0.0, np.cumsum(power))
    return np.asarray(np.diff(np.interp(edges, places, below)) / np.diff(edges))


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


@dataclass(frozen=True, slots=True, eq=False)
class Waterfall:
    """Relative spectra and lines of the logs of a machine.

    Edges of the bins in Hz, shape ``(n_bins + 1,)``; levels in dB, NaN where a log has none,
    ``(n_logs, n_bins)``; and the lines of each log within the band.
    """

    edges: FloatArray
    level: FloatArray
    lines: tuple[tuple[Line, ...], ...]

    def __post_init__(self) -> None:
        freeze(self, ("level", len(self.lines), self.edges.size - 1))

    @classmethod
    def stack(cls, logs: Sequence[tuple[SpectraSummary | None, Sequence[Line]]]) -> Self | None:
        """Stack logs of one description; None without any spectrum."""
        summaries = [summary for summary, _ in logs if summary is not None]
        if not summaries:
            return None
        low, high = min(one.low for one in summaries), max(one.high for one in summaries)
        edges = np.geomspace(low, high, WATERFALL_BINS + 1)
        return cls(
            edges=edges,
            level=np.stack([_relative_level(summary, edges) for summary, _ in logs]),
            lines=tuple(
                tuple(line for line in lines if low <= line.frequency <= high) for _, lines in logs
            ),
        )


def shown_band(stage: Stage) -> tuple[float, float]:
    """Return the band in Hz in which the tracked modes of a stage are searched."""
    modes = [mode for mode in stage.modes if mode.tracked] or stage.modes
    return min(mode.searched[0] for mode in modes), max(mode.searched[1] for mode in modes)


def _relative_level(summary: SpectraSummary | None, edges: FloatArray) -> FloatArray:
    """Return the mean in dB of all channels over their medians; NaN where a log has no values."""
    total = np.zeros(edges.size - 1)
    if summary is None:
        return np.full(total.size, np.nan)
    known = edges[1:] <= (1 + 1e-9) * summary.high
    for own in density(summary.level):
        power = np.nan_to_num(own) * np.diff(summary.edges)
        mean = _mean_density(summary.edges, power, edges)
        middle = float(np.median(mean[known]))
        if middle > 0:
            total += mean / middle
    decibel = 10 * np.log10((total / len(summary.channels)).clip(_LEAST_SHARE))
    return np.where(known & total.any(), decibel, np.nan)
