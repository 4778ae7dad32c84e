"""Tests of the truth laws."""

import itertools
from dataclasses import asdict
from datetime import UTC, datetime

import numpy as np
import pytest
from scipy.optimize import bisect

from models.dynamics.plant import GUIDE_MODES, closed_loop_modes
from models.dynamics.stages import STAGES, Condition
from models.errors import UnknownLife
from models.lives.degradation import (
    GUIDE_PRELOAD_LIMIT,
    HALL,
    LIVES,
    MOUNT_STIFFNESS_LIMIT,
    ROOM,
    Delayed,
    Grease,
    HertzWear,
    Jobs,
    Loosening,
    Steady,
    Stepped,
    draw_laws,
)
from models.lives.further_lives import ALL_LIVES, life_named

SEEDS = range(200)
# What each life changes other than the temperature.
CHANGES = {
    "healthy": set(),
    "preload-wear": {"guide_preload"},
    "mount-loosening": {"mount_stiffness"},
    "both": {"guide_preload", "mount_stiffness"},
    "sudden-loosening": {"mount_stiffness"},
    "crash": {"guide_preload", "mount_stiffness"},
    "regreasing": {"guide_damping"},
    "temperature-only": set(),
    "payload-change": {"added_payload"},
    "servo-retuning": {"servo_id"},
}


def life(name, seed):
    """Return a life as the seed draws it."""
    return life_named(name, np.random.default_rng(seed))


def test_laws_start_at_one_and_fall():
    """New is 1, and nothing heals."""
    for law in (HertzWear(8000.0, 1.1), Loosening(3000.0, 0.55)):
        values = [law.at(s) for s in np.linspace(0, 7000, 50)]
        assert values[0] == 1.0
        assert np.all(np.diff(values) < 0)


@pytest.mark.parametrize(
    ("law", "limit"), [(HertzWear(8000.0, 1.1), 0.6), (Loosening(3000.0, 0.55), 0.7)]
)
def test_limit_odometer_is_where_the_law_reaches_it(law, limit):
    """The closed form and the law agree."""
    assert law.at(law.reaches_km(limit)) == pytest.approx(limit, rel=1e-12)


def test_never_is_never():
    """A floor above the limit and a steady parameter are never crossed."""
    assert Loosening(3000.0, 0.75).reaches_km(0.7) is None
    assert Steady().reaches_km(0.6) is None
    assert Delayed(Steady(), 500.0).reaches_km(0.6) is None
    assert Stepped(Steady(), 500.0, 0.8).reaches_km(0.7) is None


def test_draws_follow_their_distributions():
    """Medians and ranges of 2,000 drawn laws are those stated (4.5 σ of the median)."""
    rng = np.random.default_rng(0)
    draws = [draw_laws(rng) for _ in range(2000)]
    tolerance = 4.5 * 0.25 * 1.2533 / np.sqrt(2000)
    for values, median in (
        ([d.wear.life_km for d in draws], 8000.0),
        ([d.loosening.scale_km for d in draws], 3000.0),
    ):
        assert abs(np.log(np.median(values) / median)) < tolerance
    assert all(0.9 <= d.wear.exponent <= 1.3 for d in draws)
    assert all(0.5 <= d.loosening.floor <= 0.65 for d in draws)


def test_climate_stays_in_its_range():
    """The room stays within ±3 K of its mean, the hall within ±10 K."""
    rng = np.random.default_rng(1)
    for climate, reach in ((ROOM, 3.0), (HALL, 10.0)):
        values = [
            climate.at(datetime(2026, month, day, hour, tzinfo=UTC), rng)
            for month in range(1, 13)
            for day in (1, 15)
            for hour in (3, 9, 15, 21)
        ]
        assert np.ptp(values) > reach
        assert np.abs(np.array(values) - climate.mean_c).max() <= reach


def test_lives_of_one_seed_share_their_laws():
    """`both` wears and loosens exactly as the single-cause lives do."""
    both, wear, loose = (
        life_named(n, np.random.default_rng(7)) for n in ("both", "preload-wear", "mount-loosening")
    )
    assert both.preload == wear.preload
    assert both.mount == loose.mount
    assert isinstance(wear.mount, Steady)


def test_unknown_life_lists_the_known():
    """An unknown life raises and names the registered ones."""
    with pytest.raises(UnknownLife, match="healthy") as caught:
        life_named("eternal", np.random.default_rng(0))
    assert caught.value.known == ALL_LIVES


def test_draws_begin_as_they_always_did():
    """The first four draws of a seed are those of wear and loosening: lives of old stay."""
    rng, again = np.random.default_rng(5), np.random.default_rng(5)
    draws = draw_laws(rng)
    assert draws.wear.life_km == 8000.0 * np.exp(0.25 * again.standard_normal())
    assert draws.wear.exponent == again.uniform(0.9, 1.3)
    assert draws.loosening.floor == again.uniform(0.5, 0.65)
    assert draws.loosening.scale_km == 3000.0 * np.exp(0.25 * again.standard_normal())


@pytest.mark.parametrize("name", sorted(LIVES))
def test_a_life_changes_what_it_says_and_nothing_else(name):
    """Over 2,000 km exactly the stated parts of the condition leave commissioning."""
    new = asdict(Condition())
    for seed in range(10):
        own = life(name, seed)
        rows = [asdict(own.condition(s, 21.0)) for s in np.linspace(0.0, 2000.0, 41)]
        moved = {key for row in rows for key in row if row[key] != new[key]}
        # A crash may leave the mount as it was.
        optional = {"mount_stiffness"} if name == "crash" else set()
        assert CHANGES[name] - optional <= moved <= CHANGES[name]


def first_passage(law, limit, end_km):
    """Return the first odometer (km) at which a law is at its limit, by search; None if never."""
    grid = np.linspace(0.0, end_km, 401)
    below = np.array([law.at(s) <= limit for s in grid])
    if not below.any():
        return None
    k = int(np.argmax(below))
    # The law may step: bisection needs a change of sign and no continuity.
    return bisect(lambda s: 0.5 - (law.at(s) <= limit), grid[k - 1], grid[k], xtol=1e-9)


@pytest.mark.parametrize("name", sorted(LIVES))
def test_first_passage_agrees_with_a_search(name):
    """The closed form is where a search finds the law at its limit, steps included."""
    limits = {"guide_preload": GUIDE_PRELOAD_LIMIT, "mount_stiffness": MOUNT_STIFFNESS_LIMIT}
    for seed in range(50):
        own = life(name, seed)
        found = {
            "guide_preload": first_passage(own.preload, limits["guide_preload"], 20000.0),
            "mount_stiffness": first_passage(own.mount, limits["mount_stiffness"], 20000.0),
        }
        for key, expected in found.items():
            assert own.limits_km()[key] == (expected and pytest.approx(expected, abs=1e-6))
        first = min((km for km in found.values() if km is not None), default=None)
        assert own.failure_km() == (first and pytest.approx(first, abs=1e-6))


def test_steps_cross_limits_in_every_way():
    """Over the seeds a crash fails at the impact or after it, a bolt likewise."""
    for name in ("crash", "sudden-loosening"):
        at_step = [
            life(name, seed).failure_km() == draw_laws(np.random.default_rng(seed)).event_km
            for seed in SEEDS
        ]
        assert 0.1 < np.mean(at_step) < 0.9
    early = Stepped(HertzWear(1000.0, 1.0), 900.0, 0.5)
    assert early.reaches_km(0.6) == HertzWear(1000.0, 1.0).reaches_km(0.6)


def test_wear_goes_on_after_a_crash():
    """Preload steps down at the impact and falls on as it would have, in proportion."""
    draws, crash = draw_laws(np.random.default_rng(2)), life("crash", 2).preload
    assert crash.at(draws.event_km) / crash.at(draws.event_km - 1e-6) == pytest.approx(
        draws.crash_preload, rel=1e-6
    )
    for s in (draws.event_km + 1.0, draws.event_km + 2000.0):
        assert crash.at(s) == draws.wear.at(s) * draws.crash_preload


def test_a_broken_bolt_is_followed_by_loosening():
    """The mount is whole before, loses a part at once, and loosens from then on."""
    draws, mount = draw_laws(np.random.default_rng(2)), life("sudden-loosening", 2).mount
    assert mount.at(draws.event_km - 1e-6) == 1.0
    assert mount.at(draws.event_km) == pytest.approx(draws.bolt, rel=1e-12)
    later = mount.at(draws.event_km + 1500.0)
    assert later == pytest.approx(draws.bolt * draws.loosening.at(1500.0), rel=1e-12)


def test_grease_ages_and_is_renewed():
    """The guide's loss falls from 1, steps up when regreased, and falls again."""
    grease = Grease(800.0, 1.4, 0.8, 700.0)
    before, after = (
        [grease.at(s) for s in np.linspace(low, high, 9)] for low, high in ((0, 799), (800, 3e3))
    )
    assert before[0] == 1.0
    assert after[0] == pytest.approx(1.4)
    for values in (before, after):
        assert np.all(np.diff(values) < 0)
        assert min(values) > 0.8


def test_jobs_take_turns():
    """Each load is carried for its distance, then the next, then the first again."""
    jobs = Jobs((0.0, 2.0, -1.0), 300.0)
    assert [jobs.at(s) for s in (0.0, 299.0, 300.0, 650.0, 901.0)] == [0.0, 0.0, 2.0, -1.0, 0.0]


@pytest.mark.slow
def test_regreasing_hardly_moves_frequencies():
    """Over the seeds guide dampings step by a fifth at least, frequencies by 2e-3 at most."""
    for stage in STAGES.values():
        for seed in range(5):
            own, event = life("regreasing", seed), draw_laws(np.random.default_rng(seed)).event_km
            before, after = (
                {m.name: m for m in closed_loop_modes(stage, own.condition(km, 21.0))}
                for km in (event - 1e-3, event)
            )
            for name in GUIDE_MODES:
                assert abs(np.log(after[name].frequency_hz / before[name].frequency_hz)) < 2e-3
                assert after[name].damping_ratio / before[name].damping_ratio > 1.2


def test_the_hall_moves_frequencies_as_a_damage_does():
    """Day and season each move roll of Y, together as much as a tenth of the preload does."""
    rng = np.random.default_rng(3)

    def roll(*condition):
        modes = closed_loop_modes(STAGES["lms-y"], Condition(*condition))
        return next(np.log(m.frequency_hz) for m in modes if m.name == "roll")

    def temperature(month, hour):
        moments = [datetime(2026, month, day, hour, tzinfo=UTC) for day in range(1, 29)]
        return float(np.mean([HALL.at(moment, rng) for moment in moments]))

    day = roll(1.0, 1.0, temperature(7, 3)) - roll(1.0, 1.0, temperature(7, 15))
    season = roll(1.0, 1.0, temperature(1, 15)) - roll(1.0, 1.0, temperature(7, 15))
    assert day == pytest.approx(8e-4 * 2 * HALL.daily_k, rel=0.1)
    assert season == pytest.approx(8e-4 * 2 * HALL.seasonal_k, rel=0.1)
    assert day + season > roll(1.0, 1.0) - roll(0.9, 1.0)


@pytest.mark.slow
@pytest.mark.parametrize("stage", sorted(STAGES))
def test_every_life_stays_stable_and_named(stage):
    """At the start, around the event, at failure and past it every mode has a name and decays."""
    conditions = set()
    for name, seed in itertools.product(LIVES, SEEDS[::2]):
        own, event = life(name, seed), draw_laws(np.random.default_rng(seed)).event_km
        failure = own.failure_km() or 1500.0
        travels = (0.0, event - 1e-6, event, failure, 1.25 * failure)
        # The hall's warmest day: soft joints damp least.
        conditions |= {own.condition(km, 31.5) for km in travels}
    assert len(conditions) > 1000
    names = {mode.name for mode in closed_loop_modes(STAGES[stage])}
    for condition in conditions:
        modes = closed_loop_modes(STAGES[stage], condition)
        assert {mode.name for mode in modes} == names
        assert len(modes) == len(names) == 17
        assert min(mode.damping_ratio for mode in modes) > 0.005
