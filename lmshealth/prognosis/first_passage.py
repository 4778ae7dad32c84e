"""First passage: when health, its law times a deviation that wanders, falls to a limit."""

from __future__ import annotations

import numpy as np

from lmshealth._arrays import FloatArray
from lmshealth.prognosis.scenarios import DegradationPath

# Points up to where the law alone would be well past the limit, and from there to the horizon.
_NEAR, _FAR = 24, 12
_BEYOND = 1.5
_RARE = 1e-9


def first_passage(
    path: DegradationPath,
    theta: FloatArray,
    off: FloatArray,
    rate: FloatArray,
    rng: np.random.Generator,
    *,
    now: float,
    limit: float,
    horizon: float,
) -> FloatArray:
    """Draw the travel from now to the first moment at which health is at its limit.

    Ln health is that of the law plus a Wiener process, which is ``off`` now. Without the process
    the passage is that of the law, in closed form. With it, the process is drawn at few moments,
    and what it does between two of them is a Brownian bridge over the variance v, which touches a
    straight limit with probability exp(-2 a b / v), a and b its distances from the limit at both
    ends; the odds of the part of the way at which it first does are inverse Gaussian, of mean
    a / abs(b) and shape a² / v.

    Parameters
    ----------
    path : DegradationPath
        What the parameter does.
    theta : ndarray
        Its natural parameters, shape ``(n, k)``.
    off : ndarray
        Ln of health over its law now, shape ``(n,)``.
    rate : ndarray
        Variance of the process per m, shape ``(n,)``.
    rng : Generator
        Of all randomness.
    now : float
        Travel in m since the baseline.
    limit : float
        As a fraction of baseline.
    horizon : float
        Travel in m from now, past which nothing is claimed.

    Returns
    -------
    ndarray
        In m, shape ``(n,)``: negative where it has been passed, by so much by the law; infinite
        where it is never reached or, if the process moves, not before the horizon.

    References
    ----------
    Borodin2002 for the bridge.
    """
    left = path.passage(theta, limit * np.exp(-off)) - now
    # What gains may have been under its limit before, after a jump: that is over.
    above = path.health(theta, np.array([now]))[:, 0] * np.exp(off) > limit
    left[above & (left <= 0)] = np.inf
    moving = (rate > 0) & (left > 0)
    if moving.any():
        left[moving] = _wandering(
            path,
            theta[moving],
            off[moving] - np.log(limit),
            rate[moving],
            rng,
            now=now,
            near=np.minimum(_BEYOND * left[moving], 0.5 * horizon),
            horizon=horizon,
        )
    return left


def _wandering(
    path: DegradationPath,
    theta: FloatArray,
    above: FloatArray,
    rate: FloatArray,
    rng: np.random.Generator,
    *,
    now: float,
    near: FloatArray,
    horizon: float,
) -> FloatArray:
    fraction = np.linspace(0, 1, _NEAR + 1)
    rest = np.linspace(0, 1, _FAR + 1)[1:]
    ahead = np.hstack([near[:, None] * fraction, near[:, None] + (horizon - near)[:, None] * rest])
    step = np.diff(ahead, axis=1)
    variance = rate[:, None] * step
    walk = np.cumsum(np.sqrt(variance) * rng.standard_normal(step.shape), axis=1)
    with np.errstate(divide="ignore"):  # nothing is left past the end of a law
        distance = np.log(path.health(theta, now + ahead)) + above[:, None]
    distance[:, 1:] += walk
    a, b = distance[:, :-1], distance[:, 1:]
    # Past the limit at the end, or touching it in between.
    with np.errstate(invalid="ignore", over="ignore"):
        touched = np.exp(-2 * a * b / variance) > rng.uniform(size=step.shape)
    crossed = (b <= 0) | touched
    first = crossed.argmax(axis=1)[:, None]
    a, b, begin, length = (
        np.take_along_axis(part, first, axis=1)[:, 0] for part in (a, b, ahead[:, :-1], step)
    )
    # When a bridge of length T that touches 0 does so first: t / (T - t) is inverse Gaussian.
    spread = rate * length
    with np.errstate(divide="ignore", invalid="ignore"):
        odds = rng.wald(np.clip(a / np.abs(b), _RARE, 1 / _RARE), np.maximum(a * a / spread, _RARE))
    share = np.where(np.isneginf(b), 0.5, odds / (1 + odds))
    return np.where(crossed.any(axis=1), begin + length * share, np.inf)
