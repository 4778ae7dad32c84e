"""Tracks of many lives, what is counted in them, and the best detector of a known loss."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from lmshealth.stage.description import Stage, load_stage
from lmshealth.tracking.constants import FALSE_ALARM_PROBABILITY, LN_F_STD
from lmshealth.tracking.track import Track, track
from studies.common.lives import HEALTHY, Array, Estimates, Life, history_of, rng_of
from studies.harness.study import Row, judge_scores, share_row

STAGES = ("lms-y", "lms-x")
NOMINALS = (0.9, 0.5)
DECLARED_RATE, MOST = 0.01, 0.05
# An event counts as found where it is reported so many logs about its own.
_ABOUT = 2
_EXPECTED = {
    "crash": "step", "sudden-loosening": "step", "regreasing": "regreasing",
    "servo-retuning": "servo",
}  # fmt: skip
_TEMPERATURE_STD = 0.001  # per K, as in the descriptions of the stages


class Followed(NamedTuple):
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
        Followed(life, seen, track(history_of(life, seen, **known), stage_of(life.stage)))
        for life, seen in pairs
    ]


def summed(followed: list[Followed], name: str) -> Row:
    """Summarise lives of one kind."""
    life = followed[0].life
    return {
        "name": name,
        "stage": life.stage,
        "kind": life.kind,
        "n": len(followed),
        "alarms": alarmed(followed),
        "coverage": coverage(followed),
        "events": events(followed),
    }


def alarmed(followed: list[Followed]) -> Row:
    """Count the lives with an alarm."""
    return share_row(sum(bool(one.track.alarms) for one in followed), len(followed))


def scores(one: Followed) -> Array:
    """Return errors of the drift over their standard deviations, from the second log on.

    Shape ``(n - 1, 3)``. A log at the baseline's own odometer has no drift and no error.
    """
    std = np.sqrt(np.einsum("kii->ki", one.track.drift_cov)[1:])
    off = one.track.drift[1:] - one.life.drift[1:]
    return np.asarray(off / np.where(std > 0, std, np.inf))


def coverage(followed: list[Followed]) -> Row:
    """Count the intervals of the drift that hold the truth.

    Judged is one interval a life, of one mode after one log, because those of one life depend on
    each other; of lives with damage one at which the truth has moved. Beside it is the share of
    all.
    """
    every = [scores(one) for one in followed]
    judged = np.array([_one(one, z) for one, z in zip(followed, every, strict=True)])
    together = np.concatenate([z.ravel() for z in every])
    rows: Row = {"rms": float(np.sqrt(np.mean(together**2)))}
    for nominal in NOMINALS:
        inside = np.abs(together) <= stats.norm.isf((1 - nominal) / 2)
        row = judge_scores(judged, nominal) | {"share_of_all": float(inside.mean())}
        rows[f"{100 * nominal:g}"] = row
    return rows


def _one(one: Followed, z: Array) -> float:
    """Choose the interval of a life that is judged."""
    rng = rng_of(2, one.life.seed, len(one.life.kind))
    mode = int(rng.integers(z.shape[1]))
    moved = np.flatnonzero(one.life.drift[1:, mode])
    if one.life.kind in HEALTHY or moved.size == 0:
        moved = np.arange(z.shape[0])
    return float(z[rng.choice(moved), mode])


def events(followed: list[Followed]) -> Row:
    """Count the undeclared events of a kind of lives that are reported right, and how soon."""
    delays, wrong = [], 0
    for life, _, found in followed:
        if life.event is None:
            continue
        near = [
            e
            for e in found.events
            if e.kind != "alarm" and not e.declared and abs(e.epoch - life.event) <= _ABOUT
        ]
        own = [e.found_at for e in near if e.kind == _EXPECTED[life.kind]]
        delays += [min(own) - life.event] if own else []
        wrong += bool(near) and not own
    if all(one.life.event is None for one in followed):
        return {}
    until = {f"q{q}": float(np.percentile(delays, q)) for q in (50, 95)} if delays else None
    right = share_row(len(delays), len(followed))
    return {"found_right": right, "taken_for_another": wrong, "logs_until": until}


def optimum(
    life: Life, estimates: Estimates, loss: Array, *, learns: bool
) -> tuple[int | None, int | None]:
    """Return the logs after which the best detectors report a loss ``(n, 3)`` of ln frequency.

    The likelihood ratio of a loss whose course is known against none, log by log. By Ville's
    inequality it reaches 1/α in at most a share α of healthy lives, and no test of this rate is
    much faster: Lorden's bound on the delay of a CUSUM is ln(1/α) over the information per log, and
    for a loss that grows, the log at which the information reaches ln(1/α). Returned are the logs
    of bound and ratio, None where they are not reached. ``learns``: the detector has to estimate
    the initial modes and their temperature coefficients, as a tracker has, or else knows them.
    """
    n, m = loss.shape
    warmer = life.covariates["temperature_c"] - 21.0
    prior = np.repeat([LN_F_STD, _TEMPERATURE_STD], m) ** 2 if learns else np.zeros(2 * m)
    known = life.ln_frequency[:1] if learns else life.ln_frequency - life.drift
    seen = np.stack([estimates.ln_frequency - known, loss], axis=2)
    # One filter for both: the estimates, and the loss.
    mean, cov = np.zeros((2 * m, 2)), np.diag(prior)
    ratio, information = np.zeros(n), np.zeros(n)
    for k in range(n):
        design = np.hstack([np.eye(m), warmer[k] * np.eye(m)])
        spread = design @ cov @ design.T + estimates.cov[k, :m, :m]
        gain = np.linalg.solve(spread, design @ cov).T
        off = seen[k] - design @ mean
        mean = mean + gain @ off
        cov = cov - gain @ design @ cov
        weighed = np.linalg.solve(spread, off[:, 1])
        information[k] = 0.5 * off[:, 1] @ weighed
        ratio[k] = off[:, 0] @ weighed - information[k]
    return _first(information), _first(ratio)


def _first(per_log: Array) -> int | None:
    enough = np.flatnonzero(np.cumsum(per_log) >= np.log(1 / FALSE_ALARM_PROBABILITY))
    return int(enough[0]) if enough.size else None
