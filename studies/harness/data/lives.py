"""Lives of simulated machines for several studies: the truth of every log, and estimates of it."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from datetime import datetime
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lmshealth import identify, read_log
from lmshealth.io.constants import LAST_MOMENT
from lmshealth.io.manifest import find_logs, read_manifest
from lmshealth.signal.readings import loop_error
from lmshealth.stage.description import load_stage
from lmshealth.tracking.history import History, Series, Step
from models.dynamics.plant import GUIDE_MODES, closed_loop_modes
from models.dynamics.stages import NOMINAL, Condition, Stage
from models.lives.degradation import draw_laws
from models.lives.simulation import Plan, Visit, schedule, simulate_life
from studies.harness.study import Trials

Array = NDArray[np.float64]

SECONDS = 20.0
DAMAGED = ("preload-wear", "mount-loosening", "both", "sudden-loosening", "crash")
HEALTHY = ("healthy", "temperature-only", "payload-change", "servo-retuning", "regreasing")
COVARIATES = ("temperature_c", "payload_kg")
RAW = "raw_lives"  # name of the file that keeps them
_FIELDS = ("ln_frequency", "ln_damping", "cov", "loop_error")
_SIZES_SEED = 7
# Of a dozen identified logs of each stage (20 s): medians of the standard deviations of ln f and
# ln ζ of roll, pitch and yaw, and scatter and jump (at the retuning) of the ln of the loop error.
_SIZES: dict[str, Any] = {
    "lms-y": {
        "median_std_ln_frequency":
            [0.0012876092413990504, 0.0010781502058618596, 0.0013689205749773865],
        "median_std_ln_damping": [0.10081697807916898, 0.07677341426717191, 0.07841702850568039],
        "ln_loop_error_scatter": 0.051752114732961214,
        "ln_loop_error_jump": -1.4783747102041005,
    },
    "lms-x": {
        "median_std_ln_frequency":
            [0.0016215925779128333, 0.0012199464910371805, 0.001336322507954427],
        "median_std_ln_damping": [0.18007474441592103, 0.04018668339940101, 0.09258308601184624],
        "ln_loop_error_scatter": 0.05775228448537332,
        "ln_loop_error_jump": -0.39161895272703795,
    },
}  # fmt: skip
_LOOP_ERROR = 1e-8  # in m; of it the jump and the scatter count alone


def rng_of(*key: int) -> np.random.Generator:
    """Return the generator of a part."""
    return np.random.default_rng([20261206, *key])


@dataclass(frozen=True, slots=True, eq=False)
class Life:
    """True state of a machine at all n logs."""

    stage: str
    kind: str
    seed: int  # of its plan
    recorded_at: tuple[datetime, ...]
    travel: Array  # odometer in m
    covariates: dict[str, Array]  # temperature in °C, payload in kg
    servo: NDArray[np.str_]  # tuning
    event: int | None  # first log after what happens once in this kind of life
    health: Array  # guide preload and mount stiffness over those at commissioning, (n, 2)
    ln_frequency: Array  # of roll, pitch and yaw, (n, 3)
    ln_damping: Array  # (n, 3)
    # Of ln frequency at the reference temperature, the nominal payload and the tuning of
    # commissioning, (n, 3)
    drift: Array
    regreased: tuple[int, ...] = ()  # first logs after regreasings that are declared


@dataclass(frozen=True, slots=True, eq=False)
class Estimates:
    """Estimates of every log of a life."""

    ln_frequency: Array  # (n, 3), NaN where a mode was not found
    ln_damping: Array  # (n, 3)
    cov: Array  # of both, (n, 6, 6)
    loop_error: Array  # RMS of the following error from 1 to 40 Hz in m, (n,)


def plan_of(stage: str, kind: str, seed: int, logs: int = 40) -> Plan:
    """Plan a life of logs of 20 s."""
    return Plan(stage, kind, logs, SECONDS, seed)


def life_of(plan: Plan) -> Life:
    """Take a life from its plan."""
    return life_with(plan, schedule(plan))


def life_with(plan: Plan, visits: Sequence[Visit]) -> Life:
    """Take a life whose visits are those of its plan, with other conditions."""
    machine, drawn_life = plan.machine().stage, plan.draw_life()
    conditions = [visit.condition for visit in visits]
    seen = np.array([_modes(visit.stage, visit.condition) for visit in visits])
    own = np.array([_modes(machine, _at_reference(condition))[0] for condition in conditions])
    travel_km = np.array([visit.travel_km for visit in visits])
    event = int(np.searchsorted(travel_km, draw_laws(plan.rng("laws")).event_km))
    happens = plan.life in ("crash", "sudden-loosening", "regreasing", "servo-retuning")
    return Life(
        stage=plan.stage,
        kind=plan.life,
        seed=plan.seed,
        recorded_at=tuple(visit.recorded_at for visit in visits),
        travel=1000.0 * travel_km,
        covariates={
            "temperature_c": np.array([visit.logged_temperature_c for visit in visits]),
            "payload_kg": np.array([visit.logged_payload_kg for visit in visits], dtype=float),
        },
        servo=np.array([one.servo_id for one in conditions]),
        event=event if happens and event < len(visits) else None,
        health=np.array([(one.guide_preload, one.mount_stiffness) for one in conditions]),
        ln_frequency=seen[:, 0],
        ln_damping=seen[:, 1],
        drift=own - own[0],
        regreased=_logs_after(
            [one.travel_km for one in drawn_life.work if one.action == "regrease"], travel_km
        ),
    )


def _logs_after(odometers_km: Sequence[float], travel_km: Array) -> tuple[int, ...]:
    """Return the first logs at or after odometers, each once; none after the last log."""
    first = np.unique(np.searchsorted(travel_km, odometers_km))
    return tuple(int(k) for k in first if k < travel_km.size)


def _at_reference(condition: Condition) -> Condition:
    """Return what wear and grease alone have made of a stage."""
    return replace(
        NOMINAL,
        guide_preload=condition.guide_preload,
        mount_stiffness=condition.mount_stiffness,
        guide_damping=condition.guide_damping,
    )


@lru_cache(maxsize=4096)
def _modes(stage: Stage, condition: Condition) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return ln frequency and ln damping of the guide modes."""
    modes = {mode.name: mode for mode in closed_loop_modes(stage, condition)}
    return (
        tuple(float(np.log(modes[name].frequency_hz)) for name in GUIDE_MODES),
        tuple(float(np.log(modes[name].damping_ratio)) for name in GUIDE_MODES),
    )


def drawn(life: Life, sizes: Estimates, sizes_of: Life, rng: np.random.Generator) -> Estimates:
    """Draw estimates about a life, each with the covariance of some really identified log.

    ``sizes`` are estimates of such logs, of both tunings, and ``sizes_of`` their truth.
    """
    n = len(life.recorded_at)
    picked = np.empty(n, dtype=int)
    loop = np.empty(n)
    for tuning in ("commissioning", "retuned"):
        own, like = life.servo == tuning, np.flatnonzero(sizes_of.servo == tuning)
        picked[own] = rng.choice(like, own.sum())
        values = np.log(sizes.loop_error[like])
        scatter = values.std(ddof=1) * rng.standard_normal(own.sum())
        loop[own] = np.exp(values.mean() + scatter)
    cov = sizes.cov[picked]
    errors = np.linalg.cholesky(cov) @ rng.standard_normal((n, cov.shape[1], 1))
    m = life.ln_frequency.shape[1]
    return Estimates(
        life.ln_frequency + errors[:, :m, 0], life.ln_damping + errors[:, m:, 0], cov, loop
    )


def history_of(
    life: Life,
    estimates: Estimates,
    *,
    declared: bool = True,
    covariates: tuple[str, ...] = COVARIATES,
    loop_error: bool = True,
) -> History:
    """Make the history that a tracker is given.

    ``declared``: logs have their ``servo_id``, and regreasing is recorded; ``covariates``: those
    that are known; ``loop_error``: whether the following error is.
    """
    n = len(life.recorded_at)
    return History(
        stage=f"{life.stage} {life.kind} {life.seed}",
        logs=tuple(f"log-{k + 1:04d}" for k in range(n)),
        recorded_at=life.recorded_at,
        travel=life.travel,
        covariates={name: life.covariates[name] for name in covariates},
        modes=GUIDE_MODES,
        series=tuple(Series(mode, "joint") for mode in GUIDE_MODES),
        ln_frequency=estimates.ln_frequency,
        ln_damping=estimates.ln_damping,
        cov=estimates.cov,
        loop_error=estimates.loop_error if loop_error else np.full(n, np.nan),
        baselines=(0,),
        steps=_declared(life) if declared else (),
    )


def _declared(life: Life) -> tuple[Step, ...]:
    """Return the steps that maintenance and metadata declare."""
    after = np.arange(life.travel.size)
    steps = [
        Step("regreasing", k, after >= k, name=f"{life.recorded_at[k]:%Y-%m-%d}")
        for k in life.regreased
    ]
    if life.event is not None and life.kind == "servo-retuning":
        k = life.event
        steps.append(Step("servo", k, after >= k, name=str(life.servo[k])))
    return tuple(steps)


def measured(stage: str, logs: int, kept: Path | None = None) -> tuple[Estimates, Life]:
    """Simulate and identify a few logs of both tunings, for `studies.harness.data.lives.drawn`."""
    plan = plan_of(stage, "servo-retuning", _SIZES_SEED, logs)
    return identified(plan, kept), life_of(plan)


def recorded(stage: str, logs: int = 8) -> tuple[Estimates, Life]:
    """Return what `measured` gives, from its recorded medians and without correlations."""
    record = _SIZES[stage]
    life = life_of(plan_of(stage, "servo-retuning", _SIZES_SEED, logs))
    std = np.array(record["median_std_ln_frequency"] + record["median_std_ln_damping"])
    tuned = life.servo != "commissioning"
    # Up and down by as much as the logarithms scatter, each tuning by itself.
    side = np.where(np.arange(logs) % 2, 1.0, -1.0)
    loop = record["ln_loop_error_jump"] * tuned + record["ln_loop_error_scatter"] * side
    cov = np.tile(np.diag(std**2), (logs, 1, 1))
    return Estimates(life.ln_frequency, life.ln_damping, cov, _LOOP_ERROR * np.exp(loop)), life


def identified(plan: Plan, cache: Path | None = None) -> Estimates:
    """Simulate a life and identify its logs, unless a file keeps that from before."""
    record = Trials(cache).once(
        partial(_identified, plan),
        type(plan).__name__,
        *astuple(plan),
        also=[type(plan).__module__],
    )
    return Estimates(*(np.array(record[field], dtype=float) for field in _FIELDS))


def _identified(plan: Plan, *_: object) -> dict[str, list[Any]]:
    with tempfile.TemporaryDirectory() as folder:
        simulate_life(plan, Path(folder))
        estimates = _identify_all(Path(folder), plan)
    return {field: getattr(estimates, field).tolist() for field in _FIELDS}


def _identify_all(folder: Path, plan: Plan) -> Estimates:
    """Identify the logs of a folder, in the order of recording."""
    stage, manifest = load_stage(plan.stage), read_manifest(folder)
    n, m = plan.logs, len(GUIDE_MODES)
    ln_f, ln_zeta, loop = np.full((n, m), np.nan), np.full((n, m), np.nan), np.full(n, np.nan)
    cov = np.full((n, 2 * m, 2 * m), np.nan)
    for k, path in enumerate(find_logs(folder).logs):
        log = read_log(path, overrides=manifest.overrides(path), name=path.name, latest=LAST_MOMENT)
        modes = identify(log, stage)
        # Those that were found: their places in the result and among the guide modes.
        at = [i for i, name in enumerate(modes.names) if name in GUIDE_MODES]
        to = [GUIDE_MODES.index(modes.names[i]) for i in at]
        ln_f[k, to], ln_zeta[k, to] = modes.ln_frequency[at], modes.ln_damping[at]
        rows = np.ix_([*to, *(i + m for i in to)], [*to, *(i + m for i in to)])
        own = np.array([*at, *(i + len(modes.names) for i in at)], dtype=int)
        cov[k][rows] = modes.cov[np.ix_(own, own)]
        error = loop_error(log)
        loop[k] = np.nan if error is None else error
    return Estimates(ln_f, ln_zeta, cov, loop)
