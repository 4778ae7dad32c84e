"""Names of identified resonances.

Ambient and free-decay identification compute the posterior probability of every assignment that
keeps the order of frequencies (`assign`). Frequency responses name only modes that no other mode
or name competes for (`name_response`): tracking assigns the rest.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.special import softmax

from lmshealth._arrays import BoolArray, FloatArray
from lmshealth.modal import constants
from lmshealth.modal.modes import Modes, Rejection
from lmshealth.modal.targets import Target
from lmshealth.stage.description import Stage


def assign(
    frequency: Sequence[float],
    targets: Sequence[Target],
    *,
    damping: Sequence[float] | None = None,
    complete: bool = False,
) -> tuple[tuple[str, ...], dict[str, Rejection]]:
    """Assign resonances to targets by the posterior of all order-preserving assignments.

    The prior of an assignment is that of its shifts of ln f (`shift_cost`) and a gain for every
    pair. Pairs outside the search, or with another damping where it is given, are excluded.
    Resonances, in Hz, and targets ascend; ``complete`` states that every resonance is a target.

    Returns the name of each resonance, empty where it is no target or the assignment is not clear,
    and the targets that are not assigned but may be one of the resonances.
    """
    n, m = len(frequency), len(targets)
    if complete and n == m:
        return tuple(target.name for target in targets), {}
    ln_f = np.log(np.asarray(frequency, dtype=float))
    nominal = np.log([target.frequency for target in targets])
    search = np.array([target.search for target in targets])
    shift = ln_f[:, None] - nominal
    admissible = np.abs(shift) <= np.log1p(search)
    if damping is not None:
        ratio = np.array(damping)[:, None] / [target.damping_ratio for target in targets]
        admissible &= np.abs(np.log(ratio)) < np.log(constants.DAMPING_SPAN)
    pairings = [
        (list(some), list(sought))
        for k in range(n if complete else 0, min(n, m) + 1)
        for some in combinations(range(n), k)
        for sought in combinations(range(m), k)
        if admissible[some, sought].all()
    ]
    probability = np.zeros((n, m))
    weights = [
        len(i) * constants.MATCH - (shift_cost(shift[i, j][None], search[j], len(i))[0] if i else 0)
        for i, j in pairings
    ]
    for pairing, weight in zip(pairings, softmax(weights) if weights else (), strict=True):
        probability[pairing] += weight
    names = tuple(
        targets[int(np.argmax(row))].name if row.size and row.max() >= constants.CLEAR_NAME else ""
        for row in probability
    )
    # With complete assignments a named resonance cannot be another target as well.
    open_ = [i for i in range(n) if not (complete and names[i])]
    ambiguous = {}
    for j, target in enumerate(targets):
        rivals = [i for i in open_ if probability[i, j] > constants.UNLIKELY_NAME]
        if target.name not in names and rivals:
            odds = "; ".join(_odds(frequency[i], probability[i], targets) for i in rivals)
            remedy = "the assignment is not clear; excite the other modes, or narrow searches"
            ambiguous[target.name] = Rejection("ambiguous", f"{odds}: {remedy}")
    return names, ambiguous


def _odds(frequency: float, probability: FloatArray, targets: Sequence[Target]) -> str:
    odds = ", ".join(
        f"{target.name} {100 * p:.0f} %"
        for target, p in zip(targets, probability.tolist(), strict=True)
        if p > constants.UNLIKELY_NAME
    )
    return f"{frequency:.5g} Hz may be {odds}"


def shift_cost(shifts: FloatArray, search: FloatArray, own: int) -> FloatArray:
    """Return the negative log prior of shifts of ln f, ``(n_candidates, n_modes)``.

    The common shift, the mean over the first ``own`` modes, has a standard deviation of half the
    search, what each mode differs from it a sixth. ``search`` has shape ``(n_modes,)``.
    """
    common = shifts[:, :own].mean(axis=1, keepdims=True)
    cost = 0.5 * (common[:, 0] / (search.mean() * constants.COMMON_SHIFT)) ** 2
    apart = (shifts - common) / (search * constants.OWN_SHIFT)
    return np.asarray(cost + 0.5 * np.sum(apart**2, axis=1))


def is_near(target: Target, frequency: float, *, slack: float = 1.0) -> bool:
    """Return whether a frequency in Hz is within so many times the search of a target."""
    return bool(abs(np.log(frequency / target.frequency)) <= slack * np.log1p(target.search))


def name_response(modes: Modes, stage: Stage) -> Modes:
    """Name modes of a frequency response where the assignment is unique.

    A mode gets a name if it alone lies in the search of one described mode and of no other.
    """
    near = _within_search(modes, stage)
    names = [""] * len(modes.names)
    for own, spec in zip(near, stage.modes, strict=True):
        if own.sum() == 1 and near[:, own].sum() == 1:
            names[int(own.argmax())] = spec.name
    return replace(modes, names=tuple(names))


def why_unnamed(modes: Modes, stage: Stage) -> Iterator[str]:
    """Yield why modes have no name after `name_response` where the description has a mode."""
    near = _within_search(modes, stage)
    for place in np.flatnonzero([not name for name in modes.names]):
        sought = [spec.name for spec, own in zip(stage.modes, near, strict=True) if own[place]]
        unnamed = f"the mode at {modes.frequency[place]:.5g} Hz has no name: "
        remedy = "; track assigns it, or enter its name in the column mode"
        if len(sought) > 1:
            several = f"{', '.join(sought[:-1])} and {sought[-1]}"
            quantity = "both" if len(sought) == 2 else "all"
            yield f"{unnamed}{several} are {quantity} searched for there{remedy}"
        elif sought:
            yield f"{unnamed}it is not the only one where {sought[0]} is searched for{remedy}"


def _within_search(modes: Modes, stage: Stage) -> BoolArray:
    """Return which modes lie in the search of which described mode, ``(n_described, n_modes)``."""
    off = [np.abs(modes.frequency / spec.frequency_hz - 1) <= spec.search for spec in stage.modes]
    return np.array(off, dtype=bool).reshape(len(stage.modes), -1)
