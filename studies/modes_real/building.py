"""The timber building: five-minute logs by the command line, thirds against the whole record."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
from scipy.stats import norm

from lmshealth import identify, load_stage
from lmshealth.modal.modes import Modes
from studies.common.metrics import clopper_pearson
from studies.harness.command_line import call
from studies.harness.study import Row
from studies.modes_real.make_map import PUBLISHED, PUBLISHED_DAMPING
from studies.modes_real.sets import identify_known, to_log

STAGE = Path(__file__).parent / "building.toml"
SAMPLE_RATE = 100.0
WINDOW_S = 300
PARTS = 3
DAMPINGS = (0.012, 0.015, 0.02)
BEGIN = datetime(2024, 1, 1, tzinfo=UTC)  # the data do not say when; only differences matter
_Z = float(norm.isf(0.025))


def study_building(data: Path, *, quick: bool) -> Row:
    """Analyse the building as a user does; when quick four sensors, one third."""
    record = np.load(data / "palisaden_building" / "Palisaden_dataset.npy", allow_pickle=False)
    if quick:
        record = record[: record.shape[0] // 3, :4]
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        write_logs(record, work / "logs")
        how = ("--epochs", 1, "--workers", 1) if quick else ("--epochs", 40)
        command = ("run", work / "logs", "--stage", STAGE, "--out", work / "out", *how)
        call("lmshealth", *command, quick=quick)
        full = identify(to_log(record, SAMPLE_RATE), load_stage(str(STAGE)))
        answer = evaluate(work / "out", full, len(record))
    answer["parts"] = [] if quick else compare_parts(record, full)
    answer["described"] = vary_description(record, DAMPINGS[::2] if quick else DAMPINGS)
    return answer


def vary_description(record: np.ndarray[Any, Any], dampings: Sequence[float]) -> list[Row]:
    """Identify the record with other dampings in the description, from which the band follows."""
    rows = []
    for damping in dampings:
        found = identify_known(
            to_log(record, SAMPLE_RATE), list(PUBLISHED.values()), [damping] * len(PUBLISHED), None
        )
        rows += [
            {"described_zeta": damping, "mode": name} | row
            for name, row in zip(PUBLISHED, found, strict=True)
        ]
    return rows


def compare_parts(record: np.ndarray[Any, Any], full: Modes) -> list[Row]:
    """Identify each third of the record and compare it with the whole."""
    n, rows = record.shape[0] // PARTS, []
    for k in range(PARTS):
        part = identify(to_log(record[k * n : (k + 1) * n], SAMPLE_RATE), load_stage(str(STAGE)))
        std = np.sqrt(np.diag(part.cov)).reshape(2, -1)
        for name in full.names:
            row: Row = {"part": k, "mode": name}
            rows.append(row)
            if name not in part.names:
                continue
            i, j = part.names.index(name), full.names.index(name)
            row |= {
                "f_hz": float(part.frequency[i]),
                "f_std_hz": float(part.frequency_std[i]),
                "zeta": float(part.damping_ratio[i]),
                "zeta_std": float(part.damping_ratio_std[i]),
                "f_off_in_std": float((part.ln_frequency[i] - full.ln_frequency[j]) / std[0, i]),
                "zeta_off_in_std": float((part.ln_damping[i] - full.ln_damping[j]) / std[1, i]),
            }
    return rows


def write_log(path: Path, samples: np.ndarray[Any, Any], hours: float) -> None:
    """Write one log in HDF5; the odometer of a building is the clock, one km an hour."""
    with h5py.File(path, "w") as file:
        for k, column in enumerate(samples.T, start=1):
            file[f"acc_{k}_m_s2"] = column
        file.attrs["stage"] = "palisaden"
        file.attrs["sample_rate_hz"] = SAMPLE_RATE
        file.attrs["travel_km"] = hours
        file.attrs["recorded_at"] = (BEGIN + timedelta(hours=hours)).isoformat()


def write_logs(record: np.ndarray[Any, Any], folder: Path) -> None:
    """Cut the record into logs."""
    folder.mkdir()
    n = int(WINDOW_S * SAMPLE_RATE)
    for k in range(record.shape[0] // n):
        write_log(folder / f"{k:03d}.h5", record[k * n : (k + 1) * n], k * WINDOW_S / 3600)


def evaluate(out: Path, full: Modes, n_samples: int) -> Row:
    """Compare windows with the published values and with the full record."""
    modes = pd.read_csv(out / "modes.csv")
    health = pd.read_csv(out / "health.csv").iloc[-1]
    prognosis = pd.read_csv(out / "prognosis.csv").set_index("parameter").loc["any"]
    verdict = pd.read_csv(out / "verdict.csv").iloc[0]
    n_windows = n_samples // int(WINDOW_S * SAMPLE_RATE)
    per_mode = {name: compare(name, modes[modes["mode"] == name], full) for name in PUBLISHED}
    return {
        "seed": 0,
        "n_windows": n_windows,
        "modes": per_mode,
        "stiffness": {key: float(health[key]) for key in ("q05", "median", "q95")},
        "verdict": str(verdict["verdict"]),
        "verdict_probability": float(verdict["probability"]),
        "probability_beyond_horizon": float(prognosis["probability_beyond_horizon"]),
        "service_by": None if pd.isna(prognosis["service_by"]) else str(prognosis["service_by"]),
        "windows": modes[
            ["log", "mode", "frequency_hz", "frequency_std_hz", "damping_ratio",
             "damping_ratio_std"]
        ].to_dict("records"),
    }  # fmt: skip


def compare(name: str, windows: pd.DataFrame, full: Modes) -> Row:
    """Compare one mode's windows with the full record."""
    i = full.names.index(name)
    whole = {"frequency_hz": full.frequency[i], "damping_ratio": full.damping_ratio[i]}
    found = {
        "published_hz": PUBLISHED[name],
        "published_damping_ratio": PUBLISHED_DAMPING[name],
        "full_frequency_hz": float(full.frequency[i]),
        "full_frequency_std_hz": float(full.frequency_std[i]),
        "full_damping_ratio": float(full.damping_ratio[i]),
        "full_damping_ratio_std": float(full.damping_ratio_std[i]),
        "n_windows": len(windows),
        "median_frequency_hz": float(windows["frequency_hz"].median()),
        "median_damping_ratio": float(windows["damping_ratio"].median()),
    }
    for column in ("frequency_hz", "damping_ratio"):
        std = windows[column.replace("_hz", "") + ("_std_hz" if "hz" in column else "_std")]
        score = (windows[column] - whole[column]).abs() / std
        for label, width in (("coverage_95", _Z), ("coverage_95_control_half_std", _Z / 2)):
            hits = int((score < width).sum())
            found[f"{column}_{label}"] = hits / len(windows)
            found[f"{column}_{label}_interval"] = clopper_pearson(hits, len(windows))
        scatter = float(windows[column].std() / np.sqrt((std**2).mean()))
        found[f"{column}_scatter_over_std"] = scatter
    return found
