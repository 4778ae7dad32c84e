"""Lives drawn from a description: their kinds, schedules, and what is true of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lmshealth.calibration import constants
from lmshealth.calibration.lives import KINDS, Kind, Schedule, draw
from lmshealth.errors import BadQuestion, BadStage
from lmshealth.life.posterior.likelihood import NO_MODE
from lmshealth.stage.description import load_stage
from tests.lives import FADING, LAWS_ALONE, STILL_MOUNT, make_stage


@pytest.fixture(scope="module")
def rng() -> np.random.Generator:
    """Draw everything from one generator."""
    return np.random.default_rng(4)


@pytest.mark.parametrize("kind", KINDS)
def test_a_life_is_of_the_kind_that_is_asked_for(rng: np.random.Generator, kind: Kind) -> None:
    """Its parts, its mode that moves alone, and health that follows from them."""
    for _ in range(5):
        life = draw(rng, load_stage("lms-y"), Schedule(logs=12), kind)
        assert life.kind == kind
        assert (life.lone != NO_MODE) == (kind == "foreign change")
        if kind == "healthy":
            wander = np.exp([part.off[-1] for part in life.parts])
            np.testing.assert_allclose(life.health, wander)


def test_kinds_are_as_frequent_as_described(rng: np.random.Generator) -> None:
    """A mode of three moves alone in 9 %; of the others about a quarter has no change of a part."""
    stage, n = load_stage("lms-y"), 200
    kinds = [draw(rng, stage, Schedule(logs=12)).kind for _ in range(n)]
    assert 0.03 < kinds.count("foreign change") / n < 0.17
    assert 0.13 < kinds.count("healthy") / n < 0.37


def test_a_still_life_is_as_the_tracker_declares_it(rng: np.random.Generator) -> None:
    """Healthy, without deviation, and with a walk of ln f that the tracker calls healthy."""
    stage, lives = load_stage("lms-y"), []
    for kind in ("healthy", "wearing", "foreign change"):
        lives += [draw(rng, stage, Schedule(logs=40), kind) for _ in range(20)]
    still = [life for life in lives if life.still]
    assert 2 <= len(still) <= 15
    for life in still:
        assert life.kind == "healthy"
        assert np.ptp(life.health) == 0
        assert life.walk <= 5e-4
    assert not replace(still[0], walk=1e-3).still
    moved = replace(still[0].parts[0], rate=1e-9)
    assert not replace(still[0], parts=(moved, *still[0].parts[1:])).still


def test_a_life_has_its_schedule(rng: np.random.Generator, tmp_path: Path) -> None:
    """Number, distance and travel of logs, and errors of the size that is asked for."""
    stage = make_stage(tmp_path, (FADING,))
    schedule = Schedule(logs=30, every=3.0, km_per_day=10.0, frequency_std=2e-3)
    history = draw(rng, stage, schedule).history
    assert len(history.logs) == 30
    days = (history.recorded_at[-1] - history.recorded_at[0]).days
    assert days == 29 * 3
    assert np.ptp(history.travel) / 1000 == pytest.approx(10 * days, rel=0.15)
    std = np.sqrt(np.einsum("kii->ki", history.cov))[:, :2]
    assert np.exp(np.nanmean(np.log(std))) == pytest.approx(2e-3, rel=0.25)
    assert 0 < np.isnan(history.ln_frequency).sum() < 12


def test_usage_of_a_description_is_kept(rng: np.random.Generator, tmp_path: Path) -> None:
    """What the description states is travelled exactly, and cannot be contradicted."""
    stage = make_stage(tmp_path, (FADING,), tail="[usage]\nkm_per_day = 5\n")
    life = draw(rng, stage, Schedule(logs=12))
    np.testing.assert_allclose(np.diff(life.history.travel), 35_000)
    assert life.days(rng, 10_000.0) == pytest.approx(2.0)
    with pytest.raises(BadQuestion, match="km_per_day is 5"):
        Schedule(km_per_day=6.0).resolved(stage)


def test_without_usage_machines_are_in_the_middle_of_their_life() -> None:
    """By the last log so many have reached a limit that dates matter, and most have not."""
    stage, rng = load_stage("lms-y"), np.random.default_rng(5)
    lives = [draw(rng, stage, Schedule(logs=12), "wearing") for _ in range(60)]
    past = [any(h < 0.65 for h in life.health) for life in lives]
    assert 0.02 < np.mean(past) < 0.5


def test_the_days_until_a_travel_scatter_about_its_mean() -> None:
    """Usage of each interval is drawn: many intervals are near the mean, infinite travel never."""
    rng = np.random.default_rng(6)
    life = draw(rng, load_stage("lms-y"), Schedule(logs=12, km_per_day=10.0))
    days = np.array([life.days(rng, 1e6) for _ in range(200)])
    assert days.mean() == pytest.approx(100, rel=0.02)
    assert 0.01 < days.std() / 100 < 0.1
    assert np.isinf(life.days(rng, np.inf))


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ({"logs": 3}, "3 logs a life: needed are 12 to 200"),
        ({"every": 0.0}, "every is 0.0: needed is a positive number"),
        ({"frequency_std": float("nan")}, "frequency_std is nan"),
        ({"km_per_day": -1.0}, "km_per_day is -1.0"),
    ],
)
def test_a_schedule_out_of_range_is_refused(wrong: dict[str, float], why: str) -> None:
    """Each number is named with what is needed."""
    with pytest.raises(BadQuestion, match=why):
        Schedule(**wrong)  # type: ignore[arg-type]


def test_logs_too_short_for_the_modes_are_refused(rng: np.random.Generator) -> None:
    """Unless their errors are stated."""
    stage = load_stage("lms-y")
    with pytest.raises(BadQuestion, match="too short to identify"):
        draw(rng, stage, Schedule(logs=12, seconds=0.1))


def test_laws_that_leave_the_map_are_refused(rng: np.random.Generator, tmp_path: Path) -> None:
    """A travel after which nothing is left on the map; and a machine that never wears."""
    stage = make_stage(tmp_path / "a", (FADING,), tail=LAWS_ALONE)
    with pytest.raises(BadStage, match=f"of {constants.MOST_TRIES} lives .* none stays inside"):
        draw(rng, stage, Schedule(logs=12, km_per_day=1e9))
    still = make_stage(tmp_path / "b", (STILL_MOUNT,))
    with pytest.raises(BadStage, match="no life wears"):
        draw(rng, still, Schedule(logs=12), "wearing")


def test_reported_steps_and_second_sources_are_drawn_where_asked_for() -> None:
    """Of all lives if asked for, else of none."""
    rng, stage = np.random.default_rng(8), load_stage("lms-y")
    for share in (0.0, 1.0):
        life = draw(rng, stage, Schedule(logs=12), steps=share, second_source=share)
        assert any(step.kind == "step" for step in life.history.steps) == bool(share)
        assert len(life.history.series) == 3 + bool(share)


def test_what_remains_ends_within_the_horizon_or_never(rng: np.random.Generator) -> None:
    """A life followed on reaches the limit at the travel of its law, if nothing deviates."""
    stage = load_stage("lms-y")
    for _ in range(10):
        life = draw(rng, stage, Schedule(logs=12), "wearing")
        for part in life.parts:
            left = part.left(rng, life.now, 0.6, 1e6)
            assert left <= 1e6 or np.isinf(left)
            exact = replace(part, off=0 * part.off, rate=0.0)
            by_law = exact._left_by_law(rng, life.now, 0.6, 1e9)
            if 0 < by_law < np.inf:
                assert exact.by_law(np.array([life.now + by_law]))[0] == pytest.approx(0.6)
