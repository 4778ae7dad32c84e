"""Candidates become modes by their odds and jumps by a second log, or are deleted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lmshealth.tracking.association.hypotheses import Scan
from lmshealth.tracking.association.mode_filters import Measurements, predict
from lmshealth.tracking.association.track_initiation import Candidates, follow, prune

NONE = Candidates.empty(0, 0)


def scan(epoch: int, ln_f: float, name: int = -1) -> Scan:
    """Make a log with one estimate of no mode."""
    own = Measurements(
        np.array([ln_f]), np.array([1e-6]), np.array([-4.0]), np.array([0.01]), np.empty((1, 0))
    )
    return Scan(epoch, np.arange(1), np.array([name]), own, np.array([1.0, 0.0]))


def followed(estimates: list[tuple[float, int] | None]) -> tuple[Candidates, list[int | None]]:
    """Process one estimate or none per log; return the candidates and what each log confirms."""
    candidates, confirmed = NONE, []
    for epoch, one in enumerate(estimates):
        candidates = replace(candidates, filters=predict(candidates.filters, 1.0, 50.0))
        own: list[int | None] = [None]
        if one:
            candidates, own = follow(candidates, scan(epoch, *one), np.zeros(0), 50.0)
        confirmed += own
        candidates = prune(candidates, epoch, set(), set())
    return candidates, confirmed


def test_three_logs_make_a_mode() -> None:
    """The third consistent estimate confirms a mode, also after a log without it."""
    assert followed([(4.8, -1)] * 3)[1] == [None, None, 0]
    assert followed([(4.8, -1), None, (4.8, -1), (4.8, -1)])[1][-1] == 0


def test_two_logs_make_a_jump() -> None:
    """The second estimate with the name of a mode confirms; another name does not."""
    assert followed([(4.8, 1), (4.8, 1)])[1] == [None, 0]
    assert followed([(4.8, 1), (4.8, 0)])[1] == [None, None]


def test_scattered_estimates_make_no_mode() -> None:
    """Scattered estimates confirm nothing; candidates without detections are deleted."""
    candidates, confirmed = followed([(4.0 + 0.3 * k, -1) for k in range(6)])
    assert confirmed == [None] * 6
    before = len(candidates)
    for epoch in range(6, 12):
        candidates = prune(candidates, epoch, set(), set())
    assert len(candidates) < before


def test_a_mode_detected_at_its_old_level_has_not_jumped() -> None:
    """The candidate for a new level is deleted once the mode is detected at the old one."""
    candidates, _ = followed([(4.8, 1)])
    assert len(candidates) == 1
    assert len(prune(candidates, 1, set(), {1})) == 0


def test_following_changes_no_candidates_given() -> None:
    """`follow` and `prune` leave the candidates that they are given unchanged."""
    before, _ = followed([(4.8, -1)])
    odds, mean = before.log_odds.copy(), before.filters.mean.copy()
    follow(before, scan(1, 4.8), np.zeros(0), 50.0)
    assert np.array_equal(before.log_odds, odds)
    assert np.array_equal(before.filters.mean, mean)
