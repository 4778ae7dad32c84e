"""Tests of the elastic modes, and of the stages that have them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import eigh, expm

from models.dynamics.elastic import (
    CLAMPED_ROOT,
    FREE_ROOT,
    ElasticMode,
    Overhang,
    clamped_bending,
    free_bending,
    overhang_mode,
)
from models.dynamics.modal_coordinates import diagonalise, frequency_response
from models.dynamics.plant import INPUTS, closed_loop, closed_loop_modes, structure_state
from models.dynamics.quantities import Number, Point
from models.dynamics.stages import (
    FULL_STAGES,
    HOUSING,
    NOMINAL,
    PLATFORM,
    STAGES,
    Condition,
    build_structure,
    stage_named,
)
from models.dynamics.structure import (
    Body,
    assemble,
    displacement_rows,
    named_modes,
    point_motion,
    undamped_modes,
)
from models.errors import BadParameter

FULL = sorted(FULL_STAGES)
RIGID = sorted(STAGES)


def beam_of_elements(count):
    """Return mass and stiffness of a free beam, E I = ρ A = L = 1, of cubic elements."""
    h = 1 / count
    turn = np.diag([1.0, h, 1.0, h])
    k = np.array([[12, 6, -12, 6], [6, 4, -6, 2], [-12, -6, 12, -6], [6, 2, -6, 4]]) / h**3
    m = np.array([[156, 22, 54, -13], [22, 4, 13, -3], [54, 13, 156, -22], [-13, -3, -22, 4]])
    k, m = turn @ k @ turn, turn @ m @ turn * h / 420
    mass, stiffness = (np.zeros((2 * count + 2, 2 * count + 2)) for _ in range(2))
    for i in range(count):
        at = slice(2 * i, 2 * i + 4)
        mass[at, at] += m
        stiffness[at, at] += k
    return mass, stiffness


def number(value, unit="1"):
    """Return a number of our choice."""
    return Number(value, unit, "our choice")


def without_parts(stage):
    """Return the rigid stage of a name with what makes it flexible but no elastic part."""
    full = FULL_STAGES[f"{stage}-full"].flexible
    assert full is not None
    return replace(STAGES[stage], flexible=replace(full, parts=(), bench_offset=number(0.0, "m")))


def stiffened(stage, factor):
    """Return a stage with elastic parts a factor stiffer."""
    parts = tuple(
        replace(p, stiffness=replace(p.stiffness, value=factor * p.stiffness.value))
        for p in stage.flexible.parts
    )
    return replace(stage, flexible=replace(stage.flexible, parts=parts))


def test_closed_forms_are_those_of_finite_elements():
    """Frequencies and shapes of free and clamped beams are those of forty cubic elements."""
    mass, stiffness = beam_of_elements(40)
    squares, shapes = eigh(stiffness, mass)
    at = np.linspace(-0.5, 0.5, 41)
    assert squares[2] ** 0.25 == pytest.approx(FREE_ROOT, rel=1e-5)
    deflection, slope = free_bending(at)
    found = shapes[:, 2] * np.sign(shapes[0, 2])
    np.testing.assert_allclose(deflection, found[::2], atol=1e-4)
    np.testing.assert_allclose(slope, found[1::2], atol=1e-3)
    squares, shapes = eigh(stiffness[2:, 2:], mass[2:, 2:])
    assert squares[0] ** 0.25 == pytest.approx(CLAMPED_ROOT, rel=1e-5)
    np.testing.assert_allclose(clamped_bending(at + 0.5)[1:], np.abs(shapes[::2, 0]), atol=1e-4)


def test_free_modes_are_orthogonal():
    """Free bending moves neither the centre nor turns about it, and has mean square 1."""
    nodes, weights = np.polynomial.legendre.leggauss(40)
    at, weights = nodes / 2, weights / 2
    rows = [np.ones_like(at), np.sqrt(12) * at, free_bending(at)[0]]
    np.testing.assert_allclose(np.array(rows) * weights @ np.array(rows).T, np.eye(3), atol=1e-10)


@pytest.mark.parametrize(("bends", "parity"), [(0, 1), (0, -1), (2, 1), (2, -1)])
def test_overhang_is_a_chain_of_masses(bends, parity):
    """The momentum of an overhang is that of forty masses that move with its shape."""
    root, reach, mass = (0.02, 0.01, 0.14), 0.3, 6.0
    sizes = number(reach, "m"), number(mass, "kg"), number(1e4, "N m²"), number(0.01)
    place = Point(root, "m", "our choice")
    part = Overhang("load", PLATFORM, 1, bends, parity, place, *sizes)
    centre = np.array([0.01, 0.0, 0.1])
    mode = overhang_mode(part, centre, 1.0)
    expected = np.zeros(6)
    for at in (np.arange(400) + 0.5) / 400:
        for side in (1, -1):
            point = (root[0], root[1] + side * at * reach, root[2])
            moved = np.eye(3)[bends] * clamped_bending(at) * (parity if side < 0 else 1)
            expected += np.sqrt(mass) / 800 * (point_motion(point, tuple(centre)).T @ moved)
    np.testing.assert_allclose(mode.momentum, expected, atol=1e-4)
    heavier = overhang_mode(part, centre, 1.2)
    assert heavier.omega == pytest.approx(mode.omega / np.sqrt(1.2))


def test_more_than_the_body_cannot_move():
    """Elastic modes with more mass than their body raise."""
    momentum = np.array([2.0, 0, 0, 0, 0, 0])
    mode = ElasticMode("loose", 100.0, 0.01, momentum, lambda point: np.zeros(3))
    assemble([Body("box", 4.1, (0.0, 0.0, 0.0), (0.1, 0.1, 0.1), (mode,))], [])
    with pytest.raises(BadParameter, match="elastic modes that move less"):
        assemble([Body("box", 3.9, (0.0, 0.0, 0.0), (0.1, 0.1, 0.1), (mode,))], [])


def test_bending_shows_along_the_feed():
    """A point above the neutral axis of a bent housing moves by the slope along the feed."""
    stage = FULL_STAGES["lms-y-full"]
    bodies = build_structure(stage, Condition(position_mm=80.0)).bodies
    (mode,) = bodies[HOUSING].elastic
    column = 18 + len(bodies[0].elastic)
    x, _, z = bodies[HOUSING].centre
    row = displacement_rows(bodies, HOUSING, (x + 0.1, 0.0, z + 0.02))[:, column]
    step = 1e-6
    low, high = (mode.shape(np.array([0.1 + s, 0.0, 0.0]))[2] for s in (-step, step))
    assert row[0] == pytest.approx(-0.02 * (high - low) / (2 * step), rel=1e-6)
    assert abs(row[0]) > 0.05 * abs(row[2])


@pytest.mark.parametrize("name", RIGID)
def test_without_elastic_parts_a_full_stage_is_the_rigid_one(name):
    """With no parts, in the middle of travel and granite, the loop's matrices are the same."""
    for condition in (NOMINAL, Condition(0.6, 0.5, 27.0, 2.0)):
        full, rigid = (closed_loop(s, condition) for s in (without_parts(name), STAGES[name]))
        for matrix in "abcd":
            np.testing.assert_array_equal(getattr(full, matrix), getattr(rigid, matrix))


@pytest.mark.slow
@pytest.mark.parametrize("name", FULL)
def test_stiff_parts_are_rigid(name):
    """With parts 1e5 times stiffer modes below 300 Hz are those without; control: as they are."""
    stage = stage_named(name)
    assert stage.flexible is not None
    bare = replace(stage, flexible=replace(stage.flexible, parts=()))
    rigid = named_modes(build_structure(bare))
    stiff, soft = (named_modes(build_structure(stiffened(stage, f))) for f in (1e5, 1.0))
    low = np.count_nonzero(rigid.omega < 2 * np.pi * 300.0)
    np.testing.assert_allclose(stiff.omega[:low], rigid.omega[:low], rtol=1e-6)
    assert stiff.names[:low] == rigid.names[:low]
    off = {k: soft.omega[soft.names.index(k)] / rigid.omega[i] for i, k in enumerate(rigid.names)}
    assert max(abs(np.log(off[k])) for k in ("pitch", "vertical")) > 0.01


@pytest.mark.parametrize("name", FULL)
def test_matrices_are_those_of_a_machine(name):
    """M, C and K are symmetric, M is positive, C loses energy, and one motion alone is free."""
    structure = build_structure(stage_named(name), Condition(position_mm=-70.0))
    for matrix in (structure.mass, structure.damping, structure.stiffness):
        np.testing.assert_allclose(matrix, matrix.T, rtol=0, atol=1e-9 * np.abs(matrix).max())
    assert np.linalg.eigvalsh(structure.mass).min() > 0
    scale = 1 / np.sqrt(np.diag(structure.mass))
    lost = np.linalg.eigvalsh(structure.damping * np.outer(scale, scale))
    assert lost.min() > -1e-9 * lost.max()
    omega, shapes = undamped_modes(structure)
    assert omega.size == structure.size - 1
    np.testing.assert_allclose(shapes.T @ structure.mass @ shapes, np.eye(omega.size), atol=1e-8)


@pytest.mark.parametrize("name", FULL)
def test_energy_of_a_decay_is_what_the_dampers_take(name):
    """From a push of the motor to rest, the fall of energy is the work of the dampers."""
    stage = stage_named(name)
    structure = build_structure(stage)
    a, b = structure_state(stage, structure)
    n, step = structure.size, 2e-6
    state, moved = b[:, 12], expm(a * step)
    energy, power = [], []
    for _ in range(2001):
        q, v = state[:n], state[n:]
        energy.append((v @ structure.mass @ v + q @ structure.stiffness @ q) / 2)
        power.append(v @ structure.damping @ v)
        state = moved @ state
    taken = step * (np.sum(power) - (power[0] + power[-1]) / 2)
    assert energy[0] - energy[-1] == pytest.approx(taken, rel=1e-3)
    assert taken > 0.01 * energy[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", FULL)
def test_modes_keep_their_names_along_the_travel(name):
    """From end to end every mode is found, no frequency jumps, and those on the guide move."""
    stage = stage_named(name)
    places = np.linspace(-120.0, 120.0, 25)
    found = [
        {m.name: m.frequency_hz for m in closed_loop_modes(stage, Condition(position_mm=p))}
        for p in places
    ]
    assert all(one.keys() == found[0].keys() for one in found)
    for mode in found[0]:
        track = np.log([one[mode] for one in found])
        assert np.abs(np.diff(track)).max() < 0.05, mode
    moved = {k: np.ptp(np.log([one[k] for one in found])) for k in found[0]}
    assert moved["vertical"] > 0.03 > 0.001 > moved["granite_vertical"]


@pytest.mark.parametrize("name", RIGID)
def test_rigid_stages_are_alike_along_the_travel(name):
    """The position changes nothing of a rigid stage."""
    here, there = (build_structure(STAGES[name], Condition(position_mm=p)) for p in (0.0, 120.0))
    np.testing.assert_array_equal(here.stiffness, there.stiffness)
    np.testing.assert_array_equal(here.mass, there.mass)


def test_payload_moves_the_load_by_its_own_compliance():
    """More payload lowers the bending of the load further than a rigid payload lowers pitch."""
    stage = stage_named("lms-y-full")
    bare, loaded = (
        {m.name: m.frequency_hz for m in closed_loop_modes(stage, Condition(added_payload=kg))}
        for kg in (0.0, 3.0)
    )
    assert loaded["load_pitch"] < 0.97 * bare["load_pitch"]
    assert loaded["load_pitch"] / bare["load_pitch"] < loaded["pitch"] / bare["pitch"]


@pytest.mark.parametrize("name", FULL)
def test_receptance_equals_the_sum_over_undamped_modes(name):
    """Far from resonance the loop's answer to a block force is the modal sum, servo open."""
    stage = stage_named(name)
    structure = build_structure(stage)
    row = displacement_rows(structure.bodies, PLATFORM, stage.acc_feed_point.value)[2]
    omega, shapes = undamped_modes(structure)
    w = 2 * np.pi * 200.0
    statics = np.sum((row @ shapes) ** 2 / (omega**2 - w**2))
    exact = row @ np.linalg.solve(structure.stiffness - w**2 * structure.mass, row)
    assert exact == pytest.approx(statics, rel=1e-6)
    response = frequency_response(diagonalise(closed_loop(stage)), np.array([200.0]))[0]
    assert np.all(np.isfinite(response[:, INPUTS.index("motor_force")]))
