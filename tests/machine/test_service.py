"""Service dates: closed forms of age replacement, accepted risks, and draws past the horizon."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, date, datetime, time, timedelta

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.stats import weibull_min

from lmshealth._private.arrays import FloatArray
from lmshealth.life.prognosis import Prognosis
from lmshealth.machine.service import (
    cheapest_travel,
    day_after,
    decide,
    probability_before,
    remaining_days,
    without_limits,
)
from lmshealth.stage.description import Decision
from tests.lives import START, make_prognosis

SCALE = 1e6
SHARES = (np.arange(10_000) + 0.5) / 10_000


@pytest.fixture
def rng() -> np.random.Generator:
    """Return a generator with a fixed seed."""
    return np.random.default_rng(8)


def aged(remaining: FloatArray, age: float, *, horizon: float = 1e8) -> Prognosis:
    """Make a prognosis of a machine so many m after its baseline; 10 km a day."""
    made = make_prognosis(remaining, np.full(remaining.size, 1e4), horizon=horizon)
    return replace(made, curve_travel=made.curve_travel + made.travel - age)


def weibull(shape: float) -> FloatArray:
    """Draw lives of a Weibull distribution at evenly spaced probabilities."""
    return np.asarray(weibull_min.ppf(SHARES, shape, scale=SCALE))


def midnight(day: date) -> float:
    """Days from the last log to the beginning of a day."""
    return (datetime.combine(day, time(), UTC) - START).total_seconds() / 86400


# a stated risk


def test_the_service_day_is_the_last_with_the_risk_allowed() -> None:
    """With one draw in ten failing per day, a risk of 0.35 lasts to the day of the fourth."""
    remaining = np.arange(1.0, 11.0) * 1e4
    prognosis = make_prognosis(remaining, np.full(10, 1e4))
    for risk, days in ((0.05, 1), (0.35, 4), (0.95, 10)):
        day = decide(prognosis, Decision(max_risk=risk)).by
        assert day == (START + timedelta(days=days)).date()
        assert np.mean(remaining / 1e4 <= midnight(day)) <= risk
        assert np.mean(remaining / 1e4 <= midnight(day) + 1) > risk


def test_a_limit_that_is_passed_needs_service_today() -> None:
    """More risk than allowed already: the day of the last log, not one before it."""
    prognosis = make_prognosis(np.full(100, -5e5), np.full(100, 1e4))
    assert decide(prognosis, Decision(max_risk=0.05)).by == START.date()
    service = decide(prognosis, Decision())
    assert (service.kind, service.by, service.risk) == ("now", START.date(), 1.0)
    assert service.wait == -50


def test_no_service_is_needed_past_the_horizon() -> None:
    """A quantile past the horizon, or never, is no date."""
    few = np.r_[np.full(4, 1e5), np.full(96, np.inf)]
    for remaining in (np.full(100, 2e7), np.full(100, np.inf), few):
        prognosis = make_prognosis(remaining, np.full(100, 1e4))
        assert decide(prognosis, Decision(max_risk=0.05)).by is None
        service = decide(prognosis, Decision())
        assert (service.kind, service.by, service.wait) == ("later", None, np.inf)
        assert np.isnan(service.risk)


def test_an_idle_machine_needs_no_service_within_any_calendar() -> None:
    """A day past the last one of the calendar is no date, and no error."""
    prognosis = make_prognosis(np.full(100, 9e6), np.full(100, 1.0))
    assert decide(prognosis, Decision(max_risk=0.05)).by is None
    service = decide(prognosis, Decision())
    assert (service.kind, service.by) == ("unknown", None)
    assert np.isfinite(service.wait)
    assert day_after(prognosis, np.inf) is None


def test_a_draw_past_the_horizon_may_fail_there(rng: np.random.Generator) -> None:
    """Whatever usage does, the risk at the service day is within the accepted one, at most."""
    usage = 1e4 * np.exp(0.5 * rng.standard_normal(1000))
    remaining = rng.uniform(0, 2e7, 1000)
    prognosis = make_prognosis(remaining, usage)
    for risk in (0.05, 0.2, 0.45):
        day = decide(prognosis, Decision(max_risk=risk)).by
        assert day is not None
        reached = probability_before(prognosis, day)
        assert reached[0, -1] <= reached[1, -1] <= risk
        assert probability_before(prognosis, day + timedelta(days=30))[1, -1] > risk


# a ratio of costs


@pytest.mark.parametrize("shape", [1.5, 2.0, 4.0])
@pytest.mark.parametrize("ratio", [3.0, 20.0])
def test_a_new_machine_is_replaced_at_the_age_of_the_known_equation(
    shape: float, ratio: float
) -> None:
    """Weibull lives: h(t) ∫S − F = 1 / (r − 1), the first-order condition of age replacement."""
    life = weibull_min(shape, scale=SCALE)

    def condition(t: float) -> float:
        hazard = life.pdf(t) / life.sf(t)
        return float(hazard * quad(life.sf, 0, t)[0] - life.cdf(t) - 1 / (ratio - 1))

    expected = brentq(condition, 1e-3 * SCALE, 5 * SCALE)
    found = cheapest_travel(aged(weibull(shape), 0.0), ratio)
    assert found == pytest.approx(expected, rel=0.02)


@pytest.mark.slow
def test_the_costs_of_an_old_machine_are_least_by_the_formula() -> None:
    """With an age, costs per travel by numerical integration are nowhere less than 0.1 % lower."""
    age, ratio, life = 4e5, 8.0, weibull_min(2.5, scale=SCALE)

    def cost(t: float) -> float:
        spent = 1 + (ratio - 1) * life.cdf(t)
        return float(spent / (age + quad(life.sf, 0, t)[0]))

    found = cheapest_travel(aged(weibull(2.5), age), ratio)
    best = min(cost(t) for t in np.linspace(0, 3 * SCALE, 600))
    assert cost(found) < 1.001 * best
    assert cost(1.5 * found) > 1.01 * best and cost(0.5 * found) > 1.01 * best


def test_a_constant_hazard_is_now_or_never() -> None:
    """Exponential remaining life of mean m at age a: now if r > 1 + m / a, else never."""
    prognosis = aged(weibull(1.0), 5e5)
    assert cheapest_travel(prognosis, 2.8) == np.inf
    assert cheapest_travel(prognosis, 3.2) == prognosis.remaining.min() < 1e-4 * SCALE
    assert decide(prognosis, Decision(cost_ratio=3.2)).kind == "now"
    assert cheapest_travel(aged(weibull(1.0), 0.0), 1e3) == np.inf


def test_a_falling_hazard_needs_no_service(rng: np.random.Generator) -> None:
    """With a falling failure rate a service saves nothing, also with random draws."""
    for draws in (weibull(0.6), SCALE * rng.weibull(0.6, 10_000)):
        assert cheapest_travel(aged(draws, 0.0), 20.0) == np.inf
        service = decide(aged(draws, 0.0), Decision(cost_ratio=20.0))
        assert (service.kind, service.by, service.kept_risk) == ("later", None, None)


def test_the_dearer_a_failure_the_earlier_the_service(rng: np.random.Generator) -> None:
    """Days never get later with the ratio; an infinite one has the day before the first draw."""
    prognosis = aged(SCALE * rng.weibull(2.0, 2000), 2e5)
    ratios = np.geomspace(1.01, 1e4, 60)
    found = np.array([cheapest_travel(prognosis, ratio) for ratio in ratios])
    asked = np.isfinite(found)
    assert not asked[0] and asked.sum() > 40
    assert (np.diff(asked.astype(int)) >= 0).all()
    assert (np.diff(found[asked]) <= 0).all() and found[asked][0] > 2 * found[-1]
    assert cheapest_travel(prognosis, 1e12) == prognosis.remaining.min()


def test_a_life_that_is_known_is_used_to_its_end() -> None:
    """Where all draws are one there is no reason to service earlier."""
    assert cheapest_travel(aged(np.full(100, SCALE), 1e5), 10.0) == SCALE


def test_draws_past_their_limit_need_service_now_and_not_later() -> None:
    """The larger their share the less worth it is to go on; none of them is taken for a life."""
    future = weibull(4.0)
    kinds = []
    for share in (0.0, 0.02, 0.5, 1.0):
        draws = future.copy()
        draws[: int(share * draws.size)] = -1e5
        kinds.append(decide(aged(np.sort(draws), 1e6), Decision(cost_ratio=10.0)).kind)
    assert kinds[0] == "by" and kinds[2:] == ["now", "now"]


def test_draws_past_the_horizon_only_count_as_alive_up_to_it() -> None:
    """What they do behind it changes nothing; an optimum behind it is no date."""
    wear_out = weibull(4.0)
    cut = np.where(wear_out > 9e5, np.inf, wear_out)
    near = cheapest_travel(aged(wear_out, 0.0, horizon=9e5), 30.0)
    assert near == cheapest_travel(aged(cut, 0.0, horizon=9e5), 30.0) < 9e5
    assert near == cheapest_travel(aged(wear_out, 0.0), 30.0)
    assert cheapest_travel(aged(wear_out, 0.0, horizon=2e5), 30.0) == np.inf
    assert cheapest_travel(aged(np.full(100, np.inf), 0.0), 30.0) == np.inf


@pytest.mark.parametrize("factor", [1e-9, 1e9])
def test_the_unit_of_length_does_not_matter(factor: float) -> None:
    """Lives and horizon that are so much longer ask for service after so much more travel."""
    lives = weibull(2.0)[::100]
    found = cheapest_travel(aged(lives, 0.0), 5.0)
    assert 0 < found < SCALE
    longer = aged(factor * lives, 0.0, horizon=factor * 1e8)
    assert cheapest_travel(longer, 5.0) == pytest.approx(factor * found)


def test_costs_choose_a_day_at_the_median_usage() -> None:
    """Days are travel over usage, and the risk is that of the chosen day."""
    prognosis = aged(weibull(3.0), 1e5)
    travel = cheapest_travel(prognosis, 10.0)
    service = decide(prognosis, Decision(cost_ratio=10.0, next_service=date(2026, 3, 21)))
    assert service.kind == "by"
    assert service.by == (START + timedelta(days=travel / 1e4)).date()
    assert service.wait == pytest.approx(travel / 1e4)
    expected = weibull_min.cdf(1e4 * midnight(service.by), 3.0, scale=SCALE)
    assert service.risk == pytest.approx(expected, abs=2e-4)
    assert (service.max_risk, service.cost_ratio, service.kept_risk) == (None, 10.0, service.risk)
    low, high = service.planned_risk
    assert low == high == probability_before(prognosis, date(2026, 3, 21))[1, -1]


def test_a_new_shift_brings_the_next_log_and_the_cheapest_day_forward() -> None:
    """Travel to the next log is at the present usage, not at that of the whole life to come."""
    prognosis = aged(weibull(3.0), 1e5)
    busy = replace(prognosis, usage_now=2 * prognosis.usage)
    slow = replace(prognosis, usage_now=prognosis.usage / 2)
    before, after, low = (decide(one, Decision(cost_ratio=10.0)) for one in (prognosis, busy, slow))
    assert after.wait == pytest.approx(before.wait / 2)
    assert before.inspect_by is not None and after.inspect_by is not None
    assert after.inspect_by < before.inspect_by
    # A rest may end: what comes is as before.
    assert (low.wait, low.inspect_by) == (before.wait, before.inspect_by)


# a given day


def test_the_probability_before_a_day_is_the_share_of_draws() -> None:
    """Per limit and for any: draws whose travel is used up when the day begins."""
    one, other = np.arange(1.0, 11.0) * 1e4, np.arange(10.0, 0.0, -1.0) * 2e4
    made = make_prognosis(one, np.full(10, 1e4))
    both = replace(
        made,
        parameters=("guide_preload", "mount_stiffness", "any"),
        limits=np.array([0.6, 0.7, np.nan]),
        remaining=np.column_stack([one, other, np.minimum(one, other)]),
        half=np.column_stack([one, other]) / 2,
        health=np.ones((10, 2)),
        curve_quantiles=np.ones((5, 3, 2)),
    )
    reached = probability_before(both, (START + timedelta(days=5)).date())  # 4.75 days
    np.testing.assert_allclose(reached[0], [0.4, 0.2, 0.6])
    np.testing.assert_array_equal(*reached)


def test_a_day_behind_the_horizon_has_bounds() -> None:
    """Draws that are past the horizon by then count in the upper bound only."""
    remaining = np.r_[np.full(30, 5e6), np.full(50, 2e7), np.full(20, np.inf)]
    prognosis = make_prognosis(remaining, np.full(100, 1e4), horizon=1e7)
    for days, low, high in ((400, 0.0, 0.0), (900, 0.3, 0.3), (1200, 0.3, 1.0)):
        reached = probability_before(prognosis, (START + timedelta(days=days)).date())
        assert (*reached[:, -1],) == (low, high)
    assert np.isinf(remaining_days(prognosis)[30:]).all()


def test_a_day_that_is_past_has_what_is_reached_already() -> None:
    """The probability before the last log is that of having passed the limit."""
    prognosis = make_prognosis(np.r_[-1e5, -1.0, 1e6, 2e6], np.full(4, 1e4))
    for day in (START.date(), date(2020, 1, 1)):
        assert probability_before(prognosis, day)[0, -1] == prognosis.already_past()[-1] == 0.5


def test_without_a_prognosis_the_service_is_unknown() -> None:
    """No kind but unknown, no day and no risk."""
    service = decide(None, Decision(max_risk=0.1, next_service=date(2026, 3, 21)))
    assert (service.kind, service.by, service.planned) == ("unknown", None, None)
    assert np.isnan([service.wait, service.risk, *service.planned_risk]).all()
    assert service.kept_risk == 0.1


def missed(prognosis: Prognosis, every: float) -> float:
    """Return the share of draws that end without a log after half of the loss, log by log."""
    found = 0
    for half, left in zip(prognosis.half[:, 0], prognosis.remaining[:, -1], strict=True):
        log = every
        while log < half:
            log += every
        found += log >= left
    return found / len(prognosis.half)


def test_logs_at_the_advised_interval_announce_the_end(rng: np.random.Generator) -> None:
    """At most a fifth of the accepted risk ends unannounced; logs a tenth rarer would miss more."""
    prognosis = aged(SCALE * rng.weibull(3.0, 4000), 2e5)
    service = decide(prognosis, Decision())
    assert service.inspect_by is not None and service.by is not None
    assert service.earliest_end is not None
    assert service.inspect_by <= service.by and service.earliest_end <= service.by
    assert missed(prognosis, service.inspect_every) <= 0.01
    assert missed(prognosis, service.inspect_every / 0.9) > 0.01
    # Faster losses ask for more frequent logs; without an end no log is asked for.
    late = replace(prognosis, half=0.95 * prognosis.remaining[:, :-1])
    steep = replace(prognosis, half=0.5 * prognosis.remaining[:, :-1])
    assert decide(steep, Decision()).inspect_every == service.inspect_every
    assert 0 < decide(late, Decision()).inspect_every < 0.5 * service.inspect_every
    endless = decide(aged(np.full(100, np.inf), 2e5), Decision())
    assert (endless.inspect_by, endless.inspect_every) == (None, np.inf)
    assert endless.earliest_end is None


def test_after_work_logs_are_as_frequent_as_the_limits_left_ask_for() -> None:
    """The half of the loss is that of the limit reached first of those that are not restored."""
    late = make_prognosis(np.linspace(4e6, 6e6, 100), np.full(100, 1e4))
    late = replace(late, half=0.95 * late.remaining[:, :-1])
    soon = late.remaining[:, :-1] / 50
    both = replace(
        late,
        parameters=("mount_stiffness", *late.parameters),
        limits=np.array([0.6, *late.limits]),
        remaining=np.column_stack([soon, late.remaining[:, :-1], soon]),
        half=np.column_stack([soon / 2, late.half]),
        health=np.tile(late.health, 2),
        curve_quantiles=np.tile(late.curve_quantiles, 2),
    )
    left = without_limits(both, ["mount_stiffness"])
    assert left is not None and left.parameters == late.parameters
    every = [decide(one, Decision()).inspect_every for one in (both, left, late)]
    assert every[1] == every[2] != every[0]
