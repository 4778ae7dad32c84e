"""Draw figure.svg from result.json: intervals and truth of every life."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from studies.harness.figures import draw_intervals, legend_above, write
from studies.harness.study import Row

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
        values = np.array([[row[key] for row in rows] for key in (middle, "q05", "q95")])
        # A limit that was passed in the past leaves nothing, however long ago it was.
        draw_intervals(ax, [max(row["truth"], 0.0) for row in rows], *values, label)
    figure.axes[0].set_ylabel("lives, sorted by truth")
    legend_above(figure, figure.axes[0], ncols=2)


if __name__ == "__main__":
    write(__file__, draw_figure, lambda record: (10.5, 1.6 + 0.22 * len(record["lives"])))
