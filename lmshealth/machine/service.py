"""Service date: last day of an accepted risk, or the day of least long-run costs."""

from collections.abc import Collection
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime, time, timedelta
from typing import Literal

import numpy as np

from lmshealth._private.arrays import FloatArray
from lmshealth.io.log import utc_day
from lmshealth.life.posterior.data import SECONDS_PER_DAY
from lmshealth.life.prognosis import Prognosis
from lmshealth.machine import constants
from lmshealth.stage.constants import MAX_RISK
from lmshealth.stage.description import Decision

_SHORTER = 0.9  # factor between the intervals of logs that are tried


@dataclass(frozen=True, slots=True)
class Service:
    """Service date of a machine, and the criterion that chose it."""

    kind: Literal["now", "by", "later", "unknown"]  # by a day; later than the horizon or never
    by: date | None  # last day, that of the last log for ``now``
    # Days from the last log, negative if the accepted risk was reached before it, infinite for
    # ``later``; of ``unknown`` NaN without a prognosis, else beyond the calendar.
    wait: float
    risk: float  # upper bound of the probability to reach a limit before that day; NaN without one
    planned: date | None  # next service by the description
    planned_risk: tuple[float, float]  # bounds of the probability to reach a limit before it
    max_risk: float | None  # max_risk, cost_ratio: criterion; one of them is None
    cost_ratio: float | None
    # Last day of the next log, and the travel in m from one log to the next; None and infinite if
    # the horizon comes first.
    inspect_by: date | None = None
    inspect_every: float = np.inf
    # Day before which an end has at most the risk of `inspect_by`; None beyond the horizon.
    earliest_end: date | None = None

    @property
    def kept_risk(self) -> float | None:
        """Accepted risk, or else the risk before the day of least costs."""
        return self.max_risk or (None if np.isnan(self.risk) else self.risk)


def decide(prognosis: Prognosis | None, decision: Decision) -> Service:
    """Choose the service date.

    Parameters
    ----------
    prognosis : Prognosis or None
        Remaining life; without it the kind is ``unknown``.
    decision : Decision
        Accepted risk or cost ratio, and the planned service.

    Examples
    --------
    >>> import lmshealth
    >>> from lmshealth import examples
    >>> stage = lmshealth.load_stage("lms-y")
    >>> prognosis = lmshealth.prognose(examples.history(), stage, seed=0, chains=False)
    >>> service = lmshealth.decide(prognosis, stage.description.decision)
    >>> service.kind, service.by.strftime("%B %Y"), service.max_risk
    ('by', 'July 2026', 0.05)
    >>> service.risk <= 0.05
    True
    """
    criterion, unknown = (decision.accepted, decision.cost_ratio), (np.nan, np.nan)
    if prognosis is None:
        return Service("unknown", None, np.nan, np.nan, None, unknown, *criterion)
    wait = _wait(prognosis, decision)
    by, planned = day_after(prognosis, wait), decision.next_service
    kind: Literal["now", "by", "later", "unknown"] = "later" if np.isinf(wait) else "unknown"
    if by is not None:
        kind = "now" if by <= utc_day(prognosis.recorded_at) else "by"
    risk = np.nan if by is None else risk_before(prognosis, by)[1]
    planned_risk = unknown if planned is None else risk_before(prognosis, planned)
    every, earliest = _inspection(prognosis, decision)
    next_log = day_after(prognosis, days_to(prognosis, every))
    end = day_after(prognosis, earliest)
    log_by = min((day for day in (next_log, by, end) if day is not None), default=None)
    return Service(kind, by, wait, risk, planned, planned_risk, *criterion, log_by, every, end)


def without_limits(prognosis: Prognosis | None, restored: Collection[str]) -> Prognosis | None:
    """Leave the limits of some parameters out, which work after the last log has restored.

    None where no limit is left: what remains is not known before the next log.
    """
    if prognosis is None or not restored:
        return prognosis
    kept = [k for k, name in enumerate(prognosis.parameters[:-1]) if name not in restored]
    if not kept:
        return None
    parts = prognosis.remaining[:, kept]
    return replace(
        prognosis,
        parameters=tuple(prognosis.parameters[k] for k in (*kept, -1)),
        limits=prognosis.limits[[*kept, -1]],
        remaining=np.column_stack([parts, parts.min(axis=1)]),
        half=prognosis.half[:, kept],
        health=prognosis.health[:, kept],
        curve_quantiles=prognosis.curve_quantiles[:, :, kept],
        laws=tuple(law for law in prognosis.laws if law.parameter not in restored),
    )


def risk_before(prognosis: Prognosis, day: date) -> tuple[float, float]:
    """Return the bounds of the probability to reach any limit before a day."""
    low, high = probability_before(prognosis, day)[:, -1].tolist()
    return low, high


def cheapest_travel(prognosis: Prognosis, cost_ratio: float) -> float:
    """Return the travel in m from now of the service of least long-run costs (age replacement).

    README.md has the equation [Barlow1960] and its assumptions [Barlow1965]. 0 for now, infinite if
    no service within the horizon saves 1 % of the costs of operation up to it.
    """
    age = prognosis.travel - float(prognosis.curve_travel[0])
    left = np.sort(np.maximum(prognosis.remaining[:, -1], 0))
    n, left = left.size, left[left <= prognosis.horizon]
    # Costs fall between two draws: they are least just before one fails.
    planned = np.concatenate([[0.0], left, [prognosis.horizon]])
    failed = np.searchsorted(left, planned, side="left")
    mean_travel = np.append(0.0, np.cumsum(left))[failed] / n + planned * (1 - failed / n)
    with np.errstate(divide="ignore"):  # a service at age 0 has infinite costs
        cost = (1 + (cost_ratio - 1) * failed / n) / (age + mean_travel)
    best = int(np.argmin(cost))
    return float(planned[best]) if cost[best] < (1 - constants.MIN_SAVING) * cost[-1] else np.inf


def _inspection(prognosis: Prognosis, decision: Decision) -> tuple[float, float]:
    """Return the longest travel in m between logs, and the days to the earliest plausible end.

    An end is missed if no log falls between the loss of half of the margin and the end; at most a
    share `constants.INSPECTION_RISK` of the accepted risk is. Infinite beyond the horizon.
    """
    risk = constants.INSPECTION_RISK * (decision.accepted or MAX_RISK)
    left, n = prognosis.remaining[:, -1], prognosis.usage.size
    ends = (left > 0) & (left <= prognosis.horizon)
    first = prognosis.remaining[ends, :-1].argmin(axis=1)  # limit
    half, left = prognosis.half[ends, first], left[ends]
    half = np.where(half < left, half, left / 2)  # a deviation may end a draw before its law does
    every = np.inf if left.size <= risk * n else prognosis.horizon
    while np.isfinite(every) and np.sum(np.ceil(half / every) * every >= left) > risk * n:
        every *= _SHORTER
    days = float(np.quantile(remaining_days(prognosis)[:, -1], risk, method="inverted_cdf"))
    return every, days


def probability_before(prognosis: Prognosis, day: date) -> FloatArray:
    """Return bounds of the probability to reach each limit, and any, before a day begins.

    Shape ``(2, n_parameters + 1)``: at least, at most. They differ if draws pass the horizon before
    that day, beyond which nothing is published: such a draw is a failure in the upper one only. The
    day is in UTC; a day before the last log counts as its moment.
    """
    ahead = datetime.combine(day, time(), UTC) - prognosis.recorded_at
    days = max(ahead.total_seconds() / SECONDS_PER_DAY, 0.0)
    within = np.minimum(prognosis.remaining, prognosis.horizon)
    maybe = within <= days * prognosis.usage[:, None]
    surely = maybe & (prognosis.remaining <= prognosis.horizon)
    return np.asarray(np.stack([surely, maybe]).mean(axis=1))


def remaining_days(prognosis: Prognosis) -> FloatArray:
    """Return the remaining life in days, infinite beyond the horizon, shaped as `remaining`."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(prognosis.censored() / prognosis.usage[:, None])


def days_to(prognosis: Prognosis, travel: float) -> float:
    """Return the days to a travel in m within the remaining life, by the larger median usage.

    A present usage above that of the record goes on for some time; one below it may end soon.
    """
    fastest = np.maximum(prognosis.usage, prognosis.usage_now)
    return travel / float(np.median(fastest))


def day_after(prognosis: Prognosis, wait: float) -> date | None:
    """Return the day so many days after the last log, at least that of the log.

    None if the wait is infinite or beyond the calendar.
    """
    try:
        return utc_day(prognosis.recorded_at + timedelta(days=max(wait, 0.0)))
    except OverflowError:
        return None


def _wait(prognosis: Prognosis, decision: Decision) -> float:
    """Return the days from the last log to the service, infinite without one."""
    if decision.cost_ratio is not None:
        return days_to(prognosis, cheapest_travel(prognosis, decision.cost_ratio))
    assert decision.accepted is not None  # one of the two is
    max_risk = decision.accepted
    remaining = prognosis.remaining[:, -1]
    if np.quantile(remaining, max_risk, method="inverted_cdf") > prognosis.horizon:
        return np.inf
    # A draw past the horizon may have reached a limit there, sooner than slower draws do.
    days = np.minimum(remaining, prognosis.horizon) / prognosis.usage
    return float(np.quantile(days, max_risk, method="inverted_cdf"))
