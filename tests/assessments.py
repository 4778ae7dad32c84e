"""Assessments of invented machines, their pages, and tools to read both."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from datetime import UTC, date, datetime, timedelta
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import asdict

from lmshealth._private.arrays import FloatArray
from lmshealth._private.files import write_text
from lmshealth._private.tables import Row
from lmshealth.io.log import Notice, Refusal
from lmshealth.life.health import Health
from lmshealth.life.prognosis import Prognosis
from lmshealth.life.verdict import Verdict
from lmshealth.machine.assessment import Assessment
from lmshealth.machine.status import make_status, on_day
from lmshealth.machine.summary import Summary, summarise
from lmshealth.modal.spectra_summary import Waterfall
from lmshealth.report.pages import by_urgency, date_page, file_names, make_page, write_index
from lmshealth.report.tables import machine_tables
from lmshealth.signal.spectral_lines import Line
from lmshealth.stage.degradation_laws import HertzWear, Law, Loosening
from lmshealth.stage.description import Stage, load_stage
from lmshealth.stage.priors import Lognormal, Normal
from lmshealth.tracking.filters.state_space import StateSpace
from lmshealth.tracking.filters.track_state import Event
from lmshealth.tracking.history import History, Series, Step
from lmshealth.tracking.track import Effect, Track
from tests.lives import health_of, plain_nuisances

MODES = ("roll", "pitch", "yaw")
PARAMETERS = ("guide_preload", "mount_stiffness")
FREQUENCY = np.array([126.4, 136.6, 155.0])
SENSITIVITY = np.array([[0.077, 0.26], [0.107, 0.18], [0.12, 0.05]])
EPOCHS = 40
START = datetime(2026, 6, 1, 8, 30, tzinfo=UTC)
Maker = Callable[..., Assessment]
COVARIATE = '[[covariate]]\nname = "temperature_c"\nreference = 21.0\nprior_std = 0.001\n'
DECISION = "[decision]\nmax_risk = 0.05\nnext_service = 2027-03-01\n"


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
        effects=tuple(
            Effect(mode, name, -1.2e-4 if name == "temperature_c" else 0.0, 1.5e-5)
            for mode, name, _ in StateSpace(history, load_stage("lms-y")).effects
        ),
        nis=rng.chisquare(dof),
        nis_dof=dof,
        noise_scale=np.ones((n, 1)),
        sources=("acc",),
        events=(),
        steps=(),
        outliers=(),
        innovations=rng.standard_normal((n, 2 * m)),
        widening=np.ones(n),
        nuisances=plain_nuisances(n, len(history.series)),
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
    passed = [law.passage(t, np.array(x)) for law, t, x in zip(laws, theta, limits, strict=True)]
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
        unidentifiable=(),
        limits=np.array([*limits, np.nan]),
        remaining=np.column_stack([remaining, remaining.min(axis=1)]),
        usage=(usage := 12e3 * np.exp(rng.normal(0, 0.08, n))),
        usage_now=usage,
        half=remaining / 2,
        horizon=horizon,
        health=np.column_stack(present),
        curve_travel=grid + history.travel[0],
        curve_quantiles=np.stack(
            [np.quantile(c, [0.05, 0.25, 0.5, 0.75, 0.95], axis=0) for c in curves], axis=-1
        ),
        laws=(),
        chi_square=121.4,
        degrees_of_freedom=115.0,
        walk=8e-4,
        noise_scale=1.02,
        deviation=0.0,
        ess=1830.0,
        r_hat=1.006,
    )


def make_waterfall(history: History) -> Waterfall:
    """Make spectra with a peak at roll, a mains line in every log, and a log without levels."""
    edges = np.geomspace(100.0, 180.0, 81)
    centre = np.sqrt(edges[1:] * edges[:-1])
    roll = np.exp(history.ln_frequency[:, 0])[:, None]
    level = 12 - 3 * np.abs(centre - np.where(np.isnan(roll), FREQUENCY[0], roll)).clip(0, 6)
    level[:, np.searchsorted(edges, 150.0) - 1] = 40.0
    level[3] = np.nan
    line = Line(150.0, 2e-3, "m/s²", "mains", "acc_feed")
    return Waterfall(edges, level, tuple((line,) for _ in history.logs))


def write_stage(folder: Path, limited: bool = True, parameters: int = 2) -> Stage:
    """Write a small description with its map, and load it."""
    names, levels = PARAMETERS[:parameters], np.geomspace(0.3, 1.6, 9)
    grid = np.stack(np.meshgrid(*[levels] * parameters), -1).reshape(-1, parameters)
    rows = [",".join([*names, "mode", "frequency_hz"])]
    for point in grid:
        for mode, base, slope in zip(MODES, FREQUENCY, SENSITIVITY[:, :parameters], strict=True):
            values = [*point, mode, base * np.exp(slope @ np.log(point))]
            rows.append(",".join(str(value) for value in values))
    (folder / "map.csv").write_text("\n".join(rows))
    text = 'name = "lms-y"\nsource = "small stage of the tests"\n'
    for mode, frequency in zip(MODES, FREQUENCY, strict=True):
        text += f'[[mode]]\nname = "{mode}"\nfrequency_hz = {frequency}\ndamping_ratio = 0.015\n'
    for name, limit in zip(names, (0.6, 0.7), strict=False):
        text += f'[[parameter]]\nname = "{name}"\n'
        text += 'prior = { kind = "lognormal", median = 1.0, sigma = 0.3 }\n'
        text += f"limit = {{ below = {limit} }}\n" if limited else ""
    text += f'[map]\nfile = "map.csv"\n{COVARIATE}{DECISION if limited else ""}'
    path = folder / "stage.toml"
    path.write_text(text)
    return load_stage(str(path))


@pytest.fixture
def make(tmp_path: Path) -> Maker:
    """Return a maker of assessments: worn by default."""
    stage = write_stage(tmp_path)

    def assess(identity: str = "M7-Y", wear_km: float = 8000, floor: float = 0.68) -> Assessment:
        travel, truth = life(wear_km, floor)
        history = make_history(identity, travel, truth)
        healthy = wear_km > 20000
        return Assessment(
            stage=stage,
            history=history,
            digests=tuple(f"{k:064x}" for k in range(len(history.logs))),
            track=make_track(history, truth),
            health=make_health(history, truth),
            prognosis=make_prognosis(history, wear_km, floor),
            judgement=Verdict(
                stage=identity,
                recorded_at=history.recorded_at[-1],
                verdict="healthy" if healthy else "both",
                probability=0.97 if healthy else 0.93,
                why="No parameter differs from its baseline by more than its uncertainty."
                if healthy
                else "Roll, pitch and yaw have fallen by 7, 7 and 4 % since the baseline; the "
                "map explains this by less guide preload and a looser mount together.",
            ),
            refused=(
                Refusal(
                    "logs/0007.csv",
                    "not excited",
                    "modal SNR 1.3 where 3 is needed",
                    channel="acc_feed",
                    mode="roll",
                    source="acc",
                ),
                Refusal("logs/x.csv", "gap", "31 % of the samples are missing, 5 % are allowed"),
            ),
            notices=(
                Notice(
                    "mode-missing",
                    "caution",
                    "",
                    "The temperature of 3 logs is missing; their estimates are less certain.",
                ),
            ),
            seed=0,
            waterfall=make_waterfall(history),
        )

    return assess


def nothing(assessment: Assessment) -> Assessment:
    """Return the same stage before its logs carry anything."""
    judgement = replace(
        assessment.judgement,
        verdict="not-enough-data",
        probability=float("nan"),
        why="2 logs so far; a baseline needs 5.",
    )
    history = assessment.history
    unseen = replace(history, ln_frequency=np.full_like(history.ln_frequency, np.nan))
    return replace(
        assessment, history=unseen, track=None, health=None, prognosis=None, judgement=judgement
    )


def blind(assessment: Assessment) -> Assessment:
    """Return the same stage with an undetermined mount stiffness, as in LMS-X."""
    truth = life(8000, 0.68)[1]
    return replace(assessment, health=make_health(assessment.history, truth, (0.95, 0.08)))


class Page(HTMLParser):
    """What a browser would be asked to load, and the order of headings."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.headings: list[int] = []
        self.ids: list[str] = []
        self.tags: list[str] = []
        self.text = ""
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note tags, identifiers and addresses."""
        self.tags.append(tag)
        self.text += " " if tag in ("p", "td", "th") else ""
        if re.fullmatch("h[1-6]", tag):
            self.headings.append(int(tag[1]))
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            if name in ("src", "href", "xlink:href", "action", "data", "srcset"):
                self.loads.append(value or "")

    def handle_data(self, data: str) -> None:
        """Collect what is read, outside of style sheets."""
        if self.tags and self.tags[-1] != "style":
            self.text += data


def words(page: Page) -> str:
    """Return the text of a page with all spaces alike."""
    return re.sub(r"\s+", " ", page.text)


@contextmanager
def chromium() -> Iterator[Any]:
    """Start a browser without a network."""
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox", "--disable-gpu"]
        )
        yield browser
        browser.close()


def watch(browser: Any, path: Path, scheme: str = "light", width: int = 1280) -> tuple[Any, Any]:
    """Open a page; return it, and all messages and requests beside its own."""
    context = browser.new_context(
        offline=True, color_scheme=scheme, viewport={"width": width, "height": 800}
    )
    page = context.new_page()
    page.set_default_timeout(180_000)  # on a busy machine
    seen: list[str] = []
    page.on("console", lambda message: seen.append(message.text))
    page.on("pageerror", lambda error: seen.append(str(error)))

    def dismiss(dialog: Any) -> None:
        seen.append(dialog.message)
        dialog.dismiss()

    page.on("dialog", dismiss)
    outside = ("data:", path.as_uri())
    page.on(
        "request",
        lambda request: None if request.url.startswith(outside) else seen.append(request.url),
    )
    page.goto(path.as_uri())
    return page, seen


def worn(folder: Path, identity: str = "M7-Y") -> Assessment:
    """Give a machine whose preload and mount wear; its description is written to the folder."""
    travel, truth = life(8000, 0.68)
    history = make_history(identity, travel, truth)
    step = Step.found("step", 9, len(history.logs))
    event = Event("step", 9, "roll", "", 0.01, 1e-4, 12.5, False, 10)
    return Assessment(
        stage=write_stage(folder),
        history=replace(history, steps=(step,)),
        digests=tuple(f"{k:064x}" for k in range(len(history.logs))),
        track=replace(
            make_track(history, truth), events=(event,), steps=(step,), outliers=((7, "roll"),)
        ),
        health=make_health(history, truth),
        prognosis=make_prognosis(history, 8000, 0.68),
        judgement=Verdict(identity, history.recorded_at[-1], "both", 0.93, "It is so."),
        refused=(Refusal("a.csv", "gap", "31 % are missing", channel="acc_feed"),),
        notices=(Notice("mode-missing", "caution", "", "The temperature of 3 logs is missing."),),
        seed=0,
        waterfall=make_waterfall(history),
    )


def tables_of(assessment: Assessment) -> dict[str, list[Row]]:
    """Return the rows of the tables of a machine, as a run writes them."""
    return machine_tables(assessment, summarise(assessment, assessment.service()))


def leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every number, text, moment and array of a result, with its place."""
    if is_dataclass(value):
        value = {item.name: getattr(value, item.name) for item in fields(value)}
    elif hasattr(value, "__struct_fields__"):
        value = {"": type(value).__name__, **asdict(value)}
    elif isinstance(value, tuple):
        value = {"n": len(value), **dict(enumerate(value))}
    if isinstance(value, dict):
        yield path, list(value)
        for name, inner in value.items():
            yield from leaves(inner, f"{path}.{name}")
    elif isinstance(value, np.ndarray):
        yield path, (value.dtype.str, value.shape, value.tobytes())
    else:
        yield path, (type(value), repr(value))


def write_report(
    folder: Path,
    assessments: Sequence[Assessment],
    refused: Sequence[Refusal],
    *,
    earlier: Mapping[str, Summary] | None = None,
    today: date | None = None,
) -> list[Path]:
    """Write all pages as a run does; return those of the machines, most urgent first, and index."""
    names = file_names(one.judgement.stage for one in assessments)
    summaries = []
    for one in assessments:
        identity = one.judgement.stage
        before = (earlier or {}).get(identity)
        summary = summarise(one, one.service(), names[identity])
        day = today or summary.recorded_at.date()
        status = make_status(replace(one, today=day), summary)
        page = make_page(one, summary, before=before)
        summary = on_day(summary, status, day)
        write_text(folder / summary.file, date_page(page, summary, status))
        summaries.append(summary)
    index = write_index(folder, summaries, refused, today=today)
    return [*(folder / one.file for one in by_urgency(summaries)), index]
