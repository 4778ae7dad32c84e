"""Markov chain Monte Carlo: independent emcee ensembles, starts, convergence."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.random import MT19937, RandomState

from lmshealth._private.arrays import FloatArray, ReadOnly
from lmshealth.errors import NotConverged
from lmshealth.life import constants
from lmshealth.life.posterior.importance_sampling import (
    LogProbability,
    Proposal,
    WeightedDraws,
    tempered,
)

if TYPE_CHECKING:
    import emcee

_FIRST_STEPS = 100
_MIN_WALKERS, _WALKERS_PER_DIMENSION = 16, 2
_MOST_TRIES = 16  # proposals for a walker in a step
_STEPS_AHEAD = 10  # whose proposals are computed at once


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


@dataclass(slots=True, eq=False)
class _Resampling:
    """Move of emcee: every walker is drawn anew among proposals and itself, by their weights.

    Iterated sampling importance resampling [Andrieu2018]: a step of many proposals, computed at
    once, leaves less autocorrelation than as many steps of one. As no proposal depends on a walker,
    those of several steps are computed at once too: `ahead`, each with its log density and weight.
    """

    proposal: Proposal
    n_tries: int
    ahead: list[tuple[FloatArray, FloatArray, FloatArray]] = field(default_factory=list)

    def propose(self, model: Any, state: emcee.State) -> tuple[emcee.State, np.ndarray]:
        """Return the next state, and which walkers moved."""
        shape, rng = state.coords.shape, model.random
        if not self.ahead:
            points = self.proposal.draw(rng, _STEPS_AHEAD * self.n_tries * shape[0])
            log_density = model.compute_log_prob_fn(points)[0]
            weight = log_density - self.proposal.log_density(points)
            each = _STEPS_AHEAD, self.n_tries, shape[0]
            parts = points.reshape(*each, -1), log_density.reshape(each), weight.reshape(each)
            self.ahead += zip(*parts, strict=True)
        points, log_density, weight = self.ahead.pop()
        own = state.log_prob - self.proposal.log_density(state.coords)
        # The largest of log weights with Gumbel noise is a draw by the weights.
        log_weight = np.concatenate([own[None], weight])
        chosen = (log_weight + rng.gumbel(size=log_weight.shape)).argmax(axis=0)
        moved = chosen > 0
        at = chosen[moved] - 1, np.flatnonzero(moved)
        coords, density = state.coords.copy(), state.log_prob.copy()
        coords[moved], density[moved] = points[at], log_density[at]
        return type(state)(coords, log_prob=density), moved


def thin(draws: FloatArray, n: int) -> FloatArray:
    """Take n evenly spaced draws along the second axis."""
    index = np.linspace(0, draws.shape[1] - 1, n).round().astype(int)
    return np.asarray(draws[:, index])


def sample(
    log_probability: LogProbability,
    draws: WeightedDraws,
    seed: np.random.SeedSequence,
) -> Sample:
    """Sample a posterior by independent ensembles [ForemanMackey2013], [Vehtari2021].

    They start from weighted draws of it, about which most of their moves are proposed. Its log
    density is -inf outside its support. Every ensemble has its own start and random stream: walkers
    of one ensemble depend on each other, so that R-hat over them is no diagnostic. `NotConverged`,
    with the chains, is raised if 50 autocorrelation times or R-hat below 1.01 are not reached.
    """
    import emcee  # late: it imports scipy.stats

    # As many proposals as have one effective draw.
    n_tries = int(np.clip(np.ceil(draws.weight.size / draws.ess), 1, _MOST_TRIES))
    streams = seed.spawn(2 * constants.N_ENSEMBLES)
    samplers = []
    for start_seed, chain_seed in zip(streams[::2], streams[1::2], strict=True):
        rng = np.random.default_rng(start_seed)
        points = _start(draws, rng)
        # Independent proposals reach all that importance sampling has found in a few steps.
        # Differences of walkers reach tails beyond it, and with gamma0 = 1 jump between modes of
        # the posterior. DESnookerMove of emcee 3.1.6 does not keep the target: it narrows a
        # Gaussian of six dimensions by 9 %.
        independent = _Resampling(Proposal.near(draws, rng), n_tries)
        moves = [independent, emcee.moves.DEMove(), emcee.moves.DEMove(gamma0=1.0)]
        weighted = list(zip(moves, (0.9, 0.07, 0.03), strict=True))
        options = {"vectorize": True, "moves": weighted}
        sampler = emcee.EnsembleSampler(*points.shape, log_probability, **options)
        # emcee ignores a Generator; without a state all samplers of a process draw the same.
        random_state = RandomState(MT19937(chain_seed)).get_state(legacy=False)
        samplers.append((sampler, emcee.State(points, random_state=random_state)))
    return _run(samplers)


def _start(draws: WeightedDraws, rng: np.random.Generator) -> FloatArray:
    """Draw distinct walkers from weighted draws, tempered: ``(n_walkers, n_dim)``."""
    points, n_dim = draws.points, draws.points.shape[1]
    n = max(_MIN_WALKERS, _WALKERS_PER_DIMENSION * n_dim)
    if points.shape[0] < n:
        found = f"{points.shape[0]} draws lie inside the modal map, {n} are needed to start from"
        raise NotConverged(f"{found}: widen the map or the prior", points)
    log_weight = np.log(np.maximum(draws.weight, 1e-300))
    flat = tempered(points, log_weight, min(2 * n, 0.5 * points.shape[0])).weight
    return np.asarray(points[rng.choice(points.shape[0], size=n, replace=False, p=flat)])


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
        r_hat = rank_r_hat(flattened(kept))
        if enough and (r_hat < constants.MAX_R_HAT).all():
            break
        if n_steps >= constants.MAX_CHAIN_STEPS:
            raise NotConverged(
                f"after {n_steps} steps the autocorrelation time is {tau.max():.0f} and R-hat "
                f"{r_hat.max():.3f}; needed are {constants.MIN_AUTOCORRELATION_TIMES} "
                f"autocorrelation times and R-hat below {constants.MAX_R_HAT}; the posterior may "
                "have several modes",
                chains,
            )
        wanted = int(1.1 * (constants.MIN_AUTOCORRELATION_TIMES + 10) * tau.max())
        target = min(max(wanted, n_steps + n_steps // 2), constants.MAX_CHAIN_STEPS)
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


def rank_r_hat(draws: FloatArray) -> FloatArray:
    """Return R-hat of draws ``(n_ensembles, n_draws, n_dim)``, 1 of those that are all equal."""
    spread = np.ptp(draws, axis=(0, 1)) > 0
    found = np.ones(draws.shape[2])
    if spread.any():
        found[spread] = _diagnose("rhat", draws[:, :, None, spread])
    return found
