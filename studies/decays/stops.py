"""Simulated stages: what they do after real moves, with all their modes, loop, mains and noise."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from lmshealth import identify_decays, load_stage, read_log
from models.dynamics.plant import Mode, closed_loop_modes
from models.dynamics.stages import STAGES
from models.recordings.velocities import Experiment, drive_velocities
from studies.harness.study import Row

VELOCITIES = (0.1, 0.4)


def one_machine(name: str, seed: int) -> list[Row]:
    """Identify the modes after strokes at two velocities; one row per tracked mode and log."""
    truth = {mode.name: mode for mode in closed_loop_modes(STAGES[name])}
    stage = load_stage(name)
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        drive_velocities(Experiment(STAGES[name], seed=seed), folder, "hdf5", velocities=VELOCITIES)
        for path in sorted(folder.glob("*.h5")):
            found = identify_decays(read_log(path), stage)
            std = np.sqrt(np.diag(found.cov)).reshape(2, -1)
            for mode in stage.modes:
                row: Row = {"stage": name, "seed": seed, "log": path.stem}
                row |= {"mode": mode.name, "f_hz": None, "refused": ""}
                if mode.name not in found.names:
                    row["refused"] = next(r.reason for r in found.refused if r.mode == mode.name)
                else:
                    i, true = found.names.index(mode.name), truth[mode.name]
                    f, zeta = float(found.frequency[i]), float(found.damping_ratio[i])
                    row["f_hz"] = f
                    row["z_f"] = float(np.log(f / true.frequency_hz) / std[0, i])
                    row["z_zeta"] = float(np.log(zeta / true.damping_ratio) / std[1, i])
                    row["nearest"] = _nearest(truth, f)
                rows.append(row)
    return rows


def _nearest(truth: dict[str, Mode], f: float) -> str:
    """Name the mode whose frequency is nearest."""
    return min(truth, key=lambda name: abs(truth[name].frequency_hz - f))
