"""The posterior density of a scenario: its grid, its settings, and deviations of health."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lmshealth._arrays import FloatArray
from lmshealth.errors import NotEnoughData
from lmshealth.prognosis import constants
from lmshealth.prognosis.life_likelihood import LifeLikelihood
from lmshealth.prognosis.life_posterior import LifeDensity
from lmshealth.stage.description import Stage
from lmshealth.tracking.history import History
from tests.lives import (
    FADING,
    FOOT,
    FREQUENCY,
    MOUNT,
    SENSITIVITY,
    make_history,
    make_stage,
    rough_history,
    true_drift,
)
from tests.oracles import LifeBelief, LifeSetting, life_deviation

NAMES = ("guide_preload", "mount_stiffness")
MODEL_STD = 0.3


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Wear of preload, loosening of the mount, two modes, temperature, a poor map."""
    return make_stage(tmp_path_factory.mktemp("stage"), model_std=MODEL_STD)


def density_of(history: History, stage: Stage) -> LifeDensity:
    """Give the density of the first scenario."""
    likelihood = LifeLikelihood.of(history, stage)
    return LifeDensity.of(likelihood, likelihood.data.scenarios[0])


def coordinates(density: LifeDensity, n: int, seed: int = 1) -> FloatArray:
    """Draw coordinates inside the support."""
    y = density.draw_prior(np.random.default_rng(seed), 300)
    return y[np.isfinite(density.log_probability(y))][:n]


def test_narrowing_the_grid_keeps_the_posterior(stage: Stage) -> None:
    """Points of the grid that carry nothing can go: differences stay within a few hundredths."""
    density = density_of(rough_history(np.random.default_rng(10)), stage)
    y = coordinates(density, 40)
    full = density.log_probability(y)
    best = np.argsort(full)[-8:]
    narrowed = density.narrowed(y[best])
    less = narrowed.log_probability(y)[best]
    assert 0 < narrowed.grid.walk.size < density.grid.walk.size
    assert (less <= full[best]).all()
    assert np.max(full[best] - less) < 0.15
    # Of all of these together a hundredth is lost at most.
    shares = np.exp(less - full[best])
    assert 0.99 <= shares.mean() < 1


def test_no_life_inside_the_map_has_no_grid(stage: Stage) -> None:
    """Coordinates that are all outside of the map are refused, and have no density."""
    density = density_of(rough_history(np.random.default_rng(10)), stage)
    y = coordinates(density, 3)
    y[:, 0] = 50.0
    assert np.isneginf(density.log_probability(y)).all()
    with pytest.raises(NotEnoughData, match="no life of the prior stays inside the map"):
        density.narrowed(y)


def test_settings_lie_inside_their_grids(stage: Stage) -> None:
    """Averages of walk, noise scale and deviation lie inside their grids; χ² is no less than 0."""
    density = density_of(rough_history(np.random.default_rng(11)), stage)
    walk, scale, deviation, chi_square = density.settings(coordinates(density, 30))
    assert constants.WALKS[0] <= walk <= constants.WALKS[-1]
    assert 1 <= scale <= constants.NOISE_SCALES[-1]
    assert constants.DEVIATIONS[0] <= deviation <= constants.DEVIATIONS[-1]
    assert chi_square > 0


def test_settings_of_draws_are_the_mean_of_each(stage: Stage) -> None:
    """Every draw of a posterior tells of the settings alike, likely ones no more than others."""
    density = density_of(rough_history(np.random.default_rng(12)), stage)
    y = coordinates(density, 6)
    alone = [density.settings(draw[None])[:3] for draw in y]
    np.testing.assert_allclose(density.settings(y)[:3], np.mean(alone, axis=0))
    assert np.ptp(alone, axis=0).min() > 1e-6


def test_chi_square_of_a_life_as_stated_is_near_its_degrees_of_freedom(tmp_path: Path) -> None:
    """Data with the stated errors give χ² per degree of freedom near 1; doubled errors do not."""
    stage = make_stage(tmp_path, (FADING,), tail="")
    rng = np.random.default_rng(12)
    travel = np.linspace(0, 2e6, 60)
    x = np.log(1 - 1e-7 * travel)[:, None]
    clean = np.log(FREQUENCY[:2]) + true_drift(("guide_preload",), x)[:, :2]
    noise = 1e-3 * rng.standard_normal((60, 2))
    for factor, scale_is_one in ((1.0, True), (2.0, False)):
        density = density_of(make_history(clean + factor * noise, travel=travel), stage)
        _, scale, _, chi_square = density.settings(np.full((5, 1), 0.2))
        dof = 2 * 60 - 2 - 1
        assert abs(chi_square / dof - 1) < 5 * np.sqrt(2 / dof)
        assert (scale < 1.1) == scale_is_one


@pytest.fixture
def wandering(monkeypatch: pytest.MonkeyPatch) -> LifeSetting:
    """One point of the grid, at which health is far off its laws."""
    monkeypatch.setattr(constants, "WALKS", (1.5e-3,))
    monkeypatch.setattr(constants, "NOISE_SCALES", (1.0,))
    monkeypatch.setattr(constants, "NOISE_SCALE_PRIOR", (1.0,))
    monkeypatch.setattr(constants, "DEVIATIONS", (0.4,))
    monkeypatch.setattr(constants, "DEVIATION_PRIOR", (1.0,))
    return LifeSetting(1.5e-3, 1.0, 0.4)


def off_by_hand(
    density: LifeDensity, history: History, y: FloatArray, setting: LifeSetting, moment: float
) -> tuple[FloatArray, FloatArray]:
    """Condition the dense Gaussian of health about wear and loosening on one life."""
    clock = history.clock()[history.baseline :]
    health = density.scenario.health(density.scenario.natural(y[None]), clock)
    x = np.log(health[0])
    alone = np.stack([true_drift(NAMES, x * (np.arange(2) == j))[:, :2] for j in range(2)])
    belief = LifeBelief(
        slopes=np.array([SENSITIVITY[name][:2] for name in NAMES]),
        horizon=density.likelihood.data.horizon,
        model_std=MODEL_STD,
        intercept_std=constants.INTERCEPT_STD,
    )
    drift = true_drift(NAMES, x)[:, :2]
    return life_deviation(history, drift, alone, belief, setting, moment)


def test_deviations_are_those_of_a_dense_gaussian(stage: Stage, wandering: LifeSetting) -> None:
    """Mean and covariance given a life and its data: past, now and to come, to 1e-8."""
    history = rough_history(np.random.default_rng(13), baseline=2)
    density = density_of(history, stage)
    y = coordinates(density, 3)
    now = density.likelihood.data.now
    moments = np.array([0.0, 0.37 * now, now, 2.5 * now])
    x, _ = density.likelihood.path(density.scenario, y)
    mean, cov = density.likelihood.deviation(density.grid, 0, x, moments)
    assert mean.shape == (3, 4, 2)
    for i, point in enumerate(y):
        for m, moment in enumerate(moments):
            known = off_by_hand(density, history, point, wandering, moment)
            np.testing.assert_allclose(mean[i, m], known[0], rtol=1e-7, atol=1e-10)
            np.testing.assert_allclose(cov[i, m], known[1], rtol=1e-7, atol=1e-10)
    # What the data say lies behind; from now on variance grows as of a Wiener process.
    rate = wandering.deviation**2 / density.likelihood.data.horizon
    np.testing.assert_allclose(mean[:, 3], mean[:, 2], rtol=1e-9)
    np.testing.assert_allclose(
        cov[:, 3] - cov[:, 2], np.tile(1.5 * now * rate * np.eye(2), (3, 1, 1))
    )
    assert np.abs(cov[:, 2, 0, 1]).min() > 1e-5  # preload and mount trade off


def test_a_wrong_deviation_is_noticed(stage: Stage, wandering: LifeSetting) -> None:
    """Negative control: with a slightly larger deviation the numbers are others."""
    history = rough_history(np.random.default_rng(13))
    density = density_of(history, stage)
    y = coordinates(density, 1)
    moments = np.array([density.likelihood.data.now])
    x, _ = density.likelihood.path(density.scenario, y)
    mean, cov = density.likelihood.deviation(density.grid, 0, x, moments)
    wrong = replace(wandering, deviation=0.41)
    known = off_by_hand(density, history, y[0], wrong, density.likelihood.data.now)
    assert np.abs(mean[0, 0] / known[0] - 1).min() > 1e-3
    assert np.abs(np.diag(cov[0, 0]) / np.diag(known[1]) - 1).min() > 1e-3


def test_draws_of_deviations_have_their_mean_and_covariance(
    stage: Stage, wandering: LifeSetting
) -> None:
    """Means and variances of draws of one life lie within five standard errors."""
    history = rough_history(np.random.default_rng(14))
    density = density_of(history, stage)
    n = 4000
    one = coordinates(density, 1)
    moments = np.array([0.0, density.likelihood.data.now])
    off, rate = density.deviations(np.tile(one, (n, 1)), moments, np.random.default_rng(1))
    mean, cov = off_by_hand(density, history, one[0], wandering, density.likelihood.data.now)
    assert np.abs(off[:, 0]).max() < 1e-6  # the baseline is what health is measured against
    std = np.sqrt(np.diag(cov))
    assert (np.abs(off[:, 1].mean(axis=0) - mean) < 5 * std / np.sqrt(n)).all()
    assert (np.abs(np.cov(off[:, 1].T) - cov) < 8 / np.sqrt(n) * np.outer(std, std)).all()
    assert (np.abs(off[:, 1].mean(axis=0) - 1.2 * mean) > 5 * std / np.sqrt(n)).any()
    np.testing.assert_allclose(rate, wandering.deviation**2 / density.likelihood.data.horizon)


def test_points_of_the_grid_are_drawn_by_their_weight(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Draws without a deviation are as many as their weight says, and are not off at all."""
    monkeypatch.setattr(constants, "WALKS", (1.5e-3,))
    density = density_of(rough_history(np.random.default_rng(15)), stage)
    y = coordinates(density, 1)
    n = 4000
    now = np.array([density.likelihood.data.now])
    off, rate = density.deviations(np.tile(y, (n, 1)), now, np.random.default_rng(2))
    still = (rate == 0).all(axis=1)
    assert (off[still] == 0).all()
    assert (off[~still] != 0).all()
    weight = density.weights(y)
    expected = weight[density.grid.deviation == 0].sum()
    assert 0.05 < expected < 0.95
    assert abs(still.mean() - expected) < 5 * np.sqrt(expected * (1 - expected) / n)


def test_only_what_has_a_law_deviates(tmp_path: Path, wandering: LifeSetting) -> None:
    """A parameter that keeps its value is never off it, nor will be, seen by the modes or not."""
    still = MOUNT[: MOUNT.index("[parameter.law]")]
    stage = make_stage(tmp_path, (FADING, still, FOOT))
    density = density_of(rough_history(np.random.default_rng(16)), stage)
    now = np.array([density.likelihood.data.now])
    off, rate = density.deviations(coordinates(density, 50), now, np.random.default_rng(3))
    assert (off[:, 0, 0] != 0).all()
    assert (off[:, 0, 1:] == 0).all()
    assert (rate[:, 0] > 0).all()
    assert (rate[:, 1:] == 0).all()


def test_a_course_without_coordinates_has_draws_of_one_life(
    tmp_path: Path, wandering: LifeSetting
) -> None:
    """Where no law is followed but one was possible, health still wanders."""
    several = FADING.replace("law = ", "law = [").replace("} }\n", '} }, { kind = "none" }]\n')
    stage = make_stage(tmp_path, (several,))
    likelihood = LifeLikelihood.of(rough_history(np.random.default_rng(17)), stage)
    density = LifeDensity.of(likelihood, likelihood.data.scenarios[1])
    assert density.scenario.n_dim == 0
    y = np.empty((2000, 0))
    assert np.isfinite(density.log_probability(y[:1])).all()
    off, rate = density.deviations(y, np.array([likelihood.data.now]), np.random.default_rng(4))
    assert off.shape == (2000, 1, 1)
    assert np.unique(off).size == 2000
    assert (rate > 0).all()
