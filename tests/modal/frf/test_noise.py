"""Noise over lines: averaged without flattening the resonances of a disturbance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import uniform_filter1d

from lmshealth.modal.frf.responses import smooth_noise

F = np.arange(40.0, 120.0, 0.25)
RESONANCE = 1 / np.abs(62**2 - F**2 + 2j * 0.01 * 62 * F) ** 2


def test_one_line_is_not_averaged() -> None:
    """A width of one gives back what it was given."""
    power = np.random.default_rng(1).exponential(size=F.size)
    np.testing.assert_allclose(smooth_noise(power, RESONANCE, 1), power)


def test_a_resonance_narrower_than_the_average_is_kept() -> None:
    """Noise of sensor and force: within a quarter at the peak, where a plain average loses half."""
    rng = np.random.default_rng(2)
    truth = 1 + 100 * RESONANCE / RESONANCE.max()
    power = truth * rng.exponential(size=(50, F.size))
    peak = int(np.argmax(RESONANCE))
    found = np.mean([smooth_noise(row, RESONANCE, 41)[peak] for row in power])
    assert found == pytest.approx(truth[peak], rel=0.25)
    assert uniform_filter1d(truth, 41)[peak] < 0.5 * truth[peak]


def test_noise_of_the_sensor_alone_stays_flat() -> None:
    """Where no force shakes the machine its resonance leaves no trace in the noise."""
    power = np.random.default_rng(3).exponential(size=F.size)
    found = smooth_noise(power, RESONANCE, 41)
    assert found[int(np.argmax(RESONANCE))] == pytest.approx(1, abs=0.5)


def test_more_lines_than_there_are_is_all_of_them() -> None:
    """A width beyond the band averages over the band; zeros do no harm."""
    found = smooth_noise(np.array([0.0, 1.0, 2.0]), np.ones(3), 41)
    np.testing.assert_allclose(found, 1.0, atol=0.7)
    assert (found > 0).all()
