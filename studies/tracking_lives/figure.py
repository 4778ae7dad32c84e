"""Draw figure.svg from result.json and raw.json: coverage, alarms, delays, events."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.figures import BLACK, BLUE, GREEN, ORANGE, draw_shares, name_lines, write
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


def draw_coverage(ax: Axes, result: Row, raw: Row) -> None:
    """Draw how often intervals of the drift hold the truth."""
    rows = [*result["lives"], {"coverage": result["halved"]}]
    names = [*map(label, result["lives"]), "control: R halved"]
    for nominal, colour, marker in (("90", BLUE, "o"), ("50", ORANGE, "s")):
        ax.axvline(float(nominal) / 100, color=colour, ls="--", lw=1)
        for y, row in enumerate(rows):
            draw_shares(ax, y, [row["coverage"][nominal]], colour, marker)
        for row in raw["lives"]:
            share = row["coverage"][nominal]["share_of_all"]
            ax.plot(share, names.index(label(row)) + 0.3, "x", ms=4, color=colour)
        ax.plot([], [], marker, color=colour, ls="-", label=f"{nominal} %, 99.9 % interval")
    ax.plot([], [], "x", color=BLACK, label="raw lives, all intervals")
    name_lines(ax, names)
    ax.set(xlim=(0.2, 1.02), xlabel="share of intervals of the drift that hold the truth")
    ax.set_title("Coverage")
    ax.legend(fontsize=7, loc="upper left")


def draw_alarms(ax: Axes, result: Row, raw: Row) -> None:
    """Draw how many lives alarm."""
    names = [label(row) for row in result["lives"] + result["controls"]]
    damaged = [row for row in result["lives"] if row["alarms"]["share"] > 0.5]
    healthy = [row for row in result["lives"] if row not in damaged]
    for rows, colour, marker, what in (
        (healthy, BLUE, "o", "healthy"),
        (damaged, GREEN, "o", "damaged"),
        (result["controls"], ORANGE, "D", "control: not known"),
    ):
        for row in rows:
            seen = {key: max(value, _LEAST_RATE) for key, value in row["alarms"].items()}
            draw_shares(ax, names.index(label(row)), [seen], colour, marker)
        ax.plot([], [], marker, color=colour, label=what)
    shares = [max(row["alarms"]["share"], _LEAST_RATE) for row in raw["lives"]]
    lines = [names.index(label(row)) + 0.3 for row in raw["lives"]]
    ax.plot(shares, lines, "x", ms=4, color=BLACK, label="raw lives")
    ax.axvline(0.01, color=BLACK, ls="--", lw=1)
    name_lines(ax, names)
    ax.set(xscale="log", xlim=(_LEAST_RATE * 0.8, 1.3), title="Alarms, 1 % declared")
    ax.set_xlabel("share of lives with an alarm (none: left edge), 99.9 % interval")
    ax.legend(fontsize=7, loc="upper right")


def draw_delays(ax: Axes, delays: Row) -> None:
    """Draw when a loss of 5 % in 60 logs is reported."""
    for y, (key, (_, colour)) in enumerate(_WHO.items()):
        own, km = delays[key], f"{delays[key + '_km']['q50']:.0f} km"
        ax.plot([own["q5"], own["q95"]], [y, y], lw=5, color=colour, alpha=0.35)
        ax.plot(own["q50"], y, "o", ms=6, color=colour)
        ax.text(own["q95"] + 0.8, y, km, va="center", fontsize=7)
    name_lines(ax, [name for name, _ in _WHO.values()])
    ax.set(xlim=(0, 60), xlabel="logs of 20 s until the alarm: median, 5 to 95 %")
    ax.set_title("Delay of a loss of 5 % preload over 60 logs")


def draw_events(ax: Axes, rows: list[Row]) -> None:
    """Draw the share of undeclared events that are reported for what they are."""
    names = ("crash", "sudden-loosening")
    rows = [r for r in rows if r["name"] in names or "undeclared" in r["name"]]
    for y, row in enumerate(rows):
        draw_shares(ax, y, [row["events"]["found_right"]], BLUE)
        until = row["events"]["logs_until"]
        when = f"{until['q50']:g} after its first log (95 %: {until['q95']:.0f})"
        ax.text(0.61, y, when, va="center", fontsize=7)
    name_lines(ax, [label(row) for row in rows])
    ax.set(xlim=(0.6, 1.01), title="Events")
    ax.set_xlabel("share of undeclared events detected with the right kind, 99.9 % interval")


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw four panels."""
    raw = read_record(__file__, "raw")
    axes = figure.subplots(2, 2, height_ratios=(2.2, 1))
    draw_coverage(axes[0, 0], result, raw)
    draw_alarms(axes[0, 1], result, raw)
    draw_delays(axes[1, 0], result["power"]["delays"])
    draw_events(axes[1, 1], result["lives"])
    for ax in axes.flat:
        ax.grid(axis="x", alpha=0.25)


if __name__ == "__main__":
    write(__file__, draw_figure, (11, 9), font=8)
