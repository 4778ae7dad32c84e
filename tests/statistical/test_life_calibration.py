"""Calibration of health and of whole lives on truths drawn from the stated priors.

Posteriors are integrated on grids, so that the check is of the model and not of the sampler. A
coverage passes when its 99.9 % Clopper-Pearson interval holds the nominal value.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lmshealth import life
from lmshealth.arrays import FloatArray
from lmshealth.inference import EpochPosterior
from lmshealth.life import LifeLikelihood
from lmshealth.stage import Stage
from lmshealth.tracks import History
from tests.lives import (
    AXES,
    FADING,
    FREQUENCY,
    MODES,
    TEMPERATURE,
    make_history,
    make_stage,
    true_drift,
)
from tests.oracles import binomial_band

NAMES = ("guide_preload", "mount_stiffness")
N_EPOCHS = 400
N_LIVES = 300
N_LOGS = 12


def check(levels_of_truth: FloatArray, calibrated: bool) -> None:
    """Hold the coverage of central 50 and 90 % intervals to its band, or outside of it.

    Parameters
    ----------
    levels_of_truth : ndarray
        Posterior probability below the truth, one per life.
    calibrated : bool
        Whether both coverages have to agree, or the 90 % one must be too low.
    """
    for level in (0.5, 0.9):
        hits = int(np.sum(np.abs(levels_of_truth - 0.5) < level / 2))
        low, high = binomial_band(hits, levels_of_truth.size)
        if calibrated:
            assert low <= level <= high, f"{level:.0%} intervals cover {low:.3f} to {high:.3f}"
        elif level == 0.9:
            assert high < level, f"{level:.0%} intervals cover {low:.3f} to {high:.3f}"


def cdf_at(axis: FloatArray, density: FloatArray, truth: float) -> float:
    """Probability below the truth of a density on an even axis."""
    total = np.cumsum(density) - 0.5 * density
    return float(np.interp(truth, axis, total / density.sum()))


def marginals(posterior: EpochPosterior, x: FloatArray) -> list[float]:
    """Posterior probability below each true ln parameter, on a coarse and then a fine grid."""
    low, high = (np.log([AXES[name][k] for name in NAMES]) for k in (0, -1))
    for n in (61, 81, 81):
        axes = [np.linspace(a, b, n) for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
        value = posterior.log_probability(grid).reshape(n, n)
        density = np.exp(value - value.max())
        likely = np.argwhere(density > 1e-7)
        first, last = likely.min(axis=0) - 1, likely.max(axis=0) + 1
        low = np.array([axis[max(k, 0)] for axis, k in zip(axes, first, strict=True)])
        high = np.array([axis[min(k, n - 1)] for axis, k in zip(axes, last, strict=True)])
    return [cdf_at(axes[j], density.sum(axis=1 - j), x[j]) for j in range(2)]


def test_health_is_calibrated_and_is_not_without_its_map_error(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    """Preload and mount drawn from their priors, map wrong by 5 %: 50 and 90 % are covered.

    Negative control: on the same drifts a map that is taken as exact covers too little.
    """
    stage = make_stage(tmp_path / "honest", n_modes=3)
    proud = make_stage(tmp_path / "proud", n_modes=3, model_std=0.0)
    cov = 4e-7 * (0.7 * np.eye(3) + 0.3)
    truth = stage.prior.draw(rng, N_EPOCHS)
    found, wrong = [], []
    for x in truth:
        drift = true_drift(NAMES, x)
        for j in range(2):
            alone = true_drift(NAMES, x * (np.arange(2) == j))
            drift = drift + 0.05 * rng.standard_normal(3) * alone
        drift = rng.multivariate_normal(drift, cov)
        found.append(marginals(EpochPosterior.of(stage, MODES, drift, cov), x))
        wrong.append(marginals(EpochPosterior(proud, MODES, drift, cov), x))
    for j in range(2):
        check(np.array(found)[:, j], calibrated=True)
        check(np.array(wrong)[:, j], calibrated=False)


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
    check(np.array(found), calibrated=True)
    check(np.array(wrong), calibrated=False)
