"""State of a track: what is known after each log, and the pure step from one log to the next.

A track is a fold: ``reduce(step, range(n_logs), initial_state(space))``. A state is never changed;
a detected step makes one whose last logs are filtered again from the checkpoint before the step.

A mean innovation over the last logs raises a suspicion of a step that nobody declared, or of a
drift that begins. Only then all kinds of change are weighed by their log Bayes factors, as the
README of this folder describes; changes that are not weighed only reduce the probability of a false
alarm.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import chdtri, ndtri, stdtrit

from lmshealth._private.arrays import BoolArray, FloatArray
from lmshealth.modal.credibility import dependence
from lmshealth.tracking import constants
from lmshealth.tracking.filters.kalman_filters import (
    LEAST_WEIGHT,
    FilterBank,
    Gaussian,
    Nuisances,
    advance,
    filter_log,
    initial,
    predict,
    prior,
    restart,
    select_nuisances,
    update,
)
from lmshealth.tracking.filters.state_space import StateSpace
from lmshealth.tracking.history import Step, StepKind

ChangeKind = StepKind | Literal["drift"]
EventKind = Literal["step", "regreasing", "servo", "sensor", "alarm"]

# Kind, source and mode of a change, and the first log after it.
_Change = tuple[ChangeKind, str, str, int]

# Lengths of the windows, in logs, and the number of checkpoints that they need.
_WINDOWS = (2, 4, 8, 16, 32, 64)
N_CHECKPOINTS = _WINDOWS[-1] + 4
# Logs about the suspected one that are tried as the first of a change.
_ABOUT = np.array([-2, -1, 0, 1, 2])
# Logs after which no running-in goes on: three times the slowest decay.
_RUN_IN = 3 * max(logs for logs, _ in constants.RUNNING_IN_LOGS)
# Logs that may be filtered again for every new one: bounds the run time.
_REPEATS = 4


@dataclass(frozen=True, slots=True)
class Event:
    """Step or alarm, as one mode shows it: one row of ``events.csv``.

    An alarm is an unexplained change of the modes since the baseline, at the declared false-alarm
    probability.
    """

    kind: EventKind
    epoch: int  # first log after a step; of an alarm, the log at which it is raised
    mode: str
    source: str  # the sensor's; else empty
    size: float  # change of ln f, of a regreasing change of ln ζ, of an alarm the drift
    std: float
    evidence: float  # log Bayes factor against no event, with the prior of an unknown place
    declared: bool  # whether maintenance or the log's ``servo_id`` declared it
    found_at: int  # the log after which it was detected


@dataclass(frozen=True, slots=True, eq=False)
class ChangeHypothesis:
    """The most likely change about a suspected log."""

    kind: ChangeKind  # of the step, or ``drift`` where a rate begins
    source: str  # the sensor's source; else empty
    first: int  # first log after it
    log_bayes_factor: float  # against no change, with the prior of the unknown place
    log_odds: float  # against all other kinds of change together
    mode: str = ""  # the only one that jumps; empty for all

    @property
    def significant(self) -> bool:
        """Whether no change is rejected at the declared false-alarm probability."""
        return self.log_bayes_factor >= threshold(1)

    def settled(self, now: int) -> bool:
        """Return whether its kind is clear, or no more logs are waited for."""
        # A step that is in the model raises no alarm any more.
        clear = self.damage if self.kind == "step" else self.log_odds >= constants.KIND_LOG_ODDS
        return clear or now - self.first >= constants.KIND_PATIENCE

    @property
    def damage(self) -> bool:
        """Whether it is damage, and other kinds are rejected at the declared probability."""
        least = threshold()
        return self.kind in ("step", "drift") and min(self.log_bayes_factor, self.log_odds) >= least


@dataclass(frozen=True, slots=True, eq=False)
class Epoch:
    """One log, as it was filtered the last time."""

    nuisances: Nuisances
    nis: float  # normalised innovation squared, without outliers
    standardised: FloatArray  # innovations of ``[ln f, ln ζ]``, NaN for none, ``(2 n_series,)``
    outlying: BoolArray  # whether each is an outlier, ``(2 n_series,)``

    @property
    def innovations(self) -> FloatArray:
        """Standardised innovations, NaN of outliers too, ``(2 n_series,)``."""
        return np.where(self.outlying, np.nan, self.standardised)


@dataclass(frozen=True, slots=True, eq=False)
class Published:
    """What is published of one log: no later one changes it. m is the number of modes."""

    mean: FloatArray  # of the state ``[ℓ, ℓ̇, ln ζ, ℓ₀]``, ``(4 m,)``
    variance: FloatArray  # ``(4 m,)``
    drift_cov: FloatArray  # ``(m, m)``
    noise_scale: FloatArray  # ``(n_sources,)``


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """A log of the last `N_CHECKPOINTS`, from which the track can continue otherwise."""

    index: int  # of the log
    epoch: Epoch
    before: Gaussian  # state of the published filter after the log before
    bank: FilterBank  # after the log
    sums: FloatArray  # running sums of innovations up to the log, of `add_to_sums`


@dataclass(frozen=True, slots=True, eq=False)
class TrackState:
    """All that is known after some logs.

    A regime begins at a reset, a baseline and a detected change: the state continues, the process
    noise has its prior again, and changes before the regime are not weighed again.
    """

    space: StateSpace  # with the steps so far
    bank: FilterBank  # from which the next log is predicted
    published: Gaussian  # state of the published filter
    checkpoints: tuple[Checkpoint, ...] = ()  # the last logs
    settled: tuple[Epoch, ...] = ()  # of the logs before them, which are not filtered again
    rows: tuple[Published, ...] = ()  # what is published of every log
    start: int = 0  # first log of the regime
    first: int = 1  # first log of its windows of innovations
    credit: int = 0  # logs that may be filtered again for other nuisances
    widening: FloatArray | None = None  # of the logs up to the last change, ``(n,)``
    loop_changes: tuple[int, ...] = ()  # unexplained changes of the following error
    changes: tuple[tuple[ChangeHypothesis, int], ...] = ()  # detected steps, and when
    alarms: tuple[Event, ...] = ()
    alarmed: bool = False  # since the last reset or baseline
    open: ChangeHypothesis | None = None  # a significant change whose kind is not settled
    weighed: tuple[int, int] = (-1, -1)  # the last suspicion that was weighed, and when
    # Half of what ln f of a first log that was left out is off from ℓ₀, ``(m,)``.
    off: FloatArray | None = None

    def epochs(self) -> list[Epoch]:
        """Return the epochs of all logs."""
        return [*self.settled, *(one.epoch for one in self.checkpoints)]


def initial_state(space: StateSpace) -> TrackState:
    """Return the state before the first log."""
    loop_changes = unexplained_loop_changes(space.history.loop_error, space.steps)
    return TrackState(space, initial(space), prior(space), loop_changes=loop_changes)


def step(state: TrackState, k: int) -> TrackState:
    """Return the state after log k from that after the log before."""
    history = state.space.history
    resets = [one.first for one in history.steps if one.kind == "reset"]
    if k and (k in history.baselines or k in resets):
        bank = restart(state.space, state.bank, anew=True)
        state = replace(state, bank=bank, start=k, first=k, alarmed=False, off=None)
    state = _filter(state, k)
    detected = _detect(state, k)
    news = len(detected.alarms) > len(state.alarms) or len(detected.changes) > len(state.changes)
    judged = _first_judged(state, k, news=news)
    if judged is not state:
        detected = _detect(judged, k)
    window, size = _worst_window(detected)
    # An older rate may hold no more, unless it is an outlier that deviates.
    if size > constants.BEGUN_GATE:
        detected = _reopened(detected, window)
    last, own = detected.checkpoints[-1], detected.published
    if last.epoch.outlying.any():
        own = filter_log(detected.space, last.before, last.epoch.nuisances, k, undecided=True)
    return replace(detected, rows=(*detected.rows, _row(detected, own)))


def _filter(state: TrackState, k: int) -> TrackState:
    """Filter log k, for the first time or again.

    What is outlying in three logs in a row has changed, by more than any prior allows for.
    """
    space = state.space
    recent = [one.epoch.outlying for one in state.checkpoints[-3:]]
    stays = len(recent) == 3 and bool(np.logical_and.reduce(recent).any())
    bank, found = update(space, predict(space, state.bank, k), k, outliers=not stays)
    bank = bank.pruned()
    state, nuisances, credit = _with_nuisances(state, select_nuisances(space, bank, found, k), k)
    before = state.published.padded(space.size)
    standardised, outlying = np.full(space.mode_of.size, np.nan), np.zeros(space.mode_of.size, bool)
    standardised[found.rows], outlying[found.rows] = found.standardised, found.is_outlier
    epoch = Epoch(nuisances, found.nis, standardised, outlying)
    most, last = constants.MOST_INNOVATION, state.checkpoints[-1:]
    sums = last[0].sums if last else np.zeros((2, standardised.size + 2))
    innovation = np.minimum(np.maximum(found.standardised, -most), most)
    sums = add_to_sums(sums, found.rows, innovation)
    checkpoints, settled = state.checkpoints, state.settled
    if len(checkpoints) == N_CHECKPOINTS:
        settled, checkpoints = (*settled, checkpoints[0].epoch), checkpoints[1:]
    return replace(
        state,
        bank=bank,
        published=filter_log(space, before, nuisances, k),
        checkpoints=(*checkpoints, Checkpoint(k, epoch, before, bank, sums)),
        settled=settled,
        credit=credit,
    )


def _first_judged(state: TrackState, k: int, *, news: bool) -> TrackState:
    """Judge the first log of a baseline by those up to log k.

    No log before it shows whether it is an outlier: the filters are run from log k back to it, at
    the length of a window, and where a step or an alarm is new.
    """
    space, first = state.space, state.start
    parts = [one.there[first : k + 1] for one in space.steps]
    stepped = any(part.any() and not part.all() for part in parts)
    due = k - first in _WINDOWS or (news and k - first >= _WINDOWS[0])
    # A step that was found begins no baseline.
    is_first = first in space.history.baselines
    if not is_first or not due or k - first > _WINDOWS[-1] or stepped:
        return state
    at = first - state.checkpoints[0].index
    left_out = state.checkpoints[at].epoch.outlying
    drift, std = _drift(_row(state, state.published))
    if not left_out.any() and not (np.abs(drift) > constants.OUTLIER_GATE * std).any():
        return state  # the others agree with it
    outlying, standardised = _judged_backwards(space.backwards(first, k))
    if (outlying == left_out).all():
        return state
    bank = restart(space, state.checkpoints[at - 1].bank, anew=True) if first else initial(space)
    again = replace(
        state,
        space=space.without(first, outlying),
        bank=bank,
        published=state.checkpoints[at].before,
        checkpoints=state.checkpoints[:at],
        widening=widening(state)[:k],  # of earlier logs, as published
        weighed=(-1, -1),
        open=None,
    )
    again = _filter(again, first)
    last = again.checkpoints[-1]
    weight = np.where(outlying, LEAST_WEIGHT, last.epoch.nuisances.weight)
    epoch = replace(
        last.epoch,
        nuisances=replace(last.epoch.nuisances, weight=weight),
        standardised=np.where(outlying, standardised, last.epoch.standardised),
        outlying=outlying,
    )
    again = replace(again, checkpoints=(*again.checkpoints[:-1], replace(last, epoch=epoch)))
    again = reduce(_filter, range(first + 1, k + 1), again)
    return replace(again, off=_half_deviations(again, first, outlying) if outlying.any() else None)


def _half_deviations(state: TrackState, first: int, outlying: BoolArray) -> FloatArray:
    """Return half of what ln f of a log that was left out is off from ℓ₀, ``(m,)``."""
    space, history = state.space, state.space.history
    x = state.published.padded(space.size).mean.copy()
    x[space.level] = x[space.base]
    n_series = len(history.series)
    off = history.ln_frequency[first] - (space.matrix(first) @ x)[:n_series]
    off = np.where(outlying[:n_series], off, 0.0) / 2
    return np.array([off[list(history.columns(mode))].mean() for mode in history.modes])


def _judged_backwards(space: StateSpace) -> tuple[BoolArray, FloatArray]:
    """Return which estimates of the last log are outliers, and their standardised innovations.

    Those of a mode that deviated in its log before as well are not, ``(2 n_series,)`` each.
    """
    bank, size = initial(space), space.mode_of.size
    outlying, before, standardised = np.zeros(size, bool), np.zeros(size, bool), np.zeros(size)
    for k in range(len(space.observations)):
        bank, found = update(space, predict(space, bank, k), k)
        bank, before = bank.pruned(), outlying.copy()
        outlying[found.rows], standardised[found.rows] = found.is_outlier, found.standardised
    last = np.isin(np.arange(size), found.rows)
    return outlying & ~before & last, standardised


def _with_nuisances(
    state: TrackState, nuisances: Nuisances, k: int
) -> tuple[TrackState, Nuisances, int]:
    """Filter the regime before log k again if the machine's nuisances have changed.

    They are unknown at first: early logs are filtered again once it is known how much they
    scatter and wander. Checkpoints and a credit bound how far back that reaches. Wear that
    begins later does not revise whether the machine has run in. Returned are the nuisances that
    log k has, and the credit that is left.
    """
    since = max(state.start, state.checkpoints[0].index if state.checkpoints else 0)
    if since == k:
        return state, nuisances, state.credit
    last, has_run_in = state.checkpoints[-1].epoch.nuisances, k - state.start >= _RUN_IN
    credit = min(state.credit + _REPEATS, N_CHECKPOINTS)
    if k > since + credit or not nuisances.differ(last, has_run_in=has_run_in):
        return state, last.at(nuisances), credit
    if has_run_in:
        nuisances = replace(nuisances, settling=last.settling, running_in=last.running_in)
    state = _filtered_again(state, since, lambda _, own: nuisances.at(own))
    return state, nuisances, credit - (k - since)


def _filtered_again(
    state: TrackState, first: int, change: Callable[[int, Nuisances], Nuisances]
) -> TrackState:
    """Filter the logs from one on again by the published filter, with other nuisances."""
    at = first - state.checkpoints[0].index
    checkpoints, published = [*state.checkpoints[:at]], state.checkpoints[at].before
    for one in state.checkpoints[at:]:
        own = change(one.index, one.epoch.nuisances)
        epoch = replace(one.epoch, nuisances=own)
        checkpoints.append(replace(one, epoch=epoch, before=published))
        published = filter_log(state.space, published, own, one.index)
    return replace(state, checkpoints=tuple(checkpoints), published=published)


def _reopened(state: TrackState, window: int) -> TrackState:
    """Give the rates their prior again before a log, unless they have had it since then."""
    since = [one.epoch for one in state.checkpoints if one.index >= window]
    if any(epoch.outlying.any() or epoch.nuisances.reopened for epoch in since):
        return state
    return _filtered_again(
        state, window, lambda k, own: replace(own, reopened=np.array(k == window))
    )


def _worst_window(state: TrackState) -> tuple[int, float]:
    """Return the first log of the window with the largest mean innovation, and its size."""
    offset = state.checkpoints[0].index + 1
    window, size = worst_window([one.sums for one in state.checkpoints], state.first - offset)
    return window + offset, size


def _detect(state: TrackState, k: int) -> TrackState:
    """Weigh a suspected change and adopt it, and raise the alarm of a drift."""
    window, size = _worst_window(state)
    suspected = recent_loop_change(state.loop_changes, state.first, k)
    if suspected is None and size > constants.SUSPICION_GATE:
        suspected = window
    if state.open is not None and suspected is not None:
        # A significant change keeps its place until it is settled.
        suspected = state.open.first
    before, when = state.weighed
    # What was weighed with nearly as many logs is not weighed again.
    if suspected is not None and (abs(before - suspected) > 2 or k - when >= (k - suspected) / 4):
        banks = {one.index: one.bank for one in state.checkpoints if one.index >= state.start}
        state = replace(state, weighed=(suspected, k), open=None)
        change = weigh_changes(state.space, banks, k, suspected, _lone(state, suspected))
        if change is not None and change.significant:
            if not change.settled(k):
                state = replace(state, open=change)
            # A drift that is no damage, or follows an alarm, is not adopted.
            elif change.kind != "drift" or (change.damage and not state.alarmed):
                return _adopted(state, change, k)
    # A single log that deviates may be an outlier or the first after a step, and an open change
    # need not be damage: later logs decide.
    waiting = state.open is not None and not state.open.settled(k)
    evidence = state.bank.log_bayes_factor()
    lone = suspected is not None and k - suspected <= 1
    if evidence >= threshold() and not waiting and not lone:
        return _alarmed(state, k, evidence)
    return state


def _lone(state: TrackState, first: int) -> str:
    """Return the mode whose ln f deviates most in the logs from one on."""
    history = state.space.history
    at = max(first - state.checkpoints[0].index, 1)
    total, number = state.checkpoints[-1].sums - state.checkpoints[at - 1].sums
    series = np.abs(total / np.sqrt(np.maximum(number, 1)))[: len(history.series)]
    return history.series[int(series.argmax())].mode


def _adopted(state: TrackState, change: ChangeHypothesis, k: int) -> TrackState:
    """Add a change to the model and filter again from the checkpoint before it."""
    j, space = change.first, state.space
    at = j - state.checkpoints[0].index
    bank = state.checkpoints[at - 1].bank
    # What is published of earlier logs does not change any more.
    state = replace(state, widening=widening(state)[:k])
    if change.kind != "drift":
        history = space.history
        found = Step.found(change.kind, j, len(history.logs), change.source, change.mode)
        space = space.with_step(found)
        bank = bank.padded(space.size)
        state = replace(
            state,
            space=space,
            changes=(*state.changes, (change, k)),
            loop_changes=unexplained_loop_changes(history.loop_error, space.steps),
        )
    state = replace(
        state,
        bank=restart(space, bank),
        published=state.checkpoints[at].before,
        checkpoints=state.checkpoints[:at],
        start=j,
        first=j + 1,
    )
    for again in range(j, k + 1):
        state = _filter(state, again)
    return _alarmed(state, k, change.log_bayes_factor) if change.damage else state


def _alarmed(state: TrackState, k: int, evidence: float) -> TrackState:
    """Raise an alarm, once since a baseline or reset, of a drift from a baseline."""
    if state.alarmed or k < state.space.history.baselines[0]:
        return state
    drift, std = _drift(_row(state, state.published))
    i = int(np.argmax(np.abs(drift) / np.maximum(std, 1e-12)))
    mode = state.space.history.modes[i]
    alarm = Event("alarm", k, mode, "", float(drift[i]), float(std[i]), evidence, False, k)
    return replace(state, alarms=(*state.alarms, alarm), alarmed=True)


def _row(state: TrackState, own: Gaussian) -> Published:
    """Return what is published of a state."""
    space, size = state.space, 4 * state.space.n_modes
    mean, cov = own.mean[:size].copy(), own.cov[:size, :size].copy()
    if state.off is not None:
        # Both explanations of a first log that was left out, an error and a change, are inside.
        mean[space.base] += state.off
        cov[space.base, space.base] += np.outer(state.off, state.off)
    return Published(
        mean,
        cov.diagonal().copy(),
        space.drift @ cov @ space.drift.T,
        state.bank.weight @ state.bank.hyperparameters.scales,
    )


def _drift(row: Published) -> tuple[FloatArray, FloatArray]:
    """Return the drift of each mode and its standard deviation, ``(m,)`` each."""
    m = row.drift_cov.shape[0]
    std = np.sqrt(np.maximum(row.drift_cov.diagonal(), 0.0))
    return row.mean[:m] - row.mean[3 * m :], std


def degrees_of_freedom(space: StateSpace, innovations: FloatArray) -> FloatArray:
    """Count the innovations of each log; the first estimate of a mode has none."""
    history = space.history
    there: BoolArray = np.isfinite(innovations)
    for mode in history.modes:
        own = np.array(history.columns(mode), dtype=int)
        found = there[:, own].any(axis=1)
        there[:, np.r_[own, own + len(history.series)]] &= (np.cumsum(found) > 1)[:, None]
    return np.asarray(there.sum(axis=1), dtype=float)


def running_sums(
    nis: FloatArray, dof: FloatArray, innovations: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return what tests of innovations need, up to each log, shape ``(n_logs,)`` each.

    They are the sums of NIS and of its degrees of freedom, the sum of products of innovations with
    those of the log before, its standard deviation if they are independent, and their
    autocorrelation. Series of one log may have common errors: sums over logs are independent.
    """
    products = np.full_like(innovations, np.nan)
    products[1:] = innovations[1:] * innovations[:-1]
    sums = np.nansum(products, axis=1)
    square = np.cumsum(np.nansum(innovations**2, axis=1))
    n, n_squares = (np.cumsum(np.isfinite(x).sum(axis=1)) for x in (products, innovations))
    size = np.maximum(square / np.maximum(n_squares, 1), 1e-12)
    total = np.cumsum(sums)
    correlation = total / np.maximum(n, 1) / size
    std = np.sqrt(np.cumsum(sums**2))
    return np.cumsum(np.where(dof > 0, nis, 0.0)), np.cumsum(dof), total, std, correlation


def widening(state: TrackState) -> FloatArray:
    """Return the factor on standard deviations up to each log, 1 while innovations are consistent.

    Innovations that are too large widen by the ratio to their expectation; positively
    autocorrelated ones by the reduction of the number of independent innovations. It is fixed up to
    the last change that was adopted, because the logs after it were filtered again.
    """
    epochs = state.epochs()
    innovations = np.array([one.innovations for one in epochs])
    dof = degrees_of_freedom(state.space, innovations)
    nis = np.array([one.nis for one in epochs])
    total, degrees, products, std, correlation = running_sums(nis, dof, innovations)
    bound = chdtri(np.maximum(degrees, 1.0), constants.WIDENING_P_VALUE)
    factor = np.where(total > bound, total / np.maximum(degrees, 1.0), 1.0)
    dependent = products > -ndtri(constants.WIDENING_P_VALUE) * std
    rho = np.clip(correlation, -0.9, 0.9)
    factor = np.sqrt(factor * np.where(dependent, dependence(rho), 1.0))
    known = np.empty(0) if state.widening is None else state.widening
    return np.append(known, factor[known.size :])


def add_to_sums(sums: FloatArray, rows: np.ndarray, innovation: FloatArray) -> FloatArray:
    """Add the standardised innovations of one log to running sums, and their numbers.

    The shape is ``(2, n_rows + 2)``: a column per row, one for all ln f, and one for all ln ζ,
    because grease changes all dampings.
    """
    total, n_series = sums.copy(), sums.shape[1] // 2 - 1
    for column in (rows, -2 + rows // n_series):
        np.add.at(total.T, column, np.column_stack([innovation, np.ones(rows.size)]))
    return total


def worst_window(sums: Sequence[FloatArray], first: int) -> tuple[int, float]:
    """Return the first log of the window with the largest mean innovation, and its size.

    `sums` are the running sums before the first log and after every log so far, `first` is the
    first log of the regime. The size is in standard deviations; 0 where there is no window.
    """
    now = len(sums) - 1
    starts = [now - length for length in _WINDOWS if now - length >= first]
    if not starts:
        return first, 0.0
    windows = sums[-1] - np.array([sums[start] for start in starts])
    mean = np.abs(windows[:, 0]) / np.sqrt(np.maximum(windows[:, 1], 1))
    at = int(mean.argmax())
    return starts[at // mean.shape[1]], float(mean.flat[at])


def recent_loop_change(loop_changes: Sequence[int], first: int, now: int) -> int | None:
    """Return the last log of the regime since which the following error differs, if it is recent.

    It locates a retuning better than innovations do; `first` is the first log of the regime.
    """
    since = max(first, now - constants.LOOP_LOGS)
    return max((j for j in loop_changes if since <= j < now), default=None)


def threshold(routes: int = constants.ALARM_ROUTES) -> float:
    """Return the log Bayes factor that raises an alarm that may come by so many routes."""
    return float(np.log(routes / constants.FALSE_ALARM_PROBABILITY))


def weigh_changes(
    space: StateSpace, checkpoints: Mapping[int, FilterBank], now: int, suspected: int, lone: str
) -> ChangeHypothesis | None:
    """Weigh all kinds of change about a suspected log by their evidence.

    `checkpoints` are the banks after each of the last logs, `now` is the present log; `lone` is the
    mode that deviates most, which may have jumped alone. Returned is the most likely change, or
    None where no checkpoint is before it.
    """
    # The suspected log is first: where it gains nothing, its neighbours gain nothing.
    about = sorted((suspected + _ABOUT).tolist(), key=lambda j: abs(j - suspected))
    gains: dict[_Change, float] = {}
    for j in about:
        if j - 1 not in checkpoints or not 0 < j < now:
            continue
        gains |= _gains(space, checkpoints, now, j, lone)
        if max(gains.values()) < 0:
            break
    if not gains:
        return None
    (best, source, mode, first), gain = max(gains.items(), key=lambda item: item[1])
    others = [0.0] + [g for key, g in gains.items() if key[:2] != (best, source)]
    # A step and a drift that begins there are both damage.
    if best in ("step", "drift"):
        others = [0.0] + [g for key, g in gains.items() if key[0] not in ("step", "drift")]
    odds = gain - float(np.logaddexp.reduce(others))
    return ChangeHypothesis(best, source, first, gain, odds, mode)


def _gains(
    space: StateSpace, checkpoints: Mapping[int, FilterBank], now: int, j: int, lone: str
) -> dict[_Change, float]:
    """Return the log Bayes factors of all kinds of change at log j."""
    kinds: list[tuple[StepKind, str]] = [("step", ""), ("regreasing", ""), ("servo", "")]
    if len(space.sources) > 1:
        kinds += [("sensor", source) for source in space.sources]
    chances = {(*kind, ""): 1 / len(kinds) for kind in kinds}
    if space.n_modes > 1:
        # Half of all steps are of one mode, each as probable as the others.
        chances["step", "", ""] /= 2
        chances["step", "", lone] = chances["step", "", ""] / space.n_modes
    history, before = space.history, checkpoints[j - 1]
    place = -float(np.log(j * (j + 1)))
    gains: dict[_Change, float] = {}
    # A step that is in the model already explains the following error there.
    known = _is_explained(space.steps, j)
    for (kind, source, mode), chance in chances.items():
        loop = None if known else loop_evidence(history.loop_error, j, now, kind)
        # Without a change of the following error, or without data of it, there is no retuning.
        if kind == "servo" and (loop is None or loop < 0):
            continue
        stepped = space.with_step(Step.found(kind, j, len(history.logs), source, mode))
        after = advance(stepped, before.padded(stepped.size), j, now)
        gain = after.log_evidence - checkpoints[now].log_evidence + (loop or 0.0)
        gains[kind, source, mode, j] = gain + place + float(np.log(chance))
    gains["drift", "", "", j] = -np.inf
    if before.hyperparameters.healthy.any():
        # A healthy machine begins to change.
        anew = restart(space, before[before.hyperparameters.healthy])
        anew = anew[~anew.hyperparameters.healthy]
        gain = advance(space, anew, j, now).log_evidence - anew.log_evidence
        unchanged = checkpoints[now].log_evidence - before.log_evidence
        gains["drift", "", "", j] = gain - unchanged + place
    return gains


def unexplained_loop_changes(loop_error: FloatArray, steps: tuple[Step, ...]) -> tuple[int, ...]:
    """List logs since which two following errors in a row differ from the dozen before.

    Logs about a step that is in the model are left out.
    """
    values = _logarithms(loop_error)
    if values.size < constants.LOOP_FEWEST + 2:
        return ()
    padded = np.concatenate([np.full(constants.LOOP_LOGS, np.nan), values])
    before = sliding_window_view(padded, constants.LOOP_LOGS)[: values.size - 1]
    there = np.isfinite(before)
    n = np.maximum(there.sum(axis=1), 2)
    mean = np.where(there, before, 0.0).sum(axis=1) / n
    square = np.where(there, before - mean[:, None], 0.0) ** 2
    std = np.sqrt(square.sum(axis=1) / (n - 1) * (1 + 1 / n))
    enough = (there.sum(axis=1) >= constants.LOOP_FEWEST) & (std > 0)
    reach = -std * stdtrit(n - 1, constants.LOOP_P_VALUE / 2)
    off = np.stack([values[:-1], values[1:]]) - mean
    loop_changes = (np.abs(off) > reach).all(axis=0) & (off[0] * off[1] > 0) & enough
    return tuple(j for j in np.flatnonzero(loop_changes).tolist() if not _is_explained(steps, j))


def _is_explained(steps: tuple[Step, ...], j: int) -> bool:
    """Return whether a step begins or ends about a log."""
    there = [step.there[max(j + _ABOUT[0] - 1, 0) : j + _ABOUT[-1] + 1] for step in steps]
    return any(part.any() and not part.all() for part in there)


def _logarithms(loop_error: FloatArray) -> FloatArray:
    with np.errstate(divide="ignore", invalid="ignore"):
        values = np.log(loop_error)
    return np.where(np.isfinite(values), values, np.nan)


def loop_evidence(loop_error: FloatArray, first: int, now: int, kind: str) -> float | None:
    """Return the log evidence of the following error for a kind of step, from log `first` to `now`.

    The logarithms before and after are two samples of unknown variance; the Bayes factor of a
    difference of their means has a closed form [Gonen2005]. None where too few values exist.
    """
    values = _logarithms(loop_error)
    before = values[max(first - constants.LOOP_LOGS, 0) : first]
    after = values[first : min(now, first + constants.LOOP_LOGS) + 1]
    before, after = before[np.isfinite(before)], after[np.isfinite(after)]
    if before.size < constants.LOOP_FEWEST or after.size < 1:
        return None
    dof = before.size + after.size - 2
    effective = before.size * after.size / (before.size + after.size)
    rest = before.size * before.var() + after.size * after.var()
    variance = max(float(rest) / dof, 1e-12)
    t2 = effective * float(before.mean() - after.mean()) ** 2 / variance
    reach = 1 + constants.LOOP_CHANGE_VARIANCE * effective
    changed = 0.5 * (dof + 1) * (np.log1p(t2 / dof) - np.log1p(t2 / (dof * reach)))
    changed -= 0.5 * np.log(reach)
    chance = constants.LOOP_CHANGE_PROBABILITY["servo" if kind == "servo" else "other"]
    return float(np.logaddexp(np.log(chance) + changed, np.log1p(-chance)))
