"""Status: the NAMUR state by a table, changes by another, and what other programs read."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, date, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import msgspec
import pytest

from lmshealth._private.serialize import pack, unpack
from lmshealth.machine import constants
from lmshealth.machine.assessment import Assessment
from lmshealth.machine.status import (
    CHANGES,
    UNKNOWN,
    Status,
    coming_states,
    compare,
    conditions,
    judge_on,
    make_status,
)
from lmshealth.machine.summary import summarise
from lmshealth.tracking.filters.track_state import Event
from tests.assessments import Maker, blind, make, nothing

__all__ = ["make"]

TODAY = date(2026, 11, 25)
LAST = datetime(2026, 11, 20, 6, tzinfo=UTC)
SOUND: dict[str, Any] = {
    "stage": "M7-Y",
    "page": "M7-Y.html",
    "description": "lms-y",
    "recorded_at": LAST,
    "baseline_at": datetime(2026, 1, 1, tzinfo=UTC),
    "verdict": "healthy",
    "probability": 0.97,
    "why": "",
    "alarms": {},
    "warnings": {},
    "infers_health": True,
    "probability_limit_reached": 0.0,
    "health": (),
    "remaining_life": (),
    "service": "by",
    "service_by": date(2027, 6, 1),
    "inspect_by": date(2026, 12, 24),
}
ALARM = {"roll": LAST}
OVERDUE = {"inspect_by": TODAY - timedelta(days=1)}
OPEN = {"verdict": "not-enough-data", "service_by": None, "inspect_by": None}


def status(**given: Any) -> Status:
    """Give the status of a sound machine, but for some fields."""
    return Status(**SOUND | given)


@pytest.mark.parametrize(
    ("given", "state", "codes"),
    [
        ({}, "NORMAL", ""),
        ({"verdict": "preload"}, "MAINTENANCE_REQUIRED", "loss"),
        ({"verdict": "both"}, "MAINTENANCE_REQUIRED", "loss"),
        ({"verdict": "step"}, "OFF_SPEC", "step"),
        (OPEN, "CHECK_FUNCTION", "no-verdict"),
        (OPEN | {"infers_health": False}, "NORMAL", ""),
        (
            OPEN | {"infers_health": False, "warnings": {"names-in-doubt": "serious"}},
            "CHECK_FUNCTION",
            "no-verdict",
        ),
        (OPEN | {"alarms": ALARM}, "OFF_SPEC", "alarm no-verdict"),
        (OPEN | {"verdict": "alarm", "alarms": ALARM, "infers_health": False}, "OFF_SPEC", "alarm"),
        ({"alarms": ALARM}, "NORMAL", ""),
        ({"probability_limit_reached": 0.49}, "NORMAL", ""),
        ({"probability_limit_reached": 0.5}, "FAILURE", "limit-reached"),
        ({"probability_limit_reached": None}, "NORMAL", ""),
        ({"service_by": TODAY + timedelta(days=31)}, "NORMAL", ""),
        ({"service_by": TODAY + timedelta(days=30)}, "MAINTENANCE_REQUIRED", "service-due"),
        ({"service_by": TODAY - timedelta(days=3)}, "MAINTENANCE_REQUIRED", "service-due"),
        ({"inspect_by": TODAY}, "NORMAL", ""),
        (OVERDUE, "CHECK_FUNCTION", "inspection-overdue"),
        # Who does the work now needs no log before it.
        (OVERDUE | {"service": "now"}, "NORMAL", ""),
        ({"silent_after_days": 5.0}, "NORMAL", ""),
        ({"silent_after_days": 4.0}, "CHECK_FUNCTION", "silent"),
        # Of a status of another day.
        ({"silent": True, "silent_after_days": 5.0}, "NORMAL", ""),
        (
            {"silent_after_days": 4.0, "verdict": "mount"},
            "MAINTENANCE_REQUIRED",
            "loss silent",
        ),
        ({"warnings": {"laws-do-not-fit": "serious"}}, "OFF_SPEC", "unreliable"),
        ({"warnings": {"mode-off-map": "caution"}}, "NORMAL", ""),
        (OPEN | {"warnings": {"no-result": "serious"}}, "CHECK_FUNCTION", "no-verdict"),
        (
            OPEN | {"warnings": {"unexplained-drifts": "serious"}},
            "OFF_SPEC",
            "unreliable no-verdict",
        ),
        (
            {"warnings": {"no-log-since": "caution"}},
            "CHECK_FUNCTION",
            "no-log-since-maintenance",
        ),
    ],
)
def test_every_result_has_a_namur_state(given: dict[str, Any], state: str, codes: str) -> None:
    """The first condition decides; all of them are listed."""
    found = conditions(status(**given), TODAY)
    assert " ".join(found) == codes
    assert next(iter(found.values()), "NORMAL") == state


def test_states_to_come_are_those_of_their_days() -> None:
    """A later day is listed where it changes the state, and no day before the last log."""
    sound = status(inspect_by=date(2027, 7, 1))
    coming = coming_states(sound, LAST.date())
    lead = date(2027, 6, 1) - timedelta(days=30)
    assert [*coming] == [LAST.date(), lead]
    assert coming[LAST.date()] == {} and coming[lead] == {"service-due": "MAINTENANCE_REQUIRED"}
    assert all(found == conditions(sound, day) for day, found in coming.items())
    worn = status(verdict="preload", service_by=date(2026, 1, 1))
    assert [*coming_states(worn, LAST.date())] == [LAST.date()]
    later = LAST.date() + timedelta(days=9)
    quiet = status(silent_after_days=5.0)
    coming = coming_states(quiet, LAST.date())
    assert coming[LAST.date() + timedelta(days=6)] == {"silent": "CHECK_FUNCTION"}
    assert all(judge_on(quiet, day, None).conditions == found for day, found in coming.items())
    assert not judge_on(quiet, LAST.date() + timedelta(days=5), None).silent
    assert [*coming_states(status(silent_after_days=5.0), later)] == [later, lead]


@pytest.mark.parametrize(
    ("before", "now", "expected"),
    [
        ({}, {}, []),
        (None, {}, []),
        (None, OPEN, []),
        (None, {"verdict": "preload"}, [("verdict", "", "preload")]),
        (None, OPEN | {"alarms": ALARM}, [("alarm", "", "roll")]),
        ({}, {"verdict": "preload"}, [("verdict", "healthy", "preload")]),
        (OPEN, {}, [("verdict", "not-enough-data", "healthy")]),
        ({"verdict": "step"}, {}, [("recovered", "step", "healthy")]),
        ({"verdict": "preload"}, {"verdict": "both"}, [("verdict", "preload", "both")]),
        ({}, {"alarms": ALARM}, [("alarm", "", "roll")]),
        ({"alarms": ALARM, "announced": ("roll",)}, {"alarms": ALARM}, []),
        # The alarm comes and goes as logs arrive: it is announced once per baseline.
        ({"announced": ("roll",)}, {"alarms": ALARM}, []),
        (
            {"announced": ("roll",), "baseline_at": LAST - timedelta(days=400)},
            {"alarms": ALARM},
            [("alarm", "", "roll")],
        ),
        (
            {"alarms": ALARM, "announced": ("roll",)},
            {},
            [("recovered", "alarm roll", "no alarm")],
        ),
        (
            {"silent": True, "recorded_at": LAST - timedelta(days=9)},
            {},
            [("recovered", "no log since 2026-11-11", "log of 2026-11-20")],
        ),
    ],
)
def test_changes_since_the_last_run(
    before: dict[str, Any] | None, now: dict[str, Any], expected: list[tuple[str, str, str]]
) -> None:
    """New alarms, changed verdicts, recoveries; of a new machine only what is bad."""
    was = None if before is None else status(**before)
    _, found = compare(was, status(**now), TODAY, 7.0)
    assert [(one.what, one.before, one.now) for one in found] == expected
    assert all((one.stage, one.recorded_at) == ("M7-Y", LAST) for one in found)


@pytest.mark.parametrize(
    ("code", "now", "text"),
    [
        ("limit-reached", {"probability_limit_reached": 0.7}, "limit-reached probability 0.70"),
        ("service-due", {"service_by": date(2026, 12, 1)}, "service-due by 2026-12-01"),
        (
            "inspection-overdue",
            {"inspect_by": date(2026, 11, 24)},
            "inspection-overdue by 2026-11-24",
        ),
        ("large-drift", OPEN | {"warnings": {"large-drift": "serious"}}, "large-drift"),
        ("unreliable", {"warnings": {"laws-do-not-fit": "serious"}}, "unreliable"),
        ("no-log-since-maintenance", {"warnings": {"no-log-since": "caution"}}, "no-log-since-m"),
        ("silent", {"silent_after_days": 3.0}, "silent last log of 2026-11-20 → no log for 5 days"),
        ("verdict", {"verdict": "preload"}, "verdict healthy → preload"),
    ],
)
def test_each_change_of_state_is_announced_once(code: str, now: dict[str, Any], text: str) -> None:
    """It is a change with its severity, of a known machine and of a new one, and never again."""
    bad = status(**now)
    first, _ = compare(None, status(**(OPEN if code == "large-drift" else {})), TODAY, None)
    for before in (first, None):
        found, changes = compare(before, bad, TODAY, None)
        if before is None and code == "verdict":
            text = "verdict preload"
        own = [one for one in changes if one.what == code]
        assert [(one.severity, str(one).startswith(f"M7-Y: {text}")) for one in own] == [
            (CHANGES[code], True)
        ]
        assert changes == own
        again, changes = compare(found, bad, TODAY, None)
        assert changes == [] and again == found


def test_what_moves_with_each_log_is_announced_once_per_baseline() -> None:
    """A service date that comes and goes is one change; a log that is late again is another one."""
    due, sound = status(service_by=TODAY), status()
    found, changes = compare(sound, due, TODAY, None)
    assert [one.what for one in changes] == ["service-due"]
    found, changes = compare(found, sound, TODAY, None)
    assert changes == []
    assert compare(found, due, TODAY, None)[1] == []
    served = msgspec.structs.replace(due, baseline_at=LAST)
    assert [one.what for one in compare(found, served, TODAY, None)[1]] == ["service-due"]
    late = status(inspect_by=TODAY - timedelta(days=1))
    found = compare(sound, late, TODAY, None)[0]
    # Another description, or another day, is no log that has come.
    assert compare(found, sound, TODAY, None)[1] == []
    newer = status(recorded_at=LAST + timedelta(days=1))
    found, changes = compare(found, newer, TODAY, None)
    assert [str(one) for one in changes] == [
        "M7-Y: recovered inspection-overdue → log of 2026-11-21"
    ]
    assert [one.what for one in compare(found, late, TODAY, None)[1]] == ["inspection-overdue"]


@pytest.mark.parametrize("code", ["unconfirmed-jump", "inspection-overdue", "limit-reached"])
def test_what_work_ends_without_a_new_log_is_announced(code: str) -> None:
    """Of statuses that know of work; it may begin again, and ends once. Control: another day."""
    jump: dict[str, Any] = {"warnings": {"last-logs-left-out": "caution"}}
    late: dict[str, Any] = {"inspect_by": TODAY - timedelta(days=1)}
    given = {"unconfirmed-jump": jump, "inspection-overdue": late}
    bad = status(works=1, **given.get(code, {"probability_limit_reached": 0.7}))
    found, changes = compare(status(works=1), bad, TODAY, None)
    assert [one.what for one in changes] == [code]
    assert compare(found, status(works=1), TODAY, None)[1] == []
    assert (
        compare(msgspec.structs.replace(found, works=None), status(works=2), TODAY, None)[1] == []
    )
    served, changes = compare(found, status(works=2), TODAY, None)
    assert [str(one) for one in changes] == [f"M7-Y: recovered {code} → work was entered"]
    assert compare(served, status(works=2), TODAY, None)[1] == []
    fewer = compare(found, status(works=0), TODAY, None)[1]
    assert [str(one) for one in fewer] == [f"M7-Y: recovered {code} → maintenance.csv was changed"]
    again = msgspec.structs.replace(bad, works=2)
    assert [one.what for one in compare(served, again, TODAY, None)[1]] == [code]


def test_a_service_that_is_near_is_not_ended_by_work_that_leaves_no_verdict() -> None:
    """It is no condition without a verdict, and due as before. Control: a service far ahead."""
    due = status(works=1, service_by=TODAY + timedelta(days=9))
    found, _ = compare(status(works=1), due, TODAY, None)
    for days, ended in ((10, []), (100, ["M7-Y: recovered service-due → work was entered"])):
        worked = status(works=2, **OPEN | {"service_by": TODAY + timedelta(days=days)})
        changes = compare(found, worked, TODAY, None)[1]
        assert [str(one) for one in changes if one.what == "recovered"] == ended


@pytest.mark.parametrize("hours", [-9, 0, 9])
def test_a_silence_is_by_the_day_in_utc(hours: int) -> None:
    """The same moment in any zone gives the same days; its first log since names the last one."""
    moment = datetime(2026, 11, 20, 20, tzinfo=UTC).astimezone(timezone(timedelta(hours=hours)))
    one = status(recorded_at=moment, silent_after_days=5.0)
    found = [judge_on(one, date(2026, 11, day), None) for day in (25, 26)]
    assert [(day.silent, day.days_without_log) for day in found] == [(False, 5), (True, 6)]
    earlier = msgspec.structs.replace(found[0], recorded_at=moment - timedelta(days=40))
    (change,) = compare(earlier, one, date(2026, 11, 26), None)[1]
    assert change.before == "last log of 2026-11-20"


def test_the_table_of_changes_is_that_of_the_readme(root: Path) -> None:
    """The README has when each kind begins, with its severity, and no other kind."""
    text = (root / "lmshealth/report/README.md").read_text(encoding="utf-8")
    rows = text.split("### Changes")[1].split("\n\n")[2].splitlines()[2:]
    found = [row[2:].split(" | ")[:2] for row in rows]
    assert list(map(tuple, found)) == [*CHANGES.items()]


def test_severities_of_verdicts_are_those_of_what_they_are_now() -> None:
    """A loss is serious, what is no loss any more a note; every kind has a severity."""
    lost, sound, none = status(verdict="preload"), status(), status(**OPEN)
    pairs = ((sound, lost), (lost, none), (lost, sound), (sound, none))
    severities = [compare(*pair, TODAY, None)[1][0].severity for pair in pairs]
    assert severities == ["serious", "note", "note", "note"]


def test_a_machine_is_silent_by_the_intervals_of_its_own_logs(make: Maker) -> None:
    """Five intervals between days with a log, the last ones; a single day gives no interval."""
    assessment = make()
    moments = [LAST + timedelta(days=k) for k in (0, 0.1, 0.2, 30, 31, 33, 34, 35, 38)]

    def limit(recorded_at: list[datetime]) -> float | None:
        history = replace(assessment.history, recorded_at=tuple(recorded_at))
        found = replace(assessment, history=history)
        return make_status(found, summarise(found, found.service())).silent_after_days

    assert limit(moments) == pytest.approx(8.0)
    assert limit(moments[:4]) == pytest.approx(150.0)
    assert limit(moments[:3]) is None


def test_a_limit_that_was_asked_for_replaces_no_interval_of_its_own(make: Maker) -> None:
    """Judged again without the option a machine has its own limit, or none with a single day."""
    assessment = make()
    for days, own in ((13, 65.0), (0, None)):
        moments = (LAST - timedelta(days=days), LAST)
        history = replace(assessment.history, recorded_at=moments)
        found = replace(assessment, history=history)
        made = make_status(found, summarise(found, found.service()))
        asked = judge_on(made, TODAY, 7.0)
        assert asked.silent_after_days == 7.0
        assert judge_on(asked, TODAY, None).silent_after_days == own
        earlier = msgspec.structs.replace(asked, own_silent_after_days=None)
        assert judge_on(earlier, TODAY, None).silent_after_days == 7.0


def test_a_status_of_an_earlier_schema_is_read_and_written_in_this_one() -> None:
    """What schema 1 had more is left out, and the machine has no change."""
    earlier = msgspec.to_builtins(status()) | {
        "schema": 1,
        "Prognoses": [{"Activity": "Service", "PredictedTime": "2027-06-01T00:00:00Z"}],
    }
    before = msgspec.json.decode(msgspec.json.encode(earlier), type=Status)
    found, changes = compare(before, before, TODAY, None)
    assert before.schema == 1 and changes == []
    assert found.schema == constants.JSON_SCHEMA == 2
    assert "Prognoses" not in msgspec.to_builtins(found)


def test_a_silence_is_that_of_the_day_and_reported_once_until_the_next_log() -> None:
    """Neither an earlier day nor another limit leaves a machine silent, or announces it again."""
    last = LAST.date()
    found, changes = compare(status(), status(), last + timedelta(days=7), 7.0)
    assert (found.silent, changes) == (False, [])
    found, changes = compare(found, status(), last + timedelta(days=8), 7.0)
    assert [str(one) for one in changes] == [
        "M7-Y: silent last log of 2026-11-20 → no log for 8 days"
    ]
    # Statuses of earlier versions do not list the silence among what was announced.
    for known in (found, msgspec.structs.replace(found, announced=())):
        before = known
        for days, limit in ((9, 7.0), (1, 7.0), (9, 7.0), (9, 400.0), (9, None), (9, 7.0)):
            before, changes = compare(before, status(), last + timedelta(days=days), limit)
            silent = days == 9 and limit == 7.0
            verdict = UNKNOWN if silent else "healthy"
            assert (before.silent, before.verdict, changes) == (silent, verdict, [])
        early = compare(before, status(), last, 7.0)[0]
        later = status(recorded_at=LAST + timedelta(days=9))
        for one in (before, early):
            after, changes = compare(one, later, last + timedelta(days=9), 7.0)
            assert [str(one) for one in changes] == [
                "M7-Y: recovered no log since 2026-11-20 → log of 2026-11-29"
            ]
        (again,) = compare(after, later, last + timedelta(days=17), 7.0)[1]
        assert again.what == "silent"


def test_a_service_that_is_due_now_announces_no_late_log() -> None:
    """Each log has `inspect_by` on its own day then, and would be late and recovered for ever."""
    before: Status | None = None
    for days in range(4):
        moment = LAST + timedelta(days=days)
        today = moment.date()
        due = status(
            verdict="preload", recorded_at=moment, service="now", service_by=today, inspect_by=today
        )
        for day in (today, today + timedelta(days=1)):
            before, changes = compare(before, due, day, None)
            assert not {"inspection-overdue", "recovered"} & {one.what for one in changes}
            assert "inspection-overdue" not in before.conditions


def document(assessment: Assessment) -> dict[str, Any]:
    """Give the status of an assessment as other programs read it."""
    made = make_status(assessment, summarise(assessment, assessment.service(), "a.html"))

    def refuse(name: str) -> None:
        raise ValueError(f"{name} is no JSON")

    text = msgspec.json.encode(made)
    assert msgspec.json.encode(msgspec.json.decode(text, type=Status)) == text
    assert msgspec.json.encode(unpack(pack(made), Status)) == text
    found: dict[str, Any] = json.loads(text, parse_constant=refuse)
    return found


def test_a_status_has_the_numbers_of_the_tables(make: Maker) -> None:
    """Service, life and health are those of the page; dates are moments in UTC."""
    assessment = make()
    service, found = assessment.service(), document(assessment)
    summary = summarise(assessment, service)
    assert found["verdict"] == "both" and found["service"] == service.kind == "by"
    assert service.by is not None and service.inspect_by is not None
    assert found["service_by"] == service.by.isoformat()
    assert found["inspect_by"] == service.inspect_by.isoformat()
    assert summary.life is not None
    last = found["remaining_life"][-1]
    assert (last["parameter"], last["service"]) == ("any", "by")
    assert last["rul_km_q50"] == summary.life.any.travel[3] / 1000
    assert [own["parameter"] for own in found["health"]] == ["guide_preload", "mount_stiffness"]
    assert found["health"][0]["median"] == summary.health[0].median
    past = [own.below_limit for own in summary.health]
    assert found["probability_limit_reached"] == max(*past, summary.life.any.already_past)


def test_what_is_not_known_is_null_or_left_out(make: Maker) -> None:
    """Without results there is no probability, date or life; an undetermined value is left out."""
    found = document(nothing(make()))
    assert (found["probability"], found["service_by"]) == (None, None)
    assert (found["service"], found["probability_limit_reached"]) == ("unknown", None)
    assert [own["parameter"] for own in document(blind(make()))["health"]] == ["guide_preload"]


def test_alarms_since_the_baseline_are_listed(make: Maker) -> None:
    """By mode, with the log at which they begin; declared ones are none."""
    assessment = make()
    track = assessment.track
    assert track is not None
    alarm = Event("alarm", 30, "roll", "", -0.02, 0.001, 9.0, False, 31)
    events = (alarm, replace(alarm, mode="yaw", declared=True))
    found = document(replace(assessment, track=replace(track, events=events)))
    assert list(found["alarms"]) == ["roll"]
    moment = datetime.fromisoformat(found["alarms"]["roll"])
    assert moment == track.recorded_at[30]
