"""What all parts of the study share: generators, the test of a whole record, rates."""

from __future__ import annotations

import numpy as np

from lmshealth.io.log import Channel
from lmshealth.signal.segments import Segment
from lmshealth.signal.spectral_lines import find_lines
from studies.common.metrics import clopper_pearson
from studies.harness.study import Row
from studies.line_test.signals import BAND, RATE, Array

SHORT, LONG = 3.0, 30.0
USUAL = 0.01
LEVEL = 0.99


def rng_of(*key: int) -> np.random.Generator:
    """Return the generator of a part."""
    return np.random.default_rng([20261121, *key])


def tested(values: Array, declared: float) -> Array:
    """Test a whole record."""
    channel = Channel("acc", "acceleration", values)
    return find_lines(channel, (Segment(0, values.size, np.nan),), RATE, BAND, declared)


def rated(hits: int, n: int, declared: float) -> Row:
    """Put a rate beside the declared one."""
    low, high = clopper_pearson(hits, n, LEVEL)
    return {"declared": declared, "hits": hits, "n": n, "low": low, "high": high,
            "raised": bool(low > declared)}  # fmt: skip
