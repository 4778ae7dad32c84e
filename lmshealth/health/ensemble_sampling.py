"""Run emcee so that its answer can be trusted: independent ensembles, seeds, convergence."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.random import MT19937, RandomState

from lmshealth._arrays import FloatArray, freeze
from lmshealth.errors import NotConverged
from lmshealth.health.laplace import LogProbability

if TYPE_CHECKING:
    import emcee

Start = Callable[[np.random.Generator], FloatArray]
"""Draws the points inside the support that an ensemble begins from: ``(n_walkers, n_dim)``."""

_N_ENSEMBLES = 4
_AUTOCORRELATION_TIMES = 50
_R_HAT = 1.01
_FIRST_STEPS = 250
_MOST_STEPS = 20_000
_LEAST_WALKERS = 32
_MOST_ROUNDS = 60
_START_ATTEMPTS = 100


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """Draws from a posterior with the evidence that they are.

    Attributes
    ----------
    draws : ndarray
        Of every ensemble, after burn-in, step by step and walker by walker, shape
        ``(n_ensembles, n_draws, n_dim)``.
    ess_bulk, ess_tail : ndarray
        Effective sample size of all ensembles together for the middle of the posterior and for
        its 5 and 95 % quantiles, shape ``(n_dim,)``.
    r_hat : ndarray
        Rank-normalised split R-hat over the independent ensembles, shape ``(n_dim,)``.
    autocorrelation_time : ndarray
        In steps, the longest of the ensembles, shape ``(n_dim,)``.
    """

    draws: FloatArray
    ess_bulk: FloatArray
    ess_tail: FloatArray
    r_hat: FloatArray
    autocorrelation_time: FloatArray

    def __post_init__(self) -> None:
        freeze(self)

    def thinned(self, n: int) -> FloatArray:
        """Take so many draws of each ensemble, evenly: ``(n_ensembles, n, n_dim)``."""
        return thin(self.draws, n)

    @property
    def flat(self) -> FloatArray:
        """Draws of all ensembles by turns, shape ``(n_ensembles n_draws, n_dim)``."""
        return np.swapaxes(self.draws, 0, 1).reshape(-1, self.draws.shape[-1])


def thin(draws: FloatArray, n: int) -> FloatArray:
    """Take so many draws along the second axis, evenly."""
    index = np.linspace(0, draws.shape[1] - 1, n).round().astype(int)
    return np.asarray(draws[:, index])


def stream(seed: int | Sequence[int], *steps: int) -> np.random.SeedSequence:
    """Name a random stream by the user's seed, the input, and the step of the computation."""
    return np.random.SeedSequence([*np.atleast_1d(seed).tolist(), *steps])


def seed_of(seed: int, *inputs: str) -> tuple[int, int]:
    """Make the seed of a computation from the user's and from what goes in, by its hash."""
    digest = hashlib.sha256("\n".join(inputs).encode()).hexdigest()
    return seed, int(digest[:12], 16)


def sample(log_probability: LogProbability, start: Start, seed: np.random.SeedSequence) -> Sample:
    """Sample a posterior with several independent emcee ensembles.

    Every ensemble has its own start and its own random stream: walkers of one ensemble depend on
    each other, so that R-hat over them would say nothing.

    Parameters
    ----------
    log_probability : callable
        Vectorised log density; -inf outside its support.
    start : callable
        Where an ensemble begins.
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
        points = start(np.random.default_rng(start_seed))
        sampler = emcee.EnsembleSampler(
            *points.shape,
            log_probability,
            vectorize=True,
            # Proposals from a kernel density of the other walkers need a quarter of the steps that
            # differences of walkers do, but keep away from tails that no walker is in; differences
            # do not. Taken whole (gamma0 = 1) they jump between modes of the posterior.
            # Not DESnookerMove: that of emcee 3.1.6 does not keep the target (its step is not along
            # a unit vector), and narrows a Gaussian of six dimensions by 9 %.
            moves=[
                (emcee.moves.KDEMove(), 0.7),
                (emcee.moves.DEMove(), 0.2),
                (emcee.moves.DEMove(gamma0=1.0), 0.1),
            ],
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
        with np.errstate(invalid="ignore"):
            tau = np.max([integrated_time(chain, tol=0, quiet=True) for chain in chains], axis=0)
        # Of a walker that never moved it is NaN: no shorter than the run.
        tau = np.where(np.isnan(tau), n_steps, tau)
        burn = int(min(10 * tau.max(), n_steps / 2))
        kept = chains[:, burn:]
        enough = kept.shape[1] >= _AUTOCORRELATION_TIMES * tau.max()
        r_hat = _diagnose("rhat", kept)
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
    # What has a time scale along a chain must see the walkers one after the other.
    walkers = np.swapaxes(kept, 1, 2)
    return Sample(
        draws=flattened(kept),
        ess_bulk=_diagnose("ess", walkers, method="bulk"),
        ess_tail=_diagnose("ess", walkers, method="tail", prob=(0.05, 0.95)),
        r_hat=r_hat,
        autocorrelation_time=tau,
    )


def flattened(chains: FloatArray) -> FloatArray:
    """Join steps and walkers: ``(n_ensembles, n_draws, n_dim)``."""
    return chains.reshape(chains.shape[0], -1, chains.shape[-1])


def _diagnose(what: str, chains: FloatArray, **options: Any) -> FloatArray:
    """Ask arviz about each dimension, an ensemble being a chain, shape ``(n_dim,)``."""
    from arviz_stats.base.array import array_stats  # late: it costs more than numpy to import

    ask: Any = getattr(array_stats, what)  # the library has no types
    flat = flattened(chains)
    axes = {"chain_axis": 0, "draw_axis": 1}
    return np.array([float(ask(flat[..., d], **axes, **options)) for d in range(flat.shape[-1])])


def _n_walkers(n_dim: int) -> int:
    """Choose the walkers of an ensemble: a step of many costs hardly more than one of few."""
    return max(_LEAST_WALKERS, 16 * n_dim)


def start_near(centre: FloatArray, cov: FloatArray, log_probability: LogProbability) -> Start:
    """Begin about a point, twice as wide as a normal distribution, inside the support."""
    factor = 2 * np.linalg.cholesky(cov)

    def start(rng: np.random.Generator) -> FloatArray:
        n = _n_walkers(centre.size)
        found = np.empty((0, centre.size))
        for _ in range(_START_ATTEMPTS):
            points = centre + rng.standard_normal((n, centre.size)) @ factor.T
            found = np.concatenate([found, points[np.isfinite(log_probability(points))]])
            if found.shape[0] >= n:
                return found[:n]
        raise NotConverged(
            f"of {_START_ATTEMPTS * n} points about the posterior's mode {found.shape[0]} lie "
            "inside the modal map: widen the map or the prior",
            found,
        )

    return start


def start_among(points: FloatArray, weight: FloatArray) -> Start:
    """Begin at some of many weighted draws of the posterior itself, none twice."""

    def start(rng: np.random.Generator) -> FloatArray:
        n = _n_walkers(points.shape[1])
        # Flattened where few draws have all the weight.
        flat, _ = _tempered(np.log(np.maximum(weight, 1e-300)), 2 * n)
        return np.asarray(points[rng.choice(points.shape[0], size=n, replace=False, p=flat)])

    return start


def start_from_prior(
    log_probability: LogProbability,
    draw_prior: Callable[[np.random.Generator, int], FloatArray],
    n_draws: int = 1000,
) -> Start:
    """Begin where rounds of importance sampling narrow the prior down to the posterior.

    They end when the weights of a round need no flattening any more: earlier than that the points
    may lie tens of log units below the posterior.

    Parameters
    ----------
    log_probability : callable
        As in `sample`.
    draw_prior : callable
        Draws points of the right order of magnitude: ``(rng, n)`` to ``(n, n_dim)``.
    n_draws : int
        Points per round.
    """

    def start(rng: np.random.Generator) -> FloatArray:
        points = draw_prior(rng, n_draws)
        n_dim = points.shape[1]
        n = _n_walkers(n_dim)
        proposal = np.zeros(points.shape[0])
        for k in range(_MOST_ROUNDS):
            log_weight = log_probability(points) - proposal
            if not np.isfinite(log_weight).any():
                raise NotConverged(
                    "no draw of the prior lies inside the modal map: widen the map or the prior",
                    points,
                )
            weight, power = _tempered(log_weight, 10 * n_dim)
            if k and power == 1 and np.isfinite(log_weight).sum() >= 2 * n:
                break
            mean = weight @ points
            off = points - mean
            # A proposal must be wider than what it is to find; flattened weights see to that too.
            cov = 1.3 * (weight[:, None] * off).T @ off + 1e-16 * np.eye(n_dim)
            factor = np.linalg.cholesky(cov)
            unit = rng.standard_normal((n_draws, n_dim))
            points = mean + unit @ factor.T
            proposal = -0.5 * np.sum(unit**2, axis=1)
        log_weight = log_probability(points) - proposal
        if (possible := np.isfinite(log_weight).sum()) < n:
            raise NotConverged(
                f"{possible} of {n_draws} draws lie inside the modal map, {n} are needed to begin "
                "from: widen the map or the prior",
                points,
            )
        weight, _ = _tempered(log_weight, 2 * n)
        chosen = rng.choice(points.shape[0], size=n, replace=False, p=weight)
        return np.asarray(points[chosen])

    return start


def _tempered(log_weight: FloatArray, least: float) -> tuple[FloatArray, float]:
    """Weights, flattened by a power until they hold so many effective draws, and that power."""
    low, high = 0.0, 1.0
    top = np.where(np.isfinite(log_weight), log_weight - np.max(log_weight), -np.inf)
    support = np.isfinite(top)
    least = min(least, 0.5 * support.sum())

    def weights(power: float) -> FloatArray:
        value = np.where(support, np.exp(power * np.where(support, top, 0.0)), 0.0)
        return np.asarray(value / value.sum())

    if 1 / np.sum(weights(1.0) ** 2) >= least:
        return weights(1.0), 1.0
    for _ in range(30):
        middle = (low + high) / 2
        if 1 / np.sum(weights(middle) ** 2) >= least:
            low = middle
        else:
            high = middle
    return weights(low), low
