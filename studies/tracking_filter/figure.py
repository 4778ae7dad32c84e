"""Draw figure.svg from result.json: sums of squares, coverages, numbers and times."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.figures import BLACK, BLUE, GREEN, ORANGE, write
from studies.harness.study import Row


def draw_sums(ax: Axes, known: Row) -> None:
    """Draw mean squares of errors and innovations with their bands, and those of the control."""
    names = list(known["as reported"])
    for y, name in enumerate(names):
        row = known["as reported"][name]
        ax.plot([row["low"], row["high"]], [y, y], lw=9, color=BLACK, alpha=0.25,
                solid_capstyle="butt", label="99.9 % band" if y == 0 else None)  # fmt: skip
        for kind, colour, marker in (("as reported", BLUE, "o"), ("halved", ORANGE, "x")):
            label = {"as reported": "covariance as reported", "halved": "halved (control)"}[kind]
            ax.plot(known[kind][name]["mean"], y, marker, color=colour, ms=6,
                    label=label if y == 0 else None)  # fmt: skip
    ax.axvline(1.0, color=BLACK, lw=0.8)
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(len(names) - 0.4, -0.9)
    ax.set_xlabel("mean square in units of what the filter says")
    ax.set_title(f"True setting, {known['lives']:,} lives", fontsize=10)
    ax.legend(fontsize=7, loc="lower right")


def draw_coverage(ax: Axes, rows: dict[str, list[Row]], title: str) -> None:
    """Draw measured coverages of 50 and 90 % intervals with their Clopper-Pearson intervals."""
    for y, (name, levels) in enumerate(rows.items()):
        colour = ORANGE if "control" in name else BLUE
        for row in levels:
            ax.plot([row["low"], row["high"]], [y, y], lw=2, color=colour)
            ax.plot(row["share"], y, "x" if colour == ORANGE else "o", color=colour, ms=5)
    for level in (0.5, 0.9):
        ax.axvline(level, color=BLACK, lw=0.8, ls="--")
    ax.set_yticks(range(len(rows)), list(rows))
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_xlim(0.1, 1.0)
    ax.set_xlabel("share of intervals of 50 and 90 % that hold the truth")
    ax.set_title(title, fontsize=10)


def draw_times(ax: Axes, speed: Row) -> None:
    """Draw processor time in units of the filterpy loop, with the seconds and the differences."""
    rows = speed["programs"]
    for y, row in enumerate(rows):
        colour = BLUE if row["program"].startswith(("bank", "track")) else GREEN
        ax.barh(y, row["times_filterpy"], color=colour, height=0.6)
        text = f"{row['cpu_s']:.2f} s"
        if "deviation" in row:
            text += f", ln f within {row['deviation']:.0e} std"
        ax.text(row["times_filterpy"] + 0.1, y, text, va="center", fontsize=7)
    ax.set_yticks(range(len(rows)), [row["program"] for row in rows])
    ax.invert_yaxis()
    ax.set_xlim(0, 1.45 * max(row["times_filterpy"] for row in rows))
    ax.set_xlabel("processor time over that of the filterpy loop")
    ax.set_title(f"{speed['epochs']:,} epochs of {speed['modes']} modes", fontsize=10)


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw four panels."""
    average, sources = result["averaged"], result["two_sources"]
    axes = figure.subplots(2, 2)
    draw_sums(axes[0, 0], result["known_setting"])
    rows = {f"{name}, quantiles": levels for name, levels in average["mixture"].items()}
    rows |= {f"{name}, ± std": levels for name, levels in average["coverage"].items()}
    rows |= {"drift, half width\n(control)": average["control"]}
    draw_coverage(axes[0, 1], rows, f"Tracker, {average['lives']:,} lives")
    names = {
        "both": "both",
        "accelerometers alone": "one alone",
        "common errors ignored": "common errors\nignored (control)",
    }
    rows = {label: sources[name]["coverage"] for name, label in names.items()}
    draw_coverage(axes[1, 0], rows, f"Drift by two sources, {sources['lives']:,} lives")
    draw_times(axes[1, 1], result["speed"])


if __name__ == "__main__":
    write(__file__, draw_figure, (11.0, 6.5))
