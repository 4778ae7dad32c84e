"""Calibration of whole lives on truths drawn from the stated priors.

Posteriors are integrated on grids, so that the check is of the model and not of the sampler. A
coverage passes when its 99.9 % Clopper-Pearson interval holds the nominal value.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lmshealth import life
from lmshealth.arrays import FloatArray
from lmshealth.density import LifeDensity
from lmshealth.life import LifeLikelihood
from lmshealth.stage import Stage
from lmshealth.tracks import History
from tests.lives import (
    AXES,
    FADING,
    FREQUENCY,
    SENSITIVITY,
    TEMPERATURE,
    make_history,
    make_stage,
    true_drift,
)
from tests.oracles import cdf_at, check_coverage

N_LIVES = 300
N_LOGS = 12
HORIZON = 2e7


def draw_history(rng: np.random.Generator, model_std: float) -> tuple[History, float, float]:
    """Draw a life of a fading preload, its loss by the law and its health now, from all priors."""
    travel = np.cumsum(np.r_[1e5, rng.uniform(5e4, 4e5, N_LOGS - 1)])
    clock = travel - travel[0]
    now = clock[-1]
    low, high = AXES["guide_preload"][[0, -1]]
    while not low < 1 - (loss := rng.normal(0, 2e-7) * now) < high:
        pass
    drift = true_drift(("guide_preload",), np.log(1 - loss * clock / now)[:, None])[:, :2]
    drift = drift * (1 + model_std * rng.standard_normal(2))
    temperature = 21 + 4 * rng.standard_normal(N_LOGS)
    drift += np.outer(temperature - 21, rng.normal(0, 1e-3, 2))
    steps = np.sqrt(np.diff(clock) / now)[:, None] * rng.standard_normal((N_LOGS - 1, 2))
    drift[1:] += rng.choice(life._WALKS) * np.cumsum(steps, axis=0)
    deviation = rng.choice(life._DEVIATIONS, p=life._DEVIATION_PRIOR)
    steps = np.sqrt(np.diff(clock) / HORIZON) * rng.standard_normal(N_LOGS - 1)
    off = deviation * np.r_[0, np.cumsum(steps)]
    drift += np.outer(off, SENSITIVITY["guide_preload"][:2])
    scale = rng.choice(life._NOISE_SCALES, p=life._NOISE_SCALE_PRIOR)
    noise = scale * 1e-3 * rng.standard_normal((N_LOGS, 2))
    history = make_history(
        np.log(FREQUENCY[:2]) + drift + noise, travel=travel, temperature=temperature
    )
    return history, float(loss), float((1 - loss) * np.exp(off[-1]))


def integrated(density: LifeDensity) -> tuple[FloatArray, FloatArray]:
    """Posterior density of the loss by the law, on a coarse then a fine grid."""
    low, high = 1 - AXES["guide_preload"][[-1, 0]]
    for _ in range(2):
        y = np.linspace(low, high, 241)
        value = density.log_probability(y[:, None])
        weight = np.exp(value - value.max())
        likely = y[weight > 1e-7]
        step = y[1] - y[0]
        low, high = likely[0] - step, likely[-1] + step
    return y, weight


def density_of(history: History, stage: Stage) -> LifeDensity:
    """Give the density of the only course."""
    likelihood = LifeLikelihood(history, stage)
    return LifeDensity.of(likelihood, likelihood.courses[0])


def level_of_health(
    density: LifeDensity, rng: np.random.Generator, truth: float, n: int = 400
) -> float:
    """Posterior probability of less health now than the truth: the law times how far it is off."""
    y, weight = integrated(density)
    drawn = rng.choice(y, n, p=weight / weight.sum())[:, None]
    off, _ = density.deviations(drawn, np.array([density.life.now]), rng)
    return float(np.mean((1 - drawn) * np.exp(off[:, 0]) < truth))


def test_lives_are_calibrated_and_are_not_without_their_map_error(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    """All that is not known drawn from its prior: losses by the law are covered, and so is health.

    Remaining life falls as the loss grows, so that its intervals cover when those of loss do.
    Negative control: on the same lives a map that is taken as exact covers too little.
    """
    honest = make_stage(tmp_path / "honest", (FADING,), model_std=0.2, tail=TEMPERATURE)
    proud = make_stage(tmp_path / "proud", (FADING,), model_std=0.0, tail=TEMPERATURE)
    found, health, wrong = [], [], []
    for _ in range(N_LIVES):
        history, loss, left = draw_history(rng, 0.2)
        density = density_of(history, honest)
        assert density.life.horizon == HORIZON
        found.append(cdf_at(*integrated(density), loss))
        health.append(level_of_health(density, rng, left))
        wrong.append(cdf_at(*integrated(density_of(history, proud)), loss))
    check_coverage(np.array(found), calibrated=True)
    check_coverage(np.array(health), calibrated=True)
    check_coverage(np.array(wrong), calibrated=False)


def test_health_off_its_law_is_calibrated_and_is_not_by_laws_alone(
    rng: np.random.Generator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where most lives stray far from their law, by modes that wander little, health is covered.

    Negative control: taken never to leave its law, it is covered too little.
    """
    monkeypatch.setattr(life, "_WALKS", (1e-5, 5e-4, 1.5e-3))
    monkeypatch.setattr(life, "_DEVIATIONS", (0.0, 0.4))
    monkeypatch.setattr(life, "_DEVIATION_PRIOR", (0.1, 0.9))
    stage = make_stage(tmp_path, (FADING,), model_std=0.2, tail=TEMPERATURE)
    found, wrong = [], []
    for _ in range(N_LIVES):
        history, _, left = draw_history(rng, 0.2)
        density = density_of(history, stage)
        found.append(level_of_health(density, rng, left))
        lawful = replace(density, grid=density.grid.chosen(density.grid.deviation == 0))
        wrong.append(level_of_health(lawful, rng, left))
    check_coverage(np.array(found), calibrated=True)
    check_coverage(np.array(wrong), calibrated=False)
