"""Measured machines whose state is known: their logs, descriptions, and maps from mechanics."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import ndimage
from scipy.linalg import eigh

from studies.harness.data.samples import MAPS
from studies.modes.decays.beam import TABLE, find_dwells, read_beam
from studies.modes.real.building import STAGE, write_log

BEGIN = datetime(2026, 1, 1, tzinfo=UTC)  # one log a day: the order of the logs is ours
MODEL_STD = 0.05  # what the description takes where a map states no error

# --- Beam: a cantilever on a roller (DROPBEAR, data set 8) ----------------------------------------
# Dimensions in m (README of the set), and of structural steel its modulus in Pa and density.
LENGTH, THICKNESS, MODULUS, DENSITY = 0.501, 0.00666, 200e9, 7850.0
# Distance of the roller from the clamp in mm: the testbed's range (README of data set 2), which
# the commands of the set divide into five equal steps.
PLACES = np.linspace(48.0, 175.0, 6)
REPEATS, QUICK_REPEATS = 11, 3
DAMPING = (0.0073, 0.0022, 0.0013, 0.0010, 0.0008, 0.0013)
# The roller rests where its smoothed sensor stays this near to the level of the dwell; a log holds
# at least so much of that, and so much before it that is marked as moving (V, s, s).
_STILL, _LEAST, _BEFORE = 0.0025, 0.4, 0.04

# --- Frame: three storeys on a shaking table, on stiff and on flexible columns ------------------
EVENTS = ("Sine1.0", "Sine1.5", "Sine2.0", "Northridge", "BonusEvent")
FLOORS = ("3rd", "2nd", "1st")  # their loggers were not started together: a log each
FRAMES = {"Stiff": {"first": 7.9, "second": 25.0}, "Flexible": {"first": 3.7, "second": 11.2}}
FRAME_DAMPING = 0.008
# Periods of the first mode in s, stated by the authors of the set: stiffness over mass.
STIFFNESS_LEFT = (0.1274 / 0.274) ** 2

_DESCRIPTION = """\
name = "{name}"
[[parameter]]
name = "{parameter}"
baseline = {baseline}
prior = {{ kind = "uniform", low = {low}, high = {high} }}
{unit}
[map]
file = "{name}.map.csv"
model_std = {model_std}
[life]
clock = "days"
[usage]
km_per_day = 1.0
horizon_km = 100.0
"""
_MODE = """
[[mode]]
name = "{}"
frequency_hz = {}
damping_ratio = {}
"""


@dataclass(frozen=True, slots=True)
class Machine:
    """A folder of logs of one machine, its description, and what is known of it."""

    set: str
    name: str
    kind: str  # ``change``, ``same``, or ``beyond`` what the description can hold
    logs: Path
    stage: Path
    parameter: str
    before: float  # state in which the first logs were recorded, and the last ones
    after: float
    unit: str = ""
    columns: Path | None = None

    @property
    def words(self) -> list[object]:
        """Return the command line that analyses it, without its output."""
        columns = () if self.columns is None else ("--columns", self.columns)
        return ["run", self.logs, "--stage", self.stage, *columns]


def check_recordings(data: Path) -> None:
    """End the study with the next step where a recording that its full form needs is missing."""
    beams = [f"dropbear_ds8/open/10steps_test{k}.txt.gz" for k in range(REPEATS)]
    frames = product(FRAMES, EVENTS, FLOORS)
    every = [*beams, *("shake_3storey/open/{}_{}_{}.csv".format(*one) for one in frames)]
    if lacking := [name for name in every if not (data / name).exists()]:
        raise SystemExit(
            f"{data}: {len(lacking)} of {len(every)} recordings are missing, the first is "
            f"{lacking[0]}; `python -m studies.health.measured.fetch {data}` fetches them"
        )


@cache
def bending(place: float) -> float:
    """Return the first natural frequency in Hz of the beam with its roller at a place in mm.

    Ritz's method for a beam of Euler and Bernoulli; clamp and roller, a support of no width, are
    rigid. Powers of x that vanish at both, and a cube that begins at the roller.
    """
    a, points, weights = place / 1e3 / LENGTH, *np.polynomial.legendre.leggauss(16)
    x = np.r_[a * (1 + points) / 2, a + (1 - a) * (1 + points) / 2]
    each = np.r_[a * weights, (1 - a) * weights] / 2
    powers, behind = np.arange(3, 10)[:, None], np.maximum(x - a, 0)
    shape = np.vstack([x**powers - a ** (powers - 2) * x**2, behind**3])
    bend = np.vstack(
        [powers * (powers - 1) * x ** (powers - 2) - 2 * a ** (powers - 2), 6 * behind]
    )
    squared = eigh((bend * each) @ bend.T, (shape * each) @ shape.T, eigvals_only=True)[0]
    wave = np.sqrt(MODULUS / DENSITY / 12) * THICKNESS / LENGTH**2
    return float(np.sqrt(squared) * wave / (2 * np.pi))


def write_stage(
    folder: Path,
    name: str,
    parameter: tuple[str, float, str],
    modes: Iterable[tuple[str, float, float]],
    table: dict[str, NDArray[np.float64]],
    at: NDArray[np.float64],
) -> Path:
    """Write a description and its map: frequencies in Hz of ``modes`` over the parameter ``at``."""
    called, baseline, unit = parameter
    rows = [
        {called: value, "mode": mode, "frequency_hz": f}
        for mode, column in table.items()
        for value, f in zip(at, column, strict=True)
    ]
    folder.mkdir(parents=True, exist_ok=True)
    pd.DataFrame(rows).to_csv(folder / f"{name}.map.csv", index=False)
    text = _DESCRIPTION.format(
        name=name, parameter=called, baseline=baseline, unit=f'unit = "{unit}"' if unit else "",
        low=1.01 * at[0], high=0.99 * at[-1], model_std=MODEL_STD,
    ) + "".join(_MODE.format(*mode) for mode in modes)  # fmt: skip
    path = folder / f"{name}.toml"
    path.write_text(text, encoding="utf-8")
    return path


def write_manifest(folder: Path, name: str) -> None:
    """Date the logs of a folder, one a day in the order of their names."""
    files = sorted(path.name for path in folder.glob("*.csv"))
    days = [(BEGIN + timedelta(days=k)).isoformat() for k in range(len(files))]
    table = pd.DataFrame({"file": files, "stage": name, "recorded_at": days})
    table.to_csv(folder / "manifest.csv", index=False)


def beam(data: Path, scratch: Path, *, quick: bool) -> list[Machine]:
    """Return the machines of the beam: its roller moved by one step, or by five, or left alone."""
    repeats = range(QUICK_REPEATS if quick else REPEATS)
    ways = [(k, way) for k in range(6) for way in ("up", "down")]
    dwells: dict[tuple[int, str], list[Path]] = {one: [] for one in ways}
    for repeat in repeats:
        for where, log in cut_dwells(data, repeat, scratch / "dwells").items():
            dwells[where].append(log)
    wide, near = np.geomspace(30.0, 215.0, 15), np.geomspace(0.95, 1.05, 5)

    def machine(before: int, after: int, kind: str, at: NDArray[np.float64] = wide) -> Machine:
        name = f"beam-{PLACES[before]:.0f}-{PLACES[after]:.0f}-{kind}"
        first, later = dwells[before, "up"], dwells[after, "down"]
        (scratch / name).mkdir()
        for n, log in enumerate([*first, *later]):
            shutil.copy(log, scratch / name / f"{n:03d}.csv")
        write_manifest(scratch / name, name)
        start = float(PLACES[before])
        stage = write_stage(
            scratch / f"{name}-stage", "beam", ("roller_mm", start, "mm"),
            [("bending", list(TABLE.values())[before], DAMPING[before])],
            {"bending": np.array([bending(float(place)) for place in at])}, at,
        )  # fmt: skip
        logs, end = scratch / name, float(PLACES[after])
        return Machine("beam", name, kind, logs, stage, "roller_mm", start, end, "mm")

    if quick:
        return [machine(4, 4, "same"), machine(4, 3, "change")]
    # At 48 mm the half second after a stop that is used holds too few periods of a mode alone.
    found = [machine(k, k, "same") for k in range(1, 6)]
    found += [machine(k + 1, k, "change") for k in range(5)]
    return [*found, machine(5, 0, "beyond"), machine(5, 4, "beyond", PLACES[5] * near)]


def cut_dwells(data: Path, repeat: int, out: Path) -> dict[tuple[int, str], Path]:
    """Write a log of each rest of the roller in a repeat; return them by place and way."""
    trial = read_beam(data, repeat)
    values = {channel.name: channel.values[:] for channel in trial.channels}
    rate, position = trial.sample_rate, values["delta_e_roller"]
    smooth = ndimage.median_filter(position, 101, mode="nearest")
    out.mkdir(parents=True, exist_ok=True)
    found, before = {}, round(_BEFORE * rate)
    for k, (dwell, level) in enumerate(find_dwells(trial)):
        off = np.abs(smooth[dwell.start : dwell.stop] - level) > _STILL
        middle = off.size // 2
        early, late = np.flatnonzero(off[:middle]), np.flatnonzero(off[middle:])
        start = max(dwell.start + (int(early[-1]) + 1 if early.size else 0), before)
        stop = dwell.start + (middle + int(late[0]) if late.size else off.size)
        if stop - start < _LEAST * rate:
            continue
        part = slice(start - before, stop)
        table = pd.DataFrame({f"{c}_m_s2": values[c][part] for c in ("acc_low", "acc_high")})
        table["reference_velocity_mm_s"] = np.where(np.arange(len(table)) < before, 1.0, 0.0)
        path = out / f"{repeat:02d}-{k:02d}.csv"
        with path.open("w", encoding="utf-8") as file:
            file.write(f"# sample_rate_hz: {rate:.9g}\n")
            table.to_csv(file, index=False)
        found[(k, "up") if k <= 5 else (10 - k, "down")] = path
    return found


def frame(data: Path, scratch: Path) -> list[Machine]:
    """Return the machines of the frame: on each kind of columns, and on weaker ones later."""
    folder, scale = data / "shake_3storey/open", np.geomspace(0.1, 1.6, 9)

    def machine(kind: str, *frames: str) -> Machine:
        name = f"frame-{'-'.join(frames).lower()}"
        (scratch / name).mkdir()
        every = [(f, e, floor) for f in frames for e in EVENTS for floor in FLOORS]
        for n, which in enumerate(every):
            shutil.copy(folder / "{}_{}_{}.csv".format(*which), scratch / name / f"{n:03d}.csv")
        write_manifest(scratch / name, name)
        columns = scratch / f"{name}.columns.toml"
        columns.write_text(MAPS["shake_3storey/open/Stiff_BonusEvent_1st.csv"], encoding="utf-8")
        modes = FRAMES[frames[0]]
        stage = write_stage(
            scratch / f"{name}-stage", "frame", ("stiffness", 1.0, ""),
            [(mode, f, FRAME_DAMPING) for mode, f in modes.items()],
            {mode: f * np.sqrt(scale) for mode, f in modes.items()}, scale,
        )  # fmt: skip
        left = STIFFNESS_LEFT if len(frames) > 1 else 1.0
        where = scratch / name, stage, "stiffness", 1.0, left
        return Machine("frame", name, kind, *where, columns=columns)

    return [
        machine("same", "Stiff"),
        machine("same", "Flexible"),
        machine("beyond", "Stiff", "Flexible"),
    ]


def building(data: Path, scratch: Path) -> list[Machine]:
    """Return the timber building, of which nobody changed anything within 90 min."""
    record = np.load(data / "palisaden_building/Palisaden_dataset.npy", allow_pickle=False)
    size, logs = 30_000, scratch / "building"  # five minutes
    logs.mkdir()
    for k in range(len(record) // size):
        write_log(logs / f"{k:03d}.h5", record[k * size : (k + 1) * size], k / 12)
    return [Machine("building", "building", "same", logs, STAGE, "stiffness", 1.0, 1.0)]
