"""Changes of a machine from one report to the next."""

from collections.abc import Iterator
from datetime import date

from lmshealth.report import text
from lmshealth.report.assessment import Summary, verdict_text
from lmshealth.report.text import GAP, percent, probability, travel_left
from lmshealth.stage.description import ParameterSpec


def changes(before: Summary, now: Summary, parameters: tuple[ParameterSpec, ...]) -> Iterator[str]:
    """Describe in sentences what changed since an earlier report on a machine.

    Reasons why the reports cannot be compared come first.
    """
    if before.description != now.description:
        yield "The stage description has changed: not all differences are wear."
    if before.baseline_at != now.baseline_at:
        yield (
            f"The baseline has changed from {text.day(before.baseline_at)} to "
            f"{text.day(now.baseline_at)}: percentages of the two reports cannot be compared."
        )
    was, present = (
        verdict_text(one.verdict, parameters) + text.in_brackets(one.probability)
        for one in (before, now)
    )
    if before.verdict != now.verdict:
        yield f"Verdict: {was} → {present}."
    elif was == present:
        yield f"Verdict: still {present}."
    else:
        yield f"Verdict: still {present}, before {probability(before.probability)}."
    yield from _health(before, now)
    if before.life is not None or now.life is not None:
        yield _life(before, now)
    if before.service.by is not None or now.service.by is not None:
        yield _service(before.service.by, now.service.by)
    more, travel = now.n_logs - before.n_logs, now.travel - before.travel
    logs = f"{abs(more)} log{_s(more)} {'more' if more > 0 else 'fewer'}" if more else ""
    further = f", {text.km(travel)} further." if travel > 0 else "."
    yield (logs or "Same number of logs") + further


def _health(before: Summary, now: Summary) -> Iterator[str]:
    was, present = (
        {one.name: one for one in summary.health if one.determined} for summary in (before, now)
    )
    for name in dict.fromkeys((*present, *was)):
        medians = [
            percent(found[name].median, 0) if name in found else "not determined"
            for found in (was, present)
        ]
        own = present.get(name)
        spread = f" (90{GAP}%: {text.interval(own.low, own.high)})" if own else ""
        yield f"{text.spell(name).capitalize()}: {' → '.join(medians)}{spread}."


def _life(before: Summary, now: Summary) -> str:
    low, middle, high = (
        [
            travel_left(life.any.travel[k], life.horizon) if life else "not known"
            for life in (before.life, now.life)
        ]
        for k in (0, 3, 6)  # quantiles of 5, 50 and 95 %
    )
    spread = f" (90{GAP}%: {low[1]} to {high[1]})" if now.life else ""
    return f"Remaining life, median: {_from_to(*middle)}{spread}."


def _service(before: date | None, now: date | None) -> str:
    shift = ""
    if before and now and before != now:
        later = (now - before).days
        shift = f", {abs(later)} day{_s(later)} {'later' if later > 0 else 'earlier'}"
    days = [one.isoformat() if one else "none" for one in (before, now)]
    return f"Service date: {_from_to(*days)}{shift}."


def _from_to(before: str, now: str) -> str:
    return f"still {now}" if before == now else f"{before} → {now}"


def _s(count: int) -> str:
    return "" if abs(count) == 1 else "s"
