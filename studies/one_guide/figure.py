"""Draw figure.svg from result.json: widths of what is known alone and together, and coverages."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.figures import BLACK, BLUE, ORANGE, write
from studies.harness.study import Row


def rows_of(answer: Row) -> list[tuple[str, Row]]:
    """Name every parameter of every way."""
    return [
        (f"{way}: {name.split(':')[-1].replace('_', ' ')}" + machine(name), own)
        for way, parameters in answer["ways"].items()
        for name, own in parameters.items()
    ]


def machine(name: str) -> str:
    """Say whose parameter one of several is."""
    return f" of {name.split(':')[0][-1].upper()}" if ":" in name else ""


def draw_widths(ax: Axes, rows: list[tuple[str, Row]]) -> None:
    """Draw the median width of the 90 % interval of ln parameter, hatched where it is no claim."""
    for y, (_, own) in enumerate(rows):
        claimed = own["told"] > 0.5
        ax.barh(y, 100 * own["median_width"], color=BLUE if claimed else "white", height=0.6,
                edgecolor=BLACK, hatch=None if claimed else "///", lw=0.8)  # fmt: skip
        text = f"{100 * own['median_width']:.1f} %"
        ax.text(108 * own["median_width"], y, text if claimed else f"{text}, not claimed",
                va="center", fontsize=8)  # fmt: skip
    ax.set_xscale("log")
    ax.set_xlim(1, 600)
    ax.set_yticks(range(len(rows)), [name for name, _ in rows], fontsize=8)
    ax.set_ylim(len(rows) - 0.4, -0.6)
    ax.set_xlabel("median width of the 90 % interval of ln parameter")
    ax.set_title("What is known", fontsize=10)


def draw_coverage(ax: Axes, rows: list[tuple[str, list[Row], bool]]) -> None:
    """Draw coverages of 50 and 90 % intervals with their Clopper-Pearson intervals."""
    for y, (_, levels, control) in enumerate(rows):
        for row in levels:
            ax.plot([row["low"], row["high"]], [y, y], lw=2, color=ORANGE if control else BLUE)
            ax.plot(row["share"], y, "x" if control else "o", color=ORANGE if control else BLUE,
                    ms=5)  # fmt: skip
    for level in (0.5, 0.9):
        ax.axvline(level, color=BLACK, lw=0.8, ls="--")
    ax.set_yticks(range(len(rows)), [name for name, _, _ in rows], fontsize=8)
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_xlim(0, 1.02)
    ax.set_xlabel("share of 50 and 90 % intervals that hold the truth")
    ax.set_title("Whether intervals cover (×: controls that must not)", fontsize=10)


def draw_figure(figure: Figure, answer: Row) -> None:
    """Draw the figure."""
    left, right = figure.subplots(1, 2)
    rows = rows_of(answer)
    draw_widths(left, rows)
    controls = [(f"control: {name}", own, True) for name, own in answer["controls"].items()]
    draw_coverage(right, [(name, own["coverage"], False) for name, own in rows] + controls)


if __name__ == "__main__":
    write(__file__, draw_figure, (11.5, 4.2))
