"""Mode shapes: motion of the bodies, participation at the sensors, strain energy of the joints."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.dynamics.plant import Mode, sensor_rows
from models.dynamics.stages import NOMINAL, PLATFORM, Condition, Stage, build_structure, corners
from models.dynamics.structure import DIRECTIONS, Structure, displacement_rows, stretch_rows

ComplexArray = NDArray[np.complex128]


def _in_place(stage: Stage, structure: Structure, shape: ComplexArray) -> ComplexArray:
    """Return a shape whose largest displacement is 1 and real.

    The largest along one axis of any body at the four blocks and at the platform's centre of
    gravity.
    """
    bodies = structure.bodies
    places = [*corners(stage.block_half_spacing), bodies[PLATFORM].centre]
    rows = np.vstack([displacement_rows(bodies, i, p) for i in range(len(bodies)) for p in places])
    moved = rows @ shape
    return np.asarray(shape / moved[np.argmax(np.abs(moved))])


def participation(stage: Stage, mode: Mode, condition: Condition = NOMINAL) -> dict[str, float]:
    """Return how much each sensor moves in a mode, as a part of the mode's largest displacement.

    Δe reads a difference of two bodies and may exceed 1.
    """
    structure = build_structure(stage, condition)
    shape = _in_place(stage, structure, mode.shape)
    rows = sensor_rows(stage, structure)
    return {name: float(abs(row @ shape)) for name, row in rows.items()}


def body_motions(
    stage: Stage, mode: Mode, condition: Condition = NOMINAL
) -> dict[str, dict[str, float]]:
    """Return the six motions of each body's centre of gravity while the largest is 1 m.

    Translations in m per m, rotations in rad per m, at the moment of the largest displacement;
    what moves out of phase with it, by damping or by the servo, is left out.
    """
    structure = build_structure(stage, condition)
    rigid = slice(len(DIRECTIONS) * len(structure.bodies))
    motion = _in_place(stage, structure, mode.shape)[rigid].real.reshape(-1, len(DIRECTIONS))
    return {
        body.name: dict(zip(DIRECTIONS, map(float, row), strict=True))
        for body, row in zip(structure.bodies, motion, strict=True)
    }


def strain_energy(
    stage: Stage, mode: Mode, condition: Condition = NOMINAL
) -> dict[str, list[float]]:
    """Return each joint's share of a mode's strain energy, by group in the order of `corners`.

    Elastic modes of bodies are the group ``elastic``, where there are any.  All shares add up to 1:
    the servo's stiffness is no joint.  Half a group's sum is d ln f / d ln k of its stiffness, as
    far as the servo does not matter.
    """
    structure = build_structure(stage, condition)
    energy: dict[str, list[float]] = {}
    for joint in structure.joints:
        stretch = stretch_rows(structure.bodies, joint) @ mode.shape
        stored = float(np.array(joint.stiffness) @ np.abs(stretch) ** 2)
        energy.setdefault(joint.group, []).append(stored)
    if structure.elastic:
        moved = np.abs(mode.shape[-len(structure.elastic) :])
        omega = np.array([part.omega for part in structure.elastic])
        energy["elastic"] = ((omega * moved) ** 2).tolist()
    total = sum(map(sum, energy.values()))
    return {group: [part / total for part in parts] for group, parts in energy.items()}
