"""Tests of the closed loop and its named modes."""

from dataclasses import replace

import numpy as np
import pytest

from models.errors import UnstableLoop
from models.modal import diagonalise, frequency_response
from models.plant import (
    INPUTS,
    OUTPUTS,
    closed_loop,
    closed_loop_modes,
    participation,
    sensor_rows,
)
from models.servo import TUNINGS, servo_matrices
from models.stages import HOUSING, PLATFORM, STAGES, Condition, build_structure
from models.structure import displacement_rows

BOTH = sorted(STAGES)


def frequencies(stage, *condition):
    """Return mode frequencies (Hz) by name."""
    modes = closed_loop_modes(stage, Condition(*condition))
    return {mode.name: mode.frequency_hz for mode in modes}


@pytest.mark.parametrize("name", BOTH)
def test_response_equals_the_loop_solved_by_hand(name):
    """Motor force to Δe is P / (1 + C P) with the receptance from the second-order matrices."""
    stage = STAGES[name]
    structure = build_structure(stage)
    servo = servo_matrices(TUNINGS[name])
    bodies, point = structure.bodies, stage.motor_point.value
    push = displacement_rows(bodies, PLATFORM, point) - displacement_rows(bodies, HOUSING, point)
    encoder = sensor_rows(stage, structure)["delta_e"]
    for hertz in (3.0, 15.0, 126.0, 300.0):
        s = 2j * np.pi * hertz
        dynamic = structure.mass * s**2 + structure.damping * s + structure.stiffness
        plant = encoder @ np.linalg.solve(dynamic, push[0])
        gain = servo.c @ np.linalg.solve(s * np.eye(servo.b.size) - servo.a, servo.b)
        expected = plant / (1 + TUNINGS[name].force_constant * gain * plant)
        found = frequency_response(diagonalise(closed_loop(stage)), np.array([hertz]))[0]
        value = found[OUTPUTS.index("delta_e"), INPUTS.index("motor_force")]
        assert abs(value / expected - 1) < 1e-6


def test_encoder_error_is_followed_below_the_bandwidth():
    """The loop follows slow encoder errors and leaves fast ones in Δe."""
    diagonal = diagonalise(closed_loop(STAGES["lms-x"]))
    gain = np.abs(frequency_response(diagonal, np.array([0.2, 2000.0])))
    column = gain[:, 0, INPUTS.index("encoder_error")]
    assert column[0] < 0.01
    assert column[1] == pytest.approx(1.0, abs=0.01)


def test_ground_moves_accelerometers_alike_at_low_frequency():
    """Far below the isolators all moves with the ground."""
    diagonal = diagonalise(closed_loop(STAGES["lms-y"]))
    response = frequency_response(diagonal, np.array([0.3]))[0]
    feed = response[OUTPUTS.index("acc_feed"), INPUTS.index("ground_x")]
    pitch = response[OUTPUTS.index("acc_pitch"), INPUTS.index("ground_z")]
    assert abs(feed) == pytest.approx(1.0, abs=0.05)
    assert abs(pitch) == pytest.approx(1.0, abs=0.01)


def test_temperature_lowers_guide_modes():
    """Guide modes of Y lose 8e-4 of their frequency per kelvin."""
    warm, cold = (frequencies(STAGES["lms-y"], 1.0, 1.0, t) for t in (26.0, 16.0))
    for name in ("roll", "pitch", "yaw"):
        assert np.log(warm[name] / cold[name]) / 10 == pytest.approx(-8e-4, rel=0.05)


def test_guide_modes_are_lightly_damped():
    """Guide modes of Y have 1.5 to 2 % damping, granite modes of both 3 to 7 %."""
    for name in BOTH:
        for mode in closed_loop_modes(STAGES[name]):
            if mode.name.startswith("granite"):
                assert 0.03 < mode.damping_ratio < 0.07
            elif mode.name in ("roll", "pitch", "yaw") and name == "lms-y":
                assert 0.015 <= mode.damping_ratio < 0.02


def test_identities_survive_a_crossing():
    """Roll and pitch of Y cross at low preload on a stiff mount and keep their names."""
    stage = STAGES["lms-y"]
    gaps = []
    for preload in np.geomspace(1.0, 0.2, 25):
        found = frequencies(stage, float(preload), 2.0)
        gaps.append(np.log(found["pitch"] / found["roll"]))
    assert gaps[0] > 0 > gaps[-1]
    # A swap of names would put a kink into the gap.
    assert np.abs(np.diff(gaps, 2)).max() < 2e-3


def test_identity_does_not_depend_on_the_way():
    """Shapes followed from the nominal agree with the neighbour's at a step of 1 %."""
    stage = STAGES["lms-y"]
    for preload, mount in ((0.2, 2.2), (2.2, 0.25), (0.2, 0.25), (2.2, 2.2)):
        here = frequencies(stage, preload, mount)
        there = frequencies(stage, preload * 0.99 if preload > 1 else preload * 1.01, mount)
        for name in ("roll", "pitch", "yaw"):
            assert abs(np.log(here[name] / there[name])) < 0.01 / 3


def test_participation_shows_which_sensor_sees_what():
    """Vertical corner sees roll and pitch, the feed signals see pitch and yaw."""
    stage = STAGES["lms-y"]
    seen = {m.name: participation(stage, m) for m in closed_loop_modes(stage)}
    assert seen["roll"]["acc_pitch"] > 0.2
    assert seen["pitch"]["acc_pitch"] > 0.2
    for name in ("pitch", "yaw"):
        assert seen[name]["delta_e"] > 0.2
        assert seen[name]["acc_feed"] > 0.2


def test_unstable_loop_is_refused():
    """Forty times the gain is named unstable, with its growing pole."""
    tuning = replace(TUNINGS["lms-x"], drive_gain=40 * 11630.0)
    with pytest.raises(UnstableLoop, match="lms-x") as caught:
        closed_loop(STAGES["lms-x"], tuning=tuning)
    assert caught.value.growth_per_s > 0
