"""Whole assessments for tests, and what to compare of two."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import asdict

from lmshealth.health.verdict import Verdict
from lmshealth.io.log import Refusal
from lmshealth.report.assessment import Assessment
from lmshealth.tracking.history import Step
from lmshealth.tracking.track import Event
from tests.report.test_figures import (
    life,
    make_health,
    make_history,
    make_prognosis,
    make_track,
    make_waterfall,
)
from tests.report.test_machine_page import write_stage


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
        notes=("The temperature of 3 logs is missing.",),
        seed=0,
        waterfall=make_waterfall(history),
    )


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
