"""Draw figure.svg from result.json: inferred and true stiffness of both machines."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from studies.harness.figures import BLUE, ORANGE, write
from studies.harness.study import Row

STYLES = {
    "bench-A": (BLUE, "o", "bench-A, as measured"),
    "bench-B": (ORANGE, "s", "bench-B, read as sampled slower and slower"),
}
HOURS_PER_WEEK = 168


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw true values, medians with 90 % intervals over the weeks, and the end of life of B."""
    ax = figure.subplots()
    for name, (colour, marker, label) in STYLES.items():
        own = [row for row in result["stiffness"] if row["stage"] == name]
        week, low, mid, high, truth = (
            np.array([row[key] for row in own])
            for key in ("hours", "q05", "median", "q95", "truth")
        )
        week = week / HOURS_PER_WEEK
        ax.plot(week, truth, color="black", lw=0.8, label="truth" if name == "bench-A" else None)
        style = {"fmt": marker, "color": colour, "ms": 4, "capsize": 3, "label": label}
        ax.errorbar(week, mid, [mid - low, high - mid], **style)
    now = max(row["hours"] for row in result["stiffness"])
    left = result["remaining"]
    ends = [left["bench-B"][f"rul_km_{q}"] for q in ("q05", "q50", "q95")]
    low, mid, high = ((now + hours) / HOURS_PER_WEEK for hours in ends)
    style = {"color": ORANGE, "mfc": "none", "ms": 6, "capsize": 3}
    label, reach = "bench-B reaches the limit, 90 %", [[mid - low], [high - mid]]
    ax.errorbar(mid, result["limit"], xerr=reach, fmt="s", label=label, **style)
    true_end = (now + left["true_of_bench-B_h"]) / HOURS_PER_WEEK
    ax.plot(true_end, result["limit"], "kx", ms=7, label="truth, if it goes on like this")
    ax.axhline(result["limit"], color="#777777", lw=0.8, ls="--")
    ax.set(xlabel="weeks, as the manifest says", ylabel="coupling stiffness / baseline")
    ax.legend(fontsize=8)
    ax.grid(alpha=0.3)


if __name__ == "__main__":
    write(__file__, draw_figure, (8, 3.6), font=9)
