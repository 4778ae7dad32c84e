"""Small lives for tests: a stage whose modal map is known in closed form, and histories on it.

Ln frequency is linear in ln parameter with one bend, so that a Chebyshev surrogate of degree two
is exact and a test can compare with the formula itself.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from threadpoolctl import threadpool_info

from lmshealth._private.arrays import FloatArray
from lmshealth.io.log import Metadata
from lmshealth.life import constants
from lmshealth.life.health import Health
from lmshealth.life.posterior.fit import LoneMode
from lmshealth.life.posterior.likelihood import NO_MODE
from lmshealth.life.prognosis import Prognosis
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.modal.modes import Modes
from lmshealth.stage.description import Stage, load_stage
from lmshealth.tracking.filters.kalman_filters import Nuisances
from lmshealth.tracking.history import History, Series, Step, StepKind
from lmshealth.tracking.track import Track

MODES = ("roll", "pitch", "yaw")
FREQUENCY = np.array([126.4, 136.6, 155.0])
DAMPING = np.array([0.018, 0.015, 0.017])
BEND = 0.01
START = datetime(2026, 3, 1, 6, 0, tzinfo=UTC)
# What ln parameter does to ln frequency of each mode; nothing sees "foot".
SENSITIVITY = {
    "guide_preload": np.array([0.08, 0.11, 0.10]),
    "mount_stiffness": np.array([0.27, 0.18, 0.05]),
    "foot": np.zeros(3),
}
AXES = {
    "guide_preload": np.geomspace(0.2, 1.5, 7),
    "mount_stiffness": np.geomspace(0.25, 1.6, 7),
    "foot": np.geomspace(0.4, 2.5, 4),
}
PRELOAD = """
name = "guide_preload"
prior = { kind = "lognormal", median = 1.0, sigma = 0.3 }
limit = { below = 0.6 }
law = { kind = "hertz-wear", life_km = { kind = "lognormal", median = 8000, sigma = 1.0 } }
"""
MOUNT = """
name = "mount_stiffness"
prior = { kind = "lognormal", median = 1.0, sigma = 0.3 }
limit = { below = 0.7 }

[parameter.law]
kind = "loosening"
life_km = { kind = "lognormal", median = 4000, sigma = 1.0 }
floor = { kind = "uniform", low = 0.3, high = 1.0 }
"""
FADING = """
name = "guide_preload"
prior = { kind = "lognormal", median = 1.0, sigma = 0.3 }
limit = { below = 0.6 }
law = { kind = "linear", rate_per_km = { kind = "normal", mean = 0.0, std = 2e-4 } }
"""
NO_LAW = 'law = { kind = "none" }\n'
STILL_MOUNT = MOUNT[: MOUNT.index("[parameter.law]")] + NO_LAW
SEEN_BY_NONE = """
name = "foot"
prior = { kind = "lognormal", median = 1.0, sigma = 0.2 }
"""
FOOT = SEEN_BY_NONE + NO_LAW
TEMPERATURE = """
[[covariate]]
name = "temperature_c"
reference = 21.0
prior_std = 0.001
"""
# No change without a law, no mode that moves alone, and no wander that all have in common.
LAWS_ALONE = """
[life]
free = 0
lone_mode = 0
common_wander = 0
"""
# Temperature with a curvature, and payload.
TWO = """
[[covariate]]
name = "temperature_c"
reference = 21.0
prior_std = 0.001
curvature_std = 0.0001

[[covariate]]
name = "payload_kg"
reference = 50.0
prior_std = 0.0005
"""


@contextmanager
def four_settings() -> Iterator[None]:
    """Average lives over two walks and two deviations alone, of one noise scale."""
    small: dict[str, Any] = {
        "WALK_STDS": (1e-5, 1.5e-3),
        "WALK_PRIOR": (0.5, 0.5),
        "NOISE_SCALES": (1.0,),
        "NOISE_SCALE_PRIOR": (1.0,),
        "DEVIATION_STDS": (0.0, 0.01),
        "DEVIATION_PRIOR": (0.5, 0.5),
    }
    with patch.multiple(constants, **small):
        yield


def true_drift(names: Sequence[str], x: FloatArray) -> FloatArray:
    """Drift of all modes at ln parameters ``(..., n_parameters)``, by the formula of the map."""
    slopes = np.array([SENSITIVITY[name] for name in names])
    return x @ slopes + BEND * x[..., :1] ** 2


def stage_text(
    parameters: Sequence[str] = (PRELOAD, MOUNT),
    *,
    n_modes: int = 2,
    model_std: float = 0.05,
    common_std: float = 0.0,
    tail: str = TEMPERATURE,
) -> str:
    """Write a stage description."""
    parts = ['name = "small"']
    for name, f, zeta in zip(MODES[:n_modes], FREQUENCY, DAMPING, strict=False):
        parts.append(f'[[mode]]\nname = "{name}"\nfrequency_hz = {f}\ndamping_ratio = {zeta}')
    parts += [f"[[parameter]]{parameter}" for parameter in parameters]
    if parameters:
        parts.append(f'[map]\nfile = "map.csv"\nmodel_std = {model_std}')
        parts += [f"common_std = {common_std}"] * (common_std > 0)
    return "\n".join([*parts, tail])


def map_rows(names: Sequence[str], n_modes: int = 2) -> list[str]:
    """Write the lines of a modal map, header first."""
    rows = [",".join([*names, "mode", "frequency_hz"])]
    for values in product(*(AXES[name] for name in names)):
        f = FREQUENCY * np.exp(true_drift(names, np.log(np.array(values))))
        for mode, value in zip(MODES[:n_modes], f, strict=False):
            rows.append(",".join([*(f"{v:.17g}" for v in values), mode, f"{value:.17g}"]))
    return rows


def make_stage(
    folder: Path,
    parameters: Sequence[str] = (PRELOAD, MOUNT),
    *,
    n_modes: int = 2,
    model_std: float = 0.05,
    common_std: float = 0.0,
    tail: str = TEMPERATURE,
) -> Stage:
    """Write a stage with its map into a folder and load it."""
    text = stage_text(
        parameters, n_modes=n_modes, model_std=model_std, common_std=common_std, tail=tail
    )
    names = [re.findall(r'name = "(\w+)"', parameter)[0] for parameter in parameters]
    folder.mkdir(parents=True, exist_ok=True)
    if parameters:
        (folder / "map.csv").write_text("\n".join(map_rows(names, n_modes)) + "\n")
    path = folder / "small.toml"
    path.write_text(text)
    return load_stage(str(path))


def make_history(
    ln_frequency: FloatArray,
    *,
    travel: FloatArray | None = None,
    cov: FloatArray | None = None,
    std: float = 1e-3,
    ln_damping: FloatArray | None = None,
    temperature: FloatArray | None = None,
    baseline: int = 0,
) -> History:
    """Make a history of the first modes by accelerometers; NaN ln f: all of the mode is missing."""
    n, m = ln_frequency.shape
    travel = np.linspace(2.0e5, 2.2e6, n) if travel is None else travel
    if cov is None:
        cov = np.tile(np.diag(np.r_[np.full(m, std**2), np.full(m, 0.05**2)]), (n, 1, 1))
    cov = np.array(cov)
    if ln_damping is None:
        ln_damping = np.tile(np.log(DAMPING[:m]), (n, 1))
    missing = np.isnan(ln_frequency)
    ln_damping = np.where(missing, np.nan, ln_damping)
    gone = np.hstack([missing, missing])
    cov[gone[:, :, None] | gone[:, None, :]] = np.nan
    return History(
        stage="AX-1",
        logs=tuple(f"{k:03d}.csv" for k in range(n)),
        recorded_at=tuple(START + timedelta(days=7 * k) for k in range(n)),
        travel=np.array(travel, dtype=float),
        covariates={} if temperature is None else {"temperature_c": np.array(temperature)},
        modes=MODES[:m],
        series=tuple(Series(mode, "acc") for mode in MODES[:m]),
        ln_frequency=np.array(ln_frequency),
        ln_damping=ln_damping,
        cov=cov,
        loop_error=np.full(n, np.nan),
        baselines=(baseline,),
    )


def since(kind: StepKind, first: int, n: int, source: str = "", name: str = "") -> Step:
    """Make a declared step that all logs from one on see."""
    return Step(kind, first, np.arange(n) >= first, source, name)


def rough_history(rng: np.random.Generator, *, baseline: int = 0, n: int = 10) -> History:
    """Make a history of two modes with everything that can be awkward.

    Irregular odometer that stands still once, covariances across modes and between frequency and
    damping, a mode missing here and there, one log without any mode, one without temperature.
    """
    m = 2
    travel = np.cumsum(np.r_[3e5, rng.uniform(1e4, 4e5, n - 1)])
    travel[6] = travel[5]
    temperature = 21 + 5 * rng.standard_normal(n)
    root = rng.standard_normal((n, 2 * m, 2 * m)) * np.r_[2e-3, 1e-3, 0.05, 0.08][:, None]
    cov = root @ np.swapaxes(root, 1, 2) + np.diag([1e-6, 1e-6, 1e-3, 1e-3])
    level = np.log(FREQUENCY[:m]) - 0.02 * (travel - travel[0])[:, None] / np.ptp(travel)
    ln_f = level - 4e-4 * (temperature[:, None] - 21) + 2e-3 * rng.standard_normal((n, m))
    ln_z = np.log(DAMPING[:m]) + 0.08 * rng.standard_normal((n, m))
    ln_f[2, 0] = ln_f[7, 1] = np.nan
    ln_f[4] = np.nan
    temperature[3] = np.nan
    return make_history(
        ln_f, travel=travel, cov=cov, ln_damping=ln_z, temperature=temperature, baseline=baseline
    )


def awkward_history(rng: np.random.Generator, n: int = 16) -> History:
    """Make a history of two modes by two sources in which everything that a history may have is.

    Irregular odometer that stands still once, errors common to both sources, series that miss here
    and there, one log without any, unknown covariates, a second baseline after work, and steps of
    every kind, of which a retuning is taken back.
    """
    m, r = 2, 4
    series = tuple(Series(mode, source) for source in ("acc", "delta_e") for mode in MODES[:m])
    travel = np.cumsum(np.r_[3e5, rng.uniform(1e4, 4e5, n - 1)])
    travel[6] = travel[5]
    temperature, payload = 21 + 5 * rng.standard_normal(n), 40 + 20 * rng.random(n)
    std = np.r_[np.tile([2e-3, 1e-3], 2), np.tile([0.05, 0.08], 2)]
    # Both sources see the same excitation: most of their errors is common.
    common = np.kron(np.eye(2), np.kron(np.sqrt([[0.1, 0.9], [0.0, 1.0]]), np.eye(m)))
    root = std[:, None] * (common + 0.2 * rng.standard_normal((n, 2 * r, 2 * r)))
    cov = root @ np.swapaxes(root, 1, 2)
    noise = (root @ rng.standard_normal((n, 2 * r, 1)))[:, :, 0]
    level = np.log(FREQUENCY[:m]) - 0.02 * (travel - travel[0])[:, None] / np.ptp(travel)
    level = level - 4e-4 * (temperature[:, None] - 21) - 1e-5 * (payload[:, None] - 50) ** 2
    level[9:] += 0.03
    values = np.hstack([level, level + 2e-3, np.tile(np.log(DAMPING[:m]), (n, 2))]) + noise
    for k, rows in ((0, [1, 5]), (2, [0, 4]), (4, range(8)), (7, [3, 7]), (11, [0, 1, 4, 5])):
        values[k, list(rows)] = np.nan
    gone = np.isnan(values)
    cov[gone[:, :, None] | gone[:, None, :]] = np.nan
    temperature[3] = payload[[3, 8]] = np.nan
    servo = Step("servo", 5, (np.arange(n) >= 5) & (np.arange(n) < 12), name="v2")
    return History(
        stage="AX-1",
        logs=tuple(f"{k:03d}.csv" for k in range(n)),
        recorded_at=tuple(START + timedelta(days=7 * k) for k in range(n)),
        travel=travel,
        covariates={"temperature_c": temperature, "payload_kg": payload},
        modes=MODES[:m],
        series=series,
        ln_frequency=values[:, :r],
        ln_damping=values[:, r:],
        cov=cov,
        loop_error=np.full(n, np.nan),
        baselines=(1, 9),
        steps=(
            since("step", 3, n),
            servo,
            since("regreasing", 6, n),
            since("reset", 9, n),
            since("sensor", 13, n, source="delta_e"),
        ),
    )


def seen_by(
    rng: np.random.Generator,
    ln_frequency: FloatArray,
    ln_damping: FloatArray,
    *,
    sources: Sequence[str] = ("acc", "delta_e"),
    std: tuple[float, float] = (5e-4, 0.05),
    common: float = 0.9,
    bias: float = 2e-3,
) -> History:
    """Make a history of true modes ``(n, m)`` seen by sources whose errors are correlated.

    Every source but the first reads ln f too high by a multiple of the bias.
    """
    n, m = ln_frequency.shape
    s = len(sources)
    shared = np.kron(np.full((s, s), common) + (1 - common) * np.eye(s), np.eye(m))
    spread = np.repeat(std, s * m)
    cov = np.outer(spread, spread) * np.kron(np.eye(2), shared)
    noise = rng.multivariate_normal(np.zeros(2 * s * m), cov, size=n, method="cholesky")
    ln_f = np.hstack([ln_frequency + j * bias for j in range(s)])
    history = make_history(ln_frequency, ln_damping=ln_damping)
    return replace(
        history,
        series=tuple(Series(mode, source) for source in sources for mode in history.modes),
        ln_frequency=ln_f + noise[:, : s * m],
        ln_damping=np.tile(ln_damping, s) + noise[:, s * m :],
        cov=np.tile(cov, (n, 1, 1)),
    )


def cut(history: History, n: int) -> History:
    """Give the first logs of a history."""
    return history.first_logs(n)


def plain_nuisances(n: int, n_series: int) -> Nuisances:
    """Make the nuisances of a machine whose modes hardly move by themselves, of one source."""
    none, one = np.zeros(n), np.ones(n)
    return Nuisances(
        level_walk=1e-6 * one,
        rate_walk=0.01 * one,
        settling=none,
        running_in=none,
        wander=none,
        wander_keep=none,
        scales=np.ones((n, 1)),
        moved=none,
        weight=np.ones((n, 2 * n_series)),
        reopened=np.zeros(n, dtype=bool),
    )


def make_track(drift: FloatArray, cov: FloatArray) -> Track:
    """Make a track of given drifts ``(n, m)`` with covariances ``(n, m, m)``."""
    n, m = drift.shape
    std = np.sqrt(np.einsum("kii->ki", cov))
    return Track(
        stage="AX-1",
        logs=tuple(f"{k:03d}.csv" for k in range(n)),
        recorded_at=tuple(START + timedelta(days=7 * k) for k in range(n)),
        travel=np.linspace(0.0, 1e6, n),
        modes=MODES[:m],
        sources=("acc",),
        ln_frequency=np.log(FREQUENCY[:m]) + drift,
        ln_frequency_std=std,
        ln_damping=np.tile(np.log(DAMPING[:m]), (n, 1)),
        ln_damping_std=np.full((n, m), 0.05),
        drift=np.array(drift),
        drift_cov=np.array(cov),
        effects=(),
        events=(),
        steps=(),
        outliers=(),
        nis=np.full(n, 2.0 * m),
        nis_dof=np.full(n, 2.0 * m),
        innovations=np.zeros((n, 2 * m)),
        noise_scale=np.ones((n, 1)),
        widening=np.ones(n),
        nuisances=plain_nuisances(n, m),
    )


def make_health(
    samples: FloatArray,
    *,
    parameters: Sequence[str] = ("guide_preload", "mount_stiffness"),
    informed: Sequence[float] = (0.9, 0.9),
    fit: float = 0.4,
    lone: np.ndarray | None = None,
    lone_modes: tuple[LoneMode, ...] = (),
) -> Health:
    """Make the health of one epoch from draws, shape ``(n_draws, n_parameters)``.

    `lone` is the index of the mode that moves alone in each draw, by default none.
    """
    return health_of(
        np.array(samples)[None],
        recorded_at=(START,),
        travel=np.array([1e6]),
        parameters=tuple(parameters),
        informed=np.array([informed], dtype=float),
        fit=fit,
        lone=lone,
        lone_modes=lone_modes,
    )


def health_of(
    samples: FloatArray,
    *,
    recorded_at: tuple[datetime, ...],
    travel: FloatArray,
    parameters: tuple[str, ...],
    informed: FloatArray,
    stage: str = "AX-1",
    fit: float = 0.4,
    lone: np.ndarray | None = None,
    lone_modes: tuple[LoneMode, ...] = (),
) -> Health:
    """Make a health of draws, ``(n_epochs, n_draws, n_parameters)``; the rest is unremarkable."""
    n, n_draws, p = samples.shape
    with np.errstate(invalid="ignore"):  # draws that are all alike have no correlation
        rho = [np.atleast_2d(np.corrcoef(one, rowvar=False)) for one in samples]
    return Health(
        stage=stage,
        recorded_at=recorded_at,
        travel=travel,
        parameters=parameters,
        chains=samples.reshape(n, 2, n_draws // 2, p),
        modes=MODES,
        lone=(np.full(n_draws, NO_MODE) if lone is None else lone).reshape(2, n_draws // 2),
        lone_modes=lone_modes,
        sampler=("emcee",) * n,
        ess_bulk=np.full((n, p), 2150.0),
        ess_tail=np.full((n, p), 1000.0),
        r_hat=np.full((n, p), 1.001),
        informed=informed,
        prior_width=np.ones((n, p)),
        identifiable=np.ones((n, p), dtype=bool),
        correlation=np.stack(rho),
        judge_shift=np.full((n, p), 0.01),
        judge_ratio=np.full((n, p), 1.01),
        fit=np.full(n, fit),
        at_edge=np.zeros((n, p), dtype=bool),
        seed=(0,),
    )


def make_prognosis(remaining: FloatArray, usage: FloatArray, *, horizon: float = 1e7) -> Prognosis:
    """Make a prognosis of one limit from draws of the remaining travel in m."""
    return Prognosis(
        stage="AX-1",
        recorded_at=START,
        travel=1e6,
        parameters=("guide_preload", "any"),
        unidentifiable=(),
        limits=np.array([0.6, np.nan]),
        remaining=np.column_stack([remaining, remaining]),
        usage=np.array(usage),
        usage_now=np.array(usage),
        half=remaining[:, None] / 2,
        horizon=horizon,
        health=np.full((remaining.size, 1), 0.8),
        curve_travel=np.linspace(0, 1e6, 3),
        curve_quantiles=np.full((5, 3, 1), 0.8),
        laws=(),
        chi_square=10.0,
        degrees_of_freedom=10.0,
        walk=1e-3,
        noise_scale=1.0,
        deviation=0.0,
        ess=1000.0,
        r_hat=1.001,
    )


def make_reading(
    log: str,
    day: float,
    travel: float,
    modes: dict[str, float],
    *,
    baseline: bool | None = None,
    covariates: dict[str, float] | None = None,
) -> LogEstimates:
    """Make the reading of one log from ln frequencies by mode name."""
    m = len(modes)
    root = np.arange(1.0, 4 * m * m + 1).reshape(2 * m, 2 * m) * 1e-4
    return LogEstimates(
        log=log,
        digest=f"digest of {log}",
        metadata=Metadata(
            stage="AX-1",
            recorded_at=START + timedelta(days=day),
            travel=travel,
            covariates=covariates or {},
            baseline=baseline,
        ),
        modes=Modes(
            names=tuple(modes),
            sources=("acc",) * m,
            channels=("acc_feed",) * m,
            ln_frequency=np.array(list(modes.values()), dtype=float),
            ln_damping=np.log(0.01) + 0.1 * np.arange(m),
            cov=root @ root.T + 1e-8 * np.eye(2 * m),
            snr=np.full(m, 200.0),
            dispersion=np.ones(m),
            flags=("",) * m,
            shape_channels=(),
            shapes=np.empty((m, 0)),
            lines=(),
            refused=(),
        ),
    )


def threads() -> set[int]:
    """Count the threads that each library of linear algebra may use now."""
    return {one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas"}
