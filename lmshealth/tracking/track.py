"""Kalman filter over a machine's life: modes followed with every uncertainty used.

All modes share one state space, because their estimates may be correlated, and one bank of
filters, which averages over what is not known of the process. What happens at once is told from
drift: steps that maintenance declares are let happen where they did, others are found and let
happen from then on. No epoch knows of later logs; `smooth` does.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Literal

import numpy as np
from scipy import stats

from lmshealth._arrays import BoolArray, FloatArray, expect_shape, freeze
from lmshealth.errors import NotEnoughData
from lmshealth.io.log import Refusal
from lmshealth.stage.description import Stage
from lmshealth.tracking.change_detection import MEMORY, Finding, Watch, explain, reborn, threshold
from lmshealth.tracking.constants import JUMP_STD
from lmshealth.tracking.filter_bank import Bank, Filter
from lmshealth.tracking.history import History, Step
from lmshealth.tracking.state_space import StateSpace, state_space

EventKind = Literal["step", "regreasing", "servo", "sensor", "alarm"]

# Below this probability of their innovations a filter is not consistent with its data: where it
# makes results too sure of themselves, and where it only makes them too cautious.
_TOO_SURE, _TOO_CAUTIOUS, _UNUSUAL = 1e-3, 1e-6, 0.05
# Innovations further out are hardly believed before the next log is there.
_FAR = 6.0
# A filter is widened once its innovations are less probable than that.
_WIDEN = 5e-4
_ROUNDING = 1e-15  # of the variance of a drift


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


def track(history: History, stage: Stage | None = None) -> Track:
    """Follow the modes of a history by a Kalman filter.

    Parameters
    ----------
    history : History
        Modal estimates with covariance; missing ones are NaN.
    stage : Stage, optional
        Its covariates are regressed out, and rates are counted per its horizon. Without it every
        covariate present is, about its median, and rates are counted per length of the history.

    Returns
    -------
    Track
        Filtered, so that no epoch knows of later logs.

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
    roll: -6.0% ± 0.1%
    pitch: -5.5% ± 0.1%
    yaw: -5.8% ± 0.1%
    >>> [(event.kind, f"{track.recorded_at[event.epoch]:%d %B}") for event in track.events]
    [('alarm', '19 March')]
    """
    if not np.isfinite(history.ln_frequency).any():
        told = f"{history.stage}: no modal estimate in {len(history.logs)} logs is of a known mode"
        raise NotEnoughData(f"{told}; without a name it is known once three logs show it")
    return _Follower(history, state_space(history, stage, history.steps)).follow()


@dataclass(slots=True, eq=False)
class _Record:
    """What is published of every epoch."""

    mean: FloatArray
    cov: FloatArray
    nis: FloatArray
    scale: FloatArray
    widening: FloatArray
    settled: int = 0


@dataclass(slots=True, eq=False)
class _Found:
    """Events, and steps that were found, as they come."""

    events: list[Event] = field(default_factory=list)
    findings: dict[int, tuple[Finding, int]] = field(default_factory=dict)
    alarmed: bool = False
    tested: tuple[int, int] = (-1, -1)
    # Believed to have happened, but not yet what it was.
    open: Finding | None = None


class _Follower:
    """Takes a bank of filters through a history, and starts new chapters where something happened.

    A chapter begins where a step does: the state stays, the settings start anew.
    """

    def __init__(self, history: History, space: StateSpace) -> None:
        self.history = history
        self.filters = Filter(space, history.baselines)
        self.resets = {step.first for step in history.steps if step.kind == "reset"}
        n, rows = len(history.logs), 2 * len(history.series)
        size = 4 * len(history.modes)
        self.record = _Record(
            np.empty((n, size)),
            np.empty((n, size, size)),
            np.zeros(n),
            np.ones((n, len(self.filters.sources))),
            np.ones(n),
        )
        self.watch = Watch(rows, history.loop_error)
        self.watch.settle(space.steps)
        self.memory: dict[int, Bank] = {}
        # Rows of a log that are taken for outliers, until an event explains them.
        self.doubted: dict[int, np.ndarray] = {}
        self.found = _Found()

    def follow(self) -> Track:
        """Filter log by log."""
        bank = self.filters.start()
        for k in range(len(self.history.logs)):
            if k in self.resets and k:
                bank = self._begin_chapter(bank, k)
                self.found.alarmed = False
            bank = self._step(bank, k, doubting=k not in self.resets)
            bank = self._look_for_events(bank, k)
            self._publish(bank, k)
        return self._result(bank)

    def _begin_chapter(self, bank: Bank, watched: int) -> Bank:
        """Start the settings anew, and watch from some log on.

        Evidence is counted from here: what is remembered of the chapter before is no measure.
        """
        self.watch.first = watched
        self.memory.clear()
        return reborn(bank, self.filters)

    def _step(self, bank: Bank, k: int, *, doubting: bool = True) -> Bank:
        """Take the bank over one log and remember it.

        What lies far off is an outlier or the beginning of something. It is hardly believed until
        the next log tells which; two in a row are believed.
        """
        self.filters.move(bank, k)
        kept = surprise = self.filters.see(bank, k)
        self.doubted.pop(k, None)
        far = np.abs(surprise.innovation) > _FAR
        in_a_row = {k - 1, k - 2} <= self.doubted.keys()
        if doubting and far.any() and k - 1 in self.memory and not in_a_row:
            self.doubted[k] = self._of_same_modes(surprise.rows[far])
            bank = self.memory[k - 1].copy()
            self.filters.move(bank, k)
            kept = self.filters.see(bank, k, self.doubted[k])
        bank = bank.pruned()
        self.watch.add(k, surprise, kept)
        self.record.nis[k] = kept.nis
        self.memory[k] = bank.copy()
        self.memory.pop(k - MEMORY, None)
        return bank

    def _of_same_modes(self, rows: np.ndarray) -> np.ndarray:
        """Mark all rows of the modes of some rows, shape ``(2 n_series,)``."""
        mode = np.tile(self.history.mode_of(), 2)
        return np.isin(mode, mode[rows])

    def _publish(self, bank: Bank, k: int) -> None:
        record = self.record
        size = record.mean.shape[1]
        mean, cov = bank.collapse(size)
        if k in self.doubted:
            # As likely the first log after a step: nobody can tell yet, and that is what is said.
            stepped = self.filters.with_step(Step.found("step", k, len(self.history.logs)))
            other = stepped.advance(self.memory[k - 1].padded(stepped.space.size), k, k)
            moved, spread = other.collapse(size)
            off = 0.5 * (moved - mean)
            mean, cov = mean + off, 0.5 * (cov + spread) + np.outer(off, off)
        record.mean[k], record.cov[k] = mean, cov
        record.scale[k] = bank.weight @ bank.settings.scales

    def _look_for_events(self, bank: Bank, k: int) -> Bank:
        """Raise the alarm of a drift, and explain what looks like more than that."""
        found = self.found
        suspect = self.watch.suspect(k)
        if found.open is not None and suspect is not None:
            # What is believed to have happened keeps its place until it is settled.
            suspect = found.open.first
        # What was weighed a moment ago is weighed again once there is notably more to it.
        if suspect is not None and not self._just_tested(suspect, k):
            found.tested = (suspect, k)
            found.open = None
            finding = explain(self.filters, self.memory, k, suspect)
            if finding is not None and finding.believed:
                if finding.settled(k):
                    adopted = self._adopt(finding, bank, k)
                    # A drift that is no damage yet leaves all as it was, the alarm too.
                    if adopted is not bank:
                        return adopted
                else:
                    found.open = finding
        # A single log that leans may be an outlier, or the first after a step: the next one tells.
        # Of what is not settled yet, later logs tell whether it is damage.
        waiting = found.open is not None and not found.open.settled(k)
        evidence = bank.log_bayes_factor()
        if evidence >= threshold() and not waiting and (suspect is None or k - suspect > 1):
            self._alarm(bank, k, evidence)
        return bank

    def _just_tested(self, suspect: int, k: int) -> bool:
        before, when = self.found.tested
        return abs(before - suspect) <= 2 and k - when < (k - suspect) / 4

    def _adopt(self, finding: Finding, bank: Bank, k: int) -> Bank:
        """Take what was found for true, from its first log on."""
        j = finding.first
        before = self.memory[j - 1]
        if finding.kind == "drift":
            if self.found.alarmed or not finding.damage:
                return bank
        else:
            step = Step.found(finding.kind, j, len(self.history.logs), finding.source)
            self.filters = self.filters.with_step(step)
            self.found.findings[len(self.filters.space.steps) - 1] = (finding, k)
            self.watch.settle(self.filters.space.steps)
            before = before.padded(self.filters.space.size)
        self._settle(k)
        begun = self._begin_chapter(before, j + 1)
        for again in range(j, k + 1):
            begun = self._step(begun, again, doubting=False)
        if finding.damage:
            self._alarm(begun, k, finding.log_bayes_factor)
        return begun

    def _settle(self, k: int) -> None:
        """Keep how much the logs before k are widened: filtered again they are judged anew."""
        record = self.record
        factor = _widening(record.nis[:k], self._dof()[:k], self.watch.innovations[:k])
        record.widening[record.settled : k] = factor[record.settled :]
        record.settled = k

    def _dof(self) -> FloatArray:
        """Count the measurements of each log that could surprise: the first of a mode cannot."""
        history = self.history
        there = np.isfinite(self.watch.innovations)
        for mode in history.modes:
            own = np.array(history.columns(mode), dtype=int)
            seen = np.cumsum(np.isfinite(history.ln_frequency[:, own]).any(axis=1)) > 1
            there[:, np.r_[own, own + len(history.series)]] &= seen[:, None]
        return np.asarray(there.sum(axis=1), dtype=float)

    def _unseen(self) -> BoolArray:
        """Mark ln f and ln ζ that no log has seen yet, ``(n_logs, 4 n_modes)``."""
        there = np.isfinite([self.history.ln_frequency, self.history.ln_damping])
        seen = np.logical_or.accumulate(there, axis=1)
        modes = [seen[:, :, self.history.columns(m)].any(axis=2) for m in self.history.modes]
        ln_f, ln_zeta = ~np.stack(modes, axis=2)
        return np.hstack([ln_f, ln_f, ln_zeta, ln_f])

    def _alarm(self, bank: Bank, k: int, evidence: float) -> None:
        """Raise the alarm once in every chapter between resets."""
        if self.found.alarmed:
            return
        self.found.alarmed = True
        mean, cov = bank.collapse(self.record.mean.shape[1])
        contrast = self.filters.space.drift()
        drift = contrast @ mean
        std = np.sqrt(np.maximum(np.diag(contrast @ cov @ contrast.T), 0.0))
        i = int(np.argmax(np.abs(drift) / np.maximum(std, 1e-12)))
        self.found.events.append(
            Event(
                kind="alarm",
                epoch=k,
                mode=self.history.modes[i],
                source="",
                size=float(drift[i]),
                std=float(std[i]),
                evidence=evidence,
                declared=False,
                found_at=k,
            )
        )

    def _result(self, bank: Bank) -> Track:
        history, record, space = self.history, self.record, self.filters.space
        contrast = space.drift()
        drift = record.mean @ contrast.T
        drift_cov = np.einsum("mi,kij,nj->kmn", contrast, record.cov, contrast)
        early = np.arange(len(history.logs)) < history.baselines[0]
        drift[early], drift_cov[early] = np.nan, np.nan
        # At a baseline, and on its spot until something happens, ℓ and ℓ₀ are the same.
        clock, spread = history.clock(), np.einsum("kmm->km", drift_cov).max(axis=1)
        for first in history.baselines:
            still = (clock == clock[first]) & (np.arange(clock.size) > first) & (spread < _ROUNDING)
            still[first] = True
            drift[still], drift_cov[still] = 0.0, 0.0
        # A variance of nearly zero may become negative by rounding, and then has no covariances.
        negative = np.einsum("kmm->km", drift_cov) < 0
        drift_cov[negative[:, :, None] | negative[:, None, :]] = 0.0
        self._settle(len(history.logs))
        widening = record.widening
        variance = np.maximum(np.einsum("kii->ki", record.cov), 0.0)
        std = np.sqrt(variance) * widening[:, None]
        unseen = self._unseen()
        record.mean[unseen], std[unseen] = np.nan, np.nan
        return Track(
            stage=history.stage,
            logs=history.logs,
            recorded_at=history.recorded_at,
            travel=history.travel,
            modes=history.modes,
            sources=self.filters.sources,
            ln_frequency=record.mean[:, space.level],
            ln_frequency_std=std[:, space.level],
            ln_damping=record.mean[:, space.damping],
            ln_damping_std=std[:, space.damping],
            drift=drift,
            drift_cov=drift_cov * widening[:, None, None] ** 2,
            effects=_effects(space, bank, self.filters.sources),
            events=tuple(
                sorted([*self.found.events, *self._events(bank)], key=lambda event: event.epoch)
            ),
            steps=space.steps,
            nis=record.nis,
            nis_dof=self._dof(),
            outliers=tuple(
                (k, mode)
                for k, rows in sorted(self.doubted.items())
                for i, mode in enumerate(history.modes)
                if rows[: len(history.series)][history.mode_of() == i].any()
            ),
            innovations=self.watch.innovations,
            noise_scale=record.scale,
            widening=widening,
        )

    def _events(self, bank: Bank) -> list[Event]:
        """Tell the steps, found and declared, mode by mode."""
        space, m = self.filters.space, len(self.history.modes)
        mean, cov = bank.collapse()
        events: list[Event] = []
        for j, step in enumerate(space.steps):
            if step.kind == "reset":
                continue
            jump = space.jump(j)
            # Of grease the damping, of all else the frequency.
            own = slice(jump.start, jump.start + m)
            if step.kind == "regreasing":
                own = slice(jump.start + m, jump.stop)
            size, spread = mean[own], cov[own, own]
            finding, found_at = self.found.findings.get(j, (None, step.first))
            evidence = finding.log_bayes_factor if finding else _evidence(space, step, size, spread)
            events += [
                Event(
                    kind=step.kind,
                    epoch=step.first,
                    mode=mode,
                    source=step.source,
                    size=float(size[i]),
                    std=float(np.sqrt(max(spread[i, i], 0.0))),
                    evidence=evidence,
                    declared=step.declared,
                    found_at=found_at,
                )
                for i, mode in enumerate(self.history.modes)
            ]
        return events


def _evidence(space: StateSpace, step: Step, size: FloatArray, spread: FloatArray) -> float:
    """Log Bayes factor of a declared step: the density ratio at no jump [Dickey1971]."""
    prior = JUMP_STD[step.kind][1 if step.kind == "regreasing" else 0]
    log_det = np.linalg.slogdet(spread)[1] - 2 * size.size * np.log(prior)
    return float(0.5 * (log_det + size @ np.linalg.solve(spread, size)))


def _widening(nis: FloatArray, dof: FloatArray, innovations: FloatArray) -> FloatArray:
    """Factor on standard deviations up to each log, one while the innovations are consistent.

    Innovations that are larger than their bound widen by the ratio; that go on from log to log, by
    what an autocorrelation takes of the number of independent ones.
    """
    total, degrees = np.cumsum(np.where(dof > 0, nis, 0.0)), np.cumsum(dof)
    bound = stats.chi2.isf(_WIDEN, np.maximum(degrees, 1.0))
    factor = np.where(degrees > 0, np.maximum(total / bound, 1.0), 1.0)
    sums, counts = neighbours(innovations)
    n = np.cumsum(counts)
    squares = np.cumsum(np.nansum(innovations**2, axis=1))
    count = np.cumsum(np.isfinite(innovations).sum(axis=1))
    size = squares / np.maximum(count, 1)
    rho = np.clip(np.cumsum(sums) / np.maximum(n, 1) / np.maximum(size, 1e-12), -0.9, 0.9)
    clear = np.cumsum(sums) > stats.norm.isf(_WIDEN) * np.sqrt(np.cumsum(sums**2))
    factor = factor * np.where(clear, (1 + rho) / (1 - rho), 1.0)
    return np.asarray(np.sqrt(factor))


def _effects(space: StateSpace, bank: Bank, sources: tuple[str, ...]) -> tuple[Effect, ...]:
    """Tell what moves the modes without wear, after the last log."""
    modes = space.history.modes
    mean, cov = bank.collapse()
    std = np.sqrt(np.maximum(np.diag(cov), 0.0))
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
        values = bank.settings.scales[:, s]
        scale = float(bank.weight @ values)
        spread = float(np.sqrt(bank.weight @ (values - scale) ** 2))
        effects.append(Effect("", f"scale:{source}", scale, spread))
    return tuple(effects)


def accepted_estimates(history: History, followed: Track) -> History:
    """Give a history as its track takes it: with all steps, without the outliers."""
    values = [np.array(part) for part in (history.ln_frequency, history.ln_damping, history.cov)]
    ln_f, ln_zeta, cov = values
    r = len(history.series)
    for k, mode in followed.outliers:
        own = history.columns(mode)
        ln_f[k, own] = ln_zeta[k, own] = np.nan
        both = [*own, *(r + i for i in own)]
        cov[k, both], cov[k][:, both] = np.nan, np.nan
    return replace(history, ln_frequency=ln_f, ln_damping=ln_zeta, cov=cov, steps=followed.steps)


def outlier_refusals(history: History, followed: Track) -> list[Refusal]:
    """Tell which estimates the track hardly believed."""
    refused = []
    for k, mode in followed.outliers:
        i, own = followed.modes.index(mode), history.columns(mode)
        found = float(np.exp(np.nanmean(history.ln_frequency[k, own])))
        before = float(np.exp(followed.ln_frequency[max(k - 1, 0), i]))
        detail = (
            f"{found:.5g} Hz, or its damping, lies far from what all logs before it tell "
            f"({before:.5g} Hz): a jump is believed once the next log confirms it"
        )
        refused.append(Refusal(log=history.logs[k], mode=mode, reason="jump", detail=detail))
    return refused
