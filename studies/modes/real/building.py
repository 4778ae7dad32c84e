"""The timber building: five-minute logs by the command line, thirds against the whole record."""

from __future__ import annotations

import tempfile
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd

from lmshealth import identify, load_stage
from lmshealth.calibration.ranks import clopper_pearson
from lmshealth.modal.modes import Modes
from studies.harness.command_line import call
from studies.harness.study import Row
from studies.modes.real.make_map import PUBLISHED, PUBLISHED_DAMPING
from studies.modes.real.sets import Z95, describe, identify_known, to_log

STAGE = Path(__file__).parent / "building.toml"
SAMPLE_RATE = 100.0
WINDOW_S = 300
PARTS = 3
DAMPINGS = (0.012, 0.015, 0.02)
BEGIN = datetime(2024, 1, 1, tzinfo=UTC)  # the data do not say when; only differences matter


def study_building(data: Path, *, quick: bool) -> Row:
    """Analyse the building as a user does; when quick four sensors, one third."""
    record = np.load(data / "palisaden_building" / "Palisaden_dataset.npy", allow_pickle=False)
    if quick:
        record = record[: record.shape[0] // 3, :4]
    stage = load_stage(str(STAGE))
    full = identify(to_log(record, SAMPLE_RATE), stage)
    with tempfile.TemporaryDirectory() as folder:
        logs, out = Path(folder) / "logs", Path(folder) / "out"
        logs.mkdir()
        for k, window in enumerate(windows_of(record)):
            write_log(logs / f"{k:03d}.h5", window, k * WINDOW_S / 3600)
        how = ("--epochs", 1, "--workers", 1) if quick else ("--epochs", 40)
        call("lmshealth", "run", logs, "--stage", STAGE, "--out", out, *how, quick=quick)
        answer = evaluate(out, full, len(windows_of(record)))
    thirds = [] if quick else np.array_split(record[: len(record) // PARTS * PARTS], PARTS)
    parts = [identify(to_log(part, SAMPLE_RATE), stage) for part in thirds]
    answer["parts"] = [row for k, part in enumerate(parts) for row in compare_part(k, part, full)]
    answer["described"] = [
        {"described_zeta": damping, "mode": name} | row
        for damping in (DAMPINGS[::2] if quick else DAMPINGS)
        for name, row in zip(
            PUBLISHED,
            identify_known(
                to_log(record, SAMPLE_RATE), PUBLISHED.values(), [damping] * len(PUBLISHED)
            ),
            strict=True,
        )
    ]
    return answer


def windows_of(record: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Cut the record into windows, shape ``(n_windows, n_samples, n_channels)``."""
    n = int(WINDOW_S * SAMPLE_RATE)
    return record[: len(record) // n * n].reshape(-1, n, record.shape[1])


def compare_part(k: int, part: Modes, full: Modes) -> list[Row]:
    """Compare the modes of a part of the record with those of the whole."""
    rows, std = [], np.sqrt(np.diag(part.cov)).reshape(2, -1)
    for j, name in enumerate(full.names):
        row: Row = {"part": k, "mode": name}
        if name in part.names:
            i = part.names.index(name)
            off_f = (part.ln_frequency[i] - full.ln_frequency[j]) / std[0, i]
            off_zeta = (part.ln_damping[i] - full.ln_damping[j]) / std[1, i]
            row |= {"f_off_in_std": float(off_f), "zeta_off_in_std": float(off_zeta)}
            row |= describe(part, i)
        rows.append(row)
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


def evaluate(out: Path, full: Modes, n_windows: int) -> Row:
    """Compare windows with the published values and with the full record."""
    modes = pd.read_csv(out / "modes.csv")
    prognosis = pd.read_csv(out / "prognosis.csv").set_index("parameter").loc["any"]
    columns = ["log", "mode", "frequency_hz", "frequency_std_hz"]
    columns += ["damping_ratio", "damping_ratio_std"]
    return {
        "n_windows": n_windows,
        "modes": {name: compare(name, modes[modes["mode"] == name], full) for name in PUBLISHED},
        "service_by": None if pd.isna(prognosis["service_by"]) else str(prognosis["service_by"]),
        "windows": modes[columns].to_dict("records"),
    }


def compare(name: str, windows: pd.DataFrame, full: Modes) -> Row:
    """Compare one mode's windows with the full record."""
    i = full.names.index(name)
    whole = {"frequency_hz": full.frequency[i], "damping_ratio": full.damping_ratio[i]}
    found: Row = {
        "published_hz": PUBLISHED[name],
        "published_damping_ratio": PUBLISHED_DAMPING[name],
        "n_windows": len(windows),
    }
    for column, value in whole.items():
        found |= {f"full_{column}": float(value)}
        found |= {f"median_{column}": float(windows[column].median())}
        std = windows[column.replace("_hz", "") + ("_std_hz" if "hz" in column else "_std")]
        score = (windows[column] - value).abs() / std
        for label, width in (("coverage_95", Z95), ("coverage_95_control_half_std", Z95 / 2)):
            hits = int((score < width).sum())
            found[f"{column}_{label}"] = hits / len(windows)
            found[f"{column}_{label}_interval"] = clopper_pearson(hits, len(windows))
        scatter = float(windows[column].std() / np.sqrt((std**2).mean()))
        found[f"{column}_scatter_over_std"] = scatter
    return found
