"""Names of identified resonances.

Ambient and free-decay identification compute the posterior probability of every assignment that
keeps the order of frequencies (`assign`). Frequency responses name only modes that no other mode
or name competes for (`name_response`): tracking assigns the rest.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax
from scipy.stats import norm

from lmshealth._private.arrays import BoolArray, FloatArray
from lmshealth.io.log import Refusal
from lmshealth.modal import constants
from lmshealth.modal.modes import Modes, Rejection, merge
from lmshealth.modal.targets import Target
from lmshealth.stage.constants import BAND_HALF_WIDTH
from lmshealth.stage.description import Stage


def assign(
    frequency: Sequence[float],
    targets: Sequence[Target],
    *,
    damping: Sequence[float] | None = None,
    shapes: FloatArray | None = None,
    complete: bool = False,
    undescribed: bool = False,
    clear: float = constants.CLEAR_NAME,
) -> tuple[tuple[str, ...], dict[str, Rejection]]:
    """Assign resonances to targets by the posterior of all order-preserving assignments.

    The prior of an assignment is that of its shifts of ln f (`shift_cost`) and a gain for every
    pair. Pairs outside the search, or with another damping where it is given, are excluded.
    Resonances, in Hz, and targets ascend; ``shapes`` holds the modal assurance criterion of each
    pair, NaN where it is unknown. ``complete`` states that every resonance is a target,
    ``undescribed`` that some are none: then dampings count, and the machine is as likely at its
    description as worn. A name needs the probability ``clear``.

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
    unlike = np.zeros((n, m))
    if undescribed and damping is not None:
        unlike += np.log1p(0.5 * (np.log(ratio) / constants.DAMPING_PRIOR) ** 2)
    if shapes is not None:
        unlike += np.log1p(0.5 * np.nan_to_num((1 - shapes) / constants.SHAPE_PRIOR) ** 2)
    pairings = [
        (list(one), list(other))
        for k in range(n if complete else 0, min(n, m) + 1)
        for one in combinations(range(n), k)
        for other in combinations(range(m), k)
        if admissible[one, other].all()
    ]
    probability = np.zeros((n, m))
    weights = []
    for some, sought in pairings:
        weight = len(some) * constants.NAME_GAIN - unlike[some, sought].sum()
        if some:
            weight -= shift_cost(shift[some, sought][None], search[sought], len(some))[0]
            weight += undescribed * _standing_gain(shift[some, sought], search[sought])
        weights.append(weight)
    for pairing, weight in zip(pairings, softmax(weights) if weights else (), strict=True):
        probability[pairing] += weight
    names = tuple(
        targets[int(np.argmax(row))].name if row.size and row.max() >= clear else ""
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


def _standing_gain(shift: FloatArray, search: FloatArray) -> float:
    """Return the gain in log prior where the machine may stand at its description, not be worn."""
    scales = search.mean() * np.array([constants.COMMON_SHIFT, constants.NO_SHIFT])
    worn, new = norm.logpdf(shift.mean(), scale=scales)
    return float(np.logaddexp(0.0, new - worn) - np.log(2))


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


def likeness(modes: Modes, targets: Sequence[Target]) -> FloatArray:
    """Return the modal assurance criterion of found and described shapes, ``(n_modes, n_targets)``.

    NaN where fewer than two channels are in both.
    """
    described = [[target.shape.get(c, np.nan) for c in modes.shape_channels] for target in targets]
    shapes = np.array(described).reshape(len(targets), len(modes.shape_channels))
    return assurance(modes.shapes, shapes)


def assurance(a: NDArray[Any], b: NDArray[Any]) -> FloatArray:
    """Return the MAC of shapes ``(n, n_channels)`` and ``(m, n_channels)``, shape ``(n, m)``.

    It is that of common channels [Allemang2003]; NaN where there are fewer than two.
    """
    in_a, in_b = np.isfinite(a), np.isfinite(b)
    a, b = np.nan_to_num(a), np.nan_to_num(b)
    power = ((np.abs(a) ** 2) @ in_b.T) * (in_a @ (np.abs(b) ** 2).T)
    several = in_a.astype(int) @ in_b.T.astype(int) > 1
    return np.asarray(np.abs(a.conj() @ b.T) ** 2 / np.where(several & (power > 0), power, np.nan))


def name_together(
    found: Modes, described: Modes, known: Sequence[Target], targets: Sequence[Target], log: str
) -> Modes:
    """Name all resonances of a log, of which some may be no described mode.

    Estimates of described modes remain where nothing more was found in their band; the others are
    biased by what their fit lacks, and replaced by those of the search.

    ``found`` is of a search without a description, ``described`` of the fit of described modes
    only, which is returned if the search found no more; ``known`` are the resonances of that fit,
    published or not, ``targets`` the described modes, ascending in frequency.
    """
    near = [any(is_near(target, f) for target in targets) for f in found.frequency.tolist()]
    found = found.select(np.flatnonzero(near).tolist())
    more = _unexplained(found, known)
    if not more:
        return described
    reach = BAND_HALF_WIDTH * np.maximum(
        described.damping_ratio[:, None], found.damping_ratio[more]
    )
    off = np.abs(described.ln_frequency[:, None] - found.ln_frequency[more])
    alone = (off > reach).all(axis=1)
    kept = described.select(np.flatnonzero(alone).tolist())
    rest = described.select(np.flatnonzero(~alone).tolist())
    rest = rest.select(_apart(rest, found.ln_frequency))
    found = found.select(_apart(found, kept.ln_frequency))
    parts = [replace(one, names=("",) * len(one.names)) for one in (kept, found, rest)]
    both = merge(parts, described.lines, (), described.shape_channels)
    values: Any = {"damping": both.damping_ratio.tolist(), "shapes": likeness(both, targets)}
    assigned = partial(assign, both.frequency.tolist(), targets, **values, undescribed=True)
    names, ambiguous = assigned()
    sure, _ = assigned(clear=constants.SURE_NAME)
    flags = tuple(
        f"{own} doubtful-name".strip() if name and not certain else own
        for own, name, certain in zip(both.flags, names, sure, strict=True)
    )
    index = [i for i, name in enumerate(names) if name]
    unnamed = both.select([i for i, name in enumerate(names) if not name])
    missing = [target for target in targets if target.name not in names]
    refused = _refuse_unnamed(described, unnamed, missing, ambiguous, log)
    return replace(both, names=names, flags=flags, refused=refused).select(index)


def _unexplained(found: Modes, known: Sequence[Target]) -> list[int]:
    """Return the modes that are not the nearest of a known one within a half-power bandwidth."""
    explained = set()
    for one in known:
        off = np.abs(found.ln_frequency - np.log(one.frequency))
        relative = off / (found.damping_ratio + one.damping_ratio)
        if relative.size and relative.min() < 1:
            explained.add(int(relative.argmin()))
    return [i for i in range(len(found.names)) if i not in explained]


def _apart(modes: Modes, ln_f: FloatArray) -> list[int]:
    """Return the modes that are further than their half-power bandwidth from all of others."""
    off = np.abs(modes.ln_frequency[:, None] - ln_f)
    return np.flatnonzero((off > 2 * modes.damping_ratio[:, None]).all(axis=1)).tolist()


def _refuse_unnamed(
    described: Modes,
    unnamed: Modes,
    missing: Sequence[Target],
    ambiguous: dict[str, Rejection],
    log: str,
) -> tuple[Refusal, ...]:
    """Return refusals of channels, of described modes without a resonance, and the reverse."""
    before = {one.mode: one for one in described.refused}
    refused = [one for one in described.refused if not one.mode]
    for target in missing:
        f = target.frequency
        detail = (
            f"every resonance near {f:.4g} Hz is more likely another mode; correct the "
            "description, or excite this mode"
        )
        why = ambiguous.get(target.name, Rejection("not-excited", detail, f))
        own = Refusal(log, why.reason, why.detail, mode=target.name, frequency=why.frequency)
        refused.append(own if target.name in ambiguous else before.get(target.name, own))
    for f, zeta in zip(unnamed.frequency.tolist(), unnamed.damping_ratio.tolist(), strict=True):
        detail = (
            f"a resonance at {f:.5g} Hz, damping {100 * zeta:.2g} %, is not clearly any described "
            "mode: describe it, or correct the description"
        )
        name = f"{f:.5g} Hz"
        refused.append(Refusal(log, "undescribed", detail, mode=name, frequency=f))
    return tuple(refused)


class Difference(NamedTuple):
    """Declared and found values of one mode."""

    mode: str
    declared_hz: float
    found_hz: float
    declared_damping_ratio: float
    found_damping_ratio: float


def compare(modes: Modes, stage: Stage) -> tuple[Difference, ...]:
    """Compare the named modes of one log with their description as `off_description` does."""
    specs = {mode.name: mode for mode in stage.modes}
    index = [i for i, name in enumerate(modes.names) if name in specs]
    named = modes.select(index)
    own = [specs[name] for name in named.names]
    targets = [
        Target(m.name, m.frequency_hz, m.damping_ratio, m.search, shape=m.shape) for m in own
    ]
    estimate, std = named.estimate.reshape(2, -1), np.sqrt(np.diag(named.cov)).reshape(2, -1)
    shapes = np.diagonal(likeness(named, targets))
    return off_description(stage, named.names, estimate, std, shapes)


def off_description(
    stage: Stage,
    names: Sequence[str],
    estimate: FloatArray,
    std: FloatArray,
    shapes: FloatArray | None = None,
) -> tuple[Difference, ...]:
    """Compare modes with their description, all if one differs beyond what is plausible, else none.

    A mode that is not where it is described may be another one, and so may its neighbours.
    ``estimate`` holds ln f and ln ζ, ``std`` their standard deviations, ``(2, n_modes)``;
    ``shapes`` the modal assurance criterion with the described shapes, NaN where unknown.
    """
    specs = {mode.name: mode for mode in stage.modes}
    own = [specs[name] for name in names]
    declared = np.array([[mode.frequency_hz, mode.damping_ratio] for mode in own]).reshape(-1, 2).T
    limit = np.log([[1 + constants.OFF_FREQUENCY], [constants.OFF_DAMPING]])
    off = (np.abs(estimate - np.log(declared)) > limit + 2 * std).any()
    if shapes is not None:
        off |= (shapes < constants.OFF_SHAPE).any()
    if not off:
        return ()
    rows = zip(names, *declared.tolist(), *np.exp(estimate).tolist(), strict=True)
    return tuple(Difference(name, f, g, zeta, eta) for name, f, zeta, g, eta in rows)


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
