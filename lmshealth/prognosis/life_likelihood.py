"""Likelihood of a life: health by the laws of a scenario against the ln frequencies of all logs.

README.md has the model. Four values follow one from the other: `LifeData` (selection of the data),
`LifeCovariance` (their covariance Σ), `NodeBasis` (nodes from which smooth drifts follow at all
logs), and `LifeLikelihood` (the data whitened at every point of a grid of nuisance parameters).
"""

from dataclasses import dataclass
from itertools import product
from typing import Self

import numpy as np
from scipy.linalg import qr, solve_triangular

from lmshealth._private.arrays import BoolArray, FloatArray, ReadOnly, Rows
from lmshealth.errors import NotEnoughData
from lmshealth.prognosis import constants
from lmshealth.prognosis.life_data import LifeData
from lmshealth.prognosis.scenarios import Scenario
from lmshealth.stage.description import ScatterPrior, Stage
from lmshealth.tracking.constants import BIAS_STD, JUMP_STD
from lmshealth.tracking.covariates import regressors
from lmshealth.tracking.history import History

# Lives of the prior per scenario that the nodes are chosen by, and the drift in ln f that the QR
# decomposition may leave: other lives are met within some 1e-6, those of a posterior within 1e-8.
_N_EXAMPLES, _RESIDUAL = 300, 1e-8
_AT_A_TIME = 20_000  # moments of lives of the prior whose drifts are computed at a time
_CACHED = 2_000_000  # whitened drifts that are computed at a time


@dataclass(frozen=True, slots=True, eq=False)
class LifeCovariance(ReadOnly):
    """Parts of the covariance Σ of the data, each of shape ``(n_data, n_data)``.

    `fixed` has intercepts, covariates, biases and declared steps; `noise` the reported covariances
    of the estimates; `walk` the random walk of ln f with variance 1 at the last log; `deviation`
    that of ln health, likewise.
    """

    fixed: FloatArray
    noise: FloatArray
    walk: FloatArray
    deviation: FloatArray

    @classmethod
    def of(cls, data: LifeData) -> Self:
        """Compute the parts from data."""
        history, clock = data.history, data.clock
        n_logs, n_series = clock.size, len(data.columns)
        cov = history.cov[history.baseline :][:, data.columns][:, :, data.columns]
        noise = np.zeros((n_series, n_logs, n_series, n_logs))
        for k in range(n_logs):
            noise[:, k, :, k] = np.nan_to_num(cov[k])
        same = np.equal.outer(data.mode_of_series, data.mode_of_series)
        common = np.full((n_logs, n_logs), constants.INTERCEPT_STD**2)
        for regressor in regressors(history.covariates, data.stage):
            values = regressor.values[history.baseline :]
            common += regressor.prior_std**2 * np.outer(values, values)
            common += np.diag(regressor.unknown[history.baseline :])
        shared = np.maximum(np.minimum.outer(clock, clock), 0.0)
        sensitivity = data.sensitivity[data.mode_of_series]
        size, own = n_series * n_logs, np.ix_(data.rows, data.rows)
        return cls(
            fixed=(np.kron(same, common) + _offsets(data, same))[own],
            noise=noise.reshape(size, size)[own],
            walk=np.kron(same, shared / data.now)[own],
            deviation=np.kron(sensitivity @ sensitivity.T, shared / data.now)[own],
        )

    def factor(self, walk: float, noise_scale: float, deviation: float) -> FloatArray:
        """Return the Cholesky factor of Σ, shape ``(n_data, n_data)``."""
        total = self.fixed + noise_scale**2 * self.noise + walk**2 * self.walk
        return np.asarray(np.linalg.cholesky(total + deviation**2 * self.deviation))


def _offsets(data: LifeData, same: BoolArray) -> FloatArray:
    """Return the covariance of offsets without wear: sources, retunings, changed sensors."""
    # The intercept is that of a mode's first series; each further one has its own bias.
    further = np.tril(same, -1).any(axis=1).astype(float)
    total = np.kron(np.diag(further), np.full((data.clock.size,) * 2, BIAS_STD[0] ** 2))
    for step in data.history.steps:
        if step.changes_modes:
            continue
        there = step.there[data.history.baseline :].astype(float)
        moved = [step.source in ("", data.history.series[i].source) for i in data.columns]
        variance = JUMP_STD[step.kind][0] ** 2
        total += np.kron(same * np.outer(moved, moved), variance * np.outer(there, there))
    return total


@dataclass(frozen=True, slots=True, eq=False)
class NodeBasis(ReadOnly):
    """Nodes: logs ``(n_nodes,)`` whose drifts determine those of all logs linearly.

    `weights` are W, shape ``(n_logs, n_nodes)``. `moments` are the travel in m since the baseline
    of nodes, ends of the life and both sides of each step, shape ``(n_nodes + 2 + 2 n_steps,)``: as
    laws are monotonic, a life inside the map at all of them is inside at all logs.
    """

    nodes: np.ndarray
    weights: FloatArray
    moments: FloatArray

    @classmethod
    def of(cls, data: LifeData) -> Self:
        """Choose the nodes by a pivoted QR decomposition of the drifts of lives of the prior."""
        rng, n_logs = np.random.default_rng(0), data.clock.size
        joined = np.empty((0, n_logs))
        for scenario in data.scenarios:
            y = scenario.draw(rng, _N_EXAMPLES if scenario.n_dim else 1)
            x, inside = ln_health(data.stage, scenario, y, data.clock)
            # A few lives at a time, for the memory: R has the columns' geometry of all before.
            for some in np.array_split(x[inside], inside.sum() * n_logs // _AT_A_TIME + 1):
                part = drifts(data, some).reshape(-1, n_logs)
                joined = qr(np.concatenate([joined, part]), mode="r")[0][:n_logs]
        if not joined.size:
            raise NotEnoughData(f"{data.stage.name}: no life of the prior stays inside the map")
        _, r, order = qr(joined, mode="economic", pivoting=True)
        n = max(int(np.sum(np.abs(np.diag(r)) > _RESIDUAL)), 1)
        nodes, weights = order[:n], np.zeros((n_logs, n))
        weights[nodes, np.arange(n)] = 1.0
        if np.abs(r[0, 0]) > 0:
            weights[order[n:]] = solve_triangular(r[:n, :n], r[:n, n:]).T
        steps = [*data.steps, *np.nextafter(data.steps, 0)]
        ends = [data.clock.min(), data.clock.max(), *steps]
        return cls(nodes, weights, np.append(data.clock[nodes], ends))


@dataclass(frozen=True, slots=True, eq=False)
class Grid(Rows):
    """Data whitened at the points of a grid of walk, noise scale, deviation and map error.

    `design` is R of each mode, shape ``(n_points, n_modes, n_nodes, n_rows)``; `target` is
    Qᵀ L⁻¹ y, ``(n_points, n_rows)``; `rest` the χ² that no life explains, and `log_weight` the log
    prior minus ln |L|, both ``(n_points,)``. `map_std` may have a column per mode.
    """

    walk: FloatArray
    noise_scale: FloatArray
    deviation: FloatArray
    map_std: FloatArray
    design: FloatArray
    target: FloatArray
    rest: FloatArray
    log_weight: FloatArray

    @classmethod
    def of(cls, data: LifeData, covariance: LifeCovariance, basis: NodeBasis) -> Self:
        """Whiten data at all points of the grid."""
        points, prior = [], scatter_prior(data.stage)
        for (walk, p), (scale, q), (deviation, r) in product(
            zip(constants.WALK_STDS, prior.walk, strict=True),
            zip(constants.NOISE_SCALES, prior.noise_scale, strict=True),
            zip(constants.DEVIATION_STDS, prior.deviation, strict=True),
        ):
            factor = covariance.factor(walk, scale, deviation)
            u, basis_q, basis_r = _reduced(data, basis, factor)
            target = basis_q.T @ u
            log_weight = np.log(p * q * r) - np.sum(np.log(np.diag(factor)))
            design = basis_r.T.reshape(len(data.modes), -1, target.size)
            rest = np.sum(u**2) - np.sum(target**2)
            for map_std, weight in data.stage.map_errors:
                whole = log_weight + np.log(weight)
                points.append((walk, scale, deviation, map_std, design, target, rest, whole))
        return cls(*(np.array(column) for column in zip(*points, strict=True)))


@dataclass(frozen=True, slots=True, eq=False)
class LifeLikelihood:
    """Likelihood of a life under any scenario, vectorised over walkers.

    Ln parameters at the nodes, `x`, are of shape ``(n, n_nodes, n_parameters)``.
    """

    data: LifeData
    covariance: LifeCovariance
    basis: NodeBasis
    grid: Grid

    @classmethod
    def of(cls, history: History, stage: Stage) -> Self:
        """Make the likelihood of a history; raises what `LifeData.select` raises."""
        data = LifeData.select(history, stage)
        covariance, basis = LifeCovariance.of(data), NodeBasis.of(data)
        return cls(data, covariance, basis, Grid.of(data, covariance, basis))

    def path(self, scenario: Scenario, y: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return ln parameters at the nodes of the lives inside the map, and which are inside.

        Shapes ``(n_inside, n_nodes, n_parameters)`` and ``(n,)`` for coordinates ``(n, n_dim)``.
        """
        x, inside = ln_health(self.data.stage, scenario, y, self.basis.moments)
        return x[inside, : self.basis.nodes.size], inside

    def terms(self, grid: Grid, x: FloatArray) -> FloatArray:
        """Return the log likelihood plus log prior at the points of a grid, ``(n_points, n)``."""
        chi_square, log_det = self.quadratic(grid, x)
        return np.asarray(grid.log_weight[:, None] - 0.5 * (chi_square + log_det))

    def quadratic(self, grid: Grid, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return χ² with the map error marginalised, and ln |M|, both ``(n_points, n)``."""
        # A few lives at a time: intermediate results stay in the processor's cache.
        size = x.shape[0] * (1 + x.shape[2]) * grid.design.size // x.shape[1]
        parts = [self._quadratic(grid, one) for one in np.array_split(x, size // _CACHED + 1)]
        chi_square, log_det = (np.concatenate(one, axis=1) for one in zip(*parts, strict=True))
        return chi_square, log_det

    def _quadratic(self, grid: Grid, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        r, v, m = self._residuals(grid, x)
        w = (v @ r[..., None])[..., 0]
        solved = np.linalg.solve(m, w[..., None])[..., 0]
        chi_square = grid.rest[:, None] + np.sum(r * r, axis=2) - np.sum(w * solved, axis=2)
        return chi_square, np.linalg.slogdet(m)[1]

    def map_errors(self, grid: Grid, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean and covariance of the errors of the map in standard deviations.

        Given a life and all data: ``(n_points, n, n_errors)`` and ``(…, n_errors, n_errors)``,
        those of all parameters at the first mode first.
        """
        r, v, m = self._residuals(grid, x)
        cov = np.asarray(np.linalg.inv(m), dtype=float)
        return (cov @ (v @ r[..., None]))[..., 0], cov

    def deviation(
        self, grid: Grid, k: int, x: FloatArray, moments: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return mean and covariance of ln health about its law, given a life and all data.

        For the k-th point of a grid and moments ``(n_moments,)`` in m since the baseline: ``(n,
        n_moments, n_parameters)``, and between the parameters ``(…, n_parameters, n_parameters)``.
        """
        data, deviation = self.data, float(grid.deviation[k])
        point = grid[np.arange(grid.walk.size) == k]
        factor = self.covariance.factor(float(grid.walk[k]), float(grid.noise_scale[k]), deviation)
        unit = deviation**2 / data.now
        shared = unit * np.maximum(np.minimum.outer(moments, data.clock[data.log_of]), 0.0)
        cross = shared[:, None] * data.sensitivity[data.mode_of].T
        n_moments, p, n_data = cross.shape
        a = solve_triangular(factor, cross.reshape(-1, n_data).T, lower=True)
        u, q, _ = _reduced(data, self.basis, factor)
        b = (a.T @ q).reshape(n_moments, p, -1)
        r, v, m = (part[0] for part in self._residuals(point, x))
        solved = np.linalg.solve(m, v)  # M⁻¹ V
        explained = np.einsum("nvr,nr->nv", solved, r)
        fitted = point.target[0] - r + np.einsum("nv,nvr->nr", explained, v)
        mean = (a.T @ u).reshape(n_moments, p) - np.einsum("nr,mpr->nmp", fitted, b)
        own = a.T.reshape(n_moments, p, n_data)
        before = unit * moments[:, None, None] * np.diag(data.free)
        known = before - own @ np.swapaxes(own, 1, 2)
        left = np.einsum("mpr,nvr->nmpv", b, v)
        right = np.einsum("nvr,mpr->nmvp", solved, b)
        return mean, known + left @ right

    def _residuals(self, grid: Grid, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the whitened residuals r, the map's errors V by rows, and M = I + VVᵀ.

        Shapes ``(n_points, n, n_rows)``, ``(n_points, n, n_errors, n_rows)`` and
        ``(n_points, n, n_errors, n_errors)``, with an error per parameter and mode.
        """
        drift = drifts(self.data, x)
        n_modes, n_paths, n, n_nodes = drift.shape
        white = drift.reshape(n_modes, -1, n_nodes) @ grid.design
        white = white.reshape(-1, n_modes, n_paths, n, grid.target.shape[1])
        r = grid.target[:, None] - white[:, :, 0].sum(axis=1)
        white = grid.map_std.reshape(len(r), -1, 1, 1, 1) * white[:, :, 1:]
        v = np.moveaxis(white, 3, 1).reshape(*r.shape[:2], -1, r.shape[2])
        return r, v, np.eye(v.shape[2]) + v @ np.swapaxes(v, 2, 3)


def ln_health(
    stage: Stage, scenario: Scenario, y: FloatArray, clock: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return ln parameters of lives at moments, and which lives stay inside the map.

    Shapes ``(n, n_moments, n_parameters)`` and ``(n,)`` for coordinates ``(n, n_dim)`` and travels
    ``(n_moments,)`` in m.
    """
    assert stage.modal_map is not None  # prognose() has checked
    health = scenario.health(scenario.natural(y), clock)
    with np.errstate(divide="ignore", invalid="ignore"):
        x = np.log(health * [p.baseline for p in stage.parameters])
    return x, np.asarray(stage.modal_map.inside(x).all(axis=1))


def drifts(data: LifeData, x: FloatArray) -> FloatArray:
    """Return the drifts along lives, then of each parameter alone, at ln parameters of `ln_health`.

    Shape ``(n_modes, 1 + n_parameters, n, n_moments)``.
    """
    n, n_moments, n_parameters = x.shape
    drift = data.stage.drifts(x.reshape(-1, n_parameters), data.modes)
    return np.moveaxis(drift.reshape(1 + n_parameters, n, n_moments, len(data.modes)), 3, 0)


def _reduced(
    data: LifeData, basis: NodeBasis, factor: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return L⁻¹ y, and Q and R of L⁻¹ W for the nodes of all modes."""
    own = data.mode_of[:, None] == np.arange(len(data.modes))
    shapes = own[:, :, None] * basis.weights[data.log_of][:, None]
    columns = np.column_stack([shapes.reshape(data.rows.size, -1), data.y])
    both = solve_triangular(factor, columns, lower=True)
    q, r = np.linalg.qr(both[:, :-1])
    return both[:, -1], q, r


def scatter_prior(stage: Stage) -> ScatterPrior:
    """Return the prior of walk, noise scale and deviation: the fleet's, or the default."""
    if stage.scatter is not None:
        return stage.scatter
    walks = (1.0,) * len(constants.WALK_STDS)
    return ScatterPrior(walks, constants.NOISE_SCALE_PRIOR, constants.DEVIATION_PRIOR)


def expected_scatter(scatter: ScatterPrior) -> tuple[float, float, float]:
    """Return the prior means of walk, noise scale and deviation."""
    return (
        float(np.average(constants.WALK_STDS, weights=scatter.walk)),
        float(np.average(constants.NOISE_SCALES, weights=scatter.noise_scale)),
        float(np.average(constants.DEVIATION_STDS, weights=scatter.deviation)),
    )
