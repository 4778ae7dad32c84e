"""Draw figure.svg from result.json: the paper's tables and the simulated ones over each other."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.figures import BLUE, GREEN, ORANGE, PINK, write
from studies.harness.study import Row

COLOURS = {"x": BLUE, "y": ORANGE}
VELOCITIES = np.array([1, 5, 10, 20, 100, 200, 400])
ERRATUM = {"color": "#56606b", "arrowprops": {"arrowstyle": "-", "color": "#56606b"}}


def over_velocity(ax: Axes, rows: list[Row], key: str, label: str) -> None:
    """Draw a row of X and of Y: printed as points, full stages as a line, rigid as a dashed one."""
    for axis, colour in COLOURS.items():
        rigid, row = (row for row in rows if row["row"] == f"{axis} {key}")
        ax.plot(VELOCITIES, rigid["simulated"], "--", lw=1, color=colour)
        mean, scatter = np.array(row["simulated"]), np.array(row["scatter"])
        name = axis.upper()
        ax.plot(VELOCITIES, mean, color=colour, label=f"{name} full stage, ±1σ of seeds")
        ax.fill_between(VELOCITIES, mean - scatter, mean + scatter, color=colour, alpha=0.2, lw=0)
        style = {"color": colour, "mfc": "white", "label": f"{name} printed"}
        ax.plot(VELOCITIES, row["printed"], "o", **style)
        if row["row"] == "x std_um":
            at = 100, row["printed"][4]
            ax.annotate("X misprinted: Y's value", at, xytext=(14, 8.5), **ERRATUM)
    ax.set(xscale="log", yscale="log", xlabel="velocity in mm/s", ylabel=label)
    ax.set_xticks(VELOCITIES, [str(v) for v in VELOCITIES])
    ax.minorticks_off()


def over_frequency(ax: Axes, rows: list[Row], axis: str, table: str) -> None:
    """Draw magnitudes of the full stage over frequency at 10 and 400 mm/s."""
    own = [row for row in rows if row["table"] == table and row["plant"] == "full"]
    hertz = [int(row["row"].split()[1]) for row in own]
    for cell, colour in ((2, GREEN), (6, PINK)):
        for key, style in (("simulated", "-"), ("printed", "o")):
            label = f"{key}, {VELOCITIES[cell]} mm/s"
            y = [row[key][cell] for row in own]
            ax.plot(hertz, y, style, ms=4, color=colour, mfc="white", label=label)
    ax.set(yscale="log", xlabel="frequency in Hz", ylim=(0.03, 1000))
    ax.set_ylabel(f"{axis.upper()}: largest harmonic of acceleration\nin mm/s² ({table})")


def draw_figure(figure: Figure, record: Row) -> None:
    """Draw errors over velocity above, accelerations over frequency below."""
    rows, axes = record["rows"], figure.subplots(2, 2)
    over_velocity(axes[0, 0], rows, "std_um", "standard deviation of Δe in µm (Table 3)")
    over_velocity(axes[0, 1], rows, "max_magnitude_um", "largest harmonic of Δe in µm (Table 4)")
    over_frequency(axes[1, 0], rows, "x", "Table 6")
    over_frequency(axes[1, 1], rows, "y", "Table 7")
    for ax in axes.flat:
        ax.grid(alpha=0.25)
        ax.legend(frameon=False, fontsize=8)


if __name__ == "__main__":
    write(__file__, draw_figure, (10, 7.6))
