"""Draw figure.svg from result.json: rank histograms, and distributions of ranks in their bands."""

from __future__ import annotations

from matplotlib.figure import Figure

from studies.common.ranks import draw_ecdf, draw_histogram
from studies.harness.figures import COLOURS, write
from studies.harness.study import Row

SHOWN = ("preload now", "mount now", "remaining, first of both")


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw histograms on the left, distributions on the right."""
    ranks: dict[str, Row] = result["ranks"]
    left, right = figure.subfigures(1, 2, width_ratios=[1.0, 1.25])
    axes = left.subplots(3, 3, sharex=True, sharey=True)
    axes[2, 2].set_visible(False)
    for ax, (name, row) in zip(axes.flat, ranks["posterior"].items(), strict=False):
        draw_histogram(ax, row, name.replace(", ", ",\n"))
    left.supylabel("ranks per bin over expected", fontsize=8)
    left.supxlabel("rank of the truth (share of draws below)", fontsize=8)
    panels = right.subplots(2, 2)
    lives = ranks["posterior"][SHOWN[0]]["n"]
    draw_ecdf(panels[0, 0], ranks["posterior"], result["bands"], f"All, {lives:,} lives", COLOURS)
    for ax, kind in zip(
        panels.flat[1:],
        ("by chains", "map taken as exact", "every part taken to lose"),
        strict=True,
    ):
        rows = {name: ranks[kind][name] for name in SHOWN}
        draw_ecdf(ax, rows, result["bands"], f"{kind}, {rows[SHOWN[0]]['n']:,} lives", COLOURS)


if __name__ == "__main__":
    write(__file__, draw_figure, (11.0, 8.0))
