"""Tests of rigid bodies and springs."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from models.dynamics.quantities import Number
from models.dynamics.stages import PLATFORM, STAGES, Condition, build_structure, stage_named
from models.dynamics.structure import (
    GROUND,
    Body,
    Joint,
    assemble,
    displacement_rows,
    energy_shares,
    named_modes,
    rigid_translation,
    undamped_modes,
)
from models.errors import BadParameter

BOTH = sorted(STAGES)


def turned_together(bodies, axis):
    """Return the motion of all bodies turning together about an axis through the origin."""
    spin = np.eye(3)[axis]
    parts = [np.concatenate([np.cross(spin, body.centre), spin]) for body in bodies]
    return np.concatenate(parts)


@pytest.mark.parametrize("name", BOTH)
def test_matrices_are_symmetric_and_mass_adds_up(name):
    """M, C and K are symmetric, M is positive, and a common motion carries the whole mass."""
    structure = build_structure(stage_named(name))
    for matrix in (structure.mass, structure.damping, structure.stiffness):
        np.testing.assert_allclose(matrix, matrix.T, rtol=0, atol=1e-9 * np.abs(matrix).max())
    assert np.linalg.eigvalsh(structure.mass).min() > 0
    together = rigid_translation(structure)
    total = sum(body.mass for body in structure.bodies)
    np.testing.assert_allclose(together.T @ structure.mass @ together, total * np.eye(3))


@pytest.mark.parametrize("name", BOTH)
def test_common_motion_strains_only_the_isolators(name):
    """Without isolators the stage turns and shifts as a whole at no energy."""
    structure = build_structure(stage_named(name))
    inner = assemble(structure.bodies, [j for j in structure.joints if j.group != "isolator"])
    motions = [*rigid_translation(structure).T]
    motions += [turned_together(structure.bodies, axis) for axis in range(3)]
    for motion in motions:
        energy = motion @ inner.stiffness @ motion
        assert abs(energy) < 1e-9 * np.abs(inner.stiffness).max()
        assert motion @ structure.stiffness @ motion > 1e5


@pytest.mark.parametrize("name", BOTH)
def test_only_the_feed_is_free(name):
    """Of 18 motions one costs no energy: the platform along its guide."""
    structure = build_structure(stage_named(name))
    omega, _ = undamped_modes(structure)
    assert omega.size == 17
    slide = np.zeros(18)
    slide[6 * PLATFORM] = 1.0
    np.testing.assert_allclose(structure.stiffness @ slide, 0.0, atol=1e-6)


def test_static_deflection_is_springs_in_series():
    """A central vertical load sinks by the sum of the three joints' compliances."""
    stage = stage_named("lms-y")
    structure = build_structure(stage)
    row = displacement_rows(structure.bodies, PLATFORM, (0.0, 0.0, 0.0))[2]
    moved = np.linalg.lstsq(structure.stiffness, row, rcond=1e-14)[0]
    stiffnesses = (stage.block_stiffness, stage.mount_stiffness, stage.isolator_vertical)
    expected = sum(1 / (4 * k.value) for k in stiffnesses)
    assert row @ moved == pytest.approx(expected, rel=1e-6)


def test_single_body_oracle():
    """One body on one spring has the textbook frequency and damping."""
    body = Body("lump", 2.0, (0.0, 0.0, 0.0), (0.1, 0.1, 0.1))
    joint = Joint("only", GROUND, 0, (0.0, 0.0, 0.0), (800.0, 0.0, 0.0), (1e-3, 0.0, 0.0))
    structure = assemble([body], [joint])
    omega, shapes = undamped_modes(structure)
    np.testing.assert_allclose(omega, [20.0])
    np.testing.assert_allclose(np.abs(shapes[0, 0]), 1 / np.sqrt(2.0))
    assert structure.damping[0, 0] == pytest.approx(0.8)


@pytest.mark.parametrize("name", BOTH)
def test_receptance_is_reciprocal(name):
    """Force at one block and motion at another may change places."""
    structure = build_structure(stage_named(name))
    first = displacement_rows(structure.bodies, PLATFORM, (0.05, 0.06, 0.0))[2]
    second = displacement_rows(structure.bodies, PLATFORM, (-0.05, 0.06, 0.02))[1]
    w = 2 * np.pi * 120.0
    dynamic = structure.stiffness + 1j * w * structure.damping - w**2 * structure.mass
    one, other = first @ np.linalg.solve(dynamic, second), second @ np.linalg.solve(dynamic, first)
    assert abs(one - other) < 1e-9 * abs(one)


def test_hertz_exponent_and_mount_factor():
    """Guide springs grow with preload to the 1/3, mount springs with their factor."""
    stage = stage_named("lms-y")
    base = build_structure(stage)
    changed = build_structure(stage, Condition(0.5, 0.7))
    factors = {"guide": 0.5 ** (1 / 3), "mount": 0.7, "isolator": 1.0}
    for before, after in zip(base.joints, changed.joints, strict=True):
        expected = np.array(before.stiffness) * factors[before.group]
        np.testing.assert_allclose(after.stiffness, expected, rtol=1e-12)


def test_strain_energy_gives_the_sensitivities():
    """Half a mode's share of strain energy in a joint group is d ln f / d ln k of the group."""
    stage = stage_named("lms-y")
    structure = build_structure(stage)
    named = named_modes(structure)
    mode = named.names.index("roll")
    share = energy_shares(structure, "mount", named.shapes, named.omega)[:, mode].sum()
    step = 1e-4
    up, down = (
        undamped_modes(build_structure(stage, Condition(1.0, float(np.exp(sign * step)))))[0][mode]
        for sign in (1, -1)
    )
    assert np.log(up / down) / (2 * step) == pytest.approx(share / 2, rel=1e-5)


@pytest.mark.parametrize("name", BOTH)
def test_strain_energy_shares_add_up(name):
    """The shares of all joints and directions of a mode sum to one."""
    structure = build_structure(stage_named(name))
    omega, shapes = undamped_modes(structure)
    groups = ("guide", "mount", "isolator")
    total = sum(energy_shares(structure, g, shapes, omega).sum(axis=0) for g in groups)
    np.testing.assert_allclose(total, 1.0, rtol=1e-7)


def test_names_are_unique():
    """Seventeen modes have seventeen names, roll, pitch and yaw among them."""
    for stage in STAGES.values():
        names = named_modes(build_structure(stage)).names
        assert len(set(names)) == 17
        assert {"roll", "pitch", "yaw", "granite_feed", "granite_yaw"} <= set(names)


def test_body_without_inertia_is_refused():
    """A body of zero mass raises and names the body."""
    with pytest.raises(BadParameter, match="lump"):
        Body("lump", 0.0, (0.0, 0.0, 0.0), (0.1, 0.1, 0.1))


def test_bodies_that_cannot_be_are_refused():
    """A moment of inertia above the sum of the other two belongs to no distribution of mass."""
    Body("plate", 1.0, (0.0, 0.0, 0.0), (3.0, 4.0, 5.0))
    with pytest.raises(BadParameter, match=r"radii of gyration of rod.*sum of the other two"):
        Body("rod", 1.0, (0.0, 0.0, 0.0), (0.3, 0.1, 0.1))


def test_spreads_always_make_a_possible_body():
    """Any three spreads give radii of gyration that a distribution of mass can have."""
    rng = np.random.default_rng(0)
    for spreads in np.exp(rng.normal(-2, 2, (200, 3))):
        numbers: dict[str, Any] = dict(
            zip(
                ("load_spread_feed", "load_spread_lateral", "load_spread_vertical"),
                (Number(float(s), "m", "our choice") for s in spreads),
                strict=True,
            )
        )
        build_structure(replace(STAGES["lms-y"], **numbers))
