"""Estimates are checked at the door, and plain logs are those that nobody need look at twice."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lmshealth.errors import BadTable
from lmshealth.tracking.association.estimates import Estimates, Table


def say(ln_f: list[float], **changes: Any) -> Estimates:
    """Make a log of named modes."""
    n = len(ln_f)
    made = Estimates(
        names=tuple("abc"[:n]),
        sources=("acc",) * n,
        ln_frequency=np.array(ln_f),
        ln_damping=np.full(n, -4.0),
        cov=np.diag(np.repeat([1e-6, 1e-2], n)),
        shapes=np.empty((n, 0)),
    )
    return replace(made, **changes)


def plain(*epochs: Estimates, offsets: list[float] | None = None) -> list[bool]:
    """Screen logs."""
    moved = np.array(offsets or [0.0] * len(epochs))[:, None]
    return [bool(p) for p in Table(epochs, moved, np.array([1e-3])).plain]


def test_logs_like_the_one_before_are_plain() -> None:
    """The first never is; one that moves, comes near, or has other names is not."""
    still = say([4.6, 4.8])
    assert plain(still, still, still) == [False, True, True]
    assert plain(still, say([4.6, 4.82]), say([4.6, 4.82])) == [False, False, True]
    near = say([4.6, 4.63])
    assert plain(near, near) == [False, False]
    assert plain(still, replace(still, names=("a", ""))) == [False, False]
    assert plain(*[replace(still, names=("", ""))] * 2) == [False, False]
    assert plain(still, replace(still, ln_damping=np.array([-4.0, -3.0]))) == [False, False]


def test_covariates_widen_what_is_plain() -> None:
    """Twenty kelvin may move a mode by 2 %."""
    pair = say([4.6, 4.9]), say([4.6, 4.92])
    assert plain(*pair) == [False, False]
    assert plain(*pair, offsets=[0.0, 20.0]) == [False, True]


def test_shapes_that_change_are_not_plain() -> None:
    """A shape at right angles to the one before needs a second look."""
    one = say([4.6, 4.8], shapes=np.eye(2))
    other = say([4.6, 4.8], shapes=np.eye(2)[::-1].copy())
    assert plain(one, one, other) == [False, True, False]


def test_shapes_are_made_of_unit_length() -> None:
    """Lengths of shapes do not count; one of nothing is unknown."""
    table = Table(
        [say([4.6, 4.8], shapes=np.array([[3.0, 4.0], [0.0, 0.0]]))], np.zeros((1, 0)), np.zeros(0)
    )
    shapes = table.readings(0).shapes
    np.testing.assert_allclose(shapes[0], [0.6, 0.8])
    assert np.isnan(shapes[1]).all()


@pytest.mark.parametrize(
    "changes",
    [
        {"cov": np.diag([1e-6, 0.0, 1e-2, 1e-2])},
        {"cov": np.diag([1e-6, -1e-6, 1e-2, 1e-2])},
        {"cov": np.diag([1e-6, np.nan, 1e-2, 1e-2])},
        {"cov": np.diag([1e-6, 1e-6, 1e-2, np.nan])},
        {"ln_frequency": np.array([4.6, np.nan])},
    ],
)
def test_estimates_without_a_value_or_std_are_refused(changes: dict[str, Any]) -> None:
    """The error names the log, the estimate and its mode."""
    with pytest.raises(BadTable, match=r"epoch 1, estimate 1 \(b\).*positive variances"):
        Table([say([4.6, 4.8]), say([4.6, 4.8], **changes)], np.zeros((2, 0)), np.zeros(0))


@pytest.mark.parametrize("name", ["sources", "ln_damping", "cov", "shapes"])
def test_fields_that_do_not_fit_are_refused(name: str) -> None:
    """The error names the field."""
    changes = {
        "sources": ("acc",),
        "ln_damping": np.zeros(3),
        "cov": np.eye(2),
        "shapes": np.eye(3),
    }
    with pytest.raises(ValueError, match=name):
        say([4.6, 4.8], **{name: changes[name]})
