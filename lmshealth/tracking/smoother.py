"""Smoother: the states of all epochs given all logs."""

from dataclasses import dataclass

import numpy as np
from filterpy.kalman import KalmanFilter

from lmshealth._private.arrays import FloatArray, ReadOnly
from lmshealth.stage.description import Stage
from lmshealth.tracking.filter_bank import (
    FilterBank,
    FilterModel,
    Hyperparameters,
    initial,
    predict,
    update,
)
from lmshealth.tracking.history import History
from lmshealth.tracking.state_space import StateSpace
from lmshealth.tracking.track import Track

# Filters that together have less of the posterior, and of its variance of ln f, are left out.
_SHARE = 1e-3
# Eigenvalues of correlations below this are rounding.
_SINGULAR = 1e-10


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed(ReadOnly):
    """Modes at every epoch given all logs; fields are as in `Track`, ``(n_epochs, n_modes)``."""

    ln_frequency: FloatArray
    ln_frequency_std: FloatArray
    ln_damping: FloatArray
    ln_damping_std: FloatArray
    drift: FloatArray
    drift_std: FloatArray


def smooth(history: History, followed: Track, stage: Stage | None = None) -> Smoothed:
    """Smooth a history by the Rauch-Tung-Striebel recursion [Rauch1965], averaged over the model.

    The steps of its track are in the model; the stage is that of `track`.
    """
    space = StateSpace(history, stage, followed.steps)
    # Where a regime begins, rates have their prior variance again.
    begun = {step.first for step in followed.steps if step.kind == "reset" or not step.declared}
    model = FilterModel(space, begun - {0})
    bank, trust = initial(model), np.ones(model.values.shape)
    for k in range(len(history.logs)):
        bank, found = update(model, predict(model, bank, k), k)
        trust[k, found.rows], bank = np.maximum(1 - found.outlying, _SINGULAR), bank.pruned()
    # An improbable filter may be as wide as to count.
    variance = np.einsum("gii->g", bank.cov[:, space.level, space.level])
    share = bank.weight * (1 + variance / (bank.weight @ variance)) / 2
    order = np.argsort(share)
    bank = bank[order[np.cumsum(share[order]) > _SHARE]]
    weight = bank.weight
    runs = [smooth_one(model, bank.hyperparameters[[g]], trust) for g in range(weight.size)]
    mean = np.einsum("g,gki->ki", weight, [run[0] for run in runs])
    cov = np.einsum("g,gkij->kij", weight, [run[1] for run in runs])
    for share, (own, _) in zip(weight, runs, strict=True):
        off = own - mean
        cov += share * off[:, :, None] * off[:, None, :]
    contrast = space.drift
    size = contrast.shape[1]
    drift = mean[:, :size] @ contrast.T
    variance = np.einsum("mi,kij,mj->km", contrast, cov[:, :size, :size], contrast)
    early = np.arange(len(history.logs)) < history.baselines[0]
    drift[early], variance[early] = np.nan, np.nan
    std = np.sqrt(np.maximum(np.einsum("kii->ki", cov), 0.0)) * followed.widening[:, None]
    unseen = space.damping.start + np.flatnonzero(np.isnan(followed.ln_damping).all(axis=0))
    mean[:, unseen], std[:, unseen] = np.nan, np.nan
    return Smoothed(
        ln_frequency=mean[:, space.level],
        ln_frequency_std=std[:, space.level],
        ln_damping=mean[:, space.damping],
        ln_damping_std=std[:, space.damping],
        drift=drift,
        drift_std=np.sqrt(np.maximum(variance, 0.0)) * followed.widening[:, None],
    )


def smooth_one(
    model: FilterModel, own: Hyperparameters, trust: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Filter and smooth with one set of hyperparameters: states ``(n, size)`` and covariances.

    `trust`, ``(n, 2 n_series)``, is the probability that an estimate is no outlier: the share of
    its information that counts.
    """
    space = model.space
    n, size = len(space.history.logs), space.size
    kalman = KalmanFilter(dim_x=size, dim_z=1)
    start = initial(model, own)
    kalman.x, kalman.P = start.mean[0], start.cov[0]
    means, covs = np.empty((n, size)), np.empty((n, size, size))
    moves, noises = np.empty((n, size, size)), np.empty((n, size, size))
    for k in range(n):
        moves[k], noises[k] = _transition(model, own, k)
        kalman.predict(F=moves[k], Q=noises[k])
        rows = np.flatnonzero(model.there[k])
        if rows.size:
            scale = own.scales[0, model.scale_of[rows]] / np.sqrt(trust[k, rows])
            noise = space.history.cov[k][np.ix_(rows, rows)] * np.outer(scale, scale)
            noise += np.diag(model.extra[k, rows])
            kalman.update(model.values[k, rows], R=noise, H=space.matrix(k)[rows])
        means[k], covs[k] = kalman.x, kalman.P
    smoothed = kalman.rts_smoother(means, covs, moves, noises, inv=_inverse)
    return smoothed[0], smoothed[1]


def _inverse(cov: FloatArray) -> FloatArray:
    """Invert a covariance where it is not singular.

    An exact copy of ℓ, and steps that are still to come, make it singular. The correlations are
    inverted, because variances of ln ζ are ten orders of magnitude above process noise of ln f.
    """
    std = np.sqrt(np.maximum(np.diag(cov), 0.0))
    scale = np.outer(np.where(std > 0, std, 1.0), np.where(std > 0, std, 1.0))
    return np.asarray(np.linalg.pinv(cov / scale, rcond=_SINGULAR, hermitian=True) / scale)


def _transition(model: FilterModel, own: Hyperparameters, k: int) -> tuple[FloatArray, FloatArray]:
    """Return transition matrix and process noise into log k: `predict` of exactly known states."""
    size = model.space.size
    state = np.zeros((size + 1, size + 1, size))
    state[:-1, -1] = np.eye(size)
    unit = FilterBank(own[np.zeros(size + 1, dtype=int)], np.zeros(size + 1), state)
    unit = predict(model, unit, k)
    return unit.mean[:-1].T, unit.cov[-1]
