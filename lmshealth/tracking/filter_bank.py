"""A bank of Kalman filters: one state space under many settings, all advanced at once.

How much a mode wanders by itself, and by what factor the reported standard deviations are wrong, is
not known. Every setting is a filter of its own, weighted by its evidence so far: maximising the
evidence instead collapses to no wandering and makes the tracker overconfident. Settings that the
data have ruled out are dropped on the way, so that long histories cost no more than a few filters.

A setting belongs to one of two groups: a machine that is healthy has no rate and wanders little,
one that is changing has a rate. The evidence of one group over the other is what an alarm stands
on.
"""

from __future__ import annotations

from collections.abc import Collection
from copy import copy
from dataclasses import dataclass, fields
from itertools import product
from math import prod

import numpy as np

from lmshealth._arrays import BoolArray, FloatArray
from lmshealth.tracking.constants import DAMPING_WALK, JUMP_STD, LN_F_STD, LN_ZETA_STD
from lmshealth.tracking.history import Step
from lmshealth.tracking.state_space import StateSpace

# Random walk of ln f per life of a healthy machine, and of one that changes with its rate per life
# and with how far the rate wanders in a life.
_HEALTHY_WALKS = (1e-5, 3e-4, 1e-3)
_WALKS = (1e-5, 1e-3, 3e-3, 1e-2)
_RATES = ((0.03, 0.01), (0.03, 0.1), (0.3, 0.1), (0.3, 1.0), (1.0, 3.0))
HEALTHY_PRIOR = 0.1
# Factors on the standard deviations of one source. Where several sources are in a history the more
# seldom ones are given fewer.
_SCALES = ((0.5, 0.02), (0.7, 0.05), (1.0, 0.8), (1.5, 0.08), (2.25, 0.03), (4.0, 0.02))
_MOST_SCALED = 3
# Share of logs that hold an outlier.
_OUTLIERS = 0.01
# A setting that has less than this share of its group's best is dropped.
_NEGLIGIBLE = float(np.log(1e-5))


@dataclass(frozen=True, slots=True, eq=False)
class Settings:
    """What each filter believes of the machine.

    Attributes
    ----------
    level_walk : ndarray
        Standard deviation of what ln f wanders in a life, shape ``(n,)``.
    rate_std : ndarray
        Of the rate of ln f per life; 0 for a healthy machine, shape ``(n,)``.
    rate_walk : ndarray
        Standard deviation of what the rate wanders in a life, shape ``(n,)``.
    scales : ndarray
        Factor on the standard deviations of each source, shape ``(n, n_sources)``.
    log_prior : ndarray
        Log of the prior probability, shape ``(n,)``.
    """

    level_walk: FloatArray
    rate_std: FloatArray
    rate_walk: FloatArray
    scales: FloatArray
    log_prior: FloatArray

    @property
    def healthy(self) -> BoolArray:
        """Which of them have no rate, shape ``(n,)``."""
        return np.asarray(self.rate_std == 0)

    def only(self, keep: np.ndarray) -> Settings:
        """Take some of them, by index or mask."""
        return Settings(*(getattr(self, one.name)[keep] for one in fields(self)))


def settings(n_sources: int) -> Settings:
    """Make the grid that is averaged over, for so many sources."""
    scaled = min(n_sources, _MOST_SCALED)
    healthy = [(walk, 0.0, 0.0, HEALTHY_PRIOR / len(_HEALTHY_WALKS)) for walk in _HEALTHY_WALKS]
    share = (1 - HEALTHY_PRIOR) / (len(_WALKS) * len(_RATES))
    changing = [(walk, rate, bend, share) for walk in _WALKS for rate, bend in _RATES]
    rows = []
    for (walk, rate, bend, weight), choice in product(
        healthy + changing, product(_SCALES, repeat=scaled)
    ):
        # Sources past the third share the factor of the third.
        scales = [scale for scale, _ in choice] + [choice[-1][0]] * (n_sources - scaled)
        rows.append((walk, rate, bend, weight * prod(chance for _, chance in choice), *scales))
    table = np.array(rows)
    return Settings(table[:, 0], table[:, 1], table[:, 2], table[:, 4:], np.log(table[:, 3]))


@dataclass(slots=True, eq=False)
class Bank:
    """Filters of all settings that are left, at one log; they are advanced in place.

    Attributes
    ----------
    settings : Settings
        One per filter.
    log_weight : ndarray
        Log of prior times evidence so far, shape ``(n_settings,)``.
    mean : ndarray
        States, shape ``(n_settings, size)``.
    cov : ndarray
        Their covariances, shape ``(n_settings, size, size)``.
    """

    settings: Settings
    log_weight: FloatArray
    mean: FloatArray
    cov: FloatArray

    def copy(self) -> Bank:
        """Give a bank that can be advanced without touching this one."""
        return Bank(self.settings, self.log_weight.copy(), self.mean.copy(), self.cov.copy())

    def only(self, keep: np.ndarray) -> Bank:
        """Keep some of the filters, by index or mask."""
        return Bank(
            self.settings.only(keep), self.log_weight[keep], self.mean[keep], self.cov[keep]
        )

    def padded(self, size: int) -> Bank:
        """Give a copy with a longer state, whose new entries are known to be 0."""
        more = size - self.mean.shape[1]
        return Bank(
            self.settings,
            self.log_weight.copy(),
            np.pad(self.mean, ((0, 0), (0, more))),
            np.pad(self.cov, ((0, 0), (0, more), (0, more))),
        )

    @property
    def weight(self) -> FloatArray:
        """Posterior probability of each setting, shape ``(n_settings,)``."""
        return np.asarray(np.exp(self.log_weight - self.log_evidence))

    @property
    def log_evidence(self) -> float:
        """Log of the evidence of all logs so far, averaged over the settings."""
        return float(np.logaddexp.reduce(self.log_weight))

    def log_bayes_factor(self) -> float:
        """Log evidence of the changing settings over the healthy ones."""
        healthy = self.settings.healthy
        if healthy.all() or not healthy.any():
            return 0.0
        prior = np.log(HEALTHY_PRIOR) - np.log1p(-HEALTHY_PRIOR)
        odds = np.logaddexp.reduce(self.log_weight[~healthy])
        return float(odds - np.logaddexp.reduce(self.log_weight[healthy]) + prior)

    def pruned(self) -> Bank:
        """Drop what carries next to nothing of its group; both groups stay."""
        group = self.settings.healthy.astype(int)
        best = np.full(2, -np.inf)
        np.maximum.at(best, group, self.log_weight)
        keep = self.log_weight > best[group] + _NEGLIGIBLE
        return self if keep.all() else self.only(keep)

    def collapse(self, size: int | None = None) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance over all settings, of the first so many entries of the state."""
        part = slice(size)
        return _mixture(self.weight, self.mean[:, part], self.cov[:, part, part])


@dataclass(frozen=True, slots=True, eq=False)
class Surprise:
    """What one log brought that was not expected.

    Attributes
    ----------
    rows : ndarray of int
        Rows of ``[ln f, ln ζ]`` that the log has, without those taken for outliers.
    innovation : ndarray
        Standardised by its mean and variance over all settings, shape ``(n_rows,)``.
    nis : float
        Normalised innovation squared, by mean and covariance over all settings.
    """

    rows: np.ndarray
    innovation: FloatArray
    nis: float


class Filter:
    """Advances a bank over the logs of a history.

    Parameters
    ----------
    space : StateSpace
        The state and how logs see it.
    copies : collection of int
        Logs at which a baseline begins.
    reopened : collection of int
        Logs before which rates are unknown anew.
    """

    def __init__(
        self, space: StateSpace, copies: Collection[int], reopened: Collection[int] = ()
    ) -> None:
        self.space, self.copies, self.reopened = space, frozenset(copies), frozenset(reopened)
        history = space.history
        self.values = np.hstack([history.ln_frequency, history.ln_damping])
        self.there = np.isfinite(self.values)
        self.whole: BoolArray = np.asarray(self.there.all(axis=1))
        self.all = np.arange(self.values.shape[1])
        self.sources = tuple(dict.fromkeys(one.source for one in history.series))
        place = [self.sources.index(one.source) for one in history.series]
        self.scale_of = np.array(place + place, dtype=int)
        self.grid = settings(len(self.sources))
        self.noise = history.cov
        self.anywhere = np.repeat(np.square([LN_F_STD, LN_ZETA_STD]), len(history.series))
        self.extra = np.zeros((len(history.logs), 2 * len(history.series)))
        self.extra[:, : len(history.series)] = space.unknown()[:, None]

    def with_step(self, step: Step) -> Filter:
        """Give the same for a state space with one more step."""
        changed = copy(self)
        changed.space = self.space.with_step(step)
        return changed

    def start(self) -> Bank:
        """Begin before the first log, with all settings."""
        grid = self.grid
        n = grid.rate_std.size
        mean, cov = self.space.prior()
        bank = Bank(grid, grid.log_prior.copy(), np.tile(mean, (n, 1)), np.tile(cov, (n, 1, 1)))
        self.open_rates(bank)
        return bank

    def open_rates(self, bank: Bank) -> None:
        """Let every changing setting have a rate anew."""
        _diagonal(bank.cov, self.space.rate)[:] += bank.settings.rate_std[:, None] ** 2

    def begin(self, bank: Bank, step: Step, j: int) -> None:
        """Let a step happen now; it is the j-th of the state space."""
        space, m, jump = self.space, self.space.n_modes, self.space.jump(j)
        variance = np.repeat(np.square(JUMP_STD[step.kind]), m)
        own = np.arange(jump.start, jump.stop)
        bank.cov[:, own, own] += variance
        if step.changes_modes:
            level, damping = space.level, space.damping
            moved = np.r_[level.start : level.stop, damping.start : damping.stop]
            bank.cov[:, own, moved] += variance
            bank.cov[:, moved, own] += variance
            bank.cov[:, moved, moved] += variance

    def move(self, bank: Bank, k: int) -> None:
        """Take all states from the log before to log k, over whatever happens between."""
        space, tick = self.space, float(self.space.ticks[k])
        level, rate = space.level, space.rate
        mean, cov = bank.mean, bank.cov
        if k in self.reopened:
            self.open_rates(bank)
        if tick > 0:
            mean[:, level] += tick * mean[:, rate]
            cov[:, level, :] += tick * cov[:, rate, :]
            cov[:, :, level] += tick * cov[:, :, rate]
            own = bank.settings.level_walk[:, None] ** 2
            bend = bank.settings.rate_walk[:, None] ** 2
            _diagonal(cov, level)[:] += own * tick + bend * tick**3 / 3
            _diagonal(cov, level, rate)[:] += bend * tick**2 / 2
            _diagonal(cov, rate, level)[:] += bend * tick**2 / 2
            _diagonal(cov, rate)[:] += bend * tick
            _diagonal(cov, space.damping)[:] += DAMPING_WALK**2 * tick
        for number, step in enumerate(space.steps):
            if step.first == k:
                self.begin(bank, step, number)
        if k in self.copies:
            level, base = space.level, space.base
            mean[:, base] = mean[:, level]
            cov[:, base, :] = cov[:, level, :]
            cov[:, :, base] = cov[:, :, level]

    def see(self, bank: Bank, k: int, doubted: np.ndarray | None = None) -> Surprise:
        """Let all states see log k: the rows that exist, with their own covariance.

        Rows that are doubted, ``(2 n_series,)``, are taken for outliers: hardly believed.
        """
        rows: np.ndarray = self.all if self.whole[k] else np.flatnonzero(self.there[k])
        matrix, value = self.space.matrix(k)[rows], self.values[k, rows]
        if value.size == 0:
            return Surprise(np.array([], dtype=int), np.array([]), 0.0)
        scales = bank.settings.scales[:, self.scale_of[rows]]
        noise = self.noise[k] if self.whole[k] else self.noise[k][np.ix_(rows, rows)]
        n, size = bank.mean.shape
        # One product of all states with the matrix instead of one each.
        crossed = (bank.cov.reshape(-1, size) @ matrix.T).reshape(n, size, -1)
        spread = matrix @ crossed + noise * scales[:, :, None] * scales[:, None, :]
        i = self.all[: value.size]
        spread[:, i, i] += self.extra[k, rows]
        if doubted is not None:
            outlying = np.flatnonzero(doubted[rows])
            # It may lie anywhere, and so tells none of the settings from another.
            spread[:, outlying, outlying] += self.anywhere[rows[outlying]]
            bank.log_weight += np.log(_OUTLIERS)
        root = np.linalg.cholesky(spread)
        half = np.linalg.inv(root)
        off = value - bank.mean @ matrix.T
        white = (half @ off[:, :, None])[:, :, 0]
        gain = half @ np.swapaxes(crossed, 1, 2)
        nis = np.square(white).sum(axis=1)
        weight = bank.weight
        bank.mean += (white[:, None, :] @ gain)[:, 0, :]
        bank.cov -= np.swapaxes(gain, 1, 2) @ gain
        log_det = np.log(root[:, i, i]).sum(axis=1)
        bank.log_weight += -0.5 * nis - log_det - 0.5 * value.size * np.log(2 * np.pi)
        return _surprise(rows, weight, off, spread, doubted)

    def advance(self, bank: Bank, first: int, last: int) -> Bank:
        """Take a bank over the logs from one to another, both included; it is used up."""
        for k in range(first, last + 1):
            self.move(bank, k)
            self.see(bank, k)
            bank = bank.pruned()
        return bank


def _mixture(
    weight: FloatArray, mean: FloatArray, cov: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of a mixture of ``(n, size)`` means and ``(n, size, size)`` ones."""
    centre = weight @ mean
    off = mean - centre
    n = centre.size
    within = (weight @ cov.reshape(-1, n * n)).reshape(n, n)
    return centre, within + (off * weight[:, None]).T @ off


def _surprise(
    rows: np.ndarray,
    weight: FloatArray,
    off: FloatArray,
    spread: FloatArray,
    doubted: np.ndarray | None,
) -> Surprise:
    """Judge innovations by their mean and covariance over all settings, without outliers."""
    centre, cov = _mixture(weight, off, spread)
    if doubted is not None:
        kept = np.flatnonzero(~doubted[rows])
        rows, centre, cov = rows[kept], centre[kept], cov[np.ix_(kept, kept)]
    nis = float(centre @ np.linalg.solve(cov, centre))
    return Surprise(rows, centre / np.sqrt(cov.diagonal()), nis)


def _diagonal(cov: FloatArray, rows: slice, columns: slice | None = None) -> FloatArray:
    """Give the diagonals of a block of matrices as a view to write to, ``(n, n_modes)``."""
    size, other = cov.shape[1], rows if columns is None else columns
    first = rows.start * size + other.start
    # Along a diagonal a matrix in a row steps by its size and one.
    return cov.reshape(-1, size * size)[:, first :: size + 1][:, : rows.stop - rows.start]
