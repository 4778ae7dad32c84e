"""Scale of the stated errors of each source, from the scatter of successive estimates.

Another program may state standard deviations that are wrong by an order of magnitude. Gates and
likelihoods of association need the scatter itself, before it is known which mode an estimate is of:
two estimates of successive logs that are each other's nearest are nearly always of one mode.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lmshealth._arrays import FloatArray
from lmshealth.tracking import constants
from lmshealth.tracking.association.mode_filters import IntArray, Measurements

Scales = dict[str, FloatArray]
"""Factors on the stated errors of ln f and ln ζ by source, ``(2,)``; 1 where there is none."""

_SCALES, _CHANCES = np.array(constants.SOURCE_NOISE_SCALES).T
_GRID = np.geomspace(_SCALES[0], _SCALES[-1], 41)  # 1 in its middle
_LOG_PRIOR = np.interp(np.log(_GRID), np.log(_SCALES), np.log(_CHANCES))


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
    log_odds: Scales = {}
    last: dict[str, tuple[Measurements, FloatArray]] = {}
    held: Scales = {}
    scales = []
    for k, (new, own) in enumerate(zip(measurements, sources, strict=True)):
        moving = offsets[k] * prior_std
        for source in dict.fromkeys(own):
            part = new[np.flatnonzero([one == source for one in own])]
            odds = log_odds.setdefault(source, np.array([_LOG_PRIOR, _LOG_PRIOR]))
            if source in last:
                before, moved = last[source]
                odds += _evidence(part, before, float(np.sum((moving - moved) ** 2)))
            last[source] = (part, moving)
            likely = _GRID[odds.argmax(axis=1)]
            change = np.abs(np.log(likely / held.get(source, np.ones(2)))).max()
            if change > np.log(constants.LEAST_RESCALING):
                held = {**held, source: likely}
        scales.append(held)
    return scales


def scaled(new: Measurements, sources: tuple[str, ...], scales: Scales) -> Measurements:
    """Return the estimates of one log with the variances by the scales of their sources."""
    if not scales:
        return new
    factor = np.array([scales.get(source, np.ones(2)) for source in sources]).reshape(-1, 2)
    var_f, var_zeta = np.array([new.var_f, new.var_zeta]) * factor.T**2
    return replace(new, var_f=var_f, var_zeta=var_zeta)


def _evidence(new: Measurements, old: Measurements, moved: float) -> FloatArray:
    """Return the log evidence of two logs for each scale of ln f and of ln ζ, ``(2, n_scales)``.

    `moved` is the variance of ln f by the covariates between them. A share of the pairs is of
    different modes: their differences have any size. Each estimate is in two differences, so that
    these count half.
    """
    i, j = _nearest_pairs(new.ln_f, old.ln_f)
    off = np.array([new.ln_f[i] - old.ln_f[j], new.ln_zeta[i] - old.ln_zeta[j]])
    stated = np.array([new.var_f[i] + old.var_f[j], new.var_zeta[i] + old.var_zeta[j]])
    known = np.isfinite(stated)
    var = np.where(known, stated, 1.0)[:, :, None] * _GRID**2
    var += np.array([moved, 0.0])[:, None, None]
    share = constants.STRAY_PROBABILITY
    density = np.exp(-0.5 * off[:, :, None] ** 2 / var) / np.sqrt(2 * np.pi * var)
    gain = np.log((1 - share) * density + share)
    return np.asarray(0.5 * np.where(known[:, :, None], gain, 0.0).sum(axis=1))


def _nearest_pairs(new: FloatArray, old: FloatArray) -> tuple[IntArray, IntArray]:
    """Return the indices of estimates of two logs that are each other's nearest."""
    if not new.size or not old.size:
        return np.empty(0, dtype=int), np.empty(0, dtype=int)
    gap = np.abs(new[:, None] - old)
    own, back = gap.argmin(axis=1), gap.argmin(axis=0)
    rows = np.arange(new.size)
    mutual = back[own] == rows
    return rows[mutual], own[mutual]
