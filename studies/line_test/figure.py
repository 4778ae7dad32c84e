"""Draw figure.svg from result.json: alarms, their border, what is found, how far modes move."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from studies.harness.figures import BLACK, BLUE, GREEN, ORANGE, PINK, write
from studies.harness.study import Row

MARKERS = "osD"
_LEAST_RATE = 1e-4


def draw_alarms(ax: Axes, rows: list[Row], controls: list[Row]) -> None:
    """Draw measured rates over declared ones, every background in a row of its own."""
    names = [row["background"] for row in rows] + ["control: rate not shared",
                                                  "control: highest ordinate"]  # fmt: skip
    every = [row["rates"] for row in rows] + [[control] for control in controls]
    declared = [rate["declared"] for rate in rows[0]["rates"]]
    for colour, marker, level in zip((GREEN, BLUE, ORANGE), MARKERS, declared, strict=True):
        ax.axvline(level, lw=1, color=colour, ls="--")
        for y, rates in enumerate(every):
            for rate in rates:
                if rate["declared"] != level:
                    continue
                share = rate["hits"] / rate["n"]
                low = max(rate["low"], _LEAST_RATE)
                ax.plot([low, rate["high"]], [y, y], lw=2, color=colour, alpha=0.6)
                ax.plot(max(share, _LEAST_RATE), y, marker, ms=5, color=colour)
        ax.plot([], [], marker, ls="-", color=colour, label=f"declared {100 * level:g} %")
    ax.set_xscale("log")
    ax.set_xlim(_LEAST_RATE, 1.5)
    ax.set_yticks(range(len(names)), names)
    ax.invert_yaxis()
    ax.set_xlabel("share of spectra with an alarm, 99 % interval")
    ax.set_title("False alarms", fontsize=10)
    ax.legend(fontsize=7, loc="lower center", frameon=True)


def draw_border(ax: Axes, rows: list[Row]) -> None:
    """Draw alarms of one resonance over its width and height."""
    widths = sorted({row["width_ordinates"] for row in rows})
    heights = sorted({row["height_db"] for row in rows})
    rate = np.array([row["hits"] / row["n"] for row in rows]).reshape(len(widths), len(heights)).T
    image = ax.imshow(np.maximum(rate, 2e-3), origin="lower", aspect="auto", cmap="cividis",
                      norm=LogNorm(2e-3, 0.3))  # fmt: skip
    for (y, x), value in np.ndenumerate(rate):
        dark = value < 0.03
        ax.text(x, y, f"{100 * value:.1f}", ha="center", va="center", fontsize=7,
                color="white" if dark else "black")  # fmt: skip
    ax.set_xticks(range(len(widths)), [f"{w:.2g}" for w in widths])
    ax.set_yticks(range(len(heights)), [f"{h:g}" for h in heights])
    ax.set_xlabel("width of the resonance in ordinates")
    ax.set_ylabel("height above the noise in dB")
    ax.set_title("Alarms of one resonance in %, declared 1 %", fontsize=10)
    ax.figure.colorbar(image, ax=ax, label="share of spectra")


def draw_detection(ax: Axes, kinds: dict[str, list[Row]]) -> None:
    """Draw the share found over the strength, against the best detectors."""
    for (name, rows), colour, marker in zip(
        kinds.items(), (BLUE, GREEN, ORANGE), MARKERS, strict=True
    ):
        ratio = [row["ratio_db"] for row in rows]
        ax.plot(ratio, [row["share_found"] for row in rows], marker + "-", ms=4, color=colour,
                label=name.replace("peak of a resonance", "resonance"))  # fmt: skip
    rows = kinds["white, 3 s"]
    ratio = [row["ratio_db"] for row in rows]
    for key, style, label in (
        ("best_known_frequency", ":", "bound, frequency known"),
        ("best_any_frequency", "--", "bound, frequency unknown"),
    ):
        ax.plot(ratio, [row[key] for row in rows], style, color=BLACK, label=label)
    ax.set_xlabel("ordinate of the line over the noise in dB")
    ax.set_ylabel("share found")
    ax.set_title("Lines found at 1 % false alarms", fontsize=10)
    ax.legend(fontsize=7, loc="lower right")
    ax.grid(alpha=0.25)


def draw_errors(ax: Axes, rows: list[Row]) -> None:
    """Draw errors of frequency and amplitude against their bounds."""
    kept = [row for row in rows if row["share_found"] > 0.3]
    ratio = [row["ratio_db"] for row in kept]
    for key, colour, marker, label in (
        ("amplitude", ORANGE, "s", "amplitude, of itself"),
        ("ordinates", BLUE, "o", "frequency, in ordinates"),
    ):
        ax.semilogy(ratio, [row[f"rms_error_{key}"] for row in kept], marker, ms=5,
                    color=colour, label=label)  # fmt: skip
        ax.semilogy(ratio, [row[f"bound_error_{key}"] for row in kept], "--", color=colour,
                    label="Cramér-Rao bound")  # fmt: skip
    ax.set_xlabel("ordinate of the line over the noise in dB")
    ax.set_ylabel("RMS error")
    ax.set_title("Errors of the lines found, white, 3 s", fontsize=10)
    ax.legend(fontsize=7)
    ax.grid(alpha=0.25, which="both")


def draw_company(ax: Axes, beside: list[Row], strokes: list[Row]) -> None:
    """Draw what is found beside a strong line, and in strokes together."""
    for contrast, colour, marker in zip((20, 30), (BLUE, ORANGE), "os", strict=True):
        rows = [row for row in beside if row["contrast_db"] == contrast]
        label = f"beside {25 + contrast} dB"
        ax.plot([row["gap"] for row in rows], [row["share_found"] for row in rows], marker + "-",
                ms=4, color=colour, label=label)  # fmt: skip
    for key, style in (("together", "D-"), ("alone", "D:")):
        label = f"strokes {key}"
        ax.plot([row["strokes"] for row in strokes], [row[key] for row in strokes], style, ms=4,
                color=GREEN, label=label)  # fmt: skip
    ax.set_xscale("log", base=2)
    ax.xaxis.set_major_formatter("{x:g}")
    ax.set_ylim(-0.03, 1.03)
    ax.set_xlabel("ordinates apart, or count of strokes")
    ax.set_ylabel("share found")
    title = f"Lines of 25 dB in company, of {strokes[0]['ratio_db']:g} dB in strokes"
    ax.set_title(title, fontsize=10)
    ax.legend(fontsize=7, loc="center right", bbox_to_anchor=(1.0, 0.25))
    ax.grid(alpha=0.25)


def draw_moves(ax: Axes, modes: Row) -> None:
    """Draw how far each line moves the mode, and how often it is refused."""
    rows = modes["rows"] + modes["orders"]
    for key, colour, marker, shift, label in (
        ("moved_with_lines_left_in", PINK, "x", 1.12, "lines left in (control)"),
        ("moved", BLUE, "o", 0.9, "as identified"),
    ):
        kept = [row for row in rows if row[key] is not None]
        ax.loglog([shift * row["times_peak"] for row in kept],
                  [max(abs(row[key]), 1e-3) for row in kept], marker, ms=3, alpha=0.6,
                  color=colour, label=label)  # fmt: skip
    ax.axhline(1.0, color=BLACK, lw=1)
    for row in modes["strengths"]:
        for key, colour, y in (("_with_lines_left_in", PINK, 0.94), ("", BLUE, 0.88)):
            ax.text(row["times_peak"], y, f"{row['refused' + key]}", color=colour, fontsize=7,
                    ha="center", transform=ax.get_xaxis_transform())  # fmt: skip
    ax.set_ylim(top=3e2)
    strengths = [row["times_peak"] for row in modes["strengths"]]
    ax.set_xticks(strengths, [f"{s:g}" for s in strengths])
    ax.minorticks_off()
    ax.set_xlabel("line over the mode's peak, amplitudes")
    ax.set_ylabel("move of the mode's frequency in σ")
    n = modes["strengths"][0]["n"]
    ax.set_title(f"Lines on a mode; on top: refused of {n}", fontsize=10)
    ax.legend(fontsize=7, loc="lower right")
    ax.grid(alpha=0.25)


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw six panels."""
    axes = figure.subplots(2, 3)
    draw_alarms(axes[0, 0], result["false_alarms"], result["controls"])
    draw_border(axes[0, 1], result["border"])
    draw_detection(axes[0, 2], result["detection"])
    draw_errors(axes[1, 0], result["detection"]["white, 3 s"])
    draw_company(axes[1, 1], result["beside"], result["strokes"])
    draw_moves(axes[1, 2], result["modes"])


if __name__ == "__main__":
    write(__file__, draw_figure, (13.0, 8.0))
