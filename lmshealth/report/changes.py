"""Changes of a machine from one report to the next."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date, datetime
from typing import Any

import numpy as np

from lmshealth.prognosis.maintenance_decision import Service
from lmshealth.report.assessment import Assessment, verdict_text
from lmshealth.report.constants import LEVELS
from lmshealth.report.text import (
    GAP,
    day,
    in_brackets,
    interval,
    km,
    percent,
    probability,
    quantiles,
    spell,
    travel_left,
)
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
    remaining: Any = None if prognosis is None else quantiles(prognosis.censored()[:, -1])
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
) -> tuple[str, ...]:
    """Describe in sentences what changed since an earlier report on a machine.

    Reasons why the reports cannot be compared come first.
    """
    return (
        *_caveats(before, now),
        _verdict(before, now, parameters),
        *_health(before, now),
        *_life(before, now),
        *_service(before, now),
        _logs(before, now),
    )


def _caveats(before: Reported, now: Reported) -> list[str]:
    found = []
    if before.description != now.description:
        found.append("The stage description has changed: not all differences are wear.")
    if before.baseline_at != now.baseline_at:
        found.append(
            f"The baseline has changed from {day(before.baseline_at)} to "
            f"{day(now.baseline_at)}: percentages of the two reports cannot be compared."
        )
    return found


def _verdict(before: Reported, now: Reported, parameters: tuple[ParameterSpec, ...]) -> str:
    def text(report: Reported) -> str:
        return verdict_text(report.verdict, parameters) + in_brackets(report.probability)

    if before.verdict != now.verdict:
        return f"Verdict: {text(before)} → {text(now)}."
    earlier = f", before {probability(before.probability)}"
    return f"Verdict: still {text(now)}{'' if text(before) == text(now) else earlier}."


def _health(before: Reported, now: Reported) -> list[str]:
    found = []
    for name in dict.fromkeys((*now.health, *before.health)):
        texts = [
            percent(report.health[name][1], 0) if name in report.health else "not determined"
            for report in (before, now)
        ]
        own = now.health.get(name)
        spread = f" (90{GAP}%: {interval(own[0], own[2])})" if own else ""
        found.append(f"{spell(name).capitalize()}: {' → '.join(texts)}{spread}.")
    return found


def _life(before: Reported, now: Reported) -> list[str]:
    if before.remaining is None and now.remaining is None:
        return []
    low, middle, high = (
        [
            travel_left(report.remaining[k], report.horizon) if report.remaining else "not known"
            for report in (before, now)
        ]
        for k in range(3)
    )
    spread = f" (90{GAP}%: {low[1]} to {high[1]})" if now.remaining else ""
    return [f"Remaining life, median: {_from_to(*middle)}{spread}."]


def _service(before: Reported, now: Reported) -> list[str]:
    if before.service_by is None and now.service_by is None:
        return []
    days = [one.isoformat() if one else "none" for one in (before.service_by, now.service_by)]
    shift = ""
    if before.service_by and now.service_by and before.service_by != now.service_by:
        later = (now.service_by - before.service_by).days
        shift = f", {abs(later)} day{_s(later)} {'later' if later > 0 else 'earlier'}"
    return [f"Service date: {_from_to(*days)}{shift}."]


def _logs(before: Reported, now: Reported) -> str:
    more, travel = now.n_logs - before.n_logs, now.travel - before.travel
    logs = f"{abs(more)} log{_s(more)} {'more' if more > 0 else 'fewer'}" if more else ""
    return (logs or "Same number of logs") + (f", {km(travel)} further." if travel > 0 else ".")


def _from_to(before: str, now: str) -> str:
    return f"still {now}" if before == now else f"{before} → {now}"


def _s(count: int) -> str:
    return "" if abs(count) == 1 else "s"
