"""Cut the recording of the bench into logs in the form of a controller's export.

Twenty periods of a multisine give ten logs of two periods each, for two machines. ``bench-A`` is
the machine as measured. ``bench-B`` has the same samples, but its manifest states for each log a
sample rate that is lower by 0.4 % than for the log before. All its frequencies decrease in the same
proportion, and its stiffness with their square: this simulates ageing without artificial samples.
Dates and running hours in the manifest are artificial as well, with one week between logs.
"""

from __future__ import annotations

import csv
import os
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from scipy.io import loadmat

RECORDING = "fditools_two_inertia_bench/open/MultisineTypeA.mat"
COLUMNS = ("iq_adx", "theta_mx", "theta_my")
RATE, PERIODS_PER_LOG = 2500, 2
SLOWER = 0.004
BEGIN, APART_H = datetime(2019, 10, 7, 14, tzinfo=UTC), 168


def main() -> None:
    """Write logs and manifest to the folder given as argument."""
    if "LMSHEALTH_DATA" not in os.environ:
        raise SystemExit("LMSHEALTH_DATA is not set: it names the folder of real measurements")
    write_logs(Path(os.environ["LMSHEALTH_DATA"]) / RECORDING, Path(sys.argv[1]))


def write_logs(recording: Path, folder: Path) -> None:
    """Write the logs of both machines and their manifest."""
    folder.mkdir(parents=True, exist_ok=True)
    matlab = loadmat(recording, squeeze_me=True, variable_names=COLUMNS)
    samples = np.column_stack([matlab[name] for name in COLUMNS])
    size = PERIODS_PER_LOG * RATE
    rows = []
    for machine, slower in (("A", 0.0), ("B", SLOWER)):
        for k in range(len(samples) // size):
            name = f"{machine}{k}.csv"
            np.savetxt(
                folder / name, samples[k * size : (k + 1) * size], fmt="%.9g", delimiter=";",
                header=";".join(COLUMNS), comments="",
            )  # fmt: skip
            moment = BEGIN + timedelta(hours=APART_H * k)
            rate = RATE * (1 - slower * k)
            rows.append((name, f"bench-{machine}", moment.isoformat(), APART_H * k, f"{rate:g}"))
    with (folder / "manifest.csv").open("w", encoding="utf-8", newline="") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(("file", "stage", "recorded_at", "travel_km", "sample_rate_hz"))
        table.writerows(rows)


if __name__ == "__main__":
    main()
