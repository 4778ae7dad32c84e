"""Find resonances in a spectrum without being told where to look."""

from __future__ import annotations

import numpy as np

from lmshealth.results import FloatArray
from lmshealth.spectra import Spectrum
from lmshealth.starts import Target

# Half widths of the sought peaks, as fractions of the frequency: about 1.5 damping ratios.
_SCALES = (0.003, 0.006, 0.012, 0.024, 0.048)
_THRESHOLD = 6.0
_LEAST_ORDINATES = 6


def find_peaks(
    channels: tuple[tuple[Spectrum, ...], ...], low: float, high: float
) -> tuple[Target, ...]:
    """List candidate modes of all channels in a band, ascending in frequency.

    At every frequency and scale the mean of the ordinates within the scale is compared with the
    means beside it on the left and on the right; a resonance stands out against both. Candidates
    are only starts: the identification accepts or refuses them.

    Parameters
    ----------
    channels : tuple of tuple of Spectrum
        Segments of each channel.
    low, high : float
        Band in Hz.
    """
    found: list[tuple[float, float, float]] = []
    for spectra in channels:
        longest = max(spectra, key=lambda spectrum: spectrum.duration)
        for scale in _SCALES:
            found += _stand_out(longest, low, high, scale)
    chosen: list[tuple[float, float, float]] = []
    for score, frequency, scale in sorted(found, reverse=True):
        # The same resonance answers at neighbouring scales and channels; the clearest one counts.
        if all(abs(frequency - f) > max(scale, s) * f for _, f, s in chosen):
            chosen.append((score, frequency, scale))
    return tuple(
        Target(
            name=f"mode_{number}",
            frequency=frequency,
            damping_ratio=scale / 1.5,
            search=min(max(3 * scale, 0.02), 0.15),
        )
        for number, (_, frequency, scale) in enumerate(sorted(chosen, key=lambda c: c[1]), start=1)
    )


def _stand_out(
    spectrum: Spectrum, low: float, high: float, scale: float
) -> list[tuple[float, float, float]]:
    """Score, frequency and scale of the local maxima of the contrast at one scale."""
    step = 1 / spectrum.duration
    if scale * high * spectrum.duration < _LEAST_ORDINATES / 2:
        return []
    n_grid = int(np.log(high / low) / (scale / 4)) + 1
    centre = np.geomspace(low, high, n_grid)
    centre = centre[2 * scale * centre >= _LEAST_ORDINATES * step]
    if centre.size < 3:
        return []
    # Clip what no exponential variable reaches, so that a line does not pose as a resonance.
    smooth = _running_median(spectrum.periodogram)
    total = np.concatenate([[0.0], np.cumsum(np.minimum(spectrum.periodogram, 12 * smooth))])

    def mean(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
        first = np.searchsorted(spectrum.frequency, a)
        last = np.maximum(np.searchsorted(spectrum.frequency, b), first + 1)
        last = np.minimum(last, spectrum.frequency.size)
        first = np.minimum(first, last - 1)
        return (total[last] - total[first]) / (last - first), last - first

    inner, n_inner = mean(centre * (1 - scale), centre * (1 + scale))
    left, n_left = mean(centre * (1 - 4 * scale), centre * (1 - 2 * scale))
    right, n_right = mean(centre * (1 + 2 * scale), centre * (1 + 4 * scale))
    contrast = np.minimum(
        np.log(inner / left) / np.sqrt(1 / n_inner + 1 / n_left),
        np.log(inner / right) / np.sqrt(1 / n_inner + 1 / n_right),
    )
    best = (contrast[1:-1] >= contrast[:-2]) & (contrast[1:-1] > contrast[2:])
    index = 1 + np.flatnonzero(best & (contrast[1:-1] > _THRESHOLD))
    return [(float(contrast[i]), float(centre[i]), scale) for i in index]


def _running_median(values: FloatArray, half: int = 10) -> FloatArray:
    """Median of blocks of ordinates, repeated to full length: a robust local level."""
    size = 2 * half + 1
    n_blocks = max(1, values.size // size)
    blocks = np.array_split(values, n_blocks)
    level = [max(float(np.median(block)), 1e-300) for block in blocks]
    return np.repeat(level, [block.size for block in blocks])
