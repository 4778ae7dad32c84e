"""Lives drawn from the tracker's own model, with what is true behind them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from lmshealth.calibration.lives import make_history
from lmshealth.stage.description import Stage, load_stage
from lmshealth.tracking.constants import (
    BIAS_STD,
    DAMPING_WALK,
    KNOWN_RATE_LOGS,
    LOGS_PER_LIFE,
    RATE_COMMON,
    SETTLING_LOGS,
    WANDER_COMMON,
)
from lmshealth.tracking.filters import kalman_filters
from lmshealth.tracking.filters.state_space import Hyperparameters, StateSpace, hyperparameter_grid
from lmshealth.tracking.history import History, Series

Array = NDArray[np.float64]
QUANTITIES = ("ln f", "ln ζ", "drift")
HORIZON = 2e7  # m of travel in a life
REFERENCE, TEMPERATURE_STD = 21.0, 1e-3
MODES = ("roll", "pitch")
LEVEL, DAMPING = np.log([126.4, 136.6]), np.log([0.018, 0.015])
DESCRIPTION = f"""
name = "small"
[[mode]]
name = "roll"
frequency_hz = 126.4
damping_ratio = 0.018
[[mode]]
name = "pitch"
frequency_hz = 136.6
damping_ratio = 0.015
[[covariate]]
name = "temperature_c"
reference = {REFERENCE}
prior_std = {TEMPERATURE_STD}
[usage]
horizon_km = {HORIZON / 1000}
"""


@dataclass(frozen=True)
class Life:
    """A history, the setting it was drawn with, and the true ln f and ln ζ."""

    history: History
    setting: Hyperparameters
    level: Array
    damping: Array

    def truth(self) -> dict[str, Array]:
        """Return ln f, ln ζ and drift since the first log, ``(n_logs, n_modes)``."""
        return {"ln f": self.level, "ln ζ": self.damping, "drift": self.level - self.level[0]}


def stage() -> Stage:
    """Describe the machine: two modes, temperature, a life of 20,000 km."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "small.toml"
        path.write_text(DESCRIPTION, encoding="utf-8")
        return load_stage(str(path))


def draw(rng: np.random.Generator, sources: tuple[str, ...] = ("acc",)) -> Life:
    """Draw a life of 20 to 40 logs: setting, rates, walks, coefficients, biases and errors.

    Errors of the estimates of a log are correlated, by 0.9 where two sources see one mode; a
    tenth of the estimates and of the temperatures are missing.
    """
    grid = hyperparameter_grid(len(sources))
    chosen = grid[rng.choice(grid.rate_std.size, size=1, p=np.exp(grid.log_prior))]
    n, m, r = int(rng.integers(20, 41)), len(MODES), len(MODES) * len(sources)
    travel = np.cumsum(np.r_[1e5, HORIZON * rng.uniform(0.002, 0.05, n - 1)])
    missing = rng.random((n, r)) < 0.1
    missing[0] = False
    seen = np.asarray(~missing.all(axis=1))
    level, damping = _walk(rng, chosen, *_ticks(travel, seen))
    temperature, effect = _temperature(rng, n)
    mode = np.tile(np.arange(m), len(sources))
    bias = rng.standard_normal((2, r)) * np.array(BIAS_STD)[:, None]
    bias[:, :m] = 0.0
    cov = _covariance(rng, n, len(sources))
    scales = np.tile(np.repeat(chosen.scales[0], m), 2)
    noise = (np.linalg.cholesky(cov) @ rng.standard_normal((n, 2 * r, 1)))[:, :, 0] * scales
    wander = _wander(rng, chosen, np.sqrt(np.diag(cov[0]))[:m], seen)
    ln_frequency = (level + effect + wander)[:, mode] + bias[0] + noise[:, :r]
    ln_damping = damping[:, mode] + bias[1] + noise[:, r:]
    history = make_history(
        MODES,
        travel,
        (ln_frequency, ln_damping, cov),
        series=[Series(name, source) for source in sources for name in MODES],
        covariates={"temperature_c": temperature},
        missing=missing,
    )
    return Life(history, chosen, level, damping)


def _walk(
    rng: np.random.Generator, chosen: Hyperparameters, ticks: Array, longer: Array
) -> tuple[Array, Array]:
    """Let both modes wander: ln f and ln ζ, ``(n_logs, n_modes)`` each."""
    m = len(MODES)
    rate = chosen.rate_std * _together(rng, RATE_COMMON)
    decay = float(chosen.rate_decay[0])
    level, damping = [LEVEL], [DAMPING]
    settled = np.exp(-np.cumsum(np.r_[0.0, ticks]) * LOGS_PER_LIFE / SETTLING_LOGS)
    for tick, more, settling in zip(ticks, longer, -np.diff(settled), strict=True):
        rate = more * rate
        # The integral of a walk, and the walk itself, over one tick.
        bend = chosen.rate_walk * np.sqrt(tick) * _together(rng, RATE_COMMON)
        rest = chosen.rate_walk * np.sqrt(tick**3 / 12) * _together(rng, RATE_COMMON)
        own = chosen.level_walk * np.sqrt(tick) * rng.standard_normal(m)
        own += chosen.settling * np.sqrt(settling) * _together(rng, RATE_COMMON)
        far = -np.expm1(-decay * tick) / decay if decay else tick
        level.append(level[-1] + rate * far + bend * tick / 2 + rest + own)
        rate = rate * np.exp(-decay * tick) + bend
        damping.append(damping[-1] + DAMPING_WALK * np.sqrt(tick) * rng.standard_normal(m))
    return np.array(level), np.array(damping)


def _ticks(travel: Array, seen: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return the parts of a life between logs, and by how much the life of the latter is longer.

    The unit is their mean distance so far; from the tenth on rates keep their value if it changes.
    """
    ticks, longer, before, count, mean = [], [], 0.0, 0, 1.0
    for s, there in zip(travel[1:] - travel[0], seen[1:], strict=True):
        known, count = count >= KNOWN_RATE_LOGS and there, count + int(there)
        ticks.append((s - before) * count / s / LOGS_PER_LIFE if there else 0.0)
        longer.append(s / count / mean if known else 1.0)
        before, mean = (s, s / count) if there else (before, mean)
    return np.array(ticks), np.array(longer)


def _together(rng: np.random.Generator, common: float) -> Array:
    """Draw a standard normal number for each mode, with a share of variance in common."""
    own = np.sqrt(1 - common) * rng.standard_normal(len(MODES))
    return np.asarray(np.sqrt(common) * rng.standard_normal() + own)


def _wander(
    rng: np.random.Generator, chosen: Hyperparameters, std: Array, seen: NDArray[np.bool_]
) -> Array:
    """Draw the wander of both modes about their level, ``(n_logs, n_modes)``."""
    size = float(chosen.wander[0] * np.exp(np.log(chosen.scales[0]).mean())) * std
    keep = float(chosen.wander_keep[0])
    found = [size * _together(rng, WANDER_COMMON)]
    for there in seen[1:]:
        new = np.sqrt(1 - keep**2) * size * _together(rng, WANDER_COMMON)
        found.append(keep * found[-1] + new if there else found[-1])
    return np.array(found)


def _temperature(rng: np.random.Generator, n: int) -> tuple[Array, Array]:
    """Draw temperatures, some unknown, and their effect on ln f of both modes."""
    temperature = REFERENCE + 5 * rng.standard_normal(n)
    temperature[1:][rng.random(n - 1) < 0.1] = np.nan
    effect = np.empty((n, len(MODES)))
    coefficient = TEMPERATURE_STD * rng.standard_normal(len(MODES))
    for k in range(n):
        known = temperature[:k][np.isfinite(temperature[:k])]
        lost = np.isnan(temperature[k])  # then it is about the mean of those before
        spread = TEMPERATURE_STD * max(float(np.std(known)), 1.0) if lost else 0.0
        value = np.mean(known) if lost else temperature[k]
        effect[k] = rng.normal(coefficient * (value - REFERENCE), spread)
    return temperature, effect


def _covariance(rng: np.random.Generator, n: int, n_sources: int) -> Array:
    """Draw covariances of ``[ln f, ln ζ]`` of all series, ``(n, 2 n_series, 2 n_series)``."""
    m = len(MODES)
    std = np.exp(np.log([5e-4, 0.05])[:, None] + 0.3 * rng.standard_normal((n, 2, 1)))
    std = np.repeat(std, m * n_sources, axis=2).reshape(n, -1)
    # Modes, and ln f with ln ζ, are correlated by chance; sources of one mode by 0.9.
    root = np.eye(2 * m) + 0.3 * rng.standard_normal((n, 2 * m, 2 * m))
    own = root @ np.swapaxes(root, 1, 2)
    size = np.sqrt(np.einsum("kii->ki", own))
    own = (own / (size[:, :, None] * size[:, None, :])).reshape(n, 2, m, 2, m)
    common = 0.9 + 0.1 * np.eye(n_sources)
    both = np.einsum("kpiqj,ab->kpaiqbj", own, common).reshape(n, std.shape[1], -1)
    return np.asarray(both * std[:, :, None] * std[:, None, :])


def alone(history: History, source: str) -> History:
    """Return the history that one source alone makes."""
    columns = [i for i, one in enumerate(history.series) if one.source == source]
    both = np.r_[columns, np.add(columns, len(history.series))]
    return replace(
        history,
        series=tuple(history.series[i] for i in columns),
        ln_frequency=history.ln_frequency[:, columns],
        ln_damping=history.ln_damping[:, columns],
        cov=history.cov[:, both[:, None], both],
    )


def without_common_errors(history: History) -> History:
    """Return the history as if the errors of two sources were independent."""
    source = np.array([one.source for one in history.series] * 2)
    same = source[:, None] == source
    return replace(history, cov=np.where(np.isnan(history.cov) | same, history.cov, 0.0))


def banks(
    history: History, machine: Stage | None, setting: Hyperparameters
) -> Iterator[tuple[kalman_filters.FilterBank, float]]:
    """Filter log by log with one setting; yield the bank and the squared innovation.

    The lives have no outliers and the other programs know none: the filter looks for none either.
    """
    space = StateSpace(history, machine)
    space.grid = replace(setting, log_prior=np.zeros(1))
    bank = kalman_filters.initial(space)
    for k in range(len(history.logs)):
        before = kalman_filters.predict(space, bank, k)
        bank, innovation = kalman_filters.update(space, before, k, outliers=False)
        yield bank, float(innovation.nis)


@dataclass(frozen=True)
class Filtered:
    """Mean and covariance of each quantity by the filter of the right setting, log by log.

    ``nis`` is the normalised innovation squared of every log but the first, ``dof`` its degrees of
    freedom.
    """

    mean: dict[str, Array]
    cov: dict[str, Array]
    nis: Array
    dof: Array


def filtered(life: Life, machine: Stage) -> Filtered:
    """Filter a life by the setting it was drawn with."""
    space = StateSpace(life.history, machine)
    n, m = len(life.history.logs), space.n_modes
    contrasts = {name: np.zeros((m, space.size)) for name in QUANTITIES}
    contrasts["ln f"][:, space.level] = contrasts["drift"][:, space.level] = np.eye(m)
    contrasts["drift"][:, space.base] = -np.eye(m)
    contrasts["ln ζ"][:, space.damping] = np.eye(m)
    mean = {name: np.empty((n, m)) for name in contrasts}
    cov = {name: np.empty((n, m, m)) for name in contrasts}
    nis = np.empty(n)
    for k, (bank, innovation) in enumerate(banks(life.history, machine, life.setting)):
        nis[k] = innovation
        for name, contrast in contrasts.items():
            mean[name][k] = contrast @ bank.mean[0]
            cov[name][k] = contrast @ bank.cov[0] @ contrast.T
    # The prior is centred on the first log, which has no innovation.
    dof = 2.0 * np.isfinite(life.history.ln_frequency).sum(axis=1)
    return Filtered(mean, cov, nis[1:], dof[1:])


def mixture(life: Life, machine: Stage, k: int, i: int) -> dict[str, float]:
    """Return the probability below the truth in the average over all settings, at one log."""
    space = StateSpace(life.history, machine)
    bank = kalman_filters.advance(space, kalman_filters.initial(space), 0, k)
    level, base, damping = (part.start + i for part in (space.level, space.base, space.damping))
    places = {"ln f": [level], "ln ζ": [damping], "drift": [level, base]}
    below = {}
    for name, own in places.items():
        sign = np.array([1.0, -1.0])[: len(own)]
        mean = bank.mean[:, own] @ sign
        variance = np.einsum("a,gab,b->g", sign, bank.cov[:, own][:, :, own], sign)
        off = (life.truth()[name][k, i] - mean) / np.sqrt(np.maximum(variance, 1e-24))
        below[name] = float(bank.weight @ stats.norm.cdf(off))
    return below
