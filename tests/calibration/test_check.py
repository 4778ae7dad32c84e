"""The check of a description: its populations, its judgement, and that it finds faults."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy import stats
from threadpoolctl import threadpool_limits

import lmshealth
from lmshealth.calibration import check as checks
from lmshealth.calibration import constants
from lmshealth.calibration.check import (
    DAYS,
    DRAWN,
    CalibrationCheck,
    LifeOutcome,
    check_calibration,
    draw_outcomes,
    outcome_of,
    ranks_of,
    summarise,
)
from lmshealth.calibration.lives import KINDS, Schedule
from lmshealth.calibration.ranks import place
from lmshealth.errors import BadQuestion, BadStage, NotConverged
from lmshealth.stage.description import Stage, load_stage
from tests.calibration.conftest import SCHEDULE
from tests.lives import STILL_MOUNT, four_settings, make_stage

HEALTH = "guide preload now"


def outcomes(
    n: int, width: float = 1.0, alarms: float = 0.0, late: float = 0.0, *, still: bool = False
) -> Any:
    """Make outcomes of healthy lives by draws of a width, with a share of alarms and late dates."""
    rng, found = np.random.default_rng(3), []
    for k in range(n):
        truth, draws = rng.normal(), {HEALTH: width * rng.normal(size=500)}
        own = {name: ranks_of({HEALTH: truth}, {HEALTH: factor * draws[HEALTH]}, rng)
               for name, factor in (("1", 1.0), ("0.5", 0.5), ("2", 2.0))}  # fmt: skip
        found.append(
            LifeOutcome(
                "healthy", True, k, truth={HEALTH: truth, DAYS: 100.0}, places=own["1"],
                quantiles={HEALTH: (-1.0, -0.5, 0.0, 0.5, 1.0)},
                controls={name: own[name] for name in ("0.5", "2")}, verdict="healthy",
                published=True, still=still, alarm=5 if k < alarms * n else None, service="by",
                wait=200.0 if k < late * n else 50.0,
            )
        )  # fmt: skip
    return found


def summary(found: list[LifeOutcome]) -> CalibrationCheck:
    """Summarise outcomes of the shipped stage of Y."""
    return summarise(load_stage("lms-y"), SCHEDULE, found, seed=0)


def test_each_kind_stands_alone(checked: CalibrationCheck) -> None:
    """Lives of the description count as such; further lives of a kind only for that kind."""
    drawn = [one for one in checked.outcomes if one.drawn]
    assert len(drawn) == 8 < len(checked.outcomes)
    kinds = {one.kind: one.n for one in checked.coverage if one.quantity == HEALTH}
    assert set(kinds) == {DRAWN, *KINDS}
    assert kinds[DRAWN] == 8
    for kind in KINDS:
        assert kinds[kind] == sum(one.kind == kind for one in checked.outcomes) >= 2
    assert not any(one.failed for one in checked.outcomes)


def test_coverage_counts_places(checked: CalibrationCheck) -> None:
    """Hits are lives whose truth is in the middle 50 or 90 % of the draws."""
    for row in checked.coverage:
        own = [one for one in checked.outcomes if row.kind in (one.kind, DRAWN)]
        own = [one for one in own if row.kind != DRAWN or one.drawn]
        places = np.array([one.places[row.quantity] for one in own])
        assert row.hits == np.sum(np.abs(places - 0.5) < row.level / 2)
        assert row.low <= row.share <= row.high
        assert row.n_ends <= row.n == len(own)


def test_quantiles_surround_the_truth_as_places_do(checked: CalibrationCheck) -> None:
    """A truth below the 5 % quantile has a low rank, one above the 95 % quantile a high one."""
    for one in checked.outcomes:
        low, *_, high = one.quantiles[HEALTH]
        place, truth = one.places[HEALTH], one.truth[HEALTH]
        assert place < 0.2 if truth < low else place > 0.01
        assert place > 0.8 if truth > high else place < 0.99


def test_results_repeat_and_depend_on_the_seed(small: Stage, checked: CalibrationCheck) -> None:
    """The same life has the same outcome alone; another seed draws another life."""
    first = checked.outcomes[0]
    with four_settings(), threadpool_limits(1):  # as in the processes of a check
        again = outcome_of(small, SCHEDULE, 2, (None, first.number))
        other = outcome_of(small, SCHEDULE, 3, (None, first.number))
    assert again == first != other


@pytest.mark.parametrize(("width", "word"), [(0.5, "too narrow"), (2.0, "too wide")])
def test_both_faults_are_found(width: float, word: str) -> None:
    """Right intervals pass, and the controls are found; too narrow and too wide ones are named."""
    fine = summary(outcomes(120))
    assert fine.wrong == fine.blind == ()
    found = summary(outcomes(120, width))
    assert word in {one.verdict for one in found.coverage if one.kind == DRAWN}
    assert f"{HEALTH}: 90% intervals" in found.wrong or f"{HEALTH}: 50% intervals" in found.wrong


def family(rng: np.random.Generator, n: int, factor: float = 1.0) -> CalibrationCheck:
    """Check n lives of eight quantities, in pairs of the same ranks, of draws of a width.

    A right program has uniform ranks, and as many late dates and false alarms as it may have.
    """
    found = []
    for k in range(n):
        truth, draws = rng.standard_normal(4), factor * rng.standard_normal((4, 127))
        names = [HEALTH, DAYS, "mount stiffness now", "remaining, first"]
        places = {
            name: float(place(draws[i][:, None], truth[i : i + 1], rng)[0])
            for i, name in enumerate(names)
        }
        places |= {f"{name} again": own for name, own in places.items()}
        found.append(
            LifeOutcome(
                "healthy", True, k, truth={DAYS: 100.0}, places=places,
                quantiles=dict.fromkeys(names, (-1.0, -0.5, 0.0, 0.5, 1.0)),
                verdict="healthy", still=True, alarm=5 if rng.random() < 0.01 else None,
                service="by", wait=200.0 if rng.random() < 0.05 else 50.0,
            )
        )  # fmt: skip
    return summary(found)


@pytest.mark.slow
@pytest.mark.parametrize("n", [15, 60])
def test_a_right_program_is_called_wrong_as_seldom_as_stated(n: int) -> None:
    """In 1 % of checks at most, however few lives. Negative control: each check by itself."""
    rng = np.random.default_rng(n)
    checks = [family(rng, n) for _ in range(500)]
    level = constants.FALSE_VERDICT
    assert len(checks[0].p_values) == 16
    wrong = sum(bool(one.wrong) for one in checks)
    assert stats.binomtest(wrong, 500, level, alternative="greater").pvalue > 1e-3
    alone = sum(min(one.p_values.values()) <= level for one in checks)
    assert stats.binomtest(alone, 500, level, alternative="greater").pvalue < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_wrong_widths_are_found_in_a_hundred_lives(factor: float) -> None:
    """In all of 100 checks of intervals of half and of double width."""
    rng = np.random.default_rng(9)
    assert all(family(rng, 100, factor).wrong for _ in range(100))


def test_false_alarms_count_where_they_are_declared() -> None:
    """Of lives in which something moves they are reported; of those that are still they judge."""
    what = "healthy: alarm of the tracker, nothing moves (false)"
    assert what not in summary(outcomes(100, alarms=0.1)).passed
    assert summary(outcomes(100, alarms=0.01, still=True)).passed[what]
    found = summary(outcomes(100, alarms=0.1, still=True))
    assert found.wrong == (what,)
    assert found.p_values[what] == pytest.approx(stats.binom.sf(9, 100, 0.01))


def test_too_few_lives_are_named_as_that() -> None:
    """Of six lives nothing is wrong, and nothing would have been found."""
    found = summary(outcomes(6))
    assert found.wrong == ()
    assert set(found.blind) == {f"{HEALTH}, too narrow", f"{HEALTH}, too wide"}


def test_rates_are_held_to_what_is_stated() -> None:
    """Limits before the service date may not be more frequent than the accepted risk."""
    assert not any(one.exceeded for one in summary(outcomes(100, late=0.04)).rates)
    found = summary(outcomes(100, alarms=0.1, late=0.3))
    late = "limit reached before the service date"
    assert {one.what for one in found.rates if one.exceeded} == {late}
    assert found.wrong == (f"{DRAWN}: {late}",)
    alarms = next(one for one in found.rates if one.what == "alarm of the tracker (false)")
    assert (alarms.hits, alarms.n) == (10, 100)


def test_a_service_chosen_by_its_cost_has_no_rate_to_hold() -> None:
    """Without an accepted risk the rate of late services is reported alone."""
    stage = load_stage("lms-y")
    decision = msgspec.structs.replace(stage.description.decision, max_risk=None, cost_ratio=5.0)
    by_cost = replace(
        stage, description=msgspec.structs.replace(stage.description, decision=decision)
    )
    found = summarise(by_cost, SCHEDULE, outcomes(20, late=0.3), seed=0)
    (late,) = (one for one in found.rates if one.what == "limit reached before the service date")
    assert (late.at_most, late.hits > 0, late.exceeded) == (None, True, False)


def test_a_life_without_posterior_counts_as_unpublished(
    small: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has a reason, no rank, and lowers the share of published ones."""

    def fails(*_: object, **__: object) -> None:
        raise NotConverged("the chains did not mix", None)

    monkeypatch.setattr(checks, "fit_life", fails)
    found = check_calibration(small, SCHEDULE, lives=1)
    assert all("did not mix" in one.failed and not one.places for one in found.outcomes)
    assert found.coverage == ()
    assert found.rates[0].what == "health is published"
    assert found.rates[0].hits == 0


def test_a_worker_that_dies_loses_its_life_alone(small: Stage) -> None:
    """The life that ends a process keeps its kind, and the reason."""
    one = checks._crashed(small, SCHEDULE, 0, ("healthy", 3), "killed")
    assert (one.kind, one.drawn, one.failed) == ("healthy", False, "killed")


def test_bad_input_is_refused(tmp_path: Path, small: Stage) -> None:
    """A description without parameters, and no life at all."""
    bare = make_stage(tmp_path / "bare", ())
    with pytest.raises(BadStage, match=r"\[\[parameter\]\]|\[map\]"):
        check_calibration(bare, Schedule(logs=12))
    with pytest.raises(BadQuestion, match="0 lives"):
        list(draw_outcomes(small, SCHEDULE, lives=0, seed=0, workers=1))


def test_a_machine_that_never_wears_has_no_wearing_lives(tmp_path: Path) -> None:
    """The other kinds are there; and without an end there is no date."""
    still = make_stage(tmp_path, (STILL_MOUNT,))
    with four_settings():
        found = lmshealth.check_calibration(still, SCHEDULE, lives=2)
    assert {one.kind for one in found.outcomes} <= {"healthy", "foreign change"}


def test_progress_and_text() -> None:
    """The result is a table in a session, and outcomes pass through JSON unchanged."""
    found = summary(outcomes(10))
    assert "Calibration of lms-y on 10 lives" in repr(found)
    assert len(found.to_frame()) == len(found.coverage) == 4
    again = msgspec.json.decode(msgspec.json.encode(found.outcomes[0]), type=LifeOutcome)
    assert again == found.outcomes[0]


@pytest.mark.slow
def test_processes_draw_the_same_lives(small: Stage) -> None:
    """Two processes have the outcomes of one, in some order."""
    one, two = (
        {(o.kind, o.drawn, o.number): o.places
         for o, _ in draw_outcomes(small, SCHEDULE, lives=2, seed=1, workers=n)}
        for n in (1, 2)
    )  # fmt: skip
    assert one == two
