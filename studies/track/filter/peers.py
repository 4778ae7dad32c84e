"""Other filters on the same numbers: filterpy log by log, simdkalman, statsmodels."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
from filterpy.kalman import KalmanFilter

from lmshealth.calibration.lives import make_history
from lmshealth.stage.description import Stage
from lmshealth.tracking import constants
from lmshealth.tracking.constants import (
    DAMPING_WALK,
    LN_F_STD,
    LN_ZETA_STD,
    LOGS_PER_LIFE,
    SETTLING_LOGS,
    WANDER_COMMON,
)
from lmshealth.tracking.filters.state_space import Hyperparameters, StateSpace
from lmshealth.tracking.history import History
from lmshealth.tracking.track import track
from studies.harness.cost import in_turns
from studies.harness.study import Row
from studies.track.filter.lives import Array, banks, draw, filtered

STD = (5e-4, 0.05)
# One setting for all: walk of ln f, its rate per life, and no walk of the rate.
LEVEL_WALK, RATE_STD = 1e-3, 0.03


class Loop(NamedTuple):
    """Ln f, its standard deviation, and the drift with its own, ``(n_logs, n_modes)`` each."""

    level: Array
    level_std: Array
    drift: Array
    drift_std: Array


def filterpy_loop(space: StateSpace, setting: Hyperparameters) -> Loop:
    """Filter one setting by filterpy: [ln f, rate, ln ζ, baseline, wander, coefficients].

    Of the state space are the history, its regressors, and the parts of a life between its logs.
    """
    history, ticks, longer, regressed = space.history, space.ticks, space.longer, space.regressed
    m, n = len(history.modes), len(history.logs)
    level, rate, damping, base, own = (slice(part * m, (part + 1) * m) for part in range(5))
    size = (5 + len(regressed)) * m
    kalman = KalmanFilter(dim_x=size, dim_z=2 * m)
    prior = [LN_F_STD, 0.0, LN_ZETA_STD, 0.0, 0.0, *(r.prior_std for r in regressed)]
    kalman.x = np.zeros(size)
    kalman.x[level], kalman.x[damping] = history.ln_frequency[0], history.ln_damping[0]
    kalman.P = np.diag(np.square(np.repeat(prior, m)))
    values = np.hstack([history.ln_frequency, history.ln_damping])
    eye = np.eye(m)
    common = constants.RATE_COMMON
    alike = common + (1 - common) * eye
    std = np.sqrt(np.diag(history.cov[0]))[:m] * setting.wander[0] * setting.scales[0, 0]
    wander = np.outer(std, std) * (WANDER_COMMON + (1 - WANDER_COMMON) * eye)
    kalman.P[rate, rate], kalman.P[own, own] = setting.rate_std[0] ** 2 * alike, wander
    decay = float(setting.rate_decay[0])
    there = np.asarray(np.isfinite(history.ln_frequency).any(axis=1))
    left = np.exp(-np.cumsum(ticks) * LOGS_PER_LIFE / SETTLING_LOGS)
    settling = setting.settling[0] ** 2 * -np.diff(left, prepend=1.0)
    states, covs = np.empty((n, size)), np.empty((n, size, size))
    for k, tick in enumerate(ticks):
        f, q = np.eye(size), np.zeros((size, size))
        bend = setting.rate_walk[0] ** 2 * alike
        f[level, rate] = longer[k] * (-np.expm1(-decay * tick) / decay if decay else tick) * eye
        f[rate, rate] = longer[k] * np.exp(-decay * tick) * eye
        q[level, level] = setting.level_walk[0] ** 2 * tick * eye + bend * tick**3 / 3
        q[level, level] += settling[k] * alike
        q[level, rate] = q[rate, level] = bend * tick**2 / 2
        q[rate, rate] = bend * tick
        keep = setting.wander_keep[0] if k and there[k] else 1.0
        f[own, own], q[own, own] = keep * eye, (1 - keep**2) * wander
        q[damping, damping] = DAMPING_WALK**2 * tick * eye
        kalman.predict(F=f, Q=q)
        if k == 0:
            copy = np.eye(size)
            copy[base, base], copy[base, level] = 0.0, eye
            kalman.x, kalman.P = copy @ kalman.x, copy @ kalman.P @ copy.T
        h = np.zeros((2 * m, size))
        h[:m, level] = h[m:, damping] = h[:m, own] = eye
        noise = history.cov[k] * setting.scales[0, 0] ** 2
        for j, one in enumerate(regressed):
            h[:m, (5 + j) * m : (6 + j) * m] = one.values[k] * eye
            noise = noise + np.diag(np.r_[np.full(m, one.unknown[k]), np.zeros(m)])
        rows = np.flatnonzero(np.isfinite(values[k]))
        if rows.size:
            kalman.update(values[k, rows], R=noise[np.ix_(rows, rows)], H=h[rows])
        states[k], covs[k] = kalman.x, kalman.P
    variance = np.einsum("kii->ki", covs)
    both = np.einsum("kii->ki", covs[:, level, base])
    drift_variance = variance[:, level] + variance[:, base] - 2 * both
    return Loop(
        states[:, level],
        np.sqrt(variance[:, level]),
        states[:, level] - states[:, base],
        np.sqrt(np.maximum(drift_variance, 0.0)),
    )


def deviation(rng: np.random.Generator, n: int, machine: Stage) -> dict[str, float]:
    """Compare the bank with filterpy on drawn lives: largest difference in standard deviations."""
    worst = {"ln f": 0.0, "std of ln f": 0.0, "drift": 0.0}
    for _ in range(n):
        life = draw(rng)
        found, space = filtered(life, machine), StateSpace(life.history, machine)
        book = filterpy_loop(space, life.setting)
        std = np.sqrt(np.einsum("kii->ki", found.cov["ln f"]))
        # Drifts of machines that hardly wander have next to no std, but numbers of ln f.
        wide = np.maximum(book.drift_std, 0.1 * std)
        for name, off in (
            ("ln f", (found.mean["ln f"] - book.level) / std),
            ("std of ln f", std / book.level_std - 1),
            ("drift", (found.mean["drift"] - book.drift) / wide),
        ):
            worst[name] = max(worst[name], float(np.abs(off).max()))
    return {"lives": n, **worst}


def long_life(n: int, m: int) -> History:
    """Make a long healthy life of evenly spaced logs with errors of one constant size."""
    rng = np.random.default_rng(7)
    walk = np.cumsum(rng.standard_normal((n, m)) * LEVEL_WALK / np.sqrt(n), axis=0)
    ln_frequency = 5 + walk + STD[0] * rng.standard_normal((n, m))
    ln_damping = -4 + STD[1] * rng.standard_normal((n, m))
    cov = np.tile(np.diag(np.repeat(STD, m) ** 2), (n, 1, 1))
    modes = [f"mode {i + 1}" for i in range(m)]
    return make_history(modes, 1e3 * np.arange(n, dtype=float), (ln_frequency, ln_damping, cov))


def one_setting() -> Hyperparameters:
    """Return the setting that all of them can express."""
    return Hyperparameters(
        np.array([LEVEL_WALK]),
        np.array([RATE_STD]),
        np.zeros(1),
        np.ones((1, 1)),
        np.zeros(1),
        *np.zeros((5, 1)),
    )


def bank_of_one(history: History) -> tuple[Array, Array]:
    """Filter by the bank with one setting: ln f and its std, ``(n_logs, n_modes)``."""
    level = StateSpace(history, None).level
    rows = [
        (bank.mean[0, level], np.diag(bank.cov[0])[level])
        for bank, _ in banks(history, None, one_setting())
    ]
    return np.array([mean for mean, _ in rows]), np.sqrt([variance for _, variance in rows])


def by_simdkalman(history: History) -> tuple[Array, Array]:
    """Filter ln f of all modes as series of their own by simdkalman."""
    import simdkalman

    tick = 1 / LOGS_PER_LIFE
    kalman = simdkalman.KalmanFilter(
        state_transition=np.array([[1.0, tick], [0.0, 1.0]]),
        process_noise=np.diag([LEVEL_WALK**2 * tick, 0.0]),
        observation_model=np.array([[1.0, 0.0]]),
        observation_noise=STD[0] ** 2,
    )
    first = np.stack([history.ln_frequency[0], np.zeros(len(history.modes))], axis=1)
    found = kalman.compute(
        history.ln_frequency.T,
        0,
        initial_value=first[:, :, None],
        initial_covariance=np.diag([LN_F_STD**2, RATE_STD**2]),
        smoothed=False,
        filtered=True,
    ).filtered.states
    return found.mean[:, :, 0].T, np.sqrt(found.cov[:, :, 0, 0]).T


def by_statsmodels(history: History) -> tuple[Array, Array]:
    """Filter ln f mode by mode by the local linear trend of statsmodels, variances given.

    Its trend counts per log. It takes a covariance that changes by less than 1e-19 as steady,
    which variances of 1e-8 are not: that is switched off.
    """
    from statsmodels.tsa.statespace.structural import UnobservedComponents

    tick = 1 / LOGS_PER_LIFE
    prior = np.diag([LN_F_STD**2, (RATE_STD * tick) ** 2])
    means, stds = [], []
    for column in history.ln_frequency.T:
        model = UnobservedComponents(column, level="lltrend")
        model.ssm.tolerance = 0.0
        model.ssm.initialize_known(np.array([column[0], 0.0]), prior)
        found = model.filter([STD[0] ** 2, LEVEL_WALK**2 * tick, 0.0])
        means.append(found.filtered_state[0])
        stds.append(np.sqrt(found.filtered_state_cov[0, 0]))
    return np.array(means).T, np.array(stds).T


PEERS = {"simdkalman": by_simdkalman, "statsmodels": by_statsmodels}
LOOP = "filterpy, one setting"


def speed(n: int, m: int, repeats: int) -> Row:
    """Compare numbers and processor time on one long life; programs take turns."""
    history = long_life(n, m)
    # The other programs take modes for independent: so do ours here.
    with patch.object(constants, "RATE_COMMON", 0.0):
        space = StateSpace(history, None)
        mean, std = bank_of_one(history)
        there = {name: work for name, work in PEERS.items() if find_spec(name)}
        others: dict[str, Callable[[], tuple[Array, Array]]] = {
            LOOP: lambda: filterpy_loop(space, one_setting())[:2],
            **{name: partial(work, history) for name, work in there.items()},
        }
        works = {
            LOOP: others[LOOP],
            "bank, one setting": lambda: bank_of_one(history),
            "track, all settings": lambda: track(history),
            **others,
        }
        times = in_turns(works, repeats)
        rows = []
        for name, taken in times.items():
            ratio = float(np.median(np.divide(taken, times[LOOP])))
            row: Row = {"program": name, "cpu_s": min(taken), "times_filterpy": ratio}
            if name in others:
                other, other_std = others[name]()
                row["deviation"] = float(np.abs((other - mean) / std).max())
                row["deviation_of_std"] = float(np.abs(other_std / std - 1).max())
            rows.append(row)
    versions = {name: version(name) for name in there}
    missing = [name for name in PEERS if name not in there]
    return {"epochs": n, "modes": m, "programs": rows, "missing": missing, "versions": versions}
