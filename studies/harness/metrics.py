"""Metrics of predictions of remaining life whose truth is known.

A prediction is a set of draws, one column per life: ``(n_draws, n)``; truths, horizons and results
have the shape ``(n,)``, or one value for all, in the unit of the draws. Draws and truths that never
reach their limit are infinite. A truth that is known only to lie beyond some travel is *censored*
there: a count of what lies beyond cannot be computed, and to leave such lives out biases the rest.
`crps` therefore takes the horizon of each life.

References
----------
Gneiting2007 and Gneiting2011 for the score, Susto2015 for services.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import sem

from lmshealth._private.arrays import BoolArray, FloatArray


def crps(draws: FloatArray, truth: ArrayLike, *, horizon: ArrayLike = np.inf) -> FloatArray:
    """Return the continuous ranked probability score of draws, up to a horizon; 0 is best.

    With F the distribution of the draws and y the truth it is ∫ (F(z) - 1{y ≤ z})² dz over all z
    up to the horizon, which is the score of draws and truth cut off there, and proper. The horizon
    must not depend on the end of the life; that of a censored life is its moment of censoring.
    """
    x, y = np.minimum(draws, horizon), np.minimum(truth, horizon)
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise ValueError("draws or truths that never end have no finite score: state a horizon")
    off, n = x - y, x.shape[0]
    # Half the mean distance of two draws, Σ |x_i - x_j| / (2 n²), from their order.
    order = (2 * np.arange(1, n + 1) - n - 1) / n**2
    return np.asarray(np.mean(np.abs(off), axis=0) - order @ np.sort(off, axis=0))


def service_at(draws: FloatArray, risk: float, *, horizon: ArrayLike = np.inf) -> FloatArray:
    """Return the latest service, up to a horizon, before which at most a share of draws end."""
    ordered = np.sort(draws, axis=0)
    # That many may have ended; a share that is whole is not lost by rounding.
    after = int(np.floor(risk * ordered.shape[0] * (1 + 1e-12)))
    return np.asarray(np.minimum(np.maximum(ordered[after], 0.0), horizon))


def unexpected_breaks(service: FloatArray, truth: ArrayLike) -> BoolArray:
    """Return which lives end before their service."""
    return np.asarray(np.asarray(truth) < service)


def mean(values: Sequence[float | None]) -> tuple[float, float]:
    """Return the mean of the values that there are, and its standard error."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)), float(sem(known)) if len(known) > 1 else 0.0
