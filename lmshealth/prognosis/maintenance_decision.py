"""When to service: what the draws of a remaining life say about days."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date, datetime, time, timedelta
from typing import Literal

import numpy as np

from lmshealth._arrays import FloatArray, freeze
from lmshealth.prognosis.results import Prognosis
from lmshealth.stage.description import Decision

_SECONDS_PER_DAY = 86_400.0
# A service that saves a smaller share of the costs is not worth a date: draws cannot tell it.
_WORTH = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class ProbabilityBounds:
    """Probability of having reached each limit before a day, shapes ``(n_parameters + 1,)``.

    The two differ where a draw gets past the horizon before that day: nothing is claimed about it
    there, so that it counts as a limit not reached in one and as a limit reached in the other.

    Attributes
    ----------
    at_least, at_most : ndarray
        In the order of the prognosis's parameters, ``any`` last.
    """

    at_least: FloatArray
    at_most: FloatArray

    def __post_init__(self) -> None:
        freeze(self)


@dataclass(frozen=True, slots=True)
class Service:
    """When to service a machine, and by what that was chosen.

    Attributes
    ----------
    kind : str
        ``now``, ``by`` a day, ``later`` than the horizon or without end, or ``unknown``.
    by : date or None
        The last day; of the last log where it is now.
    wait : float
        Days from the last log, negative where a stated risk was used up before it, infinite where
        no service is asked for, NaN where nothing is known.
    risk : float
        Probability, at most, that a limit is reached before that day; NaN without one.
    planned : date or None
        The service that the description plans.
    planned_risk : tuple of float
        Probability that a limit is reached before it, at least and at most; NaN without one.
    max_risk, cost_ratio : float or None
        What chose the day: one of them is None.
    """

    kind: Literal["now", "by", "later", "unknown"]
    by: date | None
    wait: float
    risk: float
    planned: date | None
    planned_risk: tuple[float, float]
    max_risk: float | None
    cost_ratio: float | None

    @property
    def kept_risk(self) -> float | None:
        """The risk that the day keeps: the stated one, else that of the day of least costs."""
        return self.max_risk or (None if np.isnan(self.risk) else self.risk)


def decide(prognosis: Prognosis | None, decision: Decision) -> Service:
    """Choose the day of the service.

    Parameters
    ----------
    prognosis : Prognosis or None
        The remaining life; without one the kind is ``unknown``.
    decision : Decision
        The accepted risk or the ratio of costs, and the service that is planned.

    Examples
    --------
    >>> import lmshealth
    >>> from lmshealth import examples
    >>> stage = lmshealth.load_stage("lms-y")
    >>> prognosis = lmshealth.prognose(examples.history(), stage, seed=0, chains=False)
    >>> service = lmshealth.decide(prognosis, stage.description.decision)
    >>> service.kind, service.by.strftime("%B %Y"), service.max_risk
    ('by', 'August 2026', 0.05)
    >>> service.risk <= 0.05
    True
    """
    kind: Literal["now", "by", "later", "unknown"] = "unknown"
    by, wait, risk = None, np.nan, np.nan
    planned, planned_risk = None, (np.nan, np.nan)
    if prognosis is not None:
        wait = _wait(prognosis, decision)
        by = day_after(prognosis, wait)
        if by is not None:
            kind = "now" if by <= prognosis.recorded_at.date() else "by"
            risk = float(probability_before(prognosis, by).at_most[-1])
        elif np.isinf(wait):
            kind = "later"
        planned = decision.next_service
        if planned is not None:
            reached = probability_before(prognosis, planned)
            planned_risk = float(reached.at_least[-1]), float(reached.at_most[-1])
    return Service(
        kind, by, wait, risk, planned, planned_risk, decision.accepted, decision.cost_ratio
    )


def service_date(prognosis: Prognosis, max_risk: float) -> date | None:
    """Find the last day on which the risk of having reached any limit is at most ``max_risk``.

    Returns
    -------
    date or None
        None when that day lies past the horizon: no service is asked for. A limit that is reached
        already with more than that risk gives the day of the last log.
    """
    return day_after(prognosis, _wait_for_risk(prognosis, max_risk))


def cheapest_date(prognosis: Prognosis, cost_ratio: float) -> date | None:
    """Find the day on which a service costs least per travel, at the median usage.

    Returns
    -------
    date or None
        None when no service is asked for, see `cheapest_travel`.
    """
    travel = cheapest_travel(prognosis, cost_ratio)
    return day_after(prognosis, travel / float(np.median(prognosis.usage)))


def cheapest_travel(prognosis: Prognosis, cost_ratio: float) -> float:
    """Find the travel from now at which a service costs least per travel: age replacement.

    A life ends by a service planned at age a + t, which costs 1, or by a failure before it, which
    costs r, and the next one begins. In the long run that costs, per travel,
    (S(t) + r F(t)) / (a + E[min(T, t)]). T, the remaining life to any limit, has the distribution
    of the draws, and a is the travel since the baseline.

    This assumes that every service makes the machine as it was at the baseline; that each life is
    like one of the draws, which all reach the age a; that reaching a limit ends a life as a
    failure does, at once; and that a service takes no time. What is uncertain about this machine
    counts as if it differed from life to life. A draw that is past its limit fails as soon as the
    machine goes on, and a service now still prevents that. A draw past the horizon, infinite or
    not, only counts as alive up to there.

    Parameters
    ----------
    prognosis : Prognosis
        Its draws for any limit.
    cost_ratio : float
        Cost of a failure over that of a planned service, above 1.

    Returns
    -------
    float
        In m; 0 for now, infinite where no service within the horizon saves 1 % of the costs of
        going on to it.

    References
    ----------
    [Barlow1960], [Barlow1965]
    """
    age = prognosis.travel - float(prognosis.curve_travel[0])
    left = np.sort(np.maximum(prognosis.remaining[:, -1], 0))
    n, left = left.size, left[left <= prognosis.horizon]
    # Between two draws costs fall, so that they are least just before one fails.
    planned = np.concatenate([[0.0], left, [prognosis.horizon]])
    failed = np.searchsorted(left, planned, side="left")
    mean_travel = np.append(0.0, np.cumsum(left))[failed] / n + planned * (1 - failed / n)
    with np.errstate(divide="ignore"):  # a service at age 0 has no travel to be paid by
        cost = (1 + (cost_ratio - 1) * failed / n) / (age + mean_travel)
    best = int(np.argmin(cost))
    return float(planned[best]) if cost[best] < (1 - _WORTH) * cost[-1] else np.inf


def probability_before(prognosis: Prognosis, day: date) -> ProbabilityBounds:
    """Give the probability that each limit, and any, is reached before a day begins.

    Parameters
    ----------
    prognosis : Prognosis
        With draws of travel and usage.
    day : date
        In the time zone of the last log; one before that log counts as its moment.
    """
    moment = prognosis.recorded_at
    ahead = datetime.combine(day, time(), moment.tzinfo) - moment
    days = max(ahead.total_seconds() / _SECONDS_PER_DAY, 0.0)
    within = np.minimum(prognosis.remaining, prognosis.horizon)
    maybe = within <= days * prognosis.usage[:, None]
    surely = maybe & (prognosis.remaining <= prognosis.horizon)
    return ProbabilityBounds(at_least=np.mean(surely, axis=0), at_most=np.mean(maybe, axis=0))


def remaining_days(prognosis: Prognosis) -> FloatArray:
    """Give the draws of the remaining days, infinite past the horizon, as `remaining` is shaped."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(prognosis.censored() / prognosis.usage[:, None])


def day_after(prognosis: Prognosis, wait: float) -> date | None:
    """Give the day so many days after the last log, that of the log itself where they are past.

    Returns
    -------
    date or None
        None where there is none: past the horizon, or past the calendar where a machine hardly
        moves.
    """
    try:
        return (prognosis.recorded_at + timedelta(days=max(wait, 0.0))).date()
    except OverflowError:
        return None


def _wait(prognosis: Prognosis, decision: Decision) -> float:
    """Days from the last log to the service; infinite where none is asked for."""
    if decision.cost_ratio is not None:
        usage = float(np.median(prognosis.usage))
        return cheapest_travel(prognosis, decision.cost_ratio) / usage
    assert decision.accepted is not None  # one of the two is
    return _wait_for_risk(prognosis, decision.accepted)


def _wait_for_risk(prognosis: Prognosis, max_risk: float) -> float:
    remaining = prognosis.remaining[:, -1]
    if np.quantile(remaining, max_risk, method="inverted_cdf") > prognosis.horizon:
        return np.inf
    # Usage differs between draws: one that gets past the horizon sooner than others reach a limit
    # may have reached one there.
    days = np.minimum(remaining, prognosis.horizon) / prognosis.usage
    return float(np.quantile(days, max_risk, method="inverted_cdf"))
