"""Draw figure.svg from result.json: verdicts and intervals against the truth."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.figures import draw_intervals, legend_above, write
from studies.harness.study import Row

PANELS = (
    ("health", "guide_preload", "guide preload, fraction of the first log"),
    ("health", "mount_stiffness", "mount stiffness, fraction of the first log"),
    ("left", "any", "travel left to the first limit in 1,000 km (20: beyond)"),
)
_HORIZON_KM = 20_000.0


def draw_figure(figure: Figure, record: Row) -> None:
    """Draw the table of verdicts, and a panel per quantity with a row per machine."""
    axes = figure.subplots(1, 4, width_ratios=(1.25, 1, 1, 1))
    _confusion(axes[0], record["verdicts"]["all"]["reported_of_true"])
    for ax, panel in zip(axes[1:], PANELS, strict=True):
        _intervals(ax, record["rows"], *panel)
    legend_above(figure, axes[1], ncols=2, fontsize=8)


def _confusion(ax: Axes, table: dict[str, dict[str, int]]) -> None:
    counts = np.array([list(row.values()) for row in table.values()], dtype=float)
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    ax.imshow(share, cmap="Blues", vmin=0, vmax=1)
    for (i, j), count in np.ndenumerate(counts):
        if count:
            ax.text(j, i, f"{count:.0f}", ha="center", va="center", fontsize=9,
                    color="white" if share[i, j] > 0.6 else "black")  # fmt: skip
    names = [name.replace("not-enough-data", "not enough") for name in table]
    ax.set_xticks(range(len(names)), names, rotation=45, ha="right")
    ax.set_yticks(range(len(names)), names)
    ax.set_xlabel("reported")
    ax.set_ylabel("true")


def _intervals(ax: Axes, rows: list[Row], what: str, name: str, label: str) -> None:
    """Draw medians and 90 % intervals, in the order of the truth; past the horizon at its end."""
    scale, top = (1e-3, _HORIZON_KM) if what == "left" else (1.0, np.inf)
    found = []
    for row in rows:
        if name in row["reported"][what] and name in row["truth"][what]:
            own = row["reported"][what][name]
            values = (row["truth"][what][name], own["q50"], own["q05"], own["q95"])
            found.append([scale * (top if v is None else v) for v in values])
    if found:
        draw_intervals(ax, *np.array(sorted(found)).T, label)


if __name__ == "__main__":
    write(__file__, draw_figure, (13.0, 4.6), font=8, bbox_inches="tight")
