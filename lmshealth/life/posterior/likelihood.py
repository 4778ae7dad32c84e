"""Likelihood of a life, and the posterior density of one scenario averaged over its nuisances.

README.md has the model. Five values follow one from the other: `LifeData` (selection of the data),
`LifeCovariance` (their covariance Σ), `NodeBasis` (nodes from which smooth drifts follow at all
logs), `LifeLikelihood` (the data whitened at every point of a grid of nuisance parameters), and
`LifeDensity`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Self

import numpy as np
from scipy.linalg import block_diag, qr, solve_triangular
from scipy.special import softmax

from lmshealth._private.arrays import BoolArray, FloatArray, ReadOnly, Rows
from lmshealth.errors import NotEnoughData
from lmshealth.life import constants
from lmshealth.life.posterior.data import LifeData
from lmshealth.life.posterior.sampling import log_sum_exp
from lmshealth.life.posterior.scenarios import Scenario
from lmshealth.stage import constants as of_stage
from lmshealth.stage.description import ScatterPrior, Stage
from lmshealth.tracking.constants import BIAS_STD, JUMP_STD
from lmshealth.tracking.history import History

# Lives of the prior per scenario that the nodes are chosen by, and the drift in ln f that the QR
# decomposition may leave in the norm of all of them: of 99 % of other lives the drifts are met
# within 3e-5, a fraction of the error of the best estimates.
_N_EXAMPLES, _RESIDUAL = 300, 1e-4
# Distance in ln f of the last drift of a life from that of the logs from which it counts less.
_NEAR = 0.003
_AT_A_TIME = 20_000  # moments of lives of the prior whose drifts are computed at a time
# Whitened drifts that are computed at a time: larger arrays are returned to the system and fetched
# anew by each operation, which takes as long as the operation.
_CACHED = 500_000

# Draws of steps given laws: iterations, step of the slopes in ln health, points of the grid, and
# width in standard deviations.
_NEWTON_STEPS, _SLOPE_STEP, _START_POINTS, _START_WIDTH = 3, 1e-3, 4, 2.0

# Share of the posterior of the grid points that are dropped once a scenario is sampled.
_NEGLIGIBLE = 0.01

NO_MODE = -1
"""Index in place of that of a mode that moves alone: none does."""
RIGHT, EACH, ALIKE = range(3)
"""Indices of `FIRST_LOG_PRIOR`: whether a first log is in error, and how."""

Nuisances = tuple[np.ndarray, np.ndarray]
"""Indices of the map error and of the grid point of each draw, ``(n,)`` each."""


@dataclass(frozen=True, slots=True, eq=False)
class LifeCovariance(ReadOnly):
    """Parts of the covariance Σ of the data, each of shape ``(n_data, n_data)``.

    `fixed` has intercepts, covariates, biases and declared steps; `noise` the reported covariances
    of the estimates; `unknown` the variances for want of covariates; `walk` the random walk of ln f
    with variance 1 at the last log; `deviation` that of ln health, likewise; `lone` the drift of a
    mode by a cause of its own, of all modes as if each had one; `common` the wander that all modes
    have in common, with variance 1. `in_doubt` is 1 at data of a first log that may be in error.
    """

    fixed: FloatArray
    noise: FloatArray
    unknown: FloatArray
    walk: FloatArray
    deviation: FloatArray
    lone: FloatArray
    common: FloatArray
    in_doubt: FloatArray  # ``(n_data,)``
    mode_of: np.ndarray  # index of the mode of each datum, ``(n_data,)``

    @classmethod
    def of(cls, data: LifeData) -> Self:
        """Compute the parts from data."""
        history, now, log_of, series_of = data.history, data.now, data.log_of, data.series_of
        clock = data.clock[log_of]
        same_mode = np.equal.outer(data.mode_of, data.mode_of)
        same_log, same_series = (np.equal.outer(one, one) for one in (log_of, series_of))
        rows, columns = history.baseline + log_of, np.array(data.columns)[series_of]
        reported = history.cov[rows[:, None], columns[:, None], columns]
        common = np.full(same_mode.shape, constants.INTERCEPT_STD**2)
        unknown = np.zeros(rows.size)
        for regressor in data.regressors:
            values = regressor.values[rows]
            common += regressor.prior_std**2 * np.outer(values, values)
            unknown += regressor.unknown[rows]
        fixed = same_mode * common
        # The intercept is that of a mode's first series; each further one has its own bias.
        modes = data.mode_of_series
        further = np.tril(np.equal.outer(modes, modes), -1).any(axis=1)
        fixed += BIAS_STD[0] ** 2 * (same_series & further[series_of])
        for step in history.steps:
            if not step.changes_modes:  # retunings and changed sensors
                concerned = [step.source in ("", one.source) for one in history.series]
                moved = step.there[rows] & np.array(concerned)[columns]
                fixed += JUMP_STD[step.kind][0] ** 2 * (same_mode & np.outer(moved, moved))
        shared = np.maximum(np.minimum.outer(clock, clock), 0.0) / now
        gram = data.sensitivity @ data.sensitivity.T
        return cls(
            fixed=fixed,
            noise=np.where(same_log, reported, 0.0),
            unknown=same_mode * same_log * unknown,
            walk=same_mode * shared,
            deviation=gram[data.mode_of[:, None], data.mode_of] * shared,
            lone=same_mode * lone_kernel(clock, clock, now, data.steps),
            common=common_kernel(np.unique(log_of, return_inverse=True)[1]),
            in_doubt=((log_of == 0) & np.isin(columns, history.in_doubt)).astype(float),
            mode_of=data.mode_of,
        )

    def factor(
        self,
        walk: float,
        noise_scale: float,
        deviation: float,
        lone: int = NO_MODE,
        common: float = 0.0,
        error: int = RIGHT,
    ) -> FloatArray:
        """Return the Cholesky factor of Σ, shape ``(n_data, n_data)``."""
        total = self.fixed + self.unknown + noise_scale**2 * self.noise + walk**2 * self.walk
        total += common**2 * self.common
        if error != RIGHT:
            alike = np.outer(self.in_doubt, self.in_doubt)
            alike = alike if error == ALIKE else alike * np.equal.outer(self.mode_of, self.mode_of)
            total += constants.FIRST_LOG_STD**2 * alike
        if lone != NO_MODE:
            own = (self.mode_of == lone).astype(float)
            total += constants.LONE_STD**2 * np.outer(own, own) * self.lone
        return np.asarray(np.linalg.cholesky(total + deviation**2 * self.deviation))


def common_kernel(log: np.ndarray) -> FloatArray:
    """Return the covariance of a wander of variance 1 between logs by their number, ``(n, n)``."""
    apart = np.abs(np.subtract.outer(log, log))
    return np.asarray(np.mean([np.exp(-apart / n) for n in constants.COMMON_LOGS], axis=0))


def lone_kernel(
    moments: FloatArray, clock: FloatArray, now: float, steps: Sequence[float] = ()
) -> FloatArray:
    """Return the covariance of the drift of a mode that moves alone, of variance 1 now.

    Between moments ``(n,)`` and ``(m,)`` in m since the baseline: ``(n, m)``. It is a sum of powers
    of the travel, of an integrated random walk, which begins and ends where it likes, and of jumps
    at the `steps` of the modes.
    """
    a, b = (np.maximum(one, 0.0) / now for one in (moments, clock))
    least, most = np.minimum.outer(a, b), np.maximum.outer(a, b)
    parts = [np.outer(a**p, b**p) for p in constants.LONE_EXPONENTS]
    parts.append(1.5 * least**2 * (most - least / 3))
    parts += [(least >= step / now).astype(float) for step in steps]
    return np.asarray(np.mean(parts, axis=0))


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
        seen = data.change()
        joined = np.empty((0, n_logs))
        for scenario in data.scenarios:
            y = scenario.draw(rng, _N_EXAMPLES if scenario.n_dim else 1)
            x, inside = ln_health(data.stage, scenario, y, data.clock)
            # A few lives at a time, for the memory: R has the columns' geometry of all before.
            for some in np.array_split(x[inside], inside.sum() * n_logs // _AT_A_TIME + 1):
                part = drifts(data, some)
                off = np.abs(part[:, 0, :, -1] - seen[:, None]).max(axis=0)
                # Lives that end far from the logs count less: what is left of them may be larger.
                part = part / np.maximum(off / _NEAR, 1.0)[:, None]
                rows = [joined, part.reshape(-1, n_logs)]
                joined = qr(np.concatenate(rows), mode="r")[0][:n_logs]
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
    """Data whitened at the points of a grid of walk, noise scale, deviation and foreign causes.

    `lone` is the index of a mode that moves alone, or `NO_MODE`; `common` the standard deviation of
    a wander that all modes have in common, or 0; `error` whether the first log is in error.
    `design` is R of each mode, shape ``(n_points, n_modes, n_nodes, n_rows)``; `target` is Qᵀ L⁻¹
    y, ``(n_points, n_rows)``; `rest` the χ² that no life explains, `log_weight` the log prior minus
    ln |L|, and `freedom` the data less the intercepts and coefficients that they determine, all
    ``(n_points,)``.
    """

    walk: FloatArray
    noise_scale: FloatArray
    deviation: FloatArray
    lone: np.ndarray
    common: FloatArray
    error: np.ndarray
    design: FloatArray
    target: FloatArray
    rest: FloatArray
    log_weight: FloatArray
    freedom: FloatArray

    @classmethod
    def of(cls, data: LifeData, covariance: LifeCovariance, basis: NodeBasis) -> Self:
        """Whiten data at all points of the grid."""
        points, prior = [], scatter_prior(data.stage)
        n_modes, alone = len(data.modes), data.stage.description.life.lone_mode
        intercepts = constants.INTERCEPT_STD * np.equal.outer(data.mode_of, np.arange(n_modes))
        # A mode that moves alone needs others that do not.
        alone *= n_modes > 1
        common = data.stage.description.life.common_wander * (n_modes > 1)
        others = (1 - common - n_modes * alone) / np.sum(prior.walk)
        walks = zip(constants.WALK_STDS, prior.walk, strict=True)
        ways = [(walk, p * others, NO_MODE, 0.0) for walk, p in walks]
        own = product(range(n_modes), constants.LONE_WALKS)
        ways += [(walk, alone * p, mode, 0.0) for mode, (walk, p) in own]
        each = common / len(constants.COMMON_STDS)
        together = product(constants.COMMON_STDS, constants.LONE_WALKS)
        ways += [(walk, each * p, NO_MODE, std) for std, (walk, p) in together]
        errors = enumerate(constants.FIRST_LOG_PRIOR if covariance.in_doubt.any() else (1.0,))
        for (error, wrong), (walk, p, lone, std), (scale, q), (deviation, r) in product(
            errors,
            ways,
            zip(constants.NOISE_SCALES, prior.noise_scale, strict=True),
            zip(constants.DEVIATION_STDS, prior.deviation, strict=True),
        ):
            if p * q * r == 0:
                continue
            factor = covariance.factor(walk, scale, deviation, lone, std, error)
            u, basis_q, basis_r = _reduced(data, basis, factor)
            target = basis_q.T @ u
            log_weight = np.log(wrong * p * q * r) - np.sum(np.log(np.diag(factor)))
            design = basis_r.T.reshape(n_modes, -1, target.size)
            rest = np.sum(u**2) - np.sum(target**2)
            # The trace of Σ⁻¹ times the part of the intercepts. What else is fixed is as large as
            # its prior, which is in χ²: it takes no degree of freedom.
            determined = np.sum(solve_triangular(factor, intercepts, lower=True) ** 2)
            values = (design, target, rest, log_weight, data.y.size - determined)
            points.append((walk, scale, deviation, lone, std, error, *values))
        return cls(*(np.array(column) for column in zip(*points, strict=True)))


@dataclass(frozen=True, slots=True, eq=False)
class LifeLikelihood:
    """Likelihood of a life under any scenario, vectorised over walkers.

    Ln parameters at the nodes, `x`, are of shape ``(n, n_nodes, n_parameters)``. `precision` is
    C⁻¹, ``(n_errors, n_errors)``, of the declared errors of the map, of each mode and within it of
    each parameter, and `log_det` is ln |C|.
    """

    data: LifeData
    covariance: LifeCovariance
    basis: NodeBasis
    grid: Grid
    precision: FloatArray
    log_det: float

    @classmethod
    def of(cls, history: History, stage: Stage, min_logs: int = constants.MIN_LOGS) -> Self:
        """Make the likelihood of a history; raises what `LifeData.select` raises."""
        data = LifeData.select(history, stage, min_logs)
        covariance, basis = LifeCovariance.of(data), NodeBasis.of(data)
        map_cov, p = stage.map_cov(len(data.modes)), len(stage.parameters)
        precision = np.kron(np.linalg.inv(map_cov), np.eye(p))
        log_det = p * float(np.linalg.slogdet(map_cov)[1])
        grid = Grid.of(data, covariance, basis)
        return cls(data, covariance, basis, grid, precision, log_det)

    def path(self, scenario: Scenario, y: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return ln parameters at the nodes of the lives inside the map, and which are inside.

        Shapes ``(n_inside, n_nodes, n_parameters)`` and ``(n,)`` for coordinates ``(n, n_dim)``.
        """
        x, inside = ln_health(self.data.stage, scenario, y, self.basis.moments)
        return x[inside, : self.basis.nodes.size], inside

    def terms(self, grid: Grid, x: FloatArray) -> FloatArray:
        """Return the log likelihood plus log prior, ``(n_map_errors, n_points, n)``.

        At the points of a grid, for each possible error of the map.
        """
        chi_square, log_det = self.quadratic(grid, x)
        log_prior = np.log([weight for _, weight in of_stage.MAP_ERRORS])
        log_weight = log_prior[:, None, None] + grid.log_weight[:, None]
        return np.asarray(log_weight - 0.5 * (chi_square + log_det))

    def quadratic(self, grid: Grid, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return χ² with the errors of the map marginalised, and ln |M|, as `terms`."""
        # A few lives at a time: intermediate results stay in the processor's cache.
        size = x.shape[0] * (1 + x.shape[2]) * grid.design.size // x.shape[1]
        parts = [self._quadratic(grid, one) for one in np.array_split(x, size // _CACHED + 1)]
        chi_square, log_det = (np.concatenate(one, axis=2) for one in zip(*parts, strict=True))
        return chi_square, log_det

    def _quadratic(self, grid: Grid, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        rows = self._residuals(grid, x)
        gram = np.moveaxis(rows @ np.swapaxes(rows, 2, 3), (2, 3), (0, 1))[:, :, None]
        scales = np.array([scale for scale, _ in of_stage.MAP_ERRORS])
        # [C⁻¹ + V Vᵀ, V r; (V r)ᵀ, rᵀr + 1] of each scale of C, lives last for `_pivots`.
        prior = np.zeros((*gram.shape[:2], scales.size, 1, 1))
        prior[:-1, :-1, :, 0, 0] = self.precision[:, :, None] / scales**2
        prior[-1, -1] = 1.0
        # One decomposition has both: its last pivot is χ² plus 1.
        pivots = _pivots(np.add(gram, prior, order="C"))
        if (pivots <= 0).any():
            raise np.linalg.LinAlgError("the covariance of the errors of a map is not positive")
        log_det = self.log_det + 2 * len(self.precision) * np.log(scales)[:, None, None]
        return grid.rest[:, None] + pivots[-1] - 1, log_det + np.log(pivots[:-1]).sum(axis=0)

    def steps_given_laws(
        self, grid: Grid, scenario: Scenario, y: FloatArray, rng: np.random.Generator
    ) -> FloatArray:
        """Return coordinates ``(n, n_dim)`` with other factors at the steps, drawn given the laws.

        Drifts are nearly linear in the ln factors, and their prior is Gaussian, as that of the
        errors of the map: the conditional mode by Gauss and Newton, for each life at one of a few
        points of a grid. The draws scatter wider than the posterior: they are only a start.
        """
        stage, n_nodes, columns = self.data.stage, self.basis.nodes.size, scenario.step_columns
        nodes, k = self.basis.moments[:n_nodes], columns.size
        y = y.copy()
        y[:, columns] = 0.0
        law = np.nan_to_num(ln_health(stage, scenario, y, nodes)[0])
        after = nodes >= np.array(scenario.steps)[:, None]
        # Which ln parameters each factor moves at which nodes, ``(k, n_nodes, n_parameters)``.
        moves = np.einsum("pq,kt->pktq", np.eye(law.shape[2]), after).reshape(k, n_nodes, -1)
        moved = _SLOPE_STEP * np.concatenate([np.zeros_like(moves[:1]), moves])
        assert stage.modal_map is not None  # LifeData.select() has checked
        low, high = stage.modal_map.low, stage.modal_map.high - _SLOPE_STEP
        prior = block_diag(np.eye(k) / constants.STEP_PRIOR.std**2, self.precision)
        points = np.linspace(0, grid.walk.size - 1, _START_POINTS).astype(int)
        for point, own in zip(points, np.array_split(np.arange(len(y)), points.size), strict=True):
            size = np.zeros((own.size, k))
            for _ in range(_NEWTON_STEPS):
                x = np.clip(law[own] + np.tensordot(size, moves, 1), low, high)
                lives = (x[:, None] + moved).reshape(-1, *x.shape[1:])
                rows = self._residuals(grid[[point]], lives)[0]
                rows = rows.reshape(own.size, k + 1, *rows.shape[1:])
                r, errors = rows[:, 0, -1], rows[:, 0, :-1]
                slopes = (rows[:, 1:, -1] - r[:, None]) / _SLOPE_STEP
                a = np.concatenate([slopes, errors], axis=1)
                cov = np.linalg.inv(a @ np.swapaxes(a, 1, 2) + prior)
                gradient = a @ r[:, :, None]
                gradient[:, :k, 0] += prior[0, 0] * size
                size = size - (cov @ gradient)[:, :k, 0]
            unit = rng.standard_normal((*size.shape, 1))
            size += _START_WIDTH * (np.linalg.cholesky(cov[:, :k, :k]) @ unit)[..., 0]
            y[own[:, None], columns] = size
        return y

    def conditional(
        self, grid: Grid, k: int, map_scale: float, x: FloatArray, cross: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the means of Gaussian quantities given a life and all data, and their information.

        That is by how much the data reduce their covariance. At the k-th point of a grid; `cross`
        are the covariances of several groups of quantities with the data, ``(n_groups, n_values,
        n_data)``. Shapes ``(n, n_groups, n_values)`` and, within each group, ``(n, n_groups,
        n_values, n_values)`` for x ``(n, ...)``.
        """
        point = grid[np.arange(grid.walk.size) == k]
        settings = (float(grid.walk[k]), float(grid.noise_scale[k]), float(grid.deviation[k]))
        causes = int(grid.lone[k]), float(grid.common[k]), int(grid.error[k])
        factor = self.covariance.factor(*settings, *causes)
        n_data = cross.shape[2]
        a = solve_triangular(factor, cross.reshape(-1, n_data).T, lower=True)
        u, q, _ = _reduced(self.data, self.basis, factor)
        b = a.T @ q
        of_group = a.T.reshape(cross.shape)
        known = of_group @ np.swapaxes(of_group, 1, 2)
        parts = []
        # A few lives at a time, for the memory.
        for one in np.array_split(x, x.shape[0] * b.size // _CACHED + 1):
            rows = self._residuals(point, one)[0]
            r, v = rows[:, -1], rows[:, :-1]
            m = self.precision / map_scale**2 + v @ np.swapaxes(v, 1, 2)
            explained = np.linalg.solve(m, v @ r[:, :, None])
            fitted = point.target[0] - r + (np.swapaxes(v, 1, 2) @ explained)[:, :, 0]
            # B Vᵀ M⁻¹ V Bᵀ by a root of M: of the columns of each group alone.
            root = np.linalg.solve(np.linalg.cholesky(m), v) @ b.T
            root = root.reshape(*root.shape[:2], *cross.shape[:2]).transpose(0, 2, 3, 1)
            mean = (a.T @ u - fitted @ b.T).reshape(len(one), *cross.shape[:2])
            parts.append((mean, known - root @ np.swapaxes(root, 2, 3)))
        means, information = (np.concatenate(part) for part in zip(*parts, strict=True))
        return means, information

    def deviation(
        self, grid: Grid, k: int, map_scale: float, x: FloatArray, moments: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return mean and covariance of ln health about its law, given a life and all data.

        For the k-th point of a grid and moments ``(n_moments,)`` in m since the baseline: ``(n,
        n_moments, n_parameters)``, and between the parameters ``(…, n_parameters, n_parameters)``.
        """
        data = self.data
        unit = float(grid.deviation[k]) ** 2 / data.now
        shared = unit * np.maximum(np.minimum.outer(moments, data.clock[data.log_of]), 0.0)
        cross = shared[:, None] * data.sensitivity[data.mode_of].T
        mean, known = self.conditional(grid, k, map_scale, x, cross)
        variance = unit * np.maximum(moments, 0.0)[:, None, None]
        return mean, variance * np.diag(data.free) - known

    def lone_drift(
        self, grid: Grid, k: int, map_scale: float, x: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return mean and variance of the drift now of the mode that moves alone, ``(n,)`` each.

        Of the k-th point of a grid, given a life and all data.
        """
        data, variance = self.data, constants.LONE_STD**2
        clock = data.clock[data.log_of]
        kernel = lone_kernel(np.array([data.now]), clock, data.now, data.steps)
        cross = variance * kernel * (data.mode_of == grid.lone[k])
        mean, known = self.conditional(grid, k, map_scale, x, cross[None])
        return mean[:, 0, 0], np.maximum(variance - known[:, 0, 0, 0], 0.0)

    def _residuals(self, grid: Grid, x: FloatArray) -> FloatArray:
        """Return the rows V of relative errors of the map, and last the whitened residuals r.

        Shape ``(n_points, n, n_errors + 1, n_rows)``, with an error per mode and parameter.
        """
        drift = drifts(self.data, x)
        n_modes, n_paths, n, n_nodes = drift.shape
        (n_points, n_rows), p = grid.target.shape, n_paths - 1
        rows = np.zeros((n_points, n_modes * p + 1, n, n_rows))
        for k in range(n_modes):
            filled = slice((k + 1) * n_nodes)  # R is upper triangular
            of_mode = rows[:, k * p : (k + 1) * p].reshape(n_points, -1, n_rows)[..., filled]
            alone = drift[k, 1:].reshape(-1, n_nodes)
            np.matmul(alone, grid.design[:, k, :, filled], out=of_mode)
        together = np.moveaxis(drift[:, 0], 0, 1).reshape(n, -1)
        white = together @ grid.design.reshape(n_points, -1, n_rows)
        np.subtract(grid.target[:, None], white, out=rows[:, -1])
        return rows.swapaxes(1, 2)


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


def _pivots(matrices: FloatArray) -> FloatArray:
    """Return the pivots of the Cholesky decomposition of many small matrices, which are lost.

    ``(n, ...)`` for matrices ``(n, n, ...)``: operations on all at once take a fraction of the time
    of as many calls of LAPACK.
    """
    for k in range(len(matrices) - 1):
        factors = matrices[k + 1 :, k] / matrices[k, k]
        matrices[k + 1 :, k + 1 :] -= factors[:, None] * matrices[k, k + 1 :]
    return np.asarray(np.moveaxis(matrices.diagonal(), -1, 0))


def _reduced(
    data: LifeData, basis: NodeBasis, factor: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return L⁻¹ y, and Q and R of L⁻¹ W for the nodes of all modes."""
    own = data.mode_of[:, None] == np.arange(len(data.modes))
    shapes = own[:, :, None] * basis.weights[data.log_of][:, None]
    columns = np.column_stack([shapes.reshape(data.y.size, -1), data.y])
    both = solve_triangular(factor, columns, lower=True)
    q, r = np.linalg.qr(both[:, :-1])
    return both[:, -1], q, r


def scatter_prior(stage: Stage) -> ScatterPrior:
    """Return the prior of walk, noise scale and deviation: the fleet's, or the default."""
    return default_scatter() if stage.scatter is None else stage.scatter


def default_scatter() -> ScatterPrior:
    """Return the prior of walk, noise scale and deviation of any machine."""
    values = (constants.WALK_PRIOR, constants.NOISE_SCALE_PRIOR, constants.DEVIATION_PRIOR)
    return ScatterPrior(*values)


def expected_scatter(scatter: ScatterPrior) -> tuple[float, float, float]:
    """Return the prior means of walk, noise scale and deviation."""
    return (
        float(np.average(constants.WALK_STDS, weights=scatter.walk)),
        float(np.average(constants.NOISE_SCALES, weights=scatter.noise_scale)),
        float(np.average(constants.DEVIATION_STDS, weights=scatter.deviation)),
    )


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

    def narrowed(self, y: FloatArray) -> Self:
        """Drop grid points with together a negligible share of the posterior at coordinates."""
        return replace(self, grid=self.grid[kept_weights(self.weights(y), _NEGLIGIBLE)])

    def settings(self, y: FloatArray) -> FloatArray:
        """Return means at coordinates of walk, noise scale, deviation, χ², and its freedom.

        χ² is that at the mean of the coordinates. Its degrees of freedom are the data less all that
        they determine: intercepts, and coordinates as far as χ² is larger at the draws than at
        their mean [Spiegelhalter2002].
        """
        weight, grid = self.point_weights(y).mean(axis=2), self.grid
        centre = y.mean(axis=0, keepdims=True)
        possible = np.isfinite(self.scenario.log_prior(centre))
        x, inside = self.likelihood.path(self.scenario, centre[possible])
        if not inside.any():
            x, _ = self.likelihood.path(self.scenario, y[:1])
        drawn, _ = self.likelihood.path(self.scenario, y[np.isfinite(self.scenario.log_prior(y))])
        both = self.likelihood.quadratic(grid, np.concatenate([x[:1], drawn]))[0]
        chi_square, *at_draws = np.tensordot(weight, both, 2).tolist()
        informed = np.clip(np.mean(at_draws) - chi_square, 0.0, self.scenario.n_dim)
        means = np.stack([grid.walk, grid.noise_scale, grid.deviation, grid.freedom])
        walk, noise, deviation, freedom = means @ weight.sum(axis=0)
        freedom = max(freedom - informed, 1.0)
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
        off = np.zeros((y.shape[0], moments.size, free.size))
        for own, map_scale, k, x in self.by_nuisances(y, nuisances):
            if self.grid.deviation[k] > 0:
                mean, cov = self.likelihood.deviation(self.grid, k, map_scale, x, moments)
                # A variance of 0 may be rounded to below 0.
                least = 1e-15 * np.eye(cov.shape[-1])
                unit = rng.standard_normal((own.size, *mean.shape[1:], 1))
                off[own] = mean + (np.linalg.cholesky(cov + least) @ unit)[..., 0]
        return off * free

    def by_nuisances(
        self, y: FloatArray, nuisances: Nuisances
    ) -> Iterator[tuple[np.ndarray, float, int, FloatArray]]:
        """Yield the draws of each map error and grid point, for coordinates as `deviations`.

        Their indices, the factor on the declared map error, the index of the grid point, and ln
        parameters at the nodes, of a single life where there are no coordinates.
        """
        x, _ = self.likelihood.path(self.scenario, y if self.scenario.n_dim else y[:1])
        for error, k in np.unique(np.column_stack(nuisances), axis=0).tolist():
            own = np.flatnonzero((nuisances[0] == error) & (nuisances[1] == k))
            map_scale = of_stage.MAP_ERRORS[error][0]
            yield own, map_scale, k, x[own] if self.scenario.n_dim else x


def kept_weights(weight: FloatArray, loss: float) -> BoolArray:
    """Mark the largest weights ``(n,)``, all but those that sum to less than the loss."""
    order = np.argsort(weight)
    kept = np.ones(weight.size, dtype=bool)
    kept[order[np.cumsum(weight[order]) < loss]] = False
    return kept
