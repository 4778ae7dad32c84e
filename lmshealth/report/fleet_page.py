"""Fleet page ``index.html``: all machines, most urgent first, from their summaries."""

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import date, timedelta
from pathlib import Path

import numpy as np

from lmshealth._private.files import write_text
from lmshealth.io.log import Refusal
from lmshealth.machine.constants import RUL_LEVELS
from lmshealth.machine.summary import Summary
from lmshealth.report import constants
from lmshealth.report.language import mark, tr, tr_month
from lmshealth.report.rendering import read, render
from lmshealth.report.text import number
from lmshealth.report.wording import headline, service_on_day, verdict_text

# Names of devices on Windows, with any file name extension.
_DEVICES = re.compile(r"con|prn|aux|nul|(com|lpt)[0-9\u00b9\u00b2\u00b3]", re.IGNORECASE)
_NAME_LENGTH = 60
# Parts of the script that are words.
_WORDS = (
    mark('Collator("en"'),
    mark("`by ${names[heads.indexOf(sorted)].toLowerCase()}, ${sorted.ariaSort}`"),
    mark('"most urgent first"'),
    mark('`${shown} of ${rows.length} stage${rows.length === 1 ? "" : "s"}, ${way}`'),
    mark('"Most urgent first"'),
)


@dataclass(frozen=True, slots=True)
class Month:
    """Number of services due in a month; ``before`` is the day after its last."""

    label: str
    year: str
    before: date
    count: int


def file_names(identities: Iterable[str]) -> dict[str, str]:
    """Name the pages of machines: valid on every file system and unique regardless of case."""
    taken = {"index", "how-to-read"}
    names = {}
    for identity in sorted(set(identities)):
        stem = re.sub(r"[^\w.-]+", "-", identity).strip("-._")[:_NAME_LENGTH] or "stage"
        if _DEVICES.fullmatch(stem.split(".")[0]):
            stem = f"stage-{stem}"
        name, count = stem, 1
        while name.casefold() in taken:
            count += 1
            name = f"{stem}-{count}"
        taken.add(name.casefold())
        names[identity] = f"{name}.html"
    return names


def by_urgency(summaries: Iterable[Summary]) -> list[Summary]:
    """Sort machines, most urgent first."""
    return sorted(summaries, key=lambda one: one.urgency)


def write_index(
    folder: Path,
    summaries: Iterable[Summary],
    refused: Sequence[Refusal],
    *,
    today: date | None = None,
) -> Path:
    """Write ``index.html`` and ``how-to-read.html``; the order of the summaries is of no effect.

    ``refused`` are logs that belong to no machine; ``today`` is the day of the page, by default
    that of the newest log.
    """
    ranked = by_urgency(summaries)
    script = read("index.js") if len(ranked) > constants.MANY_MACHINES else ""
    for words in _WORDS:
        script = script.replace(words, tr(words))
    newest = max((one.recorded_at.date() for one in ranked), default=date.min)
    today = today or newest
    by_reason = [
        (reason, count, [one for one in refused if one.reason == reason][: constants.REFUSED_SHOWN])
        for reason, count in Counter(one.reason for one in refused).most_common()
    ]
    text = render(
        "index.html.j2",
        rows=ranked,
        headline=headline,
        verdict_text=verdict_text,
        due=service_on_day,
        silent=sum(one.unknown for one in ranked),
        today=today,
        parameters=list(dict.fromkeys(own.name for one in ranked for own in one.health)),
        states=Counter(one.state for one in ranked),
        kinds=Counter(one.service.kind for one in ranked),
        months=_months(ranked, today) if script else [],
        lives=_lives(ranked) if script else [],
        newest=newest,
        refused=by_reason,
        fold=len(refused) > constants.REFUSED_UNFOLDED,
        script=script,
    )
    path = folder / "index.html"
    write_text(path, text)
    write_text(folder / "how-to-read.html", render("how_to_read.html.j2"))
    return path


def _lives(summaries: Sequence[Summary]) -> list[tuple[str, int]]:
    """Count machines by their median remaining travel; the last bin is beyond the horizon."""
    median = len(RUL_LEVELS) // 2
    left = [one.life.any.travel[median] / 1000 for one in summaries if one.life]
    edges = [0.0, *constants.LIFE_EDGES, np.inf]
    labels = [tr("passed"), *(tr("to {distance}", distance=number(edge)) for edge in edges[1:-1])]
    labels += [tr("more"), tr("beyond")]
    places = Counter(int(np.searchsorted(edges, km)) + (km == np.inf) for km in left)
    return [(label, places[k]) for k, label in enumerate(labels)] if left else []


def _months(summaries: Sequence[Summary], today: date) -> list[Month]:
    """Count the services due now and in each month of a year; empty without any."""
    due = [one.service.by for one in summaries if one.service.by is not None]
    today = min(today, date.max - timedelta(days=31 * (constants.CALENDAR_MONTHS + 1)))
    # Due now: everything due on or before this day.
    counts = Counter(day.replace(day=1) for day in due if day > today)
    months = [Month(tr("now"), "", today + timedelta(days=1), sum(day <= today for day in due))]
    begin = today.replace(day=1)
    for k in range(constants.CALENDAR_MONTHS):
        year = f"{begin:%Y}" if k == 0 or begin.month == 1 else ""
        after = (begin + timedelta(days=31)).replace(day=1)
        months.append(Month(tr_month(begin), year, after, counts[begin]))
        begin = after
    return months if any(month.count for month in months) else []
