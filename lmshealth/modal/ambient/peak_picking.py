"""Find resonances in a spectrum without being told where to look."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lmshealth._arrays import BoolArray, FloatArray
from lmshealth.modal.targets import Target
from lmshealth.signal.spectra import Spectrum, median_ordinate

# Half widths of the sought peaks, as fractions of the frequency: about 1.5 damping ratios.
_SCALES = (0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064)
_THRESHOLD = 6.0
_LEAST_ORDINATES = 4
# Standard deviations by which a residual must be above one; of fewer ordinates the mean is so
# skewed that noise reaches it.
_EXCESS = 5.0
_LEAST_OF_EXCESS = 16
_MOST_NARROW = 20
_TOWERING = 60.0
_BESIDE = (3, 4, 5, 6, 7, 8)


def find_peaks(
    channels: tuple[tuple[Spectrum, ...], ...],
    low: float,
    high: float,
    lines: Sequence[float] = (),
) -> tuple[Target, ...]:
    """List candidate modes of all channels in a band, ascending in frequency.

    At every frequency and scale the mean of the ordinates within the scale is compared with the
    means beside it on the left and on the right; a resonance stands out against both. It does so
    at its own scale and, by its skirts, at wider ones: the narrowest scale at which it is beyond
    doubt counts. Candidates are only starts: the identification accepts or refuses them.

    Parameters
    ----------
    channels : tuple of tuple of Spectrum
        Spectra of each channel.
    low, high : float
        Band in Hz.
    lines : sequence of float
        Frequencies in Hz at which a line stands: what rises there is no resonance.
    """
    found: list[tuple[float, float, float]] = []
    for spectra in channels:
        longest = _without_lines(max(spectra, key=lambda spectrum: spectrum.observed), lines)
        for scale in _SCALES:
            found += _stand_out(longest, low, high, scale)
    chosen: list[tuple[float, float, float]] = []
    for score, frequency, scale in sorted(found, key=lambda c: (c[2], -c[0])):
        # The same resonance answers at other scales and in other channels.
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
    total = np.concatenate([[0.0], np.cumsum(spectrum.periodogram)])

    def mean(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
        first = np.searchsorted(spectrum.frequency, a)
        last = np.maximum(np.searchsorted(spectrum.frequency, b), first + 1)
        last = np.minimum(last, spectrum.frequency.size)
        first = np.minimum(first, last - 1)
        # A channel may be silent.
        level = ((total[last] - total[first]) / (last - first)).clip(1e-300)
        return level, spectrum.count * (last - first)

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


def find_excess(residual: Spectrum, narrowest: float = 0.0) -> Target | None:
    """Find what a fit leaves over: the place and scale where its residual is most above one.

    Parameters
    ----------
    residual : Spectrum
        Periodogram over its expectation, exponential about one where the fit is right.
    narrowest : float
        Damping ratio from which on an excess counts; narrower ones are laid flat.

    Returns
    -------
    Target or None
        None where nothing stands out.
    """
    ordinates = residual.periodogram.copy()
    for _ in range(_MOST_NARROW):
        frequency, scale = _most_above_one(replace(residual, periodogram=ordinates.copy()))
        if scale == 0.0:
            return None
        if scale >= 1.5 * narrowest:
            return Target("excess", frequency, scale / 1.5, min(max(3 * scale, 0.02), 0.15))
        reach = frequency * np.array([1 - 4 * scale, 1 + 4 * scale])
        ordinates[slice(*np.searchsorted(residual.frequency, reach).tolist())] = 1.0
    return None


def _most_above_one(residual: Spectrum) -> tuple[float, float]:
    """Frequency and scale of the clearest excess; zeros where there is none."""
    total = np.concatenate([[0.0], np.cumsum(residual.periodogram - 1.0)])
    best = (_EXCESS, 0.0, 0.0)
    for scale in _SCALES:
        first = np.searchsorted(residual.frequency, residual.frequency * (1 - scale))
        last = np.searchsorted(residual.frequency, residual.frequency * (1 + scale))
        n = last - first
        # A window cut by the edge of the band is judged by what is left of it.
        weight = residual.count * n
        enough = (n >= _LEAST_ORDINATES) & (weight >= _LEAST_OF_EXCESS)
        score = np.where(enough, (total[last] - total[first]) / np.sqrt(n), 0.0)
        score *= np.sqrt(residual.count)
        k = int(np.argmax(score))
        best = max(best, (float(score[k]), float(residual.frequency[k]), scale))
    return best[1], best[2]


def _towering(spectrum: Spectrum) -> tuple[BoolArray, FloatArray]:
    """Ordinates that tower over those three to eight beside them, and the median of these.

    A resonance is several ordinates wide and its own neighbours are high; a sine has none.
    """
    widest = _BESIDE[-1]
    padded = np.pad(spectrum.periodogram, widest, mode="reflect")
    n = spectrum.periodogram.size
    beside = [padded[widest + k : widest + k + n] for b in _BESIDE for k in (-b, b)]
    level = np.median(beside, axis=0)
    tower = _TOWERING * median_ordinate(1) / median_ordinate(spectrum.count)
    towering = spectrum.periodogram > tower * level
    # The foot of a line that falls between two ordinates is two more wide.
    return np.convolve(towering, np.ones(5), mode="same") > 0, np.asarray(level)


def _without_lines(spectrum: Spectrum, lines: Sequence[float]) -> Spectrum:
    """Lay the ordinates of lines at the level beside them."""
    mask, level = _towering(spectrum)
    ordinates = np.where(mask, level, spectrum.periodogram)
    clear = spectrum.clear_of(lines)
    for line in lines:
        reach = spectrum.near(line)
        width = reach.stop - reach.start
        around = slice(max(0, reach.start - width), reach.stop + width)
        beside = ordinates[around][clear[around]]
        if beside.size:
            ordinates[reach] = np.median(beside) / median_ordinate(spectrum.count)
    return replace(spectrum, periodogram=ordinates)
