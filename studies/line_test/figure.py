"""Draw figure.svg from result.json: alarms, their border, what is found, how far modes move."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from studies.harness.figures import BLACK, BLUE, GREEN, ORANGE, PINK, name_lines, write
from studies.harness.study import Row

MARKERS = "osD"
_LEAST_RATE = 1e-4
_RATIO = "ordinate of the line over the noise in dB"


def column(rows: list[Row], key: str) -> list[float]:
    """Return one column of rows."""
    return [row[key] for row in rows]


def draw_alarms(ax: Axes, rows: list[Row], controls: list[Row]) -> None:
    """Draw measured rates over declared ones, every background in a row of its own."""
    names = [*column(rows, "background"), "control: rate not shared", "control: highest ordinate"]
    every = [row["rates"] for row in rows] + [[control] for control in controls]
    style = {}
    for rate, colour, marker in zip(rows[0]["rates"], (GREEN, BLUE, ORANGE), MARKERS, strict=True):
        level = rate["declared"]
        style[level] = colour, marker
        ax.axvline(level, lw=1, color=colour, ls="--")
        ax.plot([], [], marker, ls="-", color=colour, label=f"declared {100 * level:g} %")
    for y, rates in enumerate(every):
        for rate in rates:
            colour, marker = style[rate["declared"]]
            reach = np.maximum([rate["low"], rate["high"]], _LEAST_RATE)
            ax.plot(reach, [y, y], lw=2, color=colour, alpha=0.6)
            ax.plot(max(rate["hits"] / rate["n"], _LEAST_RATE), y, marker, ms=5, color=colour)
    name_lines(ax, names)
    ax.set(xscale="log", xlim=(_LEAST_RATE, 1.5), title="False alarms")
    ax.set_xlabel("share of spectra with an alarm, 99 % interval")
    ax.legend(fontsize=7, loc="lower center")


def draw_border(ax: Axes, rows: list[Row]) -> None:
    """Draw alarms of one resonance over its width and height."""
    widths, heights = (sorted(set(column(rows, k))) for k in ("width_ordinates", "height_db"))
    rate = np.array([row["hits"] / row["n"] for row in rows]).reshape(len(widths), len(heights)).T
    norm = LogNorm(2e-3, 0.3)
    image = ax.imshow(rate.clip(2e-3), origin="lower", aspect="auto", cmap="cividis", norm=norm)
    for (y, x), value in np.ndenumerate(rate):
        style = {"ha": "center", "va": "center", "color": "white" if value < 0.03 else "black"}
        ax.text(x, y, f"{100 * value:.1f}", fontsize=7, **style)
    ax.set_xticks(range(len(widths)), [f"{w:.2g}" for w in widths])
    ax.set_yticks(range(len(heights)), [f"{h:g}" for h in heights])
    ax.set(xlabel="width of the resonance in ordinates", ylabel="height above the noise in dB")
    ax.set_title("Alarms of one resonance in %, declared 1 %")
    ax.figure.colorbar(image, ax=ax, label="share of spectra")


def draw_detection(ax: Axes, kinds: dict[str, list[Row]]) -> None:
    """Draw the share found over the strength, against the best detectors."""
    for (name, rows), colour, marker in zip(
        kinds.items(), (BLUE, GREEN, ORANGE), MARKERS, strict=True
    ):
        label = name.replace("peak of a resonance", "resonance")
        x, y = column(rows, "ratio_db"), column(rows, "share_found")
        ax.plot(x, y, marker + "-", ms=4, color=colour, label=label)
    for what, style in (("known", ":"), ("any", "--")):
        bound = column(kinds["white, 3 s"], f"best_{what}_frequency")
        label = f"bound, frequency {'known' if what == 'known' else 'unknown'}"
        ax.plot(x, bound, style, color=BLACK, label=label)
    ax.set(xlabel=_RATIO, ylabel="share found", title="Lines found at 1 % false alarms")
    ax.legend(fontsize=7, loc="lower right")


def draw_errors(ax: Axes, rows: list[Row]) -> None:
    """Draw errors of frequency and amplitude against their bounds."""
    kept = [row for row in rows if row["share_found"] > 0.3]
    ratio = column(kept, "ratio_db")
    for key, colour, marker, label in (
        ("amplitude", ORANGE, "s", "amplitude, of itself"),
        ("ordinates", BLUE, "o", "frequency, in ordinates"),
    ):
        error, bound = (column(kept, f"{what}_error_{key}") for what in ("rms", "bound"))
        ax.semilogy(ratio, error, marker, ms=5, color=colour, label=label)
        ax.semilogy(ratio, bound, "--", color=colour, label="Cramér-Rao bound")
    ax.set(xlabel=_RATIO, ylabel="RMS error", title="Errors of the lines found, white, 3 s")
    ax.legend(fontsize=7)


def draw_company(ax: Axes, beside: list[Row], strokes: list[Row]) -> None:
    """Draw what is found beside a strong line, and in strokes together."""
    for contrast, colour, marker in ((20, BLUE, "o"), (30, ORANGE, "s")):
        rows = [row for row in beside if row["contrast_db"] == contrast]
        x, y = column(rows, "gap"), column(rows, "share_found")
        ax.plot(x, y, marker + "-", ms=4, color=colour, label=f"beside {25 + contrast} dB")
    for key, style in (("together", "D-"), ("alone", "D:")):
        x, y = column(strokes, "strokes"), column(strokes, key)
        ax.plot(x, y, style, ms=4, color=GREEN, label=f"strokes {key}")
    ax.set_xscale("log", base=2)
    ax.xaxis.set_major_formatter("{x:g}")
    ax.set(xlabel="ordinates apart, or count of strokes", ylabel="share found", ylim=(-0.03, 1.03))
    ax.set_title(f"Lines of 25 dB in company, of {strokes[0]['ratio_db']:g} dB in strokes")
    ax.legend(fontsize=7, loc="center right", bbox_to_anchor=(1.0, 0.25))


def draw_moves(ax: Axes, modes: Row) -> None:
    """Draw how far each line moves the mode, and how often it is refused."""
    strengths = modes["strengths"]
    for suffix, colour, marker, shift, high, label in (
        ("_with_lines_left_in", PINK, "x", 1.12, 0.94, "lines left in (control)"),
        ("", BLUE, "o", 0.9, 0.88, "as identified"),
    ):
        key = "moved" + suffix
        kept = [row for row in modes["rows"] + modes["orders"] if row[key] is not None]
        x, y = shift * np.array(column(kept, "times_peak")), np.abs(column(kept, key)).clip(1e-3)
        ax.loglog(x, y, marker, ms=3, alpha=0.6, color=colour, label=label)
        for row in strengths:
            style = {"ha": "center", "transform": ax.get_xaxis_transform(), "color": colour}
            ax.text(row["times_peak"], high, f"{row['refused' + suffix]}", fontsize=7, **style)
    ax.axhline(1.0, color=BLACK, lw=1)
    ax.set_ylim(top=3e2)
    ax.set_xticks(column(strengths, "times_peak"), [f"{r['times_peak']:g}" for r in strengths])
    ax.minorticks_off()
    ax.set(xlabel="line over the mode's peak, amplitudes", ylabel="move of the frequency in σ")
    ax.set_title(f"Lines on a mode; on top: refused of {strengths[0]['n']}")
    ax.legend(fontsize=7, loc="lower right")


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw six panels."""
    axes = figure.subplots(2, 3)
    draw_alarms(axes[0, 0], result["false_alarms"], result["controls"])
    draw_border(axes[0, 1], result["border"])
    draw_detection(axes[0, 2], result["detection"])
    draw_errors(axes[1, 0], result["detection"]["white, 3 s"])
    draw_company(axes[1, 1], result["beside"], result["strokes"])
    draw_moves(axes[1, 2], result["modes"])
    for ax in axes.flat[2:]:
        ax.grid(alpha=0.25)


if __name__ == "__main__":
    write(__file__, draw_figure, (13.0, 8.0))
