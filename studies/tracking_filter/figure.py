"""Draw figure.svg from result.json: sums of squares and coverages."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.figures import BLACK, BLUE, ORANGE, draw_shares, name_lines, write
from studies.harness.study import Row

LABELS = ("99.9 % band", "covariance as reported", "halved (control)")


def draw_sums(ax: Axes, known: Row) -> None:
    """Draw mean squares of errors and innovations with their bands, and those of the control."""
    band = {"lw": 9, "color": BLACK, "alpha": 0.25, "solid_capstyle": "butt"}
    for y, (row, control) in enumerate(
        zip(known["as reported"].values(), known["halved"].values(), strict=True)
    ):
        labels = iter(LABELS if y == 0 else (None,) * 3)
        ax.plot([row["low"], row["high"]], [y, y], label=next(labels), **band)
        ax.plot(row["mean"], y, "o", color=BLUE, ms=6, label=next(labels))
        ax.plot(control["mean"], y, "x", color=ORANGE, ms=6, label=next(labels))
    ax.axvline(1.0, color=BLACK, lw=0.8)
    name_lines(ax, list(known["as reported"]))
    ax.set_xlabel("mean square in units of what the filter says")
    ax.set_title(f"True setting, {known['lives']:,} lives", fontsize=10)
    ax.legend(fontsize=7, loc="center", bbox_to_anchor=(0.45, 0.5))


def draw_coverage(ax: Axes, rows: dict[str, list[Row]], title: str) -> None:
    """Draw measured coverages of 50 and 90 % intervals with their Clopper-Pearson intervals."""
    for y, (name, levels) in enumerate(rows.items()):
        draw_shares(ax, y, levels, *((ORANGE, "x") if "control" in name else (BLUE, "o")))
    for level in (0.5, 0.9):
        ax.axvline(level, color=BLACK, lw=0.8, ls="--")
    name_lines(ax, list(rows))
    ax.set(xlim=(0.1, 1.0), xlabel="share of intervals of 50 and 90 % that hold the truth")
    ax.set_title(title, fontsize=10)


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw three panels."""
    average, sources = result["averaged"], result["two_sources"]
    left, middle, right = figure.subplots(1, 3)
    draw_sums(left, result["known_setting"])
    rows = {f"{name}, quantiles": levels for name, levels in average["mixture"].items()}
    rows |= {f"{name}, ± std": levels for name, levels in average["coverage"].items()}
    rows |= {"drift, half width\n(control)": average["control"]}
    draw_coverage(middle, rows, f"Tracker, {average['lives']:,} lives")
    names = ("both", "one alone", "common errors\nignored (control)")
    kinds = ("both", "accelerometers alone", "common errors ignored")
    rows = {label: sources[kind]["coverage"] for label, kind in zip(names, kinds, strict=True)}
    draw_coverage(right, rows, f"Drift by two sources, {sources['lives']:,} lives")


if __name__ == "__main__":
    write(__file__, draw_figure, (13.0, 3.6))
