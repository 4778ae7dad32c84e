"""State of a track: what is known after each log, and the pure step from one log to the next.

A track is a fold: ``reduce(step, range(n_logs), initial_state(space))``. A state is never changed;
a detected step makes one whose last logs are filtered again from the checkpoint before the step.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri, ndtri

from lmshealth._private.arrays import BoolArray, FloatArray
from lmshealth.modal.credibility import dependence
from lmshealth.tracking import constants
from lmshealth.tracking.filters.change_detection import (
    N_CHECKPOINTS,
    ChangeHypothesis,
    Event,
    add_to_sums,
    recent_loop_change,
    threshold,
    unexplained_loop_changes,
    weigh_changes,
    worst_window,
)
from lmshealth.tracking.filters.filter_bank import FilterBank, initial, predict, restart, update
from lmshealth.tracking.filters.published_filter import (
    Gaussian,
    Nuisances,
    filter_log,
    prior,
    select_nuisances,
)
from lmshealth.tracking.filters.state_space import StateSpace
from lmshealth.tracking.history import Step

# Logs after which no running-in goes on: three times the slowest decay.
_RUN_IN = 3 * max(logs for logs, _ in constants.RUNNING_IN_LOGS)
# Logs that may be filtered again for every new one: bounds the run time.
_REPEATS = 4


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
        state = replace(state, bank=bank, start=k, first=k, alarmed=False)
    state = _filter(state, k)
    window, size = _worst_window(state)
    detected = _detect(state, k, window, size)
    if detected.checkpoints is not state.checkpoints:
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


def _detect(state: TrackState, k: int, window: int, size: float) -> TrackState:
    """Weigh a suspected change and adopt it, and raise the alarm of a drift.

    The mean innovation is largest since the log `window`.
    """
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
    row = _row(state, state.published)
    m = row.drift_cov.shape[0]
    drift = row.mean[:m] - row.mean[3 * m :]
    std = np.sqrt(np.maximum(row.drift_cov.diagonal(), 0.0))
    i = int(np.argmax(np.abs(drift) / np.maximum(std, 1e-12)))
    mode = state.space.history.modes[i]
    alarm = Event("alarm", k, mode, "", float(drift[i]), float(std[i]), evidence, False, k)
    return replace(state, alarms=(*state.alarms, alarm), alarmed=True)


def _row(state: TrackState, own: Gaussian) -> Published:
    """Return what is published of a state."""
    space, size = state.space, 4 * state.space.n_modes
    cov = own.cov[:size, :size]
    return Published(
        own.mean[:size],
        cov.diagonal().copy(),
        space.drift @ cov @ space.drift.T,
        state.bank.weight @ state.bank.hyperparameters.scales,
    )


def degrees_of_freedom(space: StateSpace, innovations: FloatArray) -> FloatArray:
    """Count the innovations of each log; the first estimate of a mode has none."""
    history = space.history
    there: BoolArray = np.isfinite(innovations)
    for mode in history.modes:
        own = np.array(history.columns(mode), dtype=int)
        found = np.isfinite(history.ln_frequency[: len(there), own]).any(axis=1)
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
