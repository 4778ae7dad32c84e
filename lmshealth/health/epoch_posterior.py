"""The posterior of the health parameters at one epoch: its density, and whether it fits.

The drifts δ of the tracked modes have covariance C from the filter. The modal map predicts h(x);
its sensitivities are believed to a relative standard deviation m, so that the error of mode i has
the variance E_i(x) = Σ_j (m h_i^j)², h^j being the drift that parameter j causes alone. Then
δ ~ N(h(x), C + E(x)), with x the ln parameters. The errors of a map are the same at all epochs of a
life: every epoch by itself is judged rightly, but not the difference of two.

Machines that share a part, such as one guide that serves two configurations, have one posterior of
all their parameters, the shared ones once: their likelihoods multiply.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from lmshealth._arrays import BoolArray, FloatArray
from lmshealth.stage.description import Stage
from lmshealth.stage.priors import JointPrior

# How much wider priors are made to see what hangs on them; what of the map, as a share of its
# reach in ln parameter, counts as its edge, and the quantiles that may not lie there.
_WIDER, _EDGE, _ENDS = 2.0, 0.01, (0.05, 0.95)


@dataclass(frozen=True, slots=True, eq=False)
class MachineDrifts:
    """What one machine shows at one epoch.

    Attributes
    ----------
    stage : Stage
        Its modal map.
    modes : tuple of str
        Modes used.
    drift : ndarray
        Shape ``(n_modes,)``.
    cov : ndarray
        Its covariance, shape ``(n_modes, n_modes)``.
    columns : tuple of int
        Where its parameters stand among all.
    """

    stage: Stage
    modes: tuple[str, ...]
    drift: FloatArray
    cov: FloatArray
    columns: tuple[int, ...]

    def log_likelihood(self, x: FloatArray) -> FloatArray:
        """Log likelihood of all ln parameters, inside the map, shape ``(n_points,)``."""
        chi_square, log_det = self.misfit(x)
        return -0.5 * (chi_square + log_det)

    def misfit(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """χ² of the drifts and the log determinant of their covariance, both ``(n_points,)``."""
        own = x[:, self.columns]
        n, n_parameters = own.shape
        drift = self.stage.drift(one_at_a_time(self.stage, own), self.modes)
        drift = drift.reshape(n_parameters + 1, n, -1)
        model_std = self.stage.description.map.model_std if self.stage.description.map else 0.0
        error = model_std**2 * np.sum(drift[1:] ** 2, axis=0)
        cov = self.cov + error[:, :, None] * np.eye(len(self.modes))
        off = self.drift - drift[0]
        solved = np.linalg.solve(cov, off[..., None])[..., 0]
        return np.sum(off * solved, axis=1), np.linalg.slogdet(cov)[1]


@dataclass(frozen=True, slots=True, eq=False)
class EpochPosterior:
    """Log posterior of the ln parameters at one epoch, of one machine or several together.

    Attributes
    ----------
    prior : JointPrior
        Of all parameters.
    machines : tuple of MachineDrifts
        One per machine.
    """

    prior: JointPrior
    machines: tuple[MachineDrifts, ...]

    @classmethod
    def of(
        cls, stage: Stage, modes: tuple[str, ...], drift: FloatArray, cov: FloatArray
    ) -> EpochPosterior:
        """Make that of a single machine; see `MachineDrifts`."""
        columns = tuple(range(len(stage.parameters)))
        return cls(stage.prior, (MachineDrifts(stage, modes, drift, cov, columns),))

    def log_probability(self, x: FloatArray) -> FloatArray:
        """Log posterior of ln parameters up to a constant, shape ``(n_points,)``."""
        total = self.prior.log_density(x)
        inside = np.isfinite(total)
        for view in self.machines:
            if inside.any():
                total[inside] += view.log_likelihood(x[inside])
        return total

    def draw_prior(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Draw ln parameters from the prior inside the map, shape ``(n, n_parameters)``."""
        return self.prior.draw(rng, n)

    def fit(self, x: FloatArray) -> float:
        """Probability of a χ² as large as the least that some of these points leave.

        As many degrees of freedom as drifts: the parameters are not taken off, as priors may hold
        them, so that what is called improbable is.
        """
        least = np.min(np.sum([view.misfit(x)[0] for view in self.machines], axis=0))
        return float(chdtrc(sum(len(view.modes) for view in self.machines), least))

    def at_edge(self, x: FloatArray) -> BoolArray:
        """Tell which parameters have draws piled up at an end of the map, ``(n_parameters,)``."""
        low, high = np.quantile(x, _ENDS, axis=0)
        margin = _EDGE * (self.prior.high - self.prior.low)
        return np.asarray((low < self.prior.low + margin) | (high > self.prior.high - margin))

    def widened(self) -> EpochPosterior:
        """Give the posterior with priors twice as wide."""
        return EpochPosterior(self.prior.widened(_WIDER), self.machines)


def one_at_a_time(stage: Stage, x: FloatArray) -> FloatArray:
    """Stack points with copies in which one parameter at a time leaves its baseline.

    Parameters
    ----------
    stage : Stage
        Says where the baseline is.
    x : ndarray
        ln parameters, shape ``(n_points, n_parameters)``.

    Returns
    -------
    ndarray
        The points, then for each parameter the points with all others at baseline,
        shape ``((1 + n_parameters) n_points, n_parameters)``.
    """
    stacked = np.empty((x.shape[1] + 1, *x.shape))
    stacked[0] = x
    stacked[1:] = stage.baseline_point
    for j in range(x.shape[1]):
        stacked[1 + j, :, j] = x[:, j]
    return stacked.reshape(-1, x.shape[1])
