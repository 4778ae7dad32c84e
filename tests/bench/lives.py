"""The likelihood of a whole life: ours, and a loop over filterpy."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray

from lmshealth.calibration.lives import make_history
from lmshealth.life.posterior.likelihood import NO_MODE, LifeDensity, LifeLikelihood, ln_health
from lmshealth.life.posterior.sampling import draw_to_ess, importance_sample
from lmshealth.stage.description import Stage
from lmshealth.tracking.history import History

Array = NDArray[np.float64]
MODES = ("roll", "pitch")
NOISE, WALK, TEMPERATURE = 8e-4, 5e-4, -8e-4
# Priors of life.py that a filter must know too.
INTERCEPT_STD, TEMPERATURE_STD, REFERENCE = 0.1, 1e-3, 21.0


def degrading_life(stage: Stage, n: int, rng: np.random.Generator) -> History:
    """Make a life of wear and loosening as two modes show it, with temperature and a walk."""
    travel = np.linspace(0.0, 3e6, n)
    preload = (1 - travel / 9e6) ** 1.5
    mount = 0.75 + 0.25 * np.exp(-travel / 2e6)
    temperature = REFERENCE + 4 * rng.standard_normal(n)
    walk = WALK / np.sqrt(n) * np.cumsum(rng.standard_normal((n, 2)), axis=0)
    specs = {mode.name: mode for mode in stage.modes}
    level = np.log([specs[name].frequency_hz for name in MODES])
    drift = stage.drift(np.log(np.column_stack([preload, mount])), MODES)
    warm = TEMPERATURE * (temperature - REFERENCE)[:, None]
    ln_f = level + drift + warm + walk + NOISE * rng.standard_normal((n, 2))
    damping = np.tile(np.log([specs[name].damping_ratio for name in MODES]), (n, 1))
    cov = np.tile(np.diag([NOISE**2, NOISE**2, 0.05**2, 0.05**2]), (n, 1, 1))
    covariates = {"temperature_c": temperature}
    return make_history(MODES, travel, (ln_f, damping, cov), covariates=covariates)


def by_filterpy(
    history: History, drift: Array, alone: Array, *, walk: float, scale: float, model_std: float
) -> float:
    """Log likelihood of one life, log by log: intercept with its walk, temperature, map errors.

    ``drift`` (n_logs, n_modes) is that of the life, ``alone`` (n_parameters, n_logs, n_modes) of
    each parameter.
    """
    total = 0.0
    clock = history.clock() / history.clock().max()
    warm = history.covariates["temperature_c"] - REFERENCE
    n_states = 2 + alone.shape[0]
    for i in range(len(history.modes)):
        filtered = KalmanFilter(dim_x=n_states, dim_z=1)
        filtered.x = np.zeros(n_states)
        filtered.P = np.diag([INTERCEPT_STD**2, TEMPERATURE_STD**2, *[model_std**2] * len(alone)])
        filtered.F = np.eye(n_states)
        y = history.ln_frequency[:, i] - history.ln_frequency[:, i].mean() - drift[:, i]
        past = 0.0
        for k in range(y.size):
            filtered.predict(Q=np.diag([walk**2 * (clock[k] - past), *[0.0] * (n_states - 1)]))
            past = clock[k]
            h = np.array([[1.0, warm[k], *alone[:, k, i]]])
            filtered.update(np.array([y[k]]), R=np.array([[scale**2 * NOISE**2]]), H=h)
            s = float(filtered.S[0, 0])
            total -= 0.5 * (float(filtered.y[0]) ** 2 / s + np.log(s))
    return total


class Walkers(NamedTuple):
    """Both ways to log likelihoods, up to a constant, at one point of the grid of settings."""

    ours: Callable[[], Array]
    by_filterpy: Callable[[], Array]
    walkers: int  # How many ours has at once, and how many filterpy one after the other
    looped: int


def two_ways(history: History, stage: Stage, walkers: int, looped: int) -> Walkers:
    """Find points that the posterior holds probable, and both ways to their likelihood."""
    likelihood = LifeLikelihood.of(history, stage)
    # Both parts lose: of all scenarios the one with the most to draw.
    scenario = max(likelihood.data.scenarios, key=lambda one: one.n_dim)
    density = LifeDensity(likelihood, scenario, likelihood.grid)
    rng = np.random.default_rng(0)
    start = scenario.draw(rng, 600)
    rough = importance_sample(density.log_probability, start, rng, 2000)
    draws = draw_to_ess(density.log_probability, rough, rng, 100.0)
    y, grid = draws.resampled(rng, walkers), density.grid
    # A filter with health as given knows of no deviation from it, and of no mode that moves alone.
    known = (grid.deviation == 0) & (grid.lone == NO_MODE)
    value = np.where(known, grid.log_weight - 0.5 * grid.rest, -np.inf)
    point = grid[np.arange(grid.walk.size) == np.argmax(value)]
    walk, scale = float(point.walk[0]), float(point.noise_scale[0])
    assert stage.description.map is not None
    model_std = stage.description.map.model_std

    def terms() -> Array:
        x, _ = likelihood.path(scenario, y)
        return likelihood.terms(point, x)[0, 0]

    def loop() -> Array:
        x, _ = ln_health(stage, scenario, y[:looped], history.clock())
        flats = [stage.drifts(path, MODES) for path in x]
        setting = {"walk": walk, "scale": scale, "model_std": model_std}
        return np.array([by_filterpy(history, flat[0], flat[1:], **setting) for flat in flats])

    return Walkers(terms, loop, y.shape[0], looped)
