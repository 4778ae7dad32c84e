"""The paper's experiment: one log per set velocity from 1 to 400 mm/s."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import pandas as pd

from models.dynamics.stages import NOMINAL, Condition, Stage
from models.errors import BadParameter
from models.recordings.effects import LINEAR, Effects
from models.recordings.formats import file_suffix, refuse_other_logs, write_log
from models.recordings.machines import COMMISSIONED, machine_identity, stream
from models.recordings.motion_profile import Profile
from models.recordings.recording import sample_count
from models.recordings.strokes import VELOCITIES, WINDOW_S, full_stroke, record_strokes

_EVERY = timedelta(minutes=2)


@dataclass(frozen=True, slots=True)
class Experiment:
    """What to drive: stage, condition, strokes of each move, dwell, window (s), seed, effects."""

    stage: Stage
    condition: Condition = NOMINAL
    strokes: int = 1
    dwell: float = 0.5
    seconds: float = WINDOW_S
    seed: int = 0
    effects: Effects = LINEAR

    def __post_init__(self) -> None:
        """Reject a window that no log can have."""
        sample_count(self.seconds)

    @property
    def identity(self) -> str:
        """Identity of the machine that the seed makes."""
        return machine_identity(self.stage, self.seed)

    def move(self, velocity: float) -> Profile:
        """Return the move at a set velocity (m/s)."""
        return replace(full_stroke(self.stage, velocity), strokes=self.strokes, dwell=self.dwell)

    def rng(self, velocity: float) -> np.random.Generator:
        """Return the generator of one move: independent of which others are driven."""
        return stream(self.stage.name, self.seed, "velocities", round(velocity * 1e6))


def _file_name(velocity: float, suffix: str) -> str:
    """Return the name of the log of a velocity (m/s)."""
    return f"velocity-{1e3 * velocity:08.3f}{suffix}"


def _refuse_twins(velocities: tuple[float, ...]) -> None:
    """Raise if two velocities (m/s) would share a file."""
    names = [_file_name(velocity, "") for velocity in velocities]
    for velocity, name in zip(velocities, names, strict=True):
        if names.count(name) > 1:
            needed = "velocities that differ by 0.001 mm/s or more"
            raise BadParameter("velocity", f"{1e3 * velocity:g} mm/s, more than once", needed)


def drive_velocities(
    experiment: Experiment,
    folder: Path,
    file_format: str,
    *,
    velocities: tuple[float, ...] = VELOCITIES,
    progress: Callable[[int], None] | None = None,
) -> None:
    """Write one log per velocity (m/s) and the manifest of all.

    Parameters
    ----------
    progress
        Called with 1 after each log.

    Raises
    ------
    BadParameter
        If a velocity cannot be driven, or two would share a file.
    OccupiedFolder
        If the folder holds logs that would not be overwritten.
    """
    suffix = file_suffix(file_format)
    moves = [experiment.move(velocity) for velocity in velocities]
    _refuse_twins(velocities)
    refuse_other_logs(folder, [_file_name(velocity, suffix) for velocity in velocities])
    folder.mkdir(parents=True, exist_ok=True)
    rows, travel_km = [], 0.0
    for i, move in enumerate(moves):
        recording = record_strokes(
            experiment.stage,
            experiment.condition,
            profile=move,
            seconds=experiment.seconds,
            rng=experiment.rng(move.velocity),
            effects=experiment.effects,
        )
        travel_km += move.strokes * move.stroke * 1e-3
        row = {
            "stage": experiment.identity,
            "recorded_at": (COMMISSIONED + i * _EVERY).isoformat(),
            "travel_km": round(travel_km, 6),
            "velocity_mm_s": round(move.velocity * 1e3, 6),
        }
        name = _file_name(move.velocity, suffix)
        write_log(recording.described(**row), folder / name, file_format)
        rows.append({"file": name, **row, "temperature_c": experiment.condition.temperature_c})
        if progress is not None:
            progress(1)
    pd.DataFrame(rows).to_csv(folder / "manifest.csv", index=False)
