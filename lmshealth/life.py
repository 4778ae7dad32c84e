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

Lives are smooth: what their drifts are at all logs follows linearly from what they are at few of
them, the nodes. H(θ) = W h(θ) with h at the nodes, and by A = L⁻¹ W = Q R, L = chol(Σ), the data
shrink to Qᵀ L⁻¹ y and W to R, so that what a walker costs hardly depends on the number of logs.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.linalg import qr, solve_triangular
from scipy.special import softmax

from lmshealth.arrays import BoolArray, FloatArray
from lmshealth.epoch import one_at_a_time
from lmshealth.errors import NotEnoughData
from lmshealth.stage import Stage
from lmshealth.statespace import BIAS_STD, JUMP_STD, MOVES, regressors
from lmshealth.tracks import History

_INTERCEPT_STD = 0.1
# Random walk of ln f over the history, and factor on the reported standard deviations, with priors.
_WALKS = (1e-5, 5e-4, 1.5e-3, 5e-3, 1.5e-2)
_NOISE_SCALES = (1.0, 1.5, 2.25)
_NOISE_SCALE_PRIOR = (0.9, 0.07, 0.03)
_NEGLIGIBLE = 0.01
# Lives that show how smooth lives are; what QR may leave of theirs, in ln f. Others are met within
# some 1e-6, those of a posterior within 1e-8.
_N_EXAMPLES, _ROUGHEST = 300, 1e-8


@dataclass(frozen=True, slots=True, eq=False)
class _Grid:
    """Whitened data at every point of the grid; the point is the first axis.

    ``design`` is R of each mode, shape ``(n_points, n_modes, n_nodes, n_rows)``, ``target`` is
    Qᵀ L⁻¹ y, ``(n_points, n_rows)``, ``rest`` the χ² that no life can explain, and ``log_weight``
    the log prior with the determinant.
    """

    walk: FloatArray
    noise_scale: FloatArray
    design: FloatArray
    target: FloatArray
    rest: FloatArray
    log_weight: FloatArray

    def chosen(self, which: BoolArray) -> _Grid:
        """Keep some of the points."""
        return _Grid(*(getattr(self, name)[which] for name in self.__slots__))


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
        self.log_of = np.tile(np.arange(self.clock.size), len(self.series))[self.rows]
        centre = np.array(
            [np.nanmean(ln_f[:, self.mode_of_series == i]) for i in range(len(self.modes))]
        )
        self.y = flat[self.rows] - centre[self.mode_of]
        self.nodes, self.weights = self._choose_nodes()
        # Laws are monotonic: a life is inside the map where its ends are.
        self.checked = np.append(self.clock[self.nodes], [self.clock.min(), self.clock.max()])
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
            # As scipy's logsumexp, at a tenth of its time for so few points.
            total[inside] += np.logaddexp.reduce(self._terms(x), axis=0)
        return total

    def narrow(self, y: FloatArray) -> None:
        """Drop grid points that carry next to nothing of the posterior at these coordinates."""
        self.grid = self.grid.chosen(self._weights(y) > _NEGLIGIBLE)

    def settings(self, y: FloatArray) -> tuple[float, float, float, int]:
        """Averaged walk and noise scale, χ² and degrees of freedom at these coordinates.

        Parameters
        ----------
        y : ndarray
            Coordinates inside the support, shape ``(n, n_dim)``.
        """
        weight = self._weights(y)
        centre = y.mean(axis=0, keepdims=True)
        x, inside = self._path(centre, np.isfinite(self.log_prior(centre)))
        if not inside.all():
            x, _ = self._path(y[:1], np.array([True]))
        chi_square = self._quadratic(x)[0][:, 0]
        walk, scale = weight @ self.grid.walk, weight @ self.grid.noise_scale
        return float(walk), float(scale), float(weight @ chi_square), self.y.size - self.n_dim

    def _weights(self, y: FloatArray) -> FloatArray:
        """Posterior probability of each point of the grid, by draws of the posterior."""
        x, inside = self._path(y, np.isfinite(self.log_prior(y)))
        if not inside.any():
            raise NotEnoughData(f"{self.stage.name}: no life of the prior stays inside the map")
        return np.asarray(softmax(self._terms(x), axis=0).mean(axis=1))

    def _path(self, y: FloatArray, possible: BoolArray) -> tuple[FloatArray, BoolArray]:
        """Ln parameters at the nodes of the lives that stay inside the map, and which these are."""
        x, inside = self._ln_health(y, self.checked)
        inside &= possible
        return x[inside, : self.nodes.size], inside

    def _ln_health(self, y: FloatArray, clock: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Ln parameters at moments of lives, and which lives are inside the map at all of them."""
        assert self.stage.modal_map is not None  # prognose() has checked
        health = self.health(y, clock) * [p.baseline for p in self.stage.parameters]
        with np.errstate(divide="ignore", invalid="ignore"):
            x = np.log(health)
        return x, np.asarray(self.stage.modal_map.inside(x).all(axis=1))

    def _terms(self, x: FloatArray) -> FloatArray:
        """Log likelihood of each grid point and walker, with the grid's prior, ``(n_grid, n)``."""
        chi_square, log_det = self._quadratic(x)
        return np.asarray(self.grid.log_weight[:, None] - 0.5 * (chi_square + log_det))

    def _quadratic(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """χ² with the map error marginalised and its log determinant, both ``(n_grid, n)``."""
        grid, drift = self.grid, self._drifts(x)
        n_modes, n_paths, n, n_nodes = drift.shape
        white = drift.reshape(n_modes, -1, n_nodes) @ grid.design
        white = white.reshape(-1, n_modes, n_paths, n, grid.target.shape[1])
        r = grid.target[:, None] - white[:, :, 0].sum(axis=1)
        model_std = self.stage.description.map.model_std if self.stage.description.map else 0.0
        # Errors last but one: of each parameter in each mode.
        v = np.moveaxis(model_std * white[:, :, 1:], 3, 1).reshape(*r.shape[:2], -1, r.shape[2])
        w = (v @ r[..., None])[..., 0]
        m = np.eye(v.shape[2]) + v @ np.swapaxes(v, 2, 3)
        solved = np.linalg.solve(m, w[..., None])[..., 0]
        chi_square = grid.rest[:, None] + np.sum(r * r, axis=2) - np.sum(w * solved, axis=2)
        return chi_square, np.linalg.slogdet(m)[1]

    def _drifts(self, x: FloatArray) -> FloatArray:
        """Drifts along lives, then those of each parameter alone: ``(n_modes, 1 + p, n, n_x)``."""
        n, n_moments, n_parameters = x.shape
        flat = one_at_a_time(self.stage, x.reshape(-1, n_parameters))
        drift = self.stage.drift(flat, self.modes).reshape(-1, n, n_moments, len(self.modes))
        return np.moveaxis(drift, 3, 0)

    def _choose_nodes(self) -> tuple[np.ndarray, FloatArray]:
        """Choose logs from whose drifts all others follow, and the weights by which they do.

        By a pivoted QR decomposition of what lives drawn from the prior do at all logs.

        Returns
        -------
        nodes : ndarray of int
            Shape ``(n_nodes,)``.
        weights : ndarray
            Shape ``(n_logs, n_nodes)``.
        """
        y = self.draw_prior(np.random.default_rng(0), _N_EXAMPLES)
        x, inside = self._ln_health(y, self.clock)
        if not inside.any():
            raise NotEnoughData(f"{self.stage.name}: no life of the prior stays inside the map")
        examples = self._drifts(x[inside]).reshape(-1, self.clock.size)
        _, r, order = qr(examples, mode="economic", pivoting=True)
        n = max(int(np.sum(np.abs(np.diag(r)) > _ROUGHEST)), 1)
        weights = np.zeros((self.clock.size, n))
        weights[order[:n], np.arange(n)] = 1.0
        if np.abs(r[0, 0]) > 0:
            weights[order[n:]] = solve_triangular(r[:n, :n], r[:n, n:]).T
        return order[:n], weights

    def _whiten(self, history: History, columns: list[int]) -> _Grid:
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
        own = self.mode_of[:, None] == np.arange(len(self.modes))
        shapes = own[:, :, None] * self.weights[self.log_of][:, None]
        shapes = shapes.reshape(self.rows.size, -1)
        points = []
        for walk, (scale, prior) in product(
            _WALKS, zip(_NOISE_SCALES, _NOISE_SCALE_PRIOR, strict=True)
        ):
            total = scale**2 * noise.reshape(size, size) + fixed
            total = total + np.kron(same, walk**2 * shared)
            factor = np.linalg.cholesky(total[np.ix_(self.rows, self.rows)])
            both = solve_triangular(factor, np.column_stack([shapes, self.y]), lower=True)
            q, r = np.linalg.qr(both[:, :-1])
            target = q.T @ both[:, -1]
            log_det = np.sum(np.log(np.diag(factor)))
            design = r.T.reshape(len(self.modes), -1, target.size)
            rest = np.sum(both[:, -1] ** 2) - np.sum(target**2)
            points.append((walk, scale, design, target, rest, np.log(prior) - log_det))
        return _Grid(*(np.array(column) for column in zip(*points, strict=True)))

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
