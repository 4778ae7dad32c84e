"""The set velocity of a log whose set point is a position."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lmshealth._arrays import FloatArray
from lmshealth.io.buffers import Samples, Spool, blocks

# Positions come in steps (1 µm of a printed column, 30 nm of a float32 at 300 mm): the difference
# reaches so far that a step is worth this share of the largest velocity, but never further than
# so many seconds, within which the set point of a stroke changes.
_STEP_SHARE = 2e-4
_LONGEST_REACH = 0.02
# Of the second differences of a position, this share is at most a step and an acceleration.
_QUANTILE = 0.9


def set_velocity(
    position: Samples, pieces: Sequence[tuple[int, int]], sample_rate: float
) -> Samples:
    """Differentiate a set position piece by piece: across a gap the difference means nothing.

    Parameters
    ----------
    position : ndarray or Stored
        In m, shape ``(n_samples,)``.
    pieces : sequence of (int, int)
        Half-open ranges without gaps, ascending.
    sample_rate : float
        In Hz.

    Returns
    -------
    ndarray or Stored
        In m/s, shape ``(n_samples,)``; NaN outside the pieces.
    """
    reach = _reach(position, pieces, sample_rate)
    velocity = Spool()
    for start, stop in pieces:
        _skip(velocity, start)
        for at, block in blocks(position, start, stop):
            low, high = max(start, at - reach), min(stop, at + block.size + reach)
            around = position[low:high]
            index = np.arange(at - low, at - low + block.size)
            # Towards the ends of a piece the difference reaches as far as there are samples.
            after = np.minimum(index + reach, high - low - 1)
            before = np.maximum(index - reach, 0)
            velocity.append((around[after] - around[before]) * sample_rate / (after - before))
    _skip(velocity, position.size)
    return velocity.samples()


def _skip(velocity: Spool, to: int) -> None:
    """Leave the velocity open up to a sample."""
    for _, block in blocks(np.broadcast_to(np.nan, (to,)), velocity.size):
        velocity.append(block)


def _reach(position: Samples, pieces: Sequence[tuple[int, int]], sample_rate: float) -> int:
    """Find how many samples to either side the difference must reach to hide the steps."""
    most = max(1, int(_LONGEST_REACH * sample_rate))
    step = fastest = 0.0
    for start, stop in pieces:
        for _, block in blocks(position, start, stop):
            if block.size > 2 * most:
                step = max(step, _step(block))
                average = (block[most:] - block[:-most]) * sample_rate / most
                fastest = max(fastest, float(np.abs(average).max()))
    if fastest == 0:
        return 1
    return int(np.clip(np.ceil(step * sample_rate / (2 * _STEP_SHARE * fastest)), 1, most))


def _step(block: FloatArray) -> float:
    """Estimate in what steps positions come, in m, from how unevenly they follow each other."""
    uneven = np.abs(np.diff(block, 2))
    # Of a velocity that is a whole number of steps per sample only few differences are uneven.
    apart = np.diff(np.unique(block))
    smallest = float(apart.min()) if apart.size else 0.0
    seen = smallest if float(uneven.max()) > 0.5 * smallest else 0.0
    return max(seen, float(np.quantile(uneven, _QUANTILE)))
