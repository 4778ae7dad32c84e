"""Draw figure.svg from result.json: accuracy, score, places of the truth, and services too late."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.figures import BLACK, BLUE, GREEN, ORANGE, PINK, write
from studies.harness.study import Row

# Colour, marker, dash, name, and horizontal offset.
WAYS = {
    "lmshealth": (BLUE, "o", "-", "lmshealth", -1.5),
    "progpy": (GREEN, "^", "--", "progpy, same draws", 0.0),
    "line": (ORANGE, "s", "-.", "line through health", 1.5),
}
CONTROL, MAIN_CUT = "a tenth of the spread", 0.7


def draw_accuracy(ax: Axes, cuts: list[Row], shares: np.ndarray) -> None:
    """Draw how often medians are within a fifth of what is left."""
    for what, dash in (("map right", "-"), ("map to 5 %", "--")):
        bound = [100 * row["bound"][what]["accurate"] for row in cuts]
        ax.plot(shares, bound, dash, color=BLACK, lw=1.2, label=f"Cramér-Rao bound, {what}")
    for name, (colour, marker, _, label, aside) in WAYS.items():
        own = [row["ways"][name]["accurate"] for row in cuts]
        low, y, high = (100 * np.array([one[k] for one in own]) for k in ("low", "share", "high"))
        reach = [y - low, high - y]
        ax.errorbar(shares + aside, y, reach, fmt=marker, ms=5, lw=1.2, color=colour, label=label)
    ax.set(ylim=(0, 103), ylabel="% of medians within ± 20 % of what is left")
    ax.set_title("α-λ accuracy, 95 % intervals", fontsize=10)
    ax.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.17), ncol=3, frameon=False)


def draw_score(ax: Axes, cuts: list[Row], shares: np.ndarray) -> None:
    """Draw mean scores."""
    kept = (GREEN, "v", ":", "progpy, runs without end kept", 0.0)
    for name, (colour, marker, dash, label, _) in (WAYS | {"progpy, all runs kept": kept}).items():
        score = [row["ways"][name]["crps_km"] for row in cuts]
        ax.plot(shares, score, dash, marker=marker, ms=5, color=colour, label=label)
    ax.set(ylim=(0, None), ylabel="mean CRPS in km (0 is best)")
    ax.set_title("Score of the remaining life", fontsize=10)
    ax.legend(fontsize=7)


def draw_places(ax: Axes, row: Row) -> None:
    """Draw the distribution of the truth's places at one cut."""
    ax.plot([0, 1], [0, 1], color=BLACK, lw=0.8)
    control = (PINK, "", ":", "control: a tenth of the spread", 0.0)
    for name, (colour, _, dash, label, _) in (WAYS | {CONTROL: control}).items():
        x = np.sort(row["ways"][name]["places"])
        y = np.r_[0, np.arange(1, x.size + 1) / x.size, 1]
        ax.step(np.r_[0, x, 1], y, dash, where="post", color=colour, lw=1.4, label=label)
    ax.set(xlim=(0, 1), ylim=(0, 1), ylabel="share of lives")
    ax.set_xlabel("place of the truth among draws (PIT)")
    title = f"At {100 * row['share']:.0f} % of the life: on the diagonal if calibrated"
    ax.set_title(title, fontsize=10)
    ax.legend(fontsize=7, loc="upper left")


def draw_services(ax: Axes, cuts: list[Row], shares: np.ndarray, risk: float) -> None:
    """Draw the life that services at a risk leave unexploited, and how many come too late."""
    for k, (name, (colour, marker, dash, label, _)) in enumerate(WAYS.items()):
        wasted = [100 * row["ways"][name]["unexploited_km"] / row["mean_left_km"] for row in cuts]
        ax.plot(shares, wasted, dash, color=colour, marker=marker, ms=5, label=label)
        for row, x in zip(cuts, shares, strict=True):
            broken = f"{100 * row['ways'][name]['broken'] / row['n']:.0f} %"
            ax.text(x, 101 + 7 * k, broken, fontsize=8, ha="center", color=colour)
    ax.text(0.0, 1.21, "ended before their service:", fontsize=8, transform=ax.transAxes)
    ax.set(ylim=(0, 100), ylabel="life unexploited, % of what is left")
    ax.set_title(f"Service at {100 * risk:.0f} % risk", fontsize=10, pad=52)
    ax.legend(fontsize=7, loc="lower left")


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw four panels."""
    cuts = result["cuts"]
    shares = np.array([100 * row["share"] for row in cuts])
    (accuracy, score), (places, services) = figure.subplots(2, 2)
    draw_accuracy(accuracy, cuts, shares)
    draw_score(score, cuts, shares)
    draw_places(places, next(row for row in cuts if row["share"] == MAIN_CUT))
    draw_services(services, cuts, shares, result["risk"])
    for ax in (accuracy, score, services):
        ax.set_xticks(shares, [f"{share:.0f}" for share in shares])
        ax.set_xlabel("cut at % of the life")
        ax.grid(axis="y", alpha=0.25)


if __name__ == "__main__":
    write(__file__, draw_figure, (10.5, 8.0))
