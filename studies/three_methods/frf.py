"""Frequency response of a sweep log, and the modes in it, by weighted least squares.

Sensors are fitted one by one: the machine's own noise reaches them all, so that a fit to several as
if they were independent would be too sure of itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.optimize import least_squares

from lmshealth.logs import Log
from lmshealth.stage import ModeSpec

Array = np.ndarray[Any, Any]

# Noise is averaged over so many neighbouring lines.
_NEIGHBOURS = 9
_MAINS = 50.0
# Of the other modes' tails and the rigid motion a polynomial is left over in the band.
_DEGREE = 5
_SEARCH = 0.06
# Gain of -2 ln L below which a mode may be noise, and uncertainty above which it says nothing.
_LEAST_GAIN, _WORST_STD = 25.0, 0.01
_OUTLIER = 20.0


@dataclass(frozen=True, slots=True)
class Response:
    """Response of a sensor at the sweep's lines, each (line,)."""

    hertz: Array
    value: Array
    variance: Array
    coherence: Array


def measure(
    log: Log, source: str, sensor: str, band: tuple[float, float], period: float
) -> Response:
    """Return the response from a current to a sensor over the whole log.

    A Hann window over M periods keeps the sweep within one bin of every M-th, so that the bins
    half way between are free of it and show the noise.
    """
    channels = {channel.name: channel.values for channel in log.channels}
    n = channels[source].size
    periods = round(n / (period * log.sample_rate))
    if periods % 2 or periods < 4:
        raise ValueError(f"{periods} periods in the log; needed an even count of at least 4")
    window = np.hanning(n + 1)[:-1]
    given, answer = (
        np.fft.rfft(window * (channels[name] - channels[name].mean())) for name in (source, sensor)
    )
    at = np.arange(int(band[0] * period), int(band[1] * period) + 1) * periods
    hertz = at * log.sample_rate / n
    between = np.abs(answer[at + periods // 2]) ** 2 + np.abs(answer[at - periods // 2]) ** 2
    # One over an average of n exponentials is larger than one over its mean by n / (n - 1).
    noise = uniform_filter1d(between / 2, _NEIGHBOURS) * _NEIGHBOURS / (_NEIGHBOURS - 1)
    coherence = np.clip(1 - noise / np.abs(answer[at]) ** 2, 0.0, 1.0)
    keep = np.abs(hertz / _MAINS - np.round(hertz / _MAINS)) * _MAINS > 0.3
    parts = (hertz, answer[at] / given[at], noise / np.abs(given[at]) ** 2, coherence)
    return Response(*(part[keep] for part in parts))


def model(response: Response, theta: Array) -> tuple[Array, Array]:
    """Return the fitted response and its whitened error, each (line,).

    Parameters
    ----------
    theta : (2 modes,)
        ln f, then ln ζ; residues and residual terms are solved for.
    """
    f, zeta = np.exp(np.split(theta, 2))
    pole = 2 * np.pi * f * (-zeta + 1j * np.sqrt(1 - zeta**2))
    s = 2j * np.pi * response.hertz
    low, high = response.hertz[[0, -1]]
    scaled = 2 * (response.hertz - low) / (high - low) - 1
    rest = np.polynomial.chebyshev.chebvander(scaled, _DEGREE)
    columns = np.hstack([np.abs(pole) / (s[:, None] - pole), rest])
    weight = 1 / np.sqrt(response.variance)
    parts = np.linalg.lstsq(weight[:, None] * columns, weight * response.value, rcond=None)[0]
    fitted = columns @ parts
    return fitted, weight * (response.value - fitted)


def _stacked(response: Response, theta: Array) -> Array:
    """Return the error as real numbers of unit variance."""
    error = np.sqrt(2) * model(response, theta)[1]
    return np.concatenate([error.real, error.imag])


def _refined(response: Response, theta: Array, modes: list[ModeSpec]) -> Any:
    """Return the least-squares solution near theta, not far from where the modes are sought."""
    home = np.log([m.frequency_hz for m in modes] + [m.damping_ratio for m in modes])
    reach = np.repeat([1.2 * _SEARCH, np.log(5.0)], len(modes))
    return least_squares(
        lambda t: _stacked(response, t), theta, bounds=(home - reach, home + reach), x_scale=0.01
    )


def _joined(theta: Array, f: float, zeta: float) -> Array:
    """Return theta with one more mode at its end."""
    ln_f, ln_zeta = np.split(theta, 2)
    return np.concatenate([ln_f, [np.log(f)], ln_zeta, [np.log(zeta)]])


def find_modes(
    response: Response, sought: tuple[ModeSpec, ...]
) -> tuple[dict[str, tuple[float, float, float]], Array]:
    """Return f (Hz), its standard deviation and the gain of fit of every mode that is seen.

    Modes are added one by one, the most telling first, while they improve the fit. Also returns
    what `model` needs to draw it.
    """
    gains: list[tuple[ModeSpec, float]] = []
    theta = np.empty(0)
    cost = float(np.sum(_stacked(response, theta) ** 2))
    while len(gains) < len(sought):
        known = [mode for mode, _ in gains]
        trials = [
            (float(np.sum(_stacked(response, trial) ** 2)), mode, trial)
            for mode in sought
            if mode not in known
            for f in mode.frequency_hz * np.arange(1 - _SEARCH, 1 + _SEARCH, mode.damping_ratio / 2)
            for trial in [_joined(theta, f, mode.damping_ratio)]
        ]
        _, mode, trial = min(trials, key=lambda t: t[0])
        solved = _refined(response, trial, [*known, mode])
        if cost - 2 * solved.cost < _LEAST_GAIN:
            break
        gains.append((mode, cost - 2 * solved.cost))
        theta, cost = solved.x, 2 * solved.cost
    if not gains:
        return {}, theta
    # Lines that are no answer to the sweep: a harmonic of the velocity may fall onto one.
    clean = np.abs(model(response, theta)[1]) ** 2 < _OUTLIER
    left = Response(*(part[clean] for part in (response.hertz, response.value, response.variance,
                                               response.coherence)))  # fmt: skip
    solved = _refined(left, theta, [mode for mode, _ in gains])
    std = np.sqrt(np.diag(np.linalg.inv(solved.jac.T @ solved.jac)))
    f = np.exp(solved.x[: len(gains)])
    seen = {
        mode.name: (float(f[i]), float(f[i] * std[i]), gain)
        for i, (mode, gain) in enumerate(gains)
        if std[i] < _WORST_STD
    }
    return seen, solved.x
