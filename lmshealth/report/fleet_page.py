"""The front page: all stages of a fleet, worst first, from rows that are light enough to keep."""

from __future__ import annotations

import hashlib
import re
from base64 import b64encode
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from lmshealth._files import write_text
from lmshealth.io.log import Refusal
from lmshealth.prognosis.maintenance_decision import Service
from lmshealth.report.assessment import Assessment
from lmshealth.report.brief import Brief, brief
from lmshealth.report.healthfacts import (
    Gauge,
    Life,
    Tone,
    gauges,
    how_sure,
    lives,
    tone,
    verdict_words,
)
from lmshealth.report.html import render
from lmshealth.report.text import quantiles

# What Windows takes for a device, whatever its ending.
_DEVICES = re.compile(r"con|prn|aux|nul|(com|lpt)[0-9\u00b9\u00b2\u00b3]", re.IGNORECASE)
_TOP = 1.5  # length of all gauges, as a fraction of baseline
# More stages than that can be searched, filtered and sorted, and have a calendar.
_MANY = 10
# Of logs without a stage, so many are shown of each reason; so few of all are not folded away.
_MOST_REFUSED, _MOST_OPEN = 50, 12
_MONTHS = 12


@dataclass(frozen=True, slots=True)
class Summary:
    """A stage on the front page: texts and a few numbers, so that all of a fleet can be kept.

    Attributes
    ----------
    file : str
        Its page, beside the front page.
    identity : str
        Of the machine.
    urgency : tuple
        Sorts rows, worst first.
    last_log : date
        Day of it.
    tone : str
        ``good``, ``bad`` or ``open``.
    verdict, probability : str
        In words; the probability is empty without one.
    gauges : tuple of Gauge
        Health now, all drawn in one length.
    life : Life or None
        What is left until any limit.
    remaining : float
        Its median in m, infinite past the horizon, NaN where nothing is known.
    service : Service
        When, and by what that was chosen.
    brief : Brief
        What a terminal says of it.
    """

    file: str
    identity: str
    urgency: tuple[int, float, float, str]
    last_log: date
    tone: Tone
    verdict: str
    probability: str
    gauges: tuple[Gauge, ...]
    life: Life | None
    remaining: float
    service: Service
    brief: Brief


@dataclass(frozen=True, slots=True)
class Month:
    """How many services are due in a month; ``before`` is the day after it."""

    label: str
    year: str
    before: date
    count: int


def summarise(assessment: Assessment, service: Service, file: str) -> Summary:
    """Keep of an assessment what the front page says of it.

    Parameters
    ----------
    assessment : Assessment
        Of the stage.
    service : Service
        What `Assessment.service` gives: to decide it takes time.
    file : str
        Name of its page.
    """
    judgement, prognosis = assessment.judgement, assessment.prognosis
    return Summary(
        file=file,
        identity=judgement.stage,
        urgency=assessment.urgency(service),
        last_log=judgement.recorded_at.date(),
        tone=tone(assessment),
        verdict=verdict_words(assessment),
        probability=how_sure(assessment),
        gauges=gauges(assessment, _TOP),
        life=next(reversed(lives(prognosis)), None),
        remaining=np.nan if prognosis is None else quantiles(prognosis.censored()[:, -1])[1],
        service=service,
        brief=brief(assessment, service),
    )


def file_names(identities: Iterable[str]) -> dict[str, str]:
    """Name the pages of stages after them: safe on every file system, never twice the same.

    Returns
    -------
    dict of str to str
        The file of each identity; the same whatever their order.
    """
    taken = {"index"}
    names = {}
    for identity in sorted(set(identities)):
        stem = re.sub(r"[^\w.-]+", "-", identity).strip("-._")[:60] or "stage"
        if _DEVICES.fullmatch(stem.split(".")[0]):
            stem = f"stage-{stem}"
        name, count = stem, 1
        while name.casefold() in taken:
            count += 1
            name = f"{stem}-{count}"
        taken.add(name.casefold())
        names[identity] = f"{name}.html"
    return names


def by_urgency(rows: Iterable[Summary]) -> list[Summary]:
    """Sort rows by risk."""
    return sorted(rows, key=lambda row: row.urgency)


def write_index(
    folder: Path,
    rows: Iterable[Summary],
    refused: Sequence[Refusal],
    *,
    generated: datetime | None = None,
) -> Path:
    """Write ``index.html``; the same rows give the same bytes, in any order.

    Parameters
    ----------
    folder : Path
        Where the pages of the stages are.
    rows : iterable of Summary
        One per stage.
    refused : sequence of Refusal
        Logs that belong to no stage.
    generated : datetime or None
        Moment to print on the page; nothing is printed for None.
    """
    ranked = by_urgency(rows)
    script = _script() if len(ranked) > _MANY else ""
    newest = max((row.last_log for row in ranked), default=date.min)
    text = render(
        "index.html.j2",
        generated,
        rows=ranked,
        parameters=list(dict.fromkeys(gauge.name for row in ranked for gauge in row.gauges)),
        tones=Counter(row.tone for row in ranked),
        kinds=Counter(row.service.kind for row in ranked),
        base=round(100 / _TOP, 2),
        months=_months(ranked, newest) if script else [],
        newest=newest,
        refused=list(_by_reason(refused)),
        fold=len(refused) > _MOST_OPEN,
        script=script,
        script_hash=b64encode(hashlib.sha256(script.encode()).digest()).decode() if script else "",
    )
    path = folder / "index.html"
    write_text(path, text)
    return path


def _script() -> str:
    """Read what makes a long table handy; the page names its digest, and nothing else may run."""
    path = resources.files("lmshealth") / "report" / "templates" / "index.js"
    return path.read_text(encoding="utf-8")


def _months(rows: Sequence[Summary], newest: date) -> list[Month]:
    """Count the services that are due now, and in each month of a year; none where none is."""
    due = [row.service.by for row in rows if row.service.by is not None]
    newest = min(newest, date.max - timedelta(days=31 * (_MONTHS + 1)))
    # What is due on the day of the newest log, or was before it, is due now.
    counts = Counter(day.replace(day=1) for day in due if day > newest)
    months = [Month("now", "", newest + timedelta(days=1), sum(day <= newest for day in due))]
    begin = newest.replace(day=1)
    for k in range(_MONTHS):
        year = f"{begin:%Y}" if k == 0 or begin.month == 1 else ""
        after = (begin + timedelta(days=31)).replace(day=1)
        months.append(Month(f"{begin:%b}", year, after, counts[begin]))
        begin = after
    return months if any(month.count for month in months) else []


def _by_reason(refused: Sequence[Refusal]) -> Iterator[dict[str, Any]]:
    """Put logs together that were refused for one reason, the most common reason first."""
    for reason, count in Counter(item.reason for item in refused).most_common():
        shown = [item for item in refused if item.reason == reason][:_MOST_REFUSED]
        yield {"reason": reason, "count": count, "shown": shown}
