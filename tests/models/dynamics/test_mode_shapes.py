"""Tests of mode shapes, participation and strain energy."""

import numpy as np
import pytest

from models.dynamics.mode_shapes import body_motions, participation, strain_energy
from models.dynamics.plant import closed_loop_modes
from models.dynamics.stages import NOMINAL, STAGES, Condition
from models.dynamics.structure import DIRECTIONS

BOTH = tuple(STAGES)


def modes(name, condition=NOMINAL):
    """Return the stage and its modes by name."""
    return STAGES[name], {m.name: m for m in closed_loop_modes(STAGES[name], condition)}


@pytest.mark.slow
def test_participation_shows_which_sensor_sees_what():
    """Vertical corner sees roll and pitch, the feed signals see pitch and yaw, Δe hardly roll."""
    stage, found = modes("lms-y")
    seen = {name: participation(stage, mode) for name, mode in found.items()}
    assert seen["roll"]["acc_pitch"] > 0.2
    assert seen["pitch"]["acc_pitch"] > 0.2
    for name in ("pitch", "yaw"):
        assert seen[name]["delta_e"] > 0.2
        assert seen[name]["acc_feed"] > 0.2
    assert seen["roll"]["delta_e"] < 0.1 * seen["pitch"]["delta_e"]


@pytest.mark.parametrize("name", BOTH)
def test_bodies_move_as_their_mode_is_called(name):
    """In roll, pitch and yaw the platform turns mostly about the axis of that name."""
    stage, found = modes(name)
    for mode in ("roll", "pitch", "yaw"):
        motion = body_motions(stage, found[mode])
        assert set(motion) == {"granite", "housing", "platform"}
        turned = {axis: abs(motion["platform"][axis]) for axis in DIRECTIONS[3:]}
        assert max(turned, key=turned.__getitem__) == mode
        assert turned[mode] > 10 * abs(motion["granite"][mode])
    for body in body_motions(stage, found["granite_vertical"]).values():
        assert abs(body["vertical"]) == pytest.approx(1.0, abs=0.3)


@pytest.mark.parametrize("name", BOTH)
def test_energy_shares_are_complete(name):
    """Four joints of each of three groups share all of a mode's strain energy."""
    stage, found = modes(name)
    for mode in found.values():
        shares = strain_energy(stage, mode)
        assert {group: len(parts) for group, parts in shares.items()} == dict.fromkeys(
            ("isolator", "mount", "guide"), 4
        )
        assert sum(map(sum, shares.values())) == pytest.approx(1.0)
        assert min(map(min, shares.values())) >= 0


@pytest.mark.parametrize("group", ["guide", "mount"])
def test_energy_shares_are_the_sensitivities(group):
    """Half of a group's share is d ln f / d ln k of roll, pitch and yaw, to 2 % of a half."""
    step = 0.01
    stage, found = modes("lms-y")
    # A preload moves the guide's stiffness by its power of one third.
    up, down = (
        Condition(guide_preload=np.exp(3 * s))
        if group == "guide"
        else Condition(mount_stiffness=np.exp(s))
        for s in (step, -step)
    )
    above, below = (modes("lms-y", condition)[1] for condition in (up, down))
    for name in ("roll", "pitch", "yaw"):
        slope = np.log(above[name].frequency_hz / below[name].frequency_hz) / (2 * step)
        share = sum(strain_energy(stage, found[name])[group])
        assert slope == pytest.approx(share / 2, abs=0.01)


def test_a_condition_is_seen_in_its_own_structure():
    """A heavier load has another centre: participation is read with it."""
    loaded = Condition(added_payload=3.0)
    stage, found = modes("lms-y", loaded)
    with_load = participation(stage, found["pitch"], loaded)
    assert with_load != participation(stage, found["pitch"])
