"""Draw figure.svg from result.json: coverage, alarms by circumstance, places of remaining life."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.drawn_machines.run import HOLDS
from studies.harness.figures import BLACK, BLUE, GREEN, ORANGE, write
from studies.harness.study import Row

GROUPS = {
    "families known": (BLUE, "o", "drawn, families known"),
    "families others": (ORANGE, "s", "drawn, other families"),
    "control": (GREEN, "^", "nominal, families known"),
}
ASKED = {"epoch": "last log", "now": "by laws", "left": "remaining"}


def draw_coverage(ax: Axes, record: Row) -> None:
    """Draw coverages of 90 % intervals."""
    labels = [(what, name) for what in HOLDS for name in record["control"][what]]
    for k, (group, (colour, marker, label)) in enumerate(GROUPS.items()):
        rows = [record[group][what][name][1] for what, name in labels]
        low, y, high = (
            100 * np.array([row[key] for row in rows]) for key in ("low", "share", "high")
        )
        at = np.arange(len(labels)) + 0.22 * (k - 1)
        ax.errorbar(at, y, [y - low, high - y], fmt=marker, ms=4, lw=1, color=colour, label=label)
    ax.axhline(90, color=BLACK, lw=0.8)
    words = [f"{ASKED[what]}\n{name.split('_')[0]}" for what, name in labels]
    ax.set_xticks(range(len(labels)), words, fontsize=7)
    ax.set(ylim=(0, 103), ylabel="% of 90 % intervals that hold the truth")
    ax.set_title("Coverage, 99.9 % intervals", fontsize=10)
    ax.legend(fontsize=7, loc="lower left")


def draw_alarms(ax: Axes, record: Row) -> None:
    """Draw how many lives without wear alarm, or show a step."""
    rows = {
        "drawn, healthy": record["healthy"]["drawn"],
        **record["circumstances"],
        "nominal, healthy": record["healthy"]["nominal"],
    }
    at = np.arange(len(rows))[::-1]
    for key, colour, shift in (("alarm", BLUE, 0.18), ("step", ORANGE, -0.18)):
        shares = [100 * row[key]["share"] for row in rows.values()]
        ax.barh(at + shift, shares, 0.34, color=colour, label=f"{key}, nobody declared it")
    ax.set_yticks(at, list(rows), fontsize=7)
    ax.set(xlim=(0, 100), xlabel="% of lives")
    ax.set_title("Alarms and steps by what acts", fontsize=10)
    ax.legend(fontsize=7)


def draw_places(ax: Axes, record: Row) -> None:
    """Draw the distribution of the places of the true remaining life."""
    ax.plot([0, 1], [0, 1], color=BLACK, lw=0.8)
    done = [row for row in record["rows"] if "left" in row]
    for known, (colour, _, label) in zip((True, False), list(GROUPS.values())[:2], strict=True):
        x = np.sort([row["left"]["place"][-1] for row in done if row["known"] == known])
        y = np.r_[0, np.arange(1, x.size + 1) / x.size, 1]
        ax.step(np.r_[0, x, 1], y, where="post", color=colour, lw=1.4, label=label)
    ax.set(xlim=(0, 1), ylim=(0, 1), xlabel="place of the truth among draws (PIT)")
    ax.set_ylabel("share of machines")
    ax.set_title("Remaining life: on the diagonal if calibrated", fontsize=10)
    ax.legend(fontsize=7, loc="upper left")


def draw_figure(figure: Figure, record: Row) -> None:
    """Draw three panels."""
    axes = figure.subplots(1, 3)
    for ax, panel in zip(axes, (draw_coverage, draw_alarms, draw_places), strict=True):
        panel(ax, record)


if __name__ == "__main__":
    write(__file__, draw_figure, (14.0, 4.4))
