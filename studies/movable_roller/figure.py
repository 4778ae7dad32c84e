"""Draw figure.svg from result.json: the map, and the roller's position inferred and measured."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.figures import BLUE, ORANGE, write
from studies.harness.study import Row

OTHER = "#777777"


def columns(rows: list[Row], *names: str) -> list[np.ndarray]:
    """Return columns of rows."""
    return [np.array([row[name] for row in rows]) for name in names]


def draw_map(ax: Axes, calibration: Row, dwells: list[Row]) -> None:
    """Draw the map with the dwells that it is made from, and the new ones."""
    ax.plot(calibration["curve_v"], calibration["curve_hz"], color="black", lw=1, label="map")
    for repeat, marker in ((0, "o"), (1, "s")):
        own = [row for row in calibration["dwells"] if row["repeat"] == repeat]
        x, y = columns(own, "roller_v", "frequency_hz")
        ax.plot(x, y, marker, color=OTHER, mfc="none", ms=7, label=f"repeat {repeat}")
    x, y = columns(dwells, "roller_v", "frequency_hz")
    ax.plot(x, y, "x", color=BLUE, ms=5, label="repeat 2, not in the map")
    ax.set(xlabel="roller position measured in V", ylabel="frequency in Hz")
    ax.set_title("modal map of two repeats")
    ax.legend()
    ax.grid(alpha=0.3)


def draw_positions(top: Axes, below: Axes, dwells: list[Row]) -> None:
    """Draw inferred over measured positions with 90 % intervals, and their difference."""
    turn = max(dwells, key=lambda row: row["roller_v"])["dwell"]
    (base,) = (row["roller_v"] for row in dwells if row["median"] is None)
    inferred = [row for row in dwells if row["median"] is not None]
    up = [row for row in inferred if row["dwell"] <= turn]
    back = [row for row in inferred if row["dwell"] > turn]
    top.axline((2.0, 2.0), slope=1, color="black", lw=0.8)
    below.axhline(0, color="black", lw=0.8)
    for rows, aside, colour, marker, label in (
        (up, -0.012, BLUE, "o", "on the way up"),
        (back, 0.012, ORANGE, "s", "on the way back"),
    ):
        x, low, mid, high = columns(rows, "roller_v", "q05", "median", "q95")
        reach = np.array([mid - low, high - mid])
        style = {"fmt": marker, "color": colour, "ms": 5, "capsize": 3, "elinewidth": 1.2}
        top.errorbar(x, mid, reach, label=label, **style)
        below.errorbar(x + aside, 1e3 * (mid - x), 1e3 * reach, **style)
    for ax, y in ((top, base), (below, 0.0)):
        ax.plot(base, y, "D", color="black", mfc="none", ms=8, label="baseline, known")
        ax.grid(alpha=0.3)
    top.set(ylabel="inferred in V", title="repeat 2: position inferred, 90 % intervals")
    top.legend()
    top.tick_params(labelbottom=False)
    below.set(ylabel="inferred - measured in mV", xlabel="roller position measured in V")
    below.set_xlim(top.get_xlim())


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw three panels."""
    axes = figure.subplot_mosaic([["map", "top"], ["map", "below"]], height_ratios=[3, 2])
    draw_map(axes["map"], result["calibration"], result["dwells"])
    draw_positions(axes["top"], axes["below"], result["dwells"])


if __name__ == "__main__":
    write(__file__, draw_figure, (9, 4.8), font=9)
