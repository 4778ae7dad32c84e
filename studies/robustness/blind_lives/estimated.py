"""Blind lives without signals: estimates about the true modes, and what the program answers."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pandas as pd
from lmshealth.health.inference import infer
from lmshealth.health.verdict import doubt_of_names, judge
from lmshealth.prognosis.remaining_life import prognose

from lmshealth.errors import LmshealthError
from lmshealth.report.assessment import Assessment, summarise_life
from lmshealth.report.constants import RUL_LEVELS
from lmshealth.stage.description import Stage, load_stage
from lmshealth.tracking.history import History
from lmshealth.tracking.track import accepted_estimates, track
from models.dynamics.plant import closed_loop_modes
from models.lives.degradation import LIVES
from models.lives.simulation import Plan
from studies.harness.data.lives import drawn, history_of, life_of, recorded, rng_of
from studies.harness.study import Row
from studies.robustness.blind_lives.lives import QUANTILES, SEED, STAGES, BlindPlan, truth_of

N_LOGS, N_FEW, FEW, SEEN_PART = (14, 20), (2, 4), 0.05, (0.3, 1.0)
# Of four lives three are of drawn machines, and two of them have the laws of their machine.
OWN_LAWS = ("drawn", "drawn", "", "")
_LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)


def plan_of(number: int) -> BlindPlan:
    """Draw a life: its machine, kind, stage, seed, number of logs, and where it is cut."""
    rng = np.random.default_rng([SEED, 2, number])
    kind = OWN_LAWS[number % 4] or str(rng.choice(list(LIVES)))
    logs = int(rng.integers(*(N_FEW if rng.random() < FEW else N_LOGS), endpoint=True))
    seed, part = int(rng.integers(10**8)), float(rng.uniform(*SEEN_PART))
    plant_seed = None if number % 4 == 3 else int(rng.integers(10**6))
    plan = BlindPlan(str(rng.choice(STAGES)), kind, logs, 20.0, seed, plant_seed=plant_seed)
    plan = replace(plan, part=part)
    fails = plan.draw_life().failure_km() is not None
    return replace(plan, until="failure") if fails and number % 3 == 0 else plan


def described(plan: Plan) -> Stage:
    """Return the shipped description with the frequencies and dampings of the new machine."""
    stage = load_stage(plan.stage)
    new = {mode.name: mode for mode in closed_loop_modes(plan.machine().stage)}
    own = [
        msgspec.structs.replace(
            spec,
            frequency_hz=new[spec.name].frequency_hz,
            damping_ratio=new[spec.name].damping_ratio,
        )
        for spec in stage.modes
    ]
    return replace(stage, description=msgspec.structs.replace(stage.description, mode=tuple(own)))


def blind_life(number: int) -> Row:
    """Take one life from estimates to the answers of the program, beside its truth."""
    plan = plan_of(number)
    life, stage = life_of(plan), described(plan)
    history = history_of(life, drawn(life, *recorded(plan.stage), rng_of(61, number)))
    made = assessed(stage, history, number)
    judged = made.judgement
    table = {"guide_preload": life.health[:, 0], "mount_stiffness": life.health[:, 1]}
    table["travel_km"] = life.travel / 1000
    return {
        "stage": plan.stage,
        "kind": plan.life,
        "drawn": plan.plant_seed is not None,
        "logs": plan.logs,
        "truth": truth_of(plan, pd.DataFrame(table)),
        "reported": {"verdict": judged.verdict, "probability": _number(judged.probability),
                 "shown": None, "refused": {}, "events": _events(made)} | _intervals(made),
    }  # fmt: skip


def assessed(stage: Stage, history: History, number: int) -> Assessment:
    """Assess as `lmshealth.assess` does, health at the last log and life by importance sampling."""
    found = track(history, stage)
    made = Assessment(
        stage=stage,
        history=history,
        digests=(),
        track=found,
        health=None,
        prognosis=None,
        judgement=judge(stage, history, None),
        refused=(),
        notices=(),
        seed=number,
        doubt=doubt_of_names(stage, history, found),
    )
    if not made.doubt:
        made = _with_results(made, number)
    judgement = judge(stage, history, made.present, found, doubt=made.doubt)
    return replace(made, judgement=judgement)


def _with_results(made: Assessment, number: int) -> Assessment:
    assert made.track is not None
    stage, history = made.stage, accepted_estimates(made.history, made.track)
    try:
        health = infer(made.track, stage, [62, number], epochs=[len(history.logs) - 1])
        made = replace(made, health=health)
        return replace(made, prognosis=prognose(history, stage, [63, number], chains=False))
    except LmshealthError:
        return made


def _intervals(made: Assessment) -> Row:
    """Return quantiles of the health that is published, and of the remaining travel in km."""
    health, left = dict[str, Any](), dict[str, Any]()
    present = made.latest_health
    if present is not None:
        for j in np.flatnonzero(present.publishable_parameters()).tolist():
            cuts = np.quantile(present.samples[-1, :, j], _LEVELS).tolist()
            health[present.parameters[j]] = dict(zip(QUANTILES, cuts, strict=True))
    if made.prognosis is not None:
        for one in summarise_life(made.prognosis, made.stage).limits:
            km = dict(zip(RUL_LEVELS, one.travel, strict=True))
            cuts = [_number(km[level] / 1000) for level in _LEVELS]
            own = dict(zip(QUANTILES, cuts, strict=True))
            left[one.parameter] = own | {"past": one.already_past, "beyond": one.beyond_horizon}
    return {"health": health, "left": left}


def _events(made: Assessment) -> dict[str, int]:
    events = made.track.events if made.track else ()
    return dict(Counter({one.kind for one in events if not one.declared}))


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
