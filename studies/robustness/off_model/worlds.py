"""Lives that break assumptions of the estimator, drawn without `models` and without its laws.

A world is what is true of a machine and of its logs: the course of the preload over the travel, and
what disturbs the estimates. Each has a name in `WORLDS`; `life_of` draws one life of it, as a
history of estimates with what is true behind it. Frequencies follow the preload by the shipped map:
worlds test the courses and the disturbances, not the map.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.signal import lfilter

from lmshealth.calibration.lives import make_history
from lmshealth.stage.description import Stage
from lmshealth.tracking.history import History

Array = NDArray[np.float64]
MODES = ("roll", "pitch", "yaw")
LN_F, LN_ZETA = np.log([126.4, 136.6, 155.0]), np.log([0.0147, 0.0153, 0.0175])
# Standard deviations that the identification states, about the medians of logs of 20 s.
STD_F, STD_ZETA = np.array([1.3e-3, 1.1e-3, 1.4e-3]), np.array([0.10, 0.08, 0.08])
N_LOGS, DAYS, KM_PER_LOG = 40, 400, 150.0
# A preload that has lost this share is at its limit.
LOST_AT_LIMIT = 0.4
REFERENCE_C, NOMINAL_KG = 21.0, 20.0
# Hours of an outdoor record before the first log, so that a slow structure has settled.
_WARM_UP_H = 24 * 20
_START = datetime(2025, 4, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class World:
    """What is true of a machine and its logs; the defaults are what the estimator assumes."""

    # Course of the preload: "stable", "hertz", "late", "bathtub", "onset", "running-in", "shocks",
    # "loss-5" (5 % over all logs), "steps".
    course: str = "stable"
    # Wander of ln f from log to log: standard deviation in stated ones, correlation length in logs,
    # and the share of its variance that all modes have in common.
    wander: float = 0.0
    wander_logs: float = 5.0
    wander_common: float = 0.0
    # Factor on the stated errors; share of outlying estimates and their size in stated errors.
    scatter: float = 1.0
    outliers: float = 0.0
    outlier_size: float = 10.0
    student_dof: float = np.inf  # of the errors
    stated: float = 1.0  # factor on the standard deviations that the program states
    # Structure behind the sensor by first order in h, scatter of the sensor and its drift in K over
    # all logs.
    lag_h: float = 0.0
    sensor_std: float = 0.0
    sensor_drift: float = 0.0
    payload_std: float = 0.0  # kg that is carried and in no log
    winter: bool = True  # whether logs are recorded in winter
    mixed: float = 0.0  # share of logs that are those of another machine
    amplitude: float = 0.0  # change of ln f per doubled excitation, whose level nobody records


@dataclass(frozen=True, slots=True, eq=False)
class Life:
    """Estimates of a life with its truth. Travel in km since the first log."""

    world: str
    seed: int
    history: History
    travel_km: Array  # ``(n_logs,)``
    preload: Array  # at the logs, share of that at the first log, ``(n_logs,)``
    drift: Array  # of ln f since the first log, covariates apart, ``(n_logs, n_modes)``
    # True remaining life in km after each log, to the limit of the preload; inf where it is never
    # reached, ``(n_logs,)``.
    remaining_km: Array

    def first_logs(self, n: int) -> Life:
        """Return the life as it is known after its first n logs."""
        return replace(
            self,
            history=self.history.first_logs(n),
            travel_km=self.travel_km[:n],
            preload=self.preload[:n],
            drift=self.drift[:n],
            remaining_km=self.remaining_km[:n],
        )


_QUIET = World()
# Disturbances of a machine that does not wear, and of one that loses 5 % of its preload.
DISTURBANCES: dict[str, World] = {
    "control": _QUIET,
    "wander 0.5 sd, 5 logs": replace(_QUIET, wander=0.5),
    "wander 1 sd, 5 logs": replace(_QUIET, wander=1.0),
    "wander 2 sd, 5 logs": replace(_QUIET, wander=2.0),
    "wander 3 sd, 5 logs": replace(_QUIET, wander=3.0),
    "wander 3 sd, 2 logs": replace(_QUIET, wander=3.0, wander_logs=2.0),
    "wander 3 sd, 12 logs": replace(_QUIET, wander=3.0, wander_logs=12.0),
    "wander 3 sd, 5 logs, in common": replace(_QUIET, wander=3.0, wander_common=0.9),
    "scatter 4": replace(_QUIET, scatter=4.0),
    "stated 10 times too wide": replace(_QUIET, stated=10.0),
    "stated 10 times too narrow": replace(_QUIET, stated=0.1),
    "outliers 5 %, 10 sd": replace(_QUIET, outliers=0.05),
    "Student errors of 2.5": replace(_QUIET, student_dof=2.5),
    "lag 1 h": replace(_QUIET, lag_h=1.0, sensor_std=0.5),
    "lag 8 h": replace(_QUIET, lag_h=8.0, sensor_std=0.5),
    "lag 24 h": replace(_QUIET, lag_h=24.0, sensor_std=0.5),
    "sensor drifts by 5 K": replace(_QUIET, sensor_drift=5.0),
    "payload never logged": replace(_QUIET, payload_std=0.3),
    "winters missing": replace(_QUIET, winter=False),
    "two machines mixed": replace(_QUIET, mixed=0.1),
    "amplitude": replace(_QUIET, amplitude=2e-3),
}
COURSES: dict[str, World] = {
    name: World(course=name)
    for name in ("hertz", "late", "bathtub", "onset", "running-in", "shocks", "steps")
}
WORLDS: dict[str, World] = {
    **DISTURBANCES,
    **COURSES,
    **{f"{name}, losing 5 %": replace(w, course="loss-5") for name, w in DISTURBANCES.items()},
}
"""Every world by name: disturbances of a stable machine, courses, disturbances of a losing one."""


def life_of(name: str, seed: int, stage: Stage) -> Life:
    """Draw one life of a world; ``stage`` is lms-y, whose map gives the frequencies."""
    world, rng = WORLDS[name], np.random.default_rng([seed, zlib.crc32(name.encode())])
    hours = _log_hours(rng, world)
    travel = KM_PER_LOG * N_LOGS * (hours - hours[0]) / (hours[-1] - hours[0])
    lost = _course(rng, world.course, float(travel[-1]))
    at_logs = np.array([lost(s) for s in travel])
    preload = (1 - at_logs) / (1 - at_logs[0])
    point = np.tile(stage.baseline_point, (N_LOGS, 1))
    point[:, 0] += np.log(preload)
    drift = stage.drift(point, MODES)
    end = _end(lost, float(travel[-1]))
    covariates, moved = _covariates(rng, world, hours)
    moved = moved + _wander(rng, world) + _others(rng, world)
    history = _estimates(rng, world, (travel, hours), drift + moved, covariates)
    return Life(name, seed, history, travel, preload, drift, end - travel)


def _log_hours(rng: np.random.Generator, world: World) -> Array:
    """Draw the hours of the logs since the start: days at random, between 6 and 22 o'clock."""
    days = np.arange(DAYS)
    if not world.winter:  # November to March
        days = days[(days % 365 < 214) | (days % 365 >= 334)]
    chosen = np.sort(rng.choice(days, N_LOGS, replace=False))
    return np.asarray(24.0 * chosen + rng.uniform(6, 22, N_LOGS))


class _Course:
    """Share of the preload that is lost over the travel in km."""

    def __init__(self, *parts: tuple[str, float, float, float]) -> None:
        # Kind, size, scale in km, exponent or onset in km.
        self.parts = parts

    def __call__(self, s: float) -> float:
        total = 0.0
        for kind, size, scale, more in self.parts:
            if kind == "power":
                total += size * (s / scale) ** more
            elif kind == "settling":
                total += size * float(-np.expm1(-s / scale))
            elif kind == "ramp":
                total += size * max(s - more, 0.0) / scale
            else:
                total += size * (s >= more)
        return total


def _course(rng: np.random.Generator, kind: str, seen: float) -> _Course:
    """Draw a course of which `seen` km are logged."""
    share = rng.uniform(0.5, 0.85)  # of the life that is logged
    life, full = seen / share, LOST_AT_LIMIT
    if kind == "hertz":
        return _Course(("power", full, life, rng.uniform(0.8, 1.3)))
    if kind == "late":
        slow = rng.uniform(0.1, 0.3)
        late = ("power", full * (1 - slow), life, rng.uniform(5, 9))
        return _Course(("power", full * slow, life, 1.0), late)
    if kind == "bathtub":
        early, quiet = rng.uniform(0.02, 0.05), rng.uniform(0.02, 0.05)
        end = ("power", full - early - quiet, life, rng.uniform(7, 11))
        return _Course(("settling", early, 0.03 * life, 0.0), ("power", quiet, life, 1.0), end)
    if kind == "onset":
        onset = seen * rng.uniform(0.3, 0.8)
        return _Course(("ramp", full, life - onset, onset))
    if kind == "running-in":
        return _Course(("settling", rng.uniform(0.06, 0.12), rng.uniform(40, 150), 0.0))
    if kind == "shocks":
        places = np.cumsum(rng.exponential(seen / 4, 40))
        sizes = rng.exponential(0.03, 40)
        return _Course(*(("jump", z, 0.0, at) for z, at in zip(sizes, places, strict=True)))
    if kind == "steps":
        return _Course(("jump", rng.uniform(0.05, 0.15), 0.0, seen * rng.uniform(0.3, 0.8)))
    if kind == "loss-5":
        return _Course(("power", 0.05, seen, 1.0))
    return _Course()


def _end(lost: _Course, seen: float) -> float:
    """Return the travel in km at which the preload reaches its limit, inf if it never does."""
    far = 50 * seen

    def excess(s: float) -> float:
        return lost(s) - LOST_AT_LIMIT * (1 - lost(0.0)) - lost(0.0)

    return float(brentq(excess, 0.0, far, xtol=1e-3)) if excess(far) > 0 else np.inf


def _covariates(
    rng: np.random.Generator, world: World, hours: Array
) -> tuple[dict[str, Array], Array]:
    """Draw what the logs say of temperature and payload, and how ln f follows the truth."""
    grid = np.arange(-_WARM_UP_H, hours[-1] + 1)
    year, day = rng.uniform(0, 2 * np.pi), 2 * np.pi * (grid % 24 - 15) / 24
    weather = lfilter([np.sqrt(1 - np.exp(-2 / 72))], [1, -np.exp(-1 / 72)],
                      rng.standard_normal(grid.size))  # fmt: skip
    air = 6 * np.sin(2 * np.pi * grid / (24 * 365) + year) + 3 * np.cos(day) + weather
    keep = np.exp(-1 / world.lag_h) if world.lag_h else 0.0
    structure = lfilter([1 - keep], [1, -keep], air)
    shown, felt = np.interp(hours, grid, air), np.interp(hours, grid, structure)
    shown = shown + world.sensor_std * rng.standard_normal(N_LOGS)
    shown = shown + world.sensor_drift * np.linspace(0, 1, N_LOGS)
    per_kelvin = -8e-4 * np.exp(0.4 * rng.standard_normal(len(MODES)))
    payload = NOMINAL_KG + rng.choice([0.0, 0.5, 1.0], N_LOGS, p=[0.8, 0.1, 0.1])
    unseen = world.payload_std * rng.standard_normal(N_LOGS)
    per_kg = -0.012 * np.exp(0.3 * rng.standard_normal(len(MODES)))
    moved = felt[:, None] * per_kelvin + (payload - NOMINAL_KG + unseen)[:, None] * per_kg
    return {"temperature_c": REFERENCE_C + shown, "payload_kg": payload}, moved


def _wander(rng: np.random.Generator, world: World) -> Array:
    """Draw stationary AR(1) wander of ln f, ``(n_logs, n_modes)``."""
    keep = np.exp(-1 / world.wander_logs)
    white = rng.standard_normal((N_LOGS + 100, len(MODES) + 1))
    paths = lfilter([np.sqrt(1 - keep**2)], [1, -keep], white, axis=0)[100:]
    common = np.sqrt(world.wander_common)
    rest = np.sqrt(1 - world.wander_common)
    return np.asarray(world.wander * STD_F * (common * paths[:, -1:] + rest * paths[:, :-1]))


def _others(rng: np.random.Generator, world: World) -> Array:
    """Draw what excitation and a second machine among the logs change, ``(n_logs, n_modes)``."""
    level = rng.standard_normal((N_LOGS, 1))
    moved = -world.amplitude * level * rng.uniform(0.5, 1.5, len(MODES))
    other = rng.random((N_LOGS, 1)) < world.mixed
    other[0] = False
    return np.asarray(moved + other * 0.01 * rng.standard_normal(len(MODES)))


def _estimates(
    rng: np.random.Generator,
    world: World,
    clock: tuple[Array, Array],
    ln_f: Array,
    covariates: dict[str, Array],
) -> History:
    """Draw estimates about the true ln f, and damping ratios about constant ones."""
    travel, hours = clock
    m = len(MODES)
    std = np.concatenate([STD_F, STD_ZETA]) * np.exp(0.15 * rng.standard_normal((N_LOGS, 2 * m)))
    errors = rng.standard_normal((N_LOGS, 2 * m))
    if np.isfinite(world.student_dof):
        errors *= np.sqrt(world.student_dof / rng.chisquare(world.student_dof, errors.shape))
    outlying = rng.random((N_LOGS, m)) < world.outliers
    errors[:, :m] = np.where(outlying, world.outlier_size, 1.0) * errors[:, :m]
    errors = world.scatter * std * errors
    stated = world.stated * std
    values = (LN_F + ln_f + errors[:, :m], LN_ZETA + errors[:, m:])
    cov = stated[:, :, None] * stated[:, None, :] * np.eye(2 * m)
    history = make_history(MODES, 1000 * travel, (*values, cov), covariates=covariates)
    moments = tuple(_START + timedelta(hours=float(h)) for h in hours)
    return replace(history, recorded_at=moments)
