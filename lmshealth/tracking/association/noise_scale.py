"""Scale of the stated errors of each source, from the scatter of successive estimates.

Another program may state standard deviations that are wrong by an order of magnitude. Gates and
likelihoods of association need the scatter itself, before it is known which mode an estimate is of:
two estimates of successive logs that are each other's nearest are nearly always of one mode.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from lmshealth._private.arrays import BoolArray, FloatArray
from lmshealth.tracking import constants
from lmshealth.tracking.association.mode_filters import IntArray, Measurements

Scales = dict[str, FloatArray]
"""Factors on the stated errors of ln f and ln ζ by source, ``(2,)``; 1 where there is none."""

_SCALES, _CHANCES = np.array(constants.SOURCE_NOISE_SCALES).T
_GRID = np.geomspace(_SCALES[0], _SCALES[-1], 41)  # 1 in its middle
_LOG_PRIOR = np.interp(np.log(_GRID), np.log(_SCALES), np.log(_CHANCES))
# Logs that are compared with those before them at once.
_BLOCK = 256


def learn_scales(
    measurements: Sequence[Measurements],
    sources: Sequence[tuple[str, ...]],
    offsets: FloatArray,
    prior_std: FloatArray,
) -> list[Scales]:
    """Return the scales of every log, as the logs up to it show them.

    They are the most probable ones of a grid, with the prior of the tracker's noise scales, and
    change only by more than `constants.LEAST_RESCALING`: until then the same object is returned.
    `sources` are those of the estimates of each log, other parameters those of `associate`.
    """
    ends = np.cumsum([0, *(len(own) for own in sources)])
    source_of = np.array([source for own in sources for source in own], dtype=object)
    log_of = np.repeat(np.arange(len(sources)), np.diff(ends))
    columns = ("ln_f", "var_f", "ln_zeta", "var_zeta")
    values = np.array([np.concatenate([getattr(m, c) for m in measurements]) for c in columns])
    likely: dict[int, Scales] = {}
    for source in dict.fromkeys(source_of):
        rows = np.flatnonzero(source_of == source)
        for k, scale in _likely_scales(values[:, rows], log_of[rows], offsets * prior_std):
            likely.setdefault(k, {})[source] = scale
    held: Scales = {}
    scales = []
    for k in range(len(sources)):
        for source, scale in likely.get(k, {}).items():
            change = np.abs(np.log(scale / held.get(source, np.ones(2)))).max()
            if change > np.log(constants.LEAST_RESCALING):
                held = {**held, source: scale}
        scales.append(held)
    return scales


def _likely_scales(
    values: FloatArray, log_of: IntArray, moving: FloatArray
) -> Iterator[tuple[int, FloatArray]]:
    """Yield the logs of a source after which other scales are the most probable ones, with these.

    `values` are ln f, its variance, ln ζ and its variance of all estimates, ``(4, n)``, `log_of`
    their logs and `moving` ln f by the covariates of each log, ``(n_logs, n_covariates)``.
    """
    logs, first, counts = np.unique(log_of, return_index=True, return_counts=True)
    # Rows of the estimates of each log; those that are missing have no distance.
    place = np.arange(counts.max())
    there, rows = place < counts[:, None], np.minimum(first[:, None] + place, log_of.size - 1)
    odds, before = np.array([_LOG_PRIOR, _LOG_PRIOR]), np.full(2, _GRID.size // 2)
    for start in range(0, logs.size, _BLOCK):
        block = np.arange(max(start, 1), min(start + _BLOCK, logs.size))
        gain = np.zeros((block.size + 1, 2, _GRID.size))
        gain[0] = odds
        new, old, pair = _nearest_pairs(values[0], rows, there, block)
        moved = np.sum((moving[logs[block]] - moving[logs[block - 1]]) ** 2, axis=1)
        np.add.at(gain, pair + 1, _evidence(values[:, new], values[:, old], moved[pair]))
        gain = np.cumsum(gain, axis=0)
        odds, best = gain[-1], gain[1:].argmax(axis=2)
        for at in np.flatnonzero((np.diff(best, axis=0, prepend=before[None]) != 0).any(axis=1)):
            yield int(logs[block[at]]), _GRID[best[at]]
        before = best[-1] if best.size else before


def scaled(new: Measurements, sources: tuple[str, ...], scales: Scales) -> Measurements:
    """Return the estimates of one log with the variances by the scales of their sources."""
    if not scales:
        return new
    factor = np.array([scales.get(source, np.ones(2)) for source in sources]).reshape(-1, 2)
    var_f, var_zeta = np.array([new.var_f, new.var_zeta]) * factor.T**2
    return replace(new, var_f=var_f, var_zeta=var_zeta)


def _nearest_pairs(
    ln_f: FloatArray, rows: IntArray, there: BoolArray, block: IntArray
) -> tuple[IntArray, IntArray, IntArray]:
    """Return the estimates of logs of a block and of the logs before that are each other's nearest.

    Returned are both estimates of each pair, and the index of the log in the block.
    """
    gap = np.abs(ln_f[rows[block]][:, :, None] - ln_f[rows[block - 1]][:, None, :])
    gap[~(there[block][:, :, None] & there[block - 1][:, None, :])] = np.inf
    own, back = gap.argmin(axis=2), gap.argmin(axis=1)
    mutual = np.take_along_axis(back, own, axis=1) == np.arange(own.shape[1])
    pair, i = np.nonzero(mutual & there[block])
    return rows[block[pair], i], rows[block[pair] - 1, own[pair, i]], pair


def _evidence(new: FloatArray, old: FloatArray, moved: FloatArray) -> FloatArray:
    """Return the log evidence of n pairs for each scale of ln f and of ln ζ, ``(n, 2, n_scales)``.

    `new` and `old` are as the values of `_likely_scales`, ``(4, n)``; `moved` is the variance of
    ln f by the covariates between them, ``(n,)``. A share of the pairs is of different modes: their
    differences have any size. Each estimate is in two differences, so that these count half.
    """
    off = (new[[0, 2]] - old[[0, 2]]).T
    stated = (new[[1, 3]] + old[[1, 3]]).T
    known = np.isfinite(stated)
    var = np.where(known, stated, 1.0)[:, :, None] * _GRID**2
    var[:, 0] += moved[:, None]
    share = constants.STRAY_PROBABILITY
    density = np.exp(-0.5 * off[:, :, None] ** 2 / var) / np.sqrt(2 * np.pi * var)
    gain = np.log((1 - share) * density + share)
    return np.asarray(0.5 * np.where(known[:, :, None], gain, 0.0))
