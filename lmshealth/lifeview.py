"""What a terminal shows of remaining lives and of machines as a whole."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import date

import click
import numpy as np

from lmshealth.decision import Service, day_after
from lmshealth.results import Health, Prognosis
from lmshealth.summary import Assessment
from lmshealth.tables import RUL_LEVELS, Row, prognosis_rows
from lmshealth.terminal import print_table
from lmshealth.wording import GAP, LEVELS, chance, percent, quantiles, spell

_KM = 1000.0
# So many machines are told one by one, and so many have a row in a table.
_FEW, _MOST_ROWS = 3, 20
# Laws less probable than that are not named.
_SEEN = 0.01


def print_assessments(assessments: Sequence[Assessment]) -> None:
    """Print what a run found of each machine: of a few all, of many a row each, worst first."""
    ranked = sorted(assessments, key=Assessment.urgency)
    if len(ranked) > _FEW:
        _print_fleet(ranked)
        return
    for assessment in ranked:
        judgement, prognosis = assessment.judgement, assessment.prognosis
        click.echo(f"{judgement.stage}: {_verdict(assessment)}. {judgement.why}")
        for gauge in _gauges(assessment.health):
            click.echo(f"  {gauge}")
        if prognosis is not None:
            service = assessment.service()
            print_life(prognosis, service, prognosis_rows(prognosis, service))


def _print_fleet(ranked: Sequence[Assessment]) -> None:
    cells = [
        (
            assessment.judgement.stage,
            _verdict(assessment),
            "\n".join(_gauges(assessment.health)),
            _left(assessment.prognosis),
            due(assessment.service()),
        )
        for assessment in ranked[:_MOST_ROWS]
    ]
    texts = ("stage", "verdict", "health", "km left", "service")
    print_table(
        f"{len(ranked)} stages, worst first (medians with 90 % intervals)", texts, (), cells
    )
    rest = len(ranked) - _MOST_ROWS
    if rest > 0:
        click.echo(f"{rest} more stages; verdict.csv and prognosis.csv list all.")


def print_life(prognosis: Prognosis, service: Service, rows: Sequence[Row]) -> None:
    """Print the quantiles of a remaining life for each limit and any, then when to service.

    Parameters
    ----------
    prognosis : Prognosis
        Whose life it is.
    service : Service
        What it leads to.
    rows : sequence of dict
        As `prognosis_rows` gives them.
    """
    shown = rows if len(rows) > 2 else rows[:1]  # of one limit "any" is the same
    cells = [cell for row in shown for cell in _life_cells(prognosis, row)]
    title = (
        f"{prognosis.stage}: what is left after {prognosis.recorded_at:%Y-%m-%d}, "
        f"at {prognosis.travel / _KM:,.0f} km"
    )
    print_table(title, ("until",), ("%", "km", "hours", "days", "date"), cells)
    for text in (*_laws(prognosis), *_untold(prognosis)):
        click.echo(text)
    click.echo(_advice(prognosis, service))
    click.echo()


def due(service: Service) -> str:
    """Say in a few words when to service."""
    if service.by is not None and service.kind == "by":
        return f"by {service.by.isoformat()}"
    return {"now": "now", "later": "no service needed yet"}.get(service.kind, "no date")


def _life_cells(prognosis: Prognosis, row: Row) -> Iterator[tuple[str, ...]]:
    """One line per level; beside the first ones stands what else is known of the limit."""
    end = f"{prognosis.horizon / _KM:,.0f}"
    name = spell(row["parameter"])
    beside = [
        "any limit" if np.isnan(row["limit"]) else f"{name} below {row['limit']:g}",
        f"  already: {_plain(percent(row['probability_already_past']))}",
        f"  beyond {end} km: {_plain(percent(row['probability_beyond_horizon']))}",
    ]
    if "before" in row:
        bounds = chance(row["probability_at_least"], row["probability_at_most"])
        beside.append(f"  before {row['before']}: {_plain(bounds)}")
    beside += [""] * (len(RUL_LEVELS) - len(beside))
    for level, text in zip(RUL_LEVELS, beside, strict=True):
        key = f"q{100 * level:02.0f}"
        share, days = f"{100 * level:.0f}", row[f"rul_days_{key}"]
        if days is None:
            yield text, share, f"beyond {end}", "–", "–", "–"
            continue
        travel, hours = (f"{row[f'rul_{unit}_{key}']:,.0f}" for unit in ("km", "hours"))
        yield text, share, travel, hours, f"{days:,.1f}", _day(day_after(prognosis, days))


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
    names = ", ".join(spell(name) for name in prognosis.untold)
    if names:
        yield f"The modes cannot tell {names}: its limit is no part of this."


def _day(day: date | None) -> str:
    return "past any" if day is None else day.isoformat()


def _advice(prognosis: Prognosis, service: Service) -> str:
    """Say when to service, why then, and what the planned service risks."""
    chosen = (
        f"accepted risk {100 * service.max_risk:.3g} %"
        if service.max_risk
        else f"least costs, where a failure costs {service.cost_ratio:.3g} times a service"
    )
    text = f"Service: {due(service)} ({chosen}).\n"
    if service.kind == "later":
        text += f"Nothing asks for one within {prognosis.horizon / _KM:,.0f} km."
    elif service.by is None:
        text += "The machine hardly moves: no calendar has the day."
    else:
        when = "already" if service.kind == "now" else "before that day"
        risk = _plain(percent(service.risk))
        text += f"Probability that a limit is reached {when}, at most: {risk}."
    if service.planned is not None:
        planned = _plain(chance(*service.planned_risk))
        text += f"\nBefore the service planned for {service.planned}: {planned}."
    return text


def _verdict(assessment: Assessment) -> str:
    judgement = assessment.judgement
    if np.isnan(judgement.probability):
        return judgement.verdict
    return f"{judgement.verdict} ({_plain(percent(judgement.probability))})"


def _gauges(health: Health | None) -> Iterator[str]:
    """Median and 90 % interval of each parameter that the logs tell."""
    if health is None or not health.recorded_at:
        return
    told, values = health.told(), 100 * health.latest(LEVELS)
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
        for value in quantiles(prognosis.claimed()[:, -1])
    )
    return middle if low == high else f"{middle} ({low} to {high})"


def _plain(text: str) -> str:
    return text.replace(GAP, " ")
