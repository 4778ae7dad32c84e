"""Draw figure.svg from result.json: accuracy, score, places of the truth, and services too late."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.figures import BLACK, BLUE, GREEN, ORANGE, PINK, write
from studies.harness.study import Row

GREY = "#777777"
# Colour, marker, dash, name, and by how much it stands aside.
WAYS = {
    "lmshealth": (BLUE, "o", "-", "lmshealth", -1.5),
    "progpy": (GREEN, "^", "--", "progpy, same draws", 0.0),
    "line": (ORANGE, "s", "-.", "line through health", 1.5),
}
CONTROL = (PINK, ":", "control: a tenth of the spread")
KEPT = "progpy, all runs kept"
MAIN_CUT = 0.7


def places_of(cuts: list[Row], name: str) -> np.ndarray:
    """Shares of life in %, each way a little aside."""
    return np.array([100 * row["share"] + WAYS[name][4] for row in cuts])


def drawn(cuts: list[Row]) -> list[str]:
    """Ways that said something at all cuts."""
    return [name for name in WAYS if all(name in row["ways"] for row in cuts)]


def label_cuts(ax: Axes, cuts: list[Row]) -> None:
    """Label the axis of all panels over the cuts."""
    shares = [100 * row["share"] for row in cuts]
    ax.set_xticks(shares, [f"{share:.0f}" for share in shares])
    ax.set_xlabel("cut at % of the life")
    ax.grid(axis="y", alpha=0.25)


def draw_accuracy(ax: Axes, cuts: list[Row]) -> None:
    """Draw how often medians are within a fifth of what is left."""
    shares = [100 * row["share"] for row in cuts]
    for what, dash in (("map right", "-"), ("map to 5 %", "--")):
        bound = [100 * row["bound"][what]["accurate"] for row in cuts]
        ax.plot(shares, bound, dash, color=BLACK, lw=1.2, label=f"Cramér-Rao bound, {what}")
    for name in drawn(cuts):
        colour, marker, _, label, _ = WAYS[name]
        own = [row["ways"][name]["accurate"] for row in cuts]
        middle = np.array([one["share"] for one in own])
        reach = [[m - one["low"], one["high"] - m] for m, one in zip(middle, own, strict=True)]
        ax.errorbar(
            places_of(cuts, name), 100 * middle, 100 * np.array(reach).T, fmt=marker, ms=5,
            color=colour, lw=1.2, label=label,
        )  # fmt: skip
    label_cuts(ax, cuts)
    ax.set_ylim(0, 103)
    ax.set_ylabel("% of medians within ± 20 % of what is left")
    ax.set_title("α-λ accuracy, 95 % intervals", fontsize=10)
    ax.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.17), ncol=3, frameon=False)


def draw_score(ax: Axes, cuts: list[Row]) -> None:
    """Draw mean scores."""
    for name in drawn(cuts):
        colour, marker, dash, label, _ = WAYS[name]
        score = [row["ways"][name]["crps_km"] for row in cuts]
        ax.plot([100 * row["share"] for row in cuts], score, dash, marker=marker, ms=5,
                color=colour, label=label)  # fmt: skip
    if all(KEPT in row["ways"] for row in cuts):
        kept = [row["ways"][KEPT]["crps_km"] for row in cuts]
        ax.plot([100 * row["share"] for row in cuts], kept, ":", marker="v", mfc="none", ms=8,
                color=WAYS["progpy"][0], label="progpy, runs without end kept")  # fmt: skip
    label_cuts(ax, cuts)
    ax.set_ylim(bottom=0)
    ax.set_ylabel("mean CRPS in km (0 is best)")
    ax.set_title("Score of the remaining life", fontsize=10)
    ax.legend(fontsize=7)


def draw_places(ax: Axes, row: Row) -> None:
    """Draw the distribution of the truth's places at one cut."""
    ax.plot([0, 1], [0, 1], color=BLACK, lw=0.8)
    styles = {name: (WAYS[name][0], WAYS[name][2], WAYS[name][3]) for name in drawn([row])}
    for name, (colour, dash, label) in (styles | {"a tenth of the spread": CONTROL}).items():
        x = np.sort(row["ways"][name]["places"])
        ax.step(np.r_[0, x, 1], np.r_[0, np.arange(1, x.size + 1) / x.size, 1], dash, where="post",
                color=colour, lw=1.4, label=label)  # fmt: skip
    ax.set_xlim(0, 1)
    ax.set_ylim(0, 1)
    ax.set_xlabel("place of the truth among draws (PIT)")
    ax.set_ylabel("share of lives")
    ax.set_title(f"At {100 * row['share']:.0f} % of the life: on the diagonal if calibrated",
                 fontsize=10)  # fmt: skip
    ax.legend(fontsize=7, loc="upper left")


def draw_services(ax: Axes, cuts: list[Row], risk: float) -> None:
    """Draw what services by a stated risk throw away, and how many lives end before them."""
    shares = [100 * row["share"] for row in cuts]
    for k, name in enumerate(drawn(cuts)):
        colour, marker, dash, label, _ = WAYS[name]
        wasted = [100 * row["ways"][name]["unexploited_km"] / row["mean_left_km"] for row in cuts]
        ax.plot(shares, wasted, dash, color=colour, marker=marker, ms=5, label=label)
        for row, x in zip(cuts, shares, strict=True):
            broken = 100 * row["ways"][name]["broken"] / row["n"]
            ax.text(x, 101 + 7 * k, f"{broken:.0f} %", fontsize=8, ha="center", color=colour)
    ax.text(0.0, 1.21, "ended before their service:", fontsize=8, transform=ax.transAxes)
    label_cuts(ax, cuts)
    ax.set_ylim(0, 100)
    ax.set_ylabel("life unexploited, % of what is left")
    ax.set_title(f"Service at {100 * risk:.0f} % risk", fontsize=10, pad=52)
    ax.legend(fontsize=7, loc="lower left")


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw four panels."""
    cuts = result["cuts"]
    axes = figure.subplots(2, 2)
    draw_accuracy(axes[0, 0], cuts)
    draw_score(axes[0, 1], cuts)
    draw_places(axes[1, 0], next(row for row in cuts if row["share"] == MAIN_CUT))
    draw_services(axes[1, 1], cuts, result["risk"])


if __name__ == "__main__":
    write(__file__, draw_figure, (10.5, 8.0))
