"""Dwells of the movable roller: where its measured position rests."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from lmshealth.logs import Log
from lmshealth.segments import Segment

# The position is in volts; it stands where the contract has a displacement.
COLUMN_MAP = """
[columns]
time_s = "3"
acc_low = "0"
acc_high = "1"
delta_e_roller = "2"
[units]
acc_low = 1.0
acc_high = 1.0
delta_e_roller = 1.0
[csv]
skip_rows = 9
delimiter = "\\t"
header = false
"""
# The roller rests where it moves by less than this share of its travel in so many seconds; the
# median over a part of that hides the noise of its sensor.
_STILL, _WHILE, _SMOOTH = 0.01, 0.05, 0.02
_SHORTEST = 0.3


def find_dwells(log: Log) -> list[tuple[Segment, float]]:
    """Find where the roller rests, and at which volts, in order of time."""
    position = next(c.values for c in log.channels if c.name == "delta_e_roller")[:]
    rate = log.sample_rate
    smooth = ndimage.median_filter(position, 2 * round(_SMOOTH * rate / 2) + 1, mode="nearest")
    size = round(_WHILE * rate)
    moved = ndimage.maximum_filter1d(smooth, size) - ndimage.minimum_filter1d(smooth, size)
    still = moved < _STILL * (smooth.max() - smooth.min())
    # Noise may lift single samples over the threshold.
    still = ndimage.binary_closing(still, np.ones(size), border_value=1)
    labels, n = ndimage.label(still)
    found = []
    for where in ndimage.find_objects(labels, n):
        start, stop = where[0].start, where[0].stop
        if stop - start >= _SHORTEST * rate:
            place = float(np.median(position[start:stop]))
            found.append((Segment(start, stop, 0.0), place))
    return found
