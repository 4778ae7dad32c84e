"""Tests of the disturbances."""

import numpy as np
import pytest

from models.dynamics.plant import INPUTS, NOISE_INPUTS
from models.dynamics.stages import STAGES
from models.recordings.disturbances import (
    LEVELS,
    drawn_orders,
    mains,
    noise_corners,
    noise_levels,
    orders,
)

STAGE = STAGES["lms-y"]
ROUGHNESS = LEVELS["lms-y"].roughness


def test_noise_grows_with_velocity():
    """Friction and roughness follow their powers of velocity, the ground does not care."""
    slow, fast = (noise_levels(STAGE, np.array(v), 20000.0) for v in (0.010, 0.040))
    ratio = dict(zip(NOISE_INPUTS, fast / slow, strict=True))
    assert ratio["block1_x"] == pytest.approx(4 ** LEVELS["lms-y"].friction.power)
    grown = ROUGHNESS.at(np.array(0.040)) / ROUGHNESS.at(np.array(0.010))
    assert ratio["block4_z"] == pytest.approx(grown)
    assert ratio["ground_z"] == pytest.approx(1.0)


def test_slow_and_fast_parts_take_over_from_each_other():
    """At 1 mm/s the slow power of velocity rules, at 400 mm/s the fast one."""
    slow, slower = (ROUGHNESS.at(np.array(v)) for v in (0.001, 0.0005))
    fast, faster = (ROUGHNESS.at(np.array(v)) for v in (0.4, 0.8))
    assert slow / slower == pytest.approx(2**ROUGHNESS.power, rel=0.01)
    assert faster / fast == pytest.approx(2**ROUGHNESS.fast_power, rel=0.01)


def test_noise_follows_a_changing_velocity_sample_by_sample():
    """Levels over time are the levels at each velocity, the same in both directions."""
    velocity = np.array([0.0, 0.010, -0.010, 0.4])
    over_time = noise_levels(STAGE, velocity, 20000.0)
    for i, value in enumerate(velocity):
        np.testing.assert_allclose(over_time[:, i], noise_levels(STAGE, value, 20000.0))


def test_standstill_leaves_ground_and_electronics():
    """Rolling and friction excite nothing at standstill."""
    level = dict(zip(NOISE_INPUTS, noise_levels(STAGE, np.array(0.0), 20000.0), strict=True))
    silent = {name for name, value in level.items() if value == 0}
    assert silent == {name for name in NOISE_INPUTS if name.startswith("block")}


def test_a_density_becomes_the_standard_deviation_of_white_samples():
    """White samples at rate fs with one-sided density d have variance d² fs / 2."""
    level = dict(zip(NOISE_INPUTS, noise_levels(STAGE, np.array(0.010), 20000.0), strict=True))
    density = ROUGHNESS.at(np.array(0.010))
    assert level["block1_z"] ** 2 == pytest.approx(density**2 * 10000.0)
    assert noise_corners(STAGE).shape == (len(NOISE_INPUTS),)


def test_orders_stand_at_velocity_over_wavelength():
    """At 10 mm/s the balls pass at 2.5 Hz and the encoder period at 500 Hz."""
    cycles, inputs, amplitudes = drawn_orders(STAGE, np.random.default_rng(0))
    assert {2.5, 500.0} <= set(np.round(cycles * 0.010, 9))
    assert cycles.shape == inputs.shape == amplitudes.shape
    assert {INPUTS[i] for i in inputs} == {n for order in orders(STAGE) for n in order.inputs}


def test_every_block_hears_the_balls_at_its_own_phase():
    """Four blocks have four phases and one amplitude."""
    cycles, inputs, amplitudes = drawn_orders(STAGE, np.random.default_rng(0))
    at_blocks = np.array([INPUTS[i].startswith("block") for i in inputs])
    ball = amplitudes[np.isclose(cycles, 250.0) & at_blocks]
    assert np.unique(np.round(np.angle(ball), 6)).size == 4
    np.testing.assert_allclose(np.abs(ball), np.abs(ball[0]))


def test_mains_lines_are_multiples_of_fifty_hertz():
    """Every line belongs to the mains and to an accelerometer."""
    for stage in STAGES.values():
        assert all(line.frequency_hz % 50 == 0 for line in mains(stage))
        assert {line.output for line in mains(stage)} == {"acc_feed", "acc_pitch"}
