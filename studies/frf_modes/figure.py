"""Draw figure.svg from result.json: responses with their fits, coverages, and real modes."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.figures import BLUE, GREEN, GREY, ORANGE, draw_shares, name_lines, write
from studies.harness.study import Row

COLOURS = (BLUE, ORANGE)


def draw_responses(ax: Axes, pictures: Row, bench: str) -> None:
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


def draw_coverage(ax: Axes, cases: Row) -> None:
    """Draw every coverage with its exact interval, and the controls that must fail."""
    labels = []
    for name, case in cases.items():
        for what in ("frequency", "damping"):
            k = len(labels)
            for part, colour, marker in (
                ("control_narrower", GREY, "<"),
                ("control_wider", GREY, ">"),
                ("coverage", COLOURS[0], "o"),
            ):
                draw_shares(ax, k, [case[what][part]], colour, marker)
            labels.append(f"{name}: {'f' if what == 'frequency' else 'ζ'}")
    ax.axvline(0.95, color=GREEN, lw=1)
    name_lines(ax, labels, fontsize=8)
    ax.set_title("simulated; grey: 1.5 × as narrow ◂, wide ▸", fontsize=10)
    ax.set_xlabel("coverage of 95 % intervals, with 99.9 % interval")
    ax.grid(alpha=0.25, axis="x")


def draw_modes(ax: Axes, rows: Row, title: str) -> None:
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


def draw_sweeps(ax: Axes, sweeps: dict[str, list[Row]]) -> None:
    """Draw how far pitch is off by each sensor, in stated standard deviations."""
    labels = []
    for name, rows in sweeps.items():
        for sensor in (key for key in rows[0] if key != "seed"):
            f, zeta = zip(*(row[sensor]["z"] for row in rows), strict=True)
            k = len(labels)
            x = np.linspace(-0.25, 0.25, len(rows))
            first = not labels
            ax.plot(k + x, f, "o", ms=3.5, color=COLOURS[0], label="f" if first else None)
            ax.plot(k + x, zeta, "s", ms=3.5, mfc="none", color=COLOURS[1],
                    label="ζ" if first else None)  # fmt: skip
            labels.append(f"{name}: {sensor}")
    for level in (-1.96, 1.96):
        ax.axhline(level, color=GREEN, lw=1)
    ax.set_xticks(range(len(labels)), labels, rotation=60, ha="right", fontsize=8)
    ax.set_title("sweeps of simulated stages: pitch, 8 seeds", fontsize=10)
    ax.set_ylabel("error over stated σ")
    ax.legend(frameon=False, fontsize=8)
    ax.grid(alpha=0.25, axis="y")


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw benches above, simulated machines below."""
    axes = figure.subplots(2, 3)
    draw_responses(axes[0, 0], result["pictures"], "linear guide")
    draw_modes(axes[0, 1], result["linear_guide"], "linear guide: friction moves it")
    draw_responses(axes[0, 2], result["pictures"], "two inertias")
    sides = {name: result["two_inertias"][name] for name in ("delta_e_motor", "delta_e_load")}
    draw_modes(axes[1, 0], sides, "two inertias: both sides")
    draw_coverage(axes[1, 1], result["cases"])
    draw_sweeps(axes[1, 2], result["sweep_rows"])


if __name__ == "__main__":
    write(__file__, draw_figure, (14.0, 8.5))
