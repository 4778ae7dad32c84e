"""The time axis: sample rate, interruptions, and the set velocity of a set position.

Samples are never sorted and never interpolated.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lmshealth._arrays import FloatArray
from lmshealth.io import constants
from lmshealth.io.buffers import Samples, Spool, blocks
from lmshealth.io.refusal import Unusable

IntArray = NDArray[np.int64]

# Quantile of the second differences of a position that is at most a step and an acceleration.
_QUANTILE = 0.9


class TimeAxis(NamedTuple):
    """Sample rate in Hz, samples before which a record is interrupted, ``(n_breaks,)``.

    ``note`` counts the interruptions; it is empty if there are none.
    """

    sample_rate: float
    breaks: IntArray
    note: str


def too_many(n_interruptions: int, n_samples: int) -> bool:
    """Return whether a record is interrupted too often to be cut into pieces."""
    return n_interruptions > max(constants.ALWAYS_ALLOWED, constants.INTERRUPTED_SHARE * n_samples)


def time_axis(time: Samples | None, rate: float | None) -> TimeAxis:
    """Find the sample rate and the interruptions of a record.

    From time stamps in s as recorded, ``(n_samples,)``, and the sample rate in Hz of the metadata.
    `Unusable` (``time``) where both are absent or disagree, where time stamps are missing, repeated
    or descending, and where the intervals are not uniform.
    """
    if time is None:
        if rate is None:
            detail = "neither a column time_s nor the metadata sample_rate_hz; needed one"
            raise Unusable("time", detail)
        return TimeAxis(rate, np.empty(0, dtype=np.int64), "")
    _check_order(time)
    interval, total, n_regular, n_gaps, missing = 0.0, 0.0, 0, 0, 0.0
    breaks = [np.empty(0, dtype=np.int64)]
    for at, stamps in blocks(time, overlap=1):
        steps = np.diff(stamps)
        # The first block determines the nominal interval.
        interval = interval or float(np.median(steps))
        gap = steps > constants.GAP * interval
        irregular = gap | (np.abs(steps / interval - 1) > constants.JITTER)
        n_gaps += int(gap.sum())
        missing += float(np.round(steps[gap] / interval - 1).sum())
        total += float(steps[~irregular].sum())
        n_regular += int(np.count_nonzero(~irregular))
        breaks.append(np.flatnonzero(irregular) + at + 1)
    where: IntArray = np.concatenate(breaks)
    notes = [f"{n_gaps} gaps with {missing:.0f} dropped samples"] if n_gaps else []
    if n_odd := where.size - n_gaps:
        notes.append(
            f"{n_odd} of {time.size - 1} intervals differ by more than {constants.JITTER:.0%} "
            f"from the median {interval:.6g} s"
        )
    note = " and ".join(notes)
    if too_many(where.size, time.size):
        raise Unusable("time", f"{note}; needed uniform samples, export them at the sampling clock")
    # The mean over all regular intervals averages the rounding of time stamps out.
    interval = total / n_regular if n_regular else interval
    if rate is not None and abs(interval * rate - 1) > constants.AGREEMENT:
        found = f"time_s gives {1 / interval:.8g} Hz, sample_rate_hz is {rate:.8g}"
        raise Unusable("time", f"{found}; needed agreement within {constants.AGREEMENT:g}")
    # 20000.000000000004 Hz is an artefact of the division.
    return TimeAxis(rate or float(f"{1 / interval:.10g}"), where, note)


def pieces(
    n_samples: int, missing: Sequence[IntArray], breaks: IntArray
) -> tuple[tuple[int, int], ...]:
    """Cut a record into half-open ranges without gaps; single samples are left out.

    ``missing`` holds for each channel the half-open ranges in which it has no samples, shape
    ``(n, 2)``; ``breaks`` the samples before which time is interrupted, ascending.
    """
    gone = np.concatenate([*missing, np.empty((0, 2), dtype=np.int64)])
    gone = gone[np.argsort(gone[:, 0], kind="stable")]
    # A piece begins where all missing ranges so far have ended.
    start = np.concatenate([[0], np.maximum.accumulate(gone[:, 1])])
    stop = np.concatenate([gone[:, 0], [n_samples]])
    there = start < stop
    start, stop = start[there], stop[there]
    inside = breaks[np.searchsorted(start, breaks) > np.searchsorted(stop, breaks, side="right")]
    start, stop = np.sort(np.append(start, inside)), np.sort(np.append(stop, inside))
    keep = stop - start >= constants.SHORTEST_PIECE
    return tuple(zip(start[keep].tolist(), stop[keep].tolist(), strict=True))


def _check_order(time: Samples) -> None:
    """Require that time stamps are numbers and increase."""
    unknown = backwards = repeated = 0
    first = None
    for at, stamps in blocks(time, overlap=1):
        steps = np.diff(stamps)
        if first is None and not (steps > 0).all():
            first = at + int(np.argmin(steps > 0)) + 1
        unknown += int(np.count_nonzero(~(np.abs(stamps[at > 0 :]) < constants.LARGEST_MAGNITUDE)))
        backwards += int(np.count_nonzero(steps < 0))
        repeated += int(np.count_nonzero(steps == 0))
    if unknown:
        raise Unusable("time", f"{unknown} of {time.size} time stamps are no numbers")
    if backwards or repeated:
        found = f"time_s runs backwards {backwards} times and repeats {repeated} times"
        where = f"in {time.size} samples, first at sample {first}"
        raise Unusable("time", f"{found} {where}; needed increasing time stamps")


def set_velocity(
    position: Samples, pieces: Sequence[tuple[int, int]], sample_rate: float
) -> Samples:
    """Differentiate a set position piece by piece, never across a gap.

    The difference spans so many samples that the steps in which positions are stored do not show.
    Position in m, velocity in m/s, both ``(n_samples,)``; NaN outside the pieces, which ascend.
    """
    reach = _reach(position, pieces, sample_rate)
    velocity = Spool()
    for start, stop in pieces:
        _fill(velocity, start)
        for at, block in blocks(position, start, stop):
            low, high = max(start, at - reach), min(stop, at + block.size + reach)
            around = position[low:high]
            index = np.arange(at - low, at - low + block.size)
            # Towards the ends of a piece the difference is one-sided.
            after = np.minimum(index + reach, high - low - 1)
            before = np.maximum(index - reach, 0)
            velocity.append((around[after] - around[before]) * sample_rate / (after - before))
    _fill(velocity, position.size)
    return velocity.samples()


def _fill(velocity: Spool, stop: int) -> None:
    """Append NaN up to a sample."""
    for _, block in blocks(np.broadcast_to(np.nan, (stop,)), velocity.size):
        velocity.append(block)


def _reach(position: Samples, pieces: Sequence[tuple[int, int]], sample_rate: float) -> int:
    """Compute how many samples to either side the difference must span to hide the steps."""
    most = max(1, int(constants.LONGEST_REACH * sample_rate))
    step = fastest = 0.0
    for start, stop in pieces:
        for _, block in blocks(position, start, stop):
            if block.size > 2 * most:
                step = max(step, _step(block))
                average = (block[most:] - block[:-most]) * sample_rate / most
                fastest = max(fastest, float(np.abs(average).max()))
    if fastest == 0:
        return 1
    return int(np.clip(np.ceil(step * sample_rate / (2 * constants.STEP_SHARE * fastest)), 1, most))


def _step(block: FloatArray) -> float:
    """Estimate the step of stored positions in m from the second differences."""
    uneven = np.abs(np.diff(block, 2))
    # At a velocity of a whole number of steps per sample only few differences are uneven.
    apart = np.diff(np.unique(block))
    smallest = float(apart.min()) if apart.size else 0.0
    visible = smallest if float(uneven.max()) > 0.5 * smallest else 0.0
    return max(visible, float(np.quantile(uneven, _QUANTILE)))
