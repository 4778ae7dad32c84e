"""Pictures: what they show, and that they repeat to the byte."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from typing import Any
from xml.etree import ElementTree

import matplotlib
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure

from lmshealth._private.arrays import FloatArray
from lmshealth.life.health import Health
from lmshealth.life.prognosis import Prognosis
from lmshealth.machine.service import decide
from lmshealth.modal.spectra_summary import Waterfall
from lmshealth.report import figures as plots
from lmshealth.report.text import plain
from lmshealth.stage.description import Decision
from lmshealth.tracking.history import History
from lmshealth.tracking.track import CovariateEffect, Effect, Track
from tests.assessments import (
    EPOCHS,
    FREQUENCY,
    PARAMETERS,
    life,
    make_health,
    make_history,
    make_prognosis,
    make_track,
    make_waterfall,
)
from tests.lives import cut
from tests.lives import make_history as make_life


@pytest.fixture(scope="module")
def history() -> History:
    """History of a wearing machine."""
    travel, truth = life(8000, 0.68)
    return make_history("M7-Y", travel, truth)


@pytest.fixture(scope="module")
def track(history: History) -> Track:
    """Its track."""
    return make_track(history, life(8000, 0.68)[1])


@pytest.fixture(scope="module")
def health(history: History) -> Health:
    """Its health."""
    return make_health(history, life(8000, 0.68)[1])


@pytest.fixture(scope="module")
def prognosis(history: History) -> Prognosis:
    """Its remaining life."""
    return make_prognosis(history, 8000, 0.68)


@pytest.fixture
def ax() -> Axes:
    """Make an empty Axes that no global state knows."""
    return Figure().add_subplot()


def data(ax: Axes, label: str) -> tuple[FloatArray, FloatArray]:
    """Return x and y of the line with a label."""
    line = next(line for line in ax.lines if line.get_label() == label)
    return np.asarray(line.get_xdata(), dtype=float), np.asarray(line.get_ydata(), dtype=float)


def labels(ax: Axes) -> list[str]:
    """Entries of the legend."""
    return ax.get_legend_handles_labels()[1]


@pytest.mark.slow
def test_import_leaves_matplotlib_alone() -> None:
    """Importing the module is light: matplotlib and Jinja2 come when something is written."""
    code = "import sys, lmshealth.report.pages; print({'matplotlib', 'jinja2'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_settings_of_the_process_do_not_reach_a_page() -> None:
    """A figure has the same bytes whatever another library has set, which stays set."""

    def draw(ax: Axes) -> None:
        ax.plot([1, 2], [3, 4], label="a line")
        ax.legend()

    expected = plots.svg(draw, salt="one")
    others: Any = {
        "axes.linewidth": 5.0,
        "legend.fontsize": 30,
        "figure.constrained_layout.w_pad": 1.0,
    }
    with matplotlib.rc_context(others):
        assert plots.svg(draw, salt="one") == expected
        assert matplotlib.rcParams["axes.linewidth"] == others["axes.linewidth"]


def test_frequencies_in_hz_over_km(ax: Axes, history: History, track: Track) -> None:
    """Logs, filtered line and baseline stand at the right numbers, missing logs are left out."""
    assert plots.plot_frequencies(ax, history, track, "roll") is ax
    points = np.asarray(ax.lines[0].get_xydata())
    assert len(points) == EPOCHS - 1
    np.testing.assert_allclose(points[-1, 0], history.travel[-1] / 1000)
    np.testing.assert_allclose(points[-1, 1], np.exp(history.ln_frequency[-1, 0]))
    np.testing.assert_allclose(data(ax, "baseline")[1], FREQUENCY[0], rtol=1e-12)
    assert labels(ax) == ["filtered, 95 % band", "baseline", "each log, ±2σ"]
    assert ax.get_xlabel() == "odometer in km"
    assert ax.get_ylabel() == "natural frequency in Hz"


def test_frequency_without_track(ax: Axes, history: History) -> None:
    """Without a track the logs alone are shown."""
    plots.plot_frequencies(ax, history, None, "yaw")
    assert labels(ax) == ["each log, ±2σ"]


def test_a_constant_mode_is_shown_on_a_wide_scale(ax: Axes, history: History) -> None:
    """A mode that hardly moves is shown on a scale of at least 1 %."""
    flat = np.where(np.isnan(history.ln_frequency), np.nan, np.log(100.0))
    still = replace(history, ln_frequency=flat)
    plots.plot_frequencies(ax, replace(still, cov=1e-12 * history.cov), None, "yaw")
    low, high = ax.get_ylim()
    assert high - low >= 0.99


def test_damping_in_percent_from_zero(ax: Axes, history: History, track: Track) -> None:
    """Damping is in percent and its axis starts at zero."""
    plots.plot_damping(ax, history, track, "pitch")
    assert ax.get_ylim()[0] == 0
    assert ax.get_ylim()[1] < 10
    assert "%" in ax.get_ylabel()


def test_posterior_regions_hold_their_share(ax: Axes, health: Health) -> None:
    """The regions called 50 and 90 % hold 50 and 90 % of the draws, at correlation -0.9."""
    plots.plot_posterior(ax, health, PARAMETERS)
    outlines = next(c for c in ax.collections if len(c.get_paths()) == 2).get_paths()
    shares = [path.contains_points(100 * health.samples[-1]).mean() for path in outlines]
    np.testing.assert_allclose(shares, [0.9, 0.5], atol=0.03)
    assert {"baseline", "median", "marginal 90 %"} <= set(labels(ax))


def test_posterior_of_one_parameter_is_a_density(ax: Axes, health: Health) -> None:
    """One parameter gives a density that integrates to one."""
    plots.plot_posterior(ax, health, PARAMETERS[:1])
    x, y = np.asarray(ax.lines[0].get_xydata()).T
    assert np.trapezoid(y, x) == pytest.approx(1, abs=0.01)


def test_health_marks_limit_and_baseline(ax: Axes, health: Health) -> None:
    """Limit and baseline are marked."""
    plots.plot_health(ax, health, "guide_preload", 0.6)
    assert {"limit 60 %", "baseline"} <= set(labels(ax))
    low, high = ax.get_ylim()
    assert low < 60
    assert high > 100


def test_undetermined_health_is_drawn_as_prior(ax: Axes, history: History) -> None:
    """An undetermined parameter is hatched and labelled as prior."""
    plots.plot_health(
        ax, make_health(history, life(8000, 0.68)[1], (0.9, 0.1)), PARAMETERS[1], None
    )
    assert "mostly prior, not measured" in labels(ax)
    assert any(collection.get_hatch() for collection in ax.collections)


def test_parameters_with_a_unit_are_drawn_by_their_baseline(prognosis: Prognosis) -> None:
    """A life begins at its baseline; health does not have it, and must be given relative to it."""
    name = prognosis.parameters[0]
    scaled = replace(
        prognosis,
        limits=5000 * prognosis.limits,
        curve_quantiles=5000 * prognosis.curve_quantiles,
    )
    tops = [one.plot(name).get_ylim()[1] for one in (prognosis, scaled)]
    assert tops[1] == pytest.approx(tops[0])


def test_life_shows_now_limit_and_horizon(ax: Axes, prognosis: Prognosis) -> None:
    """A horizon far behind the limit is named instead of squeezing the picture."""
    plots.plot_life(ax, prognosis, "guide_preload")
    assert {"now", "limit 60 %", "law", "limit reached"} <= set(labels(ax))
    assert plain(ax.get_xlabel()) == "travel in km (horizon at 21 720 km, not shown)"
    near = Figure().add_subplot()
    plots.plot_life(near, replace(prognosis, horizon=3e6), "mount_stiffness")
    assert "horizon" in labels(near)


def test_survival_is_the_share_of_draws(ax: Axes, prognosis: Prognosis) -> None:
    """The curve is the share of draws that have not reached a limit."""
    plots.plot_survival(ax, prognosis, service=decide(prognosis, Decision()))
    x, y = data(ax, "no limit reached")
    share = [100 * np.mean(prognosis.remaining[:, -1] > km * 1000) for km in x]
    np.testing.assert_allclose(y, share)
    assert "accepted risk 5 %" in labels(ax)


def test_survival_shows_the_risk_of_least_costs(ax: Axes, prognosis: Prognosis) -> None:
    """Where costs choose the day the line is at its risk; where they choose none there is none."""
    service = decide(prognosis, Decision(cost_ratio=20.0))
    plots.plot_survival(ax, prognosis, service=service)
    label = f"risk at least cost {100 * service.risk:.3g} %"
    np.testing.assert_allclose(data(ax, label)[1], 100 * (1 - service.risk))
    endless = replace(prognosis, remaining=np.full_like(prognosis.remaining, np.inf))
    bare = Figure().add_subplot()
    plots.plot_survival(bare, endless, service=decide(endless, Decision(cost_ratio=20.0)))
    assert len(bare.get_lines()) == len(ax.get_lines()) - 1


def test_survival_without_end(ax: Axes, prognosis: Prognosis) -> None:
    """A life without a visible end is drawn up to the horizon."""
    endless = np.full_like(prognosis.remaining, np.inf)
    plots.plot_survival(ax, replace(prognosis, remaining=endless))
    assert ax.get_xlim()[1] == pytest.approx(20000)
    assert "horizon" in ax.get_xlabel()


def test_nis_band_is_chi_square(ax: Axes, track: Track) -> None:
    """Epochs outside the 95 % band of their own degrees of freedom have another marker."""
    from scipy.stats import chi2

    nis = track.nis.copy()
    nis[3], nis[4] = 60.0, np.nan
    plots.plot_nis(ax, replace(track, nis=nis))
    seen = np.isfinite(nis)
    cdf = chi2.cdf(nis[seen], track.nis_dof[seen])
    assert data(ax, "outside")[0].size == np.sum((cdf < 0.025) | (cdf > 0.975))
    assert "log scale" in ax.get_ylabel()


def test_figures_without_odometer_count_days(ax: Axes, history: History, track: Track) -> None:
    """A machine without odometer has its logs at their days, also on a logarithmic scale."""
    unknown = np.full_like(track.travel, np.nan)
    days = replace(track, travel=unknown, nis=np.where(np.arange(track.nis.size), 1.0, 1e3))
    logs = replace(history, travel=unknown)
    plots.svg(lambda ax: plots.plot_nis(ax, days), salt="a")
    plots.plot_frequencies(ax, logs, days, logs.modes[0])
    assert ax.get_xlabel() == "days since the first log"
    drawn = ax.lines[0].get_xdata()
    passed = (history.recorded_at[-1] - history.recorded_at[0]).total_seconds() / 86400
    assert np.isfinite(np.asarray(drawn, dtype=float)).all() and passed > 0
    assert np.isclose(np.max(np.asarray(drawn, dtype=float)), passed)


def test_waterfall_shows_every_log_in_its_column(ax: Axes, history: History, track: Track) -> None:
    """Colours are the levels, columns hold their logs, and lines do not decide the colours."""
    waterfall = make_waterfall(history)
    assert plots.plot_waterfall(ax, waterfall, history, track) is ax
    mesh = next(c for c in ax.collections if isinstance(c, QuadMesh))
    levels = mesh.get_array()
    assert levels is not None
    shown = np.ma.filled(levels, np.nan)[:, ::2].T
    np.testing.assert_array_equal(shown, waterfall.level)
    x = np.asarray(mesh.get_coordinates())[0, :, 0].reshape(-1, 2)
    km = history.travel / 1000
    assert (x[:, 0] < km).all() and (km < x[:, 1]).all()
    assert mesh.get_clim() == (-10.0, 15.0)
    np.testing.assert_allclose(data(ax, "mains line"), [km, np.full(EPOCHS, 150.0)])
    np.testing.assert_allclose(
        data(ax, "tracked modes, 95 % band")[1], np.exp(track.ln_frequency[:, 0])
    )
    assert ax.get_ylabel() == "frequency in Hz" and ax.get_yscale() == "linear"


def test_waterfall_moves_the_modes_to_where_logs_saw_them(
    ax: Axes, history: History, track: Track
) -> None:
    """What covariates did is added to the tracked frequencies."""
    moved = np.linspace(0, 0.02, EPOCHS)[:, None] * np.ones(3)
    plots.plot_waterfall(ax, make_waterfall(history), history, track, moved=moved)
    np.testing.assert_allclose(
        data(ax, "tracked modes, 95 % band")[1], np.exp(track.ln_frequency[:, 0] + moved[:, 0])
    )


def test_waterfall_leaves_a_gap_where_logs_are_missing(ax: Axes, history: History) -> None:
    """Columns touch their neighbours, but not across a hole of several usual distances."""
    travel = history.travel.copy()
    travel[20:] += 10 * (travel[1] - travel[0])
    apart = replace(history, travel=travel)
    plots.plot_waterfall(ax, make_waterfall(apart), apart)
    mesh = next(c for c in ax.collections if isinstance(c, QuadMesh))
    left, right = np.asarray(mesh.get_coordinates())[0, :, 0].reshape(-1, 2).T
    gaps = left[1:] - right[:-1]
    usual = (travel[1] - travel[0]) / 1000
    assert gaps[19] > 9 * usual
    np.testing.assert_allclose(np.delete(gaps, 19), 0.0, atol=1e-9 * travel[-1])


@pytest.mark.parametrize("still", [False, True])
def test_waterfall_of_one_log_or_of_a_machine_at_rest(
    ax: Axes, history: History, still: bool
) -> None:
    """One log is a column; several at one odometer are one place with some width."""
    n = 5 if still else 1
    few = cut(history, n)
    few = replace(few, travel=np.full(n, few.travel[0]))
    waterfall = make_waterfall(history)
    own = Waterfall(waterfall.edges, waterfall.level[:n], waterfall.lines[:n])
    plots.plot_waterfall(ax, own, few)
    low, high = ax.get_xlim()
    assert low < few.travel[0] / 1000 < high


def test_waterfall_keeps_its_width_beside_long_names(history: History) -> None:
    """A line with a long name takes a line of the legend, not the room of the picture."""
    waterfall = make_waterfall(history)
    long = replace(waterfall.lines[0][0], kind="a disturbance of unknown origin")
    waterfall = replace(waterfall, lines=((long,), *waterfall.lines[1:]))
    figure = Figure(figsize=(4.8, 3.6), layout="constrained")
    ax = plots.plot_waterfall(figure.add_subplot(), waterfall, history)
    figure.draw_without_rendering()
    assert ax.get_position().width > 0.6


def test_wide_waterfall_is_logarithmic(ax: Axes, history: History) -> None:
    """A band over more than two octaves has a logarithmic axis."""
    waterfall = replace(make_waterfall(history), edges=np.geomspace(20.0, 2000.0, 81))
    plots.plot_waterfall(ax, waterfall, history)
    assert ax.get_yscale() == "log"


def test_influence_shows_before_and_after(ax: Axes, history: History) -> None:
    """Points before and after stand at their numbers in %, the line is the effect with its band."""
    values = history.covariates["temperature_c"]
    effect = Effect("roll", "temperature_c", -1.2e-3, 1e-4)
    rng = np.random.default_rng(5)
    measured = -1.2e-3 * (values - 21) + 1e-4 * rng.standard_normal(EPOCHS)
    one = CovariateEffect(
        "roll", "temperature_c", 21.0, (effect,), np.arange(EPOCHS), np.array(values), measured
    )
    assert plots.plot_influence(ax, one, history) is ax
    np.testing.assert_allclose(data(ax, "as measured"), [values, 100 * measured])
    left = 100 * (measured + 1.2e-3 * (values - 21))
    np.testing.assert_allclose(data(ax, "corrected"), [values, left])
    x, y = data(ax, "effect")
    np.testing.assert_allclose(y, -0.12 * (x - 21))
    band = next(c for c in ax.collections if c.get_alpha() == 0.18).get_paths()[0].vertices
    np.testing.assert_allclose(
        np.asarray(band)[:, 1].max(), max(-0.12 * (x - 21) + 1.96e-2 * np.abs(x - 21)), rtol=1e-9
    )
    assert ax.get_xlabel() == "temperature in °C"
    bent = replace(one, effects=(effect, replace(effect, covariate="temperature_c^2")))
    plain = plots.plot_influence(Figure().add_subplot(), bent, history)
    assert not [c for c in plain.collections if c.get_alpha() == 0.18]


def titles(text: str) -> list[str]:
    """Return the texts of the hints of a figure."""
    tree = ElementTree.fromstring(text)
    return [element.text or "" for element in tree.iter("{http://www.w3.org/2000/svg}title")]


def test_hints_contain_the_values_of_points(history: History, track: Track) -> None:
    """Every log that shows the mode has a title with its name and value on what feels a pointer."""
    text = plots.svg(lambda ax: plots.plot_frequencies(ax, history, track, "roll"), salt="a")
    found = titles(text)
    seen = np.flatnonzero(np.isfinite(history.ln_frequency[:, 0]))
    assert len(found) == seen.size
    for one, k in zip(found, seen, strict=True):
        assert one.startswith(f"{history.logs[k]}\n")
        assert f"{np.exp(history.ln_frequency[k, 0]):.2f} ± " in one
    assert "<a " not in text and text.count("</title>\n<use") + text.count("</title>\n<g") == len(
        found
    )


def test_hints_of_dense_pictures_are_thinned() -> None:
    """A thousand points have at most `constants.POINTS` hints, the last among them."""
    x = np.arange(1000.0)
    text = plots.svg(
        lambda ax: plots.hints(ax, x, x, [f"point {k}" for k in range(1000)]), salt="a"
    )
    found = titles(text)
    assert found[:2] == ["point 3", "point 7"] and len(found) == 250
    assert found[-1] == "point 999"


def test_figures_of_long_histories_are_as_small_as_of_short_ones() -> None:
    """Of a thousand logs 250 are drawn, the last among them, each as marker, bar and hint."""
    level = np.log(200.0) + 1e-3 * np.sin(np.arange(1000.0))[:, None]
    own = make_life(level)
    text = plots.svg(lambda ax: plots.plot_frequencies(ax, own, None, own.modes[0]), salt="a")
    found = titles(text)
    assert len(found) == 250 and found[-1].startswith(f"{own.logs[-1]}\n")
    assert text.count("<use") + text.count("<path") < 3 * 250 + 60


@pytest.mark.slow
def test_hints_of_other_pictures(
    history: History, track: Track, health: Health, prognosis: Prognosis
) -> None:
    """Health, passage, survival, NIS, columns and lines have hints with their values."""
    found = titles(
        plots.svg(lambda ax: plots.plot_health(ax, health, "guide_preload", 0.6), salt="a")
    )
    middle = 100 * np.median(health.samples[-1, :, 0])
    assert len(found) == EPOCHS and f"guide preload {middle:.1f}" in found[-1]
    found = titles(plots.svg(lambda ax: plots.plot_life(ax, prognosis, "guide_preload"), salt="a"))
    assert [one.split(":")[0] for one in found] == ["Early (5 %)", "Median", "Late (95 %)"]
    found = titles(plots.svg(lambda ax: plots.plot_survival(ax, prognosis), salt="a"))
    assert found[0] == "after 0\u202fkm: 100\u202f%" and len(found) == 25
    found = titles(plots.svg(lambda ax: plots.plot_nis(ax, track), salt="a"))
    assert len(found) == EPOCHS and f"NIS {track.nis[-1]:.1f}" in found[-1]
    waterfall = make_waterfall(history)
    found = titles(plots.svg(lambda ax: plots.plot_waterfall(ax, waterfall, history), salt="a"))
    assert len(found) == 2 * EPOCHS
    assert f"yaw {np.exp(history.ln_frequency[0, 2]):.2f}" in found[0]
    assert "mains line at 150.00\u202fHz, 0.002\u202fm/s² in acc_feed" in found[EPOCHS]


def test_undetermined_health_has_no_hints(history: History) -> None:
    """A parameter that is mostly prior has no number under the pointer."""
    health = make_health(history, life(8000, 0.68)[1], (0.9, 0.1))
    text = plots.svg(lambda ax: plots.plot_health(ax, health, PARAMETERS[1], None), salt="a")
    assert titles(text) == []


def test_svg_is_reproducible_and_self_contained(history: History, track: Track) -> None:
    """Same input, same bytes; other salt, no identifier in common; nothing from outside."""

    def draw(ax: Axes) -> Axes:
        return plots.plot_frequencies(ax, history, track, "roll")

    one, two = plots.svg(draw, salt="a"), plots.svg(draw, salt="a")
    assert one == two
    other = plots.svg(draw, salt="b")
    assert not set(re.findall(r'\sid="([^"]+)"', one)) & set(re.findall(r'\sid="([^"]+)"', other))
    tree = ElementTree.fromstring(one)
    ids = {element.get("id") for element in tree.iter()} - {None}
    used = set(re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', one))
    assert {first or second for first, second in used} <= ids
    assert "var(--blue, #0072b2)" in one
    assert "metadata" not in one and "<!--" not in one


def test_svg_survives_hostile_names(prognosis: Prognosis) -> None:
    """Formula signs, markup and unknown scripts in names neither fail nor reach the file."""
    names = ("$a_b", "<script>--> 導軌", "any")
    strange = replace(prognosis, parameters=names)
    text = plots.svg(lambda ax: plots.plot_survival(ax, strange), salt="x")
    assert "<script" not in text
    ElementTree.fromstring(text)


def test_hints_survive_hostile_names(history: History) -> None:
    """Markup, quotes, formula signs and ends of links in a log's name are text in its title."""
    evil = "'\"></a><script>alert(1)</script>$x_2$ url(#a) &amp;"
    strange = replace(history, logs=(evil, *history.logs[1:]))
    text = plots.svg(lambda ax: plots.plot_damping(ax, strange, None, "roll"), salt="x")
    assert "<script" not in text
    assert titles(text)[0].replace("#x-", "#").startswith(evil)
