"""Next step for a machine: a function of verdict, service, age and day, by one table."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import date
from typing import Literal

import numpy as np

from lmshealth.life.prognosis import Prognosis
from lmshealth.life.verdict import NO_HEALTH, OUTSIDE_MAP
from lmshealth.machine import constants
from lmshealth.machine.assessment import Assessment
from lmshealth.machine.service import Service

Step = Literal[
    "inspect", "find-cause", "check-drift", "log-now", "none", "record",
    "service-now", "overdue", "confirm", "schedule", "plan", "later",
]  # fmt: skip
"""What to do: inspect the machine, find what moved a mode, confirm a drift by a log at once, record
a log that is late, nothing, record logs, service it now, service it after its date, confirm a
service date by further logs, plan the service of a sound or of a worn machine, or nothing within
the horizon."""

# First case that applies to verdict, kind of service, age and day. A verdict is ``alarm`` (or a
# step), ``outside``, ``drift`` (large, without a verdict, or a last log that is left out), ``open``
# (none), ``healthy`` or ``loss``. A day is ``overdue`` after that of the service, else ``late``
# where a log is. "" is any.
CASES: tuple[tuple[Step, str, str, str, str], ...] = (
    ("inspect", "alarm", "", "", ""),
    ("find-cause", "outside", "", "", ""),
    ("check-drift", "drift", "", "", ""),
    ("log-now", "", "unknown", "", "late"),
    ("none", "healthy", "unknown", "", ""),
    ("record", "", "unknown", "", ""),
    ("service-now", "", "now", "", ""),
    ("log-now", "healthy", "by", "young", "overdue"),
    ("log-now", "open", "by", "young", "overdue"),
    ("overdue", "", "by", "", "overdue"),
    ("log-now", "healthy", "", "", "late"),
    ("confirm", "healthy", "by", "young", ""),
    ("confirm", "open", "by", "young", ""),
    ("schedule", "healthy", "by", "", ""),
    ("plan", "", "by", "", ""),
    ("log-now", "", "later", "", "late"),
    ("later", "", "later", "", ""),
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
    case: tuple[str, str, str] = ("open", "unknown", "young")  # verdict, service and age

    def on(self, day: str) -> NextStep:
        """Return the step on an ``overdue`` or ``late`` day, or on another (``""``)."""
        return replace(self, kind=step_of(*self.case, day))


def next_step(assessment: Assessment, service: Service) -> NextStep:
    """Choose the next step at the last log by `CASES`."""
    prognosis = assessment.prognosis
    kind = "unknown" if prognosis is None else service.kind
    n_logs = len(assessment.history.logs) - assessment.history.baseline
    age = "young" if n_logs <= constants.YOUNG_LOGS else "old"
    case = _class_of(assessment), kind, age
    step = step_of(*case)
    if prognosis is None:
        return NextStep(step, case=case)
    first = first_limit(prognosis)
    name = first[0] if first else prognosis.parameters[0]
    words = {spec.name: spec.word for spec in assessment.stage.parameters}
    every = service.inspect_every / float(np.median(prognosis.usage))
    return NextStep(step, name, words.get(name, ""), service.by, every, prognosis.horizon, case)


def step_of(verdict: str, service: str, age: str, day: str = "") -> Step:
    """Return the step of the first case that applies."""
    given = verdict, service, age, day
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
    if assessment.drifted or (assessment.left_out and verdict != OUTSIDE_MAP):
        return "drift"
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
