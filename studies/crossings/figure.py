"""Draw figure.svg from result.json: three lives with their labels, swaps, labels given."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.figures import (
    BLUE,
    COLOURS,
    GREEN,
    GREY,
    ORANGE,
    PINK,
    draw_shares,
    name_lines,
    write,
)
from studies.harness.study import Row

MARKERS = "osD^vPX"


def draw_life(ax: Axes, name: str, life: Row) -> None:
    """Draw the estimates of a life, coloured by their labels."""
    clock = life["clock"]
    for column in np.array(life["true_ln_f"]).T:
        ax.plot(clock, np.exp(column), "-", lw=0.8, color="#cccccc", zorder=0)
    shown = zip(life["modes"], life["modes"], COLOURS, MARKERS, strict=False)
    for label, mode, colour, marker in (*shown, ("no label: ambiguous", None, GREY, "x")):
        points = [
            (t, np.exp(y))
            for t, row, labels in zip(clock, life["ln_f"], life["labels"], strict=True)
            for y, own in zip(row, labels, strict=True)
            if own == mode
        ]
        if points:
            ax.plot(*zip(*points, strict=True), marker, ms=4, ls="", color=colour, label=label)
    ax.set_xlabel("odometer, of the life")
    ax.set_ylabel("frequency in Hz")
    ax.set_title(name[0].upper() + name[1:], fontsize=10)
    ax.legend(fontsize=7)


def draw_rate(ax: Axes, y: float, rate: Row, colour: str, marker: str) -> None:
    """Draw a share with its interval."""
    draw_shares(ax, y, [rate | {"share": rate["hits"] / rate["n"]}], colour, marker)


def draw_swaps(ax: Axes, result: Row) -> None:
    """Draw the share of lives swapped silently, with its interval."""
    kinds = result["kinds"]
    for key, colour, marker, shift, label in (
        ("nearest_lives_swapped", ORANGE, "s", 0.15, "nearest frequency (control)"),
        ("lives_swapped", BLUE, "o", -0.15, "as associated"),
    ):
        ax.plot([], [], marker, ms=5, color=colour, label=label)
        for y, row in enumerate(kinds.values()):
            draw_rate(ax, y + shift, row[key], colour, marker)
    ax.plot([], [], "D", ms=5, color=PINK, label="best guess (control)")
    y = list(kinds).index("merging") + 0.3
    draw_rate(ax, y, result["best_guess_where_nothing_tells"], PINK, "D")
    name_lines(ax, list(kinds), fontsize=8)
    ax.set_xlim(-0.03, 1.03)
    ax.set_xlabel("share of lives, 95 % interval")
    ax.set_title(f"Silent swaps in {result['lives']} lives", fontsize=10)
    ax.legend(fontsize=7, loc="upper center")
    ax.grid(alpha=0.25, axis="x")


def draw_recovery(ax: Axes, kinds: dict[str, Row]) -> None:
    """Draw the share labelled over logs since the modes are clear of each other."""
    for (name, row), colour, marker in zip(kinds.items(), COLOURS, MARKERS, strict=False):
        if name != "well apart":
            ax.plot(row["labelled_by_logs_after"], marker + "-", ms=4, color=colour, label=name)
    ax.set_ylim(-0.03, 1.03)
    ax.set_xlabel("logs since modes are 6 σ apart again")
    ax.set_ylabel("share of estimates labelled")
    ax.set_title("Identity after the crossing", fontsize=10)
    ax.legend(fontsize=7, loc="center right", bbox_to_anchor=(1.0, 0.4))
    ax.grid(alpha=0.25)


def draw_labelled(ax: Axes, kinds: dict[str, Row]) -> None:
    """Draw the shares labelled before and after."""
    for key, colour, shift, label in (
        ("labelled_before", GREEN, -0.18, "before"),
        ("labelled_after", BLUE, 0.18, "after"),
    ):
        share = [row[key] for row in kinds.values()]
        y = np.arange(len(share)) + shift
        ax.barh(y, share, 0.34, color=colour, label=f"{label} the crossing")
        for at, value in zip(y, share, strict=True):
            ax.text(value + 0.01, at, f"{100 * value:.1f} %", va="center", fontsize=7)
    name_lines(ax, list(kinds), fontsize=8)
    ax.set_xlim(0, 2.6)
    ax.set_xticks([0, 0.5, 1])
    ax.set_xlabel("share of estimates labelled")
    ax.set_title("Labels given", fontsize=10)
    ax.legend(fontsize=7, loc="center right")


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw six panels."""
    axes = figure.subplots(2, 3)
    for ax, (name, life) in zip(axes[0], result["examples"].items(), strict=True):
        draw_life(ax, name, life)
    draw_swaps(axes[1, 0], result)
    draw_recovery(axes[1, 1], result["kinds"])
    draw_labelled(axes[1, 2], result["kinds"])


if __name__ == "__main__":
    write(__file__, draw_figure, (13.0, 7.5))
