"""Calibration of whole lives on truths drawn from the stated priors.

Posteriors are integrated on grids, so that the check is of the model and not of the sampler. A
coverage passes when its 99.9 % Clopper-Pearson interval holds the nominal value.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lmshealth import life
from lmshealth.life import LifeLikelihood
from lmshealth.stage import Stage
from lmshealth.tracks import History
from tests.lives import AXES, FADING, FREQUENCY, TEMPERATURE, make_history, make_stage, true_drift
from tests.oracles import cdf_at, check_coverage

N_LIVES = 300
N_LOGS = 12


def draw_history(rng: np.random.Generator, model_std: float) -> tuple[History, float]:
    """Draw a life of a fading preload, and its loss now, from all stated priors."""
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
    scale = rng.choice(life._NOISE_SCALES, p=life._NOISE_SCALE_PRIOR)
    noise = scale * 1e-3 * rng.standard_normal((N_LOGS, 2))
    history = make_history(
        np.log(FREQUENCY[:2]) + drift + noise, travel=travel, temperature=temperature
    )
    return history, float(loss)


def level_of(history: History, stage: Stage, loss: float) -> float:
    """Posterior probability of a smaller loss than the true one, on a coarse then a fine grid.

    Remaining life falls as the loss grows, so that its intervals cover when those of loss do.
    """
    likelihood = LifeLikelihood(history, stage)
    low, high = 1 - AXES["guide_preload"][[-1, 0]]
    for _ in range(2):
        y = np.linspace(low, high, 241)
        value = likelihood.log_probability(y[:, None])
        density = np.exp(value - value.max())
        likely = y[density > 1e-7]
        step = y[1] - y[0]
        low, high = likely[0] - step, likely[-1] + step
    return cdf_at(y, density, loss)


def test_lives_are_calibrated_and_are_not_without_their_map_error(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    """Rates, intercepts, temperature, walk and map error drawn from their priors: covered.

    Negative control: on the same lives a map that is taken as exact covers too little.
    """
    tail = TEMPERATURE
    stage = make_stage(tmp_path / "honest", (FADING,), model_std=0.2, tail=tail)
    proud = make_stage(tmp_path / "proud", (FADING,), model_std=0.0, tail=tail)
    found, wrong = [], []
    for _ in range(N_LIVES):
        history, loss = draw_history(rng, 0.2)
        found.append(level_of(history, stage, loss))
        wrong.append(level_of(history, proud, loss))
    check_coverage(np.array(found), calibrated=True)
    check_coverage(np.array(wrong), calibrated=False)
