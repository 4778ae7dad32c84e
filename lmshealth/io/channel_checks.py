"""Checks of channels: missing samples, constant value, clipping, linear dependence."""

from collections.abc import Iterator, Sequence

import numpy as np

from lmshealth._arrays import FloatArray
from lmshealth.io import constants
from lmshealth.io.buffers import BLOCK, Samples, blocks
from lmshealth.io.refusal import Unusable
from lmshealth.io.time_axis import IntArray, too_many


def missing_ranges(values: Samples) -> tuple[IntArray, str]:
    """Find the missing samples (NaN, infinite or absurd) of a channel, ``(n_samples,)`` in SI.

    Return half-open ranges in which every sample is missing, ascending, ``(n_ranges, 2)``, and
    their counts as a text, empty if nothing is missing. `Unusable` (``missing-samples``) where they
    are so many that they would cut the other channels to pieces.
    """
    found = [np.empty(0, dtype=np.int64)]
    for at, block in blocks(values):
        missing = ~(np.abs(block) < constants.LARGEST_MAGNITUDE)
        if missing.any():
            edges = np.diff(missing.view(np.int8), prepend=0, append=0)
            found.append(np.flatnonzero(edges) + at)
    bounds = np.concatenate(found)
    # A range that ends at the edge of a block continues in the next.
    twice = np.flatnonzero(np.diff(bounds) == 0)
    bounds = np.delete(bounds, np.concatenate([twice, twice + 1]))
    ranges: IntArray = bounds.reshape(-1, 2)
    if not ranges.size:
        return ranges, ""
    n_missing, n_ranges = int(np.sum(ranges[:, 1] - ranges[:, 0])), len(ranges)
    note = f"{n_missing} of {values.size} samples are missing (NaN) in {n_ranges} ranges"
    if n_missing > constants.LARGEST_MISSING * values.size or too_many(n_ranges, values.size):
        raise Unusable("missing-samples", note)
    return ranges, note


def check_signal(values: Samples) -> None:
    """Refuse a constant (``flat``) or ``clipped`` channel, ``(n_samples,)`` in SI units."""
    low = min(float(block.min()) for block in _measured(values))
    high = max(float(block.max()) for block in _measured(values))
    if low == high:
        raise Unusable("flat", f"all {values.size} samples are {low:.6g} (SI); check the sensor")
    if high - low < constants.SMALLEST_RANGE:
        found = f"all {values.size} samples are within {high - low:.3g} (SI)"
        raise Unusable("flat", f"{found}; check the sensor and its unit")
    at_high = _stuck(values, low, high, 1.0)
    at_low = _stuck(values, -high, -low, -1.0)
    if at_high + at_low >= constants.CLIPPED_SHARE * values.size:
        found = f"{at_low} samples are at the minimum {low:.6g} and {at_high} at the maximum"
        needed = "widen the range of the sensor"
        raise Unusable("clipped", f"{found} {high:.6g} (SI) of {values.size}; {needed}")


def independent(
    columns: Sequence[Samples], ranges: Sequence[tuple[int, int]], most: int
) -> list[int]:
    """Order channels by what each adds to those before, by a pivoted Cholesky decomposition.

    Columns of ``(n_samples,)`` without missing samples in the half-open ranges. Return the indices
    of at most so many; a channel that the others determine is not among them.
    """
    gram = np.zeros((len(columns), len(columns)))
    for start, stop in ranges:
        for at in range(start, stop, BLOCK):
            part = np.stack([c[at : min(at + constants.COMPARED, stop)] for c in columns])
            part -= part.mean(axis=1, keepdims=True)
            gram += part @ part.T
    scale = np.sqrt(np.diagonal(gram).clip(np.finfo(float).tiny))
    rest = gram / scale[:, None] / scale
    order: list[int] = []
    while len(order) < min(most, len(columns)):
        left = np.diagonal(rest).copy()
        left[order] = -np.inf
        # The first of equals, whatever their rounding.
        best = int(np.argmax(left >= left.max() - 1e-9))
        if left[best] < constants.DEPENDENT:
            break
        order.append(best)
        rest = rest - np.outer(rest[:, best], rest[best]) / left[best]
    return order


def _measured(values: Samples) -> Iterator[FloatArray]:
    """Yield the samples block by block, without the missing ones."""
    for _, block in blocks(values):
        there = np.abs(block) < constants.LARGEST_MAGNITUDE
        if there.all():
            yield block
        elif there.any():
            yield block[there]


def _stuck(values: Samples, low: float, high: float, sign: float) -> int:
    """Count the samples at the maximum that clipping explains (README.md, "Method"), else 0.

    A signal of few steps is accepted. ``sign`` -1 examines the minimum.
    """
    n_at = n_adjacent = 0
    below = low
    for block in _measured(values):
        at = block == sign * high
        n_block = int(np.count_nonzero(at))
        n_at += n_block
        n_adjacent += int(np.count_nonzero(at[1:] & at[:-1])) if n_block else 0
        below = max(below, float(np.max(sign * block, where=~at, initial=low)))
    if n_at < max(constants.FEWEST_STUCK, constants.CLIPPED_SHARE / 2 * values.size):
        return 0
    step = high - below
    if n_adjacent < constants.ADJACENT_SHARE * n_at or high - low < constants.FEWEST_LEVELS * step:
        return 0
    floor = high - (constants.LEVELS_BELOW + 0.5) * step
    n_below = sum(int(np.count_nonzero(sign * b > floor)) for b in _measured(values)) - n_at
    return n_at if n_at > constants.CLIPPING_RATIO * n_below else 0
