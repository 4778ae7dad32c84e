"""The best that a detector of a known loss could do, at the same rate of false alarms.

The likelihood ratio of a loss whose course is known against none, log by log. By Ville's inequality
it reaches 1/α in at most a share α of healthy lives, and no test that keeps to this rate is faster
by much: Lorden's bound on the delay of a CUSUM is ln(1/α) over the information per log, and for a
loss that grows, the log at which the information gathered reaches ln(1/α).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lmshealth.tracking.constants import FALSE_ALARM_PROBABILITY, LN_F_STD
from studies.common.lives import Array, Estimates, Life

_TEMPERATURE_STD = 0.001  # per K, as in the descriptions of the stages
_BOUND = float(np.log(1 / FALSE_ALARM_PROBABILITY))


@dataclass(frozen=True, slots=True)
class Optimum:
    """Logs after which a known loss is told; None where it is not."""

    bound: int | None  # Where the information gathered reaches ln(1/α)
    told: int | None  # Where the likelihood ratio does


def optimum(life: Life, estimates: Estimates, loss: Array, *, learns: bool) -> Optimum:
    """Tell a loss by a detector that knows its onset, its course and its direction.

    Parameters
    ----------
    life, estimates : Life and Estimates
        What is really so, and what is seen of it.
    loss : ndarray
        The drift that is looked for, shape ``(n, 3)``.
    learns : bool
        Whether it has to learn where the modes begin and what temperature does to them, as a
        tracker has; else it knows both.
    """
    n, m = loss.shape
    warmer = life.covariates["temperature_c"] - 21.0
    prior = np.repeat([LN_F_STD, _TEMPERATURE_STD], m) ** 2 if learns else np.zeros(2 * m)
    known = life.ln_frequency[:1] if learns else life.ln_frequency - life.drift
    seen = np.stack([estimates.ln_frequency - known, loss], axis=2)
    # One filter for both: what is seen, and what the loss would look like.
    mean, cov = np.zeros((2 * m, 2)), np.diag(prior)
    ratio, information = np.zeros(n), np.zeros(n)
    for k in range(n):
        design = np.hstack([np.eye(m), warmer[k] * np.eye(m)])
        spread = design @ cov @ design.T + estimates.cov[k, :m, :m]
        gain = np.linalg.solve(spread, design @ cov).T
        off = seen[k] - design @ mean
        mean = mean + gain @ off
        cov = cov - gain @ design @ cov
        weighed = np.linalg.solve(spread, off[:, 1])
        information[k] = 0.5 * off[:, 1] @ weighed
        ratio[k] = off[:, 0] @ weighed - information[k]
    return Optimum(_first(np.cumsum(information)), _first(np.cumsum(ratio)))


def _first(gathered: Array) -> int | None:
    """Find the first log at which enough is gathered."""
    enough = np.flatnonzero(gathered >= _BOUND)
    return int(enough[0]) if enough.size else None
