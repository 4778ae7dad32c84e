"""The likelihood of a whole life: scenarios of health against the ln frequencies of all logs.

For the informative modes of all logs since the baseline, y = H(θ) + S g + a + b (T - T_ref) + walk
+ ε. The intercept a, the covariate coefficients b and the random walk are Gaussian, as are the
biases of sources and what retunings shift, and marginalised into

    Σ = R + I ⊗ [σ_a² 1 1ᵀ + σ_b² T Tᵀ + q² min(s, s')] + S Sᵀ ⊗ d² min(s, s') / s_h,

so that errors common to all epochs stay common. The last part is of the deviation g: health is its
law times exp(g), with g a Gaussian process of standard deviation d at the horizon s_h, which the
modes see by the sensitivities S at the baseline. The map's sensitivities are wrong by a relative
error m, the same over the whole life: with V the whitened contribution of each parameter to each
mode times m, M = I + VᵀV and w = Vᵀ r,

    ln L = -½ rᵀr + ½ wᵀ M⁻¹ w - ½ ln|M| - ln|chol Σ|,   r = chol(Σ)⁻¹ (y - H(θ)).

The walk q, the deviation d and a factor on R are not known either: ln L is averaged over a grid of
them.

Lives are smooth: what their drifts are at all logs follows linearly from what they are at few of
them, the nodes. H(θ) = W h(θ) with h at the nodes, and by A = L⁻¹ W = Q R, L = chol(Σ), the data
shrink to Qᵀ L⁻¹ y and W to R, so that what a walker costs hardly depends on the number of logs.
Of more than 400 logs neighbours are taken together before, see `condense`.

Histories made shorter: logs close to each other are taken for one that knows what all know.

The likelihood of a whole life grows with the third power of the number of logs. A life moves
little from log to log: of very many, neighbours say the same, each with its own error.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime
from itertools import product

import numpy as np
from scipy.linalg import qr, solve_triangular

from lmshealth._arrays import BoolArray, FloatArray
from lmshealth.errors import NotEnoughData
from lmshealth.health.epoch_posterior import one_at_a_time
from lmshealth.prognosis.scenarios import Scenario, list_scenarios
from lmshealth.stage.description import ScatterPrior, Stage
from lmshealth.tracking.constants import BIAS_STD, JUMP_STD
from lmshealth.tracking.covariates import regressors
from lmshealth.tracking.history import History


def condense(history: History, most: int) -> History:
    """Take neighbouring logs together until there are about so many.

    Estimates are averaged by generalised least squares over the logs, series and their cross terms
    together, so that independent errors average out as they must; moments, odometer and covariates
    are plain means. The first log of a baseline and the last log stay alone, and no group reaches
    across a step.

    Parameters
    ----------
    history : History
        Any number of logs.
    most : int
        A history of no more logs than that is given back as it is.

    Returns
    -------
    History
        Named by the last log of each group.
    """
    n = len(history.logs)
    if n <= most:
        return history
    begins = _begins(history, -(-n // most))
    ends = np.append(begins[1:], n)
    group_of = np.repeat(np.arange(begins.size), ends - begins)
    parts = [slice(begin, end) for begin, end in zip(begins, ends, strict=True)]
    found = [_together(history, part) for part in parts]
    seconds = np.array([moment.timestamp() for moment in history.recorded_at])
    r = len(history.series)
    return replace(
        history,
        logs=tuple(history.logs[end - 1] for end in ends),
        recorded_at=tuple(datetime.fromtimestamp(seconds[part].mean(), UTC) for part in parts),
        travel=_means(history.travel, parts),
        covariates={name: _means(own, parts) for name, own in history.covariates.items()},
        ln_frequency=np.array([mean[:r] for mean, _ in found]),
        ln_damping=np.array([mean[r:] for mean, _ in found]),
        cov=np.array([cov for _, cov in found]),
        loop_error=_means(history.loop_error, parts),
        baselines=tuple(int(group_of[k]) for k in history.baselines),
        steps=tuple(
            replace(step, first=int(group_of[step.first]), there=step.there[begins])
            for step in history.steps
        ),
    )


def _begins(history: History, size: int) -> np.ndarray:
    """Give the indices of the logs with which groups of at most so many begin."""
    n = len(history.logs)
    parted = np.zeros(n, dtype=bool)
    parted[[0, n - 1]] = True
    for k in history.baselines:
        parted[[k, min(k + 1, n - 1)]] = True
    for step in history.steps:
        parted[step.first] = True
        parted[1:] |= np.diff(step.there.astype(int)) != 0
    begins = np.flatnonzero(parted)
    lengths = np.diff(begins, append=n)
    within = np.concatenate([np.arange(length) for length in lengths])
    return np.flatnonzero(within % size == 0)


def _means(values: FloatArray, parts: list[slice]) -> FloatArray:
    """Mean of what is known in each group, NaN where nothing is."""
    known = np.isfinite(values)
    filled = np.where(known, values, 0.0)
    counts = np.array([known[part].sum() for part in parts])
    sums = np.array([filled[part].sum() for part in parts])
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def _together(history: History, part: slice) -> tuple[FloatArray, FloatArray]:
    """Average the estimates of a group: mean ``(2 n_series,)`` and covariance, NaN if missing."""
    values = np.hstack([history.ln_frequency[part], history.ln_damping[part]])
    precision, weighted = np.zeros((values.shape[1],) * 2), np.zeros(values.shape[1])
    for own, cov in zip(values, history.cov[part], strict=True):
        there = np.flatnonzero(np.isfinite(own))
        if there.size:
            block = np.linalg.inv(cov[np.ix_(there, there)])
            precision[np.ix_(there, there)] += block
            weighted[there] += block @ own[there]
    seen = np.flatnonzero(np.isfinite(values).any(axis=0))
    mean, total = np.full(values.shape[1], np.nan), np.full_like(precision, np.nan)
    if seen.size:
        cov = np.linalg.inv(precision[np.ix_(seen, seen)])
        mean[seen] = cov @ weighted[seen]
        total[np.ix_(seen, seen)] = (cov + cov.T) / 2
    return mean, total


_INTERCEPT_STD = 0.1
# Random walk of ln f over the history, factor on the reported standard deviations, and standard
# deviation of ln health about its law at the horizon, with priors.
_WALKS = (1e-5, 5e-4, 1.5e-3, 5e-3, 1.5e-2)
_NOISE_SCALES = (1.0, 1.5, 2.25)
_NOISE_SCALE_PRIOR = (0.9, 0.07, 0.03)
_DEVIATIONS = (0.0, 0.04, 0.15)
_DEVIATION_PRIOR = (0.6, 0.3, 0.1)
# Lives that show how smooth lives are; what QR may leave of theirs, in ln f. Others are met within
# some 1e-6, those of a posterior within 1e-8.
_N_EXAMPLES, _ROUGHEST = 300, 1e-8
# Of more logs neighbours are taken together.
MOST_LOGS = 400
# With more steps than these every piece of a life is too short for a law.
_MOST_STEPS = 3


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Whitened data at every point of the grid; the point is the first axis.

    ``design`` is R of each mode, shape ``(n_points, n_modes, n_nodes, n_rows)``, ``target`` is
    Qᵀ L⁻¹ y, ``(n_points, n_rows)``, ``rest`` the χ² that no life can explain, and ``log_weight``
    the log prior with the determinant.
    """

    walk: FloatArray
    noise_scale: FloatArray
    deviation: FloatArray
    design: FloatArray
    target: FloatArray
    rest: FloatArray
    log_weight: FloatArray

    def chosen(self, which: BoolArray) -> Grid:
        """Keep some of the points."""
        return Grid(*(getattr(self, field.name)[which] for field in fields(self)))


@dataclass(frozen=True, slots=True, eq=False)
class _Covariance:
    """Parts of Σ, all of shape ``(n_data, n_data)``: the last three go with grid values."""

    fixed: FloatArray
    noise: FloatArray
    walk: FloatArray
    deviation: FloatArray

    def factor(self, walk: float, noise_scale: float, deviation: float) -> FloatArray:
        """Give chol(Σ) at a point of the grid."""
        total = self.fixed + noise_scale**2 * self.noise + walk**2 * self.walk
        return np.asarray(np.linalg.cholesky(total + deviation**2 * self.deviation))


class LifeLikelihood:
    """What all logs of a life say, whichever scenario it took; vectorised over walkers.

    Parameters
    ----------
    history : History
        Modal estimates of all logs.
    stage : Stage
        Laws, priors, covariates and modal map.

    Raises
    ------
    NotEnoughData
        If fewer than three logs after the baseline hold an informative mode, the odometer has not
        moved, or the modes jumped more than three times.
    """

    def __init__(self, history: History, stage: Stage) -> None:
        self.stage = stage
        history = condense(history, MOST_LOGS)
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
        clock = _parted(history)
        self.clock = clock[history.baseline :]
        self.now = float(self.clock.max(initial=0.0))
        if np.isfinite(ln_f).any(axis=1).sum() < 3 or self.now <= 0:
            raise NotEnoughData(
                f"{history.stage}: {np.isfinite(ln_f).any(axis=1).sum()} logs with a mode of the "
                f"map over {self.now / 1000:.4g} km; a life needs at least 3 logs and some travel"
            )
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
        self.steps = _steps(history, clock)
        self.scenarios = list_scenarios(stage.parameters, self.steps, self.now)
        # What only ever keeps its value does not deviate from that either.
        free = [any(law.names for law in parameter.laws) for parameter in stage.parameters]
        self.free = np.array(free, dtype=float)
        self.horizon = stage.description.usage.horizon_km * 1000.0
        self.slopes = _slopes(stage, self.modes) * self.free
        self.nodes, self.weights = self._choose_nodes()
        # Laws are monotonic: a life is inside the map where its ends and those of its jumps are.
        ends = [self.clock.min(), self.clock.max(), *self.steps, *np.nextafter(self.steps, 0)]
        self.checked = np.append(self.clock[self.nodes], ends)
        self.covariance = self._covariance(history, columns)
        self.grid = self._whiten()

    def ln_health(
        self, scenario: Scenario, y: FloatArray, clock: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        """Ln parameters at moments of lives, and which lives are inside the map at all of them."""
        assert self.stage.modal_map is not None  # prognose() has checked
        health = scenario.health(scenario.natural(y), clock)
        with np.errstate(divide="ignore", invalid="ignore"):
            x = np.log(health * [p.baseline for p in self.stage.parameters])
        return x, np.asarray(self.stage.modal_map.inside(x).all(axis=1))

    def terms(self, grid: Grid, x: FloatArray) -> FloatArray:
        """Log likelihood of each grid point and walker, with the grid's prior, ``(n_grid, n)``."""
        chi_square, log_det = self.quadratic(grid, x)
        return np.asarray(grid.log_weight[:, None] - 0.5 * (chi_square + log_det))

    def quadratic(self, grid: Grid, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """χ² with the map error marginalised and its log determinant, both ``(n_grid, n)``."""
        r, v, m = self._residuals(grid, x)
        w = (v @ r[..., None])[..., 0]
        solved = np.linalg.solve(m, w[..., None])[..., 0]
        chi_square = grid.rest[:, None] + np.sum(r * r, axis=2) - np.sum(w * solved, axis=2)
        return chi_square, np.linalg.slogdet(m)[1]

    def deviation(
        self, grid: Grid, k: int, x: FloatArray, moments: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance of ln health about its law, given a life and all data.

        Parameters
        ----------
        grid : Grid
            Points of the grid.
        k : int
            Which of them.
        x : ndarray
            Ln parameters at the nodes, shape ``(n, n_nodes, n_parameters)``.
        moments : ndarray
            Travel in m since the baseline, past or future, shape ``(n_moments,)``.

        Returns
        -------
        mean : ndarray
            Shape ``(n, n_moments, n_parameters)``.
        cov : ndarray
            Between the parameters, shape ``(n, n_moments, n_parameters, n_parameters)``.
        """
        deviation = float(grid.deviation[k])
        point = grid.chosen(np.arange(grid.walk.size) == k)
        factor = self.covariance.factor(float(grid.walk[k]), float(grid.noise_scale[k]), deviation)
        unit = deviation**2 / self.horizon
        shared = unit * np.maximum(np.minimum.outer(moments, self.clock[self.log_of]), 0.0)
        cross = shared[:, None] * self.slopes[self.mode_of].T  # (n_moments, n_parameters, n_data)
        n_moments, p, n_data = cross.shape
        a = solve_triangular(factor, cross.reshape(-1, n_data).T, lower=True)
        u, q, _ = self._reduced(factor)
        b = (a.T @ q).reshape(n_moments, p, -1)
        r, v, m = (part[0] for part in self._residuals(point, x))
        solved = np.linalg.solve(m, v)  # M⁻¹ V
        explained = np.einsum("nvr,nr->nv", solved, r)
        fitted = point.target[0] - r + np.einsum("nv,nvr->nr", explained, v)
        mean = (a.T @ u).reshape(n_moments, p) - np.einsum("nr,mpr->nmp", fitted, b)
        own = a.T.reshape(n_moments, p, n_data)
        before = unit * moments[:, None, None] * np.diag(self.free)
        known = before - own @ np.swapaxes(own, 1, 2)
        left = np.einsum("mpr,nvr->nmpv", b, v)
        right = np.einsum("nvr,mpr->nmvp", solved, b)
        return mean, known + left @ right

    def _residuals(self, grid: Grid, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Whitened residuals, the map's errors by rows, and I + VVᵀ, grid points first."""
        drift = self._drifts(x)
        n_modes, n_paths, n, n_nodes = drift.shape
        white = drift.reshape(n_modes, -1, n_nodes) @ grid.design
        white = white.reshape(-1, n_modes, n_paths, n, grid.target.shape[1])
        r = grid.target[:, None] - white[:, :, 0].sum(axis=1)
        model_std = self.stage.description.map.model_std if self.stage.description.map else 0.0
        # Errors last but one: of each parameter in each mode.
        v = np.moveaxis(model_std * white[:, :, 1:], 3, 1).reshape(*r.shape[:2], -1, r.shape[2])
        return r, v, np.eye(v.shape[2]) + v @ np.swapaxes(v, 2, 3)

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
        rng, examples = np.random.default_rng(0), []
        for scenario in self.scenarios:
            y = scenario.draw(rng, _N_EXAMPLES if scenario.n_dim else 1)
            x, inside = self.ln_health(scenario, y, self.clock)
            if inside.any():
                examples.append(self._drifts(x[inside]).reshape(-1, self.clock.size))
        if not examples:
            raise NotEnoughData(f"{self.stage.name}: no life of the prior stays inside the map")
        # Columns of R are as those of what it is made of.
        joined = np.concatenate([qr(one, mode="r")[0][: self.clock.size] for one in examples])
        _, r, order = qr(joined, mode="economic", pivoting=True)
        n = max(int(np.sum(np.abs(np.diag(r)) > _ROUGHEST)), 1)
        weights = np.zeros((self.clock.size, n))
        weights[order[:n], np.arange(n)] = 1.0
        if np.abs(r[0, 0]) > 0:
            weights[order[n:]] = solve_triangular(r[:n, :n], r[:n, n:]).T
        return order[:n], weights

    def _covariance(self, history: History, columns: list[int]) -> _Covariance:
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
        shared = np.maximum(np.minimum.outer(self.clock, self.clock), 0.0)
        slopes = self.slopes[self.mode_of_series]
        size, own = n_series * n_logs, np.ix_(self.rows, self.rows)
        return _Covariance(
            fixed=(np.kron(same, common) + self._offsets(history))[own],
            noise=noise.reshape(size, size)[own],
            walk=np.kron(same, shared / self.now)[own],
            deviation=np.kron(slopes @ slopes.T, shared / self.horizon)[own],
        )

    def _reduced(self, factor: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Give L⁻¹ y, and Q and R of L⁻¹ W for the nodes of all modes."""
        own = self.mode_of[:, None] == np.arange(len(self.modes))
        shapes = own[:, :, None] * self.weights[self.log_of][:, None]
        shapes = shapes.reshape(self.rows.size, -1)
        both = solve_triangular(factor, np.column_stack([shapes, self.y]), lower=True)
        q, r = np.linalg.qr(both[:, :-1])
        return both[:, -1], q, r

    def _whiten(self) -> Grid:
        points, believed = [], scatter_prior(self.stage)
        for (walk, walk_prior), (scale, scale_prior), (deviation, deviation_prior) in product(
            zip(_WALKS, believed.walk, strict=True),
            zip(_NOISE_SCALES, believed.noise_scale, strict=True),
            zip(_DEVIATIONS, believed.deviation, strict=True),
        ):
            factor = self.covariance.factor(walk, scale, deviation)
            u, q, r = self._reduced(factor)
            target = q.T @ u
            prior = walk_prior * scale_prior * deviation_prior
            log_weight = np.log(prior) - np.sum(np.log(np.diag(factor)))
            design = r.T.reshape(len(self.modes), -1, target.size)
            rest = np.sum(u**2) - np.sum(target**2)
            points.append((walk, scale, deviation, design, target, rest, log_weight))
        return Grid(*(np.array(column) for column in zip(*points, strict=True)))

    def _offsets(self, history: History) -> FloatArray:
        """Covariance of what shifts readings without wear: sources, retunings, new sensors."""
        same = self.same_mode
        # The intercept is the first series'; each further one of a mode has its own bias.
        further = np.tril(same, -1).any(axis=1).astype(float)
        total = np.kron(np.diag(further), np.full((self.clock.size,) * 2, BIAS_STD[0] ** 2))
        for step in history.steps:
            if step.changes_modes:
                continue
            there = step.there[history.baseline :].astype(float)
            seen = [step.source in ("", one.source) for one in self.series]
            total += np.kron(
                same * np.outer(seen, seen), JUMP_STD[step.kind][0] ** 2 * np.outer(there, there)
            )
        return total


def scatter_prior(stage: Stage) -> ScatterPrior:
    """Give what is believed of the scatter of a stage beforehand."""
    if stage.scatter is not None:
        return stage.scatter
    return ScatterPrior((1.0,) * len(_WALKS), _NOISE_SCALE_PRIOR, _DEVIATION_PRIOR)


def expected_scatter(scatter: ScatterPrior) -> tuple[float, float, float]:
    """Give the means of walk, noise scale and deviation that are believed in beforehand."""
    values = (_WALKS, _NOISE_SCALES, _DEVIATIONS)
    priors = (scatter.walk, scatter.noise_scale, scatter.deviation)
    walk, noise_scale, deviation = (
        float(np.average(v, weights=p)) for v, p in zip(values, priors, strict=True)
    )
    return walk, noise_scale, deviation


def _jumps(history: History) -> list[int]:
    """First logs after the modes jumped, since the baseline."""
    first = {s.first for s in history.steps if s.kind == "step" and s.first > history.baseline}
    return sorted(first)


def _parted(history: History) -> FloatArray:
    """Travel since the baseline; where none parts logs from a jump, those before stand 1 m back."""
    clock = history.clock()
    for k in reversed(_jumps(history)):
        before = clock[:k]
        before[before >= clock[k]] = clock[k] - 1.0
    return clock


def _steps(history: History, clock: FloatArray) -> tuple[float, ...]:
    """Travel since the baseline at which the modes jumped, between two logs each."""
    first = _jumps(history)
    if len(first) > _MOST_STEPS:
        raise NotEnoughData(
            f"{history.stage}: the modes jumped {len(first)} times since the baseline; no law of "
            "a life holds over so many; maintenance.csv can declare a new baseline"
        )
    return tuple(float((clock[k - 1] + clock[k]) / 2) for k in first)


def _slopes(stage: Stage, modes: tuple[str, ...]) -> FloatArray:
    """D ln f / d ln parameter at the baseline, shape ``(n_modes, n_parameters)``."""
    assert stage.modal_map is not None  # prognose() has checked
    rows = [stage.modal_map.modes.index(name) for name in modes]
    return np.asarray(stage.modal_map.gradient(stage.baseline_point[None])[0, rows])
