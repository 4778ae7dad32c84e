"""Pictures of tracks: frequencies, dampings, what happened, and whether the filter is believed."""

from __future__ import annotations

from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from lmshealth.arrays import FloatArray
from lmshealth.influences import Influence
from lmshealth.plots import BLUE, GREEN, INK, MUTED, RED, bars, few, hints, legend, odometer
from lmshealth.results import Line
from lmshealth.tracks import History, Track
from lmshealth.waterfall import Waterfall
from lmshealth.wording import GAP, covariate, moment, signed, spell, whole_km

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_KM = 1000.0
# A band is shown on a logarithmic axis if its top is more than so many times its bottom.
_WIDE = 4.0
# A column of a waterfall reaches so many usual distances of logs to either side.
_MOST_ROOM = 0.75
_LINES = {"unknown": "other"}
# On an image; not of the palette, which turns where a page is dark.
_WHITE, _BLACK = "#ffffff", "#000000"


def plot_frequencies(ax: Axes, history: History, track: Track | None, mode: str) -> Axes:
    """Plot the natural frequency of a mode against the odometer.

    Each log's estimate with ± 2 standard deviations as it was measured; the filtered line with
    its 95 % band has the covariates at their reference. Without a track of this mode the line
    is left out.
    """
    for column in history.columns(mode):
        _logs(ax, history, column, history.ln_frequency[:, column], (1.0, "Hz"))
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
        _logs(
            ax, history, len(history.series) + column, history.ln_damping[:, column], (100.0, "%")
        )
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
    texts = [
        f"{title(track, k)}\nNIS {value:.1f}; expected {a:.1f} to {b:.1f}"
        for k, value, a, b in zip(np.flatnonzero(seen).tolist(), nis, low, high, strict=True)
    ]
    hints(ax, x, nis, texts)
    if not inside.all():
        ax.plot(x[~inside], nis[~inside], "D", color=RED, ms=5, label="outside")
    if nis.size and nis.max() > 4 * high.max():
        ax.set_yscale("log")
        ax.set_ylabel("NIS (log scale)")
    else:
        ax.set_ylim(bottom=0)
        ax.set_ylabel("NIS")
    return odometer(ax)


def plot_waterfall(
    ax: Axes,
    waterfall: Waterfall,
    history: History,
    track: Track | None = None,
    *,
    moved: FloatArray | None = None,
) -> Axes:
    """Plot the spectra of all logs side by side: odometer, frequency, level in dB as colour.

    The history has an odometer. The filtered frequencies of the modes stand above with their 95 %
    bands, and every line of a log at its place. Where no log stands for longer than usual there is
    a gap. ``moved`` is how far covariates have moved ln f, shape ``(n_logs, n_modes)``: with it the
    modes stand where the logs saw them, else at the covariates' reference.
    """
    sides = _columns(history.travel / _KM)
    x, level = sides.ravel(), np.full((waterfall.level.shape[1], 2 * len(sides) - 1), np.nan)
    level[:, ::2] = waterfall.level.T
    low, high = _shown_levels(waterfall)
    # As an image: thousands of rectangles would be a hundred times as many bytes.
    picture = ax.pcolormesh(
        x, waterfall.edges, level, cmap="cividis", vmin=low, vmax=high, rasterized=True
    )
    bar = ax.figure.colorbar(picture, ax=ax, extend="both", pad=0.02, aspect=30)
    bar.set_label("level in dB")
    bar.outline.set_visible(False)
    _column_hints(ax, sides, waterfall, history)
    _waterfall_lines(ax, waterfall, history)
    if track is not None:
        for k in range(len(track.modes)):
            _on_image(ax, track, k, 0.0 if moved is None else moved[:, k])
    ax.grid(visible=False)
    ax.set_ylim(waterfall.edges[0], waterfall.edges[-1])
    if waterfall.edges[-1] > _WIDE * waterfall.edges[0]:
        ax.set_yscale("log")
    ax.set_ylabel("frequency in Hz")
    return odometer(ax, room=54)  # the bar of colours takes the rest


def plot_influence(ax: Axes, influence: Influence, history: History) -> Axes:
    """Plot what a covariate does to the frequency of a mode, before and after it is taken out.

    Changes are in % of the frequency at the covariate's reference, without wear and whatever else
    is known to move the mode. Of the line a 95 % band is shown where the effect is a straight one.
    """
    x, before, after = influence.values, 100 * influence.measured, 100 * influence.corrected
    grid = np.linspace(float(x.min()), float(x.max()), 60)
    line, std = 100 * influence.explained(grid), influence.explained_std(grid)
    if std is not None:
        reach = 196 * std
        ax.fill_between(grid, line - reach, line + reach, color=BLUE, alpha=0.18, lw=0)
    ax.plot(grid, line, color=BLUE, lw=1.6, label="taken out")
    ax.plot(x, before, "o", mfc="none", mec=MUTED, ms=4.5, mew=1.0, label="as measured")
    ax.plot(x, after, "o", color=INK, ms=2.8, label="corrected")
    name, unit = covariate(influence.covariate)
    texts = [
        f"{title(history, k)}\n{name} {value:.4g}{GAP}{unit}\n"
        f"as measured {signed(a, 2)}{GAP}%, corrected {signed(b, 2)}{GAP}%"
        for k, value, a, b in zip(influence.epochs.tolist(), x, before, after, strict=True)
    ]
    hints(ax, x, before, texts)
    ax.set_xlabel(f"{name} in {unit}".replace("$", r"\$") if unit else name.replace("$", r"\$"))
    ax.set_ylabel("change of frequency in %")
    return legend(ax)


def chi_square_band(dof: FloatArray) -> FloatArray:
    """Bounds that hold a chi-square variable with 95 %, shape ``(2, ...)``."""
    from scipy.special import gammaincinv

    return np.stack([2 * gammaincinv(dof / 2, level) for level in (0.025, 0.975)])


def _logs(
    ax: Axes, history: History, row: int, level: FloatArray, unit: tuple[float, str]
) -> float:
    """Draw logarithmic estimates with ± 2 standard deviations; return the top of the bars.

    ``unit`` holds how many of it are one, and its name.
    """
    std = np.sqrt(history.cov[:, row, row])
    seen = np.flatnonzero(np.isfinite(level) & np.isfinite(std))
    per, name = unit
    bounds = per * np.exp(level[seen] + np.array([-2, 0, 2])[:, None] * std[seen])
    bars(ax, history.travel[seen], bounds, "each log, ±2σ", 3)
    texts = [
        f"{title(history, k)}\n{value:.2f} ± {value * std[k]:.2f}{GAP}{name}"
        for k, value in zip(seen.tolist(), bounds[1], strict=True)
    ]
    hints(ax, history.travel[seen] / _KM, bounds[1], texts)
    return float(np.max(bounds[2], initial=0.0))


def title(lives: History | Track, k: int) -> str:
    """Say which log it is, for hints: its name, moment and odometer."""
    return f"{lives.logs[k]}\n{moment(lives.recorded_at[k])}, {whole_km(lives.travel[k])}"


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


def _columns(x: FloatArray) -> FloatArray:
    """Give each log the room to its neighbours, but not much more than usual, ``(n_logs, 2)``."""
    gaps = np.diff(x)
    usual = float(np.median(gaps[gaps > 0])) if (gaps > 0).any() else 1.0
    # A log beside another at the same place still is a stroke.
    half = np.clip(gaps / 2, 0.1 * usual, _MOST_ROOM * usual)
    return np.stack([x - np.append(usual / 2, half), x + np.append(half, usual / 2)], axis=1)


def _shown_levels(waterfall: Waterfall) -> tuple[float, float]:
    """Choose the ends of the colours in dB: what lines do not reach decides, in steps of 5 dB."""
    free = waterfall.level.copy()
    for row, lines in zip(free, waterfall.lines, strict=True):
        for line in lines:
            at = int(np.searchsorted(waterfall.edges, line.frequency))
            row[max(at - 3, 0) : at + 2] = np.nan
    low, high = np.nanquantile(free, [0.02, 0.998])
    return 5 * float(np.floor(low / 5)), 5 * float(np.ceil(high / 5))


def _column_hints(ax: Axes, sides: FloatArray, waterfall: Waterfall, history: History) -> None:
    """Let each column tell its log, and where it has the modes."""
    from matplotlib.collections import PolyCollection

    low, high = waterfall.edges[[0, -1]]
    some = few(len(sides))
    corners = [[(a, low), (a, high), (b, high), (b, low)] for a, b in sides[some]]
    columns = PolyCollection(corners, facecolor=INK, alpha=1 / 255, lw=0)
    texts = [title(history, k) + _found(history, k) for k in range(len(sides))]
    columns.set_urls(texts[some])
    ax.add_collection(columns)


def _found(history: History, k: int) -> str:
    """List the frequencies that a log gave, a line each."""
    return "".join(
        f"\n{spell(one.mode)} {np.exp(ln_f):.2f}{GAP}Hz"
        for one, ln_f in zip(history.series, history.ln_frequency[k], strict=True)
        if np.isfinite(ln_f)
    )


def _waterfall_lines(ax: Axes, waterfall: Waterfall, history: History) -> None:
    """Mark the lines of every log; each kind has its own marker."""
    seen: dict[str, list[tuple[float, Line, int]]] = {}
    for k, (x, lines) in enumerate(zip(history.travel / _KM, waterfall.lines, strict=True)):
        for line in lines:
            seen.setdefault(line.kind, []).append((x, line, k))
    for marker, (kind, own) in zip(cycle("_x+1|"), sorted(seen.items()), strict=False):
        x = np.array([place for place, _, _ in own])
        y = np.array([line.frequency for _, line, _ in own])
        name = f"{_LINES.get(kind, spell(kind))} line".replace("$", r"\$")
        ax.plot(x, y, marker, color=RED, ms=3.5, mew=1.0, path_effects=_halo(2.0), label=name)
        texts = [
            f"{title(history, k)}\n{_LINES.get(kind, spell(kind))} line at "
            f"{line.frequency:.2f}{GAP}Hz, {line.amplitude:.2g}{GAP}{line.unit} in {line.channel}"
            for _, line, k in own
        ]
        hints(ax, x, y, texts)


def _on_image(ax: Axes, track: Track, k: int, moved: FloatArray | float) -> None:
    """Draw the filtered line of a mode and its 95 % band so that they show on every colour."""
    level, reach = track.ln_frequency[:, k] + moved, 1.96 * track.ln_frequency_std[:, k]
    x = track.travel / _KM
    name = None if k else "tracked modes, 95 % band"
    ax.fill_between(x, np.exp(level - reach), np.exp(level + reach), fc=_WHITE, alpha=0.4, lw=0)
    ax.plot(x, np.exp(level), color=_WHITE, lw=0.7, path_effects=_halo(1.5), label=name)
    if np.isfinite(level).any():
        first = int(np.argmax(np.isfinite(level)))
        style: Any = {"color": _WHITE, "size": 8, "clip_on": True, "path_effects": _halo(1.8)}
        name = spell(track.modes[k]).replace("$", r"\$")
        place = (x[first], np.exp(level[first]))
        ax.annotate(name, place, xytext=(2, 3), textcoords="offset points", **style)


def _halo(width: float) -> list[Any]:
    from matplotlib.patheffects import withStroke

    return [withStroke(linewidth=width, foreground=_BLACK)]


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
