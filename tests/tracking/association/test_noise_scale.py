"""Stated errors are scaled by the scatter of successive estimates, by the logs so far only."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pytest
from numpy.typing import NDArray

from lmshealth.tracking import constants
from lmshealth.tracking.association import associate as module
from lmshealth.tracking.association.associate import (
    Association,
    Estimates,
    Scales,
    associate,
    learn_scales,
    scaled,
)
from lmshealth.tracking.association.mode_filters import Measurements

MODES = np.log([1.5, 1.515, 5.0])
SCATTER = 1e-3
N = 24


def draw(stated: float, n: int = N) -> NDArray[np.float64]:
    """Draw ln f of logs of three modes, two of them ten standard deviations apart."""
    rng = np.random.default_rng([20261125, round(100 * stated)])
    return np.asarray(MODES + SCATTER * rng.standard_normal((n, MODES.size)))


def learned(stated: float, offsets: NDArray[np.float64] | None = None, n: int = N) -> list[Scales]:
    """Learn the scales of estimates whose errors are stated so many times too wide."""
    var = np.full(MODES.size, (stated * SCATTER) ** 2)
    none = (np.zeros(MODES.size), np.full(MODES.size, np.inf), np.empty((MODES.size, 0)))
    logs = [Measurements(row, var, *none) for row in draw(stated, n)]
    moving = np.zeros((n, 0)) if offsets is None else offsets
    return learn_scales(logs, [("acc",) * 3] * n, moving, np.full(moving.shape[1], 1e-3))


@pytest.mark.parametrize("stated", [0.25, 4.0, 15.0])
def test_scale_is_that_of_the_scatter(stated: float) -> None:
    """Errors that are stated 4 times too narrow to 15 times too wide are known after 24 logs.

    A scale is kept until another one by 1.4 is the most probable, here with an error of 8 %.
    """
    scales = learned(stated)
    assert scales[0] == {}
    off = np.log(scales[-1]["acc"][0] * stated)
    assert abs(off) < np.log(constants.LEAST_RESCALING) + 3 * 0.08
    assert scales[-1]["acc"][1] == 1.0


def test_errors_as_stated_are_left() -> None:
    """Where errors are right they stay exactly as stated, and so they do without a second log."""
    assert all(held == {} for held in learned(1.0))
    assert learned(4.0, n=1) == [{}]


def test_scales_use_no_later_logs() -> None:
    """Scales of the first logs are those of these logs alone."""
    for some, all_logs in zip(learned(15.0, n=9), learned(15.0)[:9], strict=True):
        assert {**some}.keys() == {**all_logs}.keys()
        assert all(np.array_equal(some[key], all_logs[key]) for key in some)


def test_covariates_explain_differences() -> None:
    """What a covariate may have moved between two logs is no scatter."""
    rng = np.random.default_rng(7)
    assert learned(0.25, 100 * rng.standard_normal((N, 1)))[-1] == {}


def test_variances_are_scaled_by_source() -> None:
    """Each source has its own scale; one without a scale is as stated."""
    new = Measurements(MODES, np.ones(3), MODES, np.ones(3), np.empty((3, 0)))
    own = scaled(new, ("acc", "frf", "acc"), {"acc": np.array([0.5, 2.0])})
    assert own.var_f.tolist() == [0.25, 1.0, 0.25]
    assert own.var_zeta.tolist() == [4.0, 1.0, 4.0]
    assert scaled(new, ("acc",) * 3, {}) is new


def labels_of(stated: float, n: int = N) -> Association:
    """Associate the same estimates, which have no names and no damping."""
    var = np.full(6, (stated * SCATTER) ** 2)
    var[3:] = np.nan
    cov = np.diag(var)
    unknown, shapes = np.full(3, np.nan), np.empty((3, 0))
    epochs = [Estimates(("",) * 3, ("acc",) * 3, row, unknown, cov, shapes) for row in draw(stated)]
    clock = np.arange(float(n))
    return associate(epochs[:n], clock, offsets=np.zeros((n, 0)), prior_std=np.zeros(0))


@pytest.mark.parametrize("stated", [0.25, 15.0])
def test_close_modes_are_kept_apart_whatever_is_stated(stated: float) -> None:
    """From the tenth log on each of three modes has its own label; as stated they have not."""
    found = labels_of(stated)
    assert len(found.modes) == 3
    assert set(found.assigned[10:]) == {found.assigned[-1]}
    assert set(found.assigned[-1]) == set(found.modes)
    with patch.object(module, "learn_scales", lambda logs, *_: [{}] * len(logs)):
        other = labels_of(stated)
    kept = len(other.modes) == 3 and set(other.assigned[-1]) == set(other.modes)
    assert not kept or set(other.assigned[10:]) != {other.assigned[-1]}


def test_labels_stay_where_scales_change() -> None:
    """Labels of the first logs are those of these logs alone, though later ones rescale them."""
    assert labels_of(15.0, 6).labels == labels_of(15.0).labels[:6]
