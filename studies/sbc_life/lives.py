"""Whole lives drawn from the estimator's own model, with all that it does not know of them."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

from lmshealth import life as model
from lmshealth.laws import HertzWear, Loosening
from lmshealth.stage import ParameterSpec, Stage
from lmshealth.statespace import BIAS_STD, JUMP_STD, regressors
from lmshealth.tracks import History, Series, Step

Array = NDArray[np.float64]
START = datetime(2026, 3, 1, tzinfo=UTC)
N_LOGS = 60
# Odometer now since the baseline in km: median, and standard deviation of its logarithm.
NOW_KM = 2000.0, 0.7


@dataclass(frozen=True)
class Life:
    """A history, and the law parameters behind it: an array for every health parameter."""

    history: History
    theta: tuple[Array, ...]

    @property
    def now(self) -> float:
        """Travel since the baseline in m."""
        return float(np.ptp(self.history.travel))


def draw(rng: np.random.Generator, machine: Stage) -> Life:
    """Draw a life of 60 logs.

    In half of the lives a second source sees pitch. A twentieth of estimates and temperatures is
    missing; now and then the servo is retuned, or the second source's sensor is changed.
    """
    travel = _travel(rng)
    theta = _theta(rng, machine, travel - travel[0])
    names = machine.informative
    series = tuple(Series(name, "acc") for name in names)
    if rng.random() < 0.5:
        series = (*series, Series("pitch", "delta_e"))
    covariates, steps = _covariates(rng), _steps(rng, series)
    level = _modes(rng, machine, travel - travel[0], theta)
    level += _covariate_effects(rng, machine, covariates, len(names))
    mode = np.array([names.index(one.mode) for one in series])
    values = level[:, mode] + _offsets(rng, series, mode, steps)
    cov = _covariance(rng, mode)
    scale = rng.choice(model._NOISE_SCALES, p=model._NOISE_SCALE_PRIOR)
    values += (
        scale * (np.linalg.cholesky(cov) @ rng.standard_normal((N_LOGS, mode.size, 1)))[..., 0]
    )
    return Life(_history(rng, machine, travel, covariates, series, steps, values, cov), theta)


def _travel(rng: np.random.Generator) -> Array:
    """Draw the odometer in m: that of now does not depend on the life."""
    now = 1000 * NOW_KM[0] * np.exp(NOW_KM[1] * rng.standard_normal())
    return np.asarray(1e5 + now * np.r_[0.0, np.sort(rng.uniform(size=N_LOGS - 2)), 1.0])


def _theta(rng: np.random.Generator, machine: Stage, clock: Array) -> tuple[Array, ...]:
    """Draw law parameters from the priors of the description, until a life stays inside the map."""
    assert machine.modal_map is not None
    while True:
        theta = tuple(_of_law(rng, parameter) for parameter in machine.parameters)
        path = _path(machine, clock, theta)
        with np.errstate(divide="ignore"):
            if machine.modal_map.inside(np.log(path)).all():
                return theta


def _of_law(rng: np.random.Generator, parameter: ParameterSpec) -> Array:
    """Draw the natural parameters of a law, lengths in m."""
    law, (first, second) = parameter.law, rng.uniform(size=(2, 1))
    if isinstance(law, HertzWear):
        return np.concatenate([1000 * law.life_km.quantile(first), law.exponent.quantile(second)])
    assert isinstance(law, Loosening)
    return np.concatenate([law.floor.quantile(first), 1000 * law.life_km.quantile(second)])


def _path(machine: Stage, clock: Array, theta: tuple[Array, ...]) -> Array:
    """Health parameters along a life, ``(n_logs, n_parameters)``."""
    pairs = zip(machine.parameters, theta, strict=True)
    return np.column_stack([p.baseline * p.law.health(t[None], clock)[0] for p, t in pairs])


def _modes(
    rng: np.random.Generator, machine: Stage, clock: Array, theta: tuple[Array, ...]
) -> Array:
    """Ln f of the modes: wear through a map that is wrong, an intercept, and a random walk."""
    assert machine.description.map is not None
    names, x = machine.informative, np.log(_path(machine, clock, theta))
    level = machine.drift(x, names)
    for j in range(x.shape[1]):
        alone = np.tile(machine.baseline_point, (clock.size, 1))
        alone[:, j] = x[:, j]
        error = machine.description.map.model_std * rng.standard_normal(len(names))
        level = level + error * machine.drift(alone, names)
    walk = rng.choice(model._WALKS) * np.sqrt(np.diff(clock, prepend=0.0) / clock[-1])
    level = level + np.cumsum(walk[:, None] * rng.standard_normal(level.shape), axis=0)
    known = np.log([mode.frequency_hz for mode in machine.modes if mode.name in names])
    return np.asarray(level + known + model._INTERCEPT_STD * rng.standard_normal(len(names)))


def _covariates(rng: np.random.Generator) -> dict[str, Array]:
    temperature = 21 + 3 * rng.standard_normal(N_LOGS)
    temperature[rng.random(N_LOGS) < 0.05] = np.nan
    return {
        "temperature_c": temperature,
        "payload_kg": rng.choice([10.0, 20.0, 35.0], size=N_LOGS),
    }


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


def _history(
    rng: np.random.Generator,
    machine: Stage,
    travel: Array,
    covariates: dict[str, Array],
    series: tuple[Series, ...],
    steps: tuple[Step, ...],
    values: Array,
    cov: Array,
) -> History:
    """Put estimates into a history, and leave some of them out."""
    r = len(series)
    both = np.zeros((N_LOGS, 2 * r, 2 * r))
    both[:, :r, :r] = cov
    both[:, r:, r:] = 0.05**2 * np.eye(r)
    damping = np.tile(np.log(0.015), (N_LOGS, r))
    missing = rng.random((N_LOGS, r)) < 0.05
    values, damping = np.where(missing, np.nan, values), np.where(missing, np.nan, damping)
    gone = np.hstack([missing, missing])
    both[gone[:, :, None] | gone[:, None, :]] = np.nan
    return History(
        stage="SBC-1",
        logs=tuple(f"{k:03d}" for k in range(N_LOGS)),
        recorded_at=tuple(START + timedelta(days=k) for k in range(N_LOGS)),
        travel=travel,
        covariates=covariates,
        modes=machine.informative,
        series=series,
        ln_frequency=values,
        ln_damping=damping,
        cov=both,
        loop_error=np.full(N_LOGS, np.nan),
        baselines=(0,),
        steps=steps,
    )
