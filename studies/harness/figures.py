"""Figures of studies: colours, and one way to write ``figure.svg`` from a record."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.study import Row, read_record

# Colours that colour-blind readers can distinguish (Okabe and Ito).
BLUE, ORANGE, GREEN, PINK = "#0072b2", "#d55e00", "#009e73", "#cc79a7"
SKY, YELLOW, BLACK, GREY = "#56b4e9", "#e69f00", "#000000", "#999999"
COLOURS = (BLUE, SKY, ORANGE, YELLOW, GREEN, PINK, BLACK, GREY, "#b8a000")


def write(
    script: str,
    draw: Callable[[Figure, Row], None],
    size: tuple[float, float] | Callable[[Row], tuple[float, float]],
    font: float = 10,
    **options: Any,
) -> None:
    """Draw ``figure.svg`` beside ``figure.py``, ``script``, from ``result.json``.

    ``draw`` fills the figure; its size is in inches, or a function of the record.
    """
    record = read_record(script)
    folder = Path(script).parent
    with matplotlib.rc_context(
        {"svg.hashsalt": folder.name, "font.size": font, "axes.titlesize": 10}
    ):
        width_and_height = size(record) if callable(size) else size
        figure = Figure(figsize=width_and_height, layout="constrained")
        draw(figure, record)
        figure.savefig(folder / "figure.svg", metadata={"Date": None}, **options)


def draw_shares(
    ax: Axes, y: float, rows: Iterable[Row], colour: str, marker: str = "o", **options: Any
) -> None:
    """Draw shares with their intervals on one line of a panel."""
    for row in rows:
        ax.plot([row["low"], row["high"]], [y, y], lw=2, color=colour, alpha=0.6)
        ax.plot(row["share"], y, marker, color=colour, **{"ms": 5, **options})


def draw_intervals(ax: Axes, true: Any, middle: Any, low: Any, high: Any, label: str) -> None:
    """Draw medians and 90 % intervals of several lives, and their truths, one line each."""
    y, error = np.arange(len(true)), np.stack([middle - low, high - middle])
    ax.errorbar(middle, y, xerr=error, fmt="o", ms=3.5, lw=1.2, color=BLUE,
                label="median and 90 % interval")  # fmt: skip
    ax.plot(true, y, "D", ms=4, mfc="none", mew=1.2, color=ORANGE, label="truth")
    ax.set_xlabel(label)
    ax.set_yticks([])
    ax.grid(axis="x", alpha=0.3)


def name_lines(ax: Axes, names: Sequence[str], **options: Any) -> None:
    """Name the lines of a panel, from top to bottom."""
    ax.set_yticks(range(len(names)), names, **options)
    ax.set_ylim(len(names) - 0.4, -0.6)


def legend_above(figure: Figure, ax: Axes, **options: Any) -> None:
    """Draw the legend of one panel above all panels."""
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", frameon=False, **options)
