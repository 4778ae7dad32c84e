"""Parts of a log: which of its stretches a reading is taken from, and how fast it moved."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from lmshealth.errors import BadLog
from lmshealth.logs import Log
from lmshealth.spectra import Segment, find_phases

Part = Literal["record", "constant", "settling", "idle"]
PARTS: tuple[Part, ...] = get_args(Part)

# Set velocities closer than this are one; stretches shorter than this share of the longest do not
# count: the top of a triangular move has one velocity for an instant.
_SAME_VELOCITY = 0.01
_LEAST_LENGTH = 0.05


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
