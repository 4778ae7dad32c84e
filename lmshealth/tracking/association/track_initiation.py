"""Track initiation: estimates of no mode that become modes, or new levels of modes, or are deleted.

A candidate has a filter of its own. Its odds of being a mode grow with every log that detects it
where the filter predicts it, and shrink with every log that does not.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.optimize import linear_sum_assignment

from lmshealth._private.arrays import FloatArray
from lmshealth.tracking import constants
from lmshealth.tracking.association.hypotheses import Scan, clutter_gains
from lmshealth.tracking.association.mode_filters import IntArray, ModeFilters, update


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Tentative tracks, all arrays of shape ``(n,)``."""

    filters: ModeFilters  # one hypothesis, a mode per candidate
    modes: IntArray  # mode of which this may be the new level; -1 for a new mode
    log_odds: FloatArray  # of being a mode
    n_logs: IntArray  # number of logs that detect it
    last: IntArray  # the last of them

    @classmethod
    def empty(cls, n_covariates: int, n_channels: int) -> Self:
        """Return no candidates."""
        none = np.empty(0, dtype=int)
        return cls(ModeFilters.empty(n_covariates, n_channels), none, np.empty(0), none, none)

    def __len__(self) -> int:
        return self.modes.size

    def confirmed(self, j: int) -> bool:
        """Return whether a candidate is a mode."""
        if self.modes[j] >= 0:
            return bool(self.n_logs[j] >= constants.LEAST_LOGS_NAMED)
        chance = constants.CONFIRMATION_PROBABILITY
        sure = self.log_odds[j] > np.log(chance / (1 - chance))
        return bool(sure and self.n_logs[j] >= constants.LEAST_LOGS_NEW)


def follow(
    candidates: Candidates, scan: Scan, prior_std: FloatArray, life: float
) -> tuple[Candidates, list[int | None]]:
    """Update candidates with a scan and start new ones.

    Their filters are predicted to the log. The scan has the estimates of no mode, with the mode of
    which each may be the new level as its name, else -1. Returned are the candidates, new ones at
    the end, and for each estimate the candidate that it confirms, or None.
    """
    candidates, mine = _assign(candidates, scan)
    known = [j for j in mine if j is not None]
    n_logs, last = candidates.n_logs.copy(), candidates.last.copy()
    n_logs[known] += last[known] != scan.epoch
    last[known] = scan.epoch
    lone = np.array([i for i, j in enumerate(mine) if j is None], dtype=int)
    filters = candidates.filters
    if lone.size:
        filters = filters.start(scan.measurements[lone], scan.row, prior_std, life)
    grown = Candidates(
        filters,
        np.append(candidates.modes, scan.names[lone]),
        np.append(candidates.log_odds, np.full(lone.size, np.log(constants.INITIATION_ODDS))),
        np.append(n_logs, np.ones(lone.size, dtype=int)),
        np.append(last, np.full(lone.size, scan.epoch)),
    )
    return grown, [j if j is not None and grown.confirmed(j) else None for j in mine]


def _assign(candidates: Candidates, scan: Scan) -> tuple[Candidates, list[int | None]]:
    """Assign estimates to candidates, one to one, and update these."""
    mine: list[int | None] = [None] * scan.rows.size
    if not len(candidates):
        return candidates, mine
    # The alternative of a detection is clutter, not a missed detection.
    gains = clutter_gains(candidates.filters, scan)[0]
    gains += np.log(1 - constants.DETECTION_PROBABILITY)
    gains[scan.names[:, None] != candidates.modes] = -np.inf
    best = np.maximum(gains, 0.0)
    pairs = [(i, j) for i, j in zip(*linear_sum_assignment(-best), strict=True) if best[i, j]]
    if not pairs:
        return candidates, mine
    for i, j in pairs:
        mine[i] = int(j)
    rows, own = (np.array(side) for side in zip(*pairs, strict=True))
    log_odds = candidates.log_odds.copy()
    log_odds[own] += gains[rows, own]
    at = (np.zeros_like(own), own)
    filters = update(candidates.filters, at, scan.measurements[rows], scan.row)
    return replace(candidates, filters=filters, log_odds=log_odds), mine


def prune(
    candidates: Candidates, epoch: int, confirmed: Collection[int], detected: Collection[int]
) -> Candidates:
    """Delete candidates that have become modes (`confirmed`), or whose odds are too low.

    Those for new levels of modes that were `detected` at their old level are deleted too.
    """
    if not len(candidates):
        return candidates
    missed = np.log(1 - constants.DETECTION_PROBABILITY)
    odds = candidates.log_odds + np.where(candidates.last != epoch, missed, 0.0)
    keep = odds > np.log(constants.DELETION_ODDS)
    keep[list(confirmed)] = False
    keep &= ~np.isin(candidates.modes, list(detected))
    kept = np.flatnonzero(keep)
    filters = candidates.filters
    if kept.size < len(candidates):
        filters = filters.keep(kept)
    return Candidates(
        filters, candidates.modes[kept], odds[kept], candidates.n_logs[kept], candidates.last[kept]
    )
