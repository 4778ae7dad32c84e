"""Tracks of many lives, and what is counted in them: alarms, coverage, events."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from scipy import stats

from lmshealth.stage.description import Stage, load_stage
from lmshealth.tracking.history import History
from lmshealth.tracking.track import Track, track
from studies.common.lives import HEALTHY, Array, Estimates, Life, history_of, rng_of
from studies.common.metrics import clopper_pearson
from studies.harness.study import LEVEL, Row, judge_coverage

STAGES = ("lms-y", "lms-x")
NOMINALS = (0.9, 0.5)
DECLARED_RATE, MOST = 0.01, 0.05
# An event counts as found where it is told so many logs about its own.
_ABOUT = 2
_EXPECTED = {
    "crash": "step", "sudden-loosening": "step", "regreasing": "regreasing",
    "servo-retuning": "servo",
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Followed:
    """One life, its estimates and its track."""

    life: Life
    estimates: Estimates
    track: Track


@cache
def stage_of(name: str) -> Stage:
    """Load a description once."""
    return load_stage(name)


def follow(pairs: Sequence[tuple[Life, Estimates]], **known: Any) -> list[Followed]:
    """Track lives; what is known of them goes to `history_of`."""
    return [
        Followed(life, estimates, tracked(life, history_of(life, estimates, **known)))
        for life, estimates in pairs
    ]


def tracked(life: Life, history: History) -> Track:
    """Track one history with the description of its stage."""
    return track(history, stage_of(life.stage))


def summed(followed: list[Followed], name: str) -> Row:
    """Sum up lives of one kind."""
    life = followed[0].life
    return {
        "name": name,
        "stage": life.stage,
        "kind": life.kind,
        "n": len(followed),
        "alarms": alarmed(followed),
        "coverage": coverage(followed),
        "events": told(followed),
    }


def alarmed(followed: list[Followed]) -> Row:
    """Count the lives with an alarm."""
    hits, n = sum(bool(one.track.alarms) for one in followed), len(followed)
    low, high = clopper_pearson(hits, n, LEVEL)
    return {"hits": hits, "n": n, "share": hits / n, "low": low, "high": high}


def scores(one: Followed) -> Array:
    """Errors of the drift over their standard deviations, from the second log on, ``(n - 1, 3)``.

    A log at the baseline's own odometer has no drift and no error.
    """
    std = np.sqrt(np.einsum("kii->ki", one.track.drift_cov)[1:])
    off = one.track.drift[1:] - one.life.drift[1:]
    return np.asarray(off / np.where(std > 0, std, np.inf))


def coverage(followed: list[Followed]) -> Row:
    """Count the intervals of the drift that hold the truth.

    Judged is one interval a life, of one mode after one log, because those of one life depend on
    each other; of lives with damage one at which the truth has moved. Beside it stands the share
    of all.
    """
    every = [scores(one) for one in followed]
    judged = np.array([_one(one, z) for one, z in zip(followed, every, strict=True)])
    together = np.concatenate([z.ravel() for z in every])
    rows: Row = {"rms": float(np.sqrt(np.mean(together**2)))}
    for nominal in NOMINALS:
        reach = float(stats.norm.isf((1 - nominal) / 2))
        hits = int(np.sum(np.abs(judged) <= reach))
        rows[f"{100 * nominal:g}"] = {
            **judge_coverage(hits, judged.size, nominal),
            "share_of_all": float(np.mean(np.abs(together) <= reach)),
        }
    return rows


def _one(one: Followed, z: Array) -> float:
    """Pick the interval of a life that is judged."""
    rng = rng_of(2, one.life.seed, len(one.life.kind))
    mode = int(rng.integers(z.shape[1]))
    moved = np.flatnonzero(one.life.drift[1:, mode])
    if one.life.kind in HEALTHY or moved.size == 0:
        moved = np.arange(z.shape[0])
    return float(z[rng.choice(moved), mode])


def told(followed: list[Followed]) -> Row:
    """Return what was found that nobody had declared, and how soon."""
    kinds: Counter[str] = Counter()
    delays, right, wrong = [], 0, 0
    for one in followed:
        found = {(e.kind, e.epoch): e for e in one.track.events
                 if e.kind != "alarm" and not e.declared}  # fmt: skip
        kinds.update({kind for kind, _ in found})
        if one.life.event is None:
            continue
        near = [e for e in found.values() if abs(e.epoch - one.life.event) <= _ABOUT]
        own = [e for e in near if e.kind == _EXPECTED[one.life.kind]]
        right += bool(own)
        wrong += bool(near) and not own
        delays += [min(e.found_at for e in own) - one.life.event] if own else []
    n = len(followed)
    events: Row = {"lives_with": {kind: kinds[kind] for kind in sorted(kinds)}}
    if any(one.life.event is not None for one in followed):
        low, high = clopper_pearson(right, n, LEVEL)
        events |= {"found_right": {"hits": right, "n": n, "share": right / n,
                                   "low": low, "high": high},
                   "taken_for_another": wrong,
                   "logs_until": {f"q{q}": float(np.percentile(delays, q)) for q in (50, 95)}
                   if delays else None}  # fmt: skip
    return events
