"""Result of the prognosis: remaining useful life with its uncertainty."""

from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np

from lmshealth._private.arrays import FloatArray, freeze
from lmshealth._private.result import Result
from lmshealth.life.posterior import LoneMode


@dataclass(frozen=True, slots=True)
class LawWeight:
    """Posterior probability of a law of a health parameter.

    It begins at the baseline, or at a step: `begin` is the travel in m since the baseline.
    """

    parameter: str
    kind: str
    begin: float
    probability: float


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Prognosis(Result):
    """Remaining useful life of one machine, of which `n` health parameters have a limit.

    `lmshealth.life.maintenance_decision.probability_before` has the probability by a day.
    """

    stage: str  # identity of the machine
    recorded_at: datetime  # of the last log, at which the prognosis is made
    travel: float  # odometer then in m
    parameters: tuple[str, ...]  # those with a limit, then ``any`` (the first limit reached)
    # With a limit that the modes do not identify; not in `parameters` nor ``any``.
    unidentifiable: tuple[str, ...]
    limits: FloatArray  # NaN for ``any``, ``(n + 1,)``
    # Draws of the remaining travel in m, negative if the limit has been passed and infinite if it
    # is never reached, ``(n_draws, n + 1)``; and of the mean travel in m per day, ``(n_draws,)``.
    remaining: FloatArray
    usage: FloatArray
    # Draws of the travel in m, by the laws, at which half of ln(health now / limit) is lost, of the
    # limit that is reached first, ``(n_draws,)``.
    half: FloatArray
    horizon: float  # travel in m beyond which nothing is published
    # Draws of the parameters now in their units, ``(n_draws, n)``: those of `Health`, in its order.
    health: FloatArray
    # Odometer grid in m of the life curves, ``(n_grid,)``, and 5, 25, 50, 75, 95 % quantiles of the
    # parameters there, ``(5, n_grid, n)``.
    curve_travel: FloatArray
    curve_quantiles: FloatArray
    laws: tuple[LawWeight, ...]  # of each parameter, the most probable first
    chi_square: float  # of the residuals at the posterior mean
    degrees_of_freedom: float  # number of data less all that they determine
    # Posterior means: standard deviation over the history of the random walk of ln f, factor on the
    # reported standard deviations, standard deviation over it of ln health about its laws.
    walk: float
    noise_scale: float
    deviation: float
    ess: float  # ess, r_hat: worst of all law parameters
    r_hat: float
    # Modes that moved alone in some draws, the most probable first.
    modes_off: tuple[LoneMode, ...] = ()

    def __post_init__(self) -> None:
        n, n_draws = len(self.parameters), self.remaining.shape[0]
        freeze(
            self,
            ("limits", n),
            ("remaining", n_draws, n),
            ("usage half", n_draws),
            ("health", self.health.shape[0], n - 1),
            ("curve_quantiles", 5, self.curve_travel.size, n - 1),
        )

    def title(self) -> str:
        """Return machine, moment, odometer and horizon."""
        at = f"{self.recorded_at.date()} at {self.travel / 1000:.6g} km"
        horizon = f"{self.horizon / 1000:.6g} km"
        return f"Prognosis of {self.stage} on {at}: remaining travel in km, at most {horizon}"

    def to_columns(self) -> dict[str, Any]:
        """Return quantiles of the remaining travel, infinite beyond the horizon, of each limit."""
        left = np.maximum(self.censored(), 0.0) / 1000
        levels = (0.05, 0.25, 0.5, 0.75, 0.95)
        quantiles = np.quantile(left, levels, axis=0, method="inverted_cdf")
        pairs = zip(levels, quantiles, strict=True)
        return {
            "parameter": list(self.parameters),
            "limit": self.limits,
            **{f"rul_km_q{100 * level:02.0f}": own for level, own in pairs},
            "probability_already_past": self.already_past(),
            "probability_beyond_horizon": self.beyond_horizon(),
        }

    def censored(self) -> FloatArray:
        """Return `remaining` with infinity beyond the horizon."""
        return np.where(self.remaining > self.horizon, np.inf, self.remaining)

    def beyond_horizon(self) -> FloatArray:
        """Return the probability to reach the horizon, shape ``(n_parameters + 1,)``."""
        return np.asarray(np.mean(self.remaining > self.horizon, axis=0))

    def already_past(self) -> FloatArray:
        """Return the probability that a limit has been passed, shape ``(n_parameters + 1,)``."""
        return np.asarray(np.mean(self.remaining <= 0, axis=0))
