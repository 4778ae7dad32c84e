"""Draws from many small posteriors by adaptive importance sampling, where chains take too long."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

Array = NDArray[np.float64]

_FREEDOM = 5  # of Student's t: heavier tails than any posterior here
_KERNELS, _ROUNDS = 100, 15
_ENOUGH = 0.3  # effective share of draws at which a proposal is good
_LEAST = 400  # effective draws, below which a posterior is drawn anew from more
_TRIES = 3


class TooFew(RuntimeError):
    """Importance sampling did not find the posterior."""


@dataclass(frozen=True, slots=True, eq=False)
class Draws:
    """Weighted draws, points ``(n, n_dim)`` and weights ``(n,)`` that sum to one."""

    points: Array
    weight: Array

    @property
    def ess(self) -> float:
        """Effective number of draws."""
        return float(1 / np.sum(self.weight**2))

    def resampled(self, rng: np.random.Generator, n: int) -> Array:
        """Draw points of equal weight."""
        return np.asarray(self.points[rng.choice(self.weight.size, n, p=self.weight)])


def explore(
    log_probability: Callable[[Array], Array], start: Array, rng: np.random.Generator, n: int
) -> Draws:
    """Draw from a density by importance sampling, from a mixture that learns it in rounds.

    Parameters
    ----------
    log_probability : callable
        Of ``(n_points, n_dim)``, -inf outside the support.
    start : ndarray
        Points that cover it, shape ``(n_start, n_dim)``.
    rng : Generator
        Random numbers.
    n : int
        Draws of the last round.
    """
    points, proposal = start, np.zeros(start.shape[0])
    few = max(400, n // 4)
    for _ in range(_ROUNDS):
        log_weight = log_probability(points) - proposal
        own = _weighted(points, log_weight)
        if own.ess >= _ENOUGH * few and points is not start:
            break
        points, proposal = _propose(_flattened(points, log_weight), rng, few)
    points, proposal = _propose(_flattened(points, log_weight), rng, n)
    return _weighted(points, log_probability(points) - proposal)


def _weighted(points: Array, log_weight: Array) -> Draws:
    inside = np.isfinite(log_weight)
    log_weight = log_weight[inside]
    return Draws(points[inside], np.exp(log_weight - logsumexp(log_weight)))


def _flattened(points: Array, log_weight: Array) -> Draws:
    """Weight draws by a power of their weights that leaves enough of them."""
    draws = _weighted(points, log_weight)
    least = min(20.0 * points.shape[1], 0.3 * draws.weight.size)
    low, high = 0.0, 1.0
    for _ in range(25 if draws.ess < least else 0):
        middle = (low + high) / 2
        draws = _weighted(points, middle * log_weight)
        low, high = (middle, high) if draws.ess >= least else (low, middle)
    return draws


def _propose(draws: Draws, rng: np.random.Generator, n: int) -> tuple[Array, Array]:
    """Draw from a mixture of Student's t about draws, and give its log density."""
    d = draws.points.shape[1]
    off = draws.points - draws.weight @ draws.points
    cov = (draws.weight[:, None] * off).T @ off + 1e-18 * np.eye(d)
    # Silverman's width, of the effective number of kernels.
    width = (4 / (d + 2)) ** (1 / (d + 4)) * min(_KERNELS, draws.ess) ** (-1 / (d + 4))
    factor = width * np.linalg.cholesky(cov)
    centres = draws.resampled(rng, _KERNELS)
    t = rng.standard_normal((n, d)) / np.sqrt(rng.chisquare(_FREEDOM, (n, 1)) / _FREEDOM)
    points = centres[rng.integers(_KERNELS, size=n)] + t @ factor.T
    unit, whitened = (np.linalg.solve(factor, x.T).T for x in (points, centres))
    square = (unit**2).sum(1)[:, None] + (whitened**2).sum(1) - 2 * unit @ whitened.T
    density = -0.5 * (_FREEDOM + d) * np.log1p(np.maximum(square, 0) / _FREEDOM)
    return points, logsumexp(density, axis=1)


def believed(
    log_probability: Callable[[Array], Array], start: Array, rng: np.random.Generator, n: int
) -> Draws:
    """Draw until the draws are worth enough, each time more."""
    for _ in range(_TRIES):
        draws = explore(log_probability, start, rng, n)
        if draws.ess >= _LEAST:
            return draws
        start, n = draws.resampled(rng, 500), 3 * n
    raise TooFew(f"{draws.ess:.0f} effective draws of {draws.weight.size}")


def quantiles(draws: Draws, levels: Array) -> Array:
    """Quantiles of each column, shape ``(n_levels, n_dim)``."""
    columns = []
    for column in draws.points.T:
        order = np.argsort(column)
        total = np.cumsum(draws.weight[order]) - 0.5 * draws.weight[order]
        columns.append(column[order][np.searchsorted(total, levels).clip(max=order.size - 1)])
    return np.column_stack(columns)


def place(draws: Draws, truth: Array, rng: np.random.Generator) -> Array:
    """Probability below the truth, of each column; where draws equal it (never), at random."""
    below = draws.weight @ (draws.points < truth)
    same = draws.weight @ (draws.points == truth)
    return np.asarray(below + same * rng.uniform(size=truth.size))
