"""Posteriors of many lives by adaptive importance sampling, where chains would take too long.

The densities are those that `lmshealth.infer` and `lmshealth.prognose` sample; the study checks
that both ways give the same quantiles.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from unittest.mock import patch

import numpy as np
from scipy.special import logsumexp

from lmshealth import life as life_module
from lmshealth.inference import EpochPosterior
from lmshealth.life import LifeLikelihood, limited
from lmshealth.stage import Stage
from lmshealth.tracks import History, Track
from studies.lives import Array

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


def epoch_draws(
    track: Track, stage: Stage, epoch: int, rng: np.random.Generator, shrink: float = 1.0
) -> Draws:
    """Draw health at one epoch of a track, without a law; ``shrink`` falsifies the covariance."""
    modes = tuple(name for name in stage.informative if name in track.modes)
    columns = [track.modes.index(name) for name in modes]
    cov = shrink * track.drift_cov[epoch][np.ix_(columns, columns)]
    posterior = EpochPosterior.of(stage, modes, track.drift[epoch][columns], cov)
    draws = _believed(posterior.log_probability, posterior.draw_prior(rng, 1000), rng, 8000)
    return Draws(np.exp(draws.points), draws.weight)


def life_draws(
    history: History, stage: Stage, rng: np.random.Generator, *, noise_known: bool = False
) -> tuple[Draws, Draws]:
    """Draw health now and the travel left to each limit and to the first, by the laws.

    Parameters
    ----------
    noise_known : bool
        Whether the stated covariance is believed; otherwise a factor on it is averaged over.
    """
    if noise_known:
        with (
            patch.object(life_module, "_NOISE_SCALES", (1.0,)),
            patch.object(life_module, "_NOISE_SCALE_PRIOR", (1.0,)),
        ):
            likelihood = LifeLikelihood(history, stage)
    else:
        likelihood = LifeLikelihood(history, stage)
    about = explore(likelihood.log_probability, likelihood.draw_prior(rng, 600), rng, 600)
    start = about.resampled(rng, 200)
    likelihood.narrow(start)
    draws = _believed(likelihood.log_probability, start, rng, 3000)
    now = likelihood.health(draws.points, np.array([likelihood.now]))[:, 0]
    parts = likelihood.split(draws.points)
    left = []
    for j, parameter in limited(stage):
        assert parameter.limit is not None
        theta = likelihood.laws[j].natural(parts[j], likelihood.now)
        below = parameter.limit.below / parameter.baseline
        left.append(likelihood.laws[j].passage(theta, below) - likelihood.now)
    remaining = np.column_stack([*left, np.min(left, axis=0)])
    return Draws(now, draws.weight), Draws(remaining, draws.weight)


def _believed(
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
