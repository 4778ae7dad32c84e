"""What the terminal says of remaining lives: the numbers of the tables, and words for the rest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import date, timedelta

import numpy as np
import pytest

from lmshealth.cli.lifeview import print_briefs, print_life
from lmshealth.prognosis.maintenance_decision import decide, probability_before
from lmshealth.prognosis.results import LawWeight, Prognosis
from lmshealth.report.assessment import Assessment
from lmshealth.report.brief import due, life_brief
from lmshealth.report.fleet_page import by_urgency, summarise
from lmshealth.report.tables import prognosis_rows
from lmshealth.stage.description import Decision
from tests.lives import START, make_prognosis
from tests.report.test_machine_page import blind, make, nothing

__all__ = ["make"]
Said = Callable[[], str]


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str]) -> Said:
    """Return what was printed since the last time."""
    return lambda: capsys.readouterr().out


def shown(life: Prognosis, decision: Decision, said: Said, by: date | None = None) -> str:
    """Print a life and return the text."""
    before = None if by is None else (by, probability_before(life, by))
    service = decide(life, decision)
    print_life(life_brief(life, service, prognosis_rows(life, service, before)))
    return said()


def print_fleet(assessments: Sequence[Assessment]) -> None:
    """Print what a run says of machines."""
    rows = by_urgency(summarise(one, one.service(), "") for one in assessments)
    print_briefs([row.brief for row in rows])


def test_the_numbers_are_those_of_the_table(said: Said) -> None:
    """A line per level with km, hours, days and the date; of one limit "any" is one line."""
    life = make_prognosis(np.linspace(1e5, 1e6, 1001), np.full(1001, 1e4))
    text = shown(life, Decision(next_service=date(2026, 4, 1)), said, date(2026, 4, 1))
    row = prognosis_rows(life, decide(life, Decision()))[0]
    line = next(line for line in text.splitlines() if " 50 " in line).split()
    days = row["rul_days_q50"]
    day = (START + timedelta(days=days)).date().isoformat()
    km, hours = row["rul_km_q50"], row["rul_hours_q50"]
    assert line[-5:] == ["50", f"{km:,.0f}", f"{hours:,.0f}", f"{days:,.1f}", day]
    assert "guide preload below 0.6" in text and "any limit" not in text
    assert "already: below 1 %" in text and "before 2026-04-01: 23 %" in text
    service = decide(life, Decision())
    assert f"Service: by {service.by} (accepted risk 5 %)" in text
    assert "Before the service planned for 2026-04-01: 23 %" in text


def test_what_is_past_the_horizon_has_no_number(said: Said) -> None:
    """Censored levels say so; of a life that is past its limit the service is now."""
    life = make_prognosis(np.r_[np.full(40, 1e6), np.full(60, np.inf)], np.full(100, 1e4))
    text = shown(life, Decision(), said)
    line = next(line.split() for line in text.splitlines() if " beyond 10,000 " in line)
    assert line == ["50", "to", "95", "beyond", "10,000", "–", "–", "–"]
    assert text.count("beyond 10,000 ") == 1 + 1
    assert "beyond 10,000 km: 60 %" in text and "inf" not in text and "nan" not in text
    late = make_prognosis(np.r_[np.full(90, -1e6), np.full(10, np.inf)], np.full(100, 1e4))
    text = shown(late, Decision(cost_ratio=9.0), said)
    assert "Service: now (least costs, where a failure costs 9 times a service)" in text
    assert "reached already, at most: 90 %" in text
    text = shown(make_prognosis(np.full(9, np.inf), np.full(9, 1e4)), Decision(), said)
    assert "no service needed yet" in text and "Nothing asks for one within 10,000 km" in text
    idle = make_prognosis(np.full(9, 9e6), np.full(9, 1.0))
    text = shown(idle, Decision(), said)
    assert "no date" in text and "past any" in text and "no calendar" in text


def test_what_else_is_known_of_a_limit_stands_in_no_row_of_a_level(said: Said) -> None:
    """Each probability that belongs to the limit has a line without numbers of a level."""
    life = make_prognosis(np.linspace(1e5, 1e6, 1001), np.full(1001, 1e4))
    lines = shown(life, Decision(), said, date(2026, 4, 1)).splitlines()
    for text in ("already: below 1 %", "beyond 10,000 km: below 1 %", "before 2026-04-01: 23 %"):
        assert text in [line.strip() for line in lines]
    assert any("chance %" in line for line in lines)


@pytest.mark.parametrize("other", [np.inf, 2e6, 1.5e5])
def test_any_limit_is_not_told_twice(said: Said, other: float) -> None:
    """Where one limit always comes first, any limit is that one in a line; else it has its rows."""
    remaining = np.column_stack([np.linspace(1e5, 1e6, 1001), np.full(1001, other)])
    both = np.column_stack([remaining, remaining.min(axis=1)])
    life = replace(
        make_prognosis(remaining[:, 0], np.full(1001, 1e4)),
        parameters=("guide_preload", "mount_stiffness", "any"),
        limits=np.array([0.6, 0.7, np.nan]),
        remaining=both,
        health=np.full((1001, 2), 0.8),
        curve_quantiles=np.full((5, 3, 2), 0.8),
    )
    text = shown(life, Decision(), said)
    alone = other > 1e6
    assert ("Any limit: the same as guide preload below 0.6." in text) is alone
    assert (" any limit " in text) is not alone


def test_the_risk_of_a_service_is_told_once(said: Said) -> None:
    """Where it is the one that is accepted it is not said again; where it is less it is."""
    life = make_prognosis(np.linspace(1e3, 1e6, 1001), np.full(1001, 1e4))
    told = "Probability that a limit is reached before that day, at most"
    risks = [decide(life, Decision(max_risk=risk)).risk for risk in (0.05, 0.0592)]
    for risk, found in zip((0.05, 0.0592), risks, strict=True):
        text = shown(life, Decision(max_risk=risk), said)
        assert (told in text) is (f"{100 * found:.0f} %" != f"{100 * risk:.3g} %")
    assert f"{100 * risks[0]:.0f} %" == "5 %"


def test_laws_and_what_no_mode_tells_are_named(said: Said) -> None:
    """Laws with their probability, improbable ones left out; a limit nobody sees is no part."""
    life = make_prognosis(np.full(9, 1e6), np.full(9, 1e4))
    assert "Law of" not in shown(life, Decision(), said)
    weights = (("linear", 0.0, 0.7), ("none", 3e5, 0.295), ("power", 0.0, 0.005))
    laws = tuple(LawWeight("guide_preload", *weight) for weight in weights)
    text = shown(replace(life, laws=laws, unidentifiable=("mount_stiffness",)), Decision(), said)
    told = "Law of guide preload: linear 70 %, none from 300 km after the baseline 30 %."
    assert told in " ".join(text.split()) and "power" not in text
    assert "The modes cannot tell mount stiffness" in text


def test_a_few_machines_are_told_in_full(make: Callable[..., Assessment], said: Said) -> None:
    """Verdict, gauges, remaining life of every limit and of any, and the service; worst first."""
    good, bad = make("A", wear_km=400000, floor=0.98), make("B")
    print_fleet([good, blind(bad), nothing(make("C"))])
    text = said()
    assert text.index("B: both (93 %). Roll") < text.index("C: not-enough-data. 2 logs")
    assert text.index("C: not") < text.index("A: healthy (97 %)")
    assert bad.health is not None
    low, middle, high = 100 * bad.health.quantile(np.array([0.05, 0.5, 0.95]))[:, -1, 0]
    assert f"guide preload {middle:.0f} % ({low:.0f} to {high:.0f})" in text
    assert "mount stiffness not told" in text
    assert text.lower().count("any limit") == 2
    assert f"Service: by {bad.service().by}" in text


def test_many_machines_have_a_row_each(make: Callable[..., Assessment], said: Said) -> None:
    """Twenty rows, the worst first, the rest counted; nothing runs off the terminal."""
    good, bad = make("good", wear_km=400000, floor=0.98), make("worst")
    fleet = [replace(good, judgement=replace(good.judgement, stage=f"M{k}")) for k in range(21)]
    print_fleet([*fleet, bad])
    text = said()
    rows = [line for line in text.splitlines() if "healthy" in line or "both" in line]
    assert len(rows) == 20 and rows[0].strip().startswith("worst")
    assert due(bad.service()) in rows[0]
    assert "22 stages" in text and "2 more stages" in text
    assert max(map(len, text.splitlines())) <= 80
    assert "…" not in text
