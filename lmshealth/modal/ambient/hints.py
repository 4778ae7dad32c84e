"""Described modes as hints: where a search of the spectra begins, beside the poles that it finds.

A hint is located in the data, by a common shift of all modes and a little of each. It becomes a
candidate like any pole of the subspace model: it decides neither what is found nor how it is named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lmshealth._private.arrays import FloatArray
from lmshealth.modal import constants
from lmshealth.modal.ambient.cluster_fit import (
    BinnedSpectra,
    bin_cluster,
    fit_strengths,
    incoherent_fit,
)
from lmshealth.modal.ambient.subspace import Candidate
from lmshealth.modal.naming import shift_cost
from lmshealth.modal.targets import Target, clusters
from lmshealth.signal.spectra import LogSpectra

# Steps of the common shift and of the shift of each mode, and updates that suffice to rank them.
_COMMON_STEPS, _OWN_STEPS, _FEW_UPDATES = 41, 15, 10
# Hints within so many half-power bandwidths may be any of the motions that the data show there.
_NEAR = 3.0


def candidates_at(spectra: LogSpectra, hints: tuple[Target, ...], top: float) -> list[Candidate]:
    """Return candidates at the hints that the spectra below ``top`` in Hz show, of any motion.

    A motion is an eigenvector of the cross spectra in units of the channels' levels, of which there
    are as many as hints near each other.
    """
    there: list[Target] = []
    for cluster in clusters(hints):
        binned = bin_cluster(spectra, cluster, hints, top, searched=True)
        there += screen(*locate(binned, cluster))
    found = []
    for hint in there:
        width = hint.damping_ratio * hint.frequency
        matrix = _real_part(spectra, hint.frequency, width)
        scale = np.sqrt(np.diagonal(matrix).clip(1e-300))
        vectors = np.linalg.eigh(matrix / np.outer(scale, scale))[1]
        n_near = sum(
            abs(other.frequency - hint.frequency)
            < 2 * _NEAR * max(width, other.damping_ratio * other.frequency)
            for other in there
        )
        found += [
            Candidate(hint.frequency, hint.damping_ratio, vectors[:, -k] * scale + 0j, 1.0)
            for k in range(1, min(n_near, scale.size) + 1)
        ]
    return found


def _real_part(spectra: LogSpectra, frequency: float, width: float) -> FloatArray:
    """Return the real part of the cross spectra around a frequency, without what is foreign."""
    n = len(spectra.channels)
    total = np.zeros((n, n))
    for s in spectra.spectra:
        near = s.free & (np.abs(s.frequency - frequency) < max(width, 1.5 / s.duration))
        if s.foreign is not None:
            near &= ~s.foreign.any(axis=(1, 2))
        total += s.sums([np.flatnonzero(near)])[0].real
    return total


def locate(
    binned: BinnedSpectra, targets: tuple[Target, ...]
) -> tuple[BinnedSpectra, tuple[Target, ...]]:
    """Shift the targets to where all channels show them: together, then each one by a little.

    Returns the binned spectra with neighbours at the common shift, and the targets where they were
    located.
    """
    own = len(targets)
    modes = (*targets, *binned.neighbours)
    nominal = np.array([mode.frequency for mode in modes])
    zeta = np.array([mode.damping_ratio for mode in modes])
    search = np.array([mode.search for mode in modes])

    def best(shifts: FloatArray) -> FloatArray:
        cost = shift_cost(shifts, search, own)
        f = nominal * np.exp(shifts)
        dampings = np.broadcast_to(zeta, f.shape)
        cost += incoherent_fit(binned, f, dampings, updates=_FEW_UPDATES)[1].sum(axis=0)
        return np.asarray(shifts[int(np.argmin(cost))])

    reach = float(np.log1p(search.min()))
    shift = best(np.linspace(-reach, reach, _COMMON_STEPS)[:, None] * np.ones(nominal.size))
    for width in (3.0, 1.0):
        for i in range(own):
            moved = np.tile(shift, (_OWN_STEPS, 1))
            moved[:, i] += width * zeta[i] * np.linspace(-1, 1, _OWN_STEPS)
            shift = best(moved[np.abs(moved[:, i]) <= np.log1p(search[i])])
    located = tuple(
        replace(mode, frequency=float(f))
        for mode, f in zip(modes, nominal * np.exp(shift), strict=True)
    )
    return replace(binned, neighbours=located[own:]), located[:own]


def screen(binned: BinnedSpectra, targets: Sequence[Target]) -> tuple[Target, ...]:
    """Return the modes that the binned spectra need, with refined dampings."""

    def misfit(some: Sequence[Target]) -> float:
        return float(fit_strengths(binned, some)[1].sum())

    scaled = (
        tuple(replace(t, damping_ratio=t.damping_ratio * factor) for t in targets)
        for factor in (0.5, 1.0, 2.0)
    )
    kept = min(scaled, key=misfit)
    while kept:
        full = misfit(kept)
        losses = [misfit(kept[:i] + kept[i + 1 :]) - full for i in range(len(kept))]
        worst = int(np.argmin(losses))
        if losses[worst] >= constants.ABSENT:
            break
        kept = kept[:worst] + kept[worst + 1 :]
    return kept
