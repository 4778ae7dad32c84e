"""Bank of Kalman filters: one state space under many hyperparameters, all advanced at once.

Every set of hyperparameters (process noise, scale of reported errors) is a filter of its own,
weighted by its evidence. The sets form two groups: a healthy machine has no rate and a small random
walk, a changing one has a rate. States are immutable: `predict` and `update` return a new bank.
"""

from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from math import log, log1p, prod
from typing import Self

import numpy as np

from lmshealth._private.arrays import BoolArray, FloatArray, Rows, diagonal
from lmshealth.tracking import constants
from lmshealth.tracking.history import Step
from lmshealth.tracking.state_space import StateSpace

# Sets with less than this share of their group's best are pruned (a test bounds the error).
_NEGLIGIBLE = float(np.log(1e-7))


@dataclass(frozen=True, eq=False)
class Hyperparameters(Rows):
    """Process noise and noise scales, one set per filter: standard deviations of ln f and lives.

    There are no slots: what follows from them is kept, because it is needed at every log.
    """

    level_walk: FloatArray  # of the random walk of ln f over a life, ``(n,)``
    rate_std: FloatArray  # of the initial rate per life, 0 for a healthy machine, ``(n,)``
    rate_walk: FloatArray  # of the random walk of the rate over a life, ``(n,)``
    scales: FloatArray  # factor on the reported errors of each source, ``(n, n_sources)``
    log_prior: FloatArray  # log of the prior probability, ``(n,)``
    rate_decay: FloatArray  # by which a rate decays exponentially, per life, ``(n,)``
    wander: FloatArray  # size of the wander in scaled errors of the first estimates, ``(n,)``
    wander_keep: FloatArray  # its correlation from one log to the next, ``(n,)``
    settling: FloatArray  # of the random walk of ln f that ends after a few logs, ``(n,)``
    # Index of the combination of scales and wander: of a machine, whatever its regime, ``(n,)``.
    disturbance: np.ndarray

    @cached_property
    def healthy(self) -> BoolArray:
        """Whether each set has no rate, or one that decays (running-in), shape ``(n,)``."""
        return np.asarray((self.rate_std == 0) | (self.rate_decay > 0))

    @cached_property
    def groups(self) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the healthy and of the changing sets."""
        return np.flatnonzero(self.healthy), np.flatnonzero(~self.healthy)

    @cached_property
    def decays(self) -> bool:
        """Whether a rate of any set decays."""
        return bool((self.rate_decay > 0).any())

    @cached_property
    def wander_variance(self) -> FloatArray:
        """Stationary variance of the wander in errors of the first estimates, shape ``(n,)``."""
        return np.asarray((self.wander * np.exp(np.log(self.scales).mean(axis=1))) ** 2)

    @cached_property
    def log_walks(self) -> FloatArray:
        """Logs of the variance of the walk of ln f, then of the scales, ``(n, 1 + n_sources)``."""
        with np.errstate(divide="ignore"):
            return np.log(np.column_stack([self.level_walk**2, self.scales]))

    @cached_property
    def variances(self) -> FloatArray:
        """Variances of settling, of wander, and of the part of it that stays, shape ``(n, 3)``."""
        wander = self.wander_variance
        return np.column_stack([self.settling**2, wander, wander * self.wander_keep])

    @cached_property
    def process_noise(self) -> FloatArray:
        """Variances of the parts of process noise, in the order of `_process_noise`, ``(n, 7)``."""
        drive, wander = self.rate_walk**2, (1 - self.wander_keep**2) * self.wander_variance
        damping = np.full(drive.size, constants.DAMPING_WALK**2)
        parts = (self.level_walk**2, self.settling**2, drive, drive, drive, wander, damping)
        return np.column_stack(parts)


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
    disturbances = np.array(
        [
            (size, np.exp(-1 / logs) if logs else 0.0, p * prod(q for _, q in scales),
             *(scale for scale, _ in scales))
            for scales, (size, logs, p) in product(_scales(n_sources), constants.WANDERS)
        ]
    )  # fmt: skip
    n, m = len(courses), len(disturbances)
    walk, rate, drive, decay, settling, chances = np.repeat(np.array(courses), m, axis=0).T
    size, keep, weight, *scales = np.tile(disturbances, (n, 1)).T
    prior = chances * weight
    log_prior, index = np.log(prior / prior.sum()), np.tile(np.arange(m), n)
    noise = np.stack(scales, axis=1)
    return Hyperparameters(walk, rate, drive, noise, log_prior, decay, size, keep, settling, index)


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


@dataclass(frozen=True, eq=False)
class FilterBank(Rows):
    """Filters of all hyperparameters that are left, at one log; their weights are kept."""

    hyperparameters: Hyperparameters
    log_weight: FloatArray  # log of prior times evidence so far, ``(n,)``
    # Covariances of the states, and the states as the last row: products with the columns that a
    # prediction or a measurement needs are those of both, ``(n, size + 1, size)``.
    state: FloatArray

    @property
    def mean(self) -> FloatArray:
        """States, shape ``(n, size)``."""
        return self.state[:, -1]

    @property
    def cov(self) -> FloatArray:
        """Covariances of the states, shape ``(n, size, size)``."""
        return self.state[:, :-1]

    def padded(self, size: int) -> Self:
        """Return a bank with a longer state, whose new entries are exactly 0."""
        n, _, own = self.state.shape
        state = np.zeros((n, size + 1, size))
        state[:, :own, :own], state[:, -1, :own] = self.cov, self.mean
        return replace(self, state=state)

    @cached_property
    def weight(self) -> FloatArray:
        """Posterior probability of each filter, shape ``(n,)``."""
        return np.asarray(np.exp(self.log_weight - self.log_evidence))

    @property
    def log_evidence(self) -> float:
        """Log evidence of all logs so far, averaged over the hyperparameters."""
        return float(np.logaddexp.reduce(self.log_weight))

    def log_bayes_factor(self) -> float:
        """Return the log evidence of the changing filters over the healthy ones."""
        healthy, changing = self.hyperparameters.groups
        if not healthy.size or not changing.size:
            return 0.0
        chance = constants.HEALTHY_PROBABILITY
        odds = np.logaddexp.reduce(self.log_weight[changing])
        odds -= np.logaddexp.reduce(self.log_weight[healthy])
        return float(odds) + log(chance) - log1p(-chance)

    def pruned(self) -> Self:
        """Remove filters with a negligible share of their group; both groups stay."""
        keep = np.empty(self.log_weight.size, dtype=bool)
        for group in self.hyperparameters.groups:
            odds = self.log_weight[group]
            keep[group] = odds > odds.max(initial=-np.inf) + _NEGLIGIBLE
        return self if keep.all() else self[keep]

    def collapse(self, size: int | None = None) -> tuple[FloatArray, FloatArray]:
        """Return mean and covariance of the mixture, of the first `size` entries of the state."""
        part = slice(size)
        return mixture(self.weight, self.mean[:, part], self.cov[:, part, part])


@dataclass(frozen=True, slots=True, eq=False)
class Innovation:
    """Innovations of one log, by mean and covariance of the mixture."""

    rows: np.ndarray  # rows of ``[ln f, ln ζ]`` that the log has, ``(n_rows,)``
    mean: FloatArray  # ``(n_rows,)``
    cov: FloatArray  # ``(n_rows, n_rows)``
    standardised: FloatArray  # ``(n_rows,)``
    outlying: FloatArray  # probability that they are outliers, ``(n_rows,)``

    @property
    def kept(self) -> np.ndarray:
        """Indices of those that are more probably no outliers."""
        return np.flatnonzero(self.outlying <= 0.5)

    @property
    def nis(self) -> float:
        """Normalised innovation squared of those that are more probably no outliers."""
        mean, cov, kept = self.mean, self.cov, self.kept
        if kept.size < mean.size:
            mean, cov = mean[kept], cov[kept[:, None], kept]
        return float(mean @ np.linalg.solve(cov, mean))


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """The estimates that one log has, as all filters use them."""

    rows: np.ndarray  # of ``[ln f, ln ζ]`` of all series, ``(n_rows,)``
    values: FloatArray  # ``(n_rows,)``
    matrix: FloatArray  # measurement matrix without steps, ``(n_rows, first_step)``
    cov: FloatArray  # covariance of the errors as stated, ``(n_rows, n_rows)``
    source: np.ndarray  # index of the source of each, ``(n_rows,)``
    extra: FloatArray | None  # variances of unknown covariates, ``(n_rows,)``; None without any


class FilterModel:
    """State space and observations of a history, as the filters use them.

    `observations` has those of each log, `sources` are the sources of the estimates, `mode_of` is
    the index of the mode of each row, ``(2 n_series,)``, and `grid` has the hyperparameters that a
    bank starts with.
    """

    def __init__(self, space: StateSpace) -> None:
        self.space = space
        history = space.history
        self.sources = tuple(dict.fromkeys(one.source for one in history.series))
        self.grid = hyperparameter_grid(len(self.sources))
        self.mode_of = np.tile(history.mode_of(), 2)
        self.observations = self._observations()
        # Covariance of a wander as large as the errors of each mode's first estimate.
        std = np.zeros(space.n_modes)
        for i, mode in enumerate(history.modes):
            variance = np.einsum("kii->ki", history.cov)[:, history.columns(mode)]
            first = variance[np.isfinite(variance)][:1]
            std[i] = np.sqrt(first[0]) if first.size else 0.0
        self.wander_cov = np.outer(std, std) * _correlation(constants.WANDER_COMMON, std.size)
        self.together = _correlation(constants.RATE_COMMON, std.size)
        self.single = np.eye(std.size)
        self.noise, self.noise_shares = self._process_noise()

    def _observations(self) -> list[Observation]:
        """Return the estimates of each log; logs with the same rows are taken at once."""
        history, r = self.space.history, len(self.space.history.series)
        values = np.hstack([history.ln_frequency, history.ln_damping])
        source = np.array([self.sources.index(one.source) for one in history.series] * 2)
        # Variance of ln f due to unknown covariates.
        unknown = sum((one.unknown for one in self.space.regressed), np.zeros(len(values)))
        found: dict[int, Observation] = {}
        patterns, place = np.unique(np.isfinite(values), axis=0, return_inverse=True)
        for i, there in enumerate(patterns):
            rows, logs = np.flatnonzero(there), np.flatnonzero(place.ravel() == i)
            own = values[logs[:, None], rows]
            matrices = self.space.fixed[logs[:, None], rows]
            covs = history.cov[logs[:, None, None], rows[:, None], rows]
            for j, k in enumerate(logs.tolist()):
                extra = np.where(rows < r, unknown[k], 0.0) if unknown[k] else None
                found[k] = Observation(rows, own[j], matrices[j], covs[j], source[rows], extra)
        return [found[k] for k in range(len(values))]

    def matrix(self, k: int) -> FloatArray:
        """Return the measurement matrix of the estimates that log k has, ``(n_rows, size)``."""
        own = self.observations[k]
        return self.space.matrix(k)[own.rows] if self.space.steps else own.matrix

    def _process_noise(self) -> tuple[FloatArray, FloatArray]:
        """Return covariances of the parts of process noise, and their shares in every log.

        They are the random walk of levels, settling, the rates' random walk in levels, between
        levels and rates, and in rates, wander, and the random walk of damping, of unit variance,
        ``(7, (5 n_modes)²)``. The shares, ``(n_logs, 7)``, are of variances per life.
        """
        space, size = self.space, 5 * self.space.n_modes
        level, rate, single = space.level, space.rate, self.single
        parts = np.zeros((7, size, size))
        parts[0, level, level], parts[6, space.damping, space.damping] = single, single
        parts[5, space.wander, space.wander] = self.wander_cov
        for part, row, column in (
            *((1, level, level), (2, level, level), (4, rate, rate)),
            *((3, level, rate), (3, rate, level)),
        ):
            parts[part, row, column] = self.together
        tick, one = space.ticks, np.ones(space.ticks.size)
        shares = [tick, space.settling, tick**3 / 3, tick**2 / 2, tick, one, tick]
        return parts.reshape(7, -1), np.stack(shares, axis=1)

    def with_step(self, step: Step) -> Self:
        """Return the model with one more step."""
        changed = copy(self)
        changed.space = self.space.with_step(step)
        return changed


def initial(model: FilterModel, grid: Hyperparameters | None = None) -> FilterBank:
    """Return the bank before the first log, with all hyperparameters or with those given."""
    grid = model.grid if grid is None else grid
    mean, cov = model.space.prior()
    state = np.tile(np.vstack([cov, mean]), (grid.rate_std.size, 1, 1))
    _add(state, model.space.rate, grid.rate_std**2, model.together)
    _add(state, model.space.wander, grid.wander_variance, model.wander_cov)
    return FilterBank(grid, grid.log_prior.copy(), state)


def predict(model: FilterModel, bank: FilterBank, k: int) -> FilterBank:
    """Predict all filters from the log before to log k, with the steps between."""
    space, own, state = model.space, bank.hyperparameters, bank.state.copy()
    level, rate, base, wander = space.level, space.rate, space.base, space.wander
    if k > 0 and space.seen[k]:
        keep = own.wander_keep[:, None, None]
        state[:, wander] *= keep
        state[:, :, wander] *= keep
        # A level moves by this part of a life times its rate.
        moved = space.ticks[k]
        if own.decays:
            decay = own.rate_decay[:, None, None]
            left = np.exp(-decay * moved)
            moved = np.where(decay > 0, (1 - left) / np.where(decay > 0, decay, 1.0), moved)
        state[:, level] += moved * state[:, rate]
        state[:, :, level] += moved * state[:, :, rate]
        if own.decays:
            state[:, rate] *= left
            state[:, :, rate] *= left
        noise = (own.process_noise * model.noise_shares[k]) @ model.noise
        size = wander.stop
        state[:, :size, :size] += noise.reshape(-1, size, size)
    for j, step in enumerate(space.steps):
        if step.first == k:
            begin_step(space, state, step, j)
    if k in space.history.baselines:
        state[:, base] = state[:, level]
        state[:, :, base] = state[:, :, level]
    return FilterBank(own, bank.log_weight, state)


def begin_step(space: StateSpace, state: FloatArray, step: Step, j: int) -> None:
    """Add the variance of the j-th step of a state space to covariances that the caller owns."""
    jump = space.jump(j)
    variance = np.repeat(np.square(constants.JUMP_STD[step.kind]), space.n_modes)
    own = np.arange(jump.start, jump.stop)
    state[:, own, own] += variance
    if step.changes_modes:
        level, damping = space.level, space.damping
        moved = np.r_[level.start : level.stop, damping.start : damping.stop]
        state[:, own, moved] += variance
        state[:, moved, own] += variance
        state[:, moved, moved] += variance


def update(
    model: FilterModel, bank: FilterBank, k: int, *, outliers: bool = True
) -> tuple[FilterBank, Innovation]:
    """Update filters that are predicted to log k with its estimates; nothing is pruned.

    Where innovations are large, the estimates of a mode or of all modes may be outliers: every
    filter is the mixture of these hypotheses, reduced to its mean and covariance.
    """
    given, rows = model.observations[k], model.observations[k].rows
    if not rows.size:
        return bank, Innovation(rows, np.empty(0), np.empty((0, 0)), np.empty(0), np.empty(0))
    matrix, scales = model.matrix(k), bank.hyperparameters.scales[:, given.source]
    errors = given.cov * (scales[:, :, None] * scales[:, None])
    # One product of all states with the matrix instead of one each. Its last row is the innovation
    # with the opposite sign.
    n, rest, size = bank.state.shape
    crossed = (bank.state.reshape(-1, size) @ matrix.T).reshape(n, rest, -1)
    crossed[:, -1] -= given.values
    total = matrix @ crossed[:, :-1] + errors
    if given.extra is not None:
        diagonal(total)[:] += given.extra
    centre, cov = mixture(bank.weight, -crossed[:, -1], total)
    standardised = centre / np.sqrt(cov.diagonal())
    updated, outlying = _condition(bank, crossed, total), np.zeros(rows.size)
    if outliers and np.abs(standardised).max() > constants.OUTLIER_GATE:
        hypotheses, found = _outliers(model.mode_of[rows], standardised), [updated]
        own = errors.diagonal(axis1=1, axis2=2)
        is_ln_f = rows < len(model.mode_of) // 2
        wide = np.where(is_ln_f, constants.LN_F_STD, constants.LN_ZETA_STD)
        for mask, chance, gross in hypotheses:
            wider = total.copy()
            more = wide**2 if gross else (constants.OUTLIER_SCALE**2 - 1) * own
            diagonal(wider)[:] += np.where(mask, more, 0.0)
            other = _condition(bank, crossed, wider)
            found.append(replace(other, log_weight=other.log_weight + np.log(chance)))
        updated, share = _merged(found)
        masks = np.array([mask for mask, _, _ in hypotheses])
        outlying = np.minimum(updated.weight @ share[:, 1:] @ masks, 1.0)
    return updated, Innovation(rows, centre, cov, standardised, outlying)


def _outliers(mode: np.ndarray, standardised: FloatArray) -> list[tuple[BoolArray, float, bool]]:
    """List hypotheses of outliers: rows, prior probability, and whether they are gross errors.

    They are nested: the mode with the largest innovation, the two largest, up to the whole log,
    which may be that of another machine.
    """
    worst = np.zeros(mode.max() + 1)
    np.maximum.at(worst, mode, np.abs(standardised))
    rank, chance = np.argsort(np.argsort(-worst)), constants.OUTLIER_PROBABILITY
    found: list[tuple[BoolArray, float, bool]] = []
    for i in range(1, np.count_nonzero(worst > constants.OUTLIER_GATE) + 1):
        rows: BoolArray = rank[mode] < i
        share = chance if rows.all() else chance**i
        found += [(rows, share, False), (rows, share, True)]
    return found


def _condition(bank: FilterBank, crossed: FloatArray, total: FloatArray) -> FilterBank:
    """Update filters by innovations of a covariance; `crossed` is that with the state, and they."""
    root = np.linalg.cholesky(total)
    white = np.linalg.inv(root) @ crossed.swapaxes(1, 2)
    # Reductions of covariances, and changes of states with the opposite sign.
    change = white.swapaxes(1, 2) @ white[:, :, :-1]
    nis = np.square(white[:, :, -1]).sum(axis=1)
    log_det = np.log(root.diagonal(axis1=1, axis2=2)).sum(axis=1)
    log_likelihood = -0.5 * (nis + total.shape[1] * np.log(2 * np.pi)) - log_det
    state = np.subtract(bank.state, change, out=change)
    return FilterBank(bank.hyperparameters, bank.log_weight + log_likelihood, state)


def _merged(found: list[FilterBank]) -> tuple[FilterBank, FloatArray]:
    """Reduce hypotheses to one bank; also their probabilities, ``(n, n_hypotheses)``."""
    logs = np.stack([one.log_weight for one in found], axis=1)
    log_weight = np.logaddexp.reduce(logs, axis=1)
    share = np.exp(logs - log_weight[:, None])
    means = np.stack([one.mean for one in found], axis=1)
    state = share[:, 0, None, None] * found[0].state
    for j, one in enumerate(found[1:], start=1):
        state += share[:, j, None, None] * one.state
    merged = replace(found[0], log_weight=log_weight, state=state)
    off = means - merged.mean[:, None]
    merged.cov[:] += (share[:, :, None] * off).swapaxes(1, 2) @ off
    return merged, share


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
    kept, place = np.unique(own.disturbance, return_inverse=True)
    chosen: BoolArray = np.isin(grid.disturbance, kept)
    grid = grid[chosen & (anew | (grid.rate_decay == 0))]
    at = np.searchsorted(kept, grid.disturbance)
    share = np.bincount(place, weights=bank.weight)[at]
    of_kept = np.bincount(at, weights=np.exp(grid.log_prior))[at]
    state = np.empty((at.size, *bank.state.shape[1:]))
    for d, group in product(range(kept.size), (True, False)):
        members = (place == d) & (own.healthy == group)
        mean, cov = bank[members if members.any() else place == d].collapse()
        state[(at == d) & (grid.healthy == group)] = np.vstack([cov, mean])
    # A healthy machine has no rate, whatever its rate was before.
    rates = np.arange(model.space.rate.start, model.space.rate.stop)
    still = np.flatnonzero(grid.rate_std == 0)[:, None]
    state[still, rates] = 0.0
    state[still, :, rates] = 0.0
    _add(state, model.space.rate, grid.rate_std**2, model.together)
    log_weight = grid.log_prior - np.log(of_kept) + np.log(np.maximum(share, 1e-12))
    return FilterBank(grid, log_weight, state)


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


def _add(state: FloatArray, rows: slice, variance: FloatArray, correlation: FloatArray) -> None:
    """Add correlated variances ``(n,)`` to a diagonal block of the covariances of states."""
    state[:, rows, rows] += variance[:, None, None] * correlation
