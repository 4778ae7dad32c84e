"""Parts: what a log's set point says it does, and how fast it was set to move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lmshealth.errors import BadLog
from lmshealth.logs import Log, Metadata
from lmshealth.parts import Part, select_segments, set_velocity
from tests.signals import make_log

RATE = 1000.0


def strokes(*speeds: float) -> np.ndarray:
    """Make a set velocity: rest, then ramp, constant, ramp and one second of rest per speed."""
    parts = [np.zeros(200)]
    for speed in speeds:
        ramp = np.linspace(0, speed, 50)
        parts += [ramp, np.full(2000, speed), ramp[::-1], np.zeros(1000)]
    return np.concatenate(parts)


def log_of(set_point: np.ndarray | None, told: float | None = None) -> Log:
    """Make a log with one accelerometer; its metadata may tell a velocity."""
    size = 4000 if set_point is None else set_point.size
    return make_log(
        {"acc_a": np.zeros(size)}, RATE, velocity=set_point, metadata=Metadata(velocity=told)
    )


def test_a_stroke_has_all_its_parts() -> None:
    """Constant, settling and idle have their lengths to a few ms; the record is everything."""
    log = log_of(strokes(0.1))
    (constant,) = select_segments(log, "constant")
    assert constant.stop - constant.start == pytest.approx(2000, abs=45)
    assert constant.velocity == pytest.approx(0.1)
    (settling,) = select_segments(log, "settling")
    assert settling.stop - settling.start == pytest.approx(500, abs=2)
    before, after = select_segments(log, "idle")
    assert before.start == 0
    assert after.start == settling.stop
    (record,) = select_segments(log, "record")
    assert (record.start, record.stop) == (0, log.channels[0].values.size)


def test_without_a_set_point_there_is_the_whole_record_only() -> None:
    """Record and constant velocity are everything; settling needs the set point and says so."""
    log = log_of(None)
    parts: tuple[Part, ...] = ("constant", "record")
    for part in parts:
        assert [(s.start, s.stop) for s in select_segments(log, part)] == [(0, 4000)]
    with pytest.raises(BadLog, match="reference_velocity_mm_s") as caught:
        select_segments(log, "settling")
    assert caught.value.reason == "no-set-point"


def test_a_part_that_is_not_there_is_an_error_with_those_that_are() -> None:
    """A log that never moves has nothing to settle from."""
    with pytest.raises(BadLog, match="there: idle") as caught:
        select_segments(log_of(np.zeros(4000)), "settling")
    assert caught.value.reason == "no-such-part"


def test_gaps_split_every_part() -> None:
    """No stretch of any kind reaches across a gap."""
    log = replace(log_of(strokes(0.1)), pieces=((0, 1000), (1010, 3300)))
    assert [(s.start, s.stop) for s in select_segments(log, "record")] == [(0, 1000), (1010, 3300)]
    first, second = select_segments(log, "constant")
    assert first.stop <= 1000
    assert second.start >= 1010


def test_the_set_velocity_is_a_speed() -> None:
    """There and back are one velocity; the set point has the last word over metadata."""
    assert set_velocity(log_of(strokes(0.1, -0.1), 0.3)) == pytest.approx(0.1)
    assert set_velocity(log_of(None, -0.3)) == pytest.approx(0.3)


def test_a_log_of_several_velocities_has_none() -> None:
    """Two speeds, no move at all, or nothing known: not a number."""
    for log in (log_of(strokes(0.1, 0.2)), log_of(np.zeros(4000)), log_of(None)):
        assert np.isnan(set_velocity(log))
