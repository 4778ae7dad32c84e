"""Fit a cluster of neighbouring modes in one channel, and say which of them it sees."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter
from scipy.stats import gamma

from lmshealth.arrays import BoolArray, FloatArray
from lmshealth.spectra import WANDER, Spectrum, View, median_ordinate
from lmshealth.starts import Coarse, Target
from lmshealth.whittle import WEAK, Block, Likelihood, make_block

# The band of a fit reaches this many damping ratios from its modes: beyond, a resonance adds
# little, and the noise need not be as simple as the model says.
BAND = 8.0
# Probability that noise alone makes a line somewhere in the band.
_LINE_FALSE_ALARM = 1e-3
_LINE_BINS = 2
_BESIDE = 41  # ordinates: a line is less than half as wide
_MOST_LINE_ROUNDS = 4
# Binned log likelihood gained by a mode: below the first it is absent, above the second beyond
# doubt, between them it is fitted both ways.
_ABSENT, _BEYOND_DOUBT = 3.0, 60.0
_EVIDENCE_MARGIN = 10.0
_WORST_STD_LN_F = 0.03
_WORST_STD_LN_ZETA = 0.7
# A damping off its start by more than this factor belongs to something else.
_DAMPING_SPAN = 6.0
_HEAVY = 0.1  # and above this, a hump that nobody expected is no mode


@dataclass(frozen=True, slots=True, eq=False)
class BandFit:
    """Modes of a cluster that one channel sees.

    Attributes
    ----------
    view : View
        The channel.
    targets : tuple of Target
        The modes it sees, at their start values.
    estimate : ndarray
        ``[ln f, ln ζ]``, shape ``(2 n_modes,)``.
    cov : ndarray
        Their covariance, amplitudes and noise marginalised, shape ``(2 n_modes, 2 n_modes)``.
    snr : ndarray
        Modal signal-to-noise ratio, shape ``(n_modes,)``.
    clarity : ndarray
        Log likelihood of the binned spectrum that each mode gains at its start value. Choosing
        between channels by it, and not by the smallest standard deviation, does not favour
        those that happen to show a low damping. Shape ``(n_modes,)``.
    lines : ndarray
        Frequency in Hz and amplitude in m/s² of the lines kept out but for those known beforehand,
        shape ``(n_lines, 2)``.
    residual : Spectrum
        Periodogram that saw most over what the fit expects: scattered about one where the fit is
        right, and one where a line was masked.
    """

    view: View
    targets: tuple[Target, ...]
    estimate: FloatArray
    cov: FloatArray
    snr: FloatArray
    clarity: FloatArray
    lines: FloatArray
    residual: Spectrum

    def settled(self) -> tuple[Target, ...]:
        """Its modes as another channel may take them for granted."""
        m = len(self.targets)
        std = np.sqrt(np.diag(self.cov)).tolist()
        f, zeta = np.exp(self.estimate[:m]).tolist(), np.exp(self.estimate[m:]).tolist()
        return tuple(
            replace(t, frequency=f[i], damping_ratio=zeta[i], settled=(std[i], std[m + i]))
            for i, t in enumerate(self.targets)
        )

    def only(self, names: list[str]) -> BandFit:
        """Keep only the named modes; the others stay marginalised in the covariance."""
        m = len(self.targets)
        index = np.array([i for i, t in enumerate(self.targets) if t.name in names], dtype=int)
        both = np.concatenate([index, index + m])
        return replace(
            self,
            targets=tuple(self.targets[i] for i in index),
            estimate=self.estimate[both],
            cov=self.cov[np.ix_(both, both)],
            snr=self.snr[index],
            clarity=self.clarity[index],
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    likelihood: Likelihood
    p: FloatArray
    misfit: float


def fit_band(
    view: View, coarse: Coarse, targets: tuple[Target, ...]
) -> tuple[BandFit | None, dict[str, tuple[str, str]]]:
    """Fit the modes of a cluster that a channel sees.

    Parameters
    ----------
    view : View
        The channel.
    coarse : Coarse
        Its binned spectrum around the cluster, with its neighbours.
    targets : tuple of Target
        The modes, placed where they are expected in this log.

    Returns
    -------
    fit : BandFit or None
        None when the channel sees none of them; without modes where it sees lines only.
    missing : dict
        Reason and detail of each mode that is not in the fit, by name.
    """
    missing: dict[str, tuple[str, str]] = {}
    seen, gains = _screen(coarse, targets)
    for target in set(targets) - set(seen):
        missing[target.name] = _absent(view, target, gains[target.name])
    if not seen:
        return None, missing
    spectra = _cut(view.spectra, seen)
    masks = [spectrum.clear_of(view.lines) for spectrum in spectra]
    n, needed = sum(int(mask.sum()) for mask in masks), 10 + 6 * len(seen)
    if n < needed:
        detail = f"{n} Fourier frequencies in the band, needed {needed}: record longer"
        return None, missing | {t.name: ("too-short", detail) for t in seen}
    _mask_towers(spectra, masks, coarse)
    width = min(2 * t.frequency * t.damping_ratio for t in seen)
    rounds = 0
    while True:
        blocks = tuple(
            make_block([spectra[i] for i in group], [masks[i] for i in group], width)
            for group, _ in _groups(spectra, masks)
        )
        solution, seen = _fit_and_prune(view, coarse, blocks, seen, gains, missing)
        if solution is None:
            return None, missing
        rounds += 1
        if rounds == _MOST_LINE_ROUNDS or not _mask_lines(spectra, masks, solution):
            break
    fit = _conclude(view, seen, solution, missing)
    if fit is None:
        return None, missing
    k = _most(spectra)
    fit = replace(
        fit,
        clarity=np.array([gains[target.name] for target in seen]),
        lines=_lines(spectra[k], masks[k] | ~spectra[k].clear_of(view.lines)),
        residual=_residual(spectra[k], masks[k], _expected(spectra, masks, solution)[k]),
    )
    return _keep_credible(fit, missing), missing


def _absent(view: View, target: Target, gain: float) -> tuple[str, str]:
    return (
        "not-excited",
        f"no resonance near {target.frequency:.4g} Hz in {view.channel}: it would improve the log "
        f"likelihood by {max(gain, 0):.1f}; excite it more or record longer",
    )


def _screen(
    coarse: Coarse, targets: tuple[Target, ...]
) -> tuple[tuple[Target, ...], dict[str, float]]:
    """Drop modes without which the binned spectrum is described as well; refine start dampings."""
    scaled = min(
        (tuple(_damped(target, c) for target in targets) for c in (0.5, 1.0, 2.0)),
        key=coarse.misfit,
    )
    kept = scaled
    gains: dict[str, float] = {}
    while kept:
        full = coarse.misfit(kept)
        losses = [coarse.misfit(kept[:i] + kept[i + 1 :]) - full for i in range(len(kept))]
        gains |= {t.name: loss for t, loss in zip(kept, losses, strict=True)}
        open_losses = [np.inf if t.settled else x for t, x in zip(kept, losses, strict=True)]
        worst = int(np.argmin(open_losses))
        if open_losses[worst] >= _ABSENT:
            break
        kept = kept[:worst] + kept[worst + 1 :]
    return kept, gains


def _damped(target: Target, factor: float) -> Target:
    factor = factor if target.settled is None else 1.0
    return replace(target, damping_ratio=target.damping_ratio * factor)


def _cut(spectra: tuple[Spectrum, ...], targets: tuple[Target, ...]) -> tuple[Spectrum, ...]:
    low = min(t.band(BAND)[0] for t in targets)
    high = max(t.band(BAND)[1] for t in targets)
    return tuple(spectrum.band(low, high) for spectrum in spectra)


def _groups(
    spectra: tuple[Spectrum, ...], masks: list[BoolArray]
) -> list[tuple[list[int], BoolArray]]:
    """Group the indices of spectra of the same frequencies, with what any of them keeps."""
    groups: dict[tuple[float, int], list[int]] = {}
    for i, spectrum in enumerate(spectra):
        groups.setdefault((spectrum.duration, spectrum.frequency.size), []).append(i)
    kept = [np.any([masks[i] for i in group], axis=0) for group in groups.values()]
    return [(group, keep) for group, keep in zip(groups.values(), kept, strict=True) if keep.any()]


def _fit_and_prune(
    view: View,
    coarse: Coarse,
    blocks: tuple[Block, ...],
    seen: tuple[Target, ...],
    gains: dict[str, float],
    missing: dict[str, tuple[str, str]],
) -> tuple[_Solution | None, tuple[Target, ...]]:
    """Fit all modes seen; leave out, one by one, those that the evidence does not ask for."""
    n_ordinates = sum(float(block.count.sum()) for block in blocks)
    solution = _solve(coarse, blocks, seen)
    while seen:
        doubtful = [
            i for i, t in enumerate(seen) if gains[t.name] < _BEYOND_DOUBT and t.settled is None
        ]
        evidence: dict[int, tuple[float, _Solution | None]] = {}
        for i in doubtful:
            rest = seen[:i] + seen[i + 1 :]
            without = _solve(coarse, blocks, rest)
            extra = solution.p.size - without.p.size
            gain = 2 * (without.misfit - solution.misfit)
            evidence[i] = (gain - extra * np.log(n_ordinates) - _EVIDENCE_MARGIN, without)
        refuted = {i: e for i, e in evidence.items() if e[0] < 0}
        if not refuted:
            return solution, seen
        worst = min(refuted, key=lambda i: refuted[i][0])
        missing[seen[worst].name] = _absent(view, seen[worst], gains[seen[worst].name])
        seen = seen[:worst] + seen[worst + 1 :]
        solution = refuted[worst][1] or solution
    return None, ()


def _solve(coarse: Coarse, blocks: tuple[Block, ...], targets: tuple[Target, ...]) -> _Solution:
    """Find the posterior mode for a set of modes by a trust-region Newton method."""
    f = np.array([target.frequency for target in targets])
    zeta = np.array([target.damping_ratio for target in targets])
    strength, noise = coarse.strengths(targets)
    m = len(targets)
    # A strength of zero would leave the mode without a gradient.
    floor = 0.01 * coarse.level.min() * 4 * zeta**2
    noise = max(noise, 1e-2 * coarse.level.min())
    start = np.concatenate(
        [np.log(f), np.log(zeta), np.ones(m), np.zeros(max(m - 1, 0)), [np.log(noise), 0.0]]
    )
    low = min(block.frequency[0] for block in blocks)
    high = max(block.frequency[-1] for block in blocks)
    likelihood = Likelihood(
        blocks=blocks,
        start=start,
        belief=np.array([t.settled or WEAK for t in targets]).reshape(m, 2).T.ravel(),
        scale=np.sqrt(np.maximum(strength, floor)),
        centre=float(np.sqrt(low * high)),
        spread=float(np.log(high / low) / 2),
    )
    p = likelihood.minimise(start)
    return _Solution(likelihood, p, likelihood.data_value(p))


def _mask_towers(spectra: tuple[Spectrum, ...], masks: list[BoolArray], coarse: Coarse) -> None:
    """Mask lines that tower over the medians around them, before a mode can settle on one.

    A mode that takes a strong line for its resonance leaves its own to its neighbour, which then
    bears the wrong name. Twice the threshold leaves room for what the bins do not resolve. A lone
    mode whose damping is below about 1/15 of its nominal one stands as narrow as a line, and may
    lose its own peak.
    """
    p_value = _LINE_FALSE_ALARM / sum(int(mask.sum()) for mask in masks)
    towers = [
        s.periodogram
        > 2 * _highest(s.count, p_value) * np.interp(s.frequency, coarse.frequency, coarse.level)
        for s in spectra
    ]
    _mask_around(masks, towers)


def _mask_lines(spectra: tuple[Spectrum, ...], masks: list[BoolArray], solution: _Solution) -> bool:
    """Mask ordinates that noise would not reach; tell whether there were new ones."""
    p_value = _LINE_FALSE_ALARM / sum(int(mask.sum()) for mask in masks)
    expected = _expected(spectra, masks, solution)
    lines = [
        mask & (s.periodogram > _highest(s.count, p_value) * _beside(s, e))
        for s, mask, e in zip(spectra, masks, expected, strict=True)
    ]
    return _mask_around(masks, lines)


def _beside(spectrum: Spectrum, expected: FloatArray) -> FloatArray:
    """Raise what a mean is expected to be to the level about it: what a fit lacks is no line.

    A single periodogram scatters too much for that, and lines tower over what its fit lacks.
    """
    if spectrum.count == 1:
        return expected
    ratio = spectrum.periodogram / expected / median_ordinate(spectrum.count)
    return np.asarray(expected * median_filter(ratio, _BESIDE).clip(1.0))


def _highest(count: int, p_value: float) -> float:
    """Level that the mean of so many exponential variables passes with a probability."""
    return float(gamma.isf(p_value, count)) / count


def _mask_around(masks: list[BoolArray], lines: list[BoolArray]) -> bool:
    """Mask lines with their feet; tell whether there were any."""
    kept = [mask.copy() for mask in masks]
    for keep, line in zip(kept, lines, strict=True):
        for k in np.flatnonzero(line).tolist():
            keep[max(0, k - _LINE_BINS) : k + _LINE_BINS + 1] = False
    # A band that is mostly lines is no band of modes: keep at least half of it.
    if sum(int(keep.sum()) for keep in kept) < sum(int(mask.sum()) for mask in masks) // 2:
        return False
    masks[:] = kept
    return any(bool(line.any()) for line in lines)


def _expected(
    spectra: tuple[Spectrum, ...], masks: list[BoolArray], solution: _Solution
) -> list[FloatArray]:
    """Spread what each spectrum is expected to be over its band; infinite where it is masked."""
    full = [np.full(mask.size, np.inf) for mask in masks]
    values = solution.likelihood.expected(solution.p)
    for (group, kept), expected in zip(_groups(spectra, masks), values, strict=True):
        for i in group:
            full[i][kept] = expected
    return full


def _conclude(
    view: View,
    seen: tuple[Target, ...],
    solution: _Solution,
    missing: dict[str, tuple[str, str]],
) -> BandFit | None:
    """Turn the posterior mode into estimates with the inverse Hessian as covariance."""
    m = len(seen)
    gradient, hessian = solution.likelihood.derivatives(solution.p)
    try:
        factor = np.linalg.cholesky(hessian)
        decrement = float(np.sum(np.linalg.solve(factor, gradient) ** 2))
        cov = np.asarray(np.linalg.inv(hessian)[: 2 * m, : 2 * m], dtype=np.float64)
    except np.linalg.LinAlgError:
        decrement, cov = np.inf, np.full((2 * m, 2 * m), np.nan)
    if not decrement < 1e-2:
        detail = f"the fit in {view.channel} did not reach a maximum (decrement {decrement:.2g})"
        missing.update({t.name: ("not-identified", detail) for t in seen})
        return None
    p = solution.p
    zeta = np.exp(p[m : 2 * m])
    noise = np.exp(
        p[-2] + p[-1] * (p[:m] - np.log(solution.likelihood.centre)) / (solution.likelihood.spread)
    )
    strength = (solution.likelihood.scale * p[2 * m : 3 * m]) ** 2
    strength[1:] += (solution.likelihood.scale[1:] * p[3 * m : 4 * m - 1]) ** 2
    return BandFit(
        view=view,
        targets=seen,
        estimate=p[: 2 * m],
        cov=cov,
        snr=strength / (4 * zeta**2 * noise),
        clarity=np.full(m, np.nan),
        lines=np.empty((0, 2)),
        residual=view.spectra[0],
    )


def _most(spectra: tuple[Spectrum, ...]) -> int:
    """Index of the spectrum that saw most."""
    return int(np.argmax([s.observed for s in spectra]))


def _residual(spectrum: Spectrum, mask: BoolArray, expected: FloatArray) -> Spectrum:
    return replace(spectrum, periodogram=np.where(mask, spectrum.periodogram / expected, 1.0))


def _lines(spectrum: Spectrum, mask: BoolArray) -> FloatArray:
    """Frequency and amplitude of what was masked, shape ``(n, 2)``."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (~mask).astype(int), [0]])))
    rows = [spectrum.sine(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return np.array(rows).reshape(-1, 2)


def _keep_credible(fit: BandFit, missing: dict[str, tuple[str, str]]) -> BandFit:
    """Refuse modes whose estimate cannot be what it claims to be; what is a line becomes one."""
    m = len(fit.targets)
    f = np.exp(fit.estimate[:m])
    spectrum = fit.view.spectra[_most(fit.view.spectra)]
    keep, lines = [], [fit.lines]
    for i, target in enumerate(fit.targets):
        if target.settled is not None:
            continue
        why = _incredible(fit, i, spectrum.duration)
        if why is None:
            keep.append(target.name)
            continue
        missing[target.name] = why
        if why[0] == "line-not-mode":
            k = int(np.searchsorted(spectrum.frequency, f[i]))
            row = spectrum.sine(max(0, k - _LINE_BINS), k + _LINE_BINS + 1)
            lines.append(np.array([row]))
    return replace(fit.only(keep), lines=np.concatenate(lines))


def _incredible(fit: BandFit, i: int, duration: float) -> tuple[str, str] | None:
    """Say why a mode's estimate is not believed; None when it is."""
    m = len(fit.targets)
    target, channel = fit.targets[i], fit.view.channel
    f, zeta = float(np.exp(fit.estimate[i])), float(np.exp(fit.estimate[m + i]))
    std_f, std_zeta = np.sqrt(np.diag(fit.cov))[[i, m + i]].tolist()
    low = target.damping_ratio / _DAMPING_SPAN
    high = min(target.damping_ratio * _DAMPING_SPAN, max(_HEAVY, 2 * target.damping_ratio))
    if 2 * zeta * f * duration < 1:
        return (
            "line-not-mode",
            f"{f:.5g} Hz in {channel} is narrower ({2 * zeta * f:.2g} Hz) than a record of "
            f"{duration:.3g} s resolves",
        )
    if target.nominal is None and 2 * zeta < WANDER:
        return "line-not-mode", f"{f:.5g} Hz in {channel} is as narrow as a line that wanders"
    sought = target.nominal or target.frequency
    if abs(np.log(f / sought)) > np.log1p(target.search) or not low < zeta < high:
        return (
            "outside-search",
            f"the fit in {channel} went to {f:.5g} Hz, damping {zeta:.2g}; sought within "
            f"{100 * target.search:.0f} % of {sought:.5g} Hz, damping from {low:.2g} "
            f"to {high:.2g}",
        )
    if std_f > _WORST_STD_LN_F or std_zeta > _WORST_STD_LN_ZETA:
        return (
            "too-uncertain",
            f"{f:.5g} Hz in {channel} is known to {100 * std_f:.2g} % only, its damping to "
            f"{100 * std_zeta:.0f} %; record longer or excite more",
        )
    return None
