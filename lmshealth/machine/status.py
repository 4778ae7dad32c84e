"""Status of machines: notices, NAMUR NE 107 state, service, remaining life, changes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import date, datetime, timedelta
from typing import Any, Literal

import msgspec
import numpy as np
from scipy.special import chdtrc, gammaincinv

from lmshealth._private.arrays import FloatArray, finite_or_none
from lmshealth._private.tables import FLAGS, NOTICES, fact, spell
from lmshealth.io.log import WARNINGS, Notice, Refusal, utc_day
from lmshealth.life.constants import LONE_NAMED, MIN_FIT
from lmshealth.life.verdict import (
    NO_HEALTH,
    OUTSIDE_MAP,
    degraded_words,
    lone_sentence,
    undeclared_events,
)
from lmshealth.machine import constants
from lmshealth.machine.assessment import Assessment
from lmshealth.machine.summary import Summary, prognosis_rows, step_of
from lmshealth.tracking.contradictions import are_many

_SEVERITIES = "serious", "caution", "note"


def notices(assessment: Assessment) -> tuple[Notice, ...]:
    """Return the notices about a machine, the serious ones first: rows of ``warnings.csv``."""
    found = [*assessment.notices, *_of_names(assessment), *_of_track(assessment)]
    found += [*_of_health(assessment), *_of_laws(assessment), *_of_refused(assessment)]
    return tuple(sorted(found, key=lambda one: _SEVERITIES.index(one.severity)))


def _noticed(key: str, *where: str, code: str = "", **values: object) -> Notice:
    """Return a notice of `NOTICES`, whose key begins with its code unless that is another one.

    Its sentence may have the modes, parameter, channel or log where it is as name or names.
    """
    severity, what, to_do = NOTICES[key]
    *others, last = map(spell, where or ("",))
    listed = f"{', '.join(others)} and {last}" if others else last
    values = {"name": listed, "names": listed} | values
    return Notice(
        code or key.split(",")[0], severity, ", ".join(where), what.format(**values), to_do
    )


def _of_names(assessment: Assessment) -> Iterator[Notice]:
    """Yield notices about names of modes and flags of their last estimates."""
    if assessment.doubt and all(one.what != assessment.doubt for one in assessment.notices):
        yield Notice("names-in-doubt", "serious", "", assessment.doubt)
    latest = assessment.latest
    flags = () if latest is None else zip(latest.modes.names, latest.modes.flags, strict=True)
    by_flag: dict[str, dict[str, None]] = {}
    for mode, own in flags:
        for flag in (one for one in own.split() if one not in WARNINGS.values()):
            by_flag.setdefault(flag, {})[mode] = None
    for flag, modes in by_flag.items():
        meaning = FLAGS.get(flag) or fact("see modes.csv.")
        yield _noticed("flag", *modes, code=flag, flag=flag, meaning=meaning)


def _of_track(assessment: Assessment) -> Iterator[Notice]:
    """Yield notices about drifts, jumps and the consistency of the filter."""
    track, first = assessment.track, assessment.history.baseline
    n_logs = len(assessment.history.logs) - first
    for mode, (size, n_std) in assessment.drifted.items():
        moved = f"{100 * np.expm1(size):+.2f}".replace("-", "−")
        name = spell(mode).capitalize()
        yield _noticed("large-drift", mode, mode=name, size=moved, n=n_logs, n_std=n_std)
    left = {k: n for k, n in assessment.left_out.items() if k not in assessment.drifted}
    for n in sorted(set(left.values())):
        key = "last-logs-left-out, more" if n > 1 else "last-logs-left-out, one"
        yield _noticed(key, *(mode for mode, own in left.items() if own == n), n=n)
    if track is None:
        return
    if modes := [mode for k, mode in track.outliers if k == first]:
        day = utc_day(track.recorded_at[first]).isoformat()
        yield _noticed("baseline-left-out", *modes, day=day)
    if track.suspected is not None:
        day = utc_day(track.recorded_at[track.suspected.first]).isoformat()
        yield _noticed("step-suspected", day=day)
    if not (found := track.consistency()).holds:
        p = f"{min(found.p_value, found.autocorrelation_p_value):.1g}"
        notice = _noticed("filter-inconsistent", p=p)
        if (factor := track.widening[-1]) > 1:
            wide = fact("Its intervals are {factor:.1f} times as wide.", factor=factor)
            notice = replace(notice, what=f"{notice.what} {wide}")
        yield notice


def _of_health(assessment: Assessment) -> Iterator[Notice]:
    """Yield notices about health now."""
    health = assessment.latest_health
    if health is None:
        return
    if not health.explained:
        yield _noticed("unexplained-drifts", p=health.fit[-1])
    for name in assessment.risen:
        yield _noticed("above-baseline", name, name=spell(name).capitalize())
    for name, edge in zip(health.parameters, health.at_edge[-1], strict=True):
        if edge:
            yield _noticed("end-of-map", name)


def _of_refused(assessment: Assessment) -> Iterator[Notice]:
    """Yield notices about channels that are faulty, repaired or left out, and refused logs."""
    found: dict[tuple[str, str], list[Refusal]] = {}
    for row in assessment.refused:
        if row.reason in WARNINGS and row.channel:
            found.setdefault((row.reason, row.channel), []).append(row)
    for (reason, channel), rows in found.items():
        key, n = "channel" if WARNINGS[reason] else "channel, repaired", len({r.log for r in rows})
        own = {"channel": channel, "detail": rows[-1].detail, "log": rows[-1].log, "n": n}
        yield _noticed(key, channel, code=reason, **own)
    if lost := {row.log: row.reason for row in assessment.lost}:
        n, total = len(lost), len(lost) + len(assessment.history.logs)
        key = "logs-refused, many" if are_many(n, total) else "logs-refused"
        reasons = ", ".join(dict.fromkeys(lost.values()))
        yield _noticed(key, max(lost), n=n, total=total, reasons=reasons)


def _of_laws(assessment: Assessment) -> Iterator[Notice]:
    """Yield notices about the laws, their fit, and modes that moved alone."""
    prognosis = assessment.prognosis
    if prognosis is None:
        return
    for name in prognosis.unidentifiable:
        yield _noticed("limit-not-included", name)
    for lone in prognosis.modes_off:
        if lone.probability >= LONE_NAMED:
            what = lone_sentence(lone, assessment.stage)
            yield Notice("mode-off-map", "caution", lone.mode, what)
    dof, value = prognosis.degrees_of_freedom, prognosis.chi_square
    if dof > 0 and value > chi_square_band(np.array(dof))[1]:
        # One of forty machines is above the band by chance.
        by_chance = ", perhaps by chance" if chdtrc(dof, value) >= MIN_FIT else ""
        yield _noticed(f"laws-do-not-fit{by_chance}", value=value, dof=dof)


def chi_square_band(dof: FloatArray) -> FloatArray:
    """Return the 95 % interval of chi-square variables, shape ``(2, ...)``."""
    return np.stack([2 * gammaincinv(dof / 2, level) for level in (0.025, 0.975)])


# Status

DeviceHealth = Literal["NORMAL", "FAILURE", "CHECK_FUNCTION", "OFF_SPEC", "MAINTENANCE_REQUIRED"]
"""State by NAMUR NE 107, as OPC 10000-100 names the values of ``DeviceHealthEnumeration``."""


Severity = Literal["serious", "caution", "note"]

CHANGES: dict[str, Severity] = {
    **dict.fromkeys(("alarm", "verdict", "limit-reached", "large-drift"), "serious"),
    **dict.fromkeys(("unreliable", "service-due", "inspection-overdue", "silent"), "caution"),
    **dict.fromkeys(("no-log-since-maintenance", "unconfirmed-jump"), "note"),
    **dict.fromkeys(("verdict, no loss", "recovered"), "note"),
}
"""Severity of the kinds of changes; report/README.md states when each begins. Each change of a
machine is one of them, once. A kind that is a code of `conditions` begins with that; ``recovered``
has what ended in ``before``."""

# Conditions that begin once per baseline: their dates and probabilities move with each log. Others
# begin anew after they have ended, which is a change too.
_ONCE = ("limit-reached", "large-drift", "unreliable", "service-due")
_ENDING = ("inspection-overdue", "no-log-since-maintenance", "unconfirmed-jump")

# Notices of a jump that later logs must confirm.
_UNCONFIRMED = {"last-logs-left-out", "step-suspected"}

UNKNOWN = "unknown"
"""Verdict on a machine that was sound at its last log, which is too old to rely on."""


class Change(msgspec.Struct, frozen=True):
    """Change of a machine from one run to the next: a row of ``changes.csv``."""

    stage: str
    what: str  # of `CHANGES`, up to a comma
    before: str
    now: str
    recorded_at: datetime  # of the last log
    severity: Severity = "caution"

    def __str__(self) -> str:
        states = " → ".join(state for state in (self.before, self.now) if state)
        return f"{self.stage}: {self.what} {states}".rstrip()


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
    silent: bool = False  # no log for longer than `silent_after_days`
    silent_after_days: float | None = None  # ``--silent-days``, or by the own intervals
    # By the own intervals: 0 with logs of a single day, None in statuses of earlier versions.
    own_silent_after_days: float | None = None
    days_without_log: int = 0
    unknown_since: date | None = None  # day of the last log, if the verdict is `UNKNOWN`
    verdict: str  # on the day of the run
    verdict_at_last_log: str = ""
    probability: float | None
    why: str
    alarms: dict[str, datetime]  # modes with an undeclared alarm since the baseline, and its log
    # Modes whose alarm, and conditions whose begin was a change since the baseline;
    # ``silent`` since the last log.
    announced: tuple[str, ...] = ()
    # Whether work that restores the lost parameters was entered after the last log.
    worked: bool = False
    works: int | None = None  # declared steps and baselines; None in statuses of earlier versions
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

    Evidence of damage comes before missing logs, which must not hide it; of what work was entered
    for since then, the next log is the evidence.
    """
    verdict, by = _at_last_log(status), status.service_by
    late = status.inspect_by is not None and status.inspect_by < today
    judged = verdict not in NO_HEALTH
    serious = {code for code, severity in status.warnings.items() if severity == "serious"}
    # Without parameters too few logs are no fault; what makes later ones useless too is one.
    unusable = verdict == "not-enough-data" and bool(serious - {"large-drift"})
    no_verdict = not judged and (status.infers_health or unusable)
    reached = (status.probability_limit_reached or 0.0) >= constants.FAILURE_PROBABILITY
    is_due = judged and _is_near(by, today)
    found: list[tuple[DeviceHealth, str, object]] = [
        ("FAILURE", "limit-reached", reached and not status.worked),
        ("OFF_SPEC", "alarm", status.alarms and not judged),
        ("OFF_SPEC", "step", verdict == "step"),
        ("OFF_SPEC", OUTSIDE_MAP, verdict == OUTSIDE_MAP),
        ("OFF_SPEC", "large-drift", "large-drift" in serious),
        ("OFF_SPEC", "unreliable", serious and (judged or "unexplained-drifts" in serious)),
        ("MAINTENANCE_REQUIRED", "loss", degraded_words(verdict) and not status.worked),
        ("MAINTENANCE_REQUIRED", "service-due", is_due and not status.worked),
        ("CHECK_FUNCTION", "no-verdict", no_verdict),
        ("CHECK_FUNCTION", "unconfirmed-jump", _UNCONFIRMED & status.warnings.keys()),
        ("CHECK_FUNCTION", "no-log-since-maintenance", "no-log-since" in status.warnings),
        ("CHECK_FUNCTION", "inspection-overdue", late and status.service != "now"),
        ("CHECK_FUNCTION", "silent", today > _last_day(status)),
    ]
    return {code: state for state, code, applies in found if applies}


def _is_near(by: date | None, today: date) -> bool:
    """Return whether a service by a day is due: it takes time to order parts and a visit."""
    return by is not None and by <= today + timedelta(days=constants.SERVICE_LEAD_DAYS)


def _at_last_log(status: Status) -> str:
    """Return the verdict at the last log; statuses of earlier versions have no other."""
    return status.verdict_at_last_log or status.verdict


def _last_day(status: Status) -> date:
    """Return the last day (UTC) on which a machine without a further log is not silent."""
    try:
        end = status.recorded_at + timedelta(days=status.silent_after_days or np.inf)
        return utc_day(end)
    except OverflowError:
        return date.max


def coming_states(status: Status, today: date) -> dict[date, dict[str, DeviceHealth]]:
    """Return the conditions on a day, and on later days that change the state.

    Without a further log; the first of each day's conditions is the state.
    """
    days = [today]
    if status.service_by:
        days.append(status.service_by - timedelta(days=constants.SERVICE_LEAD_DAYS))
    if status.inspect_by:
        days.append(status.inspect_by + timedelta(days=1))
    if (last := _last_day(status)) < date.max:
        days.append(last + timedelta(days=1))
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
    # A limit that later work has restored is reached no more.
    limited = (one for one in shown if one.limit is not None)
    reached = [one.below_limit for one in limited if one.name not in assessment.restored]
    reached += [life.any.already_past] if life else []
    health = [
        {
            **{"parameter": one.name, "q05": one.low, "median": one.median, "q95": one.high},
            **{"limit": one.limit, "probability_below_limit": finite_or_none(one.below_limit)},
        }
        for one in shown
    ]
    made = Status(
        stage=summary.identity,
        page=summary.file,
        description=assessment.stage.name,
        recorded_at=summary.recorded_at,
        baseline_at=summary.baseline_at,
        own_silent_after_days=_silent_after(assessment.history.recorded_at),
        verdict=summary.verdict,
        probability=finite_or_none(summary.probability),
        why=summary.why,
        alarms={one.mode: track.recorded_at[one.epoch] for one in alarms} if track else {},
        worked=summary.step.kind == "see-effect",
        works=len(assessment.history.steps)
        + sum(one.code == "no-log-since" for one in assessment.notices),
        warnings={one.code: one.severity for one in reversed(notices(assessment))},
        infers_health=bool(assessment.stage.parameters),
        probability_limit_reached=max(reached, default=None),
        health=tuple(health),
        remaining_life=tuple(prognosis_rows(life, service)) if life else (),
        service=service.kind,
        service_by=service.by,
        inspect_by=service.inspect_by,
    )
    return judge_on(made, assessment.today or utc_day(summary.recorded_at), None)


def _silent_after(moments: Sequence[datetime]) -> float:
    """Return the days without a log after which a machine is silent, by its own intervals.

    0 with logs of a single day. Several logs of one day are a single one here.
    """
    n = constants.SILENT_INTERVALS
    days = sorted({utc_day(one) for one in moments})[-n - 1 :]
    return n * (days[-1] - days[0]).days / (len(days) - 1) if len(days) > 1 else 0.0


def judge_on(status: Status, today: date, silent_days: float | None) -> Status:
    """Judge a status on a day: conditions, state by NE 107 and verdict.

    Without ``silent_days`` a silence begins by the intervals of the machine's own logs.
    """
    own = status.own_silent_after_days
    after = silent_days or (status.silent_after_days if own is None else own or None)
    # A status of an earlier schema is written again in this one.
    status = msgspec.structs.replace(status, schema=constants.JSON_SCHEMA, silent_after_days=after)
    found, verdict = conditions(status, today), _at_last_log(status)
    state: DeviceHealth = next(iter(found.values()), "NORMAL")
    unknown = "silent" in found and verdict in ("healthy", "no-alarm")
    return msgspec.structs.replace(
        status,
        conditions=found,
        device_health=state,
        days_without_log=max((today - utc_day(status.recorded_at)).days, 0),
        silent="silent" in found,
        unknown_since=utc_day(status.recorded_at) if unknown else None,
        verdict=UNKNOWN if unknown else verdict,
        verdict_at_last_log=verdict,
        probability=None if unknown else status.probability,
    )


def on_day(summary: Summary, status: Status, today: date) -> Summary:
    """Return a summary as of a day, by the status on that day: state, urgency, step, days left."""
    service = summary.service
    late = "late" if {"silent", "inspection-overdue"} & status.conditions.keys() else ""
    is_past = service.kind == "by" and service.by is not None and service.by < today
    if status.unknown_since:
        urgency = min(summary.urgency, (1, 0.0, 0.0, summary.identity))
        summary = replace(summary, state="open", urgency=urgency, unknown=True)
    postponed = [row for row in summary.postponed if row[0] >= today][: constants.POSTPONED_SHOWN]
    # Logs as rare as the step allows would let the machine become silent.
    often = min(summary.step.log_every, status.silent_after_days or np.inf)
    kind = step_of(*summary.step.case, "overdue" if is_past else late)
    step = replace(summary.step, kind=kind, log_every=often)
    return replace(summary, today=today, step=step, postponed=tuple(postponed))


def compare(
    before: Status | None, now: Status, today: date, silent_days: float | None
) -> tuple[Status, list[Change]]:
    """Judge a status on a day, and list its changes since the run before; None if it is new.

    An alarm of a mode, and a condition that moves with each log, is a change once per baseline. A
    silence is one until the next log, also where the clock is set back.
    """
    now = judge_on(now, today, silent_days)
    known = before.announced if before and before.baseline_at == now.baseline_at else ()
    once = [code for code in now.conditions if code in _ONCE]
    if _is_worked_on(before, now):  # what it has ended may begin again
        known = tuple(code for code in known if code in (*once, *now.alarms))
    known = tuple(code for code in known if code != "silent")
    lasts = before is not None and _was_silent(before) and now.recorded_at <= before.recorded_at
    silence = ("silent",) if now.silent or lasts else ()
    announced = dict.fromkeys((*known, *now.alarms, *once, *silence))
    now = msgspec.structs.replace(now, announced=tuple(announced))
    changes = [("alarm", "", mode) for mode in now.alarms if mode not in known]
    changes += [(code, "", _detail(code, now)) for code in once if code not in known]
    changes += _transitions(before, now, today)
    severities = dict(CHANGES)
    if not _is_loss(_at_last_log(now)):
        severities["verdict"] = severities["verdict, no loss"]
    return now, [Change(now.stage, *one, now.recorded_at, severities[one[0]]) for one in changes]


def _detail(code: str, now: Status) -> str:
    """Return the date or the probability behind a condition; empty for those without."""
    found = {"service-due": now.service_by, "inspection-overdue": now.inspect_by}
    if (day := found.get(code)) is not None:
        return f"by {day.isoformat()}"
    reached = now.probability_limit_reached
    return f"probability {reached:.2f}" if code == "limit-reached" and reached else ""


def _transitions(before: Status | None, now: Status, today: date) -> Iterator[tuple[str, str, str]]:
    """Yield changes of verdict, silence and late logs; of a new machine only what is bad."""
    was, verdict = _at_last_log(before) if before else "", _at_last_log(now)
    if was != verdict and ((before and now.infers_health) or _is_loss(verdict)):
        recovered = _is_loss(was) and verdict == "healthy"
        yield "recovered" if recovered else "verdict", was, verdict
    elif before and before.alarms and not now.alarms:
        yield "recovered", f"alarm {' '.join(before.alarms)}", "no alarm"
    if now.silent and not _was_silent(before):
        last = utc_day(now.recorded_at).isoformat()
        yield "silent", f"last log of {last}", f"no log for {now.days_without_log} days"
    elif before is not None and _was_silent(before) and "silent" not in now.announced:
        last, latest = (utc_day(one.recorded_at).isoformat() for one in (before, now))
        yield "recovered", f"no log since {last}", f"log of {latest}"
    earlier = before.conditions if before else {}
    for code in _ENDING:
        if code in now.conditions and code not in earlier:
            yield code, "", _detail(code, now)
    if before:
        yield from (("recovered", code, why) for code, why in _ended(before, now, today))


def _ended(before: Status, now: Status, today: date) -> Iterator[tuple[str, str]]:
    """Yield conditions that a later log has ended, or work that was entered, and which of both."""
    ended = before.conditions.keys() - now.conditions.keys()
    if now.alarms or _is_loss(_at_last_log(now)):  # they are the jump that was not confirmed
        ended -= {"unconfirmed-jump"}
    # Not by another day or description.
    if now.recorded_at > before.recorded_at and not _was_silent(before):
        why = f"log of {utc_day(now.recorded_at).isoformat()}"
        yield from ((code, why) for code in _ENDING if code in ended)
    elif _is_worked_on(before, now):
        if _is_near(now.service_by, today):  # without a verdict it is no condition, and still due
            ended -= {"service-due"}
        is_more = (now.works or 0) > (before.works or 0)
        why = "work was entered" if is_more else "maintenance.csv was changed"
        yield from ((code, why) for code in (*_ENDING, *_ONCE) if code in ended)


def _was_silent(before: Status | None) -> bool:
    """Return whether a silence was a change already; earlier versions do not list it as such."""
    return before is not None and (before.silent or "silent" in before.announced)


def _is_worked_on(before: Status | None, now: Status) -> bool:
    """Return whether work that is not yet in an earlier status was entered."""
    return before is not None and before.works is not None and now.works != before.works


def _is_loss(verdict: str) -> bool:
    return verdict not in ("", "healthy", *NO_HEALTH)
