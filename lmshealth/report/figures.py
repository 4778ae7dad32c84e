"""Figures of tracks, health and remaining life.

Every function takes matplotlib Axes, then results, and returns the Axes. Travel is shown in km,
health in % of baseline. Colours are from the palette of Okabe and Ito; no information is in the
colour alone. `svg` converts a figure to an inline SVG, in which `hints` show values under the
pointer.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Sequence
from itertools import cycle, pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from lmshealth._private.arrays import FloatArray
from lmshealth._private.result import Result
from lmshealth.errors import BadQuestion
from lmshealth.io.log import SI_UNITS, Log
from lmshealth.life.health import Health
from lmshealth.life.prognosis import Prognosis
from lmshealth.machine.constants import LEVELS
from lmshealth.machine.service import Service
from lmshealth.machine.status import chi_square_band
from lmshealth.machine.summary import quantiles
from lmshealth.modal.modes import Modes
from lmshealth.modal.spectra_summary import Waterfall
from lmshealth.report import constants, text
from lmshealth.report.language import decimal, mark, tr
from lmshealth.report.text import GAP, spell
from lmshealth.tracking.history import History
from lmshealth.tracking.track import CovariateEffect, Track

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, MUTED, GRID, PAPER = "#1f2933", "#5f6b7a", "#d9dee5", "#fefefe"
BLUE, RED, GREEN = "#0072b2", "#c44e00", "#007a5a"
_NAMED = {INK: "ink", MUTED: "muted", GRID: "line", PAPER: "card"}
_NAMED |= {BLUE: "blue", RED: "red", GREEN: "green"}
_STYLE: dict[str, Any] = {
    "font.sans-serif": ["DejaVu Sans"],  # comes with matplotlib: the same layout everywhere
    "font.size": 10,
    "text.usetex": False,
    "axes.edgecolor": MUTED,
    "axes.facecolor": "none",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "hatch.linewidth": 0.6,
    "legend.fontsize": 10,
    "legend.frameon": False,
    "svg.fonttype": "none",
    **dict.fromkeys(("xtick.color", "ytick.color"), MUTED),
    **dict.fromkeys(("axes.labelcolor", "legend.labelcolor", "text.color"), INK),
    **dict.fromkeys(("xtick.labelcolor", "ytick.labelcolor"), INK),
}
_DASHED: Any = (0, (5, 3))  # of baselines
_KM = 1000.0
_DPI = 200  # of images in a figure: enough for zooming and printing
_LEVELS = np.array(constants.BAND_LEVELS)  # the third is the median
# Of a baseline: up to it health is drawn; a median beyond it is no share of a baseline.
_MOST_SHARE = 2.5
_GRID_POINTS = 72
_SEGMENT = 8192  # samples in a segment of a quick spectrum
SIZE = (4.5, 2.8)  # of a figure in inches: its text is readable on a phone
ROOM = 46  # characters that fit on a line of its legend


def svg(draw: Callable[[Axes], object], *, salt: str, size: tuple[float, float] = SIZE) -> str:
    """Draw a figure as an inline SVG element, of a size in inches.

    The bytes are reproducible. Colours follow the style sheet of the page (``--ink``, ``--blue``,
    ...). Screen readers skip the figure, because the page contains its information as text. All
    identifiers start with ``salt`` (letters, digits, dashes), which is unique on the page.
    """
    return inline(lambda figure: draw(figure.add_subplot()), salt=salt, size=size)


def inline(draw: Callable[[Figure], object], *, salt: str, size: tuple[float, float]) -> str:
    """Draw a whole figure as `svg` draws one with a single plot."""
    text = print_figure(draw, size, salt=salt).decode()
    text = _LINK.sub(r'<g class="hint" fill-opacity="0.004"><title>\1</title>', text)
    text = text.replace("</a>", "</g>").replace(_CLEAR, "")
    text = _compact(text[text.index("<svg") :])
    # Groups have the same identifiers in every figure: make them unique.
    text = re.sub(r'(\sid="|href="#|url\(#)', rf"\g<1>{salt}-", text)
    for colour, name in _NAMED.items():
        text = text.replace(colour, f"var(--{name}, {colour})")
    return text.replace("<svg ", '<svg aria-hidden="true" focusable="false" ', 1)


def _compact(text: str) -> str:
    """Remove invisible content of an SVG by matplotlib: a third of its text."""
    text = re.sub(r"(?s)<!--.*?-->|<metadata>.*?</metadata>", "", text)
    text = re.sub(r"\n\s*", "\n", text).strip().replace("xlink:href", "href")
    # Two decimals of a point are finer than screens and printers.
    places = r'\s[dxy]="[^"]*"|translate\([^)]*\)'
    text = re.sub(places, lambda m: re.sub(r"(\.\d\d)\d+", r"\1", m[0]), text)
    text = re.sub(r'(?<=\sd=")[^"]*', lambda m: re.sub(r"\s*([A-Za-z])\s*", r"\1", m[0]), text)
    text = re.sub(r'style="[^"]*"', lambda m: re.sub(r"([:;,]) ", r"\1", m[0]), text)
    # Successive equal markers share their style.
    runs = r'(?:<use [^>]*? (style="[^"]*")/>\n)(?:<use [^>]*? \1/>\n)+'
    text = re.sub(runs, lambda m: f"<g {m[1]}>\n{m[0].replace(f' {m[1]}', '')}</g>\n", text)
    used = set(re.findall(r'(?:href="|url\()#([^")]+)', text))
    text = re.sub(r'\sid="([^"]*)"', lambda m: m[0] if m[1] in used else "", text)
    return re.sub(r"<g>\n(<(?:use|path) [^>]*/>)\n</g>", r"\1", text)


def print_figure(
    draw: Callable[[Figure], object],
    size: tuple[float, float],
    *,
    salt: str = "figure",
    kind: str = "svg",
    paper: str = "none",
) -> bytes:
    """Draw a figure of a size in inches as ``svg`` or ``png`` on a colour; reproducible."""
    import io

    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    target = io.BytesIO()
    style: Any = _STYLE | {"svg.hashsalt": salt}
    canvas_of: dict[str, Any] = {"svg": FigureCanvasSVG, "png": FigureCanvasAgg}
    left_out = {"svg": ("Date", "Creator", "Format", "Type"), "png": ("Software",)}
    with matplotlib.rc_context(), warnings.catch_warnings():
        # Settings of the process, or of its user, are not those of a page.
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(style)
        # The browser draws characters that the font lacks in another one.
        warnings.filterwarnings("ignore", message="Glyph .* missing")
        figure = Figure(figsize=size, dpi=_DPI, layout="constrained", facecolor=paper)
        draw(figure)
        _write_decimals(figure)
        # Directly, because `savefig` draws everything twice.
        canvas = canvas_of[kind](figure)
        figure.dpi = 72 if kind == "svg" else _DPI  # at which `print_svg` places texts
        _fix_layout(figure)
        figure.dpi = _DPI
        getattr(canvas, f"print_{kind}")(target, metadata=dict.fromkeys(left_out[kind]))
    return target.getvalue()


def _write_decimals(figure: Figure) -> None:
    """Write the numbers at the axes with the decimal mark of the language."""
    for axis in (own for ax in figure.axes for own in (ax.xaxis, ax.yaxis)):
        formatter: Any = axis.get_major_formatter()
        formatter.fix_minus = lambda text, fix=formatter.fix_minus: decimal(fix(text))


def _fix_layout(figure: Figure) -> None:
    """Lay out, and round all positions: the solver rounds differently each time."""
    engine: Any = figure.get_layout_engine()
    engine.execute(figure)
    figure.set_layout_engine("none")
    for part in figure.subfigs:
        part.bbox_relative.set_points(part.bbox_relative.get_points().round(6))
    for ax in figure.axes:
        x, y, width, height = (round(edge, 6) for edge in ax.get_position().bounds)
        ax.set_position((x, y, width, height))


# Hints are written as addresses of links: the only text per point that matplotlib supports.
_CLEAR = f' style="fill: {INK}; fill-opacity: 0.003922"'
_LINK = re.compile(r'<a xlink:href="([^"]*)"[^>]*>')


def hints(ax: Axes, x: FloatArray, y: FloatArray, texts: Sequence[str]) -> None:
    """Cover points, shape ``(n,)`` each, with discs whose texts browsers show under the pointer."""
    some = _thinned(len(texts))
    # Opacity 1/255: fully transparent elements do not react to the pointer.
    discs = ax.scatter(x[some], y[some], s=80, color=INK, alpha=1 / 255, lw=0, zorder=9)
    discs.set_urls(list(texts[some]))


def _thinned(n: int) -> slice:
    """Return a slice that selects at most `constants.POINTS` of n points, evenly, and the last."""
    step = -(-n // constants.POINTS) or 1
    return slice((n - 1) % step, None, step)


def plot_posterior(ax: Axes, health: Health, parameters: tuple[str, ...]) -> Axes:
    """Plot the joint posterior of health now.

    For two parameters: highest-density regions of 50 and 90 %, baseline, medians and marginal 90 %
    intervals (bars along the axes). For one parameter: its density.
    """
    columns = [health.parameters.index(name) for name in parameters]
    draws = 100 * health.samples[-1][:, columns]
    draws = draws[np.isfinite(draws).all(axis=1)]
    if len(columns) == 1:
        _density(ax, draws[:, 0])
    else:
        _regions(ax, draws)
        ax.set_ylabel(tr("{name} in % of baseline", name=_spell(parameters[1])))
    ax.set_xlabel(tr("{name} in % of baseline", name=_spell(parameters[0])))
    return legend(ax)


def plot_health(ax: Axes, health: Health, parameter: str, limit: float | None) -> Axes:
    """Plot the bands of a health parameter over travel; the limit is a fraction."""
    column = health.parameters.index(parameter)
    bands = 100 * health.quantile(_LEVELS)[:, :, column]
    informed = bool(health.publishable_parameters()[column])
    name = tr("health by all logs") if informed else tr("mostly prior, not measured")
    _bands(ax, health.travel / _KM, bands, name, informed=informed)
    if informed:  # else no values are published
        texts = []
        for when, travel, q in zip(health.recorded_at, health.travel, bands.T, strict=True):
            least, _, median, _, most = (text.fixed(one, 1) for one in q)
            own = f"{spell(parameter)} {median}{GAP}%, 90{GAP}%: {text.ends(least, most)}{GAP}%"
            texts.append(f"{text.moment(when)}, {text.whole_km(travel)}\n{own}")
        hints(ax, health.travel / _KM, bands[2], texts)
    _levels(ax, limit)
    # Show bands up to a share, baseline and limit.
    level = 100.0 if limit is None else 100 * limit
    values = 100.0, level, float(np.nanmin(bands[0])), float(np.nanmax(bands[4]))
    low, high = min(values), min(max(values), 100 * _MOST_SHARE)
    margin = 0.06 * (high - low)
    ax.set(ylim=(max(low - margin, 0.0), high + margin), ylabel=tr("% of baseline"))
    return odometer(ax)


def plot_life(ax: Axes, prognosis: Prognosis, parameter: str, *, baseline: float = 1.0) -> Axes:
    """Plot a parameter since the baseline and up to the horizon, by its laws.

    The bar on the limit is the 90 % interval of its first passage. `baseline` is the value of the
    parameter at 100 %.
    """
    column = prognosis.parameters.index(parameter)
    limit = float(prognosis.limits[column]) / baseline
    now, travel = prognosis.travel / _KM, prognosis.curve_travel / _KM
    bands = 100 * prognosis.curve_quantiles[:, :, column] / baseline
    _bands(ax, travel, bands, tr("law"), informed=True)
    _levels(ax, limit)
    ax.axvline(now, color=INK, lw=1.2, ls=":", label=tr("now"))
    end = now + prognosis.horizon / _KM
    ahead = np.array(quantiles(prognosis.censored()[:, column], LEVELS)) / _KM
    low, _, high = ahead
    if np.isfinite(low):
        _passage(ax, now, ahead, 100 * limit)
    right = min(end, now + max(1.3 * high, 0.25 * now)) if np.isfinite(high) else end
    if shown := right >= 0.55 * end:
        right = end
        ax.axvline(end, color=MUTED, lw=1.2, ls="-.", label=tr("horizon"))
    left = min(float(travel.min()), now)
    top = max(108.0, 1.04 * float(np.max(bands[4][travel <= right], initial=0.0)))
    ax.set_xlim(left - 0.01 * (right - left), right + 0.02 * (right - left))
    ax.set(ylim=(0, top), ylabel=tr("% of baseline"))
    odometer(ax)
    if not shown:
        label = tr("travel in km (horizon at {distance}, not shown)")
        ax.set_xlabel(label.format(distance=text.whole_km(_KM * end)))
    return ax


def chance_left(remaining: FloatArray, travel: FloatArray) -> FloatArray:
    """Return the probability in % of reaching no limit within each travel, ``(n,)``.

    ``remaining`` are draws of the remaining travel in the same unit, ``(n_draws,)``.
    """
    past = np.searchsorted(np.sort(remaining), travel, side="right")
    return np.asarray(100 * (1 - past / remaining.size))


def plot_survival(ax: Axes, prognosis: Prognosis, *, service: Service | None = None) -> Axes:
    """Plot the probability of not having reached a limit against the travel ahead.

    With a service, the risk on its day is drawn: the accepted risk, or that at least cost.
    """
    horizon = prognosis.horizon / _KM
    last = quantiles(prognosis.remaining[:, -1], (0.99,))[0] / _KM
    end = min(horizon, max(1.2 * last, horizon / 50)) if np.isfinite(last) else horizon
    ahead = np.linspace(0, end, 400)
    left = prognosis.remaining / _KM
    dashes = ["--", "-.", ":", (0, (7, 2, 1, 2, 1, 2))]
    several = len(prognosis.parameters) > 2
    for k, name in enumerate(prognosis.parameters[:-1] if several else ()):
        style: Any = {"color": MUTED, "lw": 1.2, "ls": dashes[k % len(dashes)]}
        ax.plot(ahead, chance_left(left[:, k], ahead), label=_spell(name), **style)
    first = _spell(prognosis.parameters[0])
    label = tr("no limit reached") if several else tr("{name} limit", name=first)
    ax.plot(ahead, chance_left(left[:, -1], ahead), color=BLUE, lw=2.2, label=label)
    some = np.linspace(0, end, 25)
    chance = chance_left(left[:, -1], some)
    texts = [
        tr("after {distance}: {share}", distance=text.whole_km(x), share=f"{y:.0f}{GAP}%")
        for x, y in zip(_KM * some, chance, strict=True)
    ]
    hints(ax, some, chance, texts)
    if service is not None and service.kept_risk is not None:
        label = tr("accepted risk {risk} %")
        label = tr("risk at least cost {risk} %") if service.cost_ratio else label
        label = label.format(risk=decimal(f"{100 * service.kept_risk:.3g}"))
        ax.axhline(100 * (1 - service.kept_risk), color=RED, lw=1.2, ls=(0, (5, 2)), label=label)
    grouped(ax)
    whole = tr("travel from now in km (ends at the horizon)")
    label = whole if end == horizon else tr("travel from now in km")
    ax.set(xlim=(0, end), ylim=(0, 103), xlabel=label, ylabel=tr("probability in %"))
    return legend(ax)


def _bands(ax: Axes, x: FloatArray, bands: FloatArray, name: str, *, informed: bool) -> None:
    """Draw median, 50 and 90 % bands; hatched and grey when mostly prior."""
    colour, line = (BLUE, "-") if informed else (MUTED, (0, (1, 2)))
    for low, alpha, label in ((0, 0.18, "90 %"), (1, 0.32, "50 %")):
        shown = label if informed else None
        ax.fill_between(x, bands[low], bands[4 - low], fc=colour, alpha=alpha, lw=0, label=shown)
    if not informed:
        ax.fill_between(x, bands[0], bands[4], fc="none", ec=colour, hatch="///", lw=0)
    marker = "o" if x.size < 3 else ""
    ax.plot(x, bands[2], color=colour, lw=1.8, ls=line, marker=marker, ms=4, label=name)


def _levels(ax: Axes, limit: float | None) -> None:
    """Draw baseline and limit."""
    ax.axhline(100, color=GREEN, lw=1.1, ls=_DASHED, label=tr("baseline"))
    if limit is not None:
        name = tr("limit {limit} %", limit=decimal(f"{100 * limit:.3g}"))
        ax.axhline(100 * limit, color=RED, lw=1.6, ls=(0, (8, 2)), label=name)


def _passage(ax: Axes, now: float, ahead: FloatArray, level: float) -> None:
    """Mark the first passage: 90 % interval as a bar on the limit, median as a point."""
    where = now + ahead
    right = where[2] if np.isfinite(where[2]) else 1e9  # beyond the figure
    ax.plot([where[0], right], [level, level], color=RED, lw=5, alpha=0.55, solid_capstyle="butt")
    if np.isfinite(where[1]):
        style: Any = {"color": RED, "mec": PAPER, "ms": 6, "zorder": 5}
        ax.plot(where[1], level, "D", label=tr("limit reached"), **style)
    names = tr("Early (5 %)"), tr("Median"), tr("Late (95 %)")
    for x, far, name in zip(where, ahead, names, strict=True):
        if np.isfinite(x):
            own = {"name": name, "ahead": text.km(_KM * far), "odometer": text.whole_km(_KM * x)}
            hint = tr("{name}: in {ahead}, at {odometer}", **own)
            passed = f"{name}: {tr('already passed')}"
            hints(ax, np.array([x]), np.array([level]), [hint if far > 0 else passed])


def _regions(ax: Axes, draws: FloatArray) -> None:
    """Draw highest-density regions of two columns, shape ``(n_draws, 2)``, smoothed."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    mean, cov = draws.mean(axis=0), np.cov(draws.T)
    root = np.linalg.cholesky(cov + 1e-12 * np.trace(cov) * np.eye(2))
    white = np.linalg.solve(root, (draws - mean).T).T
    reach = 1.15 * np.abs(white).max()
    edges = np.linspace(-reach, reach, _GRID_POINTS + 1)
    density = np.histogram2d(white[:, 0], white[:, 1], bins=(edges, edges))[0]
    width = 1.2 * draws.shape[0] ** (-1 / 6) / (edges[1] - edges[0])
    density = gaussian_filter(density, width)
    at = ((white + reach) / (edges[1] - edges[0]) - 0.5).T
    level90, level50 = np.quantile(map_coordinates(density, at, order=1), [0.1, 0.5])
    centre = (edges[:-1] + edges[1:]) / 2
    grid = np.stack(np.meshgrid(centre, centre, indexing="ij"), axis=-1) @ root.T + mean
    x, y = grid[..., 0], grid[..., 1]
    if level90 < level50 < density.max():
        steps = [level90, level50, density.max()]
        ax.contourf(x, y, density, steps[:1] + steps[2:], colors=[BLUE], alpha=0.2)
        ax.contourf(x, y, density, steps[1:], colors=[BLUE], alpha=0.35)
        ax.contour(x, y, density, steps[:2], colors=[BLUE], linewidths=1.2, linestyles=["--", "-"])
    ax.fill([], [], color=BLUE, alpha=0.55, label="50 %")
    ax.fill([], [], color=BLUE, alpha=0.2, label="90 %")
    middle = np.median(draws, axis=0)
    ax.plot(*middle, "o", color=INK, ms=5, label=tr("median"))
    ax.plot(100, 100, "*", color=GREEN, mec=PAPER, mew=0.5, ms=12, label=tr("baseline"), zorder=5)
    low, high = np.quantile(draws, [0.05, 0.95], axis=0)
    span = np.quantile(draws, [0.002, 0.998], axis=0)
    first, last = np.minimum(span[0], 100.0), np.maximum(span[1], 100.0)
    first, last = first - 0.16 * (last - first), last + 0.06 * (last - first)
    ax.set(xlim=(first[0], last[0]), ylim=(first[1], last[1]))
    across, up = ax.get_xaxis_transform(), ax.get_yaxis_transform()
    ax.plot([low[0], high[0]], [0.05] * 2, "|-", color=INK, lw=1.4, ms=8, transform=across)
    name = tr("marginal 90 %")
    ax.plot([0.04] * 2, [low[1], high[1]], "_-", color=INK, lw=1.4, ms=8, transform=up, label=name)


def plot_log(ax: Axes, log: Log, channel: str) -> Axes:
    """Plot the power spectral density of a channel, or of all accelerations, by Welch's method."""
    from scipy.signal import welch

    start, stop = max(log.pieces, key=lambda piece: piece[1] - piece[0])
    kind = next((one.kind for one in log.channels if one.name == channel), "acceleration")
    for one in log.channels:
        if one.name == channel or (not channel and one.kind == kind):
            segment = min(_SEGMENT, stop - start)
            f, density = welch(one.values[start:stop], log.sample_rate, nperseg=segment)
            ax.plot(f[1:], density[1:], lw=0.8, label=plain_label(one.name))
    ylabel = tr("PSD in ({unit})²/Hz", unit=SI_UNITS[kind])
    ax.set(yscale="log", xlabel=tr("frequency in Hz"), ylabel=ylabel)
    return legend(ax)


def plot_modes(ax: Axes, modes: Modes) -> Axes:
    """Plot damping ratios over natural frequencies, ± one standard deviation, with their names."""
    f, damping = modes.frequency, 100 * modes.damping_ratio
    style: Any = {"xerr": modes.frequency_std, "yerr": 100 * modes.damping_ratio_std, "fmt": "o"}
    ax.errorbar(f, damping, color=BLUE, ms=4, **style)
    for name, x, y in zip(modes.names, f, damping, strict=True):
        ax.annotate(_spell(name), (x, y), xytext=(4, 4), textcoords="offset points")
    labels = {"xlabel": tr("natural frequency in Hz"), "ylabel": tr("damping ratio in %")}
    ax.set(ylim=(0, None), **labels)
    return ax


def draw(result: Result, what: str = "", ax: Axes | None = None) -> Axes:
    """Plot a result, or a channel, mode or parameter of it, in Axes or a new figure of pyplot.

    Health is drawn in % of 1: that of parameters with a unit by `Health.relative_to`.
    """
    import matplotlib
    from matplotlib import pyplot

    names = _parts(result)
    if what and what not in names:
        raise BadQuestion(f"{result.title()}: nothing is called {what!r}; there are {names}")
    style: Any = _STYLE | {"axes.facecolor": PAPER}
    # The first figure starts the backend, whose settings must outlast those of this one.
    figure = ax.figure if ax else pyplot.figure(figsize=SIZE, layout="constrained")
    with matplotlib.rc_context(style):
        axes = ax or figure.add_subplot()
        match result:
            case Log():
                return plot_log(axes, result, what)
            case Modes():
                own = [k for k, name in enumerate(names) if what in ("", name)]
                return plot_modes(axes, result.select(own))
            case History():
                return plot_frequencies(axes, result, None, what or names[0])
            case Track():
                return plot_track(axes, result, what or names[0])
            case Health():
                what = what or names[0]
                return plot_health(axes, _expect_fraction(result, what), what, None)
            case Prognosis() if what not in ("", "any"):
                # Laws begin at the baseline of their parameter.
                begin = result.curve_quantiles[2, 0, names.index(what)]
                return plot_life(axes, result, what, baseline=float(begin))
            case Prognosis():
                return plot_survival(axes, result)
    raise TypeError(f"a {type(result).__name__} has no plot")


def _parts(result: Any) -> list[str]:
    """Return the names of the parts of a result that can be plotted."""
    if isinstance(result, Log):
        return [one.name for one in result.channels]
    kinds = "parameters", "modes", "names"
    return list(next((getattr(result, kind) for kind in kinds if hasattr(result, kind)), ()))


def _expect_fraction(health: Health, parameter: str) -> Health:
    """Refuse a parameter in the unit of its description, whose baseline health does not have."""
    median = float(health.latest(0.5)[health.parameters.index(parameter)])
    if median > _MOST_SHARE:
        raise BadQuestion(
            f"{health.title()}: a median of {median:.4g} is no fraction of a baseline; plot "
            "health.relative_to(baselines), with the baseline of each parameter of the description"
        )
    return health


def _density(ax: Axes, draws: FloatArray) -> None:
    """Draw the density of one column with its 50 and 90 % intervals."""
    from scipy.ndimage import gaussian_filter1d

    margin = 0.1 * float(np.ptp(draws)) + 1e-9
    counts, edges = np.histogram(draws, 280, (draws.min() - margin, draws.max() + margin))
    step = edges[1] - edges[0]
    width = max(1.06 * draws.std() * draws.size**-0.2 / step, 1.0)
    density = gaussian_filter1d(counts / (draws.size * step), width, mode="constant")
    x = (edges[:-1] + edges[1:]) / 2
    q = np.quantile(draws, _LEVELS)
    for low, high, alpha, name in ((q[0], q[4], 0.2, "90 %"), (q[1], q[3], 0.4, "50 %")):
        part = (x >= low) & (x <= high)
        ax.fill_between(x[part], density[part], color=BLUE, alpha=alpha, lw=0, label=name)
    ax.plot(x, density, color=BLUE, lw=1.6)
    ax.axvline(float(q[2]), color=INK, lw=1.4, label=tr("median"))
    ax.axvline(100, color=GREEN, lw=1.3, ls=_DASHED, label=tr("baseline"))
    ax.set(ylim=(0, 1.06 * density.max()), ylabel=tr("probability density per %"))


def along(lives: History | Track) -> FloatArray:
    """Return the odometer in km, or without one the days since the first log, ``(n_logs,)``."""
    if np.isfinite(lives.travel).all():
        return lives.travel / _KM
    seconds = [(moment - lives.recorded_at[0]).total_seconds() for moment in lives.recorded_at]
    return np.array(seconds) / 86400


def odometer(ax: Axes, lives: History | Track | None = None, *, room: int = ROOM) -> Axes:
    """Label the axis of the odometer, or of the days of ``lives`` without one; add the legend.

    Without ``lives`` it is that of the travel of a life, which may be counted by the time.
    """
    grouped(ax)
    label = tr("travel in km")
    if lives is not None:
        is_known = np.isfinite(lives.travel).all()
        label = tr("odometer in km") if is_known else tr("days since the first log")
    ax.set_xlabel(label)
    return legend(ax, room=room)


def grouped(ax: Axes) -> None:
    """Group the thousands at the horizontal axis, as the text of the page does."""
    ax.locator_params(axis="x", nbins=6)
    ax.xaxis.set_major_formatter(lambda value, _: decimal(f"{value:,g}".replace(",", GAP)))


def legend(ax: Axes, *, room: int = ROOM) -> Axes:
    """Add the legend above the axes, with at most ``room`` characters per line."""
    handles, labels = ax.get_legend_handles_labels()
    lengths = np.array([len(label) for label in labels])
    columns = max(min(4, len(labels)), 1)
    while columns > 1 and sum(p.max() + 6 for p in np.array_split(lengths, columns)) > room:
        columns -= 1
    place: Any = {"loc": "lower left", "bbox_to_anchor": (0, 1), "borderaxespad": 0.2}
    ax.legend(handles, labels, ncols=columns, columnspacing=1.2, handlelength=1.8, **place)
    return ax


def _spell(name: str) -> str:
    """Return a name for a label; a dollar sign would start a formula."""
    return plain_label(spell(name))


def plain_label(text: str) -> str:
    """Return a text for a figure in which a dollar sign starts no formula."""
    return text.replace("$", r"\$")


# Ratio of band limits above which the frequency axis is logarithmic.
_WIDE = 4.0
# Half width of a waterfall's column, at most, in median distances of logs.
_MOST_ROOM = 0.75
_WORDS = {
    "step": mark("sudden change"),
    "regreasing": mark("regreasing"),
    "servo": mark("servo retuned"),
    "sensor": mark("sensor changed"),
    "reset": mark("guide or mount serviced"),
}
# Height of the axes above which a label is below its line.
_TOP = 0.88
# On images; not from the palette, which changes on dark pages.
_WHITE, _BLACK = "#ffffff", "#000000"


def plot_frequencies(ax: Axes, history: History, track: Track | None, mode: str) -> Axes:
    """Plot the natural frequency of a mode against the odometer.

    Points are the estimates of the logs ± 2 standard deviations, as measured; the line is
    filtered, with its 95 % band, with the covariates at their reference (only with a track).
    """
    for column in history.columns(mode):
        _logs(ax, history, column, history.ln_frequency[:, column], (1.0, "Hz"))
    if track is not None and mode in track.modes:
        plot_track(ax, track, mode)
        _baselines(ax, history, track, track.modes.index(mode))
    # Show at least 1 % of the frequency, so that noise does not appear as a change.
    low, high = ax.get_ylim()
    middle = (low + high) / 2
    if high - low < 0.01 * middle:
        ax.set_ylim(0.995 * middle, 1.005 * middle)
    ax.set_ylabel(tr("natural frequency in Hz"))
    return odometer(ax, history)


def plot_track(ax: Axes, track: Track, mode: str) -> Axes:
    """Plot the filtered natural frequency of a mode with its 95 % band, and the steps."""
    k, x = track.modes.index(mode), along(track)
    _filtered(ax, x, track.ln_frequency[:, k], track.ln_frequency_std[:, k], 1.0)
    names = {kind: tr(words) for kind, words in _WORDS.items()}  # each in the legend once
    own = (step for step in track.steps if step.mode in ("", mode))
    for kind, first in dict.fromkeys((step.kind, step.first) for step in own):
        style: Any = {"color": RED, "ls": "-"} if kind == "step" else {"color": INK, "ls": ":"}
        ax.axvline(x[first], lw=1.0, label=names.pop(kind, None), zorder=1, **style)
    ax.set_ylabel(tr("natural frequency in Hz"))
    return odometer(ax, track)


def plot_damping(ax: Axes, history: History, track: Track | None, mode: str) -> Axes:
    """Plot the damping ratio of a mode against the odometer, as `plot_frequencies` does."""
    level, n = history.ln_damping, len(history.series)
    columns = history.columns(mode)
    top = max(_logs(ax, history, n + k, level[:, k], (100.0, "%")) for k in columns)
    if track is not None and mode in track.modes:
        k = track.modes.index(mode)
        _filtered(ax, along(track), track.ln_damping[:, k], track.ln_damping_std[:, k], 100.0)
    # Bars of uncertain logs may exceed the figure.
    if top > 0:
        ax.set_ylim(0, 1.08 * min(top, 300 * float(np.exp(np.nanmax(level[:, columns])))))
    ax.set_ylabel(tr("damping ratio in %"))
    return odometer(ax, history)


def plot_nis(ax: Axes, track: Track) -> Axes:
    """Plot the normalised innovation squared of each epoch with its 95 % chi-square band."""
    seen = np.flatnonzero((track.nis_dof > 0) & np.isfinite(track.nis))
    seen = seen[_thinned(seen.size)]
    x, nis = along(track)[seen], track.nis[seen]
    low, high = chi_square_band(track.nis_dof[seen])
    ax.fill_between(x, low, high, step="mid", color=BLUE, alpha=0.18, lw=0, label=tr("95 % band"))
    inside = (nis >= low) & (nis <= high)
    ax.plot(x[inside], nis[inside], "o", color=BLUE, ms=4, label=tr("inside"))
    texts, words = [], tr("NIS {value}; expected {low} to {high}")
    for k, *values in zip(seen.tolist(), nis, low, high, strict=True):
        value, least, most = (text.fixed(one, 1) for one in values)
        texts.append(f"{title(track, k)}\n{words.format(value=value, low=least, high=most)}")
    hints(ax, x, nis, texts)
    if not inside.all():
        ax.plot(x[~inside], nis[~inside], "D", color=RED, ms=5, label=tr("outside"))
    if nis.size and nis.max() > 4 * high.max():
        ax.set(yscale="log", ylabel=tr("NIS (log scale)"))
    else:
        ax.set(ylim=(0, None), ylabel="NIS")
    return odometer(ax, track)


def plot_waterfall(
    ax: Axes,
    waterfall: Waterfall,
    history: History,
    track: Track | None = None,
    *,
    moved: FloatArray | None = None,
) -> Axes:
    """Plot the spectra of all logs side by side: odometer, frequency, level in dB as colour.

    The history needs an odometer. Filtered frequencies with their 95 % bands and spectral lines are
    drawn on top. ``moved`` is the shift of ln f by the covariates, shape ``(n_logs, n_modes)``:
    with it the frequencies are those of the logs, else those at the covariates' reference.
    """
    sides = _columns(history.travel / _KM)
    x, level = sides.ravel(), np.full((waterfall.level.shape[1], 2 * len(sides) - 1), np.nan)
    level[:, ::2] = waterfall.level.T
    free = waterfall.level.copy()  # without spectral lines
    for row, lines in zip(free, waterfall.lines, strict=True):
        for at in np.searchsorted(waterfall.edges, [line.frequency for line in lines]):
            row[max(at - 3, 0) : at + 2] = np.nan
    low, high = np.nanquantile(free, [0.02, 0.998])
    # As an image: rectangles would need a hundred times the bytes.
    steps = {"vmin": 5 * float(np.floor(low / 5)), "vmax": 5 * float(np.ceil(high / 5))}
    colours: Any = {"cmap": "cividis", **steps}
    picture = ax.pcolormesh(x, waterfall.edges, level, rasterized=True, **colours)
    bar = ax.figure.colorbar(picture, ax=ax, extend="both", pad=0.02, aspect=30)
    bar.set_label(tr("level in dB"))
    bar.outline.set_visible(False)
    _column_hints(ax, sides, waterfall, history)
    _waterfall_lines(ax, waterfall, history)
    ax.grid(visible=False)
    ax.set_ylim(waterfall.edges[0], waterfall.edges[-1])
    if waterfall.edges[-1] > _WIDE * waterfall.edges[0]:
        ax.set_yscale("log")
    if track is not None:
        for k in range(len(track.modes)):
            _on_image(ax, track, k, 0.0 if moved is None else moved[:, k])
    ax.set_ylabel(tr("frequency in Hz"))
    return odometer(ax, history, room=36)  # next to the colour bar


def plot_influence(ax: Axes, influence: CovariateEffect, history: History) -> Axes:
    """Plot the effect of a covariate on the frequency of a mode, before and after correction.

    Changes are in % of the frequency at the covariate's reference, without wear and all other
    known effects. A linear effect has a 95 % band.
    """
    some = _thinned(influence.values.size)
    epochs, x = influence.epochs[some].tolist(), influence.values[some]
    before, after = 100 * influence.measured[some], 100 * influence.corrected[some]
    grid = np.linspace(float(x.min()), float(x.max()), 60)
    line, std = 100 * influence.explained(grid), influence.explained_std(grid)
    if std is not None:
        reach = 196 * std
        ax.fill_between(grid, line - reach, line + reach, color=BLUE, alpha=0.18, lw=0)
    ax.plot(grid, line, color=BLUE, lw=1.6, label=tr("effect"))
    ax.plot(x, before, "o", mfc="none", mec=MUTED, ms=4.5, mew=1.0, label=tr("as measured"))
    ax.plot(x, after, "o", color=INK, ms=2.8, label=tr("corrected"))
    name, unit = text.covariate(influence.covariate)
    texts, words = [], tr("as measured {before}, corrected {after}")
    for k, value, *both in zip(epochs, x, before, after, strict=True):
        measured, corrected = (f"{text.signed(one, 2)}{GAP}%" for one in both)
        there = f"{name} {decimal(f'{value:.4g}')}{GAP}{unit}"
        own = words.format(before=measured, after=corrected)
        texts.append(f"{title(history, k)}\n{there}\n{own}")
    hints(ax, x, before, texts)
    ax.set_xlabel(plain_label(tr("{name} in {unit}", name=name, unit=unit) if unit else name))
    ax.set_ylabel(tr("change of frequency in %"))
    return legend(ax, room=35)


def _logs(
    ax: Axes, history: History, row: int, level: FloatArray, unit: tuple[float, str]
) -> float:
    """Draw logarithmic estimates ± 2 std in a unit (factor, name); return the top of the bars."""
    std, (per, name) = np.sqrt(history.cov[:, row, row]), unit
    seen = np.flatnonzero(np.isfinite(level) & np.isfinite(std))
    seen = seen[_thinned(seen.size)]
    bounds = per * np.exp(level[seen] + np.array([-2, 0, 2])[:, None] * std[seen])
    x = along(history)[seen]
    style: Any = {"fmt": "o", "ms": 3, "color": MUTED, "elinewidth": 0.7, "alpha": 0.85}
    ax.errorbar(x, bounds[1], np.diff(bounds, axis=0), label=tr("each log, ±2σ"), **style)
    texts = [
        f"{title(history, k)}\n{text.fixed(value, 2)} ± {text.fixed(value * std[k], 2)}{GAP}{name}"
        for k, value in zip(seen.tolist(), bounds[1], strict=True)
    ]
    hints(ax, x, bounds[1], texts)
    return float(np.max(bounds[2], initial=0.0))


def title(lives: History | Track, k: int) -> str:
    """Return name, time and, where it is known, odometer of a log, for hints."""
    travel = lives.travel[k]
    place = f", {text.whole_km(travel)}" if np.isfinite(travel) else ""
    return f"{lives.logs[k]}\n{text.moment(lives.recorded_at[k])}{place}"


def _filtered(ax: Axes, x: FloatArray, level: FloatArray, std: FloatArray, unit: float) -> None:
    """Draw the filtered line with its 95 % band, above the logs."""
    x, level, std = (one[_thinned(one.size)] for one in (x, level, std))
    reach = 1.96 * std
    low, high = unit * np.exp(level - reach), unit * np.exp(level + reach)
    ax.fill_between(x, low, high, color=BLUE, alpha=0.25, lw=0, zorder=3)
    style: Any = {"color": BLUE, "lw": 1.8, "marker": "o" if x.size < 3 else "", "zorder": 4}
    ax.plot(x, unit * np.exp(level), label=tr("filtered, 95 % band"), **style)


def _baselines(ax: Axes, history: History, track: Track, column: int) -> None:
    """Draw the present estimate of each baseline over the logs that refer to it."""
    base = np.exp(track.ln_frequency[:, column] - track.drift[:, column])
    for first, end in pairwise([*history.baselines, len(history.logs)]):
        own = base[first:end][np.isfinite(base[first:end])]
        if own.size:
            x = along(track)[[first, end - 1]]
            name = None if first > history.baselines[0] else tr("baseline")
            ax.plot(x, [own[-1]] * 2, color=GREEN, lw=1.1, ls=_DASHED, label=name)


def _columns(x: FloatArray) -> FloatArray:
    """Return the sides of each log's column, shape ``(n_logs, 2)``; gaps stay open."""
    gaps = np.diff(x)
    usual = float(np.median(gaps[gaps > 0])) if (gaps > 0).any() else 1.0
    # Logs at the same odometer get a narrow column.
    half = np.clip(gaps / 2, 0.1 * usual, _MOST_ROOM * usual)
    return np.stack([x - np.append(usual / 2, half), x + np.append(half, usual / 2)], axis=1)


def _column_hints(ax: Axes, sides: FloatArray, waterfall: Waterfall, history: History) -> None:
    """Add a hint to each column: its log and the frequencies of its modes."""
    from matplotlib.collections import PolyCollection

    low, high = waterfall.edges[[0, -1]]
    some = _thinned(len(sides))
    corners = [[(a, low), (a, high), (b, high), (b, low)] for a, b in sides[some]]
    columns = PolyCollection(corners, facecolor=INK, alpha=1 / 255, lw=0)
    texts = []
    for k, ln_f in enumerate(history.ln_frequency):
        lines = [
            f"{spell(history.series[i].mode)} {text.fixed(np.exp(ln_f[i]), 2)}{GAP}Hz"
            for i in np.flatnonzero(np.isfinite(ln_f))
        ]
        texts.append("\n".join([title(history, k), *lines]))
    columns.set_urls(texts[some])
    ax.add_collection(columns)


def _waterfall_lines(ax: Axes, waterfall: Waterfall, history: History) -> None:
    """Mark the spectral lines of every log; each kind has its own marker."""
    logs = range(len(waterfall.lines))[_thinned(len(waterfall.lines))]
    seen = [(line, k) for k in logs for line in waterfall.lines[k]]
    kinds = sorted({line.kind for line, _ in seen})
    for marker, kind in zip(cycle("_x+1|"), kinds, strict=False):
        own = [(line, k) for line, k in seen if line.kind == kind]
        x = history.travel[[k for _, k in own]] / _KM
        y = np.array([line.frequency for line, _ in own])
        name = tr("other line") if kind == "unknown" else tr("{kind} line", kind=spell(kind))
        label = plain_label(name)
        ax.plot(x, y, marker, color=RED, ms=3.5, mew=1.0, path_effects=_halo(2.0), label=label)
        texts, words = [], tr("{name} at {frequency}, {amplitude} in {channel}")
        for line, k in own:
            at = f"{text.fixed(line.frequency, 2)}{GAP}Hz"
            size = f"{decimal(f'{line.amplitude:.2g}')}{GAP}{line.unit}"
            found = words.format(name=name, frequency=at, amplitude=size, channel=line.channel)
            texts.append(f"{title(history, k)}\n{found}")
        hints(ax, x, y, texts)


def _on_image(ax: Axes, track: Track, k: int, moved: FloatArray | float) -> None:
    """Draw the filtered line of a mode with its 95 % band, visible on every colour."""
    level, reach = track.ln_frequency[:, k] + moved, 1.96 * track.ln_frequency_std[:, k]
    x = track.travel / _KM
    name = None if k else tr("tracked modes, 95 % band")
    ax.fill_between(x, np.exp(level - reach), np.exp(level + reach), fc=_WHITE, alpha=0.4, lw=0)
    ax.plot(x, np.exp(level), color=_WHITE, lw=1.0, path_effects=_halo(2.6), label=name)
    if np.isfinite(level).any():
        first = int(np.argmax(np.isfinite(level)))
        style: Any = {"color": _WHITE, "size": 9.5, "path_effects": _halo(2.2)}
        place = (x[first], np.exp(level[first]))
        # Below the line where there is no room above it.
        share = ax.transAxes.inverted().transform(ax.transData.transform(place))[1]
        offset, side = ((3, -4), "top") if share > _TOP else ((3, 4), "bottom")
        name = _spell(track.modes[k])
        ax.annotate(name, place, xytext=offset, textcoords="offset points", va=side, **style)


def _halo(width: float) -> list[Any]:
    from matplotlib.patheffects import withStroke

    return [withStroke(linewidth=width, foreground=_BLACK)]
