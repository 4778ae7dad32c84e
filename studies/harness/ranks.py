"""Ranks of truths among posterior draws: whether they are uniform.

If parameters are drawn from a prior, and data from the model with these parameters, then the truth
is one more draw of the posterior: its rank among independent draws is uniform. Ties are broken at
random, and the rank is spread evenly over its cell, so that what comes out is uniform from 0 to 1
(probability integral transform).

References
----------
Talts2018 for the ranks, Sailynoja2022 for the bands of their distribution.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from arviz_stats.ecdf_utils import (
    compute_ecdf,
    get_pointwise_confidence_band,
    simulate_confidence_bands,
)
from numpy.typing import NDArray
from scipy import stats

from studies.harness.metrics import place
from studies.harness.study import LEVEL, judge_places

Array = NDArray[np.float64]
Row = dict[str, Any]

# So few of the posterior's draws that they are as good as independent.
N_DRAWS = 127
N_BINS = 20
_POINTS = np.arange(1, 64) / 64
_SIMULATIONS = 20_000
# Of fewer ranks, as quick forms have them, hardly anything is outside.
_FEW, _FEW_SIMULATIONS = 20, 2_000


def rank(truth: Array, draws: Array, rng: np.random.Generator) -> list[float]:
    """Rank truths ``(n,)`` among draws ``(n_draws, n)``, as a share from 0 to 1."""
    return [round(float(value), 6) for value in place(draws, truth, rng)]


@cache
def band(n: int) -> tuple[Array, Array]:
    """Return the simultaneous band of the distribution of n ranks, minus that of a uniform one."""
    rng = np.random.default_rng(n)
    simulations = _SIMULATIONS if n >= _FEW else _FEW_SIMULATIONS
    prob = simulate_confidence_bands(n, 1, _POINTS, LEVEL, simulations, rng)
    low, high = get_pointwise_confidence_band(prob, n, _POINTS)
    return low - _POINTS, high - _POINTS


def judge(ranks: Array) -> Row:
    """Return whether ranks may be uniform: their band, a test of their histogram, coverages."""
    n = ranks.size
    low, high = band(n)
    off = compute_ecdf(ranks, _POINTS) - _POINTS
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
