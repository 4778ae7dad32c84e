"""Wording of a summary: headline, next step, and changes since the last report."""

from collections.abc import Iterator
from datetime import date

from lmshealth._private.names import spell
from lmshealth.life.verdict import OUTSIDE_MAP
from lmshealth.machine.next_step import NextStep
from lmshealth.machine.summary import Summary
from lmshealth.report.text import (
    GAP,
    age,
    count,
    day,
    in_brackets,
    interval,
    km,
    percent,
    probability,
    service_text,
    travel_left,
)


def verdict_text(summary: Summary) -> str:
    """Return a verdict in words, with the parameters as the description names them."""
    texts = {
        "healthy": "healthy",
        "alarm": "alarm of the modes",
        "no-alarm": "modes tracked, no alarm",
        "not-enough-data": "not enough data for a verdict",
        "step": "sudden change without a known cause",
        OUTSIDE_MAP: "a mode moved alone, by a cause outside the map",
    }
    lost = " and ".join(map(spell, summary.lost))
    return texts.get(summary.verdict, f"loss of {lost}")


def headline(summary: Summary) -> str:
    """Return the verdict in words, or the alarm when there is no verdict.

    A verdict whose last log is too old is that of then: the machine is unknown since.
    """
    if summary.unknown:
        since = summary.recorded_at.date()
        return f"Unknown since {since.isoformat()}: {age(since, summary.today or since)}"
    if summary.verdict == "healthy" and summary.step.kind in ("service-now", "overdue"):
        return "Healthy at the last log, but the service is due"
    if summary.alarmed:
        return f"Alarm: unexplained change of {' and '.join(map(spell, summary.alarmed))}"
    words = verdict_text(summary)
    return words[0].upper() + words[1:]


def service_on_day(summary: Summary) -> str:
    """Return when to service a machine, as of the day of its summary, in a few words."""
    by = summary.service.by
    if summary.service.kind == "by" and by and summary.today and by < summary.today:
        return f"overdue since {by.isoformat()}"
    if summary.service.kind == "later" and summary.unknown:
        return "unknown without a log"
    if summary.service.kind == "later" and summary.step.kind in ("inspect", "find-cause"):
        return "open until the cause is found"
    return service_text(summary.service)


# Work that restores a parameter; of any other: work on it.
_WORK = {"preload": "a preload adjustment", "mount": "a tightening of the mount"}
_INSPECT = (
    "Inspect guide and mount now, and look for work, loads or tunings that the logs lack; then "
    "record a log."
)
# Sentence of each step, of the work, the day of the service and how often to record a log.
_STEPS = {
    "inspect": _INSPECT,
    "find-cause": "Find out what moved the mode: its sensor, cables, payload or attachments; then "
    "record a log.",
    "check-drift": "Record a log at once: a mode has moved by more than logs scatter. If it stays, "
    "look for work, payload, sensor or tuning as the cause.",
    "log-now": "Record a log now: without one nothing is known of this machine.",
    "none": "",
    "record": "Record further logs; the reasons are below.",
    "service-now": "Do {work} now, before the machine travels on, and record logs for a new "
    "baseline.",
    "overdue": "Do {work} now: its date, {by}, has passed. Record logs for a new baseline.",
    "confirm": "Record {often}, and order nothing yet: with so few logs the service before {by} "
    "rests on the prior of the laws.",
    "schedule": "No work is needed yet. Plan {work} for {by} at the latest; until then {often}.",
    "plan": "Order and plan {work} before {by}; until then {often}.",
    "later": "No service is needed within {horizon}; record {often}.",
}


def next_step(step: NextStep) -> str:
    """Return what to do next in a sentence."""
    work = _WORK.get(step.word, f"work on {spell(step.parameter)}")
    by = "" if step.by is None else step.by.isoformat()
    often, horizon = _often(step.log_every), km(step.horizon)
    return _STEPS[step.kind].format(work=work, by=by, often=often, horizon=horizon)


def _often(days: float) -> str:
    """Return how often to record a log."""
    if days < 2:
        return "a log a day"
    if days < 14:
        return "a log a week" if 7 <= days < 8 else f"a log every {int(days)} days"
    return f"a log every {int(min(days, 182) // 7)} weeks"


# Changes since the last report


def changes(before: Summary, now: Summary) -> Iterator[str]:
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
    was, present = (verdict_text(one) + in_brackets(one.probability) for one in (before, now))
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
