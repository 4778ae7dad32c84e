"""Stretches of a log: without gaps, cut by what the set point does, chosen for a reading."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, get_args

import numpy as np

from lmshealth.arrays import FloatArray
from lmshealth.errors import BadLog
from lmshealth.logs import Log

# Setpoint changes below this share of its largest value count as constant velocity.
_VELOCITY_TOLERANCE = 1e-3
# So long after a move, in s, the stage settles: some periods of the slowest modes and of the loop.
_SETTLING = 0.5

# Set velocities closer than this are one; stretches shorter than this share of the longest do not
# count: the top of a triangular move has one velocity for an instant.
_SAME_VELOCITY = 0.01
_LEAST_LENGTH = 0.05

Kind = Literal["whole", "ramp", "constant", "settling", "idle"]
Part = Literal["record", "constant", "settling", "idle"]
PARTS: tuple[Part, ...] = get_args(Part)


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
    scale = max((float(np.abs(velocity[a:b]).max()) for a, b in log.pieces), default=0.0)
    settling = round(_SETTLING * log.sample_rate)
    found: list[Segment] = []
    for start, stop in log.pieces:
        found += _phases(velocity[start:stop], start, scale, settling)
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
        In order of time; empty if nothing is long enough.
    """
    phases = find_phases(log)
    rests = all(phase.kind == "idle" for phase in phases)
    n_least = max(8, round(shortest * log.sample_rate))
    return tuple(
        phase
        for phase in phases
        if (rests or phase.kind in ("constant", "whole")) and phase.stop - phase.start >= n_least
    )


def _phases(velocity: FloatArray, offset: int, scale: float, settling: int) -> list[Segment]:
    """Cut a gap-free piece by its set velocity; ``settling`` in samples."""
    moving = np.abs(velocity) > _VELOCITY_TOLERANCE * scale
    # Steps are taken over 1 ms or so of samples: one sample of a slow ramp looks constant.
    lag = max(1, min(20, velocity.size // 4))
    change = np.abs(velocity[lag:] - velocity[:-lag]) > _VELOCITY_TOLERANCE * max(scale, 1e-12)
    steady = moving.copy()
    for shift in (0, lag):
        steady[shift : shift + change.size] &= ~change
    # Samples since the last one that moved; a piece that begins at rest is taken to be idle.
    index = np.arange(velocity.size)
    last = np.maximum.accumulate(np.where(moving, index, -settling - 1))
    kinds: tuple[Kind, ...] = ("ramp", "constant", "settling", "idle")
    code = np.where(moving, steady, np.where(index - last <= settling, 2, 3))
    cuts = [0, *(np.flatnonzero(np.diff(code)) + 1).tolist(), velocity.size]
    return [
        Segment(offset + a, offset + b, float(np.mean(velocity[a:b])), kinds[int(code[a])])
        for a, b in pairwise(cuts)
    ]


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
        At least one, in order of time.

    Raises
    ------
    BadLog
        With reason ``no-set-point`` where the set point is needed and missing, and
        ``no-such-part`` where the log has no such stretch.
    """
    if part == "record" or (log.reference_velocity is None and part == "constant"):
        return tuple(Segment(start, stop, float("nan")) for start, stop in log.pieces)
    if log.reference_velocity is None:
        raise BadLog(
            log.name,
            "no-set-point",
            f"what is {part} only the set point tells; needed reference_position_mm or "
            "reference_velocity_mm_s",
        )
    phases = find_phases(log)
    chosen = tuple(phase for phase in phases if phase.kind == part)
    if not chosen:
        there = ", ".join(sorted({phase.kind for phase in phases}))
        raise BadLog(log.name, "no-such-part", f"no stretch is {part}; there: {there}")
    return chosen


def set_velocity(log: Log) -> float:
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
