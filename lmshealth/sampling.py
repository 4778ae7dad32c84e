"""Run emcee so that its answer can be trusted: independent ensembles, seeds, convergence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.random import MT19937, RandomState

from lmshealth.arrays import FloatArray
from lmshealth.errors import NotConverged

if TYPE_CHECKING:
    import emcee

LogProbability = Callable[[FloatArray], FloatArray]
"""Log density of many points at once: ``(n_points, n_dim)`` to ``(n_points,)``."""

_N_ENSEMBLES = 4
_AUTOCORRELATION_TIMES = 50
_R_HAT = 1.01
_FIRST_STEPS = 600
_MOST_STEPS = 20_000
_START_ROUNDS = 6


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """Draws from a posterior with the evidence that they are.

    Attributes
    ----------
    draws : ndarray
        Shape ``(n_draws, n_dim)``; neighbours come from different walkers and ensembles.
    ess : ndarray
        Effective sample size from the autocorrelation times, shape ``(n_dim,)``.
    r_hat : ndarray
        Rank-normalised split R-hat over the independent ensembles, shape ``(n_dim,)``.
    """

    draws: FloatArray
    ess: FloatArray
    r_hat: FloatArray


def stream(seed: int | Sequence[int], *steps: int) -> np.random.SeedSequence:
    """Name a random stream by the user's seed, the input, and the step of the computation."""
    return np.random.SeedSequence([*np.atleast_1d(seed).tolist(), *steps])


def sample(
    log_probability: LogProbability,
    draw_prior: Callable[[np.random.Generator, int], FloatArray],
    seed: np.random.SeedSequence,
) -> Sample:
    """Sample a posterior with several independent emcee ensembles.

    Every ensemble has its own start and its own random stream: walkers of one ensemble depend on
    each other, so that R-hat over them would say nothing.

    Parameters
    ----------
    log_probability : callable
        Vectorised log density; -inf outside its support.
    draw_prior : callable
        Draws points of the right order of magnitude: ``(rng, n)`` to ``(n, n_dim)``.
    seed : SeedSequence
        Of all randomness.

    Raises
    ------
    NotConverged
        If 50 autocorrelation times or R-hat below 1.01 are not reached; carries the chains.
    """
    import emcee  # late: it brings scipy.stats along

    streams = seed.spawn(2 * _N_ENSEMBLES)
    samplers = []
    for start_seed, chain_seed in zip(streams[::2], streams[1::2], strict=True):
        start = find_start(log_probability, draw_prior, np.random.default_rng(start_seed))
        points = start()
        sampler = emcee.EnsembleSampler(
            *points.shape,
            log_probability,
            vectorize=True,
            # Not DESnookerMove: that of emcee 3.1.6 does not keep the target (its step is not along
            # a unit vector), and narrows a Gaussian of six dimensions by 9 %. Differences taken
            # whole (gamma0 = 1) jump between modes of the posterior.
            moves=[(emcee.moves.DEMove(), 0.8), (emcee.moves.DEMove(gamma0=1.0), 0.2)],
        )
        # emcee ignores a Generator, and without a seed two samplers of one process are alike.
        state = emcee.State(
            points, random_state=RandomState(MT19937(chain_seed)).get_state(legacy=False)
        )
        samplers.append((sampler, state))
    return _run(samplers)


def _run(samplers: list[tuple[emcee.EnsembleSampler, emcee.State]]) -> Sample:
    from emcee.autocorr import integrated_time

    n_steps, target = 0, _FIRST_STEPS
    states = [state for _, state in samplers]
    while True:
        states = [
            sampler.run_mcmc(state, target - n_steps)
            for (sampler, _), state in zip(samplers, states, strict=True)
        ]
        n_steps = target
        chains = np.stack([sampler.get_chain() for sampler, _ in samplers])
        tau = np.max([integrated_time(chain, tol=0, quiet=True) for chain in chains], axis=0)
        burn = int(min(10 * tau.max(), n_steps / 2))
        kept = chains[:, burn:]
        enough = kept.shape[1] >= _AUTOCORRELATION_TIMES * tau.max()
        r_hat = _r_hat(kept)
        if enough and (r_hat < _R_HAT).all():
            break
        if n_steps >= _MOST_STEPS:
            raise NotConverged(
                f"after {n_steps} steps the autocorrelation time is {tau.max():.0f} and R-hat "
                f"{r_hat.max():.3f}; needed are {_AUTOCORRELATION_TIMES} autocorrelation times "
                f"and R-hat below {_R_HAT}; the posterior may have several modes",
                chains,
            )
        wanted = int(1.1 * (_AUTOCORRELATION_TIMES + 10) * tau.max())
        target = min(max(wanted, n_steps + n_steps // 2), _MOST_STEPS)
    n_draws = kept.shape[0] * kept.shape[1] * kept.shape[2]
    # Time first, so that any thinning of the draws takes from all ensembles alike.
    draws = np.swapaxes(kept, 0, 1).reshape(n_draws, -1)
    return Sample(draws=draws, ess=n_draws / tau, r_hat=r_hat)


def _r_hat(chains: FloatArray) -> FloatArray:
    """R-hat over ensembles, shape ``(n_dim,)``."""
    from arviz_stats.base.array import array_stats  # late: it costs more than numpy to import

    n_ensembles, n_steps, n_walkers, n_dim = chains.shape
    flat = chains.reshape(n_ensembles, n_steps * n_walkers, n_dim)
    rhat: Any = array_stats.rhat  # the library has no types
    return np.array([float(rhat(flat[..., d], chain_axis=0, draw_axis=1)) for d in range(n_dim)])


def find_start(
    log_probability: LogProbability,
    draw_prior: Callable[[np.random.Generator, int], FloatArray],
    rng: np.random.Generator,
    n_draws: int = 1000,
) -> Callable[[], FloatArray]:
    """Narrow the prior down to the posterior by a few rounds of importance sampling.

    Parameters
    ----------
    log_probability, draw_prior : callable
        As in `sample`.
    rng : Generator
        Of all randomness.
    n_draws : int
        Points per round.

    Returns
    -------
    callable
        Draws distinct start points of one ensemble inside the support, ``(n_walkers, n_dim)``.
    """
    points = draw_prior(rng, n_draws)
    n_dim = points.shape[1]
    proposal = np.zeros(points.shape[0])
    for _ in range(_START_ROUNDS):
        log_weight = log_probability(points) - proposal
        if not np.isfinite(log_weight).any():
            raise NotConverged(
                "no draw of the prior lies inside the modal map: widen the map or the prior", points
            )
        weight = _tempered(log_weight, 10 * n_dim)
        mean = weight @ points
        off = points - mean
        # Twice the variance: a proposal must be wider than what it is to find.
        cov = 2 * (weight[:, None] * off).T @ off + 1e-16 * np.eye(n_dim)
        factor = np.linalg.cholesky(cov)
        unit = rng.standard_normal((n_draws, n_dim))
        points = mean + unit @ factor.T
        proposal = -0.5 * np.sum(unit**2, axis=1)
    log_weight = log_probability(points) - proposal

    def start() -> FloatArray:
        n = max(16, 6 * n_dim)
        weight = _tempered(log_weight, 2 * n)
        chosen = rng.choice(points.shape[0], size=n, replace=False, p=weight)
        return np.asarray(points[chosen])

    return start


def _tempered(log_weight: FloatArray, least: float) -> FloatArray:
    """Weights, flattened by a power until they hold so many effective draws."""
    low, high = 0.0, 1.0
    top = np.where(np.isfinite(log_weight), log_weight - np.max(log_weight), -np.inf)
    support = np.isfinite(top)
    least = min(least, 0.5 * support.sum())

    def weights(power: float) -> FloatArray:
        value = np.where(support, np.exp(power * np.where(support, top, 0.0)), 0.0)
        return np.asarray(value / value.sum())

    if 1 / np.sum(weights(1.0) ** 2) >= least:
        return weights(1.0)
    for _ in range(30):
        middle = (low + high) / 2
        if 1 / np.sum(weights(middle) ** 2) >= least:
            low = middle
        else:
            high = middle
    return weights(low)
