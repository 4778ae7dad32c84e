"""Segments of a log: gap-free parts of one motion phase (README.md, "Segments")."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, get_args

import numpy as np

from lmshealth._private.arrays import BoolArray, FloatArray
from lmshealth.errors import BadLog
from lmshealth.io.buffers import MINUTE, Samples, blocks
from lmshealth.io.log import Channel, Log
from lmshealth.signal import constants

Kind = Literal["whole", "ramp", "constant", "settling", "idle"]
Part = Literal["record", "constant", "settling", "idle"]
PARTS: tuple[Part, ...] = get_args(Part)
# Reason of a refusal without a channel, and what to provide.
_CHANNELS = {
    "displacement": ("no-delta-e", "delta_e", "delta_e_um"),
    "acceleration": ("no-accelerometer", "acc", "acc_<name>_m_s2"),
}
_KINDS: tuple[Kind, ...] = ("ramp", "constant", "settling", "idle")


@dataclass(frozen=True, slots=True)
class Segment:
    """A gap-free part of a log: a half-open range of samples.

    `velocity` is the mean set velocity in m/s; `kind` is ``constant`` velocity, ``ramp`` between
    two velocities, ``settling`` after a move, or ``idle`` otherwise at rest. Where the log has no
    set point they are NaN and ``whole``.
    """

    start: int
    stop: int
    velocity: float
    kind: Kind = "whole"


def find_phases(log: Log) -> tuple[Segment, ...]:
    """Cut a log at its gaps and at changes of its motion phase.

    In order of time; without a set point each gap-free piece is one segment.
    """
    velocity = log.reference_velocity
    if velocity is None:
        return tuple(Segment(start, stop, float("nan")) for start, stop in log.pieces)
    scale = max(
        (float(np.abs(part).max()) for a, b in log.pieces for _, part in blocks(velocity, a, b)),
        default=0.0,
    )
    if _range_of_position(log, velocity) < constants.LEAST_MOVE:
        return tuple(Segment(start, stop, 0.0, "idle") for start, stop in log.pieces)
    settling = round(constants.SETTLING_TIME * log.sample_rate)
    phases: list[Segment] = []
    for start, stop in log.pieces:
        found: list[Segment] = []
        # Between neighbouring samples a ramp appears constant.
        most = max(1, (stop - start) // 4)
        lag = max(constants.LEAST_VELOCITY_LAG, round(constants.VELOCITY_LAG * log.sample_rate))
        lag = min(lag, most)
        far = max(lag, min(round(constants.SLOW_RAMP_LAG * log.sample_rate), most))
        # A piece that begins at rest is idle.
        last_move = start - settling - 1
        for at, block in blocks(velocity, start, stop):
            low, high = max(start, at - far), min(stop, at + block.size + far)
            inner = slice(at - low, at - low + block.size)
            near = velocity[low:high]
            steady = (_steady(near, lag, scale) & ~_on_slow_ramp(near, far, scale))[inner]
            moving = np.abs(block) > constants.VELOCITY_TOLERANCE * scale
            code = np.where(moving, steady.view(np.int8), np.int8(2))
            cuts = [0, *(np.flatnonzero(code[1:] != code[:-1]) + 1).tolist(), block.size]
            for a, b in pairwise(cuts):
                kind = int(code[a])
                if kind < 2:
                    last_move, settled = at + b - 1, b
                else:
                    settled = min(max(last_move + settling + 1 - at, a), b)
                for begin, end, own in ((a, settled, kind), (settled, b, 3)):
                    if begin < end:
                        mean = float(np.mean(block[begin:end]))
                        _join(found, Segment(at + begin, at + end, mean, _KINDS[own]))
        phases += found
    return tuple(phases)


def find_segments(log: Log, shortest: float) -> tuple[Segment, ...]:
    """Cut a log into gap-free segments in which it is stationary.

    These are the segments of constant velocity of at least ``shortest`` s; without a set point,
    and in a log at rest (ambient vibration), the gap-free pieces. A segment of more than a minute
    at 20 kHz is cut into parts of one length, each at least ten times ``shortest``. The result is
    in order of time, and empty if no segment is long enough.
    """
    return stationary(find_phases(log), round(shortest * log.sample_rate))


def stationary(phases: Sequence[Segment], n_least: int) -> tuple[Segment, ...]:
    """Return the phases in which a log is stationary, as `find_segments` does.

    ``n_least`` is the least number of samples.
    """
    rests = all(phase.kind == "idle" for phase in phases)
    n_least = max(8, n_least)
    longest = max(MINUTE, constants.PARTS_LENGTH * n_least)
    return tuple(
        part
        for phase in phases
        if (rests or phase.kind in ("constant", "whole")) and phase.stop - phase.start >= n_least
        for part in _parts(phase, longest)
    )


def with_few_lengths(segments: Sequence[Segment]) -> tuple[Segment, ...]:
    """Shorten segments of very many lengths to fewer, each by at most `SHORTENED`.

    Every length is a computation of its own in the fits.
    """
    common: dict[int, int] = {}
    shortest = 0
    for size in sorted({segment.stop - segment.start for segment in segments}):
        if size * (1 - constants.SHORTENED) > shortest:
            shortest = size
        common[size] = shortest
    if len(common) <= constants.MOST_LENGTHS:
        return tuple(segments)
    return tuple(replace(s, stop=s.start + common[s.stop - s.start]) for s in segments)


def _parts(segment: Segment, longest: int) -> list[Segment]:
    """Cut a segment into the fewest parts of one length; a few last samples may be omitted."""
    from scipy import fft  # late: the command line needs only the names of the parts

    size = segment.stop - segment.start
    n_parts = -(-size // longest)
    if n_parts == 1:
        return [segment]
    # A transform of a length with large prime factors takes three times the memory.
    each = fft.prev_fast_len(size // n_parts, real=True)
    starts = [segment.start + k * each for k in range(n_parts)]
    return [replace(segment, start=start, stop=start + each) for start in starts]


def _steady(velocity: FloatArray, lag: int, scale: float) -> BoolArray:
    """Return which samples have the same velocity ``lag`` samples before and after."""
    most = constants.VELOCITY_TOLERANCE * max(scale, 1e-12)
    change = np.abs(velocity[lag:] - velocity[:-lag]) > most
    steady = np.ones(velocity.size, dtype=bool)
    for shift in (0, lag):
        steady[shift : shift + change.size] &= ~change
    return steady


def _on_slow_ramp(velocity: FloatArray, lag: int, scale: float) -> BoolArray:
    """Return which samples have a lower velocity ``lag`` samples before and a higher one after.

    Or the other way round: on both sides of a short plateau it is lower.
    """
    most = constants.SAME_VELOCITY * max(scale, 1e-12)
    change = velocity[lag:] - velocity[:-lag]
    slow = np.zeros(velocity.size, dtype=bool)
    for risen in (change > most, change < -most):
        slow[lag:-lag] |= risen[:-lag] & risen[lag:]
    return slow


def _range_of_position(log: Log, velocity: Samples) -> float:
    """Return the range in m of the set position by a set velocity in m/s."""
    position, ends = 0.0, [0.0]
    for start, stop in log.pieces:
        for _, part in blocks(velocity, start, stop):
            path = position + np.cumsum(part) / log.sample_rate
            position = float(path[-1])
            ends += [float(path.min()), float(path.max())]
    return max(ends) - min(ends)


def _join(found: list[Segment], segment: Segment) -> None:
    """Append a segment, or extend the last one of the same kind."""
    if not found or found[-1].kind != segment.kind:
        found.append(segment)
        return
    before = found[-1]
    n, more = before.stop - before.start, segment.stop - segment.start
    mean = (n * before.velocity + more * segment.velocity) / (n + more)
    found[-1] = replace(before, stop=segment.stop, velocity=mean)


def select_channels(log: Log, kind: Literal["displacement", "acceleration"]) -> list[Channel]:
    """Return the channels of a kind; without any `BadLog`: ``no-delta-e``, ``no-accelerometer``."""
    channels = [channel for channel in log.channels if channel.kind == kind]
    if not channels:
        reason, name, column = _CHANNELS[kind]
        there = ", ".join(channel.name for channel in log.channels)
        detail = f"no usable {name} channel; there are: {there}; needed {column}"
        raise BadLog(log.name, reason, detail)
    return channels


def select_segments(log: Log, part: Part) -> tuple[Segment, ...]:
    """Select the gap-free segments of one motion phase.

    ``record`` is all of the log, acceleration and braking included; without a set point only it can
    be selected, also as ``constant``. The result is at least one segment, in order of time, each of
    at most a minute at 20 kHz. `BadLog` as `select_phases`.
    """
    return tuple(cut for phase in select_phases(log, part) for cut in _parts(phase, MINUTE))


def select_phases(log: Log, part: Part) -> tuple[Segment, ...]:
    """Select as `select_segments` does, without cutting the segments.

    `BadLog`: ``no-set-point`` where the set point is needed and missing, ``no-such-part`` where the
    log has no such segment.
    """
    if part == "record" or (log.reference_velocity is None and part == "constant"):
        return tuple(Segment(start, stop, float("nan")) for start, stop in log.pieces)
    if log.reference_velocity is None:
        needed = "needed reference_position_mm or reference_velocity_mm_s"
        detail = f"no set point, which defines the part {part!r}; {needed}"
        raise BadLog(log.name, "no-set-point", detail)
    phases = find_phases(log)
    chosen = tuple(phase for phase in phases if phase.kind == part)
    if not chosen:
        there = ", ".join(sorted({phase.kind for phase in phases}))
        raise BadLog(log.name, "no-such-part", f"no part of the log is {part}; there are: {there}")
    return chosen


def nominal_velocity(log: Log) -> float:
    """Return the speed of a log in m/s by its set point, or without one by its metadata.

    NaN where neither states it, or where the set point holds several speeds.
    """
    if log.reference_velocity is None:
        given = log.metadata.velocity
        return float("nan") if given is None else abs(given)
    steady = [s for s in find_phases(log) if s.kind == "constant"]
    if not steady:
        return float("nan")
    length = np.array([s.stop - s.start for s in steady])
    speed = np.abs([s.velocity for s in steady])[length >= constants.LEAST_LENGTH * length.max()]
    if speed.max() > (1 + constants.SAME_VELOCITY) * speed.min():
        return float("nan")
    return float(np.median(speed))


def distinct_velocities(speeds: Iterable[float]) -> tuple[float, ...]:
    """Return the lowest of the speeds that are equal within `SAME_VELOCITY`, ascending."""
    found: list[float] = []
    for speed in sorted(speeds):
        if not found or speed > (1 + constants.SAME_VELOCITY) * found[-1]:
            found.append(speed)
    return tuple(found)
