"""Data association: assign the modal estimates of all logs to the modes of one machine.

`associate_log` is one step of a tracker with multiple hypotheses [Reid1979]_: it takes a state and
the estimates of a log, and returns the next state and a label per estimate. No label uses later
logs, and an estimate gets a mode only if that mode has nearly all of the posterior probability.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, Self

import numpy as np

from lmshealth._private.arrays import BoolArray, FloatArray, freeze
from lmshealth.errors import BadTable
from lmshealth.tracking import constants
from lmshealth.tracking.association.hypotheses import (
    Candidates,
    Hypotheses,
    Scan,
    extend,
    follow,
    prune,
    reduce_hypotheses,
)
from lmshealth.tracking.association.mode_filters import (
    IntArray,
    Measurements,
    ModeFilters,
    predict,
    update,
)

Reason = Literal["ambiguous", "jump", "unconfirmed"]
Scales = dict[str, FloatArray]
"""Factors on the stated errors of ln f and ln ζ by source, ``(2,)``; 1 where there is none."""
Place = tuple[float, float, FloatArray]
"""ln f of a named estimate, its variance, and the covariates of its log."""

_SCALES, _CHANCES = np.array(constants.SOURCE_NOISE_SCALES).T
_GRID = np.geomspace(_SCALES[0], _SCALES[-1], 41)  # 1 in its middle
_LOG_PRIOR = np.interp(np.log(_GRID), np.log(_SCALES), np.log(_CHANCES))


@dataclass(frozen=True, slots=True, eq=False)
class Estimates:
    """The modal estimates of one log; `ValueError` if shapes of arrays do not match."""

    names: tuple[str, ...]  # from the identification, empty where it assigned none
    sources: tuple[str, ...]  # two estimates of one source are never of one mode
    ln_frequency: FloatArray  # ln of Hz, ``(n,)``
    ln_damping: FloatArray  # ln ζ, ``(n,)``; NaN where unknown
    cov: FloatArray  # covariance of ``[ln f, ln ζ]``, ``(2 n, 2 n)``; NaN where ln ζ is unknown
    shapes: FloatArray  # real, of any length, ``(n, n_channels)``; NaN where a channel is absent

    def __post_init__(self) -> None:
        n = len(self.names)
        shapes = "shapes", n, self.shapes.shape[-1]
        freeze(self, ("ln_frequency ln_damping", n), ("cov", 2 * n, 2 * n), shapes)


@dataclass(frozen=True, slots=True)
class Label:
    """The mode of one estimate, or why it has none."""

    mode: str | None
    reason: Reason | Literal[""] = ""
    detail: str = ""  # the reason in a sentence


@dataclass(frozen=True, slots=True)
class Association:
    """Labels of all estimates."""

    modes: tuple[str, ...]  # ascending in first frequency, by which modes without a name are named
    labels: tuple[tuple[Label, ...], ...]  # for each log and each of its estimates

    @property
    def assigned(self) -> tuple[tuple[str | None, ...], ...]:
        """Mode of each estimate of each log, or None."""
        return tuple(tuple(label.mode for label in own) for own in self.labels)

    @property
    def unassigned(self) -> list[tuple[int, int, Label]]:
        """Log, estimate and label of each estimate without a mode, in order."""
        return [
            (k, i, label)
            for k, own in enumerate(self.labels)
            for i, label in enumerate(own)
            if label.mode is None
        ]


@dataclass(frozen=True, slots=True, eq=False)
class LogMeasurements:
    """Measurements of one log with what their prediction depends on: input of `associate_log`."""

    epoch: int  # index of the log
    clock: float
    life: float  # length of a life on the clock as known at this log, 0 while unknown
    offsets: FloatArray  # covariates about their references, ``(n_covariates,)``
    opened: bool  # whether frequencies may step before it, as after declared maintenance
    names: tuple[str, ...]
    sources: tuple[str, ...]
    measurements: Measurements

    @property
    def places(self) -> dict[tuple[str, str], Place]:
        """Place of every named mode and source."""
        new = self.measurements
        rows = zip(self.names, self.sources, new.ln_f.tolist(), new.var_f.tolist(), strict=True)
        return {(name, source): (*own, self.offsets) for name, source, *own in rows if name}


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """All that later labels depend on."""

    prior_std: FloatArray  # of the covariates' coefficients, ``(n_covariates,)``
    hypotheses: Hypotheses  # over the m modes found so far
    candidates: Candidates
    order: IntArray  # modes that the identification names, ascending in first frequency
    names: tuple[str, ...] = ()  # of the modes, in the order in which they were found
    first: tuple[float, ...] = ()  # their first ln f
    places: dict[tuple[str, str], Place] | None = None  # last ones of named modes and sources
    clock: float | None = None  # to which the filters are predicted

    @classmethod
    def start(cls, prior_std: FloatArray, n_channels: int) -> Self:
        """Return the state before the first log."""
        sizes = (prior_std.size, n_channels)
        none = np.empty(0, dtype=int)
        return cls(prior_std, Hypotheses.empty(*sizes), Candidates.empty(*sizes), none)


def associate(
    epochs: Sequence[Estimates],
    clock: FloatArray,
    *,
    offsets: FloatArray,
    prior_std: FloatArray,
    jumps: Collection[int] = (),
) -> Association:
    """Assign the estimates of all logs to modes; the labels of a log use it and earlier logs.

    All epochs, one per log, have equally many channels of shapes. The clock is an ascending
    odometer or time in any unit, ``(n_epochs,)``. Offsets are covariates about their references, 0
    where unknown, ``(n_epochs, n_covariates)``, with prior standard deviations of d ln f per unit
    of each, ``(n_covariates,)``. Jumps are epochs at which frequencies may step, as after declared
    maintenance. `BadTable` if an estimate is not finite or has no positive variance.
    """
    start = state = State.start(prior_std, epochs[0].shapes.shape[1])
    declared, places = frozenset(jumps), clock.tolist()
    # Length of a life as known at each log.
    count, gaps = np.maximum(np.arange(clock.size), 1), np.diff(clock, prepend=clock[0])
    by_count = (clock - clock[0]) * np.maximum(1.0, constants.LEAST_LIFE_LOGS / count)
    lives = np.maximum(by_count, constants.LEAST_LIFE_GAPS * gaps).tolist()
    stated, sources = measurements_of(epochs), [own.sources for own in epochs]
    scales = learn_scales(stated, sources, offsets, prior_std)
    labels: list[tuple[Label, ...]] = []

    def log_at(j: int, names: tuple[str, ...], now: int) -> LogMeasurements:
        new = scaled(stated[j], sources[j], scales[now])
        opened = j in declared
        return LogMeasurements(j, places[j], lives[j], offsets[j], opened, names, sources[j], new)

    for k, own in enumerate(epochs):
        if k and scales[k] is not scales[k - 1]:
            # Filters and hypotheses rest on errors that are wrong: they start again. Labels stay
            # as they are: they are the names of the estimates that have them.
            state = start
            for j, given in enumerate(labels):
                pairs = zip(given, epochs[j].names, strict=True)
                names = tuple(label.mode or name for label, name in pairs)
                state, _ = associate_log(state, log_at(j, names, k))
        state, found = associate_log(state, log_at(k, own.names, k))
        labels.append(found)
    order = np.argsort(state.first, kind="stable")
    return Association(tuple(state.names[i] for i in order), tuple(labels))


def associate_log(state: State, log: LogMeasurements) -> tuple[State, tuple[Label, ...]]:
    """Associate the estimates of one log: the next state, and a label per estimate.

    All filters are predicted to the log, and the sources are associated one after the other: by the
    gates where only one assignment is possible, else by hypotheses.
    """
    places = state.places or {}
    if not log.opened and _is_common_jump(places, log, state.prior_std):
        log = replace(log, opened=True)
    state = _predict(state, log)
    found: list[Label] = [Label(None)] * len(log.names)
    confirmed: set[int] = set()
    detected: set[int] = set()
    for source in dict.fromkeys(log.sources):
        rows = np.flatnonzero([one == source for one in log.sources])
        # Modes that one source starts are known to the next.
        index = {name: i for i, name in enumerate(state.names)} | {"": -1}
        meant = np.array([index.get(log.names[i], len(state.names)) for i in rows], dtype=int)
        own = log.measurements if rows.size == len(log.names) else log.measurements[rows]
        scan = Scan(log.epoch, rows, meant, own, np.concatenate([(1.0, 0.0), log.offsets]))
        unique = None if log.opened else _unique_assignment(state, scan)
        if unique is not None:
            known, modes = state.hypotheses, unique.tolist()
            filters = update(known.filters, (np.zeros_like(unique), unique), own, scan.row)
            state = replace(state, hypotheses=replace(known, filters=filters))
            labels = [Label(state.names[mode]) for mode in modes]
        else:
            state, modes, labels = _resolve(state, scan, log, confirmed)
        detected.update(mode for mode in modes if mode >= 0)
        for row, label in zip(rows, labels, strict=True):
            found[row] = label
    candidates = prune(state.candidates, log.epoch, confirmed, detected)
    state = replace(state, candidates=candidates, places=places | log.places)
    return state, tuple(found)


def _is_common_jump(
    places: dict[tuple[str, str], Place], log: LogMeasurements, prior_std: FloatArray
) -> bool:
    """Return whether several named modes are off at once, at places where no mode was before.

    A crash moves all modes: names are then more reliable than places. At places of other modes the
    names may be wrong.
    """
    moved = set()
    for (name, source), (ln_f, var, _) in log.places.items():
        if (name, source) not in places:
            continue
        change = float(np.abs(log.offsets - places[name, source][2]) @ prior_std)
        reach = constants.JUMP_LN_F + constants.JUMP_COVARIATE_GATE * change
        if not any(
            other[1] == source
            and abs(ln_f - place) <= reach + constants.JUMP_GATE * float(np.sqrt(var + place_var))
            for other, (place, place_var, _) in places.items()
        ):
            moved.add(name)
    return len(moved) > 1


def _predict(state: State, log: LogMeasurements) -> State:
    """Predict all filters to a log."""
    step = 0.0 if state.clock is None else log.clock - state.clock
    hypotheses, candidates = state.hypotheses, state.candidates
    filters = predict(hypotheses.filters, step, log.life, opened=log.opened)
    hypotheses = replace(hypotheses, filters=filters)
    if len(candidates):
        filters = predict(candidates.filters, step, log.life, opened=log.opened)
        candidates = replace(candidates, filters=filters)
    return replace(state, hypotheses=hypotheses, candidates=candidates, clock=log.clock)


def _unique_assignment(state: State, scan: Scan) -> IntArray | None:
    """Return the modes of a scan that has only one assignment inside the gates, else None.

    Each estimate is inside the inner gate of one mode, outside the outer gates of all others, and
    agrees with its mode in name, damping and shape.
    """
    filters, new = state.hypotheses.filters, scan.measurements
    if len(filters.mean) > 1 or not filters.n_modes:
        return None
    at, var = (side[0] for side in filters.predicted(scan.row))
    squared = (new.ln_f[:, None] - at) ** 2 / (new.var_f[:, None] + var)
    rows, modes = np.nonzero(squared < constants.OUTER_GATE**2)
    if rows.size != scan.rows.size or np.unique(modes).size < rows.size:
        return None
    inner = constants.INNER_GATE**2
    if (rows != np.arange(rows.size)).any() or (squared[rows, modes] > inner).any():
        return None
    named = scan.names >= 0
    rising = (np.diff(at[state.order]) > 0).all()
    if named.any() and not (rising and np.array_equal(scan.names[named], modes[named])):
        return None
    off = (new.ln_zeta - filters.ln_zeta[0, modes]) ** 2
    if (off > inner * (new.var_zeta + filters.var_zeta[0, modes])).any():
        return None
    if new.shapes.shape[1] > 1:
        mac = np.nansum(new.shapes * filters.shapes[0, modes], axis=-1) ** 2
        if not (mac > constants.LEAST_MAC).all():
            return None
    return np.asarray(modes)


def _resolve(
    state: State, scan: Scan, log: LogMeasurements, confirmed: set[int]
) -> tuple[State, list[int], list[Label]]:
    """Associate a scan by hypotheses; add the candidates that become modes to `confirmed`.

    Returned are the next state, and the mode (-1 for none) and the label of each estimate.
    """
    expected = state.hypotheses.filters.predicted(scan.row)[0][0]
    extended = extend(state.hypotheses, scan, state.order, opened=log.opened)
    state = replace(state, hypotheses=reduce_hypotheses(extended))
    known = state.names
    m = len(known)
    chances = extended.probabilities(m)
    best = np.where(chances.argmax(1) < m, chances.argmax(1), -1)
    modes = np.where(chances.max(1) >= constants.LABEL_PROBABILITY, best, -1).tolist()
    jumps = [i for i in range(len(modes)) if modes[i] < 0 and _is_jump(i, scan, chances, best)]
    for i in np.flatnonzero(chances[:, -1] > 0.5).tolist():
        name = log.names[scan.rows[i]]
        if name and name not in state.names:
            state = _start_named(state, scan.pick(np.array([i])), name, log.life)
            modes[i] = len(state.names) - 1
    lone = [i for i, mode in enumerate(modes) if mode < 0 and chances[i, -1] > 0.5]
    left = np.array(sorted({*lone, *jumps}), dtype=int)
    rest = scan.pick(left)
    rest = replace(rest, names=np.where(np.isin(left, jumps), rest.names, -1))
    candidates, new = follow(state.candidates, rest, state.prior_std, log.life)
    state = replace(state, candidates=candidates)
    for i, j in zip(left.tolist(), new, strict=True):
        if j is not None:
            state, modes[i] = _confirm(state, j, scan.row)
            confirmed.add(j)
    labels = []
    for i, mode in enumerate(modes):
        if mode >= 0:
            labels.append(Label(state.names[mode]))
            continue
        frequency = float(np.exp(scan.measurements.ln_f[i]))
        if i in jumps:
            before = float(np.exp(expected[scan.names[i]]))
            detail = (
                f"{frequency:.5g} Hz named {log.names[scan.rows[i]]}, expected at {before:.5g} Hz: "
                "a jump that the log before does not show; it is accepted once the next log "
                "confirms it"
            )
            labels.append(Label(None, "jump", detail))
        else:
            labels.append(_doubtful(frequency, chances[i], known))
    return state, modes, labels


def _is_jump(i: int, scan: Scan, chances: FloatArray, best: IntArray) -> bool:
    """Return whether an estimate is of the mode that its name means or of none.

    The name of a mode that is detected elsewhere in the scan has no weight.
    """
    own = int(scan.names[i])
    if not 0 <= own < chances.shape[1] - 1 or own in np.delete(best, i):
        return False
    return bool(chances[i, own] + chances[i, -1] >= constants.LABEL_PROBABILITY)


def _start_named(state: State, scan: Scan, name: str, life: float) -> State:
    """Start a mode at the first estimate that has its name."""
    filters = state.hypotheses.filters
    filters = filters.start(scan.measurements, scan.row, state.prior_std, life)
    state = _add_mode(state, filters, name, float(scan.measurements.ln_f[0]))
    named = np.append(state.order, len(state.names) - 1)
    by_first = np.argsort(np.array(state.first)[named], kind="stable")
    return replace(state, order=named[by_first])


def _confirm(state: State, j: int, row: FloatArray) -> tuple[State, int]:
    """Make a candidate a mode, or the new level of the mode that it is named after."""
    new = state.candidates.filters.keep(np.array([j]))
    mode, filters = int(state.candidates.modes[j]), state.hypotheses.filters
    if mode < 0:
        ln_f = float(new.predicted(row)[0][0, 0])
        name = _unique_name(state.names, float(np.exp(ln_f)))
        return _add_mode(state, filters.join(new), name, ln_f), len(state.names)
    filters = filters[np.arange(len(filters.mean))]
    for part in ("mean", "cov", "ln_zeta", "var_zeta"):
        getattr(filters, part)[:, mode] = getattr(new, part)[0, 0]
    return replace(state, hypotheses=replace(state.hypotheses, filters=filters)), mode


def _add_mode(state: State, filters: ModeFilters, name: str, ln_f: float) -> State:
    """Append a mode, for which the filters have an entry more."""
    hypotheses = replace(state.hypotheses, filters=filters)
    names, first = (*state.names, name), (*state.first, ln_f)
    return replace(state, hypotheses=hypotheses, names=names, first=first)


def _unique_name(names: tuple[str, ...], frequency: float) -> str:
    """Name a mode by its frequency, with as many digits as distinguish it from others."""
    for digits in range(6):
        name = f"{frequency:.{digits}f}_hz"
        if name not in names:
            return name
    return f"{name[:-3]}_{len(names)}_hz"


def _doubtful(frequency: float, chances: FloatArray, modes: tuple[str, ...]) -> Label:
    """Return the label of an estimate without a mode."""
    if chances[-1] >= constants.LABEL_PROBABILITY:
        detail = f"{frequency:.5g} Hz is of no known mode; it becomes one once three logs show it"
        return Label(None, "unconfirmed", detail)
    each = [*modes, "no known mode"]
    parts = [f"{each[j]} {chances[j]:.0%}" for j in np.argsort(-chances) if chances[j] > 0.005]
    detail = f"{frequency:.5g} Hz may be of {' or '.join(parts)}: the logs so far do not decide"
    return Label(None, "ambiguous", detail)


def measurements_of(epochs: Sequence[Estimates]) -> list[Measurements]:
    """Return the measurements of each log, with shapes of unit length, or raise `BadTable`."""
    start = np.cumsum([0, *(len(e.names) for e in epochs)]).tolist()
    ln_f = np.concatenate([e.ln_frequency for e in epochs])
    ln_zeta = np.concatenate([e.ln_damping for e in epochs])
    var_f, var_zeta = np.hstack([e.cov.diagonal().reshape(2, -1) for e in epochs])
    shapes = np.concatenate([e.shapes for e in epochs])
    good = np.isfinite(ln_f) & np.isfinite(var_f) & (var_f > 0)
    good &= (np.isfinite(var_zeta) & (var_zeta > 0)) | ~np.isfinite(ln_zeta)
    if not good.all():
        at = int(np.flatnonzero(~good)[0])
        k = int(np.searchsorted(start, at, side="right")) - 1
        i = at - start[k]
        raise BadTable(
            f"epoch {k}, estimate {i} ({epochs[k].names[i] or 'without a name'}): ln f "
            f"{ln_f[at]:g} with variance {var_f[at]:g}, ln ζ {ln_zeta[at]:g} with variance "
            f"{var_zeta[at]:g}: needed are finite values with positive variances; leave out "
            "estimates that have none, and give ln ζ as NaN where it is unknown"
        )
    unknown = ~np.isfinite(ln_zeta)
    ln_zeta[unknown], var_zeta[unknown] = 0.0, np.inf
    if shapes.shape[1]:
        norm = np.sqrt(np.nansum(shapes**2, axis=1, keepdims=True))
        shapes /= np.where(norm > 0, norm, np.nan)
    columns = (ln_f, var_f, ln_zeta, var_zeta, shapes)
    return [Measurements(*(column[a:b] for column in columns)) for a, b in pairwise(start)]


def learn_scales(
    measurements: Sequence[Measurements],
    sources: Sequence[tuple[str, ...]],
    offsets: FloatArray,
    prior_std: FloatArray,
) -> list[Scales]:
    """Return the scales of every log, as the scatter of successive estimates up to it shows them.

    Another program may state errors that are wrong by an order of magnitude; gates need the scatter
    before it is known which mode an estimate is of. Two estimates of successive logs that are each
    other's nearest are nearly always of one mode. Scales are the most probable ones of a grid, and
    change only by more than `constants.LEAST_RESCALING`: until then the same object is returned.
    `sources` are those of the estimates of each log, other parameters those of `associate`.
    """
    ends = np.cumsum([0, *(len(own) for own in sources)])
    source_of = np.array([source for own in sources for source in own], dtype=object)
    log_of = np.repeat(np.arange(len(sources)), np.diff(ends))
    columns = ("ln_f", "var_f", "ln_zeta", "var_zeta")
    values = np.array([np.concatenate([getattr(m, c) for m in measurements]) for c in columns])
    likely: dict[int, Scales] = {}
    for source in dict.fromkeys(source_of):
        rows = np.flatnonzero(source_of == source)
        for k, scale in _likely_scales(values[:, rows], log_of[rows], offsets * prior_std):
            likely.setdefault(k, {})[source] = scale
    held: Scales = {}
    scales = []
    for k in range(len(sources)):
        for source, scale in likely.get(k, {}).items():
            change = np.abs(np.log(scale / held.get(source, np.ones(2)))).max()
            if change > np.log(constants.LEAST_RESCALING):
                held = {**held, source: scale}
        scales.append(held)
    return scales


def _likely_scales(
    values: FloatArray, log_of: IntArray, moving: FloatArray
) -> Iterator[tuple[int, FloatArray]]:
    """Yield the logs of a source after which other scales are the most probable ones, with these.

    `values` are ln f, its variance, ln ζ and its variance of all estimates, ``(4, n)``, `log_of`
    their logs and `moving` ln f by the covariates of each log, ``(n_logs, n_covariates)``.
    """
    logs, first, counts = np.unique(log_of, return_index=True, return_counts=True)
    # Rows of the estimates of each log; those that are missing have no distance.
    place = np.arange(counts.max())
    there, rows = place < counts[:, None], np.minimum(first[:, None] + place, log_of.size - 1)
    new, old, pair = _nearest_pairs(values[0], rows, there)
    moved = np.sum(np.diff(moving[logs], axis=0) ** 2, axis=1)
    gain = np.zeros((logs.size, 2, _GRID.size))
    gain[0] = _LOG_PRIOR
    np.add.at(gain, pair + 1, _evidence(values[:, new], values[:, old], moved[pair]))
    best = np.cumsum(gain, axis=0)[1:].argmax(axis=2)
    changes = np.diff(best, axis=0, prepend=_GRID.size // 2) != 0
    for at in np.flatnonzero(changes.any(axis=1)):
        yield int(logs[at + 1]), _GRID[best[at]]


def scaled(new: Measurements, sources: tuple[str, ...], scales: Scales) -> Measurements:
    """Return the estimates of one log with the variances by the scales of their sources."""
    if not scales:
        return new
    factor = np.array([scales.get(source, np.ones(2)) for source in sources]).reshape(-1, 2)
    var_f, var_zeta = np.array([new.var_f, new.var_zeta]) * factor.T**2
    return replace(new, var_f=var_f, var_zeta=var_zeta)


def _nearest_pairs(
    ln_f: FloatArray, rows: IntArray, there: BoolArray
) -> tuple[IntArray, IntArray, IntArray]:
    """Return the estimates of two logs in a row that are each other's nearest, and which logs.

    Returned are both estimates of each pair, and the index of the first of the two logs.
    """
    gap = np.abs(ln_f[rows[1:]][:, :, None] - ln_f[rows[:-1]][:, None, :])
    gap[~(there[1:][:, :, None] & there[:-1][:, None, :])] = np.inf
    own, back = gap.argmin(axis=2), gap.argmin(axis=1)
    mutual = np.take_along_axis(back, own, axis=1) == np.arange(own.shape[1])
    pair, i = np.nonzero(mutual & there[1:])
    return rows[pair + 1, i], rows[pair, own[pair, i]], pair


def _evidence(new: FloatArray, old: FloatArray, moved: FloatArray) -> FloatArray:
    """Return the log evidence of n pairs for each scale of ln f and of ln ζ, ``(n, 2, n_scales)``.

    `new` and `old` are as the values of `_likely_scales`, ``(4, n)``; `moved` is the variance of
    ln f by the covariates between them, ``(n,)``. A share of the pairs is of different modes: their
    differences have any size. Each estimate is in two differences, so that these count half.
    """
    off = (new[[0, 2]] - old[[0, 2]]).T
    stated = (new[[1, 3]] + old[[1, 3]]).T
    known = np.isfinite(stated)
    var = np.where(known, stated, 1.0)[:, :, None] * _GRID**2
    var[:, 0] += moved[:, None]
    share = constants.STRAY_PROBABILITY
    density = np.exp(-0.5 * off[:, :, None] ** 2 / var) / np.sqrt(2 * np.pi * var)
    gain = np.log((1 - share) * density + share)
    return np.asarray(0.5 * np.where(known[:, :, None], gain, 0.0))
