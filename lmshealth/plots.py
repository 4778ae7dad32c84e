"""Pictures of results: every function takes the matplotlib Axes to draw on, then results.

They return the Axes. Names of modes and parameters are those of the results; travel is shown in
km, health in % of baseline. Colours come from the palette of Okabe and Ito, and nothing is told
by colour alone. `svg` turns one of them into an inline picture, in which `hints` show values where
the pointer rests.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from lmshealth.arrays import FloatArray
from lmshealth.decision import Service
from lmshealth.results import Health, Prognosis
from lmshealth.svg import lean
from lmshealth.wording import GAP, km, moment, spell, whole_km

if TYPE_CHECKING:
    from matplotlib.axes import Axes

INK, MUTED, GRID, PAPER = "#1f2933", "#5f6b7a", "#d9dee5", "#fefefe"
BLUE, RED, GREEN = "#0072b2", "#c44e00", "#007a5a"
_NAMED = dict(
    zip(
        (INK, MUTED, GRID, PAPER, BLUE, RED, GREEN),
        ("ink", "muted", "line", "card", "blue", "red", "green"),
        strict=True,
    )
)
_STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib: the same outlines everywhere
    "font.size": 9,
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
    "legend.fontsize": 8,
    "legend.frameon": False,
    "svg.fonttype": "path",
    **dict.fromkeys(("xtick.color", "ytick.color"), MUTED),
    **dict.fromkeys(("axes.labelcolor", "legend.labelcolor", "text.color"), INK),
    **dict.fromkeys(("xtick.labelcolor", "ytick.labelcolor"), INK),
}
_KM = 1000.0
# Of what is drawn as an image; more than screens show, so that a page can be zoomed and printed.
_DPI = 200
# A picture carries no more hints than that: what is denser no pointer can tell apart.
_MOST_HINTS = 300
_LEVELS = np.array([0.05, 0.25, 0.5, 0.75, 0.95])
_GRID_POINTS = 72
SIZE = (4.8, 2.8)  # of a picture in inches
ROOM = 72  # characters that fit on a line of its legend


def svg(draw: Callable[[Axes], object], *, salt: str, size: tuple[float, float] = SIZE) -> str:
    """Draw one picture as an SVG element for the inside of a page.

    The same input gives the same bytes. Colours follow the style sheet of the page (``--ink``,
    ``--blue``, ...) where it has one; prolog, comments and metadata are left out, and screen
    readers skip the picture, because the page carries its text.

    Parameters
    ----------
    draw : callable
        Takes the Axes and draws on it.
    salt : str
        Prefix of all identifiers, of letters, digits and dashes; one for each picture of a page.
    size : (float, float)
        Width and height in inches.
    """
    import io

    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    target = io.StringIO()
    nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    style: Any = _STYLE | {"svg.hashsalt": salt}
    with matplotlib.rc_context(style), warnings.catch_warnings():
        # A name in a script the font lacks is drawn as boxes; the page itself spells it out.
        warnings.filterwarnings("ignore", message="Glyph .* missing")
        figure = Figure(figsize=size, dpi=_DPI, layout="constrained", facecolor="none")
        draw(figure.add_subplot())
        # By itself, because `savefig` goes through everything once more before.
        canvas: Any = FigureCanvasSVG(figure)
        canvas.print_svg(target, metadata=nothing)
    text = _LINK.sub(r'<g class="hint" fill-opacity="0.004"><title>\1</title>', target.getvalue())
    text = text.replace("</a>", "</g>").replace(_CLEAR, "")
    text = lean(text[text.index("<svg") :])
    # Glyphs and groups carry the same identifiers in every file: give each picture its own.
    text = re.sub(r'(\sid="|href="#|url\(#)', rf"\g<1>{salt}-", text)
    for colour, name in _NAMED.items():
        text = text.replace(colour, f"var(--{name}, {colour})")
    return text.replace("<svg ", '<svg aria-hidden="true" focusable="false" ', 1)


# Hints travel as the addresses of links, the only text that matplotlib gives each of many artists.
_CLEAR = f' style="fill: {INK}; fill-opacity: 0.003922"'
_LINK = re.compile(r'<a xlink:href="([^"]*)"[^>]*>')


def hints(ax: Axes, x: FloatArray, y: FloatArray, texts: Sequence[str]) -> None:
    """Lay invisible discs over points, which `svg` turns into titles shown by browsers.

    Parameters
    ----------
    ax : Axes
        In its data coordinates.
    x, y : ndarray
        Shape ``(n,)``.
    texts : sequence of str
        What is shown at each point; line breaks are kept.
    """
    some = few(len(texts))
    # Opaque by one part in 255: what is not drawn at all feels no pointer.
    discs = ax.scatter(x[some], y[some], s=80, color=INK, alpha=1 / 255, lw=0, zorder=9)
    discs.set_urls(list(texts[some]))


def few(n: int) -> slice:
    """Choose as many of n things, evenly, as may have hints."""
    return slice(None, None, -(-n // _MOST_HINTS) or 1)


def plot_posterior(ax: Axes, health: Health, parameters: tuple[str, ...]) -> Axes:
    """Plot the joint posterior of the last epoch.

    Two parameters give the highest-density regions that hold 50 and 90 % of the draws, the
    baseline, the medians and the marginal 90 % intervals (bars along the axes); one parameter
    gives its density.

    Raises
    ------
    ValueError
        If the number of parameters is neither one nor two.
    """
    if len(parameters) not in (1, 2):
        raise ValueError(
            f"a posterior of {len(parameters)} parameters cannot be drawn, only 1 or 2"
        )
    columns = [health.parameters.index(name) for name in parameters]
    draws = 100 * health.samples[-1][:, columns]
    draws = draws[np.isfinite(draws).all(axis=1)]
    if len(columns) == 1:
        _density(ax, draws[:, 0])
    else:
        _regions(ax, draws)
        ax.set_ylabel(f"{_spell(parameters[1])} in % of baseline")
    ax.set_xlabel(f"{_spell(parameters[0])} in % of baseline")
    return legend(ax)


def plot_health(ax: Axes, health: Health, parameter: str, limit: float | None) -> Axes:
    """Plot median, 50 and 90 % bands of a health parameter against the odometer.

    The limit is a fraction of baseline.
    """
    column = health.parameters.index(parameter)
    bands = 100 * health.quantile(_LEVELS)[:, :, column]
    told = _tells(health, parameter)
    name = "each epoch by itself" if told else "mostly assumption, not measured"
    _bands(ax, health.travel / _KM, bands, name, told=told)
    if told:  # what is not told has no values to show
        texts = [
            f"{moment(when)}, {whole_km(travel)}\n{spell(parameter)} {q[2]:.1f}{GAP}%, "
            f"90{GAP}%: {q[0]:.1f} to {q[4]:.1f}{GAP}%"
            for when, travel, q in zip(health.recorded_at, health.travel, bands.T, strict=True)
        ]
        hints(ax, health.travel / _KM, bands[2], texts)
    failed = ~health.converged
    if failed.any():
        where = health.travel[failed] / _KM
        ax.plot(where, bands[2, failed], "x", color=RED, ms=6, label="sampler not converged")
    _levels(ax, limit)
    _room(ax, bands, limit)
    ax.set_ylabel("% of baseline")
    return odometer(ax)


def plot_life(
    ax: Axes, prognosis: Prognosis, parameter: str, *, health: Health | None = None
) -> Axes:
    """Plot the degradation law of a parameter through now and into the future.

    With `health`, its epochs stand beside the law, as 90 % intervals that know nothing of it,
    unless they are mostly assumption. The bar on the limit holds 90 % of the moments at which it
    is reached.
    """
    column = prognosis.parameters.index(parameter)
    limit = float(prognosis.limits[column])
    now, travel = prognosis.travel / _KM, prognosis.curve_travel / _KM
    bands = 100 * prognosis.curve_quantiles[:, :, column]
    _bands(ax, travel, bands, "law", told=True)
    top = 108.0
    if health is not None and _tells(health, parameter):
        top = max(top, 1.04 * _epochs(ax, health, parameter))
    _levels(ax, limit)
    ax.axvline(now, color=INK, lw=1.2, ls=":", label="now")
    end = now + prognosis.horizon / _KM
    low, middle, high = _quantiles(prognosis.remaining[:, column], (0.05, 0.5, 0.95)) / _KM
    if np.isfinite(low) and low < prognosis.horizon / _KM:
        _passage(ax, now, np.array([low, middle, high]), 100 * limit)
    right = min(end, now + max(1.3 * high, 0.25 * now)) if np.isfinite(high) else end
    shown = right >= 0.55 * end
    if shown:
        right = end
        ax.axvline(end, color=MUTED, lw=1.2, ls="-.", label="horizon")
    left = min(float(travel.min()), now)
    if health is not None:
        left = min(left, float(health.travel.min()) / _KM)
    ax.set_xlim(left - 0.01 * (right - left), right + 0.02 * (right - left))
    ax.set_ylim(0, max(top, 1.04 * float(np.max(bands[4][travel <= right], initial=0.0))))
    ax.set_ylabel("% of baseline")
    odometer(ax)
    if not shown:
        ax.set_xlabel(f"odometer in km (horizon at {end:.0f} km, not shown)")
    return ax


def plot_survival(ax: Axes, prognosis: Prognosis, *, service: Service | None = None) -> Axes:
    """Plot the probability of not having reached a limit against the travel ahead.

    With a service the risk that its day keeps is drawn: the accepted one, or that of least costs.
    """
    horizon = prognosis.horizon / _KM
    last = _quantiles(prognosis.remaining[:, -1], (0.99,))[0] / _KM
    end = min(horizon, max(1.2 * last, horizon / 50)) if np.isfinite(last) else horizon
    ahead = np.linspace(0, end, 400)
    ordered = np.sort(prognosis.remaining / _KM, axis=0)
    dashes = ["--", "-.", ":", (0, (7, 2, 1, 2, 1, 2))]
    several = len(prognosis.parameters) > 2
    for k, name in enumerate(prognosis.parameters):
        past = np.searchsorted(ordered[:, k], ahead, side="right") / ordered.shape[0]
        if name == "any":
            label = "no limit reached" if several else f"{_spell(prognosis.parameters[0])} limit"
            ax.plot(ahead, 100 * (1 - past), color=BLUE, lw=2.2, label=label)
        elif several:
            line = dashes[k % len(dashes)]
            ax.plot(ahead, 100 * (1 - past), color=MUTED, lw=1.2, ls=line, label=_spell(name))
    some = np.linspace(0, end, 25)
    chance = 100 * (1 - np.searchsorted(ordered[:, -1], some, side="right") / ordered.shape[0])
    texts = [f"after {x:,.0f}{GAP}km: {y:.0f}{GAP}%" for x, y in zip(some, chance, strict=True)]
    hints(ax, some, chance, [text.replace(",", GAP) for text in texts])
    if service is not None and service.kept_risk is not None:
        what = "accepted risk" if service.max_risk else "risk at least costs"
        label = f"{what} {100 * service.kept_risk:.3g} %"
        ax.axhline(100 * (1 - service.kept_risk), color=RED, lw=1.2, ls=(0, (5, 2)), label=label)
    ax.set_xlim(0, end)
    ax.set_ylim(0, 103)
    ax.set_xlabel("travel from now in km" + (" (ends at the horizon)" if end == horizon else ""))
    ax.set_ylabel("probability in %")
    return legend(ax)


def bars(ax: Axes, travel: FloatArray, bounds: FloatArray, label: str, size: float) -> None:
    """Draw points with bars from low, middle and high values, shape ``(3, n)``."""
    style: Any = {"fmt": "o", "color": MUTED, "elinewidth": 0.7, "alpha": 0.85}
    ax.errorbar(travel / _KM, bounds[1], np.diff(bounds, axis=0), ms=size, label=label, **style)


def _bands(ax: Axes, x: FloatArray, bands: FloatArray, name: str, *, told: bool) -> None:
    """Draw median, 50 and 90 % bands; hatched and grey where the data do not tell."""
    colour = BLUE if told else MUTED
    for low, alpha, label in ((0, 0.18, "90 %"), (1, 0.32, "50 %")):
        shown = label if told else None
        ax.fill_between(x, bands[low], bands[4 - low], fc=colour, alpha=alpha, lw=0, label=shown)
    if not told:
        ax.fill_between(x, bands[0], bands[4], fc="none", ec=colour, hatch="///", lw=0)
    line = "-" if told else (0, (1, 2))
    marker = "o" if x.size < 3 else ""
    ax.plot(x, bands[2], color=colour, lw=1.8, ls=line, marker=marker, ms=4, label=name)


def _levels(ax: Axes, limit: float | None) -> None:
    """Draw baseline and limit."""
    ax.axhline(100, color=GREEN, lw=1.1, ls=(0, (5, 3)), label="baseline")
    if limit is not None:
        name = f"limit {100 * limit:.3g} %"
        ax.axhline(100 * limit, color=RED, lw=1.6, ls=(0, (8, 2)), label=name)


def _room(ax: Axes, bands: FloatArray, limit: float | None) -> None:
    """Show bands, baseline and limit, but not all of a band without end."""
    values = [100.0, float(np.nanmin(bands[0])), float(np.nanmax(bands[4]))]
    if limit is not None:
        values.append(100 * limit)
    low, high = min(values), min(max(values), 250.0)
    ax.set_ylim(max(low - 0.06 * (high - low), 0.0), high + 0.06 * (high - low))


def _tells(health: Health, parameter: str) -> bool:
    """Tell whether the last epoch knows a parameter from the data."""
    if parameter not in health.parameters:
        return False
    return bool(health.told()[health.parameters.index(parameter)])


def _epochs(ax: Axes, health: Health, parameter: str) -> float:
    """Draw epochs that know nothing of the law; return the top of their bars."""
    bounds = 100 * health.quantile(_LEVELS[::2])[:, :, health.parameters.index(parameter)]
    # Twenty bars are enough to judge by; the last epoch is always among them.
    some = np.arange(bounds.shape[1])[:: -max(1, bounds.shape[1] // 20)]
    bars(ax, health.travel[some], bounds[:, some], "epochs, 90 %", 2.5)
    return min(float(bounds[2].max()), 160.0)


def _passage(ax: Axes, now: float, ahead: FloatArray, level: float) -> None:
    """Mark where the limit is reached: 5 to 95 % as a bar on the limit, the median as a point."""
    where = now + ahead
    right = where[2] if np.isfinite(where[2]) else 1e9  # runs out of the picture
    ax.plot([where[0], right], [level, level], color=RED, lw=5, alpha=0.55, solid_capstyle="butt")
    if np.isfinite(where[1]):
        ax.plot(where[1], level, "D", color=RED, mec=PAPER, ms=6, zorder=5, label="limit reached")
    for x, far, name in zip(where, ahead, ("Early (5 %)", "Median", "Late (95 %)"), strict=True):
        if np.isfinite(x):
            text = f"{name}: in {km(_KM * far)}, at {whole_km(_KM * x)}"
            hints(ax, np.array([x]), np.array([level]), [text])


def _regions(ax: Axes, draws: FloatArray) -> None:
    """Draw highest-density regions of two columns, smoothed along their principal axes."""
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
    ax.plot(*middle, "o", color=INK, ms=5, label="median")
    ax.plot(100, 100, "*", color=GREEN, mec=PAPER, mew=0.5, ms=12, label="baseline", zorder=5)
    low, high = np.quantile(draws, [0.05, 0.95], axis=0)
    span = np.quantile(draws, [0.002, 0.998], axis=0)
    first, last = np.minimum(span[0], 100.0), np.maximum(span[1], 100.0)
    first, last = first - 0.16 * (last - first), last + 0.06 * (last - first)
    ax.set_xlim(first[0], last[0])
    ax.set_ylim(first[1], last[1])
    across, up = ax.get_xaxis_transform(), ax.get_yaxis_transform()
    ax.plot([low[0], high[0]], [0.05] * 2, "|-", color=INK, lw=1.4, ms=8, transform=across)
    name = "single 90 %"
    ax.plot([0.04] * 2, [low[1], high[1]], "_-", color=INK, lw=1.4, ms=8, transform=up, label=name)


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
    ax.axvline(float(q[2]), color=INK, lw=1.4, label="median")
    ax.axvline(100, color=GREEN, lw=1.3, ls=(0, (5, 3)), label="baseline")
    ax.set_ylim(0, 1.06 * density.max())
    ax.set_ylabel("probability density per %")


def _quantiles(values: FloatArray, levels: tuple[float, ...]) -> FloatArray:
    """Quantiles of draws that may be infinite: always one of the draws."""
    return np.asarray(np.quantile(values, levels, method="inverted_cdf"))


def odometer(ax: Axes, *, room: int = ROOM) -> Axes:
    """Finish a picture over the odometer: axis and legend."""
    ax.set_xlabel("odometer in km")
    return legend(ax, room=room)


def legend(ax: Axes, *, room: int = ROOM) -> Axes:
    """Put the legend above the picture, where it covers nothing; ``room`` characters are a line."""
    handles, labels = ax.get_legend_handles_labels()
    lengths = np.array([len(label) for label in labels])
    columns = max(min(4, len(labels)), 1)
    while columns > 1 and sum(p.max() + 6 for p in np.array_split(lengths, columns)) > room:
        columns -= 1
    place: Any = {"loc": "lower left", "bbox_to_anchor": (0, 1), "borderaxespad": 0.2}
    ax.legend(handles, labels, ncols=columns, columnspacing=1.2, handlelength=1.8, **place)
    return ax


def _spell(name: str) -> str:
    """Spell a name for people; a dollar sign would open a formula."""
    return name.replace("_", " ").replace("$", r"\$")
