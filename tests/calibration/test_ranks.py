"""Ranks of truths among draws, coverage of intervals, and their judgement."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from lmshealth.calibration.ranks import (
    clopper_pearson,
    judge,
    judge_places,
    place,
    rank_p_value,
    uniform,
)
from tests.oracles import check_coverage
from tests.test_metrics import NEVER, lives


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


def test_p_values_of_coverage_are_those_of_its_interval() -> None:
    """Twice the smaller tail: the level of the interval that just contains the nominal."""
    p = judge_places(np.repeat([0.01, 0.5], [7, 13]), 0.9)["p_value"]
    assert p == pytest.approx(2 * stats.binom.cdf(13, 20, 0.9))
    assert clopper_pearson(13, 20, 1 - p)[1] == pytest.approx(0.9)
    assert judge_places(np.full(10, 0.5), 0.9)["p_value"] == pytest.approx(2 * 0.9**10)


@pytest.mark.parametrize("n", [1, 2, 15, 100])
def test_p_values_of_ranks_are_exact(n: int) -> None:
    """Of 4,000 uniform sets the p value is below a level as often as that, and no more."""
    rng = np.random.default_rng(n)
    p = np.array([rank_p_value(rng.uniform(size=n)) for _ in range(4000)])
    for level in (0.3, 0.05, 0.01):
        at = p[p <= level].max(initial=0.0)  # the level is met exactly where p has a value
        hits = int(np.sum(p <= level))
        assert stats.binomtest(hits, p.size, max(at, 1e-9)).pvalue > 1e-4 or hits == 0
        assert stats.binomtest(hits, p.size, level, alternative="greater").pvalue > 1e-4


def test_ranks_off_at_either_end_or_in_the_middle_are_improbable() -> None:
    """Negative controls: biased, too narrow and too wide posteriors of 120 lives."""
    u = (np.arange(120) + 0.5) / 120
    assert rank_p_value(u) > 0.99
    for wrong in (u**2, 1 - u**2, 0.25 + u / 2, stats.beta(0.4, 0.4).ppf(u)):
        assert rank_p_value(wrong) < 1e-3


def test_coverage_counts_and_judges() -> None:
    """Central intervals, their share, and whether it may be the nominal one."""
    found = judge_places(np.array([0.04, 0.06, 0.5, 0.94, 0.96]), 0.9)
    assert (found["hits"], found["n"], found["share"], found["holds"]) == (3, 5, 0.6, True)
    assert not judge_places(np.full(100, 0.01), 0.9)["holds"]


@pytest.mark.parametrize(("factor", "fine"), [(1.0, True), (0.5, False), (2.0, False)])
def test_both_sides_are_judged(factor: float, fine: bool) -> None:
    """Draws as wide as the truth scatters pass; of half and of double the width they do not."""
    rng = np.random.default_rng(7)
    truth, draws = rng.normal(size=150), factor * rng.normal(size=(127, 150))
    found = judge(place(draws, truth, rng))
    assert uniform({"one": found}) == fine
    shares = [row["share"] for row in found["coverage"]]
    assert sum(found["histogram"]) == found["n"] == 150
    if not fine:
        assert (shares[0] > 0.5) == (factor > 1)
