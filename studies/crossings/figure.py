"""Draw figure.svg from result.json: three lives with their labels, swaps, labels given."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.figures import BLUE, GREEN, ORANGE, PINK, SKY, YELLOW, write
from studies.harness.study import Row

GREY = "#888888"
COLOURS = (BLUE, ORANGE, GREEN, PINK, YELLOW, SKY, "#000000")
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


def draw_swaps(ax: Axes, result: Row) -> None:
    """Draw the share of lives swapped silently, with its interval."""
    kinds = result["kinds"]
    for key, colour, marker, shift, label in (
        ("nearest_lives_swapped", ORANGE, "s", 0.15, "nearest frequency (control)"),
        ("lives_swapped", BLUE, "o", -0.15, "as associated"),
    ):
        for y, row in enumerate(kinds.values()):
            rate = row[key]
            ax.plot([rate["low"], rate["high"]], [y + shift] * 2, lw=2, color=colour, alpha=0.6)
            ax.plot(rate["hits"] / rate["n"], y + shift, marker, ms=5, color=colour,
                    label=label if y == 0 else None)  # fmt: skip
    guess, y = result["best_guess_where_nothing_tells"], list(kinds).index("merging")
    ax.plot([guess["low"], guess["high"]], [y + 0.3] * 2, lw=2, color=PINK, alpha=0.6)
    ax.plot(guess["hits"] / guess["n"], y + 0.3, "D", ms=5, color=PINK,
            label="best guess (control)")  # fmt: skip
    ax.set_yticks(range(len(kinds)), list(kinds), fontsize=8)
    ax.invert_yaxis()
    ax.set_xlim(-0.03, 1.03)
    ax.set_xlabel("share of lives, 95 % interval")
    ax.set_title(f"Silent swaps in {result['lives']} lives", fontsize=10)
    ax.legend(fontsize=7, loc="upper center")
    ax.grid(alpha=0.25, axis="x")


def draw_recovery(ax: Axes, kinds: dict[str, Row]) -> None:
    """Draw the share labelled over logs since the modes are clear of each other."""
    for (name, row), colour, marker in zip(kinds.items(), COLOURS, MARKERS, strict=True):
        if name != "well apart":
            ax.plot(row["labelled_by_logs_after"], marker + "-", ms=4, color=colour, label=name)
    ax.set_ylim(-0.03, 1.03)
    ax.set_xlabel("logs since modes are 6 σ apart again")
    ax.set_ylabel("share of estimates labelled")
    ax.set_title("Identity after the crossing", fontsize=10)
    ax.legend(fontsize=7, loc="center right", bbox_to_anchor=(1.0, 0.4))
    ax.grid(alpha=0.25)


def draw_shares(ax: Axes, kinds: dict[str, Row]) -> None:
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
    ax.set_yticks(range(len(kinds)), list(kinds), fontsize=8)
    ax.invert_yaxis()
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
    draw_shares(axes[1, 2], result["kinds"])


if __name__ == "__main__":
    write(__file__, draw_figure, (13.0, 7.5))
