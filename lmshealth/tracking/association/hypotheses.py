"""Who is who, as several hypotheses at once: what speaks for each, which are kept.

Every hypothesis has its own filters and two weights: names follow the mode, or names follow the
order of frequencies. A peak finder that numbers its peaks gives wrong names after a crossing, all
of them and for good, so that how names are given must be asked once and not at every estimate.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.special import hyp1f1, logsumexp, ndtr

from lmshealth._arrays import BoolArray, FloatArray
from lmshealth.tracking.association.mode_filters import (
    STRAY,
    Bank,
    Innovations,
    IntArray,
    Readings,
)

# Probability that a source shows a mode in a log, and spurious estimates per log and unit of ln f.
SHOWN, _SPURIOUS = 0.8, 0.1
# Density of a stranger's ln ζ: anything within an order of magnitude.
_STRANGER_ZETA = 0.3
# Probability that a name is right, given how names are given.
_NAME_RIGHT = 0.98
# Concentration of a shape about its mode's: exp(κ MAC), a direction known to 0.13 rad.
_CONCENTRATION = 30.0
# Explanations of a log, and hypotheses, with less of the weight of the best are hopeless; so many
# explanations are tried under each hypothesis, and so many hypotheses kept.
_HOPELESS = float(np.log(1e-7))
_MOST_EACH, _MOST = 12, 24
# Probability that a declared intervention changes the order of frequencies, where the sizes of the
# steps alone would allow it: modes step together.
_REORDERED = 0.05
# Nearer than this in ln f modes may veer, in so many of all logs.
_VEERING, _EXCHANGE = 0.03, 0.02
# Hypotheses that differ by less than this, in squared standard deviations, become one.
_SAME = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """What one source shows in one log.

    Attributes
    ----------
    epoch : int
        The log.
    rows : ndarray
        Which of the log's estimates these are.
    names : ndarray
        Index of the mode that each name means; -1 without a name, the number of modes for a name
        that no mode has.
    readings : Readings
        The estimates.
    row : ndarray
        Observation row ``[1, 0, covariates]``.
    """

    epoch: int
    rows: IntArray
    names: IntArray
    readings: Readings
    row: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Hypotheses:
    """Hypotheses with their weights.

    Attributes
    ----------
    bank : Bank
        Filters of m modes under h hypotheses.
    log_weights : ndarray
        With names by mode and by order, shape ``(h, 2)``; their exponentials add up to 1.
    labels : ndarray
        Mode of each estimate of the present log, shape ``(h, n)``; -1 for none.
    """

    bank: Bank
    log_weights: FloatArray
    labels: IntArray

    def chances(self, n_modes: int) -> FloatArray:
        """Return the probability of each mode, last of none, for each estimate: ``(n, m + 1)``."""
        weights = np.exp(logsumexp(self.log_weights, axis=1))
        hits = self.labels[:, :, None] == np.append(np.arange(n_modes), -1)
        return np.asarray(np.einsum("h,hnm->nm", weights, hits))


def stranger_gains(innovations: Innovations) -> FloatArray:
    """Return log odds of being seen of a mode against being a stranger and the mode unseen."""
    known = np.isfinite(innovations.var_zeta)
    stranger = np.log(_SPURIOUS) + np.where(known, np.log(_STRANGER_ZETA), 0.0)
    seen = np.log(SHOWN / (1 - SHOWN))
    return np.asarray(innovations.log_density() + seen - stranger)


def best_assignments(
    score: FloatArray, least: float, most: int
) -> list[tuple[float, tuple[int, ...]]]:
    """Find the best one-to-one assignments of rows to columns or to nothing.

    The best is an optimal assignment; the others are the best of what remains when its pairs are
    forbidden one after the other [Murty1968]_.

    Parameters
    ----------
    score : ndarray
        Gain of each pair over leaving its row alone, ``(n, m)``; -inf where not allowed.
    least : float
        Assignments below the best by more than this (a negative number) are left out.
    most : int
        At most so many.

    Returns
    -------
    list of (float, tuple of int)
        Gain and the column of each row, -1 for nothing; the best first.
    """
    n, m = score.shape
    cost = np.full((n, m + n), np.inf)
    cost[:, :m] = -score
    cost[range(n), range(m, m + n)] = 0.0
    rows = np.arange(n)

    def solve(own: FloatArray) -> tuple[float, IntArray] | None:
        try:
            columns = linear_sum_assignment(own)[1]
        except ValueError:  # nothing is left
            return None
        return float(own[rows, columns].sum()), columns

    first = solve(cost)
    assert first is not None, "every row may be left alone"
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
    """Tell what shapes say, against shapes of any direction.

    A Watson distribution about the shape of the mode: density exp(κ MAC) / M(1/2, n/2, κ) over the
    channels that both have [Mardia2000]_, with the modal assurance criterion [Allemang2003]_. A
    small share is stray, of any direction: sensors are moved.

    Parameters
    ----------
    shapes : ndarray
        Of estimates, ``(n, n_channels)``.
    of_modes : ndarray
        Of modes, ``(h, m, n_channels)``.

    Returns
    -------
    ndarray
        Log likelihood ratio, ``(h, n, m)``; 0 where fewer than two channels are common.
    """
    both = np.isfinite(shapes)[:, None] & np.isfinite(of_modes)[:, None]
    a = np.where(both, shapes[:, None], 0.0)
    b = np.where(both, of_modes[:, None], 0.0)
    scale = np.sum(a * a, -1) * np.sum(b * b, -1)
    common = both.sum(-1)
    known = (common > 1) & (scale > 0)
    mac = np.sum(a * b, -1) ** 2 / np.where(known, scale, 1.0)
    norm = np.log(hyp1f1(0.5, np.arange(shapes.shape[1] + 1) / 2 + 1e-300, _CONCENTRATION))
    usual = np.log(1 - STRAY) + _CONCENTRATION * mac - norm[common]
    return np.where(known, np.logaddexp(usual, np.log(STRAY)), 0.0)


def name_gains(names: IntArray, labels: IntArray, order: IntArray) -> FloatArray:
    """Tell what names say if they follow the mode, against a stranger that bears any name.

    Parameters
    ----------
    names : ndarray
        Index of the mode that each estimate's name means, ``(n,)``: see `Scan`.
    labels : ndarray
        Modes that estimates are held to be of, ``(..., n)``; -1 for none.
    order : ndarray
        Modes that have names.

    Returns
    -------
    ndarray
        Log likelihood ratio of each, ``(..., n)``.
    """
    k = max(order.size, 1)
    wrong = (1 - _NAME_RIGHT) / max(k - 1, 1)
    gain = np.log(np.where(labels == names, _NAME_RIGHT, wrong) * k)
    return np.where((names >= 0) & (labels >= 0), gain, 0.0)


def order_gains(
    scan: Scan, labels: IntArray, order: IntArray, seen: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """Tell what names say if they follow the order of frequencies.

    Modes that the log shows have the order of their estimates, whichever mode is which; others are
    below an estimate with the probability that their filter gives.

    Parameters
    ----------
    scan : Scan
        The estimates.
    labels : ndarray
        Modes that they are held to be of, ``(c, n)``; -1 for none.
    order : ndarray
        Modes that have names, in the order that names follow.
    seen : (ndarray, ndarray)
        Where ln f of each mode is predicted, and its variance, each ``(c, m)``.

    Returns
    -------
    ndarray
        Log likelihood ratio against a stranger that bears any name, ``(c, n)``.
    """
    k, (c, n) = order.size, labels.shape
    if k == 0 or (scan.names < 0).all():
        return np.zeros((c, n))
    at, var = (side[:, order] for side in seen)
    own = labels[:, :, None] == order
    ln_f = scan.readings.ln_f
    spread = np.sqrt(var[:, None] + scan.readings.var_f[:, None])
    below = ndtr((ln_f[:, None] - at[:, None]) / spread)
    shown = own.any(1)
    place = np.einsum("cnk,n->ck", own, ln_f)
    below = np.where(shown[:, None], place[:, None] < ln_f[:, None], below)
    below = np.where(own, 0.0, below)
    # Distribution of how many modes lie below each estimate, one mode after the other.
    count = np.zeros((c, n, k + 1))
    count[..., 0] = 1.0
    for other in range(k):
        p = below[..., other, None]
        count[..., 1:] = (1 - p) * count[..., 1:] + p * count[..., :-1]
        count[..., :1] *= 1 - p
    rank = np.argmax(scan.names[:, None] == order, axis=1)
    known = np.isin(scan.names, order)
    right = np.where(known, count[:, np.arange(n), rank], 0.0)
    wrong = (1 - _NAME_RIGHT) / max(k - 1, 1)
    gain = np.log((wrong + (_NAME_RIGHT - wrong) * right) * k)
    return np.where((scan.names >= 0) & own.any(-1), gain, 0.0)


def explain(now: Hypotheses, scan: Scan, order: IntArray, *, opened: bool) -> Hypotheses:
    """Follow all explanations of a scan that are not hopeless.

    Parameters
    ----------
    now : Hypotheses
        With filters predicted to the log; their sum of weights is 1.
    scan : Scan
        What is to be explained.
    order : ndarray
        Modes that have names, in the order that names follow.
    opened : bool
        Whether frequencies may step in this log.

    Returns
    -------
    Hypotheses
        Each with its filters updated and its labels of the scan's estimates.
    """
    if scan.readings.shapes.shape[1] > 1:
        now = _exchanged(now, scan)
    gains = stranger_gains(now.bank.compare(scan.readings, scan.row))
    gains += shape_gains(scan.readings.shapes, now.bank.shapes)
    parents, labels = _assignments(now, gains, scan, order)
    at, var = now.bank.seen(scan.row)
    seen = (at[parents], var[parents])
    rows = np.arange(scan.rows.size)
    # One more column, for none.
    gains = np.concatenate([gains, np.zeros((*gains.shape[:2], 1))], axis=2)
    told = gains[parents[:, None], rows, labels].sum(1)
    log_weights = now.log_weights[parents] + told[:, None]
    log_weights[:, 0] += name_gains(scan.names, labels, order).sum(1)
    log_weights[:, 1] += order_gains(scan, labels, order, seen).sum(1)
    if opened:
        log_weights += np.log(_REORDERED) * _is_reordered(scan, labels, seen[0])[:, None]
    total = logsumexp(log_weights, axis=1)
    kept = np.flatnonzero(total > total.max() + _HOPELESS)
    chosen, bank = labels[kept], now.bank.take(parents[kept])
    each, shown = np.nonzero(chosen >= 0)
    bank.absorb((each, chosen[each, shown]), scan.readings.pick(shown), scan.row)
    return Hypotheses(bank, normalised(log_weights[kept]), chosen)


def _assignments(
    now: Hypotheses, gains: FloatArray, scan: Scan, order: IntArray
) -> tuple[IntArray, IntArray]:
    """Enumerate assignments under each hypothesis: its number, and modes of the estimates."""
    own = now.log_weights - logsumexp(now.log_weights, axis=1, keepdims=True)
    by_mode = name_gains(scan.names[:, None], np.arange(gains.shape[2]), order)
    # Names by order say the same of all assignments, unless modes are missing.
    by_order = np.where(scan.names >= 0, np.log(_NAME_RIGHT * max(order.size, 1)), 0.0)[:, None]
    score = gains + np.logaddexp(own[:, :1, None] + by_mode, own[:, 1:, None] + by_order)
    score[score < _HOPELESS] = -np.inf
    parents, labels = [], []
    for h, own_score in enumerate(score):
        for _, columns in best_assignments(own_score, _HOPELESS, _MOST_EACH):
            parents.append(h)
            labels.append(columns)
    return np.array(parents), np.array(labels, dtype=int).reshape(-1, scan.rows.size)


def _is_reordered(scan: Scan, labels: IntArray, at: FloatArray) -> BoolArray:
    """Tell whether modes stand in another order of frequency than before."""
    rising = np.argsort(scan.readings.ln_f)
    turned = []
    for modes, own in zip(labels[:, rising], at, strict=True):
        turned.append(bool((np.diff(own[modes[modes >= 0]]) < 0).any()))
    return np.array(turned)


def _exchanged(now: Hypotheses, scan: Scan) -> Hypotheses:
    """Add hypotheses in which two near modes have exchanged levels.

    Modes that veer come near and turn away, while their shapes go over: what keeps its shape has
    stepped to the other's level, and goes on at its own rate.
    """
    at = now.bank.seen(scan.row)[0][0]
    for t, u in combinations(range(at.size), 2):
        if abs(at[t] - at[u]) > _VEERING or not (now.bank.n_shapes[:, [t, u]] > 0).all():
            continue
        other = now.bank.take(np.arange(len(now.bank.mean)))
        levels = other.mean[:, [t, u], 0]
        other.mean[:, [u, t], 0] = levels
        # Rates were learned on the way to the other's level: the step is known to half its size.
        other.cov[:, [t, u], 0, 0] += 0.25 * np.diff(levels) ** 2
        weights = (now.log_weights + np.log(1 - _EXCHANGE), now.log_weights + np.log(_EXCHANGE))
        now = Hypotheses(
            now.bank.stack(other), np.concatenate(weights), np.concatenate([now.labels] * 2)
        )
    return now


def normalised(log_weights: FloatArray) -> FloatArray:
    """Return log weights whose exponentials add up to 1."""
    return np.asarray(log_weights - logsumexp(log_weights))


def reduce_hypotheses(kept: Hypotheses) -> Hypotheses:
    """Join hypotheses that are the same by now and drop those without weight.

    What is joined keeps mean and covariance of the mixture [Salmond1990]_. Labels of the present
    log are those of the heaviest: read the chances before.

    Parameters
    ----------
    kept : Hypotheses
        Of any weights.
    """
    total = logsumexp(kept.log_weights, axis=1)
    order = np.argsort(-total)
    order = order[total[order] > total[order[0]] + _HOPELESS]
    bank, weights = kept.bank.take(order), kept.log_weights[order]
    left = np.ones(order.size, dtype=bool)
    leaders: list[int] = []
    for i in range(order.size):
        if not left[i]:
            continue
        group = np.flatnonzero(left)
        group = group[(group == i) | (_distance(bank, i, group) < _SAME)]
        left[group] = False
        _merge(bank, i, group, np.exp(logsumexp(weights[group], axis=1) - total[order[0]]))
        weights[i] = logsumexp(weights[group], axis=0)
        leaders.append(i)
    heaviest = sorted(leaders, key=lambda i: -float(logsumexp(weights[i])))[:_MOST]
    rows = np.array(heaviest)
    return Hypotheses(bank.take(rows), normalised(weights[rows]), kept.labels[order[rows]])


def _distance(bank: Bank, i: int, group: IntArray) -> FloatArray:
    """Squared distance of hypotheses of a group to one, in its standard deviations."""
    std = np.sqrt(np.einsum("mii->mi", bank.cov[i]))
    std = np.where(std > 0, std, 1.0)
    off = (bank.mean[group] - bank.mean[i]) / std
    # Correlations: states of different units would make the solution ill-conditioned.
    cov = bank.cov[i] / (std[:, :, None] * std[:, None, :]) + 1e-9 * np.eye(std.shape[-1])
    total = np.sum(off * np.linalg.solve(cov, off[..., None])[..., 0], axis=(1, 2))
    known = np.isfinite(bank.var_zeta[i])
    var = np.where(known, bank.var_zeta[i], 1.0)
    damping = np.where(known, (bank.ln_zeta[group] - bank.ln_zeta[i]) ** 2 / var, 0.0)
    total += damping.sum(-1)
    product = np.nansum(bank.shapes[group] * bank.shapes[i], axis=-1)
    apart = np.where((bank.n_shapes[i] > 0) & (bank.n_shapes[group] > 0), 1 - product**2, 0.0)
    return np.asarray(total + _CONCENTRATION * apart.sum(-1))


def _merge(bank: Bank, i: int, group: IntArray, weights: FloatArray) -> None:
    if group.size == 1:
        return
    share = weights / weights.sum()
    mean = np.einsum("g,gmd->md", share, bank.mean[group])
    off = bank.mean[group] - mean
    bank.cov[i] = np.einsum("g,gmde->mde", share, bank.cov[group]) + np.einsum(
        "g,gmd,gme->mde", share, off, off
    )
    bank.mean[i] = mean
    ln_zeta = share @ bank.ln_zeta[group]
    known = np.isfinite(bank.var_zeta[group]).all(0)
    spread = np.where(known, bank.var_zeta[group], 0.0) + (bank.ln_zeta[group] - ln_zeta) ** 2
    bank.var_zeta[i] = np.where(known, share @ spread, bank.var_zeta[i])
    bank.ln_zeta[i] = np.where(known, ln_zeta, bank.ln_zeta[i])
