"""Ranks of truths among posterior draws, and coverage of intervals.

If parameters are drawn from a prior, and data from the model with these parameters, then the truth
is one more draw of the posterior: its rank among independent draws is uniform. Ties are broken at
random, and the rank is spread evenly over its cell, so that it is uniform from 0 to 1 (probability
integral transform).

References
----------
Talts2018 for the ranks, Sailynoja2022 for the test of their distribution, Czado2009 for censored
truths, Clopper1934 for intervals of shares, Holm1979 for several checks.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from lmshealth._private.arrays import BoolArray, FloatArray

Row = dict[str, Any]

NOMINAL, LEVEL = 0.95, 0.999
"""Coverage that intervals state, and level of the interval by which a coverage is judged."""
N_DRAWS = 127
"""So few of the draws of a posterior that they are as good as independent."""
N_BINS = 20
_POINTS = np.arange(1, 64) / 64


def place(
    draws: FloatArray, truth: ArrayLike, rng: np.random.Generator, *, horizon: ArrayLike = np.inf
) -> FloatArray:
    """Return the place of truths ``(n,)`` among draws ``(n_draws, n)``, from 0 to 1.

    A truth that is known only to lie beyond a horizon is censored there, as its draws are. Among
    draws equal to the truth the place is drawn at random, so that places of truths that are one
    more draw are uniform.
    """
    x, y = np.minimum(draws, horizon), np.minimum(truth, horizon)
    below, tied = np.sum(x < y, axis=0), np.sum(x == y, axis=0)
    return np.asarray((below + rng.uniform(size=y.shape) * (tied + 1)) / (x.shape[0] + 1))


def clopper_pearson(hits: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Return the exact interval of a proportion."""
    tail = (1 - level) / 2
    low = float(stats.beta.ppf(tail, hits, trials - hits + 1)) if hits else 0.0
    high = float(stats.beta.ppf(1 - tail, hits + 1, trials - hits)) if hits < trials else 1.0
    return low, high


def share_row(hits: int, n: int, level: float = LEVEL) -> Row:
    """Return a share with its Clopper-Pearson interval."""
    low, high = clopper_pearson(hits, n, level)
    return {"hits": hits, "n": n, "share": hits / n, "low": low, "high": high}


def judge_coverage(hits: int, n: int, nominal: float = NOMINAL) -> Row:
    """Return the coverage of n intervals of which ``hits`` contain the truth, and whether it holds.

    It holds if the Clopper-Pearson interval of the share at level `LEVEL` contains the nominal;
    ``p_value`` is the exact one of that interval, two-sided.
    """
    row = share_row(hits, n)
    tail = min(stats.binom.cdf(hits, n, nominal), stats.binom.sf(hits - 1, n, nominal))
    return row | {
        "holds": row["low"] <= nominal <= row["high"],
        "p_value": float(min(1.0, 2 * tail)),
    }


def judge_places(places: FloatArray, nominal: float) -> Row:
    """Return the coverage of central intervals from places of truths among draws, of any shape."""
    hits = int(np.sum(np.abs(places - 0.5) < nominal / 2))
    return {"nominal": nominal} | judge_coverage(hits, places.size, nominal)


def rank_p_value(ranks: FloatArray) -> float:
    """Return the exact p value of ranks ``(n,)`` if they are uniform, against any deviation.

    The statistic is the least binomial tail of the numbers of ranks below 63 points. Given their
    total, the numbers between the points are those of a Poisson process: the probability that all
    tails are larger follows from point to point [Sailynoja2022].
    """
    n = ranks.size
    below, numbers = np.searchsorted(np.sort(ranks), _POINTS, side="right"), np.arange(n + 1)
    column = numbers[:, None]
    tail = np.minimum(stats.binom.cdf(column, n, _POINTS), stats.binom.sf(column - 1, n, _POINTS))
    least = tail[below, np.arange(_POINTS.size)].min()
    between = stats.poisson.pmf(numbers, n * _POINTS[0])
    chance = np.eye(1, n + 1)[0]
    for larger in (tail > least * (1 + 1e-9)).T:
        chance = np.convolve(chance, between)[: n + 1] * larger
    inside = np.convolve(chance, between)[n] / stats.poisson.pmf(n, n)
    return float(np.clip(1 - inside, np.finfo(float).eps, 1.0))


def holm(p: Sequence[float], level: float, of: int) -> tuple[FloatArray, BoolArray]:
    """Hold p values together to one level by Holm's rule, whatever their dependence [Holm1979].

    Returns the level that each is held to, and whether it is rejected. Those of ``of`` checks that
    are missing reject nothing.
    """
    order = np.argsort(p, kind="stable")
    asked, rejected = np.empty(len(p)), np.empty(len(p), dtype=bool)
    asked[order] = level / (of - np.arange(len(p)))
    rejected[order] = np.logical_and.accumulate(np.asarray(p)[order] <= asked[order])
    return asked, rejected


def judge(ranks: FloatArray) -> Row:
    """Return whether ranks may be uniform: their test, coverages and histogram."""
    p = rank_p_value(ranks)
    return {
        "n": ranks.size,
        "inside_band": p > 1 - LEVEL,
        "p_value": p,
        "coverage": [judge_places(ranks, level) for level in (0.5, 0.9)],
        "histogram": np.histogram(ranks, bins=N_BINS, range=(0, 1))[0].tolist(),
    }


def uniform(rows: Mapping[str, Row]) -> bool:
    """Return whether all of several judgements are those of uniform ranks."""
    return all(
        row["inside_band"] and all(level["holds"] for level in row["coverage"])
        for row in rows.values()
    )
