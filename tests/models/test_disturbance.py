"""Tests of the disturbances."""

import numpy as np
import pytest

from models.disturbance import noise_levels, order_inputs
from models.plant import INPUTS
from models.stages import STAGES


def test_noise_grows_with_velocity():
    """Friction grows with the root of velocity, the ground does not care."""
    slow, _ = noise_levels(0.010, 20000.0)
    fast, _ = noise_levels(0.040, 20000.0)
    ratio = dict(zip(INPUTS, fast / slow, strict=True))
    assert ratio["block1_x"] == pytest.approx(2.0)
    assert ratio["block4_z"] == pytest.approx(4**0.75)
    assert ratio["ground_z"] == pytest.approx(1.0)


def test_orders_stand_at_velocity_over_wavelength():
    """At 10 mm/s the balls pass at 2.5 Hz and the encoder period at 500 Hz."""
    frequency, amplitudes = order_inputs(STAGES["lms-y"], 0.010, np.random.default_rng(0))
    assert {2.5, 500.0} <= set(np.round(frequency, 9))
    assert amplitudes.shape == (frequency.size, len(INPUTS))
