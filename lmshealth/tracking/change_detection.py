"""Events told from drift: what happened to a machine at once, found in the innovations.

Innovations that lean one way over the last logs raise a suspicion. Only then every explanation is
weighed: the bank is taken back to before the suspected log, the step is let happen, and the logs
are filtered again. The gain in evidence is an exact Bayes factor B_j of a step at log j.

A healthy machine is judged again and again, and at every log something might have happened. With
prior probabilities π_j of the place that sum to one, Σ_j π_j B_j is under the hypothesis that
nothing happened a martingale of mean one [Ville1939], so that the probability that it ever reaches
1/α is at most α, however many logs are looked at. What is not looked at only makes it smaller.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import stats

from lmshealth._arrays import BoolArray, FloatArray
from lmshealth.tracking import constants
from lmshealth.tracking.filter_bank import Bank, Filter, Settings, Surprise
from lmshealth.tracking.history import Step, StepKind

FindingKind = StepKind | Literal["drift"]

# An alarm may come from a drift since the baseline, from a drift that begins later, or from a step.
_ROUTES = 3
_WINDOWS = np.array([2, 4, 8, 16, 32, 64])
MEMORY = int(_WINDOWS.max()) + 4
# Innovations of a window that lean less, in standard deviations, are no suspicion. An event needs
# more than five to be believed.
_SUSPICIOUS = 4.0
# Of which kind an event is often shows a few logs later only. Until one is so much likelier than
# all others, or so many logs have passed, nothing is settled.
_CLEAR, _PATIENCE = float(np.log(10.0)), 8
# Logs about the suspected one that are tried as the first that sees it.
_ABOUT = np.array([-2, -1, 0, 1, 2])
# How likely a retuning, and anything else, changes the following error below 40 Hz; and how far
# such a change is expected to reach, in standard deviations between logs, squared.
_LOOP_CHANGES = (0.99, 0.02)
_LOOP_REACH = 100.0
_LOOP_BEFORE, _LOOP_LEAST = 12, 3
# Two following errors in a row that both differ from those before with this p-value are a leap.
_LOOP_LEAP = 0.01


class Watch:
    """Sums of standardised innovations over windows that end at the last log; leaps of the loop.

    Beside every row all frequencies are summed, and all dampings, as grease moves all of them.

    Parameters
    ----------
    n_rows : int
        Rows of estimates that a log has at most.
    loop_error : ndarray
        RMS in m, shape ``(n_logs,)``, NaN where unknown.

    Attributes
    ----------
    innovations : ndarray
        Standardised, NaN where there is none or an outlier, shape ``(n_logs, n_rows)``.
    first : int
        First log of a window.
    leaps : ndarray of int
        Logs since which the following error differs, and nothing known explains it.
    """

    def __init__(self, n_rows: int, loop_error: FloatArray) -> None:
        n_logs = loop_error.size
        self.leaps = np.flatnonzero(_leaps(loop_error))
        self.innovations = np.full((n_logs, n_rows), np.nan)
        self._rows = np.hstack([np.eye(n_rows), np.repeat(np.eye(2), n_rows // 2, axis=0)])
        self._sum = np.zeros((n_logs + 1, n_rows + 2))
        self._count = np.zeros((n_logs + 1, n_rows + 2))
        self.first = 1

    def add(self, k: int, surprise: Surprise, kept: Surprise) -> None:
        """Take note of log k, with and without outliers.

        A log that is filtered again replaces what was noted.
        """
        self.innovations[k] = np.nan
        self.innovations[k, kept.rows] = kept.innovation
        own = self._rows[surprise.rows]
        self._sum[k + 1] = self._sum[k] + surprise.innovation @ own
        self._count[k + 1] = self._count[k] + own.sum(axis=0)

    def settle(self, steps: tuple[Step, ...]) -> None:
        """Suspect nothing where the following error leaps at a step that is known."""
        open_ones = [j for j in self.leaps.tolist() if not _known(steps, j)]
        self.leaps = np.array(open_ones, dtype=int)

    def suspect(self, k: int) -> int | None:
        """Give the log since which the loop, or else innovations, differ suspiciously.

        A leap of the following error tells its log better than innovations do, and a retuning that
        moves the modes little would pass for drift before they tell it at all.
        """
        leaps = self.leaps[(self.leaps >= self.first) & (self.leaps < k)]
        if leaps.size and k - leaps[-1] <= _LOOP_BEFORE:
            return int(leaps[-1])
        start = k + 1 - _WINDOWS
        start = start[start >= self.first]
        if start.size == 0:
            return None
        count = np.maximum(self._count[k + 1] - self._count[start], 1)
        lean = np.abs(self._sum[k + 1] - self._sum[start]) / np.sqrt(count)
        window, row = np.unravel_index(np.argmax(lean), lean.shape)
        return int(start[window]) if lean[window, row] > _SUSPICIOUS else None


@dataclass(frozen=True, slots=True, eq=False)
class Finding:
    """The best explanation of what the last logs show.

    Attributes
    ----------
    kind : str
        Of the step, or ``drift`` where a rate begins.
    source : str
        The sensor's source; else empty.
    first : int
        First log that sees it.
    log_bayes_factor : float
        Against nothing having happened, the unknown place counted in.
    log_odds : float
        Against all other explanations together.
    """

    kind: FindingKind
    source: str
    first: int
    log_bayes_factor: float
    log_odds: float

    @property
    def believed(self) -> bool:
        """Whether nothing having happened is ruled out at the declared rate."""
        return self.log_bayes_factor >= threshold(1)

    def settled(self, now: int) -> bool:
        """Whether its kind is clear, or no more logs are waited for."""
        return self.log_odds >= _CLEAR or now - self.first >= _PATIENCE

    @property
    def damage(self) -> bool:
        """Whether it is damage, and no other explanation is left at the declared rate."""
        least = threshold(_ROUTES)
        return self.kind in ("step", "drift") and min(self.log_bayes_factor, self.log_odds) >= least


def threshold(routes: int = _ROUTES) -> float:
    """Log Bayes factor from which an alarm is raised that may come by so many routes."""
    return float(np.log(routes / constants.FALSE_ALARM_PROBABILITY))


def explain(filters: Filter, memory: dict[int, Bank], now: int, suspect: int) -> Finding | None:
    """Weigh every explanation of what happened about a suspected log.

    Parameters
    ----------
    filters : Filter
        Of the history.
    memory : dict of int to Bank
        Banks after each of the last logs.
    now : int
        The last log.
    suspect : int
        First log that may see it.

    Returns
    -------
    Finding or None
        None where there is no place for it.
    """
    # The suspected log comes first: where nothing is to be gained there, nothing is close by.
    about = sorted((suspect + _ABOUT).tolist(), key=lambda j: abs(j - suspect))
    gains: dict[tuple[FindingKind, str, int], float] = {}
    for j in about:
        if j - 1 not in memory or not 0 < j < now:
            continue
        gains |= _weigh(filters, memory, now, j)
        if max(gains.values()) < 0:
            break
    if not gains:
        return None
    (best, source, first), gain = max(gains.items(), key=lambda item: item[1])
    others = [0.0] + [g for key, g in gains.items() if key[:2] != (best, source)]
    # A step and a drift that begins there are both damage.
    if best in ("step", "drift"):
        others = [0.0] + [g for key, g in gains.items() if key[0] not in ("step", "drift")]
    return Finding(best, source, first, gain, gain - float(np.logaddexp.reduce(others)))


def _weigh(
    filters: Filter, memory: dict[int, Bank], now: int, j: int
) -> dict[tuple[FindingKind, str, int], float]:
    """Log Bayes factors of everything that may have happened at log j."""
    kinds: list[tuple[StepKind, str]] = [("step", ""), ("regreasing", ""), ("servo", "")]
    if len(filters.sources) > 1:
        kinds += [("sensor", source) for source in filters.sources]
    history, before = filters.space.history, memory[j - 1]
    place = -float(np.log(j * (j + 1)))
    gains: dict[tuple[FindingKind, str, int], float] = {}
    # What is known to have happened explains what the following error does there.
    known = _known(filters.space.steps, j)
    for kind, source in kinds:
        loop = None if known else loop_evidence(history.loop_error, j, now, kind)
        # Where the loop has not changed, or nothing is known of it, it was not tuned.
        if kind == "servo" and (loop is None or loop < 0):
            continue
        changed = filters.with_step(Step.found(kind, j, len(history.logs), source))
        after = changed.advance(before.padded(changed.space.size), j, now)
        gain = after.log_evidence - memory[now].log_evidence + (loop or 0.0)
        gains[kind, source, j] = gain + place - float(np.log(len(kinds)))
    nothing = memory[now].log_evidence - before.log_evidence
    gains["drift", "", j] = _drift(filters, before, now, j) - nothing + place
    return gains


def _drift(filters: Filter, before: Bank, now: int, j: int) -> float:
    """Log evidence of the logs from j on if a healthy machine begins to change there."""
    if not before.settings.healthy.any():
        return -np.inf
    begun = reborn(before.only(before.settings.healthy), filters)
    begun = begun.only(~begun.settings.healthy)
    begun.log_weight -= begun.log_evidence
    return filters.advance(begun, j, now).log_evidence


def reborn(bank: Bank, filters: Filter) -> Bank:
    """Begin a new chapter: the state and what is known of the noise stay, settings start anew."""
    grid, own = filters.grid, bank.settings
    scales, place = np.unique(own.scales, axis=0, return_inverse=True)
    weight = np.bincount(place.ravel(), weights=bank.weight)
    match = (grid.scales[:, None, :] == scales[None]).all(axis=2)
    grid, match = grid.only(match.any(axis=1)), match[match.any(axis=1)]
    share = np.log(np.maximum(match @ weight, 1e-12))
    dynamics = grid.log_prior - _per_scale(grid)
    n = grid.rate_std.size
    mean, cov = np.empty((n, bank.mean.shape[1])), np.empty((n, *bank.cov.shape[1:]))
    for group in (True, False):
        members = bank.settings.healthy == group
        state = (bank.only(members) if members.any() else bank).collapse()
        mean[grid.healthy == group], cov[grid.healthy == group] = state
    # A healthy machine has no rate, whatever it had before.
    rates = np.arange(filters.space.rate.start, filters.space.rate.stop)
    still = np.ix_(np.flatnonzero(grid.healthy), rates)
    mean[still] = 0.0
    cov[still] = 0.0
    cov[np.flatnonzero(grid.healthy)[:, None], :, rates] = 0.0
    new = Bank(grid, dynamics + share, mean, cov)
    filters.open_rates(new)
    return new


def _per_scale(grid: Settings) -> FloatArray:
    """Log prior of the scales of each setting, shape ``(n,)``."""
    _, place = np.unique(grid.scales, axis=0, return_inverse=True)
    place = place.ravel()
    total = np.bincount(place, weights=np.exp(grid.log_prior))
    return np.asarray(np.log(total[place]))


def _known(steps: tuple[Step, ...], j: int) -> bool:
    """Tell whether a step that is known begins or ends about a log."""
    there = [step.there[max(j + _ABOUT[0] - 1, 0) : j + _ABOUT[-1] + 1] for step in steps]
    return any(part.any() and not part.all() for part in there)


def _leaps(loop_error: FloatArray) -> BoolArray:
    """Tell the logs since which two following errors in a row differ from the dozen before."""
    values = _logarithms(loop_error)
    leaps = np.zeros(values.size, dtype=bool)
    if values.size < _LOOP_LEAST + 2:
        return leaps
    padded = np.concatenate([np.full(_LOOP_BEFORE, np.nan), values])
    before = sliding_window_view(padded, _LOOP_BEFORE)[: values.size]
    there = np.isfinite(before)
    n = np.maximum(there.sum(axis=1), 2)
    mean = np.where(there, before, 0.0).sum(axis=1) / n
    square = np.where(there, before - mean[:, None], 0.0) ** 2
    std = np.sqrt(square.sum(axis=1) / (n - 1) * (1 + 1 / n))
    enough = (there.sum(axis=1) >= _LOOP_LEAST) & (std > 0)
    reach = std * stats.t.isf(_LOOP_LEAP / 2, n - 1)
    off = np.stack([values[:-1], values[1:]]) - mean[:-1]
    same = (np.abs(off) > reach[:-1]).all(axis=0) & (off[0] * off[1] > 0)
    leaps[:-1] = same & enough[:-1]
    return leaps


def _logarithms(loop_error: FloatArray) -> FloatArray:
    with np.errstate(divide="ignore", invalid="ignore"):
        values = np.log(loop_error)
    return np.where(np.isfinite(values), values, np.nan)


def loop_evidence(loop_error: FloatArray, first: int, now: int, kind: str) -> float | None:
    """Log evidence that the following error below 40 Hz brings for a kind of step.

    The logarithms before and after are two samples of unknown variance; the Bayes factor of a
    difference of their means is closed [Gonen2005]. A retuning nearly always makes one, other
    events seldom.

    Parameters
    ----------
    loop_error : ndarray
        RMS in m, shape ``(n_logs,)``, NaN where unknown.
    first, now : int
        First log after the step, and the last log.
    kind : str
        Of the step.

    Returns
    -------
    float or None
        None where too few are known.
    """
    values = _logarithms(loop_error)
    before = values[max(first - _LOOP_BEFORE, 0) : first]
    after = values[first : min(now, first + _LOOP_BEFORE) + 1]
    before, after = before[np.isfinite(before)], after[np.isfinite(after)]
    if before.size < _LOOP_LEAST or after.size < 1:
        return None
    dof = before.size + after.size - 2
    effective = before.size * after.size / (before.size + after.size)
    rest = before.size * before.var() + after.size * after.var()
    variance = max(float(rest) / dof, 1e-12)
    t2 = effective * float(before.mean() - after.mean()) ** 2 / variance
    reach = 1 + _LOOP_REACH * effective
    changed = 0.5 * (dof + 1) * (np.log1p(t2 / dof) - np.log1p(t2 / (dof * reach)))
    changed -= 0.5 * np.log(reach)
    chance = _LOOP_CHANGES[0 if kind == "servo" else 1]
    return float(np.logaddexp(np.log(chance) + changed, np.log1p(-chance)))
