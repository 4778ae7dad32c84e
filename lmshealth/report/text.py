"""Formats of numbers and names, and sentences of a summary; pages and terminals share them.

They are those of the language of `report.language`: English on terminals.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, date, datetime
from string import Formatter
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from lmshealth._private import tables
from lmshealth.io.log import utc_day
from lmshealth.report import constants
from lmshealth.report.language import decimal, mark, mark_either, sentence, tr, tr_day, tr_either

if TYPE_CHECKING:  # above, so that --help needs no scipy
    from lmshealth.machine.service import Service
    from lmshealth.machine.summary import Life, NextStep, Summary


_KM = 1000.0
GAP = "\u202f"  # narrow no-break space between a number and its unit, and between thousands
_UNITS = {"c": "°C", "kg": "kg", "mm": "mm", "db": "dB", "percent": "%"}

Number = float | np.floating[Any]

# Names in the shipped descriptions, and of covariates; conditions of a state by NAMUR NE 107, kinds
# of events and of spectral lines, and labels of the pictures of how-to-read.html.
_WORDS = (
    *(mark("guide preload"), mark("mount stiffness"), mark("any limit"), mark("roll")),
    *(mark("pitch"), mark("yaw"), mark("temperature"), mark("payload"), mark("position")),
    *(mark("limit reached"), mark("alarm"), mark("step"), mark("outside map"), mark("large drift")),
    *(mark("unreliable"), mark("loss"), mark("service due"), mark("no verdict"), mark("silent")),
    *(mark("no log since maintenance"), mark("inspection overdue"), mark("regreasing")),
    *(mark("unconfirmed jump"), mark("mains"), mark("reset"), mark("and"), mark("worn")),
    *(mark("epochs, 90 %"), mark("below"), mark("above"), mark("each epoch by itself")),
)
_COUNTED = {
    "log": mark_either("{n} log", "{n} logs"),
    "stage": mark_either("{n} stage", "{n} stages"),
    "day": mark_either("{n} day", "{n} days"),
    "week": mark_either("{n} week", "{n} weeks"),
}


def plain(text: str) -> str:
    """Return a text with ordinary blanks, for terminals."""
    return text.replace(GAP, " ")


def spell(name: str) -> str:
    """Return a name with blanks instead of underscores; those that are known are translated."""
    return tr(tables.spell(name))


def capitalize(text: str) -> str:
    """Begin a text with a capital letter."""
    return text[:1].upper() + text[1:]


def joined(parts: Iterable[str]) -> str:
    """Join names by the word for and."""
    return f" {tr('and')} ".join(parts)


def covariate(column: str) -> tuple[str, str]:
    """Split the column of a covariate into its name in words and its unit ("" if unknown)."""
    name, _, unit = column.rpartition("_")
    return (spell(name), _UNITS[unit]) if name and unit in _UNITS else (spell(column), "")


def law(kind: str) -> str:
    """Return the description of a degradation law."""
    from lmshealth.stage.degradation_laws import AnyLaw  # late: --help needs no scipy

    labels = {law.__struct_config__.tag: law.label for law in get_args(AnyLaw)}
    return sentence(str(labels.get(kind, kind)))


def reason_and_code(code: str) -> str:
    """Return the code of a refusal, with its words where they differ."""
    return code if tr(code) == code else f"{tr(code)} ({code})"


def day(when: date) -> str:
    """Format a day of the calendar, of a moment its day in UTC."""
    return tr_day(_day(when))


def moment(when: datetime) -> str:
    """Format date, time and zone."""
    return f"{tr_day(when)} {when:%H:%M %Z}".strip()


def utc_moment(when: datetime) -> str:
    """Format date and time in UTC, beside an age, which is counted in these days."""
    return moment(when.astimezone(UTC))


def age(last: date, today: date) -> str:
    """Return for how many days (UTC) there has been no log on a day; empty on that of the log."""
    n = (today - _day(last)).days
    if n < 1:
        return ""
    return tr_either("no log for {n} day", "no log for {n} days", n).format(n=_grouped(n))


def _day(when: date) -> date:
    return utc_day(when) if isinstance(when, datetime) else when


def number(value: Number, digits: int = 3) -> str:
    """Format a number with significant digits and grouped thousands; NaN is a dash."""
    if np.isnan(value):
        return "–"
    rounded = float(f"{value:.{digits}g}")
    if abs(rounded) < 10 ** (digits - 1):
        return decimal(f"{rounded:.{digits}g}".replace("-", "−"))
    return _grouped(rounded)


def _grouped(value: float) -> str:
    """Format a whole number with grouped thousands."""
    return f"{value:,.0f}".replace(",", GAP).replace("-", "−")


def count(n: int, noun: str) -> str:
    """Return a number with its noun, in the plural unless it is 1."""
    one, many = _COUNTED.get(noun, (f"{{n}} {noun}", f"{{n}} {noun}s"))
    return tr_either(one, many, n).format(n=_grouped(n))


def fixed(value: Number, digits: int) -> str:
    """Format a number with fixed decimals; NaN is a dash."""
    return "–" if np.isnan(value) else decimal(f"{value:.{digits}f}".replace("-", "−"))


def signed(value: Number, digits: int) -> str:
    """Format a number with its sign and fixed decimals."""
    return decimal(f"{value:+.{digits}f}".replace("-", "−"))


def percent(share: Number, digits: int | None = None) -> str:
    """Format a share in percent: fixed decimals, or three significant digits; NaN is a dash."""
    value = 100 * float(share)
    words = number(value) if digits is None else fixed(value, digits)
    return words if np.isnan(value) else f"{words}{GAP}%"


def share(value: Number, digits: int) -> str:
    """Format a share in percent with fixed decimals, without the sign."""
    return fixed(100 * value, digits)


def yes_or_no(value: object, yes: str = mark("yes"), no: str = mark("no")) -> str:
    """Format a flag."""
    return tr(yes if value else no)


def ends(low: str, high: str) -> str:
    """Join the ends of an interval."""
    return tr("{low} to {high}", low=low, high=high)


def interval(low: Number, high: Number) -> str:
    """Format an interval of shares in whole percent."""
    return ends(fixed(100 * low, 0), percent(high, 0))


def probability(value: float) -> str:
    """Format a probability in percent; draws cannot prove 0 or 1."""
    if value < constants.LEAST_PROBABILITY:
        return tr("below {value}", value=percent(constants.LEAST_PROBABILITY))
    if value > constants.LARGEST_PROBABILITY:
        return tr("above {value}", value=percent(constants.LARGEST_PROBABILITY))
    return percent(value, 0)


def in_brackets(value: float) -> str:
    """Format a probability behind a verdict; nothing where there is none."""
    return f" ({probability(value)})" if value >= 0 else ""


def probability_range(bounds: tuple[float, float]) -> str:
    """Format a probability that lies between two bounds."""
    at_least, at_most = bounds
    low, high = probability(at_least), probability(at_most)
    if low == high:
        return low
    if at_least < constants.LEAST_PROBABILITY:
        return tr("at most {value}", value=high)
    if at_most > constants.LARGEST_PROBABILITY:
        return tr("at least {value}", value=low)
    return ends(low, high)


def change(ln: Number, std: Number, digits: int = 2) -> str:
    """Format a change of a logarithm and its standard deviation as a relative change in percent."""
    value, spread = 100 * float(np.expm1(ln)), 100 * float(np.exp(ln)) * float(std)
    return f"{signed(value, digits)} ± {fixed(spread, digits)}{GAP}%"


def coarse(value: Number) -> str:
    """Format a number with three significant digits, two below 100."""
    return number(value, 3 if abs(float(value)) >= 100 else 2)


def km(metres: Number) -> str:
    """Format a distance given in m."""
    return f"{coarse(metres / _KM)}{GAP}km"


def whole_km(metres: Number) -> str:
    """Format a distance given in m to the kilometre."""
    return f"{_grouped(float(metres) / _KM)}{GAP}km"


def travel_left(metres: float, horizon: float) -> str:
    """Format a remaining travel in m; infinite stands for beyond the horizon (m)."""
    if np.isinf(metres):
        return tr("beyond {distance}", distance=km(horizon))
    return tr("already passed") if metres <= 0 else km(metres)


def time_left(days: float) -> str:
    """Format remaining days, with years from 1,000 on; infinite is beyond the horizon."""
    if np.isinf(days) or days <= 0:
        return tr("already passed") if days <= 0 else tr("beyond")
    text = coarse(days) + GAP + tr("days")
    years = tr("{n} years", n=fixed(days / 365.25, 1))
    return f"{text} ({years})" if days >= 1000 else text


def service_text(service: Service) -> str:
    """Return when to service, in a few words."""
    if service.by is not None and service.kind == "by":
        return tr("by {day}", day=day(service.by))
    return {"now": tr("now"), "later": tr("no service needed yet")}.get(service.kind, tr("no date"))


class _Cells(Formatter):
    """Format strings with functions of this module, as in ``{drift:change {drift_std}}``.

    Values are those of a mapping, a sequence or an object.
    """

    def get_value(self, key: Any, args: Any, kwargs: Any) -> Any:
        for values in args:
            if key in values:
                return values[key]
        named = isinstance(kwargs, Mapping) or isinstance(key, int)
        return kwargs[key] if named else getattr(kwargs, key)

    def format_field(self, value: Any, format_spec: str) -> Any:
        if value is None or value != value:  # NaN
            return "–"
        name, *options = format_spec.split() or [""]
        if function := globals().get(name):
            return function(value, *map(_option, options))
        text = format(value, format_spec)
        # without a format it may be an argument of another one
        return decimal(text) if format_spec and isinstance(value, float) else text


_FORMATTER = _Cells()


def _option(text: str) -> Any:
    """Read an argument of a format: digits, a number, or a word."""
    try:
        return int(text) if text.isdecimal() else float(text)
    except ValueError:
        return text


def view_columns(view: str, headings: Mapping[str, str | None] | None = None) -> dict[str, str]:
    """Split a view of a table (see `Table.shown`) into the formats of its cells, by heading.

    ``headings`` replace those of the view; a column under None is left out.
    """
    split = [column.partition("{") for column in view.split("|")]
    forms = {head.strip(): (start + rest).strip() for head, start, rest in split}
    shown = {head: (headings or {}).get(head, tr(head)) for head in forms}
    return {name: forms[head] for head, name in shown.items() if name is not None}


def first_field(form: str) -> str:
    """Return the name of the first value in a format."""
    return next(name for _, name, *_ in _FORMATTER.parse(form) if name)


def cells(
    columns: Mapping[str, str], rows: Iterable[Any], values: Mapping[str, Any] | None = None
) -> list[dict[str, str]]:
    """Format the rows of a table by `view_columns`, and values that are the same in all rows.

    A row is a mapping, a sequence or an object. A cell whose first value is missing is a dash.
    """
    common = [values or {}]

    def cell(form: str, row: Any) -> str:
        value, _ = _FORMATTER.get_field(first_field(form), common, row)
        return "–" if value is None or value != value else _FORMATTER.vformat(form, common, row)

    return [{head: cell(form, row) for head, form in columns.items()} for row in rows]


# Sentences of a summary


def verdict_text(summary: Summary) -> str:
    """Return a verdict in words, with the parameters as the description names them."""
    from lmshealth.life.verdict import OUTSIDE_MAP  # late, as above

    texts = {
        "healthy": tr("healthy"),
        "alarm": tr("alarm of the modes"),
        "no-alarm": tr("modes tracked, no alarm"),
        "not-enough-data": tr("not enough data for a verdict"),
        "step": tr("sudden change without a known cause"),
        OUTSIDE_MAP: tr("modes moved by a cause outside the map"),
    }
    if summary.step.partial and summary.life:
        names = joined(map(spell, summary.life.undetermined))
        texts["healthy"] = tr("healthy as far as the modes show, {names} not known", names=names)
    loss = tr("loss of {names}", names=joined(map(spell, summary.lost)))
    words = texts.get(summary.verdict, loss)
    if not summary.deviates:
        return words
    if summary.deviates == ("all",):
        return tr("{verdict} before the last log, which deviates", verdict=words)
    own = {"verdict": words, "names": joined(map(spell, summary.deviates))}
    return tr("{verdict} before the last log, which deviates in {names}", **own)


def headline(summary: Summary) -> str:
    """Return the verdict in words, or the alarm when there is no verdict.

    A verdict whose last log is too old is that of then: the machine is unknown since.
    """
    if summary.unknown:
        since = utc_day(summary.recorded_at)
        past = age(since, summary.today or since)
        return tr("Unknown since {day}: {past}", day=day(since), past=past)
    if summary.verdict == "healthy" and summary.step.kind in ("service-now", "overdue"):
        return tr("Healthy at the last log, but the service is due")
    if summary.alarmed:
        return tr("Alarm: unexplained change of {names}", names=joined(map(spell, summary.alarmed)))
    return capitalize(verdict_text(summary))


NONE_SHOWN = mark("none by what the modes show")
"""No service by limits of which the modes do not determine some."""


def service_on_day(summary: Summary) -> str:
    """Return when to service a machine, as of the day of its summary, in a few words."""
    by = summary.service.by
    if summary.step.kind == "see-effect":
        return tr("unknown without a log")
    if summary.service.kind == "by" and by and summary.today and by < summary.today:
        words = tr("overdue since {day}", day=day(by))
    else:
        words = service_text(summary.service)
    if summary.step.kind == "check-loss":
        return tr("{service}, unless it was repaired", service=words)
    if summary.service.kind != "later":
        return words
    if summary.unknown:
        return tr("unknown without a log")
    if summary.step.kind in ("inspect", "find-cause"):
        return tr("open until the cause is found")
    return tr(NONE_SHOWN) if summary.step.partial else words


# Work that restores a parameter; of any other: work on it.
_WORK = {"preload": mark("a preload adjustment"), "mount": mark("a tightening of the mount")}


def next_step(step: NextStep) -> str:
    """Return what to do next in a sentence."""
    work = joined(
        tr(_WORK[word]) if word in _WORK else tr("work on {name}", name=spell(name))
        for name, word in step.parts
    )
    by = "" if step.by is None else day(step.by)
    if step.kind == "check-loss":
        by = tr("now") if step.case[1] == "now" else tr("by {day}", day=by)
    # To a tenth of a day: a rate of usage gives no whole days.
    days, horizon = min(step.log_every + 0.1, 182), km(step.horizon)
    often = tr("a log every {n} weeks", n=int(days // 7))
    if days < 14:
        often = tr("a log every {n} days", n=int(days))
    if days < 2 or 7 <= days < 8:
        often = tr("a log a day") if days < 2 else tr("a log a week")
    in_part = step.partial and step.kind == "later"
    words = tables.STEPS["later-in-part" if in_part else step.kind]
    return tr(words, work=work, by=by, often=often, horizon=horizon)


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
        yield _life_change(before.life, now.life)
    if before.service.by is not None or now.service.by is not None:
        yield _service_change(before.service, now.service)
    more, travel = now.n_logs - before.n_logs, now.travel - before.travel
    logs = count(abs(more), "log")
    if more:
        logs = tr("{logs} more", logs=logs) if more > 0 else tr("{logs} fewer", logs=logs)
    elif before.recorded_at == now.recorded_at and before.service.by != now.service.by:
        logs = tr(
            "No further log: this follows from the fleet, from maintenance that was entered, or "
            "from another description, settings or version"
        )
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


def _life_change(before: Life | None, now: Life | None) -> str:
    low, middle, high = (
        [
            travel_left(life.any.travel[k], life.horizon) if life else tr("not known")
            for life in (before, now)
        ]
        for k in (0, 3, 6)  # quantiles of 5, 50 and 95 %
    )
    spread = f" (90{GAP}%: {ends(low[1], high[1])})" if now and low[1] != high[1] else ""
    limits = [{one.parameter for one in life.limits} for life in (before, now) if life]
    if len(limits) == 2 and limits[0] != limits[1]:
        words = tr("Remaining life, median: {life}; before, it was until other limits.")
        return words.format(life=f"{middle[1]}{spread}")
    return tr("Remaining life, median: {change}.", change=f"{_from_to(*middle)}{spread}")


def _service_change(before: Service, now: Service) -> str:
    shift = ""
    # A service that is due now has the day of its log.
    dated = before.kind != "now" and now.kind != "now"
    if dated and before.by and now.by and before.by != now.by:
        n = (now.by - before.by).days
        days = count(abs(n), "day")
        shift = tr(", {days} later", days=days) if n > 0 else tr(", {days} earlier", days=days)
    words = [
        tr("now") if one.kind == "now" else day(one.by) if one.by else tr("none")
        for one in (before, now)
    ]
    return tr("Service date: {change}.", change=f"{_from_to(*words)}{shift}")


def _from_to(before: str, now: str) -> str:
    return tr("still {now}", now=now) if before == now else f"{before} → {now}"
