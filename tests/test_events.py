"""Tests of `lmshealth.events`: suspicion, and what tells a retuning from damage."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from lmshealth.events import Watch, loop_evidence
from lmshealth.tracking import track
from lmshealth.tracks import History, Series, Step

N, EVENT = 30, 15
LOOP_JUMP = -0.4


@pytest.fixture
def loop_error() -> np.ndarray:
    """Following errors that scatter by 5 % and fall by a third at once."""
    rng, after = np.random.default_rng(1), np.arange(N) >= EVENT
    return np.asarray(1e-6 * np.exp(0.05 * rng.standard_normal(N) + LOOP_JUMP * after))


@pytest.fixture
def retuned(loop_error: np.ndarray) -> History:
    """Give a life in which a retuning moves the second of two modes by 0.8 %, undeclared."""
    rng, start = np.random.default_rng(2), datetime(2026, 1, 1, tzinfo=UTC)
    std = np.array([0.001, 0.001, 0.05, 0.05])
    moved = np.outer(np.arange(N) >= EVENT, [0.0, 0.008])
    noise = std * rng.standard_normal((N, 4))
    return History(
        stage="made",
        logs=tuple(f"log-{k}" for k in range(N)),
        recorded_at=tuple(start + timedelta(days=k) for k in range(N)),
        travel=np.arange(N) * 5e4,
        covariates={},
        modes=("roll", "pitch"),
        series=(Series("roll", "joint"), Series("pitch", "joint")),
        ln_frequency=np.log([126.4, 136.6]) + moved + noise[:, :2],
        ln_damping=np.log([0.015, 0.015]) + noise[:, 2:],
        cov=np.tile(np.diag(std**2), (N, 1, 1)),
        loop_error=loop_error,
        baselines=(0,),
    )


def test_a_leap_of_the_loop_is_suspected(loop_error: np.ndarray) -> None:
    """A leap is suspected from its second log on, and one that is explained is not."""
    watch = Watch(4, loop_error)
    assert watch.suspect(EVENT) is None
    assert watch.suspect(EVENT + 1) == EVENT
    watch.settle((Step("servo", EVENT, np.arange(N) >= EVENT),))
    assert watch.suspect(EVENT + 1) is None


def test_without_a_following_error_nothing_is_said_of_it() -> None:
    """Too few following errors give no evidence, neither for a retuning nor against."""
    assert loop_evidence(np.full(N, np.nan), EVENT, EVENT + 3, "servo") is None
    assert loop_evidence(np.full(N, 1e-6), 2, 5, "servo") is None


def test_the_loop_tells_a_retuning_from_damage(retuned: History) -> None:
    """A retuning is told by its following error; the same jump without one alarms."""
    followed = track(retuned)
    assert {(e.kind, e.declared) for e in followed.events} == {("servo", False)}
    assert not followed.alarms
    blind = track(replace(retuned, loop_error=np.full(N, np.nan)))
    assert blind.alarms
    assert "servo" not in {e.kind for e in blind.events}


def test_a_declared_retuning_is_not_found_again(retuned: History) -> None:
    """What is declared explains its jump and its following error."""
    step = Step("servo", EVENT, np.arange(N) >= EVENT, name="second")
    followed = track(replace(retuned, steps=(step,)))
    assert all(e.declared for e in followed.events)
    assert followed.drift[-1] == pytest.approx([0.0, 0.0], abs=0.003)
