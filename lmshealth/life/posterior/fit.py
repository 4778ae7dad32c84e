"""Posterior of a life: probabilities of its scenarios, their laws' parameters, and nuisances."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from scipy.special import chdtrc, softmax

from lmshealth._private.arrays import FloatArray, freeze, one_thread
from lmshealth._private.serialize import stream
from lmshealth.errors import NotConverged
from lmshealth.life import constants
from lmshealth.life.posterior.data import LifeData
from lmshealth.life.posterior.exploration import Explored, LifeStart, explore, log_probability
from lmshealth.life.posterior.likelihood import (
    NO_MODE,
    LifeDensity,
    LifeLikelihood,
    Nuisances,
    ln_health,
    scatter_prior,
)
from lmshealth.life.posterior.sampling import Sample, sample, thin
from lmshealth.life.posterior.scenarios import Scenario
from lmshealth.stage.description import Stage
from lmshealth.tracking.history import History

if TYPE_CHECKING:
    from xarray import DataTree

_STEP, _CARRIED_STEP = 1 << 20, 1 << 22  # of the random streams
_N_SETTINGS, _N_LONE, _N_PRIOR = 500, 50, 2000
_N_KEPT = constants.N_DRAWS // constants.N_ENSEMBLES  # draws of each ensemble


@dataclass(frozen=True, slots=True, eq=False)
class ScenarioPosterior:
    """Posterior under one scenario."""

    density: LifeDensity
    probability: float  # posterior probability of the scenario
    evidence_std: float  # relative standard deviation of its evidence
    # Draws of the coordinates, ``(n_ensembles, n_draws, n_dim)``, with the checks of the chains;
    # after importance sampling the effective sample size, and NaN for R-hat.
    sample: Sample
    # Draws of each ensemble that represent this scenario in the mixture, and their nuisances.
    n_mixture_draws: int
    nuisances: Nuisances

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

    @property
    def some_draws(self) -> FloatArray:
        """About 500 of `mixture_draws`, for averages over their nuisances."""
        return self.mixture_draws[:: max(1, len(self.mixture_draws) // _N_SETTINGS)]

    def health_by_laws(self, moments: FloatArray) -> FloatArray:
        """Return health in the mixture at moments in m since the baseline, without deviations.

        Fractions of the baseline, ``(n_ensembles n_mixture_draws, n_moments, n_parameters)``.
        """
        return self.scenario.health(self.scenario.natural(self.mixture_draws), moments)


@dataclass(frozen=True, slots=True)
class LoneMode:
    """A mode that moved alone, by a cause that the map does not have.

    `size` and `std` are of the change of its ln f since the baseline beyond that by the map, if it
    is this mode, which has the probability.
    """

    mode: str
    size: float
    std: float
    probability: float


@dataclass(frozen=True, slots=True, eq=False)
class LifePosterior:
    """Posterior of a life, a mixture over its scenarios."""

    data: LifeData
    parameters: tuple[str, ...]
    scenarios: tuple[ScenarioPosterior, ...]  # above the least probability, in descending order
    # Draws of the health parameters now, as fractions of baseline; deviation of ln health from its
    # law now; its variance per m of future travel. Those of the first scenario first, shape
    # ``(n_ensembles, n_draws, n_parameters)``.
    health: FloatArray
    off: FloatArray
    rate: FloatArray
    lone: np.ndarray  # index of the mode that moves alone in each draw, or `NO_MODE`, ``(..., n)``
    lone_modes: tuple[LoneMode, ...]  # the most probable first
    chi_square: float  # of the residuals at the posterior mean of each scenario, averaged
    degrees_of_freedom: float  # data less all that they determine
    walk: float  # walk, noise_scale, deviation: as in `Prognosis`
    noise_scale: float
    deviation: float
    sampler: Literal["emcee", "importance"]  # that drew the probable scenarios
    # Change of the median of ln health now from importance sampling to emcee, in posterior standard
    # deviations, and ratio of the 90 % intervals, ``(n_parameters,)``; NaN without chains.
    judge_shift: FloatArray
    judge_ratio: FloatArray
    start: LifeStart  # of the next posterior
    seed: tuple[int, ...]
    # Draws of ln health at the baseline, shape of `health`, where lives before it have left some
    # loss: `health` and `off` contain it, so that fractions are of a baseline before these lives.
    carried: FloatArray | None = None

    def __post_init__(self) -> None:
        shape, p = self.health.shape, len(self.parameters)
        freeze(self, ("health off rate", *shape[:2], p), ("lone", *shape[:2]))

    def carrying(self, ln_health: FloatArray) -> LifePosterior:
        """Return the posterior of a life that begins with losses, of which there are draws.

        Their shape is ``(n, n_parameters)``. The errors of the map are common to all lives of a
        machine: the larger losses before are paired with the larger ones since.
        """
        rng, shape = np.random.default_rng(stream(self.seed, _CARRIED_STEP)), self.health.shape
        flat = self.health.reshape(-1, shape[-1])
        ranks = flat.argsort(axis=0).argsort(axis=0)
        draws = np.sort(rng.choice(ln_health, len(flat)), axis=0)
        carried = np.take_along_axis(draws, ranks, axis=0).reshape(shape)
        health = self.health * np.exp(carried)
        return replace(self, health=health, off=self.off + carried, carried=carried)

    @property
    def stage(self) -> str:
        """Identity of the machine."""
        return self.data.history.stage

    @property
    def modes(self) -> tuple[str, ...]:
        """Modes that were used."""
        return self.data.modes

    @property
    def fit(self) -> float:
        """Probability of a χ² above that of the residuals."""
        return float(chdtrc(self.degrees_of_freedom, self.chi_square))

    def by_scenario(self) -> Iterator[tuple[ScenarioPosterior, FloatArray, FloatArray]]:
        """Yield each scenario with `off` and `rate` of its draws, ``(n, n_parameters)``."""
        first = 0
        for one in self.scenarios:
            part = slice(first, first + one.n_mixture_draws)
            first = part.stop
            off, rate = (x[:, part].reshape(-1, x.shape[-1]) for x in (self.off, self.rate))
            yield one, off, rate

    def health_at(self, moments: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Draw health as fractions of baseline at moments in m since the baseline.

        In the order of `health`: ``(n_moments, n_ensembles, n_draws, n_parameters)``, with the
        scenario and the nuisances of each draw, and deviations independent from moment to moment.
        """
        parts = []
        for one in self.scenarios:
            off = one.density.deviations(one.mixture_draws, one.nuisances, moments, rng)
            health = one.health_by_laws(moments) * np.exp(off)
            shape = (self.health.shape[0], one.n_mixture_draws, *health.shape[1:])
            parts.append(health.reshape(shape))
        found = np.moveaxis(np.concatenate(parts, axis=1), 2, 0)
        return found if self.carried is None else found * np.exp(self.carried)

    def prior_at(self, moments: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Draw ln health at moments from the prior, ``(n_moments, n, n_parameters)``.

        Of lives that stay inside the map, with deviations from their laws.
        """
        data = self.data
        chances = scatter_prior(data.stage).deviation
        spread = np.average(np.square(constants.DEVIATION_STDS), weights=chances)
        scenarios = data.scenarios
        weights = np.array([one.weight for one in scenarios])
        sizes = np.ceil(_N_PRIOR * weights / weights.sum()).astype(int).tolist()
        parts = []
        for scenario, n in zip(scenarios, sizes, strict=True):
            x, inside = ln_health(data.stage, scenario, scenario.draw(rng, n), moments)
            parts.append(x[inside] - data.stage.baseline_point)
        x = np.moveaxis(np.concatenate(parts), 1, 0)
        share = np.sqrt(np.maximum(moments, 0.0) / data.now * spread)[:, None, None]
        x = np.asarray(x + share * data.free * rng.standard_normal(x.shape))
        if self.carried is None:
            return x
        return np.asarray(x + rng.choice(self.carried.reshape(-1, x.shape[-1]), x.shape[1]))

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
            for what in ("ess_bulk", "ess_tail", "r_hat"):
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


@one_thread
def fit_life(
    history: History,
    stage: Stage,
    seed: int | Sequence[int],
    *,
    chains: bool = True,
    before: LifeStart | None = None,
    min_logs: int = constants.MIN_LOGS,
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
    before : LifeStart, optional
        `start` of the posterior with fewer logs, from whose draws importance sampling begins. Where
        its weights fail, the life is fitted from nothing.
    min_logs : int
        Logs with an informative mode that are enough.

    Raises
    ------
    BadStage
        If the description has no health parameter.
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
    guide_preload: 71%
    mount_stiffness: 89%
    """
    likelihood = LifeLikelihood.of(history, stage, min_logs)
    # Updates one after the other must not repeat their random numbers.
    steps = () if before is None else (len(history.logs),)
    *seeds, off_seed = stream(seed, _STEP, *steps).spawn(3)
    try:
        update = before is not None and not chains
        weighted, start = explore(likelihood, seeds[0], before, update=update)
    except NotConverged:
        if before is None:
            raise
        return fit_life(history, stage, seed, chains=chains, min_logs=min_logs)
    scenarios = _sampled_scenarios(weighted, seeds[1], by_chains=False)
    judge, now = np.full((2, len(stage.parameters)), np.nan), np.array([likelihood.data.now])
    if chains:  # importance sampling is only compared with them
        drawn, scenarios = scenarios, _sampled_scenarios(weighted, seeds[1], by_chains=True)
        judge = _change(drawn, scenarios, now)
    rng = np.random.default_rng(off_seed)
    draws = [_drawn_now(one, now, rng) for one in scenarios]
    settings = [one.density.settings(one.some_draws) for one in scenarios]
    lone_modes = _lone_modes(likelihood, scenarios)
    health, off, rate, lone = (np.concatenate(part, axis=1) for part in zip(*draws, strict=True))
    share = np.array([one.n_mixture_draws for one in scenarios]) / _N_KEPT
    means = (float(value) for value in share @ np.array(settings))
    walk, noise_scale, deviation, chi_square, freedom = means
    return LifePosterior(
        data=likelihood.data,
        parameters=tuple(parameter.name for parameter in stage.parameters),
        scenarios=scenarios,
        health=health,
        off=off,
        rate=rate,
        lone=lone[..., 0].astype(int),
        lone_modes=lone_modes,
        chi_square=chi_square,
        degrees_of_freedom=freedom,
        walk=walk,
        noise_scale=noise_scale,
        deviation=deviation,
        sampler="emcee" if chains else "importance",
        judge_shift=judge[0],
        judge_ratio=judge[1],
        start=start,
        seed=tuple(np.atleast_1d(seed).tolist()),
    )


def _drawn_now(
    one: ScenarioPosterior, now: FloatArray, rng: np.random.Generator
) -> list[np.ndarray]:
    """Return health, off, rate and lone mode of the draws of a scenario, as `LifePosterior`."""
    density, (_, point) = one.density, one.nuisances
    off = density.deviations(one.mixture_draws, one.nuisances, now, rng)[:, 0]
    rate = density.grid.deviation[point, None] ** 2 / now * density.likelihood.data.free
    health = one.health_by_laws(now)[:, 0] * np.exp(off)
    columns = (health, off, rate, density.grid.lone[point, None])
    shape = (constants.N_ENSEMBLES, one.n_mixture_draws, -1)
    return [part.reshape(shape) for part in columns]


def _change(
    before: Sequence[ScenarioPosterior], after: Sequence[ScenarioPosterior], now: FloatArray
) -> FloatArray:
    """Return shift and ratio of ln health now, by the laws, as in `LifePosterior`, ``(2, p)``."""
    quantiles = []
    for scenarios in (before, after):
        with np.errstate(divide="ignore"):
            x = np.log(np.concatenate([one.health_by_laws(now)[:, 0] for one in scenarios]))
        quantiles.append(np.quantile(x, (0.05, 0.5, 0.95), axis=0))
    (low, middle, high), other = quantiles
    width = np.where(high > low, high - low, np.nan)
    # The width of a 90 % interval is 3.29 standard deviations.
    return np.array([(other[1] - middle) / width * 3.29, (other[2] - other[0]) / width])


def _lone_modes(
    likelihood: LifeLikelihood, scenarios: Sequence[ScenarioPosterior]
) -> tuple[LoneMode, ...]:
    """Return the modes that move alone in some draws, the most probable first."""
    data, sums = likelihood.data, np.zeros((len(likelihood.data.modes), 3))
    total = sum(one.nuisances[1].size for one in scenarios)
    for one in scenarios:
        grid = one.density.grid
        for own, map_scale, k, x in one.density.by_nuisances(one.mixture_draws, one.nuisances):
            if grid.lone[k] != NO_MODE:
                some = x[:: own.size // _N_LONE + 1]
                mean, variance = likelihood.lone_drift(grid, k, map_scale, some)
                moments = 1.0, mean.mean(), np.mean(variance + mean**2)
                sums[grid.lone[k]] += own.size / total * np.array(moments)
    found = []
    for mode, (share, first, second) in zip(data.modes, sums, strict=True):
        if share:
            size = first / share
            std = float(np.sqrt(max(second / share - size**2, 0.0)))
            found.append(LoneMode(mode, float(size), std, float(share)))
    return tuple(sorted(found, key=lambda one: -one.probability))


def _sampled_scenarios(
    found: Sequence[Explored], seed: np.random.SeedSequence, *, by_chains: bool
) -> tuple[ScenarioPosterior, ...]:
    """Sample the probable scenarios, and divide the draws of the mixture among them."""
    probability = softmax([log_probability(one) for one in found])
    least = constants.MIN_PROBABILITY
    order = [k for k in np.argsort(-probability) if probability[k] >= least]
    kept = probability[order] / probability[order].sum()
    # Rounded so that they add up.
    shares = np.diff(np.round(np.cumsum(kept) * _N_KEPT), prepend=0).astype(int)
    seeds = seed.spawn(len(found))
    sampled = []
    for k, share, own in zip(order, shares, kept, strict=True):
        density, weighted = found[k]
        n_dim = density.scenario.n_dim
        chain_seed, draw_seed = seeds[k].spawn(2)
        rng = np.random.default_rng(draw_seed)
        if by_chains and n_dim and own >= constants.MIN_CHAIN_PROBABILITY:
            draws = sample(density.log_probability, weighted, chain_seed)
        else:
            y = weighted.resampled(rng, constants.N_DRAWS)
            ess, unknown = np.full(n_dim, weighted.ess), np.full(n_dim, np.nan)
            draws = Sample(y.reshape(constants.N_ENSEMBLES, _N_KEPT, n_dim), ess, ess, unknown)
        kept_draws = thin(draws.draws, _N_KEPT)
        mixed = np.concatenate(thin(kept_draws, int(share)))
        one = ScenarioPosterior(
            density=density,
            probability=float(own),
            evidence_std=float(np.sqrt(1 / weighted.ess)) if n_dim else 0.0,
            sample=replace(draws, draws=kept_draws),
            n_mixture_draws=int(share),
            nuisances=density.draw_nuisances(mixed, rng),
        )
        sampled.append(one)
    return tuple(sampled)
