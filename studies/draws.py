"""Draws of a posterior of few parameters by importance sampling, a second way beside the chains."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax
from scipy.stats import multivariate_t

from lmshealth.sampling import start_from_prior

Array = NDArray[np.float64]
Density = Callable[[Array], Array]

# Tails of proposals are heavier than a posterior's; so many effective draws are asked for.
_FREEDOM, _LEAST = 5, 1000
_N, _ROUNDS = 1000, 12


def draw(
    log_probability: Density,
    draw_prior: Callable[[np.random.Generator, int], Array],
    rng: np.random.Generator,
    n: int,
) -> Array | None:
    """Draw independent points of a posterior.

    Proposals are Student's t about the weighted mean of the round before, until a last round of
    four times as many points is worth a thousand draws.

    Parameters
    ----------
    log_probability : callable
        Log density of many points at once.
    draw_prior : callable
        Draws points to begin from.
    rng : Generator
        Of all randomness.
    n : int
        How many points.

    Returns
    -------
    ndarray or None
        Shape ``(n, n_dim)``; None where no round is worth that much.
    """
    points = start_from_prior(log_probability, draw_prior, 300)(rng)
    mean, cov = points.mean(axis=0), 2 * np.cov(points, rowvar=False)
    size = _N
    for _ in range(_ROUNDS):
        proposal = multivariate_t(mean, cov, df=_FREEDOM, seed=rng)
        points = proposal.rvs(size)
        weight = softmax(log_probability(points) - proposal.logpdf(points))
        effective = 1 / np.sum(weight**2)
        if effective >= _LEAST:
            return np.asarray(points[rng.choice(size, size=n, p=weight)])
        if effective > 20 * mean.size:
            mean = weight @ points
            cov = np.cov(points, rowvar=False, aweights=weight)
        # Points are plenty where the proposal is right, and dear before.
        size = min(2 * size, 4 * _N) if effective < 0.2 * size else 4 * _N
    return None
