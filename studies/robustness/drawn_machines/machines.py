"""What the estimator finds on one machine: alarms, health, remaining life, modes of raw logs."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from lmshealth import identify, read_log
from lmshealth.calibration.ranks import place as rank_of
from lmshealth.errors import LmshealthError
from lmshealth.io.constants import LAST_MOMENT
from lmshealth.io.manifest import find_logs, read_manifest
from lmshealth.life.health import health_of
from lmshealth.life.posterior.fit import fit_life
from lmshealth.life.prognosis import prognosis_of
from lmshealth.life.verdict import degraded_below, doubt_of_names, judge, verdict_of
from lmshealth.stage.description import Stage, load_stage
from lmshealth.tracking.history import History
from lmshealth.tracking.track import Track, accepted_estimates, track
from models.dynamics.plant import GUIDE_MODES, closed_loop_modes
from models.lives.degradation import HertzWear, Loosening, Steady
from models.lives.simulation import Plan, schedule, simulate_life
from models.lives.wear_families import Product, Settling
from studies.harness import metrics
from studies.harness.data.lives import (
    SECONDS,
    Array,
    Life,
    drawn,
    history_of,
    life_of,
    recorded,
    rng_of,
)
from studies.harness.study import Row

STAGE = "lms-y"
PARAMETERS = ("guide_preload", "mount_stiffness")
RISK = 0.05
_LEVELS = (0.05, 0.5, 0.95)
_KM = 1000.0
# Part of its life after which a machine that fails is looked at, if it has not been before.
_SEEN_PART = (0.3, 0.95)
_KNOWN = (Steady, HertzWear, Loosening)


@dataclass(frozen=True, slots=True)
class InService(Plan):
    """A life that is looked at before its end: no machine is past a limit."""

    def end_km(self, now_km: float) -> float:
        """Return the odometer (km) of the last log: now, or at a random part of the life."""
        failure = self.draw_life().failure_km()
        part = float(self.rng("seen").uniform(*_SEEN_PART))
        return now_km if failure is None else min(now_km, part * failure)


def plan_of(kind: str, seed: int, logs: int, *, is_drawn: bool) -> InService:
    """Plan a life of a drawn or of the nominal machine."""
    return InService(STAGE, kind, logs, SECONDS, seed, plant_seed=seed if is_drawn else None)


def estimated(plan: Plan) -> tuple[Life, History]:
    """Return the truth of a life, and a history of estimates about its modes."""
    life = life_of(plan)
    key = (51, plan.seed, len(plan.life), int(plan.plant_seed is not None))
    return life, history_of(life, drawn(life, *recorded(STAGE), rng_of(*key)))


def followed(kind: str, seed: int, is_drawn: bool, logs: int) -> Row:
    """Track one life: alarms and steps that nobody declared, beside what has changed."""
    life, history = estimated(plan_of(kind, seed, logs, is_drawn=is_drawn))
    stage = load_stage(STAGE)
    return _tracked(life, history, track(history, stage), stage)


def _tracked(life: Life, history: History, found: Track, stage: Stage) -> Row:
    """Return what a track raises: what is true of the change, alarms, steps, doubt of names."""
    kept = life.health.min(axis=0) / life.health[0]
    return {
        "least_health": kept.min().item(),
        "alarm": bool(found.alarms),
        "step": any(not one.declared and one.changes_modes for one in found.steps),
        "consistent": found.consistency().holds,
        "doubt": bool(doubt_of_names(stage, history, found)),
    }


def reported(kind: str, seed: int, is_drawn: bool, logs: int) -> Row:
    """Take one life to its prognosis, and compare with its truth."""
    plan = plan_of(kind, seed, logs, is_drawn=is_drawn)
    life, history = estimated(plan)
    stage, rng = load_stage(STAGE), rng_of(52, seed, int(is_drawn))
    found = track(history, stage)
    truth = life.health[-1] / life.health[0]
    laws = plan.draw_life()
    row = _tracked(life, history, found, stage) | {
        "health": truth.tolist(),
        "known": all(_is_known(law) for law in (laws.preload, laws.mount)),
        "laws": [type(_inner(law)).__name__ for law in (laws.preload, laws.mount)],
    }
    accepted = accepted_estimates(history, found)
    try:
        posterior = fit_life(accepted, stage, [53, seed], chains=False)
        prognosis = prognosis_of(posterior, accepted, stage)
    except LmshealthError as why:
        return row | {"refused": str(why)}
    health = health_of(posterior, accepted, stage, [len(history.logs) - 1])
    verdict = judge(stage, history, health, found)
    row |= {"verdict": verdict.verdict, "probability": _number(verdict.probability),
            "true_verdict": _true_verdict(stage, truth)}  # fmt: skip
    left, horizon = _left(plan, life), prognosis.horizon
    row["now"] = _placed(health.samples[-1], truth, rng)
    row["left"] = _placed(prognosis.remaining, left, rng, horizon) | {
        "horizon_km": horizon / _KM, "km": [_number(km) for km in left / _KM],
    }  # fmt: skip
    first = prognosis.remaining[:, -1:]
    service = metrics.service_at(first, RISK, horizon=horizon)[0]
    return row | {
        "service_km": float(service) / _KM,
        "too_late": bool(metrics.unexpected_breaks(service, left[-1])),
        "has_service": bool(service < horizon),
        "chi_square": prognosis.chi_square / prognosis.degrees_of_freedom,
    }


def _inner(law: Any) -> Any:
    """Return a law without the running-in of its machine."""
    return law.first if isinstance(law, Product) and isinstance(law.second, Settling) else law


def _is_known(law: Any) -> bool:
    """Return whether the description has the family of a law; of running-in it has none."""
    return isinstance(_inner(law), _KNOWN)


def _number(value: float) -> float | None:
    """Return a number as JSON has it."""
    return float(value) if np.isfinite(value) else None


def _true_verdict(stage: Stage, truth: Array) -> str:
    """Return the right verdict of a machine without steps."""
    pairs = zip(stage.parameters, truth, strict=True)
    return verdict_of(tuple(p.word for p, value in pairs if value < degraded_below(p)))


def _placed(draws: Array, truth: Array, rng: np.random.Generator, horizon: float = np.inf) -> Row:
    """Return per quantity the place of the truth among draws, and the quantiles."""
    cuts = np.quantile(draws, _LEVELS, axis=0, method="inverted_cdf")
    place = rank_of(draws, truth, rng, horizon=horizon)
    return {
        "place": place.tolist(),
        "quantiles": [[_number(value) for value in row] for row in cuts.T],
    }


def _left(plan: Plan, life: Life) -> Array:
    """Return the travel left in m until each limit and the first of them, infinite if never."""
    laws, now = plan.draw_life(), life.travel[-1] / _KM
    limits = load_stage(STAGE).parameters
    left = []
    for law, spec, first in zip((laws.preload, laws.mount), limits, life.health[0], strict=True):
        assert spec.limit is not None
        reached = law.reaches_km(spec.limit.below * float(first))
        left.append(np.inf if reached is None else _KM * max(reached - now, 0.0))
    return np.array([*left, min(left)])


def identified(seed: int, logs: int, seconds: float) -> list[Row]:
    """Simulate logs of a drawn machine and identify them, by both descriptions.

    One is the shipped description, the other has the frequencies and dampings that the machine had
    when it was new, as its user would enter them.
    """
    plan = replace(plan_of("drawn", seed, logs, is_drawn=True), seconds=seconds)
    visits = schedule(plan)
    new = {m.name: m for m in closed_loop_modes(plan.machine().stage)}
    shipped = load_stage(STAGE)
    own = [
        msgspec.structs.replace(
            spec,
            frequency_hz=new[spec.name].frequency_hz,
            damping_ratio=new[spec.name].damping_ratio,
        )
        for spec in shipped.modes
    ]
    corrected = replace(
        shipped, description=msgspec.structs.replace(shipped.description, mode=tuple(own))
    )
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        simulate_life(plan, Path(folder))
        manifest = read_manifest(Path(folder))
        for path, visit in zip(find_logs(Path(folder)).logs, visits, strict=True):
            log = read_log(
                path, overrides=manifest.overrides(path), name=path.name, latest=LAST_MOMENT
            )
            truth = {m.name: m for m in closed_loop_modes(visit.stage, visit.condition)}
            for name, stage in (("shipped", shipped), ("corrected", corrected)):
                modes = identify(log, stage)
                seen = {mode: k for k, mode in enumerate(modes.names)}
                for mode in GUIDE_MODES:
                    row: Row = {"description": name, "mode": mode, "found": mode in seen}
                    if mode in seen:
                        k, m = seen[mode], len(modes.names)
                        value = [modes.ln_frequency[k], modes.ln_damping[k]]
                        std = np.sqrt(np.diag(modes.cov)[[k, k + m]])
                        true = np.log([truth[mode].frequency_hz, truth[mode].damping_ratio])
                        row["z"] = ((np.array(value) - true) / std).tolist()
                    rows.append(row)
    return rows
