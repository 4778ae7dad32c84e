"""Summary of an assessment in a few numbers, with the next step, for pages and terminals."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import date, datetime
from typing import Literal

import numpy as np

from lmshealth._private.arrays import FloatArray, finite_or_none
from lmshealth._private.tables import TABLES, Row, spell
from lmshealth.life.constants import LONE_NAMED
from lmshealth.life.fleet_prior import Calibration
from lmshealth.life.prognosis import LawWeight, Prognosis
from lmshealth.life.verdict import NO_HEALTH, OUTSIDE_MAP, degraded_words, undeclared_events
from lmshealth.machine import constants
from lmshealth.machine.assessment import Assessment
from lmshealth.machine.service import (
    Service,
    day_after,
    days_to,
    decide,
    remaining_days,
    risk_before,
)
from lmshealth.stage.description import ParameterSpec, Stage

Step = Literal[
    "see-effect", "inspect", "find-cause", "check-drift", "check-loss", "log-now", "none", "record",
    "service-now", "overdue", "confirm", "schedule", "plan", "later",
]  # fmt: skip
"""What to do; the sentence of each is in `[steps]` of ``_private/tables.toml``."""

# First case that applies to verdict, kind of service, age and day. A verdict is ``worked`` (the
# work that the step would order was entered after the last log), ``alarm`` (or a step), ``outside``
# (or a step of modes that moved alone), ``drift`` (large, or a last log that is left out, without a
# loss), ``repair`` (perhaps: a loss, and a last log that is left out), ``open`` (none), ``healthy``
# or ``loss``. A day is ``overdue`` after that of the service, else ``late`` where a log is. "" is
# any.
CASES: tuple[tuple[Step, str, str, str, str], ...] = (
    ("see-effect", "worked", "", "", ""),
    ("inspect", "alarm", "", "", ""),
    ("find-cause", "outside", "", "", ""),
    ("check-drift", "drift", "", "", ""),
    ("check-loss", "repair", "now", "", ""),
    ("check-loss", "repair", "by", "", ""),
    ("check-drift", "repair", "", "", ""),
    ("log-now", "", "unknown", "", "late"),
    ("none", "healthy", "unknown", "", ""),
    ("record", "", "unknown", "", ""),
    ("log-now", "open", "", "", "overdue"),
    ("log-now", "open", "", "", "late"),
    ("confirm", "open", "by", "young", ""),
    ("record", "open", "", "", ""),
    ("service-now", "", "now", "", ""),
    ("log-now", "healthy", "by", "young", "overdue"),
    ("overdue", "", "by", "", "overdue"),
    ("log-now", "healthy", "", "", "late"),
    ("confirm", "healthy", "by", "young", ""),
    ("schedule", "healthy", "by", "", ""),
    ("plan", "", "by", "", ""),
    ("log-now", "", "later", "", "late"),
    ("later", "", "later", "", ""),
)


@dataclass(frozen=True, slots=True)
class NextStep:
    """What to do next with a machine; `report.text.next_step` puts it into a sentence."""

    kind: Step
    # Parameters that the service restores, and their words in verdicts, without those for which
    # work was entered since the last log; that whose limit is most probably reached first is first.
    parts: tuple[tuple[str, str], ...] = ()
    by: date | None = None  # day of the service
    log_every: float = np.inf  # days from one log to the next
    horizon: float = np.nan  # travel in m beyond which nothing is claimed
    partial: bool = False  # whether a limit is left out, because the modes do not show it
    case: tuple[str, str, str] = ("open", "unknown", "young")  # verdict, service and age


def next_step(assessment: Assessment, service: Service) -> NextStep:
    """Choose the next step at the last log by `CASES`."""
    whole, prognosis, mended = assessment.prognosis, assessment.limits_left, assessment.restored
    kind = "unknown" if prognosis is None else service.kind
    n_logs = len(assessment.history.logs) - assessment.history.baseline
    age = "young" if n_logs <= constants.YOUNG_LOGS else "old"
    words = {one.name: one.word for one in assessment.stage.parameters}
    degraded = degraded_words(assessment.judgement.verdict)
    first, left = _ending_first(whole), _ending_first(prognosis)
    lost = [name for name, word in words.items() if word in degraded] or first
    parts = {name: words.get(name, "") for name in (*left, *lost) if name not in mended}
    # Work on one part does not restore another.
    needed = {*lost, *(first if kind in ("now", "by") else ()), *(left if kind == "now" else ())}
    done = any(notice.code == "no-log-since" for notice in assessment.notices)
    case = "worked" if done and not parts.keys() & needed else _class_of(assessment), kind, age
    step = NextStep(step_of(*case), tuple(parts.items()), case=case)
    if prognosis is None:
        return step
    every, partial = days_to(prognosis, service.inspect_every), bool(prognosis.unidentifiable)
    return replace(step, by=service.by, log_every=every, horizon=prognosis.horizon, partial=partial)


def _ending_first(prognosis: Prognosis | None) -> list[str]:
    """Return the parameter whose limit is most probably reached first; of a single one that."""
    if prognosis is None:
        return []
    first = first_limit(prognosis)
    return [first[0] if first else prognosis.parameters[0]]


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
        events = undeclared_events(assessment.track, assessment.history.baseline, "step")
        lone = assessment.health.lone_modes if assessment.health else ()
        alone = {one.mode for one in lone if one.probability >= LONE_NAMED}
        moved = {one.mode for one in events} | set(assessment.alarmed)
        return "outside" if events and moved <= alone else "alarm"
    known = {OUTSIDE_MAP: "outside", **dict.fromkeys(NO_HEALTH, "open")}
    # Without parameters no alarm is all that logs can show.
    sound = ("healthy",) if assessment.stage.parameters else ("healthy", "no-alarm")
    known |= dict.fromkeys(sound, "healthy")
    found = known.get(verdict, "loss")
    if assessment.drifted or (assessment.left_out and found in ("healthy", "open")):
        return "drift"
    return "repair" if assessment.left_out and found == "loss" else found


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


# Summaries

State = Literal["good", "bad", "open"]
Postponed = tuple[tuple[date, int | None, tuple[float, float]], ...]
"""Days of a postponed service, weeks late (or None), and bounds of the risk."""

_KM = 1000.0


@dataclass(frozen=True, slots=True)
class ParameterHealth:
    """A health parameter now."""

    name: str
    determined: bool  # whether the data determine it; else its interval is mostly the prior
    informed: float  # as `Health.informed`
    low: float  # low, median, high: 5, 50 and 95 % quantiles, as fractions of the baseline
    median: float
    high: float
    limit: float | None  # as a fraction of the baseline
    below_limit: float  # probability of being below the limit; NaN without one
    baseline: float = 1.0  # baseline, unit: baseline value with its unit; "" for a pure fraction
    unit: str = ""
    # Odometer in m, low, median and high of some epochs, in order; empty if not determined.
    course: tuple[tuple[float, ...], ...] = ()


@dataclass(frozen=True, slots=True)
class LimitLife:
    """Remaining life until one limit, quantiles at `constants.RUL_LEVELS`."""

    parameter: str  # of the limit; ``any`` for the first limit reached
    limit: float  # limit, baseline: in the unit of the parameter; the limit of ``any`` is NaN
    baseline: float
    # travel, days: in m and days, at least 0, infinite beyond the horizon.
    travel: tuple[float, ...]
    days: tuple[float, ...]
    dates: tuple[date | None, ...]  # days of the calendar; None beyond the horizon or the calendar
    already_past: float  # already_past, beyond_horizon: probabilities
    beyond_horizon: float

    @property
    def name(self) -> str:
        """Name of the limit in words."""
        return "any limit" if self.parameter == "any" else spell(self.parameter)

    @property
    def share(self) -> float:
        """Limit as a fraction of the baseline."""
        return self.limit / self.baseline


@dataclass(frozen=True, slots=True)
class Life:
    """Remaining life of a machine in a few numbers."""

    stage: str  # stage, recorded_at: identity of the machine, and its last log
    recorded_at: datetime
    # travel, horizon: odometer at the last log, and travel from there beyond which nothing is
    # claimed, in m.
    travel: float
    horizon: float
    limits: tuple[LimitLife, ...]  # one per limit, then any
    laws: tuple[LawWeight, ...]
    # Parameters with a limit that the modes do not determine: excluded.
    undetermined: tuple[str, ...]
    calibration: Calibration | None = None  # by the ended lives of the fleet
    restored: tuple[str, ...] = ()  # parameters whose limits are left out: later work restored them

    @property
    def any(self) -> LimitLife:
        """The life until any limit."""
        return self.limits[-1]


@dataclass(frozen=True, slots=True)
class Summary:
    """A machine in a few numbers, for the fleet page, a terminal and later reports."""

    file: str  # its page, in the folder of the fleet page
    identity: str
    urgency: tuple[int, float, float, str]  # sort key, most urgent first
    recorded_at: datetime  # recorded_at, baseline_at: the last log, and that at the baseline
    baseline_at: datetime
    description: str  # digest of the stage description
    n_logs: int
    travel: float  # odometer at the last log in m, NaN without one
    state: State  # ``good``, ``bad`` or ``open`` (no clear verdict)
    alarmed: tuple[str, ...]  # as `Assessment.alarmed`
    lost: tuple[str, ...]  # parameters that the verdict reports as degraded
    verdict: str  # verdict, probability, why: as in `Verdict`
    probability: float
    why: str
    health: tuple[ParameterHealth, ...]
    life: Life | None
    service: Service
    step: NextStep
    # Modes, or ``all``, in which the last log is left out: the verdict is that before it.
    deviates: tuple[str, ...] = ()
    postponed: Postponed = ()
    # Day that it is of; `status.on_day` sets it, and what depends on it.
    today: date | None = None
    unknown: bool = False  # whether its last log is too old for the verdict that it allows


def summarise(assessment: Assessment, service: Service, file: str = "") -> Summary:
    """Summarise an assessment, with its page and its service.

    Limits that later work has restored are left out, unless these are all.
    """
    judgement, history, life = assessment.judgement, assessment.history, None
    prognosis = assessment.limits_left or assessment.prognosis
    if prognosis is not None:
        of_fleet, whole = assessment.calibration, assessment.prognosis
        life = summarise_life(prognosis, assessment.stage, of_fleet, whole)
    healthy: State = "open" if assessment.left_out else "good"  # until a jump is confirmed or not
    states: dict[str, State] = {"healthy": healthy, OUTSIDE_MAP: "open"}
    states |= dict.fromkeys(NO_HEALTH, "open")
    state = "bad" if assessment.alarmed else states.get(judgement.verdict, "bad")
    words = degraded_words(judgement.verdict)
    lost = [spec.name for spec in assessment.stage.parameters if spec.word in words]
    modes, deviates = assessment.track.modes if assessment.track else (), (*assessment.left_out,)
    if set(modes) == {*deviates}:
        deviates = ("all",)
    step = next_step(assessment, service)
    if step.kind == "see-effect":  # the day was that of the state before the work
        service = decide(None, assessment.stage.description.decision)
    return Summary(
        file=file,
        identity=judgement.stage,
        urgency=assessment.urgency(service),
        recorded_at=judgement.recorded_at,
        baseline_at=[*history.recorded_at, judgement.recorded_at][history.baseline],
        description=assessment.stage.digest,
        n_logs=len(history.logs),
        travel=float(history.travel[-1]) if history.logs else np.nan,
        state=state,
        alarmed=assessment.alarmed,
        lost=tuple(lost or words),
        verdict=judgement.verdict,
        probability=judgement.probability,
        why=judgement.why,
        health=tuple(_parameters(assessment)),
        life=life,
        service=service,
        step=step,
        deviates=deviates if judgement.probability >= 0 else (),
        postponed=_postponed(prognosis, service),
    )


def _postponed(prognosis: Prognosis | None, service: Service) -> Postponed:
    """Return the days and risks of a postponed service."""
    if prognosis is None or service.by is None:
        return ()
    wait = max(service.wait, 0.0)
    days = ((weeks, day_after(prognosis, wait + 7 * weeks)) for weeks in constants.POSTPONED_WEEKS)
    return tuple((day, weeks or None, risk_before(prognosis, day)) for weeks, day in days if day)


def summarise_life(
    prognosis: Prognosis,
    stage: Stage,
    calibration: Calibration | None = None,
    whole: Prognosis | None = None,
) -> Life:
    """Summarise a prognosis: quantiles and probabilities of every limit, and of any."""
    baselines = {spec.name: spec.baseline for spec in stage.parameters}
    past, beyond = prognosis.already_past(), prognosis.beyond_horizon()
    travel, days = np.maximum(prognosis.censored(), 0), np.maximum(remaining_days(prognosis), 0)
    waits = [quantiles(own) for own in days.T]
    limits = [
        LimitLife(
            parameter=name,
            limit=float(prognosis.limits[k]),
            baseline=baselines.get(name, 1.0),
            travel=quantiles(travel[:, k]),
            days=waits[k],
            dates=tuple(day_after(prognosis, one) for one in waits[k]),
            already_past=float(past[k]),
            beyond_horizon=float(beyond[k]),
        )
        for k, name in enumerate(prognosis.parameters)
    ]
    return Life(
        stage=prognosis.stage,
        recorded_at=prognosis.recorded_at,
        travel=prognosis.travel,
        horizon=prognosis.horizon,
        limits=tuple(limits),
        laws=prognosis.laws,
        undetermined=prognosis.unidentifiable,
        calibration=calibration,
        restored=tuple(n for n in (whole or prognosis).parameters if n not in prognosis.parameters),
    )


def quantiles(
    values: FloatArray, levels: tuple[float, ...] = constants.RUL_LEVELS
) -> tuple[float, ...]:
    """Return quantiles of draws, shape ``(n_draws,)``, that may be infinite: each is a draw."""
    return tuple(np.quantile(values, levels, method="inverted_cdf").tolist())


def limit_of(spec: ParameterSpec) -> float | None:
    """Return the limit of a parameter as a fraction of its baseline; None without one."""
    return None if spec.limit is None else spec.limit.below / spec.baseline


def _parameters(assessment: Assessment) -> Iterator[ParameterHealth]:
    health = assessment.latest_health
    if health is None:
        return
    n = len(health.travel)
    rows = np.unique(np.linspace(0, n - 1, constants.COURSE_POINTS).round().astype(int))
    # Without an odometer the epochs are at equal distances.
    at = health.travel if np.isfinite(health.travel).all() else np.arange(n)
    for k, spec in enumerate(assessment.stage.parameters):
        limit, draws = limit_of(spec), health.samples[-1, :, k]
        low, median, high = np.quantile(draws, constants.LEVELS).tolist()
        determined = bool(health.publishable_parameters()[k])
        bands = np.quantile(health.samples[rows, :, k], constants.LEVELS, axis=1)
        course = np.stack([at[rows], *bands], axis=1).round(4)
        yield ParameterHealth(
            name=spec.name,
            determined=determined,
            informed=float(health.informed[-1, k]),
            low=low,
            median=median,
            high=high,
            limit=limit,
            below_limit=np.nan if limit is None else float(np.mean(draws < limit)),
            baseline=spec.baseline,
            unit=spec.unit,
            course=tuple(map(tuple, course.tolist())) if determined else (),
        )


def prognosis_rows(
    life: Life, service: Service, before: tuple[date, FloatArray] | None = None
) -> list[Row]:
    """Return a remaining life, one row per limit and one for any, which has the service.

    ``before`` is a day with the probabilities that a limit is reached before it: extra columns.
    """
    fleet = life.calibration
    of_any = (
        *(service.kind, service.by, service.risk, service.inspect_by),
        *(finite_or_none(service.inspect_every / _KM), service.earliest_end),
        finite_or_none(fleet.travel / _KM) if fleet else None,
        *((fleet.coverage, fleet.n_lives) if fleet else (None, None)),
    )
    rows = []
    for j, one in enumerate(life.limits):
        days = np.array(one.days)
        quantiles = np.concatenate([np.array(one.travel) / _KM, 24 * days, days]).tolist()
        pairs = zip(constants.RUL_LEVELS, one.days, strict=True)
        row = TABLES["prognosis"].row(
            *(life.stage, one.parameter, one.limit),
            *(None if np.isinf(value) else value for value in quantiles),
            next((level for level, wait in pairs if np.isinf(wait)), None),
            *(one.beyond_horizon, one.already_past),
            *(of_any if one.parameter == "any" else [None] * len(of_any)),
        )
        if before is not None:
            day, reached = before
            at_least, at_most = reached[:, j]
            row |= {"before": day, "probability_at_least": at_least, "probability_at_most": at_most}
        rows.append(row)
    return rows
