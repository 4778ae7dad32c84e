"""Tests of the forces that depend on the motion, inside the loop."""

from dataclasses import replace

import numpy as np
import pytest

from models.dynamics.modal_coordinates import propagate
from models.dynamics.plant import CONTACTS, INPUTS, OUTPUTS
from models.dynamics.stages import NOMINAL, stage_named, tuning_named
from models.errors import BadParameter
from models.recordings import feedback
from models.recordings.effects import LINEAR, Effects, FrictionParameters
from models.recordings.feedback import follow
from models.recordings.recording import shaken as shaken_loop
from models.recordings.recording import simulate_signals
from models.recordings.strokes import commanded
from models.recordings.sweep import Sweep, record_sweep

STAGE = stage_named("lms-y-full")
RATE = 20000.0
NOTHING = (np.zeros(0), np.zeros(0, dtype=np.intp), np.zeros(0, dtype=complex))
RUBBING = Effects(friction=FrictionParameters())


def shaken(samples=3000, seed=0):
    """Return linear outputs (output + contact, time) of a stage that is shaken along the feed."""
    time = np.arange(samples) / RATE
    outputs = np.zeros((len(OUTPUTS) + len(CONTACTS), samples))
    wave = 20e-6 * np.sin(2 * np.pi * 15 * time) + 2e-6 * np.sin(2 * np.pi * 170 * time + seed)
    outputs[0], outputs[4:] = wave, wave
    return outputs


def followed(effects, outputs, velocity=0.0, drawn=NOTHING):
    """Return outputs with the part of the motion's forces, and the forces."""
    samples = outputs.shape[1]
    moves = np.vstack([velocity * np.arange(samples) / RATE, np.full(samples, velocity)])
    changed = outputs.copy()
    forces = follow(STAGE, NOMINAL, effects, changed, moves, drawn, 1.0, RATE)
    return changed, forces


def test_compiled_is_python(monkeypatch):
    """The compiled loop is the one that stands there."""
    effects = replace(RUBBING, peak_current=0.01)
    compiled = followed(effects, shaken(200))
    monkeypatch.setattr(feedback, "advance", feedback.advance.py_func)
    python = followed(effects, shaken(200))
    for one, other in zip(compiled, python, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9 * np.abs(other).max())


def test_the_compiled_linear_part_is_the_one_of_filters():
    """Outputs and last states of `propagate`, also across chunks."""
    diagonal = shaken_loop(STAGE, NOMINAL, RUBBING)
    rng = np.random.default_rng(3)
    inputs = rng.standard_normal((diagonal.b.shape[1], 9000))
    state = np.zeros(diagonal.poles.size, dtype=complex)
    for part in (inputs[:, :100], inputs[:, 100:]):
        one, first = propagate(diagonal, state, part, RATE)
        other, state = feedback.propagate_compiled(diagonal, state, part, RATE)
        np.testing.assert_allclose(other, one, atol=1e-10 * np.abs(one).max())
        half = np.flatnonzero(first)
        np.testing.assert_allclose(
            state[half], first[half], rtol=1e-7, atol=1e-9 * np.abs(first).max()
        )


def test_chunks_join(monkeypatch):
    """A record in chunks is the record as a whole."""
    whole = followed(RUBBING, shaken())
    monkeypatch.setattr(feedback, "_CHUNK", 700)
    for one, other in zip(followed(RUBBING, shaken()), whole, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9 * np.abs(other).max())


@pytest.mark.parametrize("velocity", [0.01, -0.2])
def test_steady_sliding_costs_current(velocity):
    """Without disturbances the loop rests in steady sliding, and the current carries friction."""
    law = FrictionParameters(cable_spring=0.0)
    still = np.zeros((9, 2000))
    outputs, forces = followed(Effects(friction=law), still, velocity)
    slow = (law.stiction - 1) * np.exp(-abs(velocity) / law.stribeck_velocity)
    friction = STAGE.friction.value * (1 + slow) + law.cable_drag + law.viscous * abs(velocity)
    np.testing.assert_allclose(forces[:, :5].sum(axis=1), -np.sign(velocity) * friction, rtol=1e-9)
    constant = tuning_named(STAGE.name, "commissioning").force_constant
    expected = np.sign(velocity) * friction / constant
    np.testing.assert_allclose(outputs[OUTPUTS.index("current")], expected, rtol=1e-6)
    assert np.abs(outputs[0]).max() < 1e-12


def test_the_drive_saturates():
    """Beyond its peak current the motor gets the peak's force; below it nothing changes."""
    outputs = shaken()
    outputs[1] = 3.0 * np.sin(2 * np.pi * 40 * np.arange(3000) / RATE)
    limited, forces = followed(Effects(peak_current=2.0), outputs)
    constant = tuning_named(STAGE.name, "commissioning").force_constant
    current = limited[1]
    wanted = constant * (np.clip(current, -2.0, 2.0) - current)
    # The current of a sample is that before the force of the sample has changed it.
    np.testing.assert_allclose(forces[:, 4], wanted, atol=1e-3 * np.abs(wanted).max())
    assert np.abs(wanted).max() > 5.0
    same, none = followed(Effects(peak_current=10.0), outputs)
    np.testing.assert_allclose(same, outputs, atol=1e-12)
    assert not none.any()


def test_orders_follow_the_place():
    """A platform that is off its reference meets cogging and encoder error where it is."""
    drawn = (
        np.array([1 / 0.024, 1 / 20e-6]),
        np.array([INPUTS.index("motor_force"), INPUTS.index("encoder_error")]),
        np.array([0.5 + 0.2j, 1e-8j]),
    )
    outputs, effects = np.zeros((9, 400)), Effects(at_place=True)
    outputs[0] = 3e-6
    _, forces = followed(effects, outputs, velocity=0.01, drawn=drawn)
    place = 0.01 * np.arange(400) / RATE
    for column, cycles, amplitude in zip((4, 5), drawn[0], drawn[2], strict=True):
        wave = [(amplitude * np.exp(2j * np.pi * cycles * x)).real for x in (place, place + 3e-6)]
        expected = wave[1] - wave[0]
        # What these forces do to the error in turn is small.
        np.testing.assert_allclose(forces[:, column], expected, atol=5e-3 * np.abs(expected).max())
    assert not followed(Effects(at_place=False, peak_current=9.0), outputs, 0.01, drawn)[1].any()


@pytest.mark.parametrize(("velocity", "least", "most"), [(0.001, 0.5, 5.0), (0.1, 0.0, 0.05)])
def test_a_sweep_may_turn_back_where_friction_is_simulated(velocity, least, most):
    """At 1 mm/s a sweep of 0.4 A turns the stage back, and friction changes the response."""
    sweep = Sweep(10.0, 60.0, amplitude=0.4, period=1.0)
    effects = (RUBBING, Effects(friction=FrictionParameters(scale=0.0)))
    strong, weak = (
        record_sweep(
            STAGE, sweep, seconds=1.0, velocity=velocity, rng=np.random.default_rng(1), effects=one
        )
        .columns["delta_e_um"]
        .astype(float)
        for one in effects
    )
    assert least <= np.std(strong - weak) / np.std(weak) < most
    with pytest.raises(BadParameter, match="never turns back"):
        record_sweep(STAGE, sweep, seconds=1.0, velocity=0.001, rng=np.random.default_rng(1))


def test_a_stroke_leaves_the_friction_that_its_feedforward_misses():
    """Feedforward with the law of friction halves the error of a start, against none."""
    time = np.arange(4000) / RATE
    path = 0.05 * np.maximum(time - 0.05, 0.0) ** 2
    speed, acceleration = 0.1 * np.maximum(time - 0.05, 0.0), 0.1 * (time > 0.05)
    reference = np.vstack([path, speed, acceleration, np.zeros(time.size)])
    errors = []
    for compensation in (STAGE.friction_compensation.value, 0.0):
        number = replace(STAGE.friction_compensation, value=compensation)
        stage = replace(STAGE, friction_compensation=number)
        outputs = commanded(stage, NOMINAL, reference, NOTHING, RUBBING)
        follow(stage, NOMINAL, RUBBING, outputs, reference[:2], NOTHING, 1.0, RATE)
        errors.append(np.abs(outputs[0]).max())
    assert errors[0] < 0.5 * errors[1]


def test_signals_with_and_without_friction_differ_where_it_turns_round_only():
    """At 10 mm/s friction hardly changes the signals; at rest with the same noise it holds."""
    signals = [
        simulate_signals(
            STAGE,
            NOMINAL,
            seconds=1.0,
            velocity=0.01,
            rng=np.random.default_rng(2),
            effects=effects,
        )
        for effects in (LINEAR, Effects(friction=FrictionParameters(cable_spring=0.0)))
    ]
    for row in (0, 2, 3):
        assert np.std(signals[1][row] - signals[0][row]) < 0.3 * np.std(signals[0][row])
