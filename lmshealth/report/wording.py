"""Wording of a summary: headline, next step, and changes since the last report."""

from collections.abc import Iterator
from datetime import date

from lmshealth.life.verdict import OUTSIDE_MAP
from lmshealth.machine.summary import NextStep, Summary
from lmshealth.report.language import mark, tr
from lmshealth.report.text import (
    GAP,
    age,
    capitalize,
    count,
    day,
    ends,
    in_brackets,
    interval,
    joined,
    km,
    percent,
    probability,
    service_text,
    spell,
    travel_left,
)


def verdict_text(summary: Summary) -> str:
    """Return a verdict in words, with the parameters as the description names them."""
    texts = {
        "healthy": tr("healthy"),
        "alarm": tr("alarm of the modes"),
        "no-alarm": tr("modes tracked, no alarm"),
        "not-enough-data": tr("not enough data for a verdict"),
        "step": tr("sudden change without a known cause"),
        OUTSIDE_MAP: tr("a mode moved alone, by a cause outside the map"),
    }
    return texts.get(summary.verdict) or tr(
        "loss of {names}", names=joined(map(spell, summary.lost))
    )


def headline(summary: Summary) -> str:
    """Return the verdict in words, or the alarm when there is no verdict.

    A verdict whose last log is too old is that of then: the machine is unknown since.
    """
    if summary.unknown:
        since = summary.recorded_at.date()
        past = age(since, summary.today or since)
        return tr("Unknown since {day}: {past}", day=day(since), past=past)
    if summary.verdict == "healthy" and summary.step.kind in ("service-now", "overdue"):
        return tr("Healthy at the last log, but the service is due")
    if summary.alarmed:
        return tr("Alarm: unexplained change of {names}", names=joined(map(spell, summary.alarmed)))
    words = verdict_text(summary)
    return words[0].upper() + words[1:]


def service_on_day(summary: Summary) -> str:
    """Return when to service a machine, as of the day of its summary, in a few words."""
    by = summary.service.by
    if summary.service.kind == "by" and by and summary.today and by < summary.today:
        return tr("overdue since {day}", day=day(by))
    if summary.service.kind == "later" and summary.unknown:
        return tr("unknown without a log")
    if summary.service.kind == "later" and summary.step.kind in ("inspect", "find-cause"):
        return tr("open until the cause is found")
    return service_text(summary.service)


# Work that restores a parameter; of any other: work on it.
_WORK = {"preload": mark("a preload adjustment"), "mount": mark("a tightening of the mount")}
# Sentence of each step, of the work, the day of the service and how often to record a log.
_STEPS = {
    "inspect": mark(
        "Inspect guide and mount now, and look for work, loads or tunings that the logs lack; then "
        "record a log."
    ),
    "find-cause": mark(
        "Find out what moved the mode: its sensor, cables, payload or attachments; then record a "
        "log."
    ),
    "check-drift": mark(
        "Record a log at once: a mode has moved by more than logs scatter. If it stays, look for "
        "work, payload, sensor or tuning as the cause."
    ),
    "log-now": mark(
        "Record a log now: it is overdue, and the state since the last one is unknown."
    ),
    "none": "",
    "record": mark("Record further logs; the reasons are below."),
    "service-now": mark(
        "Do {work} now, before the machine travels on, and record logs for a new baseline."
    ),
    "overdue": mark("Do {work} now: its date, {by}, has passed. Record logs for a new baseline."),
    "confirm": mark(
        "Record {often}, and order nothing yet: with so few logs the service before {by} rests on "
        "the prior of the laws."
    ),
    "schedule": mark(
        "No work is needed yet. Plan {work} for {by} at the latest; until then {often}."
    ),
    "plan": mark("Order and plan {work} before {by}; until then {often}."),
    "later": mark("No service is needed within {horizon}; record {often}."),
}


def next_step(step: NextStep) -> str:
    """Return what to do next in a sentence."""
    known = _WORK.get(step.word)
    work = tr(known) if known else tr("work on {name}", name=spell(step.parameter))
    by = "" if step.by is None else day(step.by)
    often, horizon = _often(step.log_every), km(step.horizon)
    return tr(_STEPS[step.kind], work=work, by=by, often=often, horizon=horizon)


def _often(days: float) -> str:
    """Return how often to record a log."""
    if days < 2:
        return tr("a log a day")
    if days < 14:
        return tr("a log a week") if 7 <= days < 8 else tr("a log every {n} days", n=int(days))
    return tr("a log every {n} weeks", n=int(min(days, 182) // 7))


# Changes since the last report


def changes(before: Summary, now: Summary) -> Iterator[str]:
    """Describe in sentences what changed since an earlier report on a machine.

    Reasons why the reports cannot be compared come first.
    """
    if before.description != now.description:
        yield tr("The stage description has changed: not all differences are wear.")
    if before.baseline_at != now.baseline_at:
        yield tr(
            "The baseline has changed from {before} to {now}: percentages of the two reports "
            "cannot be compared.",
            before=day(before.baseline_at),
            now=day(now.baseline_at),
        )
    was, present = (verdict_text(one) + in_brackets(one.probability) for one in (before, now))
    if before.verdict != now.verdict:
        yield tr("Verdict: {before} → {now}.", before=was, now=present)
    elif was == present:
        yield tr("Verdict: still {now}.", now=present)
    else:
        earlier = probability(before.probability)
        yield tr("Verdict: still {now}, before {probability}.", now=present, probability=earlier)
    yield from _health_changes(before, now)
    if before.life is not None or now.life is not None:
        yield _life_change(before, now)
    if before.service.by is not None or now.service.by is not None:
        yield _service_change(before.service.by, now.service.by)
    more, travel = now.n_logs - before.n_logs, now.travel - before.travel
    logs = count(abs(more), "log")
    if more:
        logs = tr("{logs} more", logs=logs) if more > 0 else tr("{logs} fewer", logs=logs)
    else:
        logs = tr("Same number of logs")
    yield logs + (tr(", {distance} further.", distance=km(travel)) if travel > 0 else ".")


def _health_changes(before: Summary, now: Summary) -> Iterator[str]:
    was, present = (
        {one.name: one for one in summary.health if one.determined} for summary in (before, now)
    )
    for name in dict.fromkeys((*present, *was)):
        medians = [
            percent(found[name].median, 0) if name in found else tr("not determined")
            for found in (was, present)
        ]
        own = present.get(name)
        spread = f" (90{GAP}%: {interval(own.low, own.high)})" if own else ""
        yield f"{capitalize(spell(name))}: {' → '.join(medians)}{spread}."


def _life_change(before: Summary, now: Summary) -> str:
    low, middle, high = (
        [
            travel_left(life.any.travel[k], life.horizon) if life else tr("not known")
            for life in (before.life, now.life)
        ]
        for k in (0, 3, 6)  # quantiles of 5, 50 and 95 %
    )
    spread = f" (90{GAP}%: {ends(low[1], high[1])})" if now.life else ""
    return tr("Remaining life, median: {change}.", change=f"{_from_to(*middle)}{spread}")


def _service_change(before: date | None, now: date | None) -> str:
    shift = ""
    if before and now and before != now:
        n = (now - before).days
        days = count(abs(n), "day")
        shift = tr(", {days} later", days=days) if n > 0 else tr(", {days} earlier", days=days)
    days_ = [day(one) if one else tr("none") for one in (before, now)]
    return tr("Service date: {change}.", change=f"{_from_to(*days_)}{shift}")


def _from_to(before: str, now: str) -> str:
    return tr("still {now}", now=now) if before == now else f"{before} → {now}"
