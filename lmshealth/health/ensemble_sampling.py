"""Markov chain Monte Carlo: independent emcee ensembles, starts, convergence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.random import MT19937, RandomState

from lmshealth._private.arrays import FloatArray, ReadOnly
from lmshealth.errors import NotConverged
from lmshealth.health import constants
from lmshealth.health.importance_sampling import importance_sample, tempered
from lmshealth.health.laplace import LogProbability

if TYPE_CHECKING:
    import emcee

Start = Callable[[np.random.Generator], FloatArray]
"""Draw the start of an ensemble inside the support: ``(n_walkers, n_dim)``."""

_FIRST_STEPS, _START_ATTEMPTS = 250, 100
# Vectorised, many walkers cost little more than few.
_MIN_WALKERS, _WALKERS_PER_DIMENSION = 64, 16
# Draws of the prior, and of the importance sampler, that starts are chosen from.
_N_PRIOR, _N_START = 1000, 1000
_N_WEIGHTED = 2000  # weighted draws of each importance sampler


@dataclass(frozen=True, slots=True, eq=False)
class Sample(ReadOnly):
    """Draws from a posterior with their convergence diagnostics."""

    # Of every ensemble after burn-in, step after step and in a step walker after walker,
    # shape ``(n_ensembles, n_draws, n_dim)``.
    draws: FloatArray
    ess_bulk: FloatArray  # ess_bulk, ess_tail, r_hat: as in `Health`, shape ``(n_dim,)``
    ess_tail: FloatArray
    r_hat: FloatArray

    @property
    def flat(self) -> FloatArray:
        """Draws of the ensembles in turn, shape ``(n_ensembles n_draws, n_dim)``."""
        return np.swapaxes(self.draws, 0, 1).reshape(-1, self.draws.shape[-1])


def thin(draws: FloatArray, n: int) -> FloatArray:
    """Take n evenly spaced draws along the second axis."""
    index = np.linspace(0, draws.shape[1] - 1, n).round().astype(int)
    return np.asarray(draws[:, index])


def sample(
    log_probability: LogProbability,
    start: Start,
    seed: np.random.SeedSequence,
    n_ensembles: int = constants.N_ENSEMBLES,
) -> Sample:
    """Sample a posterior by independent ensembles [ForemanMackey2013], [Vehtari2021].

    Its log density is -inf outside its support. Every ensemble has its own start and random stream:
    walkers of one ensemble depend on each other, so that R-hat over them is no diagnostic.
    `NotConverged`, with the chains, is raised if 50 autocorrelation times or R-hat below 1.01 are
    not reached.
    """
    import emcee  # late: it imports scipy.stats

    streams = seed.spawn(2 * n_ensembles)
    samplers = []
    for start_seed, chain_seed in zip(streams[::2], streams[1::2], strict=True):
        points = start(np.random.default_rng(start_seed))
        # Proposals from a kernel density of the other walkers need a quarter of the steps of
        # differential evolution, but rarely reach tails without a walker; differences do, and with
        # gamma0 = 1 they jump between modes of the posterior. DESnookerMove of emcee 3.1.6 does not
        # keep the target: it narrows a Gaussian of six dimensions by 9 %.
        moves = [emcee.moves.KDEMove(), emcee.moves.DEMove(), emcee.moves.DEMove(gamma0=1.0)]
        weighted = list(zip(moves, (0.7, 0.2, 0.1), strict=True))
        options = {"vectorize": True, "moves": weighted}
        sampler = emcee.EnsembleSampler(*points.shape, log_probability, **options)
        # emcee ignores a Generator; without a state all samplers of a process draw the same.
        random_state = RandomState(MT19937(chain_seed)).get_state(legacy=False)
        samplers.append((sampler, emcee.State(points, random_state=random_state)))
    return _run(samplers)


def sample_by_importance(
    log_probability: LogProbability,
    draw_prior: Callable[[np.random.Generator, int], FloatArray],
    seed: np.random.SeedSequence,
) -> Sample:
    """Sample a posterior by independent adaptive importance samplers, started from the prior.

    They take the place of the ensembles of `sample`; effective sample sizes are those of their
    weights, together. `NotConverged`, with the draws, is raised if too few of any are effective, if
    their weights have heavy tails, or if R-hat is not below 1.01: `sample` then needs to decide.
    """
    drawn, ess = [], 0.0
    for own in seed.spawn(constants.N_ENSEMBLES):
        rng = np.random.default_rng(own)
        found = importance_sample(log_probability, draw_prior(rng, _N_PRIOR), rng, _N_WEIGHTED)
        if not (found.ess >= constants.MIN_ESS and found.pareto_k < constants.MAX_PARETO_K):
            raise NotConverged(
                f"{found.ess:.0f} draws are effective, Pareto k is {found.pareto_k:.2f}",
                found.points,
            )
        drawn.append(found.resampled(rng, _N_WEIGHTED))
        # Resampling to equal weights loses some.
        ess += 1 / (1 / found.ess + 1 / _N_WEIGHTED)
    draws = np.stack(drawn)
    r_hat = _diagnose("rhat", draws[:, :, None])
    if not (r_hat < constants.MAX_R_HAT).all():
        raise NotConverged(f"R-hat of importance samplers is {r_hat.max():.3f}", draws)
    sizes = np.full(draws.shape[2], ess)
    return Sample(draws, sizes, sizes, r_hat)


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
        with np.errstate(invalid="ignore"):
            tau = np.max([integrated_time(chain, tol=0, quiet=True) for chain in chains], axis=0)
        # NaN for a walker that never moved: at least as long as the run.
        tau = np.where(np.isnan(tau), n_steps, tau)
        burn = int(min(10 * tau.max(), n_steps / 2))
        kept = chains[:, burn:]
        enough = kept.shape[1] >= constants.MIN_AUTOCORRELATION_TIMES * tau.max()
        r_hat = _diagnose("rhat", kept)
        if enough and (r_hat < constants.MAX_R_HAT).all():
            break
        if n_steps >= constants.MAX_STEPS:
            raise NotConverged(
                f"after {n_steps} steps the autocorrelation time is {tau.max():.0f} and R-hat "
                f"{r_hat.max():.3f}; needed are {constants.MIN_AUTOCORRELATION_TIMES} "
                f"autocorrelation times and R-hat below {constants.MAX_R_HAT}; the posterior may "
                "have several modes",
                chains,
            )
        wanted = int(1.1 * (constants.MIN_AUTOCORRELATION_TIMES + 10) * tau.max())
        target = min(max(wanted, n_steps + n_steps // 2), constants.MAX_STEPS)
    # Effective sample sizes need each walker as a chain in time.
    walkers = np.swapaxes(kept, 1, 2)
    ess_bulk = _diagnose("ess", walkers, method="bulk")
    ess_tail = _diagnose("ess", walkers, method="tail", prob=(0.05, 0.95))
    return Sample(flattened(kept), ess_bulk, ess_tail, r_hat)


def flattened(chains: FloatArray) -> FloatArray:
    """Join steps and walkers: ``(n_ensembles, n_draws, n_dim)``."""
    return chains.reshape(chains.shape[0], -1, chains.shape[-1])


def _diagnose(what: str, chains: FloatArray, **options: Any) -> FloatArray:
    """Return a diagnostic of arviz with the ensembles as chains, shape ``(n_dim,)``."""
    from arviz_stats.base.array import array_stats  # late: it costs more than numpy to import

    diagnostic: Any = getattr(array_stats, what)  # the library has no types
    columns = np.moveaxis(flattened(chains), -1, 0)
    options |= {"chain_axis": 0, "draw_axis": 1}
    return np.array([float(diagnostic(column, **options)) for column in columns])


def start_near(centre: FloatArray, cov: FloatArray, log_probability: LogProbability) -> Start:
    """Start from a normal distribution of twice the standard deviations, inside the support."""
    factor = 2 * np.linalg.cholesky(cov)

    def start(rng: np.random.Generator) -> FloatArray:
        n = max(_MIN_WALKERS, _WALKERS_PER_DIMENSION * centre.size)
        found = np.empty((0, centre.size))
        for _ in range(_START_ATTEMPTS):
            points = centre + rng.standard_normal((n, centre.size)) @ factor.T
            found = np.concatenate([found, points[np.isfinite(log_probability(points))]])
            if found.shape[0] >= n:
                return found[:n]
        number = f"of {_START_ATTEMPTS * n} points about the posterior's mode {found.shape[0]}"
        raise NotConverged(f"{number} lie inside the modal map: widen the map or the prior", found)

    return start


def start_among(points: FloatArray, weight: FloatArray) -> Start:
    """Start from distinct draws ``(n, n_dim)`` of the posterior by weight ``(n,)``, tempered."""

    def start(rng: np.random.Generator) -> FloatArray:
        n = max(_MIN_WALKERS, _WALKERS_PER_DIMENSION * points.shape[1])
        if points.shape[0] < n:
            found = (
                f"{points.shape[0]} draws lie inside the modal map, {n} are needed to start from"
            )
            raise NotConverged(f"{found}: widen the map or the prior", points)
        log_weight = np.log(np.maximum(weight, 1e-300))
        flat = tempered(points, log_weight, min(2 * n, 0.5 * points.shape[0])).weight
        return np.asarray(points[rng.choice(points.shape[0], size=n, replace=False, p=flat)])

    return start


def start_from_prior(
    log_probability: LogProbability, draw_prior: Callable[[np.random.Generator, int], FloatArray]
) -> Start:
    """Start from draws of the posterior by adaptive importance sampling from the prior.

    `draw_prior` draws from the prior: ``(rng, n)`` to ``(n, n_dim)``.
    """

    def start(rng: np.random.Generator) -> FloatArray:
        found = importance_sample(log_probability, draw_prior(rng, _N_PRIOR), rng, _N_START)
        return start_among(found.points, found.weight)(rng)

    return start
