"""Bank of Kalman filters: one state space under many hyperparameters, all advanced at once.

Every set of hyperparameters (process noise, scale of reported errors) is a filter of its own,
weighted by its evidence. The sets form two groups: a healthy machine has no rate and a small random
walk, a changing one has a rate. States are immutable: `predict` and `update` return a new bank.
"""

from collections.abc import Collection
from copy import copy
from dataclasses import dataclass, replace
from itertools import product
from math import prod
from typing import Self

import numpy as np

from lmshealth._arrays import BoolArray, FloatArray, Rows
from lmshealth.tracking import constants
from lmshealth.tracking.history import Step
from lmshealth.tracking.state_space import StateSpace

# Sets with less than this share of their group's best are pruned (a test bounds the error).
_NEGLIGIBLE = float(np.log(1e-7))
_ROUNDING = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Hyperparameters(Rows):
    """Process noise and noise scales, one set per filter: standard deviations of ln f and lives."""

    level_walk: FloatArray  # of the random walk of ln f over a life, ``(n,)``
    rate_std: FloatArray  # of the initial rate per life, 0 for a healthy machine, ``(n,)``
    rate_walk: FloatArray  # of the random walk of the rate over a life, ``(n,)``
    scales: FloatArray  # factor on the reported errors of each source, ``(n, n_sources)``
    log_prior: FloatArray  # log of the prior probability, ``(n,)``
    rate_decay: FloatArray  # by which a rate decays exponentially, per life, ``(n,)``
    wander: FloatArray  # size of the wander in scaled errors of the first estimates, ``(n,)``
    wander_keep: FloatArray  # its correlation from one log to the next, ``(n,)``
    settling: FloatArray  # of the random walk of ln f that ends after a few logs, ``(n,)``

    @property
    def healthy(self) -> BoolArray:
        """Whether each set has no rate, or one that decays (running-in), shape ``(n,)``."""
        return np.asarray((self.rate_std == 0) | (self.rate_decay > 0))

    @property
    def disturbance(self) -> FloatArray:
        """Noise scales and wander of each set: of a machine, whatever regime it is in."""
        return np.column_stack([self.scales, self.wander, self.wander_keep])


def hyperparameter_grid(n_sources: int) -> Hyperparameters:
    """Return the grid of hyperparameters that is averaged over."""
    walks, rates = constants.CHANGING_WALKS, constants.CHANGING_RATES
    chance = constants.HEALTHY_PROBABILITY
    courses = [(w, 0.0, 0.0, 0.0, 0.0, chance * p) for w, p in constants.HEALTHY_WALKS]
    for logs, p in constants.RUNNING_IN_LOGS:
        decay = constants.LOGS_PER_LIFE / logs
        size = constants.RUNNING_IN_STD * decay
        courses.append((constants.HEALTHY_WALKS[0][0], size, 0.0, decay, 0.0, chance * p))
    for w, (r, d, share) in product(walks, rates):
        share *= (1 - chance) / len(walks)
        sizes = constants.SETTLING if r <= constants.SLOW_RATE else ((0.0, 1.0),)
        courses += [(w, r, d, 0.0, size, p * share) for size, p in sizes]
    rows = []
    for course, scales, wander in product(courses, _scales(n_sources), constants.WANDERS):
        size, logs, p = wander
        keep = np.exp(-1 / logs) if logs else 0.0
        weight = course[5] * prod(chance for _, chance in scales) * p
        rows.append((*course[:5], size, keep, weight, *(scale for scale, _ in scales)))
    table = np.array(rows)
    prior = table[:, 7] / table[:, 7].sum()
    walk, rate, drive, decay, settling, size, keep = table[:, :7].T
    noise = table[:, 8:]
    return Hyperparameters(walk, rate, drive, noise, np.log(prior), decay, size, keep, settling)


def _scales(n_sources: int) -> list[tuple[tuple[float, float], ...]]:
    """List the noise scales of all sources, without the most improbable combinations."""
    scaled = min(n_sources, constants.MOST_SCALED_SOURCES)
    choices = list(product(constants.SOURCE_NOISE_SCALES, repeat=scaled))
    least = constants.LEAST_SCALES_PROBABILITY
    rest = n_sources - scaled
    return [
        (*one, *(((one[-1][0], 1.0),) * rest))
        for one in choices
        if scaled == 1 or prod(p for _, p in one) >= least
    ]


@dataclass(frozen=True, slots=True, eq=False)
class FilterBank(Rows):
    """Filters of all hyperparameters that are left, at one log."""

    hyperparameters: Hyperparameters
    log_weight: FloatArray  # log of prior times evidence so far, ``(n,)``
    mean: FloatArray  # states, ``(n, size)``
    cov: FloatArray  # their covariances, ``(n, size, size)``

    def padded(self, size: int) -> Self:
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

    def pruned(self) -> Self:
        """Remove filters with a negligible share of their group; both groups stay."""
        group = self.hyperparameters.healthy.astype(int)
        best = np.full(2, -np.inf)
        np.maximum.at(best, group, self.log_weight)
        keep = self.log_weight > best[group] + _NEGLIGIBLE
        return self if keep.all() else self[keep]

    def collapse(self, size: int | None = None) -> tuple[FloatArray, FloatArray]:
        """Return mean and covariance of the mixture, of the first `size` entries of the state."""
        part = slice(size)
        return mixture(self.weight, self.mean[:, part], self.cov[:, part, part])


@dataclass(frozen=True, slots=True, eq=False)
class Innovation:
    """Innovations of one log, by mean and covariance of the mixture."""

    rows: np.ndarray  # rows of ``[ln f, ln ζ]`` that the log has, ``(n_rows,)``
    standardised: FloatArray  # ``(n_rows,)``
    outlying: FloatArray  # probability that they are outliers, ``(n_rows,)``
    nis: float  # normalised innovation squared of those that are more probably none


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
        self.mode_of = np.tile(history.mode_of(), 2)
        # Variance of ln f due to unknown covariates.
        self.extra = np.zeros((len(history.logs), 2 * r))
        for regressor in space.regressed:
            self.extra[:, :r] += regressor.unknown[:, None]
        # Covariance of a wander as large as the errors of each mode's first estimate.
        std = np.zeros(space.n_modes)
        for i, mode in enumerate(history.modes):
            variance = np.einsum("kii->ki", history.cov)[:, history.columns(mode)]
            first = variance[np.isfinite(variance)][:1]
            std[i] = np.sqrt(first[0]) if first.size else 0.0
        self.wander_cov = np.outer(std, std) * _correlation(constants.WANDER_COMMON, std.size)
        self.together = _correlation(constants.RATE_COMMON, std.size)

    def with_step(self, step: Step) -> Self:
        """Return the model with one more step."""
        changed = copy(self)
        changed.space = self.space.with_step(step)
        return changed


def initial(model: FilterModel, grid: Hyperparameters | None = None) -> FilterBank:
    """Return the bank before the first log, with all hyperparameters or with those given."""
    grid = model.grid if grid is None else grid
    n = grid.rate_std.size
    mean, cov = model.space.prior()
    covs = np.tile(cov, (n, 1, 1))
    _add(covs, model.space.rate, grid.rate_std**2, model.together)
    covs[:, model.space.wander, model.space.wander] += _wander_cov(model, grid)
    return FilterBank(grid, grid.log_prior.copy(), np.tile(mean, (n, 1)), covs)


def _wander_cov(model: FilterModel, own: Hyperparameters) -> FloatArray:
    """Return the stationary covariance of the wander, ``(n, n_modes, n_modes)``."""
    size = own.wander * np.exp(np.log(own.scales).mean(axis=1))
    return np.asarray(size[:, None, None] ** 2 * model.wander_cov)


def predict(model: FilterModel, bank: FilterBank, k: int) -> FilterBank:
    """Predict all filters from the log before to log k, with the steps between."""
    space, tick, own = model.space, float(model.space.ticks[k]), bank.hyperparameters
    level, rate, base, wander = space.level, space.rate, space.base, space.wander
    mean, cov = bank.mean.copy(), bank.cov.copy()
    if k in model.reopened:
        _add(cov, rate, own.rate_std**2, model.together)
    if k > 0 and space.seen[k]:
        keep = own.wander_keep[:, None, None]
        mean[:, wander] *= keep[:, :, 0]
        cov[:, wander, :] *= keep
        cov[:, :, wander] *= keep
        cov[:, wander, wander] += (1 - keep**2) * _wander_cov(model, own)
    if tick > 0:
        left = np.exp(-own.rate_decay * tick)[:, None]
        decay = np.maximum(own.rate_decay, _ROUNDING)[:, None]
        moved = np.where(own.rate_decay[:, None] > 0, (1 - left) / decay, tick)
        mean[:, level] += moved * mean[:, rate]
        mean[:, rate] *= left
        cov[:, level, :] += moved[:, :, None] * cov[:, rate, :]
        cov[:, :, level] += moved[:, None, :] * cov[:, :, rate]
        cov[:, rate, :] *= left[:, :, None]
        cov[:, :, rate] *= left[:, None, :]
        _diagonal(cov, level)[:] += own.level_walk[:, None] ** 2 * tick
        settling = own.settling[:, None, None] ** 2 * space.settling[k]
        cov[:, level, level] += settling * model.together
        drive = own.rate_walk[:, None, None] ** 2 * model.together
        cov[:, level, level] += drive * tick**3 / 3
        cov[:, level, rate] += drive * tick**2 / 2
        cov[:, rate, level] += drive * tick**2 / 2
        cov[:, rate, rate] += drive * tick
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
    model: FilterModel, bank: FilterBank, k: int, *, outliers: bool = True
) -> tuple[FilterBank, Innovation]:
    """Update filters that are predicted to log k with its estimates; nothing is pruned.

    Where innovations are large, the estimates of a mode or of all modes may be outliers: every
    filter is the mixture of these hypotheses, reduced to its mean and covariance.
    """
    rows: np.ndarray = np.flatnonzero(model.there[k])
    space = model.space
    matrix, value = space.matrix(k)[rows], model.values[k, rows]
    if value.size == 0:
        return bank, Innovation(np.array([], dtype=int), np.array([]), np.array([]), 0.0)
    scales = bank.hyperparameters.scales[:, model.scale_of[rows]]
    noise = space.history.cov[k][np.ix_(rows, rows)]
    n, size = bank.mean.shape
    # One product of all states with the matrix instead of one each.
    crossed = (bank.cov.reshape(-1, size) @ matrix.T).reshape(n, size, -1)
    errors = noise * scales[:, :, None] * scales[:, None, :]
    total = matrix @ crossed + errors
    _diagonal(total, slice(0, value.size))[:] += model.extra[k, rows]
    off = value - bank.mean @ matrix.T
    centre, cov = mixture(bank.weight, off, total)
    standardised = centre / np.sqrt(cov.diagonal())
    found = [_condition(bank, crossed, off, total)]
    mode, own = model.mode_of[rows], errors.diagonal(axis1=1, axis2=2)
    wide = np.where(rows < len(model.there[k]) // 2, constants.LN_F_STD, constants.LN_ZETA_STD)
    hypotheses = _outliers(mode, standardised) if outliers else []
    for outlying, chance, gross in hypotheses:
        wider = total.copy()
        more = wide**2 if gross else (constants.OUTLIER_SCALE**2 - 1) * own
        _diagonal(wider, slice(0, value.size))[:] += np.where(outlying, more, 0.0)
        other = _condition(bank, crossed, off, wider)
        found.append(replace(other, log_weight=other.log_weight + np.log(chance)))
    updated, share = _merged(found)
    masks = np.array([rows for rows, _, _ in hypotheses], dtype=float).reshape(-1, value.size)
    outlying = np.minimum(updated.weight @ share[:, 1:] @ masks, 1.0)
    kept = np.flatnonzero(outlying <= 0.5)
    inside = cov[np.ix_(kept, kept)]
    nis = float(centre[kept] @ np.linalg.solve(inside, centre[kept]))
    return updated, Innovation(rows, standardised, outlying, nis)


def _outliers(mode: np.ndarray, standardised: FloatArray) -> list[tuple[BoolArray, float, bool]]:
    """List hypotheses of outliers: rows, prior probability, and whether they are gross errors.

    They are nested: the mode with the largest innovation, the two largest, up to the whole log,
    which may be that of another machine.
    """
    modes = np.unique(mode)
    worst = np.array([np.abs(standardised[mode == m]).max() for m in modes])
    order = modes[np.argsort(-worst)]
    found: list[tuple[BoolArray, float, bool]] = []
    chance = constants.OUTLIER_PROBABILITY
    for i in range(1, int(np.sum(worst > constants.OUTLIER_GATE)) + 1):
        rows = np.isin(mode, order[:i])
        share = chance if i == modes.size else chance**i
        found += [(rows, share, False), (rows, share, True)]
    return found


def _condition(
    bank: FilterBank, crossed: FloatArray, off: FloatArray, total: FloatArray
) -> FilterBank:
    """Update filters by innovations of a covariance; `crossed` is that with the state."""
    root = np.linalg.cholesky(total)
    half = np.linalg.inv(root)
    white = (half @ off[:, :, None])[:, :, 0]
    gain = half @ np.swapaxes(crossed, 1, 2)
    nis = np.square(white).sum(axis=1)
    log_det = np.log(np.einsum("nii->ni", root)).sum(axis=1)
    reduction = np.swapaxes(gain, 1, 2) @ gain
    return FilterBank(
        bank.hyperparameters,
        bank.log_weight + (-0.5 * nis - log_det - 0.5 * off.shape[1] * np.log(2 * np.pi)),
        bank.mean + (white[:, None, :] @ gain)[:, 0, :],
        np.subtract(bank.cov, reduction, out=reduction),
    )


def _merged(found: list[FilterBank]) -> tuple[FilterBank, FloatArray]:
    """Reduce hypotheses to one bank; also their probabilities, ``(n, n_hypotheses)``."""
    if len(found) == 1:
        return found[0], np.ones((found[0].log_weight.size, 1))
    logs = np.stack([one.log_weight for one in found], axis=1)
    log_weight = np.logaddexp.reduce(logs, axis=1)
    share = np.exp(logs - log_weight[:, None])
    mean = sum(share[:, [h]] * one.mean for h, one in enumerate(found))
    cov = np.zeros_like(found[0].cov)
    for h, one in enumerate(found):
        off = one.mean - mean
        cov += share[:, h, None, None] * (one.cov + off[:, :, None] * off[:, None, :])
    return FilterBank(found[0].hyperparameters, log_weight, np.asarray(mean), cov), share


def advance(model: FilterModel, bank: FilterBank, first: int, last: int) -> FilterBank:
    """Filter the logs from one to another, both included."""
    for k in range(first, last + 1):
        bank = update(model, predict(model, bank, k), k)[0].pruned()
    return bank


def restart(model: FilterModel, bank: FilterBank, *, anew: bool = False) -> FilterBank:
    """Start a regime: keep state, noise scales and wander; process noise has its prior again.

    Only work on the machine starts it `anew`: parts then run in.
    """
    grid, own = model.grid, bank.hyperparameters
    kept, place = np.unique(own.disturbance, axis=0, return_inverse=True)
    match = (grid.disturbance[:, None, :] == kept[None]).all(axis=2)
    chosen = match.any(axis=1) & (anew | (grid.rate_decay == 0))
    grid, at = grid[chosen], match[chosen].argmax(axis=1)
    share = np.bincount(place.ravel(), weights=bank.weight)[at]
    of_kept = np.bincount(at, weights=np.exp(grid.log_prior))[at]
    n = grid.rate_std.size
    mean, cov = np.empty((n, bank.mean.shape[1])), np.empty((n, *bank.cov.shape[1:]))
    for d in range(len(kept)):
        for group in (True, False):
            members = (place.ravel() == d) & (own.healthy == group)
            state = bank[members if members.any() else place.ravel() == d].collapse()
            mean[(at == d) & (grid.healthy == group)], cov[(at == d) & (grid.healthy == group)] = (
                state
            )
    # A healthy machine has no rate, whatever its rate was before.
    rates = np.arange(model.space.rate.start, model.space.rate.stop)
    still = np.flatnonzero(grid.rate_std == 0)
    mean[np.ix_(still, rates)] = 0.0
    cov[np.ix_(still, rates)] = 0.0
    cov[still[:, None], :, rates] = 0.0
    _add(cov, model.space.rate, grid.rate_std**2, model.together)
    log_weight = grid.log_prior - np.log(of_kept) + np.log(np.maximum(share, 1e-12))
    return FilterBank(grid, log_weight, mean, cov)


def mixture(weight: FloatArray, mean: FloatArray, cov: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of a mixture of ``(n, size)`` means and their covariances."""
    centre = weight @ mean
    off = mean - centre
    n = centre.size
    within = (weight @ cov.reshape(-1, n * n)).reshape(n, n)
    return centre, within + (off * weight[:, None]).T @ off


def _correlation(common: float, n: int) -> FloatArray:
    """Return the correlation of n quantities that share a part of their variance."""
    return np.asarray(common + (1 - common) * np.eye(n))


def _add(cov: FloatArray, rows: slice, variance: FloatArray, correlation: FloatArray) -> None:
    """Add correlated variances ``(n,)`` to a diagonal block of covariances."""
    cov[:, rows, rows] += variance[:, None, None] * correlation


def _diagonal(cov: FloatArray, rows: slice) -> FloatArray:
    """Return the diagonals of a block of matrices as a writeable view, ``(n, n_modes)``."""
    size = cov.shape[1]
    # In a flattened matrix the diagonal has a stride of its size plus one.
    return cov.reshape(-1, size * size)[:, :: size + 1][:, rows]
