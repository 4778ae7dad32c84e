"""Draw figure.svg from result.json: errors, coverage, time and memory of every program."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.figures import BLUE, GREEN, ORANGE, draw_shares, name_lines, write
from studies.harness.study import Row

COLOURS, MARKERS = (BLUE, ORANGE, GREEN), "osD"
SHIFT = 0.24
QUANTITIES = {"ln f": "natural frequency", "ln zeta": "damping ratio"}


def marks(ax: Axes, cases: list[Row], values: Callable[[Row], list[float]]) -> None:
    """Draw values of every program, a mark each."""
    for k, case in enumerate(cases):
        for y, row in enumerate(case["tools"].values()):
            found = values(row)
            at = np.full(len(found), y + SHIFT * (k - 1))
            ax.plot(found, at, MARKERS[k], ms=4, color=COLOURS[k], alpha=0.8)


def draw_errors(ax: Axes, cases: list[Row], quantity: str) -> None:
    """Draw root mean square errors over the bound, a mark for each mode."""
    key = "rmse_over_bound"
    marks(
        ax,
        cases,
        lambda row: [m[key] for m in row["modes"] if m["quantity"] == quantity and key in m],
    )
    ax.axvline(1, color="black", lw=1)
    ax.set_xscale("log")
    ax.set_xticks([1, 2, 5, 10, 20], ["1", "2", "5", "10", "20"])
    ax.minorticks_off()
    ax.set_xlabel("RMSE over the Cramér-Rao bound")
    ax.set_title(f"Error of the {QUANTITIES[quantity]}")


def draw_coverage(ax: Axes, cases: list[Row]) -> None:
    """Draw how often 95 % intervals hold the truth, full marks for f and open ones for ζ."""
    for k, case in enumerate(cases):
        for y, row in enumerate(case["tools"].values()):
            for quantity, part in row["coverage"].items():
                is_f = quantity == "ln f"
                here = y + SHIFT * (k - 1) + (0.06 if is_f else -0.06)
                fill = COLOURS[k] if is_f else "white"
                draw_shares(ax, here, [part], COLOURS[k], MARKERS[k], ms=4, mfc=fill)
    for y, row in enumerate(cases[0]["tools"].values()):
        if not row["coverage"]:
            ax.text(0.75, y, "no intervals", fontsize=7, ha="center", va="center")
    ax.axvline(0.95, color="black", lw=1)
    ax.set(xlim=(0.5, 1.01), xlabel="share, 99.9 % interval")
    ax.set_title("Coverage of 95 % intervals\n(full: frequency, open: damping)")


def draw_costs(ax: Axes, cases: list[Row], key: str, label: str, title: str) -> None:
    """Draw time or memory."""
    marks(ax, cases, lambda row: [row[key]])
    ax.set_xscale("log")
    low, high = ax.get_xlim()
    steps = (0.1, 1, 10, 100) if high / low > 500 else (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50)
    ticks = [tick for tick in steps if low <= tick <= high]
    ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    ax.minorticks_off()
    ax.set_xlabel(label)
    ax.set_title(title)


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw five panels that share the list of programs."""
    cases = result["cases"]
    axes = figure.subplots(1, 5, sharey=True)
    draw_errors(axes[0], cases, "ln f")
    draw_errors(axes[1], cases, "ln zeta")
    draw_coverage(axes[2], cases)
    draw_costs(axes[3], cases, "time_over_ours", "time over that of lmshealth", "Time of a record")
    axes[3].axvline(1, color="black", lw=1)
    draw_costs(axes[4], cases, "peak_mb", "peak above what was held, MB", "Memory")
    name_lines(axes[0], list(cases[0]["tools"]))
    for ax in axes:
        ax.grid(alpha=0.25, axis="x")
    for k, case in enumerate(cases):
        axes[0].plot([], [], MARKERS[k], color=COLOURS[k], label=case["case"])
    figure.legend(loc="outside lower center", ncols=3, frameon=False)


if __name__ == "__main__":
    write(__file__, draw_figure, (14.0, 5.2))
