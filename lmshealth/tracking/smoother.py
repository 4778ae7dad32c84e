"""Smoother: the states of all epochs given all logs."""

from dataclasses import dataclass

import numpy as np

from lmshealth._arrays import FloatArray, ReadOnly
from lmshealth.stage.description import Stage
from lmshealth.tracking.filter_bank import (
    FilterBank,
    FilterModel,
    Hyperparameters,
    condition,
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
# Entries of the covariances of all logs that are smoothed at a time: 120 MB in all.
_MOST_ENTRIES = 7_500_000


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
    weight, means, cov = bank.weight, [], np.zeros((len(trust), space.size, space.size))
    some = max(1, _MOST_ENTRIES // cov.size)
    for first in range(0, weight.size, some):
        part = slice(first, first + some)
        own, covs = smooth_filters(model, bank.hyperparameters[part], trust)
        means.append(own)
        cov += np.einsum("g,kgij->kij", weight[part], covs)
    each = np.concatenate(means, axis=1)
    mean = np.einsum("g,kgi->ki", weight, each)
    off = each - mean[:, None]
    cov += np.swapaxes(off, 1, 2) @ (weight[:, None] * off)
    contrast = space.drift()
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


def smooth_filters(
    model: FilterModel, own: Hyperparameters, trust: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Filter and smooth: states ``(n_logs, n_filters, size)`` and their covariances.

    `trust`, ``(n_logs, 2 n_series)``, is the probability that an estimate is no outlier: the share
    of its information that counts.
    """
    space, bank = model.space, initial(model, own)
    mean, cov = (np.empty((len(trust), *part.shape)) for part in (bank.mean, bank.cov))
    predicted_mean, predicted_cov = np.empty_like(mean), np.empty_like(cov)
    for k in range(len(trust)):
        bank = predict(model, bank, k)
        predicted_mean[k], predicted_cov[k] = bank.mean, bank.cov
        rows = np.flatnonzero(model.there[k])
        if rows.size:
            scale = own.scales[:, model.scale_of[rows]] / np.sqrt(trust[k, rows])
            noise = space.history.cov[k][np.ix_(rows, rows)] * scale[:, :, None] * scale[:, None]
            noise += np.diag(model.extra[k, rows])
            matrix = space.matrix(k)[rows]
            crossed = bank.cov @ matrix.T
            off = model.values[k, rows] - bank.mean @ matrix.T
            bank = condition(bank, crossed, off, matrix @ crossed + noise)
        mean[k], cov[k] = bank.mean, bank.cov
    for k in range(len(trust) - 2, -1, -1):
        gain = cov[k] @ _transitions(model, own, k + 1) @ _inverse(predicted_cov[k + 1])
        mean[k] += (gain @ (mean[k + 1] - predicted_mean[k + 1])[:, :, None])[:, :, 0]
        cov[k] += gain @ (cov[k + 1] - predicted_cov[k + 1]) @ np.swapaxes(gain, 1, 2)
    return mean, cov


def _transitions(model: FilterModel, own: Hyperparameters, k: int) -> FloatArray:
    """Return transposed transition matrices into log k: `predict` of unit states."""
    size, n = model.space.size, len(own.rate_std)
    unit = FilterBank(
        own[np.repeat(np.arange(n), size)],
        np.zeros(n * size),
        np.tile(np.eye(size), (n, 1)),
        np.zeros((n * size, size, size)),
    )
    return predict(model, unit, k).mean.reshape(n, size, size)


def _inverse(cov: FloatArray) -> FloatArray:
    """Invert covariances, ``(n, size, size)``, where they are not singular.

    An exact copy of ℓ, and steps that are still to come, make them singular. The correlations are
    inverted, because variances of ln ζ are ten orders of magnitude above process noise of ln f.
    """
    std = np.sqrt(np.maximum(np.einsum("gii->gi", cov), 0.0))
    std = np.where(std > 0, std, 1.0)
    scale = std[:, :, None] * std[:, None]
    return np.asarray(np.linalg.pinv(cov / scale, rcond=_SINGULAR, hermitian=True) / scale)
