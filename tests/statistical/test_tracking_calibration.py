"""Calibration of the tracker on lives drawn from its own model.

A coverage passes when its 99.9 % Clopper-Pearson interval holds the nominal value: one honest
check in a thousand fails. Every check is repeated where it must fail.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from lmshealth import tracking
from lmshealth.arrays import FloatArray
from lmshealth.stage import Stage
from lmshealth.tracking import track
from lmshealth.tracks import History
from tests.lives import DAMPING, FREQUENCY, make_history, make_stage
from tests.oracles import DAMPING_WALK, RATE_STD, Wander, binomial_band

N_LOGS = 12
N_OWN = 900
N_AVERAGED = 160
STD = 1e-3


@dataclass(frozen=True)
class Life:
    """A history of one mode with what is true behind it."""

    history: History
    drift: FloatArray
    wander: Wander
    epoch: int


def draw_wander(rng: np.random.Generator) -> Wander:
    """Draw a setting from the tracker's grid, by the tracker's prior."""
    return Wander(
        float(rng.choice(tracking._LEVEL_WALKS)),
        float(rng.choice(tracking._RATE_WALKS)),
        float(rng.choice(tracking._NOISE_SCALES, p=tracking._NOISE_SCALE_PRIOR)),
    )


def draw_life(rng: np.random.Generator) -> Life:
    """Draw a life: setting, rate, temperature coefficient, walks and noise."""
    wander = draw_wander(rng)
    travel = np.cumsum(np.r_[1e5, rng.uniform(5e4, 3e5, N_LOGS - 1)])
    span = travel[-1] - travel[0]
    level, rate, damping = np.zeros(N_LOGS), rng.normal(0, RATE_STD / span), np.zeros(N_LOGS)
    for k in range(1, N_LOGS):
        step = travel[k] - travel[k - 1]
        bend = wander.rate**2 / span**3
        joint = bend * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
        # Scaled by a diagonal, as its entries lie 12 orders of magnitude apart.
        scale = np.sqrt(np.diag(joint))
        root = np.linalg.cholesky(joint / np.outer(scale, scale))
        moved = scale * (root @ rng.standard_normal(2))
        level[k] = level[k - 1] + rate * step + moved[0]
        level[k] += wander.level * np.sqrt(step / span) * rng.standard_normal()
        rate += moved[1]
        damping[k] = damping[k - 1] + DAMPING_WALK * np.sqrt(step / span) * rng.standard_normal()
    temperature = 21 + 4 * rng.standard_normal(N_LOGS)
    noise = wander.scale * rng.standard_normal((N_LOGS, 2)) * [STD, 0.05]
    ln_f = np.log(FREQUENCY[0]) + level + rng.normal(0, 1e-3) * (temperature - 21) + noise[:, 0]
    history = make_history(
        ln_f[:, None],
        travel=travel,
        std=STD,
        ln_damping=(np.log(DAMPING[0]) + damping + noise[:, 1])[:, None],
        temperature=temperature,
    )
    return Life(history, level - level[0], wander, int(rng.integers(1, N_LOGS)))


def halved(history: History) -> History:
    """Give the same history with half the reported covariance."""
    return make_history(
        history.ln_frequency,
        travel=history.travel,
        cov=history.cov / 2,
        ln_damping=history.ln_damping,
        temperature=history.covariates["temperature_c"],
    )


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """One mode is enough; temperature as covariate."""
    return make_stage(Path(tmp_path_factory.mktemp("stage")), n_modes=2)


def filtered(life: Life, history: History, stage: Stage) -> tuple[float, FloatArray]:
    """Standardised error of the drift at the life's epoch, and NIS, knowing the setting."""
    problem = tracking._Problem(history, stage.description.covariate)
    wander = life.wander
    setting = tracking._Setting(wander.level, wander.rate, wander.scale, 0.0)
    found = tracking._average(problem, [setting], [problem.run(setting)])
    k = life.epoch
    error = found.drift[k, 0] - life.drift[k]
    # The prior is centred on the first log, whose innovation says nothing.
    return float(error / np.sqrt(found.drift_cov[k, 0, 0])), found.nis[1:]


def band(errors: FloatArray, level: float) -> tuple[float, float]:
    """Give the 99.9 % interval of the coverage of central intervals of this level."""
    hits = int(np.sum(np.abs(errors) < stats.norm.ppf((1 + level) / 2)))
    return binomial_band(hits, errors.size)


def test_the_filter_is_calibrated_and_half_its_covariance_is_not(
    rng: np.random.Generator, stage: Stage
) -> None:
    """Knowing the setting, 50 and 90 % intervals cover 50 and 90 %, and NIS has its mean.

    Negative control: with the reported covariance halved both leave their bands.
    """
    lives = [draw_life(rng) for _ in range(N_OWN)]
    errors, nis = zip(*(filtered(life, life.history, stage) for life in lives), strict=True)
    wrong, wrong_nis = zip(
        *(filtered(life, halved(life.history), stage) for life in lives), strict=True
    )
    for level in (0.5, 0.9):
        low, high = band(np.array(errors), level)
        assert low <= level <= high, f"{level:.0%} intervals cover {low:.3f} to {high:.3f}"
        low, high = band(np.array(wrong), level)
        assert high < level, f"halved, {level:.0%} intervals cover {low:.3f} to {high:.3f}"
    dof = 2 * (N_LOGS - 1) * N_OWN
    low, high = stats.chi2.interval(0.999, dof)
    assert low <= np.sum(nis) <= high
    assert np.sum(wrong_nis) > high


def test_the_averaged_tracker_is_calibrated_and_narrower_intervals_are_not(
    rng: np.random.Generator, stage: Stage
) -> None:
    """Not knowing the setting, intervals of the average over the grid still cover 50 and 90 %.

    Negative control: intervals of half the width cover too little. (Half the reported covariance
    would be no control here: the grid holds a factor on it and finds it out.)
    """
    errors = []
    for _ in range(N_AVERAGED):
        life = draw_life(rng)
        found, k = track(life.history, stage), life.epoch
        error = found.drift[k, 0] - life.drift[k]
        errors.append(error / np.sqrt(found.drift_cov[k, 0, 0]))
    for level in (0.5, 0.9):
        low, high = band(np.array(errors), level)
        assert low <= level <= high, f"{level:.0%} intervals cover {low:.3f} to {high:.3f}"
        low, high = band(2 * np.array(errors), level)
        assert high < level, f"halved, {level:.0%} intervals cover {low:.3f} to {high:.3f}"
