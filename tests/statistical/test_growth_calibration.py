"""Growth of levels over velocity: slopes cover, and what does not grow is seldom said to.

Logs of noise whose level is a power of the velocity, read in bands that touch no other.
"""

from __future__ import annotations

import numpy as np
from scipy import stats

from lmshealth.signal.readings import (
    FrequencyBand,
    Growth,
    Magnitude,
    choose_bands,
    find_growth,
    read_magnitudes,
)
from models.recordings.strokes import VELOCITIES
from studies.harness.data.logs import make_log
from tests.claims import Claims
from tests.statistical.evidence import as_often

RATE, N = 6400.0, 25_600
# Rows of a grid that no band of the description touches: they are independent of each other.
GRID = (410.0, 600.0)
SIGNIFICANCE, COVERAGE = 0.05, 0.95


def fit(
    rng: np.random.Generator, exponent: float, bands: tuple[FrequencyBand, ...]
) -> tuple[Growth, ...]:
    """Read the growth of one series of logs at the paper's velocities."""
    readings: list[Magnitude] = []
    for velocity in VELOCITIES:
        values = rng.standard_normal(N) * (0.1 * velocity**exponent)
        readings += read_magnitudes(make_log({"acc_feed": values}, RATE, velocity=velocity), bands)
    return find_growth(readings)


def quantile(growth: Growth) -> float:
    """Return Student's quantile of the two-sided interval of a slope."""
    return float(stats.t.ppf((1 + COVERAGE) / 2, growth.n_logs - 2))


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
