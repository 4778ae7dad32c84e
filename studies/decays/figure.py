"""Draw figure.svg from result.json: coverage, scatter over its bound, machines, the beam."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import norm

from studies.harness.figures import BLACK, BLUE, GREEN, ORANGE, PINK, write
from studies.harness.study import Row

QUANTITIES = (("f", BLUE, "o", -0.15), ("zeta", ORANGE, "s", 0.15))
SYMBOLS = {"f": "frequency", "zeta": "damping"}


def rows_of(cases: Row) -> list[tuple[str, Row]]:
    """List every mode of every case with a name."""
    return [
        (f"{name}: {mode['f_hz']:g} Hz" if len(case["modes"]) > 1 else name, mode)
        for name, case in cases.items()
        for mode in case["modes"]
    ]


def draw_coverage(ax: Axes, rows: list[tuple[str, Row]]) -> None:
    """Draw coverages with their intervals, and those of the controls."""
    ax.axvline(95, color=BLACK, lw=1)
    for y, (_, mode) in enumerate(rows):
        for quantity, colour, marker, shift in QUANTITIES:
            own = mode[quantity]
            found = own["coverage"]
            low, high = found["interval"]
            ax.plot([100 * low, 100 * high], [y + shift] * 2, color=colour, lw=2, alpha=0.6)
            ax.plot(100 * found["share"], y + shift, marker, color=colour, ms=5)
            for control, sign, ink, size in (("narrow", "<", colour, 4), ("wide", ">", colour, 4),
                                             ("least_squares", "x", PINK, 6)):  # fmt: skip
                if control in own:
                    ax.plot(100 * own[control]["share"], y + shift, sign, color=ink, ms=size,
                            mfc="white")  # fmt: skip
    for quantity, colour, marker, _ in QUANTITIES:
        ax.plot([], [], marker + "-", color=colour, label=SYMBOLS[quantity])
    ax.plot([], [], "<", color="grey", mfc="white", label="control: 1.5 × narrower")
    ax.plot([], [], ">", color="grey", mfc="white", label="control: 1.5 × wider")
    ax.plot([], [], "x", color=PINK, label="least squares in white noise")
    ax.set_yticks(range(len(rows)), [name for name, _ in rows])
    ax.invert_yaxis()
    ax.set_xlabel("truths in the 95 % interval in %, with 99.9 % interval")
    ax.set_title("Coverage", fontsize=10)
    ax.legend(fontsize=7, loc="lower left")
    ax.grid(alpha=0.25, axis="x")


def draw_scatter(ax: Axes, rows: list[tuple[str, Row]]) -> None:
    """Draw scatter over the bound."""
    ax.axvline(1, color=BLACK, lw=1)
    for y, (_, mode) in enumerate(rows):
        for quantity, colour, marker, shift in QUANTITIES:
            ratio = mode[quantity]["rmse_over_bound"]
            half = 1.96 * ratio / np.sqrt(2 * mode[quantity]["coverage"]["n"])
            ax.plot([ratio - half, ratio + half], [y + shift] * 2, color=colour, alpha=0.6, lw=2)
            ax.plot(ratio, y + shift, marker, color=colour, ms=5)
    ax.set_yticks(range(len(rows)), [])
    ax.invert_yaxis()
    ax.set_xlabel("RMSE over Cramér-Rao bound, with 95 % interval")
    ax.set_title("Efficiency", fontsize=10)
    ax.grid(alpha=0.25, axis="x")


def draw_machines(ax: Axes, machines: Row) -> None:
    """Draw deviations over standard deviations against those of a normal distribution."""
    seen = [row for row in machines["rows"] if row["f_hz"] is not None]
    place = norm.ppf((np.arange(len(seen)) + 0.5) / len(seen))
    ax.plot([-3, 3], [-3, 3], color=BLACK, lw=1)
    for quantity, colour, marker, _ in QUANTITIES:
        z = np.sort([row[f"z_{quantity}"] for row in seen])
        share = 100 * machines[quantity]["share"]
        label = f"{SYMBOLS[quantity]}: {share:.0f} % in 95 % intervals"
        ax.plot(place, z, marker, color=colour, ms=3, alpha=0.7, label=label)
    ax.set_xlabel("expected of a normal distribution")
    ax.set_ylabel("deviation in standard deviations")
    title = f"Simulated X and Y stages: {len(seen)} of {machines['n_modes']} modes found"
    ax.set_title(title, fontsize=10)
    ax.legend(fontsize=7, loc="upper left")
    ax.grid(alpha=0.25)


def draw_beam(ax: Axes, beam: list[Row]) -> None:
    """Draw each dwell's deviation from the table."""
    ax.axhspan(-0.15, 0.15, color=GREEN, alpha=0.12, label="allowed")
    ax.axhline(0, color=BLACK, lw=1)
    for repeat, colour, marker in zip(range(3), (BLUE, ORANGE, GREEN), "osD", strict=True):
        own = [row for row in beam if row["repeat"] == repeat]
        seen = [row for row in own if row["f_hz"] is not None]
        x = [row["dwell"] + 0.2 * (repeat - 1) for row in seen]
        off, std = np.array([[row["off_hz"], row["f_std_hz"]] for row in seen]).T
        label = f"repeat {repeat + 1}, ± 2 σ"
        ax.errorbar(x, off, 2 * std, fmt=marker, ms=4, color=colour, label=label)
        for row in own:
            if row["f_hz"] is None:
                ax.text(row["dwell"] + 0.2 * (repeat - 1), -0.13, row["refused"], rotation=90,
                        fontsize=6, color=colour, ha="center", va="bottom")  # fmt: skip
    places = {row["dwell"]: row["reference_hz"] for row in beam}
    ax.set_xticks(list(places), [f"{hz:g}" for hz in places.values()], fontsize=7)
    ax.set_xlim(-0.6, max(places) + 0.6)
    ax.set_ylim(-0.17, 0.19)
    ax.set_xlabel("dwells in order of time, by the table's frequency in Hz")
    ax.set_ylabel("found − table in Hz")
    ax.set_title("A real beam on a moving roller", fontsize=10)
    ax.legend(fontsize=7, loc="upper left", ncols=2)


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw four panels."""
    rows = rows_of(result["cases"])
    axes = figure.subplots(2, 2, width_ratios=[1.15, 1], height_ratios=[1.25, 1])
    draw_coverage(axes[0, 0], rows)
    draw_scatter(axes[0, 1], rows)
    draw_machines(axes[1, 0], result["machines"])
    draw_beam(axes[1, 1], result["beam"])


if __name__ == "__main__":
    write(__file__, draw_figure, (12.0, 9.0))
