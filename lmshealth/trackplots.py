"""Pictures of tracks: frequencies, dampings, what happened, and whether the filter is believed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lmshealth.arrays import FloatArray
from lmshealth.plots import BLUE, GREEN, INK, RED, bars, odometer
from lmshealth.tracks import History, Track

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_KM = 1000.0


def plot_frequencies(ax: Axes, history: History, track: Track | None, mode: str) -> Axes:
    """Plot the natural frequency of a mode against the odometer.

    Each log's estimate with ± 2 standard deviations as it was measured; the filtered line with
    its 95 % band has the covariates at their reference. Without a track of this mode the line
    is left out.
    """
    for column in history.columns(mode):
        _logs(ax, history, column, history.ln_frequency[:, column], 1.0)
    if track is not None and mode in track.modes:
        k = track.modes.index(mode)
        level = track.ln_frequency[:, k]
        _filtered(ax, track.travel, level, track.ln_frequency_std[:, k], 1.0)
        _baselines(ax, history, track, k)
        _happenings(ax, track)
    # A healthy mode must not look like a drama: at least 1 % of the frequency is shown.
    low, high = ax.get_ylim()
    middle = (low + high) / 2
    if high - low < 0.01 * middle:
        ax.set_ylim(0.995 * middle, 1.005 * middle)
    ax.set_ylabel("natural frequency in Hz")
    return odometer(ax)


def plot_damping(ax: Axes, history: History, track: Track | None, mode: str) -> Axes:
    """Plot the damping ratio of a mode against the odometer, as `plot_frequencies` does."""
    columns = history.columns(mode)
    level = history.ln_damping[:, columns]
    top = max(
        _logs(ax, history, len(history.series) + column, history.ln_damping[:, column], 100.0)
        for column in columns
    )
    if track is not None and mode in track.modes:
        k = track.modes.index(mode)
        _filtered(ax, track.travel, track.ln_damping[:, k], track.ln_damping_std[:, k], 100.0)
    # A log that hardly saw the mode has bars without end; they may leave the picture.
    if top > 0:
        ax.set_ylim(0, 1.08 * min(top, 300 * float(np.exp(np.nanmax(level)))))
    ax.set_ylabel("damping ratio in %")
    return odometer(ax)


def plot_nis(ax: Axes, track: Track) -> Axes:
    """Plot the normalised innovation squared of each epoch and its 95 % chi-square band."""
    seen = (track.nis_dof > 0) & np.isfinite(track.nis)
    x, nis = track.travel[seen] / _KM, track.nis[seen]
    low, high = chi_square_band(track.nis_dof[seen])
    ax.fill_between(x, low, high, step="mid", color=BLUE, alpha=0.18, lw=0, label="95 % band")
    inside = (nis >= low) & (nis <= high)
    ax.plot(x[inside], nis[inside], "o", color=BLUE, ms=4, label="inside")
    if not inside.all():
        ax.plot(x[~inside], nis[~inside], "D", color=RED, ms=5, label="outside")
    if nis.size and nis.max() > 4 * high.max():
        ax.set_yscale("log")
        ax.set_ylabel("NIS (log scale)")
    else:
        ax.set_ylim(bottom=0)
        ax.set_ylabel("NIS")
    return odometer(ax)


def chi_square_band(dof: FloatArray) -> FloatArray:
    """Bounds that hold a chi-square variable with 95 %, shape ``(2, ...)``."""
    from scipy.special import gammaincinv

    return np.stack([2 * gammaincinv(dof / 2, level) for level in (0.025, 0.975)])


def _logs(ax: Axes, history: History, row: int, level: FloatArray, unit: float) -> float:
    """Draw logarithmic estimates with ± 2 standard deviations; return the top of the bars."""
    std = np.sqrt(history.cov[:, row, row])
    seen = np.isfinite(level) & np.isfinite(std)
    bounds = unit * np.exp(level[seen] + np.array([-2, 0, 2])[:, None] * std[seen])
    bars(ax, history.travel[seen], bounds, "each log, ±2σ", 3)
    return float(np.max(bounds[2], initial=0.0))


def _filtered(
    ax: Axes, travel: FloatArray, level: FloatArray, std: FloatArray, unit: float
) -> None:
    """Draw the filtered line with its 95 % band, above the logs."""
    x, reach = travel / _KM, 1.96 * std
    low, high = unit * np.exp(level - reach), unit * np.exp(level + reach)
    ax.fill_between(x, low, high, color=BLUE, alpha=0.25, lw=0, zorder=3)
    marker = "o" if travel.size < 3 else ""
    name = "filtered, 95 % band"
    ax.plot(x, unit * np.exp(level), color=BLUE, lw=1.8, marker=marker, zorder=4, label=name)


def _baselines(ax: Axes, history: History, track: Track, column: int) -> None:
    """Draw what each baseline is now believed to have been, as far as it counts."""
    base = np.exp(track.ln_frequency[:, column] - track.drift[:, column])
    ends = [*history.baselines[1:], len(history.logs)]
    for number, (first, end) in enumerate(zip(history.baselines, ends, strict=True)):
        own = base[first:end]
        if np.isfinite(own).any():
            value = float(own[np.isfinite(own)][-1])
            x = track.travel[[first, end - 1]] / _KM
            name = None if number else "baseline"
            ax.plot(x, [value, value], color=GREEN, lw=1.1, ls=(0, (5, 3)), label=name)


def _happenings(ax: Axes, track: Track) -> None:
    """Mark what happened at once."""
    marked: set[str] = set()
    for kind, first in dict.fromkeys((step.kind, step.first) for step in track.steps):
        colour, style = (RED, "-") if kind == "step" else (INK, ":")
        name = None if kind in marked else _WORDS[kind]
        marked.add(kind)
        ax.axvline(track.travel[first] / _KM, color=colour, ls=style, lw=1.0, label=name, zorder=1)


_WORDS = {
    "step": "sudden change",
    "regreasing": "regreasing",
    "servo": "servo retuned",
    "sensor": "sensor changed",
    "reset": "guide or mount serviced",
}
