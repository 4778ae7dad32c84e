"""The track is a fold: a pure step from one state to the next."""

from __future__ import annotations

from dataclasses import replace
from functools import reduce
from itertools import accumulate

import numpy as np

from lmshealth.tracking.filters.state_space import StateSpace
from lmshealth.tracking.filters.track_state import (
    Published,
    TrackState,
    initial_state,
    step,
    widening,
)
from lmshealth.tracking.history import History
from lmshealth.tracking.track import track
from tests.lives import since
from tests.tracking.filters.test_change_detection import HAPPENINGS, N_LOGS, life


def stepping() -> History:
    """Make a life of two sources with a step that nobody declared, and work on the machine."""
    history = life(3, **HAPPENINGS["step"])
    steps = (since("reset", 8, N_LOGS),)
    return replace(history, baselines=(0, 8), steps=steps)


def states_of(history: History) -> list[TrackState]:
    """Return the states before the first log and after every log."""
    space = StateSpace(history, None, history.steps)
    logs = range(len(history.logs))
    return list(accumulate(logs, step, initial=initial_state(space)))


def values_of(row: Published) -> list[np.ndarray]:
    """Return copies of what is published of a log."""
    return [np.array(getattr(row, name)) for name in Published.__slots__]


def test_the_step_is_pure() -> None:
    """A step changes neither its state nor what was published, and gives the same state again."""
    history = stepping()
    states = states_of(history)
    assert any(state.changes or state.alarms for state in states)
    first = [values_of(state.rows[-1]) for state in states if state.rows]
    for k in range(len(history.logs)):
        again = step(states[k], k)
        for own, expected in zip(values_of(again.rows[-1]), first[k], strict=True):
            np.testing.assert_array_equal(own, expected)
        assert (again.start, again.first, again.credit) == (
            states[k + 1].start,
            states[k + 1].first,
            states[k + 1].credit,
        )
    rows = states[-1].rows
    for row, expected_row in zip(rows, first, strict=True):
        for own, expected in zip(values_of(row), expected_row, strict=True):
            np.testing.assert_array_equal(own, expected)


def test_a_fold_may_stop_and_go_on() -> None:
    """From the state after any log the rest of the logs gives the track of all."""
    history = stepping()
    states, whole = states_of(history), track(history)
    for k in (1, 9, 23, 30):
        state = reduce(step, range(k, len(history.logs)), states[k])
        level = np.array([row.mean[:2] for row in state.rows])
        np.testing.assert_array_equal(level, whole.ln_frequency)
        np.testing.assert_array_equal(widening(state), whole.widening)
        found = [(one.kind, one.first) for one in state.space.steps]
        assert found == [(one.kind, one.first) for one in whole.steps]
        assert len(found) > 1


def test_every_log_has_an_epoch_once() -> None:
    """After n logs there are n epochs and rows, however many were filtered again."""
    for n, state in enumerate(states_of(stepping())):
        assert len(state.epochs()) == len(state.rows) == n
        assert [one.index for one in state.checkpoints] == list(range(n))
