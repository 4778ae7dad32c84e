"""Histories: readings put in order, modes lined up, odometers that run backwards."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lmshealth.errors import NotEnoughData
from lmshealth.history import build_history, in_order
from lmshealth.stage import Stage
from tests.lives import FADING, make_reading, make_stage


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    """Two tracked modes, roll and pitch."""
    return make_stage(tmp_path, (FADING,))


def test_readings_are_sorted_by_moment_then_name(stage: Stage) -> None:
    """The order given does not matter; equal moments are told apart by name."""
    late = make_reading("a", 5, 3e5, {"roll": 4.8})
    early = make_reading("z", 1, 1e5, {"roll": 4.9})
    twin = make_reading("b", 1, 1e5, {"roll": 4.9})
    assert [r.log for r in in_order([late, early, twin])] == ["b", "z", "a"]
    history, refused = build_history([late, early, twin], stage)
    assert history.logs == ("b", "z", "a")
    assert list(history.recorded_at) == sorted(history.recorded_at)
    assert refused == []


def test_modes_are_lined_up_with_their_covariances(stage: Stage) -> None:
    """Whatever the order within a log, each mode has its column, rows and cross terms."""
    readings = [
        make_reading("0", 0, 0.0, {"pitch": 4.9, "roll": 4.8}),
        make_reading("1", 1, 1e5, {"roll": 4.7}),
    ]
    history, _ = build_history(readings, stage)
    assert history.modes == ("roll", "pitch")
    np.testing.assert_array_equal(history.ln_frequency, [[4.8, 4.9], [4.7, np.nan]])
    own = readings[0].modes.cov
    order = [1, 0, 3, 2]  # roll before pitch, for frequency and for damping
    np.testing.assert_array_equal(history.cov[0], own[np.ix_(order, order)])
    alone = readings[1].modes.cov
    np.testing.assert_array_equal(history.cov[1][np.ix_([0, 2], [0, 2])], alone)
    assert np.isnan(history.cov[1][1]).all()
    assert np.isnan(history.cov[1][:, 3]).all()


def test_modes_that_are_not_tracked_or_never_found_are_left_out(stage: Stage) -> None:
    """Only tracked modes that some log found make a column; empty logs stay as epochs."""
    readings = [
        make_reading("0", 0, 0.0, {"pitch": 4.9, "shaker": 3.0}),
        make_reading("1", 1, 1e5, {"shaker": 3.0}),
    ]
    history, _ = build_history(readings, stage)
    assert history.modes == ("pitch",)
    assert np.isnan(history.ln_frequency[1]).all()


def test_an_odometer_that_runs_backwards_stands_still(stage: Stage) -> None:
    """The log stays at the highest reading so far, and a refusal names it with both numbers."""
    travels = [1e5, 3e5, 2e5, 4e5]
    readings = [make_reading(str(k), k, s, {"roll": 4.8}) for k, s in enumerate(travels)]
    history, refused = build_history(readings, stage)
    np.testing.assert_array_equal(history.travel, [1e5, 3e5, 3e5, 4e5])
    assert [(r.log, r.reason) for r in refused] == [("2", "odometer-backwards")]
    assert "200 after 300" in refused[0].detail


def test_the_first_declared_baseline_counts(stage: Stage) -> None:
    """The first log declared a baseline is it; without a declaration the first log is."""
    flags = [None, False, True, True]
    readings = [
        make_reading(str(k), k, 1e5 * k, {"roll": 4.8}, baseline=flag)
        for k, flag in enumerate(flags)
    ]
    history, _ = build_history(readings, stage)
    assert history.baseline == 2
    np.testing.assert_allclose(history.clock(), [-2e5, -1e5, 0, 1e5])
    assert build_history(readings[:2], stage)[0].baseline == 0


def test_covariates_are_nan_where_a_log_has_none(stage: Stage) -> None:
    """Covariates of any log make a column, NaN in logs without."""
    readings = [
        make_reading("0", 0, 0.0, {"roll": 4.8}, covariates={"temperature_c": 20.0}),
        make_reading("1", 1, 1e5, {"roll": 4.8}, covariates={"payload_kg": 3.0}),
    ]
    history, _ = build_history(readings, stage)
    np.testing.assert_array_equal(history.covariates["temperature_c"], [20.0, np.nan])
    np.testing.assert_array_equal(history.covariates["payload_kg"], [np.nan, 3.0])


def test_no_reading_is_refused(stage: Stage) -> None:
    """A history of nothing names the stage."""
    with pytest.raises(NotEnoughData, match="small: no usable log"):
        build_history([], stage)
