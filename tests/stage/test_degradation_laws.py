"""Degradation laws: coordinates, Jacobians, priors and first passages."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import get_args

import msgspec
import numpy as np
import pytest
from scipy import stats
from scipy.optimize import brentq

from lmshealth.stage.degradation_laws import (
    Accelerating,
    AnyLaw,
    Free,
    HertzWear,
    Law,
    Linear,
    Loosening,
    Power,
    Unchanging,
)
from lmshealth.stage.priors import Lognormal, Normal, Prior, Uniform
from tests.installed import install, run_script
from tests.lives import FADING, map_rows, stage_text

NOW = 1.7e6
WEAR = HertzWear(Lognormal(8000, 1.0), Uniform(0.7, 1.6))
LOOSE = Loosening(Lognormal(4000, 1.0), Uniform(0.3, 1.0))
POWER = Power(Lognormal(6000, 0.5), Uniform(0.5, 2.0))
LINEAR = Linear(Normal(0.0, 2e-4))
LATE = Accelerating(life_km=Lognormal(4000, 1.0), slow=Lognormal(0.1, 1.0))
FREE = Free()
LAWS = [WEAR, LOOSE, POWER, LINEAR, LATE]
NAMES = ["hertz-wear", "loosening", "power", "linear", "accelerating"]


def natural_prior(law: AnyLaw, name: str) -> tuple[Prior, float]:
    """Prior of a natural parameter, and the unit of its field over that of the parameter."""
    unit = 1e-3 if name.endswith("_m") else 1.0
    unit = 1 / unit if name.endswith("_per_m") else unit
    return getattr(law, f"{name.removesuffix('_m')}_km" if name.endswith("_m") else name), unit


def natural_log_prior(law: AnyLaw, theta: np.ndarray) -> float:
    """Log prior density of natural parameters, lengths in m."""
    total = 0.0
    for name, value in zip(law.names, theta, strict=True):
        prior, unit = natural_prior(law, name)
        total += float(prior.log_density(np.array([value * unit]))[0] + np.log(unit))
    return total


def numerical_log_jacobian(law: AnyLaw, y: np.ndarray) -> float:
    """Log |det dθ/dy| by central differences."""
    columns = []
    for j in range(y.size):
        shift = np.zeros_like(y)
        shift[j] = 1e-5
        up, down = law.natural((y + shift)[None], NOW)[0], law.natural((y - shift)[None], NOW)[0]
        columns.append((up - down) / 2e-5)
    return float(np.linalg.slogdet(np.column_stack(columns))[1])


@pytest.mark.parametrize("law", LAWS, ids=NAMES)
def test_prior_in_coordinates_is_the_natural_one_times_the_jacobian(law: AnyLaw) -> None:
    """Log prior in coordinates is the natural one plus the log Jacobian: it has the integral 1."""
    y = law.draw(np.random.default_rng(1), 40, NOW)
    found = law.log_prior(y, NOW)
    known = [
        natural_log_prior(law, theta) + numerical_log_jacobian(law, point)
        for theta, point in zip(law.natural(y, NOW), y, strict=True)
    ]
    np.testing.assert_allclose(found, known, atol=2e-5)


def test_truncated_priors_have_the_integral_1() -> None:
    """Of lengths above 0 and floors from 0 to 1, on a grid of coordinates."""
    wear = HertzWear(life_km=Normal(1000.0, 800.0))
    loose = Loosening(life_km=Lognormal(4000.0, 1.0), floor=Normal(0.8, 0.3))
    ends: tuple[tuple[AnyLaw, tuple[float, float], tuple[float, float]], ...] = (
        (wear, (-12.0, 12.0), (-14.0, 14.0)),
        (loose, (-20.0, 1.0), (np.log(1e4), np.log(1e9))),
    )
    for law, first, second in ends:
        y1, y2 = np.linspace(*first, 1500), np.linspace(*second, 700)
        y = np.stack(np.meshgrid(y1, y2, indexing="ij"), axis=-1).reshape(-1, 2)
        mass = np.exp(law.log_prior(y, 3e5)).sum() * (y1[1] - y1[0]) * (y2[1] - y2[0])
        assert mass == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("law", LAWS, ids=NAMES)
def test_draws_follow_the_prior(law: AnyLaw) -> None:
    """Draws, turned to natural parameters, have the quantiles of the stated priors."""
    theta = law.natural(law.draw(np.random.default_rng(2), 20_000, NOW), NOW)
    for name, values in zip(law.names, theta.T, strict=True):
        prior, unit = natural_prior(law, name)
        for level in (0.1, 0.5, 0.9):
            share = np.mean(values * unit < prior.quantile(np.array(level)))
            assert abs(share - level) < 5 * np.sqrt(level * (1 - level) / 20_000)


@pytest.mark.parametrize("now", [1e4, NOW])
def test_a_free_change_by_now_is_normal_whenever_now_is(now: float) -> None:
    """Ln health now is N(0, std), in both directions; exponent and bend have their priors.

    On the way it is that of the formula.
    """
    law = Free(std=0.2, exponent_sigma=0.4, bend_std=1.5)
    y = law.draw(np.random.default_rng(5), 20_000, now)
    theta = law.natural(y, now)
    change = np.log(law.health(theta, np.array([0.0, now / 4, now])))
    assert (change[:, 0] == 0).all()
    assert stats.kstest(change[:, 2], stats.norm(0, 0.2).cdf).pvalue > 1e-4
    assert stats.kstest(change[:, 2], stats.norm(0, 0.22).cdf).pvalue < 1e-4  # negative control
    b, c = theta[:, 1], theta[:, 2] * now ** theta[:, 1]
    assert stats.kstest(np.log(b), stats.norm(0, 0.4).cdf).pvalue > 1e-4
    assert stats.kstest(c, stats.norm(0, 1.5).cdf).pvalue > 1e-4
    share = (1 - np.exp(-c * 0.25**b)) / (1 - np.exp(-c))
    np.testing.assert_allclose(change[:, 1], change[:, 2] * share, rtol=1e-7)
    assert np.abs(np.atleast_2d(np.corrcoef(y.T))[np.triu_indices(3, 1)]).max() < 4.5 / np.sqrt(
        20_000
    )
    # The density is that of the draws: its mean is minus the entropy of three standard normals.
    value = law.log_prior(y, now)
    assert abs(value.mean() + 1.5 * np.log(2 * np.pi * np.exp(1.0))) < 5 * value.std() / np.sqrt(
        20_000
    )


def test_a_free_change_without_a_bend_is_a_power() -> None:
    """At a bend of 0, and next to it, the formula has no gap."""
    y = np.array([[1.0, 0.6, bend] for bend in (0.0, 1e-12, 1e-7, -1e-7)])
    travel = NOW * np.array([0.2, 1.0, 3.0])
    change = np.log(FREE.health(FREE.natural(y, NOW), travel))
    known = 0.15 * (travel / NOW) ** np.exp(0.5 * 0.6)
    np.testing.assert_allclose(change, np.tile(known, (4, 1)), rtol=1e-6)


def test_the_prior_of_a_free_change_integrates_to_one() -> None:
    """By quadrature on a grid of its coordinates."""
    axis = np.linspace(-7, 7, 71)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    total = np.exp(FREE.log_prior(grid, NOW)).sum() * (axis[1] - axis[0]) ** 3
    assert total == pytest.approx(1, abs=1e-9)


def test_a_free_change_ends_where_it_loses_and_never_where_it_gains() -> None:
    """Losses that do not settle above a limit reach it, gains none; one of 1 is reached at once."""
    theta = FREE.natural(FREE.draw(np.random.default_rng(6), 2000, NOW), NOW)
    per_power, _, bend = theta.T
    loses = per_power < 0
    assert 900 < loses.sum() < 1100
    # Where it settles, at r / k.
    floor = np.where(bend > 0, per_power / np.where(bend > 0, bend, 1.0), -np.inf)
    ends = loses & (floor < np.log(0.8))
    assert (loses & ~ends).sum() > 100
    passage = FREE.passage(theta, np.array(0.8))
    np.testing.assert_array_equal(np.isfinite(passage), ends)
    at = FREE.health(theta[ends], passage[ends, None])[:, 0]
    np.testing.assert_allclose(at, 0.8, rtol=1e-7)
    assert (FREE.health(theta[~loses], np.array([NOW, 9 * NOW])) >= 1).all()
    np.testing.assert_array_equal(FREE.passage(theta, np.array(1.0)), 0.0)


@pytest.mark.parametrize("law", [*LAWS, FREE, Unchanging()], ids=[*NAMES, "free", "none"])
def test_draws_are_finite_and_inside_the_support(law: AnyLaw) -> None:
    """Every draw of a prior has a finite density there."""
    y = law.draw(np.random.default_rng(3), 2000, NOW)
    assert y.shape == (2000, len(law.names))
    assert np.isfinite(y).all()
    assert np.isfinite(law.log_prior(y, NOW)).all()


@pytest.mark.parametrize(
    "law",
    [HertzWear(Normal(5000, 3000)), Loosening(Normal(5000, 3000), Normal(0.9, 0.1))],
    ids=["hertz-wear", "loosening"],
)
def test_a_prior_that_reaches_below_zero_is_cut_there(law: AnyLaw) -> None:
    """A normal prior of a length puts no draw at NaN, from where no sampler can start."""
    y = law.draw(np.random.default_rng(3), 2000, NOW)
    assert y.shape == (2000, len(law.names))
    assert np.isfinite(y).all()


def test_draws_are_of_the_truncated_prior() -> None:
    """Floor and life of normal priors are distributed as scipy's truncated normal."""
    law = Loosening(Normal(5000, 3000), Normal(0.9, 0.2))
    floor, life = law.natural(law.draw(np.random.default_rng(3), 20_000, NOW), NOW).T
    assert stats.kstest(floor, stats.truncnorm(-4.5, 0.5, 0.9, 0.2).cdf).pvalue > 1e-3
    assert stats.kstest(life / 1e3, stats.truncnorm(-5 / 3, np.inf, 5e3, 3e3).cdf).pvalue > 1e-3


@pytest.mark.parametrize("law", [*LAWS, FREE], ids=[*NAMES, "free"])
def test_closed_form_passage_is_the_root_of_health(law: AnyLaw) -> None:
    """Where a limit is reached, root finding on health gives the same travel."""
    theta = law.natural(law.draw(np.random.default_rng(4), 60, NOW), NOW)
    for limit in (0.35, 0.6, 0.95):
        passage = law.passage(theta, np.array(limit))
        assert passage.shape == (theta.shape[0],)
        for row, travel in zip(theta[:, None], passage, strict=True):

            def off(s: float, row: np.ndarray = row, limit: float = limit) -> float:
                return float(law.health(row, np.array([s]))[0, 0] - limit)

            if np.isfinite(travel):
                root = brentq(off, 0.0, 4 * travel, xtol=1e-9 * travel, rtol=1e-13)
                assert travel == pytest.approx(root, rel=1e-8)
            else:
                assert off(1e13) > -1e-12


@pytest.mark.parametrize("law", [*LAWS, FREE, Unchanging()], ids=[*NAMES, "free", "none"])
def test_each_draw_may_have_its_own_limit(law: AnyLaw) -> None:
    """An array of limits gives what each limit alone gives, up to those at the baseline."""
    theta = law.natural(law.draw(np.random.default_rng(7), 40, NOW), NOW)
    limit = np.linspace(0.1, 1.0, 40)
    together = law.passage(theta, limit)
    alone = [law.passage(row[None], one)[0] for row, one in zip(theta, limit, strict=True)]
    np.testing.assert_array_equal(together, alone)
    assert together[-1] == 0


@pytest.mark.parametrize("law", [*LAWS, Unchanging()], ids=[*NAMES, "none"])
def test_each_draw_may_have_its_own_travel(law: AnyLaw) -> None:
    """Health at travels of each draw is that of each draw alone."""
    theta = law.natural(law.draw(np.random.default_rng(8), 10, NOW), NOW)
    travel = np.random.default_rng(9).uniform(-1e5, 4e6, (10, 3))
    together = law.health(theta, travel)
    assert together.shape == (10, 3)
    alone = [law.health(row[None], own)[0] for row, own in zip(theta, travel, strict=True)]
    np.testing.assert_array_equal(together, alone)


@pytest.mark.parametrize("law", [*LAWS, Unchanging()], ids=[*NAMES, "none"])
def test_before_it_begins_a_law_changes_nothing(law: AnyLaw) -> None:
    """Travel below 0 is of a time before the law: health is whole."""
    theta = law.natural(law.draw(np.random.default_rng(10), 20, NOW), NOW)
    np.testing.assert_allclose(law.health(theta, np.array([-1e6, 0.0])), 1.0, atol=1e-14)


def test_every_law_of_a_description_is_tested() -> None:
    """The laws above are all that a description may name, each with a label for reports."""
    assert {type(law) for law in [*LAWS, FREE, Unchanging()]} == set(get_args(AnyLaw))
    assert all(law.label for law in get_args(AnyLaw))


@pytest.mark.parametrize(
    ("law", "kind"), [*zip(LAWS, NAMES, strict=True), (Unchanging(), "none")], ids=[*NAMES, "none"]
)
def test_laws_have_a_kind_and_a_weight(law: AnyLaw, kind: str) -> None:
    """A law has the name of the description, and weight 1 by default."""
    assert law.kind == kind
    assert law.weight == 1
    assert msgspec.structs.replace(law, weight=2.5).weight == 2.5
    assert msgspec.convert(msgspec.to_builtins(law) | {"weight": 3}, AnyLaw).weight == 3
    for weight in (0, -1.0, 1e7):
        with pytest.raises(msgspec.ValidationError, match="weight"):
            msgspec.convert(msgspec.to_builtins(law) | {"weight": weight}, AnyLaw)


def test_health_starts_at_one_and_stays_above_zero() -> None:
    """Every law is whole at the baseline and never negative."""
    travel = np.array([0.0, 1e5, 1e7, 1e12])
    for law in LAWS:
        y = law.draw(np.random.default_rng(5), 50, NOW)
        health = law.health(law.natural(y, NOW), travel)
        np.testing.assert_allclose(health[:, 0], 1.0, atol=1e-14)
        assert (health >= 0).all()


def test_wear_is_hertz_and_power_is_not() -> None:
    """Wear has the outer exponent 3/2 of a Hertz contact, a power law has 1."""
    theta, travel = np.array([[4e6, 1.2]]), np.array([1e6])
    loss = (1e6 / 4e6) ** 1.2
    np.testing.assert_allclose(WEAR.health(theta, travel), [[(1 - loss) ** 1.5]])
    np.testing.assert_allclose(POWER.health(theta, travel), [[1 - loss]])


def test_a_limit_that_is_never_reached_is_infinite() -> None:
    """Floors above the limit, gains and unchanging parameters never fail."""
    assert np.isinf(LOOSE.passage(np.array([[0.8, 1e6]]), np.array(0.7))).all()
    assert np.isinf(LINEAR.passage(np.array([[-1e-9], [0.0]]), np.array(0.7))).all()
    assert np.isinf(Unchanging().passage(np.empty((3, 0)), np.array(0.7))).all()
    assert (Unchanging().health(np.empty((3, 0)), np.zeros(4)) == 1).all()


def test_lower_limits_are_reached_later() -> None:
    """First passage grows as the limit falls."""
    for law in LAWS:
        theta = law.natural(law.draw(np.random.default_rng(6), 50, NOW), NOW)
        passages = [law.passage(theta, np.array(limit)) for limit in (0.99, 0.8, 0.5, 0.31)]
        for early, late in pairwise(passages):
            keep = np.isfinite(early)
            assert (early[keep] <= late[keep]).all()


@pytest.mark.parametrize("y", [[-400.0, 0.0], [400.0, 0.0], [0.0, 50.0], [1e3, -600.0]])
@pytest.mark.parametrize("law", [WEAR, LOOSE], ids=["hertz-wear", "loosening"])
def test_far_off_walkers_raise_no_warning(law: AnyLaw, y: list[float]) -> None:
    """Coordinates far outside the posterior give a number or minus infinity, never an error."""
    point = np.array([y])
    assert not np.isposinf(law.log_prior(point, NOW)).any()
    health = law.health(law.natural(point, NOW), np.array([0.0, NOW]))
    assert health.shape == (1, 2)


@pytest.mark.parametrize(
    ("law", "message"),
    [
        (
            lambda: HertzWear(life_km=Uniform(-5.0, -1.0)),
            "life_km must lie between 1e-06 and 1e.12",
        ),
        (
            lambda: HertzWear(Lognormal(8000, 1), Uniform(-0.7, 1.6)),
            "exponent needs a range within 0.01 to 20",
        ),
        (lambda: Loosening(Lognormal(4000, 1), Uniform(1.3, 2.0)), "floor must lie between"),
        (lambda: Loosening(Normal(-9.0, 1.0), Uniform(0.3, 1.0)), "life_km must lie between"),
    ],
)
def test_laws_that_cannot_be_are_refused(law: Callable[[], Law], message: str) -> None:
    """Priors outside of what makes sense are refused before anything is drawn from them."""
    with pytest.raises(ValueError, match=message):
        law()


# Laws of other packages

_MODULE = """
from lmshealth.stage.degradation_laws import Linear

class Swelling(Linear, frozen=True, tag="swelling", tag_field="kind"):
    "Gain in proportion to travel."
    label = "swelling"

def nothing():
    "No law."
"""
_SCRIPT = """
import numpy as np
from lmshealth import load_stage
stage = load_stage("small.toml")
(law,) = stage.parameters[0].laws
print(law.kind, law.label)
from lmshealth.life.posterior.fit import fit_life
from tests.lives import FREQUENCY, make_history, true_drift
travel = np.linspace(0, 1e6, 8)
drift = true_drift(("guide_preload",), np.log(1 - 2e-7 * travel)[:, None])[:, :2]
life = fit_life(make_history(np.log(FREQUENCY[:2]) + drift, travel=travel), stage, 1, chains=False)
print({path.law.kind for one in life.scenarios for path in one.scenario.paths})
print(round(float(np.median(life.health)), 2))
"""


@pytest.mark.slow
def test_a_law_of_another_package_is_one_of_a_description(tmp_path: Path) -> None:
    """An entry point adds a kind of law, which is fitted; without the package it is unknown."""
    law = FADING.replace('kind = "linear"', 'kind = "swelling"')
    (tmp_path / "small.toml").write_text(stage_text((law,)))
    (tmp_path / "map.csv").write_text("\n".join(map_rows(("guide_preload",))) + "\n")
    entries = "[lmshealth.laws]\nswelling = swelling:Swelling\nother = swelling:nothing\n"
    package = install(tmp_path, "swelling", _MODULE, entries)
    for known in (True, False):
        done = run_script(_SCRIPT, cwd=tmp_path, package=package if known else None)
        if known:
            assert done.returncode == 0, done.stderr
            kind, kinds, median = done.stdout.splitlines()
            assert kind == "swelling swelling"
            assert "swelling" in kinds
            assert float(median) == pytest.approx(0.8, abs=0.05)
        else:
            assert "swelling" in done.stderr and "BadStage" in done.stderr
