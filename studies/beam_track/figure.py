"""Draw figure.svg from result.json: the beam tracked without and with its roller position."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.figures import BLUE, GREEN, ORANGE, write
from studies.harness.study import Row

COLOURS = (BLUE, ORANGE, GREEN)
MARKERS = ("o", "s", "^")


def draw(ax: Axes, repeats: list[Row], kind: str) -> None:
    """Draw the drift of every dwell with two standard deviations."""
    ax.axhline(0, color="black", lw=0.8)
    for r, colour, marker in zip(repeats, COLOURS, MARKERS, strict=False):
        own = r[kind]
        x = np.arange(len(own["drift"])) + 1 + 0.16 * (r["repeat"] - 1)
        label = f"repeat {r['repeat'] + 1}"
        y, std = 100 * np.array(own["drift"]), 200 * np.array(own["drift_std"])
        ax.errorbar(x, y, std, fmt=marker, color=colour, ms=4, elinewidth=1, capsize=2, label=label)
        back = own["returned_at"]
        ax.plot(x[back], y[back], marker, ms=11, mfc="none", mec=colour)
    ax.set_xlabel("dwell that the beam could be read in")
    ax.grid(alpha=0.3)


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw the study."""
    left, right = figure.subplots(1, 2)
    draw(left, result["repeats"], "blind")
    left.set_ylim(-30, 60)
    left.set_title("estimates alone")
    left.set_ylabel("drift of ln f since the first dwell in %, ± 2σ")
    draw(right, result["repeats"], "informed")
    right.set_title("roller position as covariate")
    right.legend(loc="upper right")
    figure.suptitle("Tracked beam through ramp and return; circles: back at the first position")


if __name__ == "__main__":
    write(__file__, draw_figure, (9, 4), font=9)
