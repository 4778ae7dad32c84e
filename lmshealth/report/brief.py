"""What a terminal says of a stage, as texts: they stand for themselves and cost nothing to keep."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import date

import numpy as np

from lmshealth.health.results import Health
from lmshealth.prognosis.maintenance_decision import Service, day_after
from lmshealth.prognosis.results import Prognosis
from lmshealth.report.assessment import Assessment
from lmshealth.report.tables import RUL_LEVELS, Row, prognosis_rows
from lmshealth.report.text import GAP, LEVELS, chance, percent, quantiles, spell

_KM = 1000.0
# Laws less probable than that are not named.
_SEEN = 0.01


@dataclass(frozen=True, slots=True)
class LifeBrief:
    """A remaining life in a table of texts.

    Attributes
    ----------
    title : str
        What stands above the table.
    cells : tuple of tuple of str
        One row per limit and level: until, probability, km, hours, days, date; below them rows
        with only the first of these, for what else is known of the limit.
    sentences : tuple of str
        What stands below it: whether one limit is all, laws, what no mode tells, when to service.
    """

    title: str
    cells: tuple[tuple[str, ...], ...]
    sentences: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Brief:
    """A stage in few words.

    Attributes
    ----------
    stage, verdict, why : str
        Its identity, the verdict with its probability, and the reason.
    gauges : tuple of str
        Median and 90 % interval of each health parameter.
    left : str
        Travel until any limit, median and 90 % interval.
    due : str
        When to service.
    life : LifeBrief or None
        The remaining life in full.
    """

    stage: str
    verdict: str
    why: str
    gauges: tuple[str, ...]
    left: str
    due: str
    life: LifeBrief | None


def brief(assessment: Assessment, service: Service) -> Brief:
    """Put a stage in few words."""
    judgement, prognosis = assessment.judgement, assessment.prognosis
    life = None
    if prognosis is not None:
        life = life_brief(prognosis, service, prognosis_rows(prognosis, service))
    return Brief(
        stage=judgement.stage,
        verdict=_verdict(assessment),
        why=judgement.why,
        gauges=tuple(_gauges(assessment.health)),
        left=_left(prognosis),
        due=due(service),
        life=life,
    )


def life_brief(prognosis: Prognosis, service: Service, rows: Sequence[Row]) -> LifeBrief:
    """Put a remaining life in words: each limit and any, then when to service.

    Parameters
    ----------
    prognosis : Prognosis
        Whose life it is.
    service : Service
        What it leads to.
    rows : sequence of dict
        As `prognosis_rows` gives them.
    """
    title = (
        f"{prognosis.stage}: what is left after {prognosis.recorded_at:%Y-%m-%d}, "
        f"at {prognosis.travel / _KM:,.0f} km"
    )
    blocks = [tuple(_life_cells(prognosis, row)) for row in rows]
    same = _same_as_any(blocks)
    return LifeBrief(
        title=title,
        cells=tuple(cell for block in (blocks if same is None else blocks[:-1]) for cell in block),
        sentences=(
            *([] if same is None else [f"Any limit: the same as {same}."]),
            *_laws(prognosis),
            *_untold(prognosis),
            *_advice(prognosis, service),
        ),
    )


def _same_as_any(blocks: Sequence[tuple[tuple[str, ...], ...]]) -> str | None:
    """Name the limit after which the last block, of any limit, would say the same again."""
    *each, last = blocks
    alike = [
        block[0][0]
        for block in each
        if [b[1:] for b in block] == [b[1:] for b in last]
        and [b[0] for b in block[1:]] == [b[0] for b in last[1:]]
    ]
    return alike[0] if alike else None


def due(service: Service) -> str:
    """Say in a few words when to service."""
    if service.by is not None and service.kind == "by":
        return f"by {service.by.isoformat()}"
    return {"now": "now", "later": "no service needed yet"}.get(service.kind, "no date")


def _life_cells(prognosis: Prognosis, row: Row) -> Iterator[tuple[str, ...]]:
    """One line per level, then what else is known of the limit, each on a line of its own."""
    end = f"{prognosis.horizon / _KM:,.0f}"
    name = spell(row["parameter"])
    text = "any limit" if np.isnan(row["limit"]) else f"{name} below {row['limit']:g}"
    levels = [f"{100 * level:02.0f}" for level in RUL_LEVELS]
    for level in levels:
        share, days = f"{int(level)}", row[f"rul_days_q{level}"]
        if days is None:
            share = share if level == levels[-1] else f"{share} to {int(levels[-1])}"
            yield text, share, f"beyond {end}", "–", "–", "–"
            break
        travel, hours = (f"{row[f'rul_{unit}_q{level}']:,.0f}" for unit in ("km", "hours"))
        yield text, share, travel, hours, f"{days:,.1f}", _day(day_after(prognosis, days))
        text = ""
    notes = {
        "already": percent(row["probability_already_past"]),
        f"beyond {end} km": percent(row["probability_beyond_horizon"]),
    }
    if "before" in row:
        bounds = chance(row["probability_at_least"], row["probability_at_most"])
        notes[f"before {row['before']}"] = bounds
    for what, probability in notes.items():
        yield f"  {what}: {_plain(probability)}", "", "", "", "", ""


def _laws(prognosis: Prognosis) -> Iterator[str]:
    """Say which laws each parameter follows, and how probably."""
    for name in prognosis.parameters[:-1]:
        told = [
            f"{law.kind}{_begin(law.begin)} {_plain(percent(law.probability))}"
            for law in prognosis.laws
            if law.parameter == name and law.probability >= _SEEN
        ]
        if told:
            yield f"Law of {spell(name)}: {', '.join(told)}."


def _begin(travel: float) -> str:
    return f" from {travel / _KM:,.0f} km after the baseline" if travel else ""


def _untold(prognosis: Prognosis) -> Iterator[str]:
    names = ", ".join(spell(name) for name in prognosis.unidentifiable)
    if names:
        yield f"The modes cannot tell {names}: its limit is no part of this."


def _day(day: date | None) -> str:
    return "past any" if day is None else day.isoformat()


def _advice(prognosis: Prognosis, service: Service) -> Iterator[str]:
    """Say when to service, why then, and what the planned service risks."""
    chosen = (
        f"accepted risk {100 * service.max_risk:.3g} %"
        if service.max_risk
        else f"least costs, where a failure costs {service.cost_ratio:.3g} times a service"
    )
    yield f"Service: {due(service)} ({chosen})."
    risk = _plain(percent(service.risk))
    if service.kind == "later":
        yield f"Nothing asks for one within {prognosis.horizon / _KM:,.0f} km."
    elif service.by is None:
        yield "The machine hardly moves: no calendar has the day."
    elif service.kind == "now":
        yield f"Probability that a limit is reached already, at most: {risk}."
    elif not service.max_risk or risk != f"{100 * service.max_risk:.3g} %":
        yield f"Probability that a limit is reached before that day, at most: {risk}."
    if service.planned is not None:
        planned = _plain(chance(*service.planned_risk))
        yield f"Before the service planned for {service.planned}: {planned}."


def _verdict(assessment: Assessment) -> str:
    judgement = assessment.judgement
    if np.isnan(judgement.probability):
        return judgement.verdict
    return f"{judgement.verdict} ({_plain(percent(judgement.probability))})"


def _gauges(health: Health | None) -> Iterator[str]:
    """Median and 90 % interval of each parameter that the logs tell."""
    if health is None or not health.recorded_at:
        return
    told, values = health.informed_parameters(), 100 * health.latest(LEVELS)
    for j, name in enumerate(health.parameters):
        low, middle, high = values[:, j]
        found = f"{middle:.0f} % ({low:.0f} to {high:.0f})" if told[j] else "not told"
        yield f"{spell(name)} {found}"


def _left(prognosis: Prognosis | None) -> str:
    if prognosis is None:
        return "–"
    end = f"beyond {prognosis.horizon / _KM:,.0f}"
    low, middle, high = (
        f"{max(value, 0.0) / _KM:,.0f}" if np.isfinite(value) else end
        for value in quantiles(prognosis.censored()[:, -1])
    )
    return middle if low == high else f"{middle} ({low} to {high})"


def _plain(text: str) -> str:
    return text.replace(GAP, " ")
