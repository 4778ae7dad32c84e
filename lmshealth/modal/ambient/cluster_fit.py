"""Joint fit of a cluster of neighbouring modes to all channels of a log.

`fit_modes` masks spectral lines, maximises the posterior, prunes modes without evidence,
marginalises, and rejects estimates that are not credible.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.ndimage import binary_dilation, find_objects, label, median_filter
from scipy.special import gammainccinv

from lmshealth._private.arrays import BoolArray, ComplexArray, FloatArray
from lmshealth.modal import constants
from lmshealth.modal.ambient.cluster_modes import (
    ClusterFit,
    ClusterModes,
    FittedSpectrum,
    LineEstimate,
)
from lmshealth.modal.ambient.excitation import Colour, average_colours, unsteadiness
from lmshealth.modal.ambient.expected_periodogram import MeanOrdinates, average_ordinates
from lmshealth.modal.ambient.whittle import Likelihood, lay_out, marginalise, response
from lmshealth.modal.modes import Modes, Rejection, paired
from lmshealth.modal.targets import Target
from lmshealth.signal.constants import LINE_WIDTH
from lmshealth.signal.spectra import CrossSpectrum, LogSpectra, median_ordinate
from lmshealth.stage.description import search_offset

# So many channels are fitted as they are; of more, directions that leave so much of each mode.
_FEW, _SEEN = 4, 0.9
# Part of a shape in quadrature that adds a direction.
_QUADRATURE = 0.05
# Ordinates at which directions are compared, at most.
_MOST_COMPARED = 200
# Half-power bandwidth in Fourier frequencies below which a pole is a line.
_COLLAPSED = 0.1
# That with which a pole begins anew beside a line.
_BEGINS = 5.0
# Ordinates over which the level near a line is taken, and that it covers to either side.
_LINE_NEIGHBOURS, _LINE_BINS = 41, 2
_MOST_LINE_ROUNDS = 4
# Ordinates times unknowns of a fit with finer bins.
_MOST_SLOPES = 400_000
# Loss of log likelihood without a mode, all others fixed, below which it is fitted without.
_DOUBTFUL = 200.0
# Shift by a coloured force, in standard deviations, from which on that for a white one counts.
_FAR = 4.0
# Change of ln ζ from the joint model of the band beyond which parts in quadrature are left out.
_OTHER_DAMPING = 0.5
# The bins of a first fit resolve this part of the median bandwidth.
_FINER = 2.0
# Bins made for an expected bandwidth suffice for one that is narrower by this factor.
_NARROWER = 0.7


@dataclass(frozen=True, slots=True, eq=False)
class ClusterData:
    """Data that a cluster is fitted to: the band of the channels that show any of the modes.

    Of many channels a fit sees the directions in which the modes move, or anything foreign does.
    """

    whole: LogSpectra  # of the channels, in units of the noise of each
    unit: FloatArray  # root of the noise in (m/s²)/Hz^½, (n_channels,)
    basis: FloatArray  # orthonormal directions that are fitted, (n_channels, n_directions)
    spectra: LogSpectra  # of the directions
    masks: tuple[BoolArray, ...]  # ordinates of each spectrum without lines
    index: tuple[int, ...]  # the channels among those of the log
    static: float = 0.0  # static response of modes that is expected
    out_of_phase: bool = False  # whether shapes and forces may have parts in quadrature

    @property
    def duration(self) -> float:
        """Duration of the longest segment in s."""
        return self.spectra.spectra[self.longest].duration

    @property
    def longest(self) -> int:
        """Index of the spectrum with the longest observation."""
        return int(np.argmax([s.observed for s in self.spectra.spectra]))


@dataclass(frozen=True, slots=True, eq=False)
class _Optimum:
    """Posterior mode of some modes: unknowns ``p`` and negative log likelihood."""

    targets: tuple[Target, ...]
    likelihood: Likelihood
    p: FloatArray
    misfit: float
    near: FloatArray  # resonances in Hz that its bins are fine at
    bandwidth: float  # that these bins resolve, in Hz

    @property
    def n_counted(self) -> int:
        """Number of unknowns without those in quadrature, whose prior is in `penalised`."""
        return self.p.size - len(self.likelihood.layout.quadrature)

    @property
    def penalised(self) -> float:
        """Negative log likelihood with the prior of the unknowns in quadrature."""
        off = self.likelihood.layout.quadrature
        return self.misfit + 0.5 * float(np.sum((self.p / self.likelihood.prior_std)[off] ** 2))

    @property
    def poles(self) -> FloatArray:
        """Natural frequencies in Hz and damping ratios, shape ``(2, n_modes)``."""
        m = len(self.targets)
        return np.asarray(np.exp(self.p[: 2 * m].reshape(2, m)))


def needed_ordinates(n_modes: int) -> int:
    """Return the least number of Fourier frequencies of a fit."""
    return 10 + 6 * n_modes


def fit_modes(
    spectra: LogSpectra,
    targets: tuple[Target, ...],
    band: tuple[float, float],
    noise: FloatArray,
    static: float = 0.0,
    *,
    out_of_phase: bool = False,
) -> ClusterFit:
    """Fit modes that a search found in a band in Hz: mask lines, drop modes without evidence.

    ``noise`` is its density in each channel without foreign modes, in (m/s²)²/Hz, ``static`` the
    expected static response of the modes over their shapes, ``out_of_phase`` whether the search
    found parts in quadrature.
    """
    data = replace(prepare(spectra, targets, band, noise), static=static, out_of_phase=out_of_phase)
    n, needed = sum(int(mask.sum()) for mask in data.masks), needed_ordinates(len(targets))
    if n < needed:
        detail = f"{n} Fourier frequencies in the band hold no line, needed {needed}: record longer"
        short = {t.name: Rejection("too-short", detail, t.frequency) for t in targets}
        return ClusterFit(None, short)
    collapsed: dict[str, Rejection] = {}
    for _ in range(_MOST_LINE_ROUNDS):
        data, optimum, lines = _fit_beside_lines(data, targets)
        collapsed |= lines
        if optimum is None:
            return ClusterFit(None, collapsed)
        targets = optimum.targets
        expected = _expected(data, optimum)
        before, data = data, mask_residual_lines(data, expected)
        if data is before:
            break
    assert optimum is not None  # there is at least one round
    fit = _conclude(data, optimum, expected)
    return replace(fit, rejected=fit.rejected | collapsed)


def _fit_beside_lines(
    data: ClusterData, targets: tuple[Target, ...]
) -> tuple[ClusterData, _Optimum | None, dict[str, Rejection]]:
    """Fit modes, and mask lines that poles become; None where no mode is left.

    A pole begins anew beside the first line that it became, as a mode may be there, too.
    """
    begun: set[str] = set()
    rejected: dict[str, Rejection] = {}
    while targets:
        optimum = _fit_and_prune(data, targets)
        lines = optimum.likelihood.collapsed(optimum.p)
        if not lines:
            return data, optimum, rejected
        data = _mask_at(data, optimum, lines)
        left = list(optimum.targets)
        for i, f in zip(lines, optimum.poles[0][lines].tolist(), strict=True):
            name, duration = left[i].name, data.duration
            if name in begun:
                detail = f"{f:.5g} Hz is narrower than a record of {duration:.3g} s resolves"
                rejected[name] = Rejection("line-not-mode", detail, f)
            least = _BEGINS / (2 * f * duration)
            left[i] = replace(left[i], damping_ratio=max(left[i].damping_ratio, least))
            begun.add(name)
        targets = tuple(t for t in left if t.name not in rejected)
    return data, None, rejected


def _fit_and_prune(data: ClusterData, targets: tuple[Target, ...]) -> _Optimum:
    """Fit all modes, and drop those without evidence, the least likely first.

    Modes are tried without whose loss, all others fixed, is small; one that left its start is
    dropped, and one mode stays.
    """

    def solved(some: tuple[Target, ...]) -> _Optimum:
        f = np.array([t.frequency for t in some])
        widths = [2 * t.frequency * t.damping_ratio for t in some]
        # A pole that is narrow by error, as beside a line, would need the finest bins.
        bandwidth = max(min(widths), sorted(widths)[len(widths) // 2] / _FINER)
        return _solve(data, some, f, bandwidth)

    pairs = zip(data.spectra.spectra, data.masks, strict=True)
    n_ordinates = sum(spectrum.count * int(mask.sum()) for spectrum, mask in pairs)
    optimum = solved(targets)
    while len(targets := optimum.targets) > 1 and not optimum.likelihood.collapsed(optimum.p):
        lost = _escaped(optimum)
        doubtful = lost or [i for i, x in enumerate(_losses(optimum)) if x < _DOUBTFUL]
        worst, least = None, constants.EVIDENCE_MARGIN
        for i in doubtful:
            less = solved(targets[:i] + targets[i + 1 :])
            # Twice the log evidence (BIC) for the mode.
            extra = optimum.n_counted - less.n_counted
            evidence = 2 * (less.penalised - optimum.penalised) - extra * np.log(n_ordinates)
            if lost or evidence < least:
                worst, least = less, evidence
        if worst is None:
            break
        optimum = worst
    return _refined(data, optimum)


def _escaped(optimum: _Optimum) -> list[int]:
    """Return the mode that left its start furthest, if one did by more than three bandwidths."""
    f, zeta = optimum.poles
    start = np.array([[t.frequency, t.damping_ratio] for t in optimum.targets]).T
    left = np.abs(np.log(f / start[0])) / np.maximum(2 * start[1], 2e-3)
    left[zeta > constants.MOST_DAMPING] = np.inf
    return [int(left.argmax())] if left.max() > 3 else []


def _losses(optimum: _Optimum) -> list[float]:
    """Loss of log likelihood without each mode, all others fixed."""
    lay = optimum.likelihood.layout
    losses = []
    for i in range(lay.n_modes):
        p = optimum.p.copy()
        for a, (row, column) in enumerate(lay.force):
            if i in (row, column):
                p[lay.forces.start + a] = 0.0
        losses.append(optimum.likelihood.data_value(p) - optimum.misfit)
    return losses


def prepare(
    spectra: LogSpectra, targets: tuple[Target, ...], band: tuple[float, float], noise: FloatArray
) -> ClusterData:
    """Cut out the band of the channels that show any of the modes; arguments as in `fit_modes`."""
    cut = spectra.each(lambda spectrum: spectrum.band(*band))
    cut = replace(cut, spectra=tuple(s for s in cut.spectra if s.frequency.size))
    gain = _expected_gain(cut, targets, noise)
    index = np.flatnonzero(gain >= constants.ABSENT).tolist() or [int(gain.argmax())]
    unit = np.sqrt(noise[index])
    cut = chosen = cut.select(index).each(partial(_over, unit=unit))
    basis = np.eye(unit.size)
    if unit.size > _FEW:
        basis = _directions(_motions(targets)[index] / unit[:, None], cut)
    if basis.shape[1] < unit.size:
        names = tuple(f"direction {k}" for k in range(basis.shape[1]))
        chosen = cut.each(partial(CrossSpectrum.project, basis=basis))
        chosen = replace(chosen, channels=names, sources=(cut.source,) * len(names))
    else:
        basis = np.eye(unit.size)
    masks = tuple(s.free for s in chosen.spectra)
    return ClusterData(cut, unit, basis, chosen, masks, tuple(index))


def _motions(targets: Sequence[Target]) -> ComplexArray:
    """Return the amplitudes of targets that a search found, ``(n_channels, n_modes)``."""
    return np.stack([t.amplitude for t in targets if t.amplitude is not None], axis=1)


def _expected_gain(spectra: LogSpectra, targets: Sequence[Target], noise: FloatArray) -> FloatArray:
    """Return the log likelihood that the modes are expected to gain in each channel alone."""
    power = np.abs(_motions(targets)) ** 2 / noise[:, None]
    f, zeta = np.array([(t.frequency, t.damping_ratio) for t in targets]).T[:, :, None]
    gain = np.zeros(noise.size)
    for s in spectra.spectra:
        ratio = power @ np.abs(response(f, zeta, s.frequency)) ** 2
        gain += s.count * np.sum(ratio - np.log1p(ratio), axis=1)
    return gain


def _in_phase(columns: ComplexArray) -> ComplexArray:
    """Turn each column until its largest component is positive."""
    largest = np.take_along_axis(columns, np.abs(columns).argmax(axis=0)[None], axis=0)
    return np.asarray(columns * np.exp(-1j * np.angle(largest)))


def _over(spectrum: CrossSpectrum, unit: FloatArray) -> CrossSpectrum:
    """Return the spectrum in units of each channel."""
    foreign = None if spectrum.foreign is None else spectrum.foreign / unit[:, None]
    return replace(spectrum, transforms=spectrum.transforms / unit, foreign=foreign)


def _directions(moved: ComplexArray, spectra: LogSpectra) -> FloatArray:
    """Return an orthonormal basis of the directions in which the modes are seen best.

    They span the shapes φ, and (1 + G G*)⁻¹ φ, which avoids what is foreign, at the ordinates; both
    in units of the noise, in which nothing else distinguishes directions. There are as many as
    leave each mode its share of φ* (1 + G G*)⁻¹ φ in the mean of the ordinates, and those of the
    parts of the shapes in quadrature.
    """
    shapes = _in_phase(moved)
    shapes = shapes / np.linalg.norm(shapes.real, axis=0)
    phi = shapes.real
    quadrature = shapes.imag[:, np.linalg.norm(shapes.imag, axis=0) > _QUADRATURE]
    foreign = [
        s.foreign[:: 1 + s.frequency.size // _MOST_COMPARED]
        for s in spectra.spectra
        if s.foreign is not None
    ]
    if not foreign:
        return _with_directions(np.linalg.svd(phi, full_matrices=False)[0], quadrature)
    columns = [phi]
    for g in foreign:
        best = phi - g @ _share(g, phi)
        best = best / np.linalg.norm(best, axis=1, keepdims=True)
        rows = np.moveaxis(best, 1, 0).reshape(len(phi), -1) / np.sqrt(len(g))
        columns += [rows.real, rows.imag]
    u = np.linalg.svd(np.concatenate(columns, axis=1), full_matrices=False)[0]
    whole = [_seen(np.eye(len(phi)), phi, g) for g in foreign]
    for n in range(phi.shape[1], u.shape[1]):
        shares = [_seen(u[:, :n], phi, g) / all_ for g, all_ in zip(foreign, whole, strict=True)]
        if np.concatenate(shares).mean(axis=0).min() > _SEEN:
            return _with_directions(u[:, :n], quadrature)
    return _with_directions(u, quadrature)


def _with_directions(basis: FloatArray, columns: FloatArray) -> FloatArray:
    """Return an orthonormal basis with what columns, ``(n, n_columns)``, clearly have beside it."""
    rest = columns - basis @ (basis.T @ columns)
    u, s, _ = np.linalg.svd(rest, full_matrices=False)
    return np.column_stack([basis, u[:, s > _QUADRATURE]])


def _share(g: ComplexArray, phi: FloatArray) -> ComplexArray:
    """Return (1 + G* G)⁻¹ G* φ, shape ``(n, n_foreign, n_modes)``."""
    adjoint = np.swapaxes(g.conj(), 1, 2)
    return np.asarray(np.linalg.solve(np.eye(g.shape[2]) + adjoint @ g, adjoint @ phi))


def _seen(basis: FloatArray, phi: FloatArray, g: ComplexArray) -> FloatArray:
    """Return φ* (1 + G G*)⁻¹ φ of what a basis shows, shape ``(n, n_modes)``."""
    phi, g = basis.T @ phi, basis.T @ g
    return np.asarray(np.sum(phi * (phi - g @ _share(g, phi)), axis=1).real)


def mask_residual_lines(data: ClusterData, expected: list[ComplexArray]) -> ClusterData:
    """Mask ordinates that noise about the expectation does not reach; return ``data`` if none.

    Each channel is compared with its level, and the trace of all over their expectation: a line on
    a resonance is seen in the directions in which the mode does not move.
    """
    n, n_free = data.basis.shape[1], sum(int(mask.sum()) for mask in data.masks)
    false_alarm = constants.LINE_FALSE_ALARM / ((n + 1) * n_free)
    masks = []
    for spectrum, mask, matrix in zip(data.spectra.spectra, data.masks, expected, strict=True):
        level, count = np.diagonal(matrix, axis1=1, axis2=2).real, spectrum.count
        known = np.flatnonzero(np.isfinite(level[:, 0]))
        total = np.zeros(len(level))
        with suppress(np.linalg.LinAlgError):  # channels that copy each other
            white = np.linalg.solve(matrix[known], spectrum.matrix[known])
            total[known] = np.trace(white, axis1=1, axis2=2).real
        # A misfit of the model is no line: the expectation of a mean is raised to the level near
        # it. A single periodogram scatters too much for that, and its lines exceed any misfit.
        if count > 1:
            ratio = spectrum.powers() / level / median_ordinate(count)
            level = level * median_filter(ratio, (_LINE_NEIGHBOURS, 1)).clip(1.0)
            near = median_filter(total, _LINE_NEIGHBOURS) / n
            total = total / near.clip(1.0)
        highest = gammainccinv(count, false_alarm) / count
        above = (spectrum.powers() > highest * level).any(axis=1)
        above |= total > gammainccinv(count * n, false_alarm) / count
        masks.append(mask & ~binary_dilation(mask & above, iterations=_LINE_BINS))
    # A band that would lose more than half of its ordinates holds no lines.
    n_left = sum(int(mask.sum()) for mask in masks)
    return replace(data, masks=tuple(masks)) if n_free // 2 <= n_left < n_free else data


def _mask_at(data: ClusterData, optimum: _Optimum, lines: list[int]) -> ClusterData:
    """Mask the lines that poles became, with their neighbours.

    Means of several ordinates show only where about a line is: it is the strongest of them.
    """
    masks = list(data.masks)
    means = [b.frequency for b in optimum.likelihood.blocks if b.frequency.size > 1]
    for f in optimum.poles[0][lines].tolist():
        reach = max(float(np.interp(f, own[:-1], np.diff(own))) for own in means)
        for k, (spectrum, mask) in enumerate(zip(data.spectra.spectra, masks, strict=True)):
            near = mask & (np.abs(spectrum.frequency - f) <= reach)
            strongest = int(np.where(near, spectrum.powers().sum(axis=1), 0.0).argmax())
            line = spectrum.frequency[strongest] if near.any() else f
            apart = np.abs(spectrum.frequency - line) * spectrum.duration
            masks[k] = mask & (apart > _LINE_BINS + 0.5)
    return replace(data, masks=tuple(masks))


def group_lengths(spectra: Sequence[CrossSpectrum]) -> list[list[int]]:
    """Group the indices of spectra with the same frequencies."""
    groups: dict[tuple[float, int], list[int]] = {}
    for i, spectrum in enumerate(spectra):
        groups.setdefault((spectrum.duration, spectrum.frequency.size), []).append(i)
    return list(groups.values())


def _groups(data: ClusterData) -> list[list[int]]:
    """Group the spectra of one length that have ordinates without lines."""
    groups = group_lengths(data.spectra.spectra)
    return [group for group in groups if any(data.masks[i].any() for i in group)]


def make_blocks(
    data: ClusterData, bandwidth: float, near: Sequence[float] | None = None
) -> tuple[MeanOrdinates, ...]:
    """Average the ordinates of each segment length; arguments as in `average_ordinates`."""
    spectra = data.spectra.spectra
    return tuple(
        average_ordinates(
            [spectra[i] for i in group], [data.masks[i] for i in group], bandwidth, near=near
        )
        for group in _groups(data)
    )


def _refined(data: ClusterData, optimum: _Optimum) -> _Optimum:
    """Repeat the fit with finer bins where resonances are narrower or elsewhere than expected."""
    if optimum.likelihood.collapsed(optimum.p):
        return optimum
    f, zeta = optimum.poles
    bandwidth = 2 * zeta * f
    moved = np.abs(f - optimum.near) >= bandwidth / 2
    if not moved.any() and bandwidth.min() > _NARROWER * optimum.bandwidth:
        return optimum
    least = max(float(bandwidth.min()), optimum.bandwidth / constants.DAMPING_SPAN)
    blocks = make_blocks(data, least, f.tolist())
    # One pole that is narrow by error must not make the bins of a wide band fine.
    while sum(b.frequency.size for b in blocks) * optimum.p.size > _MOST_SLOPES:
        least *= 2
        blocks = make_blocks(data, least, f.tolist())
    likelihood = replace(optimum.likelihood, blocks=blocks)
    p = likelihood.minimise(optimum.p)
    if not np.isfinite(likelihood.value(p)):  # a pole as narrow as rounding, in single bins
        return optimum
    return _Optimum(optimum.targets, likelihood, p, likelihood.data_value(p), f, least)


def _solve(
    data: ClusterData,
    targets: tuple[Target, ...],
    near: FloatArray,
    bandwidth: float,
) -> _Optimum:
    """Find the posterior mode of a set of modes, with bins for a bandwidth at resonances, in Hz."""
    blocks = make_blocks(data, bandwidth, near.tolist())
    n_channels = data.basis.shape[1]
    zeta = np.array([target.damping_ratio for target in targets])
    own = _in_phase(data.basis.T @ (_motions(targets)[list(data.index)] / data.unit[:, None]))
    # A strength of zero would leave a mode without a gradient: a peak has 1 % of the noise or more.
    amplitude = np.maximum(np.abs(own), 0.1 * 2 * zeta)
    reference = amplitude.argmax(axis=0).tolist()
    sign = np.where(own.real < 0, -1.0, 1.0)
    scale = amplitude.max(axis=0)
    layout = lay_out(reference, n_channels)
    start = np.concatenate(
        [
            np.log([target.frequency for target in targets]),
            np.log(zeta),
            np.full(len(targets), data.static),
            np.zeros(layout.n_poles - 3 * len(targets)),
            [float(i == j) for i, j in layout.force],
            [sign[c, i] * amplitude[c, i] / scale[i] for c, i in layout.shape],
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
        known_floors=n_channels < data.unit.size,
        narrowest=_COLLAPSED / data.duration,
    )
    p = likelihood.minimise(start)
    if data.out_of_phase and not likelihood.collapsed(p) and _is_out_of_phase(likelihood, p):
        wider = likelihood.with_quadrature()
        lay = wider.layout
        begin = lay.shapes.start + lay.shape_in_phase
        start = wider.start.copy()
        start[begin : lay.shapes.stop] = [own.imag[c, i] / scale[i] for c, i in layout.shape]
        q = min((wider.minimise(one) for one in (start, layout.extended(p))), key=wider.value)
        # Parts in quadrature may explain what is no mode by a pole of another damping than that of
        # all channels and modes together.
        m = len(targets)
        moved = [float(np.abs(one[m : 2 * m] - np.log(zeta)).max()) for one in (p, q)]
        if moved[1] < max(_OTHER_DAMPING, moved[0]):
            likelihood, p = wider, q
    return _Optimum(targets, likelihood, p, likelihood.data_value(p), near, bandwidth)


def _is_out_of_phase(likelihood: Likelihood, p: FloatArray) -> bool:
    """Return whether parts of forces or shapes in quadrature gain more than by chance.

    By one Newton step of these alone, twice whose gain is χ² of as many degrees of freedom at most.
    With all other unknowns, of which the data hardly determine some, there may be no maximum.
    """
    more = likelihood.with_quadrature()
    own, n = more.layout.quadrature, len(more.layout.quadrature)
    if not n:
        return False
    gradient, hessian = more.derivatives(likelihood.layout.extended(p))
    try:
        root = np.linalg.cholesky(hessian[np.ix_(own, own)])
    except np.linalg.LinAlgError:
        return True
    gain = float(np.sum(np.linalg.solve(root, gradient[own]) ** 2))
    return bool(gain > n + constants.QUADRATURE_SIGMAS[1] * np.sqrt(2 * n))


def _expected(data: ClusterData, optimum: _Optimum) -> list[ComplexArray]:
    """Return the expectation of each spectrum over the band; infinite where it is masked."""
    bandwidth = float(np.min(2 * np.prod(optimum.poles, axis=0)))
    likelihood = replace(optimum.likelihood, blocks=make_blocks(data, bandwidth))
    masked = np.diag(np.full(data.basis.shape[1], np.inf)).astype(complex)
    full = [np.tile(masked, (mask.size, 1, 1)) for mask in data.masks]
    for group, values in zip(_groups(data), likelihood.expected(optimum.p), strict=True):
        kept = np.any([data.masks[i] for i in group], axis=0)
        for i in group:
            full[i][kept] = values
    return full


def _conclude(data: ClusterData, optimum: _Optimum, expected: list[ComplexArray]) -> ClusterFit:
    """Marginalise the posterior, and publish the modes whose estimates are credible."""
    targets, likelihood, p = optimum.targets, optimum.likelihood, optimum.p
    names = tuple(target.name for target in targets)
    white = marginalise(likelihood, p)
    estimate, cov, decrement, _ = white
    if not decrement < constants.WORST_DECREMENT:
        detail = f"the fit did not converge (Newton decrement {decrement:.2g}); record longer"
        return ClusterFit(
            None, {t.name: Rejection("not-identified", detail, t.frequency) for t in targets}
        )
    n, (f, zeta) = len(targets), np.exp(estimate).reshape(2, -1)
    ratio = likelihood.signal_to_noise(p)
    spectrum = data.spectra.spectra[data.longest]
    duration = spectrum.duration
    fitted = _fitted(data, expected[data.longest])
    known = np.isfinite(fitted.residual)
    residual = spectrum.frequency[known], fitted.residual[known], fitted.count
    dispersion = _dispersion(*residual, f, zeta)
    channels, shapes = data.whole.channels, likelihood.shapes(p).T
    seen = shapes @ data.basis.T  # in units of the noise, (n_modes, n_channels)
    clear = ratio if data.basis.shape[1] == data.unit.size else np.abs(seen.T)
    observed = data.spectra.spectra, data.masks, expected
    moved = (f, zeta), likelihood.forces(p), shapes
    unsteady = [unsteadiness(*observed, *moved, i) for i in range(n)]
    # Squares of the ordinates near a mode are correlated where its excitation is not steady.
    wider = np.sqrt([one.expected for one in unsteady] * 2)
    strength = likelihood.strength(p).sum(axis=0) / np.sum(np.abs(shapes) ** 2, axis=1)
    strength = strength * (np.abs(seen) ** 2 @ data.unit**2)
    each = zip(f.tolist(), zeta.tolist(), dispersion.tolist(), strict=True)
    flags = tuple(
        _flags(*one, duration, unsteady=force.is_clear)
        for one, force in zip(each, unsteady, strict=True)
    )
    modes = Modes(
        names=names,
        sources=(data.whole.source,) * n,
        channels=tuple(channels[c] for c in clear.argmax(axis=0)),
        ln_frequency=estimate[:n],
        ln_damping=estimate[n:],
        cov=cov,
        snr=ratio.sum(axis=0),
        dispersion=dispersion,
        excitation=np.sqrt(strength * np.pi * f / (4 * zeta)),
        flags=flags,
        shape_channels=channels,
        shapes=_unit_shapes(data.unit * seen),
        lines=(),
        refused=(),
    ).widened("unsteady", cov * np.outer(wider, wider))
    judged = [_incredible(modes, i, one, duration) for i, one in enumerate(targets)]
    rejected = {
        name: why._replace(frequency=at)
        for name, why, at in zip(names, judged, f.tolist(), strict=True)
        if why is not None
    }
    narrow = [why is not None and why.reason == "line-not-mode" for why in judged]
    lines = _excluded_lines(data, f[narrow])
    fewer = max([one.expected for one in unsteady if one.is_clear], default=1.0)
    colour = average_colours(likelihood, p, white, fewer)
    modes = _averaged(modes, colour, wider, targets, duration)
    return ClusterFit(ClusterModes(modes, np.array(_losses(optimum)), lines, fitted), rejected)


def _density(data: ClusterData, expected: ComplexArray) -> FloatArray:
    """Return the density of each channel: in other directions there is noise, and the foreign.

    Infinite where the expectation of the directions, ``(n_ordinates, n, n)``, is.
    """
    basis, foreign = data.basis, data.whole.spectra[data.longest].foreign
    known = np.isfinite(expected[:, 0, 0])
    density = np.full((known.size, len(basis)), np.inf)
    inside = np.sum((basis @ expected[known].real) * basis, axis=2)
    density[known] = inside + 1 - np.sum(basis**2, axis=1)
    if foreign is not None and basis.shape[1] < len(basis):
        own = basis @ (basis.T @ foreign[known])
        density[known] += np.sum(np.abs(foreign[known]) ** 2 - np.abs(own) ** 2, axis=2)
    return density


def _excluded_lines(data: ClusterData, found: FloatArray) -> tuple[LineEstimate, ...]:
    """Read the lines that are masked, and those that were fitted as modes at these Hz."""
    ordinates = masked_ordinates(data)
    for k in np.searchsorted(data.spectra.spectra[data.longest].frequency, found).tolist():
        ordinates.append((max(0, k - _LINE_BINS), k + _LINE_BINS + 1))
    return tuple(read_line(data, first, last) for first, last in ordinates)


def _averaged(
    modes: Modes, colour: Colour, wider: FloatArray, targets: tuple[Target, ...], duration: float
) -> Modes:
    """Replace estimates for a white force by those averaged over its spectra."""

    def with_mean(mean: FloatArray, cov: FloatArray) -> Modes:
        ln_f, ln_zeta = np.split(mean, 2)
        return replace(modes.widened("coloured", cov), ln_frequency=ln_f, ln_damping=ln_zeta)

    # An unsteady force makes the noise larger, not what its spectrum leaves open.
    cov = colour.cov * np.outer(wider, wider) + colour.more
    averaged = with_mean(colour.mean, cov)
    # Which modes are found does not depend on the average: where it is not credible the estimate
    # for a white force remains, and covers both.
    why = [_incredible(averaged, i, one, duration) for i, one in enumerate(targets)]
    lost = np.array([one is not None for one in why] * 2)
    moved = modes.estimate - colour.mean
    back = np.where(lost, moved, 0.0)
    # A spectrum that moves a mode so far is more than the bumps describe: both are covered.
    apart = np.where(lost | (moved**2 > _FAR**2 * np.diag(cov)), moved, 0.0)
    averaged = with_mean(colour.mean + back, cov + np.outer(apart, apart))
    if colour.probability <= constants.COLOURED:
        return averaged
    return replace(averaged, flags=tuple(f"{flag} coloured".strip() for flag in modes.flags))


def _unit_shapes(shapes: ComplexArray | FloatArray) -> FloatArray:
    """Scale shapes, ``(n_modes, n_channels)``, to unit norm, the largest component positive.

    Of what is not in phase with that the real part remains.
    """
    real = _in_phase(shapes.T.astype(np.complex128)).real.T
    return np.asarray(real / np.linalg.norm(real, axis=1, keepdims=True))


def _fitted(data: ClusterData, expected: ComplexArray) -> FittedSpectrum:
    """Divide the ordinates of the longest observation by their expectation: tr E⁻¹ W."""
    spectrum, mask = data.spectra.spectra[data.longest], data.masks[data.longest]
    n = data.basis.shape[1]
    residual = np.full(mask.size, np.nan)
    white = np.linalg.solve(expected[mask], spectrum.matrix[mask])
    residual[mask] = np.trace(white, axis1=1, axis2=2).real / n
    return FittedSpectrum(
        channels=data.whole.channels,
        unit=data.unit,
        spectrum=data.whole.spectra[data.longest],
        density=_density(data, expected),
        residual=residual,
        count=spectrum.count * n,
    )


def _dispersion(
    frequency: FloatArray, ratio: FloatArray, count: int, f: FloatArray, zeta: FloatArray
) -> FloatArray:
    """Return the variance of the residual within two half-power bandwidths over that of noise."""
    near = np.abs(frequency - f[:, None]) < 2 * (zeta * f)[:, None]
    n = near.sum(axis=1)
    squares = count * (ratio - 1.0) ** 2
    return np.where(n >= constants.LEAST_ORDINATES, near @ squares / n.clip(1), np.nan)


def _flags(f: float, zeta: float, dispersion: float, duration: float, *, unsteady: bool) -> str:
    """Return the flags of a mode in segments of this duration."""
    flags = {
        "resolution-limited": 2 * zeta * f * duration < constants.RESOLVED,
        "loose-fit": dispersion > constants.LOOSE_FIT,
        "unsteady": unsteady,
    }
    return " ".join(name for name, raised in flags.items() if raised)


def masked_ordinates(data: ClusterData) -> list[tuple[int, int]]:
    """Return the half-open ranges of masked ordinates of the longest observation."""
    masked = data.spectra.spectra[data.longest].free & ~data.masks[data.longest]
    return [(run.start, run.stop) for (run,) in find_objects(label(masked)[0])]


def read_line(data: ClusterData, first: int, last: int) -> LineEstimate:
    """Read a line within some ordinates of the longest observation, in its strongest channel."""
    spectrum = data.whole.spectra[data.longest]
    powers = spectrum.powers()[first:last]
    c = int(np.argmax(powers.sum(axis=0)))
    frequency = float(spectrum.frequency[first + int(np.argmax(powers[:, c]))])
    # Σ I = A² T / 2 over the ordinates of a sine.
    amplitude = float(np.sqrt(2 * powers[:, c].sum() / spectrum.duration) * data.unit[c])
    return LineEstimate(data.whole.channels[c], frequency, amplitude)


def _incredible(modes: Modes, i: int, target: Target, duration: float) -> Rejection | None:
    """Return why an estimate is not credible; None if it is."""
    channel = modes.channels[i]
    f, zeta = float(modes.frequency[i]), float(modes.damping_ratio[i])
    std_f, std_zeta = np.sqrt(np.diag(modes.cov))[paired([i], len(modes.names))].tolist()
    if 2 * zeta * f * duration < 1:
        return Rejection(
            "line-not-mode",
            f"{f:.5g} Hz in {channel} is narrower ({2 * zeta * f:.2g} Hz) than a record of "
            f"{duration:.3g} s resolves",
        )
    if 2 * zeta < LINE_WIDTH and not target.narrow:
        return Rejection(
            "line-not-mode", f"{f:.5g} Hz in {channel} is as narrow as a line that wanders"
        )
    if modes.dispersion[i] > constants.POOR_FIT:
        return Rejection(
            "poor-fit",
            f"the residual near {f:.5g} Hz scatters {modes.dispersion[i]:.1f} times as much as "
            "noise: lines, unsteady operation or an impact; export a steadier part of the log",
        )
    started = target.frequency
    moved = abs(search_offset(f, started, target.search))
    if moved > 1 or zeta > constants.MOST_DAMPING:
        return Rejection(
            "outside-search",
            f"the fit in {channel} converged to {f:.5g} Hz, damping {zeta:.2g}; it began at "
            f"{started:.5g} Hz, may move by {100 * target.search:.2g} %, and dampings are below "
            f"{constants.MOST_DAMPING:g}",
        )
    if std_f > constants.WORST_STD_LN_F or std_zeta > constants.WORST_STD_LN_ZETA:
        return Rejection(
            "too-uncertain",
            f"{f:.5g} Hz in {channel} has a standard deviation of {100 * std_f:.2g} %, its damping "
            f"of {100 * std_zeta:.0f} %; record longer or excite more",
        )
    return None
