"""Draw figure.svg from result.json: widths of what is known alone and together, and coverages."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.figures import BLACK, BLUE, ORANGE, draw_shares, name_lines, write
from studies.harness.study import Row


def rows_of(answer: Row) -> list[tuple[str, Row]]:
    """Name every parameter of every way, with its machine where one of several has it."""
    rows = []
    for way, parameters in answer["ways"].items():
        for name, own in parameters.items():
            machine, _, parameter = name.rpartition(":")
            of = f" of {machine[-1].upper()}" if machine else ""
            rows.append((f"{way}: {parameter.replace('_', ' ')}{of}", own))
    return rows


def draw_widths(ax: Axes, rows: list[tuple[str, Row]]) -> None:
    """Draw the median width of the 90 % interval of ln parameter, hatched where it is no claim."""
    for y, (_, own) in enumerate(rows):
        claimed, width = own["published"] > 0.5, 100 * own["median_width"]
        style = {"color": BLUE} if claimed else {"color": "white", "hatch": "///"}
        ax.barh(y, width, height=0.6, edgecolor=BLACK, lw=0.8, **style)
        text = f"{width:.1f} %" + ("" if claimed else ", not claimed")
        ax.text(1.08 * width, y, text, va="center", fontsize=8)
    name_lines(ax, [name for name, _ in rows], fontsize=8)
    ax.set(xscale="log", xlim=(1, 600), title="What is known")
    ax.set_xlabel("median width of the 90 % interval of ln parameter")


def draw_coverage(ax: Axes, rows: dict[str, list[Row]]) -> None:
    """Draw coverages of 50 and 90 % intervals with their Clopper-Pearson intervals."""
    for y, (name, levels) in enumerate(rows.items()):
        draw_shares(ax, y, levels, *((ORANGE, "x") if name.startswith("control") else (BLUE, "o")))
    for level in (0.5, 0.9):
        ax.axvline(level, color=BLACK, lw=0.8, ls="--")
    name_lines(ax, list(rows), fontsize=8)
    ax.set(xlim=(0, 1.02), xlabel="share of 50 and 90 % intervals that hold the truth")
    ax.set_title("Whether intervals cover (×: controls that must not)")


def draw_figure(figure: Figure, answer: Row) -> None:
    """Draw the figure."""
    left, right = figure.subplots(1, 2)
    rows = rows_of(answer)
    draw_widths(left, rows)
    controls = {f"control: {name}": own for name, own in answer["controls"].items()}
    draw_coverage(right, {name: own["coverage"] for name, own in rows} | controls)


if __name__ == "__main__":
    write(__file__, draw_figure, (11.5, 4.2))
