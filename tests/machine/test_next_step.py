"""Next step: the table of cases by verdict, service and age, and the sentences."""

from __future__ import annotations

from dataclasses import replace
from datetime import date, timedelta
from itertools import product
from typing import get_args

import msgspec
import numpy as np
import pytest

from lmshealth.cli import views
from lmshealth.life.posterior.fit import LoneMode
from lmshealth.machine import constants
from lmshealth.machine.status import judge_on, make_status, on_day
from lmshealth.machine.summary import (
    CASES,
    NextStep,
    Step,
    next_step,
    step_of,
    summarise,
)
from lmshealth.report import text
from lmshealth.report.pages import make_page
from lmshealth.report.tables import machine_tables
from lmshealth.tracking.filters.track_state import Event
from lmshealth.tracking.maintenance import Action, Maintenance, maintenance_notices
from tests.assessments import Maker, make

__all__ = ["make"]

EVENT = Event("step", 12, "yaw", "", 0.02, 0.001, 9.0, declared=False, found_at=14)


@pytest.mark.parametrize(
    ("verdict", "service", "age", "day", "expected"),
    [
        ("worked", "by", "old", "overdue", "see-effect"),
        ("drift", "unknown", "young", "", "check-drift"),
        ("drift", "unknown", "young", "late", "check-drift"),
        ("healthy", "unknown", "old", "late", "log-now"),
        ("open", "unknown", "young", "late", "log-now"),
        ("healthy", "by", "old", "late", "log-now"),
        ("healthy", "by", "young", "overdue", "log-now"),
        ("healthy", "by", "old", "overdue", "overdue"),
        ("loss", "by", "young", "late", "plan"),
        ("loss", "by", "young", "overdue", "overdue"),
        ("loss", "now", "old", "late", "service-now"),
        ("repair", "by", "old", "overdue", "check-loss"),
        ("repair", "unknown", "old", "", "check-drift"),
        ("alarm", "by", "old", "overdue", "inspect"),
        ("healthy", "later", "old", "late", "log-now"),
        ("alarm", "by", "old", "", "inspect"),
        ("outside", "now", "old", "", "find-cause"),
        ("healthy", "unknown", "young", "", "none"),
        ("open", "unknown", "young", "", "record"),
        ("loss", "unknown", "old", "", "record"),
        ("loss", "now", "old", "", "service-now"),
        ("healthy", "now", "young", "", "service-now"),
        ("healthy", "by", "young", "", "confirm"),
        ("open", "by", "young", "", "confirm"),
        ("open", "by", "young", "overdue", "log-now"),
        ("open", "by", "old", "", "record"),
        ("open", "now", "old", "", "record"),
        ("open", "now", "old", "late", "log-now"),
        ("healthy", "by", "old", "", "schedule"),
        ("loss", "by", "young", "", "plan"),
        ("healthy", "later", "old", "", "later"),
    ],
)
def test_the_step_follows_from_verdict_service_and_age(
    verdict: str, service: str, age: str, day: str, expected: Step
) -> None:
    """The first case that applies decides: alarms before services, young machines before plans."""
    assert step_of(verdict, service, age, day) == expected


def test_every_combination_has_a_step_and_every_step_a_sentence() -> None:
    """No combination is without a case, and no step without words."""
    verdicts = ("worked", "alarm", "outside", "drift", "repair", "open", "healthy", "loss")
    services, ages, days = (
        ("now", "by", "later", "unknown"),
        ("young", "old"),
        ("", "late", "overdue"),
    )
    for case in product(verdicts, services, ages, days):
        assert step_of(*case) in get_args(Step)
    assert {case[0] for case in CASES} == set(get_args(Step))
    for kind in get_args(Step):
        sentence = text.next_step(NextStep(kind, (("guide_preload", "preload"),), horizon=2e7))
        assert (sentence == "") == (kind == "none")


def test_a_limit_that_no_mode_shows_is_not_called_healthy(make: Maker) -> None:
    """Headline, service and next step are of what the modes show."""
    found = make(wear_km=30000)
    assert found.prognosis is not None
    for names in ((), ("mount_stiffness",)):
        prognosis = replace(found.prognosis, unidentifiable=names)
        one = replace(found, prognosis=prognosis)
        service = replace(one.service(), kind="later", by=None)
        summary = summarise(one, service)
        shown = text.headline(summary), text.service_on_day(summary), text.next_step(summary.step)
        assert ["modes show" in words for words in shown] == [bool(names)] * 3
        assert ("mount stiffness not known" in shown[0]) == bool(names)


def test_the_cause_of_a_jump_is_sought_where_it_is(make: Maker) -> None:
    """A jump of the one mode that moved alone is none of guide and mount; one of others may be."""
    made = make()
    track, health = made.track, made.health
    assert health is not None and track is not None
    made = replace(made, judgement=replace(made.judgement, verdict="step"))
    lone = (LoneMode("yaw", 0.02, 0.001, 0.99),)
    for modes, known, step in (
        (("yaw",), lone, "find-cause"),
        (("yaw",), (replace(lone[0], probability=0.1),), "inspect"),
        (("yaw", "roll"), lone, "inspect"),
        ((), lone, "inspect"),
    ):
        events = tuple(replace(EVENT, mode=mode) for mode in modes)
        track, health = replace(track, events=events), replace(health, lone_modes=known)
        one = replace(made, track=track, health=health)
        assert next_step(one, one.service()).kind == step


@pytest.mark.parametrize(
    ("verdict", "actions", "limit", "ordered"),
    [
        ("preload", ("preload-adjust",), 0, ""),
        ("preload", ("guide-replaced",), 0, ""),
        ("preload", ("mount-tightened",), 0, "preload"),
        ("preload", ("regrease",), 0, "preload"),
        ("preload", ("regrease",), 1, "mount preload"),
        ("preload", ("preload-adjust",), 1, "mount"),
        ("mount", ("mount-tightened",), 1, ""),
        ("both", (), 0, "preload mount"),
        ("both", ("preload-adjust",), 0, "mount"),
        ("both", ("preload-adjust", "mount-tightened"), 0, ""),
    ],
)
def test_work_that_was_entered_is_not_ordered_again(
    make: Maker,
    capsys: pytest.CaptureFixture[str],
    verdict: str,
    actions: tuple[str, ...],
    limit: int,
    ordered: str,
) -> None:
    """The effect of work after the last log is seen in the next; other work is still ordered.

    Without other work no output has a day of a service, which was that of the state before.
    """
    is_worked = not ordered
    made = make()
    made = replace(made, judgement=replace(made.judgement, verdict=verdict))
    assert made.prognosis is not None
    remaining = np.array(made.prognosis.remaining)
    remaining[:, 1 - limit] = remaining[:, limit] if verdict == "both" else np.inf
    remaining[:, 2] = remaining[:, limit]
    moments = made.history.recorded_at
    day = moments[-1] + timedelta(days=1)
    work = Maintenance(tuple(Action("M7-Y", day, action) for action in actions))
    notices = (*made.notices, *maintenance_notices(work, moments))
    prognosis = replace(made.prognosis, remaining=remaining)
    found = replace(made, prognosis=prognosis, notices=notices)
    summary = summarise(found, found.service())
    status, later = make_status(found, summary), moments[-1].date() + timedelta(days=900)
    summary = on_day(summary, status, later)
    codes = judge_on(status, later, None).conditions
    assert (summary.step.kind == "see-effect") == is_worked
    assert ("record logs now, to see its effect" in text.next_step(summary.step)) == is_worked
    assert (text.service_on_day(summary) == "unknown without a log") == is_worked
    assert {"loss", "service-due"}.isdisjoint(codes) == is_worked
    assert ("no-log-since-maintenance" in codes) == (not {*actions} <= {"regrease"})
    kinds = {status.service, machine_tables(found, summary)["prognosis"][-1]["service"]}
    assert (kinds == {"unknown"}) == is_worked
    days = {summary.service.by, status.service_by, status.inspect_by}
    assert (days == {None}) == is_worked
    views.print_summaries([summary])
    assert ("not known before a log" in capsys.readouterr().out) == is_worked
    if ordered:
        orders = {"preload": "a preload adjustment", "mount": "a tightening of the mount"}
        ordered_work = " and ".join(orders[part] for part in ordered.split())
        assert f" {ordered_work} " in text.next_step(summary.step)


def test_a_day_is_of_the_limits_that_no_work_has_restored(make: Maker) -> None:
    """Of two lost parts one was restored: the day, step and first limit are of the other."""
    made = make()
    made = replace(made, judgement=replace(made.judgement, verdict="both"))
    prognosis = made.prognosis
    assert prognosis is not None
    remaining = np.array(prognosis.remaining)
    remaining[:, 0], remaining[:, 1] = 1e4, 1e6
    remaining[:, 2] = remaining.min(axis=1)
    mount = remaining.copy()
    mount[:, 0], mount[:, 2] = np.inf, 1e6
    moments = made.history.recorded_at
    work = Action("M7-Y", moments[-1] + timedelta(days=1), "preload-adjust")
    notices = maintenance_notices(Maintenance((work,)), moments)
    both = replace(made, prognosis=replace(prognosis, remaining=remaining))
    found = replace(both, notices=(*made.notices, *notices))
    alone = replace(made, prognosis=replace(prognosis, remaining=mount))
    whole = summarise(both, both.service())
    assert found.service() == alone.service() != both.service()
    summary = summarise(found, found.service())
    assert [name for name, _ in summary.step.parts] == ["mount_stiffness"]
    assert summary.life is not None and whole.life is not None
    assert summary.life.any.travel == whole.life.limits[1].travel > whole.life.any.travel
    assert summary.postponed[0][2][1] < 0.06
    for one, shown in ((both, True), (found, False)):
        page = make_page(one, summary)
        assert ("First limit reached, most" in page) == shown
        assert ("Without guide preload, which later work has restored." in page) != shown


def test_logs_are_asked_for_before_a_machine_is_silent(make: Maker) -> None:
    """Who records as often as the step states has no machine without a log for long."""
    made = make(wear_km=30000)
    summary = summarise(made, made.service())
    rare = replace(summary, step=replace(summary.step, kind="later", log_every=63.0))
    status, today = make_status(made, rare), summary.recorded_at.date()
    for days, words in ((45.0, "every 6 weeks"), (200.0, "every 9 weeks"), (None, "every 9 weeks")):
        of_day = on_day(rare, msgspec.structs.replace(status, silent_after_days=days), today)
        assert words in text.next_step(replace(of_day.step, kind="later"))


def test_a_healthy_young_machine_orders_no_service(
    make: Maker, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With few logs since the baseline further logs come before an order, with many the order."""
    assessment = make()
    assert assessment.prognosis is not None
    healthy = replace(assessment, judgement=replace(assessment.judgement, verdict="healthy"))
    service = replace(assessment.service(), kind="by", by=date(2027, 3, 1))
    n_logs = len(healthy.history.logs) - healthy.history.baseline
    monkeypatch.setattr(constants, "YOUNG_LOGS", n_logs - 1)
    # Not "plan", whose sentence orders work beside the headline "Healthy".
    assert next_step(healthy, service).kind == "schedule"
    assert "Order" not in text.next_step(next_step(healthy, service))
    monkeypatch.setattr(constants, "YOUNG_LOGS", n_logs)
    found = next_step(healthy, service)
    assert found.kind == "confirm"
    assert (found.by, found.horizon) == (date(2027, 3, 1), assessment.prognosis.horizon)
    assert found.log_every == service.inspect_every / np.median(assessment.prognosis.usage)
    assert "order nothing yet" in text.next_step(found)
