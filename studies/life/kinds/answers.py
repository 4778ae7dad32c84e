"""Answers of `lmshealth` to lives of the plant: by importance sampling, as after a new log."""

from __future__ import annotations

import re
import tempfile
import time
from datetime import datetime
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

import lmshealth
from lmshealth.io.log import Metadata
from lmshealth.life.posterior.fit import LifePosterior, fit_life
from lmshealth.modal.modes import Modes
from lmshealth.tracking.maintenance import Action, Maintenance

Answer = dict[str, Any]
_LEVELS = (np.arange(101) + 0.5) / 101  # of the quantiles that stand for draws
_SHIPPED, _COMMON = "lms-y.map.csv", re.compile(r"^common_std.*\n", re.MULTILINE)
_NEVER_KM = 1e6  # for a limit that is never reached
_KM = 1000.0


@cache
def stage_of(map_table: str) -> Any:
    """Load the shipped description with another map, whose modes have no errors in common."""
    shipped = resources.files("lmshealth") / "stage" / "descriptions" / "lms-y.toml"
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "plant.map.csv").write_text(map_table)
        path = Path(folder) / "plant.toml"
        text = shipped.read_text(encoding="utf-8")
        assert _SHIPPED in text
        path.write_text(_COMMON.sub("", text.replace(_SHIPPED, "plant.map.csv")))
        return lmshealth.load_stage(str(path))


def readings_of(logs: Answer) -> list[lmshealth.LogEstimates]:
    """Return the modal estimates of the logs of a life."""
    m = len(logs["modes"])
    found = []
    for k, when in enumerate(logs["recorded_at"]):
        std = np.r_[logs["std"][k], np.full(m, 0.08)]
        metadata = Metadata(
            stage="AX-1", recorded_at=datetime.fromisoformat(when), travel=logs["travel"][k],
            covariates={"temperature_c": logs["temperature_c"][k], "payload_kg": 20.0},
            servo_id=logs["servo_id"][k],
        )  # fmt: skip
        modes = Modes(
            names=tuple(logs["modes"]), sources=("acc",) * m, channels=("acc_feed",) * m,
            ln_frequency=np.array(logs["ln_f"][k]), ln_damping=np.array(logs["ln_zeta"][k]),
            cov=np.diag(std**2), snr=np.full(m, 200.0), dispersion=np.ones(m), flags=("",) * m,
            shape_channels=(), shapes=np.empty((m, 0)), lines=(), refused=(),
        )  # fmt: skip
        found.append(lmshealth.LogEstimates(f"log-{k:03d}", f"{k:064d}", metadata, modes))
    return found


def answer(logs: Answer, map_table: str, seed: int) -> Answer:
    """Assess a life: verdict, draws of ln health now and of the travel left, service."""
    start, (action, moment) = time.process_time(), logs["work"]
    options: Answer = {"epochs": 1}
    if action:
        work = Maintenance((Action("AX-1", datetime.fromisoformat(moment), action),))
        options["work"] = work

    def without_chains(*given: Any, **settings: Any) -> LifePosterior:
        return fit_life(*given, **(settings | {"chains": False}))

    with patch("lmshealth.machine.assessment.fit_life", without_chains):
        made = lmshealth.assess(readings_of(logs), stage_of(map_table), seed=seed, **options)
    service, judged = made.service(), made.judgement
    found: Answer = {
        "verdict": judged.verdict, "probability": _number(judged.probability), "why": judged.why,
        "health": {}, "left_km": None, "service": [service.kind, _number(service.wait)],
    }  # fmt: skip
    if made.health is not None:
        fine = made.health.publishable_parameters()
        for j in np.flatnonzero(fine).tolist():
            draws = made.health.samples[-1][:, j]
            found["health"][made.health.parameters[j]] = _quantiles(np.log(draws))
    if made.prognosis is not None:
        km = np.minimum(made.prognosis.remaining[:, -1] / _KM, _NEVER_KM)
        found["left_km"] = _quantiles(km)
    return found | {"cpu_s": round(time.process_time() - start, 2)}


def _quantiles(draws: Any) -> list[float]:
    return [round(v, 5) for v in np.quantile(draws, _LEVELS, method="inverted_cdf").tolist()]


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
