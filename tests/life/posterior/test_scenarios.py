"""Scenarios of lives: prior probabilities, steps, restarted laws, priors and passages."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import brentq

from lmshealth._private.arrays import FloatArray
from lmshealth.life import constants
from lmshealth.life.constants import STEP_PROBABILITY
from lmshealth.life.posterior.scenarios import DegradationPath, Scenario, laws_of, list_scenarios
from lmshealth.stage.degradation_laws import AnyLaw, Free, HertzWear, Linear, Loosening, Unchanging
from lmshealth.stage.description import ParameterSpec
from lmshealth.stage.priors import Lognormal, Normal, Uniform

NOW = 2e6
STEPS = (0.5e6, 1.2e6)
WEAR = HertzWear(life_km=Lognormal(8000, 1.0), exponent=Uniform(0.7, 1.6))
LOOSE = Loosening(life_km=Lognormal(4000, 1.0), floor=Uniform(0.3, 1.0), weight=3.0)
LINEAR = Linear(rate_per_km=Normal(0.0, 2e-4))
NONE = Unchanging(weight=4.0)
FREE = Free()
LAWS: list[AnyLaw] = [WEAR, LOOSE, LINEAR, NONE, FREE]


def parameter(name: str, *laws: AnyLaw) -> ParameterSpec:
    """Make a health parameter of some laws."""
    return ParameterSpec(name=name, prior=Lognormal(1.0, 0.3), law=laws)


def natural(path: DegradationPath, n: int, seed: int = 1) -> FloatArray:
    """Draw natural parameters of a path."""
    y = path.draw(np.random.default_rng(seed), n, NOW)
    return path.natural(y, NOW)


PRELOAD = parameter("preload", WEAR, LINEAR, NONE)
MOUNT = parameter("mount", LOOSE, NONE)


@pytest.mark.parametrize(
    ("steps", "n"),
    [((), 3 * 2), (STEPS, 5 * 3 + 3 * 2), ((0.0, NOW), 2 * 3 * 2)],
    ids=["none", "two", "ends"],
)
def test_scenarios_have_all_the_probability(steps: tuple[float, ...], n: int) -> None:
    """Every choice of laws, begins and steps, or none, occurs once; weights add up to one."""
    scenarios = list_scenarios((PRELOAD, MOUNT), steps, NOW, 0.0)
    assert len(scenarios) == n
    assert sum(scenario.weight for scenario in scenarios) == pytest.approx(1, abs=1e-14)
    keys = {tuple((b.law.kind, b.begin, b.steps) for b in one.paths) for one in scenarios}
    assert len(keys) == n
    weight = dict.fromkeys((steps, ()), 0.0)
    for scenario in scenarios:
        (taken,) = {path.steps for path in scenario.paths}
        weight[taken] += scenario.weight
    assert weight[()] == pytest.approx(0.9 if steps else 1.0)


def test_a_law_has_its_weight_whether_it_restarts_or_not() -> None:
    """Beginnings share what a law has; weights count against those of the same parameter."""
    scenarios = list_scenarios((PRELOAD, MOUNT), STEPS, NOW, 0.0)
    weights: dict[tuple[str, float], float] = {}
    for scenario in scenarios:
        for path in scenario.paths:
            if path.steps:
                key = (path.law.kind, path.begin)
                weights[key] = weights.get(key, 0.0) + scenario.weight / STEP_PROBABILITY
    known = {
        ("hertz-wear", 0.0): 1 / 12,
        ("hertz-wear", 1.2e6): 1 / 12,
        ("linear", 0.0): 1 / 12,
        ("linear", 1.2e6): 1 / 12,
        ("loosening", 0.0): 3 / 14,
        ("loosening", 1.2e6): 3 / 14,
        ("none", 0.0): 4 / 6 + 4 / 7,
    }
    assert weights == pytest.approx(known)


def test_a_scenario_without_parameters_is_one_certain_life() -> None:
    """One law of each parameter, and no step, is one scenario."""
    (scenario,) = list_scenarios((parameter("foot", NONE), MOUNT_ONLY), (), NOW, 0.0)
    assert scenario.weight == 1
    assert scenario.sizes == (0, 2)
    assert scenario.n_dim == 2


MOUNT_ONLY = parameter("mount", LOOSE)


def test_a_free_change_has_its_share_of_the_laws() -> None:
    """A twentieth of a parameter's laws; what never changes, or has it itself, gets none."""
    laws = {law.kind: share for law, share in laws_of(PRELOAD, 0.05)}
    shares = {"hertz-wear": 0.95 / 6, "linear": 0.95 / 6, "none": 0.95 * 4 / 6, "free": 0.05}
    assert laws == pytest.approx(shares)
    assert [law.kind for law, _ in laws_of(PRELOAD, 0.0)] == ["hertz-wear", "linear", "none"]
    assert laws_of(parameter("foot", NONE), 0.05) == [(NONE, 1.0)]
    own = parameter("mount", LOOSE, Free(std=0.3))
    assert laws_of(own, 0.05) == [(LOOSE, 0.75), (own.laws[1], 0.25)]
    for steps, n in (((), 4 * 3), (STEPS, 7 * 5 + 4 * 3)):
        scenarios = list_scenarios((PRELOAD, MOUNT), steps, NOW, 0.05)
        assert len(scenarios) == n
        assert sum(one.weight for one in scenarios) == pytest.approx(1, abs=1e-14)
        of_free = sum(one.weight for one in scenarios if one.paths[0].law.kind == "free")
        assert of_free == pytest.approx(0.05)


@pytest.mark.parametrize("law", LAWS, ids=[law.kind for law in LAWS])
def test_jumps_act_from_their_step_on(law: AnyLaw) -> None:
    """Before a step health is that of the law; from it on, times all jumps so far."""
    path, k = DegradationPath(law, 0.0, STEPS), len(law.names)
    assert path.names == (*law.names, "jump_1", "jump_2")
    theta = natural(path, 30)
    travel = np.array(
        [0.0, np.nextafter(0.5e6, 0), 0.5e6, 1.1e6, np.nextafter(1.2e6, 0), 1.2e6, 9e6]
    )
    ratio = path.health(theta, travel)
    own = law.health(theta[:, :k], travel)
    first, second = theta[:, k], theta[:, k + 1]
    known = own * np.stack(
        [np.ones(30), np.ones(30), first, first, first, first * second, first * second], axis=1
    )
    np.testing.assert_allclose(ratio, known, rtol=1e-14)
    assert np.ptp(first) > 0.1


@pytest.mark.parametrize(
    "law", [*LAWS[:3], FREE], ids=["hertz-wear", "loosening", "linear", "free"]
)
def test_a_restarted_law_is_1_until_then(law: AnyLaw) -> None:
    """Up to where it begins only jumps act; from there it is the law of the travel since."""
    path, k = DegradationPath(law, 1.2e6, STEPS), len(law.names)
    theta = natural(path, 30)
    first, second = theta[:, k : k + 1], theta[:, k + 1 :]
    early, late = np.array([0.0, 0.4e6]), np.array([1.2e6, 1.5e6, 4e6])
    np.testing.assert_array_equal(path.health(theta, early), 1)
    np.testing.assert_array_equal(path.health(theta, np.array([0.9e6])), first)
    known = law.health(theta[:, :k], late - 1.2e6) * first * second
    np.testing.assert_allclose(path.health(theta, late), known, rtol=1e-14)
    # Coordinates are of the travel that the law itself has had.
    y = path.draw(np.random.default_rng(2), 5, NOW)
    np.testing.assert_array_equal(path.natural(y, NOW)[:, :k], law.natural(y[:, :k], NOW - 1.2e6))


FALLING = [WEAR, LOOSE, Linear(rate_per_km=Lognormal(2e-4, 0.5)), NONE]


@pytest.mark.parametrize("begin", [0.0, 1.2e6])
@pytest.mark.parametrize("law", FALLING, ids=[law.kind for law in FALLING])
def test_passage_after_the_last_step_is_the_root_of_health(law: AnyLaw, begin: float) -> None:
    """Where a limit is reached after all steps, root finding on health finds the same travel."""
    path = DegradationPath(law, begin, STEPS)
    theta = natural(path, 120)
    found = 0
    for limit in (0.5, 0.8, 0.95):
        passage = path.passage(theta, limit)
        assert passage.shape == (120,)
        for row, travel in zip(theta[:, None], passage, strict=True):

            def off(s: float, row: FloatArray = row, limit: float = limit) -> float:
                return float(path.health(row, np.array([s]))[0, 0] - limit)

            last = STEPS[-1]
            if np.isinf(travel):
                assert off(1e13) > -1e-12
            elif travel > last:
                root = brentq(off, last, 4 * travel, xtol=1e-9 * travel, rtol=1e-13)
                assert travel == pytest.approx(root, rel=1e-8)
                found += 1
            else:  # jumped over, or reached, by the last step
                assert off(last) <= 1e-12
    assert found > 20 or law is NONE


def test_a_gain_never_reaches_what_no_step_has_jumped_over() -> None:
    """Where all is gained after the jumps a limit below them is never reached."""
    path = DegradationPath(LINEAR, 0.0, STEPS)
    theta = np.array([[-1e-8, 0.9, 0.9], [-1e-8, 0.9, 1.2]])
    assert np.isinf(path.passage(theta, 0.7)).all()


def test_each_draw_may_have_its_own_limit() -> None:
    """An array of limits has the passages of each limit alone."""
    path = DegradationPath(LOOSE, 0.0, STEPS)
    theta, limit = natural(path, 40), np.linspace(0.4, 1.2, 40)
    alone = [path.passage(row[None], float(one))[0] for row, one in zip(theta, limit, strict=True)]
    np.testing.assert_array_equal(path.passage(theta, limit), alone)


def one_scenario(*paths: DegradationPath) -> Scenario:
    """Make a scenario of some paths."""
    return Scenario(paths, NOW, 1.0)


@pytest.mark.parametrize("begin", [0.0, 0.5e6])
def test_the_prior_of_a_line_with_a_jump_integrates_to_one(begin: float) -> None:
    """A rate and a jump, by quadrature on a grid of coordinates."""
    scenario = one_scenario(DegradationPath(LINEAR, begin, (0.5e6,)))
    loss, jump = np.linspace(-4, 4, 801), np.linspace(-2.5, 2.5, 501)
    y = np.stack(np.meshgrid(loss, jump, indexing="ij"), axis=-1).reshape(-1, 2)
    cell = (loss[1] - loss[0]) * (jump[1] - jump[0])
    assert np.exp(scenario.log_prior(y)).sum() * cell == pytest.approx(1, abs=1e-9)
    # Negative control: a density of the rate itself, without the Jacobian, does not.
    bare = LINEAR.rate_per_km.log_density(scenario.natural(y)[:, 0] * 1000)
    bare = np.exp(bare + constants.STEP_PRIOR.log_density(y[:, 1])).sum() * cell
    assert abs(bare - 1) > 0.1


@pytest.mark.parametrize("begin", [0.0, 0.5e6])
@pytest.mark.parametrize("law", [WEAR, LOOSE, FREE], ids=["hertz-wear", "loosening", "free"])
def test_priors_of_several_coordinates_integrate_to_one(law: AnyLaw, begin: float) -> None:
    """Wear and loosening, restarted or not, by quadrature on a grid of coordinates."""
    scenario = one_scenario(DegradationPath(law, begin, ()))
    y = scenario.draw(np.random.default_rng(3), 20_000)
    low, high = y.min(axis=0) - 2, y.max(axis=0) + 2
    n = {2: 1201, 3: 101}[low.size]
    axes = [np.linspace(a, b, n) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, low.size)
    density = np.exp(scenario.log_prior(grid))
    cell = float(np.prod((high - low) / (n - 1)))
    # The floor's prior has edges, at which a grid is rough.
    assert density.sum() * cell == pytest.approx(1, abs=3e-3)
    mean = density @ grid * cell
    assert (np.abs(y.mean(axis=0) - mean) < 5 * y.std(axis=0) / np.sqrt(20_000) + 5e-3).all()
    if law is FREE:  # whose coordinates are those at any travel
        return
    # Negative control: draws as if the law had another travel behind it.
    other = one_scenario(DegradationPath(law, 1.2e6, ())).draw(np.random.default_rng(3), 20_000)
    assert (np.abs(other.mean(axis=0) - mean) > 0.05).any()


def test_draws_follow_the_prior() -> None:
    """Rates and jumps of draws have the stated distributions, one independent of the other."""
    scenario = one_scenario(
        DegradationPath(LINEAR, 0.5e6, STEPS), DegradationPath(NONE, 0.0, STEPS)
    )
    y = scenario.draw(np.random.default_rng(4), 5000)
    assert y.shape == (5000, 5)
    assert np.isfinite(scenario.log_prior(y)).all()
    theta = scenario.natural(y)
    books = [stats.norm(0.0, 2e-7), *[stats.lognorm(constants.STEP_PRIOR.std)] * 4]
    for column, book in zip(theta.T, books, strict=True):
        assert stats.kstest(column, book.cdf).pvalue > 1e-4
    correlation = np.asarray(np.corrcoef(y.T))[np.triu_indices(5, 1)]
    assert np.abs(correlation).max() < 4.5 / np.sqrt(5000)
    assert stats.kstest(1.1 * theta[:, 0], books[0].cdf).pvalue < 1e-3  # negative control


def test_a_scenario_joins_its_paths() -> None:
    """Coordinates, densities and health of a scenario are those of its paths, side by side."""
    paths = (
        DegradationPath(WEAR, 0.0, STEPS),
        DegradationPath(NONE, 0.0, STEPS),
        DegradationPath(LOOSE, 1.2e6, STEPS),
    )
    scenario = one_scenario(*paths)
    assert scenario.sizes == (4, 2, 4)
    y = scenario.draw(np.random.default_rng(5), 20)
    parts = scenario.split(y)
    assert [part.shape for part in parts] == [(20, 4), (20, 2), (20, 4)]
    travel = np.array([0.0, 1e6, NOW])
    alone = [
        path.health(path.natural(part, NOW), travel)
        for path, part in zip(paths, parts, strict=True)
    ]
    theta = scenario.natural(y)
    np.testing.assert_array_equal(scenario.health(theta, travel), np.stack(alone, axis=-1))
    total = sum(b.log_prior(part, NOW) for b, part in zip(paths, parts, strict=True))
    np.testing.assert_allclose(scenario.log_prior(y), total, rtol=1e-14)


def test_far_off_walkers_are_impossible_and_raise_no_warning() -> None:
    """Coordinates beyond the range of floats have a prior of next to nothing, never NaN."""
    scenario = one_scenario(DegradationPath(LOOSE, 0.0, STEPS), DegradationPath(WEAR, 0.0, STEPS))
    y = scenario.draw(np.random.default_rng(6), 1)
    for shift in (-1e3, 1e3):
        far = y + shift * np.eye(scenario.n_dim)
        value = scenario.log_prior(far)
        assert not np.isnan(value).any()
        assert (value < scenario.log_prior(y) - 100).all()
        assert not np.isnan(scenario.natural(far)).any()
