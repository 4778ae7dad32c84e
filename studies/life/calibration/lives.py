"""Whole lives drawn from the estimator's own model, with all that is unknown to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lmshealth.life import constants
from lmshealth.life.posterior.likelihood import NO_MODE, lone_kernel, scatter_prior
from lmshealth.life.posterior.scenarios import DegradationPath, list_scenarios
from lmshealth.life.prognosis import early_life, rate_std
from lmshealth.stage.description import Stage
from lmshealth.tracking.constants import BIAS_STD, JUMP_STD
from lmshealth.tracking.covariates import regressors
from lmshealth.tracking.history import History, Series, Step
from studies.harness.data.histories import make_history, map_std

Array = NDArray[np.float64]
N_LOGS = 60
# Odometer now since the baseline in km: median, and standard deviation of its logarithm.
NOW_KM = 2000.0, 0.7


# Lives of which the tracker reports a step, and how far ahead in m a life is followed step by step.
STEPS, FINE = 0.3, 2000.0


@dataclass(frozen=True)
class Part:
    """What really becomes of a health parameter."""

    path: DegradationPath  # Of the scenario: its law, and where that and the steps begin
    theta: Array  # Natural parameters of the path, lengths in m
    off: Array  # Ln of health over its path at each log, shape ``(n_logs,)``
    rate: float  # Variance of it per m

    @property
    def changes(self) -> bool:
        """Whether a law with parameters holds."""
        return bool(self.path.law.names)

    def by_law(self, travel: Array) -> Array:
        """Health by the law and the steps alone, at travels since the baseline."""
        return self.path.health(self.theta[None], travel)[0]

    def left(self, rng: np.random.Generator, now: float, limit: float, horizon: float) -> float:
        """Follow the parameter from now on until its limit, in m; inf past the horizon."""
        left = self._left_by_law(rng, now, limit, horizon)
        if left <= 0 or not self.changes:
            return left
        if left <= horizon:
            law = self.path.law
            left *= rng.lognormal(0.0, rate_std(law) * np.sqrt(np.log2(1 + left / now)))
        proven = now + early_life(self.path.law, limit, rng)
        hazard = rng.gamma(constants.UNSEEN_ONSETS) / proven
        onset = rng.exponential() / hazard if hazard > 0 else np.inf
        growth = constants.UNSEEN_GROWTH
        end = onset + (proven + onset) * rng.lognormal(np.log(growth.median), growth.sigma)
        return min(left, float(end))

    def _left_by_law(
        self, rng: np.random.Generator, now: float, limit: float, horizon: float
    ) -> float:
        """Follow the parameter by its law and its deviation alone."""
        start = limit * np.exp(-self.off[-1])
        closed = float(self.path.passage(self.theta[None], start)[0]) - now
        # A parameter that gains may have been below the limit before.
        if closed <= 0 and self.by_law(np.array([now]))[0] > start:
            return np.inf
        if self.rate == 0 or closed <= 0:
            return closed if closed <= horizon else np.inf
        ahead = np.arange(0.0, horizon, FINE)
        walk = np.cumsum(np.sqrt(self.rate * FINE) * rng.standard_normal(ahead.size - 1))
        with np.errstate(divide="ignore"):
            health = np.log(self.by_law(now + ahead[1:])) + self.off[-1] + walk
        below = np.flatnonzero(health <= np.log(limit))
        return float(ahead[1 + below[0]]) if below.size else np.inf


@dataclass(frozen=True)
class Life:
    """A history, and what is true of it: a part for every health parameter."""

    history: History
    parts: tuple[Part, ...]
    lone: int  # Index of the mode that moves alone, or `NO_MODE`

    @property
    def now(self) -> float:
        """Travel since the baseline in m."""
        return float(np.ptp(self.history.travel))


def draw(rng: np.random.Generator, machine: Stage) -> Life:
    """Draw a life of 60 logs, in which roll and pitch are seen.

    In half of the lives a second source sees pitch. A twentieth of estimates and temperatures is
    missing; now and then the servo is retuned, the sensor of the second source is changed, or the
    tracker reports a step, which is true as often as the estimator's prior has it.
    """
    names = machine.informative[:2]
    travel = _travel(rng)
    clock = travel - travel[0]
    first = int(rng.integers(5, N_LOGS - 5)) if rng.random() < STEPS else None
    parts = _parts(rng, machine, clock, first)
    series = tuple(Series(name, "acc") for name in names)
    if rng.random() < 0.5:
        series = (*series, Series("pitch", "delta_e"))
    covariates, steps = _covariates(rng), _steps(rng, series)
    if first is not None:
        steps = tuple(sorted([*steps, Step.found("step", first, N_LOGS)], key=lambda s: s.first))
    level, lone = _modes(rng, machine, names, clock, _path(machine, clock, parts))
    level += _covariate_effects(rng, machine, covariates, len(names))
    mode = np.array([names.index(one.mode) for one in series])
    values = level[:, mode] + _offsets(rng, series, mode, steps)
    cov = _covariance(rng, mode)
    scale = rng.choice(constants.NOISE_SCALES, p=shares(machine, "noise_scale"))
    noise = np.linalg.cholesky(cov) @ rng.standard_normal((N_LOGS, mode.size, 1))
    r = len(series)
    both = np.zeros((N_LOGS, 2 * r, 2 * r))
    both[:, :r, :r], both[:, r:, r:] = cov, 0.05**2 * np.eye(r)
    estimates = values + scale * noise[..., 0], np.full((N_LOGS, r), np.log(0.015)), both
    missing = rng.random((N_LOGS, r)) < 0.05
    history = make_history(
        names, travel, estimates, series=series, covariates=covariates, steps=steps, missing=missing
    )
    return Life(history, parts, lone)


def _travel(rng: np.random.Generator) -> Array:
    """Draw the odometer in m: that of now does not depend on the life."""
    now = 1000 * NOW_KM[0] * np.exp(NOW_KM[1] * rng.standard_normal())
    return np.asarray(1e5 + now * np.r_[0.0, np.sort(rng.uniform(size=N_LOGS - 2)), 1.0])


def _parts(
    rng: np.random.Generator, machine: Stage, clock: Array, first: int | None
) -> tuple[Part, ...]:
    """Draw scenarios and deviations from their priors, until a life stays inside the map."""
    assert machine.modal_map is not None
    steps = () if first is None else (float(clock[first - 1 : first + 1].mean()),)
    now, free = float(clock[-1]), machine.description.life.free
    scenarios = list_scenarios(machine.parameters, steps, now, free)
    weights = np.array([one.weight for one in scenarios])
    while True:
        scenario = scenarios[rng.choice(weights.size, p=weights / weights.sum())]
        theta = scenario.split(scenario.natural(scenario.draw(rng, 1))[0])
        pairs = zip(scenario.paths, theta, strict=True)
        deviation = rng.choice(constants.DEVIATION_STDS, p=shares(machine, "deviation"))
        parts = tuple(part_of(rng, path, own, float(deviation), clock) for path, own in pairs)
        with np.errstate(divide="ignore"):
            if machine.modal_map.inside(np.log(_path(machine, clock, parts))).all():
                return parts


def part_of(
    rng: np.random.Generator, path: DegradationPath, theta: Array, deviation: float, clock: Array
) -> Part:
    """Draw how health wanders about a path, with a standard deviation by the last log."""
    rate = deviation**2 / float(clock[-1])
    steps = np.sqrt(rate * np.diff(clock, prepend=0.0)) * rng.standard_normal(clock.size)
    return Part(path, theta, np.cumsum(steps), rate)


def shares(stage: Stage, field: str) -> Array:
    """Return the prior of the walk, the noise scale or the deviation, of sum 1."""
    weight = np.array(getattr(scatter_prior(stage), field))
    return np.asarray(weight / weight.sum())


def _path(machine: Stage, clock: Array, parts: tuple[Part, ...]) -> Array:
    """Health parameters along a life, ``(n_logs, n_parameters)``."""
    pairs = zip(machine.parameters, parts, strict=True)
    columns = [p.baseline * part.by_law(clock) * np.exp(part.off) for p, part in pairs]
    return np.column_stack(columns)


def _modes(
    rng: np.random.Generator, machine: Stage, names: tuple[str, ...], clock: Array, path: Array
) -> tuple[Array, int]:
    """Ln f of the modes: health through a map that is wrong, and what moves without health.

    Last the index of the mode that moves alone, or `NO_MODE`.
    """
    x = np.log(path)
    level, wrong_by = machine.drift(x, names), map_std(rng, machine)
    for j in range(x.shape[1]):
        alone = np.tile(machine.baseline_point, (clock.size, 1))
        alone[:, j] = x[:, j]
        error = wrong_by * rng.standard_normal(len(names))
        level = level + error * machine.drift(alone, names)
    moved, lone = without_health(rng, machine, clock, len(names))
    known = np.log([mode.frequency_hz for mode in machine.modes if mode.name in names])
    return np.asarray(level + moved + known), lone


def without_health(
    rng: np.random.Generator, stage: Stage, clock: Array, n_modes: int
) -> tuple[Array, int]:
    """Draw intercepts, random walks, and the drift of a mode that moves alone.

    Of ln f at each log, ``(n_logs, n_modes)``, and the index of that mode, or `NO_MODE`.
    """
    which, alone = rng.random(), stage.description.life.lone_mode
    lone = int(which / alone) if which < n_modes * alone else NO_MODE
    if lone == NO_MODE:
        walk = rng.choice(constants.WALK_STDS, p=shares(stage, "walk"))
    else:
        stds, weights = zip(*constants.LONE_WALKS, strict=True)
        walk = rng.choice(stds, p=weights)
    steps = walk * np.sqrt(np.diff(clock, prepend=0.0) / clock[-1])
    drift = np.cumsum(steps[:, None] * rng.standard_normal((clock.size, n_modes)), axis=0)
    if lone != NO_MODE:
        cov = constants.LONE_STD**2 * lone_kernel(clock, clock, float(clock[-1]))
        # It is 0 at the baseline: no Cholesky factor.
        drift[:, lone] += rng.multivariate_normal(np.zeros(clock.size), cov, method="eigh")
    return drift + constants.INTERCEPT_STD * rng.standard_normal(n_modes), lone


def _covariates(rng: np.random.Generator) -> dict[str, Array]:
    temperature = 21 + 3 * rng.standard_normal(N_LOGS)
    temperature[rng.random(N_LOGS) < 0.05] = np.nan
    payload = rng.choice([10.0, 20.0, 35.0], size=N_LOGS)
    return {"temperature_c": temperature, "payload_kg": payload}


def _covariate_effects(
    rng: np.random.Generator, machine: Stage, covariates: dict[str, Array], n_modes: int
) -> Array:
    """Draw what covariates do to ln f of each mode, be they known or not."""
    total = np.zeros((N_LOGS, n_modes))
    for one in regressors(covariates, machine):
        total += np.outer(one.values, one.prior_std * rng.standard_normal(n_modes))
        total += np.sqrt(one.unknown)[:, None] * rng.standard_normal((N_LOGS, n_modes))
    return total


def _steps(rng: np.random.Generator, series: tuple[Series, ...]) -> tuple[Step, ...]:
    steps = []
    if rng.random() < 0.25:
        first = int(rng.integers(1, N_LOGS))
        steps.append(Step("servo", first, np.arange(N_LOGS) >= first, name="v2"))
    if len({one.source for one in series}) > 1 and rng.random() < 0.5:
        first = int(rng.integers(1, N_LOGS))
        steps.append(Step("sensor", first, np.arange(N_LOGS) >= first, source="delta_e"))
    return tuple(sorted(steps, key=lambda step: step.first))


def _offsets(
    rng: np.random.Generator, series: tuple[Series, ...], mode: Array, steps: tuple[Step, ...]
) -> Array:
    """Draw what shifts readings without wear: the bias of a second source, and steps."""
    second = [one.mode in {other.mode for other in series[:i]} for i, one in enumerate(series)]
    total = np.tile(second * rng.normal(0, BIAS_STD[0], len(series)), (N_LOGS, 1))
    for step in steps:
        if step.kind == "step":  # health itself jumps
            continue
        jump = rng.normal(0, JUMP_STD[step.kind][0], len(series))[mode]
        seen = [step.source in ("", one.source) for one in series]
        total += np.outer(step.there, jump * seen)
    return total


def _covariance(rng: np.random.Generator, mode: Array) -> Array:
    """Covariances of ln f that differ from log to log; errors of one mode are mostly common."""
    std = rng.uniform(3e-4, 2e-3) * np.exp(0.3 * rng.standard_normal((N_LOGS, mode.size)))
    correlation = np.where(np.equal.outer(mode, mode), 0.9, 0.2)
    np.fill_diagonal(correlation, 1.0)
    return np.asarray(std[:, :, None] * std[:, None, :] * correlation)
