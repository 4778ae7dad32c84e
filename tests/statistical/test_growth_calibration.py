"""Growth of levels over velocity: slopes cover, and what does not grow is seldom said to.

Logs of noise whose level is a power of the velocity, read in bands that touch no other.
"""

from __future__ import annotations

import numpy as np
from scipy import stats
from studies.readings.growth import COVERAGE, GRID, SIGNIFICANCE, fit, quantile

from lmshealth.signal.acceleration_levels import choose_bands
from tests.claims import Claims
from tests.statistical.evidence import as_often


def test_slopes_over_velocity_cover(rng: np.random.Generator, claims: Claims) -> None:
    """95 % intervals hold the exponent, one in twenty levels without any is said to grow.

    Controls: half the standard deviation.
    """
    bands = choose_bands(None, None, GRID)
    for name, exponent in (("slopes", 0.5), ("said to grow", 0.0)):
        found = [growth for _ in range(claims.trials) for growth in fit(rng, exponent, bands)]
        t = np.array([(growth.slope - exponent) / growth.slope_std for growth in found])
        reach, limit = quantile(found[0]), stats.t.isf(SIGNIFICANCE, found[0].n_logs - 2)
        if exponent:
            hits, wrong = (int(np.sum(np.abs(own) < reach)) for own in (t, 2 * t))
        else:
            hits, wrong = sum(growth.grows is True for growth in found), int(np.sum(2 * t > limit))
        share = COVERAGE if exponent else SIGNIFICANCE
        claims.claim(name, as_often(hits, t.size, share))
        claims.control(name, as_often(wrong, t.size, share))
