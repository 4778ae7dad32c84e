"""Remaining life as we draw it, and by a straight line through the health of single epochs."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from lmshealth.health.epoch_posterior import EpochPosterior
from lmshealth.health.laplace import approximate
from lmshealth.prognosis.life_posterior import LifePosterior, fit_life
from lmshealth.prognosis.remaining_life import (
    identifiable_limits,
    parameters_with_limit,
    remaining_travel,
)
from lmshealth.stage.description import Stage
from lmshealth.tracking.history import History
from lmshealth.tracking.track import track
from studies.common.lives import Array

N_DRAWS = 10_000
_N_BEGIN = 64
_KM = 1000.0


@dataclass(frozen=True, slots=True, eq=False)
class Futures:
    """What a posterior states of the time to come."""

    remaining: Array  # Draws of the travel in m to the first limit, shape ``(n_draws,)``
    # The draws that they are from, each of shape ``(n_draws,)``: travel now, life and exponent of
    # the wear, floor and length of the loosening, of either parameter ln of health over its law,
    # and the variance that every unit of travel adds to these; lengths in km
    states: dict[str, Array]
    posterior_s: float  # Processor times of both steps
    futures_s: float


def ours(history: History, stage: Stage, seed: list[int]) -> Futures:
    """Draw the remaining life as `prognose` does, but without chains."""
    begin = time.process_time()
    # Chains would take five times as long, and say the same (sbc_life judges both).
    life = fit_life(history, stage, seed, chains=False)
    fitted = time.process_time()
    remaining = futures(life, history, stage, seed)
    ended = time.process_time()
    return Futures(remaining, states_of(life, history), fitted - begin, ended - fitted)


def futures(life: LifePosterior, history: History, stage: Stage, seed: list[int]) -> Array:
    """Draw the travel to the first limit from a posterior."""
    return remaining_travel(
        life,
        identifiable_limits(stage, life.modes),
        np.random.default_rng(seed),
        now=_since_baseline(history),
        horizon=stage.description.usage.horizon_km * _KM,
    )[:, -1]


def _since_baseline(history: History) -> float:
    return float(history.travel[-1] - history.travel[history.baseline])


def states_of(life: LifePosterior, history: History) -> dict[str, Array]:
    """Write every draw as wear and loosening; of what never changes nothing is ever lost."""
    now, parts = _since_baseline(history), []
    for way, off, rate in life.by_scenario():
        n = rate.shape[0]
        never = np.full(n, np.inf), np.ones(n)
        theta = way.scenario.split(way.scenario.natural(way.mixture_draws))
        pairs = zip(way.scenario.paths, theta, strict=True)
        by_law = {path.law.kind: own for path, own in pairs}
        wear = by_law["hertz-wear"].T if "hertz-wear" in by_law else never
        floor, length = by_law["loosening"].T if "loosening" in by_law else never[::-1]
        parts.append(
            {
                "travel": np.full(n, now / _KM),
                "life": wear[0] / _KM,
                "exponent": wear[1],
                "floor": floor,
                "length": length / _KM,
                "off_preload": off[:, 0],
                "off_mount": off[:, 1],
                "rate": rate[:, 0] * _KM,  # the same of both
            }
        )
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def health_index(history: History, stage: Stage) -> tuple[Array, Array]:
    """Return the health of single epochs, without a law.

    It is the mode of the posterior that `infer` draws from, for a median.

    Returns
    -------
    travel : ndarray
        Of the epochs in m, from now, shape ``(n,)``.
    health : ndarray
        Shape ``(n, n_parameters)``.
    """
    followed, prior = track(history, stage), stage.prior
    begin = prior.draw(np.random.default_rng(0), _N_BEGIN)
    low, high = prior.support
    epochs, found = [], []
    for k in range(history.baseline + 1, len(history.logs)):
        posterior = EpochPosterior.of(
            stage, followed.modes, followed.drift[k], followed.drift_cov[k]
        )
        normal = approximate(posterior.log_probability, begin, low, high)
        if normal is not None:
            epochs.append(k)
            found.append(np.exp(normal.mode))
    return history.travel[epochs] - history.travel[-1], np.array(found)


def linear(history: History, stage: Stage, rng: np.random.Generator) -> Array:
    """Extrapolate the health index by least squares to the first limit, with what is not known.

    Lines are drawn from the posterior of the regression under a flat prior, both parameters
    together, and what a next reading would be off its line is added, so that quantiles of health
    are the ends of prediction intervals.

    Returns
    -------
    ndarray
        Draws of the travel left in m, infinite where a line does not fall, shape ``(N_DRAWS,)``.
    """
    s, health = health_index(history, stage)
    x = np.column_stack([np.ones_like(s), s])
    best, *_ = np.linalg.lstsq(x, health, rcond=None)
    off, freedom = health - x @ best, s.size - 2
    scatter = np.linalg.cholesky(off.T @ off / freedom)
    root = np.linalg.cholesky(np.linalg.inv(x.T @ x))
    scale = np.sqrt(freedom / rng.chisquare(freedom, (N_DRAWS, 1, 1)))
    normal = rng.standard_normal((N_DRAWS, 3, health.shape[1])) @ scatter.T * scale
    lines = best + root @ normal[:, :2]
    level, slope = lines[:, 0] + normal[:, 2], lines[:, 1]
    limits = np.array(
        [p.limit.below for _, p in parameters_with_limit(stage) if p.limit is not None]
    )
    falling = slope < 0
    passed = (limits - level) / np.where(falling, slope, 1.0)
    ends = np.where(falling, passed, np.where(level <= limits, 0.0, np.inf))
    return np.asarray(ends.min(axis=1))
