"""Change detection: steps that nobody declared, and drift that begins.

A mean innovation over the last logs raises a suspicion. Only then all kinds of change are weighed
by their log Bayes factors, as the README of this folder describes; changes that are not weighed
only reduce the probability of a false alarm.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import stdtrit

from lmshealth._private.arrays import FloatArray
from lmshealth.tracking import constants
from lmshealth.tracking.filters.filter_bank import FilterBank, advance, restart
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
