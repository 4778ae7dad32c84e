"""Likelihood and posterior density of a life against one dense multivariate normal."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from scipy import stats

from lmshealth._private.arrays import FloatArray
from lmshealth.errors import NotEnoughData
from lmshealth.life import constants
from lmshealth.life.posterior import likelihood
from lmshealth.life.posterior.likelihood import NO_MODE, LifeDensity, LifeLikelihood, scatter_prior
from lmshealth.life.posterior.scenarios import Scenario
from lmshealth.stage.constants import MAP_ERRORS
from lmshealth.stage.description import LifeSpec, Stage
from lmshealth.tracking.history import History
from tests.lives import (
    FADING,
    FOOT,
    FREQUENCY,
    LAWS_ALONE,
    MOUNT,
    PRELOAD,
    SENSITIVITY,
    STILL_MOUNT,
    TEMPERATURE,
    make_history,
    make_stage,
    rough_history,
    since,
    true_drift,
)
from tests.oracles import (
    LifeBelief,
    LifeSetting,
    life_deviation,
    life_log_likelihood,
    life_lone_drift,
)

NAMES = ("guide_preload", "mount_stiffness")
MODEL_STD, COMMON_STD = 0.3, 0.2
NO_PRELOAD = PRELOAD.replace("law = { kind", "law = [{ kind").replace("} }\n", "} }, NONE]\n")
NO_PRELOAD = NO_PRELOAD.replace("NONE", '{ kind = "none", weight = 3 }')


@pytest.fixture(autouse=True)
def exact(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Choose nodes that give the drifts of all lives to rounding, unless a test is of few."""
    if "few_nodes" not in request.fixturenames:
        monkeypatch.setattr(likelihood, "_RESIDUAL", 1e-9)
        monkeypatch.setattr(likelihood, "_NEAR", 1e9)


@pytest.fixture
def few_nodes() -> None:
    """Keep the nodes as they are chosen by default."""


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Wear of preload, loosening of the mount, two modes, temperature."""
    return make_stage(tmp_path_factory.mktemp("stage"))


@pytest.fixture(scope="module")
def poor_map(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Make the same stage with a poor map."""
    tail = TEMPERATURE + LAWS_ALONE
    folder = tmp_path_factory.mktemp("poor")
    return make_stage(folder, model_std=MODEL_STD, common_std=COMMON_STD, tail=tail)


def density_of(history: History, stage: Stage) -> LifeDensity:
    """Return the density of the first scenario."""
    likelihood = LifeLikelihood.of(history, stage)
    return LifeDensity(likelihood, likelihood.data.scenarios[0], likelihood.grid)


def coordinates(density: LifeDensity, n: int = 6, seed: int = 1) -> FloatArray:
    """Draw coordinates inside the support."""
    y = density.scenario.draw(np.random.default_rng(seed), 300)
    return y[np.isfinite(density.log_probability(y))][:n]


def healths(scenario: Scenario, y: FloatArray, clock: FloatArray) -> FloatArray:
    """Preload and mount by their laws and jumps written out, shape (n_logs, 2)."""
    columns = []
    for path, part in zip(scenario.paths, scenario.split(scenario.natural(y[None])), strict=True):
        own, column = part[0], []
        for s in clock:
            since = max(s - path.begin, 0.0)
            if path.law.kind == "hertz-wear":
                health = (1 - (since / own[0]) ** own[1]) ** 1.5
            elif path.law.kind == "loosening":
                health = own[0] + (1 - own[0]) * np.exp(-since / own[1])
            elif path.law.kind == "free":
                bent = own[2] * since ** own[1]
                settled = -np.expm1(-bent) / bent if bent else 1.0
                health = np.exp(own[0] * since ** own[1] * settled)
            else:
                health = 1.0
            for k, step in enumerate(path.steps):
                health *= own[len(path.law.names) + k] if s > step else 1.0
            column.append(health)
        columns.append(column)
    return np.array(columns).T


def believed(model_std: float, common_std: float = 0.0) -> LifeBelief:
    """State what is believed of a life, with errors of the map, of each mode and common."""
    slopes = np.array([SENSITIVITY[name][:2] for name in NAMES])
    return LifeBelief(slopes, model_std, constants.INTERCEPT_STD, common_std)


def settings(life: LifeSpec, *, in_doubt: bool = False) -> list[LifeSetting]:
    """List the points of the grid, with modes that move alone, a common wander, a first log."""
    lone_mode, common = life.lone_mode, life.common_wander
    ways: list[tuple[float, float, int | None, float]] = [
        (walk, p * (1 - common - 2 * lone_mode), None, 0.0)
        for walk, p in zip(constants.WALK_STDS, constants.WALK_PRIOR, strict=True)
    ]
    if lone_mode:
        ways += [(walk, lone_mode * p, i, 0.0) for i in (0, 1) for walk, p in constants.LONE_WALKS]
    if common:
        walks = product((1e-3, 3e-3), constants.LONE_WALKS)
        ways += [(walk, common * p / 2, None, e) for e, (walk, p) in walks]
    scales = zip(constants.NOISE_SCALES, constants.NOISE_SCALE_PRIOR, strict=True)
    deviations = zip(constants.DEVIATION_STDS, constants.DEVIATION_PRIOR, strict=True)
    whole = [
        LifeSetting(walk, scale, deviation, r * p * q, lone, e)
        for (walk, r, lone, e), (scale, p), (deviation, q) in product(ways, scales, deviations)
    ]
    if not in_doubt:
        return whole
    alternatives: dict[Literal["", "each", "alike"], float] = {"": 0.5, "each": 0.25, "alike": 0.25}
    return [
        replace(one, prior=one.prior * p, error=how)
        for how, p in alternatives.items()
        for one in whole
    ]


def drifts_of(
    density: LifeDensity, y: FloatArray, clock: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Drifts of one set of coordinates, and those of each parameter alone, by the formula."""
    x = np.log(healths(density.scenario, y, clock))
    alone = np.stack([true_drift(NAMES, x * (np.arange(2) == j))[:, :2] for j in range(2)])
    return true_drift(NAMES, x)[:, :2], alone


def book_by_map_error(
    history: History, density: LifeDensity, y: FloatArray, *stds: float
) -> list[float]:
    """Log likelihood and prior of each error of the map, of one life, by the dense oracle."""
    drift, alone = drifts_of(density, y, history.clock()[history.baseline :])
    life = density.likelihood.data.stage.description.life
    grid = settings(life, in_doubt=bool(history.in_doubt))
    beliefs = [believed(*(scale * std for std in stds)) for scale, _ in MAP_ERRORS]
    constant = density.likelihood.data.y.size / 2 * np.log(2 * np.pi)
    return [
        constant + np.log(weight) + life_log_likelihood(history, drift, alone, belief, grid)
        for belief, (_, weight) in zip(beliefs, MAP_ERRORS, strict=True)
    ]


def book(history: History, density: LifeDensity, y: FloatArray, *stds: float) -> float:
    """Log likelihood of one set of coordinates by the dense oracle."""
    return float(np.logaddexp.reduce(book_by_map_error(history, density, y, *stds)))


@pytest.fixture
def short_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    """Average over two values each, so that a plainly written oracle takes no long time."""
    monkeypatch.setattr(constants, "WALK_STDS", (5e-4, 5e-3))
    monkeypatch.setattr(constants, "WALK_PRIOR", (0.7, 0.3))
    monkeypatch.setattr(constants, "LONE_WALKS", ((5e-4, 0.6), (1.5e-3, 0.4)))
    monkeypatch.setattr(constants, "NOISE_SCALES", (1.0, 1.5))
    monkeypatch.setattr(constants, "NOISE_SCALE_PRIOR", (0.9, 0.1))
    monkeypatch.setattr(constants, "DEVIATION_STDS", (0.0, 0.15))
    monkeypatch.setattr(constants, "DEVIATION_PRIOR", (0.6, 0.4))


@pytest.mark.usefixtures("short_grid")
@pytest.mark.parametrize("stds", [(0.0, 0.0), (0.05, 0.0), (0.3, 0.0), (0.05, 0.2), (0.0, 0.2)])
@pytest.mark.parametrize("baseline", [0, 3])
def test_likelihood_is_the_dense_multivariate_normal(
    tmp_path: Path, stds: tuple[float, float], baseline: int
) -> None:
    """Missing data, cross terms, unknown temperature, map errors, deviation and grid: to 1e-9."""
    stage = make_stage(tmp_path, model_std=stds[0], common_std=stds[1])
    history = rough_history(np.random.default_rng(2), baseline=baseline)
    history.covariates["temperature_c"][8:] = np.nan  # its sensor has failed since
    density = density_of(history, stage)
    y = coordinates(density, 4)
    found = density.log_probability(y) - density.scenario.log_prior(y)
    # A map that is declared as exact is so to 1e-4.
    own, common = max(stds[0], 1e-4), stds[1]
    known = np.array([book(history, density, point, own, common) for point in y])
    np.testing.assert_allclose(found, known, rtol=1e-9, atol=1e-7)


@pytest.mark.usefixtures("short_grid")
@pytest.mark.parametrize("in_doubt", [(0,), (0, 1)])
@pytest.mark.parametrize("baseline", [0, 5])
def test_a_first_log_in_doubt_is_right_or_in_error(
    poor_map: Stage, in_doubt: tuple[int, ...], baseline: int
) -> None:
    """The likelihood is the mean over its alternatives, as by the dense oracle, to 1e-9."""
    history = rough_history(np.random.default_rng(2), baseline=baseline)
    doubted = replace(history, in_doubt=in_doubt)
    density, certain = density_of(doubted, poor_map), density_of(history, poor_map)
    y = coordinates(density, 3)
    found = density.log_probability(y) - density.scenario.log_prior(y)
    known = np.array([book(doubted, density, point, MODEL_STD, COMMON_STD) for point in y])
    np.testing.assert_allclose(found, known, rtol=1e-9, atol=1e-7)
    assert np.abs(found - certain.log_probability(y) + certain.scenario.log_prior(y)).min() > 0.01


@pytest.mark.usefixtures("short_grid")
def test_every_scenario_after_a_step_is_the_dense_normal(tmp_path: Path) -> None:
    """Laws or none, steps, restarted and free laws: values, not only differences, compare."""
    stage = make_stage(tmp_path, (NO_PRELOAD, MOUNT))
    history = rough_history(np.random.default_rng(3))
    history = replace(history, steps=(since("step", 5, 10),))
    likelihood = LifeLikelihood.of(history, stage)
    assert likelihood.data.steps == (np.mean(history.clock()[4:6]),)
    assert len(likelihood.data.scenarios) == 5 * 4 + 3 * 2
    found, known = [], []
    for scenario in likelihood.data.scenarios:
        density = LifeDensity(likelihood, scenario, likelihood.grid)
        y = coordinates(density, 1)
        found.append((density.log_probability(y) - scenario.log_prior(y))[0])
        known.append(book(history, density, y[0], 0.05))
    np.testing.assert_allclose(found, known, rtol=1e-9, atol=1e-7)
    assert np.ptp(found) > 0.1


@pytest.mark.usefixtures("short_grid")
@pytest.mark.parametrize("model_std", [0.05, 0.3])
def test_each_error_of_the_map_has_its_own_dense_normal(tmp_path: Path, model_std: float) -> None:
    """The axis of map errors is not averaged: terms and probabilities are those of each error."""
    stage = make_stage(tmp_path, model_std=model_std)
    history = rough_history(np.random.default_rng(4), baseline=1)
    density = density_of(history, stage)
    y = coordinates(density, 3)
    x, _ = density.likelihood.path(density.scenario, y)
    terms = density.likelihood.terms(density.grid, x)
    assert terms.shape == (len(MAP_ERRORS), density.grid.walk.size, 3)
    found = np.logaddexp.reduce(terms, axis=1).T
    known = np.array([book_by_map_error(history, density, point, model_std) for point in y])
    np.testing.assert_allclose(found, known, rtol=1e-9, atol=1e-7)
    assert np.ptp(known, axis=1).min() > 0.1
    share = np.exp(known - np.logaddexp.reduce(known, axis=1)[:, None])
    np.testing.assert_allclose(density.point_weights(y).sum(axis=1).T, share, atol=1e-7)


@pytest.mark.usefixtures("short_grid")
@pytest.mark.parametrize("what", ["map error", "common error", "deviation", "lone mode"])
def test_what_is_wrong_is_noticed(stage: Stage, what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Negative control: the oracle with another error differs by far more than rounding."""
    history = rough_history(np.random.default_rng(2))
    density = density_of(history, stage)
    y = coordinates(density)
    found = density.log_probability(y) - density.scenario.log_prior(y)
    if what == "deviation":
        monkeypatch.setattr(constants, "DEVIATION_STDS", (0.0, 0.151))
    if what == "lone mode":
        monkeypatch.setattr("tests.oracles.lone_drift", lambda t, u, now, _: 4e-4 * t * u / now**2)
    stds = {"map error": (0.0501, 0.0), "common error": (0.05, 0.002)}.get(what, (0.05, 0.0))
    known = np.array([book(history, density, point, *stds) for point in y])
    assert np.abs(found - known).max() > 1e-5


def test_walkers_are_independent(stage: Stage) -> None:
    """A batch equals its walkers one at a time, also where some are impossible."""
    density = density_of(rough_history(np.random.default_rng(3)), stage)
    y = density.scenario.draw(np.random.default_rng(4), 40)
    y[5, 0] = 50.0  # preload gone long before now
    together = density.log_probability(y)
    alone = np.concatenate([density.log_probability(point[None]) for point in y])
    np.testing.assert_allclose(together, alone, rtol=1e-11)
    assert np.isneginf(together[5])
    assert np.isfinite(together).any()


def test_lives_that_leave_the_map_or_the_prior_are_impossible(stage: Stage) -> None:
    """Preload below the map, or a floor below 0 or outside its prior: minus infinity, no error."""
    density = density_of(rough_history(np.random.default_rng(5)), stage)
    inside = coordinates(density, 1)[0]
    now = density.likelihood.data.now
    wear, loose = (path.law for path in density.scenario.paths)
    worn, below, low = inside.copy(), inside.copy(), inside.copy()
    worn[0] = 0.5  # s_w < now
    below[2] = 1.0  # floor below 0
    life_m = loose.natural(inside[None, 2:], now)[0, 1]
    low[2] = np.log(0.9 * -np.expm1(-now / life_m))  # floor 0.1, prior from 0.3
    assert wear.natural(worn[None, :2], now)[0, 0] < now
    found = density.log_probability(np.array([inside, worn, below, low]))
    assert np.isfinite(found).tolist() == [True, False, False, False]
    assert np.isneginf(found[1:]).all()


def test_reported_errors_and_exact_laws_are_the_most_probable(stage: Stage) -> None:
    """Larger errors and larger deviations are the less probable beforehand."""
    scatter = scatter_prior(stage)
    for prior in (scatter.noise_scale, scatter.deviation):
        assert sum(prior) == pytest.approx(1)
        assert prior[0] > 0.5
        assert (np.diff(prior) < 0).all()


def test_the_intercept_is_free(stage: Stage) -> None:
    """Moving every frequency by the same part in a hundred changes no difference of likelihood."""
    history = rough_history(np.random.default_rng(6))
    moved = replace(history, ln_frequency=history.ln_frequency + 0.01)
    one, two = density_of(history, stage), density_of(moved, stage)
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
    one, two = density_of(history, stage), density_of(without, stage)
    y = coordinates(one)
    np.testing.assert_allclose(one.log_probability(y), two.log_probability(y), rtol=1e-11)


def test_a_mode_that_vanished_before_the_baseline_is_left_out(stage: Stage) -> None:
    """A mode without any estimate since the baseline adds nothing, and no warning."""
    ln_f = np.log(FREQUENCY[:2]) + 1e-3 * np.random.default_rng(8).standard_normal((8, 2))
    ln_f[2:, 1] = np.nan
    density = density_of(make_history(ln_f, baseline=2), stage)
    assert density.likelihood.data.y.size == 6
    assert np.isfinite(density.log_probability(coordinates(density))).all()


def test_a_covariate_that_is_not_recorded_is_ignored(stage: Stage) -> None:
    """Without any temperature the likelihood is that of a stage without the covariate."""
    ln_f = np.log(FREQUENCY[:2]) + 1e-3 * np.random.default_rng(9).standard_normal((6, 2))
    bare = density_of(make_history(ln_f), stage)
    reference = density_of(make_history(ln_f, temperature=np.full(6, 21.0)), stage)
    y = coordinates(bare)
    np.testing.assert_allclose(bare.log_probability(y), reference.log_probability(y), rtol=1e-12)


def test_laws_without_parameters_take_no_coordinate(tmp_path: Path) -> None:
    """An unchanging parameter among others keeps health 1 and needs no coordinate."""
    stage = make_stage(tmp_path, (PRELOAD, FOOT, MOUNT))
    density = density_of(rough_history(np.random.default_rng(13)), stage)
    scenario = density.scenario
    assert scenario.n_dim == 4
    y = coordinates(density, 5)
    assert [part.shape for part in scenario.split(y)] == [(5, 2), (5, 0), (5, 2)]
    health = scenario.health(scenario.natural(y), np.array([0.0, density.likelihood.data.now]))
    assert health.shape == (5, 2, 3)
    assert (health[:, :, 1] == 1).all()
    np.testing.assert_allclose(health[:, 0], 1)
    np.testing.assert_array_equal(density.likelihood.data.free, [1, 0, 1])
    assert (density.likelihood.data.sensitivity[:, 1] == 0).all()


def test_a_parameter_without_law_does_not_deviate(tmp_path: Path) -> None:
    """A parameter that only keeps its value adds nothing to the covariance, seen or not."""
    history = rough_history(np.random.default_rng(13))
    alone = LifeLikelihood.of(history, make_stage(tmp_path / "one", (PRELOAD,)))
    with_constant = LifeLikelihood.of(history, make_stage(tmp_path / "two", (PRELOAD, STILL_MOUNT)))
    free = LifeLikelihood.of(history, make_stage(tmp_path / "three", (PRELOAD, MOUNT)))
    deviation = alone.covariance.deviation
    np.testing.assert_allclose(with_constant.covariance.deviation, deviation, rtol=1e-9)
    assert (free.covariance.deviation > 1.1 * deviation)[deviation > 0].all()


@pytest.mark.parametrize("n", [3, 4])
def test_a_life_of_many_steps_is_refused(stage: Stage, n: int) -> None:
    """Three jumps since the baseline are as many as laws hold over; those before do not count."""
    history = rough_history(np.random.default_rng(14), baseline=2)
    steps = [since("step", k, 10) for k in (1, *range(4, 4 + n))]
    history = replace(history, steps=tuple(steps))
    if n == 3:
        likelihood = LifeLikelihood.of(history, stage)
        assert len(likelihood.data.steps) == 3
        assert likelihood.data.scenarios[0].n_dim == 4 + 2 * 3
        return
    with pytest.raises(NotEnoughData, match=r"jumped 4 times.*declare a new baseline"):
        LifeLikelihood.of(history, stage)


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
    """Fewer than three logs with modes, or no travel, are refused with the reason."""
    with pytest.raises(NotEnoughData, match="at least 3 logs and some travel"):
        LifeLikelihood.of(make_history(ln_f, travel=travel), stage)


def test_baseline_units_do_not_matter(tmp_path: Path) -> None:
    """A parameter in kN with baseline 1 kN is the same as a fraction: paths are relative."""
    stage = make_stage(tmp_path, (FADING,))
    density = density_of(rough_history(np.random.default_rng(14)), stage)
    scenario, y = density.scenario, np.array([[0.1], [0.3]])
    health = scenario.health(scenario.natural(y), np.array([density.likelihood.data.now]))
    np.testing.assert_allclose(health[:, 0, 0], [0.9, 0.7])


@pytest.mark.slow
@pytest.mark.usefixtures("short_grid")
def test_few_nodes_give_the_drifts_of_many_logs(stage: Stage, few_nodes: None) -> None:
    """Of 80 logs two dozen nodes give the drifts of 99 % of plausible lives to 3e-5.

    Evidences are right to 5e-3, and log likelihoods to 1e-2 in the mean square of a posterior.
    """
    rng = np.random.default_rng(12)
    n = 80
    loss = np.column_stack([np.linspace(1.0, 0.8, n), np.linspace(1.0, 0.9, n)])
    drift = true_drift(NAMES, np.log(loss))[:, :2]
    history = make_history(
        np.log(FREQUENCY[:2]) + drift + 1e-3 * rng.standard_normal((n, 2)),
        temperature=21 + rng.standard_normal(n),
    )
    model = LifeLikelihood.of(history, stage)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(likelihood, "_RESIDUAL", 1e-9)
        patch.setattr(likelihood, "_NEAR", 1e9)
        exact_model = LifeLikelihood.of(history, stage)
    assert model.basis.nodes.size < exact_model.basis.nodes.size < 24
    off, rough = [], []
    for scenario in model.data.scenarios:
        density = LifeDensity(model, scenario, model.grid)
        y = scenario.draw(np.random.default_rng(5), 10_000)
        y = y[model.path(scenario, y)[1]]
        x = np.log(scenario.health(scenario.natural(y), model.data.clock))
        drifts = np.moveaxis(true_drift(NAMES, x)[..., :2], 1, 2)
        plausible = np.abs(drifts[:, :, -1] - drift[-1]).max(axis=1) < 3e-3
        assert plausible.sum() > 10
        drifts, y = drifts[plausible], y[plausible]
        nodes, weights = model.basis.nodes, model.basis.weights
        off.append(np.abs(drifts[..., nodes] @ weights.T - drifts).max(axis=(1, 2)))
        # Negative control: three nodes are too few.
        few = drifts[..., nodes[:3]].reshape(-1, 3)
        flat = drifts.reshape(-1, n)
        rough.append(np.abs(few @ np.linalg.lstsq(few, flat)[0] - flat).max())
        known = LifeDensity(exact_model, scenario, exact_model.grid).log_probability(y)
        error = density.log_probability(y) - known
        weight = np.exp(known - known.max()) / np.exp(known - known.max()).sum()
        assert abs(np.log(weight @ np.exp(error))) < 5e-3
        assert np.sqrt(weight @ error**2) < 1e-2
    assert np.quantile(np.concatenate(off), 0.99) < 3e-5
    assert max(rough) > 1e-4


@pytest.mark.parametrize("last_still", [1, 5, 9], ids=["at the baseline", "between", "at the end"])
def test_a_step_without_travel_parts_the_logs(tmp_path: Path, last_still: int) -> None:
    """Logs at one odometer lie on both sides of a step; without one they are of one moment."""
    stage = make_stage(tmp_path, (FADING,))
    travel = np.linspace(0.0, 2e6, 10)
    travel[last_still] = travel[last_still - 1]
    ln_f = np.log(FREQUENCY[:2]) + 1e-3 * np.random.default_rng(3).standard_normal((10, 2))
    history = make_history(ln_f, travel=travel)
    without = LifeLikelihood.of(history, stage)
    stepped = LifeLikelihood.of(replace(history, steps=(since("step", last_still, 10),)), stage)
    (step,) = stepped.data.steps
    np.testing.assert_array_equal(stepped.data.clock < step, np.arange(10) < last_still)
    np.testing.assert_allclose(stepped.data.clock, without.data.clock, atol=1.0)
    assert without.data.clock[last_still] == without.data.clock[last_still - 1]
    for scenario in stepped.data.scenarios:
        density = LifeDensity(stepped, scenario, stepped.grid)
        y = coordinates(density, 20)
        assert np.isfinite(density.log_probability(y)).all()
        rng = np.random.default_rng(4)
        moments = np.array([0.0, stepped.data.now])
        off = density.deviations(y, density.draw_nuisances(y, rng), moments, rng)
        assert off.shape == (y.shape[0], 2, 1)
        assert np.isfinite(off).all()


# the posterior density of a scenario


def test_narrowing_the_grid_keeps_the_posterior(poor_map: Stage) -> None:
    """Points of the grid that carry nothing can go: differences stay within a few hundredths."""
    density = density_of(rough_history(np.random.default_rng(10)), poor_map)
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


def test_no_life_inside_the_map_has_no_grid(poor_map: Stage) -> None:
    """Coordinates that are all outside of the map are refused, and have no density."""
    density = density_of(rough_history(np.random.default_rng(10)), poor_map)
    y = coordinates(density, 3)
    y[:, 0] = 50.0
    assert np.isneginf(density.log_probability(y)).all()
    with pytest.raises(NotEnoughData, match="no life of the prior stays inside the map"):
        density.narrowed(y)


def test_settings_lie_inside_their_grids(poor_map: Stage) -> None:
    """Averages of walk, noise scale and deviation lie inside their grids; χ² is no less than 0."""
    density = density_of(rough_history(np.random.default_rng(11)), poor_map)
    walk, scale, deviation, chi_square, freedom = density.settings(coordinates(density, 30))
    assert constants.WALK_STDS[0] <= walk <= constants.WALK_STDS[-1]
    assert 1 <= scale <= constants.NOISE_SCALES[-1]
    assert constants.DEVIATION_STDS[0] <= deviation <= constants.DEVIATION_STDS[-1]
    assert chi_square > 0
    # The logs determine two intercepts, and of the coordinates a part.
    left = density.likelihood.data.y.size - 2
    assert left - density.scenario.n_dim - 0.01 < freedom < left + 0.01


def test_settings_of_draws_are_the_mean_of_each(poor_map: Stage) -> None:
    """Settings are averaged over the draws with equal weights."""
    density = density_of(rough_history(np.random.default_rng(12)), poor_map)
    y = coordinates(density, 6)
    alone = [density.settings(draw[None])[:3] for draw in y]
    np.testing.assert_allclose(density.settings(y)[:3], np.mean(alone, axis=0))
    assert np.ptp(alone, axis=0).min() > 1e-6


def test_chi_square_of_a_life_as_stated_is_near_its_degrees_of_freedom(tmp_path: Path) -> None:
    """Data with the stated errors have χ² per degree of freedom near 1; doubled errors do not."""
    stage = make_stage(tmp_path, (FADING,), tail=LAWS_ALONE)
    rng = np.random.default_rng(12)
    travel = np.linspace(0, 2e6, 60)
    x = np.log(1 - 1e-7 * travel)[:, None]
    clean = np.log(FREQUENCY[:2]) + true_drift(("guide_preload",), x)[:, :2]
    noise = 1e-3 * rng.standard_normal((60, 2))
    for factor, scale_is_one in ((1.0, True), (2.0, False)):
        density = density_of(make_history(clean + factor * noise, travel=travel), stage)
        _, scale, _, chi_square, dof = density.settings(np.full((5, 1), 0.2))
        assert dof == pytest.approx(2 * 60 - 2, abs=0.01)  # the coordinate is given
        assert abs(chi_square / dof - 1) < 5 * np.sqrt(2 / dof)
        assert (scale < 1.1) == scale_is_one


def test_coefficients_within_their_priors_take_no_degree_of_freedom(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of lives whose covariate acts as its prior states, a twentieth has a p value below 0.05."""
    for name, value in {"WALK_STDS": 1e-6, "NOISE_SCALES": 1.0, "DEVIATION_STDS": 0.0}.items():
        monkeypatch.setattr(constants, name, (value,))
        prior = re.sub(r"(_STD)?S$", "_PRIOR", name)
        monkeypatch.setattr(constants, prior, (1.0,))
    monkeypatch.setattr("lmshealth.stage.constants.MAP_ERRORS", ((1.0, 1.0),))
    stage = make_stage(tmp_path, (FADING,), model_std=1e-6, tail=TEMPERATURE + LAWS_ALONE)
    rng, n, p_values = np.random.default_rng(14), 6, []
    travel, y = np.linspace(0, 1e6, n), np.full((5, 1), 0.2)
    clean = true_drift(("guide_preload",), np.log(1 - 0.2 * travel[:, None] / 1e6))[:, :2]
    (covariate,) = stage.description.covariate
    for _ in range(300):
        warmth = rng.normal(0, 6, n)
        moved = np.outer(warmth, covariate.prior_std * rng.standard_normal(2))
        history = make_history(
            np.log(FREQUENCY[:2]) + clean + moved + 3e-4 * rng.standard_normal((n, 2)),
            travel=travel, std=3e-4, temperature=covariate.reference + warmth,
        )  # fmt: skip
        *_, chi_square, freedom = density_of(history, stage).settings(y)
        p_values.append(stats.chi2.sf(chi_square, [freedom, freedom - 2]))
    # Negative control: the two coefficients would take two degrees of freedom.
    few, many = (np.array(p_values) < 0.05).sum(axis=0).tolist()
    assert stats.binomtest(few, 300, 0.05).pvalue > 1e-3
    assert stats.binomtest(many, 300, 0.05).pvalue < 1e-6


@pytest.fixture
def with_deviation(monkeypatch: pytest.MonkeyPatch) -> LifeSetting:
    """One point of the grid, at which health is far off its laws."""
    monkeypatch.setattr(constants, "WALK_STDS", (1.5e-3,))
    monkeypatch.setattr(constants, "WALK_PRIOR", (1.0,))
    monkeypatch.setattr(constants, "LONE_WALKS", ((5e-4, 1.0),))
    monkeypatch.setattr(constants, "NOISE_SCALES", (1.0,))
    monkeypatch.setattr(constants, "NOISE_SCALE_PRIOR", (1.0,))
    monkeypatch.setattr(constants, "DEVIATION_STDS", (0.4,))
    monkeypatch.setattr(constants, "DEVIATION_PRIOR", (1.0,))
    monkeypatch.setattr("lmshealth.stage.constants.MAP_ERRORS", ((1.0, 1.0),))
    return LifeSetting(1.5e-3, 1.0, 0.4)


def off_by_hand(
    density: LifeDensity, history: History, y: FloatArray, setting: LifeSetting, moment: float
) -> tuple[FloatArray, FloatArray]:
    """Condition the dense Gaussian of health about wear and loosening on one life."""
    drift, alone = drifts_of(density, y, history.clock()[history.baseline :])
    return life_deviation(history, drift, alone, believed(MODEL_STD, COMMON_STD), setting, moment)


def test_deviations_are_those_of_a_dense_gaussian(
    poor_map: Stage, with_deviation: LifeSetting
) -> None:
    """Mean and covariance given a life and its data: past, now and to come, to 1e-8."""
    history = rough_history(np.random.default_rng(13), baseline=2)
    density = density_of(history, poor_map)
    y = coordinates(density, 3)
    now = density.likelihood.data.now
    moments = np.array([0.0, 0.37 * now, now, 2.5 * now])
    x, _ = density.likelihood.path(density.scenario, y)
    mean, cov = density.likelihood.deviation(density.grid, 0, 1.0, x, moments)
    assert mean.shape == (3, 4, 2)
    for i, point in enumerate(y):
        for m, moment in enumerate(moments):
            known = off_by_hand(density, history, point, with_deviation, moment)
            np.testing.assert_allclose(mean[i, m], known[0], rtol=1e-7, atol=1e-10)
            np.testing.assert_allclose(cov[i, m], known[1], rtol=1e-7, atol=1e-10)
    # From now on the variance grows as that of a Wiener process.
    rate = with_deviation.deviation**2 / density.likelihood.data.now
    np.testing.assert_allclose(mean[:, 3], mean[:, 2], rtol=1e-9)
    np.testing.assert_allclose(
        cov[:, 3] - cov[:, 2], np.tile(1.5 * now * rate * np.eye(2), (3, 1, 1))
    )
    assert np.abs(cov[:, 2, 0, 1]).min() > 1e-5  # preload and mount trade off


def test_a_wrong_deviation_is_noticed(poor_map: Stage, with_deviation: LifeSetting) -> None:
    """Negative control: with a slightly larger deviation the numbers are others."""
    history = rough_history(np.random.default_rng(13))
    density = density_of(history, poor_map)
    y = coordinates(density, 1)
    moments = np.array([density.likelihood.data.now])
    x, _ = density.likelihood.path(density.scenario, y)
    mean, cov = density.likelihood.deviation(density.grid, 0, 1.0, x, moments)
    wrong = replace(with_deviation, deviation=0.41)
    known = off_by_hand(density, history, y[0], wrong, density.likelihood.data.now)
    assert np.abs(mean[0, 0] / known[0] - 1).min() > 1e-3
    assert np.abs(np.diag(cov[0, 0]) / np.diag(known[1]) - 1).min() > 1e-3


def test_drifts_of_a_mode_that_moves_alone_are_those_of_a_dense_gaussian(
    tmp_path: Path, with_deviation: LifeSetting
) -> None:
    """Mean and variance of its drift now, and deviations beside it, given a life: to 1e-7."""
    tail = TEMPERATURE + "[life]\ncommon_wander = 0\n"
    stage = make_stage(tmp_path, model_std=MODEL_STD, tail=tail)
    history = rough_history(np.random.default_rng(13), baseline=2)
    density = density_of(history, stage)
    y, grid = coordinates(density, 3), density.grid
    assert grid.lone.tolist() == [NO_MODE, 0, 1]
    moments = np.array([0.5, 1.0]) * density.likelihood.data.now
    x, _ = density.likelihood.path(density.scenario, y)
    for k in (1, 2):
        setting = replace(with_deviation, walk=5e-4, lone=k - 1)
        mean, variance = density.likelihood.lone_drift(grid, k, 1.0, x)
        of_health, cov = density.likelihood.deviation(grid, k, 1.0, x, moments)
        for i, point in enumerate(y):
            drift, alone = drifts_of(density, point, history.clock()[history.baseline :])
            given = (history, drift, alone, believed(MODEL_STD))
            known = life_lone_drift(*given, setting)
            np.testing.assert_allclose((mean[i], variance[i]), known, rtol=1e-7)
            # Negative control: beside another walk the numbers are others.
            wrong = life_lone_drift(*given, replace(setting, walk=1e-3))
            assert abs(mean[i] / wrong[0] - 1) > 1e-5
            for m, moment in enumerate(moments):
                off = life_deviation(*given, setting, float(moment))
                np.testing.assert_allclose(of_health[i, m], off[0], rtol=1e-6, atol=1e-10)
                np.testing.assert_allclose(cov[i, m], off[1], rtol=1e-6, atol=1e-10)


def test_draws_of_deviations_have_their_mean_and_covariance(
    poor_map: Stage, with_deviation: LifeSetting
) -> None:
    """Means and variances of draws of one life lie within five standard errors."""
    history = rough_history(np.random.default_rng(14))
    density = density_of(history, poor_map)
    n = 4000
    one = coordinates(density, 1)
    moments = np.array([0.0, density.likelihood.data.now])
    nuisances = (np.zeros(n, dtype=int), np.zeros(n, dtype=int))
    of_life = np.tile(one, (n, 1)), nuisances, moments
    off = density.deviations(*of_life, np.random.default_rng(1))
    mean, cov = off_by_hand(density, history, one[0], with_deviation, density.likelihood.data.now)
    assert np.abs(off[:, 0]).max() < 1e-6  # health is relative to the baseline
    std = np.sqrt(np.diag(cov))
    assert (np.abs(off[:, 1].mean(axis=0) - mean) < 5 * std / np.sqrt(n)).all()
    assert (np.abs(np.cov(off[:, 1].T) - cov) < 8 / np.sqrt(n) * np.outer(std, std)).all()
    assert (np.abs(off[:, 1].mean(axis=0) - 1.2 * mean) > 5 * std / np.sqrt(n)).any()


def test_points_of_the_grid_are_drawn_by_their_weight(
    poor_map: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Draws are as many as the weight of map error and point; without deviation on the law."""
    monkeypatch.setattr(constants, "WALK_STDS", (1.5e-3,))
    monkeypatch.setattr(constants, "WALK_PRIOR", (1.0,))
    density = density_of(rough_history(np.random.default_rng(15)), poor_map)
    y = coordinates(density, 1)
    n, rng = 4000, np.random.default_rng(2)
    tiled, now = np.tile(y, (n, 1)), np.array([density.likelihood.data.now])
    error, k = density.draw_nuisances(tiled, rng)
    off = density.deviations(tiled, (error, k), now, rng)[:, 0]
    still = density.grid.deviation[k] == 0
    assert (off[still] == 0).all()
    assert (off[~still] != 0).all()
    assert 0.05 < still.mean() < 0.95
    weight = density.point_weights(y)[..., 0]
    np.testing.assert_allclose(density.weights(y), weight.sum(axis=0))
    share = np.zeros(weight.shape)
    np.add.at(share, (error, k), 1 / n)
    std = np.sqrt(weight * (1 - weight) / n)
    assert (np.abs(share - weight) < 5 * std + 1e-9).all()
    # Negative control: errors of the map of another order.
    assert (np.abs(share - weight[::-1]) > 5 * std[::-1] + 1e-9).any()


def test_only_what_has_a_law_deviates(tmp_path: Path, with_deviation: LifeSetting) -> None:
    """A parameter that keeps its value is never off it, nor will be, seen by the modes or not."""
    stage = make_stage(tmp_path, (FADING, STILL_MOUNT, FOOT))
    density = density_of(rough_history(np.random.default_rng(16)), stage)
    now, y = np.array([density.likelihood.data.now]), coordinates(density, 50)
    rng = np.random.default_rng(3)
    off = density.deviations(y, density.draw_nuisances(y, rng), now, rng)
    assert (off[:, 0, 0] != 0).all()
    assert (off[:, 0, 1:] == 0).all()


def test_a_scenario_without_coordinates_has_draws_of_one_life(
    tmp_path: Path, with_deviation: LifeSetting
) -> None:
    """Where no law is followed but one was possible, health still wanders."""
    several = FADING.replace("law = ", "law = [").replace("} }\n", '} }, { kind = "none" }]\n')
    stage = make_stage(tmp_path, (several,))
    likelihood = LifeLikelihood.of(rough_history(np.random.default_rng(17)), stage)
    density = LifeDensity(likelihood, likelihood.data.scenarios[1], likelihood.grid)
    assert density.scenario.n_dim == 0
    y = np.empty((2000, 0))
    assert np.isfinite(density.log_probability(y[:1])).all()
    rng = np.random.default_rng(4)
    nuisances = density.draw_nuisances(y, rng)
    off = density.deviations(y, nuisances, np.array([likelihood.data.now]), rng)
    assert off.shape == (2000, 1, 1)
    assert np.unique(off).size == 2000


def test_a_law_that_ends_before_the_first_log_is_no_error(tmp_path: Path) -> None:
    """A prior of lives of a metre leaves the map: that scenario is empty, or all are refused."""
    history = rough_history(np.random.default_rng(10))
    law = '{ kind = "hertz-wear", life_km = { kind = "lognormal", median = 1e-3, sigma = 0.1 } }'
    others = {f"[{law}, {{ kind = 'none' }}]": False, law: True}
    for k, (laws, is_refused) in enumerate(others.items()):
        text = re.sub(r"law = .*", f"law = {laws}", FADING)
        stage = make_stage(tmp_path / str(k), (text,), tail=LAWS_ALONE)
        if is_refused:
            with pytest.raises(NotEnoughData, match="no life of the prior stays inside the map"):
                LifeLikelihood.of(history, stage)
        else:
            assert LifeLikelihood.of(history, stage).grid.walk.size
