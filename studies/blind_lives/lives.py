"""Lives drawn blind, and what is true of them at their last log."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pandas as pd

from lmshealth.health.verdict import degraded_below
from lmshealth.stage.description import Stage, load_stage
from models.dynamics.stages import stage_named
from models.lives.degradation import LIVES, Delayed, Law, Steady, Stepped
from models.lives.simulation import Plan, schedule
from models.recordings.machines import machine_identity
from studies.harness.study import Row

SEED = 20261123
STAGES = ("lms-x", "lms-y")
# What the modes of a stage can tell; in X the mount moves none of them.
SEEN = {"lms-x": ("guide_preload",), "lms-y": ("guide_preload", "mount_stiffness")}
WORDS = ("healthy", "preload", "mount", "both", "step", "not-enough-data")
# Of logs: of most lives, and of the share that have too few; and seconds of each.
N_LOGS, N_FEW, FEW, SECONDS = (18, 28), (2, 4), 0.1, (8.0, 12.0)
# Every third life that ends is drawn past its end, and every life is cut on the way.
TO_FAILURE, SEEN_PART = 1 / 3, (0.3, 1.0)
# A life is near the border if a parameter is as near to where it counts as degraded, or if so few
# logs have seen its step: one log's jump is believed once the next confirms it.
NEAR, CONFIRMED = 0.02, 2


@dataclass(frozen=True, slots=True)
class BlindPlan(Plan):
    """A life whose logs are spread over a part of the way to where they would end."""

    part: float = 1.0

    def end_km(self, now_km: float) -> float:
        """Return the odometer (km) of the last log."""
        return self.part * Plan.end_km(self, now_km)

    @property
    def identity(self) -> str:
        """The name that the machine has in its logs."""
        return machine_identity(stage_named(self.stage), self.seed)


def plan_of(number: int) -> BlindPlan:
    """Draw a life: its kind, stage, seed, count and length of logs, and where it is cut."""
    rng = np.random.default_rng([SEED, number])
    kind, stage = str(rng.choice(list(LIVES))), str(rng.choice(STAGES))
    seed, few, failing = int(rng.integers(10**8)), rng.random() < FEW, rng.random() < TO_FAILURE
    logs = int(rng.integers(*(N_FEW if few else N_LOGS), endpoint=True))
    seconds, part = round(float(rng.uniform(*SECONDS)), 1), float(rng.uniform(*SEEN_PART))
    plan = BlindPlan(stage, kind, logs, seconds, seed, part=part)
    if failing and plan.draw_life().failure_km() is not None:
        return BlindPlan(stage, kind, logs, seconds, seed, until="failure", part=part)
    return plan


def truth_of(plan: Plan, table: pd.DataFrame) -> Row:
    """Tell what is true at the last log.

    Parameters
    ----------
    plan : Plan
        The life.
    table : DataFrame
        Its ``truth.csv``.

    Returns
    -------
    dict
        ``verdict`` that is right, whether it is ``clear`` of every border, ``health`` as a fraction
        of the first log, and ``left`` until each limit and any, in km: 0 where it is past, None
        where no limit is reached. A step to come is in no law: what is left is that of a machine
        to which none happens, and ``to_come`` says so.
    """
    stage = _described(plan.stage)
    limits = {p.name: p for p in stage.parameters if p.name in SEEN[plan.stage]}
    first, last = table.iloc[0], table.iloc[-1]
    health = {name: float(last[name] / first[name]) for name in limits}
    borders = {name: degraded_below(spec) for name, spec in limits.items()}
    since = _logs_since_step(plan)
    few = len(table) < stage.description.baseline.logs
    lost = [spec.word for name, spec in limits.items() if health[name] < borders[name]]
    word = "not-enough-data" if few else "step" if since else _word(lost)
    if few or since:
        clear = not since if few else since >= CONFIRMED
    else:
        clear = all(abs(health[name] - borders[name]) > NEAR for name in limits)
    left, to_come = _left(plan, {n: p.limit.below for n, p in limits.items() if p.limit}, table)
    return {"verdict": word, "clear": clear, "health": health, "left": left,
            "to_come": to_come}  # fmt: skip


@cache
def _described(name: str) -> Stage:
    return load_stage(name)


def _word(lost: list[str]) -> str:
    return "both" if len(lost) == 2 else lost[0] if lost else "healthy"


def _logs_since_step(plan: Plan) -> int:
    """Count the logs after the step of a part that the modes tell; 0 where there is none."""
    life, visits = plan.draw_life(), schedule(plan)
    laws = {"guide_preload": life.preload, "mount_stiffness": life.mount}
    steps = [
        law.step_km
        for name, law in laws.items()
        if name in SEEN[plan.stage] and isinstance(law, Stepped) and law.left < 1.0
    ]
    return sum(visit.travel_km >= min(steps) for visit in visits) if steps else 0


def _left(
    plan: Plan, limits: dict[str, float], table: pd.DataFrame
) -> tuple[dict[str, float | None], bool]:
    """Tell the travel left until each limit and any, and whether a step is still to come."""
    life, now_km = plan.draw_life(), float(table.iloc[-1]["travel_km"])
    laws: dict[str, Law] = {"guide_preload": life.preload, "mount_stiffness": life.mount}
    left: dict[str, float | None] = {}
    to_come = False
    for name, below in limits.items():
        law = _without_what_comes(laws[name], now_km)
        to_come |= law is not laws[name]
        reached = law.reaches_km(below * float(table.iloc[0][name]))
        left[name] = None if reached is None else max(reached - now_km, 0.0)
    left["any"] = min((km for km in left.values() if km is not None), default=None)
    return left, to_come


def _without_what_comes(law: Law, now_km: float) -> Law:
    """Give a law as it goes on if nothing more happens at once."""
    if isinstance(law, Stepped) and law.step_km > now_km:
        return _without_what_comes(law.law, now_km)
    return Steady() if isinstance(law, Delayed) and law.start_km > now_km else law
