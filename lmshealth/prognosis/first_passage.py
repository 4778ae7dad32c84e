"""First passage of health, a law times the exponential of a Wiener process, to its limit."""

from __future__ import annotations

import numpy as np

from lmshealth._arrays import FloatArray
from lmshealth.prognosis.scenarios import DegradationPath

# Grid points up to 1.5 times the passage of the law alone, and from there to the horizon.
_NEAR, _FAR = 24, 12
_BEYOND = 1.5
_RARE = 1e-9  # bounds of the mean and shape of the inverse Gaussian


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
    """Draw the travel from now to the first passage of a limit.

    Without deviation the passage is that of the law, in closed form. With deviation, ln health is
    drawn at grid points with Brownian bridges between them; README.md has the equations. The result
    in m, shape ``(n,)``, is negative, by the law, if the limit has been passed, and infinite if it
    is never reached or, with deviation, not before the horizon.

    Parameters
    ----------
    path, theta : DegradationPath, ndarray
        Degradation of the parameter, with natural parameters of shape ``(n, k)``.
    off, rate : ndarray
        Deviation of ln health from its law now, and its variance per m, shape ``(n,)``.
    now, limit, horizon : float
        Travel in m since the baseline, limit as a fraction of it, and m from now to the horizon.

    References
    ----------
    [Borodin2002]
    """
    left = path.passage(theta, limit * np.exp(-off)) - now
    # A law that gains may have been below the limit before, and is above it now.
    above = path.health(theta, np.array([now]))[:, 0] * np.exp(off) > limit
    left[above & (left <= 0)] = np.inf
    moving = (rate > 0) & (left > 0)
    if moving.any():
        near = np.minimum(_BEYOND * left[moving], 0.5 * horizon)[:, None]
        fraction, rest = np.linspace(0, 1, _NEAR + 1), np.linspace(0, 1, _FAR + 1)[1:]
        ahead = np.hstack([near * fraction, near + (horizon - near) * rest])
        with np.errstate(divide="ignore"):  # health is 0 past the end of a law
            distance = np.log(path.health(theta[moving], now + ahead))
        distance += (off[moving] - np.log(limit))[:, None]
        left[moving] = _with_deviation(distance, ahead, rate[moving], rng)
    return left


def _with_deviation(
    distance: FloatArray, ahead: FloatArray, rate: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Draw the first passage of 0 by a Wiener process about a path, both ``(n, n_grid)``."""
    step = np.diff(ahead, axis=1)
    variance = rate[:, None] * step
    distance[:, 1:] += np.cumsum(np.sqrt(variance) * rng.standard_normal(step.shape), axis=1)
    a, b = distance[:, :-1], distance[:, 1:]
    # Below the limit at the end of the interval, or the bridge touches it in between.
    with np.errstate(invalid="ignore", over="ignore"):
        touched = np.exp(-2 * a * b / variance) > rng.uniform(size=step.shape)
    crossed = (b <= 0) | touched
    first = crossed.argmax(axis=1)[:, None]
    a, b, begin, length = (
        np.take_along_axis(part, first, axis=1)[:, 0] for part in (a, b, ahead[:, :-1], step)
    )
    # First passage t of a bridge of length T that touches 0: t / (T - t) is inverse Gaussian.
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.clip(a / np.abs(b), _RARE, 1 / _RARE)
        odds = rng.wald(mean, np.maximum(a * a / (rate * length), _RARE))
    share = np.where(np.isneginf(b), 0.5, odds / (1 + odds))
    return np.where(crossed.any(axis=1), begin + length * share, np.inf)
