"""What a page and the index say first of a stage, as texts: verdict, health, life and service."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from lmshealth.health.results import Health
from lmshealth.health.verdict import degraded_words
from lmshealth.prognosis.maintenance_decision import Service, remaining_days
from lmshealth.prognosis.results import Prognosis
from lmshealth.report.assessment import Assessment
from lmshealth.report.text import (
    GAP,
    LEVELS,
    chance,
    day_count,
    km,
    left,
    percent,
    quantiles,
    spell,
)
from lmshealth.stage.description import ParameterSpec

Tone = Literal["good", "bad", "open"]


@dataclass(frozen=True, slots=True)
class Gauge:
    """A health parameter now, as text; ``places`` are % of the gauge's length."""

    name: str
    told: bool
    converged: bool
    share: str
    value: str
    interval: str
    below: str
    limit: str
    unit: str
    places: dict[str, float]


@dataclass(frozen=True, slots=True)
class Life:
    """Remaining life of one limit, as text: 5, 50, 95 %; ``now`` is health by the law."""

    name: str
    limit: str
    km: tuple[str, ...]
    days: tuple[str, ...]
    past: str
    beyond: str
    now: str


def tone(assessment: Assessment) -> Tone:
    """Sort a verdict into good, bad and open; an alarm is bad where there is no verdict."""
    if assessment.alarmed:
        return "bad"
    tones: dict[str, Tone] = {"healthy": "good", "not-enough-data": "open"}
    return tones.get(assessment.judgement.verdict, "bad")


def verdict_words(assessment: Assessment) -> str:
    """Say the verdict, or the alarm where there is none."""
    verdict = assessment.judgement.verdict
    if assessment.alarmed:
        return f"Alarm: {' and '.join(map(spell, assessment.alarmed))} moved"
    if not assessment.stage.parameters and verdict == "not-enough-data":
        return "Modes followed, no verdict asked for"
    words = {
        "healthy": "Healthy",
        "not-enough-data": "Not enough data for a verdict",
        "step": "A sudden change that nothing explains",
    }
    if verdict in words:
        return words[verdict]
    lost = degraded_words(verdict)
    names = [spell(spec.name) for spec in assessment.stage.parameters if spec.word in lost]
    return f"Loss of {' and '.join(names) or verdict}"


def how_sure(assessment: Assessment) -> str:
    """Write the probability of the verdict, empty without one."""
    probability = assessment.judgement.probability
    return percent(probability) if probability >= 0 else ""


def health_now(assessment: Assessment) -> Health | None:
    """Give the health, if there is an epoch and a parameter to tell."""
    health = assessment.health
    return health if health is not None and health.recorded_at and health.parameters else None


def limit_of(spec: ParameterSpec | None) -> float | None:
    """Give the limit as a fraction of the baseline."""
    return None if spec is None or spec.limit is None else spec.limit.below / spec.baseline


def gauges(assessment: Assessment, top: float | None = None) -> tuple[Gauge, ...]:
    """Put the last epoch of every health parameter in words and places.

    Parameters
    ----------
    assessment : Assessment
        Of the stage.
    top : float or None
        Length of all gauges, as a fraction of the baseline; None for one that fits this stage.
    """
    health = health_now(assessment)
    if health is None:
        return ()
    if top is None:  # one length for all gauges of a page, so that bars can be compared
        highest = health.latest(0.95).max()
        top = float(np.clip(np.ceil(10 * highest + 0.5) / 10, 1.2, 2.0))
    specs = {spec.name: spec for spec in assessment.stage.parameters}
    return tuple(
        _gauge(specs.get(name), health, k, top) for k, name in enumerate(health.parameters)
    )


def _gauge(spec: ParameterSpec | None, health: Health, column: int, top: float) -> Gauge:
    low, middle, high = health.latest(LEVELS)[:, column]
    limit = limit_of(spec)
    places = {"low": low, "median": middle, "high": high, "baseline": 1.0, "limit": limit or 0.0}
    below = "" if limit is None else percent(np.mean(health.samples[-1, :, column] < limit))
    return Gauge(
        name=spell(health.parameters[column]),
        told=bool(health.informed_parameters()[column]),
        converged=bool(health.converged[-1]),
        share=percent(float(health.informed[-1, column])),
        value=f"{100 * middle:.0f}{GAP}%",
        interval=f"{100 * low:.0f} to {100 * high:.0f}{GAP}%",
        below=below,
        limit="" if limit is None else f"{100 * limit:.3g}{GAP}%",
        unit=f"{spec.baseline:g}{GAP}{spec.unit}" if spec and spec.unit else "",
        places={key: round(100 * min(float(v) / top, 1.0), 2) for key, v in places.items()},
    )


def lives(prognosis: Prognosis | None) -> tuple[Life, ...]:
    """Put the remaining life of every limit, and of any, in words."""
    if prognosis is None:
        return ()
    return tuple(_life(prognosis, column) for column in range(len(prognosis.limits)))


def _life(prognosis: Prognosis, column: int) -> Life:
    name, limit = prognosis.parameters[column], float(prognosis.limits[column])
    distance = quantiles(prognosis.censored()[:, column])
    days = quantiles(remaining_days(prognosis)[:, column])
    low, middle, high = quantiles(
        100 * prognosis.health[:, min(column, prognosis.health.shape[1] - 1)]
    )
    return Life(
        name="any limit" if name == "any" else spell(name),
        limit="" if np.isnan(limit) else f"{100 * limit:.3g}{GAP}%",
        km=tuple(left(v, f"beyond {km(prognosis.horizon)}", km(v)) for v in distance),
        days=tuple(left(v, "beyond", day_count(v)) for v in days),
        past=percent(float(prognosis.already_past()[column])),
        beyond=percent(float(prognosis.beyond_horizon()[column])),
        now="" if name == "any" else f"{middle:.0f}{GAP}% ({low:.0f} to {high:.0f}{GAP}%)",
    )


def first_limit(prognosis: Prognosis | None) -> tuple[str, str] | None:
    """Name the part whose limit is most probably the first, and how probably.

    None where one limit is all there is, or no draw ends before the horizon.
    """
    if prognosis is None or len(prognosis.limits) < 3:
        return None
    parts = prognosis.censored()[:, :-1]
    ending = np.isfinite(parts).any(axis=1)
    if not ending.any():
        return None
    shares = np.bincount(parts[ending].argmin(axis=1), minlength=parts.shape[1]) / ending.sum()
    k = int(shares.argmax())
    return spell(prognosis.parameters[k]), percent(float(shares[k]))


def service_words(service: Service) -> dict[str, Any]:
    """Put in words when to service, and by what that was chosen."""
    ratio = service.cost_ratio
    return {
        "kind": service.kind,
        "by": service.by,
        "accepted": service.max_risk and f"{100 * service.max_risk:.3g}{GAP}%",
        "times": ratio and f"{ratio:.3g}",
        "risk": percent(service.risk),
        "planned": service.planned,
        "planned_risk": chance(*service.planned_risk),
    }
