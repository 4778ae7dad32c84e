"""The time axis: sample rate, and where samples are missing. Never sorted, never interpolated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lmshealth.io.buffers import Samples, blocks
from lmshealth.io.refusal import Unusable

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


def time_axis(time: Samples | None, rate: float | None) -> TimeAxis:
    """Find the sample rate and the interruptions of a record.

    Parameters
    ----------
    time : ndarray, Stored or None
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
    _check_order(time)
    interval, total, n_regular, n_gaps, missing = 0.0, 0.0, 0, 0, 0.0
    breaks = [np.empty(0, dtype=np.int64)]
    for at, stamps in blocks(time, overlap=1):
        steps = np.diff(stamps)
        # The first block tells what an interval is.
        interval = interval or float(np.median(steps))
        gap = steps > GAP * interval
        irregular = gap | (np.abs(steps / interval - 1) > JITTER)
        n_gaps += int(gap.sum())
        missing += float(np.round(steps[gap] / interval - 1).sum())
        total += float(steps[~irregular].sum())
        n_regular += int(np.count_nonzero(~irregular))
        breaks.append(np.flatnonzero(irregular) + at + 1)
    where: IntArray = np.concatenate(breaks)
    note = _note(n_gaps, missing, where.size - n_gaps, time.size - 1, interval)
    if too_many(where.size, time.size):
        raise Unusable("time", f"{note}; needed uniform samples, export them at the sampling clock")
    # The mean over all regular intervals averages the rounding of time stamps out.
    interval = total / n_regular if n_regular else interval
    return TimeAxis(_agreed(interval, rate), where, note)


def pieces(
    n_samples: int, missing: Sequence[IntArray], breaks: IntArray
) -> tuple[tuple[int, int], ...]:
    """Cut a record into ranges without gaps.

    Parameters
    ----------
    n_samples : int
        Length of the record.
    missing : sequence of ndarray
        Of each channel the half-open ranges in which it has no samples, shape ``(n, 2)``.
    breaks : ndarray of int
        Samples before which time is interrupted, ascending, shape ``(n_breaks,)``.

    Returns
    -------
    tuple of (int, int)
        Half-open ranges of sample indices; single samples are left out.
    """
    gone = np.concatenate([*missing, np.empty((0, 2), dtype=np.int64)])
    gone = gone[np.argsort(gone[:, 0], kind="stable")]
    # What is there begins where all that is missing so far has ended.
    start = np.concatenate([[0], np.maximum.accumulate(gone[:, 1])])
    stop = np.concatenate([gone[:, 0], [n_samples]])
    there = start < stop
    start, stop = start[there], stop[there]
    inside = breaks[np.searchsorted(start, breaks) > np.searchsorted(stop, breaks, side="right")]
    start, stop = np.sort(np.append(start, inside)), np.sort(np.append(stop, inside))
    keep = stop - start >= SHORTEST_PIECE
    return tuple(zip(start[keep].tolist(), stop[keep].tolist(), strict=True))


def _check_order(time: Samples) -> None:
    """Insist that time stamps are numbers and increase."""
    if time.size < SHORTEST_PIECE:
        raise Unusable("empty", f"{time.size} samples; needed at least {SHORTEST_PIECE}")
    unknown = backwards = repeated = 0
    first = None
    for at, stamps in blocks(time, overlap=1):
        steps = np.diff(stamps)
        wrong = ~(steps > 0)
        if wrong.any() and first is None:
            first = at + int(np.argmax(wrong)) + 1
        unknown += int(np.count_nonzero(~(np.abs(stamps[at > 0 :]) < 1e12)))
        backwards += int(np.count_nonzero(steps < 0))
        repeated += int(np.count_nonzero(steps == 0))
    if unknown:
        raise Unusable("time", f"{unknown} of {time.size} time stamps are no numbers")
    if backwards or repeated:
        raise Unusable(
            "time",
            f"time_s runs backwards {backwards} times and stands still {repeated} times in "
            f"{time.size} samples, first at sample {first}; needed increasing time stamps",
        )


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
