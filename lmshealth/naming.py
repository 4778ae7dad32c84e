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
# A damping off its target's by more than this factor belongs to something else.
DAMPING_SPAN = 6.0


def assign(
    found: list[tuple[float, float]], targets: tuple[Target, ...]
) -> tuple[list[str], dict[str, str]]:
    """Weigh all ways to name found modes that keep the order of the targets.

    Wear moves all modes of a guide together: their common shift is taken to be half of the search,
    what each has of its own a sixth.

    Parameters
    ----------
    found : list of (float, float)
        Frequency in Hz and damping ratio of what was found, ascending in frequency.
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
    for k in range(min(len(found), len(targets)) + 1):
        for some in combinations(range(len(found)), k):
            for sought in combinations(range(len(targets)), k):
                pairs = list(zip(some, sought, strict=True))
                if all(may_be(targets[j], *found[i]) for i, j in pairs):
                    ways.append(dict(pairs))
                    weights.append(k * _MATCH - _cost(found, targets, pairs))
    chance = np.zeros((len(found), len(targets)))
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
            told = ", ".join(f"{found[i][0]:.5g} Hz {100 * chance[i, j]:.0f} %" for i in likely)
            unclear[target.name] = f"which resonance it is cannot be told: {told}"
    return names, unclear


def may_be(target: Target, f: float, zeta: float) -> bool:
    """Tell whether something found is near enough to a target, in frequency and in damping."""
    near = abs(np.log(f / target.frequency)) <= np.log1p(target.search)
    return bool(near and abs(np.log(zeta / target.damping_ratio)) < np.log(DAMPING_SPAN))


def _cost(
    found: list[tuple[float, float]], targets: tuple[Target, ...], pairs: list[tuple[int, int]]
) -> float:
    """Negative log prior of the shifts of ln f."""
    if not pairs:
        return 0.0
    shift = np.log([found[i][0] / targets[j].frequency for i, j in pairs])
    search = np.array([targets[j].search for _, j in pairs])
    own = shift - shift.mean()
    return float(
        0.5 * (shift.mean() / (search.mean() / 2)) ** 2 + 0.5 * np.sum((own / (search / 6)) ** 2)
    )
