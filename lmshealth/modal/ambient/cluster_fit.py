"""Joint fit of a cluster of neighbouring modes to all channels.

`fit_cluster` screens the modes on binned spectra, masks spectral lines, maximises the posterior
and prunes modes without evidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter
from scipy.stats import gamma

from lmshealth._arrays import ComplexArray, FloatArray
from lmshealth.modal import constants
from lmshealth.modal.ambient.cluster_modes import ClusterFit, conclude
from lmshealth.modal.ambient.expected_periodogram import MeanOrdinates, average_ordinates
from lmshealth.modal.ambient.initial_values import prepare, screen, strengths
from lmshealth.modal.ambient.log_spectra import BinnedSpectrum, ClusterData, LogSpectra
from lmshealth.modal.ambient.whittle import Likelihood, lay_out
from lmshealth.modal.modes import Rejection
from lmshealth.modal.targets import Target
from lmshealth.signal.spectra import CrossSpectrum, median_ordinate
from lmshealth.stage.constants import BAND

# Ordinates over which the level near a line is taken, and that it covers to either side.
_LINE_NEIGHBOURS, _LINE_BINS = 41, 2
_MOST_LINE_ROUNDS = 4
# The sign of a shape starts as that of the cross spectrum within so many damping ratios.
_SIGN_BAND = 1.5
# Bins made for an expected bandwidth suffice for one that is narrower by this factor.
_NARROWER = 0.7


@dataclass(frozen=True, slots=True, eq=False)
class _Optimum:
    """Posterior mode of some modes: unknowns ``p`` and negative log likelihood."""

    targets: tuple[Target, ...]
    likelihood: Likelihood
    p: FloatArray
    misfit: float


def fit_cluster(
    spectra: LogSpectra, binned: tuple[BinnedSpectrum, ...], targets: tuple[Target, ...]
) -> ClusterFit:
    """Fit the modes of a cluster to all channels that show any of them.

    Parameters
    ----------
    spectra : LogSpectra
        All channels.
    binned : tuple of BinnedSpectrum
        Of each channel around the cluster, with its neighbours.
    targets : tuple of Target
        The modes at their start values.
    """
    present, gains = screen(binned, targets)
    names = {target.name for target in present}
    absent = [target for target in targets if target.name not in names]
    if not present:
        return ClusterFit(None, _not_excited(absent, gains))
    low = min(target.band(BAND)[0] for target in present)
    high = max(target.band(BAND)[1] for target in present)
    data = prepare(spectra.band(low, high), binned, present)
    n, needed = sum(int(mask.sum()) for mask in data.masks), 10 + 6 * len(present)
    if n < needed:
        detail = f"{n} Fourier frequencies in the band hold no line, needed {needed}: record longer"
        short = dict.fromkeys((t.name for t in present), Rejection("too-short", detail))
        return ClusterFit(None, _not_excited(absent, gains) | short)
    data = mask_prominent_lines(data)
    for _ in range(_MOST_LINE_ROUNDS):
        optimum, pruned = _fit_and_prune(data, present, gains)
        present, absent = optimum.targets, [*absent, *pruned]
        if not present:
            return ClusterFit(None, _not_excited(absent, gains))
        expected = _expected(data, optimum)
        before, data = data, mask_residual_lines(data, expected)
        if data is before:
            break
    fit = conclude(data, present, (optimum.likelihood, optimum.p), expected, gains)
    return ClusterFit(fit.modes, _not_excited(absent, gains) | fit.rejected)


def _not_excited(targets: Sequence[Target], gains: dict[str, float]) -> dict[str, Rejection]:
    return {
        target.name: Rejection(
            "not-excited",
            f"no resonance near {target.frequency:.4g} Hz in any channel: it would improve the log "
            f"likelihood by {max(gains[target.name], 0):.1f}; excite it more or record longer",
        )
        for target in targets
    }


def mask_prominent_lines(data: ClusterData) -> ClusterData:
    """Mask lines far above the binned level, before a mode can settle on one.

    A mode that takes a line for its resonance leaves its own to its neighbour, which then gets the
    wrong name. Twice the threshold leaves room for what the bins do not resolve. A single mode
    whose damping is below about 1/15 of the described one is as narrow as a line, and may lose its
    own peak.
    """
    levels = [
        np.stack([np.interp(s.frequency, one.frequency, one.level) for one in data.binned], axis=-1)
        for s in data.spectra.spectra
    ]
    return _mask_above(data, [2 * level for level in levels])


def mask_residual_lines(data: ClusterData, expected: list[ComplexArray]) -> ClusterData:
    """Mask ordinates that noise about the expectation does not reach; return ``data`` if none."""
    levels = [
        _raised(spectrum, np.diagonal(e, axis1=1, axis2=2).real)
        for spectrum, e in zip(data.spectra.spectra, expected, strict=True)
    ]
    return _mask_above(data, levels)


def _raised(spectrum: CrossSpectrum, expected: FloatArray) -> FloatArray:
    """Raise the expectation of a mean to the level near it: a misfit of the model is no line.

    A single periodogram scatters too much for that, and its lines exceed any misfit.
    """
    if spectrum.count == 1:
        return expected
    ordinates = np.diagonal(spectrum.matrix, axis1=1, axis2=2).real
    ratio = ordinates / expected / median_ordinate(spectrum.count)
    return np.asarray(expected * median_filter(ratio, (_LINE_NEIGHBOURS, 1)).clip(1.0))


def _mask_above(data: ClusterData, levels: list[FloatArray]) -> ClusterData:
    """Mask lines with their neighbours wherever any channel shows one.

    ``levels`` holds the mean level of each spectrum, shape ``(n_ordinates, n_channels)``.
    """
    n_free = sum(int(mask.sum()) for mask in data.masks)
    false_alarm = constants.LINE_FALSE_ALARM / (len(data.binned) * n_free)
    masks = []
    found = False
    for spectrum, mask, level in zip(data.spectra.spectra, data.masks, levels, strict=True):
        highest = gamma.isf(false_alarm, spectrum.count) / spectrum.count
        ordinates = np.diagonal(spectrum.matrix, axis1=1, axis2=2).real
        lines = mask & (ordinates > highest * level).any(axis=1)
        found = found or bool(lines.any())
        masks.append(mask.copy())
        for k in np.flatnonzero(lines).tolist():
            masks[-1][max(0, k - _LINE_BINS) : k + _LINE_BINS + 1] = False
    # A band that would lose more than half of its ordinates holds no lines.
    if not found or sum(int(mask.sum()) for mask in masks) < n_free // 2:
        return data
    return replace(data, masks=tuple(masks))


def group_lengths(spectra: Sequence[CrossSpectrum]) -> list[list[int]]:
    """Group the indices of spectra with the same frequencies."""
    groups: dict[tuple[float, int], list[int]] = {}
    for i, spectrum in enumerate(spectra):
        groups.setdefault((spectrum.duration, spectrum.frequency.size), []).append(i)
    return list(groups.values())


def make_blocks(
    data: ClusterData, bandwidth: float, near: Sequence[float] | None = None
) -> tuple[MeanOrdinates, ...]:
    """Average the ordinates of each segment length; arguments as in `average_ordinates`."""
    spectra = data.spectra.spectra
    return tuple(
        average_ordinates(
            [spectra[i] for i in group], [data.masks[i] for i in group], bandwidth, near=near
        )
        for group in group_lengths(spectra)
    )


def _fit_and_prune(
    data: ClusterData, present: tuple[Target, ...], gains: dict[str, float]
) -> tuple[_Optimum, list[Target]]:
    """Fit all modes, and drop, one by one, those without evidence; return these, too."""

    def evidence(full: _Optimum, less: _Optimum) -> float:
        """Twice the log evidence (BIC) for the modes that one has and the other has not."""
        extra = full.p.size - less.p.size
        return float(2 * (less.misfit - full.misfit) - extra * np.log(data.n_ordinates))

    bandwidth = min(2 * t.frequency * t.damping_ratio for t in present)
    blocks = make_blocks(data, bandwidth, [target.frequency for target in present])
    optimum = _solve(data, blocks, present)
    pruned: list[Target] = []
    while present:
        doubtful = [i for i, t in enumerate(present) if gains[t.name] < constants.PRESENT]
        less = {i: _solve(data, blocks, present[:i] + present[i + 1 :]) for i in doubtful}
        margin = {i: evidence(optimum, one) - constants.EVIDENCE_MARGIN for i, one in less.items()}
        worst = min(margin, key=lambda i: margin[i], default=None)
        if worst is None or margin[worst] >= 0:
            return _refined(data, optimum), pruned
        pruned.append(present[worst])
        optimum = less[worst]
        present = optimum.targets
    return optimum, pruned


def _refined(data: ClusterData, optimum: _Optimum) -> _Optimum:
    """Repeat the fit with finer bins where resonances are narrower or elsewhere than expected."""
    m = len(optimum.targets)
    f, zeta = np.exp(optimum.p[:m]), np.exp(optimum.p[m : 2 * m])
    bandwidth, expected = 2 * zeta * f, [2 * t.frequency * t.damping_ratio for t in optimum.targets]
    apart = np.abs(f - [target.frequency for target in optimum.targets])
    if (apart < bandwidth / 2).all() and bandwidth.min() > _NARROWER * min(expected):
        return optimum
    least = max(float(bandwidth.min()), min(expected) / constants.DAMPING_SPAN)
    likelihood = replace(optimum.likelihood, blocks=make_blocks(data, least, f.tolist()))
    p = likelihood.minimise(optimum.p)
    return _Optimum(optimum.targets, likelihood, p, likelihood.data_value(p))


def _solve(
    data: ClusterData, blocks: tuple[MeanOrdinates, ...], targets: tuple[Target, ...]
) -> _Optimum:
    """Find the posterior mode of a set of modes."""
    n_channels = len(data.binned)
    zeta = np.array([target.damping_ratio for target in targets])
    # A strength of zero would leave a mode without a gradient.
    least = np.outer([0.01 * channel.level.min() for channel in data.binned], 4 * zeta**2)
    amplitude = np.sqrt(np.maximum(strengths(data.binned, targets)[0], least))
    reference = amplitude.argmax(axis=0).tolist()
    scale = amplitude.max(axis=0)
    layout = lay_out(reference, n_channels)
    start = np.concatenate(
        [
            np.log([target.frequency for target in targets]),
            np.log(zeta),
            np.zeros(layout.n_poles - 2 * len(targets)),
            [float(i == j) for i, j in layout.force],
            [
                relative_sign(blocks, targets[i], c, reference[i]) * amplitude[c, i] / scale[i]
                for c, i in layout.shape
            ],
        ]
    )
    low = min(float(block.frequency[0]) for block in blocks)
    high = max(float(block.frequency[-1]) for block in blocks)
    likelihood = Likelihood(
        blocks=blocks,
        layout=layout,
        start=start,
        scale=np.concatenate([scale, np.ones(n_channels)]),
        centre=float(np.sqrt(low * high)),
        spread=float(np.log(high / low) / 2),
    )
    p = likelihood.minimise(start)
    return _Optimum(targets, likelihood, p, likelihood.data_value(p))


def relative_sign(
    blocks: tuple[MeanOrdinates, ...], target: Target, channel: int, reference: int
) -> float:
    """Return the sign of the cross spectrum of two channels near a mode."""
    low, high = target.band(_SIGN_BAND)
    total = 0.0
    for block in blocks:
        near = (block.frequency >= low) & (block.frequency <= high)
        total += float(block.count[near] @ block.matrix[near, channel, reference].real)
    return 1.0 if total >= 0 else -1.0


def _expected(data: ClusterData, optimum: _Optimum) -> list[ComplexArray]:
    """Return the expectation of each spectrum over the band; infinite where it is masked."""
    m = optimum.likelihood.layout.n_modes
    bandwidth = float(np.min(2 * np.exp(optimum.p[:m] + optimum.p[m : 2 * m])))
    likelihood = replace(optimum.likelihood, blocks=make_blocks(data, bandwidth))
    masked = np.diag(np.full(len(data.binned), np.inf)).astype(complex)
    full = [np.tile(masked, (mask.size, 1, 1)) for mask in data.masks]
    groups = group_lengths(data.spectra.spectra)
    for group, values in zip(groups, likelihood.expected(optimum.p), strict=True):
        kept = np.any([data.masks[i] for i in group], axis=0)
        for i in group:
            full[i][kept] = values
    return full
