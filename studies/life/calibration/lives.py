"""Whole lives drawn from the estimator's own model, with all that is unknown to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lmshealth.life import constants
from lmshealth.life.remaining_life import early_life, rate_std
from lmshealth.stage.degradation_laws import Accelerating, HertzWear, Law, Loosening
from lmshealth.stage.description import ParameterSpec, Stage
from lmshealth.tracking.constants import BIAS_STD, JUMP_STD
from lmshealth.tracking.covariates import regressors
from lmshealth.tracking.history import History, Series, Step
from studies.harness.data.histories import make_history, map_std

Array = NDArray[np.float64]
N_LOGS = 60
# Odometer now since the baseline in km: median, and standard deviation of its logarithm.
NOW_KM = 2000.0, 0.7


# Lives in which the modes jump once, and how far ahead in m a life is followed step by step.
STEPS, FINE = 0.15, 2000.0


@dataclass(frozen=True)
class Part:
    """What really becomes of a health parameter."""

    law: Law  # Of the scenario it takes
    theta: Array  # Natural parameters of the law, lengths in m
    begin: float  # Travel in m at which the law begins, and at which health jumps (inf: never)
    step: float
    jump: float  # Factor of the jump
    off: Array  # Ln of health over its law at each log, shape ``(n_logs,)``
    rate: float  # Variance of it per m

    def by_law(self, travel: Array) -> Array:
        """Health by the law and the jump alone, at travels since the baseline."""
        health = self.law.health(self.theta[None], np.maximum(travel - self.begin, 0.0))[0]
        return np.asarray(health * np.where(travel >= self.step, self.jump, 1.0))

    def left(self, rng: np.random.Generator, now: float, limit: float, horizon: float) -> float:
        """Follow the parameter from now on until its limit, in m; inf past the horizon."""
        left = self._left_by_law(rng, now, limit, horizon)
        if left <= 0 or not self.law.names:
            return left
        if left <= horizon:
            left *= rng.lognormal(0.0, rate_std(self.law) * np.sqrt(np.log2(1 + left / now)))
        proven = now + early_life(self.law, limit, rng)
        hazard = rng.gamma(constants.UNSEEN_ONSETS) / proven
        onset = rng.exponential() / hazard if hazard > 0 else np.inf
        growth = constants.UNSEEN_GROWTH
        end = onset + (proven + onset) * rng.lognormal(np.log(growth.median), growth.sigma)
        return min(left, float(end))

    def _left_by_law(
        self, rng: np.random.Generator, now: float, limit: float, horizon: float
    ) -> float:
        """Follow the parameter by its law and its deviation alone."""
        start = limit * np.exp(-self.off[-1]) / (self.jump if now >= self.step else 1.0)
        closed = self.begin + self.law.passage(self.theta[None], np.array([start]))[0] - now
        if self.rate == 0 or closed <= 0:
            return float(closed) if closed <= horizon else np.inf
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

    @property
    def now(self) -> float:
        """Travel since the baseline in m."""
        return float(np.ptp(self.history.travel))


def draw(rng: np.random.Generator, machine: Stage) -> Life:
    """Draw a life of 60 logs, in which roll and pitch are seen.

    In half of the lives a second source sees pitch. A twentieth of estimates and temperatures is
    missing; now and then the servo is retuned, the second source's sensor is changed, or health
    jumps.
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
    level = _modes(rng, machine, names, clock, _path(machine, clock, parts))
    level += _covariate_effects(rng, machine, covariates, len(names))
    mode = np.array([names.index(one.mode) for one in series])
    values = level[:, mode] + _offsets(rng, series, mode, steps)
    cov = _covariance(rng, mode)
    scale = rng.choice(constants.NOISE_SCALES, p=constants.NOISE_SCALE_PRIOR)
    noise = np.linalg.cholesky(cov) @ rng.standard_normal((N_LOGS, mode.size, 1))
    r = len(series)
    both = np.zeros((N_LOGS, 2 * r, 2 * r))
    both[:, :r, :r], both[:, r:, r:] = cov, 0.05**2 * np.eye(r)
    estimates = values + scale * noise[..., 0], np.full((N_LOGS, r), np.log(0.015)), both
    missing = rng.random((N_LOGS, r)) < 0.05
    history = make_history(
        names, travel, estimates, series=series, covariates=covariates, steps=steps, missing=missing
    )
    return Life(history, parts)


def _travel(rng: np.random.Generator) -> Array:
    """Draw the odometer in m: that of now does not depend on the life."""
    now = 1000 * NOW_KM[0] * np.exp(NOW_KM[1] * rng.standard_normal())
    return np.asarray(1e5 + now * np.r_[0.0, np.sort(rng.uniform(size=N_LOGS - 2)), 1.0])


def _parts(
    rng: np.random.Generator, machine: Stage, clock: Array, first: int | None
) -> tuple[Part, ...]:
    """Draw scenarios and deviations from their priors, until a life stays inside the map."""
    assert machine.modal_map is not None
    step = np.inf if first is None else float(clock[first - 1 : first + 1].mean())
    while True:
        deviation = rng.choice(constants.DEVIATION_STDS, p=constants.DEVIATION_PRIOR)
        rate = deviation**2 / clock[-1]
        parts = tuple(_part(rng, one, clock, step, rate) for one in machine.parameters)
        with np.errstate(divide="ignore"):
            if machine.modal_map.inside(np.log(_path(machine, clock, parts))).all():
                return parts


def _part(
    rng: np.random.Generator, parameter: ParameterSpec, clock: Array, step: float, rate: float
) -> Part:
    """Draw what becomes of a parameter: its law, where that begins, and how health wanders."""
    weight = np.array([law.weight for law in parameter.laws])
    law = parameter.laws[rng.choice(weight.size, p=weight / weight.sum())]
    anew = np.isfinite(step) and law.names and rng.random() < 0.5
    steps = np.sqrt(rate * np.diff(clock, prepend=0.0)) * rng.standard_normal(clock.size)
    return Part(
        law=law,
        theta=_of_law(rng, law),
        begin=step if anew else 0.0,
        step=step,
        jump=float(np.exp(constants.STEP_PRIOR.std * rng.standard_normal())),
        off=np.cumsum(steps),
        rate=float(rate),
    )


def _of_law(rng: np.random.Generator, law: Law) -> Array:
    """Draw the natural parameters of a law, lengths in m."""
    first, second = rng.uniform(size=(2, 1))
    if isinstance(law, Accelerating):
        wear = [1000 * law.life_km.quantile(first), law.exponent.quantile(second)]
        return np.concatenate([*wear, law.slow.quantile(rng.uniform(size=1))])
    if isinstance(law, HertzWear):
        return np.concatenate([1000 * law.life_km.quantile(first), law.exponent.quantile(second)])
    if isinstance(law, Loosening):
        return np.concatenate([law.floor.quantile(first), 1000 * law.life_km.quantile(second)])
    return np.empty(0)


def _path(machine: Stage, clock: Array, parts: tuple[Part, ...]) -> Array:
    """Health parameters along a life, ``(n_logs, n_parameters)``."""
    pairs = zip(machine.parameters, parts, strict=True)
    columns = [p.baseline * part.by_law(clock) * np.exp(part.off) for p, part in pairs]
    return np.column_stack(columns)


def _modes(
    rng: np.random.Generator, machine: Stage, names: tuple[str, ...], clock: Array, path: Array
) -> Array:
    """Ln f of the modes: health through a map that is wrong, an intercept, and a random walk."""
    x = np.log(path)
    level, wrong_by = machine.drift(x, names), map_std(rng, machine)
    for j in range(x.shape[1]):
        alone = np.tile(machine.baseline_point, (clock.size, 1))
        alone[:, j] = x[:, j]
        error = wrong_by * rng.standard_normal(len(names))
        level = level + error * machine.drift(alone, names)
    walk = rng.choice(constants.WALK_STDS) * np.sqrt(np.diff(clock, prepend=0.0) / clock[-1])
    level = level + np.cumsum(walk[:, None] * rng.standard_normal(level.shape), axis=0)
    known = np.log([mode.frequency_hz for mode in machine.modes if mode.name in names])
    return np.asarray(level + known + constants.INTERCEPT_STD * rng.standard_normal(len(names)))


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
