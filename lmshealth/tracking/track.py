"""Track: Kalman filtering of all modes over a machine's life, with steps and alarms.

All modes share one state space, because their estimates may be correlated, and one bank of filters.
Declared steps are in the model from the start; a detected step is added, and the logs from it on
are filtered again from the checkpoint before it. No epoch uses later logs; `smoother.smooth` does.
"""

from dataclasses import dataclass, replace
from datetime import datetime
from typing import Any, Literal

import numpy as np
from scipy import stats

from lmshealth._private.arrays import BoolArray, FloatArray, freeze
from lmshealth._private.result import Result
from lmshealth._private.tables import TABLES
from lmshealth.errors import NotEnoughData
from lmshealth.io.log import Refusal
from lmshealth.modal.credibility import dependence
from lmshealth.stage.description import Stage
from lmshealth.tracking import constants
from lmshealth.tracking.change_detection import (
    N_CHECKPOINTS,
    ChangeHypothesis,
    add_to_sums,
    recent_loop_change,
    threshold,
    unexplained_loop_changes,
    weigh_changes,
    worst_window,
)
from lmshealth.tracking.filter_bank import (
    FilterBank,
    FilterModel,
    initial,
    predict,
    restart,
    update,
)
from lmshealth.tracking.history import History, Step
from lmshealth.tracking.published_filter import Nuisances, PublishedFilter, select_nuisances
from lmshealth.tracking.state_space import StateSpace

EventKind = Literal["step", "regreasing", "servo", "sensor", "alarm"]

# Variance of a drift below which it is rounding.
_ROUNDING = 1e-15


@dataclass(frozen=True, slots=True)
class Effect:
    """Coefficient of ln f that is no wear: one row of ``effects.csv``.

    ``covariate`` is the name of a covariate, ``bias:<source>``, ``servo:<id>``, ``sensor:<date>``,
    or ``scale:<source>`` for the factor on the standard deviations of a source (then `mode` is
    empty).
    """

    mode: str
    covariate: str
    coefficient: float
    std: float


@dataclass(frozen=True, slots=True)
class Event:
    """Step or alarm, as one mode shows it: one row of ``events.csv``.

    An alarm is an unexplained change of the modes since the baseline, at the declared false-alarm
    probability.
    """

    kind: EventKind
    epoch: int  # first log after a step; of an alarm, the log at which it is raised
    mode: str
    source: str  # the sensor's; else empty
    size: float  # change of ln f, of a regreasing change of ln ζ, of an alarm the drift
    std: float
    evidence: float  # log Bayes factor against no event, with the prior of an unknown place
    declared: bool  # whether maintenance or the log's ``servo_id`` declared it
    found_at: int  # the log after which it was detected


@dataclass(frozen=True, slots=True)
class Consistency:
    """Tests of a filter's innovations, with two-sided p-values."""

    nis: float  # sum of the normalised innovations squared over their degrees of freedom
    p_value: float  # of that sum under χ²
    # Of standardised innovations of one series from one log to the next, all series together.
    autocorrelation: float
    autocorrelation_p_value: float  # if they were independent

    @property
    def holds(self) -> bool:
        """Whether neither test rejects the filter."""
        bounds = (constants.CAUTIOUS_P_VALUE, constants.OVERCONFIDENT_P_VALUE)
        least = bounds[self.autocorrelation > 0]
        return self.p_value >= bounds[self.nis > 1] and self.autocorrelation_p_value >= least

    @property
    def side(self) -> Literal["below", "inside", "above"]:
        """Position of the sum relative to its 95 % band under a consistent filter."""
        if self.p_value >= constants.NIS_P_VALUE:
            return "inside"
        return "above" if self.nis > 1 else "below"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Track(Result):
    """Filtered modes of a machine over its life: no epoch uses later logs."""

    stage: str  # identity of the machine
    logs: tuple[str, ...]  # their names, an epoch each
    recorded_at: tuple[datetime, ...]  # never decreasing
    travel: FloatArray  # odometer in m, ``(n_epochs,)``; NaN throughout where there is none
    modes: tuple[str, ...]
    sources: tuple[str, ...]  # of the estimates
    # ln of Hz and ln ζ, covariates at their reference, ``(n_epochs, n_modes)``; NaN before the
    # first estimate of a mode.
    ln_frequency: FloatArray
    ln_frequency_std: FloatArray
    ln_damping: FloatArray
    ln_damping_std: FloatArray
    drift: FloatArray  # ln f minus its value at the baseline before it, ``(n_epochs, n_modes)``
    drift_cov: FloatArray  # between the modes of one epoch, ``(n_epochs, n_modes, n_modes)``
    effects: tuple[Effect, ...]  # after the last epoch
    events: tuple[Event, ...]  # steps and alarms, in order
    steps: tuple[Step, ...]  # declared and detected ones
    outliers: tuple[tuple[int, str], ...]  # epochs and modes that no later log confirmed
    # Normalised innovation squared, ``(n_epochs,)``, of the last time that a log was filtered, and
    # its degrees of freedom: none of outliers, and of the first estimate of a mode.
    nis: FloatArray
    nis_dof: FloatArray
    innovations: FloatArray  # standardised, of ``[ln f, ln ζ]``, ``(n_epochs, 2 n_series)``
    # Factor on the reported standard deviations of each source, ``(n_epochs, n_sources)``, by the
    # innovations, and on all published ones where innovations are inconsistent, ``(n_epochs,)``.
    noise_scale: FloatArray
    widening: FloatArray
    # Of the published filter, at every epoch; None of a track that was not filtered here.
    nuisances: Nuisances | None = None

    def __post_init__(self) -> None:
        n, m = len(self.logs), len(self.modes)
        freeze(
            self,
            ("ln_frequency ln_frequency_std ln_damping ln_damping_std drift", n, m),
            ("drift_cov", n, m, m),
            ("noise_scale", n, len(self.sources)),
            ("innovations", n, self.innovations.shape[1]),
            ("travel nis nis_dof widening", n),
        )

    def title(self) -> str:
        """Return machine, number of epochs and events, and the last epoch."""
        last = f"; modes at {self.recorded_at[-1].date()}" if self.recorded_at else ""
        events = f"{len(self.steps)} steps, {len(self.alarms)} alarms"
        return f"Track of {self.stage}: {len(self.logs)} epochs, {events}{last}"

    @property
    def drift_std(self) -> FloatArray:
        """Standard deviation of the drift, shape ``(n_epochs, n_modes)``."""
        return np.asarray(np.sqrt(np.einsum("kii->ki", self.drift_cov)))

    def to_columns(self) -> dict[str, Any]:
        """Return the columns of ``track.csv``, one row per epoch and mode."""
        n, m = len(self.logs), len(self.modes)
        scale = self.noise_scale.max(axis=1, initial=0.0)
        return TABLES["track"].row(
            np.repeat(self.stage, n * m),
            np.repeat([moment.isoformat() for moment in self.recorded_at], m),
            np.repeat(self.travel / 1000, m),
            np.tile(self.modes, n),
            *mode_columns(self).values(),
            *(np.repeat(own, m) for own in (self.nis, self.nis_dof, scale, self.widening)),
        )

    def digest_columns(self) -> dict[str, Any]:
        """Return the modes at the last epoch."""
        names = ("mode", *mode_columns(self))
        return {name: self.to_columns()[name][-len(self.modes) :] for name in names}

    @property
    def alarms(self) -> tuple[Event, ...]:
        """Damage alarms."""
        return tuple(event for event in self.events if event.kind == "alarm")

    def consistency(self) -> Consistency:
        """Test the filter by its innovations."""
        return consistency(self.nis, self.nis_dof, self.innovations)


def mode_columns(values: Any) -> dict[str, FloatArray]:
    """Return the columns of modes of a track, filtered or smoothed, one row per epoch and mode."""
    frequency, damping = np.exp(values.ln_frequency), np.exp(values.ln_damping)
    columns = {
        "frequency_hz": frequency,
        "frequency_std_hz": frequency * values.ln_frequency_std,
        "damping_ratio": damping,
        "damping_ratio_std": damping * values.ln_damping_std,
        "drift": values.drift,
        "drift_std": values.drift_std,
    }
    return {name: own.ravel() for name, own in columns.items()}


def lagged_products(innovations: FloatArray) -> tuple[FloatArray, np.ndarray]:
    """Multiply innovations by those of the log before: their sum over each log and their number.

    Series of one log may have common errors: only sums over different logs are independent.
    """
    products = np.full_like(innovations, np.nan)
    products[1:] = innovations[1:] * innovations[:-1]
    there = np.isfinite(products)
    return np.where(there, products, 0.0).sum(axis=1), there.sum(axis=1)


def consistency(nis: FloatArray, dof: FloatArray, innovations: FloatArray) -> Consistency:
    """Test innovations by their sum of squares and their autocorrelation [BarShalom2001, 5.4].

    `nis` and `dof` have the shape ``(n_epochs,)``, standardised innovations ``(n_epochs, n)``, NaN
    where there is none.
    """
    judged = dof > 0
    total, degrees = float(nis[judged].sum()), float(dof[judged].sum())
    tail = stats.chi2.sf(total, degrees) if degrees else 0.5
    sums, counts = lagged_products(innovations)
    n = int(counts.sum())
    scale = float(np.sqrt(np.sum(sums**2)))
    size = float(np.mean(innovations[np.isfinite(innovations)] ** 2)) if n else 1.0
    correlation = float(sums.sum()) / n / max(size, 1e-12) if n else 0.0
    return Consistency(
        nis=total / degrees if degrees else 1.0,
        p_value=float(2 * min(tail, 1 - tail)),
        autocorrelation=correlation,
        autocorrelation_p_value=float(2 * stats.norm.sf(abs(sums.sum()) / scale)) if scale else 1.0,
    )


def track(history: History, stage: Stage | None = None) -> Track:
    """Track the modes of a history by a bank of Kalman filters.

    Parameters
    ----------
    history : History
        Modal estimates with covariance; missing ones are NaN.
    stage : Stage, optional
        Its covariates are regressed out, and rates are per its horizon. Without it every covariate
        present is, about its median, and rates are per length of the history.

    Returns
    -------
    Track
        Filtered: no epoch uses later logs.

    Raises
    ------
    NotEnoughData
        If there is no estimate at all.

    References
    ----------
    BarShalom2001.

    Examples
    --------
    How far have the modes of a simulated machine drifted?

    >>> import numpy as np
    >>> import lmshealth
    >>> from lmshealth import examples
    >>> track = lmshealth.track(examples.history(), lmshealth.load_stage("lms-y"))
    >>> std = np.sqrt(np.diag(track.drift_cov[-1]))
    >>> for mode, drift, off in zip(track.modes, track.drift[-1], std):
    ...     print(f"{mode}: {drift:.1%} ± {off:.1%}")
    roll: -6.0% ± 0.4%
    pitch: -5.7% ± 0.3%
    yaw: -6.1% ± 0.3%
    >>> [(event.kind, f"{track.recorded_at[event.epoch]:%d %B}") for event in track.events]
    [('alarm', '05 April')]
    """
    if not np.isfinite(history.ln_frequency).any():
        raise NotEnoughData(
            f"{history.stage}: no modal estimate in {len(history.logs)} logs is of a known mode; "
            "a mode without a name is known once three logs show it"
        )
    return _Tracker(FilterModel(StateSpace(history, stage, history.steps))).run()


class _Tracker:
    """Filters a history log by log and filters again from a checkpoint where a step is detected.

    A regime begins at a reset and at a detected step: the state continues, the process noise has
    its prior again, and changes before the regime are not weighed again.
    """

    def __init__(self, model: FilterModel) -> None:
        self.model, self.history = model, model.space.history
        self.resets = {step.first for step in self.history.steps if step.kind == "reset"}
        self.bank, self.published = initial(model), PublishedFilter(model)
        # Banks after each of the last logs of the regime, and the first log of its windows.
        self.checkpoints: dict[int, FilterBank] = {}
        self.first = 1
        n, n_rows = model.values.shape
        size = self.size = 4 * len(self.history.modes)
        # Of each log: NIS and innovations without outliers, rows of outliers, running sums.
        self.nis, self.innovations = np.zeros(n), np.full((n, n_rows), np.nan)
        self.outlying: dict[int, tuple[int, ...]] = {}
        self.sums = np.zeros((n + 1, 2, n_rows + 2))
        # Published: mean, variance, covariance of drifts, noise scales; factor on standard
        # deviations of the first logs, which later ones do not change any more.
        self.mean, self.variance = np.empty((n, size)), np.empty((n, size))
        self.drift_cov = np.empty((n, size // 4, size // 4))
        self.noise_scale = np.empty((n, len(model.sources)))
        self.widening = np.empty(0)
        self.loop_changes = unexplained_loop_changes(self.history.loop_error, model.space.steps)
        # Detected changes by the number of their step, with the log that detected them.
        self.changes: dict[int, tuple[ChangeHypothesis, int]] = {}
        self.alarms: list[Event] = []
        self.alarmed = False
        # A significant change whose kind is not settled, and the last suspicion that was weighed.
        self.open: ChangeHypothesis | None = None
        self.weighed = (-1, -1)

    def run(self) -> Track:
        """Filter all logs."""
        for k in range(len(self.history.logs)):
            if k in self.resets and k:
                self._begin_regime(self.bank, k, anew=True)
                self.published.begin_regime(k, self.model)
                self.alarmed = False
            self._filter(k)
            self._detect(k, *worst_window(self.sums[: k + 2], self.first))
            window, size = worst_window(self.sums[: k + 2], self.first)
            # An older rate may hold no more, unless it is an outlier that deviates.
            if size > constants.BEGUN_GATE and not any(j >= window for j in self.outlying):
                self.published.reopen(window)
            self._publish(k)
        return self._track()

    def _begin_regime(self, bank: FilterBank, first: int, *, anew: bool = False) -> None:
        """Continue from a bank; evidence before the regime is not comparable."""
        self.bank, self.first = restart(self.model, bank, anew=anew), first
        self.checkpoints = {}

    def _filter(self, k: int) -> None:
        """Filter log k, for the first time or again.

        What is outlying in three logs in a row has changed, by more than any prior allows for.
        """
        recent = [self.outlying.get(k - j, ()) for j in (1, 2, 3)]
        stays = bool(set(recent[0]).intersection(*recent[1:]))
        predicted = predict(self.model, self.bank, k)
        bank, found = update(self.model, predicted, k, outliers=not stays)
        most = constants.MOST_INNOVATION
        innovation = found.standardised.clip(-most, most)
        self.sums[k + 1] = add_to_sums(self.sums[k], found.rows, innovation)
        self.outlying.pop(k, None)
        kept = found.outlying <= 0.5
        if not kept.all():
            self.outlying[k] = tuple(found.rows[~kept].tolist())
        self.nis[k], self.innovations[k] = found.nis, np.nan
        self.innovations[k, found.rows[kept]] = found.standardised[kept]
        self.bank = self.checkpoints[k] = bank.pruned()
        self.published.select(select_nuisances(self.model, self.bank, found, k))
        self.checkpoints.pop(k - N_CHECKPOINTS, None)

    def _detect(self, k: int, window: int, size: float) -> None:
        """Weigh a suspected change and adopt it, and raise the alarm of a drift.

        The mean innovation is largest since the log `window`.
        """
        suspected = recent_loop_change(self.loop_changes, self.first, k)
        if suspected is None and size > constants.SUSPICION_GATE:
            suspected = window
        if self.open is not None and suspected is not None:
            # A significant change keeps its place until it is settled.
            suspected = self.open.first
        before, when = self.weighed
        # What was weighed with nearly as many logs is not weighed again.
        if suspected is not None and (
            abs(before - suspected) > 2 or k - when >= (k - suspected) / 4
        ):
            self.weighed, self.open = (suspected, k), None
            change = weigh_changes(self.model, self.checkpoints, k, suspected)
            if change is not None and change.significant:
                if not change.settled(k):
                    self.open = change
                elif self._adopt(change, k):
                    return
        # A single log that deviates may be an outlier or the first after a step, and an open change
        # need not be damage: later logs decide.
        waiting = self.open is not None and not self.open.settled(k)
        evidence = self.bank.log_bayes_factor()
        lone = suspected is not None and k - suspected <= 1
        if evidence >= threshold() and not waiting and not lone:
            self._alarm(k, evidence)

    def _adopt(self, change: ChangeHypothesis, k: int) -> bool:
        """Add a change to the model and filter again from the checkpoint before it, if adopted.

        A drift that is no damage, or follows an alarm, is not adopted.
        """
        j = change.first
        before = self.checkpoints[j - 1]
        if change.kind == "drift":
            if self.alarmed or not change.damage:
                return False
        else:
            step = Step.found(change.kind, j, len(self.history.logs), change.source)
            self.model = self.model.with_step(step)
            steps = self.model.space.steps
            self.changes[len(steps) - 1] = (change, k)
            self.loop_changes = unexplained_loop_changes(self.history.loop_error, steps)
            before = before.padded(self.model.space.size)
        self.widening = self._widened(k, self._dof())
        self._begin_regime(before, j + 1)
        self.published.begin_regime(j, self.model)
        for again in range(j, k + 1):
            self._filter(again)
        if change.damage:
            self._alarm(k, change.log_bayes_factor)
        return True

    def _alarm(self, k: int, evidence: float) -> None:
        """Raise an alarm, once between two resets."""
        if self.alarmed:
            return
        self.alarmed = True
        mean, cov = self.published.kalman.x[: self.size], self.published.kalman.P
        cov = cov[: self.size, : self.size]
        contrast = self.model.space.drift
        drift = contrast @ mean
        std = np.sqrt(np.maximum(np.diag(contrast @ cov @ contrast.T), 0.0))
        i = int(np.argmax(np.abs(drift) / np.maximum(std, 1e-12)))
        mode, size, error = self.history.modes[i], float(drift[i]), float(std[i])
        self.alarms.append(Event("alarm", k, mode, "", size, error, evidence, False, k))

    def _publish(self, k: int) -> None:
        """Record the state of log k, and the noise scale of each source."""
        kalman = self.published.kalman
        state = self.published.undecided() if k in self.outlying else (kalman.x, kalman.P)
        mean, cov = (own[(slice(self.size),) * own.ndim] for own in state)
        contrast = self.model.space.drift
        self.mean[k], self.variance[k] = mean, cov.diagonal()
        self.drift_cov[k] = contrast @ cov @ contrast.T
        self.noise_scale[k] = self.bank.weight @ self.bank.hyperparameters.scales

    def _dof(self) -> FloatArray:
        """Count the innovations of each log; the first estimate of a mode has none."""
        history = self.history
        there = np.isfinite(self.innovations)
        for mode in history.modes:
            own = np.array(history.columns(mode), dtype=int)
            seen = np.cumsum(np.isfinite(history.ln_frequency[:, own]).any(axis=1)) > 1
            there[:, np.r_[own, own + len(history.series)]] &= seen[:, None]
        return np.asarray(there.sum(axis=1), dtype=float)

    def _widened(self, n: int, dof: FloatArray) -> FloatArray:
        """Return the widening of the first n logs; it is fixed before logs are filtered again."""
        factor = _widening(self.nis[:n], dof[:n], self.innovations[:n])
        return np.append(self.widening, factor[self.widening.size :])

    def _undetected(self) -> BoolArray:
        """Mark entries of the state before the first estimate of their mode, (n_logs, 4 m)."""
        there = np.isfinite([self.history.ln_frequency, self.history.ln_damping])
        seen = np.logical_or.accumulate(there, axis=1)
        modes = [seen[:, :, self.history.columns(m)].any(axis=2) for m in self.history.modes]
        ln_f, ln_zeta = ~np.stack(modes, axis=2)
        return np.hstack([ln_f, ln_f, ln_zeta, ln_f])

    def _track(self) -> Track:
        history, space, mean = self.history, self.model.space, self.mean.copy()
        drift, drift_cov = _drifts(space, mean, self.drift_cov)
        dof = self._dof()
        widening = self._widened(len(history.logs), dof)
        std = np.sqrt(np.maximum(self.variance, 0.0)) * widening[:, None]
        undetected = self._undetected()
        mean[undetected], std[undetected] = np.nan, np.nan
        return Track(
            stage=history.stage,
            logs=history.logs,
            recorded_at=history.recorded_at,
            travel=history.travel,
            modes=history.modes,
            sources=self.model.sources,
            ln_frequency=mean[:, space.level],
            ln_frequency_std=std[:, space.level],
            ln_damping=mean[:, space.damping],
            ln_damping_std=std[:, space.damping],
            drift=drift,
            drift_cov=drift_cov * widening[:, None, None] ** 2,
            effects=_effects(space, self.published.kalman, self.bank, self.model.sources),
            events=tuple(sorted([*self.alarms, *self._step_events()], key=lambda e: e.epoch)),
            steps=space.steps,
            outliers=tuple(
                (k, mode)
                for k, rows in self.outlying.items()
                for mode in history.modes
                if not set(rows).isdisjoint(history.columns(mode))
            ),
            nis=self.nis,
            nis_dof=dof,
            innovations=self.innovations,
            noise_scale=self.noise_scale,
            widening=widening,
            nuisances=Nuisances.stacked(self.published.nuisances),
        )

    def _step_events(self) -> list[Event]:
        """List the steps, detected and declared, mode by mode."""
        space, m = self.model.space, len(self.history.modes)
        mean, cov = self.published.kalman.x, self.published.kalman.P
        events: list[Event] = []
        for j, step in enumerate(space.steps):
            if step.kind == "reset":
                continue
            jump = space.jump(j)
            # A regreasing is measured by ln ζ, all others by ln f.
            own = slice(jump.start, jump.start + m)
            if step.kind == "regreasing":
                own = slice(jump.start + m, jump.stop)
            size, size_cov = mean[own], cov[own, own]
            change, found_at = self.changes.get(j, (None, step.first))
            evidence = change.log_bayes_factor if change else _evidence(step, size, size_cov)
            std = np.sqrt(np.maximum(np.diag(size_cov), 0.0))
            events += [
                Event(
                    kind=step.kind,
                    epoch=step.first,
                    mode=mode,
                    source=step.source,
                    size=float(size[i]),
                    std=float(std[i]),
                    evidence=evidence,
                    declared=step.declared,
                    found_at=found_at,
                )
                for i, mode in enumerate(self.history.modes)
            ]
        return events


def _drifts(
    space: StateSpace, mean: FloatArray, drift_cov: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the drifts of all epochs, ``(n, m)``, and their covariances; NaN before a baseline."""
    history, drift, drift_cov = space.history, mean @ space.drift.T, drift_cov.copy()
    early = np.arange(len(history.logs)) < history.baselines[0]
    drift[early], drift_cov[early] = np.nan, np.nan
    # At a baseline, and at its place on the clock until a step, ℓ and ℓ₀ are equal.
    clock, variance = history.clock(), np.einsum("kmm->km", drift_cov).max(axis=1)
    for first in history.baselines:
        still = (clock == clock[first]) & (np.arange(clock.size) > first) & (variance < _ROUNDING)
        still[first] = True
        drift[still], drift_cov[still] = 0.0, 0.0
    # A variance of nearly zero may become negative by rounding, and then has no covariances.
    negative = np.einsum("kmm->km", drift_cov) < 0
    drift_cov[negative[:, :, None] | negative[:, None, :]] = 0.0
    return drift, drift_cov


def _evidence(step: Step, size: FloatArray, cov: FloatArray) -> float:
    """Return the log Bayes factor of a declared step: the density ratio at no jump [Dickey1971]."""
    prior = constants.JUMP_STD[step.kind][1 if step.kind == "regreasing" else 0]
    log_det = np.linalg.slogdet(cov)[1] - 2 * size.size * np.log(prior)
    return float(0.5 * (log_det + size @ np.linalg.solve(cov, size)))


def _widening(nis: FloatArray, dof: FloatArray, innovations: FloatArray) -> FloatArray:
    """Return the factor on standard deviations up to each log, 1 while innovations are consistent.

    Innovations that are too large widen by the ratio to their expectation; positively
    autocorrelated ones by the reduction of the number of independent innovations.
    """
    total, degrees = np.cumsum(np.where(dof > 0, nis, 0.0)), np.cumsum(dof)
    bound = stats.chi2.isf(constants.WIDENING_P_VALUE, np.maximum(degrees, 1.0))
    factor = np.where(total > bound, total / np.maximum(degrees, 1.0), 1.0)
    sums, counts = lagged_products(innovations)
    n = np.cumsum(counts)
    squares = np.cumsum(np.nansum(innovations**2, axis=1))
    count = np.cumsum(np.isfinite(innovations).sum(axis=1))
    size = squares / np.maximum(count, 1)
    rho = np.clip(np.cumsum(sums) / np.maximum(n, 1) / np.maximum(size, 1e-12), -0.9, 0.9)
    bound = stats.norm.isf(constants.WIDENING_P_VALUE) * np.sqrt(np.cumsum(sums**2))
    factor = factor * np.where(np.cumsum(sums) > bound, dependence(rho), 1.0)
    return np.asarray(np.sqrt(factor))


def _effects(
    space: StateSpace, kalman: Any, bank: FilterBank, sources: tuple[str, ...]
) -> tuple[Effect, ...]:
    """List the effects that are no wear, after the last log."""
    modes = space.history.modes
    mean, std = kalman.x, np.sqrt(np.maximum(np.diag(kalman.P), 0.0))
    places = [(one.name, space.regressor(j).start) for j, one in enumerate(space.regressed)]
    places += [
        (f"{step.kind}:{step.name or step.source}", space.jump(j).start)
        for j, step in enumerate(space.steps)
        if not step.changes_modes
    ]
    effects = [
        Effect(mode, name, float(mean[first + i]), float(std[first + i]))
        for name, first in places
        for i, mode in enumerate(modes)
    ]
    for j, i in enumerate(space.biased):
        at, one = space.first_bias + 2 * j, space.history.series[i]
        effects.append(Effect(one.mode, f"bias:{one.source}", float(mean[at]), float(std[at])))
    for s, source in enumerate(sources):
        values = bank.hyperparameters.scales[:, s]
        scale = float(bank.weight @ values)
        std_of_scale = float(np.sqrt(bank.weight @ (values - scale) ** 2))
        effects.append(Effect("", f"scale:{source}", scale, std_of_scale))
    return tuple(effects)


def accepted_estimates(history: History, track: Track) -> History:
    """Return a history with the steps of its track and without its outliers."""
    ln_f, ln_zeta, cov = map(np.array, (history.ln_frequency, history.ln_damping, history.cov))
    r = len(history.series)
    for k, mode in track.outliers:
        own = history.columns(mode)
        ln_f[k, own] = ln_zeta[k, own] = np.nan
        both = [*own, *(r + i for i in own)]
        cov[k, both], cov[k][:, both] = np.nan, np.nan
    return replace(history, ln_frequency=ln_f, ln_damping=ln_zeta, cov=cov, steps=track.steps)


def outlier_refusals(history: History, track: Track) -> list[Refusal]:
    """List the outliers of a track as refusals."""
    refused = []
    for k, mode in track.outliers:
        i, own = track.modes.index(mode), history.columns(mode)
        found = float(np.exp(np.nanmean(history.ln_frequency[k, own])))
        before = float(np.exp(track.ln_frequency[max(k - 1, 0), i]))
        detail = (
            f"{found:.5g} Hz, or its damping, is far from the estimates of all logs before "
            f"({before:.5g} Hz): a jump is accepted once the next log confirms it"
        )
        refused.append(Refusal(log=history.logs[k], mode=mode, reason="jump", detail=detail))
    return refused
