"""Maximum of the likelihood of decays, and its average over what few ordinates tell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg
from scipy.special import softmax

from lmshealth.arrays import FloatArray
from lmshealth.restricted import Evaluation, IntArray, TransientLikelihood

_MOST_STEPS, _STEP_TOLERANCE = 60, 1e-5
# The Hessian is differenced over this share of a standard deviation.
_DIFFERENCE = 0.02
# Levels of the ambient response that are averaged over: where to begin if it is not seen, the
# least that shows, and how much less likely than the best they may be.
_FIRST_LEVEL, _LEAST_LEVEL, _UNLIKELY = 0.5, 0.1, 6.0
# Largest step of their logarithm, and the step in standard deviations of a level that is known: a
# sum over a normal density in such steps is exact to 1e-5.
_COARSE, _SPREADS = 0.6, 1.3
# Longest steps, of half a Fourier frequency, that a mode may move by when its ambient response is
# raised.
_STAYS = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Optimum:
    """Where the likelihood is largest.

    Attributes
    ----------
    p : ndarray
        Shape ``(n_parameters,)``.
    at : Evaluation
        The likelihood there.
    decrement : float
        How much larger it might be, by the last step.
    """

    p: FloatArray
    at: Evaluation
    decrement: float


def maximise(
    likelihood: TransientLikelihood,
    p: FloatArray,
    free: IntArray,
    *,
    tolerance: float = _STEP_TOLERANCE,
) -> Optimum:
    """Find the maximum along some parameters by quasi-Newton steps from the Fisher information.

    Parameters
    ----------
    likelihood : TransientLikelihood
        Of which.
    p : ndarray
        Start, shape ``(n_parameters,)``.
    free : ndarray of int
        Which parameters may move, shape ``(n_free,)``.
    tolerance : float
        Gain in log likelihood below which no further step is worth it.
    """
    at = likelihood.evaluate(p)
    metric, fresh, decrement = likelihood.metric(at), True, np.inf
    for _ in range(_MOST_STEPS):
        step = _step(metric, at.gradient, likelihood.movable(p, at.gradient, free))
        decrement = float(-at.gradient @ step) / 2
        if decrement < tolerance:
            break
        reach = likelihood.reach(p)
        moved = _shorten(likelihood, p, np.clip(step, -reach, reach), at)
        if moved is None and fresh:
            break
        if moved is None:
            metric, fresh = likelihood.metric(at), True
            continue
        metric, fresh = _updated(metric, moved[0] - p, moved[1].gradient - at.gradient), False
        p, at = moved
    return Optimum(p, at, decrement)


def _step(metric: FloatArray, gradient: FloatArray, free: IntArray) -> FloatArray:
    """Solve for the step along the free parameters, scaled because they differ by 10⁵."""
    scale = np.sqrt(np.diag(metric)[free])
    system = metric[np.ix_(free, free)] / np.outer(scale, scale) + 1e-9 * np.eye(free.size)
    step = np.zeros(gradient.size)
    step[free] = -np.linalg.solve(system, gradient[free] / scale) / scale
    return step


def _updated(metric: FloatArray, step: FloatArray, change: FloatArray) -> FloatArray:
    """Update the metric by what a step did to the gradient, as Broyden and others do."""
    along = metric @ step
    expected, seen = float(step @ along), float(step @ change)
    if seen < 1e-2 * expected:
        return metric
    return np.asarray(metric - np.outer(along, along) / expected + np.outer(change, change) / seen)


def _shorten(
    likelihood: TransientLikelihood, p: FloatArray, step: FloatArray, at: Evaluation
) -> tuple[FloatArray, Evaluation] | None:
    """Shorten a step until it gains; None where none does."""
    for share in (1.0, 0.3, 0.1, 0.03, 0.01, 1e-3):
        tried = likelihood.clip(p + share * step)
        there = likelihood.evaluate(tried)
        if there.value < at.value:
            return tried, there
    return None


@dataclass(frozen=True, slots=True, eq=False)
class Average:
    """The posterior with one mode's ambient response averaged over.

    Attributes
    ----------
    mean : ndarray
        Of all parameters, shape ``(n_parameters,)``.
    cov : ndarray
        Their covariance, shape ``(n_parameters, n_parameters)``; zero where held.
    """

    mean: FloatArray
    cov: FloatArray


def average_ambient(
    likelihood: TransientLikelihood, p: FloatArray, mode: int, free: IntArray
) -> Average:
    """Average over the ambient response of a mode, which few ordinates tell.

    A stop shows it at two or three Fourier frequencies beside the resonance, and the most
    probable level is often far below the true one. Intervals at that level cover two times out of
    three; averaged over all levels under Jeffreys' prior they cover as they say.

    Parameters
    ----------
    likelihood : TransientLikelihood
        Of which.
    p : ndarray
        Its maximum, shape ``(n_parameters,)``.
    mode : int
        Which mode's.
    free : ndarray of int
        The other parameters that are not held, shape ``(n_free,)``.
    """
    place = 2 * likelihood.n_modes + mode
    start = p.copy()
    start[place] = max(abs(p[place]), _FIRST_LEVEL)
    weight, levels = _levels(likelihood, start, place, free, _COARSE)
    best = levels[int(np.argmax(weight))]
    if abs(best.p[mode] - p[mode]) > _STAYS * likelihood.reach(p)[mode]:
        # An ambient response far above a clean decay's noise drives the mode out of its place, and
        # another pole takes it: the response is raised from the least one on.
        start[place] = max(abs(p[place]), _LEAST_LEVEL * (1 + _STEP_TOLERANCE))
        weight, levels = _levels(likelihood, start, place, free, _COARSE)
        best = levels[int(np.argmax(weight))]
    metric = likelihood.metric(best.at)
    spread = float(np.sqrt(np.linalg.inv(metric)[place, place])) / best.p[place]
    if _SPREADS * spread < _COARSE:
        weight, levels = _levels(likelihood, best.p, place, free, _SPREADS * spread)
    weights, most = softmax(weight), int(np.argmax(weight))
    inverses = np.array([np.linalg.inv(level.at.fisher[np.ix_(free, free)]) for level in levels])
    # The Hessian is costly: what it is over the Fisher information is taken from the best level.
    wide = np.linalg.cholesky(invert(likelihood, levels[most], free))
    stretch = wide @ np.linalg.inv(np.linalg.cholesky(inverses[most]))
    where = np.array([level.p for level in levels])
    mean = weights @ where
    cov = (where - mean).T @ (weights[:, None] * (where - mean))
    cov[np.ix_(free, free)] += stretch @ np.tensordot(weights, inverses, 1) @ stretch.T
    return Average(mean, cov)


def _levels(
    likelihood: TransientLikelihood, p: FloatArray, place: int, free: IntArray, step: float
) -> tuple[FloatArray, list[Optimum]]:
    """Maximise at levels in both directions from a first one, until they are too unlikely.

    Returns
    -------
    weights : ndarray
        Log posterior of each level, the others integrated, under Jeffreys' prior on a log grid.
    levels : list of Optimum
        The levels.
    """
    found: list[tuple[float, Optimum]] = []
    for way in (1, -1):
        at = p.copy()
        if way < 0:
            at[place] *= np.exp(-step)
        while at[place] > _LEAST_LEVEL:
            level = maximise(likelihood, at, free)
            fisher = level.at.fisher
            log_det = np.linalg.slogdet(fisher[np.ix_(free, free)])[1]
            prior = 0.5 * np.log(fisher[place, place]) + np.log(at[place])
            found.append((float(prior - level.at.value - log_det / 2), level))
            if found[-1][0] < max(weight for weight, _ in found) - _UNLIKELY:
                break
            at = level.p.copy()
            at[place] *= np.exp(way * step)
    best = max(weight for weight, _ in found)
    kept = [item for item in found if item[0] > best - _UNLIKELY]
    return np.array([weight for weight, _ in kept]), [level for _, level in kept]


def invert(likelihood: TransientLikelihood, optimum: Optimum, free: IntArray) -> FloatArray:
    """Invert the Hessian, or the Fisher information where that has no inverse.

    Parameters
    ----------
    likelihood : TransientLikelihood
        Of which.
    optimum : Optimum
        Its maximum.
    free : ndarray of int
        Along which parameters, shape ``(n_free,)``.

    Returns
    -------
    ndarray
        Covariance of the free parameters, shape ``(n_free, n_free)``.
    """
    try:
        factor = np.linalg.cholesky(_hessian(likelihood, optimum, free))
    except np.linalg.LinAlgError:
        factor = np.linalg.cholesky(optimum.at.fisher[np.ix_(free, free)])
    return np.asarray(linalg.cho_solve((factor, True), np.eye(free.size)))


def _hessian(likelihood: TransientLikelihood, optimum: Optimum, free: IntArray) -> FloatArray:
    """Differentiate the gradient along some parameters, shape ``(n_free, n_free)``."""
    p = optimum.p
    scale = 1 / np.sqrt(np.diag(likelihood.metric(optimum.at)))
    reach = likelihood.reach(p)
    rows = []
    for j in free:
        step = np.zeros(p.size)
        step[j] = _DIFFERENCE * min(scale[j], reach[j])
        up, down = likelihood.evaluate(p + step), likelihood.evaluate(p - step)
        rows.append((up.gradient - down.gradient)[free] / (2 * step[j]))
    return np.asarray(np.add(rows, np.transpose(rows)) / 2)
