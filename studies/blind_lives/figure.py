"""Draw figure.svg from result.json: verdicts and intervals against the truth."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.figures import BLUE, ORANGE, write
from studies.harness.study import Row

INTERVAL = BLUE
TRUTH = ORANGE
PANELS = (
    ("health", "guide_preload", "guide preload, fraction of the first log"),
    ("health", "mount_stiffness", "mount stiffness, fraction of the first log"),
    ("left", "any", "travel left to the first limit in 1,000 km (20: beyond)"),
)
_HORIZON_KM = 20_000.0


def draw_figure(figure: Figure, record: Row) -> None:
    """Draw the table of verdicts, and a panel per quantity with a row per machine."""
    axes = figure.subplots(1, 4, width_ratios=(1.25, 1, 1, 1))
    _confusion(axes[0], record["verdicts"]["all"]["told_of_true"])
    for ax, panel in zip(axes[1:], PANELS, strict=True):
        _intervals(ax, record["rows"], *panel)
    handles, labels = axes[1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=2, frameon=False, fontsize=8)


def _confusion(ax: Axes, table: dict[str, dict[str, int]]) -> None:
    counts = np.array([list(row.values()) for row in table.values()], dtype=float)
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    ax.imshow(share, cmap="Blues", vmin=0, vmax=1)
    for (i, j), count in np.ndenumerate(counts):
        if count:
            ax.text(j, i, f"{count:.0f}", ha="center", va="center", fontsize=9,
                    color="white" if share[i, j] > 0.6 else "black")  # fmt: skip
    names = [name.replace("not-enough-data", "not enough") for name in table]
    ax.set_xticks(range(len(names)), names, rotation=45, ha="right", fontsize=8)
    ax.set_yticks(range(len(names)), names, fontsize=8)
    ax.set_xlabel("reported", fontsize=8)
    ax.set_ylabel("true", fontsize=8)


def _intervals(ax: Axes, rows: list[Row], what: str, name: str, label: str) -> None:
    """Draw medians and 90 % intervals, in the order of the truth; past the horizon at its end."""
    scale, top = (1e-3, _HORIZON_KM) if what == "left" else (1.0, np.inf)
    found = []
    for row in rows:
        if name in row["told"][what] and name in row["truth"][what]:
            own = row["told"][what][name]
            values = (row["truth"][what][name], own["q50"], own["q05"], own["q95"])
            found.append([scale * (top if v is None else v) for v in values])
    if found:
        true, middle, low, high = np.array(sorted(found)).T
        y = np.arange(true.size)
        error = np.stack([middle - low, high - middle])
        ax.errorbar(middle, y, xerr=error, fmt="o", ms=3, lw=1.0, color=INTERVAL,
                    label="median and 90 % interval")  # fmt: skip
        ax.plot(true, y, "D", ms=3.5, mfc="none", mew=1.1, color=TRUTH, label="truth")
    ax.set_xlabel(label, fontsize=8)
    ax.set_yticks([])
    ax.tick_params(labelsize=7)
    ax.grid(axis="x", alpha=0.3)


if __name__ == "__main__":
    write(__file__, draw_figure, (13.0, 4.6), bbox_inches="tight")
