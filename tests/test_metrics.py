"""Metrics of predictions against their definitions and against known distributions."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy import stats

from lmshealth.calibration.ranks import clopper_pearson
from studies.harness.metrics import crps, service_at, unexpected_breaks

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
