"""Estimates that belong to no mode, watched until they are one: births and jumps.

A single estimate apart from all modes is most often nothing. It is followed by a filter of its own,
and its odds of being a mode grow with every log that shows it where the filter expects it.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from lmshealth._arrays import FloatArray
from lmshealth.tracking.association.hypotheses import SHOWN, Scan, stranger_gains
from lmshealth.tracking.association.mode_filters import Bank

# Odds that an estimate apart from all modes is a mode's first; when it is one, when it is dropped.
_NEW_ODDS, _CONFIRMED, _DROPPED = 1e-3, 0.95, 1e-5
_LEAST_LOGS = 3
_LEAST_LOGS_NAMED = 2


class Newcomers:
    """What may become a mode, or a mode's new level.

    Parameters
    ----------
    n_covariates, n_channels : int
        Sizes of its filters.
    """

    def __init__(self, n_covariates: int, n_channels: int) -> None:
        self.bank = Bank.empty(n_covariates, n_channels)
        self._names: list[int] = []
        self._log_odds: list[float] = []
        self._logs: list[int] = []
        self._last: list[int] = []

    def __len__(self) -> int:
        return len(self._names)

    def watch(self, scan: Scan, prior_std: FloatArray, scale: float) -> list[int | None]:
        """Follow strangers and say which newcomer each is, with all that are confirmed.

        Parameters
        ----------
        scan : Scan
            Estimates that are of no mode; a name is that of a mode which the log does not show
            elsewhere, else -1.
        prior_std : ndarray
            Of the covariates' coefficients.
        scale : float
            Length of a life on the clock.

        Returns
        -------
        list of int or None
            For each estimate the newcomer that it confirms.
        """
        mine = self._match(scan)
        for j in mine:
            if j is not None and self._last[j] != scan.epoch:
                self._logs[j] += 1
                self._last[j] = scan.epoch
        lone = np.array([i for i, j in enumerate(mine) if j is None], dtype=int)
        if lone.size:
            self.bank = self.bank.found(scan.readings.pick(lone), scan.row, prior_std, scale)
            self._names += scan.names[lone].tolist()
            self._log_odds += [float(np.log(_NEW_ODDS))] * lone.size
            self._logs += [1] * lone.size
            self._last += [scan.epoch] * lone.size
        return [j if j is not None and self._confirmed(j) else None for j in mine]

    def _match(self, scan: Scan) -> list[int | None]:
        """Assign estimates to newcomers, one to one, and update these."""
        mine: list[int | None] = [None] * scan.rows.size
        if not self._names:
            return mine
        gains = stranger_gains(self.bank.compare(scan.readings, scan.row))[0]
        # Being seen counts against being no mode, not against being missed.
        gains += np.log(1 - SHOWN)
        theirs = np.array(self._names)
        gains[scan.names[:, None] != theirs] = -np.inf
        best = np.maximum(gains, 0.0)
        pairs = [(i, j) for i, j in zip(*linear_sum_assignment(-best), strict=True) if best[i, j]]
        for i, j in pairs:
            mine[i] = int(j)
            self._log_odds[j] += float(gains[i, j])
        if pairs:
            rows, own = (np.array(side) for side in zip(*pairs, strict=True))
            at = (np.zeros_like(own), own)
            self.bank.absorb(at, scan.readings.pick(rows), scan.row)
        return mine

    def _confirmed(self, j: int) -> bool:
        if self._names[j] >= 0:
            return self._logs[j] >= _LEAST_LOGS_NAMED
        sure = self._log_odds[j] > np.log(_CONFIRMED / (1 - _CONFIRMED))
        return sure and self._logs[j] >= _LEAST_LOGS

    def name(self, j: int) -> int:
        """Return the mode whose new level a newcomer is, -1 for a new mode."""
        return self._names[j]

    def forget(self, epoch: int, gone: set[int], back: set[int]) -> None:
        """Close a log: drop what it makes unlikely.

        Parameters
        ----------
        epoch : int
            The log.
        gone : set of int
            Newcomers that are modes now.
        back : set of int
            Modes that were seen where they were expected: what had jumped with their name had not.
        """
        if not self._names:
            return
        for j, last in enumerate(self._last):
            if last != epoch:
                self._log_odds[j] += float(np.log(1 - SHOWN))
        kept = [
            j
            for j, odds in enumerate(self._log_odds)
            if j not in gone and self._names[j] not in back and odds > np.log(_DROPPED)
        ]
        if len(kept) < len(self._names):
            self.bank = self.bank.keep(np.array(kept, dtype=int))
            self._names = [self._names[j] for j in kept]
            self._log_odds = [self._log_odds[j] for j in kept]
            self._logs = [self._logs[j] for j in kept]
            self._last = [self._last[j] for j in kept]
