"""What changed on a machine from one report to the next."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date, datetime

import numpy as np

from lmshealth.health.verdict import degraded_words
from lmshealth.prognosis.maintenance_decision import Service
from lmshealth.report.assessment import Assessment
from lmshealth.report.text import GAP, LEVELS, km, left, percent, quantiles, spell

_WORDS = {"step": "a sudden change", "not-enough-data": "not enough data"}

Interval = tuple[float, float, float]
"""The 5, 50 and 95 % quantiles of something."""


@dataclass(frozen=True, slots=True)
class Reported:
    """What a report said of a machine, in few numbers.

    Attributes
    ----------
    recorded_at : datetime
        The last log.
    baseline_at : datetime
        The log that the fractions are of.
    description : str
        Digest of the stage description.
    n_logs : int
        Logs used.
    travel : float
        Odometer at the last log in m, NaN without one.
    verdict : str
        As in ``verdict.csv``.
    probability : float
        Of that word; NaN for ``not-enough-data``.
    health : dict of str to tuple of float
        Quantiles of each parameter that the logs tell, as fractions of the baseline.
    remaining : tuple of float or None
        Quantiles of the remaining travel until any limit in m, infinite past the horizon.
    horizon : float
        Travel in m past which nothing is claimed.
    service_by : date or None
        Last day for the service; None where none is asked for.
    """

    recorded_at: datetime
    baseline_at: datetime
    description: str
    n_logs: int
    travel: float
    verdict: str
    probability: float
    health: dict[str, Interval]
    remaining: Interval | None
    horizon: float
    service_by: date | None


def reported(assessment: Assessment, service: Service | None = None) -> Reported:
    """Keep of an assessment what a later report compares itself with.

    Parameters
    ----------
    assessment : Assessment
        Of the stage.
    service : Service or None
        What `Assessment.service` gives, where it is known: to decide it takes time.
    """
    history, judgement = assessment.history, assessment.judgement
    health, prognosis = assessment.health, assessment.prognosis
    told: dict[str, Interval] = {}
    if health is not None and health.recorded_at:
        low, middle, high = health.latest(LEVELS)
        for k in np.flatnonzero(health.informed_parameters()).tolist():
            told[health.parameters[k]] = float(low[k]), float(middle[k]), float(high[k])
    remaining: Interval | None = None
    if prognosis is not None:
        low, middle, high = quantiles(prognosis.censored()[:, -1])
        remaining = low, middle, high
    return Reported(
        recorded_at=judgement.recorded_at,
        baseline_at=[*history.recorded_at, judgement.recorded_at][history.baseline],
        description=assessment.stage.digest,
        n_logs=len(history.logs),
        travel=float(history.travel[-1]) if history.logs else np.nan,
        verdict=judgement.verdict,
        probability=judgement.probability,
        health=told,
        remaining=remaining,
        horizon=np.inf if prognosis is None else prognosis.horizon,
        service_by=(service or assessment.service()).by,
    )


def changes(before: Reported, now: Reported) -> tuple[str, ...]:
    """Say in sentences what changed since an earlier report.

    Parameters
    ----------
    before, now : Reported
        The earlier report on a machine and the present one.

    Returns
    -------
    tuple of str
        What keeps the two from being compared comes first.
    """
    return (
        *_caveats(before, now),
        _verdict(before, now),
        *_health(before, now),
        *_life(before, now),
        *_service(before, now),
        _logs(before, now),
    )


def _caveats(before: Reported, now: Reported) -> list[str]:
    told = []
    if before.description != now.description:
        told.append("The stage description is another one now: not all that differs is wear.")
    if before.baseline_at != now.baseline_at:
        told.append(
            f"The baseline is another one now, that of {_day(now.baseline_at)} and no longer that "
            f"of {_day(before.baseline_at)}: percentages of then and now do not compare."
        )
    return told


def _verdict(before: Reported, now: Reported) -> str:
    one, other = (_sure(report) for report in (before, now))
    if before.verdict != now.verdict:
        return f"Verdict was {one}, now {other}."
    return (
        f"Verdict still {other}{'' if one == other else f', then {percent(before.probability)}'}."
    )


def _sure(report: Reported) -> str:
    sure = f" ({percent(report.probability)})" if report.probability >= 0 else ""
    # A report keeps the words of its parameters, not their names.
    names = [
        "mount stiffness" if w == "mount" else spell(w) for w in degraded_words(report.verdict)
    ]
    lost = f"loss of {' and '.join(names)}" if names else report.verdict
    return _WORDS.get(report.verdict, lost) + sure


def _health(before: Reported, now: Reported) -> list[str]:
    told = []
    for name in dict.fromkeys((*now.health, *before.health)):
        then, own = before.health.get(name), now.health.get(name)
        what = spell(name).capitalize()
        if own is None and then is not None:
            told.append(f"{what}: {_share(then)} then; these logs do not tell it any more.")
        elif own is not None and then is None:
            told.append(f"{what}: {_share(own)} ({_range(own)}); not told then.")
        elif own is not None and then is not None:
            told.append(f"{what}: {_share(then)} → {_share(own)} ({_range(own)}).")
    return told


def _life(before: Reported, now: Reported) -> list[str]:
    if before.remaining is None and now.remaining is None:
        return []
    low, middle, high = (
        [_distance(report, k) if report.remaining else "not known" for report in (before, now)]
        for k in range(3)
    )
    reach = f" (90 %: {low[1]} to {high[1]})" if now.remaining else ""
    return [f"Remaining life, median: {_from_to(*middle)}{reach}."]


def _distance(report: Reported, k: int) -> str:
    assert report.remaining is not None
    value = report.remaining[k]
    return left(value, f"beyond {km(report.horizon)}", km(value))


def _service(before: Reported, now: Reported) -> list[str]:
    if before.service_by is None and now.service_by is None:
        return []
    days = [one.isoformat() if one else "none" for one in (before.service_by, now.service_by)]
    shift = ""
    if before.service_by and now.service_by and before.service_by != now.service_by:
        later = (now.service_by - before.service_by).days
        shift = f", {abs(later)} day{_s(later)} {'later' if later > 0 else 'earlier'}"
    return [f"Service date: {_from_to(*days)}{shift}."]


def _logs(before: Reported, now: Reported) -> str:
    more = now.n_logs - before.n_logs
    logs = f"{abs(more)} log{_s(more)} {'more' if more > 0 else 'fewer'}" if more else ""
    further = now.travel - before.travel
    if more > 0 and further > 0:
        return f"{more} log{_s(more)} and {km(further)} more."
    return f"{logs or 'As many logs as then'}{f', {km(further)} further' if further > 0 else ''}."


def _from_to(one: str, other: str) -> str:
    return f"still {other}" if one == other else f"{one} → {other}"


def _share(interval: Interval) -> str:
    return f"{100 * interval[1]:.0f}{GAP}%"


def _range(interval: Interval) -> str:
    return f"90{GAP}%: {100 * interval[0]:.0f} to {100 * interval[2]:.0f}{GAP}%"


def _day(moment: datetime) -> str:
    return moment.date().isoformat()


def _s(count: int) -> str:
    return "" if abs(count) == 1 else "s"
