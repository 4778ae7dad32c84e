"""Noise of the lines of a response: of the sensor, and of forces that the modes answer."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.optimize import minimize_scalar

from lmshealth.arrays import FloatArray

_LEAST_RATIO, _LARGEST_RATIO = 1e-6, 1e6


def smooth_noise(power: FloatArray, response: FloatArray, width: int) -> FloatArray:
    """Average the power of noise over neighbouring lines, without flattening its resonances.

    A disturbance that the machine answers has the modes' resonances, narrower than what is
    averaged over. The power is divided by the shape a + b |H|² that suits it best by the likelihood
    of exponential variables, averaged, and multiplied again.

    Parameters
    ----------
    power : ndarray
        Shape ``(n_lines,)``.
    response : ndarray
        |H|² up to a factor, shape ``(n_lines,)``.
    width : int
        Lines to average over.

    Returns
    -------
    ndarray
        Shape ``(n_lines,)``.
    """
    relative = response / response.max()
    power = np.maximum(power, np.finfo(float).tiny)

    def cost(ln_ratio: float) -> float:
        shape = 1 + np.exp(ln_ratio) * relative
        return float(power.size * np.log(np.mean(power / shape)) + np.sum(np.log(shape)))

    bounds = (np.log(_LEAST_RATIO), np.log(_LARGEST_RATIO))
    found = minimize_scalar(cost, bounds=bounds, method="bounded")
    shape = 1 + np.exp(found.x) * relative
    width = min(width, power.size)
    return np.asarray(shape * uniform_filter1d(power / shape, width, mode="nearest"))
