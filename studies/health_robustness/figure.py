"""Draw figure.svg from result.json and raw.json: coverage and bias, by kinds, arms and plants."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.figures import BLACK, BLUE, ORANGE, name_lines, write
from studies.harness.study import Row, read_record

PARAMETERS = {"guide_preload": (BLUE, "o", "preload"), "mount_stiffness": (ORANGE, "s", "mount")}
WHAT = {"last": "last log, no law", "now": "now, by laws", "left": "remaining life"}


Name = Callable[[Row], str]


def draw_lines(
    ax: Axes, values: Callable[[Row], list[float | None]], own: list[Row], raw: list[Row],
    name: Name, names: list[str],
) -> None:  # fmt: skip
    """Draw low, middle and high values of rows and the middle of raw lives, one line per name."""
    for row in own:
        colour, marker, _ = PARAMETERS.get(row["parameter"], (BLACK, "D", "first of both"))
        place = list(PARAMETERS).index(row["parameter"]) if row["parameter"] in PARAMETERS else 2
        y, (low, middle, high) = names.index(name(row)) + 0.2 * (place - 0.5), values(row)
        ax.plot([low, high], [y, y], lw=1.3, color=colour, alpha=0.6)
        ax.plot(middle, y, marker, ms=4, color=colour)
    for row in raw:
        if name(row) in names and row["parameter"] in PARAMETERS:
            colour = PARAMETERS[row["parameter"]][0]
            ax.plot(values(row)[1], names.index(name(row)) + 0.36, "x", ms=4, color=colour)
    name_lines(ax, names)
    ax.grid(axis="x", alpha=0.25)


def coverage(
    ax: Axes, own: list[Row], name: Name, names: list[str], raw: Sequence[Row] = ()
) -> None:
    """Draw how often intervals contain the truth."""
    ax.axvline(0.9, color=BLACK, ls="--", lw=1)
    draw_lines(ax, lambda row: [row["90"][key] for key in ("low", "share", "high")],
               own, list(raw), name, names)  # fmt: skip
    ax.set_xlim(-0.02, 1.02)
    ax.set_xlabel("share of 90 % intervals holding the truth")


def off(row: Row) -> list[float | None]:
    """Return the mean error of medians in %, with two standard errors below and above."""
    mean, se = row["error"]["mean"], row["error"]["se"] or 0.0
    return [100 * (mean - 2 * se), 100 * mean, 100 * (mean + 2 * se)]


def bias(ax: Axes, own: list[Row], name: Name, names: list[str], raw: list[Row]) -> None:
    """Draw the mean error of medians."""
    ax.axvline(0, color=BLACK, lw=1)
    draw_lines(ax, off, own, raw, name, names)
    ax.set_xscale("symlog", linthresh=2)
    ticks = (-20, -5, -2, 0, 2, 5, 20)
    ax.set_xticks(ticks, [str(tick) for tick in ticks])
    ax.set_xlabel("mean error of the median in %, ± 2 std errors")


def kind(row: Row) -> str:
    """Name a kind of life."""
    return f"{row['stage'][-1].upper()} {row['kind']}"


def fleet(row: Row) -> str:
    """Name an arm of drawn lives."""
    return f"{row['world']}:\n{row['arm']}"


def plant(row: Row) -> str:
    """Name a wrong plant."""
    return f"{row['plant']}:\n{'with' if row['arm'] == 'coherent' else 'no'} error term"


def draw_demo(ax: Axes, rows: list[Row]) -> None:
    """Draw how wide intervals of the demo's kind of life are, and what lies in their middle."""
    names = named_in(rows, fleet)
    for row in rows:
        colour, _, _ = PARAMETERS[row["parameter"]]
        y = names.index(fleet(row)) + 0.36 * (list(PARAMETERS).index(row["parameter"]) - 0.5)
        ax.barh(y, 100 * row["width"], 0.32, color=colour)
        rms = 3.29 * row["error"]["rms"]
        ax.plot(100 * rms, y, "|", ms=11, mew=2, color=BLACK)
        side = 100 * max(row["width"], rms) + 0.2
        ax.text(side, y, f"{100 * row['third']:.0f} % in a third", va="center",
                fontsize=7)  # fmt: skip
    ax.plot([], [], "|", ms=11, mew=2, color=BLACK, label="3.29 × rms error of the median")
    ax.set_yticks(range(len(names)), names)
    ax.set_xlim(0, 1.6 * max(100 * row["width"] for row in rows))
    ax.set_xlabel("median width of the 90 % interval in %")
    ax.set_title("Y, both wear, last log\n(a third of an interval holds 42 %)", fontsize=10)
    ax.set_ylim(len(names) - 0.1, -0.6)
    ax.legend(fontsize=7, loc="lower right")


def named_in(rows: list[Row], named: Name) -> list[str]:
    """Names of rows, each once."""
    return list(dict.fromkeys(named(row) for row in rows))


def of(rows: list[Row], what: str) -> list[Row]:
    """Rows of one question."""
    return [row for row in rows if row["what"] == what]


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw."""
    raw = read_record(__file__, "raw")["lives"]
    control = read_record(__file__, "control")["fleets"]
    arms = {(row["stage"], row["arm"]) for row in control}
    result["fleets"] = control + [
        row for row in result["fleets"] if (row["stage"], row["arm"]) not in arms
    ]
    top, middle, bottom = figure.subfigures(3, 1, height_ratios=(2.1, 1.3, 1.5))
    lives, fleets, plants = result["lives"], result["fleets"], result["plants"]
    axes = top.subplots(1, 3, sharey=True)
    names = named_in(lives, kind)
    coverage(axes[0], of(lives, "last"), kind, names, of(raw, "last"))
    axes[0].set_title("Kinds of lives: last log, no law", fontsize=10)
    bias(axes[1], of(lives, "last"), kind, names, of(raw, "last"))
    axes[1].set_title("The same: bias", fontsize=10)
    bias(axes[2], of(lives, "now"), kind, names, of(raw, "now"))
    axes[2].set_title("Health now by laws of the whole life: bias", fontsize=10)
    axes = middle.subplots(1, 3, sharey=True)
    own = [row for row in fleets if row["stage"] == "lms-y"]
    for ax, (what, title) in zip(axes, WHAT.items(), strict=True):
        coverage(ax, of(own, what), fleet, named_in(own, fleet))
        ax.set_title(f"Y, drawn from the priors: {title}", fontsize=10)
    left, right = bottom.subfigures(1, 2, width_ratios=(2, 1.1))
    for ax, (what, title) in zip(left.subplots(1, 2, sharey=True), WHAT.items(), strict=False):
        coverage(ax, of(plants, what), plant, named_in(plants, plant))
        ax.set_title(f"Y, a wrong plant's map: {title}", fontsize=10)
    draw_demo(right.subplots(), result["demo"])
    for colour, marker, what in (*PARAMETERS.values(), (BLACK, "D", "first limit of both"),
                                 (BLACK, "x", "raw lives")):  # fmt: skip
        axes[2].plot([], [], marker, color=colour, label=what)
    axes[2].legend(fontsize=7, loc="lower left")


if __name__ == "__main__":
    write(__file__, draw_figure, (13, 15), font=8)
