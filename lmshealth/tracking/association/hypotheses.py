"""Association hypotheses of one scan: likelihoods, enumeration, merging, pruning, track initiation.

Every hypothesis has its own mode filters and two weights: names follow the mode, or names follow
the order of frequencies. A peak finder that numbers its peaks names them wrongly after a crossing,
all of them and permanently, so that the naming rule is one unknown of a life and not one of every
estimate.

Estimates of no mode become modes, or new levels of modes, or are deleted. Such a candidate has a
filter of its own, and odds of being a mode that grow with every log that detects it where the
filter predicts it, and shrink with every log that does not.
"""

import heapq
from collections.abc import Collection
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Self

import numpy as np
from scipy.special import hyp1f1, ndtr

from lmshealth._private.arrays import FloatArray
from lmshealth.tracking import constants
from lmshealth.tracking.association.mode_filters import IntArray, Measurements, ModeFilters, update

# Added to variances of correlations before they are inverted.
_RIDGE = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """The n estimates of one source in one log."""

    epoch: int  # index of the log
    rows: IntArray  # indices of the estimates in their log, ``(n,)``
    # Index of the mode that each name means, ``(n,)``; -1 without a name, the number of modes for a
    # name that no mode has.
    names: IntArray
    measurements: Measurements
    row: FloatArray  # observation row ``[1, 0, covariates]``, ``(d,)``

    def pick(self, chosen: IntArray) -> Self:
        """Return some of the estimates."""
        rows, names = self.rows[chosen], self.names[chosen]
        return replace(self, rows=rows, names=names, measurements=self.measurements[chosen])


@dataclass(frozen=True, slots=True, eq=False)
class Hypotheses:
    """Weighted association hypotheses."""

    filters: ModeFilters  # of m modes under h hypotheses
    log_weights: FloatArray  # of names by mode and by order, ``(h, 2)``; the weights sum to 1
    labels: IntArray  # mode of each estimate of the present scan, ``(h, n)``; -1 for none

    @classmethod
    def empty(cls, n_covariates: int, n_channels: int) -> Self:
        """Return one hypothesis without modes."""
        filters = ModeFilters.empty(n_covariates, n_channels)
        return cls(filters, normalised(np.zeros((1, 2))), np.empty((1, 0), dtype=int))

    def probabilities(self, n_modes: int) -> FloatArray:
        """Return the probability of each mode, last of none, per estimate: ``(n, m + 1)``."""
        weights = np.exp(np.logaddexp.reduce(self.log_weights, axis=1))
        hits = self.labels[:, :, None] == np.append(np.arange(n_modes), -1)
        return np.asarray(np.einsum("h,hnm->nm", weights, hits))


def clutter_gains(filters: ModeFilters, scan: Scan) -> FloatArray:
    """Return log odds of a detection of each mode against clutter and a miss, ``(h, n, m)``."""
    both = np.isfinite(scan.measurements.var_zeta[:, None] + filters.var_zeta[:, None])
    clutter = np.log(constants.CLUTTER_DENSITY)
    clutter = clutter + np.where(both, np.log(constants.CLUTTER_LN_ZETA_DENSITY), 0.0)
    detected = np.log(constants.DETECTION_PROBABILITY / (1 - constants.DETECTION_PROBABILITY))
    density = filters.log_density(scan.measurements, scan.row)
    return np.asarray(density + detected - clutter)


def best_assignments(
    score: FloatArray, least: float, most: int
) -> list[tuple[float, tuple[int, ...]]]:
    """Return the best one-to-one assignments of rows to columns or to nothing [Murty1968]_.

    `score` is the gain of each pair over leaving its row unassigned, ``(n, m)``, -inf where not
    allowed. Returned are gain and the column of each row, -1 for nothing, the best first; at most
    `most`, none below the best by more than `least` (negative).
    """
    from scipy.optimize import linear_sum_assignment  # late: reading a result needs none of it

    n, m = score.shape
    cost = np.full((n, m + n), np.inf)
    cost[:, :m] = -score
    cost[range(n), range(m, m + n)] = 0.0
    rows = np.arange(n)

    def solve(own: FloatArray) -> tuple[float, IntArray] | None:
        try:
            columns = linear_sum_assignment(own)[1]
        except ValueError:  # no assignment is left
            return None
        return float(own[rows, columns].sum()), columns

    first = solve(cost)
    assert first is not None, "every row may be left unassigned"
    heap = [(first[0], 0, first[1], cost, 0)]
    count = 0
    found: list[tuple[float, tuple[int, ...]]] = []
    while heap and len(found) < most:
        total, _, columns, own, fixed = heapq.heappop(heap)
        found.append((-total, tuple(c if c < m else -1 for c in columns.tolist())))
        own = own.copy()
        for row in range(fixed, n):
            column = columns[row]
            value = own[row, column]
            own[row, column] = np.inf
            other = solve(own)
            if other is not None and first[0] - other[0] >= least:
                count += 1
                heapq.heappush(heap, (other[0], count, other[1], own.copy(), row))
            own[row], own[:, column] = np.inf, np.inf
            own[row, column] = value
    return found


def shape_gains(shapes: FloatArray, of_modes: FloatArray) -> FloatArray:
    """Return log likelihood ratios of shapes against shapes of random direction, ``(h, n, m)``.

    Shapes of estimates are ``(n, n_channels)``, those of modes ``(h, m, n_channels)``; the ratios
    are 0 where fewer than two channels are common. A small share has random directions: sensors are
    moved.
    """
    both = np.isfinite(shapes)[:, None] & np.isfinite(of_modes)[:, None]
    a = np.where(both, shapes[:, None], 0.0)
    b = np.where(both, of_modes[:, None], 0.0)
    scale = np.sum(a * a, -1) * np.sum(b * b, -1)
    common = both.sum(-1)
    known = (common > 1) & (scale > 0)
    mac = np.sum(a * b, -1) ** 2 / np.where(known, scale, 1.0)
    kappa, stray = constants.SHAPE_CONCENTRATION, constants.STRAY_PROBABILITY
    norm = np.log(hyp1f1(0.5, np.arange(shapes.shape[1] + 1) / 2 + 1e-300, kappa))
    regular = np.log(1 - stray) + kappa * mac - norm[common]
    return np.where(known, np.logaddexp(regular, np.log(stray)), 0.0)


def name_gains(names: IntArray, labels: IntArray, order: IntArray) -> FloatArray:
    """Return log likelihood ratios of names that follow the mode, against clutter of any name.

    `names` is that of a `Scan`, ``(n,)``; `labels` the modes of the estimates, ``(..., n)``, -1 for
    none; `order` the modes that have names. The ratios have the shape of `labels`.
    """
    k = max(order.size, 1)
    wrong = (1 - constants.NAME_PROBABILITY) / max(k - 1, 1)
    gain = np.log(np.where(labels == names, constants.NAME_PROBABILITY, wrong) * k)
    return np.where((names >= 0) & (labels >= 0), gain, 0.0)


def order_gains(
    scan: Scan, labels: IntArray, order: IntArray, predicted: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """Return log likelihood ratios of names that follow the order of frequencies, ``(c, n)``.

    Detected modes have the order of their estimates; missed modes are below an estimate with the
    probability that their filters predict: ln f of each mode and its variance, each ``(c, m)``.
    `labels`, ``(c, n)``, and `order` are those of `name_gains`.
    """
    k, (c, n) = order.size, labels.shape
    if k == 0 or (scan.names < 0).all():
        return np.zeros((c, n))
    at, var = (side[:, order] for side in predicted)
    own = labels[:, :, None] == order
    ln_f = scan.measurements.ln_f
    std = np.sqrt(var[:, None] + scan.measurements.var_f[:, None])
    below = ndtr((ln_f[:, None] - at[:, None]) / std)
    shown = own.any(1)
    place = np.einsum("cnk,n->ck", own, ln_f)
    below = np.where(shown[:, None], place[:, None] < ln_f[:, None], below)
    below = np.where(own, 0.0, below)
    # Distribution of the number of modes below each estimate, one mode after the other.
    count = np.zeros((c, n, k + 1))
    count[..., 0] = 1.0
    for other in range(k):
        p = below[..., other, None]
        count[..., 1:] = (1 - p) * count[..., 1:] + p * count[..., :-1]
        count[..., :1] *= 1 - p
    rank = np.argmax(scan.names[:, None] == order, axis=1)
    known = np.isin(scan.names, order)
    right = np.where(known, count[:, np.arange(n), rank], 0.0)
    wrong = (1 - constants.NAME_PROBABILITY) / max(k - 1, 1)
    gain = np.log((wrong + (constants.NAME_PROBABILITY - wrong) * right) * k)
    return np.where((scan.names >= 0) & own.any(-1), gain, 0.0)


def extend(now: Hypotheses, scan: Scan, order: IntArray, *, opened: bool) -> Hypotheses:
    """Extend hypotheses by all assignments of a scan that are not pruned [Reid1979]_.

    The filters of `now` are predicted to the log; `order` are the modes that have names, in the
    order that names follow; `opened` is whether frequencies may step in this log. Each hypothesis
    returned has its filters updated and its labels of the scan's estimates.
    """
    if scan.measurements.shapes.shape[1] > 1:
        now = _with_veering(now, scan)
    gains = clutter_gains(now.filters, scan)
    gains += shape_gains(scan.measurements.shapes, now.filters.shapes)
    at, var = now.filters.predicted(scan.row)
    if not opened:
        off = scan.measurements.ln_f[:, None] - at[:, None]
        reach = constants.INNER_GATE * np.sqrt(scan.measurements.var_f[:, None] + var[:, None])
        near = np.abs(off) < reach
        gains[near.any(axis=2, keepdims=True) & ~near] += np.log(constants.TAKING_PROBABILITY)
    parents, labels = _assignments(now, gains, scan, order)
    predicted = (at[parents], var[parents])
    rows = np.arange(scan.rows.size)
    # One more column, for no mode.
    gains = np.concatenate([gains, np.zeros((*gains.shape[:2], 1))], axis=2)
    log_weights = now.log_weights[parents] + gains[parents[:, None], rows, labels].sum(1)[:, None]
    log_weights[:, 0] += name_gains(scan.names, labels, order).sum(1)
    log_weights[:, 1] += order_gains(scan, labels, order, predicted).sum(1)
    if opened:
        rising = np.argsort(scan.measurements.ln_f)
        for i, modes in enumerate(labels[:, rising]):
            if (np.diff(predicted[0][i, modes[modes >= 0]]) < 0).any():
                log_weights[i] += np.log(constants.REORDERING_PROBABILITY)
    total = np.logaddexp.reduce(log_weights, axis=1)
    kept = np.flatnonzero(total > total.max() + constants.PRUNING_LOG_ODDS)
    chosen, filters = labels[kept], now.filters[parents[kept]]
    each, detected = np.nonzero(chosen >= 0)
    at_modes = (each, chosen[each, detected])
    filters = update(filters, at_modes, scan.measurements[detected], scan.row)
    return Hypotheses(filters, normalised(log_weights[kept]), chosen)


def _assignments(
    now: Hypotheses, gains: FloatArray, scan: Scan, order: IntArray
) -> tuple[IntArray, IntArray]:
    """Enumerate assignments: index of the parent hypothesis, and modes of the estimates."""
    share = now.log_weights - np.logaddexp.reduce(now.log_weights, axis=1, keepdims=True)
    by_mode = name_gains(scan.names[:, None], np.arange(gains.shape[2]), order)
    # Names by order are as likely under all assignments, unless modes are missing.
    named = np.log(constants.NAME_PROBABILITY * max(order.size, 1))
    by_order = np.where(scan.names >= 0, named, 0.0)[:, None]
    score = gains + np.logaddexp(share[:, :1, None] + by_mode, share[:, 1:, None] + by_order)
    score[score < constants.PRUNING_LOG_ODDS] = -np.inf
    limits = (constants.PRUNING_LOG_ODDS, constants.MOST_ASSIGNMENTS)
    found = [(h, own[1]) for h, one in enumerate(score) for own in best_assignments(one, *limits)]
    labels = np.array([columns for _, columns in found], dtype=int)
    return np.array([h for h, _ in found]), labels.reshape(-1, scan.rows.size)


def _with_veering(now: Hypotheses, scan: Scan) -> Hypotheses:
    """Add hypotheses in which two near modes have exchanged levels.

    Modes that veer approach each other and turn away while their shapes are exchanged: the mode of
    one shape steps to the level of the other and keeps its own rate.
    """
    at = now.filters.predicted(scan.row)[0][0]
    chance = constants.VEERING_PROBABILITY
    for t, u in combinations(range(at.size), 2):
        near = abs(at[t] - at[u]) <= constants.VEERING_LN_F
        if not near or not (now.filters.n_shapes[:, [t, u]] > 0).all():
            continue
        other = now.filters[np.arange(len(now.filters.mean))]
        levels = other.mean[:, [t, u], 0]
        other.mean[:, [u, t], 0] = levels
        # The rates come from the approach to the other's level: an error of half the step.
        other.cov[:, [t, u], 0, 0] += 0.25 * np.diff(levels) ** 2
        weights = (now.log_weights + np.log(1 - chance), now.log_weights + np.log(chance))
        labels = np.concatenate([now.labels] * 2)
        now = Hypotheses(now.filters.append(other, axis=0), np.concatenate(weights), labels)
    return now


def normalised(log_weights: FloatArray) -> FloatArray:
    """Return log weights whose exponentials sum to 1."""
    return np.asarray(log_weights - np.logaddexp.reduce(log_weights, axis=None))


def reduce_hypotheses(extended: Hypotheses) -> Hypotheses:
    """Merge hypotheses that are nearly equal and prune those without weight.

    Merged hypotheses have the mean and covariance of their mixture [Salmond1990]_, and the labels
    of the heaviest: read the probabilities before.
    """
    total = np.logaddexp.reduce(extended.log_weights, axis=1)
    order = np.argsort(-total)
    order = order[total[order] > total[order[0]] + constants.PRUNING_LOG_ODDS]
    filters, weights = extended.filters[order], extended.log_weights[order]
    left = np.ones(order.size, dtype=bool)
    leaders: list[int] = []
    for i in range(order.size):
        if not left[i]:
            continue
        group = np.flatnonzero(left)
        near = _distance(filters, i, group) < constants.MERGING_DISTANCE
        group = group[(group == i) | near]
        left[group] = False
        _merge(
            filters, i, group, np.exp(np.logaddexp.reduce(weights[group], axis=1) - total[order[0]])
        )
        weights[i] = np.logaddexp.reduce(weights[group], axis=0)
        leaders.append(i)
    heaviest = sorted(leaders, key=lambda i: -float(np.logaddexp.reduce(weights[i])))
    rows = np.array(heaviest[: constants.MOST_HYPOTHESES])
    return Hypotheses(filters[rows], normalised(weights[rows]), extended.labels[order[rows]])


def _distance(filters: ModeFilters, i: int, group: IntArray) -> FloatArray:
    """Return squared distances of a group of hypotheses to one, in its standard deviations."""
    std = np.sqrt(np.einsum("mii->mi", filters.cov[i]))
    std = np.where(std > 0, std, 1.0)
    off = (filters.mean[group] - filters.mean[i]) / std
    # Correlations: states of different units would make the solution ill-conditioned.
    cov = filters.cov[i] / (std[:, :, None] * std[:, None, :]) + _RIDGE * np.eye(std.shape[-1])
    total = np.sum(off * np.linalg.solve(cov, off[..., None])[..., 0], axis=(1, 2))
    known = np.isfinite(filters.var_zeta[i])
    var = np.where(known, filters.var_zeta[i], 1.0)
    damping = np.where(known, (filters.ln_zeta[group] - filters.ln_zeta[i]) ** 2 / var, 0.0)
    total += damping.sum(-1)
    product = np.nansum(filters.shapes[group] * filters.shapes[i], axis=-1)
    apart = np.where((filters.n_shapes[i] > 0) & (filters.n_shapes[group] > 0), 1 - product**2, 0.0)
    return np.asarray(total + constants.SHAPE_CONCENTRATION * apart.sum(-1))


def _merge(filters: ModeFilters, i: int, group: IntArray, weights: FloatArray) -> None:
    """Replace hypothesis i, of filters that only the caller has, by the mixture of its group."""
    if group.size == 1:
        return
    share = weights / weights.sum()
    mean = np.einsum("g,gmd->md", share, filters.mean[group])
    off = filters.mean[group] - mean
    filters.cov[i] = np.einsum("g,gmde->mde", share, filters.cov[group]) + np.einsum(
        "g,gmd,gme->mde", share, off, off
    )
    filters.mean[i] = mean
    ln_zeta = share @ filters.ln_zeta[group]
    known = np.isfinite(filters.var_zeta[group]).all(0)
    square = np.where(known, filters.var_zeta[group], 0.0) + (filters.ln_zeta[group] - ln_zeta) ** 2
    filters.var_zeta[i] = np.where(known, share @ square, filters.var_zeta[i])
    filters.ln_zeta[i] = np.where(known, ln_zeta, filters.ln_zeta[i])


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Tentative tracks, all arrays of shape ``(n,)``."""

    filters: ModeFilters  # one hypothesis, a mode per candidate
    modes: IntArray  # mode of which this may be the new level; -1 for a new mode
    log_odds: FloatArray  # of being a mode
    n_logs: IntArray  # number of logs that detect it
    last: IntArray  # the last of them

    @classmethod
    def empty(cls, n_covariates: int, n_channels: int) -> Self:
        """Return no candidates."""
        none = np.empty(0, dtype=int)
        return cls(ModeFilters.empty(n_covariates, n_channels), none, np.empty(0), none, none)

    def __len__(self) -> int:
        return self.modes.size

    def confirmed(self, j: int) -> bool:
        """Return whether a candidate is a mode."""
        if self.modes[j] >= 0:
            return bool(self.n_logs[j] >= constants.LEAST_LOGS_NAMED)
        chance = constants.CONFIRMATION_PROBABILITY
        sure = self.log_odds[j] > np.log(chance / (1 - chance))
        return bool(sure and self.n_logs[j] >= constants.LEAST_LOGS_NEW)


def follow(
    candidates: Candidates, scan: Scan, prior_std: FloatArray, life: float
) -> tuple[Candidates, list[int | None]]:
    """Update candidates with a scan and start new ones.

    Their filters are predicted to the log. The scan has the estimates of no mode, with the mode of
    which each may be the new level as its name, else -1. Returned are the candidates, new ones at
    the end, and for each estimate the candidate that it confirms, or None.
    """
    from scipy.optimize import linear_sum_assignment  # late, as above

    mine: list[int | None] = [None] * scan.rows.size
    filters, log_odds = candidates.filters, candidates.log_odds.copy()
    # The alternative of a detection is clutter, not a missed detection.
    gains = clutter_gains(filters, scan)[0] + np.log(1 - constants.DETECTION_PROBABILITY)
    best = np.where(scan.names[:, None] == candidates.modes, np.maximum(gains, 0.0), 0.0)
    rows, known = linear_sum_assignment(-best)
    detected = best[rows, known] > 0
    rows, known = rows[detected], known[detected]
    for i, j in zip(rows.tolist(), known.tolist(), strict=True):
        mine[i] = j
    if known.size:
        log_odds[known] += best[rows, known]
        at = (np.zeros_like(known), known)
        filters = update(filters, at, scan.measurements[rows], scan.row)
    n_logs, last = candidates.n_logs.copy(), candidates.last.copy()
    n_logs[known] += last[known] != scan.epoch
    last[known] = scan.epoch
    lone = np.array([i for i, j in enumerate(mine) if j is None], dtype=int)
    if lone.size:
        filters = filters.start(scan.measurements[lone], scan.row, prior_std, life)
    grown = Candidates(
        filters,
        np.append(candidates.modes, scan.names[lone]),
        np.append(log_odds, np.full(lone.size, np.log(constants.INITIATION_ODDS))),
        np.append(n_logs, np.ones(lone.size, dtype=int)),
        np.append(last, np.full(lone.size, scan.epoch)),
    )
    return grown, [j if j is not None and grown.confirmed(j) else None for j in mine]


def prune(
    candidates: Candidates, epoch: int, confirmed: Collection[int], detected: Collection[int]
) -> Candidates:
    """Delete candidates that have become modes (`confirmed`), or whose odds are too low.

    Those for new levels of modes that were `detected` at their old level are deleted too.
    """
    if not len(candidates):
        return candidates
    missed = np.log(1 - constants.DETECTION_PROBABILITY)
    odds = candidates.log_odds + np.where(candidates.last != epoch, missed, 0.0)
    keep = odds > np.log(constants.DELETION_ODDS)
    keep[list(confirmed)] = False
    keep &= ~np.isin(candidates.modes, list(detected))
    kept = np.flatnonzero(keep)
    filters = candidates.filters
    if kept.size < len(candidates):
        filters = filters.keep(kept)
    return Candidates(
        filters, candidates.modes[kept], odds[kept], candidates.n_logs[kept], candidates.last[kept]
    )
