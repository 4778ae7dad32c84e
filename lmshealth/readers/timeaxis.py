"""The time axis: sample rate, and where samples are missing. Never sorted, never interpolated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lmshealth.arrays import BoolArray, FloatArray
from lmshealth.readers.trouble import Unusable

IntArray = NDArray[np.int64]

AGREEMENT = 1e-4
GAP = 1.5
# Time stamps are rounded (to 1e-6 s in many exports, to 2e-6 s by float32 after 20 s): a quarter
# of an interval leaves room for that, and is too much for any sampling clock.
JITTER = 0.25
# More interruptions than this share are no gaps but a broken recording.
BROKEN = 0.01
ALWAYS_ALLOWED = 10
SHORTEST_PIECE = 2


@dataclass(frozen=True, slots=True, eq=False)
class TimeAxis:
    """How the samples of a log lie in time.

    Attributes
    ----------
    sample_rate : float
        In Hz.
    breaks : ndarray of int
        Samples before which the record is interrupted, shape ``(n_breaks,)``.
    note : str
        Counts of what interrupts the record; empty if nothing does.
    """

    sample_rate: float
    breaks: IntArray
    note: str


def too_many(n_interruptions: int, n_samples: int) -> bool:
    """Tell whether a record is interrupted too often to be cut into pieces."""
    return n_interruptions > max(ALWAYS_ALLOWED, BROKEN * n_samples)


def time_axis(time: FloatArray | None, rate: float | None) -> TimeAxis:
    """Find the sample rate and the interruptions of a record.

    Parameters
    ----------
    time : ndarray or None
        Time stamps in s as recorded, shape ``(n_samples,)``.
    rate : float or None
        Sample rate in Hz that the metadata give.

    Raises
    ------
    Unusable
        With reason ``time`` where both are absent or disagree, where time stands still, runs
        backwards or is unknown, and where the intervals are not uniform.
    """
    if time is None:
        if rate is None:
            raise Unusable(
                "time", "neither a column time_s nor the metadata sample_rate_hz; needed one"
            )
        return TimeAxis(rate, np.empty(0, dtype=np.int64), "")
    steps = _steps(time)
    interval = float(np.median(steps))
    gap = steps > GAP * interval
    odd = ~gap & (np.abs(steps / interval - 1) > JITTER)
    n_gaps, n_odd = int(gap.sum()), int(odd.sum())
    missing = np.round(steps[gap] / interval - 1).sum()
    note = _note(n_gaps, missing, n_odd, steps.size, interval)
    if too_many(n_gaps + n_odd, time.size):
        raise Unusable("time", f"{note}; needed uniform samples, export them at the sampling clock")
    regular = steps[~gap & ~odd]
    # The mean over all regular intervals averages the rounding of time stamps out.
    interval = float(regular.mean()) if regular.size else interval
    return TimeAxis(_agreed(interval, rate), np.flatnonzero(gap | odd) + 1, note)


def pieces(missing: BoolArray, breaks: IntArray) -> tuple[tuple[int, int], ...]:
    """Cut a record into ranges without gaps.

    Parameters
    ----------
    missing : ndarray of bool
        Where a sample is missing, shape ``(n_samples,)``.
    breaks : ndarray of int
        Samples before which time is interrupted, shape ``(n_breaks,)``.

    Returns
    -------
    tuple of (int, int)
        Half-open ranges of sample indices; single samples are left out.
    """
    edge = np.zeros(missing.size + 1, dtype=bool)
    edge[[0, -1]] = True
    edge[breaks] = True
    edge[1:-1] |= missing[1:] != missing[:-1]
    bounds = np.flatnonzero(edge)
    start, stop = bounds[:-1], bounds[1:]
    keep = ~missing[start] & (stop - start >= SHORTEST_PIECE)
    return tuple(zip(start[keep].tolist(), stop[keep].tolist(), strict=True))


def _steps(time: FloatArray) -> FloatArray:
    """Give the intervals in s, shape ``(n_samples - 1,)``, all of them positive."""
    if time.size < SHORTEST_PIECE:
        raise Unusable("empty", f"{time.size} samples; needed at least {SHORTEST_PIECE}")
    unknown = int(np.count_nonzero(~(np.abs(time) < 1e12)))
    if unknown:
        raise Unusable("time", f"{unknown} of {time.size} time stamps are no numbers")
    steps = np.diff(time)
    backwards, repeated = int((steps < 0).sum()), int((steps == 0).sum())
    if backwards or repeated:
        first = int(np.argmax(steps <= 0)) + 1
        raise Unusable(
            "time",
            f"time_s runs backwards {backwards} times and stands still {repeated} times in "
            f"{time.size} samples, first at sample {first}; needed increasing time stamps",
        )
    return np.asarray(steps, dtype=np.float64)


def _note(n_gaps: int, missing: float, n_odd: int, n_steps: int, interval: float) -> str:
    parts = []
    if n_gaps:
        parts.append(f"{n_gaps} gaps with {missing:.0f} dropped samples")
    if n_odd:
        parts.append(
            f"{n_odd} of {n_steps} intervals differ by more than {JITTER:.0%} "
            f"from the median {interval:.6g} s"
        )
    return " and ".join(parts)


def _agreed(interval: float, rate: float | None) -> float:
    """Choose the sample rate in Hz: the metadata's, if the time stamps confirm it."""
    if rate is None:
        # 20000.000000000004 Hz is an artefact of the division.
        return float(f"{1 / interval:.10g}")
    if abs(interval * rate - 1) > AGREEMENT:
        raise Unusable(
            "time",
            f"time_s says {1 / interval:.8g} Hz, sample_rate_hz says {rate:.8g}; "
            f"needed agreement within {AGREEMENT:g}",
        )
    return rate
