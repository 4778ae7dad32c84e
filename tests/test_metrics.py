"""Metrics of predictions against their definitions and against known distributions."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy import stats

from lmshealth.calibration.ranks import clopper_pearson, judge_places, place
from studies.harness.metrics import crps, service_at, unexpected_breaks
from tests.oracles import check_coverage

NEVER = np.inf


def plain_crps(draws: np.ndarray, truth: float) -> float:
    """Score of draws as a double sum over pairs."""
    pairs = np.abs(draws[:, None] - draws[None])
    return float(np.mean(np.abs(draws - truth)) - 0.5 * np.mean(pairs))


def integrated_crps(draws: np.ndarray, truth: float, horizon: float) -> float:
    """Score of draws as the integral that defines it, piece by piece up to the horizon."""
    cuts = np.unique(np.append(draws[draws < horizon], [min(truth, horizon), horizon]))
    total = 0.0
    for a, b in pairwise(cuts):
        total += (np.mean(draws <= a) - (truth <= a)) ** 2 * (b - a)
    return total


def test_crps_is_the_double_sum() -> None:
    """Sorting gives what all pairs do, with ties and of a single draw too."""
    rng = np.random.default_rng(1)
    draws = np.round(rng.normal(size=(57, 4)), 1)
    truth = rng.normal(size=4)
    expected = [plain_crps(own, y) for own, y in zip(draws.T, truth, strict=True)]
    np.testing.assert_allclose(crps(draws, truth), expected, atol=1e-14)
    assert crps(np.array([[3.0]]), [5.0]) == 2.0


def test_crps_up_to_a_horizon_is_the_integral_up_to_it() -> None:
    """Cutting draws and truth off is the same as not integrating any further."""
    rng = np.random.default_rng(2)
    draws = rng.exponential(size=(40, 5))
    draws[:7] = NEVER
    truth, horizon = np.array([0.3, 0.9, 1.4, 7.0, NEVER]), np.array([1.0, 0.9, 1.2, 2.0, 0.5])
    expected = [
        integrated_crps(own, y, h) for own, y, h in zip(draws.T, truth, horizon, strict=True)
    ]
    np.testing.assert_allclose(crps(draws, truth, horizon=horizon), expected, atol=1e-14)


def test_crps_of_a_normal_distribution() -> None:
    """Evenly spaced quantiles have the closed form of Gneiting2007."""
    mean, std, truth = 3.0, 2.0, np.array([[-1.0, 3.0, 4.5]])
    levels = (np.arange(20_000) + 0.5) / 20_000
    draws = np.repeat(stats.norm(mean, std).ppf(levels)[:, None], 3, axis=1)
    z = (truth[0] - mean) / std
    closed = std * (z * (2 * stats.norm.cdf(z) - 1) + 2 * stats.norm.pdf(z) - 1 / np.sqrt(np.pi))
    np.testing.assert_allclose(crps(draws, truth[0]), closed, rtol=2e-4)


def test_crps_without_end_needs_a_horizon() -> None:
    """Draws or truths that never end are refused unless they are cut off."""
    with pytest.raises(ValueError, match="state a horizon"):
        crps(np.array([[NEVER]]), [1.0])
    with pytest.raises(ValueError, match="state a horizon"):
        crps(np.array([[1.0]]), [NEVER])
    assert crps(np.array([[1.0]]), [NEVER], horizon=4.0) == 3.0
    assert crps(np.full((9, 1), NEVER), [NEVER], horizon=2e7) == 0.0


@pytest.mark.parametrize("horizon", [NEVER, 1.5])
def test_crps_is_proper_with_and_without_censoring(horizon: float) -> None:
    """Nobody has a better expected score than who states the truth, by more than its error."""
    levels = (np.arange(400) + 0.5) / 400
    truth = stats.gamma(2, scale=0.7).ppf((np.arange(2000) + 0.5) / 2000)

    def score(mean: float, width: float) -> float:
        draws = mean + width * (stats.gamma(2, scale=0.7).ppf(levels) - 1.4)
        return float(np.mean(crps(draws[:, None], truth, horizon=horizon)))

    honest = score(1.4, 1.0)
    for wrong in ((1.2, 1.0), (1.6, 1.0), (1.4, 0.7), (1.4, 1.4)):
        assert score(*wrong) > honest + 1e-3


def test_leaving_censored_lives_out_is_not_proper() -> None:
    """Negative control: of the lives that end before the horizon alone, a shorter life is best."""
    levels = (np.arange(400) + 0.5) / 400
    truth = stats.gamma(2, scale=0.7).ppf((np.arange(2000) + 0.5) / 2000)
    draws = stats.gamma(2, scale=0.7).ppf(levels)
    seen = truth[truth < 1.5]
    honest, short = (np.mean(crps(x[:, None], seen)) for x in (draws, draws[draws < 1.5]))
    assert short < 0.9 * honest


def lives(rng: np.random.Generator, n: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    """Draw truths that are one more draw, most of them beyond 1, some never ending."""
    all_draws = rng.exponential(rng.uniform(1, 4, n), size=(100, n))
    all_draws[rng.uniform(size=all_draws.shape) < 0.2] = NEVER
    return all_draws[1:], all_draws[0]


@pytest.mark.parametrize("horizon", [NEVER, 1.0])
def test_places_are_uniform(horizon: float) -> None:
    """Truths that are one more draw are placed evenly, with 20 or 70 % of them censored."""
    rng = np.random.default_rng(3)
    draws, truth = lives(rng)
    assert np.mean(truth >= horizon) > (0.15 if horizon == NEVER else 0.6)
    places = place(draws, truth, rng, horizon=horizon)
    assert stats.kstest(places, "uniform").pvalue > 0.001
    check_coverage(places, calibrated=True)


def test_ranks_that_break_no_ties_are_not_uniform() -> None:
    """Negative control: with heavy censoring strict and middle ranks cover far off."""
    draws, truth = lives(np.random.default_rng(4))
    x, y = np.minimum(draws, 1.0), np.minimum(truth, 1.0)
    strict = np.mean(x < y, axis=0)
    middle = strict + 0.5 * np.mean(x == y, axis=0)
    for wrong in (strict, middle):
        assert stats.kstest(wrong, "uniform").pvalue < 1e-10
        assert not judge_places(wrong, 0.5)["holds"]
    assert judge_places(middle, 0.5)["low"] > 0.7


def test_places_find_draws_that_are_too_sure() -> None:
    """Negative control: draws of half the spread do not cover."""
    rng = np.random.default_rng(5)
    truth = rng.normal(size=2000)
    draws = 0.5 * rng.normal(size=(99, 2000))
    check_coverage(place(draws, truth, rng), calibrated=False)


def test_clopper_pearson_is_exact() -> None:
    """At either end so few or so many hits have the probability of the tail."""
    low, high = clopper_pearson(7, 20, 0.9)
    assert stats.binom.sf(6, 20, low) == pytest.approx(0.05)
    assert stats.binom.cdf(7, 20, high) == pytest.approx(0.05)
    assert clopper_pearson(0, 20)[0] == 0
    assert clopper_pearson(20, 20)[1] == 1


def test_coverage_counts_and_judges() -> None:
    """Central intervals, their share, and whether it may be the nominal one."""
    found = judge_places(np.array([0.04, 0.06, 0.5, 0.94, 0.96]), 0.9)
    assert (found["hits"], found["n"], found["share"], found["holds"]) == (3, 5, 0.6, True)
    assert not judge_places(np.full(100, 0.01), 0.9)["holds"]


def test_service_keeps_to_its_risk() -> None:
    """Before it end no more draws than the risk, before the next draw more; now if there are."""
    draws = np.arange(1.0, 101.0)[:, None]
    for risk in (0.0, 0.05, 0.051, 0.29, 0.99):
        at = service_at(draws, risk)
        assert np.mean(draws < at) <= risk < np.mean(draws <= at)
    assert service_at(draws - 50, 0.05) == 0
    assert service_at(np.full((9, 1), NEVER), 0.05, horizon=7.0) == 7
    assert service_at(draws, 0.05, horizon=3.0) == 3


def test_breaks_happen_as_often_as_risked() -> None:
    """Of calibrated draws the share of lives that end before their service is the risk."""
    rng = np.random.default_rng(6)
    draws, truth = lives(rng)
    service = service_at(draws, 0.1)
    broken = unexpected_breaks(service, truth)
    low, high = clopper_pearson(int(broken.sum()), broken.size, 0.999)
    assert low <= 0.1 <= high
    late = unexpected_breaks(service_at(2 * draws, 0.1), truth)
    assert clopper_pearson(int(late.sum()), late.size, 0.999)[0] > 0.1
