"""Interactive page of one machine (Bokeh, extra ``interactive``): zoom, cursor, linked pictures.

It has the pictures of the static page that are read closely. The library is part of the page, which
loads nothing: its content security policy allows no request.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from functools import cache
from importlib import import_module
from itertools import combinations
from typing import Any

import numpy as np

from lmshealth._arrays import FloatArray
from lmshealth.errors import LmshealthError
from lmshealth.modal.spectra_summary import density
from lmshealth.report import constants
from lmshealth.report.assessment import Assessment, limit_of
from lmshealth.report.figures import BLUE, GREEN, INK, MUTED, RED, chance_left
from lmshealth.report.rendering import render
from lmshealth.report.text import moment, quantiles, spell
from lmshealth.tracking.history import LogEstimates


class InteractiveError(LmshealthError):
    """Interactive pages cannot be made; the static pages exist."""


try:
    embed: Any = import_module("bokeh.embed")
    models: Any = import_module("bokeh.models")
    plotting: Any = import_module("bokeh.plotting")
except ImportError as error:
    raise InteractiveError(
        'interactive pages need Bokeh: pip install "lmshealth[interactive]"; the pages are '
        "written, and `lmshealth report --interactive` makes them of what the store keeps"
    ) from error

_KM, _HEIGHT = 1000.0, 290  # of a picture in pixels
_TOOLS = "xpan,xwheel_zoom,box_zoom,undo,reset,save"
_SHOW = """for (const item of JSON.parse(document.getElementById("pictures").textContent)) {
  Bokeh.embed.embed_item(item);
}
"""


def interactive_page(assessment: Assessment, static: str) -> str:
    """Make the interactive page of a machine, which links to its static page."""
    sections = {
        "Spectra of the last log and of the baseline": [*_spectra(assessment)],
        "Modes and health over the odometer": [*_tracks(assessment)],
        "Posterior of the last epoch, and remaining life": [
            *_draws(assessment),
            *_survival(assessment),
        ],
    }
    shown = {title: plots for title, plots in sections.items() if plots}
    items = []
    for k, plots in enumerate(shown.values()):
        _link_cursor(plots)
        for plot in plots:
            _place_legend(plot)
        options: Any = {"ncols": 1, "merge_tools": True, "sizing_mode": "stretch_width"}
        items.append(embed.json_item(plotting.gridplot(plots, **options), f"section-{k}"))
    return render(
        "interactive.html.j2",
        identity=assessment.judgement.stage,
        recorded_at=assessment.judgement.recorded_at,
        static=static,
        titles=list(shown),
        pictures=json.dumps(items, allow_nan=True).replace("<", "\\u003c"),
        scripts=[_script(), _SHOW],
    )


@cache
def _script() -> str:
    """Return the JavaScript of Bokeh; it is read once for all pages."""
    from bokeh.resources import Resources

    parts = Resources(mode="inline", components=["bokeh"], log_level="warn").js_raw
    return "\n".join(parts).replace("</script", "<\\/script")


def _new(title: str, x: str, y: str, **options: Any) -> Any:
    """Return an empty picture; pictures of one ``x_range`` are linked."""
    plot = plotting.figure(
        title=title, x_axis_label=x, y_axis_label=y, height=_HEIGHT, tools=_TOOLS,
        active_drag="box_zoom", active_scroll=None, output_backend="canvas", **options,
    )  # fmt: skip
    plot.toolbar.logo = None
    return plot


def _link_cursor(plots: Sequence[Any]) -> None:
    """Add a vertical line under the pointer, the same in all pictures of one horizontal axis."""
    lines: dict[Any, Any] = {}
    for plot in plots:
        style = {"dimension": "height", "line_color": MUTED, "line_dash": "dotted"}
        line = lines.setdefault(plot.x_range, models.Span(**style))
        plot.add_tools(models.CrosshairTool(overlay=line))


def _hover(plot: Any, renderer: Any, *rows: tuple[str, str]) -> None:
    plot.add_tools(models.HoverTool(renderers=[renderer], tooltips=list(rows)))


def _place_legend(plot: Any) -> None:
    """Place the legend where it covers nothing; a click hides a curve."""
    if plot.legend:
        plot.legend.click_policy = "hide"
        plot.legend.ncols, plot.legend.border_line_color = 2, None  # fits on a phone
        plot.legend.label_text_font_size, plot.legend.padding = "9pt", 2
        plot.legend.location = "top_left"
        plot.add_layout(plot.legend[0], "below")


def _spectra(assessment: Assessment) -> Iterator[Any]:
    """Yield a picture per channel of the last log, over that of the baseline."""
    latest, before = assessment.latest, assessment.compared
    if latest is None or latest.spectra is None:
        return
    x_range = models.DataRange1d()
    declared = [mode.frequency_hz for mode in assessment.stage.modes]
    for channel, derived in zip(latest.spectra.channels, latest.spectra.derived, strict=True):
        name = f"{channel}, 2nd derivative" if derived else channel
        axes: Any = {"y_axis_type": "log", "x_range": x_range}
        plot = _new(name, "frequency in Hz", "(m/s²)²/Hz", **axes)
        if before is not None:
            _curve(plot, before, channel, MUTED, "baseline")
        _curve(plot, latest, channel, INK, "last log")
        _lines(plot, latest, channel)
        for k, f in enumerate(latest.modes.frequency.tolist()):
            reach = float(np.exp(1.96 * np.sqrt(latest.modes.cov[k, k])))
            band = {"fill_color": BLUE, "fill_alpha": 0.3, "line_color": None}
            plot.add_layout(models.BoxAnnotation(left=f / reach, right=f * reach, **band))
        for f in declared:
            if latest.spectra.low <= f <= latest.spectra.high:
                style = {"dimension": "height", "line_color": GREEN, "line_dash": "dashed"}
                plot.add_layout(models.Span(location=f, **style))
        yield plot


def _curve(plot: Any, found: LogEstimates, channel: str, colour: str, name: str) -> None:
    """Draw the spectrum of a channel of a log with its fit."""
    spectra = found.spectra
    if spectra is None or channel not in spectra.channels:
        return
    k, x = spectra.channels.index(channel), spectra.centres
    level, fitted = density(spectra.level[k]), density(spectra.fitted[k])
    source = models.ColumnDataSource({"x": x, "y": level, "log": [found.log] * len(x)})
    drawn = plot.line("x", "y", source=source, color=colour, legend_label=name)
    _hover(plot, drawn, (name, "@log"), ("at", "@x{0.00} Hz"), ("PSD", "@y{0.00e+0}"))
    style = {"color": GREEN, "line_dash": "solid" if colour == INK else "dashed"}
    plot.line(x, fitted, line_width=2, legend_label=f"fit, {name}", **style)


def _lines(plot: Any, found: LogEstimates, channel: str) -> None:
    """Mark the spectral lines of a channel, with their kind and amplitude."""
    spectra = found.spectra
    assert spectra is not None
    inside = [
        line
        for line in found.modes.lines
        if line.channel == channel and spectra.low <= line.frequency <= spectra.high
    ]
    if not inside:
        return
    level = spectra.level[spectra.channels.index(channel)].astype(float)
    at = [line.frequency for line in inside]
    source = {
        "x": at,
        "y": density(np.interp(at, spectra.centres, level)),
        "kind": [spell(line.kind) for line in inside],
        "amplitude": [f"{line.amplitude:.3g} {line.unit}" for line in inside],
    }
    columns = models.ColumnDataSource(source)
    style = {"color": RED, "size": 9, "marker": "inverted_triangle"}
    drawn = plot.scatter("x", "y", source=columns, legend_label="spectral line", **style)
    _hover(plot, drawn, ("line", "@kind, @x{0.00} Hz"), ("amplitude", "@amplitude"))


def _tracks(assessment: Assessment) -> Iterator[Any]:
    """Yield a picture of each tracked mode and of each health parameter over the odometer."""
    track, history, health = assessment.track, assessment.history, assessment.latest_health
    if track is None or not history.has_odometer:
        return
    x, x_range = "odometer in km", models.DataRange1d()
    for k, mode in enumerate(track.modes):
        plot = _new(f"Frequency of {spell(mode)}", x, "Hz", x_range=x_range)
        level, reach = track.ln_frequency[:, k], 1.96 * track.ln_frequency_std[:, k]
        bands = np.exp([level - reach, level, level + reach])
        _band(plot, track.travel, bands, "filtered, 95 % band")
        for column in history.columns(mode):
            value = np.exp(history.ln_frequency[:, column])
            std = value * np.sqrt(history.cov[:, column, column])
            source = _logs(assessment, value, std)
            drawn = plot.scatter("x", "y", source=source, color=INK, legend_label="each log, ±2σ")
            plot.segment("x", "low", "x", "high", source=source, color=MUTED)
            shown = "@y{0.00} ± @std{0.00} Hz"
            _hover(plot, drawn, ("log", "@log"), ("recorded", "@when"), ("mode", shown))
        at = np.isfinite(track.drift[:, k])
        if at.any():
            base = float(np.exp((track.ln_frequency[:, k] - track.drift[:, k])[at][-1]))
            _level(plot, track.travel, base, GREEN, "baseline")
        yield plot
    for k in np.flatnonzero(health.publishable_parameters()).tolist() if health else ():
        assert health is not None
        spec = assessment.stage.parameters[k]
        title = f"{spell(spec.name).capitalize()}, each epoch by itself"
        plot = _new(title, x, "% of baseline", x_range=x_range)
        bands = 100 * health.quantile(np.array(constants.LEVELS))[:, :, k]
        _band(plot, health.travel, bands, "median, 90 % band")
        if (limit := limit_of(spec)) is not None:
            _level(plot, health.travel, 100 * limit, RED, "limit")
        yield plot


def _level(plot: Any, travel: FloatArray, y: float, colour: str, name: str) -> None:
    """Draw a level over the travel of the logs; the vertical axis includes it."""
    ends = travel[[0, -1]] / _KM
    plot.line(ends, [y, y], color=colour, line_dash="dashed", legend_label=name)


def _logs(assessment: Assessment, value: FloatArray, std: FloatArray) -> Any:
    """Return estimates of logs with what the pointer shows of them."""
    history = assessment.history
    seen = np.flatnonzero(np.isfinite(value) & np.isfinite(std))
    return models.ColumnDataSource(
        {
            "x": history.travel[seen] / _KM,
            "y": value[seen],
            "std": std[seen],
            "low": (value - 2 * std)[seen],
            "high": (value + 2 * std)[seen],
            "log": [history.logs[i] for i in seen],
            "when": [moment(history.recorded_at[i]) for i in seen],
        }
    )


def _band(plot: Any, travel: FloatArray, bands: FloatArray, name: str) -> None:
    """Draw low, middle and high values, shape ``(3, n)``, over travel in m."""
    low, middle, high = bands
    columns = {"x": travel / _KM, "low": low, "y": middle, "high": high}
    source = models.ColumnDataSource(columns)
    style = {"fill_color": BLUE, "fill_alpha": 0.25, "legend_label": name}
    plot.varea("x", "low", "high", source=source, **style)
    drawn = plot.line("x", "y", source=source, color=BLUE, line_width=2, legend_label=name)
    shown = "@y{0.00} (@low{0.00} to @high{0.00})"
    _hover(plot, drawn, (name, shown), ("odometer", "@x{0} km"))


def _draws(assessment: Assessment) -> Iterator[Any]:
    """Yield a picture of the draws of each pair of parameters."""
    health = assessment.latest_health
    if health is None:
        return
    names, draws = health.parameters, 100 * health.samples[-1]
    some = draws[:: max(1, len(draws) // constants.DRAWS_SHOWN)]
    for i, j in combinations(range(len(names)), 2):
        labels = [f"{spell(names[k])} in % of baseline" for k in (i, j)]
        plot = _new("Draws of the posterior; +: baseline", *labels)
        drawn = plot.scatter(some[:, i], some[:, j], color=BLUE, alpha=0.35, size=4)
        rows = (spell(names[i]), "@x{0.0} %"), (spell(names[j]), "@y{0.0} %")
        _hover(plot, drawn, *rows)
        plot.scatter([100], [100], marker="cross", size=14, color=GREEN, line_width=3)
        yield plot


def _survival(assessment: Assessment) -> Iterator[Any]:
    prognosis = assessment.prognosis
    if prognosis is None:
        return
    labels = "travel from now in km", "probability in %"
    plot = _new("Probability of reaching no limit", *labels)
    last = 1.2 * quantiles(prognosis.remaining[:, -1], (0.99,))[0]
    end = min(prognosis.horizon, last) if last > 0 else prognosis.horizon
    ahead = np.linspace(0, end, 400)
    colours = dict.fromkeys(prognosis.parameters, MUTED) | {"any": BLUE}
    for k, name in enumerate(prognosis.parameters):
        chance = chance_left(prognosis.remaining[:, k], ahead)
        style = {"color": colours[name], "line_width": 3 if name == "any" else 1}
        drawn = plot.line(ahead / _KM, chance, legend_label=spell(name), **style)
        _hover(plot, drawn, (f"{spell(name)} limit", "@y{0.0} % after @x{0} km"))
    yield plot
