"""Evidences of the scenarios of a life, and weighted draws of them, by importance sampling."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lmshealth._private.arrays import FloatArray, ReadOnly
from lmshealth.errors import NotConverged
from lmshealth.life import constants
from lmshealth.life.posterior.likelihood import LifeDensity, LifeLikelihood, kept_weights
from lmshealth.life.posterior.sampling import (
    WeightedDraws,
    draw_to_ess,
    importance_sample,
    importance_sample_again,
)
from lmshealth.life.posterior.scenarios import DegradationPath, Scenario
from lmshealth.stage.degradation_laws import Free

_N_ROUGH, _N_FINE = 300, 2000
# Draws of an update, and those of each scenario that are kept for the next one.
_N_UPDATE, _N_START = 3000, 300
# Log odds from which a scenario is left out of updates, until chains sample the life again; and
# those that a scenario may gain over a more flexible one by being simpler.
_NO_RETURN, _SIMPLER = 13.0, 6.0
# Log odds beyond those of a dropped scenario at which no more is spent on one.
_HOPELESS = 6.0
# Effective draws below which an evidence may miss most of its integral.
_LEAST_ESS = 20.0


@dataclass(frozen=True, slots=True, eq=False)
class LifeStart(ReadOnly):
    """Draws of a posterior from which that with further logs is sampled.

    `points`, ``(n_scenarios, n_draws, n_dim)``, are coordinates of the scenarios called `names`,
    with zeros after the last coordinate of each; `log_share` are their log probabilities, relative
    to the largest, ``(n_scenarios,)``.
    """

    names: tuple[str, ...]
    points: FloatArray
    log_share: FloatArray

    def of(self, scenario: Scenario) -> FloatArray:
        """Return the draws of a scenario, ``(n_draws, n_dim)``; none of one that is new."""
        if scenario.name not in self.names:
            return np.empty((0, scenario.n_dim))
        return self.points[self.names.index(scenario.name), :, : scenario.n_dim]

    def excludes(self, scenario: Scenario) -> bool:
        """Return whether a scenario was too improbable to become probable by a log."""
        if scenario.name not in self.names:
            return False
        return bool(self.log_share[self.names.index(scenario.name)] < -_NO_RETURN)


Explored = tuple[LifeDensity, WeightedDraws]


def log_probability(found: Explored) -> float:
    """Return the log posterior probability of a scenario up to a constant."""
    return float(np.log(found[0].scenario.weight) + found[1].log_evidence)


class _Exploration:
    """Rough draws of scenarios, made one after the other from what is known by then.

    `known` are, of each parameter, draws of each path in the best scenario so far that has it: good
    ones to begin with, whatever the other parameters do.
    """

    def __init__(
        self, likelihood: LifeLikelihood, seed: np.random.SeedSequence, before: LifeStart | None
    ) -> None:
        self.likelihood, self.grid, self.before = likelihood, likelihood.grid, before
        self.scenarios = likelihood.data.scenarios
        seeds = seed.spawn(len(self.scenarios))
        self.generators = [np.random.default_rng(own) for own in seeds]
        self.found: dict[int, Explored] = {}
        self.known: list[dict[DegradationPath, tuple[float, FloatArray]]]
        self.known = [{} for _ in likelihood.data.stage.parameters]

    def add(self, which: Iterable[int]) -> None:
        """Draw from scenarios that have not been drawn from."""
        for k in which:
            if k not in self.found:
                self._draw(k)

    def _draw(self, k: int) -> None:
        scenario, rng = self.scenarios[k], self.generators[k]
        density = LifeDensity(self.likelihood, scenario, self.grid)
        if scenario.n_dim == 0:  # exact
            point = np.empty((1, 0))
            value = float(density.log_probability(point)[0])
            self.found[k] = density, WeightedDraws(point, np.ones(1), value)
            return
        start = self._start(scenario, rng)
        least = self.best() - constants.MAX_LOG_ODDS - _HOPELESS - float(np.log(scenario.weight))
        draws = importance_sample(density.log_probability, start, rng, _N_ROUGH, least)
        self.found[k] = density, draws
        value = log_probability(self.found[k])
        parts = scenario.split(draws.resampled(rng, _N_ROUGH))
        for own, path, part in zip(self.known, scenario.paths, parts, strict=True):
            if path not in own or own[path][0] < value:
                own[path] = value, part

    def _start(self, scenario: Scenario, rng: np.random.Generator) -> FloatArray:
        """Return points to begin with: draws of the prior, and others where there are any.

        These are draws of the posterior with fewer logs, else of the same paths elsewhere.
        """
        start, earlier = scenario.draw(rng, _N_ROUGH), np.empty((0, scenario.n_dim))
        if self.before is not None:
            earlier = self.before.of(scenario)
        pairs = list(zip(self.known, scenario.paths, strict=True))
        if earlier.shape[0]:
            # Draws of the prior stay among them, for a mode that the others did not show.
            start = start[: _N_START // 4]
        elif all(path in own or not path.names for own, path in pairs):
            empty = np.empty((_N_ROUGH, 0))
            parts = [own[path][1] if path in own else empty for own, path in pairs]
            known = np.hstack([rng.permutation(part) for part in parts])
            start = np.concatenate([known, start[: _N_START // 4]])
        if scenario.steps:
            start = self.likelihood.steps_given_laws(self.grid, scenario, start, rng)
        return np.concatenate([earlier, start])

    def narrow(self, anchors: Sequence[int]) -> None:
        """Leave out grid points that the anchors do without, as far as they are likely.

        They are drawn from with a few grid points first, which is enough to place their draws.
        """
        whole = self.grid
        least = (whole.noise_scale.min(), whole.deviation.min())
        self.grid = whole[(whole.noise_scale == least[0]) & (whole.deviation == least[1])]
        self.add(anchors)
        kept = np.zeros(whole.walk.size, dtype=bool)
        for k in self.likely():
            density, draws = self.found[k]
            some = draws.resampled(self.generators[k], _N_ROUGH // 2)
            weight = replace(density, grid=whole).weights(some)
            kept |= kept_weights(weight, constants.MAX_GRID_LOSS)
        self.grid = whole[kept]
        self.found.clear()
        self.add(anchors)

    def best(self) -> float:
        """Return the log probability of the most probable scenario, -inf without any."""
        return max(map(log_probability, self.found.values()), default=-np.inf)

    def likely(self) -> list[int]:
        """Return the scenarios that are not much less probable than the best, in order."""
        least = self.best() - constants.MAX_LOG_ODDS
        return sorted(k for k, one in self.found.items() if log_probability(one) > least)

    def may_be_likely(self, group: Sequence[int], anchors: Sequence[int]) -> bool:
        """Return whether a group of scenarios may have one that is not much less probable.

        None is expected to be much better than the most flexible one of its own, for their priors.
        """
        own = [self.found[k][1].log_evidence for k in anchors if k in group]
        if not own:
            return bool(group)
        weight = max(self.scenarios[k].weight for k in group)
        possible = max(own) + float(np.log(weight)) + _SIMPLER
        return possible > self.best() - constants.MAX_LOG_ODDS

    def refine(self, k: int, n: int) -> None:
        """Draw n times from a scenario again, with the grid points that it needs."""
        (density, draws), rng = self.found[k], self.generators[k]
        density = density.narrowed(draws.resampled(rng, _N_ROUGH // 3))
        draws = importance_sample_again(density.log_probability, draws, rng, n)
        self.found[k] = density, draws

    def ensure(self, k: int, n: int, min_ess: float, *, updated: bool) -> None:
        """Draw from a scenario again, more often, unless enough draws are effective.

        Of a probable one of an update the weights must be reliable too.
        """
        (density, draws), rng = self.found[k], self.generators[k]
        if updated and not draws.pareto_k < constants.MAX_PARETO_K:
            start = draws.resampled(rng, _N_ROUGH)
            draws = importance_sample(density.log_probability, start, rng, 3 * n)
        self.found[k] = density, draw_to_ess(density.log_probability, draws, rng, min_ess)

    def next_start(self) -> LifeStart:
        """Return draws of all scenarios, with those that an update has left out."""
        draws = {
            density.scenario.name: own.resampled(self.generators[k], _N_START)
            for k, (density, own) in self.found.items()
        }
        value = np.array([log_probability(one) for one in self.found.values()])
        share = dict(zip(draws, (value - value.max()).tolist(), strict=True))
        if self.before is not None:
            known = {one.name: one for one in self.scenarios}
            for name, own in zip(self.before.names, self.before.log_share.tolist(), strict=True):
                if name in known and name not in draws:
                    draws[name], share[name] = self.before.of(known[name]), own
        points = np.zeros((len(draws), _N_START, max(own.shape[1] for own in draws.values())))
        for row, own in zip(points, draws.values(), strict=True):
            row[:, : own.shape[1]] = own
        return LifeStart(tuple(draws), points, np.array(list(share.values())))


def explore(
    likelihood: LifeLikelihood,
    seed: np.random.SeedSequence,
    before: LifeStart | None = None,
    *,
    update: bool = False,
) -> tuple[list[Explored], LifeStart]:
    """Return weighted draws and evidences of the scenarios that a rough evidence does not drop.

    They begin with draws from before, if there are any; an update leaves out the scenarios that
    were improbable then.

    `NotConverged` is raised where the weights of an update are unreliable: they are those of the
    posterior with all logs, so that errors of one update do not reach the next.
    """
    all_ = _Exploration(likelihood, seed, before)
    scenarios = all_.scenarios
    # Grid points that the least and the most flexible scenarios do without, all do without.
    anchors = _anchors(scenarios)
    all_.narrow(anchors)
    excluded = before.excludes if update and before is not None else lambda _: False
    for with_steps in (False, True):
        group = [
            k
            for k, one in enumerate(scenarios)
            if bool(one.steps) == with_steps and not excluded(one)
        ]
        if all_.may_be_likely(group, anchors):
            all_.add(k for k in group if not scenarios[k].restarts)
            # A law may restart at a step where it may have gone on.
            going_on = {scenarios[k].name for k in all_.likely()}
            all_.add(k for k in group if scenarios[k].from_start() in going_on)
    likely = all_.likely()
    n = _N_UPDATE if update else _N_FINE
    log_share = np.array([log_probability(all_.found[k]) for k in likely])
    # Errors of a mixture are those of a single scenario if draws follow the root of the share.
    sizes = np.maximum(_N_ROUGH, n * np.exp((log_share - log_share.max()) / 2)).astype(int)
    drawn = [(k, int(m)) for k, m in zip(likely, sizes, strict=True) if scenarios[k].n_dim]
    for k, m in drawn:
        all_.refine(k, m)
    largest = max(log_probability(all_.found[k]) for k in likely)
    for k, m in drawn:
        share = float(np.exp(log_probability(all_.found[k]) - largest))
        updated = update and share >= constants.MIN_CHAIN_PROBABILITY
        min_ess = max(_LEAST_ESS, constants.MIN_ESS * float(np.sqrt(share)))
        all_.ensure(k, m, min_ess, updated=updated)
        draws = all_.found[k][1]
        if updated and not draws.pareto_k < constants.MAX_PARETO_K:
            raise NotConverged(f"Pareto k of an update is {draws.pareto_k:.2f}", draws.points)
    return [all_.found[k] for k in likely], all_.next_start()


def _anchors(scenarios: Sequence[Scenario]) -> list[int]:
    """Return the scenarios of the fewest coordinates, and the freest that begin at the baseline."""
    found = {min(range(len(scenarios)), key=lambda k: scenarios[k].n_dim)}
    for with_steps in (False, True):
        own = [
            k
            for k, one in enumerate(scenarios)
            if bool(one.steps) == with_steps and not one.restarts
        ]
        if own:
            free = (k for k in own if all(isinstance(p.law, Free) for p in scenarios[k].paths))
            found.add(next(free, max(own, key=lambda k: scenarios[k].n_dim)))
    return sorted(found)
