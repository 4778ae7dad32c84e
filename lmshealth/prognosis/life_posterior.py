"""The posterior of a whole life: which scenario it took, and by which parameters of its laws.

The posterior density of one scenario of a life, in its coordinates.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from scipy.special import softmax
from threadpoolctl import threadpool_limits

from lmshealth._arrays import BoolArray, FloatArray, expect_shape, freeze
from lmshealth.errors import NotEnoughData
from lmshealth.health.ensemble_sampling import Sample, sample, start_among, stream, thin
from lmshealth.health.importance_sampling import (
    WeightedDraws,
    importance_sample,
    importance_sample_to_ess,
)
from lmshealth.health.results import QUANTILES
from lmshealth.prognosis.life_likelihood import Grid, LifeLikelihood
from lmshealth.prognosis.scenarios import Scenario
from lmshealth.stage.description import Stage
from lmshealth.tracking.history import History

if TYPE_CHECKING:
    from xarray import DataTree

_NEGLIGIBLE = 0.01  # share of the posterior


@dataclass(frozen=True, slots=True, eq=False)
class LifeDensity:
    """Log posterior of the coordinates of one scenario.

    Attributes
    ----------
    life : LifeLikelihood
        The data.
    scenario : Scenario
        Laws, and their priors.
    grid : Grid
        Points of walk, noise scale and deviation to average over.
    """

    life: LifeLikelihood
    scenario: Scenario
    grid: Grid

    @classmethod
    def of(cls, life: LifeLikelihood, scenario: Scenario) -> LifeDensity:
        """Give the density of a scenario over the whole grid."""
        return cls(life, scenario, life.grid)

    def draw_prior(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Draw coordinates from the prior, shape ``(n, n_dim)``."""
        return self.scenario.draw(rng, n)

    def log_probability(self, y: FloatArray) -> FloatArray:
        """Log posterior, not normalised; -inf where a life leaves the map, shape ``(n,)``.

        Its integral is the evidence of the scenario, up to a factor that all scenarios share.
        """
        total = self.scenario.log_prior(y)
        x, inside = self._path(y, np.isfinite(total))
        total = np.where(inside, total, -np.inf)
        if inside.any():
            # As scipy's logsumexp, at a tenth of its time for so few points.
            total[inside] += np.logaddexp.reduce(self.life.terms(self.grid, x), axis=0)
        return total

    def narrowed(self, y: FloatArray) -> LifeDensity:
        """Drop grid points that together carry a hundredth of the posterior at coordinates."""
        weight = self.weights(y)
        order = np.argsort(weight)
        kept = np.ones(weight.size, dtype=bool)
        kept[order[np.cumsum(weight[order]) < _NEGLIGIBLE]] = False
        return replace(self, grid=self.grid.chosen(kept))

    def settings(self, y: FloatArray) -> tuple[float, float, float, float]:
        """Averaged walk, noise scale and deviation, and χ² at the mean of coordinates.

        Parameters
        ----------
        y : ndarray
            Coordinates inside the support, shape ``(n, n_dim)``.
        """
        weight, grid = self.weights(y), self.grid
        centre = y.mean(axis=0, keepdims=True)
        x, inside = self._path(centre, np.isfinite(self.scenario.log_prior(centre)))
        if not inside.all():
            x, _ = self._path(y[:1], np.array([True]))
        chi_square = self.life.quadratic(grid, x)[0][:, 0]
        means = [weight @ part for part in (grid.walk, grid.noise_scale, grid.deviation)]
        return float(means[0]), float(means[1]), float(means[2]), float(weight @ chi_square)

    def deviations(
        self, y: FloatArray, moments: FloatArray, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Draw how far ln health is off its laws.

        Parameters
        ----------
        y : ndarray
            Coordinates inside the support, shape ``(n, n_dim)``.
        moments : ndarray
            Travel in m since the baseline, past or future, shape ``(n_moments,)``.
        rng : Generator
            Of all randomness.

        Returns
        -------
        off : ndarray
            Independent from moment to moment, shape ``(n, n_moments, n_parameters)``.
        rate : ndarray
            Variance that is added per m of travel to come, shape ``(n, n_parameters)``.
        """
        # Without coordinates all draws are of one life.
        one = y[:1] if not self.scenario.n_dim else y
        x, _ = self._path(one, np.full(one.shape[0], True))
        upto = np.cumsum(softmax(self.life.terms(self.grid, x), axis=0), axis=0)
        point = (upto < rng.uniform(size=y.shape[0])).sum(axis=0).clip(max=upto.shape[0] - 1)
        off = np.zeros((y.shape[0], moments.size, len(self.scenario.paths)))
        for k in np.unique(point[self.grid.deviation[point] > 0]):
            own = point == k
            of = own if self.scenario.n_dim else slice(None)
            mean, cov = self.life.deviation(self.grid, int(k), x[of], moments)
            # What the data or the baseline leave nothing of is rounding.
            least = 1e-15 * np.eye(cov.shape[-1])
            unit = rng.standard_normal((own.sum(), *mean.shape[1:], 1))
            off[own] = mean + (np.linalg.cholesky(cov + least) @ unit)[..., 0]
        rate = self.grid.deviation[point, None] ** 2 / self.life.horizon
        return off * self.life.free, rate * self.life.free

    def weights(self, y: FloatArray) -> FloatArray:
        """Probability of each point of the grid, averaged over coordinates, ``(n_grid,)``."""
        x, inside = self._path(y, np.isfinite(self.scenario.log_prior(y)))
        if not inside.any():
            name = self.life.stage.name
            raise NotEnoughData(f"{name}: no life of the prior stays inside the map")
        return np.asarray(softmax(self.life.terms(self.grid, x), axis=0).mean(axis=1))

    def _path(self, y: FloatArray, possible: BoolArray) -> tuple[FloatArray, BoolArray]:
        """Ln parameters at the nodes of the lives that stay inside the map, and which these are."""
        inside = possible.copy()
        x, within = self.life.ln_health(self.scenario, y[possible], self.life.checked)
        inside[possible] = within
        return x[within, : self.life.nodes.size], inside


_STEP = 1 << 20  # far from the epochs that health counts its streams by
_N_ENSEMBLES, _N_PRIOR, _N_SETTINGS = 4, 10_000, 500
_N_ROUGH, _N_FINE = 600, 2000
# A scenario less probable than the first is told of no more, and one less probable than the second
# is drawn by importance sampling alone: chains of it would not change what all draws say.
_LEAST_PROBABILITY, _WORTH_CHAINS = 0.01, 0.1
# In ln: what a first look finds so much less probable than the best is looked at no closer.
_HOPELESS = 9.0
_ENDS = (0.05, 0.95)


@dataclass(frozen=True, slots=True, eq=False)
class ScenarioPosterior:
    """Posterior under one scenario.

    Attributes
    ----------
    density : LifeDensity
        Of its coordinates.
    probability : float
        That the life took this scenario.
    evidence_std : float
        Relative standard deviation of its evidence, from which the probability is.
    coordinates : ndarray
        Draws, shape ``(n_ensembles, n_draws, n_dim)``.
    ess_bulk, ess_tail, r_hat : ndarray
        As in `Health`, of the coordinates; of draws by importance sampling their effective number,
        and no R-hat (NaN); shape ``(n_dim,)``.
    informed : ndarray
        One minus the squared ratio of posterior to prior width of the 90 % interval of each natural
        parameter, floored at 0, shape ``(n_dim,)``.
    n_mixture : int
        So many draws of each ensemble stand for this scenario among those of all.
    """

    density: LifeDensity
    probability: float
    evidence_std: float
    coordinates: FloatArray
    ess_bulk: FloatArray
    ess_tail: FloatArray
    r_hat: FloatArray
    informed: FloatArray
    n_mixture: int

    def __post_init__(self) -> None:
        n = self.scenario.n_dim
        expect_shape("coordinates", self.coordinates, (*self.coordinates.shape[:2], n))
        for name in ("ess_bulk", "ess_tail", "r_hat", "informed"):
            expect_shape(name, getattr(self, name), (n,))
        freeze(self)

    @property
    def scenario(self) -> Scenario:
        """What each health parameter does."""
        return self.density.scenario

    @property
    def chains(self) -> FloatArray:
        """Draws of the natural parameters, ``(n_ensembles, n_draws, n_dim)``; lengths are in m."""
        n, own = self.coordinates.shape[:2], self.scenario.n_dim
        flat = self.coordinates.reshape(n[0] * n[1], own)
        return self.scenario.natural(flat).reshape(self.coordinates.shape)

    @property
    def mixture_draws(self) -> FloatArray:
        """Coordinates that stand among those of all scenarios, ``(n_ensembles share, n_dim)``."""
        kept = thin(self.coordinates, self.n_mixture)
        return kept.reshape(kept.shape[0] * kept.shape[1], self.scenario.n_dim)


@dataclass(frozen=True, slots=True, eq=False)
class LifePosterior:
    """Posterior of a life, averaged over its scenarios.

    Attributes
    ----------
    stage : str
        Identity of the machine.
    parameters : tuple of str
        Health parameters.
    modes : tuple of str
        Modes that it rests on.
    scenarios : tuple of ScenarioPosterior
        Courses worth telling, the most probable first.
    health : ndarray
        Health parameters now, as fractions of the baseline value: those of the first way, then of
        the second, shape ``(n_ensembles, n_draws, n_parameters)``.
    off : ndarray
        Ln of health over its law now, like `health`.
    rate : ndarray
        Variance of ln health about its law that every m of travel to come adds, like `health`.
    correlation : ndarray
        Of the logarithms of health now, shape ``(n_parameters, n_parameters)``; NaN where a
        parameter never changes.
    chi_square : float
        Of the residuals at the posterior mean of each scenario, averaged.
    degrees_of_freedom : int
        Data minus parameters of the most probable scenario.
    walk, noise_scale, deviation : float
        As in `Prognosis`.
    seed : tuple of int
        The same one gives the same chains.
    """

    stage: str
    parameters: tuple[str, ...]
    modes: tuple[str, ...]
    scenarios: tuple[ScenarioPosterior, ...]
    health: FloatArray
    off: FloatArray
    rate: FloatArray
    correlation: FloatArray
    chi_square: float
    degrees_of_freedom: int
    walk: float
    noise_scale: float
    deviation: float
    seed: tuple[int, ...]

    def __post_init__(self) -> None:
        shape, p = self.health.shape, len(self.parameters)
        expect_shape("health", self.health, (*shape[:2], p))
        expect_shape("off", self.off, shape)
        expect_shape("rate", self.rate, shape)
        expect_shape("correlation", self.correlation, (p, p))
        if sum(way.n_mixture for way in self.scenarios) != shape[1]:
            raise ValueError("the ways do not share the draws among them")
        freeze(self)

    def by_scenario(self) -> Iterator[tuple[ScenarioPosterior, FloatArray, FloatArray]]:
        """Yield each way with what `off` and `rate` its own draws have."""
        first = 0
        for way in self.scenarios:
            part = slice(first, first + way.n_mixture)
            first = part.stop
            off, rate = (x[:, part].reshape(-1, x.shape[-1]) for x in (self.off, self.rate))
            yield way, off, rate

    def laws(self, parameter: str) -> dict[tuple[str, float], float]:
        """Probability of each law of a parameter, by its kind and the travel it begins at."""
        j, found = self.parameters.index(parameter), dict[tuple[str, float], float]()
        for way in self.scenarios:
            path = way.scenario.paths[j]
            key = (path.law.kind, path.begin)
            found[key] = found.get(key, 0.0) + way.probability
        return dict(sorted(found.items(), key=lambda item: -item[1]))

    @property
    def ess(self) -> float:
        """The smallest effective sample size of chains; infinite where there are none."""
        chains = [way for way in self.scenarios if np.isfinite(way.r_hat).all()]
        found = [value for way in chains for value in (*way.ess_bulk, *way.ess_tail)]
        return float(np.min(found, initial=np.inf))

    @property
    def worst_r_hat(self) -> float:
        """The largest R-hat of any way."""
        found = [value for way in self.scenarios for value in way.r_hat if np.isfinite(value)]
        return float(np.max(found, initial=1.0))

    def to_frame(self) -> pd.DataFrame:
        """Make a table: health now, then the natural parameters of each way."""
        rows = [
            {"way": 0, "probability": 1.0, "parameter": name} | _quantiles(self.health[..., j])
            for j, name in enumerate(self.parameters)
        ]
        for k, way in enumerate(self.scenarios):
            chains = way.chains
            for i, name in enumerate(self._names(way)):
                checks = ("ess_bulk", "ess_tail", "r_hat", "informed")
                rows.append(
                    {"way": k + 1, "probability": way.probability, "parameter": name}
                    | _quantiles(chains[..., i])
                    | {check: getattr(way, check)[i] for check in checks}
                )
        return pd.DataFrame(rows).assign(stage=self.stage)

    def to_arviz(self) -> DataTree:
        """Give health now, and the natural parameters of each way, to ArviZ; see `Health`."""
        import arviz_base  # late: it takes a second to import

        groups: dict[str, dict[str, FloatArray]] = {
            "posterior": {name: self.health[..., j] for j, name in enumerate(self.parameters)}
        }
        checks = {
            name: np.array(getattr(self, name))
            for name in ("chi_square", "degrees_of_freedom", "walk", "noise_scale", "deviation")
        }
        for k, way in enumerate(self.scenarios):
            names, chains = self._names(way), way.chains
            groups[f"way_{k + 1}"] = {name: chains[..., i] for i, name in enumerate(names)}
            checks[f"probability_{k + 1}"] = np.array(way.probability)
            for what in ("ess_bulk", "ess_tail", "r_hat", "informed"):
                values = zip(names, getattr(way, what), strict=True)
                checks |= {f"{what}_{k + 1}_{name}": value for name, value in values}
        groups["checks_data"] = checks
        return arviz_base.from_dict(
            {name: group for name, group in groups.items() if group},
            attrs={"/": {"stage": self.stage, "seed": " ".join(map(str, self.seed))}},
        )

    def _names(self, way: ScenarioPosterior) -> list[str]:
        """Name natural parameters by health parameter, law, and where it begins if not at first."""
        names = []
        for parameter, path in zip(self.parameters, way.scenario.paths, strict=True):
            since = f"@{path.begin / 1000:.0f}km" if path.begin else ""
            names += [f"{parameter}.{path.law.kind}{since}.{own}" for own in path.names]
        return names


def _quantiles(draws: FloatArray) -> dict[str, float]:
    return {name: float(np.quantile(draws, level)) for name, level in QUANTILES.items()}


def fit_life(
    history: History,
    stage: Stage,
    seed: int | Sequence[int],
    *,
    chains: bool = True,
    n_draws: int = 10_000,
) -> LifePosterior:
    """Fit the degradation laws of a stage to all logs since its baseline.

    Every scenario that the laws and the steps allow is weighed by its evidence; those that are
    probable are sampled, and their draws stand together by their probabilities.

    Parameters
    ----------
    history : History
        Modal estimates of all logs.
    stage : Stage
        Laws, priors, covariates and modal map.
    seed : int or sequence of int
        Of all randomness.
    chains : bool
        Whether emcee samples the probable scenarios; otherwise importance sampling draws them (at
        least 400 effective draws), in a fraction of the time.
    n_draws : int
        Of all ensembles, a multiple of 4.

    Raises
    ------
    NotEnoughData
        If fewer than three logs hold an informative mode, the odometer has not moved, or the modes
        jumped too often.
    NotConverged
        If the sampler did not converge; carries the chains.

    Examples
    --------
    What a simulated machine has left, and by which laws it lost the rest:

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
    likelihood = LifeLikelihood(history, stage)
    explore_seed, chain_seed, off_seed = stream(seed, _STEP).spawn(3)
    n_kept = n_draws // _N_ENSEMBLES
    # Arrays are small: threads inside linear algebra would only wait for one another.
    with threadpool_limits(1, user_api="blas"):
        found = _explored(likelihood, explore_seed)
        ways = _ways(found, chain_seed, n_kept, _WORTH_CHAINS if chains else np.inf)
    rng = np.random.default_rng(off_seed)
    now = np.array([likelihood.now])
    health, off, rate, settings = [], [], [], []
    for way in ways:
        y = way.mixture_draws
        own_off, own_rate = way.density.deviations(y, now, rng)
        by_law = way.scenario.health(way.scenario.natural(y), now)
        shape = (_N_ENSEMBLES, way.n_mixture, own_off.shape[-1])
        health.append((by_law * np.exp(own_off)).reshape(shape))
        off.append(own_off.reshape(shape))
        rate.append(own_rate.reshape(shape))
        settings.append(way.density.settings(y[:: max(1, y.shape[0] // _N_SETTINGS)]))
    both = np.concatenate(health, axis=1)
    with np.errstate(invalid="ignore"):  # health that never changes has no correlation
        flat = np.log(both.reshape(-1, both.shape[-1]))
        correlation = np.atleast_2d(np.corrcoef(flat, rowvar=False))
    share = np.array([way.n_mixture for way in ways]) / n_kept
    walk, noise_scale, deviation, chi_square = (float(v) for v in share @ np.array(settings))
    return LifePosterior(
        stage=history.stage,
        parameters=tuple(parameter.name for parameter in stage.parameters),
        modes=likelihood.modes,
        scenarios=ways,
        health=both,
        off=np.concatenate(off, axis=1),
        rate=np.concatenate(rate, axis=1),
        correlation=correlation,
        chi_square=chi_square,
        degrees_of_freedom=likelihood.y.size - ways[0].scenario.n_dim,
        walk=walk,
        noise_scale=noise_scale,
        deviation=deviation,
        seed=tuple(np.atleast_1d(seed).tolist()),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """What importance sampling finds under one scenario."""

    density: LifeDensity
    draws: WeightedDraws

    @property
    def value(self) -> float:
        """Log of the probability of the scenario, up to a constant."""
        return float(np.log(self.density.scenario.weight) + self.draws.log_evidence)


def _explored(likelihood: LifeLikelihood, seed: np.random.SeedSequence) -> list[_Look]:
    """Find the posteriors and evidences of all scenarios that may be worth it."""
    densities = [LifeDensity.of(likelihood, scenario) for scenario in likelihood.scenarios]
    generators = [np.random.default_rng(own) for own in seed.spawn(len(densities))]
    looks = [_rough(one, rng) for one, rng in zip(densities, generators, strict=True)]
    best = max(look.value for look in looks)
    return [
        _fine(look, rng) if look.density.scenario.n_dim else look
        for look, rng in zip(looks, generators, strict=True)
        if look.value > best - _HOPELESS
    ]


def _rough(density: LifeDensity, rng: np.random.Generator) -> _Look:
    """Look at a scenario; where it has no coordinates this is exact."""
    if density.scenario.n_dim == 0:
        point = np.empty((1, 0))
        value = float(density.log_probability(point)[0])
        return _Look(density.narrowed(point), WeightedDraws(point, np.ones(1), value))
    start = density.draw_prior(rng, _N_ROUGH)
    return _Look(density, importance_sample(density.log_probability, start, rng, _N_ROUGH))


def _fine(look: _Look, rng: np.random.Generator) -> _Look:
    """Look closely, with what walk, noise and deviation the data leave."""
    start = look.draws.resampled(rng, _N_ROUGH)
    density = look.density.narrowed(start[: _N_ROUGH // 3])
    return _Look(density, importance_sample_to_ess(density.log_probability, start, rng, _N_FINE))


def _ways(
    found: Sequence[_Look], seed: np.random.SeedSequence, n_kept: int, worth_chains: float
) -> tuple[ScenarioPosterior, ...]:
    """Sample the scenarios that are probable, and share the draws among them."""
    probability = softmax([look.value for look in found])
    order = [k for k in np.argsort(-probability) if probability[k] >= _LEAST_PROBABILITY]
    kept = probability[order] / probability[order].sum()
    # Rounded so that they add up.
    shares = np.diff(np.round(np.cumsum(kept) * n_kept), prepend=0).astype(int)
    seeds = seed.spawn(len(found))
    ways = []
    for k, share, own in zip(order, shares, kept, strict=True):
        density, weighted = found[k].density, found[k].draws
        draws = _drawn(density, weighted, seeds[k], n_kept, chains=own >= worth_chains)
        ways.append(
            ScenarioPosterior(
                density=density,
                probability=float(own),
                evidence_std=float(np.sqrt(1 / weighted.ess)) if density.scenario.n_dim else 0.0,
                coordinates=draws.thinned(n_kept),
                ess_bulk=draws.ess_bulk,
                ess_tail=draws.ess_tail,
                r_hat=draws.r_hat,
                informed=_informed(density.scenario, draws.thinned(n_kept)),
                n_mixture=int(share),
            )
        )
    return tuple(ways)


def _drawn(
    density: LifeDensity,
    weighted: WeightedDraws,
    seed: np.random.SeedSequence,
    n_kept: int,
    *,
    chains: bool,
) -> Sample:
    """Draw coordinates from the posterior of a scenario."""
    n_dim = density.scenario.n_dim
    if n_dim and chains:
        start = start_among(weighted.points, weighted.weight)
        return sample(density.log_probability, start, seed)
    draws = weighted.resampled(np.random.default_rng(seed), _N_ENSEMBLES * n_kept)
    worth, unknown = np.full(n_dim, weighted.ess), np.full(n_dim, np.nan)
    return Sample(draws.reshape(_N_ENSEMBLES, n_kept, n_dim), worth, worth, unknown, unknown)


def _informed(scenario: Scenario, y: FloatArray) -> FloatArray:
    if not scenario.n_dim:
        return np.empty(0)
    prior = scenario.natural(scenario.draw(np.random.default_rng(0), _N_PRIOR))
    theta = scenario.natural(y.reshape(-1, scenario.n_dim))
    before, after = (np.ptp(np.quantile(x, _ENDS, axis=0), axis=0) for x in (prior, theta))
    return np.asarray(np.clip(1 - (after / before) ** 2, 0, 1))
