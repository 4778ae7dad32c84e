"""Draw figure.svg from result.json: the building through its windows, the other sets by mode."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.figures import BLUE, GREEN, ORANGE, write
from studies.harness.study import Row

DATA = "#56606b"
FULL = BLUE
KNOWN = ORANGE
STEPPED = GREEN


def draw_building(top: Axes, bottom: Axes, name: str, building: Row) -> None:
    """Draw frequency and damping of one mode in every window, the thirds and the whole."""
    mode = building["modes"][name]
    windows = [row for row in building["windows"] if row["mode"] == name]
    parts = [row for row in building["parts"] if row["mode"] == name]
    minutes = np.array([5 * int(row["log"][:3]) + 2.5 for row in windows])
    length = 5 * building["n_windows"] / len(parts)
    for ax, key, short, unit in (
        (top, "frequency_hz", "f", 1.0),
        (bottom, "damping_ratio", "zeta", 100),
    ):
        std = "frequency_std_hz" if short == "f" else "damping_ratio_std"
        value, error = (unit * np.array([row[k] for row in windows]) for k in (key, std))
        ax.errorbar(minutes, value, 2 * error, fmt="o", ms=3.5, lw=1, color=DATA,
                    label="5-minute log, ±2σ")  # fmt: skip
        names = ("f_hz", "f_std_hz") if short == "f" else ("zeta", "zeta_std")
        for row in (row for row in parts if "f_hz" in row):
            middle = length * (row["part"] + 0.5)
            ax.errorbar(middle, unit * row[names[0]], 2 * unit * row[names[1]], length / 2 - 1,
                        fmt="s", ms=5, lw=2, color=STEPPED,
                        label="third, ±2σ" if row["part"] == 0 else None)  # fmt: skip
        ax.axhline(unit * mode[f"full_{key}"], color=FULL, label="whole record")
        ax.axhline(unit * mode[f"published_{'hz' if short == 'f' else key}"], color=KNOWN, ls="--",
                   label="published, or known by another method")  # fmt: skip
        ax.grid(alpha=0.25)
    top.set_title(f"Building, {name} mode", fontsize=10)
    bottom.set_ylim(0, 3)
    bottom.set_xlabel("time in min")


def draw_shear(ax: Axes, rows: list[Row]) -> None:
    """Draw relative errors of the shear frame's frequencies, and what its integration does."""
    at = np.arange(1, len(rows) + 1)
    documented, stepped = (
        np.array([row[f"{k}_f_hz"] for row in rows]) for k in ("documented", "stepped")
    )
    f, std = (np.array([row.get(k, np.nan) for row in rows]) for k in ("f_hz", "f_std_hz"))
    ax.errorbar(at, 100 * (f / documented - 1), 200 * std / documented, fmt="o", ms=4, color=FULL,
                label="identified, ±2σ")  # fmt: skip
    ax.plot(at, 100 * (stepped / documented - 1), "x", ms=8, color=STEPPED,
            label="documented, integrated\nin steps of 1/12 s")  # fmt: skip
    ax.axhline(0, color=KNOWN, ls="--", label="documented")
    ax.set_xticks(at, [f"{value:.3g}" for value in documented])
    ax.set_xlabel("documented frequency in Hz")
    ax.set_ylabel("off the documented frequency in %")
    ax.set_title("Shear frame (simulated)", fontsize=10)
    ax.legend(fontsize=7)
    ax.grid(alpha=0.25)


def draw_light(ax: Axes, rows: list[Row]) -> None:
    """Draw the light frame's dampings beside the known one and the resolution."""
    at = np.arange(1, len(rows) + 1)
    zeta, std = (np.array([row.get(k, np.nan) for row in rows]) for k in ("zeta", "zeta_std"))
    low, high = 100 * zeta * np.exp(-2 * std / zeta), 100 * zeta * np.exp(2 * std / zeta)
    ax.errorbar(at, 100 * zeta, [100 * zeta - low, high - 100 * zeta], fmt="o", ms=4, color=FULL,
                label="identified, ±2σ of ln ζ")  # fmt: skip
    ax.axhline(0.19, color=KNOWN, ls="--", label="known")
    ax.plot(at, [100 * row["resolution"] for row in rows], "_", ms=12, color=DATA,
            label="bandwidth of one\nFourier step")  # fmt: skip
    ax.set_xticks(at, [f"{row['known_f_hz']:.2f}" for row in rows], fontsize=7)
    ax.set_ylim(0, 0.5)
    ax.set_xlabel("frequency in Hz")
    ax.set_ylabel("damping ratio in %")
    ax.set_title("Light frame (simulated)", fontsize=10)
    ax.legend(fontsize=7)
    ax.grid(alpha=0.25)


def draw_shake(ax: Axes, rows: list[Row]) -> None:
    """Draw the table frame's frequencies from each floor against their known ranges."""
    modes = sorted({(row["frame"], row["mode"]) for row in rows})
    floors = sorted({row["floor"] for row in rows})
    for y, key in enumerate(modes):
        for row in (row for row in rows if (row["frame"], row["mode"]) == key):
            middle = (row["low_hz"] + row["high_hz"]) / 2
            half = (row["high_hz"] - row["low_hz"]) / 2 + row["tolerance_hz"]
            here = y + 0.2 * (floors.index(row["floor"]) - 1)
            ax.plot([-half, half], [y, y], lw=14, color=KNOWN, alpha=0.12, solid_capstyle="butt")
            if "f_hz" in row:
                ax.errorbar(row["f_hz"] - middle, here, xerr=2 * row["f_std_hz"], ms=4,
                            fmt="osD"[floors.index(row["floor"])], color=FULL)  # fmt: skip
            else:
                ax.text(0, here, f"{row['floor']}: refused, {row['refused']}", fontsize=7,
                        color=DATA, ha="center", va="center")  # fmt: skip
    names = {key: next(r for r in rows if (r["frame"], r["mode"]) == key) for key in modes}
    ax.set_yticks(range(len(modes)), [
        f"{frame.lower()}\n{(names[frame, mode]['low_hz'] + names[frame, mode]['high_hz']) / 2:.2f}"
        for frame, mode in modes
    ], fontsize=7)  # fmt: skip
    for floor, marker in zip(floors, "osD", strict=True):
        ax.plot([], [], marker, color=FULL, ms=4, label=f"{floor} floor, ±2σ")
    ax.plot([], [], lw=8, color=KNOWN, alpha=0.3, label="known, with its tolerance")
    ax.set_ylim(len(modes) + 0.6, -0.6)
    ax.set_xlabel("off the middle of what is known (left, Hz) in Hz")
    ax.set_title("Frame on a shaking table", fontsize=10)
    ax.legend(fontsize=7, loc="lower center", ncols=2, frameon=False)
    ax.grid(alpha=0.25, axis="x")


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw the building above, the other sets below."""
    axes = figure.subplots(3, 3, height_ratios=(1, 1, 1.25))
    for column, name in enumerate(result["building"]["modes"]):
        draw_building(axes[0, column], axes[1, column], name, result["building"])
    axes[0, 0].set_ylabel("natural frequency in Hz")
    axes[1, 0].set_ylabel("damping ratio in %")
    draw_shake(axes[2, 0], result["shake"]["rows"])
    draw_shear(axes[2, 1], result["shear_frame"])
    draw_light(axes[2, 2], result["light_frame"])
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4, frameon=False)


if __name__ == "__main__":
    write(__file__, draw_figure, (11.0, 9.0))
