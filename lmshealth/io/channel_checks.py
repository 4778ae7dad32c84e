"""What makes a single channel unusable: too many missing samples, a flat line, clipping."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lmshealth._arrays import FloatArray
from lmshealth.io.buffers import Samples, blocks
from lmshealth.io.refusal import Unusable
from lmshealth.io.time_axis import IntArray, too_many

LARGEST_MISSING = 0.10
# No acceleration, position or current reaches this in SI units; its square is still a number.
ABSURD = 1e12

CLIPPED_SHARE = 1e-3
_PILE_UP = 2.0
_LEVELS_BELOW = 4
_FEWEST_LEVELS = 16
_FEWEST_STUCK = 5
_ADJACENT = 0.1


def missing_stretches(values: Samples) -> tuple[IntArray, str]:
    """Find the samples of a channel that are no measurements.

    Parameters
    ----------
    values : ndarray or Stored
        Samples in SI units, shape ``(n_samples,)``.

    Returns
    -------
    ndarray of int
        Half-open ranges in which every sample is NaN, infinite or absurd, ascending, shape
        ``(n_stretches, 2)``.
    str
        Their counts; empty if nothing is missing.

    Raises
    ------
    Unusable
        With reason ``missing-samples`` when they are too many to work around: other channels
        would be cut to pieces by this one.
    """
    found = [np.empty(0, dtype=np.int64)]
    for at, block in blocks(values):
        missing = ~(np.abs(block) < ABSURD)
        if missing.any():
            edges = np.diff(missing.view(np.int8), prepend=0, append=0)
            found.append(np.flatnonzero(edges) + at)
    bounds = np.concatenate(found)
    # Where a stretch ends at the edge of a block and another begins there, they are one.
    twice = np.flatnonzero(np.diff(bounds) == 0)
    bounds = np.delete(bounds, np.concatenate([twice, twice + 1]))
    stretches: IntArray = bounds.reshape(-1, 2)
    if not stretches.size:
        return stretches, ""
    n_missing = int(np.sum(stretches[:, 1] - stretches[:, 0]))
    n_stretches = len(stretches)
    note = f"{n_missing} of {values.size} samples are missing (NaN) in {n_stretches} stretches"
    if n_missing > LARGEST_MISSING * values.size or too_many(n_stretches, values.size):
        raise Unusable("missing-samples", note)
    return stretches, note


def check_signal(values: Samples) -> None:
    """Refuse a flat or clipped channel.

    Parameters
    ----------
    values : ndarray or Stored
        Samples in SI units, shape ``(n_samples,)``; those that are missing are passed over.

    Raises
    ------
    Unusable
        With reason ``flat`` or ``clipped``.
    """
    low = min(float(block.min()) for block in _measured(values))
    high = max(float(block.max()) for block in _measured(values))
    if low == high:
        raise Unusable("flat", f"all {values.size} samples are {low:.6g} (SI); check the sensor")
    at_high = _stuck(values, low, high, 1.0)
    at_low = _stuck(values, -high, -low, -1.0)
    if at_high + at_low >= CLIPPED_SHARE * values.size:
        raise Unusable(
            "clipped",
            f"{at_low} samples stand at the minimum {low:.6g} and {at_high} at the maximum "
            f"{high:.6g} (SI) of {values.size}; widen the range of the sensor",
        )


def _measured(values: Samples) -> Iterator[FloatArray]:
    """Give the samples block by block, without those that are missing."""
    for _, block in blocks(values):
        there = np.abs(block) < ABSURD
        if there.all():
            yield block
        elif there.any():
            yield block[there]


def _stuck(values: Samples, low: float, high: float, sign: float) -> int:
    """Count the samples that a limited range holds at the maximum; 0 where nothing says so.

    Many samples at the maximum alone prove nothing: a sine in steps of an encoder spends
    ``(d / 2A)^½ 2/π`` of its time in its outermost step of width d. Over the four steps below it
    spends ``5^½ - 1 = 1.24`` times that, whereas a clipped signal crosses those steps quickly.
    So clipping is a pile-up at the end, of at least twice what the steps below hold together. A
    signal of few steps has no such shape and is given the benefit of the doubt. With ``sign`` -1
    the minimum is looked at, as the maximum of the signal turned upside down.
    """
    n_at = n_adjacent = 0
    below = low
    for block in _measured(values):
        at = block == sign * high
        n_block = int(np.count_nonzero(at))
        n_at += n_block
        n_adjacent += int(np.count_nonzero(at[1:] & at[:-1])) if n_block else 0
        below = max(below, float(np.max(sign * block, where=~at, initial=low)))
    if n_at < max(_FEWEST_STUCK, CLIPPED_SHARE / 2 * values.size):
        return 0
    step = high - below
    if n_adjacent < _ADJACENT * n_at or high - low < _FEWEST_LEVELS * step:
        return 0
    floor = high - (_LEVELS_BELOW + 0.5) * step
    n_below = sum(int(np.count_nonzero(sign * b > floor)) for b in _measured(values)) - n_at
    return n_at if n_at > _PILE_UP * n_below else 0
