"""Posterior of a life: probabilities of its scenarios, and their laws' parameters."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import softmax
from threadpoolctl import threadpool_limits

from lmshealth._private.arrays import FloatArray, ReadOnly, freeze
from lmshealth._private.seeds import stream
from lmshealth.errors import NotConverged, NotEnoughData
from lmshealth.health.constants import MAX_PARETO_K, MIN_ESS
from lmshealth.health.ensemble_sampling import Sample, sample, start_among, thin
from lmshealth.health.importance_sampling import (
    WeightedDraws,
    importance_sample,
    importance_sample_again,
    importance_sample_to_ess,
)
from lmshealth.prognosis import constants
from lmshealth.prognosis.life_likelihood import Grid, LifeLikelihood
from lmshealth.prognosis.scenarios import Scenario
from lmshealth.stage.description import Stage
from lmshealth.tracking.history import History

if TYPE_CHECKING:
    from xarray import DataTree

_STEP = 1 << 20  # of the random stream: beyond the epochs of health
_N_ENSEMBLES, _N_SETTINGS = 4, 500
_N_ROUGH, _N_FINE = 600, 2000
# Effective draws below which an evidence may miss most of its integral.
_LEAST_ESS = 20.0
# Draws of an update, and those of each scenario that are kept for the next one.
_N_UPDATE, _N_START = 4000, 300
# Share of the posterior of the grid points that are dropped once a scenario is sampled.
_NEGLIGIBLE = 0.01
_CHECKS = ("ess_bulk", "ess_tail", "r_hat")


@dataclass(frozen=True, slots=True, eq=False)
class LifeDensity:
    """Log posterior density of the coordinates of one scenario, averaged over a grid."""

    likelihood: LifeLikelihood
    scenario: Scenario
    grid: Grid

    def log_probability(self, y: FloatArray) -> FloatArray:
        """Return the log posterior density, -inf outside the map, shape ``(n,)``.

        Its integral is the evidence of the scenario up to a factor that all scenarios share.
        """
        total = self.scenario.log_prior(y)
        possible = np.isfinite(total)
        x, within = self.likelihood.path(self.scenario, y[possible])
        total[possible] = np.where(within, total[possible], -np.inf)
        if within.any():
            # As scipy's logsumexp, at a tenth of its time for so few points.
            terms = self.likelihood.terms(self.grid, x)
            total[np.isfinite(total)] += np.logaddexp.reduce(terms, axis=0)
        return total

    def weights(self, y: FloatArray) -> FloatArray:
        """Return the probability of each grid point, averaged over coordinates, ``(n_points,)``."""
        x, inside = self.likelihood.path(self.scenario, y[np.isfinite(self.scenario.log_prior(y))])
        if not inside.any():
            name = self.likelihood.data.stage.name
            raise NotEnoughData(f"{name}: no life of the prior stays inside the map")
        return np.asarray(softmax(self.likelihood.terms(self.grid, x), axis=0).mean(axis=1))

    def narrowed(self, y: FloatArray) -> LifeDensity:
        """Drop grid points that together have a hundredth of the posterior at coordinates."""
        weight = self.weights(y)
        order = np.argsort(weight)
        kept = np.ones(weight.size, dtype=bool)
        kept[order[np.cumsum(weight[order]) < _NEGLIGIBLE]] = False
        return replace(self, grid=self.grid[kept])

    def settings(self, y: FloatArray) -> FloatArray:
        """Return the means of walk, noise scale, deviation, and χ² at the mean of coordinates."""
        weight, grid = self.weights(y), self.grid
        centre = y.mean(axis=0, keepdims=True)
        possible = np.isfinite(self.scenario.log_prior(centre))
        x, inside = self.likelihood.path(self.scenario, centre[possible])
        if not inside.any():
            x, _ = self.likelihood.path(self.scenario, y[:1])
        chi_square = self.likelihood.quadratic(grid, x)[0][:, 0]
        return np.stack([grid.walk, grid.noise_scale, grid.deviation, chi_square]) @ weight

    def deviations(
        self, y: FloatArray, moments: FloatArray, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Draw the deviation of ln health from its laws at moments in m since the baseline.

        For coordinates ``(n, n_dim)`` inside the support: deviations of shape ``(n, n_moments,
        n_parameters)``, independent from moment to moment, and their variance per m of future
        travel ``(n, n_parameters)``.
        """
        free, now = self.likelihood.data.free, self.likelihood.data.now
        # Without coordinates all draws are of one life.
        one = y[:1] if not self.scenario.n_dim else y
        x, _ = self.likelihood.path(self.scenario, one)
        upto = np.cumsum(softmax(self.likelihood.terms(self.grid, x), axis=0), axis=0)
        point = (upto < rng.uniform(size=y.shape[0])).sum(axis=0).clip(max=upto.shape[0] - 1)
        off = np.zeros((y.shape[0], moments.size, free.size))
        for k in np.unique(point[self.grid.deviation[point] > 0]):
            own = point == k
            of = own if self.scenario.n_dim else slice(None)
            mean, cov = self.likelihood.deviation(self.grid, int(k), x[of], moments)
            # A variance of 0 may be rounded to below 0.
            least = 1e-15 * np.eye(cov.shape[-1])
            unit = rng.standard_normal((own.sum(), *mean.shape[1:], 1))
            off[own] = mean + (np.linalg.cholesky(cov + least) @ unit)[..., 0]
        return off * free, self.grid.deviation[point, None] ** 2 / now * free


@dataclass(frozen=True, slots=True, eq=False)
class ScenarioPosterior:
    """Posterior under one scenario."""

    density: LifeDensity
    probability: float  # posterior probability of the scenario
    evidence_std: float  # relative standard deviation of its evidence
    # Draws of the coordinates, ``(n_ensembles, n_draws, n_dim)``, with the checks of the chains;
    # after importance sampling the effective sample size, and NaN for R-hat.
    sample: Sample
    # Draws of each ensemble that represent this scenario in the mixture of all.
    n_mixture_draws: int

    @property
    def scenario(self) -> Scenario:
        """The scenario."""
        return self.density.scenario

    @property
    def chains(self) -> FloatArray:
        """Draws of the natural parameters (lengths in m), ``(n_ensembles, n_draws, n_dim)``."""
        natural = self.scenario.natural(np.concatenate(self.sample.draws))
        return natural.reshape(self.sample.draws.shape)

    @property
    def mixture_draws(self) -> FloatArray:
        """Coordinates in the mixture of all scenarios, ``(n_ensembles n_mixture_draws, n_dim)``."""
        return np.concatenate(thin(self.sample.draws, self.n_mixture_draws))


@dataclass(frozen=True, slots=True, eq=False)
class LifeStart(ReadOnly):
    """Draws of a posterior from which that with further logs is sampled.

    `points`, ``(n_scenarios, n_draws, n_dim)``, are coordinates of the scenarios called `names`,
    with zeros after the last coordinate of each.
    """

    names: tuple[str, ...]
    points: FloatArray

    def of(self, scenario: Scenario) -> FloatArray:
        """Return the draws of a scenario, ``(n_draws, n_dim)``; none of one that is new."""
        if scenario.name not in self.names:
            return np.empty((0, scenario.n_dim))
        return self.points[self.names.index(scenario.name), :, : scenario.n_dim]


@dataclass(frozen=True, slots=True, eq=False)
class LifePosterior:
    """Posterior of a life, a mixture over its scenarios."""

    stage: str  # identity of the machine
    parameters: tuple[str, ...]
    modes: tuple[str, ...]  # those that were used
    scenarios: tuple[ScenarioPosterior, ...]  # above the least probability, in descending order
    # Draws of the health parameters now, as fractions of baseline; deviation of ln health from its
    # law now; its variance per m of future travel. Those of the first scenario first, shape
    # ``(n_ensembles, n_draws, n_parameters)``.
    health: FloatArray
    off: FloatArray
    rate: FloatArray
    chi_square: float  # of the residuals at the posterior mean of each scenario, averaged
    degrees_of_freedom: int  # number of data minus parameters of the most probable scenario
    walk: float  # walk, noise_scale, deviation: as in `Prognosis`
    noise_scale: float
    deviation: float
    start: LifeStart  # of the next posterior
    seed: tuple[int, ...]

    def __post_init__(self) -> None:
        shape, p = self.health.shape, len(self.parameters)
        freeze(self, ("health off rate", *shape[:2], p))
        if sum(one.n_mixture_draws for one in self.scenarios) != shape[1]:
            raise ValueError("the draws of the scenarios do not add up to those of health")

    def by_scenario(self) -> Iterator[tuple[ScenarioPosterior, FloatArray, FloatArray]]:
        """Yield each scenario with `off` and `rate` of its draws, ``(n, n_parameters)``."""
        first = 0
        for one in self.scenarios:
            part = slice(first, first + one.n_mixture_draws)
            first = part.stop
            off, rate = (x[:, part].reshape(-1, x.shape[-1]) for x in (self.off, self.rate))
            yield one, off, rate

    def laws(self, parameter: str) -> dict[tuple[str, float], float]:
        """Return the probability of each law of a parameter by its kind and begin in m."""
        j, found = self.parameters.index(parameter), dict[tuple[str, float], float]()
        for one in self.scenarios:
            path = one.scenario.paths[j]
            key = (path.law.kind, path.begin)
            found[key] = found.get(key, 0.0) + one.probability
        return dict(sorted(found.items(), key=lambda item: -item[1]))

    @property
    def ess(self) -> float:
        """Smallest effective sample size of the scenarios that chains sample; infinite without any.

        After an update by importance sampling it is that of the weights.
        """
        least = constants.MIN_CHAIN_PROBABILITY
        by_chains = [one.sample for one in self.scenarios if one.probability >= least]
        sizes = [size for one in by_chains for size in (*one.ess_bulk, *one.ess_tail)]
        return float(min(sizes, default=np.inf))

    @property
    def worst_r_hat(self) -> float:
        """Largest R-hat of any scenario."""
        return float(np.nanmax([1.0, *(x for one in self.scenarios for x in one.sample.r_hat)]))

    def to_arviz(self) -> DataTree:
        """Return health now and the natural parameters of each scenario for ArviZ; see `Health`."""
        import arviz_base  # late: its import takes a second

        posterior = {name: self.health[..., j] for j, name in enumerate(self.parameters)}
        groups: dict[str, dict[str, FloatArray]] = {"posterior": posterior}
        scalars = ("chi_square", "degrees_of_freedom", "walk", "noise_scale", "deviation")
        checks = {name: np.array(getattr(self, name)) for name in scalars}
        for k, one in enumerate(self.scenarios, start=1):
            names, chains = self._names(one), one.chains
            if names:
                groups[f"way_{k}"] = {name: chains[..., i] for i, name in enumerate(names)}
            checks[f"probability_{k}"] = np.array(one.probability)
            for what in _CHECKS:
                values = zip(names, getattr(one.sample, what), strict=True)
                checks |= {f"{what}_{k}_{name}": value for name, value in values}
        attrs = {"/": {"stage": self.stage, "seed": " ".join(map(str, self.seed))}}
        return arviz_base.from_dict(groups | {"checks_data": checks}, attrs=attrs)

    def _names(self, one: ScenarioPosterior) -> list[str]:
        """Name natural parameters by health parameter, law, and begin if not at the baseline."""
        names = []
        for parameter, path in zip(self.parameters, one.scenario.paths, strict=True):
            since = f"@{path.begin / 1000:.0f}km" if path.begin else ""
            names += [f"{parameter}.{path.law.kind}{since}.{own}" for own in path.names]
        return names


def fit_life(
    history: History,
    stage: Stage,
    seed: int | Sequence[int],
    *,
    chains: bool = True,
    n_draws: int = 10_000,
    before: LifeStart | None = None,
) -> LifePosterior:
    """Fit the degradation laws of a stage to all logs since its baseline.

    Scenarios are weighted by their evidence; the probable ones are sampled, and their draws are
    mixed by probability.

    Parameters
    ----------
    history, stage : History, Stage
        Modal estimates of all logs; laws, priors, covariates and modal map.
    seed : int or sequence of int
        Seed of all random numbers.
    chains : bool
        Whether emcee samples the probable scenarios; otherwise importance sampling draws them (at
        least 400 effective draws of the most probable), in a fraction of the time.
    n_draws : int
        Draws of all ensembles, a multiple of 4.
    before : LifeStart, optional
        `start` of the posterior with fewer logs, which is updated by importance sampling. Where
        its weights fail, the life is fitted from nothing.

    Raises
    ------
    NotEnoughData
        If fewer than three logs since the baseline have an informative mode, the odometer is
        missing or has not moved, or the modes stepped more than three times.
    NotConverged
        If the sampler did not converge; carries the chains.

    Examples
    --------
    Health of a simulated machine now, and the laws by which it degraded:

    >>> import numpy as np
    >>> import lmshealth
    >>> from lmshealth import examples
    >>> stage = lmshealth.load_stage("lms-y")
    >>> life = lmshealth.fit_life(examples.history(), stage, seed=0, chains=False)
    >>> [path.law.kind for path in life.scenarios[0].scenario.paths]
    ['hertz-wear', 'loosening']
    >>> for name, median in zip(life.parameters, np.median(life.health, axis=(0, 1))):
    ...     print(f"{name}: {median:.0%}")
    guide_preload: 72%
    mount_stiffness: 87%
    """
    likelihood = LifeLikelihood.of(history, stage)
    n_kept = n_draws // _N_ENSEMBLES
    # Arrays are small: threads inside linear algebra would only wait for one another.
    with threadpool_limits(1, user_api="blas"):
        # Updates one after the other must not repeat their random numbers.
        steps = () if before is None else (len(history.logs),)
        *seeds, off_seed = stream(seed, _STEP, *steps).spawn(3)
        try:
            weighted, start = _weighted_scenarios(likelihood, seeds[0], before)
        except NotConverged:
            if before is None:
                raise
            return fit_life(history, stage, seed, chains=chains, n_draws=n_draws)
        chained = chains and before is None
        min_probability = constants.MIN_CHAIN_PROBABILITY if chained else np.inf
        scenarios = _sampled_scenarios(weighted, seeds[1], n_kept, min_probability)
    rng = np.random.default_rng(off_seed)
    now = np.array([likelihood.data.now])
    draws, settings = [], []
    for one in scenarios:
        y = one.mixture_draws
        own_off, own_rate = one.density.deviations(y, now, rng)
        by_law = one.scenario.health(one.scenario.natural(y), now)
        shape = (_N_ENSEMBLES, one.n_mixture_draws, own_off.shape[-1])
        parts = (by_law * np.exp(own_off), own_off, own_rate)
        draws.append([part.reshape(shape) for part in parts])
        settings.append(one.density.settings(y[:: max(1, y.shape[0] // _N_SETTINGS)]))
    health, off, rate = (np.concatenate(part, axis=1) for part in zip(*draws, strict=True))
    share = np.array([one.n_mixture_draws for one in scenarios]) / n_kept
    walk, noise_scale, deviation, chi_square = (float(v) for v in share @ np.array(settings))
    return LifePosterior(
        stage=history.stage,
        parameters=tuple(parameter.name for parameter in stage.parameters),
        modes=likelihood.data.modes,
        scenarios=scenarios,
        health=health,
        off=off,
        rate=rate,
        chi_square=chi_square,
        degrees_of_freedom=likelihood.data.y.size - scenarios[0].scenario.n_dim,
        walk=walk,
        noise_scale=noise_scale,
        deviation=deviation,
        start=start,
        seed=tuple(np.atleast_1d(seed).tolist()),
    )


_Explored = tuple[LifeDensity, WeightedDraws]


def _log_probability(found: _Explored) -> float:
    """Return the log posterior probability of a scenario up to a constant."""
    return float(np.log(found[0].scenario.weight) + found[1].log_evidence)


def _weighted_scenarios(
    likelihood: LifeLikelihood, seed: np.random.SeedSequence, before: LifeStart | None = None
) -> tuple[list[_Explored], LifeStart]:
    """Return weighted draws and evidences of the scenarios that a rough evidence does not drop.

    The start of the next posterior has draws of all scenarios: one that is dropped may return.
    `NotConverged` is raised where the weights of an update are unreliable: they are those of the
    posterior with all logs, so that errors of one update do not reach the next.
    """
    grid = likelihood.grid
    densities = [LifeDensity(likelihood, one, grid) for one in likelihood.data.scenarios]
    generators = [np.random.default_rng(own) for own in seed.spawn(len(densities))]
    rough = [_rough(one, rng, before) for one, rng in zip(densities, generators, strict=True)]
    n = _N_FINE if before is None else _N_UPDATE
    log_share = np.array([_log_probability(one) for one in rough])
    log_share -= log_share.max()
    likely = np.flatnonzero(log_share > -constants.MAX_LOG_ODDS).tolist()
    # Errors of a mixture are those of a single scenario if draws follow the root of the share.
    sizes = np.maximum(_N_ROUGH, n * np.exp(log_share / 2)).astype(int).tolist()
    drawn = [k for k in likely if densities[k].scenario.n_dim]
    explored = list(rough)
    for k in drawn:
        density, draws = rough[k]
        density = density.narrowed(draws.resampled(generators[k], _N_ROUGH // 3))
        draws = importance_sample_again(density.log_probability, draws, generators[k], sizes[k])
        explored[k] = density, draws
    largest = max(_log_probability(explored[k]) for k in likely)
    for k in drawn:
        density, draws = explored[k]
        share = float(np.exp(_log_probability(explored[k]) - largest))
        needed = max(_LEAST_ESS, MIN_ESS * np.sqrt(share))
        # Of an update too: one that is not reliable costs a fit from nothing.
        judged = before is not None and share >= constants.MIN_CHAIN_PROBABILITY
        if draws.ess < needed or (judged and draws.pareto_k >= MAX_PARETO_K):
            start = draws.resampled(generators[k], _N_ROUGH)
            how = start, generators[k], 3 * sizes[k], needed
            explored[k] = density, importance_sample_to_ess(density.log_probability, *how)
    found = [explored[k] for k in likely]
    shares = softmax([_log_probability(one) for one in found])
    for (density, draws), own in zip(found, shares, strict=True):
        judged = before is not None and own >= constants.MIN_CHAIN_PROBABILITY
        if judged and density.scenario.n_dim and not draws.pareto_k < MAX_PARETO_K:
            raise NotConverged(f"Pareto k of an update is {draws.pareto_k:.2f}", draws.points)
    widest = max(one.scenario.n_dim for one in densities)
    points = np.zeros((len(densities), _N_START, widest))
    for k, (density, draws) in enumerate(explored):
        points[k, :, : density.scenario.n_dim] = draws.resampled(generators[k], _N_START)
    next_start = LifeStart(tuple(one.scenario.name for one in densities), points)
    return found, next_start


def _rough(density: LifeDensity, rng: np.random.Generator, before: LifeStart | None) -> _Explored:
    """Return rough draws of a scenario; without coordinates they are exact."""
    if density.scenario.n_dim == 0:
        point = np.empty((1, 0))
        value = float(density.log_probability(point)[0])
        return density.narrowed(point), WeightedDraws(point, np.ones(1), value)
    start, earlier = density.scenario.draw(rng, _N_ROUGH), np.empty((0, 0))
    if before is not None:
        earlier = before.of(density.scenario)
    if earlier.shape[0]:
        density = density.narrowed(earlier[: _N_ROUGH // 6])
        # Draws of the prior stay among them, for a mode that the earlier logs did not show.
        start = np.concatenate([earlier, start[: _N_START // 4]])
    return density, importance_sample(density.log_probability, start, rng, _N_ROUGH)


def _sampled_scenarios(
    found: Sequence[_Explored],
    seed: np.random.SeedSequence,
    n_kept: int,
    min_chain_probability: float,
) -> tuple[ScenarioPosterior, ...]:
    """Sample the probable scenarios, and divide the draws of the mixture among them."""
    probability = softmax([_log_probability(one) for one in found])
    least = constants.MIN_PROBABILITY
    order = [k for k in np.argsort(-probability) if probability[k] >= least]
    kept = probability[order] / probability[order].sum()
    # Rounded so that they add up.
    shares = np.diff(np.round(np.cumsum(kept) * n_kept), prepend=0).astype(int)
    seeds = seed.spawn(len(found))
    sampled = []
    for k, share, own in zip(order, shares, kept, strict=True):
        density, weighted = found[k]
        n_dim = density.scenario.n_dim
        if n_dim and own >= min_chain_probability:
            start = start_among(weighted.points, weighted.weight)
            draws = sample(density.log_probability, start, seeds[k])
        else:
            y = weighted.resampled(np.random.default_rng(seeds[k]), _N_ENSEMBLES * n_kept)
            ess, unknown = np.full(n_dim, weighted.ess), np.full(n_dim, np.nan)
            draws = Sample(y.reshape(_N_ENSEMBLES, n_kept, n_dim), ess, ess, unknown)
        one = ScenarioPosterior(
            density=density,
            probability=float(own),
            evidence_std=float(np.sqrt(1 / weighted.ess)) if n_dim else 0.0,
            sample=replace(draws, draws=thin(draws.draws, n_kept)),
            n_mixture_draws=int(share),
        )
        sampled.append(one)
    return tuple(sampled)
