"""Adaptive importance sampling: the evidence of a small posterior, and draws to begin chains from.

References
----------
Cappe2008 for mixtures that learn the target in rounds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln, logsumexp

from lmshealth._arrays import FloatArray, freeze
from lmshealth.errors import NotConverged
from lmshealth.health.laplace import LogProbability

_FREEDOM = 5  # of Student's t: heavier tails than a posterior has
_KERNELS, _ROUNDS = 100, 15
_ENOUGH = 0.3  # effective share of draws at which a proposal is good
_LEAST = 400  # effective draws, below which a posterior is drawn anew from more
_TRIES = 3


@dataclass(frozen=True, slots=True, eq=False)
class WeightedDraws:
    """WeightedDraws draws of a density.

    Attributes
    ----------
    points : ndarray
        Shape ``(n, n_dim)``.
    weight : ndarray
        They sum to one, shape ``(n,)``.
    log_evidence : float
        Logarithm of the integral of the density.
    """

    points: FloatArray
    weight: FloatArray
    log_evidence: float

    def __post_init__(self) -> None:
        freeze(self)

    @property
    def ess(self) -> float:
        """Effective number of draws; its inverse bounds the relative variance of the evidence."""
        return float(1 / np.sum(self.weight**2))

    def resampled(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Draw points of equal weight, shape ``(n, n_dim)``."""
        return np.asarray(self.points[rng.choice(self.weight.size, n, p=self.weight)])


def importance_sample(
    log_probability: LogProbability, start: FloatArray, rng: np.random.Generator, n: int
) -> WeightedDraws:
    """Draw from a density by importance sampling, from a mixture that learns it in rounds.

    Parameters
    ----------
    log_probability : callable
        Vectorised log density, -inf outside its support.
    start : ndarray
        Points that cover it, shape ``(n_start, n_dim)``.
    rng : Generator
        Random numbers.
    n : int
        Draws of the last round.

    Raises
    ------
    NotConverged
        If no point has a density above 0.
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


def importance_sample_to_ess(
    log_probability: LogProbability, start: FloatArray, rng: np.random.Generator, n: int
) -> WeightedDraws:
    """Draw as `importance_sample` until the draws are worth 400 independent ones, each time more.

    Raises
    ------
    NotConverged
        If three times are not enough; carries the points.
    """
    for _ in range(_TRIES):
        found = importance_sample(log_probability, start, rng, n)
        if found.ess >= _LEAST:
            return found
        start, n = found.resampled(rng, 500), 3 * n
    raise NotConverged(
        f"{found.ess:.0f} effective draws of {found.weight.size} by importance sampling; needed "
        f"are {_LEAST}: the posterior may have several modes far apart",
        found.points,
    )


def _weighted(points: FloatArray, log_weight: FloatArray) -> WeightedDraws:
    inside = np.isfinite(log_weight)
    if not inside.any():
        raise NotConverged(
            "no draw of the prior lies inside the modal map: widen the map or the prior", points
        )
    kept = log_weight[inside]
    total = float(logsumexp(kept))
    return WeightedDraws(points[inside], np.exp(kept - total), total - np.log(log_weight.size))


def _flattened(points: FloatArray, log_weight: FloatArray) -> WeightedDraws:
    """Weight draws by a power of their weights that leaves enough of them."""
    draws = _weighted(points, log_weight)
    least = min(20.0 * points.shape[1], 0.3 * draws.weight.size)
    low, high = 0.0, 1.0
    for _ in range(25 if draws.ess < least else 0):
        middle = (low + high) / 2
        draws = _weighted(points, middle * log_weight)
        low, high = (middle, high) if draws.ess >= least else (low, middle)
    return draws


def _propose(
    draws: WeightedDraws, rng: np.random.Generator, n: int
) -> tuple[FloatArray, FloatArray]:
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
    scale = gammaln((_FREEDOM + d) / 2) - gammaln(_FREEDOM / 2) - d / 2 * np.log(np.pi * _FREEDOM)
    scale -= np.sum(np.log(np.diag(factor))) + np.log(_KERNELS)
    return points, logsumexp(density, axis=1) + scale
