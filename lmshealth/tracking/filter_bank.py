"""Bank of Kalman filters: one state space under many hyperparameters, all advanced at once.

Every set of hyperparameters (process noise, scale of reported errors) is a filter of its own,
weighted by its evidence. The sets form two groups: a healthy machine has no rate and a small random
walk, a changing one has a rate. States are immutable: `predict` and `update` return a new bank.
"""

from __future__ import annotations

from collections.abc import Collection
from copy import copy
from dataclasses import dataclass, replace
from itertools import product
from math import prod

import numpy as np

from lmshealth._arrays import BoolArray, FloatArray, Rows
from lmshealth.tracking import constants
from lmshealth.tracking.history import Step
from lmshealth.tracking.state_space import StateSpace

# Sets with less than this share of their group's best are pruned (a test bounds the error).
_NEGLIGIBLE = float(np.log(1e-5))


@dataclass(frozen=True, slots=True, eq=False)
class Hyperparameters(Rows):
    """Process noise and noise scales, one set per filter: standard deviations of ln f and lives."""

    level_walk: FloatArray  # of the random walk of ln f over a life, ``(n,)``
    rate_std: FloatArray  # of the initial rate per life, 0 for a healthy machine, ``(n,)``
    rate_walk: FloatArray  # of the random walk of the rate over a life, ``(n,)``
    scales: FloatArray  # factor on the reported errors of each source, ``(n, n_sources)``
    log_prior: FloatArray  # log of the prior probability, ``(n,)``

    @property
    def healthy(self) -> BoolArray:
        """Whether each set has no rate, shape ``(n,)``."""
        return np.asarray(self.rate_std == 0)


def hyperparameter_grid(n_sources: int) -> Hyperparameters:
    """Return the grid of hyperparameters that is averaged over."""
    scaled = min(n_sources, constants.MOST_SCALED_SOURCES)
    walks, rates = constants.CHANGING_WALKS, constants.CHANGING_RATES
    share = constants.HEALTHY_PROBABILITY / len(constants.HEALTHY_WALKS)
    healthy = [(walk, 0.0, 0.0, share) for walk in constants.HEALTHY_WALKS]
    share = (1 - constants.HEALTHY_PROBABILITY) / (len(walks) * len(rates))
    changing = [(walk, rate, drive, share) for walk in walks for rate, drive in rates]
    rows = []
    for (walk, rate, drive, weight), choice in product(
        healthy + changing, product(constants.SOURCE_NOISE_SCALES, repeat=scaled)
    ):
        scales = [scale for scale, _ in choice] + [choice[-1][0]] * (n_sources - scaled)
        rows.append((walk, rate, drive, weight * prod(chance for _, chance in choice), *scales))
    table = np.array(rows)
    return Hyperparameters(table[:, 0], table[:, 1], table[:, 2], table[:, 4:], np.log(table[:, 3]))


@dataclass(frozen=True, slots=True, eq=False)
class FilterBank(Rows):
    """Filters of all hyperparameters that are left, at one log."""

    hyperparameters: Hyperparameters
    log_weight: FloatArray  # log of prior times evidence so far, ``(n,)``
    mean: FloatArray  # states, ``(n, size)``
    cov: FloatArray  # their covariances, ``(n, size, size)``

    def padded(self, size: int) -> FilterBank:
        """Return a bank with a longer state, whose new entries are exactly 0."""
        more = size - self.mean.shape[1]
        mean = np.pad(self.mean, ((0, 0), (0, more)))
        return replace(self, mean=mean, cov=np.pad(self.cov, ((0, 0), (0, more), (0, more))))

    @property
    def weight(self) -> FloatArray:
        """Posterior probability of each filter, shape ``(n,)``."""
        return np.asarray(np.exp(self.log_weight - self.log_evidence))

    @property
    def log_evidence(self) -> float:
        """Log evidence of all logs so far, averaged over the hyperparameters."""
        return float(np.logaddexp.reduce(self.log_weight))

    def log_bayes_factor(self) -> float:
        """Return the log evidence of the changing filters over the healthy ones."""
        healthy = self.hyperparameters.healthy
        if healthy.all() or not healthy.any():
            return 0.0
        chance = constants.HEALTHY_PROBABILITY
        changing = np.logaddexp.reduce(self.log_weight[~healthy])
        odds = changing - np.logaddexp.reduce(self.log_weight[healthy])
        return float(odds + (np.log(chance) - np.log1p(-chance)))

    def pruned(self) -> FilterBank:
        """Remove filters with a negligible share of their group; both groups stay."""
        group = self.hyperparameters.healthy.astype(int)
        best = np.full(2, -np.inf)
        np.maximum.at(best, group, self.log_weight)
        keep = self.log_weight > best[group] + _NEGLIGIBLE
        return self if keep.all() else self[keep]

    def collapse(self, size: int | None = None) -> tuple[FloatArray, FloatArray]:
        """Return mean and covariance of the mixture, of the first `size` entries of the state."""
        part = slice(size)
        return _mixture(self.weight, self.mean[:, part], self.cov[:, part, part])


@dataclass(frozen=True, slots=True, eq=False)
class Innovation:
    """Innovations of one log, without outliers, by mean and covariance of the mixture."""

    rows: np.ndarray  # rows of ``[ln f, ln ζ]`` that the log has, ``(n_rows,)``
    standardised: FloatArray  # ``(n_rows,)``
    nis: float  # normalised innovation squared


class FilterModel:
    """State space and measurements of a history, as the filters use them.

    Rates have their prior variance again before the logs `reopened`. `values` are the estimates
    ``[ln f, ln ζ]``, ``(n_logs, 2 n_series)``, `scale_of` the index of the source of each row, and
    `grid` the hyperparameters that a bank starts with.
    """

    def __init__(self, space: StateSpace, reopened: Collection[int] = ()) -> None:
        self.space, self.reopened = space, frozenset(reopened)
        history, r = space.history, len(space.history.series)
        self.values = np.hstack([history.ln_frequency, history.ln_damping])
        self.there = np.isfinite(self.values)
        self.sources = tuple(dict.fromkeys(one.source for one in history.series))
        self.scale_of = np.array([self.sources.index(one.source) for one in history.series] * 2)
        self.grid = hyperparameter_grid(len(self.sources))
        self.outlier_variance = np.repeat(np.square([constants.LN_F_STD, constants.LN_ZETA_STD]), r)
        # Variance of ln f due to unknown covariates.
        self.extra = np.zeros((len(history.logs), 2 * r))
        for regressor in space.regressed:
            self.extra[:, :r] += regressor.unknown[:, None]

    def with_step(self, step: Step) -> FilterModel:
        """Return the model with one more step."""
        changed = copy(self)
        changed.space = self.space.with_step(step)
        return changed


def initial(model: FilterModel) -> FilterBank:
    """Return the bank before the first log, with all hyperparameters."""
    grid = model.grid
    n = grid.rate_std.size
    mean, cov = model.space.prior()
    covs = np.tile(cov, (n, 1, 1))
    _diagonal(covs, model.space.rate)[:] += grid.rate_std[:, None] ** 2
    return FilterBank(grid, grid.log_prior.copy(), np.tile(mean, (n, 1)), covs)


def predict(model: FilterModel, bank: FilterBank, k: int) -> FilterBank:
    """Predict all filters from the log before to log k, with the steps between."""
    space, tick, own = model.space, float(model.space.ticks[k]), bank.hyperparameters
    level, rate, base = space.level, space.rate, space.base
    mean, cov = bank.mean.copy(), bank.cov.copy()
    if k in model.reopened:
        _diagonal(cov, rate)[:] += own.rate_std[:, None] ** 2
    if tick > 0:
        mean[:, level] += tick * mean[:, rate]
        cov[:, level, :] += tick * cov[:, rate, :]
        cov[:, :, level] += tick * cov[:, :, rate]
        walk, drive = own.level_walk[:, None] ** 2, own.rate_walk[:, None] ** 2
        _diagonal(cov, level)[:] += walk * tick + drive * tick**3 / 3
        _diagonal(cov, level, rate)[:] += drive * tick**2 / 2
        _diagonal(cov, rate, level)[:] += drive * tick**2 / 2
        _diagonal(cov, rate)[:] += drive * tick
        _diagonal(cov, space.damping)[:] += constants.DAMPING_WALK**2 * tick
    for j, step in enumerate(space.steps):
        if step.first == k:
            _begin_step(space, cov, step, j)
    if k in space.history.baselines:
        mean[:, base] = mean[:, level]
        cov[:, base, :] = cov[:, level, :]
        cov[:, :, base] = cov[:, :, level]
    return FilterBank(own, bank.log_weight, mean, cov)


def _begin_step(space: StateSpace, cov: FloatArray, step: Step, j: int) -> None:
    """Add the variance of the j-th step of a state space to covariances that the caller owns."""
    jump = space.jump(j)
    variance = np.repeat(np.square(constants.JUMP_STD[step.kind]), space.n_modes)
    own = np.arange(jump.start, jump.stop)
    cov[:, own, own] += variance
    if step.changes_modes:
        level, damping = space.level, space.damping
        moved = np.r_[level.start : level.stop, damping.start : damping.stop]
        cov[:, own, moved] += variance
        cov[:, moved, own] += variance
        cov[:, moved, moved] += variance


def update(
    model: FilterModel, bank: FilterBank, k: int, outlying: np.ndarray | None = None
) -> tuple[FilterBank, Innovation]:
    """Update filters that are predicted to log k with its estimates; nothing is pruned.

    Rows that are `outlying`, ``(2 n_series,)``, have the variance of the prior, and no innovation.
    """
    rows: np.ndarray = np.flatnonzero(model.there[k])
    space = model.space
    matrix, value = space.matrix(k)[rows], model.values[k, rows]
    if value.size == 0:
        return bank, Innovation(np.array([], dtype=int), np.array([]), 0.0)
    scales = bank.hyperparameters.scales[:, model.scale_of[rows]]
    noise = space.history.cov[k][np.ix_(rows, rows)]
    log_weight = bank.log_weight
    n, size = bank.mean.shape
    # One product of all states with the matrix instead of one each.
    crossed = (bank.cov.reshape(-1, size) @ matrix.T).reshape(n, size, -1)
    total = matrix @ crossed + noise * scales[:, :, None] * scales[:, None, :]
    _diagonal(total, slice(0, value.size))[:] += model.extra[k, rows]
    if outlying is not None:
        own = np.flatnonzero(outlying[rows])
        # The same for all hyperparameters: an outlier does not weigh them.
        total[:, own, own] += model.outlier_variance[rows[own]]
        log_weight = log_weight + np.log(constants.OUTLIER_PROBABILITY)
    root = np.linalg.cholesky(total)
    half = np.linalg.inv(root)
    off = value - bank.mean @ matrix.T
    white = (half @ off[:, :, None])[:, :, 0]
    gain = half @ np.swapaxes(crossed, 1, 2)
    nis = np.square(white).sum(axis=1)
    log_det = np.log(np.einsum("nii->ni", root)).sum(axis=1)
    reduction = np.swapaxes(gain, 1, 2) @ gain
    updated = FilterBank(
        bank.hyperparameters,
        log_weight + (-0.5 * nis - log_det - 0.5 * value.size * np.log(2 * np.pi)),
        bank.mean + (white[:, None, :] @ gain)[:, 0, :],
        np.subtract(bank.cov, reduction, out=reduction),
    )
    centre, cov = _mixture(bank.weight, off, total)
    if outlying is not None:
        kept = np.flatnonzero(~outlying[rows])
        rows, centre, cov = rows[kept], centre[kept], cov[np.ix_(kept, kept)]
    squared = float(centre @ np.linalg.solve(cov, centre))
    return updated, Innovation(rows, centre / np.sqrt(cov.diagonal()), squared)


def advance(model: FilterModel, bank: FilterBank, first: int, last: int) -> FilterBank:
    """Filter the logs from one to another, both included."""
    for k in range(first, last + 1):
        bank = update(model, predict(model, bank, k), k)[0].pruned()
    return bank


def restart(model: FilterModel, bank: FilterBank) -> FilterBank:
    """Start a regime: keep state and noise scales, and give process noise its prior again."""
    grid, own = model.grid, bank.hyperparameters
    scales, place = np.unique(own.scales, axis=0, return_inverse=True)
    weight = np.bincount(place.ravel(), weights=bank.weight)
    match = (grid.scales[:, None, :] == scales[None]).all(axis=2)
    grid, match = grid[match.any(axis=1)], match[match.any(axis=1)]
    share = np.log(np.maximum(match @ weight, 1e-12))
    _, place = np.unique(grid.scales, axis=0, return_inverse=True)
    place = place.ravel()
    of_scale = np.log(np.bincount(place, weights=np.exp(grid.log_prior))[place])
    n = grid.rate_std.size
    mean, cov = np.empty((n, bank.mean.shape[1])), np.empty((n, *bank.cov.shape[1:]))
    for group in (True, False):
        members = own.healthy == group
        state = (bank[members] if members.any() else bank).collapse()
        mean[grid.healthy == group], cov[grid.healthy == group] = state
    # A healthy machine has no rate, whatever its rate was before.
    rates = np.arange(model.space.rate.start, model.space.rate.stop)
    still = np.flatnonzero(grid.healthy)
    mean[np.ix_(still, rates)] = 0.0
    cov[np.ix_(still, rates)] = 0.0
    cov[still[:, None], :, rates] = 0.0
    _diagonal(cov, model.space.rate)[:] += grid.rate_std[:, None] ** 2
    return FilterBank(grid, grid.log_prior - of_scale + share, mean, cov)


def _mixture(
    weight: FloatArray, mean: FloatArray, cov: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of a mixture of ``(n, size)`` means and their covariances."""
    centre = weight @ mean
    off = mean - centre
    n = centre.size
    within = (weight @ cov.reshape(-1, n * n)).reshape(n, n)
    return centre, within + (off * weight[:, None]).T @ off


def _diagonal(cov: FloatArray, rows: slice, columns: slice | None = None) -> FloatArray:
    """Return the diagonals of a block of matrices as a writeable view, ``(n, n_modes)``."""
    size, other = cov.shape[1], rows if columns is None else columns
    first = rows.start * size + other.start
    # In a flattened matrix the diagonal has a stride of its size plus one.
    return cov.reshape(-1, size * size)[:, first :: size + 1][:, : rows.stop - rows.start]
