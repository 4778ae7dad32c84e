"""Changes of a machine from one report to the next."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import date, datetime
from typing import Any

import numpy as np

from lmshealth.prognosis.maintenance_decision import Service
from lmshealth.report import text
from lmshealth.report.assessment import Assessment, verdict_text
from lmshealth.report.constants import LEVELS
from lmshealth.report.text import GAP, percent, probability, travel_left
from lmshealth.stage.description import ParameterSpec

Interval = tuple[float, float, float]
"""The 5, 50 and 95 % quantiles."""


@dataclass(frozen=True, slots=True)
class Reported:
    """State of a machine in a report, in a few numbers."""

    recorded_at: datetime  # recorded_at, baseline_at: the last log, and that at the baseline
    baseline_at: datetime
    description: str  # digest of the stage description
    n_logs: int
    travel: float  # odometer at the last log in m, NaN without one
    verdict: str  # verdict, probability: as in ``verdict.csv``; NaN for ``not-enough-data``
    probability: float
    # Quantiles of each parameter that the data determine, as fractions of the baseline.
    health: dict[str, Interval]
    # Quantiles of the remaining travel until any limit in m, infinite beyond the horizon.
    remaining: Interval | None
    horizon: float  # travel in m beyond which nothing is claimed
    service_by: date | None  # last day for the service; None without a due service


def reported(assessment: Assessment, service: Service | None = None) -> Reported:
    """Return what a later report compares itself with; finding the service again takes time."""
    history, judgement = assessment.history, assessment.judgement
    health, prognosis = assessment.latest_health, assessment.prognosis
    determined: dict[str, Any] = {}
    if health is not None:
        levels = health.latest(np.array(LEVELS)).T.tolist()
        for k in np.flatnonzero(health.publishable_parameters()):
            determined[health.parameters[k]] = tuple(levels[k])
    remaining: Any = None if prognosis is None else text.quantiles(prognosis.censored()[:, -1])
    return Reported(
        recorded_at=judgement.recorded_at,
        baseline_at=[*history.recorded_at, judgement.recorded_at][history.baseline],
        description=assessment.stage.digest,
        n_logs=len(history.logs),
        travel=float(history.travel[-1]) if history.logs else np.nan,
        verdict=judgement.verdict,
        probability=judgement.probability,
        health=determined,
        remaining=remaining,
        horizon=np.inf if prognosis is None else prognosis.horizon,
        service_by=(service or assessment.service()).by,
    )


def changes(
    before: Reported, now: Reported, parameters: tuple[ParameterSpec, ...]
) -> Iterator[str]:
    """Describe in sentences what changed since an earlier report on a machine.

    Reasons why the reports cannot be compared come first.
    """
    if before.description != now.description:
        yield "The stage description has changed: not all differences are wear."
    if before.baseline_at != now.baseline_at:
        yield (
            f"The baseline has changed from {text.day(before.baseline_at)} to "
            f"{text.day(now.baseline_at)}: percentages of the two reports cannot be compared."
        )
    was, present = (
        verdict_text(one.verdict, parameters) + text.in_brackets(one.probability)
        for one in (before, now)
    )
    if before.verdict != now.verdict:
        yield f"Verdict: {was} → {present}."
    elif was == present:
        yield f"Verdict: still {present}."
    else:
        yield f"Verdict: still {present}, before {probability(before.probability)}."
    yield from _health(before, now)
    if before.remaining is not None or now.remaining is not None:
        yield _life(before, now)
    if before.service_by is not None or now.service_by is not None:
        yield _service(before.service_by, now.service_by)
    more, travel = now.n_logs - before.n_logs, now.travel - before.travel
    logs = f"{abs(more)} log{_s(more)} {'more' if more > 0 else 'fewer'}" if more else ""
    further = f", {text.km(travel)} further." if travel > 0 else "."
    yield (logs or "Same number of logs") + further


def _health(before: Reported, now: Reported) -> Iterator[str]:
    for name in dict.fromkeys((*now.health, *before.health)):
        medians = [
            percent(one.health[name][1], 0) if name in one.health else "not determined"
            for one in (before, now)
        ]
        own = now.health.get(name)
        spread = f" (90{GAP}%: {text.interval(own[0], own[2])})" if own else ""
        yield f"{text.spell(name).capitalize()}: {' → '.join(medians)}{spread}."


def _life(before: Reported, now: Reported) -> str:
    low, middle, high = (
        [
            travel_left(one.remaining[k], one.horizon) if one.remaining else "not known"
            for one in (before, now)
        ]
        for k in range(3)
    )
    spread = f" (90{GAP}%: {low[1]} to {high[1]})" if now.remaining else ""
    return f"Remaining life, median: {_from_to(*middle)}{spread}."


def _service(before: date | None, now: date | None) -> str:
    shift = ""
    if before and now and before != now:
        later = (now - before).days
        shift = f", {abs(later)} day{_s(later)} {'later' if later > 0 else 'earlier'}"
    days = [one.isoformat() if one else "none" for one in (before, now)]
    return f"Service date: {_from_to(*days)}{shift}."


def _from_to(before: str, now: str) -> str:
    return f"still {now}" if before == now else f"{before} → {now}"


def _s(count: int) -> str:
    return "" if abs(count) == 1 else "s"
