"""Resonances that no description has: fitted beside the described modes, and named with them.

A described mode may be located at the resonance of a mode that nobody described. What the
described modes leave unexplained is therefore fitted with them, and one posterior over all
assignments decides which resonance has which name, or none (README.md of `modal`, "Names").
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lmshealth._arrays import FloatArray
from lmshealth.modal import constants
from lmshealth.modal.ambient.candidates import clusters
from lmshealth.modal.ambient.cluster_fit import (
    BinnedSpectra,
    bin_cluster,
    fit_cluster,
    incoherent_model,
)
from lmshealth.modal.ambient.cluster_modes import ClusterFit, refuse_close_modes
from lmshealth.modal.modes import Rejection
from lmshealth.modal.naming import assign, is_near
from lmshealth.modal.targets import Target
from lmshealth.signal.spectra import LogSpectra


class NamedFits(NamedTuple):
    """Fits with their names, what is refused, and the names that are not certain."""

    fits: list[ClusterFit]
    undescribed: Sequence[Rejection] = ()  # of each resonance without a name
    doubtful: Collection[str] = ()


def fit_undescribed(
    spectra: LogSpectra,
    binned: Sequence[BinnedSpectra],
    fits: Sequence[ClusterFit],
    targets: tuple[Target, ...],
    top: float,
) -> NamedFits | None:
    """Fit and name all resonances anew; None where the fits of described modes explain all.

    ``binned`` holds the spectra over the search of each fit.
    """
    described = {target.name: target.damping_ratio for target in targets}
    # A resonance much wider than described may stand for two.
    before = [
        one
        for one in _resonances(fits, targets)
        if one.damping_ratio < constants.OFF_DAMPING * described[one.name]
    ]
    known = _distinct(before)
    extra = _unexplained(binned, known, targets, slack=1.0)
    doubled = len(known) < len(before)
    if not extra and not doubled:
        return None
    refits: list[ClusterFit] = []
    for _ in range(constants.UNDESCRIBED_ROUNDS):
        # What is beyond the searches has a part in the band of the fit, too.
        extra += _unexplained(binned, [*known, *extra], targets, slack=np.inf)
        if refits and not extra:
            break
        n_known, together = len(known), (*known, *extra)
        refits = [
            fit_cluster(spectra, bin_cluster(spectra, group, together, top, searched=False), group)
            for group in _groups(together)
        ]
        known, extra = _resonances(refits, targets, prefix="fitted_"), []
        if len(known) <= n_known:
            break
    if not doubled and len(known) <= len(before):
        return None
    named = _name(refits, fits, targets)
    if _unexplained(binned, known, targets, slack=1.0):
        named = named._replace(doubtful=described)
    return named


def _resonances(
    fits: Sequence[ClusterFit], targets: Sequence[Target], prefix: str = ""
) -> list[Target]:
    """Return the modes of fits, ascending, as start values of another fit."""
    search = max(target.search for target in targets)
    resonances = [
        Target(prefix + name, float(f), float(zeta), search)
        for found in (fit.modes for fit in fits if fit.modes is not None)
        for name, f, zeta in zip(
            found.names, found.modes.frequency, found.modes.damping_ratio, strict=True
        )
    ]
    return sorted(resonances, key=lambda one: one.frequency)


def _distinct(resonances: Sequence[Target]) -> list[Target]:
    """Drop resonances within half a half-power bandwidth of a lower one."""
    kept: list[Target] = []
    for one in resonances:
        width = one.damping_ratio + (kept[-1].damping_ratio if kept else 0.0)
        if not kept or np.log(one.frequency / kept[-1].frequency) >= 0.5 * width:
            kept.append(one)
    return kept


def _unexplained(
    binned: Sequence[BinnedSpectra],
    known: Sequence[Target],
    targets: Sequence[Target],
    *,
    slack: float,
) -> list[Target]:
    """Return resonances near targets (times ``slack``) that the known ones leave unexplained."""
    extra: list[Target] = []
    for one in binned:
        while len(extra) < constants.MOST_UNDESCRIBED:
            further = _most_unexplained(one, (*known, *extra), targets, slack)
            if further is None:
                break
            extra.append(further)
    return extra


def _most_unexplained(
    binned: BinnedSpectra, known: Sequence[Target], targets: Sequence[Target], slack: float
) -> Target | None:
    f = binned.frequency
    near = [k for k in known if f[0] / 1.3 < k.frequency < 1.3 * f[-1]]
    ratio = binned.level / incoherent_model(replace(binned, neighbours=()), near)
    excess = np.where(ratio > 1, binned.count * (ratio - 1 - np.log(ratio)), 0.0).sum(axis=0)
    zeta = float(np.median([target.damping_ratio for target in targets]))

    def sums(values: FloatArray, low: float, high: float) -> FloatArray:
        """Add up the bins from 1 + low ζ to 1 + high ζ times the frequency of each bin."""
        total = np.cumsum(np.pad(values, [(0, 0), (1, 0)]), axis=1)
        first, last = np.searchsorted(f, [f * (1 + low * zeta), f * (1 + high * zeta)])
        return np.asarray(total[:, last] - total[:, first])

    inner, left, right = (
        sums(binned.level, *window) / sums(np.ones((1, f.size)), *window).clip(1)
        for window in ((-0.5, 0.5), (-2, -1), (1, 2))
    )
    conditions = [
        (inner > constants.PEAK_RATIO * np.maximum(left, right)).any(axis=0),
        (f * (1 - 2 * zeta) >= f[0]) & (f * (1 + 2 * zeta) <= f[-1]),
        np.any([[is_near(t, x, slack=slack) for x in f.tolist()] for t in targets], axis=0),
        *(np.abs(f - k.frequency) > 2 * k.damping_ratio * k.frequency for k in near),
    ]
    gain = np.where(np.all(conditions, axis=0), sums(excess[None], -1, 1)[0], 0.0)
    best = int(np.argmax(gain))
    if gain[best] < constants.PRESENT:
        return None
    name, search = f"undescribed_{len(known) + 1}", max(target.search for target in targets)
    return Target(name, float(f[best]), zeta, search, undescribed=True)


def _groups(resonances: Sequence[Target]) -> list[tuple[Target, ...]]:
    """Group resonances to fit jointly as `clusters` does, but with as many as interact."""
    groups: list[list[Target]] = []
    for one in sorted(resonances, key=lambda one: one.frequency):
        if groups and len(clusters((groups[-1][-1], one))) == 1:
            groups[-1].append(one)
        else:
            groups.append([one])
    return [tuple(group) for group in groups]


def _name(
    refits: Sequence[ClusterFit], fits: Sequence[ClusterFit], targets: tuple[Target, ...]
) -> NamedFits:
    """Name the resonances of all refits; refuse described modes and resonances without a pair."""
    found = _resonances(refits, targets)
    frequency = [one.frequency for one in found]
    damping = [one.damping_ratio for one in found]
    assigned, rejected = assign(frequency, targets, damping=damping, undescribed=True)
    sure = constants.SURE_NAME
    certain, _ = assign(frequency, targets, damping=damping, undescribed=True, clear=sure)
    before = {name: why for fit in fits for name, why in fit.rejected.items()}
    for target in targets:
        if target.name not in assigned and target.name not in rejected:
            rejected[target.name] = before.get(target.name) or Rejection(
                "not-excited",
                f"every resonance near {target.frequency:.4g} Hz is more likely another mode; "
                "correct the description, or excite this mode",
            )
    unnamed = [
        Rejection(
            "undescribed",
            f"a resonance at {one.frequency:.5g} Hz, damping {100 * one.damping_ratio:.2g} %, is "
            "not clearly any described mode: describe it, or correct the description",
        )
        for one, name in zip(found, assigned, strict=True)
        if not name and any(is_near(target, one.frequency) for target in targets)
    ]
    names = {one.name: name for one, name in zip(found, assigned, strict=True) if name}
    named = [
        refuse_close_modes(ClusterFit(fit.modes.rename(names), {}))
        for fit in refits
        if fit.modes is not None
    ]
    return NamedFits([*named, ClusterFit(None, rejected)], unnamed, set(assigned) - set(certain))
