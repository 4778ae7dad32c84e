"""A life of one stage: schedule, logs, and the truth beside them."""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pandas as pd

from models.degradation import (
    GUIDE_PRELOAD_LIMIT,
    MOUNT_STIFFNESS_LIMIT,
    Life,
    life_named,
)
from models.errors import BadParameter
from models.formats import file_suffix, write_log
from models.plant import GUIDE_MODES, closed_loop_modes
from models.recording import move_velocity, record
from models.stages import Condition, Stage, stage_named

_START = datetime(2026, 3, 2, 8, 0, tzinfo=UTC)
_KM_PER_DAY = 12.0
_NOW_KM = (1400.0, 2000.0)
_MAINTENANCE = ["stage", "recorded_at", "travel_km", "action"]
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True, slots=True)
class Plan:
    """What to simulate: stage and life by name, count of logs, seconds of each, seed."""

    stage: str
    life: str
    logs: int
    seconds: float
    seed: int
    file_format: str = "hdf5"

    def __post_init__(self) -> None:
        """Refuse impossible plans before any file is written."""
        if self.logs < 1:
            raise BadParameter("logs", self.logs, "at least 1")
        if self.seed < 0:
            raise BadParameter("seed", self.seed, "0 or more")
        move_velocity(stage_named(self.stage), self.seconds)
        self.draw_life()
        file_suffix(self.file_format)

    def rng(self, step: str, log: int = 0) -> np.random.Generator:
        """Return the generator of one step of one log: independent of all others."""
        words = [self.seed, zlib.crc32(f"{self.stage}/{step}".encode()), log]
        return np.random.default_rng(np.random.SeedSequence(words))

    def draw_life(self) -> Life:
        """Return the life with the laws of this seed."""
        return life_named(self.life, self.rng("laws"))


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

    The odometer of the last log does not depend on the life: how far a stage has run says
    nothing about its damage.
    """
    rng = plan.rng("schedule")
    now_km = float(rng.uniform(*_NOW_KM))
    share = (np.arange(plan.logs) + 0.3 * rng.uniform(-1, 1, plan.logs)) / max(plan.logs - 1, 1)
    travel = now_km * np.clip(share, 0.0, 1.0)
    travel[0] = now_km * 0.001
    if plan.logs > 1:
        travel[-1] = now_km
    # Daily use varies; a long gap averages it out.
    gaps = np.diff(travel, prepend=0.0) / _KM_PER_DAY
    days = np.cumsum(gaps * np.exp(0.1 * rng.standard_normal(plan.logs)))
    hours = rng.uniform(-4.0, 6.0, plan.logs)
    # Within a shift of ±hours, never overtaking the neighbour.
    moments = np.maximum.accumulate(days + hours / 24) + np.arange(plan.logs) / 1440
    life, suffix = plan.draw_life(), file_suffix(plan.file_format)
    identity = f"LMS-{plan.seed}-{stage_named(plan.stage).identity_suffix}"
    visits = []
    for i in range(plan.logs):
        moment = (_START + timedelta(days=float(moments[i]))).replace(microsecond=0)
        km = round(float(travel[i]), 3)
        temperature = round(life.climate.at(moment, plan.rng("temperature", i)), 2)
        condition = Condition(life.preload.at(km), life.mount.at(km), temperature)
        visits.append(Visit(i, f"log-{i + 1:04d}{suffix}", identity, moment, km, condition))
    return visits


def _simulate_log(plan: Plan, visit: Visit, folder: Path) -> dict[str, object]:
    """Write one log and return its row of the truth."""
    stage = stage_named(plan.stage)
    recording = record(
        stage, visit.condition, seconds=plan.seconds, rng=plan.rng("signals", visit.index)
    )
    recording = recording.described(
        stage=visit.identity,
        recorded_at=visit.recorded_at.isoformat(),
        travel_km=visit.travel_km,
        servo_id="commissioning",
    )
    write_log(recording, folder / visit.file, plan.file_format)
    return truth_row(stage, visit)


def truth_row(stage: Stage, visit: Visit) -> dict[str, object]:
    """Return what was really so at a log: parameters, closed-loop frequencies and damping."""
    row: dict[str, object] = {
        "file": visit.file,
        "recorded_at": visit.recorded_at.isoformat(),
        "travel_km": visit.travel_km,
        "temperature_c": visit.condition.temperature_c,
        "guide_preload": visit.condition.guide_preload,
        "mount_stiffness": visit.condition.mount_stiffness,
    }
    modes = {mode.name: mode for mode in closed_loop_modes(stage, visit.condition)}
    for name in GUIDE_MODES:
        row[f"{name}_hz"] = modes[name].frequency_hz
        row[f"{name}_damping"] = modes[name].damping_ratio
    return row


@contextmanager
def _single_threaded_children() -> Iterator[None]:
    """Give child processes one linear-algebra thread each: two workers fill two cores."""
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
    """
    if workers < 1:
        raise BadParameter("workers", workers, "at least 1")
    folder.mkdir(parents=True, exist_ok=True)
    visits = schedule(plan)
    rows = []
    for row in _rows(plan, visits, folder, workers):
        rows.append(row)
        if progress is not None:
            progress(1)
    life = plan.draw_life()
    truth = pd.DataFrame(rows)
    truth["guide_preload_limit_km"] = life.preload.reaches_km(GUIDE_PRELOAD_LIMIT)
    truth["mount_stiffness_limit_km"] = life.mount.reaches_km(MOUNT_STIFFNESS_LIMIT)
    truth.to_csv(folder / "truth.csv", index=False)
    _manifest(visits).to_csv(folder / "manifest.csv", index=False)
    pd.DataFrame(columns=_MAINTENANCE).to_csv(folder / "maintenance.csv", index=False)


def _manifest(visits: list[Visit]) -> pd.DataFrame:
    """Return the manifest: what is known of each log without opening it."""
    return pd.DataFrame(
        [
            {
                "file": visit.file,
                "stage": visit.identity,
                "recorded_at": visit.recorded_at.isoformat(),
                "travel_km": visit.travel_km,
                "temperature_c": visit.condition.temperature_c,
                "servo_id": "commissioning",
            }
            for visit in visits
        ]
    )
