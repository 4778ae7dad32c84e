"""Published filter: the Kalman filter by `filterpy` whose states are the track.

The filter has the state space of `state_space` and one set of nuisances per log, which the filter
bank selects from the logs up to it: process noise, noise scales and the weight of each estimate.
The rates have a weak prior, so that a drift is not shrunk to zero.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from lmshealth._private.arrays import BoolArray, FloatArray, Rows, freeze
from lmshealth.tracking import constants
from lmshealth.tracking.filters.filter_bank import FilterBank, Innovation
from lmshealth.tracking.filters.state_space import Observation, StateSpace

# Least weight of an estimate: an outlier for certain.
_LEAST_WEIGHT = 1e-10
# Least value of a nuisance that matters, and the factor by which it may differ; the first two do
# not change once a machine has run in. The last is the factor of scales.
_TOLERANCES = (
    ("settling", 1e-8, 1.5), ("running_in", 1e-4, 1.5),
    ("level_walk", 1e-9, 1.5), ("rate_walk", 1e-5, 1.5), ("wander", 0.03, 1.3),
)  # fmt: skip
_MOST_RESCALING = 1.05
# Eigenvalues of correlations below this are rounding.
_SINGULAR = 1e-10


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
    weight[found.rows] = np.maximum(1 - found.outlying, _LEAST_WEIGHT)
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
    from filterpy.kalman import predict, update  # late: it imports scipy.stats, half a second

    move, noise = _transition(space, own, k)
    mean, cov = predict(before.mean, before.cov, F=move, Q=noise)
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
    return Gaussian(*update(mean, cov, given.values, errors, matrix))


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
    return errors if given.extra is None else errors + np.diag(given.extra)


def _transition(space: StateSpace, own: Nuisances, k: int) -> tuple[FloatArray, FloatArray]:
    """Return transition matrix and covariance of the process noise into log k."""
    size = space.wander.stop
    move, noise = np.eye(space.size), np.zeros((space.size, space.size))
    if k == 0:
        noise[space.wander, space.wander] = own.wander * space.wander_cov
    elif space.seen[k]:
        move[space.level, space.rate] = space.ticks[k] * np.eye(space.n_modes)
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
