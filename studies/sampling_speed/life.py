"""The posterior of a whole life: its time, and its likelihood beside a loop over filterpy."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray

from lmshealth.health.ensemble_sampling import start_from_prior
from lmshealth.prognosis.life_likelihood import LifeLikelihood, ln_health
from lmshealth.prognosis.life_posterior import LifeDensity
from lmshealth.prognosis.remaining_life import prognose
from lmshealth.stage.description import Stage, load_stage
from lmshealth.tracking.history import History
from studies.common.cost import cpu_s
from studies.common.histories import make_history
from studies.harness.study import Row

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
    n_settings: int  # Of the grid, before and after it is cut to what is probable
    n_kept: int


def two_ways(history: History, stage: Stage, walkers: int, looped: int) -> Walkers:
    """Find points that the posterior holds probable, and both ways to their likelihood."""
    likelihood = LifeLikelihood.of(history, stage)
    # Both parts lose: of all scenarios the one with the most to draw.
    scenario = max(likelihood.data.scenarios, key=lambda one: one.n_dim)
    density = LifeDensity(likelihood, scenario, likelihood.grid)
    begin = start_from_prior(density.log_probability, scenario.draw)
    y = np.concatenate([begin(np.random.default_rng(k)) for k in range(8)])[:walkers]
    density = density.narrowed(y)
    grid, n_kept = density.grid, density.grid.walk.size
    # A filter with health as given knows of no deviation from it.
    value = np.where(grid.deviation == 0, grid.log_weight - 0.5 * grid.rest, -np.inf)
    density = replace(density, grid=grid[np.arange(n_kept) == np.argmax(value)])
    walk, scale = float(density.grid.walk[0]), float(density.grid.noise_scale[0])
    prior = scenario.log_prior(y)
    model_std = float(density.grid.map_std[0])

    def loop() -> Array:
        x, _ = ln_health(stage, scenario, y[:looped], history.clock())
        flats = [stage.drifts(path, MODES) for path in x]
        setting = {"walk": walk, "scale": scale, "model_std": model_std}
        return np.array([by_filterpy(history, flat[0], flat[1:], **setting) for flat in flats])

    n_settings = likelihood.grid.walk.size
    return Walkers(
        lambda: density.log_probability(y) - prior, loop, y.shape[0], looped, n_settings, n_kept
    )


def likelihoods(history: History, stage: Stage, walkers: int, looped: int) -> Row:
    """Compare the time of a walker and the values, at one point of the grid of settings."""
    ways, turns = two_ways(history, stage, walkers, looped), max(400 // walkers, 1)
    found, book = ways.ours(), []
    ours = cpu_s(lambda: [ways.ours() for _ in range(turns)]) / turns / walkers
    loop = cpu_s(lambda: book.append(ways.by_filterpy())) / looped
    return {
        "logs": len(history.logs),
        "modes": len(MODES),
        "settings": {"all": ways.n_settings, "kept": ways.n_kept},
        "walkers": walkers,
        "us_per_walker": 1e6 * ours,
        "us_per_walker_by_filterpy": 1e6 * loop,
        "times_faster": loop / ours,
        # Up to a constant, which is that of the grid's prior.
        "largest_difference": float(np.ptp(found[:looped] - book[0])),
        "spread_of_values": float(np.ptp(book[0])),
    }


def life_posterior(seed: int, turns: int, *, quick: bool) -> Row:
    """Time the whole posterior with its convergence; the quick form has no chains."""
    # The fewer laws, the fewer scenarios.
    stage = load_stage("lms-x" if quick else "lms-y")
    rng = np.random.default_rng(seed)
    history = degrading_life(stage, 20 if quick else 100, rng)
    runs = []
    for turn in range(turns):
        begin = time.process_time()
        found = prognose(history, stage, seed + turn, chains=not quick)
        seconds = time.process_time() - begin
        runs.append({"cpu_s": seconds, "ess": found.ess, "r_hat": found.r_hat})
    return {
        "runs": runs,
        "cpu_s": float(np.median([run["cpu_s"] for run in runs])),
        "worst_r_hat": max(run["r_hat"] for run in runs),
        "likelihood": likelihoods(history, stage, 64, 3 if quick else 20),
    }
