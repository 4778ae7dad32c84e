"""Ranks of truths among posterior draws, and coverage of intervals.

If parameters are drawn from a prior, and data from the model with these parameters, then the truth
is one more draw of the posterior: its rank among independent draws is uniform. Ties are broken at
random, and the rank is spread evenly over its cell, so that it is uniform from 0 to 1 (probability
integral transform).

References
----------
Talts2018 for the ranks, Sailynoja2022 for the bands of their distribution, Czado2009 for censored
truths, Clopper1934 for intervals of shares.
"""

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from lmshealth._private.arrays import FloatArray

Row = dict[str, Any]

NOMINAL, LEVEL = 0.95, 0.999
"""Coverage that intervals state, and level of the interval by which a coverage is judged."""
N_DRAWS = 127
"""So few of the draws of a posterior that they are as good as independent."""
N_BINS = 20
_POINTS = np.arange(1, 64) / 64
_SIMULATIONS = 20_000
# Of fewer ranks, as quick forms have them, hardly anything is outside.
_FEW, _FEW_SIMULATIONS = 20, 2_000


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

    It holds if the Clopper-Pearson interval of the share at level `LEVEL` contains the nominal.
    """
    row = share_row(hits, n)
    return row | {"holds": row["low"] <= nominal <= row["high"]}


def judge_places(places: FloatArray, nominal: float) -> Row:
    """Return the coverage of central intervals from places of truths among draws, of any shape."""
    hits = int(np.sum(np.abs(places - 0.5) < nominal / 2))
    return {"nominal": nominal} | judge_coverage(hits, places.size, nominal)


@cache
def band(n: int) -> tuple[FloatArray, FloatArray]:
    """Return the simultaneous band of the distribution of n ranks, minus that of a uniform one."""
    from arviz_stats import ecdf_utils  # late: it costs more than numpy to import

    ecdf: Any = ecdf_utils  # the library has no types
    rng = np.random.default_rng(n)
    simulations = _SIMULATIONS if n >= _FEW else _FEW_SIMULATIONS
    prob = ecdf.simulate_confidence_bands(n, 1, _POINTS, LEVEL, simulations, rng)
    low, high = ecdf.get_pointwise_confidence_band(prob, n, _POINTS)
    return low - _POINTS, high - _POINTS


def judge(ranks: FloatArray) -> Row:
    """Return whether ranks may be uniform: their band, a test of their histogram, coverages."""
    n = ranks.size
    low, high = band(n)
    off = np.searchsorted(np.sort(ranks), _POINTS, side="right") / n - _POINTS
    counts = np.histogram(ranks, bins=N_BINS, range=(0, 1))[0]
    return {
        "n": n,
        "inside_band": bool(np.all((low <= off) & (off <= high))),
        "p_value": float(stats.chisquare(counts).pvalue),
        "coverage": [judge_places(ranks, level) for level in (0.5, 0.9)],
        "histogram": counts.tolist(),
    }


def uniform(rows: Mapping[str, Row]) -> bool:
    """Return whether all of several judgements are those of uniform ranks."""
    return all(
        row["inside_band"] and all(level["holds"] for level in row["coverage"])
        for row in rows.values()
    )
