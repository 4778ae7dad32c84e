"""Draw figure.svg from result.json: intervals and truth of every life."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from studies.harness.figures import BLUE, ORANGE, write
from studies.harness.study import Row

INTERVAL = BLUE
TRUTH = ORANGE
PANELS = (
    ("guide_preload", "median", "guide preload, fraction of commissioning"),
    ("mount_stiffness", "median", "mount stiffness, fraction of commissioning"),
    ("remaining_km", "q50", "travel left to the first limit in km"),
)


def draw_figure(figure: Figure, record: Row) -> None:
    """Draw one panel per quantity, one row per life, in the order of the truth."""
    lives = record["lives"]
    for ax, (name, middle, label) in zip(figure.subplots(1, 3), PANELS, strict=True):
        rows = sorted((life[name] for life in lives), key=lambda row: row["truth"])
        y = np.arange(len(rows))
        centre = np.array([row[middle] for row in rows])
        low, high = (np.array([row[key] for row in rows]) for key in ("q05", "q95"))
        error = np.stack([centre - low, high - centre])
        ax.errorbar(centre, y, xerr=error, fmt="o", ms=4, lw=1.6, color=INTERVAL,
                    label="median and 90 % interval")  # fmt: skip
        # A limit that was passed in the past leaves nothing, however long ago it was.
        truth = [max(row["truth"], 0.0) for row in rows]
        ax.plot(truth, y, "D", ms=5, mfc="none", mew=1.5, color=TRUTH, label="truth")
        ax.set_xlabel(label)
        ax.set_yticks([])
        ax.grid(axis="x", alpha=0.3)
    figure.axes[0].set_ylabel("lives, sorted by truth")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2, frameon=False)


if __name__ == "__main__":
    write(__file__, draw_figure, lambda record: (10.5, 1.6 + 0.22 * len(record["lives"])))
