"""Candidate modes: peaks of spectra, excesses of residuals, and clusters of neighbours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lmshealth._arrays import FloatArray
from lmshealth.modal import constants
from lmshealth.modal.targets import Target
from lmshealth.signal.spectra import Spectrum, median_ordinate
from lmshealth.stage.constants import BAND

# Half widths of peaks, as fractions of the frequency: about 1.5 damping ratios.
_SCALES = (0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064)
_LEAST_ORDINATES = 4
# Least ordinates of an excess: the mean of fewer is so skewed that noise reaches the threshold.
_LEAST_OF_EXCESS = 16
_MOST_NARROW = 20
# Ratio of a line to the ordinates near it, and which these are.
_LINE_RATIO = 60.0
_NEAR_LINE = (3, 4, 5, 6, 7, 8)


def find_peaks(
    channels: Sequence[Spectrum], low: float, high: float, lines: Sequence[float] = ()
) -> tuple[Target, ...]:
    """Return candidate modes of the longest observation of each channel in a band in Hz.

    At every frequency and scale the mean ordinate within the scale is compared with the means to
    the left and to the right. A resonance exceeds both at its own scale and, by its skirts, at
    wider ones; the narrowest significant scale gives its damping. None is searched for at the
    frequencies of ``lines``. Candidates, ascending in frequency, are start values: the fit accepts
    or rejects them.
    """
    found: list[tuple[float, float, float]] = []
    for spectrum in channels:
        clear = _without_lines(spectrum, lines)
        for scale in _SCALES:
            found += _peaks(clear, low, high, scale)
    chosen: list[tuple[float, float, float]] = []
    for score, frequency, scale in sorted(found, key=lambda c: (c[2], -c[0])):
        # A resonance is found at several scales and in several channels.
        if all(abs(frequency - f) > max(scale, s) * f for _, f, s in chosen):
            chosen.append((score, frequency, scale))
    return tuple(
        _start_value(f"mode_{number}", frequency, scale)
        for number, (_, frequency, scale) in enumerate(sorted(chosen, key=lambda c: c[1]), start=1)
    )


def _peaks(
    spectrum: Spectrum, low: float, high: float, scale: float
) -> list[tuple[float, float, float]]:
    """Return contrast, frequency and scale of the local maxima of the contrast at one scale."""
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
        # A channel may be constant.
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
    index = 1 + np.flatnonzero(best & (contrast[1:-1] > constants.PEAK_THRESHOLD))
    return [(float(contrast[i]), float(centre[i]), scale) for i in index]


def add_excess(cluster: tuple[Target, ...], residual: Spectrum) -> tuple[Target, ...]:
    """Add the mode that the residual of a fit shows most clearly to its cluster, if there is one.

    The residual is a periodogram over its expectation, exponential about one where the model fits.
    """
    if len(cluster) > constants.MOST_TOGETHER:
        return cluster
    # A narrower excess would have been a peak, unless it is a line.
    excess = find_excess(residual, 0.5 * min(target.damping_ratio for target in cluster))
    if excess is None or any(
        abs(excess.frequency / t.frequency - 1) < t.damping_ratio for t in cluster
    ):
        return cluster
    excess = replace(excess, name=f"{cluster[0].name}_and_{len(cluster)}")
    return tuple(sorted((*cluster, excess), key=lambda target: target.frequency))


def find_excess(residual: Spectrum, narrowest: float = 0.0) -> Target | None:
    """Return where the residual of a fit is most above one, if anywhere.

    Excesses with a damping ratio below ``narrowest`` are ignored.
    """
    ordinates = residual.periodogram.copy()
    for _ in range(_MOST_NARROW):
        total = np.concatenate([[0.0], np.cumsum(ordinates - 1.0)])
        best = (constants.EXCESS_THRESHOLD, 0.0, 0.0)
        for scale in _SCALES:
            first = np.searchsorted(residual.frequency, residual.frequency * (1 - scale))
            last = np.searchsorted(residual.frequency, residual.frequency * (1 + scale))
            n = last - first
            enough = (n >= _LEAST_ORDINATES) & (residual.count * n >= _LEAST_OF_EXCESS)
            score = np.where(enough, (total[last] - total[first]) / np.sqrt(n), 0.0)
            score *= np.sqrt(residual.count)
            k = int(np.argmax(score))
            best = max(best, (float(score[k]), float(residual.frequency[k]), scale))
        _, frequency, scale = best
        if scale == 0.0:
            return None
        if scale >= 1.5 * narrowest:
            return _start_value("excess", frequency, scale)
        reach = frequency * np.array([1 - 4 * scale, 1 + 4 * scale])
        ordinates[slice(*np.searchsorted(residual.frequency, reach).tolist())] = 1.0
    return None


def _start_value(name: str, frequency: float, scale: float) -> Target:
    """Return a candidate at a frequency in Hz whose peak has this relative half width."""
    return Target(name, frequency, scale / 1.5, min(max(3 * scale, 0.02), 0.15))


def _without_lines(spectrum: Spectrum, lines: Sequence[float]) -> Spectrum:
    """Replace the ordinates of lines, also of isolated ones, by the level near them.

    Neighbours of a resonance are high, too; those three to eight ordinates from a sine are not.
    """
    widest = _NEAR_LINE[-1]
    padded = np.pad(spectrum.periodogram, widest, mode="reflect")
    n = spectrum.periodogram.size
    around = [padded[widest + k : widest + k + n] for b in _NEAR_LINE for k in (-b, b)]
    level = np.median(around, axis=0)
    ratio = _LINE_RATIO * median_ordinate(1) / median_ordinate(spectrum.count)
    # A line between two ordinates reaches two more on either side.
    isolated = np.convolve(spectrum.periodogram > ratio * level, np.ones(5), mode="same") > 0
    ordinates = np.where(isolated, level, spectrum.periodogram)
    clear = spectrum.clear_of(lines)
    for line in lines:
        reach = spectrum.near(line)
        width = reach.stop - reach.start
        beside = slice(max(0, reach.start - width), reach.stop + width)
        near = ordinates[beside][clear[beside]]
        if near.size:
            ordinates[reach] = np.median(near) / median_ordinate(spectrum.count)
    return replace(spectrum, periodogram=ordinates)


def clusters(targets: Sequence[Target]) -> list[tuple[Target, ...]]:
    """Group neighbours to fit jointly: their bands overlap, their bandwidths are similar."""

    def interact(lower: Target, upper: Target) -> bool:
        # A narrow peak near a broad resonance would need the finest resolution over the whole band.
        ratio = (upper.frequency * upper.damping_ratio) / (lower.frequency * lower.damping_ratio)
        similar = 1 / constants.SIMILAR_BANDWIDTH < ratio < constants.SIMILAR_BANDWIDTH
        return upper.band(BAND)[0] < lower.band(BAND)[1] and similar

    groups: list[list[Target]] = []
    for target in targets:
        last = groups[-1] if groups else []
        if last and len(last) < constants.MOST_TOGETHER and interact(last[-1], target):
            last.append(target)
        else:
            groups.append([target])
    return [tuple(group) for group in groups]
