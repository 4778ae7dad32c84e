"""Checks of channels: missing samples, constant value, clipping, linear dependence."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lmshealth._private.arrays import FloatArray, IntArray, pivots
from lmshealth.io import constants
from lmshealth.io.buffers import BLOCK, NO_RANGES, Samples, blocks, runs
from lmshealth.io.refusal import Unusable
from lmshealth.io.time_axis import too_many

# Standard deviation of normal noise over the median of its magnitude, and samples of a block from
# which the usual second difference is taken.
_NORMAL, _SAMPLE = 1.4826, 1 << 12
_Ranges = Sequence[tuple[int, int]]


def missing_ranges(values: Samples, added: IntArray = NO_RANGES) -> tuple[IntArray, str]:
    """Find the missing samples (NaN, infinite or absurd) of a channel, ``(n_samples,)`` in SI.

    Return half-open ranges in which every sample is missing, ascending, ``(n_ranges, 2)``, and
    their counts as a text, empty if nothing is missing. `Unusable` (``missing-samples``) where they
    are so many that they would cut the other channels to pieces.
    """
    found = [
        runs(~(np.abs(block) < constants.LARGEST_MAGNITUDE), at) for at, block in blocks(values)
    ]
    bounds = np.concatenate(found, axis=None)
    # A range that ends at the edge of a block continues in the next.
    twice = np.flatnonzero(np.diff(bounds) == 0)
    bounds = np.delete(bounds, np.concatenate([twice, twice + 1]))
    ranges: IntArray = bounds.reshape(-1, 2)
    if not ranges.size:
        return ranges, ""
    n_missing, n_ranges = int(np.sum(ranges[:, 1] - ranges[:, 0])), len(ranges)
    note = f"{n_missing} of {values.size} samples are missing (NaN) in {n_ranges} ranges"
    # Gaps of the time are common to all channels, and were counted there.
    own = n_missing - int(np.sum(added[:, 1] - added[:, 0]))
    many = too_many(n_ranges - len(added), values.size)
    if own > constants.LARGEST_MISSING * values.size or many:
        raise Unusable("missing-samples", note)
    return ranges, note


class Roughness(NamedTuple):
    """Range of a channel, its largest first and second differences, and the usual second one."""

    low: float
    high: float
    step: float  # largest |x_t - x_{t-1}|
    bend: float  # largest |x_{t-1} - 2 x_t + x_{t+1}|
    usual: float  # robust standard deviation of the latter


def roughness(values: Samples) -> Roughness:
    """Measure a channel, ``(n_samples,)``, in one pass; missing samples are left out."""
    low, high, step, bend, usual = np.inf, -np.inf, 0.0, 0.0, [0.0]
    for _, block in blocks(values, overlap=2):
        if np.isnan(block.min(initial=0.0)):
            block = block[np.isfinite(block)]
        low = min(low, float(block.min(initial=low)))
        high = max(high, float(block.max(initial=high)))
        if block.size < 3:
            continue
        first = np.diff(block)
        second = np.diff(first)
        step = max(step, float(first.max()), -float(first.min()))
        bend = max(bend, float(second.max()), -float(second.min()))
        some = np.abs(second[:_SAMPLE])
        usual.append(float(max(_NORMAL * np.median(some), some.mean())))
    return Roughness(low, high, step, bend, float(np.median(usual[1:] or usual)))


def check_signal(values: Samples) -> Roughness:
    """Refuse a constant (``flat``) or ``clipped`` channel, ``(n_samples,)`` in SI units."""
    rough = roughness(values)
    low, high = rough.low, rough.high
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
    return rough


def independent(columns: Sequence[Samples], ranges: _Ranges, most: int) -> list[int]:
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
    return pivots(gram / scale[:, None] / scale, most, least=constants.DEPENDENT)


def magnitudes(columns: Sequence[Samples], ranges: _Ranges) -> dict[int, list[int]]:
    """Find channels that are the magnitude of others, each with the indices of these.

    With r = (x² + y² + z²)^½ - g the square of r is linear in r, x², y² and z², which have equal
    weights. Arguments as in `independent`, in one unit.
    """
    found: dict[int, list[int]] = {}
    start, stop = max(ranges, key=lambda one: one[1] - one[0])
    if len(columns) < 3 or stop - start < constants.FEWEST_FOR_SHAPE:
        return found
    x = np.stack([c[start : min(start + constants.COMPARED, stop)] for c in columns])
    x = x / np.abs(x).max().clip(np.finfo(float).tiny)
    for k, r in enumerate(x):
        rest = [j for j in range(len(x)) if j != k]
        weights, unexplained = _regression([*x[rest] ** 2, r], r**2)
        if unexplained < min(constants.MAGNITUDE, 0.1 * _regression(x[rest], r)[1]):
            own = weights[: len(rest)]
            axes = own > own.max() / 2
            if axes.sum() > 1 and own[axes].min() > 0.95 * own.max():
                found[k] = [j for j, is_axis in zip(rest, axes, strict=True) if is_axis]
    return found


def _regression(
    columns: Sequence[FloatArray] | FloatArray, target: FloatArray
) -> tuple[FloatArray, float]:
    """Regress on columns ``(n,)`` and a constant; return weights and the unexplained share."""
    design = np.stack([c - c.mean() for c in columns], axis=1)
    centred = target - target.mean()
    weights = np.linalg.lstsq(design, centred, rcond=1e-12)[0]
    total = float(centred @ centred)
    rest = centred - design @ weights
    return weights, float(rest @ rest) / total if total else 1.0


def _stuck(values: Samples, low: float, high: float, sign: float) -> int:
    """Count the samples at the maximum that clipping explains (README.md, "Method"), else 0.

    A signal of few steps is accepted. ``sign`` -1 examines the minimum.
    """
    n_at = n_adjacent = 0
    below = low
    for _, block in blocks(values):
        block = block[np.isfinite(block)]
        at = block == sign * high
        n_at += int(np.count_nonzero(at))
        n_adjacent += int(np.count_nonzero(at[1:] & at[:-1]))
        below = max(below, float(np.max(sign * block, where=~at, initial=low)))
    if n_at < max(constants.FEWEST_STUCK, constants.CLIPPED_SHARE / 2 * values.size):
        return 0
    step = high - below
    if n_adjacent < constants.ADJACENT_SHARE * n_at or high - low < constants.FEWEST_LEVELS * step:
        return 0
    floor = high - (constants.LEVELS_BELOW + 0.5) * step
    n_below = sum(int(np.count_nonzero(sign * b > floor)) for _, b in blocks(values)) - n_at
    return n_at if n_at > constants.CLIPPING_RATIO * n_below else 0
