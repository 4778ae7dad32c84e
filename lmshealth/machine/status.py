"""Status of machines for other programs: NAMUR NE 107 state, service, remaining life, changes."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import date, datetime, timedelta
from typing import Any, Literal

import msgspec
import numpy as np

from lmshealth.life.verdict import NO_HEALTH, OUTSIDE_MAP, degraded_words, undeclared_events
from lmshealth.machine import constants
from lmshealth.machine.assessment import Assessment
from lmshealth.machine.notices import notices
from lmshealth.machine.summary import Summary, prognosis_rows

DeviceHealth = Literal["NORMAL", "FAILURE", "CHECK_FUNCTION", "OFF_SPEC", "MAINTENANCE_REQUIRED"]
"""State by NAMUR NE 107, as OPC 10000-100 names the values of ``DeviceHealthEnumeration``."""


class Change(msgspec.Struct, frozen=True):
    """Change of a machine from one run to the next: a row of ``changes.csv``."""

    stage: str
    what: str  # alarm, verdict, silent or recovered
    before: str
    now: str
    recorded_at: datetime  # of the last log

    def __str__(self) -> str:
        states = " → ".join(state for state in (self.before, self.now) if state)
        return f"{self.stage}: {self.what} {states}"


class Status(msgspec.Struct, frozen=True, kw_only=True):
    """Status of a machine after a run: one ``<stage>.status.json``."""

    schema: int = constants.JSON_SCHEMA
    stage: str
    page: str  # file in the same folder
    description: str  # name of the stage description
    recorded_at: datetime  # of the last log
    baseline_at: datetime
    device_health: DeviceHealth = msgspec.field(name="DeviceHealth", default="NORMAL")
    conditions: dict[str, DeviceHealth] = {}  # `conditions`; the first one is `device_health`
    silent: bool = False  # no log for longer than ``--silent-days``
    verdict: str
    probability: float | None
    why: str
    alarms: dict[str, datetime]  # modes with an undeclared alarm since the baseline, and its log
    announced: tuple[str, ...] = ()  # modes whose alarm was a change since the baseline
    warnings: dict[str, str]  # code and severity of what was noticed
    infers_health: bool  # whether the description has a parameter
    probability_limit_reached: float | None  # now; None where no limit is determined
    health: tuple[dict[str, Any], ...]  # parameters that the logs determine, over their baselines
    remaining_life: tuple[dict[str, Any], ...]  # rows of prognosis.csv; the last one is any limit
    service: str  # service, service_by, inspect_by: as in prognosis.csv
    service_by: date | None
    inspect_by: date | None


class Fleet(msgspec.Struct, frozen=True):
    """Status of all machines after a run."""

    machines: tuple[Status, ...] = ()
    schema: int = constants.JSON_SCHEMA


def conditions(status: Status, today: date) -> dict[str, DeviceHealth]:
    """Return what keeps a machine from the state ``NORMAL``, by code; the first is its state.

    Evidence of damage comes before missing logs, which must not hide it.
    """
    verdict, by, inspect = status.verdict, status.service_by, status.inspect_by
    judged = verdict not in NO_HEALTH
    serious = {code for code, severity in status.warnings.items() if severity == "serious"}
    reached = (status.probability_limit_reached or 0.0) >= constants.FAILURE_PROBABILITY
    soon = today + timedelta(days=constants.SERVICE_LEAD_DAYS)
    found: list[tuple[DeviceHealth, str, object]] = [
        ("FAILURE", "limit-reached", reached),
        ("OFF_SPEC", "alarm", status.alarms and not judged),
        ("OFF_SPEC", "step", verdict == "step"),
        ("OFF_SPEC", OUTSIDE_MAP, verdict == OUTSIDE_MAP),
        ("OFF_SPEC", "unreliable", serious and (judged or "unexplained-drifts" in serious)),
        ("MAINTENANCE_REQUIRED", "loss", degraded_words(verdict)),
        ("MAINTENANCE_REQUIRED", "service-due", by is not None and by <= soon),
        ("CHECK_FUNCTION", "no-verdict", status.infers_health and not judged),
        ("CHECK_FUNCTION", "no-log-since-maintenance", "no-log-since" in status.warnings),
        ("CHECK_FUNCTION", "inspection-overdue", inspect is not None and inspect < today),
        ("CHECK_FUNCTION", "silent", status.silent),
    ]
    return {code: state for state, code, applies in found if applies}


def coming_states(status: Status) -> dict[date, dict[str, DeviceHealth]]:
    """Return the conditions on the day of the last log, and on later days that change the state.

    Without a further log; the first of each day's conditions is the state.
    """
    days = [status.recorded_at.date()]
    if status.service_by:
        days.append(status.service_by - timedelta(days=constants.SERVICE_LEAD_DAYS))
    if status.inspect_by:
        days.append(status.inspect_by + timedelta(days=1))
    states: dict[date, dict[str, DeviceHealth]] = {}
    for day in sorted(one for one in days if one >= days[0]):
        found = conditions(status, day)
        before = next(reversed(states.values()), None)
        if before is None or [*found.values()][:1] != [*before.values()][:1]:
            states[day] = found
    return states


def make_status(assessment: Assessment, summary: Summary) -> Status:
    """Collect the status of a machine from its results, judged on `Assessment.today`."""
    track, life, service = assessment.track, summary.life, summary.service
    alarms = undeclared_events(track, assessment.history.baseline, "alarm")
    shown = [one for one in summary.health if one.determined]
    reached = [one.below_limit for one in shown if one.limit is not None]
    reached += [life.any.already_past] if life else []
    health = [
        {
            **{"parameter": one.name, "q05": one.low, "median": one.median, "q95": one.high},
            **{"limit": one.limit, "probability_below_limit": _or_none(one.below_limit)},
        }
        for one in shown
    ]
    made = Status(
        stage=summary.identity,
        page=summary.file,
        description=assessment.stage.name,
        recorded_at=summary.recorded_at,
        baseline_at=summary.baseline_at,
        verdict=summary.verdict,
        probability=_or_none(summary.probability),
        why=summary.why,
        alarms={one.mode: track.recorded_at[one.epoch] for one in alarms} if track else {},
        warnings={one.code: one.severity for one in reversed(notices(assessment))},
        infers_health=bool(assessment.stage.parameters),
        probability_limit_reached=max(reached, default=None),
        health=tuple(health),
        remaining_life=tuple(prognosis_rows(life, service)) if life else (),
        service=service.kind,
        service_by=service.by,
        inspect_by=service.inspect_by,
    )
    return _judged(made, assessment.today or summary.recorded_at.date())


def _judged(status: Status, today: date) -> Status:
    """Set the conditions of a status on a day, and its state by NE 107."""
    found = conditions(status, today)
    state: DeviceHealth = next(iter(found.values()), "NORMAL")
    return msgspec.structs.replace(status, conditions=found, device_health=state)


def _or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def compare(
    before: Status | None, now: Status, moment: datetime, silent_days: float | None
) -> tuple[Status, list[Change]]:
    """Judge a status at a moment, and list its changes since the run before; None if it is new.

    An alarm of a mode is a change once per baseline. The silence of a machine is one once, and
    lasts until its next log, also where the clock is set back; without ``silent_days`` none begins.
    """
    silent = before is not None and before.silent and before.recorded_at == now.recorded_at
    if silent_days is not None:
        silent = silent or moment - now.recorded_at > timedelta(days=silent_days)
    known = before.announced if before and before.baseline_at == now.baseline_at else ()
    announced = tuple(dict.fromkeys((*known, *now.alarms)))
    # A status of an earlier schema is written again in this one.
    now = msgspec.structs.replace(
        now, schema=constants.JSON_SCHEMA, silent=silent, announced=announced
    )
    now = _judged(now, moment.date())
    changes = [("alarm", "", mode) for mode in announced if mode not in known]
    changes += _transitions(before, now, moment)
    return now, [Change(now.stage, *one, now.recorded_at) for one in changes]


def _transitions(
    before: Status | None, now: Status, moment: datetime
) -> Iterator[tuple[str, str, str]]:
    """Yield changes of verdict, silence and alarms; of a new machine only what is bad."""
    was = before.verdict if before else ""
    last = (before or now).recorded_at.date().isoformat()
    if was != now.verdict and ((before and now.infers_health) or _is_loss(now.verdict)):
        recovered = _is_loss(was) and now.verdict == "healthy"
        yield "recovered" if recovered else "verdict", was, now.verdict
    elif before and before.alarms and not now.alarms:
        yield "recovered", f"alarm {' '.join(before.alarms)}", "no alarm"
    if now.silent and not (before and before.silent):
        yield "silent", f"last log of {last}", f"no log for {(moment - now.recorded_at).days} days"
    elif before and before.silent and not now.silent:
        yield "recovered", f"no log since {last}", f"log of {now.recorded_at.date().isoformat()}"


def _is_loss(verdict: str) -> bool:
    return verdict not in ("", "healthy", *NO_HEALTH)
