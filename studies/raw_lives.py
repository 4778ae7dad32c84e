"""Lives simulated at 20 kHz and identified log by log, each once for all studies."""

from __future__ import annotations

import json
import tempfile
from dataclasses import astuple
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lmshealth import identify, read_log
from lmshealth.io.manifest import find_logs, read_manifest
from lmshealth.signal.following_error import loop_error
from lmshealth.stage.description import load_stage
from models.dynamics.plant import GUIDE_MODES
from models.lives.simulation import Plan, simulate_life
from studies.lives import Estimates, Life, life_of, plan_of
from studies.resume import Trials

RAW = "raw_lives"  # name of the file that keeps them
_FIELDS = ("ln_frequency", "ln_damping", "cov", "loop_error")
_SIZES_SEED = 7
_RECORD = Path(__file__).parent / "tracking_lives" / "result.json"
_LOOP_ERROR = 1e-8  # in m; of it the jump and the scatter count alone


def measured(stage: str, logs: int, kept: Path | None = None) -> tuple[Estimates, Life]:
    """Simulate and identify a few logs of both tunings, for `studies.lives.drawn`."""
    plan = plan_of(stage, "servo-retuning", _SIZES_SEED, logs)
    return identified(plan, kept), life_of(plan)


def recorded(stage: str, logs: int = 8) -> tuple[Estimates, Life]:
    """Take what `measured` gives from the record of tracking_lives: its medians, uncorrelated.

    It is for quick forms, which have no time to simulate and identify logs.
    """
    told = json.loads(_RECORD.read_text(encoding="utf-8"))["sizes"][stage]
    life = life_of(plan_of(stage, "servo-retuning", _SIZES_SEED, logs))
    std = np.array(told["median_std_ln_frequency"] + told["median_std_ln_damping"])
    tuned = life.servo != "commissioning"
    # Up and down by as much as the logarithms scatter, each tuning by itself.
    side = np.where(np.arange(logs) % 2, 1.0, -1.0)
    loop = told["ln_loop_error_jump"] * tuned + told["ln_loop_error_scatter"] * side
    cov = np.tile(np.diag(std**2), (logs, 1, 1))
    return Estimates(life.ln_frequency, life.ln_damping, cov, _LOOP_ERROR * np.exp(loop)), life


def identified(plan: Plan, cache: Path | None = None) -> Estimates:
    """Simulate a life and identify its logs, unless a file keeps that from before."""
    told = Trials(cache).once(
        partial(_identified, plan),
        type(plan).__name__,
        *astuple(plan),
        also=[type(plan).__module__],
    )
    return Estimates(*(np.array(told[field], dtype=float) for field in _FIELDS))


def _identified(plan: Plan, *_: object) -> dict[str, list[Any]]:
    with tempfile.TemporaryDirectory() as folder:
        simulate_life(plan, Path(folder))
        estimates = _identify_all(Path(folder), plan)
    return {field: getattr(estimates, field).tolist() for field in _FIELDS}


def _identify_all(folder: Path, plan: Plan) -> Estimates:
    """Identify the logs of a folder, which stand in the order of recording."""
    stage, manifest = load_stage(plan.stage), read_manifest(folder)
    n, m = plan.logs, len(GUIDE_MODES)
    ln_f, ln_zeta, loop = np.full((n, m), np.nan), np.full((n, m), np.nan), np.full(n, np.nan)
    cov = np.full((n, 2 * m, 2 * m), np.nan)
    for k, path in enumerate(find_logs(folder).logs):
        log = read_log(path, overrides=manifest.overrides(path), name=path.name)
        modes = identify(log, stage)
        # Those that were found: where they stand in the result, and where they belong.
        at = [i for i, name in enumerate(modes.names) if name in GUIDE_MODES]
        to = [GUIDE_MODES.index(modes.names[i]) for i in at]
        ln_f[k, to], ln_zeta[k, to] = modes.ln_frequency[at], modes.ln_damping[at]
        rows = np.ix_([*to, *(i + m for i in to)], [*to, *(i + m for i in to)])
        own = np.array([*at, *(i + len(modes.names) for i in at)], dtype=int)
        cov[k][rows] = modes.cov[np.ix_(own, own)]
        error = loop_error(log)
        loop[k] = np.nan if error is None else error
    return Estimates(ln_f, ln_zeta, cov, loop)
