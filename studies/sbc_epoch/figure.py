"""Draw figure.svg from result.json: rank histograms, and distributions of ranks in their bands."""

from __future__ import annotations

from matplotlib.figure import Figure

from studies.common.ranks import draw_ecdf, draw_histogram
from studies.harness.figures import BLUE, COLOURS, ORANGE, write
from studies.harness.study import Row


def short(name: str) -> str:
    """Shorten the names of parameters."""
    return name.replace("guide_preload", "preload").replace("mount_stiffness", "mount")


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw histograms above, distributions below."""
    ranks: dict[str, Row] = result["ranks"]
    upper, lower = figure.subfigures(2, 1, height_ratios=[1.0, 1.35])
    axes = iter(upper.subplots(1, 6, sharey=True))
    halved = "all covariances halved"
    for kind, colour in (("lms-y", BLUE), ("lms-x", BLUE), (halved, ORANGE)):
        for name, row in ranks[kind].items():
            draw_histogram(next(axes), row, f"{kind}\n{short(name)}", colour)
    upper.supylabel("ranks per bin over expected", fontsize=8)
    shared = "lms-y, three epochs of a life"
    three = {short(name): row for name, row in ranks[shared].items()}
    controls = ("covariance of the drifts halved", halved, "map taken as exact")
    for ax, rows, title in zip(
        lower.subplots(1, 3),
        (joined(ranks, ("lms-y", "lms-x", "lms-y, by infer")), three, joined(ranks, controls)),
        ("Epochs of their own", "Three epochs that share an error of the map", "Controls"),
        strict=True,
    ):
        draw_ecdf(ax, rows, result["bands"], title, COLOURS)


def joined(ranks: dict[str, Row], kinds: tuple[str, ...]) -> Row:
    """Put parameters of several kinds of lives into one table."""
    return {
        f"{kind}, {short(name)}, {row['n']:,}": row
        for kind in kinds
        for name, row in ranks[kind].items()
    }


if __name__ == "__main__":
    write(__file__, draw_figure, (11.0, 6.5))
