"""Rows of the front page of an invented fleet: as many as asked, of all states."""

from __future__ import annotations

from datetime import UTC, date, datetime, time, timedelta
from typing import Any

import numpy as np

from lmshealth.io.log import Refusal
from lmshealth.machine.service import Service
from lmshealth.machine.summary import Life, LimitLife, NextStep, ParameterHealth, State, Summary

TODAY = date(2026, 11, 20)
HORIZON = 20e6
# In m a day; and what the parameters may fall to.
USAGE, LIMITS = 12e3, {"guide_preload": 0.6, "mount_stiffness": 0.7}
# Of so many stages one each is worn, and young.
WORN, YOUNG = 25, 40
REASONS = ("no stage", "unreadable", "time axis", "no channel")


def make_rows(n: int, seed: int = 0) -> list[Summary]:
    """Invent so many stages: most are healthy, a few worn, a few too young for a verdict."""
    rng = np.random.default_rng(seed)
    return [_row(k, rng) for k in range(n)]


def make_refused(n: int) -> list[Refusal]:
    """Invent logs that belong to no stage."""
    return [
        Refusal(f"archive/2026/{k // 100:03d}/{k:06d}.csv", REASONS[k * k % 4], "as told there")
        for k in range(n)
    ]


def _row(k: int, rng: np.random.Generator) -> Summary:
    identity = f"LINE{k // 100:02d}-M{k:04d}-{'XY'[k % 2]}"
    worn, young = k % WORN == 3, k % YOUNG == 7
    level = rng.uniform(0.66, 0.9, 2) if worn else rng.uniform(0.94, 1.03, 2)
    lost = [name for name, value in zip(LIMITS, level, strict=True) if value < 0.88]
    days = float(rng.uniform(-60, 400) if worn else rng.uniform(200, 6000))
    state: State = "open" if young else "bad" if worn else "good"
    service = _service(None if young else days)
    probability = rng.uniform(0.8, 1)
    health = () if young else tuple(map(_parameter, LIMITS, level, rng.uniform(0.01, 0.04, 2)))
    return Summary(
        file=f"{identity}.html",
        identity=identity,
        urgency=(1 if young else 2 if service.kind == "later" else 0, days, 0.0, identity),
        recorded_at=datetime.combine(TODAY, time()) - timedelta(days=int(rng.integers(0, 30))),
        baseline_at=datetime.combine(TODAY, time()) - timedelta(days=365),
        description="as drawn",
        n_logs=40,
        travel=1e6,
        state=state,
        alarmed=(),
        lost=tuple(lost or LIMITS) if worn else (),
        verdict="not-enough-data" if young else "both" if worn else "healthy",
        probability=np.nan if young else probability,
        why="as drawn",
        health=health,
        life=None if young else _life(identity, 1.6 * days),
        service=service,
        step=NextStep("none"),
    )


def _parameter(name: str, level: float, std: float) -> ParameterHealth:
    return ParameterHealth(
        name=name, determined=True, informed=0.96,
        low=level - 1.6 * std, median=level, high=level + 1.6 * std,
        limit=LIMITS[name], below_limit=0.0,
    )  # fmt: skip


def _life(identity: str, days: float) -> Life:
    spread = tuple(max(factor * days, 0.0) for factor in (0.8, 0.85, 0.9, 1.0, 1.15, 1.3, 1.4))
    travel, dates = tuple(day * USAGE for day in spread), (None,) * len(spread)
    any_limit = LimitLife("any", np.nan, 1.0, travel, spread, dates, 0.01, 0.01)
    now = datetime(TODAY.year, TODAY.month, TODAY.day, tzinfo=UTC)
    return Life(identity, now, 1e6, HORIZON, (any_limit,), laws=(), undetermined=())


def _service(days: float | None) -> Service:
    kinds: dict[str, Any] = {"kind": "unknown", "by": None, "wait": np.nan, "risk": np.nan}
    if days is not None and days * USAGE > HORIZON:
        kinds |= {"kind": "later", "wait": np.inf}
    elif days is not None:
        by = TODAY + timedelta(days=max(days, 0))
        kinds |= {"kind": "now" if days <= 0 else "by", "by": by, "wait": days, "risk": 0.05}
    return Service(
        **kinds, planned=None, planned_risk=(np.nan, np.nan), max_risk=0.05, cost_ratio=None
    )
