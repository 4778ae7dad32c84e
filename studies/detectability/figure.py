"""Draw figure.svg from result.json: smallest losses that are seen, and the law behind them."""

from __future__ import annotations

from textwrap import wrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import ScalarFormatter

from studies.harness.figures import BLUE, GREEN, ORANGE, draw_shares, name_lines, write
from studies.harness.study import Row

COLOURS = {"roll": BLUE, "pitch": ORANGE, "yaw": GREEN}
_LINES = (0.2, 0.3, 0.5, 1, 2, 3, 5)  # per cent
_NAMES = {"guide_preload": "guide preload", "mount_stiffness": "mount stiffness"}
_ARMS = {
    "as planned": "as planned",
    "as shipped, the other as it was": "shipped",
    "as shipped, the other from its prior": "shipped, other lost",
}


def draw_map(ax: Axes, result: Row, one: Row) -> Any:
    """Draw one map with labelled lines, and the shares of calls at the points that were checked."""
    loss = 100 * np.array(one["smallest_loss"], dtype=float)
    x, y = np.array(result["durations_s"]), np.array(result["logs"])
    levels = np.geomspace(0.2, 7, 25)
    mesh = ax.contourf(x, y, loss, levels, norm=LogNorm(0.2, 7), cmap="cividis", extend="min")
    lines = ax.contour(x, y, loss, levels=_LINES, colors="white", linewidths=1.2)
    outline = [withStroke(linewidth=2, foreground="black")]
    lines.set_path_effects(outline)
    for text in ax.clabel(lines, fmt=lambda value: f"{value:g} %", fontsize=8):
        text.set_path_effects(outline)
    for row in result["checks"]:
        same = (row["stage"], row["parameter"]) == (one["stage"], one["parameter"])
        if same and row["arm"] == "as planned":
            ax.plot(row["duration_s"], row["logs"], "o", ms=5, mfc="white", mec="black")
    ax.set(xscale="log", yscale="log", xlabel="length of a log in s", ylabel="logs now, and before")
    for axis, ticks in (
        (ax.xaxis, (10, 20, 60, 120, 300, 600)),
        (ax.yaxis, (1, 2, 5, 10, 30, 100)),
    ):
        axis.set_major_formatter(ScalarFormatter())
        axis.set_ticks(ticks)
        axis.set_minor_formatter(lambda *_: "")
    ax.set_title(f"{one['stage'].upper()}: {_NAMES[one['parameter']]}", fontsize=10)
    return mesh


def draw_checks(ax: Axes, result: Row) -> None:
    """Draw how often the planned losses are called, and none."""
    rows = result["checks"]
    arms = list(_ARMS)
    colours = (BLUE, GREEN, ORANGE)
    keys = list(
        dict.fromkeys((r["stage"], r["parameter"], r["duration_s"], r["logs"]) for r in rows)
    )
    for row in rows:
        key = (row["stage"], row["parameter"], row["duration_s"], row["logs"])
        k = arms.index(row["arm"])
        y = keys.index(key) + 0.22 * (k - 1)
        for what, marker in (("power", "o"), ("false_alarms", "x")):
            draw_shares(ax, y, [row[what]], colours[k], marker, ms=4)
    for arm, colour in zip(_ARMS.values(), colours, strict=True):
        ax.plot([], [], "o-", color=colour, label=arm)
    ax.plot([], [], "x", color="black", label="false alarms")
    for value in (result["power"], result["false_alarm"]):
        ax.axvline(value, color="black", ls="--", lw=1)
    names = [f"{s[-1].upper()} {_NAMES[p].split()[-1]}, {n} of {t:g} s" for s, p, t, n in keys]
    name_lines(ax, names)
    ax.set_xlim(-0.02, 1.02)
    ax.set_xlabel("share of losses called, 99.9 % interval")
    ax.set_title("Power and false alarms of the posterior", fontsize=10)
    ax.legend(fontsize=7, loc="center", bbox_to_anchor=(0.3, 0.2))
    ax.grid(axis="x", alpha=0.25)


def draw_law(ax: Axes, result: Row) -> None:
    """Draw the standard deviation of ln f of one log: bound, law, and what was identified."""
    law = result["law"]
    for mode, colour in COLOURS.items():
        ax.plot(law["durations_s"], law["bound"][mode], color=colour, label=f"{mode}: bound")
        ax.plot(law["durations_s"], law["long_record"][mode], color=colour, ls=":", lw=1)
        for row in result["identified"]:
            own = row["modes"][mode]
            x = row["duration_s"] * {"roll": 0.96, "pitch": 1.0, "yaw": 1.04}[mode]
            ax.errorbar(x, own["rms_error"], 2 * own["rms_error_se"], fmt="o", ms=4, color=colour,
                        lw=1)  # fmt: skip
            ax.plot(x, own["stated_std"], "_", ms=11, mew=2, color=colour)
    ax.plot([], [], "o-", ms=4, color="black", label="errors of identified logs, ± 2 se")
    ax.plot([], [], "_", ms=11, mew=2, color="black", label="their stated std")
    ax.plot([], [], ":", color="black", lw=1, label="law of long records, no noise")
    ax.set(xscale="log", yscale="log", xlabel="length of a log in s", ylabel="std of ln f, one log")
    ax.xaxis.set_major_formatter(ScalarFormatter())
    ax.xaxis.set_ticks((10, 20, 60, 120, 300, 600))
    ax.xaxis.set_minor_formatter(lambda *_: "")
    ax.set_title(f"{law['stage'].upper()}: the uncertainty law", fontsize=10)
    ax.set_ylim(1e-4, 6e-3)
    ax.legend(fontsize=7, ncols=2, loc="upper right")
    ax.grid(alpha=0.25)


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw."""
    top, bottom = figure.subfigures(2, 1, height_ratios=(1, 1.15))
    axes = top.subplots(1, 3)
    for ax, one in zip(axes, result["maps"], strict=True):
        mesh = draw_map(ax, result, one)
    bar = top.colorbar(mesh, ax=axes, label="loss in %; power 95 %, false alarms 1 %")
    bar.set_ticks(_LINES, labels=[f"{value:g}" for value in _LINES])
    left, right = bottom.subplots(1, 2, width_ratios=(1, 1.3))
    draw_law(left, result)
    draw_checks(right, result)
    figure.supxlabel("\n".join(wrap(f"Not drawn, {result['unseen']['message']}", 170)), fontsize=7)


if __name__ == "__main__":
    write(__file__, draw_figure, (12, 9), font=8)
