"""Draw figure.svg from result.json: effective draws a second, and what results and walkers take."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.figures import BLACK, BLUE, GREEN, ORANGE, name_lines, write
from studies.harness.study import Row


def draw_rates(ax: Axes, rows: list[Row]) -> None:
    """Draw effective draws per second of processor time, each with its multiple of ours."""
    for y, row in enumerate(rows):
        ax.barh(y, row["ess_per_s"], color=BLUE if y == 0 else GREEN, height=0.6)
        text = f"{row['ess_per_s']:,.0f}" if row["ess_per_s"] >= 10 else f"{row['ess_per_s']:.1f}"
        if y:
            text += f"  (ours × {row['ours_is_times_faster']:,.0f})"
        ax.text(row["ess_per_s"] * 1.15, y, text, va="center", fontsize=8,
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 1})  # fmt: skip
    ax.axvline(2000, color=BLACK, lw=0.8, ls="--", zorder=0)
    ax.text(2300, -0.55, "asked", fontsize=7, ha="left", va="bottom")
    ax.set_xscale("log")
    ax.set_xlim(0.5, 4e5)
    names = [row["program"].replace(", ", ",\n").replace(" with the", "\nwith the") for row in rows]
    name_lines(ax, names, fontsize=8)
    ax.set_xlabel("effective draws per second of processor time")
    ax.set_title("Posterior of one epoch, LMS-Y")


def draw_ratios(ax: Axes, answer: Row) -> None:
    """Draw what was measured as a share of what was asked for at most."""
    life = answer["life"]
    rows = [
        ("converged epoch", answer["converged_epoch"]["cpu_s"] / 3.0,
         f"{answer['converged_epoch']['cpu_s']:.1f} of 3 s"),
        ("life of 100 logs,\n2 modes", life["cpu_s"] / 10.0, f"{life['cpu_s']:.1f} of 10 s"),
        ("walker of a life beside\na filterpy loop", 20 / life["likelihood"]["times_faster"],
         f"{life['likelihood']['times_faster']:.0f} times faster, asked 20"),
    ]  # fmt: skip
    for y, (_, share, text) in enumerate(rows):
        ax.barh(y, share, color=BLUE if share <= 1 else ORANGE, height=0.5)
        ax.text(share + 0.02, y, text, va="center", fontsize=8)
    ax.axvline(1.0, color=BLACK, lw=0.8, ls="--")
    name_lines(ax, [name for name, _, _ in rows], fontsize=8)
    ax.set_xlim(0, 1.35)
    ax.set_xlabel("share of what was asked for at most")
    ax.set_title("What results take")


def draw_figure(figure: Figure, answer: Row) -> None:
    """Draw the figure."""
    left, right = figure.subplots(1, 2, width_ratios=[1.25, 1])
    draw_rates(left, answer["epoch"]["programs"])
    draw_ratios(right, answer)


if __name__ == "__main__":
    write(__file__, draw_figure, (10.5, 4.0))
