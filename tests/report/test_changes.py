"""Sentences about changes since the last report."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lmshealth._private.serialize import pack, unpack
from lmshealth.life.verdict import degraded_words
from lmshealth.machine.service import Service
from lmshealth.machine.summary import (
    Life,
    LimitLife,
    NextStep,
    ParameterHealth,
    Summary,
    summarise,
)
from lmshealth.report.text import changes
from lmshealth.stage.description import ParameterSpec, load_stage
from lmshealth.stage.priors import Lognormal
from tests.assessments import nothing, worn

PARAMETERS = (
    *load_stage("lms-y").parameters,
    ParameterSpec("coupling_stiffness", Lognormal(1.0, 0.3)),
)
THEN: dict[str, Any] = {
    "recorded_at": datetime(2026, 6, 1, tzinfo=UTC),
    "baseline_at": datetime(2026, 1, 1, tzinfo=UTC),
    "description": "d1",
    "n_logs": 20,
    "travel": 1e6,
    "verdict": "healthy",
    "probability": 0.93,
    "health": {"guide_preload": (0.95, 0.97, 0.99)},
    "remaining": (3e6, 5e6, 9e6),
    "service_by": date(2027, 3, 3),
}
NOW = THEN | {
    "recorded_at": datetime(2026, 9, 1, tzinfo=UTC),
    "n_logs": 32,
    "travel": 1.34e6,
    "verdict": "preload",
    "probability": 0.88,
    "health": {"guide_preload": (0.89, 0.91, 0.93)},
    "remaining": (1e6, 3e6, np.inf),
    "service_by": date(2027, 1, 12),
}


def summary(state: dict[str, Any]) -> Summary:
    """Give the summary of a state; what a state leaves out plays no part."""
    own = dict(state)
    by, remaining = own.pop("service_by"), own.pop("remaining")
    health = [
        ParameterHealth(name, True, 1.0, low, median, high, None, np.nan)
        for name, (low, median, high) in own.pop("health").items()
    ]
    life = None
    if remaining is not None:
        low, middle, high = remaining
        travel = (low, low, low, middle, high, high, high)
        limit = LimitLife("any", np.nan, 1.0, travel, travel, (None,) * 7, 0.0, 0.0)
        life = Life("M7-Y", own["recorded_at"], own["travel"], 2e7, (limit,), (), ())
    service = Service("by", by, 1.0, 0.05, None, (np.nan, np.nan), 0.05, None)
    more: dict[str, Any] = {"health": tuple(health), "life": life, "service": service}
    page: dict[str, Any] = {"file": "a.html", "identity": "M7-Y", "urgency": (0, 0.0, 0.0, "M7-Y")}
    lost = tuple(one.name for one in PARAMETERS if one.word in degraded_words(own["verdict"]))
    of_verdict: dict[str, Any] = {"alarmed": (), "lost": lost, "step": NextStep("none")}
    return Summary(**own, **more, **page, **of_verdict, state="good", why="")


def sentences(now: dict[str, Any] | Summary, before: dict[str, Any] | Summary = THEN) -> list[str]:
    """Give the sentences with all spaces alike."""
    one, other = (x if isinstance(x, Summary) else summary(x) for x in (before, now))
    return [sentence.replace("\u202f", " ") for sentence in changes(one, other)]


def test_every_number_of_two_reports_is_set_side_by_side() -> None:
    """Verdict, health, life, date and logs, each in one sentence."""
    assert sentences(NOW) == [
        "Verdict: healthy (93 %) → loss of guide preload (88 %).",
        "Guide preload: 97 % → 91 % (90 %: 89 to 93 %).",
        "Remaining life, median: 5 000 km → 3 000 km (90 %: 1 000 km to beyond 20 000 km).",
        "Service date: 2027-03-03 → 2027-01-12, 50 days earlier.",
        "12 logs more, 340 km further.",
    ]


def test_unchanged_values_are_marked_as_such() -> None:
    """Unchanged values are not shown as changes."""
    assert sentences(THEN) == [
        "Verdict: still healthy (93 %).",
        "Guide preload: 97 % → 97 % (90 %: 95 to 99 %).",
        "Remaining life, median: still 5 000 km (90 %: 3 000 km to 9 000 km).",
        "Service date: still 2027-03-03.",
        "Same number of logs.",
    ]
    past = THEN | {"remaining": (-2e6, -1e6, -1e5)}
    assert sentences(past, past)[2] == "Remaining life, median: still already passed."
    # The prior of the fleet moves a date without a log of the machine.
    of_fleet = sentences(THEN | {"service_by": date(2027, 9, 3)})
    assert of_fleet[-1].startswith("No further log: this follows from the fleet")
    # So do a changed description and changed settings, which no summary has.
    redone = sentences(THEN | {"service_by": date(2027, 9, 3), "description": "d2"})
    assert "another description, settings or version" in redone[-1]
    coupling = THEN | {"verdict": "mount+coupling_stiffness"}
    loss = "Verdict: healthy (93 %) → loss of mount stiffness and coupling stiffness (93 %)."
    assert sentences(coupling)[0] == loss
    assert (
        sentences(THEN | {"probability": 0.8})[0] == "Verdict: still healthy (80 %), before 93 %."
    )


@pytest.mark.parametrize(
    ("now", "state"),
    [
        (NOW | {"health": {}}, "Guide preload: 97 % → not determined."),
        (
            NOW | {"health": {"mount_stiffness": (0.5, 0.6, 0.7)}},
            "Mount stiffness: not determined → 60 % (90 %: 50 to 70 %).",
        ),
        (NOW | {"remaining": None}, "Remaining life, median: 5 000 km → not known."),
        (
            NOW | {"remaining": (-2e6, -1e6, 1e5)},
            "Remaining life, median: 5 000 km → already passed (90 %: already passed to 100 km).",
        ),
        (NOW | {"service_by": None}, "Service date: 2027-03-03 → none."),
        (
            NOW | {"service_by": date(2027, 3, 4)},
            "Service date: 2027-03-03 → 2027-03-04, 1 day later.",
        ),
        (NOW | {"n_logs": 19}, "1 log fewer, 340 km further."),
        (NOW | {"n_logs": 21, "travel": np.nan}, "1 log more."),
        (NOW | {"n_logs": 18, "travel": 9e5}, "2 logs fewer."),
        (
            NOW | {"verdict": "not-enough-data", "probability": np.nan},
            "Verdict: healthy (93 %) → not enough data for a verdict.",
        ),
    ],
)
def test_values_missing_in_one_report_are_named(now: dict[str, Any], state: str) -> None:
    """A number that one of the reports lacks is named."""
    assert state in sentences(now)
    assert "nan" not in " ".join(sentences(now)) and "inf" not in " ".join(sentences(now))


def test_what_keeps_reports_from_being_compared_comes_first() -> None:
    """A changed description or baseline comes before any number."""
    other = NOW | {"description": "d2", "baseline_at": datetime(2026, 7, 1, tzinfo=UTC)}
    description, baseline, *rest = sentences(other)
    assert "stage description has changed" in description
    assert "from 2026-01-01 to 2026-07-01" in baseline
    assert rest == sentences(NOW)


def test_a_report_keeps_the_numbers_of_its_page(tmp_path: Path) -> None:
    """Quantiles, date and counts are those of the assessment, and come back from bytes."""
    assessment = worn(tmp_path)
    assert assessment.health is not None and assessment.prognosis is not None
    state = summarise(assessment, assessment.service())
    expected = assessment.health.quantile(np.array([0.05, 0.5, 0.95]))[:, -1]
    assert [own.name for own in state.health] == ["guide_preload", "mount_stiffness"]
    kept = [(own.low, own.median, own.high) for own in state.health]
    np.testing.assert_array_equal(np.array(kept).T, expected)
    assert state.service.by == assessment.service().by
    assert (state.n_logs, state.travel) == (40, 1.72e6)
    assert state.life is not None
    share = np.mean(assessment.prognosis.remaining[:, -1] <= state.life.any.travel[3])
    assert share == pytest.approx(0.5, abs=1e-3)
    assert repr(unpack(pack(state), Summary)) == repr(state)


def test_an_undetermined_parameter_is_not_compared(tmp_path: Path) -> None:
    """A value that a page does not show is not compared later."""
    assessment = worn(tmp_path)
    assert assessment.health is not None
    blind = replace(assessment.health, informed=assessment.health.informed * [1.0, 0.1])
    state = summarise(replace(assessment, health=blind), assessment.service())
    assert [own.name for own in state.health if own.determined] == ["guide_preload"]
    assert not any("Mount stiffness" in sentence for sentence in sentences(state, state))


def test_a_report_without_results_or_logs_has_gaps_not_failures(tmp_path: Path) -> None:
    """Without results only the verdict is kept; also without logs."""
    bare = nothing(worn(tmp_path))
    state = summarise(bare, bare.service())
    assert (state.health, state.life, state.service.by) == ((), None, None)
    assert sentences(state, state) == [
        "Verdict: still not enough data for a verdict.",
        "Same number of logs.",
    ]
    history = bare.history
    empty = replace(
        history,
        logs=(),
        recorded_at=(),
        travel=history.travel[:0],
        covariates={},
        ln_frequency=history.ln_frequency[:0],
        ln_damping=history.ln_damping[:0],
        cov=history.cov[:0],
        loop_error=history.loop_error[:0],
    )
    state = summarise(replace(bare, history=empty), bare.service())
    assert state.n_logs == 0 and np.isnan(state.travel)
    assert state.baseline_at == bare.judgement.recorded_at
