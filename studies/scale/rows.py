"""Rows of the front page of an invented fleet: as many as asked, of all states."""

from __future__ import annotations

from datetime import date, timedelta

import numpy as np

from lmshealth.io.log import Refusal
from lmshealth.prognosis.maintenance_decision import Service
from lmshealth.report.brief import Brief
from lmshealth.report.fleet_page import Summary
from lmshealth.report.healthfacts import Gauge, Life, Tone
from lmshealth.report.text import GAP, day_count, km, percent
from studies.harness.study import Row

TODAY = date(2026, 11, 20)
HORIZON = 20e6
# In m a day; and what the parameters may fall to.
USAGE, LIMITS = 12e3, {"guide preload": 0.6, "mount stiffness": 0.7}
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
    verdict = "Not enough data for a verdict" if young else "Healthy"
    if worn:
        verdict = f"Loss of {' and '.join(lost or LIMITS)}"
    tone: Tone = "open" if young else "bad" if worn else "good"
    service = _service(None if young else days)
    likely = "" if young else percent(rng.uniform(0.8, 1))
    gauges = () if young else tuple(map(_gauge, LIMITS, level, rng.uniform(0.01, 0.04, 2)))
    return Summary(
        file=f"{identity}.html",
        identity=identity,
        urgency=(1 if young else 2 if service.kind == "later" else 0, days, 0.0, identity),
        last_log=TODAY - timedelta(days=int(rng.integers(0, 30))),
        tone=tone,
        verdict=verdict,
        probability=likely,
        gauges=gauges,
        life=None if young else _life(1.6 * days),
        remaining=np.nan if young else 1.6 * days * USAGE,
        service=service,
        brief=Brief(identity, tone, "as drawn", (), "", service.kind, None),
    )


def _gauge(name: str, level: float, std: float) -> Gauge:
    values = {"low": level - 1.6 * std, "median": level, "high": level + 1.6 * std}
    values |= {"baseline": 1.0, "limit": LIMITS[name]}
    return Gauge(
        name=name,
        told=True,
        converged=True,
        share=f"96{GAP}%",
        value=f"{100 * level:.0f}{GAP}%",
        interval=f"{100 * values['low']:.0f} to {100 * values['high']:.0f}{GAP}%",
        below=percent(0.0),
        limit=f"{100 * LIMITS[name]:.3g}{GAP}%",
        unit="",
        places={key: round(100 * value / 1.5, 2) for key, value in values.items()},
    )


def _life(days: float) -> Life:
    spread = [0.8 * days, days, 1.4 * days]
    return Life(
        name="any limit",
        limit="",
        km=tuple("already passed" if day <= 0 else km(day * USAGE) for day in spread),
        days=tuple("already passed" if day <= 0 else day_count(day) for day in spread),
        past=percent(0.01),
        beyond=percent(0.01),
        now="",
    )


def _service(days: float | None) -> Service:
    kinds: Row = {"kind": "unknown", "by": None, "wait": np.nan, "risk": np.nan}
    if days is not None and days * USAGE > HORIZON:
        kinds |= {"kind": "later", "wait": np.inf}
    elif days is not None:
        by = TODAY + timedelta(days=max(days, 0))
        kinds |= {"kind": "now" if days <= 0 else "by", "by": by, "wait": days, "risk": 0.05}
    return Service(
        **kinds, planned=None, planned_risk=(np.nan, np.nan), max_risk=0.05, cost_ratio=None
    )
