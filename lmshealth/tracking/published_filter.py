"""Published filter: one `filterpy` Kalman filter per machine, whose states are the track.

The filter has the state space of `state_space` and one set of nuisances per log, which the filter
bank selects from the logs up to it: process noise, noise scales and the weight of each estimate.
The rates have a weak prior, so that a drift is not shrunk to zero. The state of a log is never
changed by later logs; where a change is adopted, the filter continues from the log before it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from filterpy.kalman import KalmanFilter

from lmshealth._private.arrays import BoolArray, FloatArray, Rows, freeze
from lmshealth.tracking import constants
from lmshealth.tracking.change_detection import N_CHECKPOINTS
from lmshealth.tracking.filter_bank import FilterBank, FilterModel, Innovation, begin_step

# Least weight of an estimate: an outlier for certain.
_LEAST_WEIGHT = 1e-10
# Logs after which no running-in goes on: three times the slowest decay.
_RUN_IN = 3 * max(logs for logs, _ in constants.RUNNING_IN_LOGS)
# Logs that may be filtered again for every new one: bounds the run time.
_REPEATS = 4
# Least value of a nuisance that matters, and the factor by which it may differ.
_TOLERANCES = (
    ("level_walk", 1e-9, 1.5), ("rate_walk", 1e-5, 1.5), ("settling", 1e-8, 1.5),
    ("running_in", 1e-4, 1.5), ("wander", 0.03, 1.3), ("scales", 0.0, 1.05),
)  # fmt: skip
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

    def differ(self, other: Self) -> bool:
        """Return whether nuisances of the machine differ by more than states depend on them."""
        for name, least, factor in _TOLERANCES:
            own, their = (getattr(one, name) + least for one in (self, other))
            if (np.abs(np.log(own / their)) > np.log(factor)).any():
                return True
        return False


def select_nuisances(model: FilterModel, bank: FilterBank, found: Innovation, k: int) -> Nuisances:
    """Select the nuisances of log k from the posterior of the bank after it.

    Random walks and scales are geometric means over the posterior, because those of few improbable
    filters are larger by orders of magnitude; the random walk of rates is that of the changing
    filters. Running-in, by which rates of the bank decay, enters as noise of its size.
    """
    own, share, space = bank.hyperparameters, bank.weight, model.space
    changing = share if own.healthy.all() else np.where(own.healthy, 0.0, share)
    spread = own.wander_variance
    wander = float(share @ spread)
    decays = np.where(own.rate_decay > 0, share, 0.0)
    running_in = decays.sum()
    rates = bank.mean[:, space.rate] ** 2
    rates += np.einsum("gii->gi", bank.cov[:, space.rate, space.rate])
    weight = np.ones(model.values.shape[1])
    weight[found.rows] = np.maximum(1 - found.outlying, _LEAST_WEIGHT)
    return Nuisances(
        level_walk=_geometric(share, own.level_walk**2),
        rate_walk=_geometric(changing / changing.sum(), own.rate_walk**2),
        settling=share @ own.settling**2,
        running_in=running_in,
        wander=np.array(wander),
        wander_keep=share @ (spread * own.wander_keep) / (wander or 1.0),
        scales=_geometric(share, own.scales),
        moved=decays @ rates.mean(axis=1) / max(running_in, 1e-300) * space.ticks[k] ** 2,
        weight=weight,
        reopened=np.array(False),
    )


def _geometric(share: FloatArray, values: FloatArray) -> FloatArray:
    """Return the geometric mean of values, where all are positive or none is."""
    return np.asarray(np.exp(share @ np.log(values)) if values.all() else share @ values)


class PublishedFilter:
    """Kalman filter of one machine, online: a log at a time, or again from an earlier log.

    Attributes
    ----------
    kalman : KalmanFilter
        State ``(size,)`` and covariance ``(size, size)`` after the last log.
    nuisances : list of Nuisances
        Those of each log so far.
    """

    def __init__(self, model: FilterModel) -> None:
        self.model, self.nuisances = model, list[Nuisances]()
        mean, cov = model.space.prior()
        rate = model.space.rate
        cov[rate, rate] += constants.PUBLISHED_RATE_STD**2 * model.together
        self.kalman = KalmanFilter(dim_x=mean.size, dim_z=1)
        self.kalman.x, self.kalman.P = mean, cov
        # States and covariances before each of the last logs.
        self._before: dict[int, tuple[FloatArray, FloatArray]] = {}
        self._first = 0  # log of the regime
        self._credit = 0  # logs that may be filtered again

    def filter(self, nuisances: Nuisances) -> None:
        """Predict to the next log and update with its estimates."""
        k, model, kalman = len(self.nuisances), self.model, self.kalman
        self._before[k] = kalman.x, kalman.P
        self._before.pop(k - N_CHECKPOINTS, None)
        self.nuisances.append(nuisances)
        move, noise = self._transition(k)
        kalman.predict(F=move, Q=noise)
        rows = model.rows[k]
        if rows.size:
            errors = self._errors(k)
            kalman.update(model.values[k, rows], R=errors, H=model.space.matrix(k)[rows])

    def select(self, nuisances: Nuisances) -> None:
        """Filter the next log; all of its regime again if the machine's nuisances have changed.

        They are unknown at first: early logs are filtered again once it is known how much they
        scatter and wander. Checkpoints and a credit bound how far back that reaches. Wear that
        begins later does not revise whether the machine has run in.
        """
        k, since = len(self.nuisances), max(self._first, min(self._before, default=0))
        if k - self._first >= _RUN_IN:
            last = self.nuisances[-1]
            nuisances = replace(nuisances, settling=last.settling, running_in=last.running_in)
        if since < k:
            self._credit = min(self._credit + _REPEATS, N_CHECKPOINTS)
            if k <= since + self._credit and nuisances.differ(self.nuisances[-1]):
                self._credit -= k - since
                for one in self._return_to(since):
                    self.filter(nuisances.at(one))
            nuisances = self.nuisances[-1].at(nuisances)
        self.filter(nuisances)

    def reopen(self, first: int) -> None:
        """Give the rates their prior again before a log, unless they have had it since then."""
        if first in self._before and not any(one.reopened for one in self.nuisances[first:]):
            for one in self._return_to(first):
                opened = np.array(len(self.nuisances) == first)
                self.filter(replace(one, reopened=opened))

    def begin_regime(self, first: int, model: FilterModel) -> None:
        """Continue from the state before a log, with a model that may have one more step."""
        self.model, self._first = model, first
        if first < len(self.nuisances):
            self._return_to(first)

    def _return_to(self, first: int) -> list[Nuisances]:
        """Return to the state before a log; return the nuisances of the logs since then."""
        mean, cov = self._before[first]
        more = self.model.space.size - mean.size
        self.kalman = KalmanFilter(dim_x=mean.size + more, dim_z=1)
        self.kalman.x, self.kalman.P = np.pad(mean, (0, more)), np.pad(cov, (0, more))
        self.nuisances, later = self.nuisances[:first], self.nuisances[first:]
        return later

    def undecided(self) -> tuple[FloatArray, FloatArray]:
        """Return the state where the last log has outliers, any of which may be a step.

        Half of the squared innovation is added to the variance of the error and of the quantity:
        both explanations are within two standard deviations.
        """
        k, model = len(self.nuisances) - 1, self.model
        rows, space = model.rows[k], model.space
        move, noise = self._transition(k)
        trial = KalmanFilter(dim_x=space.size, dim_z=1)
        trial.x, trial.P = self._before[k]
        trial.predict(F=move, Q=noise)
        matrix = space.matrix(k)[rows]
        half = (model.values[k, rows] - matrix @ trial.x) ** 2 / 2
        half[self.nuisances[k].weight[rows] >= 0.5] = 0.0
        first = np.where(rows < len(space.history.series), space.level.start, space.damping.start)
        jump = np.zeros(space.size)
        np.maximum.at(jump, first + model.mode_of[rows], half)
        trial.P = trial.P + np.diag(jump)
        errors = self._errors(k, weighted=False) + np.diag(half)
        trial.update(model.values[k, rows], R=errors, H=matrix)
        return trial.x, trial.P

    def _errors(self, k: int, *, weighted: bool = True) -> FloatArray:
        """Return the covariance of the errors of the estimates of log k."""
        model, own, rows = self.model, self.nuisances[k], self.model.rows[k]
        scale = own.scales[model.scale_of[rows]]
        if weighted:
            scale = scale / np.sqrt(own.weight[rows])
        errors: FloatArray = model.space.history.cov[k][rows[:, None], rows]
        errors *= scale[:, None] * scale
        if model.unknown[k]:
            errors += np.diag(model.extra[k, rows])
        return errors

    def _transition(self, k: int) -> tuple[FloatArray, FloatArray]:
        """Return transition matrix and covariance of the process noise into log k."""
        model, own, space = self.model, self.nuisances[k], self.model.space
        move, noise = np.eye(space.size), np.zeros((space.size, space.size))
        tick, wander = space.ticks[k], space.wander
        if k == 0:
            noise[wander, wander] = own.wander * model.wander_cov
        elif space.seen[k]:
            move[space.level, space.rate] = tick * np.eye(space.n_modes)
            move[wander, wander] *= own.wander_keep
            drive = own.rate_walk * np.array([tick**3 / 3, tick**2 / 2, tick])
            settling = own.settling * space.settling[k] + own.running_in * own.moved
            fresh, damping = (1 - own.wander_keep**2) * own.wander, constants.DAMPING_WALK**2 * tick
            variances = np.array([own.level_walk * tick, settling, *drive, fresh, damping])
            size = wander.stop
            noise[:size, :size] = (variances @ model.noise).reshape(size, size)
        begun = [(j, step) for j, step in enumerate(space.steps) if step.first == k]
        if k and (own.reopened or any(s.kind == "reset" or not s.declared for _, s in begun)):
            # Since the log before, the rates have their prior again.
            moved = move[:, space.rate]
            noise += constants.PUBLISHED_RATE_STD**2 * moved @ model.together @ moved.T
        for j, step in begun:
            begin_step(space, noise[None], step, j)
        if k in space.history.baselines:
            for part in (move, noise, noise.T):
                part[space.base] = part[space.level]
        return move, noise

    def smooth(self, nuisances: Sequence[Nuisances]) -> tuple[FloatArray, FloatArray]:
        """Filter and smooth all logs: states ``(n_logs, size)`` and covariances [Rauch1965]."""
        n, size = len(nuisances), self.model.space.size
        means, covs = np.empty((n, size)), np.empty((n, size, size))
        moves, noises = np.empty((n, size, size)), np.empty((n, size, size))
        for k, one in enumerate(nuisances):
            self.filter(one)
            means[k], covs[k] = self.kalman.x, self.kalman.P
            moves[k], noises[k] = self._transition(k)
        smoothed = self.kalman.rts_smoother(means, covs, moves, noises, inv=_inverse)
        return smoothed[0], smoothed[1]


def _inverse(cov: FloatArray) -> FloatArray:
    """Invert a covariance where it is not singular.

    An exact copy of ℓ, and steps that are still to come, make it singular. The correlations are
    inverted, because variances of ln ζ are ten orders of magnitude above process noise of ln f.
    """
    std = np.sqrt(np.maximum(np.diag(cov), 0.0))
    scale = np.outer(np.where(std > 0, std, 1.0), np.where(std > 0, std, 1.0))
    return np.asarray(np.linalg.pinv(cov / scale, rcond=_SINGULAR, hermitian=True) / scale)
