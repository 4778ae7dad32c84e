"""Histories, tracks and what judges a filter by its innovations."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta

import numpy as np
import pytest
from scipy import stats

from lmshealth.tracking.history import History, Series
from lmshealth.tracking.track import Event, consistency
from tests.lives import START, awkward_history, make_track
from tests.oracles import binomial_band


@pytest.fixture
def history() -> History:
    """Make two modes by two sources, with a second baseline at log 9."""
    return awkward_history(np.random.default_rng(1))


def test_the_present_baseline_is_the_last(history: History) -> None:
    """Of several baselines the last counts, and the clock is 0 there."""
    assert history.baseline == 9
    assert history.clock()[9] == 0
    np.testing.assert_allclose(np.diff(history.clock()), np.diff(history.travel))


def test_without_odometer_the_clock_is_time(history: History) -> None:
    """One odometer reading that is missing makes the time the clock, in seconds."""
    travel = history.travel.copy()
    assert history.has_odometer
    travel[3] = np.nan
    timed = replace(history, travel=travel)
    assert not timed.has_odometer
    week = timedelta(days=7).total_seconds()
    np.testing.assert_allclose(timed.clock(), week * (np.arange(16) - 9))
    assert timed.recorded_at[0] == START


def test_series_know_their_mode(history: History) -> None:
    """Columns of the estimates are found by mode."""
    assert history.mode_of().tolist() == [0, 1, 0, 1]
    assert history.columns("pitch") == [1, 3]
    assert history.columns("yaw") == []


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("travel", np.zeros(3), r"travel has shape \(3,\), needed \(16,\)"),
        ("loop_error", np.zeros((16, 1)), "loop_error has shape"),
        ("ln_damping", np.zeros((16, 2)), r"ln_damping has shape \(16, 2\), needed \(16, 4\)"),
        ("cov", np.zeros((16, 4, 4)), r"cov has shape .* needed \(16, 8, 8\)"),
        ("baselines", (), "baselines are logs"),
        ("baselines", (0, 16), r"baselines are logs \(0, 16\) of 16"),
        ("series", (Series("strange", "acc"),) * 4, "not among"),
    ],
)
def test_histories_that_contradict_themselves_are_refused(
    history: History, field: str, value: object, message: str
) -> None:
    """Wrong shapes, baselines that are no logs and series of unknown modes are named."""
    with pytest.raises(ValueError, match=message):
        replace(history, **{field: value})


@pytest.mark.parametrize("variance", [np.nan, 0.0, -1e-6])
def test_estimates_without_errors_are_refused(history: History, variance: float) -> None:
    """No std, none at all and a negative variance are named, with their log and series."""
    cov = np.array(history.cov)
    cov[5, 2, 2] = variance
    with pytest.raises(ValueError, match=r"005.csv: roll by delta_e has an estimate of variance"):
        replace(history, cov=cov)
    cov = np.array(history.cov)
    cov[5, 2, 3] = np.nan
    with pytest.raises(ValueError, match=r"005.csv: roll by delta_e .* without covariances"):
        replace(history, cov=cov)


def test_logs_out_of_order_are_refused(history: History) -> None:
    """A clock or an odometer that runs backwards is named; logs at one moment are not refused."""
    moments = list(history.recorded_at)
    moments[4], moments[5] = moments[5], moments[4]
    with pytest.raises(ValueError, match=r"recorded_at runs backwards at 005.csv"):
        replace(history, recorded_at=tuple(moments))
    travel = np.array(history.travel)
    travel[7] = travel[8] + 1
    with pytest.raises(ValueError, match=r"travel runs backwards at 008.csv"):
        replace(history, travel=travel)
    moments[5] = moments[4] = moments[3]
    assert replace(history, recorded_at=tuple(moments)).clock().size == 16


def test_arrays_are_read_only(history: History) -> None:
    """Nobody writes to a history, a step or a track."""
    followed = make_track(np.zeros((3, 2)), np.zeros((3, 2, 2)))
    for array in (history.cov, history.steps[0].there, followed.drift, followed.innovations):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


@pytest.mark.parametrize("field", ["drift", "drift_cov", "noise_scale", "nis", "widening"])
def test_tracks_of_wrong_shape_are_refused(field: str) -> None:
    """Every array of a track has as many epochs as there are logs."""
    followed = make_track(np.zeros((3, 2)), np.zeros((3, 2, 2)))
    with pytest.raises(ValueError, match=f"{field} has shape"):
        replace(followed, **{field: getattr(followed, field)[:2]})


def test_alarms_are_events_of_damage() -> None:
    """Of all events only those of kind alarm are alarms."""
    followed = make_track(np.zeros((3, 1)), np.zeros((3, 1, 1)))
    events = tuple(
        Event(kind, 1, "roll", "", 0.1, 0.01, 9.0, False, 2) for kind in ("step", "alarm")
    )
    assert replace(followed, events=events).alarms == events[1:]


def white(rng: np.random.Generator, n: int = 200, rows: int = 4) -> np.ndarray:
    """Draw innovations of a filter that is right, with a few missing."""
    innovations = rng.standard_normal((n, rows))
    innovations[rng.random((n, rows)) < 0.1] = np.nan
    return innovations


def judged(innovations: np.ndarray) -> tuple[float, float]:
    """Judge innovations that are independent of one another: both p values."""
    squares = np.nansum(innovations**2, axis=1)
    found = consistency(squares, np.isfinite(innovations).sum(axis=1).astype(float), innovations)
    least = [1e-3 if sign > 0 else 1e-6 for sign in (found.nis - 1, found.autocorrelation)]
    assert found.holds == (found.p_value >= least[0] and found.autocorrelation_p_value >= least[1])
    return found.p_value, found.autocorrelation_p_value


@pytest.mark.slow
def test_p_values_of_a_filter_that_is_right_are_uniform() -> None:
    """A tenth of them lies under a tenth, of the sum of squares and of the autocorrelation."""
    rng = np.random.default_rng(2)
    p = np.array([judged(white(rng)) for _ in range(1000)])
    for column in p.T:
        low, high = binomial_band(int((column < 0.1).sum()), column.size)
        assert low <= 0.1 <= high


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_innovations_of_wrong_size_are_not_consistent(factor: float) -> None:
    """Negative control: too large and too small ones are both found out."""
    p, correlated = judged(factor * white(np.random.default_rng(3)))
    assert p < 1e-3 < correlated


def test_innovations_that_go_on_are_not_consistent() -> None:
    """Negative control: what leans the same way from log to log is found out."""
    innovations = white(np.random.default_rng(4))
    innovations[1:] = (innovations[1:] + 0.5 * innovations[:-1]) / np.sqrt(1.25)
    assert judged(innovations)[1] < 1e-3


def test_consistency_is_what_it_says() -> None:
    """Mean of squares over their degrees of freedom, and the lag-one autocorrelation, by hand."""
    innovations = np.array([[1.0, -2.0], [2.0, np.nan], [-1.0, 3.0]])
    found = consistency(np.array([5.0, 4.0, 10.0]), np.array([0.0, 1.0, 2.0]), innovations)
    assert found.nis == pytest.approx(14 / 3)
    assert found.p_value == pytest.approx(2 * stats.chi2.sf(14, 3))
    # Two products exist, 2 and -2; the third series' neighbours are missing.
    assert found.autocorrelation == 0
    assert found.autocorrelation_p_value == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("mean_square", "holds", "side"),
    [(1.0, True, "inside"), (0.57, True, "below"), (0.4, False, "below"), (1.4, True, "above"),
     (1.7, False, "above")],
)  # fmt: skip
def test_unusual_innovations_are_told_before_they_are_wrong(
    mean_square: float, holds: bool, side: str
) -> None:
    """Beside the band of 95 % a filter may hold and leans; far outside it does not hold."""
    n = 100
    found = consistency(np.full(n, mean_square), np.ones(n), np.full((n, 1), np.nan))
    assert (found.holds, found.side) == (holds, side)


def test_nothing_to_judge_is_consistent() -> None:
    """A filter that has seen one log only is neither right nor wrong."""
    found = consistency(np.zeros(1), np.zeros(1), np.full((1, 2), np.nan))
    assert (found.nis, found.p_value, found.holds) == (1.0, 1.0, True)
