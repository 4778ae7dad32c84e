"""Names of identified resonances.

Ambient and free-decay identification compute the posterior probability of every assignment that
keeps the order of frequencies (`assign`). Frequency responses name only modes that no other mode
or name competes for (`name_response`): tracking assigns the rest.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmshealth._private.arrays import BoolArray, FloatArray
from lmshealth.io.log import Refusal
from lmshealth.modal import constants
from lmshealth.modal.modes import Modes, Rejection
from lmshealth.modal.targets import Target
from lmshealth.stage.description import Stage, search_offset

# Steps of the common shift of ln f over which assignments are summed.
_COMMON_SHIFTS = 121


def assign(
    frequency: Sequence[float],
    targets: Sequence[Target],
    probability: FloatArray,
    *,
    complete: bool = False,
) -> tuple[tuple[str, ...], dict[str, Rejection]]:
    """Assign resonances to targets by their `pairing_probability`.

    Returns the name of each resonance, empty where it is no target or the assignment is not clear,
    and the targets that are not assigned but may be one of the resonances, each at the likeliest
    one without a name.
    """
    names = clear_names(probability, targets, constants.CLEAR_NAME)
    # With complete assignments a named resonance cannot be another target as well.
    open_ = [i for i, name in enumerate(names) if not (complete and name)]
    ambiguous = {}
    for j, target in enumerate(targets):
        rivals = [i for i in open_ if probability[i, j] > constants.UNLIKELY_NAME]
        if target.name not in names and rivals:
            odds = "; ".join(_odds(frequency[i], probability[i], targets) for i in rivals)
            remedy = "the assignment is not clear; excite the other modes, or narrow searches"
            free = [(probability[i, j], frequency[i]) for i in rivals if not names[i]]
            place = max(free)[1] if free else None
            ambiguous[target.name] = Rejection("ambiguous", f"{odds}: {remedy}", place)
    return names, ambiguous


def clear_names(
    probability: FloatArray, targets: Sequence[Target], least: float
) -> tuple[str, ...]:
    """Return the names that resonances have with at least this probability, else an empty one."""
    return tuple(
        targets[int(np.argmax(row))].name if row.size and row.max() >= least else ""
        for row in probability
    )


def pairing_probability(
    frequency: Sequence[float],
    targets: Sequence[Target],
    *,
    damping: Sequence[float] | None = None,
    shapes: FloatArray | None = None,
    complete: bool = False,
    standing: bool = False,
) -> FloatArray:
    """Return the probability that each resonance is each target, ``(n_resonances, n_targets)``.

    It is that of all assignments that keep the order of frequencies, of which the shifts of ln f
    are normal about a common one, or those of a state of wear on the map, and every pair gains.
    Pairs outside the search, or with another damping where it is given, are excluded. Resonances,
    in Hz, and targets ascend; ``shapes`` holds the modal assurance criterion of each pair, NaN
    where it is unknown. ``complete`` states that every resonance is a target, ``standing`` that the
    machine is as likely at its description as worn: then dampings count, too.
    """
    n, m = len(frequency), len(targets)
    if not n or not m:
        return np.zeros((n, m))
    found = np.asarray(frequency, dtype=float)[:, None]
    described, search = np.array([(target.frequency, target.search) for target in targets]).T
    shift = np.log(found) - np.log(described)
    admissible = np.abs(search_offset(found, described, search)) <= 1
    gain = np.full((n, m), constants.NAME_GAIN)
    if damping is not None:
        ratio = np.array(damping)[:, None] / [target.damping_ratio for target in targets]
        admissible &= np.abs(np.log(ratio)) < np.log(constants.DAMPING_SPAN)
        if standing:
            gain -= np.log1p(0.5 * (np.log(ratio) / constants.DAMPING_PRIOR) ** 2)
    if shapes is not None:
        gain -= np.log1p(0.5 * np.nan_to_num((1 - shapes) / constants.SHAPE_PRIOR) ** 2)
    reach = float(np.log1p(search.max()))
    common = np.linspace(-reach, reach, _COMMON_SHIFTS)
    scales = search.mean() * np.array([constants.COMMON_SHIFT, constants.NO_SHIFT])
    # Normal densities up to a factor, which cancels.
    moved, still = (np.exp(-0.5 * (common[:, None] / scales) ** 2) / scales).T
    expected = np.repeat(common[:, None], m, axis=1)
    if all(target.wear.size for target in targets):
        # Wear has one half of its probability by the map.
        states = np.array([target.wear for target in targets]).T
        expected = np.concatenate([expected, states])
        moved = np.append(moved / 2, np.full(len(states), moved.sum() / 2 / len(states)))
        still = np.append(still, np.zeros(len(states)))
    prior = moved + still * standing
    apart = (shift - expected[:, None]) / (search * constants.OWN_SHIFT)
    weight = np.where(admissible, np.exp(gain - 0.5 * apart**2), 0.0)
    before = _sums_before(weight, complete=complete)
    after = _sums_before(weight[:, ::-1, ::-1], complete=complete)[:, ::-1, ::-1]
    joint = np.einsum("c,cij,cij,cij->ij", prior, before[:, :n, :m], weight, after[:, 1:, 1:])
    total = float(prior @ before[:, n, m])
    return np.asarray(joint / total) if total > 0 else np.zeros((n, m))


def _sums_before(weight: FloatArray, *, complete: bool) -> FloatArray:
    """Sum the weights of all assignments of the first i resonances to the first j targets.

    The weight of an assignment is the product of those of its pairs, ``(..., n, m)``; the result
    has shape ``(..., n + 1, m + 1)``. In a complete assignment no resonance is without a target.
    """
    *others, n, m = weight.shape
    total = np.zeros((*others, n + 1, m + 1))
    total[..., 0, :] = 1.0
    for i in range(n):
        total[..., i + 1, 1:] = np.cumsum(total[..., i, :-1] * weight[..., i, :], axis=-1)
        if not complete:
            total[..., i + 1, :] += total[..., i, :]
    return total


def _odds(frequency: float, probability: FloatArray, targets: Sequence[Target]) -> str:
    odds = ", ".join(
        f"{target.name} {100 * p:.0f} %"
        for target, p in zip(targets, probability.tolist(), strict=True)
        if p > constants.UNLIKELY_NAME
    )
    return f"{frequency:.5g} Hz may be {odds}"


def is_near(target: Target, frequency: float, *, slack: float = 1.0) -> bool:
    """Return whether a frequency in Hz is within so many times the search of a target."""
    return bool(abs(search_offset(frequency, target.frequency, target.search)) <= slack)


def is_near_light(targets: Sequence[Target], frequency: float) -> bool:
    """Return whether a described mode that may look like a line is near a frequency in Hz."""
    return any(one.is_light and is_near(one, frequency) for one in targets)


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


@dataclass(frozen=True, slots=True, eq=False)
class Named:
    """Names of the resonances of a log, and why described modes have none."""

    names: dict[str, str]  # of described modes, by the provisional names of resonances
    doubtful: frozenset[str]  # described modes whose resonance may be another one
    ambiguous: dict[str, Rejection]  # by described mode
    undescribed: frozenset[str]  # provisional names of resonances that are likely no described mode
    log: str

    def publish(
        self,
        modes: Modes,
        wanted: Sequence[Target],
        rejected: dict[str, Refusal],
        *,
        unclear: bool = False,
    ) -> Modes:
        """Return the wanted ones of credible modes, and refuse those that are not there.

        ``rejected`` are the resonances of the log that are not credible, by provisional name. With
        ``unclear`` those that may be several of the wanted ones are returned without a name.
        """
        by_name = {target.name: target for target in wanted}
        index = [
            i
            for i, (name, f) in enumerate(zip(modes.names, modes.frequency.tolist(), strict=True))
            if self.names.get(name) in by_name
            or (unclear and self._is_open(name) and any(is_near(t, f) for t in wanted))
        ]
        named = modes.select(index)
        names = tuple(self.names.get(name, "") for name in named.names)
        flags = tuple(
            " ".join(flag for flag in (own, *self._flags(by_name.get(name), f, zeta)) if flag)
            for own, name, f, zeta in zip(
                named.flags, names, named.frequency, named.damping_ratio, strict=True
            )
        )
        refused = [self._refuse(t, rejected, modes) for t in wanted if t.name not in names]
        for i, name in enumerate(modes.names):
            f, zeta = float(modes.frequency[i]), float(modes.damping_ratio[i])
            if name in self.names or name not in self.undescribed:
                continue
            detail = (
                f"a resonance at {f:.5g} Hz, damping {100 * zeta:.2g} %, is not clearly any "
                "described mode: describe it, or correct the description"
            )
            refused.append(
                Refusal(self.log, "undescribed", detail, mode=f"{f:.5g} Hz", frequency=f)
            )
        return replace(named, names=names, flags=flags, refused=(*modes.refused, *refused))

    def _is_open(self, name: str) -> bool:
        """Return whether a resonance is likely one of several described modes."""
        return name not in self.names and name not in self.undescribed

    def _flags(self, target: Target | None, f: float, zeta: float) -> Iterator[str]:
        """Yield the flags of a mode that follow from its description, none without a name."""
        if target is None:
            return
        offset = abs(search_offset(f, target.frequency, target.search))
        ratio = abs(np.log(zeta / target.damping_ratio)) / np.log(constants.DAMPING_SPAN)
        if offset > constants.AT_BOUND or ratio > constants.AT_BOUND:
            yield "at-bound"
        if target.name in self.doubtful:
            yield "doubtful-name"

    def _refuse(self, target: Target, rejected: dict[str, Refusal], modes: Modes) -> Refusal:
        """Return why a described mode is not published."""
        given = {name: own for own, name in self.names.items()}
        if (own := rejected.get(given.get(target.name, ""))) is not None:
            return replace(own, mode=target.name)
        if target.name in self.ambiguous:
            reason, detail, place = self.ambiguous[target.name]
            return Refusal(self.log, reason, detail, mode=target.name, frequency=place)
        near = [
            (abs(np.log(row.frequency / target.frequency)), row)
            for name, row in rejected.items()
            if name not in self.names
            and row.frequency is not None
            and is_near(target, row.frequency)
        ]
        if near:
            return replace(min(near, key=lambda one: one[0])[1], mode=target.name)
        f = target.frequency
        unnamed = [
            (x, zeta)
            for name, x, zeta in zip(
                modes.names, modes.frequency.tolist(), modes.damping_ratio.tolist(), strict=True
            )
            if name not in self.names and is_near(target, x)
        ]
        detail = f"no resonance near {f:.4g} Hz in any channel; excite it more or record longer"
        if unnamed:
            x, zeta = min(unnamed, key=lambda one: abs(np.log(one[0] / f)))
            factor = constants.DAMPING_SPAN
            if abs(np.log(zeta / target.damping_ratio)) > np.log(factor):
                detail = (
                    f"the resonance at {x:.5g} Hz has a damping of {100 * zeta:.2g} %, more than a "
                    f"factor of {factor:g} from the {100 * target.damping_ratio:.2g} % described"
                )
                return Refusal(self.log, "outside-search", detail, mode=target.name, frequency=x)
            detail = (
                f"every resonance near {f:.4g} Hz is more likely another mode; correct the "
                "description, or excite this mode"
            )
        return Refusal(self.log, "not-excited", detail, mode=target.name, frequency=f)


def name_resonances(both: Modes, targets: tuple[Target, ...], log: str) -> Named:
    """Name all resonances of a log, of which some may be no described mode.

    Fewer than there are described modes are all taken for such modes where that is possible. A
    lonely one of these is not named by guessing: only two resonances show that the machine stands
    at its description.
    """
    near = [i for i, f in enumerate(both.frequency.tolist()) if any(is_near(t, f) for t in targets)]
    both = both.select(near)
    complete, more = len(near) < len(targets), len(near) > len(targets)
    frequency = both.frequency.tolist()
    pair = partial(
        pairing_probability,
        frequency,
        targets,
        damping=both.damping_ratio.tolist(),
        shapes=likeness(both, targets),
        standing=not complete or len(near) > 1,
    )
    probability = pair(complete=complete)
    if complete and not probability.any():
        # They cannot all be described modes, as two that lie in one search only.
        complete, more = False, True
        probability = pair(complete=False)
    names, ambiguous = assign(frequency, targets, probability, complete=complete)
    sure = clear_names(probability, targets, constants.SURE_NAME)
    likely = probability.sum(axis=1) > 0.5
    return Named(
        names={own: name for own, name in zip(both.names, names, strict=True) if name},
        doubtful=frozenset(names) - frozenset(sure) if more else frozenset(),
        ambiguous=ambiguous,
        undescribed=frozenset(
            own for own, there in zip(both.names, likely, strict=True) if not there
        ),
        log=log,
    )


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
    offset = [search_offset(modes.frequency, m.frequency_hz, m.search) for m in stage.modes]
    return np.abs(np.reshape(offset, (len(stage.modes), len(modes.names)))) <= 1
