"""Draw figure.svg from result.json: gain, distribution, growth, and the lines of a real record."""

from __future__ import annotations

from itertools import groupby

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.harness.figures import BLUE, ORANGE, write
from studies.harness.study import Row

GREY = "#56606b"
# Lines of one kind that are closer than this share a label.
_TOGETHER_HZ = 10.0


def draw_gain(ax: Axes, details: Row) -> None:
    """Draw how far sines and expected noise are read from the truth, by ordinate."""
    sine, noise = details["sine_error"], details["noise_error"]
    at = np.geomspace(1, 8000, 50)
    ax.loglog(at, 6 / (np.pi * at) ** 2, color=BLUE, lw=0.8, label="stated, 6/(πk)²")
    ax.loglog(at, 3 / (np.pi * at) ** 2, color=ORANGE, lw=0.8, ls="--", label="stated, 3/(πk)²")
    ax.loglog(sine["ordinate"], sine["periodogram"], "o", ms=5, color=BLUE,
              label=f"sine, worst of {sine['sines_each']} (phases, odd and even n)")  # fmt: skip
    ax.loglog(noise["ordinate"], noise["periodogram"], "^", ms=4, mfc="none", color=ORANGE,
              label="white noise, expectation")  # fmt: skip
    ax.axhline(1e-6, color=GREY, lw=1)
    ax.text(1.1, 1.2e-6, "asked from k = 780 on", color=GREY, fontsize=8, va="bottom")
    ax.axvline(780, color=GREY, lw=0.6, ls=":")
    ax.set(xlabel="ordinate k (periods in the record)", ylabel="|read / true − 1|",
           ylim=(1e-9, 3.0))  # fmt: skip
    ax.set_title("Gain: only what the removed trend takes is missing", fontsize=10)
    ax.legend(frameon=False, fontsize=7.5, loc="lower left")


def draw_ratios(ax: Axes, details: Row) -> None:
    """Draw noise of known density as read in bands, with standard errors."""
    bands = details["noise_bands"]
    middle = np.sqrt(np.array(bands["low_hz"]) * np.array(bands["high_hz"]))
    error = 2 * np.array(bands["standard_error"])
    ax.errorbar(middle, bands["ratio"], error, fmt="o", ms=4, lw=1, color=BLUE,
                label=f"density, one record of {bands['duration_s']:.0f} s")  # fmt: skip
    known = details["known_rms"]
    logs = f"health and watched bands, mean of {known['repetitions']} logs"
    for i, row in enumerate(known["rows"]):
        low, high = map(float, row["band"].split()[-2].split("-"))
        # A mean square has twice the relative error of its root.
        ax.errorbar((low * high) ** 0.5, row["ratio"] ** 2, 4 * row["standard_error"], fmt="s",
                    ms=5, mfc="none", lw=1, color=ORANGE,
                    label="" if i else logs)  # fmt: skip
    ax.axhline(1.0, color=GREY, lw=1)
    ax.set(xscale="log", ylim=(0.88, 1.17), xlabel="frequency in Hz",
           ylabel="mean square read / true, ±2 σ")  # fmt: skip
    ax.set_title("Noise of known density reads its density", fontsize=10)
    ax.legend(frameon=False, fontsize=7.5, loc="upper right")


def draw_distribution(ax: Axes, ordinates: Row) -> None:
    """Draw the share of ordinates above a level beside the exponential distribution."""
    x = np.linspace(0, 15, 50)
    share = ordinates["probability_above"]
    ax.semilogy(x, np.exp(-x), color=GREY, lw=1, label="exponential, two degrees of freedom")
    ax.semilogy(ordinates["quantile"], share, "o", ms=3.5, color=BLUE,
                label=f"{ordinates['n']:,} ordinates of noise")  # fmt: skip
    ax.semilogy(ordinates["quantile_hann"], share, "x", ms=4, color=ORANGE,
                label="control: Hann window, uncorrected")  # fmt: skip
    ax.set(xlim=(0, 15), ylim=(1e-6, 1.5), xlabel="ordinate / density",
           ylabel="share of ordinates above")  # fmt: skip
    ax.set_title("Ordinates scatter as stated", fontsize=10)
    ax.legend(frameon=False, fontsize=7.5, loc="upper right")


def draw_slopes(ax: Axes, shown: list[Row], checks: Row) -> None:
    """Draw slopes with their intervals, less the truth."""
    start, ticks, labels = 0, [], []
    for part in shown:
        off = np.array(part["slope"]) - part["exponent"]
        reach = np.array(part["half_width"])
        at = start + np.arange(off.size)
        for missed, colour, marker in ((False, BLUE, "o"), (True, ORANGE, "x")):
            own = (np.abs(off) > reach) == missed
            ax.errorbar(
                at[own], off[own], reach[own], fmt=marker, ms=3 + 3 * missed, lw=0.9, color=colour
            )
        covered = checks[f"level ~ velocity^{part['exponent']:g}, magnitude: coverage of the 95 % "
                         "interval"]["measured"]  # fmt: skip
        ticks.append(float(at.mean()))
        labels.append(f"true slope {part['exponent']:g}\n{100 * covered:.1f} % cover")
        start += off.size + 4
    ax.axhline(0, color=GREY, lw=1)
    ax.set_xticks(ticks, labels)
    ax.tick_params(axis="x", length=0)
    ax.set_xlabel(f"first {at.size} series of each; shares are of all", fontsize=9)
    ax.set_ylabel("slope read − true, 95 % interval")
    ax.set_title("Growth over velocity (×: interval misses)", fontsize=10)


def draw_lines(ax: Axes, mpstd: Row) -> None:
    """Draw the spectrum of a real record with its lines named."""
    spectrum = mpstd["spectrum"]
    ax.semilogy(spectrum["frequency_hz"], 1e3 * np.array(spectrum["amplitude"]), lw=0.7,
                color=GREY, label="largest harmonic of every 0.5 Hz")  # fmt: skip
    mine = [line for line in mpstd["lines"] if line["channel"] == spectrum["channel"]]
    for kind, colour, marker, side in (("mains", BLUE, "o", "left"),
                                       ("unknown", ORANGE, "^", "center")):  # fmt: skip
        own = [line for line in mine if line["kind"] == kind]
        ax.plot([line["frequency_hz"] for line in own], [1e3 * line["amplitude"] for line in own],
                marker, ms=6, color=colour, label=f"line found, called {kind}")  # fmt: skip
        places = [round(line["frequency_hz"] / _TOGETHER_HZ) for line in own]
        for _, group in groupby(zip(places, own, strict=True), key=lambda pair: pair[0]):
            lines = [line for _, line in group]
            top = max(lines, key=lambda line: line["amplitude"])
            hertz = " / ".join(f"{line['frequency_hz']:.3g}" for line in lines)
            most = "" if len(lines) == 1 else "up to "
            ax.annotate(f"{hertz} Hz\n{most}{1e3 * top['amplitude']:.2f} mm/s²",
                        (top["frequency_hz"], 1e3 * top["amplitude"]), xytext=(-5, 8),
                        textcoords="offset points", ha=side, fontsize=8,
                        color=colour)  # fmt: skip
    ax.set(xlim=mpstd["band_hz"], xlabel="frequency in Hz", ylabel="amplitude in mm/s²")
    ax.text(0.99, 0.86, f"{mpstd['duration_s']:.0f} s spread a line that wanders over several\n"
            "harmonics: its mark stands above the curve.", transform=ax.transAxes, ha="right",
            va="top", fontsize=8, color=GREY)  # fmt: skip
    low, high = ax.get_ylim()
    ax.set_ylim(low, 8 * high)
    ax.set_title(
        "Real vibration (MPSTD, one of four channels): mains are called mains", fontsize=10
    )
    ax.legend(frameon=False, fontsize=8, ncols=3, loc="upper right")


def draw_figure(figure: Figure, result: Row) -> None:
    """Draw what is calibrated above; growth and a real record below."""
    details = result["details"]
    grid = figure.add_gridspec(2, 6)
    above = [figure.add_subplot(grid[0, 2 * i : 2 * i + 2]) for i in range(3)]
    below = [figure.add_subplot(grid[1, :2]), figure.add_subplot(grid[1, 2:])]
    draw_gain(above[0], details)
    draw_ratios(above[1], details)
    draw_distribution(above[2], details["ordinates"])
    draw_slopes(below[0], details["known_growth"]["shown"], result["checks"]["growth"])
    draw_lines(below[1], details["mpstd"])
    for ax in (*above, *below):
        ax.grid(alpha=0.25)


if __name__ == "__main__":
    write(__file__, draw_figure, (13.0, 7.6))
