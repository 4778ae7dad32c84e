"""Track: Kalman filtering of all modes over a machine's life, with steps and alarms.

All modes share one state space, because their estimates may be correlated, and one bank of filters.
Declared steps are in the model from the start; a detected step is added, and the logs from it on
are filtered again from the checkpoint before it. No epoch uses later logs; `smooth` does.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import reduce
from typing import Any, Literal

import numpy as np
from scipy.special import chdtrc, ndtr

from lmshealth._private.arrays import BoolArray, FloatArray, diagonal, freeze, one_thread
from lmshealth._private.result import Result
from lmshealth._private.tables import TABLES, fact
from lmshealth.errors import NotEnoughData
from lmshealth.io.log import Refusal, utc_day
from lmshealth.stage.description import Stage
from lmshealth.tracking import constants
from lmshealth.tracking.covariates import regressors
from lmshealth.tracking.filters.kalman_filters import Nuisances, smooth_states
from lmshealth.tracking.filters.state_space import StateSpace
from lmshealth.tracking.filters.track_state import (
    Epoch,
    Event,
    TrackState,
    degrees_of_freedom,
    initial_state,
    running_sums,
    step,
    widening,
)
from lmshealth.tracking.history import History, Step

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
class Consistency:
    """Tests of a filter's innovations, with two-sided p-values."""

    nis: float  # sum of the normalised innovations squared over their degrees of freedom
    p_value: float  # of that sum under χ²
    # Of standardised innovations of one series from one log to the next, all series together.
    autocorrelation: float
    autocorrelation_p_value: float  # if they were independent

    @property
    def holds(self) -> bool:
        """Whether no test rejects the filter, or only by deviations too small to matter."""
        bounds = (constants.CAUTIOUS_P_VALUE, constants.OVERCONFIDENT_P_VALUE)
        low, high = constants.NEGLIGIBLE_NIS
        right = low <= self.nis <= high or self.p_value >= bounds[self.nis > 1]
        least = bounds[self.autocorrelation > 0]
        small = abs(self.autocorrelation) <= constants.NEGLIGIBLE_CORRELATION
        return right and (small or self.autocorrelation_p_value >= least)

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
    # Step that the last logs may show, by less evidence than an event needs; None without.
    suspected: Step | None = None
    unconfirmed: tuple[tuple[int, str], ...] = ()  # its epochs and modes

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
        last = f"; modes at {utc_day(self.recorded_at[-1])}" if self.recorded_at else ""
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


def mode_columns(values: Track) -> dict[str, FloatArray]:
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


def consistency(nis: FloatArray, dof: FloatArray, innovations: FloatArray) -> Consistency:
    """Test innovations by their sum of squares and their autocorrelation [BarShalom2001, 5.4].

    `nis` and `dof` have the shape ``(n_epochs,)``, standardised innovations ``(n_epochs, n)``, NaN
    where there is none.
    """
    ends = (float(own[-1:].sum()) for own in running_sums(nis, dof, innovations))
    total, degrees, products, std, correlation = ends
    tail = float(chdtrc(degrees, total)) if degrees else 0.5
    return Consistency(
        nis=total / degrees if degrees else 1.0,
        p_value=2 * min(tail, 1 - tail),
        autocorrelation=correlation,
        autocorrelation_p_value=float(2 * ndtr(-abs(products) / std)) if std else 1.0,
    )


@one_thread
def track(history: History, stage: Stage | None = None) -> Track:
    """Track the modes of a history by a bank of Kalman filters.

    Parameters
    ----------
    history : History
        Modal estimates with covariance; missing ones are NaN.
    stage : Stage, optional
        Its covariates are regressed out. Without it every covariate present is, about its median.

    Returns
    -------
    Track
        Filtered: no epoch uses later logs, but for the medians to which ln f refers without a
        stage.

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
    roll: -6.0% ± 0.3%
    pitch: -5.7% ± 0.3%
    yaw: -6.1% ± 0.3%
    >>> [(event.kind, f"{track.recorded_at[event.epoch]:%d %B}") for event in track.events]
    [('alarm', '05 April')]
    """
    if not np.isfinite(history.ln_frequency).any():
        raise NotEnoughData(
            fact(
                "{stage}: no modal estimate in {n} logs is of a known mode; a mode without a name "
                "is known once three logs show it",
                stage=history.stage,
                n=len(history.logs),
            )
        )
    space = StateSpace(history, stage, history.steps)
    return _published(reduce(step, range(len(history.logs)), initial_state(space)))


def _published(state: TrackState) -> Track:
    """Return the track of the logs up to a state."""
    space, sources = state.space, state.space.sources
    history, epochs, rows = space.history, state.epochs(), state.rows
    mean = np.array([row.mean for row in rows])
    drift, drift_cov = _drifts(space, mean, np.array([row.drift_cov for row in rows]))
    factor = widening(state)
    std = np.sqrt(np.maximum([row.variance for row in rows], 0.0)) * factor[:, None]
    undetected = _undetected(history)
    mean[undetected], std[undetected] = np.nan, np.nan
    innovations = np.array([epoch.innovations for epoch in epochs])
    outliers, unconfirmed = _outliers(history, epochs, space.steps)
    begun = min(unconfirmed, default=None)
    events = sorted([*state.alarms, *_step_events(state)], key=lambda event: event.epoch)
    return Track(
        stage=history.stage,
        logs=history.logs,
        recorded_at=history.recorded_at,
        travel=history.travel,
        modes=history.modes,
        sources=sources,
        ln_frequency=mean[:, space.level],
        ln_frequency_std=std[:, space.level],
        ln_damping=mean[:, space.damping],
        ln_damping_std=std[:, space.damping],
        drift=drift,
        drift_cov=drift_cov * factor[:, None, None] ** 2,
        effects=_effects(state),
        events=tuple(events),
        steps=space.steps,
        outliers=tuple(outliers),
        suspected=Step.found("step", begun[0], len(epochs)) if begun else None,
        unconfirmed=tuple(unconfirmed),
        nis=np.array([epoch.nis for epoch in epochs]),
        nis_dof=degrees_of_freedom(state.space, innovations),
        innovations=innovations,
        noise_scale=np.array([row.noise_scale for row in rows]),
        widening=factor,
        nuisances=Nuisances.stacked([epoch.nuisances for epoch in epochs]),
    )


def _outliers(
    history: History, epochs: Sequence[Epoch], steps: Sequence[Step]
) -> tuple[list[tuple[int, str]], list[tuple[int, str]]]:
    """List the logs and modes that are outliers, and those that may show a step.

    Two or more last logs in which a mode deviates to the same side have something in common, even
    if it is not clear yet what: they are no outliers, unless there are already `MAX_STEPS` steps.
    """
    n_series, baseline = len(history.series), history.baselines[-1]
    n_steps = sum(one.kind == "step" and one.first > baseline for one in steps)
    standardised = np.array([epoch.standardised for epoch in epochs])
    outlying = np.array([epoch.outlying for epoch in epochs])
    found: list[tuple[int, str]] = []
    changed: list[tuple[int, str]] = []
    for mode in history.modes:
        columns = history.columns(mode)
        own = [*columns, *(n_series + i for i in columns)]
        away = np.nan_to_num(standardised[:, own])
        worst = np.abs(away).argmax(axis=1)
        side = np.sign(np.take_along_axis(away, worst[:, None], axis=1)[:, 0])
        # ±1 where ln f deviates most, ±2 where ln ζ does, 0 of no outlier.
        side = np.where(outlying[:, own].any(axis=1), side * (1 + worst // len(columns)), 0)
        logs = np.flatnonzero(np.isfinite(standardised[:, own]).any(axis=1))
        last = logs[np.logical_and.accumulate(side[logs][::-1] == side[logs][-1:])[::-1]]
        if len(last) > 1 and side[last[0]] and n_steps < constants.MAX_STEPS:
            changed += [(k, mode) for k in last.tolist()]
            logs = logs[: -len(last)]
        found += [(k, mode) for k in logs[side[logs] != 0].tolist()]
    return found, changed


def _undetected(history: History) -> BoolArray:
    """Mark entries of the state before the first estimate of their mode, ``(n_logs, 4 m)``."""
    there = np.isfinite([history.ln_frequency, history.ln_damping])
    seen = np.logical_or.accumulate(there, axis=1)
    modes = [seen[:, :, history.columns(m)].any(axis=2) for m in history.modes]
    ln_f, ln_zeta = ~np.stack(modes, axis=2)
    return np.hstack([ln_f, ln_f, ln_zeta, ln_f])


def _step_events(state: TrackState) -> list[Event]:
    """List the steps, detected and declared, mode by mode."""
    space, (mean, cov) = state.space, (state.published.mean, state.published.cov)
    n_declared, m = len(space.history.steps), space.n_modes
    events: list[Event] = []
    for j, one in enumerate(space.steps):
        if one.kind == "reset":
            continue
        # A regreasing is measured by ln ζ, all others by ln f.
        first = space.jump(j).start + (m if one.kind == "regreasing" else 0)
        own = slice(first, first + m)
        size, size_cov = mean[own], cov[own, own]
        std = np.sqrt(np.maximum(np.diag(size_cov), 0.0))
        if j < n_declared:
            evidence, found_at = _evidence(one, size, size_cov), one.first
        else:
            change, found_at = state.changes[j - n_declared]
            evidence = change.log_bayes_factor
        events += [
            Event(
                kind=one.kind,
                epoch=one.first,
                mode=mode,
                source=one.source,
                size=float(size[i]),
                std=float(std[i]),
                evidence=evidence,
                declared=one.declared,
                found_at=found_at,
            )
            for i, mode in enumerate(space.history.modes)
            if one.mode in ("", mode)
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


def _effects(state: TrackState) -> tuple[Effect, ...]:
    """List the effects that are no wear, after the last log."""
    space, bank = state.space, state.bank
    mean, std = state.published.mean, np.sqrt(np.maximum(np.diag(state.published.cov), 0.0))
    effects = [
        Effect(mode, name, float(mean[at]), float(std[at])) for mode, name, at in space.effects
    ]
    for s, source in enumerate(state.space.sources):
        values = bank.hyperparameters.scales[:, s]
        scale = float(bank.weight @ values)
        std_of_scale = float(np.sqrt(bank.weight @ (values - scale) ** 2))
        effects.append(Effect("", f"scale:{source}", scale, std_of_scale))
    return tuple(effects)


def accepted_estimates(history: History, track: Track, *, doubtful: bool = False) -> History:
    """Return a history with the steps of its track and without its outliers, as `infer` needs it.

    A suspected step is among them: a life without it competes with those that have it. One log does
    not show whether it is in error or the machine has changed since: if ``doubtful``, as `assess`
    sets it, ln f of the first log of the present baseline stay, and are `History.in_doubt`.

    Examples
    --------
    A life that is tracked step by step:

    >>> import lmshealth
    >>> from lmshealth import examples
    >>> stage, history = lmshealth.load_stage("lms-y"), examples.history()
    >>> track = lmshealth.track(history, stage)
    >>> accepted = lmshealth.accepted_estimates(history, track, doubtful=True)
    >>> health = lmshealth.infer(accepted, stage, seed=1, chains=False)
    >>> print(f"{health.latest(0.5)[0]:.2f}")
    0.71
    """
    ln_f, ln_zeta, cov = map(np.array, (history.ln_frequency, history.ln_damping, history.cov))
    steps = track.steps if track.suspected is None else (*track.steps, track.suspected)
    r, in_doubt = len(history.series), list[int]()
    for k, mode in track.outliers:
        own = history.columns(mode)
        left_out = [r + i for i in own]
        if doubtful and k == history.baseline and k + 1 < len(track.logs):
            in_doubt += own
        else:
            left_out += own
            ln_f[k, own] = np.nan
        ln_zeta[k, own] = np.nan
        cov[k, left_out], cov[k][:, left_out] = np.nan, np.nan
    changed = replace(history, ln_frequency=ln_f, ln_damping=ln_zeta, cov=cov, steps=steps)
    return replace(changed, in_doubt=tuple(in_doubt))


def known_shifts(
    history: History, track: Track, stage: Stage | None, logs: Iterable[int]
) -> FloatArray:
    """Return what covariates, steps of the loop, sensors and biases add to ln f of some logs.

    By the effects after the last epoch; shape ``(n, n_series)`` for n logs.
    """
    space = StateSpace(history, stage, track.steps)
    places = [at for _, _, at in space.effects]
    effects = np.array([one.coefficient for one in track.effects[: len(places)]])
    n_series = len(history.series)
    found = [space.matrix(k)[:n_series, places] @ effects for k in logs]
    return np.array(found).reshape(-1, n_series)


def outlier_refusals(history: History, track: Track, stage: Stage | None = None) -> list[Refusal]:
    """List the outliers of a track as refusals; the stage is that of `track`."""
    if not track.outliers:
        return []
    refused = []
    shifts = known_shifts(history, track, stage, [k for k, _ in track.outliers])
    for (k, mode), shift in zip(track.outliers, shifts, strict=True):
        i, own = track.modes.index(mode), history.columns(mode)
        # As it would be without what the track explains.
        found = float(np.exp(np.nanmean((history.ln_frequency[k] - shift)[own])))
        before = float(np.exp(track.ln_frequency[k - 1, i]))
        detail = (
            f"{found:.5g} Hz, or its damping, is far from the estimates of all logs before "
            f"({before:.5g} Hz): a jump is accepted once the next log confirms it"
        )
        if k in (0, *history.baselines) and k + 2 < len(track.logs):  # judged by those after it
            after = float(np.exp(track.ln_frequency[k + 2, i]))
            detail = (
                f"{found:.5g} Hz, or its damping, is far from the estimates of all logs after "
                f"({after:.5g} Hz): a jump is accepted once the second log confirms it"
            )
        refused.append(Refusal(log=history.logs[k], mode=mode, reason="jump", detail=detail))
    return refused


def smooth(history: History, followed: Track, stage: Stage | None = None) -> Track:
    """Return a track with its modes and drifts at every epoch given all logs [Rauch1965].

    By the recursion of Rauch, Tung and Striebel of the published filter: the steps and nuisances of
    the track are in the model; the stage is that of `track`. `ValueError` for a track without
    nuisances, which `track` did not make.
    """
    if followed.nuisances is None:
        raise ValueError(f"the track of {followed.stage} has no nuisances: filter it by `track`")
    space = StateSpace(history, stage, followed.steps)
    mean, cov = smooth_states(space, followed.nuisances)
    size = space.drift.shape[1]
    drift = mean[:, :size] @ space.drift.T
    drift_cov = space.drift @ cov[:, :size, :size] @ space.drift.T
    for variance in (diagonal(cov), diagonal(drift_cov)):  # rounding
        np.maximum(variance, 0.0, out=variance)
    early = np.arange(len(history.logs)) < history.baselines[0]
    drift[early], drift_cov[early] = np.nan, np.nan
    std = np.sqrt(diagonal(cov)) * followed.widening[:, None]
    unseen = space.damping.start + np.flatnonzero(np.isnan(followed.ln_damping).all(axis=0))
    mean[:, unseen], std[:, unseen] = np.nan, np.nan
    return replace(
        followed,
        ln_frequency=mean[:, space.level],
        ln_frequency_std=std[:, space.level],
        ln_damping=mean[:, space.damping],
        ln_damping_std=std[:, space.damping],
        drift=drift,
        drift_cov=drift_cov * followed.widening[:, None, None] ** 2,
    )


@dataclass(frozen=True, slots=True, eq=False)
class CovariateEffect:
    """Effect of a covariate on a mode, and the n estimates that it was regressed on."""

    mode: str
    covariate: str
    reference: float  # the covariate at which the effect is zero
    effects: tuple[Effect, ...]  # per unit, and per unit squared where there is a curvature
    epochs: np.ndarray  # logs of the estimates, ``(n,)``
    values: FloatArray  # the covariate in these logs, ``(n,)``
    # ln f minus its smoothed level, steps, biases and other covariates, ``(n,)``. The level follows
    # the logs: residuals scatter less than the estimates' errors.
    measured: FloatArray

    def __post_init__(self) -> None:
        freeze(self, ("values measured", *self.epochs.shape))

    def explained(self, values: FloatArray) -> FloatArray:
        """Return the change of ln f at values of the covariate, shape of ``values``."""
        offset = values - self.reference
        return np.asarray(sum(e.coefficient * offset**p for p, e in enumerate(self.effects, 1)))

    def explained_std(self, values: FloatArray) -> FloatArray | None:
        """Return its standard deviation; None with a curvature, whose covariance is not kept."""
        if len(self.effects) > 1:
            return None
        return np.abs(values - self.reference) * self.effects[0].std

    @property
    def corrected(self) -> FloatArray:
        """Residuals of the measured changes, shape ``(n,)``."""
        return self.measured - self.explained(self.values)

    @property
    def seen(self) -> bool:
        """Whether any of the effects is more than two standard deviations from zero."""
        return any(abs(effect.coefficient) > 2 * effect.std for effect in self.effects)


def find_covariate_effects(
    history: History, track: Track, stage: Stage
) -> tuple[CovariateEffect, ...]:
    """Return the effect of every described covariate on every mode, without outliers of the track.

    The order is that of the description; a covariate that is unknown or never left its reference
    has no effect. In a long history the level is the filtered one.
    """
    columns = regressors(history.covariates, stage, history.recorded_at)
    if not columns:
        return ()
    taken = accepted_estimates(history, track)
    short = len(taken.logs) <= constants.MOST_SMOOTHED
    level = (smooth(taken, track, stage) if short else track).ln_frequency
    moved = known_shifts(history, track, stage, range(len(history.logs)))
    rest = taken.ln_frequency - level[:, taken.mode_of()] - moved
    found = []
    for covariate in stage.description.covariate:
        own = [j for j, r in enumerate(columns) if r.name.removesuffix("^2") == covariate.name]
        for i, mode in enumerate(track.modes) if own else ():
            effects = tuple(track.effects[len(track.modes) * j + i] for j in own)
            at, values = history.columns(mode), history.covariates[covariate.name]
            epochs, series = np.nonzero(np.isfinite(rest[:, at]) & np.isfinite(values)[:, None])
            parts = zip(own, effects, strict=True)
            explained = np.sum([e.coefficient * columns[j].values for j, e in parts], axis=0)
            found.append(
                CovariateEffect(
                    mode=mode,
                    covariate=covariate.name,
                    reference=covariate.reference,
                    effects=effects,
                    epochs=epochs,
                    values=values[epochs],
                    measured=rest[:, at][epochs, series] + explained[epochs],
                )
            )
    return tuple(found)


def covariate_shifts(history: History, track: Track, stage: Stage) -> FloatArray:
    """Return the change of ln f of every mode by covariates, shape ``(n_logs, n_modes)``."""
    columns, n_modes = regressors(history.covariates, stage, history.recorded_at), len(track.modes)
    effects = track.effects[: len(columns) * n_modes]
    coefficients = np.array([one.coefficient for one in effects]).reshape(-1, n_modes)
    values = np.array([one.values for one in columns]).reshape(-1, len(history.logs))
    return np.asarray(values.T @ coefficients)
