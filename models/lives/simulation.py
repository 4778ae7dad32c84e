"""Simulate the life of one stage: schedule, logs, and a table of the truth."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass, replace
from datetime import UTC, datetime, timedelta
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from models.dynamics.plant import GUIDE_MODES, closed_loop_modes
from models.dynamics.stages import Condition, Stage, stage_named
from models.errors import BadParameter
from models.lives.circumstances import Contact, circumstances_of, stage_at, wander_of
from models.lives.degradation import Life
from models.lives.drawing import FURTHEST_MM, Machine, draw_machine
from models.lives.faults import fault_named
from models.lives.further_lives import life_named, run_in
from models.lives.wear_families import Product
from models.recordings.effects import effects_named
from models.recordings.formats import file_suffix, refuse_other_logs, write_log
from models.recordings.machines import COMMISSIONED, machine_identity, stream
from models.recordings.recording import Recording, move_velocity, payload_kg, record, room_of

Array = NDArray[np.float64]

_NOW_KM = (1400.0, 2000.0)
# A life that is simulated to its failure continues for this fraction of it.
_PAST_FAILURE = 0.15
# Events of a law, such as shocks, that the table of the truth states.
_EVENTS_WRITTEN = 20
UNTIL = ("now", "failure")
# Courses of a life that the table of the truth states as text.
_LAWS = ("preload", "mount", "grease", "contact", "level")
_MAINTENANCE = ["stage", "recorded_at", "travel_km", "action"]
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True, slots=True)
class Plan:
    """What to simulate: stage and life by name, count of logs, seconds of each, seed.

    ``until`` sets the odometer of the last log: ``now``, at an odometer that does not depend on the
    life, or past its ``failure``.  ``faults`` are faults of the recording, by name: each strikes
    a tenth of the logs, at least one.  With ``plant_seed`` the machine and its laws of wear are
    drawn by it; ``seed`` then draws its schedule and its records only.  ``effects`` names what the
    stage has beyond a linear loop.
    """

    stage: str
    life: str
    logs: int
    seconds: float
    seed: int
    file_format: str = "hdf5"
    until: str = "now"
    faults: tuple[str, ...] = ()
    plant_seed: int | None = None
    effects: str = "linear"

    def __post_init__(self) -> None:
        """Reject impossible plans before any file is written."""
        if self.logs < 1:
            raise BadParameter("logs", self.logs, "at least 1")
        if self.seed < 0:
            raise BadParameter("seed", self.seed, "0 or more")
        if self.plant_seed is not None and self.plant_seed < 0:
            raise BadParameter("plant seed", self.plant_seed, "0 or more")
        move_velocity(stage_named(self.stage), self.seconds)
        file_suffix(self.file_format)
        for name in self.faults:
            fault_named(name)
        effects_named(self.effects)
        if self.until not in UNTIL:
            raise BadParameter("until", self.until, " or ".join(UNTIL))
        if self.draw_life().failure_km() is None and self.until == "failure":
            raise BadParameter("until", self.until, f"now, as {self.life} crosses no limit")
        # The first log is at the beginning.
        if self.until == "failure" and self.logs < 2:
            raise BadParameter("logs", self.logs, "at least 2 for a life until its failure")

    def rng(self, step: str, log: int = 0) -> np.random.Generator:
        """Return the generator of one step of one log: independent of all others."""
        if step == "laws" and self.plant_seed is not None:
            return stream(self.stage, self.plant_seed, "plant/laws")
        return stream(self.stage, self.seed, step, log)

    def machine(self) -> Machine:
        """Return the machine of the plant seed, or the nominal one."""
        return draw_machine(self.stage, self.plant_seed)

    def draw_life(self) -> Life:
        """Return the life with the laws of this seed, and with what a drawn machine has besides."""
        life = life_named(self.life, self.rng("laws"))
        if self.plant_seed is None:
            return life
        numbers = self.machine().numbers
        both = life.circumstances.above(circumstances_of(numbers))
        return replace(run_in(life, numbers), circumstances=both)

    def identity_of_machine(self) -> str:
        """Return the identity of the machine, of drawn ones by the plant seed."""
        stage = stage_named(self.stage)
        seed = self.seed if self.plant_seed is None else f"P{self.plant_seed}"
        return machine_identity(stage, seed)

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
    """One log of the schedule.

    Parameters
    ----------
    condition, contact
        True state; its temperature is that of the structure.
    stage
        The stage as it is at this log.
    logged_temperature_c
        What the log states, °C.
    logged_payload_kg
        What the log states, kg; None if it does not.
    """

    index: int
    file: str
    identity: str
    recorded_at: datetime
    travel_km: float
    condition: Condition
    contact: Contact
    stage: Stage
    logged_temperature_c: float
    logged_payload_kg: float | None


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
        # Of many logs the second is near the first.
        travel[0] = min(travel[0], travel[1] / 2)
        travel[-1] = end_km
    life, suffix = plan.draw_life(), file_suffix(plan.file_format)
    # Daily use varies; a long gap averages it out.
    gaps = np.diff(travel, prepend=0.0) / life.circumstances.km_per_day
    days = np.cumsum(gaps * np.exp(0.1 * rng.standard_normal(plan.logs)))
    hours = rng.uniform(-4.0, 6.0, plan.logs)
    # Within a shift of ±hours, never overtaking the neighbour.
    moments = np.maximum.accumulate(days + hours / 24) + np.arange(plan.logs) / 1440
    moments = _calendar_days(moments, life.circumstances.closed_months)
    travelled = [round(float(km), 3) for km in travel]
    contacts = _contacts(plan, life, travelled)
    identity = plan.identity_of_machine()
    machine = plan.machine().stage
    positions = _positions(plan)
    visits = []
    for i, (km, contact) in enumerate(zip(travelled, contacts, strict=True)):
        moment = (COMMISSIONED + timedelta(days=float(moments[i]))).replace(microsecond=0)
        true_c, logged_c = _temperatures(plan, life, i, moment, km)
        condition = replace(life.condition(km, true_c), position_mm=positions[i])
        payload = payload_kg(machine, condition) if life.circumstances.logs_payload else None
        stage = stage_at(machine, contact, life.circumstances.amplitude_softening)
        name = f"log-{i + 1:04d}{suffix}"
        visits.append(
            Visit(i, name, identity, moment, km, condition, contact, stage, logged_c, payload)
        )
    return visits


def _calendar_days(days: Array, closed_months: tuple[int, ...]) -> Array:
    """Return days since commissioning from days of operation: in closed months there is none."""
    if not closed_months:
        return days
    first = math.floor(days[0])
    needed, day = math.floor(days[-1]) - first + 1, first
    open_days: list[int] = []
    while len(open_days) < needed:
        if (COMMISSIONED + timedelta(days=day)).month not in closed_months:
            open_days.append(day)
        day += 1
    whole = np.floor(days).astype(int)
    return np.asarray(np.array(open_days)[whole - first] + (days - whole))


def _positions(plan: Plan) -> list[float]:
    """Return where the platform stands at each log, mm from the middle of the travel.

    Of a full stage uniform within ±100 mm, or within what the move of the log leaves of the travel;
    rigid stages are alike everywhere and stay in the middle.
    """
    stage = stage_named(plan.stage)
    if stage.flexible is None:
        return [0.0] * plan.logs
    most = min(FURTHEST_MM, 1e3 * room_of(stage, plan.seconds))
    drawn = plan.rng("position").uniform(-most, most, plan.logs)
    # Adding zero makes positive zeros of negative ones.
    return [round(float(place), 1) + 0.0 for place in drawn]


def _contacts(plan: Plan, life: Life, travel_km: list[float]) -> list[Contact]:
    """Return the state of the contacts at every log."""
    what = life.circumstances
    common, own = wander_of(what, np.array(travel_km), plan.rng("wander"))
    level = np.exp(what.level_scatter * plan.rng("level").standard_normal(len(travel_km)))
    return [
        Contact(
            stiffness=life.contact.at(km),
            level=life.level.at(km) * float(level[i]),
            wander_common=float(common[i]),
            wander=(float(own[i, 0]), float(own[i, 1]), float(own[i, 2])),
        )
        for i, km in enumerate(travel_km)
    ]


def _temperatures(
    plan: Plan, life: Life, log: int, moment: datetime, travel_km: float
) -> tuple[float, float]:
    """Return the temperatures (°C) of the structure and of the log."""
    what = life.circumstances
    air = life.climate.at(moment, plan.rng("temperature", log))
    true = life.climate.behind(moment, what.lag_h) if what.lag_h else air
    rng = plan.rng("sensor", log)
    duty, scatter = rng.uniform(), rng.standard_normal()
    logged = air + what.sensor_offset_k + what.sensor_drift_k * travel_km / 1000.0
    logged += what.sensor_scatter_k * float(np.clip(scatter, -3.0, 3.0))
    return round(true + what.self_heating_k * float(duty), 2), round(logged, 2)


def _simulate_log(plan: Plan, visit: Visit, folder: Path) -> dict[str, object]:
    """Write one log and return its row of the truth."""
    recording = record(
        visit.stage,
        visit.condition,
        seconds=plan.seconds,
        rng=plan.rng("signals", visit.index),
        level=visit.contact.level,
        effects=effects_named(plan.effects),
    )
    struck = plan.faults_of(visit.index)
    for name in struck:
        recording = fault_named(name)(recording, plan.rng(f"fault/{name}", visit.index))
    recording = _stating(recording, visit).described(
        stage=visit.identity,
        recorded_at=visit.recorded_at.isoformat(),
        travel_km=visit.travel_km,
        servo_id=visit.condition.servo_id,
    )
    write_log(recording, folder / visit.file, plan.file_format)
    row = truth_row(visit.stage, visit)
    return {**row, "effects": plan.effects, "faults": " ".join(struck)}


def _stating(recording: Recording, visit: Visit) -> Recording:
    """Return a recording that states what its sensor and its operator say."""
    metadata = {**recording.metadata, "temperature_c": visit.logged_temperature_c}
    if visit.logged_payload_kg is None:
        del metadata["payload_kg"]
    return Recording(recording.columns, metadata)


def truth_row(stage: Stage, visit: Visit) -> dict[str, object]:
    """Return what was really so at a log: its condition and every closed-loop mode."""
    condition, contact = visit.condition, visit.contact
    row: dict[str, object] = {
        "file": visit.file,
        "recorded_at": visit.recorded_at.isoformat(),
        "travel_km": visit.travel_km,
        "temperature_c": condition.temperature_c,
        "guide_preload": condition.guide_preload,
        "mount_stiffness": condition.mount_stiffness,
        "payload_kg": payload_kg(stage, condition),
        "servo_id": condition.servo_id,
        "position_mm": condition.position_mm,
        "guide_damping_factor": condition.guide_damping,
        "logged_temperature_c": visit.logged_temperature_c,
        "contact_stiffness_factor": contact.stiffness,
        "excitation_level": contact.level,
        "wander_common": contact.wander_common,
        **{f"wander_{n}": w for n, w in zip(GUIDE_MODES, contact.wander, strict=True)},
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
    pd.concat([truth, _drawn_numbers(plan, life, len(truth))], axis=1).to_csv(
        folder / "truth.csv", index=False
    )
    _manifest(visits).to_csv(folder / "manifest.csv", index=False)
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


def _drawn_numbers(plan: Plan, life: Life, logs: int) -> pd.DataFrame:
    """Return the laws and the numbers of a drawn machine, the same in all rows; else no columns."""
    if plan.plant_seed is None:
        return pd.DataFrame(index=range(logs))
    numbers = {f"plant_{name}": value for name, value in plan.machine().numbers.items()}
    laws = {f"{name}_law": _text_of(getattr(life, name)) for name in _LAWS}
    row = {"plant_seed": plan.plant_seed, **laws, **numbers}
    return pd.DataFrame([row] * logs)


def _text_of(law: Any) -> str:
    """Return a law as ``family(parameter=value, ...)``; of its events the first."""
    if isinstance(law, tuple):
        first = " ".join(f"{value:.6g}" for value in law[:_EVENTS_WRITTEN])
        return f"{first} ..." if len(law) > _EVENTS_WRITTEN else first
    if not is_dataclass(law):
        return f"{law:.6g}"
    if isinstance(law, Product):
        return f"{_text_of(law.first)} * {_text_of(law.second)}"
    inner = ", ".join(f"{f.name}={_text_of(getattr(law, f.name))}" for f in fields(law))
    return _family(law) + (f"({inner})" if inner else "")


def _family(law: object) -> str:
    """Return the name of a law's family in lower case, as it is written in ``truth.csv``."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "-", type(law).__name__).lower()


def _manifest(visits: list[Visit]) -> pd.DataFrame:
    """Return the manifest: metadata of each log, as a user would list them."""
    return pd.DataFrame(
        [
            {
                "file": visit.file,
                "stage": visit.identity,
                "recorded_at": visit.recorded_at.isoformat(),
                "travel_km": visit.travel_km,
                "temperature_c": visit.logged_temperature_c,
                "payload_kg": visit.logged_payload_kg,
                "servo_id": visit.condition.servo_id,
            }
            for visit in visits
        ]
    )
