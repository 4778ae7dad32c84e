"""Posterior of health by who knows the shape of every course, all scatter, and what stays.

Unknown are the loss now of each parameter that changes, the intercept and the slope of each mode
with temperature, the declared jump, and the error of the map, of the two sizes that the description
states. All but the losses and this size are normal and integrated out, so that the posterior of one
or two losses is computed on a grid. Its width is what a posterior without this knowledge is
compared with.
"""

from __future__ import annotations

import numpy as np
from scipy.special import logsumexp

from studies.life.kinds.plant import FREQUENCY_HZ, MODES, PARAMETERS, Array, drift, drifts_alone
from studies.life.kinds.worlds import COMMON_LOGS, N_LOGS, REFERENCE_C, Life

# Priors: ln of a parameter now (that of the description), intercept, slope (per K), jump.
HEALTH_STD, INTERCEPT_STD, SLOPE_STD, JUMP_STD = 0.3, 0.03, 1e-3, 0.01
# Sizes of the map's relative errors with their probabilities, as the description states them.
MAP_ERRORS = (0.05, 0.75), (0.10, 0.25)
_EACH = range(len(MODES))
_COARSE, _FINE = {1: 241, 2: 61}, {1: 241, 2: 81}
_UNLIKELY = 1e-6  # density over its maximum beyond which the fine grid ends


def marginals(life: Life) -> dict[str, tuple[Array, Array]]:
    """Return grid and probabilities of ln health now of each parameter that has changed.

    None after work: what a parameter lost before it and since are two unknowns.
    """
    moving = [j for j in range(len(PARAMETERS)) if life.size[j] and life.course[-1, j]]
    if not moving or life.world.work:
        return {}
    limits = [(-1.2, -1e-4) if life.size[j] > 0 else (1e-4, 0.6) for j in moving]
    axes = [np.linspace(*ends, _COARSE[len(moving)]) for ends in limits]
    axes = _where_likely(axes, _density(life, moving, axes), _FINE[len(moving)])
    density = _density(life, moving, axes)
    found = {}
    for k, (j, axis) in enumerate(zip(moving, axes, strict=True)):
        own = density.sum(axis=tuple(i for i in range(len(moving)) if i != k))
        found[PARAMETERS[j]] = axis, own / own.sum()
    return found


def quantile(marginal: tuple[Array, Array], level: float) -> float:
    """Return a quantile of a marginal."""
    axis, probability = marginal
    return float(np.interp(level, np.cumsum(probability) - probability / 2, axis))


def place(marginal: tuple[Array, Array], truth: float) -> float:
    """Return the probability below the truth."""
    axis, probability = marginal
    return float(np.interp(truth, axis, np.cumsum(probability) - probability / 2))


def _where_likely(axes: list[Array], density: Array, n: int) -> list[Array]:
    """Return axes over the part of a grid that has almost all of the probability."""
    found = []
    for k, axis in enumerate(axes):
        own = density.max(axis=tuple(i for i in range(len(axes)) if i != k))
        likely = np.flatnonzero(own > _UNLIKELY)
        low, high = max(likely[0] - 1, 0), min(likely[-1] + 1, axis.size - 1)
        found.append(np.linspace(axis[low], axis[high], n))
    return found


def _density(life: Life, moving: list[int], axes: list[Array]) -> Array:
    """Return the posterior density on the grid of ln health now, at most 1."""
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    points = grid.reshape(-1, len(moving))
    ln_health = np.zeros((len(points), N_LOGS, len(PARAMETERS)))
    for k, j in enumerate(moving):
        share = life.course[:, j] / life.course[-1, j]
        ln_health[:, :, j] = np.log1p(np.expm1(points[:, k : k + 1]) * share)
    residual = life.ln_f - np.log(FREQUENCY_HZ) - drift(ln_health)
    alone = drifts_alone(ln_health)
    groups = [list(_EACH)] if life.world.common else [[i] for i in _EACH]
    parts = [
        np.log(weight) + sum(_log_likelihood(life, own, residual, size * alone) for own in groups)
        for size, weight in MAP_ERRORS
    ]
    prior = -0.5 * np.sum((points / HEALTH_STD) ** 2, axis=1)
    log_density = prior + logsumexp(parts, axis=0)
    return np.asarray(np.exp(log_density - log_density.max()).reshape(grid.shape[:-1]))


def _log_likelihood(life: Life, modes: list[int], residual: Array, wrong: Array) -> Array:
    """Return the log likelihood of the estimates of modes, for a size of the map's errors."""
    cov = np.zeros((len(residual), len(modes), N_LOGS, len(modes), N_LOGS))
    if len(modes) > 1:
        logs = np.arange(N_LOGS)
        wander = np.exp(-np.abs(np.subtract.outer(logs, logs)) / COMMON_LOGS)
        cov += life.world.common**2 * wander[:, None]
    for k, mode in enumerate(modes):
        own = wrong[..., mode]
        cov[:, k, :, k] += _known_cov(life, mode) + np.einsum("nkj,nlj->nkl", own, own)
    size = len(modes) * N_LOGS
    root = np.linalg.cholesky(cov.reshape(-1, size, size))
    errors = np.swapaxes(residual[:, :, modes], 1, 2).reshape(-1, size, 1)
    white = np.linalg.solve(root, errors)[..., 0]
    log_det = np.log(np.einsum("nkk->nk", root)).sum(axis=1)
    return np.asarray(-0.5 * np.sum(white**2, axis=1) - log_det)


def _known_cov(life: Life, mode: int) -> Array:
    """Return the covariance of ln f of a mode, but for the map's error, ``(n_logs, n_logs)``."""
    logs, seen = np.arange(N_LOGS), life.travel / life.travel[-1]
    warm, later = life.temperature - REFERENCE_C, (logs >= life.retuned_at).astype(float)
    return np.asarray(
        np.diag(life.std[:, mode] ** 2)
        + life.world.walk**2 * np.minimum.outer(seen, seen)
        + life.world.wander**2 * np.exp(-np.abs(np.subtract.outer(logs, logs)) / 5.0)
        + INTERCEPT_STD**2
        + SLOPE_STD**2 * np.outer(warm, warm)
        + JUMP_STD**2 * np.outer(later, later)
    )
