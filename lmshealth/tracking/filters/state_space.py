"""State space of a machine's modes: state vector, observations, process noise and priors.

The state is ``[ℓ, ℓ̇, ln ζ, ℓ₀, w | covariates | biases | steps]``, as the README of this folder
describes. All but the biases are in blocks of the modes, biases and steps have ln f and ln ζ.
"""

from copy import copy
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from math import prod
from typing import Self

import numpy as np

from lmshealth._private.arrays import BoolArray, FloatArray, Rows
from lmshealth.stage.description import Stage
from lmshealth.tracking import constants
from lmshealth.tracking.covariates import regressors
from lmshealth.tracking.history import History, Step


@dataclass(frozen=True, eq=False)
class Hyperparameters(Rows):
    """Process noise and noise scales, one set per filter: standard deviations of ln f and lives.

    There are no slots: what follows from them is kept, because it is needed at every log.
    """

    level_walk: FloatArray  # of the random walk of ln f over a life, ``(n,)``
    rate_std: FloatArray  # of the initial rate per life, 0 for a healthy machine, ``(n,)``
    rate_walk: FloatArray  # of the random walk of the rate over a life, ``(n,)``
    scales: FloatArray  # factor on the reported errors of each source, ``(n, n_sources)``
    log_prior: FloatArray  # log of the prior probability, ``(n,)``
    rate_decay: FloatArray  # by which a rate decays exponentially, per life, ``(n,)``
    wander: FloatArray  # size of the wander in scaled errors of the first estimates, ``(n,)``
    wander_keep: FloatArray  # its correlation from one log to the next, ``(n,)``
    settling: FloatArray  # of the random walk of ln f that ends after a few logs, ``(n,)``
    # Index of the combination of scales and wander: of a machine, whatever its regime, ``(n,)``.
    disturbance: np.ndarray

    @cached_property
    def healthy(self) -> BoolArray:
        """Whether each set has no rate, or one that decays (running-in), shape ``(n,)``."""
        return np.asarray((self.rate_std == 0) | (self.rate_decay > 0))

    @cached_property
    def groups(self) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the healthy and of the changing sets."""
        return np.flatnonzero(self.healthy), np.flatnonzero(~self.healthy)

    @cached_property
    def decays(self) -> bool:
        """Whether a rate of any set decays."""
        return bool((self.rate_decay > 0).any())

    @cached_property
    def wander_variance(self) -> FloatArray:
        """Stationary variance of the wander in errors of the first estimates, shape ``(n,)``."""
        return np.asarray((self.wander * np.exp(np.log(self.scales).mean(axis=1))) ** 2)

    @cached_property
    def process_noise(self) -> FloatArray:
        """Variances of the parts of process noise, in the order of `_process_noise`, ``(n, 7)``."""
        drive, wander = self.rate_walk**2, (1 - self.wander_keep**2) * self.wander_variance
        damping = np.full(drive.size, constants.DAMPING_WALK**2)
        parts = (self.level_walk**2, self.settling**2, drive, drive, drive, wander, damping)
        return np.column_stack(parts)


def hyperparameter_grid(n_sources: int) -> Hyperparameters:
    """Return the grid of hyperparameters that is averaged over."""
    walks, rates = constants.CHANGING_WALKS, constants.CHANGING_RATES
    chance = constants.HEALTHY_PROBABILITY
    courses = [(w, 0.0, 0.0, 0.0, 0.0, chance * p) for w, p in constants.HEALTHY_WALKS]
    for logs, p in constants.RUNNING_IN_LOGS:
        decay = constants.LOGS_PER_LIFE / logs
        size = constants.RUNNING_IN_STD * decay
        courses.append((constants.HEALTHY_WALKS[0][0], size, 0.0, decay, 0.0, chance * p))
    for w, (r, d, share) in product(walks, rates):
        share *= (1 - chance) / len(walks)
        sizes = constants.SETTLING if r <= constants.SLOW_RATE else ((0.0, 1.0),)
        courses += [(w, r, d, 0.0, size, p * share) for size, p in sizes]
    disturbances = np.array(
        [
            (size, np.exp(-1 / logs) if logs else 0.0, p * prod(q for _, q in scales),
             *(scale for scale, _ in scales))
            for scales, (size, logs, p) in product(_scales(n_sources), constants.WANDERS)
        ]
    )  # fmt: skip
    n, m = len(courses), len(disturbances)
    walk, rate, drive, decay, settling, chances = np.repeat(np.array(courses), m, axis=0).T
    size, keep, weight, *scales = np.tile(disturbances, (n, 1)).T
    prior = chances * weight
    log_prior, index = np.log(prior / prior.sum()), np.tile(np.arange(m), n)
    noise = np.stack(scales, axis=1)
    return Hyperparameters(walk, rate, drive, noise, log_prior, decay, size, keep, settling, index)


def _scales(n_sources: int) -> list[tuple[tuple[float, float], ...]]:
    """List the noise scales of all sources, without the most improbable combinations."""
    scaled = min(n_sources, constants.MOST_SCALED_SOURCES)
    choices = list(product(constants.SOURCE_NOISE_SCALES, repeat=scaled))
    least = constants.LEAST_SCALES_PROBABILITY
    rest = n_sources - scaled
    return [
        (*one, *(((one[-1][0], 1.0),) * rest))
        for one in choices
        if scaled == 1 or prod(p for _, p in one) >= least
    ]


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """The estimates that one log has, as all filters use them."""

    rows: np.ndarray  # of ``[ln f, ln ζ]`` of all series, ``(n_rows,)``
    values: FloatArray  # ``(n_rows,)``
    cov: FloatArray  # covariance of the errors as stated, ``(n_rows, n_rows)``
    source: np.ndarray  # index of the source of each, ``(n_rows,)``
    extra: FloatArray | None  # covariance of unknown covariates, as `cov`; None without any


class StateSpace:
    """State space of a history: layout of the state, observations and process noise.

    Rates and random walks are per life of `constants.LOGS_PER_LIFE` logs at their mean distance so
    far. `ticks` are the parts of it between each log that has estimates (`seen`) and the one
    before, `longer` the length of a life over that at the log before, by which rates grow, and
    `settling` the parts of the variance of settling, ``(n_logs,)`` each; `size` is the length of
    the state. `fixed` has the measurement matrices without steps, `observations` the estimates of
    each log; `sources` are those of the series, `mode_of` is the index of the mode of
    each row of ``[ln f, ln ζ]``, ``(2 n_series,)``, and `grid` has the hyperparameters that a
    filter bank starts with.
    """

    def __init__(self, history: History, stage: Stage | None, steps: tuple[Step, ...] = ()) -> None:
        self.history, self.stage, self.steps = history, stage, steps
        regressed = self.regressed = regressors(history.covariates, stage, history.recorded_at)
        m = self.n_modes = len(history.modes)
        self.level, self.rate, self.damping, self.base, self.wander = (
            slice(part * m, (part + 1) * m) for part in range(5)
        )
        self.first_bias = (5 + len(regressed)) * m
        # All series of a mode but the one detected first have a bias.
        there = np.isfinite(history.ln_frequency)
        first = np.where(there.any(axis=0), there.argmax(axis=0), len(there)).tolist()
        series = [history.columns(mode) for mode in history.modes]
        self.biased = [i for own in series for i in own if i != min(own, key=first.__getitem__)]
        self.first_step = self.first_bias + 2 * len(self.biased)
        self.size = self.first_step + 2 * m * len(steps)
        # The mean distance between logs so far is the unit: no horizon has to be known.
        self.seen: BoolArray = np.asarray(np.isfinite(history.ln_frequency).any(axis=1))
        self.seen[:1] = True
        clock = np.where(self.seen, history.clock() - history.clock()[:1], 0.0)
        clock = np.maximum.accumulate(clock)
        logs_so_far = np.cumsum(self.seen) - 1
        logs = logs_so_far / np.where(clock > 0, clock, 1.0)
        self.ticks = np.diff(clock, prepend=0.0) * logs / constants.LOGS_PER_LIFE
        # Until then rates are known little better than by their prior, which is per life of now.
        mean, known = clock / np.maximum(logs_so_far, 1), logs_so_far >= constants.KNOWN_RATE_LOGS
        known = known[:-1] & (mean[:-1] > 0)
        self.longer = np.ones(mean.size)
        self.longer[1:][known] = (mean[1:] / np.where(known, mean[:-1], 1.0))[known]
        since = np.cumsum(self.ticks) * constants.LOGS_PER_LIFE / constants.SETTLING_LOGS
        for first in history.baselines:  # a machine settles anew after work on it
            since[first:] -= since[first]
        left = np.exp(-since)
        self.settling = np.maximum(-np.diff(left, prepend=1.0), 0.0)
        # Contrast ℓ - ℓ₀ of the first entries of a state, ``(n_modes, 4 n_modes)``.
        one, none = np.eye(m), np.zeros((m, m))
        self.drift: FloatArray = np.hstack([one, none, none, -one])
        self._jumps = [(step, self._jump_matrix(step)) for step in steps]
        self.fixed = self._without_steps()
        self.sources = tuple(dict.fromkeys(one.source for one in history.series))
        self.mode_of = np.tile(history.mode_of(), 2)
        self.observations = self._observations()
        self.grid = hyperparameter_grid(len(self.sources))
        # Covariance of a wander as large as the errors of each mode's first estimate.
        std = np.zeros(m)
        for i, mode in enumerate(history.modes):
            variance = np.einsum("kii->ki", history.cov)[:, history.columns(mode)]
            first = variance[np.isfinite(variance)][:1]
            std[i] = np.sqrt(first[0]) if first.size else 0.0
        self.wander_cov = np.outer(std, std) * _correlation(constants.WANDER_COMMON, std.size)
        self.together = _correlation(constants.RATE_COMMON, std.size)
        self.noise, self.noise_shares = self._process_noise()

    def with_step(self, step: Step) -> Self:
        """Return the state space with one more step at the end of the state."""
        longer = copy(self)
        longer.steps = (*self.steps, step)
        longer.size = self.size + 2 * self.n_modes
        longer._jumps = [*self._jumps, (step, self._jump_matrix(step))]
        return longer

    def without(self, k: int, outlying: BoolArray) -> Self:
        """Return the state space without some estimates of log k, ``(2 n_series,)``."""
        other, given = copy(self), self._observations()[k]
        kept = np.flatnonzero(~outlying[given.rows])
        extra = None if given.extra is None else given.extra[kept[:, None], kept]
        own = given.rows[kept], given.values[kept], given.cov[kept[:, None], kept]
        left = Observation(*own, given.source[kept], extra)
        other.observations = [*self.observations[:k], left, *self.observations[k + 1 :]]
        return other

    def backwards(self, first: int, last: int) -> Self:
        """Return the state space of the logs from the last back to the first, without steps."""
        other = type(self)(self.history.backwards(first, last), self.stage)
        # Their distances are all known: a gap before the first log is as long as it was.
        ticks = np.diff(other.history.clock(), prepend=0.0)
        other.ticks = ticks * (last - first) / (max(ticks.sum(), 1e-300) * constants.LOGS_PER_LIFE)
        other.longer = np.ones(ticks.size)
        other.noise, other.noise_shares = other._process_noise()
        return other

    @property
    def effects(self) -> list[tuple[str, str, int]]:
        """Mode, name and place in the state of each coefficient of ln f that is no wear."""
        modes, series = self.history.modes, self.history.series
        places = [(one.name, self.regressor(j).start) for j, one in enumerate(self.regressed)]
        places += [
            (f"{step.kind}:{step.name or step.source}", self.jump(j).start)
            for j, step in enumerate(self.steps)
            if not step.changes_modes
        ]
        found = [(mode, name, at + i) for name, at in places for i, mode in enumerate(modes)]
        for j, one in enumerate(series[i] for i in self.biased):
            found.append((one.mode, f"bias:{one.source}", self.first_bias + 2 * j))
        return found

    def matrix(self, k: int) -> FloatArray:
        """Return the measurement matrix of ``[ln f, ln ζ]`` of log k, ``(2 n_series, size)``."""
        matrix = np.zeros((len(self.mode_of), self.size))
        matrix[:, : self.first_step] = self.fixed[k]
        for j, (step, reading) in enumerate(self._jumps):
            if step.there[k]:
                matrix[:, self.jump(j)] = reading
        return matrix

    def jump_noise(self, k: int) -> FloatArray | None:
        """Return the covariance of the jumps of the steps at log k, ``(size, size)``; None if none.

        Steps that change the modes move ℓ and ln ζ by their jumps.
        """
        begun = [(j, step) for j, step in enumerate(self.steps) if step.first == k]
        if not begun:
            return None
        noise, places = np.zeros((self.size, self.size)), np.arange(self.size)
        moved = np.r_[places[self.level], places[self.damping]]
        for j, step in begun:
            jumps = np.array([step.mode in ("", mode) for mode in self.history.modes])
            variance = np.outer(np.square(constants.JUMP_STD[step.kind]), jumps).ravel()
            own = places[self.jump(j)]
            for row, column in product((own, moved) if step.changes_modes else (own,), repeat=2):
                noise[row, column] += variance
        return noise

    def regressor(self, j: int) -> slice:
        """Return the place of the coefficients of a regressor."""
        return slice((5 + j) * self.n_modes, (6 + j) * self.n_modes)

    def jump(self, j: int) -> slice:
        """Return the place of the jumps of a step: those of ln f, then those of ln ζ."""
        first = self.first_step + 2 * self.n_modes * j
        return slice(first, first + 2 * self.n_modes)

    def _without_steps(self) -> FloatArray:
        """Return all measurement matrices without steps, ``(n_logs, 2 n_series, first_step)``."""
        history, r = self.history, len(self.history.series)
        mode, series = history.mode_of(), np.arange(r)
        matrix = np.zeros((len(history.logs), 2 * r, self.first_step))
        matrix[:, series, mode] = matrix[:, series, self.wander.start + mode] = 1
        matrix[:, r + series, self.damping.start + mode] = 1
        for j, regressor in enumerate(self.regressed):
            matrix[:, series, self.regressor(j).start + mode] = regressor.values[:, None]
        for j, i in enumerate(self.biased):
            matrix[:, i, self.first_bias + 2 * j] = 1
            matrix[:, r + i, self.first_bias + 2 * j + 1] = 1
        return matrix

    def _observations(self) -> list[Observation]:
        """Return the estimates of each log."""
        history, r = self.history, len(self.history.series)
        values = np.hstack([history.ln_frequency, history.ln_damping])
        source = np.array([self.sources.index(one.source) for one in history.series] * 2)
        # Variance of ln f due to unknown covariates, which all series of a mode have in common.
        alike = np.equal.outer(self.mode_of, self.mode_of)
        alike[r:], alike[:, r:] = False, False
        unknown = sum((one.unknown for one in self.regressed), np.zeros(len(values)))
        found = []
        for own, cov, more in zip(values, history.cov, unknown, strict=True):
            rows = np.flatnonzero(np.isfinite(own))
            extra = more * alike[rows[:, None], rows] if more else None
            errors = cov[rows[:, None], rows]
            found.append(Observation(rows, own[rows], errors, source[rows], extra))
        return found

    def _process_noise(self) -> tuple[FloatArray, FloatArray]:
        """Return covariances of the parts of process noise, and their shares in every log.

        They are the random walk of levels, settling, the rates' random walk in levels, between
        levels and rates, and in rates, wander, and the random walk of damping, of unit variance,
        ``(7, (5 n_modes)²)``. The shares, ``(n_logs, 7)``, are of variances per life.
        """
        size, level, rate, single = 5 * self.n_modes, self.level, self.rate, np.eye(self.n_modes)
        parts = np.zeros((7, size, size))
        parts[0, level, level], parts[6, self.damping, self.damping] = single, single
        parts[5, self.wander, self.wander] = self.wander_cov
        for part, row, column in (
            *((1, level, level), (2, level, level), (4, rate, rate)),
            *((3, level, rate), (3, rate, level)),
        ):
            parts[part, row, column] = self.together
        tick, one = self.ticks, np.ones(self.ticks.size)
        shares = [tick, self.settling, tick**3 / 3, tick**2 / 2, tick, one, tick]
        return parts.reshape(7, -1), np.stack(shares, axis=1)

    def _jump_matrix(self, step: Step) -> FloatArray:
        """Return the measurement matrix of the jumps of a step, ``(2 n_series, 2 n_modes)``.

        It is zero for a step that changes the modes: ℓ and ln ζ contain its jumps.
        """
        series, r, m = self.history.series, len(self.history.series), self.n_modes
        reading = np.zeros((2 * r, 2 * m))
        if not step.changes_modes:
            for i, mode in enumerate(self.history.mode_of()):
                if step.source in ("", series[i].source):
                    reading[i, mode] = reading[r + i, m + mode] = 1
        return reading

    def prior(self) -> tuple[FloatArray, FloatArray]:
        """Return mean and covariance before the first log, without rates and steps.

        The mean is each mode's first estimate.
        """
        history = self.history
        mean, std = np.zeros(self.size), np.zeros(self.size)
        for place, values, width in (
            (self.level, history.ln_frequency, constants.LN_F_STD),
            (self.damping, history.ln_damping, constants.LN_ZETA_STD),
        ):
            for i, mode in enumerate(history.modes):
                own = values[:, history.columns(mode)]
                first = own[np.isfinite(own)][:1]
                mean[place.start + i] = first[0] if first.size else 0.0
            std[place] = width
        for j, regressor in enumerate(self.regressed):
            std[self.regressor(j)] = regressor.prior_std
        std[self.first_bias : self.first_step] = np.tile(constants.BIAS_STD, len(self.biased))
        return mean, np.diag(std**2)


def _correlation(common: float, n: int) -> FloatArray:
    """Return the correlation of n quantities that share a part of their variance."""
    return np.asarray(common + (1 - common) * np.eye(n))
