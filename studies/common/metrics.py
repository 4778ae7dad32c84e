"""How good predictions of remaining life were, once the truth is known.

A prediction is a set of draws, one column per life: ``(n_draws, n)``. A draw that is infinite never
reaches its limit, and so does a truth that is infinite. All lengths are in one unit, m elsewhere in
the package. A truth that is known only to lie beyond some travel is *censored* there: nothing that
counts what lies beyond can be computed, and leaving such lives out biases all the rest. `crps` and
`place` therefore take a horizon of each life.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import beta as beta_distribution

from lmshealth._arrays import BoolArray, FloatArray


def mass_within(draws: FloatArray, truth: ArrayLike, margin: ArrayLike) -> FloatArray:
    """Return the share of draws that lie within a margin of the truth.

    Parameters
    ----------
    draws : ndarray
        Shape ``(n_draws, n)``.
    truth : array_like
        Shape ``(n,)``. Within any margin of a truth that is infinite are infinite draws alone.
    margin : array_like
        In the unit of the draws, shape ``(n,)`` or one for all.

    Returns
    -------
    ndarray
        Shape ``(n,)``.
    """
    draws, truth = np.asarray(draws, float), np.asarray(truth, float)
    with np.errstate(invalid="ignore"):  # what never ends from what never ends
        near = np.abs(draws - truth) <= np.asarray(margin, float)
    return np.asarray(np.mean(np.where(np.isfinite(truth), near, draws == truth), axis=0))


def within(
    draws: FloatArray, truth: ArrayLike, margin: ArrayLike, *, mass: float | None = None
) -> BoolArray:
    """Return which predictions lie within a margin of the truth.

    Parameters
    ----------
    draws, truth, margin
        As in `mass_within`.
    mass : float, optional
        What share of the draws must lie there, β of Saxena2010; by default the median must.

    Returns
    -------
    ndarray of bool
        Shape ``(n,)``.
    """
    if mass is None:
        return np.asarray(mass_within(np.median(draws, axis=0)[None], truth, margin) == 1)
    return np.asarray(mass_within(draws, truth, margin) >= mass)


def alpha_lambda(
    draws: FloatArray, truth: ArrayLike, alpha: float, *, mass: float | None = None
) -> BoolArray:
    """Return which predictions lie within the share α of the true remaining life: α-λ accuracy.

    Parameters
    ----------
    draws : ndarray
        Remaining life, shape ``(n_draws, n)``.
    truth : array_like
        True remaining life at the same moment, positive, shape ``(n,)``.
    alpha : float
        As 0.2 for a fifth of what is left.
    mass : float, optional
        As in `within`.

    Returns
    -------
    ndarray of bool
        Shape ``(n,)``.

    Raises
    ------
    ValueError
        If a life is over.

    References
    ----------
    Saxena2008 for the point form, Saxena2010 for the one by probability mass.
    """
    left = _left(truth)
    return within(draws, left, alpha * left, mass=mass)


def relative_accuracy(draws: FloatArray, truth: ArrayLike) -> FloatArray:
    """Return one minus the relative error of the median.

    Parameters
    ----------
    draws, truth
        As in `alpha_lambda`.

    Returns
    -------
    ndarray
        Shape ``(n,)``: 1 for a median that is right, 0 for one that is off by all that is left,
        -inf where the median never ends and the life does.

    Raises
    ------
    ValueError
        If a life is over.

    References
    ----------
    Saxena2008
    """
    left, median = _left(truth), np.median(draws, axis=0)
    with np.errstate(invalid="ignore"):
        accuracy = 1 - np.abs(median - left) / left
    # The limit for lives that get ever longer.
    never = np.where(np.isfinite(median), 0.0, 1.0)
    return np.asarray(np.where(np.isfinite(left), accuracy, never))


def cumulative_relative_accuracy(
    accuracy: FloatArray, weights: FloatArray | None = None
) -> FloatArray:
    """Average relative accuracies over the moments of prediction.

    Parameters
    ----------
    accuracy : ndarray
        Of `relative_accuracy`, shape ``(n_moments, n)``.
    weights : ndarray, optional
        Of each moment, shape ``(n_moments,)``; equal by default.

    Returns
    -------
    ndarray
        Shape ``(n,)``.

    References
    ----------
    Saxena2008
    """
    return np.asarray(np.average(accuracy, axis=0, weights=weights))


def prognostic_horizon(held: BoolArray, left: FloatArray) -> FloatArray:
    """Return the life that is left when predictions begin to be good and stay so.

    Saxena2010 count from the first moment at which a criterion is met. Here it must be met at all
    later moments too: a criterion that is met once by chance warns of nothing.

    Parameters
    ----------
    held : ndarray of bool
        Whether a criterion is met, as of `within`, shape ``(n_moments, n)``, in order of time.
    left : ndarray
        True remaining life at these moments, shape ``(n_moments, n)``.

    Returns
    -------
    ndarray
        Shape ``(n,)``; 0 where the last prediction does not meet it.

    References
    ----------
    Saxena2008, Saxena2010
    """
    held, left = np.asarray(held, bool), np.asarray(left, float)
    lasting = np.logical_and.accumulate(held[::-1], axis=0)[::-1]
    first = np.take_along_axis(left, np.argmax(lasting, axis=0)[None], axis=0)[0]
    return np.where(lasting.any(axis=0), first, 0.0)


def crps(draws: FloatArray, truth: ArrayLike, *, horizon: ArrayLike = np.inf) -> FloatArray:
    """Return the continuous ranked probability score of draws, up to a horizon.

    With F the distribution of the draws and y the truth it is ∫ (F(z) - 1{y ≤ z})² dz over all z
    up to the horizon, which is the score of the draws and the truth cut off there. It is proper:
    who states what he believes of life up to the horizon has the least expected score. A life that
    is censored has its moment of censoring for horizon.

    Parameters
    ----------
    draws : ndarray
        Shape ``(n_draws, n)``.
    truth : array_like
        Shape ``(n,)``; of a censored life anything past the horizon, as infinity.
    horizon : array_like
        Shape ``(n,)`` or one for all. It must not depend on when the life ends.

    Returns
    -------
    ndarray
        In the unit of the draws, shape ``(n,)``; 0 is best. Of a single draw, its absolute error.

    Raises
    ------
    ValueError
        If draws or truths are infinite and there is no horizon.

    References
    ----------
    Gneiting2007, Gneiting2011 for weights by thresholds.
    """
    x, y = np.minimum(draws, horizon), np.minimum(truth, horizon)
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise ValueError("draws or truths that never end have no finite score: state a horizon")
    off, n = x - y, x.shape[0]
    # Half the mean distance of two draws, Σ |x_i - x_j| / (2 n²), from their order.
    order = (2 * np.arange(1, n + 1) - n - 1) / n**2
    return np.asarray(np.mean(np.abs(off), axis=0) - order @ np.sort(off, axis=0))


def place(
    draws: FloatArray,
    truth: ArrayLike,
    rng: np.random.Generator,
    *,
    horizon: ArrayLike = np.inf,
) -> FloatArray:
    """Return the place of truths among draws, from 0 to 1: probability integral transforms.

    Where draws equal the truth, as all do that lie beyond the horizon with it, the place is drawn
    evenly from where they stand, so that places of truths that are one more draw are uniform.
    Counting the draws below (0 for a certainty that is right), or the middle, is not.

    Parameters
    ----------
    draws : ndarray
        Shape ``(n_draws, n)``.
    truth : array_like
        Shape ``(n,)``.
    rng : Generator
        Breaks ties.
    horizon : array_like
        As in `crps`.

    Returns
    -------
    ndarray
        Shape ``(n,)``.

    References
    ----------
    Czado2009
    """
    x, y = np.minimum(draws, horizon), np.minimum(truth, horizon)
    below, tied = np.sum(x < y, axis=0), np.sum(x == y, axis=0)
    return np.asarray((below + rng.uniform(size=y.shape) * (tied + 1)) / (x.shape[0] + 1))


@dataclass(frozen=True, slots=True)
class Coverage:
    """How often intervals hold the truth.

    Attributes
    ----------
    nominal : float
        How often they claim to.
    hits, n : int
        How often they do, of how many.
    low, high : float
        Interval of the share by Clopper and Pearson.
    """

    nominal: float
    hits: int
    n: int
    low: float
    high: float

    @property
    def share(self) -> float:
        """How often they do."""
        return self.hits / self.n

    @property
    def holds(self) -> bool:
        """Whether that may be as often as they claim."""
        return self.low <= self.nominal <= self.high


def coverage(places: FloatArray, nominal: float, *, level: float = 0.999) -> Coverage:
    """Count how often central intervals hold the truth.

    Parameters
    ----------
    places : ndarray
        Of `place`, of any shape.
    nominal : float
        Probability of the intervals, as 0.9.
    level : float
        Of the interval of the share.

    References
    ----------
    Clopper1934
    """
    hits, n = int(np.sum(np.abs(np.asarray(places) - 0.5) < nominal / 2)), int(np.size(places))
    return Coverage(nominal, hits, n, *clopper_pearson(hits, n, level))


def clopper_pearson(hits: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Return the exact interval of a proportion.

    References
    ----------
    Clopper1934
    """
    tail = (1 - level) / 2
    low = float(beta_distribution.ppf(tail, hits, trials - hits + 1)) if hits else 0.0
    high = float(beta_distribution.ppf(1 - tail, hits + 1, trials - hits)) if hits < trials else 1.0
    return low, high


def service_at(draws: FloatArray, risk: float, *, horizon: ArrayLike = np.inf) -> FloatArray:
    """Return the latest service before which no more than a share of the draws have ended.

    Parameters
    ----------
    draws : ndarray
        Remaining life, shape ``(n_draws, n)``.
    risk : float
        The share, from 0 up to but not including 1.
    horizon : array_like
        The latest that is planned at all, shape ``(n,)`` or one for all.

    Returns
    -------
    ndarray
        Shape ``(n,)``; 0 where the risk is exceeded already.
    """
    ordered = np.sort(draws, axis=0)
    # That many may have ended; a share that is whole is not lost by rounding.
    after = int(np.floor(risk * ordered.shape[0] * (1 + 1e-12)))
    return np.asarray(np.minimum(np.maximum(ordered[after], 0.0), horizon))


def unexpected_breaks(service: FloatArray, truth: ArrayLike) -> BoolArray:
    """Return which lives end before their service.

    Parameters
    ----------
    service, truth : array_like
        When it is, as of `service_at`, and when the life ends, shape ``(n,)``.

    Returns
    -------
    ndarray of bool
        Shape ``(n,)``.

    References
    ----------
    Susto2015
    """
    return np.asarray(np.asarray(truth) < service)


def unexploited_life(
    service: FloatArray, truth: ArrayLike, *, horizon: ArrayLike = np.inf
) -> FloatArray:
    """Return the life that a service throws away.

    Parameters
    ----------
    service, truth : array_like
        As in `unexpected_breaks`.
    horizon : array_like
        Life beyond it is not counted, shape ``(n,)`` or one for all.

    Returns
    -------
    ndarray
        Shape ``(n,)``; 0 where the life ends before.

    References
    ----------
    Susto2015
    """
    return np.asarray(np.maximum(np.minimum(truth, horizon) - service, 0.0))


def _left(truth: ArrayLike) -> FloatArray:
    left = np.asarray(truth, float)
    if not (left > 0).all():
        raise ValueError(
            f"remaining lives must be positive, got {left.min():g}: a share of what is left means "
            "nothing once a life is over; leave such moments out"
        )
    return left
