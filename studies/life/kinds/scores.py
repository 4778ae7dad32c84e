"""Scores of answers to lives of the plant, and their summary over lives of one kind."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from lmshealth.calibration.ranks import place as rank_of
from lmshealth.calibration.ranks import share_row
from studies.harness.study import Row
from studies.life.kinds.ideal import marginals, place, quantile
from studies.life.kinds.plant import MODES, PARAMETERS
from studies.life.kinds.worlds import SEED, SHARES, Life, life_of

LEVEL, SURE, SOON_DAYS = 0.95, 0.9, 90.0
NARROW = 0.8  # of the width of intervals, as a control
_DEGRADED = ("preload", "mount", "both")


def scored(kind: str, number: int, answer: Row) -> Row:
    """Score the answer to one life."""
    life = life_of(kind, number)
    rng = np.random.default_rng([SEED, number])
    truth = dict(zip(PARAMETERS, life.ln_health[-1].tolist(), strict=True))
    right, word = life.right_verdicts, answer["verdict"]
    wait = _wait(answer["service"])
    row: Row = {
        "share": life.share, "verdict": word, "probability": answer["probability"],
        "right": None if not right else word in right and _names(life, answer["why"]),
        "surely_degraded": word in _DEGRADED and (answer["probability"] or 0.0) > SURE,
        "soon": wait is not None and wait <= SOON_DAYS,
        "late": wait is not None and life.left_days < wait, "left": None,
        "health": {name: _health(np.array(draws), truth[name], rng)
                   for name, draws in answer["health"].items()},
        "ideal": {
            name: {"place": place(own, truth[name]),
                   "width": quantile(own, 0.95) - quantile(own, 0.05)}
            for name, own in marginals(life).items()
        },
    }  # fmt: skip
    if answer["left_km"] is not None and np.isfinite(life.left_km):
        km = np.array(answer["left_km"])
        low, high = np.quantile(km, [0.05, 0.95])
        at = float(rank_of(km[:, None], np.array([life.left_km]), rng)[0])
        row["left"] = {"place": at, "width": float((high - low) / life.left_km)}
    return row


def _health(draws: Any, truth: float, rng: np.random.Generator) -> Row:
    """Place the truth among draws, ties at random: a parameter that surely stays is one value.

    "narrow" is its place among draws that are nearer to their median, as a control.
    """
    low, middle, high = np.quantile(draws, [0.05, 0.5, 0.95])
    # As draws are rounded.
    at = float(rank_of(draws[:, None], np.array([round(truth, 5)]), rng)[0])
    narrow = float(np.mean(middle + NARROW * (draws - middle) < truth))
    return {"place": at, "off": float(middle - truth), "width": float(high - low), "narrow": narrow}


def _wait(service: Sequence[Any]) -> float | None:
    """Return the days until the service; None where none is advised for want of a prognosis."""
    kind, wait = service
    if kind == "unknown":
        return None
    return np.inf if kind == "later" else float(wait)


def _names(life: Life, why: str) -> bool:
    """Return whether the first mode of an explanation is the one that moves alone, if one does."""
    named = sorted((why.lower().index(mode), mode) for mode in MODES if mode in why.lower())
    return not life.world.lone or (bool(named) and named[0][1] == life.world.lone[0])


def summarised(rows: Sequence[Row]) -> Row:
    """Summarise lives of one kind, or of several that wear alike."""
    clear = [row for row in rows if row["right"] is not None]
    left = [row["left"] for row in rows if row["left"]]
    near = [row["left"]["width"] for row in rows if row["left"] and row["share"] == SHARES[-1]]
    sure = [row for row in clear if row["probability"] is not None]
    return {
        "n": len(rows),
        "verdicts": dict(Counter(row["verdict"] for row in rows)),
        "right": _share([row["right"] for row in clear]),
        "expected": float(sum(row["probability"] for row in sure)),
        "surely_degraded": _share([row["surely_degraded"] for row in rows]),
        "soon": _share([row["soon"] for row in rows]),
        "late": _share([row["late"] for row in rows if row["left"]]),
        "left_90": _share([abs(one["place"] - 0.5) < 0.45 for one in left]),
        "left_width": float(np.median(near)) if near else None,
        "health": {name: _summed([row for row in rows if name in row["health"]], name)
                   for name in PARAMETERS if any(name in row["health"] for row in rows)},
    }  # fmt: skip


def _summed(rows: Sequence[Row], name: str) -> Row:
    """Summarise what is published of a parameter."""
    own = [row["health"][name] for row in rows]
    keys = "place", "off", "width", "narrow"
    places, off, width, narrow = (np.array([one[key] for one in own]) for key in keys)
    best = [row["ideal"].get(name) for row in rows]
    ratio = [w / one["width"] for w, one in zip(width, best, strict=True) if one]
    held = [abs(one["place"] - 0.5) < 0.45 for one in best if one]
    return {
        "n": len(own),
        "held_90": _share(np.abs(places - 0.5) < 0.45),
        "held_50": _share(np.abs(places - 0.5) < 0.25),
        "held_90_narrow": _share(np.abs(narrow - 0.5) < 0.45),
        "bias": [float(off.mean()), float(off.std() / np.sqrt(len(off)))],
        "rms": float(np.sqrt(np.mean(off**2))),
        "width": float(np.median(width)),
        "width_over_ideal": float(np.median(ratio)) if ratio else None,
        "ideal_held_90": _share(held),
    }


def _share(hits: Any) -> Row | None:
    """Count hits, with the Clopper-Pearson interval of 95 %; None of none."""
    values = [bool(hit) for hit in hits]
    return share_row(sum(values), len(values), LEVEL) if values else None
