"""Fit a cluster of neighbouring modes to all channels at once, and say which of them are there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import gamma

from lmshealth.arrays import BoolArray, ComplexArray, FloatArray
from lmshealth.blocks import Block, make_block
from lmshealth.posterior import marginalise
from lmshealth.spectra import CrossSpectrum, Spectrum
from lmshealth.starts import Coarse, Target
from lmshealth.whittle import Likelihood, lay_out

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
# Newton decrement of a fit that has arrived.
_WORST_DECREMENT = 1e-2
_HEAVY = 0.1  # and above this, a hump that nobody expected is no mode
# A shape begins by the sign it has within so many damping ratios of the resonance.
_NEAR = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A log in the frequency domain.

    Attributes
    ----------
    channels, sources : tuple of str
        Names, and ``acc`` or ``delta_e``.
    spectra : tuple of CrossSpectrum
        Of its segments, or means over several.
    """

    channels: tuple[str, ...]
    sources: tuple[str, ...]
    spectra: tuple[CrossSpectrum, ...]

    @property
    def source(self) -> str:
        """The source of all channels, or ``joint``."""
        return self.sources[0] if len(set(self.sources)) == 1 else "joint"

    def single(self, index: int) -> tuple[Spectrum, ...]:
        """Give the spectra of one channel."""
        return tuple(spectrum.channel(index) for spectrum in self.spectra)

    def only(self, index: Sequence[int]) -> View:
        """Keep some channels."""
        pick = np.ix_(index, index)
        return View(
            tuple(self.channels[c] for c in index),
            tuple(self.sources[c] for c in index),
            tuple(replace(s, matrix=s.matrix[(slice(None), *pick)]) for s in self.spectra),
        )

    def band(self, low: float, high: float) -> View:
        """Cut out a band in Hz."""
        cut = (spectrum.band(low, high) for spectrum in self.spectra)
        return replace(self, spectra=tuple(s for s in cut if s.frequency.size))


@dataclass(frozen=True, slots=True)
class Sighting:
    """A line in a channel: frequency in Hz, amplitude in m/s²."""

    channel: str
    frequency: float
    amplitude: float


@dataclass(frozen=True, slots=True, eq=False)
class BandFit:
    """Modes of a cluster.

    Attributes
    ----------
    view : View
        The band, and the channels that see any of them.
    targets : tuple of Target
        The modes, at their start values.
    estimate : ndarray
        ``[ln f, ln ζ]``, shape ``(2 n_modes,)``.
    cov : ndarray
        Their covariance, forces, shapes and noise marginalised, ``(2 n_modes, 2 n_modes)``.
    snr : ndarray
        Modal signal-to-noise ratio of all channels together, shape ``(n_modes,)``.
    best : tuple of str
        The channel that sees each mode most clearly.
    clarity : ndarray
        Log likelihood of the binned spectra that each mode gains at its start, ``(n_modes,)``.
    lines : tuple of Sighting
        Lines that were kept out.
    residual : Spectrum
        Mean over the channels of what the ordinates that saw most are over what the fit expects:
        scattered about one where the fit is right, and one where a line was masked.
    """

    view: View
    targets: tuple[Target, ...]
    estimate: FloatArray
    cov: FloatArray
    snr: FloatArray
    best: tuple[str, ...]
    clarity: FloatArray
    lines: tuple[Sighting, ...]
    residual: Spectrum

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
            best=tuple(self.best[i] for i in index),
            clarity=self.clarity[index],
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Band:
    """What a cluster is fitted to.

    Attributes
    ----------
    view : View
        The band, of the channels that see any of the modes, each in units of its noise.
    unit : ndarray
        Root of the noise in (m/s²)/Hz^½, shape ``(n_channels,)``.
    coarse : tuple of Coarse
        Their binned spectra in the same units.
    masks : list of ndarray of bool
        Ordinates of each spectrum that hold no line.
    width : float
        Smallest half-power bandwidth expected, in Hz.
    """

    view: View
    unit: FloatArray
    coarse: tuple[Coarse, ...]
    masks: list[BoolArray]
    width: float


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    likelihood: Likelihood
    p: FloatArray
    misfit: float


Missing = dict[str, tuple[str, str]]


def fit_band(
    view: View, coarse: tuple[Coarse, ...], targets: tuple[Target, ...]
) -> tuple[BandFit | None, Missing]:
    """Fit the modes of a cluster to all channels that see any of them.

    Parameters
    ----------
    view : View
        All channels.
    coarse : tuple of Coarse
        The binned spectrum of each around the cluster, with its neighbours.
    targets : tuple of Target
        The modes, placed where they are expected in this log.

    Returns
    -------
    fit : BandFit or None
        None when none of them is seen; without modes where there are lines only.
    missing : dict
        Reason and detail of each mode that is not in the fit, by name.
    """
    seen, gains = _screen(coarse, targets)
    kept = {target.name for target in seen}
    missing = {t.name: _absent(t, gains[t.name]) for t in targets if t.name not in kept}
    if not seen:
        return None, missing
    low = min(t.band(BAND)[0] for t in seen)
    high = max(t.band(BAND)[1] for t in seen)
    cut = view.band(low, high)
    n, needed = sum(s.frequency.size for s in cut.spectra), 10 + 6 * len(seen)
    if n < needed:
        detail = f"{n} Fourier frequencies in the band, needed {needed}: record longer"
        return None, missing | {t.name: ("too-short", detail) for t in seen}
    band = _prepare(cut, coarse, seen)
    _mask_towers(band)
    for _ in range(_MOST_LINE_ROUNDS):
        solution, seen = _fit_and_prune(band, seen, gains, missing)
        if not seen:
            return None, missing
        expected = _expected(band, solution)
        if not _mask_lines(band, expected):
            break
    fit = _conclude(band, seen, solution, missing)
    if fit is None:
        return None, missing
    clarity = np.array([gains[target.name] for target in seen])
    fit = replace(fit, clarity=clarity, lines=_lines(band), residual=_residual(band, expected))
    return _keep_credible(fit, band.unit, missing), missing


def _absent(target: Target, gain: float) -> tuple[str, str]:
    return (
        "not-excited",
        f"no resonance near {target.frequency:.4g} Hz in any channel: it would improve the log "
        f"likelihood by {max(gain, 0):.1f}; excite it more or record longer",
    )


def _misfit(coarse: Sequence[Coarse], targets: tuple[Target, ...]) -> float:
    return sum(channel.misfit(targets) for channel in coarse)


def _screen(
    coarse: tuple[Coarse, ...], targets: tuple[Target, ...]
) -> tuple[tuple[Target, ...], dict[str, float]]:
    """Drop modes without which the binned spectra are described as well; refine start dampings."""
    scaled = min(
        (
            tuple(replace(t, damping_ratio=t.damping_ratio * c) for t in targets)
            for c in (0.5, 1.0, 2.0)
        ),
        key=lambda candidates: _misfit(coarse, candidates),
    )
    kept = scaled
    gains: dict[str, float] = {}
    while kept:
        full = _misfit(coarse, kept)
        losses = [_misfit(coarse, kept[:i] + kept[i + 1 :]) - full for i in range(len(kept))]
        gains |= {t.name: loss for t, loss in zip(kept, losses, strict=True)}
        worst = int(np.argmin(losses))
        if losses[worst] >= _ABSENT:
            break
        kept = kept[:worst] + kept[worst + 1 :]
    return kept, gains


def _prepare(view: View, coarse: tuple[Coarse, ...], seen: tuple[Target, ...]) -> _Band:
    """Choose the channels that see any of the modes, and put each in units of its noise."""
    gains = [channel.misfit(()) - channel.misfit(seen) for channel in coarse]
    index = [c for c, gain in enumerate(gains) if gain >= _ABSENT] or [int(np.argmax(gains))]
    used = [coarse[c] for c in index]
    noise = np.array([max(c.strengths(seen)[1], 1e-2 * c.level.min()) for c in used])
    unit = np.sqrt(noise)
    chosen = view.only(index)
    spectra = tuple(replace(s, matrix=s.matrix / np.outer(unit, unit)) for s in chosen.spectra)
    return _Band(
        replace(chosen, spectra=spectra),
        unit,
        tuple(replace(c, level=c.level / n) for c, n in zip(used, noise, strict=True)),
        [s.free.copy() for s in spectra],
        min(2 * t.frequency * t.damping_ratio for t in seen),
    )


def _alike(spectra: Sequence[CrossSpectrum]) -> list[list[int]]:
    """Group the indices of spectra that have the same frequencies."""
    groups: dict[tuple[float, int], list[int]] = {}
    for i, spectrum in enumerate(spectra):
        groups.setdefault((spectrum.duration, spectrum.frequency.size), []).append(i)
    return list(groups.values())


def _fit_and_prune(
    band: _Band, seen: tuple[Target, ...], gains: dict[str, float], missing: Missing
) -> tuple[_Solution, tuple[Target, ...]]:
    """Fit all modes seen; leave out, one by one, those that the evidence does not ask for."""
    n_ordinates = sum(
        s.count * int(mask.sum()) for s, mask in zip(band.view.spectra, band.masks, strict=True)
    )

    def evidence(full: _Solution, less: _Solution) -> float:
        """Twice the log evidence (BIC) for what one solution has and the other has not."""
        extra = full.p.size - less.p.size
        return float(2 * (less.misfit - full.misfit) - extra * np.log(n_ordinates))

    blocks = _blocks(band, merge=True)
    solution = _solve(band, blocks, seen)
    while seen:
        doubtful = [i for i, t in enumerate(seen) if gains[t.name] < _BEYOND_DOUBT]
        without = {i: _solve(band, blocks, seen[:i] + seen[i + 1 :]) for i in doubtful}
        for_mode = {i: evidence(solution, w) - _EVIDENCE_MARGIN for i, w in without.items()}
        worst = min(for_mode, key=lambda i: for_mode[i], default=None)
        if worst is None or for_mode[worst] >= 0:
            break
        missing[seen[worst].name] = _absent(seen[worst], gains[seen[worst].name])
        seen, solution = seen[:worst] + seen[worst + 1 :], without[worst]
    return solution, seen


def _blocks(band: _Band, *, merge: bool) -> tuple[Block, ...]:
    spectra = band.view.spectra
    return tuple(
        make_block(
            [spectra[i] for i in group],
            [band.masks[i] for i in group],
            band.width,
            merge=merge,
        )
        for group in _alike(spectra)
    )


def _solve(band: _Band, blocks: tuple[Block, ...], targets: tuple[Target, ...]) -> _Solution:
    """Find the posterior mode for a set of modes by a trust-region Newton method."""
    n_channels = len(band.coarse)
    zeta = np.array([target.damping_ratio for target in targets])
    # A strength of zero would leave a mode without a gradient.
    amplitude = np.sqrt(
        [
            np.maximum(c.strengths(targets)[0], 0.01 * c.level.min() * 4 * zeta**2)
            for c in band.coarse
        ]
    )
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
                _sign(blocks, targets[i], c, reference[i]) * amplitude[c, i] / scale[i]
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
    return _Solution(likelihood, p, likelihood.data_value(p))


def _sign(blocks: tuple[Block, ...], target: Target, channel: int, reference: int) -> float:
    """Tell whether two channels move alike where a mode stands."""
    low, high = target.band(_NEAR)
    alike = 0.0
    for block in blocks:
        near = (block.frequency >= low) & (block.frequency <= high)
        alike += float(block.count[near] @ block.matrix[near, channel, reference].real)
    return 1.0 if alike >= 0 else -1.0


def _mask_towers(band: _Band) -> None:
    """Mask lines that tower over the medians around them, before a mode can settle on one.

    A mode that takes a strong line for its resonance leaves its own to its neighbour, which then
    bears the wrong name. Twice the threshold leaves room for what the bins do not resolve. A lone
    mode whose damping is below about 1/15 of its nominal one stands as narrow as a line, and may
    lose its own peak.
    """
    levels = [
        np.stack([np.interp(s.frequency, c.frequency, c.level) for c in band.coarse], axis=-1)
        for s in band.view.spectra
    ]
    _mask_above(band, [2 * level for level in levels])


def _mask_lines(band: _Band, expected: list[ComplexArray]) -> bool:
    """Mask ordinates that noise would not reach; tell whether there were new ones."""
    return _mask_above(band, [np.diagonal(e, axis1=1, axis2=2).real for e in expected])


def _mask_above(band: _Band, levels: list[FloatArray]) -> bool:
    """Mask lines with their feet, wherever a channel shows one; tell whether there were any.

    ``levels`` holds what noise would have in the mean, shape ``(n_ordinates, n_channels)`` each.
    """
    n_tests = len(band.coarse) * sum(int(mask.sum()) for mask in band.masks)
    kept = [mask.copy() for mask in band.masks]
    found = False
    for spectrum, keep, level in zip(band.view.spectra, kept, levels, strict=True):
        highest = gamma.isf(_LINE_FALSE_ALARM / n_tests, spectrum.count) / spectrum.count
        ordinates = np.diagonal(spectrum.matrix, axis1=1, axis2=2).real
        lines = keep & (ordinates > highest * level).any(axis=1)
        found = found or bool(lines.any())
        for k in np.flatnonzero(lines).tolist():
            keep[max(0, k - _LINE_BINS) : k + _LINE_BINS + 1] = False
    # A band that is mostly lines is no band of modes: keep at least half of it.
    if sum(int(keep.sum()) for keep in kept) < sum(int(mask.sum()) for mask in band.masks) // 2:
        return False
    band.masks[:] = kept
    return found


def _expected(band: _Band, solution: _Solution) -> list[ComplexArray]:
    """Give what each spectrum is expected to be over its band; infinite where it is masked."""
    likelihood = replace(solution.likelihood, blocks=_blocks(band, merge=False))
    n_channels = len(band.coarse)
    nothing = np.diag(np.full(n_channels, np.inf)).astype(complex)
    full = [np.tile(nothing, (mask.size, 1, 1)) for mask in band.masks]
    for group, values in zip(
        _alike(band.view.spectra), likelihood.expected(solution.p), strict=True
    ):
        kept = np.any([band.masks[i] for i in group], axis=0)
        for i in group:
            full[i][kept] = values
    return full


def _conclude(
    band: _Band, seen: tuple[Target, ...], solution: _Solution, missing: Missing
) -> BandFit | None:
    """Turn the posterior into estimates with their covariance."""
    m, p, likelihood = len(seen), solution.p, solution.likelihood
    estimate, cov, decrement = marginalise(likelihood, p)
    if not decrement < _WORST_DECREMENT:
        detail = f"the fit did not reach a maximum (decrement {decrement:.2g}); record longer"
        missing.update({t.name: ("not-identified", detail) for t in seen})
        return None
    ratio = likelihood.signal_to_noise(p)
    names = band.view.channels
    return BandFit(
        view=band.view,
        targets=seen,
        estimate=estimate,
        cov=cov,
        snr=ratio.sum(axis=0),
        best=tuple(names[c] for c in ratio.argmax(axis=0)),
        clarity=np.full(m, np.nan),
        lines=(),
        residual=band.view.spectra[0].channel(0),
    )


def _residual(band: _Band, expected: list[ComplexArray]) -> Spectrum:
    """Compare the ordinates that saw most with what is expected: tr E⁻¹ W over the channels."""
    most = _most(band.view.spectra)
    spectrum, mask = band.view.spectra[most], band.masks[most]
    n_channels = len(band.coarse)
    ratio = np.ones(mask.size)
    white = np.linalg.solve(expected[most][mask], spectrum.matrix[mask])
    ratio[mask] = np.trace(white, axis1=1, axis2=2).real / n_channels
    return replace(spectrum.channel(0), periodogram=ratio, count=spectrum.count * n_channels)


def _most(spectra: Sequence[CrossSpectrum]) -> int:
    """Index of the spectrum that saw most."""
    return int(np.argmax([s.observed for s in spectra]))


def _lines(band: _Band) -> tuple[Sighting, ...]:
    """Tell what was masked where most was seen, in the channels that show it best."""
    most = _most(band.view.spectra)
    masked = band.view.spectra[most].free & ~band.masks[most]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], masked.astype(int), [0]])))
    return tuple(
        _sighting(band.view, band.unit, int(a), int(b))
        for a, b in zip(edges[::2], edges[1::2], strict=True)
    )


def _sighting(view: View, unit: FloatArray, first: int, last: int) -> Sighting:
    """Read a line within some ordinates, from the channel in which it stands out most."""
    spectrum = view.spectra[_most(view.spectra)]
    power = np.diagonal(spectrum.matrix[first:last], axis1=1, axis2=2).real.sum(axis=0)
    c = int(np.argmax(power))
    frequency, amplitude = spectrum.channel(c).sine(first, last)
    return Sighting(view.channels[c], frequency, amplitude * float(unit[c]))


def _keep_credible(fit: BandFit, unit: FloatArray, missing: Missing) -> BandFit:
    """Refuse modes whose estimate cannot be what it claims to be; what is a line becomes one."""
    m = len(fit.targets)
    f = np.exp(fit.estimate[:m])
    spectrum = fit.view.spectra[_most(fit.view.spectra)]
    keep, lines = [], [*fit.lines]
    for i, target in enumerate(fit.targets):
        why = _incredible(fit, i, spectrum.duration)
        if why is None:
            keep.append(target.name)
            continue
        missing[target.name] = why
        if why[0] == "line-not-mode":
            k = int(np.searchsorted(spectrum.frequency, f[i]))
            lines.append(_sighting(fit.view, unit, max(0, k - _LINE_BINS), k + _LINE_BINS + 1))
    return replace(fit.only(keep), lines=tuple(lines))


def _incredible(fit: BandFit, i: int, duration: float) -> tuple[str, str] | None:
    """Say why a mode's estimate is not believed; None when it is."""
    m = len(fit.targets)
    target, channel = fit.targets[i], fit.best[i]
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
