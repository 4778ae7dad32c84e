"""Remaining life: censoring, usage, determinism, and a grid as oracle."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from lmshealth.errors import BadStage, NotEnoughData
from lmshealth.life import constants
from lmshealth.life.posterior import sampling
from lmshealth.life.posterior.fit import fit_life
from lmshealth.life.posterior.likelihood import LifeDensity, LifeLikelihood
from lmshealth.life.prognosis import (
    LawWeight,
    Prognosis,
    _beyond_laws,
    _usage,
    early_life,
    identifiable_limits,
    parameters_with_limit,
    prognose,
)
from lmshealth.stage.degradation_laws import Accelerating, Free, Linear
from lmshealth.stage.description import Stage
from lmshealth.stage.priors import Lognormal, Normal
from lmshealth.tracking.history import History, Step
from tests.lives import (
    FADING,
    FOOT,
    FREQUENCY,
    LAWS_ALONE,
    MOUNT,
    PRELOAD,
    START,
    STILL_MOUNT,
    TEMPERATURE,
    cut,
    make_history,
    make_stage,
    true_drift,
)

KNOWN_USAGE = LAWS_ALONE + "[usage]\nkm_per_day = 20\nhorizon_km = 5000\n"
FADING_OR_NOT = FADING.replace("law = {", "law = [{").replace("} }\n", "} }, { kind = 'none' }]\n")
LIMITED_FOOT = FOOT + "limit = { below = 0.8 }\n"


@pytest.fixture(scope="module", autouse=True)
def small_grid() -> Iterator[None]:
    """Average over two walks, in short chains, about exact laws: checks hold for any of them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(constants, "WALK_STDS", (1e-5, 1.5e-3))
        patch.setattr(constants, "WALK_PRIOR", (0.5, 0.5))
        patch.setattr(sampling, "_FIRST_STEPS", 300)
        patch.setattr(constants, "NOISE_SCALES", (1.0,))
        patch.setattr(constants, "NOISE_SCALE_PRIOR", (1.0,))
        patch.setattr(constants, "DEVIATION_STDS", (0.0,))
        patch.setattr(constants, "DEVIATION_PRIOR", (1.0,))
        patch.setattr(constants, "UNSEEN_ONSETS", 1e-9)
        patch.setattr(constants, "RATE_STD", 0.0)
        yield


def fading_life(rate_per_km: float, n: int = 8, *, baseline: int = 0, seed: int = 1) -> History:
    """Make the life of a preload that fades in proportion to travel, 100 km to 1,500 km."""
    travel = np.linspace(1e5, 1.5e6, n)
    left = 1 - rate_per_km / 1000 * np.maximum(travel - travel[baseline], 0)
    drift = true_drift(("guide_preload",), np.log(left)[:, None])[:, :2]
    noise = 1e-3 * np.random.default_rng(seed).standard_normal((n, 2))
    return make_history(np.log(FREQUENCY[:2]) + drift + noise, travel=travel, baseline=baseline)


@pytest.fixture(scope="module")
def stage(small_grid: None, tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Load a fading preload with limit 0.6, an unchanging mount and an unseen foot; 20 km a day."""
    folder = tmp_path_factory.mktemp("stage")
    parameters = (FADING, STILL_MOUNT, LIMITED_FOOT)
    return make_stage(folder, parameters, tail=TEMPERATURE + KNOWN_USAGE)


@pytest.fixture(scope="module")
def fading(stage: Stage) -> Prognosis:
    """Preload at about 0.79 after 1,400 km: some 1,300 km left."""
    return prognose(fading_life(1.5e-4), stage, 3)


@pytest.mark.slow
def test_four_thousand_draws_and_the_first_limit(fading: Prognosis) -> None:
    """4,000 draws of each limit; "any" is the smaller of them, draw by draw."""
    assert fading.parameters == ("guide_preload", "mount_stiffness", "any")
    assert fading.remaining.shape == (4000, 3)
    np.testing.assert_array_equal(fading.remaining[:, 2], fading.remaining[:, :2].min(axis=1))
    np.testing.assert_array_equal(fading.limits, [0.6, 0.7, np.nan])


@pytest.mark.slow
def test_remaining_life_is_that_of_a_grid(stage: Stage, fading: Prognosis) -> None:
    """Quantiles of the remaining travel have the right probability on a 1-D grid."""
    likelihood = LifeLikelihood.of(fading_life(1.5e-4), stage)
    y = np.linspace(-0.3, 0.6, 4001)[:, None]
    density = LifeDensity(likelihood, likelihood.data.scenarios[0], likelihood.grid)
    value = density.log_probability(y)
    density = np.exp(value - value.max())
    cdf = (np.cumsum(density) - 0.5 * density) / density.sum()
    for level in (0.05, 0.25, 0.5, 0.75, 0.95):
        left = np.quantile(fading.remaining[:, 0], level)
        rate = 0.4 / (left + 1.4e6)  # what is lost per metre if the limit comes after that
        share = 1 - np.interp(rate * 1.4e6, y[:, 0], cdf)
        assert abs(share - level) < 5 * np.sqrt(level * (1 - level) / fading.ess) + 0.02


@pytest.mark.slow
def test_intervals_hold_the_truth(fading: Prognosis) -> None:
    """Truth of health and remaining life lie within the central 99 % of this life's draws."""
    left = 0.4 / 1.5e-7 - 1.4e6
    low, high = np.quantile(fading.remaining[:, 0], [0.005, 0.995])
    assert low < left < high
    low, high = np.quantile(fading.health[:, 0], [0.005, 0.995])
    assert low < 0.79 < high


@pytest.mark.slow
def test_limits_never_reached_stay_infinite(fading: Prognosis) -> None:
    """An unchanging parameter never fails: infinite in every draw, and past every horizon."""
    assert np.isinf(fading.remaining[:, 1]).all()
    assert fading.beyond_horizon()[1] == 1
    assert fading.already_past()[1] == 0
    assert (fading.health[:, 1] == 1).all()


@pytest.mark.slow
def test_a_machine_that_does_not_wear_keeps_its_censored_draws(stage: Stage) -> None:
    """With rates around 0 about half of the draws gain, and are kept as infinite."""
    found = prognose(fading_life(0.0), stage, 4)
    infinite = np.isinf(found.remaining[:, 0])
    assert 0.02 < infinite.mean() < 0.98
    assert found.beyond_horizon()[0] >= infinite.mean()
    assert found.remaining.shape == (4000, 3)
    assert np.isfinite(found.curve_quantiles).all()


@pytest.mark.slow
def test_a_limit_that_is_past_has_negative_life(stage: Stage) -> None:
    """Preload at 0.5, limit 0.6: past with certainty, by the travel since."""
    found = prognose(fading_life(0.5 / 1400), stage, 5)
    assert found.already_past()[0] > 0.99
    assert np.median(found.remaining[:, 0]) == pytest.approx(1.12e6 - 1.4e6, abs=8e4)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_prognosis(stage: Stage, fading: Prognosis) -> None:
    """Two prognoses with one seed agree to the bit."""
    again = prognose(fading_life(1.5e-4), stage, 3)
    np.testing.assert_array_equal(again.remaining, fading.remaining)
    np.testing.assert_array_equal(again.curve_quantiles, fading.curve_quantiles)


@pytest.mark.slow
def test_curves_start_whole_and_fall(fading: Prognosis) -> None:
    """Quantile curves start at the baseline with 1, are ordered, and their median falls."""
    assert fading.curve_travel[0] == 1e5
    np.testing.assert_allclose(fading.curve_quantiles[:, 0], 1.0)
    assert (np.diff(fading.curve_quantiles, axis=0) >= -1e-12).all()
    assert (np.diff(fading.curve_quantiles[2, :, 0]) <= 0).all()
    assert fading.curve_travel[-1] > 1.5e6
    assert fading.curve_travel[-1] <= 1.5e6 + fading.horizon


@pytest.mark.slow
def test_draws_of_health_and_remaining_life_agree(fading: Prognosis) -> None:
    """Draw by draw, health now and remaining travel come from the same life."""
    rate = (1 - fading.health[:, 0]) / 1.4e6
    losing = rate > 0
    left = 0.4 / rate[losing] - 1.4e6
    np.testing.assert_allclose(fading.remaining[losing, 0], left, rtol=1e-9, atol=1e-3)
    assert (fading.remaining[~losing, 0] == np.inf).all()


@pytest.mark.slow
def test_the_travel_counts_from_the_baseline(stage: Stage) -> None:
    """With a later baseline the clock starts there: 1,000 km worn of the 2,667 km to the limit."""
    found = prognose(fading_life(1.5e-4, 15, baseline=4), stage, 6)
    since = 1.5e6 - np.linspace(1e5, 1.5e6, 15)[4]
    low, high = np.quantile(found.remaining[:, 0], [0.005, 0.995])
    assert low < 0.4 / 1.5e-7 - since < high
    assert found.curve_travel[0] == pytest.approx(1.5e6 - since)


@pytest.mark.slow
def test_usage_that_is_stated_is_taken(fading: Prognosis) -> None:
    """Stated kilometres per day come out as metres per day without spread."""
    assert (fading.usage == 20_000).all()
    assert fading.horizon == 5e6


def test_stated_usage_needs_no_odometer(stage: Stage) -> None:
    """A machine with one log, which gives no usage, has the stated usage."""
    rng, left = np.random.default_rng(9), np.array([-1e5, 1e6, np.inf])
    usage, _ = _usage(cut(fading_life(1e-4), 1), stage, rng, left, 2e7)
    np.testing.assert_array_equal(usage, np.full(3, 2e4), strict=True)


@pytest.fixture(scope="module")
def unstated(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Load a stage whose usage has to be read from the odometer."""
    return make_stage(tmp_path_factory.mktemp("unstated"), (FADING,), tail=LAWS_ALONE)


def moved(rng: np.random.Generator, n: int, spread: float) -> History:
    """Make a still life of n weeks, of 140 km each but for normal differences."""
    steps = 1.4e5 * (1 + spread * rng.standard_normal(n))
    ln_f = np.tile(np.log(FREQUENCY[:2]), (n + 1, 1))
    return make_history(ln_f, travel=np.r_[0, np.cumsum(steps)])


@pytest.fixture
def unchanging_usage(monkeypatch: pytest.MonkeyPatch) -> None:
    """Exclude that the usage has changed."""
    monkeypatch.setattr(constants, "USAGE_CHANGED", 1e-300)


@pytest.mark.usefixtures("unchanging_usage")
def test_usage_is_estimated_from_the_odometer(unstated: Stage) -> None:
    """Of three weeks' logs the mean of years to come has the relative error of Student's t."""
    history, n_draws = moved(np.random.default_rng(7), 3, 0.2), 10_000
    steps = np.diff(history.travel)
    usage, _ = _usage(history, unstated, np.random.default_rng(8), np.full(n_draws, np.inf), 2e8)
    off = np.log(usage * 7 / steps.mean()) / (np.std(steps, ddof=1) / steps.mean())
    assert stats.kstest(off * np.sqrt(3), stats.t(2).cdf).pvalue > 1e-3
    # Negative control: a normal distribution in place of Student's t.
    assert stats.kstest(off * np.sqrt(3), stats.norm.cdf).pvalue < 1e-3


@pytest.mark.usefixtures("unchanging_usage")
def test_a_short_life_has_the_usage_of_few_days(unstated: Stage) -> None:
    """The uncertainty of the next week is the scatter of weeks and that of the mean of 40."""
    history, n_draws = moved(np.random.default_rng(7), 40, 0.2), 10_000
    steps = np.diff(history.travel)
    usage, _ = _usage(history, unstated, np.random.default_rng(8), np.full(n_draws, 1.4e5), 1e7)
    off = np.log(usage * 7 / steps.mean()) / (np.std(steps, ddof=1) / steps.mean())
    spread = np.sqrt(1 / 40 + steps.mean() / 1.4e5)
    assert stats.kstest(off / spread, stats.norm.cdf).pvalue > 1e-3
    # Negative control: without the scatter of the week.
    assert stats.kstest(off * np.sqrt(40), stats.norm.cdf).pvalue < 1e-3


@pytest.mark.usefixtures("unchanging_usage")
def test_life_past_or_without_end_has_a_usage(unstated: Stage) -> None:
    """Lives that are over scatter most, those without end as at the horizon; none goes back."""
    history = moved(np.random.default_rng(11), 10, 0.3)
    stds = []
    for left in (-1e6, 1e6, np.inf):
        usage, _ = _usage(history, unstated, np.random.default_rng(12), np.full(4000, left), 2e7)
        assert (usage > 0).all()
        stds.append(np.std(np.log(usage)))
    assert stds[0] > stds[1] > stds[2] > 0


def with_usage(factors: np.ndarray) -> History:
    """Make a still life of weeks of 140 km, each by a factor, with a scatter of a tenth."""
    rng = np.random.default_rng(3)
    steps = 1.4e5 * factors * (1 + 0.1 * rng.standard_normal(factors.size))
    ln_f = np.tile(np.log(FREQUENCY[:2]), (factors.size + 1, 1))
    return make_history(ln_f, travel=np.r_[0, np.cumsum(steps)])


@pytest.mark.parametrize(("since", "factor"), [(20, 1.0), (12, 2.0), (6, 5.0), (6, 0.3)])
def test_usage_is_that_of_the_present_phase(unstated: Stage, since: int, factor: float) -> None:
    """With the mean of the whole record, services of a machine with a new shift came too late."""
    history = with_usage(np.where(np.arange(30) < 30 - since, 1.0, factor))
    left = np.full(4000, 0.5 * since * factor * 1.4e5)  # half as long as the phase has lasted
    usage, _ = _usage(history, unstated, np.random.default_rng(1), left, 2e8)
    usage = usage / 20_000
    assert np.median(usage) == pytest.approx(factor, rel=0.15)
    low, high = np.quantile(usage, (0.05, 0.95))
    assert low < factor < high
    # The phase may end before the life does.
    assert factor == 1 or (low < 0.8 * factor if factor > 1 else high > 1.25 * factor)


def test_a_holiday_is_no_usage_of_years_to_come(unstated: Stage) -> None:
    """A phase of one log lasts about as long again: the mean of a long life is that before."""
    history = with_usage(np.append(np.ones(29), 0.02))
    usage, _ = _usage(history, unstated, np.random.default_rng(1), np.full(4000, 7e6), 2e8)
    assert np.median(usage) == pytest.approx(20_000, rel=0.15)
    assert np.mean(usage < 10_000) < 0.25


def test_an_odometer_without_usage_is_refused(unstated: Stage) -> None:
    """Logs of one moment give no usage; the error names the key to state."""
    history, rng, left = fading_life(1e-4), np.random.default_rng(9), np.full(10, 1e6)
    once = replace(history, recorded_at=(START,) * 8)
    with pytest.raises(NotEnoughData, match=r"state \[usage\] km_per_day"):
        _usage(once, unstated, rng, left, 2e7)
    twice = replace(history, recorded_at=(START,) * 4 + (START + timedelta(days=9),) * 4)
    with pytest.raises(NotEnoughData, match="km_per_day"):
        _usage(twice, unstated, rng, left, 2e7)


def test_without_a_limit_there_is_no_end(tmp_path: Path) -> None:
    """No limit, no prognosis."""
    stage = make_stage(tmp_path, (FADING.replace("limit = { below = 0.6 }", ""),))
    with pytest.raises(BadStage, match=r"no \[\[parameter\]\] has a limit"):
        prognose(fading_life(1e-4), stage, 1)


def test_a_stage_without_any_law_never_fails(tmp_path: Path) -> None:
    """Where nothing may change the prognosis is infinite, without sampling."""
    stage = make_stage(tmp_path, (STILL_MOUNT,), tail=KNOWN_USAGE)
    found = prognose(fading_life(0.0), stage, 1)
    assert np.isinf(found.remaining).all()
    assert found.degrees_of_freedom == pytest.approx(16 - 2, abs=0.01)
    assert np.isfinite(found.curve_quantiles).all()
    assert found.laws == (LawWeight("mount_stiffness", "none", 0.0, 1.0),)


@pytest.mark.slow
def test_an_unidentifiable_parameter_is_named_and_left_out(stage: Stage, fading: Prognosis) -> None:
    """The foot has a limit, but moves no mode: it has no remaining life and is not in "any"."""
    assert fading.unidentifiable == ("foot",)
    assert fading.health.shape == (4000, 2)
    assert fading.curve_quantiles.shape[2] == 2
    assert {weight.parameter for weight in fading.laws} == {"guide_preload", "mount_stiffness"}
    assert [p.name for _, p in parameters_with_limit(stage)] == [
        "guide_preload",
        "mount_stiffness",
        "foot",
    ]
    found = identifiable_limits(stage, ("roll", "pitch"))
    assert [(j, p.name) for j, p in found] == [(0, "guide_preload"), (1, "mount_stiffness")]


@pytest.mark.slow
def test_a_life_without_identifiable_limit_is_refused(tmp_path: Path) -> None:
    """Without an identifiable parameter with a limit there is no prognosis, but the reason."""
    stage = make_stage(tmp_path, (PRELOAD.replace("limit = { below = 0.6 }", ""), LIMITED_FOOT))
    with pytest.raises(NotEnoughData, match="roll, pitch identify no parameter that has a limit"):
        prognose(fading_life(0.0), stage, 1)


@pytest.mark.slow
def test_laws_have_their_probability(tmp_path: Path) -> None:
    """Of a small loss, law and none have the weights of the posterior and of the draws."""
    stage = make_stage(tmp_path, (FADING_OR_NOT, STILL_MOUNT), tail=KNOWN_USAGE)
    history = fading_life(2e-5)
    found, fitted = prognose(history, stage, 3), fit_life(history, stage, 3)
    preload = [weight for weight in found.laws if weight.parameter == "guide_preload"]
    assert {weight.kind for weight in preload} == {"linear", "none"}
    assert preload[0].probability >= preload[1].probability > 0.02
    assert sum(weight.probability for weight in preload) == pytest.approx(1)
    for weight in preload:
        known = fitted.laws("guide_preload")[weight.kind, weight.begin]
        assert weight.probability == known
    none = next(weight for weight in preload if weight.kind == "none")
    still = np.isinf(found.remaining[:, 0]) & (found.health[:, 0] == 1)
    assert still.mean() == pytest.approx(none.probability, abs=1e-3)


@pytest.mark.slow
def test_a_restarted_law_is_reported_with_its_begin(tmp_path: Path) -> None:
    """A preload that fades from a step on has a law that begins there."""
    stage = make_stage(tmp_path, (FADING,), tail=KNOWN_USAGE)
    travel = np.linspace(0, 1.4e6, 15)
    step = float((travel[6] + travel[7]) / 2)
    drift = true_drift(("guide_preload",), np.log(1 - 4e-7 * np.maximum(travel - step, 0))[:, None])
    noise = 1e-3 * np.random.default_rng(1).standard_normal((15, 2))
    history = make_history(np.log(FREQUENCY[:2]) + drift[:, :2] + noise, travel=travel)
    found = prognose(replace(history, steps=(Step.found("step", 7, 15),)), stage, 3)
    assert found.laws[0].begin == step
    assert found.laws[0].probability > 0.6
    assert sum(weight.probability for weight in found.laws) == pytest.approx(1)
    low, high = np.quantile(found.remaining[:, 0], [0.005, 0.995])
    assert low < 0.4 / 4e-7 - (1.4e6 - step) < high
    assert prognose(history, stage, 3).laws == (LawWeight("guide_preload", "linear", 0.0, 1.0),)


@pytest.mark.slow
def test_deviation_makes_life_less_certain(
    stage: Stage, fading: Prognosis, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A deviation widens what is left, and what is past is so of the health that is now."""
    monkeypatch.setattr(constants, "DEVIATION_STDS", (0.08,))
    for rate, past_share in ((1.5e-4, 0.0), (0.4 / 1400, 0.5)):
        found = prognose(fading_life(rate), stage, 3)
        assert found.deviation == pytest.approx(0.08)
        past = found.remaining[:, 0] <= 0
        np.testing.assert_array_equal(past, found.health[:, 0] <= 0.6)
        assert past.mean() == pytest.approx(past_share, abs=0.4)
        assert np.isinf(found.remaining[:, 1]).all()
        if rate == 1.5e-4:
            wide, narrow = (
                np.subtract(*np.quantile(one.remaining[:, 0], [0.95, 0.05]))
                for one in (found, fading)
            )
            assert wide > 1.1 * narrow


@pytest.mark.slow
def test_curves_pass_through_the_health_now(fading: Prognosis) -> None:
    """The band of a parameter at the last log is that of its draws there."""
    order = np.abs(fading.curve_travel - fading.travel).argsort()[:2]
    for level, curve in zip(
        (0.05, 0.5, 0.95), fading.curve_quantiles[[0, 2, 4], :, 0], strict=True
    ):
        low, high = np.sort(curve[order])
        now = np.quantile(fading.health[:, 0], level)
        # The curves are of the same draws, exactly by their laws.
        assert low <= now <= high


@pytest.mark.slow
def test_a_floor_above_the_limit_never_fails_and_one_below_does(tmp_path: Path) -> None:
    """Draws of a mount whose floor lies above the limit are infinite, the others finite."""
    stage = make_stage(tmp_path, (MOUNT,), tail=KNOWN_USAGE)
    travel = np.linspace(0, 2e6, 8)
    x = np.log(0.7 + 0.3 * np.exp(-travel / 1e6))[:, None]
    noise = 2e-3 * np.random.default_rng(3).standard_normal((8, 2))
    ln_f = np.log(FREQUENCY[:2]) + true_drift(("mount_stiffness",), x)[:, :2] + noise
    found = prognose(make_history(ln_f, std=2e-3, travel=travel), stage, 2)
    infinite = np.isinf(found.remaining[:, 0])
    assert 0.05 < infinite.mean() < 0.95
    assert np.isfinite(found.remaining[~infinite]).all()
    assert found.health.shape == (4000, 1)


def test_limited_parameters_keep_their_position(tmp_path: Path) -> None:
    """Parameters with a limit are found with their place among all."""
    stage = make_stage(tmp_path, (FOOT, PRELOAD))
    assert [(j, p.name) for j, p in parameters_with_limit(stage)] == [(1, "guide_preload")]


def test_an_unseen_onset_has_the_hazard_of_none_in_the_travel_proven(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without an end by the law half of the onsets lie within three times the travel proven."""
    monkeypatch.setattr(constants, "UNSEEN_ONSETS", 0.5)
    monkeypatch.setattr(constants, "UNSEEN_GROWTH", Lognormal(0.2, 1e-9))
    law, n, proven = Linear(rate_per_km=Normal(0.0, 2e-4)), 20_000, 1e6
    never, rng = np.full(n, np.inf), np.random.default_rng(1)
    left, half = _beyond_laws(rng, law, never, never, now=3e5, proven=proven)
    # The end at s_e comes 1.2 times as late as its onset s, with P(s > x) = sqrt(proven / x).
    for ahead in (0.5, 1.0, 3.0):
        share = 1 - np.sqrt(1.2 / (1 + ahead))
        assert abs(np.mean(left < ahead * proven) - share) < 5 * np.sqrt(share / n)
    onset = (left + proven) / 1.2
    np.testing.assert_allclose(half + proven, onset * (1 + 0.2 * np.sqrt(0.5)), rtol=1e-6)
    wrong = 1 - np.sqrt(1.2 / 2.0) * 0.9
    assert abs(np.mean(left < proven) - wrong) > 5 * np.sqrt(wrong / n)  # negative control


def test_early_lives_of_a_description_count_as_proven() -> None:
    """A twentieth of the rates of N(0, 2e-4) per km exceeds 3.29e-4: 1,216 km to a limit of 0.6."""
    law = Linear(rate_per_km=Normal(0.0, 2e-4))
    found = early_life(law, 0.6, np.random.default_rng(1))
    assert found == pytest.approx(0.4 / 3.29e-4 * 1e3, rel=0.06)


def test_a_change_without_a_law_proves_no_more_than_the_machine_itself() -> None:
    """Its prior has the scale of the travel seen: lives of other machines do not follow from it.

    With a twentieth of the lives by that prior up to now, which are longer than the travel seen,
    11 of 36 machines that settle, rest and fail late got a service after the end.
    """
    assert early_life(Free(), 0.6, np.random.default_rng(1)) == 0.0


def test_intervals_open_with_the_distance_beyond_the_travel_seen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The rate of a law drifts with the logarithm of travel, most of one that accelerates."""
    monkeypatch.setattr(constants, "RATE_STD", 0.075)
    named = Linear(rate_per_km=Normal(0.0, 2e-4))
    late = Accelerating(life_km=Lognormal(4000, 1.0), slow=Lognormal(0.1, 1.0))
    for law, std in ((named, 0.075), (late, constants.ACCELERATION_STD)):
        for ahead, doublings in ((1e5, np.log2(1.1)), (1e6, 1.0), (3e6, 2.0)):
            left, half = np.full(4000, ahead), np.full(4000, ahead / 2)
            found, halves = _beyond_laws(
                np.random.default_rng(2), law, left, half, now=1e6, proven=1e9
            )
            assert np.log(found).std() == pytest.approx(std * np.sqrt(doublings), rel=0.06)
            np.testing.assert_allclose(halves, found / 2)
    past = np.full(10, -1e5)
    of_past = _beyond_laws(np.random.default_rng(3), named, past, past, now=1e6, proven=1e6)
    np.testing.assert_array_equal(of_past[0], past)


@pytest.mark.parametrize(("deviation", "rate_std"), [(0.0, 0.075), (0.05, 0.075), (0.05, 1.0)])
def test_the_posterior_does_not_depend_on_the_horizon(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, deviation: float, rate_std: float
) -> None:
    """Horizons of 1,000 and 160,000 km: the same health, and the same risks up to the nearer.

    The future that opens brings some ends within the horizon that are beyond it by their law.
    """
    monkeypatch.setattr(constants, "DEVIATION_STDS", (deviation,))
    monkeypatch.setattr(constants, "RATE_STD", rate_std)
    stages = [
        make_stage(tmp_path / str(km), (FADING,), tail=LAWS_ALONE + f"[usage]\nhorizon_km = {km}\n")
        for km in (1000, 160_000)
    ]
    near, far = (prognose(fading_life(1.5e-4), stage, 3, chains=False) for stage in stages)
    np.testing.assert_array_equal(near.health, far.health)
    for share in (0.25, 0.5, 0.75, 1.0):
        risks = [np.mean(one.remaining[:, -1] <= share * near.horizon) for one in (near, far)]
        assert abs(risks[0] - risks[1]) < 0.02
    assert 0.05 < risks[0] < 0.9
