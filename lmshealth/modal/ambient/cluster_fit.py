"""Fit a cluster of neighbouring modes to all channels at once, and say which of them are there.

The band of a cluster: what of a log it is fitted to, and the lines that are kept out of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter
from scipy.stats import gamma

from lmshealth._arrays import BoolArray, ComplexArray, FloatArray
from lmshealth.modal.ambient.expected_periodogram import Block, make_block
from lmshealth.modal.ambient.initial_values import (
    Coarse,
    misfits,
    strengths,
)
from lmshealth.modal.ambient.marginalisation import marginalise
from lmshealth.modal.ambient.whittle import Likelihood, lay_out
from lmshealth.modal.targets import WORST_STD_LN_F, WORST_STD_LN_ZETA, Target
from lmshealth.signal.constants import LINE_WIDTH
from lmshealth.signal.spectra import CrossSpectrum, Spectrum, median_ordinate
from lmshealth.stage.constants import BAND

# Probability that noise alone makes a line somewhere in the band.
_LINE_FALSE_ALARM = 1e-3
LINE_BINS = 2
_BESIDE = 41  # ordinates: a line is less than half as wide
# Binned log likelihood gained by a mode below which it is absent.
ABSENT = 3.0
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
        rows, columns = np.ix_(index, index)
        return View(
            tuple(self.channels[c] for c in index),
            tuple(self.sources[c] for c in index),
            tuple(replace(s, matrix=s.matrix[:, rows, columns]) for s in self.spectra),
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
class Band:
    """What a cluster is fitted to; its masks grow as lines are found.

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
    """

    view: View
    unit: FloatArray
    coarse: tuple[Coarse, ...]
    masks: list[BoolArray]


def prepare(view: View, coarse: tuple[Coarse, ...], seen: tuple[Target, ...]) -> Band:
    """Choose the channels that see any of the modes, and put each in units of its noise."""
    gains = misfits(coarse, ()) - misfits(coarse, seen)
    index = [c for c, gain in enumerate(gains) if gain >= ABSENT] or [int(np.argmax(gains))]
    used = [coarse[c] for c in index]
    noise = np.maximum(strengths(used, seen)[1], [1e-2 * c.level.min() for c in used])
    unit = np.sqrt(noise)
    chosen = view.only(index)
    spectra = tuple(replace(s, matrix=s.matrix / np.outer(unit, unit)) for s in chosen.spectra)
    return Band(
        replace(chosen, spectra=spectra),
        unit,
        tuple(replace(c, level=c.level / n) for c, n in zip(used, noise, strict=True)),
        [s.free.copy() for s in spectra],
    )


def alike(spectra: Sequence[CrossSpectrum]) -> list[list[int]]:
    """Group the indices of spectra that have the same frequencies."""
    groups: dict[tuple[float, int], list[int]] = {}
    for i, spectrum in enumerate(spectra):
        groups.setdefault((spectrum.duration, spectrum.frequency.size), []).append(i)
    return list(groups.values())


def make_blocks(
    band: Band, bandwidth: float, near: Sequence[float] | None = None
) -> tuple[Block, ...]:
    """Prepare the ordinates for the likelihood; ``bandwidth`` and ``near`` as in `make_block`."""
    spectra = band.view.spectra
    return tuple(
        make_block(
            [spectra[i] for i in group], [band.masks[i] for i in group], bandwidth, near=near
        )
        for group in alike(spectra)
    )


def sign(blocks: tuple[Block, ...], target: Target, channel: int, reference: int) -> float:
    """Tell whether two channels move alike where a mode stands."""
    low, high = target.band(_NEAR)
    alike = 0.0
    for block in blocks:
        near = (block.frequency >= low) & (block.frequency <= high)
        alike += float(block.count[near] @ block.matrix[near, channel, reference].real)
    return 1.0 if alike >= 0 else -1.0


def mask_towers(band: Band) -> None:
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


def mask_lines(band: Band, expected: list[ComplexArray]) -> bool:
    """Mask ordinates that noise would not reach; tell whether there were new ones."""
    levels = [
        _beside(spectrum, np.diagonal(e, axis1=1, axis2=2).real)
        for spectrum, e in zip(band.view.spectra, expected, strict=True)
    ]
    return _mask_above(band, levels)


def _beside(spectrum: CrossSpectrum, expected: FloatArray) -> FloatArray:
    """Raise what a mean is expected to be to the level about it: what a fit lacks is no line.

    A single periodogram scatters too much for that, and lines tower over what its fit lacks.
    """
    if spectrum.count == 1:
        return expected
    ordinates = np.diagonal(spectrum.matrix, axis1=1, axis2=2).real
    ratio = ordinates / expected / median_ordinate(spectrum.count)
    return np.asarray(expected * median_filter(ratio, (_BESIDE, 1)).clip(1.0))


def _mask_above(band: Band, levels: list[FloatArray]) -> bool:
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
            keep[max(0, k - LINE_BINS) : k + LINE_BINS + 1] = False
    # A band that is mostly lines is no band of modes: keep at least half of it.
    if sum(int(keep.sum()) for keep in kept) < sum(int(mask.sum()) for mask in band.masks) // 2:
        return False
    band.masks[:] = kept
    return found


def index_of_most(spectra: Sequence[CrossSpectrum]) -> int:
    """Index of the spectrum that saw most."""
    return int(np.argmax([s.observed for s in spectra]))


def find_sightings(band: Band) -> tuple[Sighting, ...]:
    """Tell what was masked where most was seen, in the channels that show it best."""
    most = index_of_most(band.view.spectra)
    masked = band.view.spectra[most].free & ~band.masks[most]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], masked.astype(int), [0]])))
    return tuple(
        read_sighting(band.view, band.unit, int(a), int(b))
        for a, b in zip(edges[::2], edges[1::2], strict=True)
    )


def read_sighting(view: View, unit: FloatArray, first: int, last: int) -> Sighting:
    """Read a line within some ordinates, from the channel in which it stands out most."""
    spectrum = view.spectra[index_of_most(view.spectra)]
    power = np.diagonal(spectrum.matrix[first:last], axis1=1, axis2=2).real.sum(axis=0)
    c = int(np.argmax(power))
    frequency, amplitude = spectrum.channel(c).sine(first, last)
    return Sighting(view.channels[c], frequency, amplitude * float(unit[c]))


_MOST_LINE_ROUNDS = 4
# Binned log likelihood gained by a mode: above this it is beyond doubt, between `ABSENT` and this
# it is fitted both ways.
_BEYOND_DOUBT = 60.0
_EVIDENCE_MARGIN = 10.0
# A damping off its start by more than this factor belongs to something else.
_DAMPING_SPAN = 6.0
# Variance of what a fit leaves, over that of noise, from which on it is called loose or not
# believed, and the ordinates that must be there to tell.
_LOOSE, _WORST_DISPERSION, _LEAST_TO_COMPARE = 1.5, 3.0, 30
# Fourier frequencies in the half-power bandwidth below which the resolution limits the damping, and
# share of the search beyond which an estimate is at its bound.
_RESOLVED, _AT_BOUND = 4.0, 0.9
# Bins made for a resonance are fine enough for one that is narrower by this factor.
_NARROWER = 0.7
# Newton decrement of a fit that has arrived.
_WORST_DECREMENT = 0.1
_HEAVY = 0.1  # and above this, a hump that nobody expected is no mode


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
    shapes : ndarray
        How far each mode moves each channel, in units of its noise; one in the channel that it
        moves most, shape ``(n_channels, n_modes)``.
    unit : ndarray
        Root of the noise of each channel in (m/s²)/Hz^½, shape ``(n_channels,)``.
    snr : ndarray
        Modal signal-to-noise ratio of all channels together, shape ``(n_modes,)``.
    dispersion : ndarray
        Variance of what the fit leaves about each mode over that of noise, shape ``(n_modes,)``.
    flags : tuple of str
        As in `Modes`.
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
    shapes: FloatArray
    unit: FloatArray
    snr: FloatArray
    dispersion: FloatArray
    flags: tuple[str, ...]
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
            shapes=self.shapes[:, index],
            snr=self.snr[index],
            dispersion=self.dispersion[index],
            flags=tuple(self.flags[i] for i in index),
            best=tuple(self.best[i] for i in index),
            clarity=self.clarity[index],
        )


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
    n, needed = sum(int(s.free.sum()) for s in cut.spectra), 10 + 6 * len(seen)
    if n < needed:
        detail = f"{n} Fourier frequencies in the band hold no line, needed {needed}: record longer"
        return None, missing | {t.name: ("too-short", detail) for t in seen}
    band = prepare(cut, coarse, seen)
    mask_towers(band)
    for _ in range(_MOST_LINE_ROUNDS):
        solution, seen = _fit_and_prune(band, seen, gains, missing)
        if not seen:
            return None, missing
        expected = _expected(band, solution)
        if not mask_lines(band, expected):
            break
    fit = _conclude(band, seen, solution, expected, gains, missing)
    if fit is None:
        return None, missing
    return _keep_credible(fit, band.unit, missing), missing


def _absent(target: Target, gain: float) -> tuple[str, str]:
    return (
        "not-excited",
        f"no resonance near {target.frequency:.4g} Hz in any channel: it would improve the log "
        f"likelihood by {max(gain, 0):.1f}; excite it more or record longer",
    )


def _misfit(coarse: Sequence[Coarse], targets: tuple[Target, ...]) -> float:
    return float(misfits(coarse, targets).sum())


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
        if losses[worst] >= ABSENT:
            break
        kept = kept[:worst] + kept[worst + 1 :]
    return kept, gains


def _fit_and_prune(
    band: Band, seen: tuple[Target, ...], gains: dict[str, float], missing: Missing
) -> tuple[_Solution, tuple[Target, ...]]:
    """Fit all modes seen; leave out, one by one, those that the evidence does not ask for."""
    n_ordinates = sum(
        s.count * int(mask.sum()) for s, mask in zip(band.view.spectra, band.masks, strict=True)
    )

    def evidence(full: _Solution, less: _Solution) -> float:
        """Twice the log evidence (BIC) for what one solution has and the other has not."""
        extra = full.p.size - less.p.size
        return float(2 * (less.misfit - full.misfit) - extra * np.log(n_ordinates))

    bandwidth = min(2 * t.frequency * t.damping_ratio for t in seen)
    blocks = make_blocks(band, bandwidth, [target.frequency for target in seen])
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
    return _refined(band, solution, seen) if seen else solution, seen


def _refined(band: Band, solution: _Solution, seen: tuple[Target, ...]) -> _Solution:
    """Go on with bins as fine as the resonances ask for that were found, if they are not yet."""
    m = len(seen)
    f, zeta = np.exp(solution.p[:m]), np.exp(solution.p[m : 2 * m])
    bandwidth, expected = 2 * zeta * f, [2 * t.frequency * t.damping_ratio for t in seen]
    apart = np.abs(f - [target.frequency for target in seen])
    if (apart < bandwidth / 2).all() and bandwidth.min() > _NARROWER * min(expected):
        return solution
    least = max(float(bandwidth.min()), min(expected) / _DAMPING_SPAN)
    blocks = make_blocks(band, least, f.tolist())
    likelihood = replace(solution.likelihood, blocks=blocks)
    p = likelihood.minimise(solution.p)
    return _Solution(likelihood, p, likelihood.data_value(p))


def _solve(band: Band, blocks: tuple[Block, ...], targets: tuple[Target, ...]) -> _Solution:
    """Find the posterior mode for a set of modes by a trust-region Newton method."""
    n_channels = len(band.coarse)
    zeta = np.array([target.damping_ratio for target in targets])
    # A strength of zero would leave a mode without a gradient.
    least = np.outer([0.01 * channel.level.min() for channel in band.coarse], 4 * zeta**2)
    amplitude = np.sqrt(np.maximum(strengths(band.coarse, targets)[0], least))
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
                sign(blocks, targets[i], c, reference[i]) * amplitude[c, i] / scale[i]
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


def _expected(band: Band, solution: _Solution) -> list[ComplexArray]:
    """Give what each spectrum is expected to be over its band; infinite where it is masked."""
    m = solution.likelihood.layout.n_modes
    bandwidth = float(np.min(2 * np.exp(solution.p[:m] + solution.p[m : 2 * m])))
    likelihood = replace(solution.likelihood, blocks=make_blocks(band, bandwidth))
    n_channels = len(band.coarse)
    nothing = np.diag(np.full(n_channels, np.inf)).astype(complex)
    full = [np.tile(nothing, (mask.size, 1, 1)) for mask in band.masks]
    for group, values in zip(
        alike(band.view.spectra), likelihood.expected(solution.p), strict=True
    ):
        kept = np.any([band.masks[i] for i in group], axis=0)
        for i in group:
            full[i][kept] = values
    return full


def _conclude(
    band: Band,
    seen: tuple[Target, ...],
    solution: _Solution,
    expected: list[ComplexArray],
    gains: dict[str, float],
    missing: Missing,
) -> BandFit | None:
    """Turn the posterior into estimates with their covariance, and look at what is left over."""
    p, likelihood = solution.p, solution.likelihood
    estimate, cov, decrement = marginalise(likelihood, p)
    if not decrement < _WORST_DECREMENT:
        detail = f"the fit did not reach a maximum (decrement {decrement:.2g}); record longer"
        missing.update({t.name: ("not-identified", detail) for t in seen})
        return None
    f, zeta = np.exp(estimate).reshape(2, -1)
    ratio = likelihood.signal_to_noise(p)
    names = band.view.channels
    residual = _residual(band, expected)
    dispersion = _dispersion(residual, f, zeta)
    modes = zip(seen, f.tolist(), zeta.tolist(), dispersion.tolist(), strict=True)
    return BandFit(
        view=band.view,
        targets=seen,
        estimate=estimate,
        cov=cov,
        shapes=likelihood.shapes(p),
        unit=band.unit,
        snr=ratio.sum(axis=0),
        dispersion=dispersion,
        flags=tuple(_flags(*mode, residual.duration) for mode in modes),
        best=tuple(names[c] for c in ratio.argmax(axis=0)),
        clarity=np.array([gains[target.name] for target in seen]),
        lines=find_sightings(band),
        residual=residual,
    )


def _residual(band: Band, expected: list[ComplexArray]) -> Spectrum:
    """Compare the ordinates that saw most with what is expected: tr E⁻¹ W over the channels."""
    most = index_of_most(band.view.spectra)
    spectrum, mask = band.view.spectra[most], band.masks[most]
    n_channels = len(band.coarse)
    ratio = np.ones(mask.size)
    white = np.linalg.solve(expected[most][mask], spectrum.matrix[mask])
    ratio[mask] = np.trace(white, axis1=1, axis2=2).real / n_channels
    return replace(spectrum.channel(0), periodogram=ratio, count=spectrum.count * n_channels)


def _dispersion(residual: Spectrum, f: FloatArray, zeta: FloatArray) -> FloatArray:
    """Compare the scatter of what is left within two half-power bandwidths with that of noise."""
    off = np.abs(residual.frequency - f[:, None])
    near = (off < 2 * (zeta * f)[:, None]) & (residual.periodogram != 1.0)
    left = residual.count * (residual.periodogram - 1.0) ** 2
    n = near.sum(axis=1)
    return np.where(n >= _LEAST_TO_COMPARE, near @ left / n.clip(1), np.nan)


def _flags(target: Target, f: float, zeta: float, dispersion: float, duration: float) -> str:
    """Name what to bear in mind of a mode in segments of this duration."""
    shift = abs(np.log(f / (target.nominal or target.frequency))) / np.log1p(target.search)
    low, high = _damping_span(target)
    flags = {
        "resolution-limited": 2 * zeta * f * duration < _RESOLVED,
        "at-bound": shift > _AT_BOUND or not low / _AT_BOUND < zeta < high * _AT_BOUND,
        "loose-fit": dispersion > _LOOSE,
    }
    return " ".join(name for name, raised in flags.items() if raised)


def _damping_span(target: Target) -> tuple[float, float]:
    """Give the dampings that are believed of a target."""
    zeta = target.damping_ratio
    return zeta / _DAMPING_SPAN, min(zeta * _DAMPING_SPAN, max(_HEAVY, 2 * zeta))


def _keep_credible(fit: BandFit, unit: FloatArray, missing: Missing) -> BandFit:
    """Refuse modes whose estimate cannot be what it claims to be; what is a line becomes one."""
    m = len(fit.targets)
    f = np.exp(fit.estimate[:m])
    spectrum = fit.view.spectra[index_of_most(fit.view.spectra)]
    keep, lines = [], [*fit.lines]
    for i, target in enumerate(fit.targets):
        why = _incredible(fit, i, spectrum.duration)
        if why is None:
            keep.append(target.name)
            continue
        missing[target.name] = why
        if why[0] == "line-not-mode":
            k = int(np.searchsorted(spectrum.frequency, f[i]))
            lines.append(read_sighting(fit.view, unit, max(0, k - LINE_BINS), k + LINE_BINS + 1))
    return replace(fit.only(keep), lines=tuple(lines))


def _incredible(fit: BandFit, i: int, duration: float) -> tuple[str, str] | None:
    """Say why a mode's estimate is not believed; None when it is."""
    m = len(fit.targets)
    target, channel = fit.targets[i], fit.best[i]
    f, zeta = float(np.exp(fit.estimate[i])), float(np.exp(fit.estimate[m + i]))
    std_f, std_zeta = np.sqrt(np.diag(fit.cov))[[i, m + i]].tolist()
    low, high = _damping_span(target)
    if 2 * zeta * f * duration < 1:
        return (
            "line-not-mode",
            f"{f:.5g} Hz in {channel} is narrower ({2 * zeta * f:.2g} Hz) than a record of "
            f"{duration:.3g} s resolves",
        )
    if target.nominal is None and 2 * zeta < LINE_WIDTH:
        return "line-not-mode", f"{f:.5g} Hz in {channel} is as narrow as a line that wanders"
    if fit.dispersion[i] > _WORST_DISPERSION:
        return (
            "poor-fit",
            f"what the fit leaves about {f:.5g} Hz scatters {fit.dispersion[i]:.1f} times as much "
            "as noise: lines, unsteady running or a strike; choose a steadier part of the log",
        )
    sought = target.nominal or target.frequency
    if abs(np.log(f / sought)) > np.log1p(target.search) or not low < zeta < high:
        return (
            "outside-search",
            f"the fit in {channel} went to {f:.5g} Hz, damping {zeta:.2g}; sought within "
            f"{100 * target.search:.0f} % of {sought:.5g} Hz, damping from {low:.2g} "
            f"to {high:.2g}",
        )
    if std_f > WORST_STD_LN_F or std_zeta > WORST_STD_LN_ZETA:
        return (
            "too-uncertain",
            f"{f:.5g} Hz in {channel} is known to {100 * std_f:.2g} % only, its damping to "
            f"{100 * std_zeta:.0f} %; record longer or excite more",
        )
    return None
