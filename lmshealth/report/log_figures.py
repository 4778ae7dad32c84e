"""Figures of one log: spectra or a frequency response, with the modes that were found in it."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import cycle, product
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.special import gammaincinv

from lmshealth._private.arrays import FloatArray
from lmshealth._private.files import write_bytes, write_text
from lmshealth.io.log import SI_UNITS, Log, Refusal
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.modal.mode_shapes import ModeShapes, mode_shapes
from lmshealth.modal.modes import Modes
from lmshealth.modal.spectra_summary import WIDE, SpectraSummary, density, summarise
from lmshealth.report import figures, tables
from lmshealth.report.figures import BLUE, GREEN, GRID, INK, MUTED, RED, plain_label
from lmshealth.report.language import decimal, tr
from lmshealth.report.rendering import render
from lmshealth.report.text import spell
from lmshealth.signal.spectral_lines import expected_orders
from lmshealth.stage.description import ChannelSpec, Stage

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from lmshealth.modal.ambient.cluster_modes import FittedSpectrum
    from lmshealth.modal.ambient.search import Found
    from lmshealth.modal.deterministic.frequency_response import FrfReading
    from lmshealth.modal.deterministic.measured import MeasuredResponse
    from lmshealth.modal.identification import ModalReading

_WIDTH, _NOTE_COLUMNS = 8.0, 112
# Heights of a panel, of legend and labels, of upright labels and of a line of notes, in inches.
_PANEL, _FRAME, _LETTERS, _NOTE = 1.15, 1.75, 1.1, 0.16
_BINS, _SINGULAR = 480, 4  # of a spectrum, and singular values, at most
# Of the largest singular value; smaller ones are rounding where bins have too few ordinates.
_RANK = 1e-9
# Drawings of shapes in a row, their height in inches, the largest motion over the extent of the
# sensors, and the projection of x, y and z.
_DRAWN_BESIDE, _DRAWING, _MOVED = 4, 1.8, 0.25
# Height of a bar of a component, and of titles and legend of a row of them, in inches.
_BAR, _TITLE = 0.24, 1.0
_ISOMETRIC = np.array([[0.866, -0.5], [0.866, 0.5], [0.0, 1.0]])
# Distance of labels over the width of the axes: side by side, and upright from this many on.
_APART, _APART_UPRIGHT, _UPRIGHT = 0.2, 0.03, 6
_MARKERS = "v^sDPX*<>"


class LogFigure(NamedTuple):
    """Figure of a log: its title, size in inches, and what draws it."""

    title: str
    size: tuple[float, float]
    draw: Callable[[Figure], object]
    modes: Modes


def modes_figure(
    log: Log,
    reading: ModalReading,
    stage: Stage | None = None,
    *,
    band: tuple[float, float] | None = None,
) -> LogFigure:
    """Return a figure of the spectra of a log with its modes; ``band`` is that of `identify`."""
    modes = replace(reading.modes, refused=_join(reading.modes.refused, reading.rejected))
    low, high = band or _band(log, modes, stage)
    high = min(high, 0.49 * log.sample_rate)
    fitted = [_without_harmonics(fit, reading) for fit in reading.fitted]
    summary = summarise(reading.spectra, fitted, modes, (low, high), _BINS, n_singular=_SINGULAR)
    shapes = mode_shapes(modes, reading.fitted)
    width, height = spectra_size(summary, modes, reading.sought)
    below = shapes_size(shapes, stage)[1]

    def draw(figure: Figure) -> None:
        parts: Any = figure.subfigures(2, height_ratios=[height, below]) if below else [figure]
        plot_spectra(parts[0], summary, modes, stage, sought=reading.sought)
        if below:
            plot_shapes(parts[1], shapes, stage)

    return LogFigure(tr("Modes of {log}", log=log.name), (width, height + below), draw, modes)


def _without_harmonics(fit: FittedSpectrum, reading: ModalReading) -> FittedSpectrum:
    """Subtract what stands for harmonics that wander: the expectation of modes and floors."""
    density = fit.density
    for part in reading.sought:
        names = part.spectra.channels
        if len(names) == 1 or not set(fit.channels) <= set(names):
            continue  # in a single channel their bands are left out
        rows = [names.index(name) for name in fit.channels]
        for one in part.harmonics:
            there = one.expected(fit.spectrum.frequency)[:, rows, 0]
            density = density - (np.abs(there) / fit.unit) ** 2
    return replace(fit, density=density)


def shapes_size(shapes: ModeShapes, stage: Stage | None) -> tuple[float, float]:
    """Return the size of `plot_shapes` in inches; its height is 0 where nothing is drawn."""
    n_rows = -(-len(_shown(shapes)) // _DRAWN_BESIDE)
    bars = _TITLE + _BAR * len(shapes.channels)
    return _WIDTH, n_rows * (bars + bool(_places(shapes, stage)) * _DRAWING)


def plot_shapes(
    figure: Figure, shapes: ModeShapes, stage: Stage | None, before: ModeShapes | None = None
) -> Figure:
    """Plot the complex components of each mode per channel, beside those of an earlier log.

    Where the description places the sensors, the motion is drawn above.
    """
    places, shown = _places(shapes, stage), _shown(shapes)
    mac = np.full(len(shapes.names), np.nan) if before is None else shapes.mac_with(before)
    heights = [_DRAWING] * bool(places) + [_TITLE + _BAR * len(shapes.channels)]
    n_rows, n_columns = -(-len(shown) // _DRAWN_BESIDE), min(len(shown), _DRAWN_BESIDE)
    grid: Any = figure.subplots(
        n_rows * len(heights), n_columns, squeeze=False, height_ratios=heights * n_rows
    )
    for ax in grid.ravel():
        ax.set_axis_off()
    for k, i in enumerate(shown):
        row, column = divmod(k, n_columns)
        axes = grid[row * len(heights) : (row + 1) * len(heights), column]
        if places:
            plot_shape(axes[0], shapes, i, places)
        axes[-1].set_axis_on()
        _plot_components(axes[-1], shapes, i, before)
        own = {"MPC": float(shapes.complexity[i]), "MAC": float(mac[i])}
        values = (f"{name} {decimal(f'{one:.2f}')}" for name, one in own.items() if one == one)
        title = f"{spell(shapes.names[i])}\n{', '.join(values)}"
        axes[0].set_title(plain_label(title), size=9)
        axes[-1].tick_params(labelleft=column == 0)
    handles, labels = grid[len(heights) - 1, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower left", ncols=4)
    return figure


def _shown(shapes: ModeShapes) -> list[int]:
    """Return the modes with components in several channels."""
    return np.flatnonzero(np.isfinite(shapes.shapes).sum(axis=1) > 1).tolist()


def _places(shapes: ModeShapes, stage: Stage | None) -> list[ChannelSpec]:
    """Return the described places of the channels of shapes."""
    sensors = {one.name: one for one in stage.description.channel} if stage else {}
    return [sensors[name] for name in shapes.channels if name in sensors]


def _plot_components(ax: Axes, shapes: ModeShapes, i: int, before: ModeShapes | None) -> None:
    """Draw real and imaginary part of a mode per channel, the first channel on top."""
    y = np.arange(len(shapes.channels))
    part = shapes.shapes[i]
    style: Any = {"height": 0.62, "lw": 0}
    if before is not None and shapes.names[i] in before.names:
        row = before.shapes[before.names.index(shapes.names[i])]
        at = [before.channels.index(c) if c in before.channels else -1 for c in shapes.channels]
        own = np.array([row[k].real if k >= 0 else np.nan for k in at])
        # Shapes are known but for their sign.
        own = own * (np.sign(np.nansum(own * part.real)) or 1.0)
        ax.barh(y, own, color=MUTED, alpha=0.35, label=tr("at the baseline, real"), **style)
    style["height"] = 0.26
    ax.barh(y, part.real, color=BLUE, label=tr("in phase (real)"), **style)
    ax.plot(part.imag, y, "D", color=RED, ms=3.5, label=tr("90° shifted (imaginary)"))
    ax.axvline(0, color=MUTED, lw=0.8)
    ax.set_xlim(-1.1, 1.1)
    ax.set_xticks([-1, 0, 1])
    ax.set_yticks(y, [plain_label(name) for name in shapes.channels])
    ax.invert_yaxis()


def plot_shape(ax: Axes, shapes: ModeShapes, i: int, places: Sequence[ChannelSpec]) -> Axes:
    """Draw the shape of a mode in one extreme, in isometric projection, from sensors at places."""
    at: dict[tuple[float, float, float], FloatArray] = {}
    for one in places:
        part = shapes.shapes[i, shapes.channels.index(one.name)].real
        direction = np.array(one.direction) / np.linalg.norm(one.direction)
        moved = at.setdefault(one.position_m, np.zeros(3))
        at[one.position_m] = moved + (direction * part if np.isfinite(part) else 0.0)
    rest, moved = np.array([*at]), np.array([*at.values()])
    extent = float(np.ptp(rest, axis=0).max()) or 1.0
    largest = float(np.linalg.norm(moved, axis=1).max()) or 1.0
    moved = rest + _MOVED * extent / largest * moved
    start, end = rest @ _ISOMETRIC, moved @ _ISOMETRIC
    ground = np.c_[rest[:, :2], np.full(len(rest), rest[:, 2].min())] @ _ISOMETRIC
    for foot, point in zip(ground, start, strict=True):
        ax.plot(*np.c_[foot, point], color=GRID, lw=0.8)
    from scipy.sparse.csgraph import minimum_spanning_tree  # late, as matplotlib

    # Neighbours are joined: the shortest tree.
    apart = np.linalg.norm(rest[:, None] - rest, axis=2)
    for a, b in zip(*minimum_spanning_tree(apart).nonzero(), strict=True):
        ax.plot(*start[[a, b]].T, color=MUTED, lw=0.8, ls=":")
        ax.plot(*end[[a, b]].T, color=BLUE, lw=1)
    ax.plot(*start.T, "o", mfc="none", mec=MUTED, ms=5)
    style: Any = {"arrowstyle": "-|>", "color": BLUE, "shrinkA": 0, "shrinkB": 0}
    for point, tip in zip(start, end, strict=True):
        ax.annotate("", tip, point, arrowprops=style)
    # Axes of the positions, in the lower left corner.
    corner = np.vstack([ground, start, end]).min(axis=0) - 0.25 * extent
    for axis, name in zip(0.2 * extent * _ISOMETRIC, "xyz", strict=True):
        ax.plot(*np.c_[corner, corner + axis], color=MUTED, lw=0.8)
        u, v = corner + 1.3 * axis
        ax.text(u, v, name, color=MUTED, size=8, ha="center", va="center")
    ax.update_datalim(end)
    ax.margins(0.12)
    ax.set_aspect("equal", anchor="N")
    ax.set_axis_off()
    return ax


def spectra_size(
    summary: SpectraSummary, modes: Modes, sought: Sequence[Found] = ()
) -> tuple[float, float]:
    """Return the size of `plot_spectra` in inches."""
    return _size(len(summary.channels) + bool(len(summary.singular)) + bool(sought), modes)


def plot_spectra(
    figure: Figure,
    summary: SpectraSummary,
    modes: Modes,
    stage: Stage | None,
    *,
    before: LogEstimates | None = None,
    sought: Sequence[Found] = (),
) -> Figure:
    """Plot the spectrum of each channel with its fit, lines, modes and what was refused.

    The spectra and modes of an earlier log are drawn behind them.
    """
    middle = summary.centres
    n = len(summary.channels) + bool(len(summary.singular)) + bool(sought)
    panels = list(figure.subplots(n, sharex=True, squeeze=False)[:, 0])
    level, fitted, singular = map(density, (summary.level, summary.fitted, summary.singular))
    refused = {one.channel: one.reason for one in modes.refused if not one.mode}
    count = summary.count.astype(float)
    range_ = gammaincinv(count, [[0.025], [0.975]]) / count
    for ax, name, derived, own, fit in zip(
        panels, summary.channels, summary.derived, level, fitted, strict=False
    ):
        if before is not None and before.spectra is not None:
            _plot_before(ax, before.spectra, before.modes, name)
        ax.plot(middle, own, color=INK, lw=0.7, label=tr("measured"))
        ax.plot(middle, fit, color=GREEN, lw=1.4, label=tr("fit"))
        if np.isfinite(fit).any():
            words = tr("95 % range of the data, by the fit")
            ax.fill_between(middle, *(fit * range_), color=GREEN, alpha=0.2, lw=0, label=words)
        label = plain_label(name) + ("\n" + tr("(2nd derivative)") if derived else "")
        label += f"\n({tr(refused[name])})" if name in refused else ""
        _name_panel(ax, label)
        _mark_lines(ax, modes, name, middle, own)
    for k, values in enumerate(singular):
        shown = np.where(values > _RANK * singular[0], values, np.nan)
        width, colour = (0.6, MUTED) if k else (0.9, INK)
        panels[len(level)].plot(middle, shown, lw=width, color=colour)
    if singular.size:
        _name_panel(panels[len(level)], tr("singular values\nof all channels"))
    for ax in panels[: len(level) + bool(singular.size)]:
        ax.set_yscale("log")
        ax.margins(y=0.08)  # room for markers
    _mark_orders(panels[: len(level)], summary, stage)
    for part in sought:
        _plot_search(panels, part)
    if sought:
        _name_panel(panels[-1], tr("order of the\nsubspace model"))
    figure.supylabel(tr("acceleration PSD in (m/s²)²/Hz"), fontsize=10)
    _annotate(figure, panels, (summary.low, summary.high), modes, stage)
    return figure


def _plot_before(ax: Axes, summary: SpectraSummary, modes: Modes, channel: str) -> None:
    """Fill the area below the spectrum of a channel in an earlier log, and mark its modes."""
    if channel not in summary.channels:
        return
    own = density(summary.level[summary.channels.index(channel)])
    low, label = np.nanmin(own, initial=np.inf), tr("measured at the baseline")
    ax.fill_between(summary.centres, low, own, color=MUTED, alpha=0.3, lw=0, label=label)
    for f in modes.frequency.tolist():
        if summary.low <= f <= summary.high:
            ax.axvline(f, color=MUTED, lw=1, ls="-.", label=tr("mode at the baseline"))


def _name_panel(ax: Axes, name: str) -> None:
    ax.text(1.01, 0.5, name, transform=ax.transAxes, va="center", size=9)


def _plot_search(panels: Sequence[Axes], sought: Found) -> None:
    """Plot the poles of all orders of the subspace model in the last panel, and wandering lines."""
    poles, ax = sought.poles, panels[-1]
    for stable, style in ((False, {"mfc": "none", "mew": 0.4}), (True, {"mew": 0})):
        own = poles.stable == stable
        label = tr("stable pole of the search") if stable else tr("other pole of the search")
        place = poles.frequency[own], poles.order[own]
        ax.plot(*place, "o", ms=2.5, color=INK, label=label, **style)
    words = tr("band of a line that wanders")
    for line, panel in product(sought.harmonics, panels):
        panel.axvspan(line.low, line.high, color=RED, alpha=0.15, lw=0, label=words)


def _join(listed: Sequence[Refusal], rejected: Sequence[Refusal]) -> tuple[Refusal, ...]:
    """Append resonances that are not listed, ascending; name those without one by frequency."""
    new = [one for one in rejected if one not in listed and one.reason != "not-excited"]
    found = [replace(one, mode="") for one in new if one.frequency]
    found.sort(key=lambda one: one.frequency or 0.0)
    return tuple(
        replace(one, mode=f"{one.frequency:.4g} Hz") if one.frequency and not one.mode else one
        for one in (*listed, *found)
    )


def response_figure(
    log: Log | MeasuredResponse, reading: FrfReading, modes: Modes, stage: Stage | None = None
) -> LogFigure:
    """Return a figure of a frequency response with its fit, and the modes with their names."""
    frf, fit = reading.frf, reading.fit
    if isinstance(log, Log):
        kinds = {channel.name: channel.kind for channel in log.channels}
        unit = f"({SI_UNITS[kinds[frf.output]]})/{SI_UNITS[kinds[frf.input]]}"
    else:
        unit = log.unit or tr("unit of the file")

    def draw(figure: Figure) -> None:
        panels = list(figure.subplots(3, sharex=True, height_ratios=[2, 1.2, 0.8]))
        points: Any = {"color": MUTED, "ms": 2.5, "lw": 0}
        fitted: Any = {"color": GREEN, "lw": 1.4, "label": tr("fit")}
        x, gain = fit.ordinates.frequency, np.abs(frf.response)
        panels[0].plot(frf.frequency, gain, "o", label=tr("measured"), **points)
        panels[0].plot(x, np.abs(fit.response), **fitted)
        panels[0].set(yscale="log", ylabel=tr("gain in {unit}", unit=unit))
        _mark_lines(panels[0], modes, frf.output, frf.frequency, gain)
        panels[1].plot(frf.frequency, np.angle(frf.response, deg=True), "o", **points)
        phase = np.angle(fit.response, deg=True)
        phase[1:][np.abs(np.diff(phase)) > 180] = np.nan  # no line from -180 to 180
        panels[1].plot(x, phase, **fitted)
        panels[1].set(ylabel=tr("phase in °"), yticks=[-180, -90, 0, 90, 180])
        panels[2].plot(frf.frequency, frf.coherence, color=INK, lw=0.9)
        panels[2].set(ylabel=tr("coherence"), ylim=(0, 1.05))
        low, high = frf.frequency[[0, -1]].tolist()
        _annotate(figure, panels, (low, high), modes, stage)

    own = {"output": frf.output, "input": frf.input, "log": log.name}
    title = tr("Response of {output} to {input}, {log}", **own)
    return LogFigure(title, _size(4, modes), draw, modes)


def write_figure(path: Path, figure: LogFigure) -> None:
    """Write a figure as ``.svg``, ``.png`` or an HTML page with tables of modes and refusals."""
    if path.suffix == ".html":
        svg = figures.inline(figure.draw, salt="log", size=figure.size)
        rows = tables.to_rows(figure.modes.to_columns())
        page = render("log.html.j2", title=figure.title, modes=figure.modes, rows=rows, svg=svg)
        write_text(path, page)
        return
    notes = _notes(figure.modes)
    width, height = figure.size
    below = _NOTE * (len(notes) + 1) if notes else 0.0

    def draw(whole: Figure) -> None:
        parts: Any = whole.subfigures(2, height_ratios=[height, below or 1e-3])
        upper, lower = parts
        upper.suptitle(plain_label(figure.title), x=0.01, ha="left", size=10)
        figure.draw(upper)
        lower.text(0.01, 1, "\n".join(notes), va="top", size=7.5, linespacing=1.3)

    kind, size = path.suffix[1:], (width, height + below)
    write_bytes(path, figures.print_figure(draw, size, kind=kind, paper="#ffffff"))


def _size(n_panels: int, modes: Modes) -> tuple[float, float]:
    upright = len(modes.names) + len(modes.refused) >= _UPRIGHT
    return _WIDTH, _FRAME + _PANEL * n_panels + upright * _LETTERS


def _band(log: Log, modes: Modes, stage: Stage | None) -> tuple[float, float]:
    """Return the band of the searches, or of the resonances found, with a margin."""
    places = [(f, 0.3) for f in modes.frequency.tolist()]
    places += [(one.frequency, 0.3) for one in modes.refused if one.frequency]
    if stage is not None:
        places += [(mode.frequency_hz, mode.search) for mode in stage.modes]
    if not places:
        return 20 * log.sample_rate / max(b - a for a, b in log.pieces), 0.45 * log.sample_rate
    return min(f * (1 - share) for f, share in places), max(f * (1 + share) for f, share in places)


def _mark_lines(
    ax: Axes, modes: Modes, channel: str, frequency: FloatArray, level: FloatArray
) -> None:
    """Mark the spectral lines of a channel above its curve, each kind with its own marker."""
    low, high = frequency[[0, -1]]
    seen = [line for line in modes.lines if low <= line.frequency <= high]
    for marker, kind in zip(cycle(_MARKERS), sorted({line.kind for line in seen}), strict=False):
        own = [line for line in seen if (line.kind, line.channel) == (kind, channel)]
        x = np.array([line.frequency for line in own])
        y = 1.5 * np.interp(x, frequency, level)
        unknown = tr("line of unknown origin")
        name = unknown if kind == "unknown" else tr("line: {kind}", kind=spell(kind))
        label = plain_label(name)
        ax.plot(x, y, marker, color=RED, ms=4, mew=0, label=label)


def _mark_orders(panels: Sequence[Axes], summary: SpectraSummary, stage: Stage | None) -> None:
    """Mark where the described orders of the velocities of the log are, whether found or not."""
    band = summary.low, summary.high
    orders = expected_orders(stage, summary.velocities, band) if stage else ()
    for (f, name), ax in product(orders, panels):
        label = plain_label(tr("expected: {name}", name=spell(name)))
        place = ax.get_xaxis_transform()
        ax.plot(f, 0.05, "|", color=RED, ms=9, mew=1.4, transform=place, label=label)


def _annotate(
    figure: Figure,
    panels: Sequence[Axes],
    band: tuple[float, float],
    modes: Modes,
    stage: Stage | None,
) -> None:
    """Draw modes and refused candidates in all panels, their names, the legend and the notes."""
    labels, last = [], panels[-1]
    for k, f in enumerate(modes.frequency.tolist()):
        reach = 1.96 * float(np.sqrt(modes.cov[k, k]))
        low, high = f * np.exp(-reach), f * np.exp(reach)
        for ax in panels:
            ax.axvspan(low, high, color=BLUE, alpha=0.35, lw=0, label=tr("mode, 95 % interval"))
            ax.axvline(f, color=BLUE, lw=0.6)
        name = spell(modes.names[k] or tr("unnamed"))
        labels.append((f, f"{name}\n{_value(f, float(modes.frequency_std[k]))}", BLUE))
    sought = {mode.name: mode.frequency_hz for mode in stage.modes} if stage else {}
    style: Any = {"color": GREEN, "ms": 6, "mew": 0, "clip_on": False}
    for declared in sought.values():
        if band[0] <= declared <= band[1]:
            place, label = last.get_xaxis_transform(), tr("declared frequency")
            last.plot(declared, 0, "^", transform=place, label=label, **style)
    style = {"color": RED, "lw": 1, "ls": (0, (4, 3))}
    for refusal in modes.refused:
        refused = refusal.frequency or sought.get(refusal.mode)
        if refused is not None and band[0] <= refused <= band[1]:
            for ax in panels:
                ax.axvline(refused, label=tr("refused, or not found"), **style)
            labels.append((refused, f"{spell(refusal.mode)}\n{tr(refusal.reason)}", RED))
    last.set(xlabel=tr("frequency in Hz"), xlim=band)
    if band[1] > WIDE * band[0] > 0:
        from matplotlib.ticker import LogLocator

        subs = (1, 2, 5) if band[1] > 30 * band[0] else (1, 1.5, 2, 3, 4, 5, 7)
        last.set_xscale("log")
        last.xaxis.set_major_locator(LogLocator(subs=subs))
        last.xaxis.set_major_formatter("{x:g}")
        last.xaxis.minorticks_off()
    _write_labels(panels[0], [label for label in labels if band[0] <= label[0] <= band[1]])
    entries: dict[str, Any] = {}
    for ax in panels:
        entries |= zip(*reversed(ax.get_legend_handles_labels()), strict=True)
    figure.legend(list(entries.values()), list(entries), loc="outside lower left", ncols=3)


def _value(frequency: float, std: float) -> str:
    """Format a frequency to two digits of its standard deviation, one of a very small one."""
    digits = max(0, 1 - int(np.floor(np.log10(std))))
    digits -= digits > 3
    return decimal(f"{frequency:.{digits}f} ± {std:.{digits}f} Hz")


def _write_labels(ax: Axes, labels: list[tuple[float, str, str]]) -> None:
    """Write names above the axes, moved apart as little as needed."""
    if not labels:
        return
    labels = sorted(labels)
    upright = len(labels) >= _UPRIGHT
    steps = (_APART_UPRIGHT if upright else _APART) * np.arange(len(labels))
    bottom = ax.get_ylim()[0]
    points = ax.transData.transform([(f, bottom) for f, _, _ in labels])
    places = ax.transAxes.inverted().transform(points)[:, 0]
    from scipy.optimize import isotonic_regression  # late, as matplotlib

    moved = isotonic_regression(places - steps).x.clip(0, None) + steps
    style: Any = {"rotation": 90 if upright else 0, "ha": "center", "va": "bottom", "size": 9}
    across, ends = ax.get_xaxis_transform(), ("axes fraction", "offset points")
    for (f, text, colour), x in zip(labels, moved.tolist(), strict=True):
        text = plain_label(text.replace("\n", "  ") if upright else text)
        arrow = {"arrowstyle": "-", "color": colour, "lw": 0.7, "shrinkA": 0, "shrinkB": 0}
        ax.annotate(text, (f, 1), (x, 16), across, ends, color=colour, arrowprops=arrow, **style)


def _notes(modes: Modes) -> list[str]:
    """Return the refusals in lines that fit."""
    lines = []
    for refusal in modes.refused:
        what, why = spell(refusal.mode) or refusal.channel or tr("modes"), tr(refusal.reason)
        own = {"what": what, "reason": why, "detail": refusal.detail}
        text = plain_label(tr("{what} refused, {reason}: {detail}", **own))
        lines += textwrap.wrap(text, _NOTE_COLUMNS, subsequent_indent="    ")
    return lines
