"""Draw figure.svg from result.json: effective draws a second beside other programs."""

from __future__ import annotations

from matplotlib.figure import Figure

from studies.harness.figures import BLACK, BLUE, GREEN, name_lines, write
from studies.harness.study import Row


def draw_figure(figure: Figure, answer: Row) -> None:
    """Draw effective draws per second of processor time, each with its multiple of ours."""
    ax, rows = figure.subplots(), answer["epoch"]["programs"]
    box = {"facecolor": "white", "edgecolor": "none", "pad": 1}
    for y, row in enumerate(rows):
        rate = row["ess_per_s"]
        ax.barh(y, rate, color=BLUE if y == 0 else GREEN, height=0.6)
        text = f"{rate:,.0f}" if rate >= 10 else f"{rate:.1f}"
        text += f"  (ours × {row['ours_is_times_faster']:,.0f})" if y else ""
        ax.text(rate * 1.15, y, text, va="center", fontsize=8, bbox=box)
    ax.axvline(2000, color=BLACK, lw=0.8, ls="--", zorder=0)
    ax.text(2300, -0.5, "required", fontsize=7, va="bottom")
    names = [row["program"].replace(", ", ",\n").replace(" with the", "\nwith the") for row in rows]
    name_lines(ax, names, fontsize=8)
    ax.set(xscale="log", xlim=(0.5, 4e5), title="Posterior of one epoch, LMS-Y")
    ax.set_xlabel("effective draws per second of processor time")


if __name__ == "__main__":
    write(__file__, draw_figure, (6.5, 3.6))
