"""Segments: motion phases by the set point, selection by phase, speed of a log."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from lmshealth.errors import BadLog
from lmshealth.io import buffers as samples
from lmshealth.io.log import Log, Metadata
from lmshealth.signal import segments
from lmshealth.signal.segments import (
    Part,
    Segment,
    find_phases,
    find_segments,
    nominal_velocity,
    select_segments,
    with_few_lengths,
)
from tests.signals import make_log

RATE = 1000.0


def strokes(*speeds: float) -> np.ndarray:
    """Make a set velocity: rest, then ramp, constant, ramp and one second of rest per speed."""
    parts = [np.zeros(200)]
    for speed in speeds:
        ramp = np.linspace(0, speed, 50)
        parts += [ramp, np.full(2000, speed), ramp[::-1], np.zeros(1000)]
    return np.concatenate(parts)


def log_of(set_point: np.ndarray | None, stated: float | None = None) -> Log:
    """Make a log with one accelerometer; its metadata may state a velocity."""
    size = 4000 if set_point is None else set_point.size
    return make_log(
        {"acc_a": np.zeros(size)}, RATE, velocity=set_point, metadata=Metadata(velocity=stated)
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


@pytest.mark.parametrize("seconds", [0.5, 1.5, 5.0])
def test_a_slow_ramp_is_no_constant_velocity(seconds: float) -> None:
    """The speed of a log is that of its plateau, however slowly it is reached."""
    ramp = np.linspace(0, 0.1, round(seconds * RATE))
    log = log_of(np.concatenate([np.zeros(500), ramp, np.full(5000, 0.1), ramp[::-1]]))
    (constant,) = select_segments(log, "constant")
    assert constant.start == pytest.approx(500 + ramp.size, abs=0.02 * ramp.size + 20)
    assert constant.stop - constant.start == pytest.approx(5000, abs=0.04 * ramp.size + 40)
    assert nominal_velocity(log) == pytest.approx(0.1, rel=2e-3)


@pytest.mark.parametrize("seconds", [0.08, 0.15, 0.25])
def test_a_short_plateau_is_of_constant_velocity(seconds: float) -> None:
    """Between two ramps the velocity is lower before and after: that is no ramp."""
    ramp, top = np.linspace(0, 0.2, 100), np.full(round(seconds * 2000), 0.2)
    strokes = np.tile(np.concatenate([ramp, top, ramp[::-1], np.zeros(400)]), 10)
    log = make_log({"acc_a": np.zeros(strokes.size)}, 2000.0, velocity=strokes)
    found = select_segments(log, "constant")
    assert len(found) == 10
    assert all(s.stop - s.start == pytest.approx(top.size, abs=50) for s in found)
    assert nominal_velocity(log) == pytest.approx(0.2)


def test_a_set_point_that_trembles_is_at_rest() -> None:
    """A position within 1 µm is no move, whatever its velocities are; a move of 10 µm is one."""
    rng = np.random.default_rng(4)
    trembling = np.gradient(1e-9 * rng.standard_normal(20_000), 1 / RATE)
    (idle,) = find_phases(log_of(trembling))
    assert (idle.start, idle.stop, idle.kind, idle.velocity) == (0, 20_000, "idle", 0.0)
    creeping = trembling + np.where(np.arange(20_000) < 10_000, 1e-6, 0.0)
    assert "ramp" in {phase.kind for phase in find_phases(log_of(creeping))}


def test_without_a_set_point_there_is_the_whole_record_only() -> None:
    """Record and constant velocity are everything; settling needs the set point."""
    log = log_of(None)
    parts: tuple[Part, ...] = ("constant", "record")
    for part in parts:
        assert [(s.start, s.stop) for s in select_segments(log, part)] == [(0, 4000)]
    with pytest.raises(BadLog, match="reference_velocity_mm_s") as caught:
        select_segments(log, "settling")
    assert caught.value.reason == "no-set-point"


def test_a_part_that_is_not_there_is_an_error_with_those_that_are() -> None:
    """A log that never moves has nothing to settle from."""
    with pytest.raises(BadLog, match="there are: idle") as caught:
        select_segments(log_of(np.zeros(4000)), "settling")
    assert caught.value.reason == "no-such-part"


def test_gaps_split_every_part() -> None:
    """No segment of any kind reaches across a gap."""
    log = replace(log_of(strokes(0.1)), pieces=((0, 1000), (1010, 3300)))
    assert [(s.start, s.stop) for s in select_segments(log, "record")] == [(0, 1000), (1010, 3300)]
    first, second = select_segments(log, "constant")
    assert first.stop <= 1000
    assert second.start >= 1010


def test_the_set_velocity_is_a_speed() -> None:
    """There and back are one velocity; the set point has the last word over metadata."""
    assert nominal_velocity(log_of(strokes(0.1, -0.1), 0.3)) == pytest.approx(0.1)
    assert nominal_velocity(log_of(None, -0.3)) == pytest.approx(0.3)


def test_a_log_of_several_velocities_has_none() -> None:
    """Two speeds, no move at all, or nothing known: not a number."""
    for log in (log_of(strokes(0.1, 0.2)), log_of(np.zeros(4000)), log_of(None)):
        assert np.isnan(nominal_velocity(log))


def moves(rate: float = 20_000.0) -> tuple[np.ndarray, list[tuple[int, int, float]]]:
    """Velocity set point of a move there and back with rests, and its constant segments."""
    ramp = np.arange(0, 0.08, 1 / rate) * 5.0  # 5 m/s² up to 0.4 m/s
    top, rest = np.full(13_000, 0.4), np.zeros(4000)
    there = np.concatenate([ramp, top, ramp[::-1]])
    velocity = np.concatenate([rest, there, rest, -there, rest])
    first = rest.size + ramp.size
    second = first + top.size + ramp.size + rest.size + ramp.size
    return velocity, [(first, first + top.size, 0.4), (second, second + top.size, -0.4)]


def test_moves_are_cut_to_their_constant_velocity() -> None:
    """Ramps and rests are left out, at most 2 ms of a segment are lost, the velocity is exact."""
    velocity, truth = moves()
    log = make_log({"acc_a": np.zeros(velocity.size)}, 20_000.0, velocity=velocity)
    segments = find_segments(log, 0.1)
    assert len(segments) == len(truth)
    for segment, (start, stop, speed) in zip(segments, truth, strict=True):
        assert segment.velocity == pytest.approx(speed, rel=1e-9)
        assert start <= segment.start + 1
        assert segment.stop <= stop + 1
        assert (stop - start) - (segment.stop - segment.start) <= 42


def test_a_slow_ramp_is_a_ramp_at_every_rate() -> None:
    """Ramps of 0.45 s, 0.2 % of the velocity per ms, are not constant at 51.2 kHz either."""
    for rate in (20_000.0, 51_200.0):
        time = np.arange(0, 2, 1 / rate)
        velocity = 0.1 * np.clip(np.minimum(time, 2 - time) / 0.45, 0, 1)
        log = make_log({"acc_a": np.zeros(time.size)}, rate, velocity=velocity)
        (constant,) = select_segments(log, "constant")
        assert (constant.stop - constant.start) / rate == pytest.approx(1.1, abs=3e-3)


def test_phases_are_all_of_a_move_and_named() -> None:
    """Rest, ramp, constant velocity and settling follow each other without a hole."""
    velocity, _ = moves()
    log = make_log({"acc_a": np.zeros(velocity.size)}, 20_000.0, velocity=velocity)
    phases = find_phases(log)
    assert phases[0].start == 0
    assert phases[-1].stop == velocity.size
    assert all(a.stop == b.start for a, b in pairwise(phases))
    long = [p.kind for p in phases if p.stop - p.start > 20]
    move = ["ramp", "constant", "ramp", "settling"]
    assert long == ["idle", *move, *move]


def test_rest_becomes_idle_half_a_second_after_a_move() -> None:
    """Settling ends after half a second, wherever the rest ends."""
    velocity = np.concatenate([np.full(2000, 0.1), np.zeros(3000)])
    phases = find_phases(make_log({"acc_a": np.zeros(5000)}, 2000.0, velocity=velocity))
    settling, idle = phases[-2:]
    assert (settling.kind, idle.kind) == ("settling", "idle")
    assert settling.stop - settling.start == pytest.approx(0.5 * 2000.0, abs=1)
    assert idle.stop == 5000


def test_rest_beside_moves_is_not_stationary() -> None:
    """In a log that moves, a gap-free piece at rest is no segment; moves there are."""
    velocity = np.concatenate([np.full(2000, 0.1), np.zeros(2000)])
    log = make_log(
        {"acc_a": np.zeros(4000)}, 2000.0, velocity=velocity, pieces=((0, 1900), (2100, 4000))
    )
    assert [s.kind for s in find_segments(log, 0.1)] == ["constant"]


def test_short_segments_are_left_out() -> None:
    """A segment below the shortest useful one is no segment."""
    velocity, _ = moves()
    log = make_log({"acc_a": np.zeros(velocity.size)}, 20_000.0, velocity=velocity)
    assert find_segments(log, 0.66) == ()


def test_gaps_cut_a_log_into_segments_without_a_velocity() -> None:
    """Without a set point each gap-free piece is a segment of unknown velocity."""
    log = make_log(
        {"acc_a": np.zeros(3000)}, 2000.0, pieces=((0, 1000), (1010, 1040), (1100, 3000))
    )
    segments = find_segments(log, 0.25)
    assert [(s.start, s.stop) for s in segments] == [(0, 1000), (1100, 3000)]
    assert all(np.isnan(s.velocity) for s in segments)


def test_a_gap_inside_a_move_is_not_bridged() -> None:
    """With a set point, segments still end at the gaps and start after them."""
    velocity = np.full(4000, 0.1)
    velocity[1900:2000] = np.nan
    log = make_log(
        {"acc_a": np.zeros(4000)}, 2000.0, velocity=velocity, pieces=((0, 1900), (2000, 4000))
    )
    segments = find_segments(log, 0.1)
    assert [(s.start, s.stop, s.velocity) for s in segments] == [
        (0, 1900, pytest.approx(0.1)),
        (2000, 4000, pytest.approx(0.1)),
    ]


def test_a_record_at_rest_throughout_is_one_segment() -> None:
    """Ambient vibration with the axis standing still is analysed, at velocity zero."""
    log = make_log({"acc_a": np.zeros(4000)}, 2000.0, velocity=np.zeros(4000))
    assert find_segments(log, 0.1) == (Segment(0, 4000, 0.0, "idle"),)


def test_a_continuously_accelerating_sweep_has_no_segment() -> None:
    """Without constant velocity there is no segment."""
    log = make_log({"acc_a": np.zeros(4000)}, 2000.0, velocity=np.linspace(0, 0.4, 4000))
    assert find_segments(log, 0.05) == ()


# Long records


def test_phases_do_not_depend_on_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Moves, settling and rests are cut alike in one block or many."""
    velocity = strokes(0.1, -0.2, 0.1)
    log = log_of(velocity)
    whole = find_phases(log)
    for size in (40, 333, 1000):
        monkeypatch.setattr(samples, "BLOCK", size)
        parts = find_phases(log)
        assert [(p.start, p.stop, p.kind) for p in parts] == [
            (p.start, p.stop, p.kind) for p in whole
        ]
        np.testing.assert_allclose([p.velocity for p in parts], [p.velocity for p in whole])


def test_long_segments_are_cut_into_equal_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is longer than the longest is cut; parts have one length and follow each other."""
    monkeypatch.setattr(segments, "MINUTE", 1000)
    log = make_log({"acc_a": np.zeros(3701)}, RATE, pieces=((0, 900), (1000, 3701)))
    for parts in (find_segments(log, 0.0), select_segments(log, "record")):
        assert [(p.start, p.stop) for p in parts] == [
            (0, 900), (1000, 1900), (1900, 2800), (2800, 3700),
        ]  # fmt: skip


def test_parts_stay_long_enough_for_what_is_looked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """A narrow mode asks for long parts: ten times the shortest that resolves it."""
    monkeypatch.setattr(segments, "MINUTE", 1000)
    log = make_log({"acc_a": np.zeros(9000)}, RATE)
    assert {p.stop - p.start for p in find_segments(log, 0.1)} == {1000}
    assert {p.stop - p.start for p in find_segments(log, 0.45)} == {4500}
    assert {p.stop - p.start for p in find_segments(log, 2.0)} == {9000}


def test_segments_of_many_lengths_get_few() -> None:
    """A hundred gaps leave a dozen lengths, each at most a tenth shorter; few lengths stay."""
    ends = np.cumsum(np.random.default_rng(0).integers(500, 2000, 101)).tolist()
    many = [Segment(start, stop, np.nan) for start, stop in pairwise(ends)]
    few = with_few_lengths(many)
    assert len({one.stop - one.start for one in few}) <= 14
    for one, before in zip(few, many, strict=True):
        assert one.start == before.start and one.stop <= before.stop
        assert one.stop - one.start >= 0.9 * (before.stop - before.start)
    assert with_few_lengths(many[:20]) == tuple(many[:20])
    # Moves of nearly one length lose nothing more than what they differ in.
    moves = [Segment(0, 5000 + k, 0.1) for k in range(40)]
    assert {one.stop for one in with_few_lengths(moves)} == {5000}
