"""Modes are founded by names, followed late where nothing presses, and have unique names."""

from __future__ import annotations

import numpy as np
import pytest

from lmshealth.tracking.association.estimates import Estimates, Table
from lmshealth.tracking.association.identities import Identities, Log


def logs(n: int) -> tuple[list[Log], Table]:
    """Make logs of two named modes that drift."""
    rng = np.random.default_rng(3)
    rows = [
        Estimates(
            names=("a", "b"),
            sources=("acc",) * 2,
            ln_frequency=np.array([4.6, 4.8]) - 1e-4 * k + 1e-3 * rng.standard_normal(2),
            ln_damping=np.full(2, -4.0),
            cov=np.diag([1e-6, 1e-6, 1e-2, 1e-2]),
            shapes=np.empty((2, 0)),
        )
        for k in range(n)
    ]
    every = [
        Log(k, float(k), float(max(k, 50)), np.zeros(0), False, ("a", "b"), ("acc",) * 2)
        for k in range(n)
    ]
    return every, Table(rows, np.zeros((n, 0)), np.zeros(0))


def expected(n: int, deferred: range) -> np.ndarray:  # type: ignore[type-arg]
    """Where the last log expects the modes, if some before are deferred."""
    every, table = logs(n)
    identities = Identities(np.zeros(0), 0)
    for log in every[:-1]:
        if log.epoch in deferred:
            identities.defer(log, table)
        else:
            identities.see(log, table)
    (verdict,) = identities.see(every[-1], table)
    assert verdict.modes == [0, 1]
    return verdict.expected


def test_deferred_logs_are_caught_up() -> None:
    """Some logs taken at their names leave the filters as if they had been seen."""
    np.testing.assert_allclose(expected(30, range(10, 25)), expected(30, range(0)), rtol=1e-12)


def test_old_deferred_logs_have_no_pull() -> None:
    """Of very many deferred logs the last ones suffice to a tenth of σ."""
    np.testing.assert_allclose(expected(400, range(5, 395)), expected(400, range(0)), atol=1e-4)


def test_a_settled_machine_is_said_to_be_one() -> None:
    """After some logs of two modes far from each other nothing else is followed."""
    every, table = logs(10)
    identities = Identities(np.zeros(0), 0)
    assert not identities.settled
    for log in every:
        identities.see(log, table)
    assert identities.settled
    assert identities.names == ["a", "b"]
    assert identities.first == pytest.approx([4.6, 4.8], abs=0.005)
