"""Status of machines for other programs: NAMUR NE 107 state, service, remaining life, changes."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, date, datetime, time, timedelta
from typing import Any, Literal, NamedTuple

import msgspec
import numpy as np

from lmshealth.batch import constants
from lmshealth.health.verdict import degraded_words, undeclared_events
from lmshealth.report.assessment import Assessment, Life, Summary
from lmshealth.report.constants import LEVELS
from lmshealth.report.notices import notices
from lmshealth.report.tables import prognosis_rows
from lmshealth.report.text import spell
from lmshealth.stage.constants import INFORMED

DeviceHealth = Literal["NORMAL", "FAILURE", "CHECK_FUNCTION", "OFF_SPEC", "MAINTENANCE_REQUIRED"]
"""State by NAMUR NE 107, as OPC 10000-100 names the values of ``DeviceHealthEnumeration``."""


class Condition(msgspec.Struct, frozen=True):
    """Reason for a state: README.md lists the codes."""

    device_health: DeviceHealth = msgspec.field(name="DeviceHealth")
    code: str


class MaintenancePrognosis(msgspec.Struct, frozen=True, rename="pascal"):
    """Activity and the time when it becomes necessary: MaintenancePrognosisType of OPC 40501-1."""

    activity: str
    predicted_time: datetime  # UTC
    probability: float | None  # of reaching a limit before that time; no part of OPC 40501-1


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

    schema: int = constants.STATUS_SCHEMA
    stage: str
    page: str  # file in the same folder
    description: str  # name of the stage description
    recorded_at: datetime  # of the last log
    baseline_at: datetime
    device_health: DeviceHealth = msgspec.field(name="DeviceHealth", default="NORMAL")
    conditions: tuple[Condition, ...] = ()
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
    prognoses: tuple[MaintenancePrognosis, ...] = msgspec.field(name="Prognoses")


class Fleet(msgspec.Struct, frozen=True):
    """Status of all machines after a run, and changes that were not delivered by channel."""

    machines: tuple[Status, ...] = ()
    pending: dict[str, tuple[Change, ...]] = {}
    schema: int = constants.STATUS_SCHEMA


class Point(NamedTuple):
    """Value of a quantity at a log with its 90 % interval, for dashboards; None is missing."""

    quantity: Literal["health", "frequency_hz", "remaining_km"]
    subject: str  # parameter, mode or limit
    recorded_at: datetime
    low: float | None
    median: float | None
    high: float | None


def conditions(status: Status, today: date) -> tuple[Condition, ...]:
    """Return what keeps a machine from the state ``NORMAL``; the first one decides its state.

    Evidence of damage comes before missing logs, which must not hide it.
    """
    verdict, by, inspect = status.verdict, status.service_by, status.inspect_by
    judged = verdict != "not-enough-data"
    serious = {code for code, severity in status.warnings.items() if severity == "serious"}
    reached = (status.probability_limit_reached or 0.0) >= constants.FAILURE_PROBABILITY
    soon = today + timedelta(days=constants.SERVICE_LEAD_DAYS)
    found: list[tuple[DeviceHealth, str, object]] = [
        ("FAILURE", "limit-reached", reached),
        ("OFF_SPEC", "alarm", status.alarms and not judged),
        ("OFF_SPEC", "step", verdict == "step"),
        ("OFF_SPEC", "unreliable", serious and (judged or "unexplained-drifts" in serious)),
        ("MAINTENANCE_REQUIRED", "loss", degraded_words(verdict)),
        ("MAINTENANCE_REQUIRED", "service-due", by is not None and by <= soon),
        ("CHECK_FUNCTION", "no-verdict", status.infers_health and not judged),
        ("CHECK_FUNCTION", "no-log-since-maintenance", "no-log-since" in status.warnings),
        ("CHECK_FUNCTION", "inspection-overdue", inspect is not None and inspect < today),
        ("CHECK_FUNCTION", "silent", status.silent),
    ]
    return tuple(Condition(state, code) for state, code, applies in found if applies)


def make_status(assessment: Assessment, summary: Summary) -> Status:
    """Collect the status of a machine from its results, before it is compared and judged."""
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
    return Status(
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
        prognoses=tuple(_prognoses(summary)),
    )


def _prognoses(summary: Summary) -> Iterator[MaintenancePrognosis]:
    """Yield what has to be done and when, as far as that is before the horizon."""
    service, zone = summary.service, summary.recorded_at.tzinfo
    limits = summary.life.limits[:-1] if summary.life else ()
    found = [("Service", service.by, service.risk), ("Record a log", service.inspect_by, np.nan)]
    found += [(f"Restore {spell(one.parameter)}", one.dates[3], 0.5) for one in limits]  # medians
    for activity, day, risk in found:
        if day is not None:
            moment = datetime.combine(day, time(), zone).astimezone(UTC)
            yield MaintenancePrognosis(activity, moment, _or_none(risk))


def _or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def compare(
    before: Status | None, now: Status, moment: datetime, silent_days: float | None
) -> tuple[Status, list[Change]]:
    """Judge a status at a moment, and list its changes since the run before; None if it is new.

    An alarm of a mode is a change once per baseline, the silence of a machine once until its next
    log. Without ``silent_days`` a silence only lasts.
    """
    if silent_days is None:
        silent = before is not None and before.silent and before.recorded_at == now.recorded_at
    else:
        silent = moment - now.recorded_at > timedelta(days=silent_days)
    known = before.announced if before and before.baseline_at == now.baseline_at else ()
    announced = tuple(dict.fromkeys((*known, *now.alarms)))
    now = msgspec.structs.replace(now, silent=silent, announced=announced)
    found = conditions(now, moment.date())
    state: DeviceHealth = found[0].device_health if found else "NORMAL"
    now = msgspec.structs.replace(now, conditions=found, device_health=state)
    changes = [("alarm", "", mode) for mode in announced if mode not in known]
    changes += [*_of_verdict(before, now), *_of_silence(before, now, moment)]
    return now, [Change(now.stage, *one, now.recorded_at) for one in changes]


def _of_verdict(before: Status | None, now: Status) -> Iterator[tuple[str, str, str]]:
    """Yield the change of the verdict; of a new machine a loss or a step is one."""
    was, lost = (before.verdict, _is_loss(before.verdict)) if before else ("", False)
    if was != now.verdict and (before is not None or _is_loss(now.verdict)):
        yield "recovered" if lost and now.verdict == "healthy" else "verdict", was, now.verdict
    elif before is not None and before.alarms and not now.alarms:
        yield "recovered", f"alarm {' '.join(before.alarms)}", "no alarm"


def _is_loss(verdict: str) -> bool:
    return verdict == "step" or bool(degraded_words(verdict))


def _of_silence(
    before: Status | None, now: Status, moment: datetime
) -> Iterator[tuple[str, str, str]]:
    """Yield that logs stopped coming, or came again."""
    was = before is not None and before.silent
    if now.silent and not was:
        last = now.recorded_at.date().isoformat()
        days = (moment - now.recorded_at).days
        yield "silent", f"last log of {last}", f"no log for {days} days"
    elif before is not None and was and not now.silent:
        last, new = (one.recorded_at.date().isoformat() for one in (before, now))
        yield "recovered", f"no log since {last}", f"log of {new}"


def points(assessment: Assessment, life: Life | None) -> Iterator[Point]:
    """Yield health, frequencies and remaining life of a machine, at its newest logs."""
    health, track = assessment.latest_health, assessment.track
    if health is not None:
        usable = health.converged[:, None] & health.identifiable & (health.informed >= INFORMED)
        quantiles = health.quantile(np.array(LEVELS))
        for k, j in np.argwhere(usable).tolist():
            own = quantiles[:, k, j].tolist()
            yield Point("health", health.parameters[j], health.recorded_at[k], *own)
    if track is not None:
        # 5, 50 and 95 % quantiles of a normal distribution.
        spread = 1.645 * track.ln_frequency_std[:, :, None] * np.array([-1.0, 0.0, 1.0])
        hertz = np.exp(track.ln_frequency[:, :, None] + spread)[-constants.POINTS_PER_SERIES :]
        newest = track.recorded_at[-constants.POINTS_PER_SERIES :]
        for k, i in np.argwhere(np.isfinite(hertz).all(axis=2)).tolist():
            yield Point("frequency_hz", track.modes[i], newest[k], *hertz[k, i].tolist())
    if life is None:
        return
    for limit in life.limits:
        km = [_or_none(travel / 1000) for travel in limit.travel[::3]]  # 5, 50 and 95 %
        yield Point("remaining_km", limit.parameter, life.recorded_at, *km)
