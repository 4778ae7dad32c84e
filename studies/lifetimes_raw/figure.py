"""Draw figure.svg from result.json: distributions of ranks in their bands."""

from __future__ import annotations

from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

from studies.common.ranks import COLOURS, draw_ecdf
from studies.harness.study import read_record

HERE = Path(__file__).parent


def main() -> None:
    """Draw a panel for the map believed, one for its error, one for the control."""
    matplotlib.rcParams["svg.hashsalt"] = "lifetimes_raw"
    result = read_record(__file__)
    figure = Figure(figsize=(11.5, 4.4), layout="constrained")
    axes = figure.subplots(1, 3, sharey=True)
    for ax, (name, rows) in zip(axes, result["ranks"].items(), strict=True):
        lives = next(iter(rows.values()))["n"]
        draw_ecdf(ax, rows, result["bands"], f"{name}, {lives} raw lives", COLOURS)
    figure.savefig(HERE / "figure.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
