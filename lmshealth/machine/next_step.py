"""Next step for a machine: a function of its verdict, its service and its age, by one table."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date
from typing import Literal

import numpy as np

from lmshealth.life.prognosis import Prognosis
from lmshealth.life.verdict import NO_HEALTH, OUTSIDE_MAP
from lmshealth.machine import constants
from lmshealth.machine.assessment import Assessment
from lmshealth.machine.service import Service

Step = Literal["inspect", "find-cause", "none", "record", "service-now", "confirm", "plan", "later"]
"""What to do: inspect the machine, find what moved a mode, nothing, record logs, service it now,
confirm a service date by further logs, plan the service, or nothing within the horizon."""

# First case that applies to verdict, kind of service and age. A verdict is ``alarm`` (or a step),
# ``outside``, ``open`` (none), ``healthy`` or ``loss``; "" stands for any value.
CASES: tuple[tuple[Step, str, str, str], ...] = (
    ("inspect", "alarm", "", ""),
    ("find-cause", "outside", "", ""),
    ("none", "healthy", "unknown", ""),
    ("record", "", "unknown", ""),
    ("service-now", "", "now", ""),
    ("confirm", "healthy", "by", "young"),
    ("plan", "", "by", ""),
    ("later", "", "later", ""),
)


@dataclass(frozen=True, slots=True)
class NextStep:
    """What to do next with a machine; `report.wording.next_step` puts it into a sentence."""

    kind: Step
    # parameter, word: the parameter whose limit is most probably reached first, and its word in
    # verdicts; "" without a service.
    parameter: str = ""
    word: str = ""
    by: date | None = None  # day of the service
    log_every: float = np.inf  # days from one log to the next
    horizon: float = np.nan  # travel in m beyond which nothing is claimed


def next_step(assessment: Assessment, service: Service) -> NextStep:
    """Choose the next step by `CASES`."""
    prognosis = assessment.prognosis
    kind = "unknown" if prognosis is None else service.kind
    n_logs = len(assessment.history.logs) - assessment.history.baseline
    age = "young" if n_logs <= constants.YOUNG_LOGS else "old"
    step = step_of(_class_of(assessment), kind, age)
    if prognosis is None or step in ("inspect", "find-cause", "none", "record"):
        return NextStep(step)
    first = first_limit(prognosis)
    name = first[0] if first else prognosis.parameters[0]
    words = {spec.name: spec.word for spec in assessment.stage.parameters}
    every = service.inspect_every / float(np.median(prognosis.usage))
    return NextStep(step, name, words.get(name, ""), service.by, every, prognosis.horizon)


def step_of(verdict: str, service: str, age: str) -> Step:
    """Return the step of the first case that applies."""
    given = verdict, service, age
    return next(
        step
        for step, *case in CASES
        if all(wanted in ("", one) for wanted, one in zip(case, given, strict=True))
    )


def _class_of(assessment: Assessment) -> str:
    """Return the class of the verdict as `CASES` has it."""
    verdict = assessment.judgement.verdict
    if assessment.alarmed or verdict == "step":
        return "alarm"
    known = {OUTSIDE_MAP: "outside", "healthy": "healthy", **dict.fromkeys(NO_HEALTH, "open")}
    return known.get(verdict, "loss")


def first_limit(prognosis: Prognosis | None) -> tuple[str, float] | None:
    """Return the parameter whose limit is most probably reached first, and its probability.

    None with a single limit, or when no draw reaches one before the horizon.
    """
    if prognosis is None or len(prognosis.limits) < 3:
        return None
    parts = prognosis.censored()[:, :-1]
    ending = np.isfinite(parts).any(axis=1)
    if not ending.any():
        return None
    shares = np.bincount(parts[ending].argmin(axis=1), minlength=parts.shape[1]) / ending.sum()
    k = int(shares.argmax())
    return prognosis.parameters[k], float(shares[k])
