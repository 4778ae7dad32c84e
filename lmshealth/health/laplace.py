"""Laplace's approximation of a posterior: the sampler's start and an independent check."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import Bounds, minimize

from lmshealth._private.arrays import FloatArray, ReadOnly

LogProbability = Callable[[FloatArray], FloatArray]
"""Log density of many points at once: ``(n_points, n_dim)`` to ``(n_points,)``."""

# Steps of the differences: first as a share of the box, then of the standard deviation, where
# rounding (1e-15 over its square) and the fourth derivative are both negligible.
_FIRST_STEP, _STEP = 1e-4, 0.01
_SEARCHES = 3


@dataclass(frozen=True, slots=True, eq=False)
class Laplace(ReadOnly):
    """Maximum of a density, and inverse of the negative Hessian of its logarithm there."""

    mode: FloatArray
    cov: FloatArray

    @property
    def std(self) -> FloatArray:
        """Standard deviations, shape ``(n_dim,)``."""
        return np.sqrt(np.diag(self.cov))


def approximate(
    log_probability: LogProbability, points: FloatArray, low: FloatArray, high: FloatArray
) -> Laplace | None:
    """Approximate a density by a normal distribution at its maximum.

    The search starts from the best three of the points ``(n_points, n_dim)``; the density is zero
    outside the box from low to high, ``(n_dim,)``. None if the maximum lies at the edge of the box
    or the Hessian there is not negative definite.
    """
    margin = 1e-9 * (high - low)
    box, bounds = Bounds(low, high), Bounds(low + margin, high - margin)

    def cost(x: FloatArray) -> float:
        return -float(log_probability(x[None])[0])

    value = log_probability(points)
    begins = points[np.argsort(-value, kind="stable")[:_SEARCHES]]
    ends = [minimize(cost, begin, method="L-BFGS-B", bounds=bounds) for begin in begins]
    mode = min(ends, key=lambda end: float(end.fun)).x
    cov = _inverse_curvature(log_probability, mode, _FIRST_STEP * (high - low), box)
    for _ in range(2):  # a Newton step, then the curvature at its end
        if cov is None:
            return None
        step = _STEP * np.sqrt(np.diag(cov))
        shifts = np.diag(step)
        value = log_probability(np.concatenate([mode + shifts, mode - shifts])).reshape(2, -1)
        mode = mode + cov @ ((value[0] - value[1]) / (2 * step))
        cov = _inverse_curvature(log_probability, mode, step, box)
    return None if cov is None else Laplace(mode=mode, cov=cov)


def _inverse_curvature(
    log_probability: LogProbability, x: FloatArray, step: FloatArray, box: Bounds
) -> FloatArray | None:
    """Invert the negative matrix of second differences; None if it is not positive definite."""
    n = x.size
    if (x - 2 * step <= box.lb).any() or (x + 2 * step >= box.ub).any():
        return None
    shifts = np.diag(step)
    one, other = np.repeat(shifts, n, axis=0), np.tile(shifts, (n, 1))
    corners = [x + one + other, x + one - other, x - one + other, x - one - other]
    value = log_probability(np.concatenate(corners)).reshape(4, n, n)
    curvature = -(value[0] - value[1] - value[2] + value[3]) / (4 * np.outer(step, step))
    try:
        np.linalg.cholesky(curvature)
    except np.linalg.LinAlgError:
        return None
    return np.asarray(np.linalg.inv(curvature))
