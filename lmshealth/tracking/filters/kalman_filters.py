"""Kalman filters of one state space: a bank of many hyperparameters, and the one that is published.

Every set of hyperparameters (process noise, scale of reported errors) is a filter of the bank,
weighted by its evidence; all are advanced at once. The sets form two groups: a healthy machine has
no rate and a small random walk, a changing one has a rate.

The states of the published filter, by `filterpy`, are the track. It has one set of nuisances per
log, which the bank selects from the logs up to it: process noise, noise scales and the weight of
each estimate. Its rates have a weak prior, so that a drift is not shrunk to zero. States are
immutable: every function returns a new one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from math import log, log1p
from typing import Self

import numpy as np

from lmshealth._private.arrays import BoolArray, FloatArray, Rows, diagonal, freeze
from lmshealth.tracking import constants
from lmshealth.tracking.filters.state_space import Hyperparameters, Observation, StateSpace

# Sets with less than this share of their group's best are pruned (a test bounds the error).
_NEGLIGIBLE = float(np.log(1e-7))
# Least weight of an estimate: an outlier for certain.
LEAST_WEIGHT = 1e-10
# Least value of a nuisance that matters, and the factor by which it may differ; the first two do
# not change once a machine has run in. The last is the factor of scales.
_TOLERANCES = (
    ("settling", 1e-8, 1.5), ("running_in", 1e-4, 1.5),
    ("level_walk", 1e-9, 1.5), ("rate_walk", 1e-5, 1.5), ("wander", 0.03, 1.3),
)  # fmt: skip
_MOST_RESCALING = 1.05
# Eigenvalues of correlations below this are rounding.
_SINGULAR = 1e-10


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

    def collapse(self) -> tuple[FloatArray, FloatArray]:
        """Return mean and covariance of the mixture."""
        return mixture(self.weight, self.mean, self.cov)


@dataclass(frozen=True, slots=True, eq=False)
class Innovation:
    """Innovations of one log, by mean and covariance of the mixture."""

    rows: np.ndarray  # rows of ``[ln f, ln ζ]`` that the log has, ``(n_rows,)``
    mean: FloatArray  # ``(n_rows,)``
    cov: FloatArray  # ``(n_rows, n_rows)``
    standardised: FloatArray  # ``(n_rows,)``
    outlying: FloatArray  # probability that they are outliers, ``(n_rows,)``

    @property
    def is_outlier(self) -> BoolArray:
        """Whether each is more probably an outlier than not, ``(n_rows,)``."""
        return np.asarray(self.outlying > 0.5)

    @property
    def nis(self) -> float:
        """Normalised innovation squared of those that are more probably no outliers."""
        mean, cov, kept = self.mean, self.cov, np.flatnonzero(~self.is_outlier)
        if kept.size < mean.size:
            mean, cov = mean[kept], cov[kept[:, None], kept]
        return float(mean @ np.linalg.solve(cov, mean))


def initial(space: StateSpace) -> FilterBank:
    """Return the bank before the first log, with all hyperparameters."""
    grid, (mean, cov) = space.grid, space.prior()
    state = np.tile(np.vstack([cov, mean]), (grid.rate_std.size, 1, 1))
    _add(state, space.rate, grid.rate_std**2, space.together)
    _add(state, space.wander, grid.wander_variance, space.wander_cov)
    return FilterBank(grid, grid.log_prior.copy(), state)


def predict(space: StateSpace, bank: FilterBank, k: int) -> FilterBank:
    """Predict all filters from the log before to log k, with the steps between."""
    own, state = bank.hyperparameters, bank.state.copy()
    level, rate, base, wander = space.level, space.rate, space.base, space.wander
    if k > 0 and space.seen[k]:
        keep = own.wander_keep[:, None, None]
        state[:, wander] *= keep
        state[:, :, wander] *= keep
        # A level moves by this part of a life times its rate, which is per life of now.
        state[:, rate] *= space.longer[k]
        state[:, :, rate] *= space.longer[k]
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
        noise = (own.process_noise * space.noise_shares[k]) @ space.noise
        size = wander.stop
        state[:, :size, :size] += noise.reshape(-1, size, size)
    jumps = space.jump_noise(k)
    if jumps is not None:
        state[:, :-1] += jumps
    if k in space.history.baselines:
        state[:, base] = state[:, level]
        state[:, :, base] = state[:, :, level]
    return FilterBank(own, bank.log_weight, state)


def update(
    space: StateSpace, bank: FilterBank, k: int, *, outliers: bool = True
) -> tuple[FilterBank, Innovation]:
    """Update filters that are predicted to log k with its estimates; nothing is pruned.

    Where innovations are large, the estimates of a mode or of all modes may be outliers: every
    filter is the mixture of these hypotheses, reduced to its mean and covariance.
    """
    given, rows = space.observations[k], space.observations[k].rows
    if not rows.size:
        return bank, Innovation(rows, np.empty(0), np.empty((0, 0)), np.empty(0), np.empty(0))
    matrix, scales = space.matrix(k)[rows], bank.hyperparameters.scales[:, given.source]
    errors = given.cov * (scales[:, :, None] * scales[:, None])
    # One product of all states with the matrix instead of one each. Its last row is the innovation
    # with the opposite sign.
    n, rest, size = bank.state.shape
    crossed = (bank.state.reshape(-1, size) @ matrix.T).reshape(n, rest, -1)
    crossed[:, -1] -= given.values
    total = matrix @ crossed[:, :-1] + errors
    if given.extra is not None:
        total += given.extra
    centre, cov = mixture(bank.weight, -crossed[:, -1], total)
    standardised = centre / np.sqrt(cov.diagonal())
    updated, outlying = _condition(bank, crossed, total), np.zeros(rows.size)
    if outliers and np.abs(standardised).max() > constants.OUTLIER_GATE:
        hypotheses, found = _outliers(space.mode_of[rows], standardised), [updated]
        own = errors.diagonal(axis1=1, axis2=2)
        is_ln_f = rows < len(space.mode_of) // 2
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
    nis = np.einsum("gi,gi->g", white[:, :, -1], white[:, :, -1])
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


def advance(space: StateSpace, bank: FilterBank, first: int, last: int) -> FilterBank:
    """Filter the logs from one to another, both included."""
    for k in range(first, last + 1):
        bank = update(space, predict(space, bank, k), k)[0].pruned()
    return bank


def restart(space: StateSpace, bank: FilterBank, *, anew: bool = False) -> FilterBank:
    """Start a regime: keep state, noise scales and wander; process noise has its prior again.

    A baseline and work on the machine start it `anew`: parts then run in.
    """
    grid, own = space.grid, bank.hyperparameters
    kept, place = np.unique(own.disturbance, return_inverse=True)
    chosen: BoolArray = np.isin(grid.disturbance, kept)
    grid = grid[chosen & (anew | (grid.rate_decay == 0))]
    at = np.searchsorted(kept, grid.disturbance)
    share = np.bincount(place, weights=bank.weight)[at]
    # Without running-in the kept filters are fewer: healthy has its prior probability all the same.
    cell, chance = 2 * at + grid.healthy, constants.HEALTHY_PROBABILITY
    prior = np.exp(grid.log_prior)
    prior /= np.bincount(cell, weights=prior)[cell]
    prior *= np.where(grid.healthy, chance, 1 - chance)
    prior /= np.bincount(at, weights=prior)[at]
    state = np.empty((at.size, *bank.state.shape[1:]))
    for d, group in product(range(kept.size), (True, False)):
        members = (place == d) & (own.healthy == group)
        mean, cov = bank[members if members.any() else place == d].collapse()
        state[(at == d) & (grid.healthy == group)] = np.vstack([cov, mean])
    # A healthy machine has no rate, whatever its rate was before.
    rates = np.arange(space.rate.start, space.rate.stop)
    still = np.flatnonzero(grid.rate_std == 0)[:, None]
    state[still, rates] = 0.0
    state[still, :, rates] = 0.0
    _add(state, space.rate, grid.rate_std**2, space.together)
    log_weight = np.log(prior) + np.log(np.maximum(share, 1e-12))
    return FilterBank(grid, log_weight, state)


def mixture(weight: FloatArray, mean: FloatArray, cov: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of a mixture of ``(n, size)`` means and their covariances."""
    centre = weight @ mean
    off = mean - centre
    n = centre.size
    within = (weight @ cov.reshape(-1, n * n)).reshape(n, n)
    return centre, within + (off * weight[:, None]).T @ off


def _add(state: FloatArray, rows: slice, variance: FloatArray, correlation: FloatArray) -> None:
    """Add correlated variances ``(n,)`` to a diagonal block of the covariances of states."""
    state[:, rows, rows] += variance[:, None, None] * correlation


@dataclass(frozen=True, slots=True, eq=False)
class Nuisances(Rows):
    """Settings of the filter at one log; stacked, those of all logs with a leading axis."""

    level_walk: FloatArray  # variance per life of the random walk of ln f
    rate_walk: FloatArray  # variance per life of the random walk of the rate
    settling: FloatArray  # variance of ln f by settling
    running_in: FloatArray  # probability that the machine runs in
    wander: FloatArray  # variance of the wander in variances of the first estimates
    wander_keep: FloatArray  # its correlation with the log before
    scales: FloatArray  # factor on the reported errors of each source, ``(n_sources,)``
    moved: FloatArray  # mean square of the change of ln f since the log before, if it runs in
    # Probability that an estimate is no outlier, 1 where there is none, ``(2 n_series,)``.
    weight: FloatArray
    reopened: BoolArray  # whether rates have their prior again before this log

    @classmethod
    def stacked(cls, logs: Sequence[Self]) -> Self:
        """Return the nuisances of all logs as one object."""
        whole = logs[0].with_each(lambda *own: np.array(own), *logs[1:])
        freeze(whole)
        return whole

    def at(self, log: Self) -> Self:
        """Return these nuisances of the machine with those of a log alone."""
        return replace(self, weight=log.weight, moved=log.moved, reopened=log.reopened)

    def differ(self, other: Self, *, has_run_in: bool) -> bool:
        """Return whether nuisances of the machine differ by more than states depend on them.

        Those of a machine that `has_run_in` differ neither in settling nor in running-in.
        """
        for name, least, factor in _TOLERANCES[2 * has_run_in :]:
            ratio = (getattr(self, name) + least) / (getattr(other, name) + least)
            if not 1 / factor <= ratio <= factor:
                return True
        ratio = self.scales / other.scales
        return bool(ratio.max() > _MOST_RESCALING or ratio.min() < 1 / _MOST_RESCALING)


def select_nuisances(space: StateSpace, bank: FilterBank, found: Innovation, k: int) -> Nuisances:
    """Select the nuisances of log k from the posterior of the bank after it.

    The random walk of ln f and scales are geometric means over the posterior, because those of few
    improbable filters are larger by orders of magnitude; other variances are means, that of the
    random walk of rates over the changing filters. Running-in, by which rates of the bank decay,
    enters as noise of its size.
    """
    own, share, changing = bank.hyperparameters, bank.weight, bank.hyperparameters.groups[1]
    with np.errstate(divide="ignore"):
        walks = np.log(np.column_stack([own.level_walk**2, own.scales]))
    walk, *scales = np.exp(share @ walks)
    size = own.wander_variance
    settling, wander, kept = share @ np.column_stack(
        [own.settling**2, size, size * own.wander_keep]
    )
    # Their weights among themselves: against those of healthy filters they may be 0.
    odds = np.exp(bank.log_weight[changing] - bank.log_weight[changing].max(initial=-np.inf))
    running_in, moved = np.zeros(()), np.zeros(())
    if own.decays:
        decays, rate = np.where(own.rate_decay > 0, share, 0.0), space.rate
        running_in = decays.sum()
        rates = bank.mean[:, rate] ** 2 + np.einsum("gii->gi", bank.cov[:, rate, rate])
        tick = space.ticks[k]
        moved = decays @ rates.mean(axis=1) / max(running_in, 1e-300) * tick**2
    weight = np.ones(space.mode_of.size)
    weight[found.rows] = np.maximum(1 - found.outlying, LEAST_WEIGHT)
    return Nuisances(
        level_walk=walk,
        rate_walk=odds @ own.rate_walk[changing] ** 2 / (odds.sum() or 1.0),
        settling=settling,
        running_in=running_in,
        wander=wander,
        wander_keep=kept / (wander or 1.0),
        scales=np.array(scales),
        moved=moved,
        weight=weight,
        reopened=np.array(False),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Gaussian:
    """Mean and covariance of a state, which may be of a state space with fewer steps."""

    mean: FloatArray  # ``(size,)``
    cov: FloatArray  # ``(size, size)``

    def padded(self, size: int) -> Self:
        """Return a longer state, whose new entries are exactly 0."""
        more = size - self.mean.size
        if not more:
            return self
        return type(self)(np.pad(self.mean, (0, more)), np.pad(self.cov, (0, more)))


def prior(space: StateSpace) -> Gaussian:
    """Return the state before the first log."""
    mean, cov = space.prior()
    rate = space.rate
    cov[rate, rate] += constants.PUBLISHED_RATE_STD**2 * space.together
    return Gaussian(mean, cov)


def filter_log(
    space: StateSpace, before: Gaussian, own: Nuisances, k: int, *, undecided: bool = False
) -> Gaussian:
    """Predict to log k from the state before it, and update with its estimates.

    An outlier may be a step. If that is `undecided`, half of the squared innovation is added to the
    variance of its error and of the quantity: both explanations are within two standard deviations.
    """
    from filterpy import kalman  # late: it imports scipy.stats, half a second

    move, noise = _transition(space, own, k)
    mean, cov = kalman.predict(before.mean, before.cov, F=move, Q=noise)
    given, rows = space.observations[k], space.observations[k].rows
    if not rows.size:
        return Gaussian(mean, cov)
    matrix, errors = space.matrix(k)[rows], _errors(given, own)
    if undecided:
        half = (given.values - matrix @ mean) ** 2 / 2
        half[own.weight[rows] >= 0.5] = 0.0
        first = np.where(rows < len(space.history.series), space.level.start, space.damping.start)
        jump = np.zeros(space.size)
        np.maximum.at(jump, first + space.mode_of[rows], half)
        cov = cov + np.diag(jump)
        errors = _errors(given, replace(own, weight=np.ones_like(own.weight))) + np.diag(half)
    return Gaussian(*kalman.update(mean, cov, given.values, errors, matrix))


def smooth_states(space: StateSpace, nuisances: Nuisances) -> tuple[FloatArray, FloatArray]:
    """Filter and smooth all logs: states ``(n_logs, size)`` and covariances [Rauch1965]."""
    from filterpy.kalman import KalmanFilter  # late, as above

    n, size = len(space.observations), space.size
    means, covs = np.empty((n, size)), np.empty((n, size, size))
    moves, noises = np.empty((n, size, size)), np.empty((n, size, size))
    state = prior(space)
    for k in range(n):
        state = filter_log(space, state, nuisances[k], k)
        means[k], covs[k] = state.mean, state.cov
        moves[k], noises[k] = _transition(space, nuisances[k], k)
    smoother = KalmanFilter(dim_x=size, dim_z=1)
    smoothed = smoother.rts_smoother(means, covs, moves, noises, inv=_inverse)
    return smoothed[0], smoothed[1]


def _errors(given: Observation, own: Nuisances) -> FloatArray:
    """Return the covariance of the errors of the estimates of one log."""
    scale = own.scales[given.source] / np.sqrt(own.weight[given.rows])
    errors: FloatArray = given.cov * (scale[:, None] * scale)
    return errors if given.extra is None else errors + given.extra


def _transition(space: StateSpace, own: Nuisances, k: int) -> tuple[FloatArray, FloatArray]:
    """Return transition matrix and covariance of the process noise into log k."""
    size = space.wander.stop
    move, noise = np.eye(space.size), np.zeros((space.size, space.size))
    if k == 0:
        noise[space.wander, space.wander] = own.wander * space.wander_cov
    elif space.seen[k]:
        rates = space.longer[k] * np.eye(space.n_modes)
        move[space.rate, space.rate], move[space.level, space.rate] = rates, space.ticks[k] * rates
        move[space.wander, space.wander] *= own.wander_keep
        walk, fresh = own.rate_walk, (1 - own.wander_keep**2) * own.wander
        parts = (own.level_walk, own.settling, walk, walk, walk, fresh, constants.DAMPING_WALK**2)
        variances = parts * space.noise_shares[k]
        variances[1] += own.running_in * own.moved
        noise[:size, :size] = (variances @ space.noise).reshape(size, size)
    begun = (step for step in space.steps if step.first == k)
    anew = own.reopened or k in space.history.baselines
    if k and (anew or any(step.kind == "reset" or not step.declared for step in begun)):
        # Since the log before, the rates have their prior again.
        moved = move[:, space.rate]
        noise += constants.PUBLISHED_RATE_STD**2 * moved @ space.together @ moved.T
    jumps = space.jump_noise(k)
    if jumps is not None:
        noise += jumps
    if k in space.history.baselines:
        for part in (move, noise, noise.T):
            part[space.base] = part[space.level]
    return move, noise


def _inverse(cov: FloatArray) -> FloatArray:
    """Invert a covariance where it is not singular.

    An exact copy of ℓ, and steps that are still to come, make it singular. The correlations are
    inverted, because variances of ln ζ are ten orders of magnitude above process noise of ln f.
    """
    std = np.sqrt(np.maximum(np.diag(cov), 0.0))
    scale = np.outer(np.where(std > 0, std, 1.0), np.where(std > 0, std, 1.0))
    return np.asarray(np.linalg.pinv(cov / scale, rcond=_SINGULAR, hermitian=True) / scale)
