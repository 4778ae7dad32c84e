"""Tests of the closed loop and its named modes."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from models.dynamics.modal_coordinates import diagonalise, frequency_response
from models.dynamics.plant import INPUTS, OUTPUTS, closed_loop, closed_loop_modes, sensor_rows
from models.dynamics.quantities import Number
from models.dynamics.servo import TUNINGS, controller, current_loop, servo_matrices
from models.dynamics.stages import (
    HOUSING,
    PLATFORM,
    STAGES,
    Condition,
    build_structure,
    tuning_named,
)
from models.dynamics.structure import displacement_rows, named_modes
from models.errors import UnstableLoop

BOTH = sorted(STAGES)


def frequencies(stage, *condition):
    """Return mode frequencies (Hz) by name."""
    modes = closed_loop_modes(stage, Condition(*condition))
    return {mode.name: mode.frequency_hz for mode in modes}


@pytest.mark.slow
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
    """Guide modes of Y have 1.4 to 2 % damping, granite modes of both 4 to 10 %."""
    for name in BOTH:
        for mode in closed_loop_modes(STAGES[name]):
            if mode.name.startswith("granite"):
                assert 0.04 < mode.damping_ratio < 0.10
            elif mode.name in ("roll", "pitch", "yaw") and name == "lms-y":
                assert 0.014 <= mode.damping_ratio < 0.02


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


@pytest.mark.slow
def test_identity_does_not_depend_on_the_way():
    """Shapes followed from the nominal agree with the neighbour's at a step of 1 %."""
    stage = STAGES["lms-y"]
    for preload, mount in ((0.2, 2.2), (2.2, 0.25), (0.2, 0.25), (2.2, 2.2)):
        here = frequencies(stage, preload, mount)
        there = frequencies(stage, preload * 0.99 if preload > 1 else preload * 1.01, mount)
        for name in ("roll", "pitch", "yaw"):
            assert abs(np.log(here[name] / there[name])) < 0.01 / 3


def test_unstable_loop_is_refused():
    """Forty times the gain is named unstable, with its growing pole."""
    tuning = replace(TUNINGS["lms-x"], drive_gain=40 * 11630.0)
    with pytest.raises(UnstableLoop, match="lms-x") as caught:
        closed_loop(STAGES["lms-x"], tuning=tuning)
    assert caught.value.growth_per_s > 0


# Standard deviation of the drift of pitch (ln f) that a tracker reaches over 40 logs of 20 s.
TRACKER_STD = {"lms-x": 1.1e-3, "lms-y": 1.5e-3}
SERVO_IDS = ("commissioning", "retuned")


@pytest.mark.parametrize("name", BOTH)
def test_retuning_moves_pitch_more_than_a_tracker_wanders(name):
    """Retuning moves closed-loop pitch by three of its sigmas at least, roll by a tenth at most."""
    old, new = (frequencies(STAGES[name], 1.0, 1.0, 21.0, 0.0, 1.0, servo) for servo in SERVO_IDS)
    assert abs(np.log(new["pitch"] / old["pitch"])) > 3 * TRACKER_STD[name]
    assert abs(np.log(new["roll"] / old["roll"])) < 0.1 * TRACKER_STD[name]


@pytest.mark.slow
@pytest.mark.parametrize("name", BOTH)
@pytest.mark.parametrize("rigid", [True, False])
def test_retuned_loop_keeps_its_margins(name, rigid):
    """Every crossover keeps 6 dB and 30 degrees, around a rigid platform and the flexible one."""
    stage, tuning = STAGES[name], tuning_named(name, "retuned")
    hertz = np.geomspace(0.05, 8000.0, 8001)
    s = 2j * np.pi * hertz
    gain = controller(tuning)(s, squeeze=True) * current_loop(tuning)(s, squeeze=True)
    if rigid:
        plant: np.ndarray = 1 / (stage.moving_mass.value * s**2)
    else:
        structure = build_structure(stage)
        point, encoder = stage.motor_point.value, sensor_rows(stage, structure)["delta_e"]
        push, held = (displacement_rows(structure.bodies, b, point)[0] for b in (PLATFORM, HOUSING))
        dynamic = (
            structure.mass * s[:, None, None] ** 2
            + structure.damping * s[:, None, None]
            + structure.stiffness
        )
        forces = np.broadcast_to((push - held)[:, None], (s.size, structure.size, 1))
        plant = np.linalg.solve(dynamic, forces)[..., 0] @ encoder
    loop = tuning.force_constant * gain * plant
    crossed = np.flatnonzero(np.diff(np.abs(loop) > 1))
    assert crossed.size >= 1
    assert np.abs(np.degrees(np.angle(-loop[crossed]))).min() >= 30.0
    real = np.flatnonzero(np.diff(loop.imag > 0) & (loop.real[:-1] < 0))
    assert real.size >= 2
    assert np.abs(20 * np.log10(np.abs(loop[real]))).min() >= 6.0


@pytest.mark.parametrize("name", BOTH)
@pytest.mark.parametrize(
    "change",
    [
        {"servo_id": "retuned"},
        {"added_payload": 3.0},
        {"added_payload": -2.0},
        {"guide_damping": 1.5},
        {"guide_preload": 0.5, "mount_stiffness": 0.8, "servo_id": "retuned"},
    ],
)
def test_names_agree_with_the_structure_of_the_condition(name, change):
    """Names followed from the nominal are those that the energies of the damaged structure give."""
    stage, condition = STAGES[name], Condition(**change)
    named = named_modes(build_structure(stage, condition))
    undamped = dict(zip(named.names, named.omega / (2 * np.pi), strict=True))
    for mode in closed_loop_modes(stage, condition):
        assert abs(np.log(mode.frequency_hz / undamped[mode.name])) < 0.03


def test_payload_lowers_every_mode_of_the_platform():
    """Three kilograms more lower roll, pitch and yaw of both stages by 0.5 to 10 %."""
    for name in BOTH:
        bare, loaded = (frequencies(STAGES[name], 1.0, 1.0, 21.0, kg) for kg in (0.0, 3.0))
        for mode in ("roll", "pitch", "yaw"):
            assert 0.005 < np.log(bare[mode] / loaded[mode]) < 0.10


@pytest.mark.parametrize(
    ("name", "field", "factor"),
    [("lms-x", "block_stiffness", 1e-3), ("lms-y", "mount_stiffness", 1e-5)],
)
def test_stiffness_that_the_loop_cannot_hold_is_refused(name, field, factor):
    """Guide or mount so soft that the loop grows are named unstable, with the pole."""
    soft = Number(factor * getattr(STAGES[name], field).value, "N/m", "our choice")
    changed: dict[str, Any] = {field: soft}
    stage = replace(STAGES[name], **changed)
    with pytest.raises(UnstableLoop, match=f"{name}.*unstable") as caught:
        closed_loop(stage)
    assert caught.value.growth_per_s > 0
    with pytest.raises(UnstableLoop):
        closed_loop_modes(stage)
