"""History: the modal estimates of one machine in order of time, each assigned to its mode."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import pairwise, takewhile
from typing import Any, Literal, Self

import numpy as np

from lmshealth._private.arrays import BoolArray, FloatArray, ReadOnly, freeze
from lmshealth._private.result import Result
from lmshealth._private.tables import fact
from lmshealth.errors import NotEnoughData
from lmshealth.io.log import Notice, Refusal, utc_day
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.modal.modes import Modes
from lmshealth.stage.description import ModeSpec, Stage, search_offset
from lmshealth.tracking import constants
from lmshealth.tracking.association.associate import Association, Estimates, associate
from lmshealth.tracking.contradictions import BY_CLOCK, NO_MOMENT, are_many, without_contradictions
from lmshealth.tracking.covariates import regressors
from lmshealth.tracking.maintenance import RESETS, Action

StepKind = Literal["step", "regreasing", "servo", "sensor", "reset"]

# Order of the series of one mode.
_SOURCES = ("joint", "acc", "frf", "delta_e")
_KINDS: dict[str, StepKind] = {"regrease": "regreasing", "servo": "servo", "sensor": "sensor"}
# Cost of an estimate that gets no name, above all distances within the searches together.
_NO_NAME = 1e3
EXCITATION = "excitation_db"
"""Covariate that the identification measures: needed where frequencies depend on the amplitude."""


@dataclass(frozen=True, slots=True)
class Series:
    """Estimates of one mode by one source."""

    mode: str
    source: str


@dataclass(frozen=True, slots=True, eq=False)
class Step(ReadOnly):
    """A sudden change of the estimates between two logs.

    ``step``: the modes change without a declared cause. ``regreasing``: their dampings change.
    ``servo``: the closed loop changes, in all sources, and ``sensor``: one source does; neither is
    drift. ``reset``: work on guide or mount, which opens a new baseline.
    """

    kind: StepKind
    first: int  # first log after it
    there: BoolArray  # logs that it applies to, ``(n_logs,)``
    source: str = ""  # of a sensor; empty for all sources
    name: str = ""  # its ``servo_id``, or a date
    mode: str = ""  # the only one that jumps; empty for all modes
    declared: bool = True  # else it was detected

    @property
    def changes_modes(self) -> bool:
        """Whether the modes themselves change, and not only their estimates."""
        return self.kind in ("step", "regreasing", "reset")

    @classmethod
    def found(
        cls, kind: StepKind, first: int, n_logs: int, source: str = "", mode: str = ""
    ) -> Self:
        """Make a detected step, which applies to all logs from the first on."""
        return cls(kind, first, np.arange(n_logs) >= first, source, mode=mode, declared=False)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class History(Result):
    """All modal estimates of one stage, in the order of recording."""

    stage: str  # identity of the machine
    logs: tuple[str, ...]  # their names
    recorded_at: tuple[datetime, ...]  # never decreasing
    travel: FloatArray  # odometer in m, ``(n_logs,)``; NaN throughout where there is none
    covariates: dict[str, FloatArray]  # by column name, ``(n_logs,)`` each, NaN where unknown
    modes: tuple[str, ...]  # their names
    series: tuple[Series, ...]  # columns of the estimates
    ln_frequency: FloatArray  # ln of Hz, ``(n_logs, n_series)``, NaN where the mode was not found
    ln_damping: FloatArray  # ln ζ, likewise
    # Covariance of ``[ln_frequency, ln_damping]``, ``(n_logs, 2 n_series, 2 n_series)``, NaN in the
    # rows and columns of what is missing.
    cov: FloatArray
    loop_error: FloatArray  # RMS following error below 40 Hz in m, ``(n_logs,)``, NaN where unknown
    baselines: tuple[int, ...]  # logs at which health is 1: the first, and one after each reset
    steps: tuple[Step, ...] = ()  # declared ones, in order
    contradictions: int = 0  # most logs in a row that are left out for their odometer or date
    # Columns of the estimates of the present baseline's first log that those after it contradict.
    in_doubt: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        n, r = len(self.logs), len(self.series)
        columns = "ln_frequency ln_damping", n, r
        freeze(self, ("travel loop_error", n), columns, ("cov", n, 2 * r, 2 * r))
        if not self.baselines or not all(0 <= first < max(n, 1) for first in self.baselines):
            raise ValueError(f"baselines are logs {self.baselines} of {n}")
        if {one.mode for one in self.series} - set(self.modes):
            raise ValueError(f"series {self.series} of modes that are not among {self.modes}")
        for name, ticks in (("recorded_at", self.seconds), ("travel", self.travel)):
            back = np.flatnonzero(np.diff(ticks) < 0)
            if back.size:
                log = self.logs[back[0] + 1]
                raise ValueError(f"{name} runs backwards at {log}: sort the logs")
        self._expect_errors()

    def _expect_errors(self) -> None:
        """Require a covariance of every estimate, with positive variances."""
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

    def title(self) -> str:
        """Return machine, number of logs, and their time and travel."""
        ends = ""
        if self.logs:
            ends = f", {utc_day(self.recorded_at[0])} to {utc_day(self.recorded_at[-1])}"
            if self.has_odometer:
                ends += f", {self.travel[0] / 1000:.6g} to {self.travel[-1] / 1000:.6g} km"
        return f"History of {self.stage}: {len(self.logs)} logs{ends}"

    def to_columns(self) -> dict[str, Any]:
        """Return the estimates, one row per log and series; NaN where a mode was not found."""
        n, r = len(self.logs), len(self.series)
        std = np.sqrt(np.einsum("kii->ki", self.cov))
        frequency, damping = np.exp(self.ln_frequency), np.exp(self.ln_damping)
        return {
            "stage": self.stage,
            "log": np.repeat(np.array(self.logs, dtype=object), r),
            "recorded_at": np.repeat([moment.isoformat() for moment in self.recorded_at], r),
            "travel_km": np.repeat(self.travel / 1000, r),
            **{name: np.repeat(values, r) for name, values in self.covariates.items()},
            "mode": np.tile([one.mode for one in self.series], n),
            "source": np.tile([one.source for one in self.series], n),
            "frequency_hz": frequency.ravel(),
            "frequency_std_hz": (frequency * std[:, :r]).ravel(),
            "damping_ratio": damping.ravel(),
            "damping_ratio_std": (damping * std[:, r:]).ravel(),
        }

    def digest_columns(self) -> dict[str, Any]:
        """Return number of estimates, first and last frequency of each series."""
        found = [own[np.isfinite(own)] for own in np.exp(self.ln_frequency).T]
        ends = np.array([(own[0], own[-1]) if own.size else (np.nan,) * 2 for own in found])
        return {
            "mode": [one.mode for one in self.series],
            "source": [one.source for one in self.series],
            "logs": [own.size for own in found],
            "first_hz": ends.reshape(-1, 2)[:, 0],
            "last_hz": ends.reshape(-1, 2)[:, 1],
        }

    @property
    def baseline(self) -> int:
        """Index of the log at which the present baseline begins."""
        return self.baselines[-1]

    @property
    def has_odometer(self) -> bool:
        """Whether the odometer is the clock; else it is the time."""
        return bool(np.isfinite(self.travel).all())

    @property
    def seconds(self) -> FloatArray:
        """Moments of the logs in s since 1970, shape ``(n_logs,)``."""
        return np.array([moment.timestamp() for moment in self.recorded_at])

    def clock(self) -> FloatArray:
        """Return odometer (m), or time (s) without one, since the baseline, shape ``(n_logs,)``."""
        ticks = self.travel if self.has_odometer else self.seconds
        return np.asarray(ticks - ticks[self.baseline])

    def first_logs(self, n: int) -> Self:
        """Return the history as it was after its first n logs."""
        steps = (replace(one, there=one.there[:n]) for one in self.steps if one.first < n)
        return replace(
            self,
            logs=self.logs[:n],
            recorded_at=self.recorded_at[:n],
            travel=self.travel[:n],
            covariates={name: values[:n] for name, values in self.covariates.items()},
            ln_frequency=self.ln_frequency[:n],
            ln_damping=self.ln_damping[:n],
            cov=self.cov[:n],
            loop_error=self.loop_error[:n],
            baselines=tuple(first for first in self.baselines if first < n),
            steps=tuple(steps),
            in_doubt=self.in_doubt if n > self.baseline else (),
        )

    def backwards(self, first: int, last: int) -> Self:
        """Return the logs from the last back to the first, without steps."""
        own = slice(first, last + 1)
        ends = self.recorded_at[first], self.recorded_at[last]
        return replace(
            self,
            logs=self.logs[own][::-1],
            recorded_at=tuple(ends[0] + (ends[1] - at) for at in self.recorded_at[own][::-1]),
            travel=self.travel[last] - self.travel[own][::-1],
            covariates={name: values[own][::-1] for name, values in self.covariates.items()},
            ln_frequency=self.ln_frequency[own][::-1],
            ln_damping=self.ln_damping[own][::-1],
            cov=self.cov[own][::-1],
            loop_error=self.loop_error[own][::-1],
            baselines=(0,),
            steps=(),
        )

    def mode_of(self) -> np.ndarray:
        """Return the index of the mode of each series, shape ``(n_series,)``."""
        return np.array([self.modes.index(one.mode) for one in self.series], dtype=int)

    def columns(self, mode: str) -> list[int]:
        """Return the indices of the series of a mode, in their order."""
        return [i for i, one in enumerate(self.series) if one.mode == mode]


def build_history(
    readings: Sequence[LogEstimates], stage: Stage | None = None, actions: Sequence[Action] = ()
) -> tuple[History, list[Refusal]]:
    """Assign the estimates of one machine to its modes, in the order of time.

    Parameters
    ----------
    readings : sequence of LogEstimates
        Logs of one machine in any order, with identity and moment; the odometer is the clock where
        every log has it, else the time is.
    stage : Stage, optional
        Names the tracked modes; without it all are, and those without a name are named by their
        frequency.
    actions : sequence of Action
        Maintenance. Work on guide or mount opens a new baseline; a regreasing, a retuning and a new
        sensor are steps, as is every change of ``servo_id``.

    Returns
    -------
    history : History
        Its first baseline is the first log that the manifest declares one, else the first log.
    refused : list of Refusal
        Logs whose odometer, date or sample rate contradicts the others, which are left out, and
        estimates that are assigned to no mode, which are missing.

    Raises
    ------
    NotEnoughData
        If there is no log.

    Examples
    --------
    >>> import lmshealth
    >>> from lmshealth import examples
    >>> stage = lmshealth.load_stage("lms-y")
    >>> history, refused = lmshealth.build_history(examples.readings(), stage)
    >>> len(history.logs), len(refused), history.modes
    (24, 0, ('roll', 'pitch', 'yaw'))
    >>> print(f"{history.travel[-1] / 1000:.0f} km")
    1632 km
    """
    if not readings:
        name = "" if stage is None else f"{stage.name}: "
        raise NotEnoughData(f"{name}no usable log")
    ordered, refused, in_a_row = without_contradictions(readings)
    declared = {reading.log for reading in readings if reading.metadata.baseline}
    refused = [replace(one, baseline=one.log in declared) for one in refused]
    # Missing values are None here and NaN in arrays.
    travel = np.array([r.metadata.travel for r in ordered], dtype=float)
    moments = tuple(r.metadata.recorded_at or NO_MOMENT for r in ordered)
    has_odometer = bool(np.isfinite(travel).all())
    clock = travel if has_odometer else np.array([moment.timestamp() for moment in moments])
    names = sorted({name for reading in ordered for name in reading.metadata.covariates})
    covariates = {
        name: np.array([r.metadata.covariates.get(name) for r in ordered], dtype=float)
        for name in names
    }
    if stage is not None and any(c.name == EXCITATION for c in stage.description.covariate):
        covariates.setdefault(EXCITATION, _excitation(ordered))
    steps = _steps(ordered, actions)
    regressed = regressors(covariates, stage)
    estimates = _estimates(ordered, stage)
    found = associate(
        estimates,
        clock,
        offsets=np.array([one.values for one in regressed]).reshape(-1, len(ordered)).T,
        prior_std=np.array([one.prior_std for one in regressed]),
        jumps={step.first for step in steps},
    )
    # Jumps are left to the tracker.
    refused += [
        Refusal(
            log=ordered[k].log,
            mode=estimates[k].names[i],
            source=estimates[k].sources[i],
            reason=label.reason,
            detail=label.detail,
        )
        for k, i, label in found.unassigned
        if label.reason != "jump"
    ]
    modes, series, columns = _line_up(estimates, found, stage)
    refused += _undescribed(ordered, estimates, found, modes)
    history = History(
        stage=str(ordered[0].metadata.stage),
        logs=tuple(reading.log for reading in ordered),
        recorded_at=moments,
        travel=travel if has_odometer else np.full_like(travel, np.nan),
        covariates=covariates,
        modes=modes,
        series=series,
        **columns,
        loop_error=np.array([r.loop_error or np.nan for r in ordered], dtype=float),
        baselines=_baselines(ordered, steps),
        steps=steps,
        contradictions=in_a_row,
    )
    return history, refused


def _excitation(ordered: Sequence[LogEstimates]) -> FloatArray:
    """Return the level of the excitation of each log in dB, ``(n_logs,)``, NaN where unknown.

    It is the mean over its modes of the levels that each mode has over those of its first log.
    """
    first: dict[str, float] = {}
    found = np.full(len(ordered), np.nan)
    for k, reading in enumerate(ordered):
        modes = reading.modes
        known = {
            name: 20 * np.log10(level)
            for name, level in zip(modes.names, modes.excitation, strict=True)
            if level > 0
        }
        if known:
            # A mode that appears later begins at the level of the others.
            others = [level - first[name] for name, level in known.items() if name in first]
            found[k] = float(np.mean(others)) if others else 0.0
            first |= {n: x - found[k] for n, x in known.items() if n not in first}
    return found


def _steps(ordered: Sequence[LogEstimates], actions: Sequence[Action]) -> tuple[Step, ...]:
    """Return the declared steps between the logs."""
    moments = [reading.metadata.recorded_at for reading in ordered]
    steps: list[Step] = []
    ids = [""]
    for reading in ordered:  # an unknown tuning is that of the log before
        ids.append(reading.metadata.servo_id or ids[-1])
    known = [name for name in dict.fromkeys(ids) if name]
    for name in known[1:]:
        there = np.array(ids[1:]) == name
        steps.append(Step("servo", int(np.argmax(there)), there, name=name))
    for action in sorted(actions, key=lambda action: action.recorded_at):
        later = np.array([m is not None and m >= action.recorded_at for m in moments])
        first = int(np.argmax(later))
        # Actions before the first log or after the last have no effect on the estimates.
        if not later.any() or first == 0:
            continue
        kind: StepKind = "reset" if action.action in RESETS else _KINDS[action.action]
        # A retuning that comes with a new servo_id is one step, and so is work on guide and mount.
        if any((step.kind, step.first) == (kind, first) for step in steps):
            continue
        name = action.recorded_at.date().isoformat()
        steps.append(Step(kind, first, np.arange(len(ordered)) >= first, name=name))
    return tuple(sorted(steps, key=lambda step: step.first))


def _baselines(ordered: Sequence[LogEstimates], steps: Sequence[Step]) -> tuple[int, ...]:
    """Return the first log of each baseline: the first declared one since the last reset."""
    declared = [k for k, reading in enumerate(ordered) if reading.metadata.baseline]
    begins = [0, *(step.first for step in steps if step.kind == "reset"), len(ordered)]
    return tuple(
        dict.fromkeys(
            next((k for k in declared if begin <= k < end), begin)
            for begin, end in pairwise(begins)
        )
    )


def _estimates(ordered: Sequence[LogEstimates], stage: Stage | None) -> list[Estimates]:
    """Return the estimates of tracked modes of each log, with shapes over all channels."""
    tracked = [] if stage is None else [mode for mode in stage.modes if mode.tracked]
    channels = list(dict.fromkeys(c for r in ordered for c in r.modes.shape_channels))
    estimates = []
    for modes in (reading.modes for reading in ordered):
        names = dict(enumerate(modes.names)) if stage is None else _tracked(modes, tracked)
        n, kept = len(modes.names), sorted(names)
        shapes = np.full((n, len(channels)), np.nan)
        shapes[:, [channels.index(channel) for channel in modes.shape_channels]] = modes.shapes
        at = np.array(kept, dtype=int)
        both = np.concatenate([at, at + n])
        estimates.append(
            Estimates(
                names=tuple(names[i] for i in kept),
                sources=tuple(modes.sources[i] for i in kept),
                ln_frequency=modes.ln_frequency[at],
                ln_damping=modes.ln_damping[at],
                cov=modes.cov[both[:, None], both],
                shapes=shapes[at],
            )
        )
    return estimates


def _tracked(modes: Modes, tracked: Sequence[ModeSpec]) -> dict[int, str]:
    """Return the indices of the estimates that may be of tracked modes, with their names.

    Those without a name in the search of a mode are assigned to the modes that no other estimate of
    the log by the same source has, one to one and as near as possible together; one that is nearest
    to a mode with an estimate stays without a name.
    """
    known = [mode.name for mode in tracked]
    found = {i: name for i, name in enumerate(modes.names) if name in known}
    unnamed = [i for i, name in enumerate(modes.names) if not name]
    if not unnamed or not tracked:
        return found
    from scipy.optimize import linear_sum_assignment  # late: most logs have names

    described, search = np.array([(mode.frequency_hz, mode.search) for mode in tracked]).T
    off = np.abs(search_offset(modes.frequency[:, None], described, search))
    for source in dict.fromkeys(modes.sources):
        own = [i for i in unnamed if modes.sources[i] == source and off[i].min() <= 1]
        found |= dict.fromkeys(own, "")
        taken = {name for i, name in found.items() if name and modes.sources[i] == source}
        is_free = np.array([name not in taken for name in known])
        open_ = [i for i in own if is_free[off[i].argmin()]]
        cost = np.where(is_free & (off[open_] <= 1), off[open_], _NO_NAME)
        for row, column in zip(*linear_sum_assignment(cost), strict=True):
            if cost[row, column] < _NO_NAME:
                found[open_[row]] = known[column]
    return found


def _undescribed(
    ordered: Sequence[LogEstimates],
    estimates: Sequence[Estimates],
    found: Association,
    modes: Sequence[str],
) -> list[Refusal]:
    """Refuse the estimates of modes that are not described."""
    refused = []
    for reading, own, labels in zip(ordered, estimates, found.labels, strict=True):
        for ln_f, source, label in zip(own.ln_frequency, own.sources, labels, strict=True):
            if label.mode is not None and label.mode not in modes:
                f = float(np.exp(ln_f))
                detail = (
                    f"a resonance at {f:.5g} Hz is not clearly any described mode: describe it, or "
                    "correct the description"
                )
                refused.append(
                    Refusal(
                        reading.log, "undescribed", detail, mode=f"{f:.5g} Hz", source=source,
                        frequency=f,
                    )
                )  # fmt: skip
    return refused


def _line_up(
    estimates: Sequence[Estimates], found: Association, stage: Stage | None
) -> tuple[tuple[str, ...], tuple[Series, ...], dict[str, Any]]:
    """Put the estimates of every mode and source in a column; missing ones are NaN."""
    # A jump keeps its name: the tracker decides whether it is an outlier or a step.
    assigned = [
        (k, i, (name if label.reason == "jump" else label.mode, source))
        for k, (one, labels) in enumerate(zip(estimates, found.labels, strict=True))
        for i, (name, source, label) in enumerate(zip(one.names, one.sources, labels, strict=True))
    ]
    seen = {(mode, source) for _, _, (mode, source) in assigned if mode is not None}
    order = found.modes
    if stage is not None:
        order = tuple(mode.name for mode in stage.modes if mode.tracked)
    named = {mode for mode, _ in seen}
    modes = tuple(mode for mode in order if mode in named)
    sources = [*_SOURCES, *sorted({source for _, source in seen} - {*_SOURCES})]
    series = tuple(Series(m, s) for m in modes for s in sources if (m, s) in seen)
    places = {(one.mode, one.source): i for i, one in enumerate(series)}
    pairs: list[list[tuple[int, int]]] = [[] for _ in estimates]
    for k, i, (mode, source) in assigned:
        if mode is not None and (mode, source) in places:
            pairs[k].append((places[mode, source], i))
    n, r = len(estimates), len(series)
    ln_f, ln_zeta = np.full((n, r), np.nan), np.full((n, r), np.nan)
    cov = np.full((n, 2 * r, 2 * r), np.nan)
    for k, (one, own) in enumerate(zip(estimates, pairs, strict=True)):
        to, of = np.array(own, dtype=int).reshape(-1, 2).T
        ln_f[k, to], ln_zeta[k, to] = one.ln_frequency[of], one.ln_damping[of]
        to, of = np.concatenate([to, to + r]), np.concatenate([of, of + len(one.names)])
        cov[k, to[:, None], to] = one.cov[of[:, None], of]
    return modes, series, {"ln_frequency": ln_f, "ln_damping": ln_zeta, "cov": cov}


def doubt_of_clock(history: History, refused: Sequence[Refusal]) -> str:
    """Return why odometer and dates do not allow any health; empty where they do.

    So many logs contradict the others, in all or in a row, that a clock was reset and it is not
    known which are right.
    """
    n = sum(one.reason in BY_CLOCK for one in refused)
    total = n + len(history.logs)
    if history.contradictions <= constants.FEW_CONTRADICTIONS and not are_many(n, total):
        return ""
    return fact(
        "In {n} of {total} logs odometer or date contradicts the others, as after a reset: which "
        "of them are right is not known, so that no health is published.",
        n=n,
        total=total,
    )


def contradiction_notices(history: History, refused: Sequence[Refusal]) -> list[Notice]:
    """Return notices about logs of a machine that contradict the others."""
    rates = [one.log for one in refused if one.reason == "odd-rate"]
    notices = []
    if rates:
        what = fact(
            "Logs with another sample rate, which their frequencies follow: {n}, left out.",
            n=len(rates),
        )
        to_do = fact(
            "Find out which rate is right (refused.csv has both), and correct manifest.csv."
        )
        notices.append(Notice("odd-rate", "caution", rates[0], what, to_do))
    times = [one.log for one in refused if one.reason in BY_CLOCK]
    if not times:
        return notices
    to_do = fact("Correct odometer or date of the logs of refused.csv in manifest.csv.")
    if doubt := doubt_of_clock(history, refused):
        return [*notices, Notice("logs-contradict", "serious", times[-1], doubt, to_do)]
    what = fact(
        "In {n} of {total} logs odometer or date contradicts the others: left out.",
        n=len(times),
        total=len(times) + len(history.logs),
    )
    return [*notices, Notice("logs-left-out", "caution", times[-1], what, to_do)]


def missing_mode_notices(history: History, refused: Sequence[Refusal]) -> list[Notice]:
    """List modes that the last logs do not detect, or whose estimates are ambiguous there."""
    least = constants.MISSING_LOGS
    # Logs at the end in a row that are ambiguous, by mode.
    ambiguous: dict[str, int] = {}
    for name in history.modes:
        doubtful = {r.log for r in refused if (r.reason, r.mode) == ("ambiguous", name)}
        n = sum(1 for _ in takewhile(doubtful.__contains__, reversed(history.logs)))
        if n >= least:
            ambiguous[name] = n
    notices = []
    for n in sorted(set(ambiguous.values()), reverse=True):
        names = " and ".join(name for name, own in ambiguous.items() if own == n)
        what = fact(
            "{names}: the estimates of the last {n} logs are ambiguous, so that nothing new is "
            "known; logs with more channels would distinguish modes by their shapes.",
            names=names,
            n=n,
        )
        notices.append(Notice("ambiguous-modes", "caution", names, what))
    for name in history.modes:
        found = np.flatnonzero(np.isfinite(history.ln_frequency[:, history.columns(name)]).any(1))
        missed = len(history.logs) - 1 - int(found.max(initial=-1))
        if missed >= least and name not in ambiguous:
            what = fact(
                "{name}: no estimate in the last {n} logs; nothing new is known.",
                name=name,
                n=missed,
            )
            to_do = fact("refused.csv has the reasons in its rows of {name}.", name=name)
            notices.append(Notice("mode-missing", "caution", name, what, to_do))
    return notices
