"""Posterior of a life: scenarios, convergence, mixture, tables."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray
from msgspec import structs
from scipy import signal, stats
from threadpoolctl import threadpool_limits

from lmshealth._private.arrays import FloatArray
from lmshealth.errors import NotConverged
from lmshealth.life import constants
from lmshealth.life.posterior import exploration, fit
from lmshealth.life.posterior.fit import LifePosterior, fit_life
from lmshealth.life.posterior.likelihood import NO_MODE, LifeDensity, LifeLikelihood
from lmshealth.life.posterior.sampling import Sample, draw_to_ess, importance_sample
from lmshealth.life.prognosis import prognose
from lmshealth.stage.description import Stage, load_stage
from lmshealth.tracking.history import History, Step
from tests.lives import (
    FADING,
    FOOT,
    FREQUENCY,
    LAWS_ALONE,
    MOUNT,
    PRELOAD,
    SENSITIVITY,
    four_settings,
    make_history,
    make_stage,
    threads,
    true_drift,
)

NAMES = ("guide_preload", "mount_stiffness")
NONE = '{ kind = "none" }'
FADING_OR_NOT = FADING.replace("law = {", "law = [{").replace("} }\n", "} }, " + NONE + "]\n")
MOUNT_OR_NOT = MOUNT[: MOUNT.index("[parameter.law]")] + (
    'law = [{ kind = "loosening", life_km = { kind = "lognormal", median = 4000, sigma = 1.0 }, '
    'floor = { kind = "uniform", low = 0.3, high = 1.0 } }, ' + NONE + "]\n"
)


@pytest.fixture(scope="module", autouse=True)
def small_grid() -> Iterator[None]:
    """Average over two walks, two deviations and one noise scale: checks hold for any of them."""
    with four_settings():
        yield


@pytest.fixture(scope="module")
def stage(small_grid: None, tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Wear of the preload and loosening of the mount, seen by two modes."""
    return make_stage(tmp_path_factory.mktemp("stage"), (PRELOAD, MOUNT), tail=LAWS_ALONE)


@pytest.fixture(scope="module")
def wavering(small_grid: None, tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Preload that fades and a mount that settles, or either of them not."""
    parameters = (FADING_OR_NOT, MOUNT_OR_NOT)
    return make_stage(tmp_path_factory.mktemp("wavering"), parameters, tail=LAWS_ALONE)


def lived(travel: FloatArray, preload: FloatArray, mount: FloatArray, seed: int = 1) -> History:
    """Make the life of a preload and a mount, with errors of 5e-4 in ln f."""
    drift = true_drift(NAMES, np.log([preload, mount]).T)[:, :2]
    noise = 5e-4 * np.random.default_rng(seed).standard_normal((travel.size, 2))
    return make_history(np.log(FREQUENCY[:2]) + drift + noise, travel=travel, std=5e-4)


TRAVEL = np.linspace(0.0, 2.5e6, 12)


@pytest.fixture(scope="module")
def history() -> History:
    """Make a life of 12 logs: preload for 8,000 km, the mount settling to 0.8 within 1,500."""
    preload = (1 - TRAVEL / 8e6) ** 1.5
    return lived(TRAVEL, preload, 0.8 + 0.2 * np.exp(-TRAVEL / 1.5e6))


@pytest.fixture(scope="module")
def found(history: History, stage: Stage) -> LifePosterior:
    """Its posterior."""
    return fit_life(history, stage, (3, 4))


@pytest.fixture(scope="module")
def faded(wavering: Stage) -> LifePosterior:
    """Posterior of a preload that loses a fifth, on a mount that keeps its value."""
    return fit_life(lived(TRAVEL, 1 - 0.08e-6 * TRAVEL, np.ones(12)), wavering, 7)


@pytest.fixture(scope="module")
def unchained(history: History, stage: Stage) -> LifePosterior:
    """Posterior by importance sampling alone."""
    return fit_life(history, stage, 11, chains=False)


@pytest.fixture
def forked(unchained: LifePosterior) -> LifePosterior:
    """Make two ways of it, the second with the same draws backwards, with checks of their own."""
    (way,) = unchained.scenarios
    steps = np.arange(way.scenario.n_dim, dtype=float)
    ways = tuple(
        replace(
            way,
            probability=probability,
            sample=Sample(
                draws=way.sample.draws[:, :: 1 - 2 * k],
                ess_bulk=900.0 - 100 * k - steps,
                ess_tail=800.0 - 100 * k - steps,
                r_hat=1.001 + 0.004 * k + 1e-4 * steps,
            ),
            n_mixture_draws=int(1000 * probability),
        )
        for k, probability in enumerate((0.75, 0.25))
    )
    return replace(unchained, scenarios=ways)


def agree(one: FloatArray, two: FloatArray, ess: float) -> bool:
    """Whether draws ``(n, k)`` have the same quantiles within the error of so many draws."""
    for level in (0.1, 0.5, 0.9):
        share = np.mean(one < np.quantile(two, level, axis=0), axis=0)
        if (np.abs(share - level) > 4.5 * np.sqrt(level * (1 - level) / ess)).any():
            return False
    return True


def both_ess(one: float, two: float) -> float:
    """Draws whose error is that of the difference of two samples."""
    return 1 / (1 / one + 1 / two)


@pytest.mark.slow
def test_laws_and_health_are_those_of_importance_sampling(
    found: LifePosterior, history: History, stage: Stage
) -> None:
    """Chains and importance sampling have the same quantiles, within the error of both."""
    likelihood = LifeLikelihood.of(history, stage)
    (scenario,) = likelihood.data.scenarios
    density = LifeDensity(likelihood, scenario, likelihood.grid)
    rng = np.random.default_rng(5)
    rough = importance_sample(density.log_probability, density.scenario.draw(rng, 600), rng, 12000)
    drawn = draw_to_ess(density.log_probability, rough, rng)
    y = drawn.resampled(rng, 12000)
    now = np.array([likelihood.data.now])
    theta = scenario.natural(y)
    off = density.deviations(y, density.draw_nuisances(y, rng), now, rng)
    health = scenario.health(theta, now) * np.exp(off)
    known = np.column_stack([health[:, 0], theta[:, :2]])
    (way,) = found.scenarios
    draws = np.concatenate([found.health, way.chains[..., :2]], axis=2).reshape(-1, 4)
    # Drawn twice: with weights, then by these.
    ess = both_ess(found.ess, both_ess(drawn.ess, 12000))
    assert ess > 500
    assert agree(known, draws, ess)
    assert not agree(known, 1.01 * draws, ess)  # negative control


@pytest.mark.slow
def test_importance_sampling_alone_has_the_same_posterior(
    found: LifePosterior, unchained: LifePosterior
) -> None:
    """Without chains quantiles are the same within their error, of as many draws."""
    quick = unchained
    assert quick.health.shape == found.health.shape == (4, 1000, 2)
    assert (quick.sampler, found.sampler) == ("importance", "emcee")
    (way,) = quick.scenarios
    assert np.isnan(way.sample.r_hat).all()
    assert way.sample.ess_bulk.min() >= 400
    assert quick.ess == way.sample.ess_bulk.min()
    assert quick.worst_r_hat == 1
    one, two = (
        np.concatenate([fit.health, fit.scenarios[0].chains], axis=2).reshape(-1, 6)
        for fit in (quick, found)
    )
    ess = both_ess(found.ess, both_ess(float(way.sample.ess_bulk.min()), 4000))
    assert agree(one, two, ess)
    assert not agree(one, 1.01 * two, ess)  # negative control


@pytest.mark.slow
def test_a_life_updated_log_by_log_is_that_from_nothing(history: History, stage: Stage) -> None:
    """After five updates in a row quantiles are those of a fit from nothing, within its error."""
    one = fit_life(history.first_logs(7), stage, 11, chains=False)
    for n in range(8, 13):
        one = fit_life(history.first_logs(n), stage, 11, chains=False, before=one.start)
        assert one.sampler == "importance"
    whole = fit_life(history, stage, 12, chains=False)
    one_draws, whole_draws = (
        np.concatenate([fit.health, fit.scenarios[0].chains], axis=2).reshape(-1, 6)
        for fit in (one, whole)
    )
    ess = both_ess(both_ess(one.ess, 4000), both_ess(whole.ess, 4000))
    assert agree(one_draws, whole_draws, ess)
    assert not agree(one_draws, 1.02 * whole_draws, ess)  # negative control


def test_an_update_that_fails_is_a_fit_from_nothing(
    history: History, stage: Stage, unchained: LifePosterior, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the weights of an update are unreliable, its result is that without a start."""
    monkeypatch.setattr(constants, "MAX_PARETO_K", -9.0)
    start = unchained.start
    again = fit_life(history, stage, 11, chains=False, before=start)
    np.testing.assert_array_equal(again.health, unchained.health)


def test_the_update_of_a_life_without_wear_is_accepted(
    wavering: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A scenario without coordinates has a single draw, which is exact."""
    travel = 1e5 + np.linspace(0.0, 2e6, 12)
    history = lived(travel, np.ones(12), np.ones(12))
    one = fit_life(history.first_logs(11), wavering, 11, chains=False)
    probable = {way.scenario.n_dim: way.probability for way in one.scenarios}
    assert probable[0] > constants.MIN_CHAIN_PROBABILITY
    starts = []
    explore = exploration.explore

    def counting(*arguments, **options):
        starts.append(arguments[2:])
        return explore(*arguments, **options)

    monkeypatch.setattr(fit, "explore", counting)
    fit_life(history, wavering, 11, chains=False, before=one.start)
    assert starts == [(one.start,)]


def test_linear_algebra_keeps_to_one_thread(
    history: History, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On small arrays more would only wait for one another, whatever is usual around it."""
    seen: set[int] = set()
    sampled = fit._sampled_scenarios

    def counting(*arguments, **options):
        seen.update(threads())
        return sampled(*arguments, **options)

    monkeypatch.setattr(fit, "_sampled_scenarios", counting)
    with threadpool_limits(2, user_api="blas"):
        fit_life(history, stage, 11, chains=False)
        assert seen == {1}
        assert threads() == {2}


def test_importance_sampling_alone_has_no_chains(unchained: LifePosterior) -> None:
    """Without chains there is no R-hat to be worse than 1, and the sample size is of weights."""
    assert np.isnan(unchained.scenarios[0].sample.r_hat).all()
    assert unchained.ess == unchained.scenarios[0].sample.ess_bulk.min()
    assert unchained.worst_r_hat == 1


def test_the_worst_of_all_chains_is_reported(forked: LifePosterior) -> None:
    """Of the checks of all ways the worst speaks for the whole."""
    assert forked.ess == 697
    assert forked.worst_r_hat == pytest.approx(1.0053)


@pytest.mark.slow
def test_a_life_has_its_diagnostics(found: LifePosterior) -> None:
    """Names, convergence, what is informed, and the trade-off of preload and mount."""
    (way,) = found.scenarios
    assert found.parameters == NAMES
    assert found.modes == ("roll", "pitch")
    assert found.seed == (3, 4)
    assert way.probability == 1
    assert way.n_mixture_draws == found.health.shape[1] == 1000
    assert found.worst_r_hat < 1.01
    assert found.ess > 1000
    assert np.corrcoef(np.log(found.health.reshape(-1, 2)).T)[0, 1] < -0.5
    ratio = found.chi_square / found.degrees_of_freedom
    assert 0.2 < ratio < 2.5
    # Two intercepts, and four coordinates.
    assert found.degrees_of_freedom == pytest.approx(24 - 2 - 4, abs=0.05)
    assert (found.lone == NO_MODE).all()
    assert found.lone_modes == ()
    assert found.laws("mount_stiffness") == {("loosening", 0.0): 1.0}


@pytest.mark.slow
def test_health_is_its_law_times_its_deviation(found: LifePosterior) -> None:
    """Draws of laws, of what is off them and of health belong together, one by one."""
    ((way, off, rate),) = found.by_scenario()
    theta = way.scenario.natural(way.mixture_draws)
    by_law = way.scenario.health(theta, TRAVEL[-1:])[:, 0]
    np.testing.assert_allclose(by_law * np.exp(off), found.health.reshape(-1, 2), rtol=1e-12)
    np.testing.assert_array_equal(way.chains.reshape(-1, 4), theta)
    moving = rate[:, 0] > 0
    assert 40 < moving.sum() < 0.9 * moving.size
    np.testing.assert_allclose(rate[moving], 0.01**2 / TRAVEL[-1])
    assert (off[moving] != 0).all()
    assert (off[~moving] == 0).all()


@pytest.mark.slow
def test_a_prognosis_is_of_the_same_draws(
    found: LifePosterior, history: History, stage: Stage
) -> None:
    """Health now of the prognosis is that of the fitted life, draw by draw."""
    prognosis = prognose(history, stage, (3, 4))
    np.testing.assert_array_equal(prognosis.health, found.health.reshape(-1, 2))
    assert prognosis.ess == found.ess


@pytest.mark.slow
def test_the_seed_alone_decides(found: LifePosterior, history: History, stage: Stage) -> None:
    """The same seed gives the same chains, another one others."""
    same, other = (fit_life(history, stage, seed) for seed in ((3, 4), (3, 5)))
    np.testing.assert_array_equal(same.scenarios[0].sample.draws, found.scenarios[0].sample.draws)
    np.testing.assert_array_equal(same.health, found.health)
    assert not np.array_equal(other.scenarios[0].sample.draws, found.scenarios[0].sample.draws)


@pytest.mark.slow
def test_laws_without_parameters_have_no_draws_of_them(history: History, tmp_path: Path) -> None:
    """An unchanging foot adds health of one, and nothing to what is fitted."""
    only = fit_life(history, make_stage(tmp_path / "one", (FADING, FOOT), tail=LAWS_ALONE), 1)
    assert only.scenarios[0].scenario.sizes == (1, 0)
    assert (only.health[..., 1] == 1).all()
    nothing = fit_life(history, make_stage(tmp_path / "none", (FOOT,)), 1)
    assert nothing.scenarios[0].chains.shape == (4, 1000, 0)
    assert nothing.scenarios[0].evidence_std == 0
    assert nothing.ess == np.inf
    assert nothing.worst_r_hat == 1


@pytest.mark.slow
def test_a_constant_value_is_found_constant(tmp_path: Path) -> None:
    """Rough logs of a constant mount: health is 1, unless the description has it settle."""
    noise = 8e-3 * np.random.default_rng(1).standard_normal((12, 2))
    history = make_history(np.log(FREQUENCY[:2]) + noise, travel=TRAVEL, std=8e-3)
    may, must = (
        fit_life(history, make_stage(tmp_path / str(k), (parameter,), tail=LAWS_ALONE), 7)
        for k, parameter in enumerate((MOUNT_OR_NOT, MOUNT))
    )
    assert may.laws("mount_stiffness")["none", 0.0] > 0.6
    assert np.median(may.health) == pytest.approx(1, abs=2e-3)
    assert np.mean(may.health < 0.98) < 0.1
    # Negative control: what can only settle is read as settled.
    assert np.mean(must.health < 0.98) > 0.2
    assert np.median(must.health) < 0.992


@pytest.mark.slow
def test_the_law_of_the_data_is_the_most_probable(faded: LifePosterior, wavering: Stage) -> None:
    """A clear loss is the law's, a still life is none's; probabilities add up to one."""
    still = fit_life(lived(TRAVEL, np.ones(12), np.ones(12)), wavering, 7)
    assert faded.laws("guide_preload")["linear", 0.0] > 0.99
    assert next(iter(still.laws("guide_preload"))) == ("none", 0.0)
    assert still.laws("guide_preload")["none", 0.0] > 0.6
    for one in (faded, still):
        probability = [way.probability for way in one.scenarios]
        assert sum(probability) == pytest.approx(1, abs=1e-12)
        assert probability == sorted(probability, reverse=True)
        assert min(probability) >= 0.01
        for name in NAMES:
            assert sum(one.laws(name).values()) == pytest.approx(1, abs=1e-12)
        share = [way.n_mixture_draws / one.health.shape[1] for way in one.scenarios]
        np.testing.assert_allclose(share, probability, atol=1 / 1000)


@pytest.mark.slow
def test_draws_of_several_scenarios_follow_each_other(faded: LifePosterior) -> None:
    """Each scenario has its own part of the draws, and health in it is that of its laws."""
    assert len(faded.scenarios) > 1
    first = 0
    for way, off, _ in faded.by_scenario():
        part = faded.health[:, first : first + way.n_mixture_draws].reshape(-1, 2)
        first += way.n_mixture_draws
        theta = way.scenario.natural(way.mixture_draws)
        by_law = way.scenario.health(theta, TRAVEL[-1:])[:, 0]
        np.testing.assert_allclose(by_law * np.exp(off), part, rtol=1e-12)
    assert first == faded.health.shape[1]


@pytest.mark.slow
def test_a_scenario_of_little_probability_has_no_chains(
    wavering: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is improbable is drawn by importance sampling alone, the rest by chains."""
    monkeypatch.setattr("lmshealth.life.constants.MIN_CHAIN_PROBABILITY", 0.5)
    fit = fit_life(lived(TRAVEL, 1 - 0.08e-6 * TRAVEL, np.ones(12)), wavering, 7)
    with_law = [way for way in fit.scenarios if way.scenario.n_dim]
    assert {way.probability >= 0.5 for way in with_law} == {True, False}
    for way in with_law:
        assert np.isfinite(way.sample.r_hat).all() == (way.probability >= 0.5)
        # As many effective draws as its share needs; the share itself is an estimate.
        share = way.probability / max(one.probability for one in fit.scenarios)
        assert 0 < way.evidence_std**2 * 400 * np.sqrt(share) < 1.25


@pytest.mark.slow
def test_probabilities_are_those_of_the_evidence(tmp_path: Path) -> None:
    """One law of one coordinate against none: its probability is that of the integral on a grid."""
    weighty = FADING_OR_NOT.replace(NONE, '{ kind = "none", weight = 3 }')
    stage = make_stage(tmp_path, (weighty,), tail=LAWS_ALONE)
    history = lived(TRAVEL, 1 - 0.008e-6 * TRAVEL, np.ones(12))
    likelihood = LifeLikelihood.of(history, stage)
    scenarios, grid = likelihood.data.scenarios, likelihood.grid
    law, none = (LifeDensity(likelihood, scenario, grid) for scenario in scenarios)
    assert (law.scenario.weight, none.scenario.weight) == (0.25, 0.75)
    y = np.linspace(-0.5, 0.6, 20_001)
    value = law.log_probability(y[:, None])
    top = none.log_probability(np.empty((1, 0)))[0]
    evidence = np.sum(np.exp(value - top)) * (y[1] - y[0])
    known = 0.25 * evidence / (0.25 * evidence + 0.75)
    fit = fit_life(history, stage, 2)
    found = fit.laws("guide_preload")["linear", 0.0]
    assert 0.1 < known < 0.9
    std = max(way.evidence_std for way in fit.scenarios)
    # Narrowing the grid may lose a hundredth of the evidence.
    off = abs(np.log(found / (1 - found)) - np.log(known / (1 - known)))
    assert off < 4 * std + 0.01
    even = evidence / (evidence + 1)  # negative control: weights left out
    assert abs(np.log(found / (1 - found)) - np.log(even / (1 - even))) > 4 * std + 0.01


@pytest.mark.slow
@pytest.mark.parametrize(("kept", "real"), [(1.0, False), (0.875, True)])
def test_a_step_that_the_tracker_found_may_not_be_one(
    tmp_path: Path, kept: float, real: bool
) -> None:
    """Whether it happened is decided by the logs: without a jump the life has no step."""
    stage = make_stage(tmp_path, (FADING,), tail=LAWS_ALONE)
    travel = np.linspace(0.0, 2.4e6, 13)
    preload = (1 - 0.04e-6 * travel) * np.where(travel > 1.3e6, kept, 1.0)
    history = replace(lived(travel, preload, np.ones(13)), steps=(Step.found("step", 7, 13),))
    fit = fit_life(history, stage, 3, chains=False)
    stepped = sum(one.probability for one in fit.scenarios if one.scenario.paths[0].steps)
    assert stepped > 0.99 if real else stepped < 0.1


@pytest.mark.slow
def test_a_step_is_followed_by_a_jump(tmp_path: Path) -> None:
    """A loss of an eighth between two logs is followed if the history has the step."""
    stage = make_stage(tmp_path, (FADING,), tail=LAWS_ALONE)
    travel = np.linspace(0.0, 2.4e6, 13)
    preload = (1 - 0.04e-6 * travel) * np.where(travel > 1.3e6, 0.875, 1.0)
    history = lived(travel, preload, np.ones(13))
    stepped = replace(history, steps=(Step.found("step", 7, 13),))
    fit, blind = fit_life(stepped, stage, 3), fit_life(history, stage, 3)
    for way in fit.scenarios:
        path = way.scenario.paths[0]
        assert path.steps == (1.3e6,)
        assert path.begin in (0.0, 1.3e6)
        jump = way.chains[..., path.names.index("jump_1")]
        low, high = np.quantile(jump, [0.005, 0.995])
        assert low < 0.875 < high
        assert high - low < 0.4
    assert sum(fit.laws("guide_preload").values()) == pytest.approx(1)
    low, high = np.quantile(fit.health, [0.005, 0.995])
    assert low < preload[-1] < high
    assert fit.chi_square / fit.degrees_of_freedom < 2
    # Negative control: without the step it is a deviation from the law, or a walk.
    assert blind.walk + blind.deviation > 1.5 * (fit.walk + fit.deviation)


@pytest.mark.slow
def test_a_life_goes_to_arviz_and_back(found: LifePosterior, tmp_path: Path) -> None:
    """NetCDF keeps laws and health by ensemble."""
    found.to_arviz().to_netcdf(tmp_path / "life.nc", engine="h5netcdf")
    tree = xarray.open_datatree(tmp_path / "life.nc", engine="h5netcdf")
    draws = tree["way_1/guide_preload.hertz-wear.life_m"]
    assert draws.dims == ("chain", "draw")
    np.testing.assert_array_equal(draws.to_numpy(), found.scenarios[0].chains[..., 0])
    np.testing.assert_array_equal(tree["posterior/mount_stiffness"], found.health[..., 1])
    checks = tree["checks_data"]
    assert float(checks["chi_square"]) == found.chi_square
    assert float(checks["probability_1"]) == 1
    name = "mount_stiffness.loosening.floor"
    assert float(checks[f"ess_bulk_1_{name}"]) == found.scenarios[0].sample.ess_bulk[2]


@pytest.mark.slow
def test_a_scenario_without_parameters_has_no_group_in_arviz(faded: LifePosterior) -> None:
    """Groups are of scenarios that have draws; every scenario has its probability."""
    tree = faded.to_arviz()
    for k, way in enumerate(faded.scenarios):
        assert (f"way_{k + 1}" in tree.children) == (way.scenario.n_dim > 0)
        assert float(tree["checks_data"][f"probability_{k + 1}"]) == way.probability


def test_arviz_has_every_scenario(forked: LifePosterior) -> None:
    """Draws, checks and probability of each scenario have its number."""
    tree = forked.to_arviz()
    checks = tree["checks_data"]
    np.testing.assert_array_equal(tree["posterior/guide_preload"], forked.health[..., 0])
    names = [
        "guide_preload.hertz-wear.life_m",
        "guide_preload.hertz-wear.exponent",
        "mount_stiffness.loosening.floor",
        "mount_stiffness.loosening.life_m",
    ]
    for k, way in enumerate(forked.scenarios, 1):
        assert list(tree[f"way_{k}"].data_vars) == names
        assert float(checks[f"probability_{k}"]) == way.probability
        for i, name in enumerate(names):
            np.testing.assert_array_equal(tree[f"way_{k}"][name], way.chains[..., i])
            for what in ("ess_bulk", "ess_tail", "r_hat"):
                assert float(checks[f"{what}_{k}_{name}"]) == getattr(way.sample, what)[i]


@pytest.mark.slow
def test_no_life_without_convergence(
    history: History, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sampler that stops too soon is refused with its chains."""
    monkeypatch.setattr("lmshealth.life.posterior.sampling._FIRST_STEPS", 40)
    monkeypatch.setattr("lmshealth.life.constants.MAX_CHAIN_STEPS", 40)
    with pytest.raises(NotConverged, match="after 40 steps") as caught:
        fit_life(history, stage, 1)
    assert np.asarray(caught.value.chains).shape == (4, 40, 16, 4)


# Changes without a law, modes that move alone, and fit


def test_without_weight_of_a_free_change_the_laws_are_alone(
    history: History, tmp_path: Path, unchained: LifePosterior
) -> None:
    """A weight of 0 leaves the scenarios, and the posterior, of a description's laws alone."""
    kinds = {}
    for free in (0, 0.05):
        tail = f"[life]\nfree = {free}\nlone_mode = 0\ncommon_wander = 0\n"
        stage = make_stage(tmp_path / str(free), (PRELOAD, MOUNT), tail=tail)
        scenarios = LifeLikelihood.of(history, stage).data.scenarios
        kinds[free] = [tuple(path.law.kind for path in one.paths) for one in scenarios]
        if not free:
            again = fit_life(history, stage, 11, chains=False)
            np.testing.assert_array_equal(again.health, unchained.health)
    assert kinds[0] == [("hertz-wear", "loosening")]
    assert len(kinds[0.05]) == 4
    assert ("free", "free") in kinds[0.05]


def test_a_wander_that_all_modes_have_in_common_is_no_health() -> None:
    """Health of a machine that stays as it is holds; without it some intervals do not."""
    stage = load_stage("lms-y")
    life = structs.replace(stage.description.life, common_wander=0.0)
    without = replace(stage, description=structs.replace(stage.description, life=life))
    held = {True: 0, False: 0}
    for seed in range(4):
        rng = np.random.default_rng(seed)
        ln_f = np.log(FREQUENCY) + 5e-4 * rng.standard_normal((30, 3))
        steps = 3e-3 * rng.standard_normal(30)
        wander = signal.lfilter([np.sqrt(0.19)], [1, -0.9], steps, zi=[0.9 * steps[0]])[0]
        history = make_history(ln_f + wander[:, None], travel=np.linspace(0.0, 2.9e6, 30), std=5e-4)
        for own in (stage, without):
            health = fit_life(history, own, 1, chains=False).health
            low, high = np.quantile(health, (0.05, 0.95), axis=(0, 1))
            held[own is stage] += int(np.sum((low <= 1) & (high >= 1)))
    assert held[True] == 8 > held[False]


def test_a_gain_is_found_by_a_change_without_a_law(tmp_path: Path) -> None:
    """A mount that settles stiffer is found so; by laws that only lose it is not."""
    preload, mount = 1 - 0.25 * TRAVEL / TRAVEL[-1], 1 + 0.15 * np.sqrt(TRAVEL / TRAVEL[-1])
    ln_health = np.log([preload, mount]).T
    noise = 5e-4 * np.random.default_rng(1).standard_normal((TRAVEL.size, 3))
    ln_f = np.log(FREQUENCY) + true_drift(NAMES, ln_health) + noise
    history = make_history(ln_f, travel=TRAVEL, std=5e-4)
    medians = []
    for free in (0.05, 0):
        tail = f"[life]\nfree = {free}\nlone_mode = 0\ncommon_wander = 0\n"
        stage = make_stage(tmp_path / str(free), (PRELOAD, MOUNT), n_modes=3, tail=tail)
        life = fit_life(history, stage, 1, chains=False)
        low, median, high = np.quantile(life.health[..., 1], (0.01, 0.5, 0.99))
        medians.append(median)
        assert (low < 1.15 < high) == (free > 0)
    assert medians[0] > 1.1
    assert medians[1] < 1.08  # laws alone


@pytest.fixture(scope="module")
def alone(small_grid: None, tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Three modes, of which one may move alone."""
    parameters = (FADING_OR_NOT, MOUNT_OR_NOT)
    return make_stage(tmp_path_factory.mktemp("alone"), parameters, n_modes=3, tail="")


def test_a_mode_that_moves_alone_is_found_with_its_drift(alone: Stage) -> None:
    """Yaw by −2 %, the others not at all: yaw alone, by 2 %, and health of 1; not if all move."""
    noise = 5e-4 * np.random.default_rng(1).standard_normal((TRAVEL.size, 3))
    share = TRAVEL[:, None] / TRAVEL[-1]
    drift = {"alone": share * [0.0, 0.0, -0.02]}
    loss = np.log(1 - 0.2 * share) * [1.0, 0.0]
    drift["wear"] = true_drift(NAMES, loss)
    for kind, own in drift.items():
        history = make_history(np.log(FREQUENCY) + own + noise, travel=TRAVEL, std=5e-4)
        life = fit_life(history, alone, 1, chains=False)
        share_of_lone = np.mean(life.lone == 2)
        assert life.fit > 0.01
        for one in life.lone_modes:
            own_share = np.mean(life.lone == life.modes.index(one.mode))
            assert one.probability == pytest.approx(own_share, abs=1e-12)
        if kind == "alone":
            assert share_of_lone > 0.95
            yaw = life.lone_modes[0]
            assert yaw.mode == "yaw"
            assert abs(yaw.size + 0.02) < 4 * yaw.std < 0.008
            low, high = np.quantile(life.health[..., 0], (0.05, 0.95))
            assert low < 1 < high + 1e-9
            assert np.mean(life.health[..., 0] < 0.9) < 0.05
        else:
            assert share_of_lone < 0.2
            assert np.median(life.health[..., 0]) == pytest.approx(0.8, abs=0.05)


def test_a_mode_that_jumps_alone_at_a_step_is_no_health(alone: Stage) -> None:
    """Yaw by −2 % between two logs: health of 1; control: a jump of all modes as of the map."""
    noise = 5e-4 * np.random.default_rng(1).standard_normal((TRAVEL.size, 3))
    n, first = TRAVEL.size, TRAVEL.size // 2
    after = (np.arange(n) >= first)[:, None]
    wear = true_drift(NAMES, np.log(1 - 0.2 * after) * [1.0, 0.0])
    for own, health in ((after * [0.0, 0.0, -0.02], 1.0), (wear, 0.8)):
        history = make_history(np.log(FREQUENCY) + own + noise, travel=TRAVEL, std=5e-4)
        history = replace(history, steps=(Step.found("step", first, n),))
        life = fit_life(history, alone, 1, chains=False)
        assert np.median(life.health[..., 0]) == pytest.approx(health, abs=0.05)
        assert (np.mean(life.lone == 2) > 0.9) == (health == 1.0)


@pytest.mark.slow
def test_the_probability_of_fit_is_uniform_on_lives_of_the_model(alone: Stage) -> None:
    """Of forty drawn lives p is not far from uniform; of doubled noise all are small."""
    rng, p, p_wrong = np.random.default_rng(4), list[float](), list[float]()
    slopes = np.array([SENSITIVITY[name] for name in NAMES])
    for k in range(40):
        rate = rng.uniform(-0.3, 0.5) / TRAVEL[-1]
        x = np.log(np.column_stack([1 - rate * TRAVEL, np.ones(TRAVEL.size)]))
        # The map is wrong by 5 % of what each parameter does to each mode.
        error = 0.05 * rng.standard_normal(slopes.shape)
        drift = true_drift(NAMES, x) + x @ (slopes * error)
        walk = rng.choice([1e-5, 1.5e-3]) / np.sqrt(TRAVEL.size)
        drift += walk * np.cumsum(rng.standard_normal(drift.shape), axis=0)
        noise = rng.standard_normal(drift.shape)
        for factor, found in ((1.0, p), (2.5, p_wrong)):
            if factor > 1 and k >= 10:
                continue
            ln_f = np.log(FREQUENCY) + drift + factor * 5e-4 * noise
            history = make_history(ln_f, travel=TRAVEL, std=5e-4)
            found.append(fit_life(history, alone, k, chains=False).fit)
    assert stats.kstest(p, "uniform").pvalue > 1e-3
    assert stats.kstest(p_wrong, "uniform").pvalue < 1e-3  # negative control
