"""Draw figure.svg from result.json: the map, and the roller's position inferred and measured."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.figures import BLUE, ORANGE, write
from studies.harness.study import Row

UP = BLUE
DOWN = ORANGE
OTHER = "#777777"


def draw_map(ax: Axes, calibration: Row, dwells: list[Row]) -> None:
    """Draw the map with the dwells that it is made from, and the new ones."""
    ax.plot(calibration["curve_v"], calibration["curve_hz"], color="black", lw=1, label="map")
    known = calibration["dwells"]
    for repeat, marker in ((0, "o"), (1, "s")):
        own = [row for row in known if row["repeat"] == repeat]
        x, y = ([row[name] for row in own] for name in ("roller_v", "frequency_hz"))
        ax.plot(x, y, marker, color=OTHER, mfc="none", ms=7, label=f"repeat {repeat}")
    x, y = ([row[name] for row in dwells] for name in ("roller_v", "frequency_hz"))
    ax.plot(x, y, "x", color=UP, ms=5, label="repeat 2, not in the map")
    ax.set_xlabel("roller position measured in V")
    ax.set_ylabel("frequency in Hz")
    ax.set_title("modal map of two repeats")
    ax.legend()
    ax.grid(alpha=0.3)


def draw_positions(top: Axes, below: Axes, dwells: list[Row]) -> None:
    """Draw inferred over measured positions with 90 % intervals, and their difference."""
    turn = max(dwells, key=lambda row: row["roller_v"])["dwell"]
    top.axline((2.0, 2.0), slope=1, color="black", lw=0.8)
    below.axhline(0, color="black", lw=0.8)
    for is_up, colour, marker, label in (
        (True, UP, "o", "on the way up"),
        (False, DOWN, "s", "on the way back"),
    ):
        own = [r for r in dwells if (r["dwell"] <= turn) == is_up and r["median"] is not None]
        x, low, mid, high = (
            np.array([row[name] for row in own]) for name in ("roller_v", "q05", "median", "q95")
        )
        style = {"fmt": marker, "color": colour, "ms": 5, "capsize": 3, "elinewidth": 1.2}
        top.errorbar(x, mid, [mid - low, high - mid], label=label, **style)
        # Beside each other, where up and down have a position in common.
        beside = x + (-0.012 if is_up else 0.012)
        below.errorbar(beside, 1e3 * (mid - x), 1e3 * np.array([mid - low, high - mid]), **style)
    base = next(row for row in dwells if row["median"] is None)["roller_v"]
    for ax, y in ((top, base), (below, 0.0)):
        ax.plot(base, y, "D", color="black", mfc="none", ms=8, label="baseline, known")
        ax.grid(alpha=0.3)
    top.set_ylabel("inferred in V")
    top.set_title("repeat 2: position inferred, 90 % intervals")
    top.legend()
    top.tick_params(labelbottom=False)
    below.set_ylabel("inferred - measured in mV")
    below.set_xlabel("roller position measured in V")


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw the study."""
    axes = figure.subplot_mosaic([["map", "top"], ["map", "below"]], height_ratios=[3, 2])
    draw_map(axes["map"], result["calibration"], result["dwells"])
    draw_positions(axes["top"], axes["below"], result["dwells"])
    axes["below"].set_xlim(axes["top"].get_xlim())


if __name__ == "__main__":
    write(__file__, draw_figure, (9, 4.8), font=9)
