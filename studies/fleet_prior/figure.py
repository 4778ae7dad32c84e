"""Draw figure.svg from result.json: loss against the known fleet, coverages, and priors."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.figures import BLACK, BLUE, GREY, ORANGE, draw_shares, name_lines, write
from studies.harness.study import Row

NAMES = {
    "description": "prior of the description",
    "learned": "learned from its fleet",
    "learned, laws alone": "learned, laws alone",
    "known": "the fleet is known",
    "only the worn teach": "prior from worn machines only",
    "another fleet teaches": "prior from another fleet",
}
COLOURS = {"description": BLACK, "learned": BLUE, "learned, laws alone": BLUE, "known": GREY}


def colour(way: str) -> str:
    """Return the colour of a way: controls share one."""
    return COLOURS.get(way, ORANGE)


def draw_lost(ax: Axes, ways: Row) -> None:
    """Draw what the score loses on average, with its standard error."""
    for k, (way, found) in enumerate(ways.items()):
        value, error = found["lost_km"]
        ax.errorbar(value, k, xerr=error, fmt="o", color=colour(way), capsize=3)
    name_lines(ax, [NAMES[way] for way in ways], fontsize=9)
    ax.set_xlim(left=-60)
    ax.set_xlabel("score lost against the known fleet, km\n"
                  "(CRPS, mean ± standard error over fleets)")  # fmt: skip
    ax.grid(axis="x", lw=0.3)


def draw_coverage(ax: Axes, ways: Row) -> None:
    """Draw coverages of 50 and 90 % intervals with their Clopper-Pearson intervals."""
    for nominal, marker in ((0, "s"), (1, "o")):
        for k, (way, found) in enumerate(ways.items()):
            at = k + (-0.12, 0.12)[nominal]
            draw_shares(ax, at, [found["coverage"][nominal]], colour(way), marker)
        ax.axvline((0.5, 0.9)[nominal], color=BLACK, lw=0.8, ls="--")
    name_lines(ax, [""] * len(ways))
    ax.set_xlim(0, 1)
    ax.set_xlabel("share of true remaining lives in 50 % (squares)\n"
                  "and 90 % intervals (circles; bars: 99.9 %)")  # fmt: skip


def draw_priors(ax: Axes, priors: list[dict[str, list[float]]]) -> None:
    """Draw learned medians of life against true ones, with the learned spread."""
    kept = [row for row in priors if "learned" in row]
    true = np.array([row["true"] for row in kept])
    learned = np.array([row["learned"] for row in kept])
    width = learned[:, 0] * (np.exp(learned[:, 1]) - 1), learned[:, 0] * -np.expm1(-learned[:, 1])
    ax.errorbar(
        true[:, 0], learned[:, 0], yerr=(width[1], width[0]), fmt="none", ecolor=BLUE, alpha=0.3
    )
    dots = ax.scatter(
        true[:, 0], learned[:, 0], c=100 * true[:, 2], cmap="cividis", vmin=0, vmax=100,
        edgecolor=BLACK, lw=0.5, zorder=3,
    )  # fmt: skip
    both = np.r_[true[:, 0], learned[:, 0]]
    ends = np.array([both.min() / 2, 2 * both.max()])
    ax.plot(ends, ends, color=BLACK, lw=0.8)
    ax.axhline(8000, color=BLACK, lw=0.8, ls=":")
    ax.text(1.05 * ends[0], 8400, "description", fontsize=8)
    ax.set(xscale="log", yscale="log", xlim=ends, ylim=ends, aspect="equal")
    ax.set_xlabel("true median life of a fleet, km")
    ax.set_ylabel("learned median, km (bars: ± one sigma)")
    bar = ax.figure.colorbar(dots, ax=ax, shrink=0.8)
    bar.set_label("machines of the fleet that wear, %")


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw the three side by side."""
    axes = figure.subplots(1, 3, width_ratios=[1.0, 1.0, 1.25])
    draw_lost(axes[0], result["ways"])
    draw_coverage(axes[1], result["ways"])
    draw_priors(axes[2], result["priors"])
    title = f"{result['young']} young machines of {result['fleets']} fleets"
    figure.suptitle(f"{title}, {result['teachers']} machines for each prior", fontsize=10)


if __name__ == "__main__":
    write(__file__, draw_figure, (13.0, 4.2))
