"""Search of a band for modes on all channels at once, without a description.

Candidates are the stable poles of a subspace model. Those that the cross spectra need start a joint
model of the band, which is refined, pruned by evidence and extended where its residual shows
further modes. Modes of constant amplitude are harmonics that wander: they are left out, and the
search is repeated. Of many channels those that add most to each other are searched first; the
others are added to the model a few at a time, with the modes that only they show, so that the time
is proportional to their number.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
from scipy.linalg import block_diag
from scipy.special import comb

from lmshealth._private.arrays import BoolArray, ComplexArray, FloatArray, pivots
from lmshealth.modal import constants
from lmshealth.modal.ambient.joint_model import (
    LEAST_FLOOR,
    BandData,
    JointModel,
    expectation,
    floor_ratio,
)
from lmshealth.modal.ambient.subspace import Candidate, Poles, find_candidates
from lmshealth.modal.ambient.wandering import Harmonic, find_harmonic, near_lines
from lmshealth.modal.ambient.whittle import response
from lmshealth.modal.naming import is_near, is_near_light
from lmshealth.modal.targets import Target
from lmshealth.signal.constants import LINE_WIDTH
from lmshealth.signal.spectra import CrossSpectrum, LogSpectra
from lmshealth.stage.constants import BAND_HALF_WIDTH

# Width of the bins at a resonance in damping ratios, of which the least counts, and the widest as a
# fraction of the frequency.
_BIN, _NARROWEST, _WIDEST_BIN = 0.4, 2e-3, 0.006
_MOST_HARMONICS = 10
# Channels that are searched together, and that are added to these at a time.
_FIRST, _MORE = 8, 8
# Of these, whose modes are not all refined, a residual shows a further mode from a larger gain on.
_CLEARLY = 3.0
# A mode is tried without if its loss, the others fixed, is below the first, or another one is
# within so many half-power bandwidths.
_DOUBTFUL, _NEAR, _MOST_TRIED = 150.0, 3.0, 6
_ROUNDS = 4
# Half widths of the windows in which the residual is averaged, as fractions of the frequency.
_WINDOWS = (0.003, 0.006, 0.012, 0.024)
# Static responses of all modes that are tried: of force and acceleration, and of absolute
# acceleration where the base moves.
_STATICS = 0.0, -1.0
# Sweeps of the model whose modes are chosen: fits see its other modes as foreign.
_SWEEPS = 20
# Ratio of bandwidths up to which two poles of unlike shapes are two modes.
_SIMILAR = 2.0
# Modes closer than this, in half-power bandwidths, are neighbours; of these, those that overlap.
_NEIGHBOUR, _OVERLAP = 12.0, 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Modes of a band in Hz, ascending, and harmonics that wander."""

    modes: tuple[Target, ...]
    harmonics: tuple[Harmonic, ...]
    spectra: LogSpectra  # without the directions of the harmonics
    model: JointModel
    band: tuple[float, float]
    left_out: tuple[str, ...]  # channels that the modes do not explain
    poles: Poles  # of all orders, without the harmonics

    def within(self, frequency: float) -> bool:
        """Return whether a frequency in Hz lies in the band."""
        return self.band[0] <= frequency <= self.band[1]

    def skirt(self, target: Target) -> float:
        """Return how far from its resonance a mode stands above the noise, in damping ratios.

        It is that of the channel that shows it furthest.
        """
        model = self.model
        mode = int(np.abs(model.f - target.frequency).argmin())
        floor = model.floor_at(target.frequency)
        return float((np.abs(model.phi[:, mode]) / (2 * model.zeta[mode] * np.sqrt(floor))).max())

    def noise(self, frequency: float) -> FloatArray:
        """Return the density of the noise of each channel at a frequency in Hz, in (m/s²)²/Hz."""
        return self.model.floor_at(frequency) * self.model.data.scale**2

    def around(self, near: tuple[Target, ...], low: float, high: float) -> LogSpectra:
        """Return the spectra from low to high Hz, with the other modes as foreign."""
        cut = self.spectra.each(lambda spectrum: spectrum.band(low, high))
        others = ~np.isin(self.model.f, [target.frequency for target in near])
        if not others.any():
            return cut
        expected = partial(self.model.modal, others)
        return cut.each(lambda spectrum: spectrum.with_foreign(expected))


def search(
    spectra: LogSpectra,
    low: float,
    high: float,
    lines: Sequence[float] = (),
    suspected: Sequence[float] = (),
    hints: tuple[Target, ...] = (),
) -> Found:
    """Search a band; frequencies are in Hz.

    Lines are masked in the spectra. There may be further ones where ``suspected``. Less makes a
    mode worth a trial where one is described (``hints``); evidence decides as for any other one.
    Channels that no common modes explain are left out.
    """
    every = spectra.channels
    # A silent channel shows nothing, and is not unlike the others.
    level = sum(s.powers().sum(axis=0) for s in spectra.spectra)
    silent = [name for name, power in zip(every, level, strict=True) if not power > 0]
    spectra = spectra.select([c for c, name in enumerate(every) if name not in silent] or [0])
    first = _informative(spectra, low, high)
    while True:
        searched = spectra.select(first)
        model, harmonics, after, poles = _explain(searched, low, high, suspected, hints)
        kept = _consistent(model)
        if len(kept) == len(first):
            break
        # Another channel takes the place of one that is unlike the others.
        fewer = {first[k] for k in range(len(first)) if k not in kept}
        spectra = spectra.select([c for c in range(len(spectra.channels)) if c not in fewer])
        first = _informative(spectra, low, high)
    if model.quadrature_sigmas() > constants.QUADRATURE_SIGMAS[0]:
        # More modes are no explanation of those that move out of phase.
        again = _explain(searched, low, high, suspected, hints, out_of_phase=True)
        if again[0].f.size <= model.f.size and again[0].misfit < model.misfit:
            model, harmonics, after, poles = again
    # On the channels that show most: the time of a sweep is cubic in their number.
    model = _with_likelier_static(_without_splits(model, len(hints)).refined(_SWEEPS))
    if len(first) < len(spectra.channels):
        model, harmonics, after = _of_all_channels(model, harmonics, spectra, first, (low, high))
    # What is as narrow as a line, the foot of one or as broad as noise stays in the model, as
    # foreign to modes.
    width = 2 * model.zeta
    narrow = np.array([is_near_light(hints, f) for f in model.f.tolist()], bool)
    wide = (width > LINE_WIDTH) & ~(
        near_lines(model.f, model.zeta, lines) & (model.zeta < constants.LIGHT)
    )
    wide = (wide | narrow) & (width * model.f * spectra.duration > 1)
    wide &= model.zeta < constants.MOST_DAMPING
    modes = tuple(
        Target(
            f"mode_{number}",
            float(model.f[i]),
            float(model.zeta[i]),
            max(0.02, 4 * float(model.zeta[i])),
            narrow=bool(narrow[i]),
            amplitude=model.phi[:, i] * model.data.scale,
        )
        for number, i in enumerate((i for i in np.argsort(model.f) if wide[i]), start=1)
    )
    left_out = tuple(name for name in every if name not in (*after.channels, *silent))
    return Found(modes, harmonics, after, model, (low, high), left_out, poles)


def _informative(spectra: LogSpectra, low: float, high: float) -> list[int]:
    """Return the channels that add most to each other, by a pivoted Cholesky decomposition.

    In units of the median of each channel, so that they are those whose resonances stand out.
    """
    n = len(spectra.channels)
    if n <= _FIRST:
        return list(range(n))
    longest = spectra.longest.band(low, high)
    free = np.flatnonzero(longest.free)
    scale = np.sqrt(np.median(longest.powers()[free], axis=0).clip(1e-300))
    return sorted(pivots(longest.sums([free])[0].real / np.outer(scale, scale), _FIRST))


def _of_all_channels(
    model: JointModel,
    harmonics: tuple[Harmonic, ...],
    spectra: LogSpectra,
    first: list[int],
    band: tuple[float, float],
) -> tuple[JointModel, tuple[Harmonic, ...], LogSpectra]:
    """Add the channels to a model of the first ones, with the modes that only they show.

    Returns also the harmonics in all channels that the modes explain, and the spectra of these
    without the harmonics.
    """
    poles = zip(model.f.tolist(), model.zeta.tolist(), model.phi.T, strict=True)
    candidates = [Candidate(*pole, 1.0) for pole in poles]
    n, order = len(first), list(first)
    others = [c for c in range(len(spectra.channels)) if c not in first]
    batches = [others[start : start + _MORE] for start in range(0, len(others), _MORE)]

    # Cross spectra of all channels would be too large.
    def binned(spectra: LogSpectra, added: list[int]) -> BandData:
        return _bin(spectra.select([*first, *added]), candidates, *band)

    if harmonics:
        columns = [np.zeros(len(spectra.channels), dtype=complex) for _ in harmonics]
        alone = model.on(binned(spectra, []))
        for added in batches:
            part = alone.with_channels(binned(spectra, added), _beside(harmonics))
            for one, column in zip(harmonics, columns, strict=True):
                column[first], column[added] = one.vector, one.seen_by(part)[n:]
        harmonics = tuple(one.along(v) for one, v in zip(harmonics, columns, strict=True))
        for one in harmonics:
            spectra = spectra.each(partial(CrossSpectrum.with_foreign, expected=one.expected))
    model, parts = model.on(binned(spectra, [])), list[JointModel]()
    for added in batches:
        part = model.with_channels(binned(spectra, added)).refined(6)
        for _ in range(_ROUNDS):
            more = _grow(part, (), _CLEARLY * constants.LEAST_EXCESS)
            if more is None or _weaker_of_split(more) is not None:
                break
            part = more.refined(2)
        explained = [k for k in _consistent(part) if k >= n]
        order += [added[k - n] for k in explained]
        parts.append(part.of_channels(explained))
        model = part.of_channels(range(n))
    used = sorted(order)
    harmonics = tuple(one.along(one.vector[used]) for one in harmonics)
    return model.joined(parts, np.argsort(order).tolist()), harmonics, spectra.select(used)


def _beside(harmonics: Sequence[Harmonic]) -> Callable[[FloatArray], BoolArray]:
    """Return a function of frequency in Hz that is true outside the bands of harmonics."""
    return lambda f: ~np.any([(f >= one.low) & (f <= one.high) for one in harmonics], axis=0)


def _explain(
    spectra: LogSpectra,
    low: float,
    high: float,
    suspected: Sequence[float],
    hints: tuple[Target, ...],
    *,
    out_of_phase: bool = False,
) -> tuple[JointModel, tuple[Harmonic, ...], LogSpectra, Poles]:
    """Select modes and harmonics; return the spectra without these, and the poles found there."""
    harmonics: list[Harmonic] = []
    recording = spectra.longest
    while True:
        stable, poles = find_candidates(spectra, low, high)
        candidates = [
            c for c in stable if 2 * c.damping_ratio * c.frequency * spectra.duration > 1.0
        ]
        # Before the selection the direction of a harmonic is too uncertain to leave it out.
        start = _start(_bin(spectra, candidates, low, high), candidates, out_of_phase)
        # Floors and strengths of a start are those of c = 0: refined models are compared.
        refined = [replace(start, static=c).refined(6) for c in _STATICS]
        best = min(refined, key=lambda one: one.misfit)
        model = _select(_with_likelier_static(best), hints)
        harmonic = find_harmonic(model, recording, harmonics, suspected)
        if harmonic is None or len(harmonics) == _MOST_HARMONICS:
            return model, tuple(harmonics), spectra, poles
        harmonics.append(harmonic)
        if len(spectra.channels) == 1:
            spectra = spectra.each(
                partial(CrossSpectrum.without_band, low=harmonic.low, high=harmonic.high)
            )
        else:
            spectra = spectra.each(partial(CrossSpectrum.with_foreign, expected=harmonic.expected))


def _with_likelier_static(model: JointModel) -> JointModel:
    """Choose the static response of all modes that leaves least to that of each.

    The expectation is the same: which of two refined models has the higher likelihood depends more
    on where their refinement ended.
    """
    return min((model.with_static(c) for c in _STATICS), key=lambda one: one.misfit)


def _without_splits(model: JointModel, most: int) -> JointModel:
    """Drop the weaker pole of pairs that no fit separates, while there are more than ``most``.

    One mode that is not as the model is explained better by several poles of unlike bandwidths, of
    which none is the mode. Two of unlike shapes and similar bandwidths are modes, left to the fit.
    """
    while model.f.size > most and (weaker := _weaker_of_split(model)) is not None:
        f = float(model.f[weaker])
        model = model.without(weaker)
        model = model.refined(3, model.nearest(f)).refined(2)
    return model


def _weaker_of_split(model: JointModel) -> int | None:
    """Return the weaker pole of the nearest pair that no fit separates, None without any."""
    width, power = model.f * model.zeta, np.sum(np.abs(model.phi) ** 2, axis=0)
    alike = np.abs(model.phi.conj().T @ model.phi) ** 2
    alike = alike > constants.ALIKE_MAC * np.outer(power, power)
    limit = np.where(alike, constants.SEPARATION_ALIKE, constants.SEPARATION)
    apart = np.abs(model.f[:, None] - model.f) / (width[:, None] + width) / limit
    apart[~alike & (np.abs(np.log(width[:, None] / width)) < np.log(_SIMILAR))] = np.inf
    np.fill_diagonal(apart, np.inf)
    i, j = np.unravel_index(int(apart.argmin()), apart.shape)
    if apart[i, j] > 1:
        return None
    return int(i if power[i] / model.zeta[i] < power[j] / model.zeta[j] else j)


def _consistent(model: JointModel) -> list[int]:
    """Return the channels that the modes explain; the others are left out one by one."""
    kept = list(range(model.data.scale.size))
    while len(kept) > 1 and model.dispersions().max() > constants.POOR_FIT:
        n = range(len(kept))
        fewer = [model.of_channels([k for k in n if k != c]).refined(2) for c in n]
        best = int(np.argmin([np.log(one.dispersions()).mean() for one in fewer]))
        model = fewer[best]
        del kept[best]
    return kept


def _select(model: JointModel, hints: tuple[Target, ...]) -> JointModel:
    """Select the modes that the cross spectra need, by stepwise maximum likelihood."""
    for _ in range(_ROUNDS):
        model = _prune(model)
        more = _grow(model, hints)
        if more is None:
            break
        model = more
    return model


def _evidence(more: JointModel, less: JointModel) -> float:
    """Return twice the log evidence (BIC) for the modes that one has and the other has not."""
    cost = (more.size - less.size) * np.log(more.data.count.sum())
    return float(2 * (less.misfit - more.misfit) - cost)


def _prune(model: JointModel) -> JointModel:
    """Drop modes without evidence, the least likely first.

    Only the neighbours of a mode are refined without it; all modes are where that may decide.
    """
    while model.f.size:
        less = [(model.without(i), float(model.f[i])) for i in _doubtful(model)]
        tried = [one.refined(2, one.nearest(f)) for one, f in less]
        if not tried:
            break
        worst = min(tried, key=partial(_evidence, model))
        if _evidence(model, worst) >= constants.EVIDENCE_MARGIN:
            worst = worst.refined(2)
        if _evidence(model, worst) >= constants.EVIDENCE_MARGIN:
            break
        model = worst.refined(2)
    return model


def _doubtful(model: JointModel) -> list[int]:
    """Return modes whose absence the others may explain."""
    losses = np.array([model.without(i).misfit - model.misfit for i in range(model.f.size)])
    width = model.f * model.zeta
    apart = np.abs(model.f[:, None] - model.f) / (width[:, None] + width)
    np.fill_diagonal(apart, np.inf)
    near = apart.min(axis=1) < _NEAR
    return [int(i) for i in losses.argsort() if losses[i] < _DOUBTFUL or near[i]][:_MOST_TRIED]


def _grow(
    model: JointModel, hints: tuple[Target, ...], least: float = constants.LEAST_EXCESS
) -> JointModel | None:
    """Add the mode that the residual shows most clearly; None where there is no evidence."""
    for gain, f, zeta, phi in _excesses(model)[:2]:
        if gain < (constants.LEAST_HINTED if any(is_near(hint, f) for hint in hints) else least):
            break
        more = model.with_mode(
            f, zeta, phi if model.out_of_phase else phi.real.astype(np.complex128)
        )
        more = more.refined(3, more.nearest(f))
        enough = _evidence(more, model) >= constants.EVIDENCE_MARGIN
        if enough and more.zeta[-1] < constants.MOST_DAMPING:
            return more
    return None


def _excesses(model: JointModel) -> list[tuple[float, float, float, ComplexArray]]:
    """Return gain, frequency, damping and amplitude of the largest residual of each window.

    Of the mean of n ordinates the eigenvalue λ gains n (λ - 1 - ln λ) in log likelihood.
    """
    data = model.data
    root = np.linalg.cholesky(model.expected)
    inverse = np.linalg.inv(root)
    white = inverse @ data.matrix @ np.swapaxes(inverse.conj(), 1, 2)
    summed = np.cumsum(white * data.count[:, None, None], axis=0)
    total = np.concatenate([np.zeros_like(white[:1]), summed])
    count = np.concatenate([[0.0], np.cumsum(data.count)])
    found = []
    for half in _WINDOWS:
        first = np.searchsorted(data.frequency, data.frequency * (1 - half))
        last = np.searchsorted(data.frequency, data.frequency * (1 + half), side="right")
        weight = count[last] - count[first]
        value, vector = np.linalg.eigh((total[last] - total[first]) / weight[:, None, None])
        largest = value[:, -1].clip(1.0)
        gain = weight * (largest - 1 - np.log(largest))
        k = int(gain.argmax())
        phi = root[k] @ vector[k, :, -1]
        phi = np.asarray(phi * np.exp(-0.5j * np.angle(np.sum(phi * phi))), np.complex128)
        strength = 2 * half * np.sqrt(largest[k] - 1)
        found.append((float(gain[k]), float(data.frequency[k]), half, strength * phi))
    return sorted(found, key=lambda excess: -excess[0])


def split_groups(targets: tuple[Target, ...]) -> list[tuple[Target, ...]]:
    """Group neighbours whose bands overlap and whose bandwidths are similar.

    A narrow peak near a broad resonance would need the finest resolution over the whole band.
    Groups of too many are split at the widest gap.
    """
    bands = [target.band(BAND_HALF_WIDTH) for target in targets]
    apart = [upper[0] >= lower[1] for lower, upper in pairwise(bands)]
    edges = [0, *(1 + np.flatnonzero(apart)).tolist(), len(targets)]
    return [
        small
        for a, b in pairwise(edges)
        for alike in _by_bandwidth(targets[a:b])
        for small in _small(alike)
    ]


def _by_bandwidth(group: tuple[Target, ...]) -> list[tuple[Target, ...]]:
    """Split a group into those that are similar, beginning with the widest."""
    found = []
    while group:
        widest = max(target.bandwidth for target in group)
        alike = tuple(t for t in group if t.bandwidth * constants.SIMILAR_BANDWIDTH > widest)
        group = tuple(t for t in group if t not in alike)
        found.append(alike)
    return found


def similar(group: tuple[Target, ...], targets: tuple[Target, ...]) -> tuple[Target, ...]:
    """Return a group with all targets of similar bandwidths, ascending in frequency."""
    least = max(t.bandwidth for t in group) / constants.SIMILAR_BANDWIDTH
    most = min(t.bandwidth for t in group) * constants.SIMILAR_BANDWIDTH
    return tuple(t for t in targets if t in group or least < t.bandwidth < most)


def _small(group: tuple[Target, ...]) -> list[tuple[Target, ...]]:
    """Split a group of too many."""
    if len(group) <= constants.MOST_FOUND:
        return [group] if group else []
    return [small for half in halves(group) for small in _small(half)]


def halves(group: tuple[Target, ...]) -> list[tuple[Target, ...]]:
    """Split a group at its widest gap."""
    k = 1 + int(np.argmax([_gap(a, b) for a, b in pairwise(group)]))
    return [group[:k], group[k:]]


def _gap(a: Target, b: Target) -> float:
    """Distance of two modes in half the sum of their half-power bandwidths."""
    widths = a.frequency * a.damping_ratio + b.frequency * b.damping_ratio
    return (b.frequency - a.frequency) / widths


def neighbourhood(group: tuple[Target, ...], targets: tuple[Target, ...]) -> tuple[Target, ...]:
    """Add the neighbours of a group, and those that these overlap with."""
    first, last = targets.index(group[0]), targets.index(group[-1]) + 1
    limit = _NEIGHBOUR
    while first and _gap(targets[first - 1], targets[first]) < limit:
        first, limit = first - 1, _OVERLAP
    limit = _NEIGHBOUR
    while last < len(targets) and _gap(targets[last - 1], targets[last]) < limit:
        last, limit = last + 1, _OVERLAP
    return targets[first:last]


def _start(data: BandData, candidates: list[Candidate], out_of_phase: bool) -> JointModel:
    """Add candidates one by one, by their gain with all else fixed.

    Poles and shapes stay fixed, the covariance S of the forces and the floors are updated. A model
    that is ``out_of_phase`` has parts in quadrature.
    """
    f = np.array([c.frequency for c in candidates])
    zeta = np.array([c.damping_ratio for c in candidates])
    phi = np.array([c.shape for c in candidates]).reshape(-1, data.scale.size) / data.scale
    phi = phi / np.linalg.norm(phi, axis=1, keepdims=True)
    h = response(f[:, None], zeta[:, None], data.frequency)
    peak = np.abs(h).max(axis=1, initial=1e-300)
    b = np.einsum("ic,ik->kci", phi, h / peak[:, None])
    s, floor = np.zeros((0, 0), dtype=complex), np.full((data.scale.size, len(data.basis)), 0.5)
    s, floor = _update(data, b[:, :, :0], s, floor, 10)
    chosen: list[int] = []
    rest = list(range(len(candidates)))
    while rest:
        e = expectation(data, b[:, :, chosen], s, floor)
        gains, strength = _gains(data, e, b[:, :, rest])
        best = int(gains.argmax())
        if gains[best] < constants.LEAST_START:
            break
        chosen.append(rest.pop(best))
        first = candidates[chosen[-1]]
        rest = [k for k in rest if not _inseparable(candidates[k], first, data.scale)]
        s, floor = _update(data, b[:, :, chosen], block_diag(s, strength[best]), floor, 8)
    turn = np.exp(-0.5j * np.angle(np.sum(phi[chosen] ** 2, axis=1)))
    root = np.sqrt(np.diagonal(s).real)
    r = s * np.outer(turn.conj(), turn) / np.outer(root, root)
    r = 0.95 * r + 0.05 * np.eye(len(r))  # not singular
    shapes = (phi[chosen] * turn[:, None]).T * (root / peak[chosen])
    poles = f[chosen], zeta[chosen]
    model = JointModel(data, floor, *poles, shapes, np.zeros_like(shapes), r, out_of_phase)
    return model if out_of_phase else model.in_phase()


def _inseparable(one: Candidate, other: Candidate, scale: FloatArray) -> bool:
    """Return whether no fit separates two poles: their motions are alike, their bands overlap."""
    a, b = (c.shape / scale / np.linalg.norm(c.shape / scale) for c in (one, other))
    apart = abs(one.frequency - other.frequency)
    widths = one.frequency * one.damping_ratio + other.frequency * other.damping_ratio
    alike = abs(a.conj() @ b) ** 2 > constants.ALIKE_MAC
    return bool(alike and apart < constants.SEPARATION_ALIKE * widths)


def _update(
    data: BandData, b: ComplexArray, s: ComplexArray, floor: FloatArray, times: int
) -> tuple[ComplexArray, FloatArray]:
    """Improve forces by expectation maximisation, and floors by a multiplicative update."""
    adjoint = np.swapaxes(b.conj(), 1, 2)
    for _ in range(times):
        g = np.asarray(np.linalg.inv(expectation(data, b, s, floor)), dtype=np.complex128)
        if s.size:
            lack = np.einsum("k,kij->ij", data.count, adjoint @ (g @ data.matrix @ g - g) @ b)
            information = np.einsum("k,kii->i", data.count, adjoint @ g @ b).real
            s = s + _force_step(s, lack, information)
        floor = np.maximum(floor * floor_ratio(data, g) ** 0.75, LEAST_FLOOR)
    return s, floor


def _gains(data: BandData, e: ComplexArray, b: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Return the gain in log likelihood by each candidate, and its strength."""
    gb = np.linalg.inv(e) @ b
    r = np.einsum("kac,kac->ck", b.conj(), gb).real
    q = np.einsum("kac,kab,kbc->ck", gb.conj(), data.matrix, gb, optimize=True).real
    x = 10.0 ** np.arange(-2, 5, 0.25)[:, None, None] / r.max(axis=1)[:, None]
    gain = (data.count * (x * q / (1 + x * r) - np.log1p(x * r))).sum(axis=-1)
    best, k = gain.argmax(axis=0), np.arange(b.shape[2])
    return gain[best, k], x[best, k, 0]


def _force_step(s: ComplexArray, lack: ComplexArray, information: FloatArray) -> ComplexArray:
    """Return a step of the forces by expectation maximisation that keeps S positive."""
    # The information takes the place of the number of ordinates.
    n = (np.diagonal(s).real * information).clip(1e-12)
    step = s @ lack @ s / np.sqrt(n[:, None] * n)
    least = 1e-3 * np.linalg.eigvalsh(s).min().clip(0)
    for scale in (1.0, 0.5, 0.25, 0.1):
        new = s + scale * step
        if np.linalg.eigvalsh((new + new.conj().T) / 2).min() > least:
            return np.asarray(scale * (step + step.conj().T) / 2)
    return np.zeros_like(s)


def _bin(spectra: LogSpectra, candidates: list[Candidate], low: float, high: float) -> BandData:
    """Average the cross spectra of a band in bins that are fine at the candidates."""
    fine = np.geomspace(low, high, 20_000)
    density = np.full(fine.size, 1 / _WIDEST_BIN)
    for c in candidates:
        off = np.log(fine / c.frequency)
        width = _BIN * np.hypot(max(c.damping_ratio, _NARROWEST), off)
        density = np.maximum(density, 1 / width)
    place = np.concatenate([[0.0], np.cumsum(density[1:] * np.diff(np.log(fine)))])
    edges = np.interp(np.arange(0, place[-1] + 1), place, fine)
    edges[-1] = high
    n, n_bins = len(spectra.channels), edges.size - 1
    matrix, foreign = np.zeros((2, n_bins, n, n), dtype=complex)
    count, frequency = np.zeros((2, n_bins))
    for s in spectra.spectra:
        place = np.searchsorted(s.frequency, edges)
        parts = [a + np.flatnonzero(s.free[a:b]) for a, b in pairwise(place.tolist())]
        count += [s.count * part.size for part in parts]
        frequency += [s.count * s.frequency[part].sum() for part in parts]
        matrix += s.sums(parts)
        if s.foreign is not None:
            columns = (np.moveaxis(s.foreign[part], 1, 0).reshape(n, -1) for part in parts)
            foreign += [s.count * own @ own.conj().T for own in columns]
    kept = count > 0
    count, frequency = count[kept], frequency[kept] / count[kept]
    matrix, foreign = matrix[kept] / count[:, None, None], foreign[kept] / count[:, None, None]
    scale = np.sqrt(np.median(np.diagonal(matrix, axis1=1, axis2=2).real, axis=0).clip(1e-300))
    whole = np.outer(scale, scale)
    u = np.log(frequency / frequency[0]) / np.log(frequency[-1] / frequency[0])
    degree = 2 + round(2 * np.log(high / low))
    basis = [comb(degree, k) * u**k * (1 - u) ** (degree - k) for k in range(degree + 1)]
    matrix, foreign = (np.asarray(x / whole, dtype=np.complex128) for x in (matrix, foreign))
    there = foreign if foreign.any() else None
    return BandData(frequency, count, matrix, there, scale, np.stack(basis) + 1e-3)
