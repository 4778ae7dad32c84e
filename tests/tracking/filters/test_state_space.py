"""Layout of the state, measurement matrices and prior."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lmshealth.stage.description import Stage
from lmshealth.tracking.constants import COVARIATE_STD, LN_F_STD, LN_ZETA_STD
from lmshealth.tracking.filters.state_space import StateSpace
from lmshealth.tracking.history import History
from tests.lives import (
    PRELOAD,
    TWO,
    awkward_history,
    cut,
    make_history,
    make_stage,
    rough_history,
    since,
)

THREE = (
    TWO
    + """
[[covariate]]
name = "humidity"
reference = 0.5
prior_std = 0.01

[usage]
horizon_km = 10000
"""
)


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Three covariates, of which histories have two, and a horizon of 10,000 km."""
    return make_stage(tmp_path_factory.mktemp("stage"), (PRELOAD,), tail=THREE)


@pytest.fixture
def history() -> History:
    """Make two modes by two sources with steps of every kind."""
    return awkward_history(np.random.default_rng(1))


def test_the_state_is_laid_out_without_gaps(history: History, stage: Stage) -> None:
    """Blocks of two modes follow one another: 5, three regressors, two biased series, steps."""
    space = StateSpace(history, stage, history.steps)
    places = [space.level, space.rate, space.damping, space.base, space.wander]
    places += [space.regressor(j) for j in range(3)]
    assert [one.name for one in space.regressed] == [
        "temperature_c",
        "temperature_c^2",
        "payload_kg",
    ]
    places.append(slice(space.first_bias, space.first_step))
    places += [space.jump(j) for j in range(5)]
    ends = [0, *(place.stop for place in places)]
    assert [place.start for place in places] == ends[:-1]
    assert ends[-1] == space.size == 16 + 2 * 2 + 5 * 4


def test_ticks_are_in_mean_distances_of_the_logs_so_far(history: History, stage: Stage) -> None:
    """A tick of 1/150 is the mean distance between logs so far; a log without estimates has none.

    No tick depends on the horizon of the stage or on a later log.
    """
    empty = np.asarray(~np.isfinite(history.ln_frequency).any(axis=1))
    empty[0] = False
    assert empty.any()
    there = np.flatnonzero(~empty)
    travel = history.travel[there] - history.travel[0]
    expected = np.zeros(len(empty))
    expected[there[1:]] = np.diff(travel) * np.arange(1, there.size) / travel[1:] / 150
    for given in (stage, None):
        np.testing.assert_allclose(StateSpace(history, given).ticks, expected)
    np.testing.assert_allclose(StateSpace(cut(history, 9), stage).ticks, expected[:9])


def test_without_odometer_ticks_are_of_time(history: History, stage: Stage) -> None:
    """The clock is the time of recording where there is no odometer: here a log a day."""
    timed = replace(history, travel=np.full(len(history.logs), np.nan))
    ticks = StateSpace(timed, stage).ticks
    seen = np.asarray(np.isfinite(history.ln_frequency).any(axis=1))
    assert (ticks[~seen] == 0).all()
    steady = seen & np.r_[False, seen[:-1]] & (np.cumsum(~seen) == 0)
    assert steady.sum() > 1
    np.testing.assert_allclose(ticks[steady], 1 / 150)


def test_a_history_without_length_has_ticks_of_nothing(stage: Stage) -> None:
    """Logs at one place have ticks of 0."""
    history = make_history(np.full((4, 2), 4.8), travel=np.full(4, 1e5))
    assert (StateSpace(history, None).ticks == 0).all()


def test_covariates_are_about_their_reference_and_their_mean_where_unknown(
    history: History, stage: Stage
) -> None:
    """Offsets and their squares are in the measurement matrix of ln f only."""
    space = StateSpace(history, stage)
    offset = history.covariates["temperature_c"] - 21
    means = np.mean(offset[:3]), np.mean(offset[:3] ** 2)
    for k, (value, square) in {0: (offset[0], offset[0] ** 2), 3: means}.items():
        matrix = space.matrix(k)
        for i, mode in enumerate([0, 1, 0, 1]):
            assert matrix[i, space.regressor(0).start + mode] == pytest.approx(value)
            assert matrix[i, space.regressor(1).start + mode] == pytest.approx(square)
            assert matrix[i, space.regressor(0).start + 1 - mode] == 0
        assert (matrix[4:, space.regressor(0).start : space.first_bias] == 0).all()


def test_unknown_covariates_widen_ln_f(history: History, stage: Stage) -> None:
    """An unknown value adds the variance of earlier values, and only in its log."""
    observations = StateSpace(history, stage).observations
    unknown = np.array([0.0 if one.extra is None else one.extra[0, 0] for one in observations])
    temperature, payload = history.covariates["temperature_c"], history.covariates["payload_kg"]
    spread = 0.001 * np.std(temperature[:3]), 0.0005 * np.std(payload[:3])
    assert unknown[3] == pytest.approx(spread[0] ** 2 + spread[1] ** 2)
    assert unknown[8] == pytest.approx((0.0005 * np.nanstd(payload[:8])) ** 2)
    assert (np.delete(unknown, [3, 8]) == 0).all()
    # Before its first value nothing is known of a covariate.
    late = {"temperature_c": np.where(np.arange(temperature.size) < 2, np.nan, temperature)}
    space = StateSpace(replace(history, covariates=late), stage)
    first, rows = space.observations[0].extra, space.observations[0].rows
    assert first is not None
    # All series of a mode have it in common, and ln ζ has none.
    modes = np.where(rows < 4, space.mode_of[rows], -1 - rows)
    alike = np.equal.outer(modes, modes) & (rows < 4)
    np.testing.assert_allclose(first, 0.03**2 * alike)


def test_without_a_stage_covariates_are_about_their_median(history: History) -> None:
    """Every covariate present is a regressor, with a common prior and without curvature."""
    space = StateSpace(history, None)
    assert [one.name for one in space.regressed] == ["temperature_c", "payload_kg"]
    for one in space.regressed:
        values = history.covariates[one.name]
        known = np.isfinite(values)
        np.testing.assert_allclose(one.values[known], values[known] - np.nanmedian(values))
        assert one.prior_std == COVARIATE_STD


def test_a_covariate_that_is_never_known_is_left_out(history: History) -> None:
    """A covariate that no log knows has no coefficient."""
    empty = {"temperature_c": np.full(len(history.logs), np.nan)}
    for covariates in ({}, empty):
        assert StateSpace(replace(history, covariates=covariates), None).regressed == ()


def test_the_series_seen_first_of_a_mode_has_no_bias(history: History, stage: Stage) -> None:
    """The series detected first is the reference; of two in one log, the first in order."""
    # The first log has both estimates of one mode, and of the other that by Δe alone.
    assert np.isfinite(history.ln_frequency[0]).tolist() == [True, False, True, True]
    space = StateSpace(history, stage)
    assert space.biased == [2, 1]
    matrix = space.matrix(0)[:, space.first_bias : space.first_step]
    expected = np.zeros((8, 4))
    expected[2, 0] = expected[6, 1] = expected[1, 2] = expected[5, 3] = 1
    np.testing.assert_array_equal(matrix, expected)


def test_steps_are_read_where_they_are_there(history: History, stage: Stage) -> None:
    """A retuning is measured in all series until it is undone, a sensor's step in its source.

    A step that changes the modes is part of their levels.
    """
    space = StateSpace(history, stage, history.steps)
    for k in range(len(history.logs)):
        matrix = space.matrix(k)
        for j, step in enumerate(history.steps):
            expected: np.ndarray = np.zeros((8, 4))
            if step.kind == "servo" and step.there[k]:
                expected = np.kron(np.eye(2), np.tile(np.eye(2), (2, 1)))
            if step.kind == "sensor" and step.there[k]:
                expected[[2, 3, 6, 7], [0, 1, 2, 3]] = 1
            np.testing.assert_array_equal(matrix[:, space.jump(j)], expected)


def test_one_more_step_only_makes_the_state_longer(history: History, stage: Stage) -> None:
    """Appending a step gives the state space that is built with all steps."""
    short = StateSpace(history, stage, history.steps[:-1])
    longer, whole = short.with_step(history.steps[-1]), StateSpace(history, stage, history.steps)
    assert longer.size == whole.size == short.size + 4
    assert longer.steps == history.steps
    for k in (0, 4, 14):
        np.testing.assert_array_equal(longer.matrix(k), whole.matrix(k))
        np.testing.assert_array_equal(longer.matrix(k)[:, : short.size], short.matrix(k))


def test_the_prior_is_about_the_first_estimates(stage: Stage) -> None:
    """The mean of each mode is its first estimate by any source; rates and steps are 0."""
    history = rough_history(np.random.default_rng(2))
    ln_f = history.ln_frequency.copy()
    ln_f[0, 1] = np.nan
    history = replace(history, ln_frequency=ln_f, steps=(since("step", 3, 10),))
    space = StateSpace(history, stage, history.steps)
    mean, cov = space.prior()
    assert mean[space.level].tolist() == [ln_f[0, 0], ln_f[1, 1]]
    assert mean[space.damping].tolist() == history.ln_damping[0].tolist()
    std = np.sqrt(np.diag(cov))
    np.testing.assert_allclose(std[space.level], LN_F_STD)
    np.testing.assert_allclose(std[space.damping], LN_ZETA_STD)
    for nothing in (space.rate, space.base, space.jump(0)):
        assert (std[nothing] == 0).all()


def test_the_drift_is_the_level_less_its_copy(history: History, stage: Stage) -> None:
    """The contrast is ℓ - ℓ₀ of each mode."""
    space = StateSpace(history, stage)
    state = np.arange(8.0)
    np.testing.assert_array_equal(space.drift @ state, state[space.level] - state[space.base])
