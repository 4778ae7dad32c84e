"""Lives and what is followed through them: histories of estimates, steps, and tracks.

Arrays are read-only, log (or epoch) axis first, mode axis last, NaN where a value is missing.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Literal

import numpy as np
from scipy import stats

from lmshealth._arrays import BoolArray, FloatArray, expect_shape, freeze

StepKind = Literal["step", "regreasing", "servo", "sensor", "reset"]
EventKind = Literal["step", "regreasing", "servo", "sensor", "alarm"]

# Below this probability of their innovations a filter is not consistent with its data: where it
# makes results too sure of themselves, and where it only makes them too cautious.
_TOO_SURE, _TOO_CAUTIOUS, _UNUSUAL = 1e-3, 1e-6, 0.05


@dataclass(frozen=True, slots=True)
class Series:
    """Estimates of one mode by one source."""

    mode: str
    source: str


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """Something that happens between two logs and moves the estimates at once.

    Attributes
    ----------
    kind : str
        ``step``: the modes themselves jump, without a declared cause. ``regreasing``: their
        dampings do. ``servo``: the closed loop reads otherwise, in all sources, and ``sensor``:
        one source does; neither counts as drift. ``reset``: work on guide or mount, which opens a
        new baseline.
    first : int
        Index of the first log that sees it.
    there : ndarray of bool
        The logs that see it, shape ``(n_logs,)``.
    source : str
        Of a sensor; empty where all sources are meant.
    name : str
        What tells it from others of its kind: a ``servo_id``, or a date.
    declared : bool
        Whether somebody said so, or the estimates did.
    """

    kind: StepKind
    first: int
    there: BoolArray
    source: str = ""
    name: str = ""
    declared: bool = True

    def __post_init__(self) -> None:
        freeze(self)

    @classmethod
    def found(cls, kind: StepKind, first: int, n_logs: int, source: str = "") -> Step:
        """Make a step that nobody declared, and that all logs from one on see."""
        return cls(kind, first, np.arange(n_logs) >= first, source, declared=False)


@dataclass(frozen=True, slots=True, eq=False)
class History:
    """All modal estimates of one stage, in the order of recording.

    Attributes
    ----------
    stage : str
        Identity of the machine.
    logs : tuple of str
        Log names.
    recorded_at : tuple of datetime
        Ascending.
    travel : ndarray
        Odometer in m, shape ``(n_logs,)``; NaN throughout where there is none.
    covariates : dict of str to ndarray
        Column name to values, each of shape ``(n_logs,)``, NaN where unknown.
    modes : tuple of str
        Mode names.
    series : tuple of Series
        What the columns of the estimates are: a mode as one source sees it.
    ln_frequency, ln_damping : ndarray
        Shape ``(n_logs, n_series)``, NaN where the mode was not found.
    cov : ndarray
        Covariance of ``[ln_frequency, ln_damping]`` per log, shape
        ``(n_logs, 2 n_series, 2 n_series)``, NaN in rows and columns of what is missing.
    loop_error : ndarray
        RMS of the following error below 40 Hz in m, shape ``(n_logs,)``, NaN where unknown.
    baselines : tuple of int
        Indices of the logs at which health is one by definition: the first, and one after every
        reset, ascending.
    steps : tuple of Step
        What is known to have happened, in order.
    """

    stage: str
    logs: tuple[str, ...]
    recorded_at: tuple[datetime, ...]
    travel: FloatArray
    covariates: dict[str, FloatArray]
    modes: tuple[str, ...]
    series: tuple[Series, ...]
    ln_frequency: FloatArray
    ln_damping: FloatArray
    cov: FloatArray
    loop_error: FloatArray
    baselines: tuple[int, ...]
    steps: tuple[Step, ...] = ()

    def __post_init__(self) -> None:
        n, r = len(self.logs), len(self.series)
        for name in ("travel", "loop_error"):
            expect_shape(name, getattr(self, name), (n,))
        for name in ("ln_frequency", "ln_damping"):
            expect_shape(name, getattr(self, name), (n, r))
        expect_shape("cov", self.cov, (n, 2 * r, 2 * r))
        if not self.baselines or not all(0 <= first < max(n, 1) for first in self.baselines):
            raise ValueError(f"baselines are logs {self.baselines} of {n}")
        if {one.mode for one in self.series} - set(self.modes):
            raise ValueError(f"series {self.series} of modes that are not among {self.modes}")
        self._expect_order()
        self._expect_errors()
        freeze(self)

    def _expect_order(self) -> None:
        """Insist on logs in the order of recording, and on an odometer that never runs backwards.

        Raises
        ------
        ValueError
            Naming the log that comes too late.
        """
        for name, ticks in (
            ("recorded_at", [moment.timestamp() for moment in self.recorded_at]),
            ("travel", self.travel if self.has_odometer else []),
        ):
            back = np.flatnonzero(np.diff(ticks) < 0)
            if back.size:
                raise ValueError(
                    f"{name} runs backwards at {self.logs[back[0] + 1]}: sort the logs"
                )

    def _expect_errors(self) -> None:
        """Insist on a covariance of every estimate.

        Raises
        ------
        ValueError
            Naming a log and a series whose estimate has none, or a variance that is not positive.
        """
        there = np.isfinite(np.hstack([self.ln_frequency, self.ln_damping]))
        variance = np.einsum("kii->ki", self.cov)
        both = there[:, :, None] & there[:, None, :]
        wrong = (there & ~(variance > 0)) | (both & ~np.isfinite(self.cov)).any(axis=2)
        if wrong.any():
            k, row = np.argwhere(wrong)[0]
            one = self.series[row % len(self.series)]
            raise ValueError(
                f"{self.logs[k]}: {one.mode} by {one.source} has an estimate of variance "
                f"{variance[k, row]:g}, or without covariances; needed are positive ones"
            )

    @property
    def baseline(self) -> int:
        """Index of the log at which the present baseline begins."""
        return self.baselines[-1]

    @property
    def has_odometer(self) -> bool:
        """Whether the odometer is the clock; else it is the time."""
        return bool(np.isfinite(self.travel).all())

    def clock(self) -> FloatArray:
        """Odometer (m), or time (s) without one, since the baseline log, shape ``(n_logs,)``."""
        if self.has_odometer:
            ticks = self.travel
        else:
            ticks = np.array([moment.timestamp() for moment in self.recorded_at])
        return np.asarray(ticks - ticks[self.baseline])

    def mode_of(self) -> np.ndarray:
        """Column of `modes` that each series belongs to, shape ``(n_series,)``."""
        return np.array([self.modes.index(one.mode) for one in self.series], dtype=int)

    def columns(self, mode: str) -> list[int]:
        """Give the series of a mode, in their order."""
        return [i for i, one in enumerate(self.series) if one.mode == mode]


@dataclass(frozen=True, slots=True)
class Effect:
    """What moves a mode without wear: one row of ``effects.csv``.

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
    """Something that happened to a machine, as one mode shows it: one row of ``events.csv``.

    Attributes
    ----------
    kind : str
        ``step``, ``regreasing``, ``servo``, ``sensor``, or ``alarm``: unexplained change of the
        modes since the baseline, at the declared rate of false alarms.
    epoch : int
        First log that shows it; of an alarm, the log at which it is raised.
    mode : str
        The mode.
    source : str
        The sensor's; else empty.
    size, std : float
        Change of ln f, of a regreasing change of ln ζ, of an alarm the drift.
    evidence : float
        Log Bayes factor against nothing having happened; of what was found by itself, the place
        of the step is not known beforehand and counted in.
    declared : bool
        Whether maintenance or the log's ``servo_id`` told of it.
    found_at : int
        The log after which it was known.
    """

    kind: EventKind
    epoch: int
    mode: str
    source: str
    size: float
    std: float
    evidence: float
    declared: bool
    found_at: int


@dataclass(frozen=True, slots=True)
class Consistency:
    """Whether a filter's innovations are what it expects.

    Attributes
    ----------
    nis : float
        Sum of the normalised innovations squared over their degrees of freedom.
    p_value : float
        Two-sided, of that sum under χ².
    autocorrelation : float
        Of standardised innovations of one series from one log to the next, all series together.
    autocorrelation_p_value : float
        Two-sided, if they were independent.
    """

    nis: float
    p_value: float
    autocorrelation: float
    autocorrelation_p_value: float

    @property
    def holds(self) -> bool:
        """Whether neither is improbable; an average is somewhat cautious with quiet machines."""
        least = _TOO_SURE if self.nis > 1 else _TOO_CAUTIOUS
        least_of_all = _TOO_SURE if self.autocorrelation > 0 else _TOO_CAUTIOUS
        return self.p_value >= least and self.autocorrelation_p_value >= least_of_all

    @property
    def side(self) -> Literal["below", "inside", "above"]:
        """Where the sum lies beside the band that holds 95 % of those of a filter that is right."""
        if self.p_value >= _UNUSUAL:
            return "inside"
        return "above" if self.nis > 1 else "below"


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Modes followed over a machine's life by a Kalman filter.

    Attributes
    ----------
    stage : str
        Identity of the machine.
    logs : tuple of str
        Names of the logs, one epoch each.
    recorded_at : tuple of datetime
        Ascending.
    travel : ndarray
        Odometer in m, shape ``(n_epochs,)``; NaN throughout where there is none.
    modes : tuple of str
        Mode names.
    sources : tuple of str
        Sources of estimates.
    ln_frequency, ln_frequency_std, ln_damping, ln_damping_std : ndarray
        Filtered (no future data), covariates at their reference, shape ``(n_epochs, n_modes)``;
        NaN before the first estimate of a mode.
    drift : ndarray
        ln frequency minus its value at the baseline before it, shape ``(n_epochs, n_modes)``.
    drift_cov : ndarray
        Covariance of the drifts of one epoch, shape ``(n_epochs, n_modes, n_modes)``.
    effects : tuple of Effect
        Coefficients after the last epoch.
    events : tuple of Event
        What happened, in order.
    steps : tuple of Step
        The steps among it, declared and found.
    outliers : tuple of (int, str)
        Epochs and modes whose estimates lie so far off that they were hardly believed, and that no
        later log confirmed.
    nis : ndarray
        Normalised innovation squared, shape ``(n_epochs,)``. Logs that were filtered again with an
        event have that of the last time.
    nis_dof : ndarray
        Its degrees of freedom, shape ``(n_epochs,)``; the first estimate of a mode has none,
        because the filter starts from it, and outliers have none.
    innovations : ndarray
        Standardised innovations of ``[ln f, ln ζ]`` of all series, ``(n_epochs, 2 n_series)``.
    noise_scale : ndarray
        Factor on the reported standard deviations of each source that the innovations ask for,
        shape ``(n_epochs, n_sources)``; 1 when they are consistent.
    widening : ndarray
        Factor on all standard deviations, as the filter's innovations were not consistent up to
        there, shape ``(n_epochs,)``; 1 when they are.
    """

    stage: str
    logs: tuple[str, ...]
    recorded_at: tuple[datetime, ...]
    travel: FloatArray
    modes: tuple[str, ...]
    sources: tuple[str, ...]
    ln_frequency: FloatArray
    ln_frequency_std: FloatArray
    ln_damping: FloatArray
    ln_damping_std: FloatArray
    drift: FloatArray
    drift_cov: FloatArray
    effects: tuple[Effect, ...]
    events: tuple[Event, ...]
    steps: tuple[Step, ...]
    outliers: tuple[tuple[int, str], ...]
    nis: FloatArray
    nis_dof: FloatArray
    innovations: FloatArray
    noise_scale: FloatArray
    widening: FloatArray

    def __post_init__(self) -> None:
        n, m = len(self.logs), len(self.modes)
        for name in ("ln_frequency", "ln_frequency_std", "ln_damping", "ln_damping_std", "drift"):
            expect_shape(name, getattr(self, name), (n, m))
        expect_shape("drift_cov", self.drift_cov, (n, m, m))
        expect_shape("noise_scale", self.noise_scale, (n, len(self.sources)))
        expect_shape("innovations", self.innovations, (n, self.innovations.shape[1]))
        for name in ("travel", "nis", "nis_dof", "widening"):
            expect_shape(name, getattr(self, name), (n,))
        freeze(self)

    @property
    def alarms(self) -> tuple[Event, ...]:
        """The damage alarms."""
        return tuple(event for event in self.events if event.kind == "alarm")

    def consistency(self) -> Consistency:
        """Judge the filter by its innovations."""
        return consistency(self.nis, self.nis_dof, self.innovations)


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """What all logs together say of every epoch, later ones included.

    Attributes
    ----------
    ln_frequency, ln_frequency_std, ln_damping, ln_damping_std, drift, drift_std : ndarray
        As in `Track`, shape ``(n_epochs, n_modes)``.
    """

    ln_frequency: FloatArray
    ln_frequency_std: FloatArray
    ln_damping: FloatArray
    ln_damping_std: FloatArray
    drift: FloatArray
    drift_std: FloatArray

    def __post_init__(self) -> None:
        freeze(self)


def neighbours(innovations: FloatArray) -> tuple[FloatArray, np.ndarray]:
    """Multiply innovations by those of the log before: sums over each log, and how many they are.

    Series of one log may have errors in common: the sums over a log are what is independent.
    """
    products = np.full_like(innovations, np.nan)
    products[1:] = innovations[1:] * innovations[:-1]
    there = np.isfinite(products)
    return np.where(there, products, 0.0).sum(axis=1), there.sum(axis=1)


def consistency(nis: FloatArray, dof: FloatArray, innovations: FloatArray) -> Consistency:
    """Judge innovations: their sum of squares by χ², their independence by the autocorrelation.

    Parameters
    ----------
    nis, dof : ndarray
        Normalised innovation squared and its degrees of freedom, shape ``(n_epochs,)``.
    innovations : ndarray
        Standardised, NaN where there is none, shape ``(n_epochs, n)``.

    References
    ----------
    BarShalom2001, section 5.4.
    """
    judged = dof > 0
    total, degrees = float(nis[judged].sum()), float(dof[judged].sum())
    tail = stats.chi2.sf(total, degrees) if degrees else 0.5
    sums, counts = neighbours(innovations)
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
