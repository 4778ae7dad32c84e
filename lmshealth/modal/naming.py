"""Give what rings its names, and join it into one result.

Names go by frequency, in order, and only where they are clear.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.special import softmax

from lmshealth._arrays import FloatArray
from lmshealth.errors import BadLog
from lmshealth.io.log import Log, Refusal
from lmshealth.modal.ambient.initial_values import (
    shift_cost,
)
from lmshealth.modal.modes import Modes
from lmshealth.modal.targets import Target

# What a named mode gains over a mode missed and a stranger found, in log likelihood.
_MATCH = 3.5
# Probability from which on a found mode is given its name; below the second nobody asks for it.
_CLEAR, _UNLIKELY = 0.8, 0.01
# A damping off its target's by more than this factor belongs to something else.
_DAMPING_SPAN = 6.0


@dataclass(frozen=True, slots=True, eq=False)
class Pole:
    """Something that rings, before it has a name.

    Attributes
    ----------
    frequency, damping : float
        Natural frequency in Hz and damping ratio.
    snr : ndarray
        Of each channel, shape ``(n_channels,)``.
    why : (str, str) or None
        Reason and detail where it is not believed to be a mode.
    """

    frequency: float
    damping: float
    snr: FloatArray
    why: tuple[str, str] | None


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """What a band of one kind of channels shows.

    Attributes
    ----------
    source : str
        ``acc`` or ``delta_e``.
    channels : tuple of str
        Names.
    poles : tuple of Pole
        Those believed, n of them.
    mean, cov : ndarray
        ``[ln f, ln ζ]`` of ``poles``, shapes ``(2 n,)`` and ``(2 n, 2 n)``.
    doubted : tuple of Pole
        Those not believed.
    """

    source: str
    channels: tuple[str, ...]
    poles: tuple[Pole, ...]
    mean: FloatArray
    cov: FloatArray
    doubted: tuple[Pole, ...]


# A name, and of which band's poles which.
_Row = tuple[str, Band, int]


def name_modes(log: Log, targets: tuple[Target, ...], bands: list[Band]) -> Modes:
    """Name what was found and join it into one result.

    Parameters
    ----------
    log : Log
        Where it was found.
    targets : tuple of Target
        What was sought, ascending in frequency; without any, what was found is numbered.
    bands : list of Band
        What was found.

    Raises
    ------
    BadLog
        If nothing was sought and nothing found.
    """
    chosen, refused = _named(log, targets, bands) if targets else (_numbered(log, bands), [])
    rows = sorted(chosen, key=lambda row: row[1].poles[row[2]].frequency)
    n = len(rows)
    mean, cov = np.empty(2 * n), np.zeros((2 * n, 2 * n))
    for a, (_, band, i) in enumerate(rows):
        m = len(band.poles)
        mean[[a, n + a]] = band.mean[[i, m + i]]
        for b, (_, other, j) in enumerate(rows):
            if other is band:
                cov[np.ix_([a, n + a], [b, n + b])] = band.cov[np.ix_([i, m + i], [j, m + j])]
    snr = [band.poles[i].snr for _, band, i in rows]
    return Modes(
        names=tuple(name for name, _, _ in rows),
        sources=tuple(band.source for _, band, _ in rows),
        channels=tuple(
            band.channels[int(np.argmax(own))] for (_, band, _), own in zip(rows, snr, strict=True)
        ),
        ln_frequency=mean[:n],
        ln_damping=mean[n:],
        cov=cov,
        snr=np.array([own.max() for own in snr]),
        dispersion=np.full(n, np.nan),
        flags=("",) * n,
        shape_channels=(),
        shapes=np.empty((n, 0)),
        lines=(),
        refused=(*log.refused, *refused),
    )


def _numbered(log: Log, bands: list[Band]) -> list[_Row]:
    """Give numbers to what rings; Δe is not asked about what accelerometers show."""
    there = [(band, i, pole) for band in bands for i, pole in enumerate(band.poles)]
    seen = [pole for band, _, pole in there if band.source == "acc"]
    kept = [
        (band, i, pole)
        for band, i, pole in there
        if band.source == "acc"
        or all(abs(pole.frequency / p.frequency - 1) >= 2 * pole.damping for p in seen)
    ]
    if not kept:
        doubted = [pole for band in bands for pole in band.doubted]
        loudest = max(doubted, key=lambda pole: pole.snr.max(), default=None)
        nothing = ("not-excited", "nothing rings in the band: stop harder, or look elsewhere")
        raise BadLog(log.name, *((loudest and loudest.why) or nothing))
    kept.sort(key=lambda row: row[2].frequency)
    return [(f"mode_{k}", band, i) for k, (band, i, _) in enumerate(kept, 1)]


def _named(
    log: Log, targets: tuple[Target, ...], bands: list[Band]
) -> tuple[list[_Row], list[Refusal]]:
    """Give names by frequency: accelerometers first, then Δe for what they do not show."""
    rows: list[_Row] = []
    unclear: dict[str, str] = {}
    for source in ("acc", "delta_e"):
        missing = tuple(t for t in targets if t.name not in {name for name, _, _ in rows})
        there = [
            (pole, band, i)
            for band in bands
            if band.source == source
            for i, pole in enumerate(band.poles)
        ]
        there.sort(key=lambda item: item[0].frequency)
        seen = [(pole.frequency, pole.damping) for pole, _, _ in there]
        names, why = assign(seen, missing)
        rows += [(n, band, i) for n, (_, band, i) in zip(names, there, strict=True) if n]
        unclear |= why
    named = {name for name, _, _ in rows}
    refused = []
    for target in targets:
        if target.name not in named:
            reason = _why_not(target, bands)
            if target.name in unclear:
                reason = ("ambiguous", unclear[target.name])
            refused.append(Refusal(log.name, *reason, mode=target.name))
    return rows, refused


def _why_not(target: Target, bands: list[Band]) -> tuple[str, str]:
    """Say why a mode was not found: what was seen where it should be, or that nothing was."""
    seen = [pole for band in bands for pole in (*band.poles, *band.doubted)]
    near = [pole for pole in seen if is_near(target, pole.frequency)]
    if not near:
        return (
            "not-excited",
            f"nothing rings within {100 * target.search:.0f} % of {target.frequency:.4g} Hz; "
            "excite it more, or look for it while the stage moves",
        )
    loudest = max(near, key=lambda pole: pole.snr.max())
    return loudest.why or (
        "outside-search",
        f"what rings at {loudest.frequency:.5g} Hz with damping {loudest.damping:.2g} is not "
        f"within a factor of {_DAMPING_SPAN:g} of the damping {target.damping_ratio:.2g}",
    )


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
                if all(_may_be(targets[j], *found[i]) for i, j in pairs):
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


def is_near(target: Target, f: float, *, slack: float = 1.0) -> bool:
    """Tell whether a frequency is within so many times the search of a target."""
    return bool(abs(np.log(f / target.frequency)) <= slack * np.log1p(target.search))


def _may_be(target: Target, f: float, zeta: float) -> bool:
    """Tell whether something found is near enough to a target, in frequency and in damping."""
    off = abs(np.log(zeta / target.damping_ratio))
    return is_near(target, f) and bool(off < np.log(_DAMPING_SPAN))


def _cost(
    found: list[tuple[float, float]], targets: tuple[Target, ...], pairs: list[tuple[int, int]]
) -> float:
    """Negative log prior of the shifts of ln f."""
    if not pairs:
        return 0.0
    shift = np.log([[found[i][0] / targets[j].frequency for i, j in pairs]])
    search = np.array([targets[j].search for _, j in pairs])
    return float(shift_cost(shift, search, len(pairs))[0])
