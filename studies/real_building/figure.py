"""Draw figure.svg from result.json: every window beside the full record and the published value."""

from __future__ import annotations

import json
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

HERE = Path(__file__).parent
DATA, FULL, PUBLISHED = "#56606b", "#0072b2", "#d55e00"


def main() -> None:
    """Draw frequencies above and damping ratios below, one column per mode."""
    matplotlib.rcParams["svg.hashsalt"] = "real_building"
    result = json.loads((HERE / "result.json").read_text())
    figure = Figure(figsize=(9.5, 5.6), layout="constrained")
    axes = figure.subplots(2, 3, sharex=True)
    for column, (name, mode) in enumerate(result["modes"].items()):
        windows = [row for row in result["windows"] if row["mode"] == name]
        index = np.array([int(row["log"][:3]) for row in windows])
        minutes = 5 * index + 2.5
        for row, (key, std, unit) in enumerate(
            (("frequency_hz", "frequency_std_hz", 1.0), ("damping_ratio", "damping_ratio_std", 100))
        ):
            ax = axes[row, column]
            value = unit * np.array([w[key] for w in windows])
            error = 2 * unit * np.array([w[std] for w in windows])
            ax.errorbar(minutes, value, error, fmt="o", ms=3.5, lw=1, color=DATA,
                        label="5-minute log, ±2σ")  # fmt: skip
            ax.axhline(unit * mode[f"full_{key}"], color=FULL, label="full record")
            published = mode["published_hz"] if row == 0 else unit * mode["published_damping_ratio"]
            ax.axhline(published, color=PUBLISHED, ls="--", label="published")
            ax.grid(alpha=0.25)
            if row == 0:
                ax.set_title(f"{name} mode")
            else:
                ax.set_ylim(0, 3)
                ax.set_xlabel("time in min")
    axes[0, 0].set_ylabel("natural frequency in Hz")
    axes[1, 0].set_ylabel("damping ratio in %")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3, frameon=False)
    figure.savefig(HERE / "figure.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
