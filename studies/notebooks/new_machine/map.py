"""Write the modal map of two inertias on a spring, the model of the bench.

Two inertias J_m and J_l that rotate freely and are connected by a stiffness k have one torsional
mode, (2 π f)² = k (1/J_m + 1/J_l). The response of the motor's angle has an antiresonance at
(2 π f_a)² = k / J_l. The two frequencies determine the ratio J_l/J_m = (f/f_a)² − 1. Relative to
the values at commissioning

    f/f_0 = sqrt(κ (1 + r/λ) / (1 + r)),   κ = k/k_0, λ = J_l/J_l0, r = J_m/J_l0.

With λ = 1 the inertias cancel: f is proportional to the square root of the stiffness.
"""

from __future__ import annotations

import argparse
import csv
import json
from pathlib import Path

import numpy as np

STIFFNESS = np.geomspace(0.25, 2.5, 13)
LOAD = np.geomspace(0.6, 1.7, 7)


def main() -> None:
    """Write the map."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("hz", type=float, help="of the mode at commissioning")
    parser.add_argument("out", type=Path)
    motor_help = "vary the load's inertia too; the antiresonance of this response gives its share"
    parser.add_argument("--motor", type=Path, metavar="FRF.json", help=motor_help)
    options = parser.parse_args()
    write_map(options.out, options.hz, options.motor and read_antiresonance(options.motor))


def read_antiresonance(path: Path) -> float:
    """Return the spectral line (Hz) at which the response of the motor's angle is smallest."""
    lines = json.loads(path.read_text(encoding="utf-8"))["frf"]
    return float(min(lines, key=lambda line: line["gain"])["frequency_hz"])


def write_map(path: Path, hz: float, antiresonance: float | None = None) -> None:
    """Write the frequency (Hz) over a grid of the stiffness and the load's inertia.

    The inertia is varied only if the ``antiresonance`` of the motor's angle is given, in Hz.
    """
    motor_over_load = 0.0 if antiresonance is None else 1 / ((hz / antiresonance) ** 2 - 1)
    loads = np.ones(1) if antiresonance is None else LOAD
    names = ["coupling_stiffness", "load_inertia"][: 1 if antiresonance is None else 2]
    with path.open("w", encoding="utf-8", newline="") as stream:
        table = csv.writer(stream, lineterminator="\n")
        table.writerow([*names, "mode", "frequency_hz"])
        for stiffness in STIFFNESS:
            for load in loads:
                shift = stiffness * (1 + motor_over_load / load) / (1 + motor_over_load)
                at = [f"{value:.6g}" for value in (stiffness, load)[: len(names)]]
                table.writerow([*at, "torsion", f"{hz * np.sqrt(shift):.9g}"])


if __name__ == "__main__":
    main()
