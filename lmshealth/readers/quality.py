"""What makes a single channel unusable: too many missing samples, a flat line, clipping."""

from __future__ import annotations

import numpy as np

from lmshealth.arrays import BoolArray, FloatArray
from lmshealth.readers.timeaxis import too_many
from lmshealth.readers.trouble import Unusable

LARGEST_MISSING = 0.10
# No acceleration, position or current reaches this in SI units; its square is still a number.
ABSURD = 1e12

CLIPPED_SHARE = 1e-3
_PILE_UP = 2.0
_LEVELS_BELOW = 4
_FEWEST_LEVELS = 16
_FEWEST_STUCK = 5
_ADJACENT = 0.1


def missing_samples(values: FloatArray) -> tuple[BoolArray, str]:
    """Find the samples of a channel that are no measurements.

    Parameters
    ----------
    values : ndarray
        Samples in SI units, shape ``(n_samples,)``.

    Returns
    -------
    ndarray of bool
        Where a sample is NaN, infinite or absurd, shape ``(n_samples,)``.
    str
        Their counts; empty if nothing is missing.

    Raises
    ------
    Unusable
        With reason ``missing-samples`` when they are too many to work around: other channels
        would be cut to pieces by this one.
    """
    missing = ~(np.abs(values) < ABSURD)
    n_missing = int(np.count_nonzero(missing))
    if not n_missing:
        return missing, ""
    n_stretches = int(missing[0]) + int(np.count_nonzero(missing[1:] & ~missing[:-1]))
    note = f"{n_missing} of {values.size} samples are missing (NaN) in {n_stretches} stretches"
    if n_missing > LARGEST_MISSING * values.size or too_many(n_stretches, values.size):
        raise Unusable("missing-samples", note)
    return missing, note


def check_signal(values: FloatArray) -> None:
    """Refuse a flat or clipped channel.

    Parameters
    ----------
    values : ndarray
        Samples in SI units, none missing, shape ``(n_samples,)``.

    Raises
    ------
    Unusable
        With reason ``flat`` or ``clipped``.
    """
    low, high = float(values.min()), float(values.max())
    if low == high:
        raise Unusable("flat", f"all {values.size} samples are {low:.6g} (SI); check the sensor")
    at_high = _stuck(values, low, high)
    at_low = _stuck(-values, -high, -low)
    if at_high + at_low >= CLIPPED_SHARE * values.size:
        raise Unusable(
            "clipped",
            f"{at_low} samples stand at the minimum {low:.6g} and {at_high} at the maximum "
            f"{high:.6g} (SI) of {values.size}; widen the range of the sensor",
        )


def _stuck(values: FloatArray, low: float, high: float) -> int:
    """Count the samples that a limited range holds at the maximum; 0 where nothing says so.

    Many samples at the maximum alone prove nothing: a sine in steps of an encoder spends
    ``(d / 2A)^½ 2/π`` of its time in its outermost step of width d. Over the four steps below it
    spends ``5^½ - 1 = 1.24`` times that, whereas a clipped signal crosses those steps quickly.
    So clipping is a pile-up at the end, of at least twice what the steps below hold together. A
    signal of few steps has no such shape and is given the benefit of the doubt.
    """
    at = values == high
    n_at = int(np.count_nonzero(at))
    if n_at < max(_FEWEST_STUCK, CLIPPED_SHARE / 2 * values.size):
        return 0
    if np.count_nonzero(at[1:] & at[:-1]) < _ADJACENT * n_at:
        return 0
    step = high - float(values[~at].max())
    if high - low < _FEWEST_LEVELS * step:
        return 0
    n_below = int(np.count_nonzero(values > high - (_LEVELS_BELOW + 0.5) * step)) - n_at
    return n_at if n_at > _PILE_UP * n_below else 0
