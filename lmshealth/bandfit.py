"""Fit a cluster of neighbouring modes in one channel, and say which of them it sees."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lmshealth.arrays import BoolArray, FloatArray
from lmshealth.spectra import Spectrum
from lmshealth.starts import Coarse, Target
from lmshealth.whittle import WEAK, Block, Likelihood, make_block

# The band of a fit reaches this many damping ratios from its modes: beyond, a resonance adds
# little, and the noise need not be as simple as the model says.
BAND = 8.0
# Probability that noise alone makes a line somewhere in the band.
_LINE_FALSE_ALARM = 1e-3
_LINE_BINS = 2
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
class View:
    """All segments of one channel in the frequency domain.

    Attributes
    ----------
    channel, source : str
        Name, and ``acc`` or ``delta_e``.
    spectra : tuple of Spectrum
        One per segment.
    """

    channel: str
    source: str
    spectra: tuple[Spectrum, ...]


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
        Frequency in Hz and amplitude in m/s² of the lines kept out, shape ``(n_lines, 2)``.
    residual : Spectrum
        Periodogram of the longest segment over what the fit expects: exponential about one
        where the fit is right, and one where a line was masked.
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
    masks = [np.ones(s.frequency.size, dtype=bool) for s in spectra]
    if sum(mask.sum() for mask in masks) < 10 + 6 * len(seen):
        n = sum(int(mask.sum()) for mask in masks)
        detail = f"{n} Fourier frequencies in the band, needed {10 + 6 * len(seen)}: record longer"
        return None, missing | {t.name: ("too-short", detail) for t in seen}
    _mask_towers(spectra, masks, coarse)
    width = min(2 * t.frequency * t.damping_ratio for t in seen)
    rounds = 0
    while True:
        blocks = tuple(make_block(s, mask, width) for s, mask in zip(spectra, masks, strict=True))
        solution, seen = _fit_and_prune(view, coarse, blocks, seen, gains, missing)
        if solution is None:
            return None, missing
        rounds += 1
        if rounds == _MOST_LINE_ROUNDS or not _mask_lines(spectra, masks, solution):
            break
    fit = _conclude(view, seen, solution, missing)
    if fit is None:
        return None, missing
    clarity = np.array([gains[target.name] for target in seen])
    residual = _residual(spectra, masks, solution)
    fit = replace(fit, clarity=clarity, lines=_lines(spectra, masks), residual=residual)
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
    if target.settled is not None:
        return target
    return replace(target, damping_ratio=target.damping_ratio * factor)


def _cut(spectra: tuple[Spectrum, ...], targets: tuple[Target, ...]) -> tuple[Spectrum, ...]:
    low = min(t.band(BAND)[0] for t in targets)
    high = max(t.band(BAND)[1] for t in targets)
    return tuple(spectrum.band(low, high) for spectrum in spectra)


def _fit_and_prune(
    view: View,
    coarse: Coarse,
    blocks: tuple[Block, ...],
    seen: tuple[Target, ...],
    gains: dict[str, float],
    missing: dict[str, tuple[str, str]],
) -> tuple[_Solution | None, tuple[Target, ...]]:
    """Fit all modes seen; leave out, one by one, those that the evidence does not ask for."""
    n_ordinates = sum(block.periodogram.size for block in blocks)
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
    n_ordinates = sum(int(mask.sum()) for mask in masks)
    threshold = 2 * np.log(n_ordinates / _LINE_FALSE_ALARM)
    kept = [mask.copy() for mask in masks]
    for spectrum, keep in zip(spectra, kept, strict=True):
        level = np.interp(spectrum.frequency, coarse.frequency, coarse.level)
        towers = np.flatnonzero(spectrum.periodogram > threshold * level)
        for k in towers.tolist():
            keep[max(0, k - _LINE_BINS) : k + _LINE_BINS + 1] = False
    # Towers everywhere are no lines, as in `_mask_lines`.
    if sum(int(keep.sum()) for keep in kept) < n_ordinates // 2:
        return
    for mask, keep in zip(masks, kept, strict=True):
        mask &= keep


def _mask_lines(spectra: tuple[Spectrum, ...], masks: list[BoolArray], solution: _Solution) -> bool:
    """Mask ordinates that no exponential variable would reach; tell whether there were new ones."""
    n_ordinates = sum(int(mask.sum()) for mask in masks)
    threshold = np.log(n_ordinates / _LINE_FALSE_ALARM)
    new = False
    for spectrum, mask, expected in zip(
        spectra, masks, solution.likelihood.expected(solution.p), strict=True
    ):
        index = np.flatnonzero(mask)
        for k in index[spectrum.periodogram[index] > threshold * expected].tolist():
            mask[max(0, k - _LINE_BINS) : k + _LINE_BINS + 1] = False
            new = True
    # A band that is mostly lines is no band of modes: keep at least half of it.
    return new and sum(int(mask.sum()) for mask in masks) >= n_ordinates // 2


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


def _residual(
    spectra: tuple[Spectrum, ...], masks: list[BoolArray], solution: _Solution
) -> Spectrum:
    longest = int(np.argmax([s.duration for s in spectra]))
    ratio = np.ones(spectra[longest].frequency.size)
    expected = solution.likelihood.expected(solution.p)[longest]
    ratio[masks[longest]] = spectra[longest].periodogram[masks[longest]] / expected
    return replace(spectra[longest], periodogram=ratio)


def _lines(spectra: tuple[Spectrum, ...], masks: list[BoolArray]) -> FloatArray:
    """Frequency and amplitude of what was masked in the longest segment, shape ``(n, 2)``."""
    longest = int(np.argmax([s.duration for s in spectra]))
    spectrum, mask = spectra[longest], masks[longest]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (~mask).astype(int), [0]])))
    rows = [spectrum.sine(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    return np.array(rows).reshape(-1, 2)


def _keep_credible(fit: BandFit, missing: dict[str, tuple[str, str]]) -> BandFit:
    """Refuse modes whose estimate cannot be what it claims to be; what is a line becomes one."""
    m = len(fit.targets)
    f = np.exp(fit.estimate[:m])
    spectrum = max(fit.view.spectra, key=lambda s: s.duration)
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
