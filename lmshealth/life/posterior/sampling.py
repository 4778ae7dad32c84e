"""Sampling of a posterior of few dimensions: importance sampling with its evidence, and emcee."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.random import MT19937, RandomState
from scipy.special import gammaln, softmax

from lmshealth._private.arrays import FloatArray, ReadOnly
from lmshealth.errors import NotConverged
from lmshealth.life import constants

if TYPE_CHECKING:
    import emcee

LogProbability = Callable[[FloatArray], FloatArray]
"""Log density of many points at once: ``(n_points, n_dim)`` to ``(n_points,)``."""

# Degrees of freedom of the proposal's Student's t: heavier tails than a posterior has.
_FREEDOM = 5
_N_KERNELS, _MAX_ROUNDS, _MAX_ATTEMPTS = 100, 15, 4
# Rounds after which a density that integrates to too little is not adapted to any more.
_HOPELESS = 4
# Effective share of the draws at which the proposal is good enough for the last round; and
# effective draws from which it is once another round changes the log evidence by no more than this.
_GOOD_SHARE, _SETTLED, _SAME = 0.3, 20.0, 0.3
# Draws of another attempt over those before: least and most, and the margin by which those that are
# missing are exceeded.
_GROWTH, _MARGIN = (2.0, 3.0), 1.3
# Effective draws per dimension from which a proposal is made.
_LEAST_PER_DIMENSION = 20.0
# Share of a wide component about all draws, which covers tails between and beyond the kernels, and
# its width in standard deviations [Hesterberg1995].
_WHOLE_SHARE, _WHOLE_WIDTH = 0.2, 1.5
# Variance added in each direction, of that of the draws, where the draws span fewer dimensions.
_RIDGE = 0.05
# Of the ensembles.
_FIRST_STEPS = 100
_MIN_WALKERS, _WALKERS_PER_DIMENSION = 16, 2
_MOST_TRIES = 16  # proposals for a walker in a step
_STEPS_AHEAD = 10  # whose proposals are computed at once


@dataclass(frozen=True, slots=True, eq=False)
class WeightedDraws(ReadOnly):
    """Draws of a density ``(n, n_dim)``, normalised weights ``(n,)``, and log of its integral."""

    points: FloatArray
    weight: FloatArray
    log_evidence: float

    @property
    def ess(self) -> float:
        """Effective sample size; its inverse bounds the relative variance of the evidence."""
        return float(1 / np.sum(self.weight**2))

    @property
    def pareto_k(self) -> float:
        """Shape of the generalised Pareto distribution of the largest weights.

        NaN of too few, and where hardly any is positive.
        The posterior mean by [Zhang2009], with the weak prior of [Vehtari2024]; that of arviz,
        whose import costs more time than an update.
        """
        n = self.weight.size
        m = int(3 * n**0.5) if n > 225 else n // 5
        cutoff, *tail = np.sort(self.weight)[-m - 1 :]
        excess = np.array(tail) - cutoff
        if m < 5 or excess[quarter := int(m / 4 + 0.5) - 1] <= 0:
            return float("nan")
        n_grid = 30 + int(m**0.5)
        grid = 1 - np.sqrt(n_grid / (np.arange(n_grid) + 0.5))
        grid = grid / (3 * excess[quarter]) + 1 / excess[-1]
        shape = np.log1p(-grid[:, None] * excess).mean(axis=1)
        scale = softmax(m * (np.log(-grid / shape) - shape)) @ grid
        return float((m * np.log1p(-scale * excess).mean() + 5) / (m + 10))

    def resampled(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Draw points of equal weight, shape ``(n, n_dim)``."""
        return np.asarray(self.points[rng.choice(self.weight.size, n, p=self.weight)])


def importance_sample(
    log_probability: LogProbability,
    start: FloatArray,
    rng: np.random.Generator,
    n: int,
    least: float = -np.inf,
) -> WeightedDraws:
    """Draw from a density by importance sampling from a mixture adapted in rounds [Cappe2008].

    The start are points that cover the support of the density, ``(n_start, n_dim)``; n is the
    number of draws of the last round. Adaptation ends early where no draw contributes as much as
    `least` to the log integral. `NotConverged` is raised if no point has a density above 0.
    """
    points, proposal, before = start, np.zeros(start.shape[0]), np.inf
    few = max(200, n // 4)
    for k in range(_MAX_ROUNDS):
        log_weight = log_probability(points) - proposal
        draws = _weighted(points, log_weight)
        is_settled = draws.ess >= _SETTLED and abs(draws.log_evidence - before) < _SAME
        is_good = points is not start and (draws.ess >= _GOOD_SHARE * few or is_settled)
        before = np.inf if points is start else draws.log_evidence
        is_hopeless = k >= _HOPELESS and log_weight.max() < least
        # Enough draws to place kernels by: some are left of a density that most of them miss.
        wanted = min(_LEAST_PER_DIMENSION * points.shape[1], 0.3 * draws.weight.size)
        draws = tempered(points, log_weight, wanted)
        if is_good or is_hopeless or k == _MAX_ROUNDS - 1:
            break
        points, proposal = _propose(draws, rng, few)
    return _drawn_near(log_probability, draws, rng, n)


def importance_sample_again(
    log_probability: LogProbability, before: WeightedDraws, rng: np.random.Generator, n: int
) -> WeightedDraws:
    """Draw n times from a density, given draws of nearly the same: without rounds if they suffice.

    `NotConverged` is raised as by `importance_sample`.
    """
    if before.ess >= _LEAST_PER_DIMENSION * before.points.shape[1]:
        return _drawn_near(log_probability, before, rng, n)
    start = before.resampled(rng, before.points.shape[0])
    return importance_sample(log_probability, start, rng, n)


def _drawn_near(
    log_probability: LogProbability, draws: WeightedDraws, rng: np.random.Generator, n: int
) -> WeightedDraws:
    points, proposal = _propose(draws, rng, n)
    return _weighted(points, log_probability(points) - proposal)


def draw_to_ess(
    log_probability: LogProbability,
    draws: WeightedDraws,
    rng: np.random.Generator,
    min_ess: float = constants.MIN_ESS,
) -> WeightedDraws:
    """Draw again from a density, more often, unless enough of the draws are effective.

    Raises `NotConverged`, with the points, if the fourth attempt has fewer.
    """
    n = draws.weight.size
    for _ in range(_MAX_ATTEMPTS):
        if draws.ess >= min_ess:
            return draws
        n = int(n * np.clip(_MARGIN * min_ess / draws.ess, *_GROWTH))
        draws = importance_sample_again(log_probability, draws, rng, n)
    if draws.ess >= min_ess:
        return draws
    raise NotConverged(
        f"{draws.ess:.0f} effective draws of {draws.weight.size} by importance sampling; needed "
        f"are {min_ess:.0f}: the posterior may have several modes far apart",
        draws.points,
    )


def tempered(points: FloatArray, log_weight: FloatArray, min_ess: float) -> WeightedDraws:
    """Raise weights ``(n,)`` of points ``(n, n_dim)`` to a power that leaves an effective size.

    The power is at most 1; a log weight of -inf drops its point.
    """
    draws = _weighted(points, log_weight)
    if draws.ess >= min_ess:
        return draws
    low, high = 0.0, 1.0
    relative = log_weight[np.isfinite(log_weight)] - log_weight.max()
    for _ in range(25):
        power = (low + high) / 2
        weight = np.exp(power * relative)
        enough = weight.sum() ** 2 >= min_ess * (weight @ weight)
        low, high = (power, high) if enough else (low, power)
    return _weighted(points, power * log_weight)


def _weighted(points: FloatArray, log_weight: FloatArray) -> WeightedDraws:
    inside = np.isfinite(log_weight)
    if not inside.any():
        raise NotConverged(
            "no draw of the prior lies inside the modal map: widen the map or the prior", points
        )
    kept = log_weight[inside]
    total = float(log_sum_exp(kept))
    return WeightedDraws(points[inside], np.exp(kept - total), total - np.log(log_weight.size))


def log_sum_exp(values: FloatArray, axis: int = 0) -> FloatArray:
    """Return ln of the sum of exponentials of finite values along an axis.

    As scipy's logsumexp, at a fraction of its time for so few values.
    """
    largest = values.max(axis=axis, keepdims=True)
    total = np.log(np.exp(values - largest).sum(axis=axis))
    return np.asarray(total + largest.squeeze(axis))


@dataclass(frozen=True, slots=True, eq=False)
class Proposal(ReadOnly):
    """Mixture of Student's t at draws of a density, and about all of them, as a proposal.

    `centres` of the kernels, ``(n_kernels, n_dim)``; mean and Cholesky factor of the covariance of
    all draws; `width` of a kernel as a share of it.
    """

    centres: FloatArray
    mean: FloatArray
    factor: FloatArray
    width: float

    @classmethod
    def near(cls, draws: WeightedDraws, rng: np.random.Generator) -> Self:
        """Make a proposal for the density of which these are draws."""
        d = draws.points.shape[1]
        mean = draws.weight @ draws.points
        off = draws.points - mean
        cov = (draws.weight[:, None] * off).T @ off + 1e-18 * np.eye(d)
        try:
            factor = np.linalg.cholesky(cov)
        except np.linalg.LinAlgError:  # fewer effective draws than dimensions
            factor = np.linalg.cholesky(cov + _RIDGE * np.diag(draws.points.var(axis=0) + 1e-18))
        # Silverman's width, of the effective number of kernels.
        width = (4 / (d + 2)) ** (1 / (d + 4)) * min(_N_KERNELS, draws.ess) ** (-1 / (d + 4))
        # Drawn to the mean, so that the mixture is as wide as the draws [Liu2001].
        drawn = draws.resampled(rng, _N_KERNELS) - mean
        centres = mean + np.sqrt(max(1 - width**2, 0.0)) * drawn
        return cls(centres, mean, np.asarray(factor, dtype=float), float(width))

    def draw(self, rng: Any, n: int) -> FloatArray:
        """Draw points, ``(n, n_dim)``; `rng` is a Generator, or the RandomState of emcee."""
        d = self.mean.size
        t = rng.standard_normal((n, d)) / np.sqrt(rng.chisquare(_FREEDOM, (n, 1)) / _FREEDOM)
        chosen = (rng.uniform(size=n) * _N_KERNELS).astype(int)
        near = self.centres[chosen] + self.width * t @ self.factor.T
        whole = (rng.uniform(size=n) < _WHOLE_SHARE)[:, None]
        return np.asarray(np.where(whole, self.mean + _WHOLE_WIDTH * t @ self.factor.T, near))

    def log_density(self, points: FloatArray) -> FloatArray:
        """Return the log density of points, ``(n,)``."""
        d = self.mean.size
        unit, whitened = (
            np.linalg.solve(self.factor, (x - self.mean).T).T for x in (points, self.centres)
        )
        square = (unit**2).sum(1)[:, None] + (whitened**2).sum(1) - 2 * unit @ whitened.T
        of_kernel = _log_t(np.maximum(square, 0), self.width, d)
        kernels = log_sum_exp(of_kernel, axis=1) - np.log(_N_KERNELS)
        about_all = _log_t((unit**2).sum(1), _WHOLE_WIDTH, d)
        total = np.logaddexp(kernels + np.log1p(-_WHOLE_SHARE), about_all + np.log(_WHOLE_SHARE))
        return np.asarray(total - np.sum(np.log(np.diag(self.factor))))


def _propose(
    draws: WeightedDraws, rng: np.random.Generator, n: int
) -> tuple[FloatArray, FloatArray]:
    """Draw from a proposal near draws: ``(n, n_dim)``, and log density ``(n,)``."""
    proposal = Proposal.near(draws, rng)
    points = proposal.draw(rng, n)
    return points, proposal.log_density(points)


def _log_t(square: FloatArray, width: float, d: int) -> FloatArray:
    """Return the log density of Student's t of a width in d dimensions at squared distances."""
    scale = gammaln((_FREEDOM + d) / 2) - gammaln(_FREEDOM / 2) - d / 2 * np.log(np.pi * _FREEDOM)
    tail = np.log1p(square / (_FREEDOM * width**2))
    return np.asarray(scale - d * np.log(width) - 0.5 * (_FREEDOM + d) * tail)


@dataclass(frozen=True, slots=True, eq=False)
class Sample(ReadOnly):
    """Draws from a posterior with their convergence diagnostics."""

    # Of every ensemble after burn-in, step after step and in a step walker after walker,
    # shape ``(n_ensembles, n_draws, n_dim)``.
    draws: FloatArray
    ess_bulk: FloatArray  # ess_bulk, ess_tail, r_hat: as in `Health`, shape ``(n_dim,)``
    ess_tail: FloatArray
    r_hat: FloatArray


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
    log_probability: LogProbability, draws: WeightedDraws, seed: np.random.SeedSequence
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
