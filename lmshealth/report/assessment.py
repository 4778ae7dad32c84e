"""Results of one machine (`Assessment`), and their summary in a few numbers (`Summary`)."""

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import date, datetime
from typing import Literal

import numpy as np

from lmshealth.io.log import Notice, Refusal
from lmshealth.life.fleet_prior import Calibration, EndedLife, FleetPrior, MachineEvidence
from lmshealth.life.health import Health
from lmshealth.life.maintenance_decision import Service, day_after, decide, remaining_days
from lmshealth.life.prognosis import LawWeight, Prognosis
from lmshealth.life.verdict import (
    NO_HEALTH,
    OUTSIDE_MAP,
    Verdict,
    degraded_words,
    undeclared_events,
)
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.modal.spectra_summary import Waterfall
from lmshealth.report import constants
from lmshealth.report.text import (
    GAP,
    count,
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
from lmshealth.stage.description import ParameterSpec, Stage
from lmshealth.tracking.history import History
from lmshealth.tracking.track import Track

State = Literal["good", "bad", "open"]


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Assessment:
    """All results of one machine, as far as its data carry them."""

    stage: Stage  # description that the logs were analysed with
    history: History  # history, judgement: modal estimates of all logs, and the verdict
    digests: tuple[str, ...]  # SHA-256 of each log of the history
    track: Track | None  # none without an estimate of a tracked mode
    health: Health | None  # none without a health parameter, or with too few logs
    prognosis: Prognosis | None  # none without health, or without a limit
    judgement: Verdict
    refused: tuple[Refusal, ...]  # everything of this machine that was not analysed
    notices: tuple[Notice, ...]  # about logs and maintenance; `report.notices` adds the others
    seed: int  # seed of all random streams
    # Spectra of the logs of the history; None when no log covers the band of the modes.
    waterfall: Waterfall | None = None
    # Estimates of the last log, and of the first one of the baseline.
    latest: LogEstimates | None = None
    at_baseline: LogEstimates | None = None
    # Evidence for the fleet prior; None without a posterior of the life.
    evidence: MachineEvidence | None = None
    # Fleet prior of the prognosis; None when it rests on the prior of the description.
    fleet: FleetPrior | None = None
    # Lives before the present baseline, and what those of the fleet support; None with too few.
    ended: tuple[EndedLife, ...] = ()
    calibration: Calibration | None = None
    doubt: str = ""  # why the names of the modes are in doubt; then there is no health

    def __repr__(self) -> str:
        judged, service = self.judgement, self.service()
        at = f"{judged.recorded_at.date()}: {judged.verdict}"
        lines = [f"Assessment of {judged.stage} at {at}", judged.why]
        lines += [f"Service: {service.kind} {service.by or ''}".rstrip()] * bool(self.prognosis)
        parts = ("history", "track", "health", "prognosis")
        there = ", ".join(name for name in parts if getattr(self, name) is not None)
        lines.append(f"{len(self.history.logs)} logs, {len(self.refused)} refusals; with {there}")
        return "\n".join(lines)

    def service(self) -> Service:
        """Choose the day of the service by the rule of the description."""
        return decide(self.prognosis, self.stage.description.decision)

    @property
    def alarmed(self) -> tuple[str, ...]:
        """Modes with an alarm since the baseline, when no verdict explains it."""
        if self.judgement.verdict not in NO_HEALTH:
            return ()
        alarms = undeclared_events(self.track, self.history.baseline, "alarm")
        return tuple(dict.fromkeys(event.mode for event in alarms))

    @property
    def compared(self) -> LogEstimates | None:
        """The first log of the baseline, beside which the last is shown; None if it is the last."""
        latest, before = self.latest, self.at_baseline
        return before if latest and before and before.log != latest.log else None

    @property
    def latest_health(self) -> Health | None:
        """The health as fractions of the baseline, if it has an epoch and a parameter."""
        health = self.health
        if health is None or not (health.recorded_at and health.parameters):
            return None
        return health.relative_to(np.array([spec.baseline for spec in self.stage.parameters]))

    def urgency(self, service: Service) -> tuple[int, float, float, str]:
        """Return a sort key: days until the service; without a verdict before safe machines."""
        identity, verdict = self.judgement.stage, self.judgement.verdict
        if verdict in NO_HEALTH:
            return (0 if self.alarmed else 1), 0.0, 0.0, identity
        if verdict == OUTSIDE_MAP:
            return 1, 0.0, 0.0, identity
        if self.prognosis is None:
            return (1 if verdict == "healthy" else 0), 0.0, 0.0, identity
        days = service.wait
        group = 2 if verdict == "healthy" and np.isinf(days) else 0
        return group, days, float(self.prognosis.beyond_horizon()[-1]), identity


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
    state: State  # ``good``, ``bad`` or ``open`` (no verdict)
    headline: str  # the verdict in words
    verdict: str  # verdict, probability, why: as in `Verdict`
    probability: float
    why: str
    health: tuple[ParameterHealth, ...]
    life: Life | None
    service: Service
    to_do: str = ""  # the next step in a sentence


def summarise(assessment: Assessment, service: Service, file: str = "") -> Summary:
    """Summarise an assessment, with its page and the result of `Assessment.service`."""
    judgement, prognosis = assessment.judgement, assessment.prognosis
    history, of_fleet = assessment.history, assessment.calibration
    states: dict[str, State] = {"healthy": "good", OUTSIDE_MAP: "open"}
    states |= dict.fromkeys(NO_HEALTH, "open")
    state = "bad" if assessment.alarmed else states.get(judgement.verdict, "bad")
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
        headline=_headline(assessment),
        verdict=judgement.verdict,
        probability=judgement.probability,
        why=judgement.why,
        health=tuple(_parameters(assessment)),
        life=summarise_life(prognosis, assessment.stage, of_fleet) if prognosis else None,
        service=service,
        to_do=_next_step(assessment, service, state),
    )


def summarise_life(
    prognosis: Prognosis, stage: Stage, calibration: Calibration | None = None
) -> Life:
    """Summarise a prognosis: quantiles and probabilities of every limit, and of any."""
    baselines = {spec.name: spec.baseline for spec in stage.parameters}
    past, beyond = prognosis.already_past(), prognosis.beyond_horizon()
    travel, days = np.maximum(prognosis.censored(), 0), np.maximum(remaining_days(prognosis), 0)
    limits = []
    for k, name in enumerate(prognosis.parameters):
        baseline = baselines.get(name, 1.0)
        wait = quantiles(days[:, k], constants.RUL_LEVELS)
        limits.append(
            LimitLife(
                parameter=name,
                limit=float(prognosis.limits[k]),
                travel=quantiles(travel[:, k], constants.RUL_LEVELS),
                days=wait,
                dates=tuple(day_after(prognosis, one) for one in wait),
                already_past=float(past[k]),
                beyond_horizon=float(beyond[k]),
                baseline=baseline,
            )
        )
    return Life(
        stage=prognosis.stage,
        recorded_at=prognosis.recorded_at,
        travel=prognosis.travel,
        horizon=prognosis.horizon,
        limits=tuple(limits),
        laws=prognosis.laws,
        undetermined=prognosis.unidentifiable,
        calibration=calibration,
    )


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


def limit_of(spec: ParameterSpec) -> float | None:
    """Return the limit of a parameter as a fraction of its baseline; None without one."""
    return None if spec.limit is None else spec.limit.below / spec.baseline


def verdict_text(verdict: str, parameters: tuple[ParameterSpec, ...]) -> str:
    """Return a verdict in words, with the parameters as the description names them."""
    texts = {
        "healthy": "healthy",
        "alarm": "alarm of the modes",
        "no-alarm": "modes tracked, no alarm",
        "not-enough-data": "not enough data for a verdict",
        "step": "sudden change without a known cause",
        OUTSIDE_MAP: "a mode moved alone, by a cause outside the map",
    }
    lost = degraded_words(verdict)
    names = [spell(spec.name) for spec in parameters if spec.word in lost]
    return texts.get(verdict, f"loss of {' and '.join(names or map(spell, lost))}")


def _headline(assessment: Assessment) -> str:
    """Return the verdict in words, or the alarm when there is no verdict."""
    verdict, parameters = assessment.judgement.verdict, assessment.stage.parameters
    if assessment.alarmed:
        return f"Alarm: unexplained change of {' and '.join(map(spell, assessment.alarmed))}"
    words = verdict_text(verdict, parameters)
    return words[0].upper() + words[1:]


# Work that restores a parameter; of any other: work on it.
_WORK = {"preload": "a preload adjustment", "mount": "a tightening of the mount"}


def _next_step(assessment: Assessment, service: Service, state: State) -> str:
    """Return what to do next in a sentence."""
    prognosis, verdict = assessment.prognosis, assessment.judgement.verdict
    if assessment.alarmed or verdict == "step":
        what = "Inspect guide and mount now, and look for work, loads or tunings that the logs lack"
        return f"{what}; then record a log."
    if verdict == OUTSIDE_MAP:
        return "Find out what moved the mode: " + (
            "its sensor, cables, payload or attachments; then record a log."
        )
    if prognosis is None or service.kind == "unknown":
        return "" if state == "good" else "Record further logs; the reasons are below."
    first = first_limit(prognosis)
    name = first[0] if first else prognosis.parameters[0]
    words = {spec.name: spec.word for spec in assessment.stage.parameters}
    work = _WORK.get(words.get(name, ""), f"work on {spell(name)}")
    every = service.inspect_every / float(np.median(prognosis.usage))
    if service.kind == "now":
        return f"Do {work} now, before the machine travels on, and record logs for a new baseline."
    if service.kind == "by" and service.by is not None:
        return f"Order and plan {work} before {service.by.isoformat()}; until then {_often(every)}."
    return f"No service is needed within {km(prognosis.horizon)}; record {_often(every)}."


def _often(days: float) -> str:
    """Return how often to record a log."""
    if days < 2:
        return "a log a day"
    if days < 14:
        return "a log a week" if 7 <= days < 8 else f"a log every {int(days)} days"
    return f"a log every {int(min(days, 182) // 7)} weeks"


def _parameters(assessment: Assessment) -> Iterator[ParameterHealth]:
    health = assessment.latest_health
    if health is None:
        return
    for k, spec in enumerate(assessment.stage.parameters):
        limit, draws = limit_of(spec), health.samples[-1, :, k]
        below = np.nan if limit is None else float(np.mean(draws < limit))
        low, median, high = np.quantile(draws, constants.LEVELS).tolist()
        determined = bool(health.publishable_parameters()[k])
        rows = np.linspace(0, len(health.travel) - 1, constants.COURSE_POINTS).round().astype(int)
        rows = np.unique(rows)
        bands = np.quantile(health.samples[rows, :, k], constants.LEVELS, axis=1)
        # Without an odometer the epochs are at equal distances.
        at = health.travel if np.isfinite(health.travel).all() else np.arange(len(health.travel))
        course = np.stack([at[rows], *bands], axis=1).round(4)
        yield ParameterHealth(
            name=spec.name,
            determined=determined,
            informed=float(health.informed[-1, k]),
            low=low,
            median=median,
            high=high,
            limit=limit,
            below_limit=below,
            baseline=spec.baseline,
            unit=spec.unit,
            course=tuple(map(tuple, course.tolist())) if determined else (),
        )


# Changes since the last report


def changes(before: Summary, now: Summary, parameters: tuple[ParameterSpec, ...]) -> Iterator[str]:
    """Describe in sentences what changed since an earlier report on a machine.

    Reasons why the reports cannot be compared come first.
    """
    if before.description != now.description:
        yield "The stage description has changed: not all differences are wear."
    if before.baseline_at != now.baseline_at:
        yield (
            f"The baseline has changed from {day(before.baseline_at)} to {day(now.baseline_at)}: "
            "percentages of the two reports cannot be compared."
        )
    was, present = (
        verdict_text(one.verdict, parameters) + in_brackets(one.probability)
        for one in (before, now)
    )
    if before.verdict != now.verdict:
        yield f"Verdict: {was} → {present}."
    elif was == present:
        yield f"Verdict: still {present}."
    else:
        yield f"Verdict: still {present}, before {probability(before.probability)}."
    yield from _health_changes(before, now)
    if before.life is not None or now.life is not None:
        yield _life_change(before, now)
    if before.service.by is not None or now.service.by is not None:
        yield _service_change(before.service.by, now.service.by)
    more, travel = now.n_logs - before.n_logs, now.travel - before.travel
    logs = f"{count(abs(more), 'log')} {'more' if more > 0 else 'fewer'}" if more else ""
    further = f", {km(travel)} further." if travel > 0 else "."
    yield (logs or "Same number of logs") + further


def _health_changes(before: Summary, now: Summary) -> Iterator[str]:
    was, present = (
        {one.name: one for one in summary.health if one.determined} for summary in (before, now)
    )
    for name in dict.fromkeys((*present, *was)):
        medians = [
            percent(found[name].median, 0) if name in found else "not determined"
            for found in (was, present)
        ]
        own = present.get(name)
        spread = f" (90{GAP}%: {interval(own.low, own.high)})" if own else ""
        yield f"{spell(name).capitalize()}: {' → '.join(medians)}{spread}."


def _life_change(before: Summary, now: Summary) -> str:
    low, middle, high = (
        [
            travel_left(life.any.travel[k], life.horizon) if life else "not known"
            for life in (before.life, now.life)
        ]
        for k in (0, 3, 6)  # quantiles of 5, 50 and 95 %
    )
    spread = f" (90{GAP}%: {low[1]} to {high[1]})" if now.life else ""
    return f"Remaining life, median: {_from_to(*middle)}{spread}."


def _service_change(before: date | None, now: date | None) -> str:
    shift = ""
    if before and now and before != now:
        later = (now - before).days
        shift = f", {count(abs(later), 'day')} {'later' if later > 0 else 'earlier'}"
    days = [one.isoformat() if one else "none" for one in (before, now)]
    return f"Service date: {_from_to(*days)}{shift}."


def _from_to(before: str, now: str) -> str:
    return f"still {now}" if before == now else f"{before} → {now}"
