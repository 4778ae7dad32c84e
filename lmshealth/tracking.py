"""Kalman filter over a machine's life: modes followed with every uncertainty used.

The state of one mode is [ℓ, ℓ̇, ln ζ, ℓ₀, b₁ … b_c]: ln frequency at the covariates' reference, its
rate, ln damping, an exact copy of ℓ at the baseline, and one coefficient per covariate. The copy
makes the filter's covariance hold Cov(ℓ, ℓ₀), so that the drift ℓ - ℓ₀ has the right variance and
the error of the baseline stays common to all epochs. All modes share one filter, because their
estimates may be correlated.

How much a mode wanders by itself is not known. The filter is run on a grid of process noises and
averaged by their evidence so far: maximising it instead collapses to zero and makes the tracker
overconfident.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from filterpy.kalman import KalmanFilter
from scipy.special import softmax

from lmshealth.arrays import FloatArray
from lmshealth.errors import NotEnoughData
from lmshealth.results import Effect, History, Track
from lmshealth.stage import Covariate, Stage

_LEVEL, _RATE, _DAMPING, _BASE = range(4)
_N_OWN = 4

# Priors. Rates and process noises are per length of the history: what a mode does in a life.
_LN_F_STD = 0.1
_LN_ZETA_STD = 1.0
_RATE_STD = 0.3
_DAMPING_WALK = 0.3
_UNKNOWN_COVARIATE_STD = 0.001
# Grids averaged over: random walk of ln f and of its rate over the history, factor on R's std.
_LEVEL_WALKS = (1e-5, 3e-4, 1e-3, 3e-3, 1e-2)
_RATE_WALKS = (1e-3, 3e-2, 1e-1, 3e-1)
_NOISE_SCALES = (1.0, 1.5, 2.25)
_NOISE_SCALE_PRIOR = (0.9, 0.07, 0.03)


@dataclass(frozen=True, slots=True)
class _Setting:
    level_walk: float
    rate_walk: float
    noise_scale: float
    log_prior: float


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """Filtered states of one setting: shapes (n, d), (n, d, d), (n,), (n,)."""

    mean: FloatArray
    cov: FloatArray
    log_evidence: FloatArray
    nis: FloatArray


def track(history: History, stage: Stage | None = None) -> Track:
    """Follow the modes of a history by a Kalman filter.

    Parameters
    ----------
    history : History
        Modal estimates with covariance; missing ones are NaN.
    stage : Stage, optional
        Its covariates are regressed out. Without it every covariate present is, about its median.

    Returns
    -------
    Track
        Filtered, so that no epoch knows of later logs.

    Raises
    ------
    NotEnoughData
        If there is no estimate at all.
    """
    if not np.isfinite(history.ln_frequency).any():
        raise NotEnoughData(f"{history.stage}: no modal estimate in {len(history.logs)} logs")
    covariates = _covariates(history, stage)
    problem = _Problem(history, covariates)
    settings = [
        _Setting(level, rate, scale, float(np.log(prior)))
        for level, rate, (scale, prior) in product(
            _LEVEL_WALKS, _RATE_WALKS, zip(_NOISE_SCALES, _NOISE_SCALE_PRIOR, strict=True)
        )
    ]
    return _average(problem, settings, [problem.run(setting) for setting in settings])


def _covariates(history: History, stage: Stage | None) -> tuple[Covariate, ...]:
    """Covariates that are asked for and known in at least one log."""
    if stage is not None:
        wanted = stage.description.covariate
    else:
        wanted = tuple(
            Covariate(name, float(np.nanmedian(values)), _UNKNOWN_COVARIATE_STD)
            for name, values in history.covariates.items()
            if np.isfinite(values).any()
        )
    return tuple(
        covariate
        for covariate in wanted
        if covariate.name in history.covariates
        and np.isfinite(history.covariates[covariate.name]).any()
    )


class _Problem:
    """What all settings share: measurements, their matrices, and the prior."""

    def __init__(self, history: History, covariates: tuple[Covariate, ...]) -> None:
        self.history = history
        self.covariates = covariates
        self.n_modes = len(history.modes)
        self.size = _N_OWN + len(covariates)
        self.clock = history.clock()
        self.span = max(float(np.ptp(self.clock)), 1e-9)
        self.offset = np.zeros((len(history.logs), len(covariates)))
        # What an unknown covariate adds to the variance of ln f.
        self.unknown = np.zeros(len(history.logs))
        for k, covariate in enumerate(covariates):
            values = history.covariates[covariate.name]
            known = np.isfinite(values)
            spread = max(float(np.std(values[known])), 1.0)
            self.offset[:, k] = np.where(known, values - covariate.reference, 0.0)
            self.unknown += np.where(known, 0.0, (covariate.prior_std * spread) ** 2)

    def index(self, part: int) -> np.ndarray:
        """Positions of one part of the state of every mode, shape ``(n_modes,)``."""
        return part + self.size * np.arange(self.n_modes)

    def prior(self) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance before the first log; the centre is each mode's first estimate."""
        mean = np.zeros(self.size * self.n_modes)
        std = np.zeros_like(mean)
        for values, part, width in (
            (self.history.ln_frequency, _LEVEL, _LN_F_STD),
            (self.history.ln_damping, _DAMPING, _LN_ZETA_STD),
        ):
            first = np.argmax(np.isfinite(values), axis=0)
            mean[self.index(part)] = np.nan_to_num(values[first, np.arange(self.n_modes)])
            std[self.index(part)] = width
        std[self.index(_RATE)] = _RATE_STD / self.span
        for k, covariate in enumerate(self.covariates):
            std[self.index(_N_OWN + k)] = covariate.prior_std
        return mean, np.diag(std**2)

    def transition(self, step: float, setting: _Setting) -> tuple[FloatArray, FloatArray]:
        """Transition matrix and process noise over so many metres."""
        size = self.size * self.n_modes
        move, noise = np.eye(size), np.zeros((size, size))
        level, rate, damping = (self.index(part) for part in (_LEVEL, _RATE, _DAMPING))
        move[level, rate] = step
        walk = setting.level_walk**2 / self.span
        bend = (setting.rate_walk / self.span) ** 2 / self.span
        noise[level, level] = walk * step + bend * step**3 / 3
        noise[level, rate] = noise[rate, level] = bend * step**2 / 2
        noise[rate, rate] = bend * step
        noise[damping, damping] = _DAMPING_WALK**2 / self.span * step
        return move, noise

    def measurement(self, k: int, scale: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Rows that exist at log k: values, matrix and covariance."""
        values = np.concatenate([self.history.ln_frequency[k], self.history.ln_damping[k]])
        rows = np.flatnonzero(np.isfinite(values))
        matrix = np.zeros((2 * self.n_modes, self.size * self.n_modes))
        modes = np.arange(self.n_modes)
        matrix[modes, self.index(_LEVEL)] = 1
        for j in range(len(self.covariates)):
            matrix[modes, self.index(_N_OWN + j)] = self.offset[k, j]
        matrix[self.n_modes + modes, self.index(_DAMPING)] = 1
        noise = self.history.cov[k] * scale**2
        noise[modes, modes] += self.unknown[k]
        return values[rows], matrix[rows], noise[np.ix_(rows, rows)]

    def copy_baseline(self, kalman: KalmanFilter) -> None:
        """Make ℓ₀ an exact copy of ℓ."""
        duplicate = np.eye(self.size * self.n_modes)
        duplicate[self.index(_BASE)] = duplicate[self.index(_LEVEL)]
        kalman.x = duplicate @ kalman.x
        kalman.P = duplicate @ kalman.P @ duplicate.T

    def run(self, setting: _Setting) -> _Run:
        """Filter the whole history with one setting."""
        n, size = len(self.history.logs), self.size * self.n_modes
        kalman = KalmanFilter(dim_x=size, dim_z=2 * self.n_modes)
        kalman.x, kalman.P = self.prior()
        mean, cov = np.empty((n, size)), np.empty((n, size, size))
        evidence, nis = np.zeros(n), np.zeros(n)
        for k in range(n):
            if k:
                move, noise = self.transition(float(self.clock[k] - self.clock[k - 1]), setting)
                kalman.predict(F=move, Q=noise)
            if k == self.history.baseline:
                self.copy_baseline(kalman)
            values, matrix, noise = self.measurement(k, setting.noise_scale)
            if values.size:
                kalman.update(values, R=noise, H=matrix)
                # The filter's own log_likelihood costs more than the step itself.
                nis[k] = kalman.y @ kalman.SI @ kalman.y
                log_det = np.linalg.slogdet(kalman.S)[1]
                evidence[k] = -0.5 * (nis[k] + log_det + values.size * np.log(2 * np.pi))
            mean[k], cov[k] = kalman.x, kalman.P
        return _Run(mean, cov, np.cumsum(evidence), nis)


def _average(problem: _Problem, settings: list[_Setting], runs: list[_Run]) -> Track:
    """Average the runs by their evidence up to each epoch."""
    history = problem.history
    prior = np.array([setting.log_prior for setting in settings])
    evidence = np.stack([run.log_evidence for run in runs]) + prior[:, None]
    weight = softmax(evidence, axis=0)
    # An innovation is judged by what was believed before it.
    before = softmax(np.column_stack([prior, evidence[:, :-1]]), axis=0)
    mean = np.einsum("gk,gki->ki", weight, [run.mean for run in runs])
    cov = np.einsum("gk,gkij->kij", weight, [run.cov for run in runs])
    for g, run in enumerate(runs):
        off = run.mean - mean
        cov += weight[g][:, None, None] * off[:, :, None] * off[:, None, :]
    level, base = problem.index(_LEVEL), problem.index(_BASE)
    contrast = np.zeros((problem.n_modes, mean.shape[1]))
    modes = np.arange(problem.n_modes)
    contrast[modes, level] = 1
    contrast[modes, base] = -1
    drift = mean @ contrast.T
    drift_cov = np.einsum("mi,kij,nj->kmn", contrast, cov, contrast)
    early = np.arange(len(history.logs)) < history.baseline
    drift[early], drift_cov[early] = np.nan, np.nan
    # At the baseline ℓ and ℓ₀ are the same; rounding must not make an epoch of it.
    still = (problem.clock == 0) & ~early
    drift[still], drift_cov[still] = 0.0, 0.0
    std = np.sqrt(np.einsum("kii->ki", cov))
    scales = np.array([setting.noise_scale for setting in settings])
    return Track(
        stage=history.stage,
        logs=history.logs,
        recorded_at=history.recorded_at,
        travel=history.travel,
        modes=history.modes,
        ln_frequency=mean[:, level],
        ln_frequency_std=std[:, level],
        ln_damping=mean[:, problem.index(_DAMPING)],
        ln_damping_std=std[:, problem.index(_DAMPING)],
        drift=drift,
        drift_cov=drift_cov,
        effects=_effects(problem, mean[-1], std[-1]),
        nis=np.einsum("gk,gk->k", before, [run.nis for run in runs]),
        nis_dof=_predicted(history),
        noise_scale=scales @ weight,
    )


def _predicted(history: History) -> FloatArray:
    """Count the measurements of each log that could surprise: the first of a mode cannot."""
    there = np.isfinite(np.hstack([history.ln_frequency, history.ln_damping]))
    again = there & (np.cumsum(there, axis=0) > 1)
    return np.asarray(again.sum(axis=1, dtype=float))


def _effects(problem: _Problem, mean: FloatArray, std: FloatArray) -> tuple[Effect, ...]:
    return tuple(
        Effect(mode, covariate.name, float(mean[i]), float(std[i]))
        for k, covariate in enumerate(problem.covariates)
        for mode, i in zip(problem.history.modes, problem.index(_N_OWN + k).tolist(), strict=True)
    )
