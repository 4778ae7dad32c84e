"""Does the whole chain say the right thing about a real structure in which nothing changes?

Question
    A timber building under ambient excitation (90 min, 6 accelerometers, 100 Hz) cut into
    5-minute logs: do the modes agree with the published ones, do the intervals of the windows
    hold the value of the full record, and is the verdict "healthy"?
Method
    The record is written as logs of the log contract, and `lmshealth run` is called on them as a
    user would, with the stage description building.toml. The full record is identified as one log.
    Negative control: the coverage with all standard deviations halved.
Run time
    About half a minute.
Data
    Folder ``palisaden_building`` of LMSHEALTH_DATA.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd

from studies.real_building.make_map import PUBLISHED, PUBLISHED_DAMPING
from studies.record import Stopwatch, clopper_pearson, keep

HERE = Path(__file__).parent
SAMPLE_RATE = 100.0
WINDOW_S = 300
BEGIN = datetime(2024, 1, 1, tzinfo=UTC)  # the data do not say when; only differences matter


def main() -> None:
    """Run the study; ``--quick`` uses the first third of the record and records nothing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    quick = parser.parse_args().quick
    watch = Stopwatch()
    if "LMSHEALTH_DATA" not in os.environ:
        raise SystemExit("LMSHEALTH_DATA is not set: it names the folder of real measurements")
    data = Path(os.environ["LMSHEALTH_DATA"]) / "palisaden_building" / "Palisaden_dataset.npy"
    record = np.load(data, allow_pickle=False)
    if quick:
        record = record[: record.shape[0] // 3]
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        write_logs(record, work / "logs")
        out = work / "out"
        command = ["run", str(work / "logs"), "--stage", str(HERE / "building.toml")]
        lmshealth(*command, "--out", str(out), "--epochs", "4" if quick else "40")
        write_log(work / "full.h5", record, 0.0)
        full = json.loads(
            lmshealth("modes", str(work / "full.h5"), "--stage", command[-1], "--format", "json")
        )
        answer = evaluate(out, {row["mode"]: row for row in full["modes"]}, len(record))
    print(json.dumps({k: v for k, v in answer.items() if k != "windows"}, indent=1))
    if not quick:
        keep(HERE / "result.json", __doc__.split("\n")[0], answer, watch)
    if not all(answer["passed"].values()):
        raise SystemExit(f"not as asked: {answer['passed']}")


def lmshealth(*arguments: str) -> str:
    """Call the command line as a user does and return what it prints."""
    done = subprocess.run(
        [sys.executable, "-m", "lmshealth", *arguments], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(f"lmshealth {arguments[0]} ended with {done.returncode}: {done.stderr}")
    return done.stdout


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


def evaluate(out: Path, full: dict[str, dict[str, Any]], n_samples: int) -> dict[str, Any]:
    """Compare windows with the published values and with the full record."""
    modes = pd.read_csv(out / "modes.csv")
    health = pd.read_csv(out / "health.csv").iloc[-1]
    prognosis = pd.read_csv(out / "prognosis.csv").set_index("parameter").loc["any"]
    verdict = pd.read_csv(out / "verdict.csv").iloc[0]
    n_windows = n_samples // int(WINDOW_S * SAMPLE_RATE)
    per_mode = {
        name: compare(name, modes[modes["mode"] == name], full[name], f)
        for name, f in PUBLISHED.items()
    }
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
        "passed": {
            "median frequency within 0.5 % of the published": all(
                abs(m["median_frequency_hz"] / f - 1) < 0.005
                for m, f in zip(per_mode.values(), PUBLISHED.values(), strict=True)
            ),
            "median damping within 1.2 to 1.8 %": all(
                0.012 < m["median_damping_ratio"] < 0.018 for m in per_mode.values()
            ),
            "verdict is healthy": verdict["verdict"] == "healthy",
            "stiffness 1 inside its 90 % interval": bool(health["q05"] < 1 < health["q95"]),
            "no end of life visible": bool(pd.isna(prognosis["service_by"])),
        },
    }  # fmt: skip


def compare(
    name: str, windows: pd.DataFrame, full: dict[str, Any], published: float
) -> dict[str, Any]:
    """Compare one mode's windows with the full record."""
    found = {
        "published_hz": published,
        "published_damping_ratio": PUBLISHED_DAMPING[name],
        "full_frequency_hz": full["frequency_hz"],
        "full_damping_ratio": full["damping_ratio"],
        "n_windows": len(windows),
        "median_frequency_hz": float(windows["frequency_hz"].median()),
        "median_damping_ratio": float(windows["damping_ratio"].median()),
    }
    for column in ("frequency_hz", "damping_ratio"):
        std = windows[column.replace("_hz", "") + ("_std_hz" if "hz" in column else "_std")]
        score = (windows[column] - full[column]).abs() / std
        for name, width in (("coverage_95", 1.96), ("coverage_95_control_half_std", 0.98)):
            hits = int((score < width).sum())
            found[f"{column}_{name}"] = hits / len(windows)
            found[f"{column}_{name}_interval"] = clopper_pearson(hits, len(windows))
        scatter = float(windows[column].std() / np.sqrt((std**2).mean()))
        found[f"{column}_scatter_over_std"] = scatter
    return found


if __name__ == "__main__":
    main()
