"""Ways to the remaining life: ours, a line through the health of single epochs, and progpy."""

from __future__ import annotations

import time
from importlib.util import find_spec

import numpy as np

from lmshealth.errors import NotConverged
from lmshealth.health.epoch_posterior import EpochPosterior
from lmshealth.health.laplace import approximate
from lmshealth.prognosis.life_posterior import LifePosterior, fit_life
from lmshealth.prognosis.remaining_life import (
    identifiable_limits,
    parameters_with_limit,
    passages,
)
from lmshealth.stage.description import Stage
from lmshealth.tracking.history import History
from lmshealth.tracking.track import track
from studies.common.lives import Array

OURS, LINE, PROGPY = "lmshealth", "line", "progpy"
KEPT, CONTROL = "progpy, all runs kept", "a tenth of the spread"
WAYS = (OURS, LINE, PROGPY, KEPT, CONTROL)
MISSING = "progpy: not installed; pip install '.[peers]'"
N_DRAWS = 10_000
_N_BEGIN = 64
_KM = 1000.0


def all_ways(
    history: History, stage: Stage, seed: list[int], rng: np.random.Generator
) -> tuple[dict[str, Array], dict[str, float]]:
    """Draw the remaining life in m in every way, with the processor times of the steps in s.

    Draws are infinite where life does not end, and at least 0: the machine still runs.
    """
    horizon = 1000 * stage.description.usage.horizon_km
    draws, seconds = {LINE: linear(history, stage, rng)}, {}
    begin = time.process_time()
    try:
        # Chains would take five times as long, with the same results (sbc_life judges both).
        life = fit_life(history, stage, seed, chains=False)
    except NotConverged:
        life = None
    if life is not None:
        fitted = time.process_time()
        draws[OURS] = futures(life, history, stage, seed)
        seconds = {"posterior": fitted - begin, OURS: time.process_time() - fitted}
        middle = np.median(draws[OURS])
        finite = np.isfinite(middle)
        draws[CONTROL] = middle + (draws[OURS] - middle) / 10 if finite else draws[OURS]
        if find_spec("progpy"):
            from studies.rul_metrics.by_progpy import predicted

            ends, seconds[PROGPY] = predicted(states_of(life, history), horizon, rng)
            draws[KEPT] = np.where(np.isnan(ends), np.inf, ends)
            if np.isfinite(ends).any():
                draws[PROGPY] = ends[np.isfinite(ends)]
    return {name: np.maximum(own, 0.0) for name, own in draws.items()}, seconds


def futures(life: LifePosterior, history: History, stage: Stage, seed: list[int]) -> Array:
    """Draw the travel to the first limit from a posterior, as `prognose` does."""
    limits, rng = identifiable_limits(stage, life.modes), np.random.default_rng(seed)
    horizon = stage.description.usage.horizon_km * _KM
    now = _since_baseline(history)
    return passages(life, limits, rng, now=now, horizon=horizon)[0][:, -1]


def _since_baseline(history: History) -> float:
    return float(history.travel[-1] - history.travel[history.baseline])


def states_of(life: LifePosterior, history: History) -> dict[str, Array]:
    """Express every draw of a posterior as states of progpy's model, lengths in km.

    These are the travel, life and exponent of wear, floor and length of loosening, ln of either
    health over its law, and the variance that every km adds to it.
    """
    now, parts = _since_baseline(history), []
    for way, off, rate in life.by_scenario():
        # Not a law of that model: its share of the draws goes to the other laws.
        if any(path.law.kind == "accelerating" for path in way.scenario.paths):
            continue
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
    """Return the travel in m from now and the health (posterior mode) of single epochs."""
    followed = track(history, stage)
    begin = stage.prior.draw(np.random.default_rng(0), _N_BEGIN)
    epochs, found = [], []
    for k in range(history.baseline + 1, len(history.logs)):
        drift = followed.drift[k], followed.drift_cov[k]
        posterior = EpochPosterior.of(stage, followed.modes, *drift)
        normal = approximate(posterior.log_probability, begin, *stage.prior.support)
        if normal is not None:
            epochs.append(k)
            found.append(np.exp(normal.mode))
    return history.travel[epochs] - history.travel[-1], np.array(found)


def linear(history: History, stage: Stage, rng: np.random.Generator) -> Array:
    """Extrapolate the health index by least squares to the first limit.

    Lines are drawn from the posterior of the regression under a flat prior, both parameters
    together, with the scatter of one more reading, so that quantiles of health are the ends of
    prediction intervals. Draws are infinite where a line does not fall.
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
    limits = np.array([p.limit.below for _, p in parameters_with_limit(stage)])
    falling = slope < 0
    passed = (limits - level) / np.where(falling, slope, 1.0)
    ends = np.where(falling, passed, np.where(level <= limits, 0.0, np.inf))
    return np.asarray(ends.min(axis=1))
