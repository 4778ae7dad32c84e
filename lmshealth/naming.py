"""Give what was found the names that its frequencies speak for."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from scipy.special import softmax

from lmshealth.starts import Target

# What a named mode gains over a mode missed and a stranger found, in log likelihood.
_MATCH = 3.5
# Probability from which on a found mode is given its name; below the second nobody asks for it.
_CLEAR, _UNLIKELY = 0.8, 0.01


def assign(frequency: list[float], targets: tuple[Target, ...]) -> tuple[list[str], dict[str, str]]:
    """Weigh all ways to name found modes that keep the order of the targets.

    Wear moves all modes of a guide together: their common shift is taken to be half of the search,
    what each has of its own a sixth.

    Parameters
    ----------
    frequency : list of float
        What was found, ascending, in Hz.
    targets : tuple of Target
        What was sought, ascending.

    Returns
    -------
    names : list of str
        Of each found mode; empty where it is no target, or where it is not clear which.
    unclear : dict of str to str
        Of each target that may be one of several, or one of which may be several, what is unclear.
    """
    ways: list[dict[int, int]] = []
    weights: list[float] = []
    for k in range(min(len(frequency), len(targets)) + 1):
        for found in combinations(range(len(frequency)), k):
            for sought in combinations(range(len(targets)), k):
                shift = np.log(
                    [
                        frequency[i] / targets[j].frequency
                        for i, j in zip(found, sought, strict=True)
                    ]
                )
                search = np.array([targets[j].search for j in sought])
                if (np.abs(shift) > np.log1p(search)).any():
                    continue
                ways.append(dict(zip(found, sought, strict=True)))
                weights.append(k * _MATCH - _cost(shift, search))
    chance = np.zeros((len(frequency), len(targets)))
    for way, weight in zip(ways, softmax(weights), strict=True):
        for i, j in way.items():
            chance[i, j] += weight
    names = [
        targets[int(np.argmax(row))].name if row.size and row.max() >= _CLEAR else ""
        for row in chance
    ]
    unclear = {}
    for j, target in enumerate(targets):
        likely = np.flatnonzero(chance[:, j] > _UNLIKELY)
        if target.name not in names and likely.size:
            told = ", ".join(f"{frequency[i]:.5g} Hz {100 * chance[i, j]:.0f} %" for i in likely)
            unclear[target.name] = f"which resonance it is cannot be told: {told}"
    return names, unclear


def _cost(shift: np.ndarray, search: np.ndarray) -> float:
    """Negative log prior of shifts of ln f."""
    if not shift.size:
        return 0.0
    common = shift.mean()
    cost = 0.5 * (common / (search.mean() / 2)) ** 2
    return float(cost + 0.5 * np.sum(((shift - common) / (search / 6)) ** 2))
