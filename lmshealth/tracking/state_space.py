"""State space of a machine's modes: state vector, measurement matrices and prior.

The state is ``[ℓ, ℓ̇, ln ζ, ℓ₀, w | covariates | biases | steps]``, as the README of this folder
describes. All but the biases are in blocks of the modes, biases and steps have ln f and ln ζ.
"""

from copy import copy
from typing import Self

import numpy as np

from lmshealth._private.arrays import BoolArray, FloatArray
from lmshealth.stage.description import Stage
from lmshealth.tracking import constants
from lmshealth.tracking.covariates import regressors
from lmshealth.tracking.history import History, Step


class StateSpace:
    """Layout of the state, and the measurement matrices of a history.

    Rates and random walks are per life of `constants.LOGS_PER_LIFE` logs at their mean distance so
    far. `ticks` are the parts of it between each log that has estimates (`seen`) and the one
    before, and `settling` the parts of the variance of settling, ``(n_logs,)`` each; `size` is the
    length of the state; `fixed` has the measurement matrices without steps.
    """

    def __init__(self, history: History, stage: Stage | None, steps: tuple[Step, ...] = ()) -> None:
        self.history, self.steps = history, steps
        regressed = self.regressed = regressors(history.covariates, stage, history.recorded_at)
        m = self.n_modes = len(history.modes)
        self.level, self.rate, self.damping, self.base, self.wander = (
            slice(part * m, (part + 1) * m) for part in range(5)
        )
        self.first_bias = (5 + len(regressed)) * m
        self.biased = self._biased()
        self.first_step = self.first_bias + 2 * len(self.biased)
        self.size = self.first_step + 2 * m * len(steps)
        # The mean distance between logs so far is the unit: no horizon has to be known.
        self.seen: BoolArray = np.asarray(np.isfinite(history.ln_frequency).any(axis=1))
        self.seen[:1] = True
        clock = np.where(self.seen, history.clock() - history.clock()[:1], 0.0)
        clock = np.maximum.accumulate(clock)
        logs = (np.cumsum(self.seen) - 1) / np.where(clock > 0, clock, 1.0)
        self.ticks = np.diff(clock, prepend=0.0) * logs / constants.LOGS_PER_LIFE
        since = np.cumsum(self.ticks) * constants.LOGS_PER_LIFE / constants.SETTLING_LOGS
        for first in history.baselines:  # a machine settles anew after work on it
            since[first:] -= since[first]
        left = np.exp(-since)
        self.settling = np.maximum(-np.diff(left, prepend=1.0), 0.0)
        # Contrast ℓ - ℓ₀ of the first entries of a state, ``(n_modes, 4 n_modes)``.
        one, none = np.eye(m), np.zeros((m, m))
        self.drift: FloatArray = np.hstack([one, none, none, -one])
        self.fixed = self._without_steps()
        self._jumps = [(step, self._jump_matrix(step)) for step in steps]

    def with_step(self, step: Step) -> Self:
        """Return the state space with one more step at the end of the state."""
        longer = copy(self)
        longer.steps = (*self.steps, step)
        longer.size = self.size + 2 * self.n_modes
        longer._jumps = [*self._jumps, (step, self._jump_matrix(step))]
        return longer

    def matrix(self, k: int) -> FloatArray:
        """Return the measurement matrix of ``[ln f, ln ζ]`` of log k, ``(2 n_series, size)``."""
        fixed: FloatArray = self.fixed[k]
        if not self.steps:
            return fixed
        matrix = np.zeros((fixed.shape[0], self.size))
        matrix[:, : self.first_step] = fixed
        for j, (step, reading) in enumerate(self._jumps):
            if step.there[k]:
                matrix[:, self.jump(j)] = reading
        return matrix

    def regressor(self, j: int) -> slice:
        """Return the place of the coefficients of a regressor."""
        return slice((5 + j) * self.n_modes, (6 + j) * self.n_modes)

    def jump(self, j: int) -> slice:
        """Return the place of the jumps of a step: those of ln f, then those of ln ζ."""
        first = self.first_step + 2 * self.n_modes * j
        return slice(first, first + 2 * self.n_modes)

    def _biased(self) -> tuple[int, ...]:
        """Return the series that have a bias: all of a mode but the one detected first."""
        there = np.isfinite(self.history.ln_frequency)
        first = np.where(there.any(axis=0), there.argmax(axis=0), len(there))
        biased: list[int] = []
        for mode in self.history.modes:
            own = self.history.columns(mode)
            reference = min(own, key=lambda i: (first[i], i), default=None)
            biased += [i for i in self.history.columns(mode) if i != reference]
        return tuple(biased)

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
