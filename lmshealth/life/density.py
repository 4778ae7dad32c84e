"""Posterior density of the coordinates of one scenario of a life, and its nuisances."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import softmax

from lmshealth._private.arrays import BoolArray, FloatArray
from lmshealth.errors import NotEnoughData
from lmshealth.life.importance_sampling import log_sum_exp
from lmshealth.life.likelihood import Grid, LifeLikelihood
from lmshealth.life.scenarios import Scenario

# Share of the posterior of the grid points that are dropped once a scenario is sampled.
_NEGLIGIBLE = 0.01

Nuisances = tuple[np.ndarray, np.ndarray]
"""Indices of the map error and of the grid point of each draw, ``(n,)`` each."""


@dataclass(frozen=True, slots=True, eq=False)
class LifeDensity:
    """Log posterior density of the coordinates of one scenario, averaged over a grid."""

    likelihood: LifeLikelihood
    scenario: Scenario
    grid: Grid

    def log_probability(self, y: FloatArray) -> FloatArray:
        """Return the log posterior density, -inf outside the map, shape ``(n,)``.

        Its integral is the evidence of the scenario up to a factor that all scenarios share.
        """
        total = self.scenario.log_prior(y)
        possible = np.isfinite(total)
        x, within = self.likelihood.path(self.scenario, y[possible])
        total[possible] = np.where(within, total[possible], -np.inf)
        if within.any():
            terms = self.likelihood.terms(self.grid, x)
            total[np.isfinite(total)] += log_sum_exp(terms.reshape(-1, terms.shape[2]))
        return total

    def point_weights(self, y: FloatArray) -> FloatArray:
        """Return the probability of map errors and grid points, ``(n_map_errors, n_points, n)``.

        At coordinates, of which those outside the map are left out.
        """
        x, inside = self.likelihood.path(self.scenario, y[np.isfinite(self.scenario.log_prior(y))])
        if not inside.any():
            name = self.likelihood.data.stage.name
            raise NotEnoughData(f"{name}: no life of the prior stays inside the map")
        return np.asarray(softmax(self.likelihood.terms(self.grid, x), axis=(0, 1)))

    def weights(self, y: FloatArray) -> FloatArray:
        """Return the probability of each grid point, averaged over coordinates, ``(n_points,)``."""
        return np.asarray(self.point_weights(y).sum(axis=0).mean(axis=1))

    def narrowed(self, y: FloatArray, loss: float = _NEGLIGIBLE) -> LifeDensity:
        """Drop grid points that together have a share of the posterior at coordinates."""
        return replace(self, grid=self.grid[kept_weights(self.weights(y), loss)])

    def settings(self, y: FloatArray) -> FloatArray:
        """Return means at coordinates of walk, noise scale, deviation, χ², and its freedom.

        χ² is that at the mean of the coordinates. Its degrees of freedom are the data less all that
        they determine: intercepts, coefficients, and coordinates.
        """
        weight, grid = self.point_weights(y).mean(axis=2), self.grid
        centre = y.mean(axis=0, keepdims=True)
        possible = np.isfinite(self.scenario.log_prior(centre))
        x, inside = self.likelihood.path(self.scenario, centre[possible])
        if not inside.any():
            x, _ = self.likelihood.path(self.scenario, y[:1])
        chi_square = float(np.sum(weight * self.likelihood.quadratic(grid, x)[0][:, :, 0]))
        means = np.stack([grid.walk, grid.noise_scale, grid.deviation, grid.freedom])
        walk, noise, deviation, freedom = means @ weight.sum(axis=0)
        freedom = max(freedom - self.scenario.n_dim, 1.0)
        return np.array([walk, noise, deviation, chi_square, freedom])

    def draw_nuisances(
        self, y: FloatArray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Draw a map error and a grid point for coordinates inside the support, ``(n,)`` each."""
        # Without coordinates all draws are of one life.
        one = y[:1] if not self.scenario.n_dim else y
        weight = self.point_weights(one)
        upto = np.cumsum(weight.reshape(-1, one.shape[0]), axis=0)
        chosen = (upto < rng.uniform(size=y.shape[0])).sum(axis=0).clip(max=upto.shape[0] - 1)
        return np.divmod(chosen, weight.shape[1])

    def deviations(
        self, y: FloatArray, nuisances: Nuisances, moments: FloatArray, rng: np.random.Generator
    ) -> FloatArray:
        """Draw the deviation of ln health from its laws at moments in m since the baseline.

        For coordinates ``(n, n_dim)`` inside the support and their nuisances: ``(n, n_moments,
        n_parameters)``, independent from moment to moment.
        """
        free = self.likelihood.data.free
        x, _ = self.likelihood.path(self.scenario, y if self.scenario.n_dim else y[:1])
        off = np.zeros((y.shape[0], moments.size, free.size))
        map_errors = self.likelihood.data.stage.map_errors
        for error, k in np.unique(np.column_stack(nuisances), axis=0).tolist():
            if self.grid.deviation[k] > 0:
                own = (nuisances[0] == error) & (nuisances[1] == k)
                of = own if self.scenario.n_dim else slice(None)
                place = k, map_errors[error][0]
                mean, cov = self.likelihood.deviation(self.grid, *place, x[of], moments)
                # A variance of 0 may be rounded to below 0.
                least = 1e-15 * np.eye(cov.shape[-1])
                unit = rng.standard_normal((own.sum(), *mean.shape[1:], 1))
                off[own] = mean + (np.linalg.cholesky(cov + least) @ unit)[..., 0]
        return off * free


def kept_weights(weight: FloatArray, loss: float) -> BoolArray:
    """Mark the largest weights ``(n,)``, all but those that sum to less than the loss."""
    order = np.argsort(weight)
    kept = np.ones(weight.size, dtype=bool)
    kept[order[np.cumsum(weight[order]) < loss]] = False
    return kept
