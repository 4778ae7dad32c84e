"""Draw figure.svg from result.json: distributions of ranks in their bands."""

from __future__ import annotations

from matplotlib.figure import Figure

from studies.common.ranks import draw_ecdf
from studies.harness.figures import COLOURS, write
from studies.harness.study import Row


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw a panel for the map assumed, one for its error, one for the control."""
    axes = figure.subplots(1, 3, sharey=True)
    for ax, (name, rows) in zip(axes, result["ranks"].items(), strict=True):
        lives = next(iter(rows.values()))["n"]
        draw_ecdf(ax, rows, result["bands"], f"{name}, {lives} raw lives", COLOURS)


if __name__ == "__main__":
    write(__file__, draw_figure, (11.5, 4.4))
