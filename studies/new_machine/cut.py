"""Cut the bench's one recording into logs as its controller might have exported them.

Twenty periods of a multisine are ten logs of two periods. As two machines: ``bench-A`` is what was
measured. ``bench-B`` is the same samples, but the manifest says of each log that it was sampled
0.4 % slower than the one before. That is a machine whose every frequency falls, and whose
stiffness falls with the square: the only ageing that these data can be given without inventing a
sample. Dates and running hours in the manifest are invented too, a week between logs.
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
    """Write logs and manifest into the folder that is named."""
    if "LMSHEALTH_DATA" not in os.environ:
        raise SystemExit("LMSHEALTH_DATA is not set: it names the folder of real measurements")
    write_logs(Path(os.environ["LMSHEALTH_DATA"]) / RECORDING, Path(sys.argv[1]))


def write_logs(recording: Path, folder: Path) -> None:
    """Write the logs of both machines, and the manifest beside them."""
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
