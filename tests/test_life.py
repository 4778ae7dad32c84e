"""The likelihood of a whole life against one dense multivariate normal."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lmshealth import life
from lmshealth.arrays import FloatArray
from lmshealth.errors import NotEnoughData
from lmshealth.life import LifeLikelihood
from lmshealth.stage import Stage
from lmshealth.tracks import History
from tests.lives import (
    FADING,
    FOOT,
    FREQUENCY,
    MOUNT,
    PRELOAD,
    make_history,
    make_stage,
    rough_history,
    true_drift,
)
from tests.oracles import life_log_likelihood

NAMES = ("guide_preload", "mount_stiffness")


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Wear of preload, loosening of the mount, two modes, temperature."""
    return make_stage(tmp_path_factory.mktemp("stage"))


def coordinates(likelihood: LifeLikelihood, n: int = 6, seed: int = 1) -> FloatArray:
    """Draw coordinates inside the support."""
    y = likelihood.draw_prior(np.random.default_rng(seed), 200)
    return y[np.isfinite(likelihood.log_probability(y))][:n]


def healths(likelihood: LifeLikelihood, y: FloatArray, clock: FloatArray) -> FloatArray:
    """Preload and mount by their laws written out, shape (n_logs, 2)."""
    wear, loose = (
        law.natural(part[None], likelihood.now)[0]
        for law, part in zip(likelihood.laws, (y[:2], y[2:]), strict=True)
    )
    preload = (1 - (clock / wear[0]) ** wear[1]) ** 1.5
    mount = loose[0] + (1 - loose[0]) * np.exp(-clock / loose[1])
    return np.column_stack([preload, mount])


def book(history: History, likelihood: LifeLikelihood, y: FloatArray, model_std: float) -> float:
    """Log likelihood of one set of coordinates by the dense oracle."""
    x = np.log(healths(likelihood, y, history.clock()[history.baseline :]))
    alone = np.stack([true_drift(NAMES, x * (np.arange(2) == j))[:, :2] for j in range(2)])
    return life_log_likelihood(
        history,
        true_drift(NAMES, x)[:, :2],
        alone,
        model_std=model_std,
        walks=life._WALKS,
        scales=life._NOISE_SCALES,
        scale_prior=life._NOISE_SCALE_PRIOR,
        intercept_std=life._INTERCEPT_STD,
    )


@pytest.mark.parametrize("model_std", [0.0, 0.05, 0.3])
@pytest.mark.parametrize("baseline", [0, 3])
def test_likelihood_is_the_dense_multivariate_normal(
    tmp_path: Path, model_std: float, baseline: int
) -> None:
    """Missing data, cross terms, unknown temperature, map error and grid: equal to 1e-9."""
    stage = make_stage(tmp_path, model_std=model_std)
    history = rough_history(np.random.default_rng(2), baseline=baseline)
    likelihood = LifeLikelihood(history, stage)
    y = coordinates(likelihood)
    found = likelihood.log_probability(y) - likelihood.log_prior(y)
    known = np.array([book(history, likelihood, point, model_std) for point in y])
    np.testing.assert_allclose(np.diff(found), np.diff(known), rtol=1e-9, atol=1e-8)


def test_a_wrong_map_error_is_noticed(stage: Stage) -> None:
    """Negative control: the oracle with another map error differs by far more than rounding."""
    history = rough_history(np.random.default_rng(2))
    likelihood = LifeLikelihood(history, stage)
    y = coordinates(likelihood)
    found = likelihood.log_probability(y) - likelihood.log_prior(y)
    known = np.array([book(history, likelihood, point, 0.0501) for point in y])
    assert np.abs(np.diff(found) - np.diff(known)).max() > 1e-5


def test_walkers_do_not_see_each_other(stage: Stage) -> None:
    """A batch equals its walkers one at a time, also where some are impossible."""
    likelihood = LifeLikelihood(rough_history(np.random.default_rng(3)), stage)
    y = likelihood.draw_prior(np.random.default_rng(4), 40)
    y[5, 0] = 50.0  # preload gone long before now
    together = likelihood.log_probability(y)
    alone = np.concatenate([likelihood.log_probability(point[None]) for point in y])
    np.testing.assert_allclose(together, alone, rtol=1e-11)
    assert np.isneginf(together[5])
    assert np.isfinite(together).any()


def test_lives_that_leave_the_map_or_the_prior_are_impossible(stage: Stage) -> None:
    """Preload below the map, or a floor below 0 or outside its prior: minus infinity, no error."""
    likelihood = LifeLikelihood(rough_history(np.random.default_rng(5)), stage)
    inside = coordinates(likelihood, 1)[0]
    now = likelihood.now
    wear, loose = likelihood.laws
    worn, below, low = inside.copy(), inside.copy(), inside.copy()
    worn[0] = 0.5  # s_w < now
    below[2] = 1.0  # floor below 0
    life_m = loose.natural(inside[None, 2:], now)[0, 1]
    low[2] = np.log(0.9 * -np.expm1(-now / life_m))  # floor 0.1, prior from 0.3
    assert wear.natural(worn[None, :2], now)[0, 0] < now
    found = likelihood.log_probability(np.array([inside, worn, below, low]))
    assert np.isfinite(found).tolist() == [True, False, False, False]
    assert np.isneginf(found[1:]).all()


def test_the_intercept_is_free(stage: Stage) -> None:
    """Moving every frequency by the same part in a hundred changes no difference of likelihood."""
    history = rough_history(np.random.default_rng(6))
    moved = replace(history, ln_frequency=history.ln_frequency + 0.01)
    one, two = LifeLikelihood(history, stage), LifeLikelihood(moved, stage)
    y = coordinates(one)
    np.testing.assert_allclose(one.log_probability(y), two.log_probability(y), atol=1e-8)


def test_an_empty_log_changes_nothing(stage: Stage) -> None:
    """A log without any mode, at a known temperature, leaves the likelihood."""
    history = rough_history(np.random.default_rng(7))
    temperature = np.nan_to_num(history.covariates["temperature_c"], nan=21.0)
    history = replace(history, covariates={"temperature_c": temperature})
    keep = np.arange(len(history.logs)) != 4
    without = make_history(
        history.ln_frequency[keep],
        travel=history.travel[keep],
        cov=history.cov[keep],
        temperature=temperature[keep],
    )
    one, two = LifeLikelihood(history, stage), LifeLikelihood(without, stage)
    y = coordinates(one)
    np.testing.assert_allclose(one.log_probability(y), two.log_probability(y), rtol=1e-11)


def test_a_mode_that_vanished_before_the_baseline_is_left_out(stage: Stage) -> None:
    """A mode without any estimate since the baseline adds nothing, and no warning."""
    ln_f = np.log(FREQUENCY[:2]) + 1e-3 * np.random.default_rng(8).standard_normal((8, 2))
    ln_f[2:, 1] = np.nan
    likelihood = LifeLikelihood(make_history(ln_f, baseline=2), stage)
    assert likelihood.y.size == 6
    assert np.isfinite(likelihood.log_probability(coordinates(likelihood))).all()


def test_a_covariate_that_is_not_recorded_is_ignored(stage: Stage) -> None:
    """Without any temperature the likelihood is that of a stage without the covariate."""
    ln_f = np.log(FREQUENCY[:2]) + 1e-3 * np.random.default_rng(9).standard_normal((6, 2))
    bare = LifeLikelihood(make_history(ln_f), stage)
    reference = LifeLikelihood(make_history(ln_f, temperature=np.full(6, 21.0)), stage)
    y = coordinates(bare)
    np.testing.assert_allclose(bare.log_probability(y), reference.log_probability(y), rtol=1e-12)


def test_narrowing_the_grid_keeps_the_likelihood(stage: Stage) -> None:
    """Points of the grid that carry nothing can go: differences stay within a few hundredths."""
    likelihood = LifeLikelihood(rough_history(np.random.default_rng(10)), stage)
    y = coordinates(likelihood, 40)
    full = likelihood.log_probability(y)
    best = np.argsort(full)[-8:]
    n = likelihood.grid.walk.size
    likelihood.narrow(y[best])
    less = likelihood.log_probability(y)[best]
    assert 0 < likelihood.grid.walk.size < n
    assert np.ptp(less - full[best]) < 0.15


def test_settings_count_data_and_parameters(stage: Stage) -> None:
    """Degrees of freedom are data minus law parameters; averages lie inside their grids."""
    likelihood = LifeLikelihood(rough_history(np.random.default_rng(11)), stage)
    walk, scale, chi_square, dof = likelihood.settings(coordinates(likelihood, 30))
    assert dof == 2 * 10 - 4 - 4  # four estimates are missing, four law parameters
    assert life._WALKS[0] <= walk <= life._WALKS[-1]
    assert 1 <= scale <= life._NOISE_SCALES[-1]
    assert chi_square > 0


def test_settings_of_draws_are_the_mean_of_each(stage: Stage) -> None:
    """Every draw of a posterior tells of walk and noise alike, likely ones no more than others."""
    likelihood = LifeLikelihood(rough_history(np.random.default_rng(12)), stage)
    y = coordinates(likelihood, 6)
    alone = [likelihood.settings(draw[None])[:2] for draw in y]
    np.testing.assert_allclose(likelihood.settings(y)[:2], np.mean(alone, axis=0))
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
        likelihood = LifeLikelihood(make_history(clean + factor * noise, travel=travel), stage)
        _, scale, chi_square, dof = likelihood.settings(np.full((5, 1), 0.2))
        assert abs(chi_square / dof - 1) < 5 * np.sqrt(2 / dof)
        assert (scale < 1.1) == scale_is_one


def test_laws_without_parameters_take_no_coordinate(tmp_path: Path) -> None:
    """An unchanging parameter among others keeps health 1 and needs no coordinate."""
    stage = make_stage(tmp_path, (PRELOAD, FOOT, MOUNT))
    likelihood = LifeLikelihood(rough_history(np.random.default_rng(13)), stage)
    assert likelihood.n_dim == 4
    y = coordinates(likelihood, 5)
    assert [part.shape for part in likelihood.split(y)] == [(5, 2), (5, 0), (5, 2)]
    health = likelihood.health(y, np.array([0.0, likelihood.now]))
    assert health.shape == (5, 2, 3)
    assert (health[:, :, 1] == 1).all()
    np.testing.assert_allclose(health[:, 0], 1)


@pytest.mark.parametrize(
    ("ln_f", "travel"),
    [
        (np.log(np.tile(FREQUENCY[:2], (2, 1))), None),
        (np.log(np.tile(FREQUENCY[:2], (5, 1))), np.full(5, 1e5)),
        (np.where(np.arange(6)[:, None] < 2, np.log(FREQUENCY[:2]), np.nan), None),
    ],
    ids=["two-logs", "no-travel", "two-with-modes"],
)
def test_a_life_too_short_is_refused(
    stage: Stage, ln_f: FloatArray, travel: FloatArray | None
) -> None:
    """Fewer than three logs with modes, or no travel, are no life; the error says so."""
    with pytest.raises(NotEnoughData, match="at least 3 logs and some travel"):
        LifeLikelihood(make_history(ln_f, travel=travel), stage)


def test_baseline_units_do_not_matter(tmp_path: Path) -> None:
    """A parameter in kN with baseline 1 kN is the same as a fraction: paths are relative."""
    stage = make_stage(tmp_path, (FADING,))
    likelihood = LifeLikelihood(rough_history(np.random.default_rng(14)), stage)
    y = np.array([[0.1], [0.3]])
    health = likelihood.health(y, np.array([likelihood.now]))
    np.testing.assert_allclose(health[:, 0, 0], [0.9, 0.7])


def test_many_logs_are_told_by_few_nodes(stage: Stage) -> None:
    """Of 80 logs two dozen nodes are enough, and what follows between them is right to 1e-7."""
    rng = np.random.default_rng(12)
    n = 80
    history = make_history(
        np.log(FREQUENCY[:2]) + 1e-3 * rng.standard_normal((n, 2)),
        temperature=21 + rng.standard_normal(n),
    )
    likelihood = LifeLikelihood(history, stage)
    assert likelihood.nodes.size < 24
    y = coordinates(likelihood, 20, seed=5)
    x = np.log([healths(likelihood, point, likelihood.clock) for point in y])
    drift = np.moveaxis(true_drift(NAMES, x)[..., :2], 1, 2)
    told = drift[..., likelihood.nodes] @ likelihood.weights.T
    np.testing.assert_allclose(told, drift, atol=1e-7)
    # Negative control: a node less than half of them does not tell.
    few = np.linalg.lstsq(drift[..., likelihood.nodes[:6]].reshape(-1, 6), drift.reshape(-1, n))[0]
    told = drift[..., likelihood.nodes[:6]] @ few
    assert np.abs(told - drift).max() > 1e-6
    found = likelihood.log_probability(y[:2]) - likelihood.log_prior(y[:2])
    known = np.array([book(history, likelihood, point, 0.05) for point in y[:2]])
    np.testing.assert_allclose(np.diff(found), np.diff(known), atol=1e-5)
