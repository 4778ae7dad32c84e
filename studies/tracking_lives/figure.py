"""Draw figure.svg from result.json and raw.json: coverage, alarms, delays, events."""

from __future__ import annotations

from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.figures import BLACK, BLUE, GREEN, ORANGE, write
from studies.harness.study import Row, read_record

_LEAST_RATE = 1e-3
_WHO = {
    "bound_knows": ("bound, all known", BLACK),
    "knows": ("optimum, all known", BLACK),
    "bound_learns": ("bound, has to learn", GREEN),
    "learns": ("optimum, has to learn", GREEN),
    "tracker": ("tracker", BLUE),
}


def label(row: Row) -> str:
    """Name a row."""
    return f"{row['stage'][-1].upper()} {row['name']}"


def interval(ax: Axes, y: float, rate: Row, colour: str, marker: str, least: float = 0,
             **style: Any) -> None:  # fmt: skip
    """Draw a share and its interval."""
    ax.plot([max(rate["low"], least), rate["high"]], [y, y], lw=1.5, color=colour, alpha=0.6)
    ax.plot(max(rate["share"], least), y, marker, ms=4.5, color=colour, **style)


def draw_coverage(ax: Axes, result: Row, raw: Row) -> None:
    """Draw how often intervals of the drift hold the truth."""
    rows = result["lives"]
    names = [label(row) for row in rows]
    for nominal, colour, marker in (("90", BLUE, "o"), ("50", ORANGE, "s")):
        ax.axvline(float(nominal) / 100, color=colour, ls="--", lw=1)
        for y, row in enumerate(rows):
            interval(ax, y, row["coverage"][nominal], colour, marker)
        interval(ax, len(rows), result["halved"][nominal], colour, marker)
        for row in raw["lives"]:
            share = row["coverage"][nominal]["share_of_all"]
            ax.plot(share, names.index(label(row)) + 0.3, "x", ms=4, color=colour)
        ax.plot([], [], marker, color=colour, ls="-", label=f"{nominal} %, 99.9 % interval")
    ax.plot([], [], "x", color=BLACK, label="raw lives, all intervals")
    ax.set_yticks(range(len(rows) + 1), [*names, "control: R halved"])
    ax.invert_yaxis()
    ax.set_xlim(0.2, 1.02)
    ax.set_xlabel("share of intervals of the drift that hold the truth")
    ax.set_title("Coverage", fontsize=10)
    ax.legend(fontsize=7, loc="upper left")
    ax.grid(axis="x", alpha=0.25)


def draw_alarms(ax: Axes, result: Row, raw: Row) -> None:
    """Draw how many lives alarm."""
    rows = result["lives"] + result["controls"]
    names = [label(row) for row in rows]
    for y, row in enumerate(rows):
        control = row in result["controls"]
        damaged = not control and row["alarms"]["share"] > 0.5
        colour = ORANGE if control else GREEN if damaged else BLUE
        interval(ax, y, row["alarms"], colour, "D" if control else "o", _LEAST_RATE)
    for row in raw["lives"]:
        share = max(row["alarms"]["share"], _LEAST_RATE)
        ax.plot(share, names.index(label(row)) + 0.3, "x", ms=4, color=BLACK)
    for colour, marker, what in (
        (BLUE, "o", "healthy"),
        (GREEN, "o", "damaged"),
        (ORANGE, "D", "control: not known"),
        (BLACK, "x", "raw lives"),
    ):
        ax.plot([], [], marker, color=colour, label=what)
    ax.axvline(0.01, color=BLACK, ls="--", lw=1)
    ax.set_xscale("log")
    ax.set_xlim(_LEAST_RATE * 0.8, 1.3)
    ax.set_yticks(range(len(rows)), names)
    ax.invert_yaxis()
    ax.set_xlabel("share of lives with an alarm (none: left edge), 99.9 % interval")
    ax.set_title("Alarms, 1 % declared", fontsize=10)
    ax.legend(fontsize=7, loc="upper right")
    ax.grid(axis="x", alpha=0.25)


def draw_delays(ax: Axes, delays: Row) -> None:
    """Draw when a loss of 5 % in 60 logs is told."""
    for y, (key, (_, colour)) in enumerate(_WHO.items()):
        own = delays[key]
        ax.plot([own["q5"], own["q95"]], [y, y], lw=5, color=colour, alpha=0.35)
        ax.plot(own["q50"], y, "o", ms=6, color=colour)
        ax.text(own["q95"] + 0.8, y, f"{delays[key + '_km']['q50']:.0f} km", va="center",
                fontsize=7)  # fmt: skip
    ax.set_yticks(range(len(_WHO)), [name for name, _ in _WHO.values()])
    ax.invert_yaxis()
    ax.set_xlim(0, 60)
    ax.set_xlabel("logs of 20 s until it is told: median, 5 to 95 %")
    ax.set_title("Delay of a loss of 5 % preload over 60 logs", fontsize=10)
    ax.grid(axis="x", alpha=0.25)


def draw_events(ax: Axes, rows: list[Row]) -> None:
    """Draw the share of undeclared events that are reported for what they are."""
    rows = [
        row
        for row in rows
        if "found_right" in row["events"]
        and ("undeclared" in row["name"] or row["kind"] in ("crash", "sudden-loosening"))
    ]
    for y, row in enumerate(rows):
        interval(ax, y, row["events"]["found_right"], BLUE, "o")
        until = row["events"]["logs_until"]
        when = f"{until['q50']:g} after its first log (95 %: {until['q95']:.0f})"
        ax.text(0.61, y, when, va="center", fontsize=7)
    ax.set_yticks(range(len(rows)), [label(row) for row in rows])
    ax.invert_yaxis()
    ax.set_xlim(0.6, 1.01)
    ax.set_xlabel("share of undeclared events told for what they are, 99.9 % interval")
    ax.set_title("Events", fontsize=10)
    ax.grid(axis="x", alpha=0.25)


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw."""
    raw = read_record(__file__, "raw")
    axes = figure.subplots(2, 2, height_ratios=(2.2, 1))
    draw_coverage(axes[0, 0], result, raw)
    draw_alarms(axes[0, 1], result, raw)
    draw_delays(axes[1, 0], result["power"]["delays"])
    draw_events(axes[1, 1], result["lives"])


if __name__ == "__main__":
    write(__file__, draw_figure, (11, 9), font=8)
