"""Result of the prognosis: remaining useful life."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

import numpy as np

from lmshealth._arrays import FloatArray, expect_shape, freeze


@dataclass(frozen=True, slots=True)
class LawWeight:
    """How probable it is that a parameter follows a law.

    Attributes
    ----------
    parameter : str
        Name of the health parameter.
    kind : str
        The law, as in the stage description.
    begin : float
        Travel in m since the baseline at which it begins: 0, or that of a step.
    probability : float
        In the posterior.
    """

    parameter: str
    kind: str
    begin: float
    probability: float


@dataclass(frozen=True, slots=True, eq=False)
class Prognosis:
    """Remaining useful life with everything that is not known about it.

    Attributes
    ----------
    stage : str
        Identity of the machine.
    recorded_at : datetime
        The moment the prognosis is made at: the last log.
    travel : float
        Odometer at that moment, in m.
    parameters : tuple of str
        Names of the health parameters with a limit, then ``any`` (the first limit reached).
    unidentifiable : tuple of str
        Parameters with a limit of which the modes cannot tell how far off it is: nothing is said of
        them, and they are no part of ``any``.
    limits : ndarray
        Limit of each parameter, NaN for ``any``, shape ``(n_parameters + 1,)``.
    remaining : ndarray
        Draws of the remaining travel in m, negative when the limit is already passed and infinite
        when it is never reached, shape ``(n_draws, n_parameters + 1)``.
    usage : ndarray
        Draws of the mean travel per day in m until the end, shape ``(n_draws,)``.
    horizon : float
        Travel in m past which nothing is claimed.
    health : ndarray
        Draws of the same parameters now, by their laws and how far health is off these,
        shape ``(n_draws, n_parameters)``.
    curve_travel : ndarray
        Odometer grid in m of the life curves, shape ``(n_grid,)``.
    curve_quantiles : ndarray
        5, 25, 50, 75, 95 % quantiles of the same on that grid,
        shape ``(5, n_grid, n_parameters)``.
    laws : tuple of LawWeight
        Of each parameter, the most probable law first.
    chi_square : float
        Of the residuals at the posterior mean.
    degrees_of_freedom : int
        Data minus law parameters.
    walk : float
        Standard deviation over the history of the random walk of ln frequency that the data ask
        for beside the laws, averaged over its evidence.
    noise_scale : float
        Factor on the reported standard deviations that the data ask for, averaged likewise.
    deviation : float
        Standard deviation at the horizon of ln health about its laws, averaged likewise.
    ess, r_hat : float
        Worst over the law parameters.
    """

    stage: str
    recorded_at: datetime
    travel: float
    parameters: tuple[str, ...]
    unidentifiable: tuple[str, ...]
    limits: FloatArray
    remaining: FloatArray
    usage: FloatArray
    horizon: float
    health: FloatArray
    curve_travel: FloatArray
    curve_quantiles: FloatArray
    laws: tuple[LawWeight, ...]
    chi_square: float
    degrees_of_freedom: int
    walk: float
    noise_scale: float
    deviation: float
    ess: float
    r_hat: float

    def __post_init__(self) -> None:
        n = len(self.parameters)
        expect_shape("limits", self.limits, (n,))
        expect_shape("remaining", self.remaining, (self.remaining.shape[0], n))
        expect_shape("usage", self.usage, (self.remaining.shape[0],))
        expect_shape("health", self.health, (self.health.shape[0], n - 1))
        expect_shape("curve_quantiles", self.curve_quantiles, (5, self.curve_travel.size, n - 1))
        freeze(self)

    def censored(self) -> FloatArray:
        """Draws of the remaining travel, infinite past the horizon, as `remaining` is shaped."""
        return np.where(self.remaining > self.horizon, np.inf, self.remaining)

    def beyond_horizon(self) -> FloatArray:
        """Probability that each limit stays unreached to the horizon, ``(n_parameters + 1,)``."""
        return np.asarray(np.mean(self.remaining > self.horizon, axis=0))

    def already_past(self) -> FloatArray:
        """Probability that each limit has been passed already, shape ``(n_parameters + 1,)``."""
        return np.asarray(np.mean(self.remaining <= 0, axis=0))
