"""Draw figure.svg from result.json: a response with its fit, every estimate beside the truth."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter

from studies.harness.figures import BLUE, GREEN, ORANGE, write
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
        ax.semilogy(hertz, scale * np.array(part["gain"]), ".", ms=3, color=colour,
                    label="measured")  # fmt: skip
        ax.semilogy(part["fit_hz"], scale * np.array(part["fit"]), lw=1, color="black", label="fit")
        ax.set_title(f"FRF, current to {label}", fontsize=10)
        ax.set_ylabel(f"gain in {unit}")
        ax.legend(frameon=False, fontsize=8)
        ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        ax.yaxis.set_minor_formatter(NullFormatter())
        missing = part["missing_coherence"]
        coherence.semilogy(hertz, missing, ".", ms=3, color=colour, label=label)
    coherence.set_title("what is missing of a coherence of 1", fontsize=10)
    coherence.set_ylabel("1 - coherence")
    coherence.legend(frameon=False, fontsize=8, loc="upper right")
    for ax in (*gain, coherence):
        ax.set_xlabel("frequency in Hz")
        ax.grid(alpha=0.25)


def draw_mode(ax: Axes, name: str, mode: Row, rows: list[Row]) -> None:
    """Draw what every method found in every log, less the truth."""
    reach = _REACH * max(m.get("median_std_hz", 0.0) for m in mode["methods"].values())
    for k, (method, (label, colour, marker)) in enumerate(METHODS.items()):
        found = [(i, *row[method][name]) for i, row in enumerate(rows)
                 if not isinstance(row[method][name], str)]  # fmt: skip
        if not found or (method == "frf_worn" and name != "pitch"):
            continue
        index, f, std = np.array(found).T
        off = f - mode["truth_hz"]
        inside = np.abs(off) < reach
        x = index + 0.2 * (k - 1)
        ax.errorbar(x[inside], off[inside], 2 * std[inside], fmt=marker, ms=3.5, lw=0.9,
                    color=colour, label=f"{label}, ±2σ")  # fmt: skip
        for at, by in zip(x[~inside], off[~inside], strict=True):
            edge = np.sign(by) * 0.97 * reach
            ax.annotate(f"{by:+.1f}", (at, edge), ha="center", va="top" if by > 0 else "bottom",
                        fontsize=6, color=colour, rotation=90)  # fmt: skip
    ax.axhline(0.0, lw=1, color=GREEN)
    ax.set_ylim(-reach, reach)
    ax.set_title(f"{name}, {mode['truth_hz']:.2f} Hz: {mode['verdict']}", fontsize=10)
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
    handles, labels = axes[1, 1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)


if __name__ == "__main__":
    write(__file__, draw_figure, (11.0, 6.6))
