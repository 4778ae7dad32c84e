"""No page states two things that contradict each other, for machines of every state and age."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from datetime import date, datetime, timedelta, timezone
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from lmshealth.machine.assessment import Assessment
from lmshealth.machine.service import Service, day_after
from lmshealth.machine.status import judge_on, make_status, on_day
from lmshealth.machine.summary import summarise
from lmshealth.report import figures as plots
from lmshealth.report.pages import date_page, make_page, write_index
from tests.assessments import Maker, Page, make, words

__all__ = ["make"]

VERDICTS = ("healthy", "preload", "both", "step", "outside-map", "not-enough-data")
SERVICES = ("unknown", "now", "by", "later")
# Days since the last log. The logs of the machines are some three days apart.
AGES = (0, 4, 40, 400)


@pytest.fixture(autouse=True)
def _blank(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plots, "svg", lambda draw, *, salt, size: f'<svg id="{salt}"></svg>')


def contradictions(text: str) -> Iterator[str]:
    """Yield what a first screen, or a row of the fleet page, states against itself.

    The verdict at the last log is stated as such: it contradicts nothing.
    """
    now = re.sub(r"(At the last log: \w[^.]*\.|Last verdict: \w[^%]*%|\d healthy)", "", text)
    late = "verdue since" in now or "was due by" in now or "has passed" in now
    is_healthy = "Healthy" in now and "the service is due" not in now
    idle = "No work is needed yet" in now or "No service is needed" in now
    pairs = {
        "healthy, and order": is_healthy and re.search("Order and plan|Do [^.]* now", now),
        "healthy, and loss": is_healthy and re.search("Loss of|Alarm|Sudden change", now),
        "unknown, and healthy": "Unknown since" in now and re.search("[Hh]ealthy|No service", now),
        "overdue, and nothing to do": late and (idle or "order nothing yet" in now),
        "due, and nothing to do": "Do " in now and idle,
        "normal, and not healthy": "107 on" in now
        and re.search(r"107 on [\d‑]+: normal", now)
        and re.search("Unknown since|Loss of|Alarm|verdue|Do [^.]* now", now),
        "perhaps repaired, and order": "repaired" in now
        and re.search("Order and plan|Do [^.]* now", now),
        "several ages": len(set(re.findall(r"[Nn]o log for (\d+) day", now))) > 1,
    }
    yield from (name for name, found in pairs.items() if found)


def aged(made: Assessment, verdict: str, service: str, days: int, kind: str) -> Assessment:
    """Give a machine another verdict and another service, its last log some days ago.

    It is ``young``, or its last log ``deviates``.
    """
    assert made.track is not None
    if kind == "deviates":
        last = len(made.track.logs) - 1, made.track.modes[0]
        made = replace(made, track=replace(made.track, outliers=(last,)))
    judgement = replace(made.judgement, verdict=verdict)
    if verdict == "not-enough-data":
        judgement = replace(judgement, probability=float("nan"))
    history = replace(made.history, baselines=(35,)) if kind == "young" else made.history
    prognosis = None if service == "unknown" else made.prognosis
    today = made.judgement.recorded_at.date() + timedelta(days=days)
    return replace(made, judgement=judgement, history=history, prognosis=prognosis, today=today)


def served(found: Assessment, kind: str, wait: float) -> Service:
    """Return a service of a kind, so many days after the last log."""
    own = found.service()
    if found.prognosis is None:
        return own
    wait = {"now": -1.0, "later": np.inf}.get(kind, wait)
    by = day_after(found.prognosis, wait)
    return replace(own, kind=kind, wait=wait, by=by, inspect_by=own.inspect_by and by)  # type: ignore[arg-type]


def pages_of(found: Assessment, service: Service, folder: Path) -> tuple[str, str, str]:
    """Return the words of the first screen, of the page, and of the row of the fleet page."""
    today = found.today
    assert today is not None
    summary = summarise(found, service, "a.html")
    status = make_status(found, summary)
    summary = on_day(summary, status, today)
    path = folder / "a.html"
    path.write_text(date_page(make_page(found, summary), summary, status))
    whole = words(Page(path))
    fleet = words(Page(write_index(folder, [summary], (), today=today)))
    row = fleet[fleet.index("Fleet") : fleet.index("Stages are sorted")]
    return whole[: whole.index("Since the last report")], whole, row


@pytest.mark.parametrize("verdict", VERDICTS)
def test_no_page_contradicts_itself(make: Maker, tmp_path: Path, verdict: str) -> None:
    """For each verdict, service, age and number of logs: first screen and row of the fleet page."""
    made = make("M7-Y", 30000 if verdict == "healthy" else 8000)
    for service, days, kind in product(SERVICES, AGES, ("", "young", "deviates")):
        found = aged(made, verdict, service, days, kind)
        for wait in (20.0, 300.0) if service == "by" else (0.0,):
            first, _, row = pages_of(found, served(found, service, wait), tmp_path)
            case = f"{verdict}, service {service} in {wait:.0f} days, {days} days old, {kind=}"
            assert list(contradictions(first)) == [], f"{case}: {first}"
            assert list(contradictions(row)) == [], f"{case}: {row}"
            ages = re.findall(r"[Nn]o log for (\d+) day", first + row)
            assert set(ages) == ({str(days)} if days else set()), case
            last = made.judgement.recorded_at.date()
            written = f"Written on {last + timedelta(days=days)}, last log {last}"
            assert written in first and written in row, case
            # Logs are 3.4 days apart: unknown after 17 days.
            unknown = verdict == "healthy" and days > 17
            due = service == "by" and days > wait
            assert ("Unknown since" in first) == unknown, case
            assert not due or "Overdue since" in row, case


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("Healthy Order and plan a preload adjustment before 2027-01-01", "healthy, and order"),
        ("Healthy Loss of guide preload", "healthy, and loss"),
        ("If it was repaired, enter it. Order and plan a log", "perhaps repaired, and order"),
        ("Unknown since 2026-01-01 No service needed yet", "unknown, and healthy"),
        ("Overdue since 2026-01-01 No service is needed", "overdue, and nothing"),
        ("Loss of guide preload State by NAMUR NE 107 on 2026‑01‑01: normal", "normal, and not"),
        ("no log for 176 days no log for 188 days", "several ages"),
    ],
)
def test_contradictions_are_found(text: str, expected: str) -> None:
    """The check itself: it finds each kind in a text that has it."""
    assert any(found.startswith(expected) for found in contradictions(text))


def test_a_machine_without_logs_for_long_is_unknown_everywhere(make: Maker, tmp_path: Path) -> None:
    """Not healthy on its page, on the fleet page, in its status and by NE 107; a day ago it is."""
    made = make("M7-Y", 30000)
    last = made.judgement.recorded_at.date()
    found = replace(made, today=last + timedelta(days=176))
    first, _, row = pages_of(found, served(found, "later", 0.0), tmp_path)
    expected = f"Unknown since {last}: no log for 176 days"
    assert expected in first and expected in row and "1 unknown: no log for long" in row
    assert "At the last log: healthy." in first and "97 % probability" in first
    assert "Record a log now" in first and "check function (C)" in first
    summary = summarise(found, served(found, "later", 0.0))
    status = make_status(found, summary)
    assert (status.verdict, status.unknown_since, status.days_without_log) == ("unknown", last, 176)
    assert (status.device_health, status.verdict_at_last_log) == ("CHECK_FUNCTION", "healthy")
    early = replace(made, today=last + timedelta(days=1))
    assert make_status(early, summary).verdict == "healthy"
    assert "Healthy" in pages_of(early, early.service(), tmp_path)[2]
    # A limit of one's own replaces that by the intervals of the logs.
    status = judge_on(make_status(made, summary), last + timedelta(days=176), 200.0)
    assert status.verdict == "healthy"


def test_a_log_is_of_its_day_in_utc_everywhere(make: Maker, tmp_path: Path) -> None:
    """Of a log at 1:00 east of Greenwich both pages state the day before, where its age begins."""
    made = make()
    last = datetime(2026, 10, 20, 1, tzinfo=timezone(timedelta(hours=2)))
    found = replace(
        made,
        history=replace(made.history, recorded_at=(*made.history.recorded_at[:-1], last)),
        judgement=replace(made.judgement, recorded_at=last),
        today=last.date(),
    )
    first, _, row = pages_of(found, served(found, "by", 20.0), tmp_path)
    assert "Written on 2026-10-20, last log 2026-10-19 23:00 UTC, no log for 1 day" in first
    assert "State at the last log, 2026-10-19" in first
    assert "Written on 2026-10-20, last log 2026-10-19, no log for 1 day" in row
    assert row.count("last log 2026-10-19") == 2


def test_the_page_of_a_loss_keeps_its_headline(make: Maker, tmp_path: Path) -> None:
    """Missing logs hide no evidence of damage."""
    made = make()
    today: date = made.judgement.recorded_at.date() + timedelta(days=400)
    first, _, row = pages_of(replace(made, today=today), made.service(), tmp_path)
    assert "Loss of guide preload" in first and "Loss of guide preload" in row
    assert "no log for 400 days" in first and "Overdue since" in row
