"""Draw figure.svg from result.json: rank histograms, and distributions of ranks in their bands."""

from __future__ import annotations

from matplotlib.figure import Figure

from studies.common.ranks import draw_ecdf, draw_histogram
from studies.harness.figures import BLUE, COLOURS, ORANGE, write
from studies.harness.study import Row

WORDS = {"guide_preload": "preload", "mount_stiffness": "mount"}


def short(name: str) -> str:
    """Shorten the names of parameters."""
    for long, word in WORDS.items():
        name = name.replace(long, word)
    return name


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw histograms above, distributions below."""
    ranks: dict[str, Row] = result["ranks"]
    upper, lower = figure.subfigures(2, 1, height_ratios=[1.0, 1.35])
    axes = iter(upper.subplots(1, 6, sharey=True))
    for kind, colour in (
        ("lms-y", BLUE), ("lms-x", BLUE), ("all covariances halved", ORANGE),
    ):  # fmt: skip
        for name, row in ranks[kind].items():
            draw_histogram(next(axes), row, f"{kind}\n{short(name)}", colour)
    upper.supylabel("ranks per bin over expected", fontsize=8)
    one, shared, controls = lower.subplots(1, 3)
    kinds = ("lms-y", "lms-x", "lms-y, by infer")
    draw_ecdf(one, joined(ranks, kinds), result["bands"], "Epochs of their own", COLOURS)
    draw_ecdf(
        shared,
        {short(name): row for name, row in ranks["lms-y, three epochs of a life"].items()},
        result["bands"],
        "Three epochs that share an error of the map",
        COLOURS,
    )
    kinds = ("covariance of the drifts halved", "all covariances halved", "map taken as exact")
    draw_ecdf(controls, joined(ranks, kinds), result["bands"], "Controls", COLOURS)


def joined(ranks: dict[str, Row], kinds: tuple[str, ...]) -> Row:
    """Put parameters of several kinds of lives into one table."""
    return {
        f"{kind}, {short(name)}, {row['n']:,}": row
        for kind in kinds
        for name, row in ranks[kind].items()
    }


if __name__ == "__main__":
    write(__file__, draw_figure, (11.0, 6.5))
