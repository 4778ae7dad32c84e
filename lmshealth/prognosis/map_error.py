"""Errors of the modal map that a life shows: modes that disagree with the others."""

from dataclasses import replace

import numpy as np
from scipy.special import softmax

from lmshealth._private.arrays import FloatArray
from lmshealth.health.importance_sampling import importance_sample
from lmshealth.prognosis import constants
from lmshealth.prognosis.life_likelihood import drifts, ln_health
from lmshealth.prognosis.life_posterior import LifeDensity, LifePosterior
from lmshealth.prognosis.results import ModeError

_N_START, _N_DRAWS = 200, 400


def modes_off_map(life: LifePosterior, seed: np.random.SeedSequence) -> tuple[ModeError, ...]:
    """Return the modes whose drifts over a life disagree with the map, the most probable first.

    Empty unless the life shows that the map is worse than declared. Each mode in turn is given an
    error of `constants.MODE_ERROR_STD` and the others the declared one; all are equally probable.
    """
    if map_doubt(life) < constants.MAP_DOUBT:
        return ()
    rng = np.random.default_rng(seed)
    found = [_error(life, k, rng) for k in range(len(life.modes))]
    probability = softmax([log_evidence for log_evidence, _, _ in found]).tolist()
    errors = [
        ModeError(mode, size, std, p)
        for mode, (_, size, std), p in zip(life.modes, found, probability, strict=True)
    ]
    return tuple(sorted(errors, key=lambda one: -one.probability))


def map_doubt(life: LifePosterior) -> float:
    """Return the probability that the map is worse than its description declares."""
    total = 0.0
    for one in life.scenarios:
        weight = one.density.weights(_some(one.mixture_draws))
        worse = one.density.grid.map_std > one.density.likelihood.grid.map_std.min()
        total += one.probability * float(weight[worse].sum())
    return total


def _some(draws: FloatArray) -> FloatArray:
    return draws[:: max(1, len(draws) // _N_START)]


def _error(life: LifePosterior, k: int, rng: np.random.Generator) -> tuple[float, float, float]:
    """Return the log evidence of an error of the k-th mode; mean and standard deviation of it."""
    log_evidence, means, variances = [], [], []
    for one in life.scenarios:
        density, start = _with_error(one.density, k), _some(one.mixture_draws)
        if not one.scenario.n_dim:  # nothing drifts by the map, right or wrong
            log_evidence.append(float(density.log_probability(start[:1])[0]))
            means.append(0.0)
            variances.append(constants.MODE_ERROR_STD**2)
        else:
            drawn = importance_sample(density.log_probability, start, rng, _N_DRAWS)
            mean, of_draw = _relative_error(density, k, drawn.resampled(rng, _N_START))
            log_evidence.append(drawn.log_evidence)
            means.append(float(mean.mean()))
            variances.append(float(of_draw.mean() + mean.var()))
        log_evidence[-1] += float(np.log(one.scenario.weight))
    share, of_scenario = softmax(log_evidence), np.array(means)
    size = float(share @ of_scenario)
    variance = float(share @ (np.array(variances) + (of_scenario - size) ** 2))
    return float(np.logaddexp.reduce(log_evidence)), size, float(np.sqrt(variance))


def _with_error(density: LifeDensity, k: int) -> LifeDensity:
    """Return a density with a large error of the k-th mode, and the declared one of the others."""
    whole, own = density.likelihood.grid, density.grid
    kept = set(zip(own.walk, own.noise_scale, own.deviation, strict=True))
    points = zip(whole.walk, whole.noise_scale, whole.deviation, strict=True)
    least = whole.map_std == whole.map_std.min()
    grid = whole[least & np.array([point in kept for point in points])]
    n_modes = grid.design.shape[1]
    map_std = np.repeat(grid.map_std[:, None], n_modes, axis=1)
    map_std[:, k] = constants.MODE_ERROR_STD
    return replace(density, grid=replace(grid, map_std=map_std))


def _relative_error(density: LifeDensity, k: int, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mean and variance of the relative error of the k-th drift now, shape ``(n,)`` each."""
    likelihood, data = density.likelihood, density.likelihood.data
    x, _ = likelihood.path(density.scenario, y)
    weight = softmax(likelihood.terms(density.grid, x), axis=0)
    mean, cov = likelihood.map_errors(density.grid, x)
    present, _ = ln_health(data.stage, density.scenario, y, np.array([data.now]))
    of_parameter = drifts(data, present)[k, 1:, :, 0].T  # (n, n_parameters)
    share = of_parameter / np.sum(of_parameter, axis=1, keepdims=True)
    n = share.shape[1]
    own = slice(k * n, (k + 1) * n)
    std = density.grid.map_std[:, k, None]
    size = std * np.einsum("nj,gnj->gn", share, mean[..., own])
    variance = std**2 * np.einsum("nj,gnji,ni->gn", share, cov[..., own, own], share)
    centre = np.sum(weight * size, axis=0)
    return centre, np.sum(weight * (variance + (size - centre) ** 2), axis=0)
