"""Pictures: what they show, and that they repeat to the byte."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lmshealth import plots, trackplots
from lmshealth.arrays import FloatArray
from lmshealth.decision import decide
from lmshealth.laws import HertzWear, Law, Loosening
from lmshealth.priors import Lognormal, Normal
from lmshealth.results import Health, Prognosis
from lmshealth.stage import Decision
from lmshealth.tracks import Effect, History, Series, Track
from tests.lives import health_of

MODES = ("roll", "pitch", "yaw")
PARAMETERS = ("guide_preload", "mount_stiffness")
FREQUENCY = np.array([126.4, 136.6, 155.0])
SENSITIVITY = np.array([[0.077, 0.26], [0.107, 0.18], [0.12, 0.05]])
EPOCHS = 40
START = datetime(2026, 6, 1, 8, 30, tzinfo=UTC)


def life(wear_km: float, floor: float) -> tuple[FloatArray, FloatArray]:
    """Return odometer in m and true health, shape (n_epochs, 2), of a machine."""
    travel = np.linspace(120.0, 1720.0, EPOCHS) * 1000
    s = travel - travel[0]
    preload = (1 - s / (wear_km * 1000)) ** 1.5
    mount = floor + (1 - floor) * np.exp(-s / 1.5e6)
    return travel, np.column_stack([preload, mount])


def make_history(stage: str, travel: FloatArray, truth: FloatArray, seed: int = 1) -> History:
    """Make estimates of three modes with temperature and errors; roll is lost in one log."""
    rng = np.random.default_rng(seed)
    n, m = travel.size, len(MODES)
    temperature = 21 + 2.5 * np.sin(np.arange(n) / 4) + rng.normal(0, 0.5, n)
    level = np.log(FREQUENCY) + np.log(truth) @ SENSITIVITY.T
    level = level - 1.2e-4 * (temperature[:, None] - 21)
    std = np.r_[np.full(m, 8e-4), np.full(m, 0.06)] * np.exp(rng.normal(0, 0.25, (n, 1)))
    cov = std[:, :, None] * std[:, None, :] * np.eye(2 * m)
    damping = np.log([0.015, 0.018, 0.012]) + 0.1 * np.arange(n)[:, None] / n
    noise = std * rng.standard_normal((n, 2 * m))
    ln_f, ln_z = level + noise[:, :m], damping + noise[:, m:]
    ln_f[7, 0] = ln_z[7, 0] = np.nan
    cov[7, [0, m]] = cov[7][:, [0, m]] = np.nan
    cov[7, :, 0] = cov[7, :, m] = np.nan
    return History(
        stage=stage,
        logs=tuple(f"logs/{stage}/{i:04d}.csv" for i in range(n)),
        recorded_at=tuple(START + timedelta(days=float(s) / 12e3) for s in travel - travel[0]),
        travel=travel,
        covariates={"temperature_c": temperature},
        modes=MODES,
        ln_frequency=ln_f,
        ln_damping=ln_z,
        cov=cov,
        series=tuple(Series(mode, "acc") for mode in MODES),
        loop_error=np.full(n, np.nan),
        baselines=(0,),
    )


def make_track(history: History, truth: FloatArray, seed: int = 2) -> Track:
    """Make a track whose line follows the truth."""
    rng = np.random.default_rng(seed)
    n, m = len(history.logs), len(history.modes)
    drift = np.log(truth) @ SENSITIVITY.T
    std = 6e-4 / np.sqrt(1 + np.arange(n))[:, None] + np.full(m, 2.5e-4)
    wander = np.cumsum(rng.normal(0, 8e-5, (n, m)), axis=0)
    ln_f = np.log(FREQUENCY) + drift + wander
    dof = np.where(np.isnan(history.ln_frequency).any(axis=1), m - 1.0, float(m))
    return Track(
        stage=history.stage,
        logs=history.logs,
        recorded_at=history.recorded_at,
        travel=history.travel,
        modes=history.modes,
        ln_frequency=ln_f,
        ln_frequency_std=std,
        ln_damping=np.log([0.015, 0.018, 0.012]) + 0.1 * np.arange(n)[:, None] / n,
        ln_damping_std=np.full((n, m), 0.02),
        drift=drift + wander,
        drift_cov=(std**2)[:, :, None] * np.eye(m),
        effects=tuple(Effect(mode, "temperature_c", -1.2e-4, 1.5e-5) for mode in history.modes),
        nis=rng.chisquare(dof),
        nis_dof=dof,
        noise_scale=np.ones((n, 1)),
        sources=("acc",),
        events=(),
        steps=(),
        outliers=(),
        innovations=rng.standard_normal((n, 2 * m)),
        widening=np.ones(n),
    )


def make_health(
    history: History, truth: FloatArray, informed: tuple[float, float] = (0.96, 0.93), seed: int = 3
) -> Health:
    """Make a posterior with the strong trade-off between preload and mount."""
    rng = np.random.default_rng(seed)
    n = len(history.logs)
    std = np.where(np.array(informed) > 0.5, [0.055, 0.035], [0.3, 0.3])
    std = std * (1 + 1.5 / np.sqrt(1 + np.arange(n)))[:, None] * [1.0, 1.0]
    root = np.linalg.cholesky(np.array([[1, -0.9], [-0.9, 1]]))
    both = min(informed) > 0.5
    white = rng.standard_normal((n, 1500, 2))
    white = white @ root.T if both else white
    return health_of(
        np.exp(np.log(truth)[:, None] + std[:, None] * white),
        stage=history.stage,
        recorded_at=history.recorded_at,
        travel=history.travel,
        parameters=PARAMETERS,
        converged=np.ones(n, dtype=bool),
        informed=np.tile(np.array(informed), (n, 1)),
    )


def make_prognosis(
    history: History, wear_km: float, floor: float, limits: tuple[float, float] = (0.6, 0.7)
) -> Prognosis:
    """Make a prognosis from draws of the laws around the truth."""
    rng = np.random.default_rng(4)
    n, now = 4000, float(history.clock()[-1])
    wear = HertzWear(life_km=Lognormal(8000, 0.5))
    loose = Loosening(life_km=Lognormal(1500, 0.3), floor=Normal(0.7, 0.1))
    laws: tuple[Law, Law] = (wear, loose)
    theta: tuple[FloatArray, ...] = (
        np.column_stack(
            [wear_km * 1e3 * np.exp(rng.normal(0, 0.12, n)), rng.uniform(0.9, 1.15, n)]
        ),
        np.column_stack([rng.normal(floor, 0.03, n), 1.5e6 * np.exp(rng.normal(0, 0.15, n))]),
    )
    passed = [law.passage(t, x) for law, t, x in zip(laws, theta, limits, strict=True)]
    remaining = np.column_stack(passed) - now
    horizon = 20e6
    grid = np.linspace(0, now + horizon, 240)
    curves = [law.health(t, grid) for law, t in zip(laws, theta, strict=True)]
    present = [law.health(t, np.array([now])) for law, t in zip(laws, theta, strict=True)]
    return Prognosis(
        stage=history.stage,
        recorded_at=history.recorded_at[-1],
        travel=float(history.travel[-1]),
        parameters=(*PARAMETERS, "any"),
        untold=(),
        limits=np.array([*limits, np.nan]),
        remaining=np.column_stack([remaining, remaining.min(axis=1)]),
        usage=12e3 * np.exp(rng.normal(0, 0.08, n)),
        horizon=horizon,
        health=np.column_stack(present),
        curve_travel=grid + history.travel[0],
        curve_quantiles=np.stack(
            [np.quantile(c, [0.05, 0.25, 0.5, 0.75, 0.95], axis=0) for c in curves], axis=-1
        ),
        laws=(),
        chi_square=121.4,
        degrees_of_freedom=115,
        walk=8e-4,
        noise_scale=1.02,
        deviation=0.0,
        ess=1830.0,
        r_hat=1.006,
    )


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


def test_import_leaves_matplotlib_alone() -> None:
    """Importing the module is light: matplotlib and Jinja2 come when something is written."""
    code = "import sys, lmshealth.report; print({'matplotlib', 'jinja2'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_frequencies_in_hz_over_km(ax: Axes, history: History, track: Track) -> None:
    """Logs, filtered line and baseline stand at the right numbers, missing logs are left out."""
    assert trackplots.plot_frequencies(ax, history, track, "roll") is ax
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
    trackplots.plot_frequencies(ax, history, None, "yaw")
    assert labels(ax) == ["each log, ±2σ"]


def test_quiet_mode_is_no_drama(ax: Axes, history: History) -> None:
    """A mode that hardly moves is shown on a scale of at least 1 %."""
    flat = np.where(np.isnan(history.ln_frequency), np.nan, np.log(100.0))
    still = replace(history, ln_frequency=flat)
    trackplots.plot_frequencies(ax, replace(still, cov=1e-12 * history.cov), None, "yaw")
    low, high = ax.get_ylim()
    assert high - low >= 0.99


def test_damping_in_percent_from_zero(ax: Axes, history: History, track: Track) -> None:
    """Damping is in percent and its axis starts at zero."""
    trackplots.plot_damping(ax, history, track, "pitch")
    assert ax.get_ylim()[0] == 0
    assert ax.get_ylim()[1] < 10
    assert "%" in ax.get_ylabel()


def test_posterior_regions_hold_their_share(ax: Axes, health: Health) -> None:
    """The regions called 50 and 90 % hold 50 and 90 % of the draws, at correlation -0.9."""
    plots.plot_posterior(ax, health, PARAMETERS)
    outlines = next(c for c in ax.collections if len(c.get_paths()) == 2).get_paths()
    shares = [path.contains_points(100 * health.samples[-1]).mean() for path in outlines]
    np.testing.assert_allclose(shares, [0.9, 0.5], atol=0.03)
    assert {"baseline", "median", "single 90 %"} <= set(labels(ax))


def test_posterior_of_one_parameter_is_a_density(ax: Axes, health: Health) -> None:
    """One parameter gives a density that integrates to one."""
    plots.plot_posterior(ax, health, PARAMETERS[:1])
    x, y = np.asarray(ax.lines[0].get_xydata()).T
    assert np.trapezoid(y, x) == pytest.approx(1, abs=0.01)


def test_posterior_of_three_parameters_is_refused(ax: Axes, health: Health) -> None:
    """Three parameters cannot be drawn in one picture."""
    with pytest.raises(ValueError, match="3 parameters"):
        plots.plot_posterior(ax, health, ("a", "b", "c"))


def test_health_marks_limit_and_failures(ax: Axes, health: Health) -> None:
    """Limit, baseline and epochs without convergence are marked."""
    converged = health.converged.copy()
    converged[5] = False
    plots.plot_health(ax, replace(health, converged=converged), "guide_preload", 0.6)
    assert {"limit 60 %", "baseline", "sampler not converged"} <= set(labels(ax))
    low, high = ax.get_ylim()
    assert low < 60
    assert high > 100


def test_life_hides_epochs_that_are_not_told(
    ax: Axes, history: History, prognosis: Prognosis
) -> None:
    """Epochs that are mostly assumption do not stand beside the law."""
    health = make_health(history, life(8000, 0.68)[1], (0.9, 0.1))
    plots.plot_life(ax, prognosis, "mount_stiffness", health=health)
    assert "epochs, 90 %" not in labels(ax)


def test_health_that_is_not_told_does_not_look_measured(ax: Axes, history: History) -> None:
    """A parameter the data do not tell is hatched and named as an assumption."""
    plots.plot_health(
        ax, make_health(history, life(8000, 0.68)[1], (0.9, 0.1)), PARAMETERS[1], None
    )
    assert "mostly assumption, not measured" in labels(ax)
    assert any(collection.get_hatch() for collection in ax.collections)


def test_life_shows_now_limit_and_horizon(ax: Axes, prognosis: Prognosis, health: Health) -> None:
    """A horizon far behind the limit is named instead of squeezing the picture."""
    plots.plot_life(ax, prognosis, "guide_preload", health=health)
    assert {"now", "limit 60 %", "law", "epochs, 90 %", "limit reached"} <= set(labels(ax))
    assert "horizon at 21720 km" in ax.get_xlabel()
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
    label = f"risk at least costs {100 * service.risk:.3g} %"
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
    trackplots.plot_nis(ax, replace(track, nis=nis))
    seen = np.isfinite(nis)
    cdf = chi2.cdf(nis[seen], track.nis_dof[seen])
    assert data(ax, "outside")[0].size == np.sum((cdf < 0.025) | (cdf > 0.975))
    assert "log scale" in ax.get_ylabel()


def test_svg_repeats_and_stands_alone(history: History, track: Track) -> None:
    """Same input, same bytes; other salt, no identifier in common; nothing from outside."""

    def draw(ax: Axes) -> Axes:
        return trackplots.plot_frequencies(ax, history, track, "roll")

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
