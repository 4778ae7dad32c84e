"""Simulate the life of one stage: schedule, logs, and a table of the truth."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pandas as pd

from models.dynamics.plant import GUIDE_MODES, closed_loop_modes
from models.dynamics.stages import Condition, Stage, stage_named
from models.errors import BadParameter
from models.lives.degradation import Life, life_named
from models.lives.faults import fault_named
from models.recordings.formats import file_suffix, refuse_other_logs, write_log
from models.recordings.machines import COMMISSIONED, machine_identity, stream
from models.recordings.recording import move_velocity, payload_kg, record

_KM_PER_DAY = 12.0
_NOW_KM = (1400.0, 2000.0)
# A life that is simulated to its failure continues for this fraction of it.
_PAST_FAILURE = 0.15
UNTIL = ("now", "failure")
_MAINTENANCE = ["stage", "recorded_at", "travel_km", "action"]
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True, slots=True)
class Plan:
    """What to simulate: stage and life by name, count of logs, seconds of each, seed.

    ``until`` sets the odometer of the last log: ``now``, at an odometer that does not depend on the
    life, or past its ``failure``.  ``faults`` are faults of the recording, by name: each strikes
    a tenth of the logs, at least one.
    """

    stage: str
    life: str
    logs: int
    seconds: float
    seed: int
    file_format: str = "hdf5"
    until: str = "now"
    faults: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Reject impossible plans before any file is written."""
        if self.logs < 1:
            raise BadParameter("logs", self.logs, "at least 1")
        if self.seed < 0:
            raise BadParameter("seed", self.seed, "0 or more")
        move_velocity(stage_named(self.stage), self.seconds)
        file_suffix(self.file_format)
        for name in self.faults:
            fault_named(name)
        if self.until not in UNTIL:
            raise BadParameter("until", self.until, " or ".join(UNTIL))
        if self.draw_life().failure_km() is None and self.until == "failure":
            raise BadParameter("until", self.until, f"now, as {self.life} crosses no limit")
        # The first log is at the beginning.
        if self.until == "failure" and self.logs < 2:
            raise BadParameter("logs", self.logs, "at least 2 for a life until its failure")

    def rng(self, step: str, log: int = 0) -> np.random.Generator:
        """Return the generator of one step of one log: independent of all others."""
        return stream(self.stage, self.seed, step, log)

    def draw_life(self) -> Life:
        """Return the life with the laws of this seed."""
        return life_named(self.life, self.rng("laws"))

    def faults_of(self, log: int) -> list[str]:
        """Return the faults that strike a log (its index)."""
        share = max(1, round(0.1 * self.logs))
        return [
            name
            for name in self.faults
            if log in self.rng(f"faults/{name}").choice(self.logs, share, replace=False)
        ]

    def end_km(self, now_km: float) -> float:
        """Return the odometer (km) of the last log from that of the present."""
        failure = self.draw_life().failure_km()
        if self.until == "now" or failure is None:
            return now_km
        return failure * (1.0 + _PAST_FAILURE)


@dataclass(frozen=True, slots=True)
class Visit:
    """One log of the schedule."""

    index: int
    file: str
    identity: str
    recorded_at: datetime
    travel_km: float
    condition: Condition


def schedule(plan: Plan) -> list[Visit]:
    """Return the logs of a life, oldest first.

    Until now, the odometer of the last log does not depend on the life: how far a stage has run
    does not depend on its damage.
    """
    rng = plan.rng("schedule")
    end_km = plan.end_km(float(rng.uniform(*_NOW_KM)))
    share = (np.arange(plan.logs) + 0.3 * rng.uniform(-1, 1, plan.logs)) / max(plan.logs - 1, 1)
    travel = end_km * np.clip(share, 0.0, 1.0)
    travel[0] = end_km * 0.001
    if plan.logs > 1:
        travel[-1] = end_km
    # Daily use varies; a long gap averages it out.
    gaps = np.diff(travel, prepend=0.0) / _KM_PER_DAY
    days = np.cumsum(gaps * np.exp(0.1 * rng.standard_normal(plan.logs)))
    hours = rng.uniform(-4.0, 6.0, plan.logs)
    # Within a shift of ±hours, never overtaking the neighbour.
    moments = np.maximum.accumulate(days + hours / 24) + np.arange(plan.logs) / 1440
    life, suffix = plan.draw_life(), file_suffix(plan.file_format)
    identity = machine_identity(stage_named(plan.stage), plan.seed)
    visits = []
    for i in range(plan.logs):
        moment = (COMMISSIONED + timedelta(days=float(moments[i]))).replace(microsecond=0)
        km = round(float(travel[i]), 3)
        temperature = round(life.climate.at(moment, plan.rng("temperature", i)), 2)
        condition = life.condition(km, temperature)
        visits.append(Visit(i, f"log-{i + 1:04d}{suffix}", identity, moment, km, condition))
    return visits


def _simulate_log(plan: Plan, visit: Visit, folder: Path) -> dict[str, object]:
    """Write one log and return its row of the truth."""
    stage = stage_named(plan.stage)
    recording = record(
        stage, visit.condition, seconds=plan.seconds, rng=plan.rng("signals", visit.index)
    )
    struck = plan.faults_of(visit.index)
    for name in struck:
        recording = fault_named(name)(recording, plan.rng(f"fault/{name}", visit.index))
    recording = recording.described(
        stage=visit.identity,
        recorded_at=visit.recorded_at.isoformat(),
        travel_km=visit.travel_km,
        servo_id=visit.condition.servo_id,
    )
    write_log(recording, folder / visit.file, plan.file_format)
    return {**truth_row(stage, visit), "faults": " ".join(struck)}


def truth_row(stage: Stage, visit: Visit) -> dict[str, object]:
    """Return what was really so at a log: its condition and every closed-loop mode."""
    condition = visit.condition
    row: dict[str, object] = {
        "file": visit.file,
        "recorded_at": visit.recorded_at.isoformat(),
        "travel_km": visit.travel_km,
        "temperature_c": condition.temperature_c,
        "guide_preload": condition.guide_preload,
        "mount_stiffness": condition.mount_stiffness,
        "payload_kg": payload_kg(stage, condition),
        "servo_id": condition.servo_id,
        "guide_damping_factor": condition.guide_damping,
    }
    modes = {mode.name: mode for mode in closed_loop_modes(stage, condition)}
    # One order in all rows and files: by frequency it would change where modes cross.
    for name in (*GUIDE_MODES, *sorted(modes.keys() - set(GUIDE_MODES))):
        row[f"{name}_hz"] = modes[name].frequency_hz
        row[f"{name}_damping"] = modes[name].damping_ratio
    return row


@contextmanager
def _single_threaded_children() -> Iterator[None]:
    """Limit child processes to one linear-algebra thread each: two workers fill two cores."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _rows(
    plan: Plan, visits: list[Visit], folder: Path, workers: int
) -> Iterator[dict[str, object]]:
    """Yield truth rows in the order of the visits, from this process or a pool."""
    if workers == 1 or len(visits) == 1:
        yield from (_simulate_log(plan, visit, folder) for visit in visits)
        return
    # Spawned, not forked: a forked child inherits threads and their locks.
    with (
        _single_threaded_children(),
        ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool,
    ):
        yield from pool.map(_simulate_log, [plan] * len(visits), visits, [folder] * len(visits))


def simulate_life(
    plan: Plan, folder: Path, *, workers: int = 1, progress: Callable[[int], None] | None = None
) -> None:
    """Write a life: logs, manifest.csv, maintenance.csv and truth.csv.

    Parameters
    ----------
    workers
        Processes; the files do not depend on it.
    progress
        Called with 1 after each log.

    Raises
    ------
    OccupiedFolder
        If the folder holds logs that would not be overwritten.
    """
    if workers < 1:
        raise BadParameter("workers", workers, "at least 1")
    visits = schedule(plan)
    refuse_other_logs(folder, [visit.file for visit in visits])
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for row in _rows(plan, visits, folder, workers):
        rows.append(row)
        if progress is not None:
            progress(1)
    life = plan.draw_life()
    truth = pd.DataFrame(rows)
    for name, limit_km in life.limits_km().items():
        truth[f"{name}_limit_km"] = limit_km
    truth["failure_km"] = life.failure_km()
    truth.to_csv(folder / "truth.csv", index=False)
    _manifest(stage_named(plan.stage), visits).to_csv(folder / "manifest.csv", index=False)
    _maintenance(life, visits).to_csv(folder / "maintenance.csv", index=False)


def _maintenance(life: Life, visits: list[Visit]) -> pd.DataFrame:
    """Return what was done up to the last log, each at the moment that its odometer was reached."""
    travel = [visit.travel_km for visit in visits]
    moments = [visit.recorded_at.timestamp() for visit in visits]
    rows = []
    for work in life.work:
        if work.travel_km <= travel[-1]:
            # Whole seconds, rounded up: never before a log that did not see it.
            moment = math.ceil(float(np.interp(work.travel_km, travel, moments)))
            when = datetime.fromtimestamp(moment, UTC).isoformat()
            rows.append((visits[0].identity, when, work.travel_km, work.action))
    return pd.DataFrame(rows, columns=_MAINTENANCE)


def _manifest(stage: Stage, visits: list[Visit]) -> pd.DataFrame:
    """Return the manifest: metadata of each log, as a user would list them."""
    return pd.DataFrame(
        [
            {
                "file": visit.file,
                "stage": visit.identity,
                "recorded_at": visit.recorded_at.isoformat(),
                "travel_km": visit.travel_km,
                "temperature_c": visit.condition.temperature_c,
                "payload_kg": payload_kg(stage, visit.condition),
                "servo_id": visit.condition.servo_id,
            }
            for visit in visits
        ]
    )
