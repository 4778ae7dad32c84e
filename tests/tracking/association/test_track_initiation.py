"""Strangers become modes by their odds, jumps by a second log, and are forgotten else."""

from __future__ import annotations

import numpy as np

from lmshealth.tracking.association.hypotheses import Scan
from lmshealth.tracking.association.mode_filters import Readings
from lmshealth.tracking.association.track_initiation import Newcomers


def scan(epoch: int, ln_f: float, name: int = -1) -> Scan:
    """Make a log with one stranger."""
    own = Readings(
        np.array([ln_f]), np.array([1e-6]), np.array([-4.0]), np.array([0.01]), np.empty((1, 0))
    )
    return Scan(epoch, np.arange(1), np.array([name]), own, np.array([1.0, 0.0]))


def follow(new: Newcomers, seen: list[tuple[float, int] | None]) -> list[int | None]:
    """Show one stranger or none in each log; return what each log confirms."""
    told: list[int | None] = []
    for epoch, one in enumerate(seen):
        new.bank.predict(1.0, 50.0)
        told += new.watch(scan(epoch, *one), np.zeros(0), 50.0) if one else [None]
        new.forget(epoch, set(), set())
    return told


def test_three_logs_make_a_mode() -> None:
    """The third consistent estimate confirms, also after a log that misses it."""
    assert follow(Newcomers(0, 0), [(4.8, -1)] * 3) == [None, None, 0]
    assert follow(Newcomers(0, 0), [(4.8, -1), None, (4.8, -1), (4.8, -1)])[-1] == 0


def test_two_logs_make_a_jump() -> None:
    """With the name of a mode the second estimate confirms; another name does not."""
    assert follow(Newcomers(0, 0), [(4.8, 1), (4.8, 1)]) == [None, 0]
    assert follow(Newcomers(0, 0), [(4.8, 1), (4.8, 0)]) == [None, None]


def test_scattered_strangers_make_none() -> None:
    """Estimates all over the band confirm nothing, and what is not seen again is dropped."""
    new = Newcomers(0, 0)
    assert follow(new, [(4.0 + 0.3 * k, -1) for k in range(6)]) == [None] * 6
    before = len(new)
    for epoch in range(6, 12):
        new.forget(epoch, set(), set())
    assert len(new) < before


def test_a_mode_seen_again_where_it_was_has_not_jumped() -> None:
    """The watched jump of a mode is forgotten once the mode is back."""
    new = Newcomers(0, 0)
    follow(new, [(4.8, 1)])
    new.forget(1, set(), {1})
    assert len(new) == 0
