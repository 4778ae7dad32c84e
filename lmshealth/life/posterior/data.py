"""Data of a life: ln frequencies of the informative modes since the baseline, condensed."""

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Self

import numpy as np

from lmshealth._private.arrays import BoolArray, FloatArray, ReadOnly
from lmshealth._private.tables import fact
from lmshealth.errors import BadStage, NotEnoughData
from lmshealth.life import constants
from lmshealth.life.posterior.scenarios import Scenario, list_scenarios
from lmshealth.stage.description import Stage
from lmshealth.tracking.constants import MAX_STEPS
from lmshealth.tracking.covariates import Regressor, regressors
from lmshealth.tracking.history import History

SECONDS_PER_DAY, KM = 86_400.0, 1000.0
_FEW = 3  # logs at either end of a life, whose mean ln f is compared


@dataclass(frozen=True, slots=True, eq=False)
class LifeData(ReadOnly):
    """Data of a life, ordered by series, and those of a series by log."""

    stage: Stage
    history: History  # all logs, condensed
    regressors: tuple[Regressor, ...]  # covariates of these
    # Series of the history that are used, their modes, and the mode of each, ``(n_series,)``.
    columns: list[int]
    modes: tuple[str, ...]
    mode_of_series: np.ndarray
    # Travel since the baseline in m of each log, shape ``(n_logs,)``, and step of the modes.
    clock: FloatArray
    steps: tuple[float, ...]
    # Series and log of each datum, and its ln f minus the mean of its mode, shape ``(n_data,)``.
    series_of: np.ndarray
    log_of: np.ndarray
    y: FloatArray

    @classmethod
    def select(cls, history: History, stage: Stage, min_logs: int = constants.MIN_LOGS) -> Self:
        """Select the data of a life; raise `NotEnoughData` as `fit_life` describes it."""
        if not stage.parameters:
            raise BadStage(f"{stage.name}: no [[parameter]] to infer")
        whole = with_clock(history, stage)
        history, regressed = _with_regressors(whole, stage, min_logs)
        if not history.has_odometer:
            raise NotEnoughData(
                fact(
                    "{stage}: not every log has travel_km, and degradation laws count by the "
                    "odometer; add it to manifest.csv, or to every row of the table, or state in "
                    'the stage description [life] clock = "days" with [usage] km_per_day',
                    stage=history.stage,
                )
            )
        observed = np.any(np.isfinite(history.ln_frequency[history.baseline :]), axis=0)
        names = [name for name in stage.informative if name in history.modes]
        columns = [i for name in names for i in history.columns(name) if observed[i]]
        of_series = [history.series[i].mode for i in columns]
        modes = tuple(dict.fromkeys(of_series))
        ln_f = history.ln_frequency[history.baseline :, columns]
        all_clock, (_, steps) = clock_and_steps(history)[0], clock_and_steps(whole)
        clock = all_clock[history.baseline :]
        now, n_logs = float(clock.max(initial=0.0)), np.isfinite(ln_f).any(axis=1).sum()
        if n_logs < min_logs or now <= 0:
            raise NotEnoughData(
                fact(
                    "{stage}: logs with a mode of the map: {n}, over {travel:.4g} km; a life "
                    "needs at least {least} logs and some travel",
                    stage=history.stage,
                    n=n_logs,
                    travel=now / 1000,
                    least=min_logs,
                )
            )
        series_of, log_of = np.nonzero(np.isfinite(ln_f.T))
        mode_of_series = np.array([modes.index(name) for name in of_series])
        means = np.array([np.nanmean(ln_f[:, mode_of_series == i]) for i in range(len(modes))])
        y = ln_f[log_of, series_of] - means[mode_of_series[series_of]]
        places = (series_of, log_of, y)
        return cls(stage, history, regressed, columns, modes, mode_of_series, clock, steps, *places)

    @property
    def now(self) -> float:
        """Travel since the baseline at the last log in m."""
        return float(self.clock.max())

    def change(self) -> FloatArray:
        """Return the change of ln f from first to last logs, ``(n_modes,)``."""
        found = np.zeros(len(self.modes))
        for i in range(len(self.modes)):
            own = self.mode_of == i
            order = np.argsort(self.clock[self.log_of[own]], kind="stable")
            y = self.y[own][order]
            n = max(1, min(_FEW, y.size // 2))
            found[i] = y[-n:].mean() - y[:n].mean()
        return found

    @property
    def mode_of(self) -> np.ndarray:
        """Index of the mode of each datum, shape ``(n_data,)``."""
        return np.asarray(self.mode_of_series[self.series_of])

    @property
    def scenarios(self) -> tuple[Scenario, ...]:
        """Scenarios that the laws and the steps allow."""
        free = self.stage.description.life.free
        return list_scenarios(self.stage.parameters, self.steps, self.now, free)

    @property
    def free(self) -> FloatArray:
        """1 for a parameter that may change and 0 for one that keeps its value, by parameter."""
        parameters = self.stage.parameters
        return np.array([float(any(law.names for law in one.laws)) for one in parameters])

    @property
    def sensitivity(self) -> FloatArray:
        """D ln f / d ln parameter at the baseline, 0 if not free, ``(n_modes, n_parameters)``."""
        assert self.stage.modal_map is not None  # select() has checked
        rows = [self.stage.modal_map.modes.index(name) for name in self.modes]
        gradient = self.stage.modal_map.gradient(self.stage.baseline_point[None])
        return np.asarray(gradient[0, rows] * self.free)


def with_clock(history: History, stage: Stage) -> History:
    """Return a history with the odometer that the clock of its description asks for."""
    return replace(history, travel=clock_travel(history.travel, history.seconds, stage))


def clock_travel(travel: FloatArray, seconds: FloatArray, stage: Stage) -> FloatArray:
    """Return the odometer in m that the clock of a description asks for, shape of ``travel``."""
    if stage.description.life.clock == "odometer":
        return travel
    per_day = stage.description.usage.km_per_day
    assert per_day is not None  # the description has been checked
    return np.asarray((seconds - seconds[:1]) / SECONDS_PER_DAY * per_day * KM)


def _with_regressors(
    history: History, stage: Stage, min_logs: int
) -> tuple[History, tuple[Regressor, ...]]:
    """Condense a history and its covariates, without estimates whose covariate is unknown.

    Those are kept that no log with the covariate follows, and all if too few others are left.
    """
    found = regressors(history.covariates, stage, history.recorded_at)
    known = np.array([one.unknown == 0 for one in found], bool).reshape(-1, len(history.logs))
    known_later = np.logical_or.accumulate(known[:, ::-1], axis=1)[:, ::-1]
    lost = (~known & known_later).any(axis=0)
    seen: BoolArray = np.asarray(np.isfinite(history.ln_frequency).any(axis=1))
    if (seen & ~lost)[history.baseline :].sum() >= min_logs:
        ln_f, ln_zeta, cov = map(np.array, (history.ln_frequency, history.ln_damping, history.cov))
        ln_f[lost] = ln_zeta[lost] = cov[lost] = np.nan
        history = replace(history, ln_frequency=ln_f, ln_damping=ln_zeta, cov=cov)
        seen &= ~lost
    # Means over the logs of a group that have an estimate, also of squares and of daily cycles.
    columns = {f"{one.name}:unknown": one.unknown for one in found}
    columns |= {one.name: one.values for one in found}
    averaged = {name: np.where(seen, own, np.nan) for name, own in columns.items()}
    history = condense(replace(history, covariates=averaged), constants.MAX_LOGS)
    means = {name: np.nan_to_num(own) for name, own in history.covariates.items()}
    return history, tuple(
        replace(one, values=means[one.name], unknown=means[f"{one.name}:unknown"]) for one in found
    )


def condense(history: History, most: int) -> History:
    """Average neighbouring logs until there are about so many; return a short history as it is.

    Estimates are averaged by generalised least squares over the logs, series and cross terms of a
    group; moments, odometer and covariates are plain means. A group has the name of its last log.
    The first log of a baseline and the last log stay alone, and no group reaches across a step.
    """
    n = len(history.logs)
    if n <= most:
        return history
    begins = _group_begins(history, -(-n // most))
    ends = np.append(begins[1:], n)
    group_of = np.repeat(np.arange(begins.size), ends - begins)
    parts = [slice(begin, end) for begin, end in zip(begins, ends, strict=True)]
    found = [_average(history, part) for part in parts]
    seconds, r = history.seconds, len(history.series)
    return replace(
        history,
        logs=tuple(history.logs[end - 1] for end in ends),
        recorded_at=tuple(datetime.fromtimestamp(seconds[part].mean(), UTC) for part in parts),
        travel=_means(history.travel, begins),
        covariates={name: _means(own, begins) for name, own in history.covariates.items()},
        ln_frequency=np.array([mean[:r] for mean, _ in found]),
        ln_damping=np.array([mean[r:] for mean, _ in found]),
        cov=np.array([cov for _, cov in found]),
        loop_error=_means(history.loop_error, begins),
        baselines=tuple(int(group_of[k]) for k in history.baselines),
        steps=tuple(
            replace(step, first=int(group_of[step.first]), there=step.there[begins])
            for step in history.steps
        ),
    )


def _group_begins(history: History, size: int) -> np.ndarray:
    """Return the index of the first log of each group of at most so many."""
    n = len(history.logs)
    begins = np.zeros(n, dtype=bool)
    begins[[0, n - 1]] = True
    for k in history.baselines:
        begins[[k, min(k + 1, n - 1)]] = True
    for step in history.steps:
        begins[step.first] = True
        begins[1:] |= np.diff(step.there.astype(int)) != 0
    lengths = np.diff(np.flatnonzero(begins), append=n)
    within = np.concatenate([np.arange(length) for length in lengths])
    return np.flatnonzero(within % size == 0)


def _means(values: FloatArray, begins: np.ndarray) -> FloatArray:
    """Return the mean of each group without missing values, NaN if all are missing."""
    known = np.isfinite(values)
    counts = np.add.reduceat(known.astype(int), begins)
    sums = np.add.reduceat(np.where(known, values, 0.0), begins)
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def _average(history: History, part: slice) -> tuple[FloatArray, FloatArray]:
    """Average ln f and ln ζ of a group: mean ``(2 n_series,)`` and covariance, NaN if missing."""
    values = np.hstack([history.ln_frequency[part], history.ln_damping[part]])
    precision, weighted = np.zeros((values.shape[1],) * 2), np.zeros(values.shape[1])
    for own, cov in zip(values, history.cov[part], strict=True):
        present = np.flatnonzero(np.isfinite(own))
        if present.size:
            block = np.linalg.inv(cov[np.ix_(present, present)])
            precision[np.ix_(present, present)] += block
            weighted[present] += block @ own[present]
    observed = np.flatnonzero(np.isfinite(values).any(axis=0))
    mean, total = np.full(values.shape[1], np.nan), np.full_like(precision, np.nan)
    if observed.size:
        cov = np.linalg.inv(precision[np.ix_(observed, observed)])
        mean[observed] = cov @ weighted[observed]
        total[np.ix_(observed, observed)] = (cov + cov.T) / 2
    return mean, total


def clock_and_steps(history: History) -> tuple[FloatArray, tuple[float, ...]]:
    """Return the travel in m since the baseline of each log, and of each step between two logs."""
    steps = {s.first for s in history.steps if s.kind == "step" and s.first > history.baseline}
    first = sorted(steps)
    clock = history.clock()
    for k in reversed(first):  # at least 1 m is between the logs before and after a step
        before = clock[:k]
        before[before >= clock[k]] = clock[k] - 1.0
    if len(first) > MAX_STEPS:
        raise NotEnoughData(
            fact(
                "{stage}: the modes jumped {n} times since the baseline; no law of a life holds "
                "over so many; maintenance.csv can declare a new baseline",
                stage=history.stage,
                n=len(first),
            )
        )
    return clock, tuple(float((clock[k - 1] + clock[k]) / 2) for k in first)
