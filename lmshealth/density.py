"""The posterior density of one course of a life, in its coordinates."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import softmax

from lmshealth.arrays import BoolArray, FloatArray
from lmshealth.courses import Course
from lmshealth.errors import NotEnoughData
from lmshealth.life import Grid, LifeLikelihood

_NEGLIGIBLE = 0.01  # share of the posterior


@dataclass(frozen=True, slots=True, eq=False)
class LifeDensity:
    """Log posterior of the coordinates of one course.

    Attributes
    ----------
    life : LifeLikelihood
        The data.
    course : Course
        Laws, and their priors.
    grid : Grid
        Points of walk, noise scale and deviation to average over.
    """

    life: LifeLikelihood
    course: Course
    grid: Grid

    @classmethod
    def of(cls, life: LifeLikelihood, course: Course) -> LifeDensity:
        """Give the density of a course over the whole grid."""
        return cls(life, course, life.grid)

    def draw_prior(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Draw coordinates from the prior, shape ``(n, n_dim)``."""
        return self.course.draw(rng, n)

    def log_probability(self, y: FloatArray) -> FloatArray:
        """Log posterior, not normalised; -inf where a life leaves the map, shape ``(n,)``.

        Its integral is the evidence of the course, up to a factor that all courses share.
        """
        total = self.course.log_prior(y)
        x, inside = self._path(y, np.isfinite(total))
        total = np.where(inside, total, -np.inf)
        if inside.any():
            # As scipy's logsumexp, at a tenth of its time for so few points.
            total[inside] += np.logaddexp.reduce(self.life.terms(self.grid, x), axis=0)
        return total

    def narrowed(self, y: FloatArray) -> LifeDensity:
        """Drop grid points that together carry a hundredth of the posterior at coordinates."""
        weight = self.weights(y)
        order = np.argsort(weight)
        kept = np.ones(weight.size, dtype=bool)
        kept[order[np.cumsum(weight[order]) < _NEGLIGIBLE]] = False
        return replace(self, grid=self.grid.chosen(kept))

    def settings(self, y: FloatArray) -> tuple[float, float, float, float]:
        """Averaged walk, noise scale and deviation, and χ² at the mean of coordinates.

        Parameters
        ----------
        y : ndarray
            Coordinates inside the support, shape ``(n, n_dim)``.
        """
        weight, grid = self.weights(y), self.grid
        centre = y.mean(axis=0, keepdims=True)
        x, inside = self._path(centre, np.isfinite(self.course.log_prior(centre)))
        if not inside.all():
            x, _ = self._path(y[:1], np.array([True]))
        chi_square = self.life.quadratic(grid, x)[0][:, 0]
        means = [weight @ part for part in (grid.walk, grid.noise_scale, grid.deviation)]
        return float(means[0]), float(means[1]), float(means[2]), float(weight @ chi_square)

    def deviations(
        self, y: FloatArray, moments: FloatArray, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Draw how far ln health is off its laws.

        Parameters
        ----------
        y : ndarray
            Coordinates inside the support, shape ``(n, n_dim)``.
        moments : ndarray
            Travel in m since the baseline, past or future, shape ``(n_moments,)``.
        rng : Generator
            Of all randomness.

        Returns
        -------
        off : ndarray
            Independent from moment to moment, shape ``(n, n_moments, n_parameters)``.
        rate : ndarray
            Variance that is added per m of travel to come, shape ``(n, n_parameters)``.
        """
        # Without coordinates all draws are of one life.
        one = y[:1] if not self.course.n_dim else y
        x, _ = self._path(one, np.full(one.shape[0], True))
        upto = np.cumsum(softmax(self.life.terms(self.grid, x), axis=0), axis=0)
        point = (upto < rng.uniform(size=y.shape[0])).sum(axis=0).clip(max=upto.shape[0] - 1)
        off = np.zeros((y.shape[0], moments.size, len(self.course.branches)))
        for k in np.unique(point[self.grid.deviation[point] > 0]):
            own = point == k
            of = own if self.course.n_dim else slice(None)
            mean, cov = self.life.deviation(self.grid, int(k), x[of], moments)
            # What the data or the baseline leave nothing of is rounding.
            least = 1e-15 * np.eye(cov.shape[-1])
            unit = rng.standard_normal((own.sum(), *mean.shape[1:], 1))
            off[own] = mean + (np.linalg.cholesky(cov + least) @ unit)[..., 0]
        rate = self.grid.deviation[point, None] ** 2 / self.life.horizon
        return off * self.life.free, rate * self.life.free

    def weights(self, y: FloatArray) -> FloatArray:
        """Probability of each point of the grid, averaged over coordinates, ``(n_grid,)``."""
        x, inside = self._path(y, np.isfinite(self.course.log_prior(y)))
        if not inside.any():
            name = self.life.stage.name
            raise NotEnoughData(f"{name}: no life of the prior stays inside the map")
        return np.asarray(softmax(self.life.terms(self.grid, x), axis=0).mean(axis=1))

    def _path(self, y: FloatArray, possible: BoolArray) -> tuple[FloatArray, BoolArray]:
        """Ln parameters at the nodes of the lives that stay inside the map, and which these are."""
        inside = possible.copy()
        x, within = self.life.ln_health(self.course, y[possible], self.life.checked)
        inside[possible] = within
        return x[within, : self.life.nodes.size], inside
