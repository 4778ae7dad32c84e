"""Draw figure.svg from result.json: the building through its windows, the other sets by mode."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.figures import BLUE, GREEN, ORANGE, legend_above, write
from studies.harness.study import Row

DATA, FULL, KNOWN, STEPPED = "#56606b", BLUE, ORANGE, GREEN


def column(rows: list[Row], key: str) -> np.ndarray:
    """Return one column of rows, NaN where it is missing."""
    return np.array([row.get(key, np.nan) for row in rows])


def draw_building(ax: Axes, name: str, building: Row, keys: tuple[str, ...], unit: float) -> None:
    """Draw frequency or damping of one mode in every window, the thirds and the whole."""
    key, std, short, short_std, published = keys
    mode = building["modes"][name]
    windows = [row for row in building["windows"] if row["mode"] == name]
    parts = [row for row in building["parts"] if row["mode"] == name]
    length = 5 * building["n_windows"] / len(parts)
    minutes = [5 * int(row["log"][:3]) + 2.5 for row in windows]
    value, error = unit * column(windows, key), 2 * unit * column(windows, std)
    ax.errorbar(minutes, value, error, fmt="o", ms=3.5, lw=1, color=DATA, label="5-minute log, ±2σ")
    middle = length * (column(parts, "part") + 0.5)
    value, error = unit * column(parts, short), 2 * unit * column(parts, short_std)
    style = {"fmt": "s", "ms": 5, "lw": 2, "color": STEPPED, "label": "third, ±2σ"}
    ax.errorbar(middle, value, error, length / 2 - 1, **style)
    ax.axhline(unit * mode[f"full_{key}"], color=FULL, label="whole record")
    label = "published, or known by another method"
    ax.axhline(unit * mode[published], color=KNOWN, ls="--", label=label)
    ax.grid(alpha=0.25)


def draw_shear(ax: Axes, rows: list[Row]) -> None:
    """Draw relative errors of the shear frame's frequencies, and the effect of its integration."""
    at = np.arange(1, len(rows) + 1)
    known, stepped = column(rows, "documented_f_hz"), column(rows, "stepped_f_hz")
    off, std = 100 * (column(rows, "f_hz") / known - 1), 200 * column(rows, "f_std_hz") / known
    ax.errorbar(at, off, std, fmt="o", ms=4, color=FULL, label="identified, ±2σ")
    label = "documented, integrated\nin steps of 1/12 s"
    ax.plot(at, 100 * (stepped / known - 1), "x", ms=8, color=STEPPED, label=label)
    ax.axhline(0, color=KNOWN, ls="--", label="documented")
    ax.set_xticks(at, [f"{value:.3g}" for value in known])
    ax.set(xlabel="documented frequency in Hz", ylabel="off the documented frequency in %")
    ax.set_title("Shear frame (simulated)")
    ax.legend(fontsize=7)
    ax.grid(alpha=0.25)


def draw_light(ax: Axes, rows: list[Row]) -> None:
    """Draw the light frame's dampings beside the known one and the resolution."""
    at = np.arange(1, len(rows) + 1)
    zeta = 100 * column(rows, "zeta")
    factor = np.exp(2 * column(rows, "zeta_std") / column(rows, "zeta"))
    reach = [zeta - zeta / factor, zeta * factor - zeta]
    ax.errorbar(at, zeta, reach, fmt="o", ms=4, color=FULL, label="identified, ±2σ of ln ζ")
    ax.axhline(0.19, color=KNOWN, ls="--", label="known")
    label = "bandwidth of one\nFourier step"
    ax.plot(at, 100 * column(rows, "resolution"), "_", ms=12, color=DATA, label=label)
    ax.set_xticks(at, [f"{row['known_f_hz']:.2f}" for row in rows], fontsize=7)
    ax.set(ylim=(0, 0.5), xlabel="frequency in Hz", ylabel="damping ratio in %")
    ax.set_title("Light frame (simulated)")
    ax.legend(fontsize=7)
    ax.grid(alpha=0.25)


def draw_shake(ax: Axes, rows: list[Row]) -> None:
    """Draw the table frame's frequencies from each floor against their known ranges."""
    modes = sorted({(row["frame"], row["mode"]) for row in rows})
    floors, labels = dict(zip(("1st", "2nd", "3rd"), "osD", strict=True)), {}
    for row in rows:
        y = modes.index((row["frame"], row["mode"]))
        middle = (row["low_hz"] + row["high_hz"]) / 2
        half = (row["high_hz"] - row["low_hz"]) / 2 + row["tolerance_hz"]
        labels[y] = f"{row['frame'].lower()}\n{middle:.2f}"
        here = y + 0.2 * (list(floors).index(row["floor"]) - 1)
        ax.plot([-half, half], [y, y], lw=14, color=KNOWN, alpha=0.12, solid_capstyle="butt")
        if "f_hz" in row:
            marker = floors[row["floor"]]
            off, reach = row["f_hz"] - middle, 2 * row["f_std_hz"]
            ax.errorbar(off, here, xerr=reach, ms=4, fmt=marker, color=FULL)
        else:
            text = f"{row['floor']}: refused, {row['refused']}"
            ax.text(0, here, text, fontsize=7, color=DATA, ha="center", va="center")
    ax.set_yticks(list(labels), list(labels.values()), fontsize=7)
    for floor, marker in floors.items():
        ax.plot([], [], marker, color=FULL, ms=4, label=f"{floor} floor, ±2σ")
    ax.plot([], [], lw=8, color=KNOWN, alpha=0.3, label="known, with its tolerance")
    ax.set_ylim(len(modes) + 0.6, -0.6)
    ax.set_xlabel("off the middle of what is known (left, Hz) in Hz")
    ax.set_title("Frame on a shaking table")
    ax.legend(fontsize=7, loc="lower center", ncols=2, frameon=False)
    ax.grid(alpha=0.25, axis="x")


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw the building above, the other sets below."""
    axes = figure.subplots(3, 3, height_ratios=(1, 1, 1.25))
    frequency = ("frequency_hz", "frequency_std_hz", "f_hz", "f_std_hz", "published_hz")
    damping = ("damping_ratio", "damping_ratio_std", "zeta", "zeta_std", "published_damping_ratio")
    for (top, bottom), name in zip(axes[:2].T, result["building"]["modes"], strict=True):
        draw_building(top, name, result["building"], frequency, 1.0)
        draw_building(bottom, name, result["building"], damping, 100)
        top.set_title(f"Building, {name} mode")
        bottom.set(ylim=(0, 3), xlabel="time in min")
    axes[0, 0].set_ylabel("natural frequency in Hz")
    axes[1, 0].set_ylabel("damping ratio in %")
    draw_shake(axes[2, 0], result["shake"]["rows"])
    draw_shear(axes[2, 1], result["shear_frame"])
    draw_light(axes[2, 2], result["light_frame"])
    legend_above(figure, axes[0, 0], ncols=4)


if __name__ == "__main__":
    write(__file__, draw_figure, (11.0, 9.0))
