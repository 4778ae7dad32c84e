"""Answers of `lmshealth` to lives of the plant, through its published functions alone.

As a program it answers lives from stdin, one JSON object a line, with the code that ``PYTHONPATH``
names: an earlier revision as well as this one. It therefore imports nothing of the studies.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from functools import cache, partial
from importlib import import_module, resources
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

import lmshealth
from lmshealth.io.log import Metadata
from lmshealth.modal.modes import Modes

Answer = dict[str, Any]
# How a life is assessed: with the chains that are published; by importance sampling, as after a log
# that only updates a life; or, by the earlier revision alone, in a shorter way.
PUBLISHED, IMPORTANCE = "as published", "by importance sampling"
WITHOUT_CHAINS, HEALTH_ALONE = "life without chains", "health alone"
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


def answer(logs: Answer, map_table: str, seed: int, how: str = PUBLISHED) -> Answer:
    """Assess a life: verdict, draws of ln health now and of the travel left, service."""
    start = time.process_time()
    with _shortened(how) as options:
        if logs["work"][0]:
            options |= {"work": _maintenance(*logs["work"])}
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


def _maintenance(action: str, moment: str) -> Any:
    module: Any = import_module("lmshealth.tracking.maintenance")
    return module.Maintenance((module.Action("AX-1", datetime.fromisoformat(moment), action),))


@contextmanager
def _shortened(how: str) -> Iterator[Answer]:
    """Shorten the assessment of the earlier revision: one epoch, and a life without chains."""
    if how == PUBLISHED:
        yield {}
        return
    if how == IMPORTANCE:
        module: Any = import_module("lmshealth.machine.assessment")
        fit = module.fit_life
        with patch.object(module, "fit_life", lambda *a, **k: fit(*a, **(k | {"chains": False}))):
            yield {"epochs": 1}
        return
    module = import_module("lmshealth.batch.assess")  # its place in that revision
    name = "prognose_with_posterior"

    def no_life(*_: Any, **__: Any) -> None:
        raise lmshealth.LmshealthError("no life is asked for")

    short = no_life if how == HEALTH_ALONE else partial(getattr(module, name), chains=False)
    with patch.object(module, name, short):
        yield {"epochs": 1}


def _quantiles(draws: Any) -> list[float]:
    return [round(v, 5) for v in np.quantile(draws, _LEVELS, method="inverted_cdf").tolist()]


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def main() -> None:
    """Answer lives until the end of stdin."""
    for line in sys.stdin:
        print(json.dumps(answer(**json.loads(line))), flush=True)


if __name__ == "__main__":
    main()
