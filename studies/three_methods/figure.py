"""Draw figure.svg from result.json: a response with its fit, every estimate beside the truth."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter

from studies.harness.figures import BLUE, GREEN, ORANGE, legend_above, write
from studies.harness.study import Row

SENSORS = {
    "delta_e": ("following error", 1e6, "µm/A", BLUE),
    "acc_pitch": ("vertical acceleration", 1.0, "m/s²/A", ORANGE),
}
METHODS = {
    "frf": ("FRF", "#000000", "o"),
    "delta_e": ("following error", BLUE, "s"),
    "accelerometers": ("accelerometers", ORANGE, "^"),
    "frf_worn": ("FRF at 95 % preload (control)", "#999999", "x"),
}
STAGE, MODES = "lms-y", ("roll", "pitch", "yaw")
# Half the height of a panel, in the largest median standard deviation of its methods.
_REACH = 5.0


def draw_response(gain: list[Axes], coherence: Axes, example: Row) -> None:
    """Draw measured gain, its fit, and coherence of both sensors."""
    for ax, (name, (label, scale, unit, colour)) in zip(gain, SENSORS.items(), strict=True):
        part = example[name]
        hertz = part["frequency_hz"]
        measured, fit = scale * np.array(part["gain"]), scale * np.array(part["fit"])
        ax.semilogy(hertz, measured, ".", ms=3, color=colour, label="measured")
        ax.semilogy(part["fit_hz"], fit, lw=1, color="black", label="fit")
        ax.set_title(f"FRF, current to {label}")
        ax.set_ylabel(f"gain in {unit}")
        ax.legend(frameon=False, fontsize=8)
        ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        ax.yaxis.set_minor_formatter(NullFormatter())
        coherence.semilogy(hertz, part["missing_coherence"], ".", ms=3, color=colour, label=label)
    coherence.set(title="what is missing of a coherence of 1", ylabel="1 - coherence")
    coherence.legend(frameon=False, fontsize=8, loc="upper right")
    for ax in (*gain, coherence):
        ax.set_xlabel("frequency in Hz")
        ax.grid(alpha=0.25)


def draw_mode(ax: Axes, name: str, mode: Row, rows: list[Row]) -> None:
    """Draw what every method found in every log, less the truth."""
    reach = _REACH * max(m.get("median_std_hz", 0.0) for m in mode["methods"].values())
    for k, (method, (label, colour, marker)) in enumerate(METHODS.items()):
        cells = [(i, row[method][name]) for i, row in enumerate(rows)]
        found = [(i, *cell) for i, cell in cells if not isinstance(cell, str)]
        if not found or (method == "frf_worn" and name != "pitch"):
            continue
        index, f, std = np.array(found).T
        x, off = index + 0.2 * (k - 1), f - mode["truth_hz"]
        inside = np.abs(off) < reach
        style = {"fmt": marker, "ms": 3.5, "lw": 0.9, "label": f"{label}, ±2σ"}
        ax.errorbar(x[inside], off[inside], 2 * std[inside], color=colour, **style)
        for at, by in zip(x[~inside], off[~inside], strict=True):
            place = {"ha": "center", "va": "top" if by > 0 else "bottom", "rotation": 90}
            edge = at, np.sign(by) * 0.97 * reach
            ax.annotate(f"{by:+.1f}", edge, fontsize=6, color=colour, **place)
    ax.axhline(0.0, lw=1, color=GREEN)
    ax.set_ylim(-reach, reach)
    ax.set_title(f"{name}, {mode['truth_hz']:.2f} Hz: {mode['verdict']}")
    ax.set_xlabel("seed")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.grid(alpha=0.25)


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw responses above, one panel per mode below."""
    axes = figure.subplots(2, 3)
    draw_response([axes[0, 0], axes[0, 1]], axes[0, 2], result["example"])
    rows = [row for row in result["rows"] if row["stage"] == STAGE]
    for ax, name in zip(axes[1], MODES, strict=True):
        draw_mode(ax, name, result["stages"][STAGE]["modes"][name], rows)
    axes[1, 0].set_ylabel("frequency less eigenvalue in Hz")
    legend_above(figure, axes[1, 1], ncols=4)


if __name__ == "__main__":
    write(__file__, draw_figure, (11.0, 6.6))
