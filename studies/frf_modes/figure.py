"""Draw figure.svg from result.json: responses with their fits, coverages, and real modes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

HERE = Path(__file__).parent
COLOURS = ("#0072b2", "#d55e00")


def draw_responses(ax: Axes, pictures: dict[str, Any], bench: str) -> None:
    """Draw measured gain, its noise and the fit of two responses of a bench."""
    shown = {name: part for name, part in pictures.items() if name.startswith(bench)}
    for (name, part), colour in zip(shown.items(), COLOURS, strict=True):
        hertz = part["frequency_hz"]
        ax.semilogy(hertz, part["gain"], ".", ms=3, color=colour, label=name.split(", ")[1])
        ax.semilogy(part["fit_hz"], part["fit"], lw=1, color=colour)
        ax.semilogy(hertz, part["std"], ":", lw=1, color=colour)
    ax.set_title(f"{bench}: measured, fit, noise (dotted)", fontsize=10)
    ax.set_xlabel("frequency in Hz")
    ax.set_ylabel("gain, SI units as mapped")
    ax.legend(frameon=False, fontsize=8)
    ax.grid(alpha=0.25)


def draw_coverage(ax: Axes, cases: dict[str, Any]) -> None:
    """Draw every coverage with its exact interval, and the halved ones that must fail."""
    labels = []
    for name, case in cases.items():
        parts = {what: case[what]["coverage"] for what in ("frequency", "damping")}
        for what, part in (parts | {"halved": case["coverage_halved"]}).items():
            k = len(labels)
            colour = "#999999" if what == "halved" else COLOURS[0]
            ax.plot([part["low"], part["high"]], [k, k], lw=3, color=colour)
            ax.plot(part["share"], k, "o", color=colour)
            labels.append(f"{name}: {what}")
    ax.axvline(0.95, color="#009e73", lw=1)
    ax.set_yticks(range(len(labels)), labels, fontsize=8)
    ax.invert_yaxis()
    ax.set_xlabel("coverage of 95 % intervals, with 99.9 % interval")
    ax.grid(alpha=0.25, axis="x")


def draw_modes(ax: Axes, rows: dict[str, Any], title: str) -> None:
    """Draw frequency and damping of real modes with two standard deviations."""
    for k, (name, row) in enumerate(rows.items()):
        ax.errorbar(row["frequency_hz"], 100 * row["damping_ratio"],
                    200 * row["damping_ratio_std"], 2 * row["frequency_std_hz"], fmt="o", ms=4,
                    lw=1, color=COLOURS[k * 2 // len(rows)], alpha=0.5 + 0.5 * (k % 2),
                    label=name.replace("delta_e_", ""))  # fmt: skip
    ax.set_title(title, fontsize=10)
    ax.set_xlabel("frequency in Hz, ±2σ")
    ax.set_ylabel("damping in %, ±2σ")
    ax.legend(frameon=False, fontsize=8)
    ax.grid(alpha=0.25)


def draw_sweeps(ax: Axes, rows: list[dict[str, Any]]) -> None:
    """Draw what three sensors say of pitch in every sweep, less the truth."""
    sensors = [name for name in rows[0] if name != "seed"]
    for k, sensor in enumerate(sensors):
        x = np.array([row["seed"] for row in rows]) + 0.2 * (k - 1)
        error = [1e3 * row[sensor]["error_hz"] for row in rows]
        std = [2e3 * row[sensor]["std_hz"] for row in rows]
        ax.errorbar(x, error, std, fmt="os^"[k], ms=3.5, lw=0.9, label=sensor)
    ax.axhline(0.0, color="#009e73", lw=1)
    ax.set_title("sweeps of simulated Y: pitch less eigenvalue", fontsize=10)
    ax.set_xlabel("seed")
    ax.set_ylabel("mHz, ±2σ")
    ax.legend(frameon=False, fontsize=8)
    ax.grid(alpha=0.25)


def main() -> None:
    """Draw benches above, simulated machines below."""
    matplotlib.rcParams["svg.hashsalt"] = "frf_modes"
    result = json.loads((HERE / "result.json").read_text())
    figure = Figure(figsize=(12.0, 7.0), layout="constrained")
    axes = figure.subplots(2, 3)
    draw_responses(axes[0, 0], result["pictures"], "linear guide")
    draw_modes(axes[0, 1], result["linear_guide"], "linear guide: friction moves it")
    draw_responses(axes[0, 2], result["pictures"], "two inertias")
    sides = {name: result["two_inertias"][name] for name in ("delta_e_motor", "delta_e_load")}
    draw_modes(axes[1, 0], sides, "two inertias: both sides")
    draw_coverage(axes[1, 1], result["cases"])
    draw_sweeps(axes[1, 2], result["sweep_rows"])
    figure.savefig(HERE / "figure.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
