"""Likelihood of a whole life: degradation laws against the ln frequencies of all logs.

For the informative modes of all logs since the baseline, y = H(θ) + a + b (T - T_ref) + walk + ε.
The intercept a, the covariate coefficients b and the random walk are Gaussian, as are the biases of
sources and what retunings shift, and marginalised into

    Σ = R + I ⊗ [σ_a² 1 1ᵀ + σ_b² T Tᵀ + q² min(s, s')],

so that errors common to all epochs stay common. The map's sensitivities are wrong by a relative
error m, the same over the whole life: with V the whitened contribution of each parameter to each
mode times m, M = I + VᵀV and w = Vᵀ r,

    ln L = -½ rᵀr + ½ wᵀ M⁻¹ w - ½ ln|M| - ln|chol Σ|,   r = chol(Σ)⁻¹ (y - H(θ)).

The walk q and a factor on R are not known either: ln L is averaged over a grid of both.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import logsumexp, softmax

from lmshealth.arrays import FloatArray
from lmshealth.errors import NotEnoughData
from lmshealth.inference import one_at_a_time
from lmshealth.stage import ParameterSpec, Stage
from lmshealth.statespace import BIAS_STD, JUMP_STD, MOVES, regressors
from lmshealth.tracks import History

_INTERCEPT_STD = 0.1
# Random walk of ln f over the history, and factor on the reported standard deviations, with priors.
_WALKS = (1e-5, 5e-4, 1.5e-3, 5e-3, 1.5e-2)
_NOISE_SCALES = (1.0, 1.5, 2.25)
_NOISE_SCALE_PRIOR = (0.9, 0.07, 0.03)
_NEGLIGIBLE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class _Whitening:
    """One point of the grid: inverse Cholesky factor of Σ, and its log prior weight."""

    walk: float
    noise_scale: float
    inverse: FloatArray
    log_weight: float


class LifeLikelihood:
    """Log likelihood and prior of all law parameters, vectorised over walkers.

    Parameters
    ----------
    history : History
        Modal estimates of all logs.
    stage : Stage
        Laws, priors, covariates and modal map.

    Raises
    ------
    NotEnoughData
        If fewer than three logs after the baseline hold an informative mode, or the odometer
        has not moved.
    """

    def __init__(self, history: History, stage: Stage) -> None:
        self.stage = stage
        if not history.has_odometer:
            raise NotEnoughData(
                f"{history.stage}: not every log has travel_km, and laws of a life count by the "
                "odometer; add it to manifest.csv"
            )
        seen = np.any(np.isfinite(history.ln_frequency[history.baseline :]), axis=0)
        columns = [
            i
            for name in stage.informative
            for i in (history.columns(name) if name in history.modes else [])
            if seen[i]
        ]
        self.series = tuple(history.series[i] for i in columns)
        self.modes = tuple(dict.fromkeys(one.mode for one in self.series))
        ln_f = history.ln_frequency[history.baseline :, columns]
        self.clock = history.clock()[history.baseline :]
        self.now = float(self.clock.max(initial=0.0))
        if np.isfinite(ln_f).any(axis=1).sum() < 3 or self.now <= 0:
            raise NotEnoughData(
                f"{history.stage}: {np.isfinite(ln_f).any(axis=1).sum()} logs with a mode of the "
                f"map over {self.now / 1000:.4g} km; a life needs at least 3 logs and some travel"
            )
        self.laws = tuple(parameter.law for parameter in stage.parameters)
        self.sizes = tuple(len(law.names) for law in self.laws)
        # Series-major order of the data: all logs of the first series, then of the second.
        flat = ln_f.T.ravel()
        self.rows = np.flatnonzero(np.isfinite(flat))
        self.mode_of_series = np.array([self.modes.index(one.mode) for one in self.series])
        self.same_mode = np.equal.outer(self.mode_of_series, self.mode_of_series)
        series = np.repeat(np.arange(len(self.series)), self.clock.size)[self.rows]
        self.mode_of = self.mode_of_series[series]
        centre = np.array(
            [np.nanmean(ln_f[:, self.mode_of_series == i]) for i in range(len(self.modes))]
        )
        self.y = flat[self.rows] - centre[self.mode_of]
        self.grid = self._whiten(history, columns)

    @property
    def n_dim(self) -> int:
        """Number of law parameters."""
        return sum(self.sizes)

    def split(self, y: FloatArray) -> list[FloatArray]:
        """Cut sampling coordinates into those of each law, ``(n, n_dim)`` to ``(n, k)`` each."""
        return np.split(y, np.cumsum(self.sizes)[:-1], axis=1)

    def health(self, y: FloatArray, travel: FloatArray) -> FloatArray:
        """Health parameters at each travel, shape ``(n, n_travel, n_parameters)``."""
        return np.stack(
            [
                law.health(law.natural(part, self.now), travel)
                for law, part in zip(self.laws, self.split(y), strict=True)
            ],
            axis=-1,
        )

    def log_prior(self, y: FloatArray) -> FloatArray:
        """Log prior of the sampling coordinates, shape ``(n,)``."""
        parts = zip(self.laws, self.split(y), strict=True)
        total = np.zeros(y.shape[0])
        for law, part in parts:
            total = total + law.log_prior(part, self.now)
        return np.where(np.isnan(total), -np.inf, total)

    def draw_prior(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Draw sampling coordinates from the prior, shape ``(n, n_dim)``."""
        return np.column_stack([law.draw(rng, n, self.now) for law in self.laws])

    def log_probability(self, y: FloatArray) -> FloatArray:
        """Log posterior up to a constant; -inf where a life leaves the map, shape ``(n,)``."""
        total = self.log_prior(y)
        x, inside = self._path(y, np.isfinite(total))
        total = np.where(inside, total, -np.inf)
        if inside.any():
            total[inside] += logsumexp(self._terms(x), axis=0)
        return total

    def narrow(self, y: FloatArray) -> None:
        """Drop grid points that carry next to nothing of the posterior at these coordinates."""
        weight = self._weights(y)
        self.grid = [g for g, w in zip(self.grid, weight, strict=True) if w > _NEGLIGIBLE]

    def settings(self, y: FloatArray) -> tuple[float, float, float, int]:
        """Averaged walk and noise scale, χ² and degrees of freedom at these coordinates.

        Parameters
        ----------
        y : ndarray
            Coordinates inside the support, shape ``(n, n_dim)``.
        """
        weight = self._weights(y)
        walk = float(weight @ [g.walk for g in self.grid])
        scale = float(weight @ [g.noise_scale for g in self.grid])
        centre = y.mean(axis=0, keepdims=True)
        x, inside = self._path(centre, np.isfinite(self.log_prior(centre)))
        if not inside.all():
            x, _ = self._path(y[:1], np.array([True]))
        residual, contribution = self._residuals(x)
        chi_square = [_quadratic(g.inverse, residual, contribution)[0][0] for g in self.grid]
        return walk, scale, float(weight @ chi_square), self.y.size - self.n_dim

    def _weights(self, y: FloatArray) -> FloatArray:
        x, inside = self._path(y, np.isfinite(self.log_prior(y)))
        if not inside.any():
            raise NotEnoughData(f"{self.stage.name}: no life of the prior stays inside the map")
        return np.asarray(softmax(logsumexp(self._terms(x), axis=1)))

    def _path(self, y: FloatArray, possible: np.ndarray) -> tuple[FloatArray, np.ndarray]:
        """Ln parameters along the lives that stay inside the map, and which these are."""
        assert self.stage.modal_map is not None  # prognose() has checked
        health = self.health(y, self.clock) * [p.baseline for p in self.stage.parameters]
        with np.errstate(divide="ignore", invalid="ignore"):
            x = np.log(health)
        inside = possible & self.stage.modal_map.inside(x).all(axis=1)
        return x[inside], inside

    def _terms(self, x: FloatArray) -> FloatArray:
        """Log likelihood of each grid point and walker, with the grid's prior, ``(n_grid, n)``."""
        residual, contribution = self._residuals(x)
        rows = []
        for point in self.grid:
            chi_square, log_det = _quadratic(point.inverse, residual, contribution)
            rows.append(point.log_weight - 0.5 * (chi_square + log_det))
        return np.stack(rows)

    def _residuals(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals ``(n, n_data)`` and map-error contributions ``(n, n_data, n_errors)``."""
        n, n_logs, n_parameters = x.shape
        n_modes = len(self.modes)
        flat = one_at_a_time(self.stage, x.reshape(-1, n_parameters))
        drift = self.stage.drift(flat, self.modes).reshape(-1, n, n_logs, n_modes)
        drift = np.swapaxes(drift, 2, 3)[:, :, self.mode_of_series]
        drift = drift.reshape(n_parameters + 1, n, -1)[..., self.rows]
        model_std = self.stage.description.map.model_std if self.stage.description.map else 0.0
        own = self.mode_of[:, None] == np.arange(n_modes)
        spread = np.einsum("pnd,dm->ndpm", model_std * drift[1:], own)
        return self.y - drift[0], spread.reshape(n, self.rows.size, -1)

    def _whiten(self, history: History, columns: list[int]) -> list[_Whitening]:
        n_logs, n_series = self.clock.size, len(self.series)
        cov = history.cov[history.baseline :][:, columns][:, :, columns]
        noise = np.zeros((n_series, n_logs, n_series, n_logs))
        for k in range(n_logs):
            noise[:, k, :, k] = np.nan_to_num(cov[k])
        same = self.same_mode
        common = np.full((n_logs, n_logs), _INTERCEPT_STD**2)
        for regressor in regressors(history.covariates, self.stage):
            values = regressor.values[history.baseline :]
            common += regressor.prior_std**2 * np.outer(values, values)
            common += np.diag(regressor.unknown[history.baseline :])
        shared = np.minimum.outer(self.clock, self.clock) / self.now
        size = n_series * n_logs
        fixed = np.kron(same, common) + self._offsets(history)
        grid = []
        for walk, (scale, prior) in product(
            _WALKS, zip(_NOISE_SCALES, _NOISE_SCALE_PRIOR, strict=True)
        ):
            total = scale**2 * noise.reshape(size, size) + fixed
            total = total + np.kron(same, walk**2 * shared)
            factor = np.linalg.cholesky(total[np.ix_(self.rows, self.rows)])
            inverse = solve_triangular(factor, np.eye(self.rows.size), lower=True)
            log_det = float(np.sum(np.log(np.diag(factor))))
            grid.append(_Whitening(walk, scale, inverse, float(np.log(prior)) - log_det))
        return grid

    def _offsets(self, history: History) -> FloatArray:
        """Covariance of what shifts readings without wear: sources, retunings, new sensors."""
        same = self.same_mode
        # The intercept is the first series'; each further one of a mode has its own bias.
        further = np.tril(same, -1).any(axis=1).astype(float)
        total = np.kron(np.diag(further), np.full((self.clock.size,) * 2, BIAS_STD[0] ** 2))
        for step in history.steps:
            if step.kind in MOVES:
                continue
            there = step.there[history.baseline :].astype(float)
            seen = [step.source in ("", one.source) for one in self.series]
            total += np.kron(
                same * np.outer(seen, seen), JUMP_STD[step.kind][0] ** 2 * np.outer(there, there)
            )
        return total


def _quadratic(
    inverse: FloatArray, residual: FloatArray, contribution: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """χ² with the map error marginalised and its log determinant, both ``(n,)``."""
    r = residual @ inverse.T
    # One product for all walkers instead of one small one each.
    v = np.moveaxis(np.tensordot(inverse, contribution, axes=(1, 1)), 0, 1)
    w = np.einsum("nde,nd->ne", v, r)
    m = np.eye(v.shape[2]) + np.swapaxes(v, 1, 2) @ v
    solved = np.linalg.solve(m, w[..., None])[..., 0]
    chi_square = np.sum(r * r, axis=1) - np.sum(w * solved, axis=1)
    return chi_square, np.linalg.slogdet(m)[1]


def limited(stage: Stage) -> list[tuple[int, ParameterSpec]]:
    """Parameters that have a limit, with their position."""
    return [(j, p) for j, p in enumerate(stage.parameters) if p.limit is not None]
