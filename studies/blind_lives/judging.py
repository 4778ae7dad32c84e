"""How right the answers are, and how right they say that they are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from studies.blind_lives.lives import SEED, WORDS
from studies.common.metrics import clopper_pearson
from studies.harness.study import LEVEL, Row

LEVELS = {0.5: ("q25", "q75"), 0.9: ("q05", "q95")}
_BINS = (0.0, 0.5, 0.8, 0.95, 0.99, 1.0)
# Nothing that is told is surer than that when it is scored: a posterior has some thousand draws.
_SUREST = 1e-3
_SHRUNK = 3.0
# Standard deviations by which rights may fall short of what was told: one run in a thousand.
_SHORT = -3.09


def confusion(rows: Iterable[Row]) -> dict[str, dict[str, int]]:
    """Count what was told of what is true, each in the order of `WORDS`."""
    seen = Counter((row["truth"]["verdict"], row["told"]["verdict"]) for row in rows)
    return {true: {told: seen[true, told] for told in WORDS} for true in WORDS}


def share(hits: Iterable[bool]) -> Row:
    """Count hits, with the 95 % Clopper-Pearson interval of their share."""
    found = list(hits)
    low, high = clopper_pearson(sum(found), len(found)) if found else (0.0, 1.0)
    return {"hits": sum(found), "n": len(found), "low": low, "high": high}


def of_others(rows: Sequence[Row]) -> list[Row]:
    """Give every answer the truth of another life of the same stage: a control."""
    rng = np.random.default_rng([SEED, 0, 1])
    mixed: list[Row] = []
    for stage in sorted({row["stage"] for row in rows}):
        own = [row for row in rows if row["stage"] == stage]
        order = rng.permutation(len(own))
        other = np.roll(order, 1)
        mixed += [own[i] | {"truth": own[j]["truth"]} for i, j in zip(order, other, strict=True)]
    return mixed


def sureness(rows: Iterable[Row]) -> Row:
    """Tell whether verdicts are right as often as they say, and score their probabilities.

    Returns
    -------
    dict
        How many were right and how many their probabilities promise, by how many standard
        deviations (of so many independent trials) the first exceeds the second and whether it is
        no less; Brier and logarithmic score beside those of the share of rights told of all; the
        same in bins of what was told.
    """
    pairs = [
        (row["told"]["probability"], row["told"]["verdict"] == row["truth"]["verdict"])
        for row in rows
        if row["told"]["probability"] is not None
    ]
    if not pairs:
        return {"n": 0}
    told, right = np.array(pairs, dtype=float).T
    base = np.full(told.size, right.mean())
    spread = np.sqrt(np.sum(told * (1 - told)))
    # With hardly any doubt told, the spread of rights is that of one trial at least.
    z = float((right.sum() - told.sum()) / max(spread, 0.5))
    places = np.clip(np.searchsorted(_BINS, told, side="left") - 1, 0, len(_BINS) - 2)
    return {
        "n": told.size,
        "right": int(right.sum()),
        "promised": round(float(told.sum()), 2),
        "z": round(z, 2),
        "holds": z > _SHORT,
        "brier": [round(float(np.mean((p - right) ** 2)), 4) for p in (told, base)],
        "log_score": [round(_log_score(p, right), 4) for p in (told, base)],
        "bins": [
            {"from": _BINS[k], "to": _BINS[k + 1], "told": round(float(told[own].mean()), 4)}
            | share(map(bool, right[own]))
            for k in range(len(_BINS) - 1)
            if (own := places == k).any()
        ],
    }


def _log_score(told: np.ndarray, right: np.ndarray) -> float:
    p = np.clip(told, _SUREST, 1 - _SUREST)
    return float(-np.mean(np.where(right == 1, np.log(p), np.log(1 - p))))


def coverages(rows: Iterable[Row], what: str, names: Iterable[str]) -> dict[str, dict[str, Row]]:
    """Count intervals of what is claimed that hold the truth: ``health`` or what is ``left``.

    Returns
    -------
    dict
        Of every name and level, as they are and shrunk to a third about the median.
    """
    found = list(rows)
    told: dict[str, dict[str, Row]] = {}
    for name in names:
        pairs = [(row["told"][what][name], row["truth"][what][name]) for row in found
                 if name in row["told"][what] and name in row["truth"][what]]  # fmt: skip
        told[name] = {
            f"{100 * level:.0f}{way}": _at_least(level, [hold(*pair, ends) for pair in pairs])
            for level, ends in LEVELS.items()
            for way, hold in _WAYS.items()
        }
    return told


def _at_least(level: float, held: Sequence[bool]) -> Row:
    """Judge a coverage that must not be less than told: the map's error is in every interval."""
    high = clopper_pearson(sum(held), len(held), LEVEL)[1] if held else 1.0
    return share(held) | {"holds": high >= level}


def _holds(interval: Row, truth: float | None, ends: tuple[str, str]) -> bool:
    low, high = (_number(interval[end]) for end in ends)
    return low <= _number(truth) <= high


def _shrunk_holds(interval: Row, truth: float | None, ends: tuple[str, str]) -> bool:
    low, middle, high = (_number(interval[key]) for key in (ends[0], "q50", ends[1]))
    true = _number(truth)
    if not np.isfinite(middle):  # most of it lies past the horizon, and so must the truth
        return not np.isfinite(true)
    return middle - (middle - low) / _SHRUNK <= true <= middle + (high - middle) / _SHRUNK


def _number(value: float | None) -> float:
    """Read a travel: None is past the horizon."""
    return np.inf if value is None else value


_WAYS: dict[str, Callable[[Row, float | None, tuple[str, str]], bool]] = {
    "": _holds,
    " shrunk": _shrunk_holds,
}
