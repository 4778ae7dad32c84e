"""Is a drift shown without bias, do its intervals hold, and is fast wear alarmed in time?

Method
    Lives of three modes are drawn without the state space and laws of the program: 30 to 60 logs at
    irregular distances, errors of 2e-4 to 5e-4 in ln f, courses that are linear, powers, exponential
    or begin late, half of them with a seasonal temperature. Wear is 2 to 8 %, slow wear 0.5 to 1 %;
    healthy lives are quiet, wander about a mean, or run in. At three logs of each life the drift is
    compared with the truth: the slope of estimated over true drift, and how many 90 % intervals hold
    it, for each kind of life. Fast wear is 3 % within eight logs after 10 to 30 quiet logs or from
    the start, at errors of 2e-4 to 1e-3: it should raise an alarm by the eighth log, and healthy
    lives none. The code before a single filter published its states (``--before``) sees the same
    lives; processor times of tracking are taken in turns.
Answer
    TODO
Run time
    TODO
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from scipy import stats

from lmshealth.stage.description import load_stage
from lmshealth.tracking.history import History
from lmshealth.tracking.track import track
from studies.harness.checkout import ROOT, checkout
from studies.harness.claims import Claim
from studies.harness.data.histories import make_history
from studies.harness.study import Row, Study, share_row

MODES, LN_F, LN_ZETA = ("roll", "pitch", "yaw"), np.log([110.0, 124.0, 138.0]), np.log(0.016)
STD_ZETA, REFERENCE_C = 0.06, 21.0
WEARING = ("linear", "power", "exponential", "late")
SLOW = tuple(f"slow {course}" for course in WEARING)
HEALTHY = ("quiet", "wandering", "running-in", "seasonal")
FAST = ("fast after quiet logs", "fast from the start")
LIVES = {kind: 60 for kind in (*WEARING, *SLOW)} | {kind: 100 for kind in (*HEALTHY, *FAST)}
PLACES, REACH = (0.5, 0.7, 1.0), stats.norm.ppf(0.95)


class Life(NamedTuple):
    """A history with the true drift of its modes, ``(n_logs, n_modes)``."""

    history: History
    drift: np.ndarray


def draw(kind: str, seed: int) -> Life:
    """Draw one life of a kind."""
    rng = np.random.default_rng([seed, sum(kind.encode())])
    fast, n = kind in FAST, int(rng.integers(30, 61))
    quiet = int(rng.integers(10, 31)) if kind == FAST[0] else 1
    n = quiet + 8 if fast else n
    travel = np.cumsum(rng.uniform(0.7, 1.3, n)) * 1e5
    s = (travel - travel[0]) / (travel[-1] - travel[0])
    std = np.exp(rng.uniform(np.log(2e-4), np.log(1e-3 if fast else 5e-4)))
    size = rng.uniform(0.005, 0.01) if kind in SLOW else rng.uniform(0.02, 0.08)
    course = np.zeros(n)
    if fast:
        course[quiet:], size = np.arange(1, 9) / 8, 0.03
    elif kind not in HEALTHY:
        course = shape(kind.split()[-1], s, rng)
    moved = -size * course[:, None] * (np.ones(3) if fast else rng.uniform(0.7, 1.3, 3))
    if kind == "running-in":
        logs = np.arange(n) / rng.uniform(0.5, 4.0)
        moved = -rng.uniform(-0.02, 0.02) * (1 - np.exp(-logs))[:, None] * rng.uniform(0.7, 1.3, 3)
    seen = LN_F + moved + std * rng.standard_normal((n, 3))
    if kind == "wandering":
        keep, own = np.exp(-1 / rng.uniform(2, 10)), rng.standard_normal((n, 3))
        for k in range(1, n):
            own[k] = keep * own[k - 1] + np.sqrt(1 - keep**2) * own[k]
        seen = seen + rng.uniform(0.5, 3) * std * own
    covariates = {}
    if kind == "seasonal" or (not fast and kind not in HEALTHY and seed % 2):
        phase, turns = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 2)
        warm = rng.uniform(4, 10) * np.sin(2 * np.pi * turns * s + phase) + rng.standard_normal(n)
        covariates["temperature_c"] = REFERENCE_C + warm
        slope = -5e-4 * np.exp(0.5 * rng.standard_normal()) * rng.uniform(0.7, 1.3, 3)
        seen = seen + slope * warm[:, None]
    ln_zeta = LN_ZETA + STD_ZETA * rng.standard_normal((n, 3))
    cov = np.tile(np.diag(np.repeat([std, STD_ZETA], 3) ** 2), (n, 1, 1))
    return Life(make_history(MODES, travel, (seen, ln_zeta, cov), covariates=covariates), moved)


def shape(course: str, s: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a course from 0 to 1 over shares of the travel."""
    if course == "power":
        return np.asarray(s ** rng.uniform(0.6, 2.0))
    if course == "exponential":
        rate = rng.uniform(0.7, 2.5) * rng.choice([-1, 1])
        return np.asarray(np.expm1(rate * s) / np.expm1(rate))
    if course == "late":
        begin = rng.uniform(0.3, 0.5)
        return np.asarray((np.maximum(s - begin, 0) / (1 - begin)) ** 1.5)
    return s


def of_kind(kind: str, n: int, first: int = 0) -> Row:
    """Track lives of a kind: drifts, truths and standard deviations at three logs, and alarms."""
    rows, alarms, start = [], [], time.process_time()
    for seed in range(first, first + n):
        life = draw(kind, seed)
        found = track(life.history, load_stage("lms-y"))
        at = [round(p * (len(found.logs) - 1)) for p in PLACES]
        std = np.sqrt(np.einsum("kii->ki", found.drift_cov))
        rows.append([found.drift[at], life.drift[at], std[at]])
        alarms.append(bool(found.alarms))
    return {"rows": np.array(rows).tolist(), "alarms": alarms, "cpu_s": time.process_time() - start}
