"""Tests of the stages' numbers."""

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from models.dynamics.quantities import SOURCES, Number, Point
from models.dynamics.stages import (
    FULL_STAGES,
    PLATFORM,
    STAGES,
    Condition,
    build_structure,
    stage_named,
    tuning_named,
)
from models.dynamics.structure import point_motion
from models.errors import BadParameter, UnknownServo, UnknownStage


def test_every_number_has_unit_and_source():
    """No number of a stage or of an elastic part is without unit or source."""
    owners: list[Any] = [*STAGES.values(), *FULL_STAGES.values()]
    for stage in FULL_STAGES.values():
        assert stage.flexible is not None
        owners += [stage.flexible, *stage.flexible.parts]
    plain = {"name", "identity_suffix", "flexible", "parts"}
    plain |= {"body", "along", "bends", "parity", "moves", "encoder"}
    for owner in owners:
        for field in fields(owner):
            if field.name not in plain:
                entry = getattr(owner, field.name)
                assert isinstance(entry, Number | Point)
                assert entry.unit
                assert entry.source in SOURCES


def test_both_stages_share_one_guide():
    """X and Y have the same blocks at the same places."""
    x, y = STAGES["lms-x"], STAGES["lms-y"]
    for name in ("block_stiffness", "block_lateral_ratio", "block_half_spacing", "guide_loss_time"):
        assert getattr(x, name) == getattr(y, name)


def test_unknown_stage_lists_the_known():
    """An unknown stage raises with the list of those that exist."""
    with pytest.raises(UnknownStage, match="lms-x, lms-y, lms-x-full, lms-y-full") as caught:
        stage_named("lms-z")
    assert caught.value.got == "lms-z"


@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan"), 1e3])
def test_impossible_condition_is_refused(bad):
    """A preload that is no positive fraction raises."""
    with pytest.raises(BadParameter, match="guide_preload"):
        Condition(guide_preload=bad)


def test_unknown_source_is_refused():
    """A number of unstated origin raises."""
    with pytest.raises(BadParameter, match="moving_mass"):
        replace(STAGES["lms-x"], moving_mass=Number(23.5, "kg", "somewhere"))


@pytest.mark.parametrize("bad", [0.0, -1.0])
def test_impossible_elastic_part_is_refused(bad):
    """An elastic part whose stiffness is not positive raises."""
    flexible = FULL_STAGES["lms-x-full"].flexible
    assert flexible is not None
    part = replace(flexible.parts[0], stiffness=Number(bad, "N m²", "our choice"))
    with pytest.raises(BadParameter, match=r"stiffness is .* a positive number"):
        replace(flexible, parts=(part,))


def test_position_beyond_the_travel_is_refused():
    """A position that the platform cannot reach raises."""
    with pytest.raises(BadParameter, match=r"position_mm is 151.*within ±150 mm"):
        Condition(position_mm=151.0)


@pytest.mark.parametrize("field", ["moving_mass", "granite_mass", "block_stiffness", "payload"])
@pytest.mark.parametrize("bad", [-1.0, 0.0, float("nan"), float("inf")])
def test_impossible_mass_or_stiffness_is_refused(field, bad):
    """A mass or stiffness that is not positive raises and is named."""
    unit = getattr(STAGES["lms-y"], field).unit
    with pytest.raises(
        BadParameter, match=f"{field} is .* needed: (a positive number|finite numbers)"
    ):
        changed: dict[str, Any] = {field: Number(bad, unit, "our choice")}
        replace(STAGES["lms-y"], **changed)


@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan"), 1e3])
def test_impossible_damping_is_refused(bad):
    """A guide damping that is no positive fraction raises."""
    with pytest.raises(BadParameter, match="guide_damping"):
        Condition(guide_damping=bad)


def test_unknown_servo_lists_the_known():
    """A servo_id without a tuning raises with the list of those that exist."""
    with pytest.raises(UnknownServo, match="commissioning, retuned") as caught:
        tuning_named("lms-x", "yesterday")
    assert caught.value.got == "yesterday"


@pytest.mark.parametrize(
    ("added", "message"),
    [
        (-21.0, r"payload is -1.0 kg; needed: 0 kg or more"),
        (-19.0, r"added_payload is -19.0 kg; needed: to leave platform a possible inertia"),
    ],
)
def test_payload_that_is_not_there_cannot_be_taken_off(added, message):
    """Less than no payload raises, and so does a block larger than the inertia it is cut from."""
    with pytest.raises(BadParameter, match=message):
        build_structure(STAGES["lms-x"], Condition(added_payload=added))
    with pytest.raises(BadParameter, match="added_payload"):
        Condition(added_payload=float("inf"))


def about_origin(body):
    """Return the (6, 6) mass matrix of a body for motions of the point at the origin."""
    motion = np.eye(6)
    motion[:3] = point_motion(body.centre, (0.0, 0.0, 0.0))
    inertia = np.diag([body.mass] * 3 + [body.mass * r**2 for r in body.radii])
    return motion.T @ inertia @ motion


@pytest.mark.parametrize("name", sorted(STAGES))
@pytest.mark.parametrize("added", [3.0, -2.0])
def test_payload_adds_its_mass_matrix(name, added):
    """Platform with payload has the kinetic energy of the platform plus that of the block."""
    stage = STAGES[name]
    bare, loaded = (
        build_structure(stage, Condition(added_payload=a)).bodies[PLATFORM] for a in (0.0, added)
    )
    x, y, z = stage.payload_box.value
    a, b, c = (float(np.hypot(*edges) / 12**0.5) for edges in ((y, z), (x, z), (x, y)))
    centre = (*bare.centre[:2], stage.payload_height.value)
    block = replace(bare, mass=1.0, centre=centre, radii=(a, b, c))
    expected = about_origin(bare) + added * about_origin(block)
    np.testing.assert_allclose(about_origin(loaded), expected, rtol=1e-12, atol=1e-12)


def test_grease_scales_the_guide_alone():
    """Twice the loss doubles the guide's dampers and touches no spring and no mass."""
    plain, greased = (
        build_structure(STAGES["lms-y"], Condition(guide_damping=d)) for d in (1.0, 2.0)
    )
    np.testing.assert_array_equal(greased.mass, plain.mass)
    np.testing.assert_array_equal(greased.stiffness, plain.stiffness)
    for old, new in zip(plain.joints, greased.joints, strict=True):
        factor = 2.0 if old.group == "guide" else 1.0
        assert new.loss_time == tuple(factor * loss for loss in old.loss_time)
