"""Posterior density of the ln health parameters at one epoch, and its goodness of fit.

README.md has the model. Machines that share a part have one posterior of all parameters.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.special import chdtrc

from lmshealth._private.arrays import BoolArray, FloatArray
from lmshealth.health import constants
from lmshealth.stage.description import Stage
from lmshealth.stage.priors import JointPrior


@dataclass(frozen=True, slots=True, eq=False)
class MachineDrifts:
    """Drifts of ln f of the modes of one machine since its baseline, at one epoch.

    Drifts ``(n_modes,)`` with their covariance ``(n_modes, n_modes)``; `columns` are the indices of
    the machine's parameters among all parameters.
    """

    stage: Stage
    modes: tuple[str, ...]
    drift: FloatArray
    cov: FloatArray
    columns: tuple[int, ...]

    def log_likelihood(self, x: FloatArray) -> FloatArray:
        """Return the log likelihood of all ln parameters inside the map, shape ``(n_points,)``."""
        chi_square, log_det = self.misfit(x)
        log_prior = np.log([weight for _, weight in self.stage.map_errors])
        terms = log_prior[:, None] - 0.5 * (chi_square + log_det)
        return np.asarray(np.logaddexp.reduce(terms, axis=0))

    def misfit(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return χ² of the drifts and the log determinant of their covariance.

        Both ``(n_map_errors, n_points)``, for the possible errors of the map.
        """
        drift = self.stage.drifts(x[:, self.columns], self.modes)
        variance = np.array([std for std, _ in self.stage.map_errors])[:, None, None] ** 2
        error = variance * np.sum(drift[1:] ** 2, axis=0)
        cov = self.cov + error[..., None] * np.eye(len(self.modes))
        off = self.drift - drift[0]
        solved = np.linalg.solve(cov, np.broadcast_to(off, error.shape)[..., None])[..., 0]
        return np.sum(off * solved, axis=-1), np.linalg.slogdet(cov)[1]


@dataclass(frozen=True, slots=True, eq=False)
class EpochPosterior:
    """Log posterior of the ln parameters at one epoch, of one machine or several together."""

    prior: JointPrior
    machines: tuple[MachineDrifts, ...]

    @classmethod
    def of(cls, stage: Stage, modes: tuple[str, ...], drift: FloatArray, cov: FloatArray) -> Self:
        """Make the posterior of a single machine; see `MachineDrifts`."""
        columns = tuple(range(len(stage.parameters)))
        return cls(stage.prior, (MachineDrifts(stage, modes, drift, cov, columns),))

    def log_probability(self, x: FloatArray) -> FloatArray:
        """Return the log posterior of ln parameters up to a constant, shape ``(n_points,)``."""
        total = self.prior.log_density(x)
        inside = np.isfinite(total)
        for machine in self.machines:
            if inside.any():
                total[inside] += machine.log_likelihood(x[inside])
        return total

    def fit(self, x: FloatArray) -> float:
        """Return the probability of a χ² above the smallest of these points ``(n, n_parameters)``.

        The degrees of freedom are the number of drifts, without the parameters, which priors may
        hold: an upper bound of the p value.
        """
        total = np.sum([machine.misfit(x)[0] for machine in self.machines], axis=0)
        weights = [weight for _, weight in self.machines[0].stage.map_errors]
        degrees = sum(len(machine.modes) for machine in self.machines)
        return float(weights @ chdtrc(degrees, total.min(axis=1)))

    def at_edge(self, x: FloatArray) -> BoolArray:
        """Return which parameters' draws end at an end of the map, shape ``(n_parameters,)``."""
        low, high = np.quantile(x, (0.05, 0.95), axis=0)
        margin = constants.EDGE_SHARE * (self.prior.high - self.prior.low)
        return np.asarray((low < self.prior.low + margin) | (high > self.prior.high - margin))
