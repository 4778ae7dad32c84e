"""Stretches of a log: without gaps, cut by what the set point does, chosen for a reading."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, get_args

import numpy as np

from lmshealth._arrays import BoolArray, FloatArray
from lmshealth.errors import BadLog
from lmshealth.io.buffers import MINUTE, Samples, blocks
from lmshealth.io.log import Log

# Setpoint changes below this share of its largest value count as constant velocity.
_VELOCITY_TOLERANCE = 1e-3
# So long after a move, in s, the stage settles: some periods of the slowest modes and of the loop.
_SETTLING = 0.5

# Set velocities closer than this are one; stretches shorter than this share of the longest do not
# count: the top of a triangular move has one velocity for an instant.
_SAME_VELOCITY = 0.01
_LEAST_LENGTH = 0.05
# A long stretch is cut into parts of so many times the shortest that resolves what is looked for.
_MANY = 10

Kind = Literal["whole", "ramp", "constant", "settling", "idle"]
Part = Literal["record", "constant", "settling", "idle"]
PARTS: tuple[Part, ...] = get_args(Part)
_KINDS: tuple[Kind, ...] = ("ramp", "constant", "settling", "idle")


@dataclass(frozen=True, slots=True)
class Segment:
    """A stretch of a log without gaps.

    Attributes
    ----------
    start, stop : int
        Half-open range of samples.
    velocity : float
        Mean set velocity in m/s; NaN where the log has no set point.
    kind : str
        ``constant`` velocity, ``ramp`` between two velocities, ``settling`` within half a second
        after a move, ``idle`` at rest otherwise; ``whole`` where the log has no set point.
    """

    start: int
    stop: int
    velocity: float
    kind: Kind = "whole"


def find_phases(log: Log) -> tuple[Segment, ...]:
    """Cut a log where it has gaps and where its set point changes what it does.

    Parameters
    ----------
    log : Log
        Without a set point each gap-free piece is one segment.

    Returns
    -------
    tuple of Segment
        In order of time; together they are all of the log but its gaps.
    """
    velocity = log.reference_velocity
    if velocity is None:
        return tuple(Segment(start, stop, float("nan")) for start, stop in log.pieces)
    scale = max(
        (float(np.abs(part).max()) for a, b in log.pieces for _, part in blocks(velocity, a, b)),
        default=0.0,
    )
    settling = round(_SETTLING * log.sample_rate)
    found: list[Segment] = []
    for start, stop in log.pieces:
        found += _phases(velocity, start, stop, scale, settling)
    return tuple(found)


def find_segments(log: Log, shortest: float) -> tuple[Segment, ...]:
    """Cut a log into stretches without gaps in which it is stationary.

    Parameters
    ----------
    log : Log
        Without a set point each gap-free piece is one segment, and so it is of a log that never
        moves (ambient vibration); else the stretches of constant velocity are.
    shortest : float
        Segments below this many seconds are left out.

    Returns
    -------
    tuple of Segment
        In order of time; empty if nothing is long enough. A stretch of more than a minute at
        20 kHz is cut into parts of one length, each at least ten times ``shortest``.
    """
    phases = find_phases(log)
    rests = all(phase.kind == "idle" for phase in phases)
    n_least = max(8, round(shortest * log.sample_rate))
    longest = max(MINUTE, _MANY * n_least)
    return tuple(
        part
        for phase in phases
        if (rests or phase.kind in ("constant", "whole")) and phase.stop - phase.start >= n_least
        for part in _parts(phase, longest)
    )


def _parts(segment: Segment, longest: int) -> list[Segment]:
    """Cut a segment into the fewest parts of one length; a few last samples may be left out."""
    from scipy import fft  # late: the command line only names the parts

    size = segment.stop - segment.start
    n_parts = -(-size // longest)
    if n_parts == 1:
        return [segment]
    # Lengths with large prime factors would cost the transform three times the memory.
    each = fft.prev_fast_len(size // n_parts, real=True)
    starts = [segment.start + k * each for k in range(n_parts)]
    return [replace(segment, start=start, stop=start + each) for start in starts]


def _phases(velocity: Samples, start: int, stop: int, scale: float, settling: int) -> list[Segment]:
    """Cut a gap-free piece by its set velocity; ``settling`` in samples."""
    # Steps are taken over 1 ms or so of samples: one sample of a slow ramp looks constant.
    lag = max(1, min(20, (stop - start) // 4))
    # A piece that begins at rest is taken to be idle.
    last_move = start - settling - 1
    found: list[Segment] = []
    for at, block in blocks(velocity, start, stop):
        low, high = max(start, at - lag), min(stop, at + block.size + lag)
        inner = slice(at - low, at - low + block.size)
        steady = _steady(velocity[low:high], lag, scale)[inner]
        moving = np.abs(block) > _VELOCITY_TOLERANCE * scale
        index = np.arange(at, at + block.size)
        last = np.maximum.accumulate(np.where(moving, index, last_move))
        last_move = int(last[-1])
        code = np.where(moving, steady, np.where(index - last <= settling, 2, 3))
        cuts = [0, *(np.flatnonzero(np.diff(code)) + 1).tolist(), block.size]
        for a, b in pairwise(cuts):
            mean = float(np.mean(block[a:b]))
            _join(found, Segment(at + a, at + b, mean, _KINDS[int(code[a])]))
    return found


def _steady(velocity: FloatArray, lag: int, scale: float) -> BoolArray:
    """Tell which samples have the same velocity ``lag`` samples before and after."""
    change = np.abs(velocity[lag:] - velocity[:-lag]) > _VELOCITY_TOLERANCE * max(scale, 1e-12)
    steady = np.ones(velocity.size, dtype=bool)
    for shift in (0, lag):
        steady[shift : shift + change.size] &= ~change
    return steady


def _join(found: list[Segment], segment: Segment) -> None:
    """Append a segment, or make it part of the one that it continues."""
    if not found or found[-1].kind != segment.kind:
        found.append(segment)
        return
    before = found[-1]
    n, more = before.stop - before.start, segment.stop - segment.start
    mean = (n * before.velocity + more * segment.velocity) / (n + more)
    found[-1] = replace(before, stop=segment.stop, velocity=mean)


def select_segments(log: Log, part: Part) -> tuple[Segment, ...]:
    """Choose stretches without gaps.

    Parameters
    ----------
    log : Log
        Without a set point only its whole record can be chosen; ``constant`` is the same then.
    part : str
        ``record`` (all of it, acceleration and braking included, as the paper reads it),
        ``constant`` velocity, ``settling`` after a move, or ``idle``.

    Returns
    -------
    tuple of Segment
        At least one, in order of time; none is longer than a minute at 20 kHz.

    Raises
    ------
    BadLog
        With reason ``no-set-point`` where the set point is needed and missing, and
        ``no-such-part`` where the log has no such stretch.
    """
    if part == "record" or (log.reference_velocity is None and part == "constant"):
        pieces = [Segment(start, stop, float("nan")) for start, stop in log.pieces]
        return tuple(cut for piece in pieces for cut in _parts(piece, MINUTE))
    if log.reference_velocity is None:
        raise BadLog(
            log.name,
            "no-set-point",
            f"what is {part} only the set point tells; needed reference_position_mm or "
            "reference_velocity_mm_s",
        )
    phases = find_phases(log)
    chosen = tuple(cut for phase in phases if phase.kind == part for cut in _parts(phase, MINUTE))
    if not chosen:
        there = ", ".join(sorted({phase.kind for phase in phases}))
        raise BadLog(log.name, "no-such-part", f"no stretch is {part}; there: {there}")
    return chosen


def nominal_velocity(log: Log) -> float:
    """Tell the one velocity a log was set to, in m/s, whatever its direction.

    By the set point; without it by the metadata. NaN where neither tells, or where the set point
    holds several velocities.
    """
    if log.reference_velocity is None:
        given = log.metadata.velocity
        return float("nan") if given is None else abs(given)
    steady = [s for s in find_phases(log) if s.kind == "constant"]
    if not steady:
        return float("nan")
    length = np.array([s.stop - s.start for s in steady])
    speed = np.abs([s.velocity for s in steady])[length >= _LEAST_LENGTH * length.max()]
    if speed.max() > (1 + _SAME_VELOCITY) * speed.min():
        return float("nan")
    return float(np.median(speed))
