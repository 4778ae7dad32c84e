"""Rigid bodies joined by springs at points: mass, damping and stiffness matrices, named modes.

Coordinates are the six motions (x, y, z, roll, pitch, yaw) of each body's centre of gravity,
relative to the ground, bodies in the order of the argument; then the elastic modes of each body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.optimize import linear_sum_assignment

from models.dynamics.elastic import ElasticMode
from models.errors import BadParameter

Array = NDArray[np.float64]

GROUND = -1
DIRECTIONS = ("feed", "lateral", "vertical", "roll", "pitch", "yaw")
# A free motion has a computed ω² of rounding size, never exactly zero.
_FREE_BELOW_RAD_S = 2 * np.pi * 0.5


@dataclass(frozen=True, slots=True)
class Body:
    """A body: mass (kg), centre of gravity (m), radii of gyration about x, y, z (m), elastic modes.

    Without elastic modes it is rigid.
    """

    name: str
    mass: float
    centre: tuple[float, float, float]
    radii: tuple[float, float, float]
    elastic: tuple[ElasticMode, ...] = ()

    def __post_init__(self) -> None:
        """Reject a body without inertia, or with moments that no distribution of mass has."""
        if self.mass <= 0 or min(self.radii) <= 0:
            raise BadParameter(f"body {self.name}", (self.mass, self.radii), "positive inertia")
        moments = sorted(radius**2 for radius in self.radii)
        # A thin plate has equality, here with room for rounding.
        if moments[2] > (moments[0] + moments[1]) * (1 + 1e-9):
            needed = "no moment of inertia above the sum of the other two"
            raise BadParameter(f"radii of gyration of {self.name}", self.radii, needed)


@dataclass(frozen=True, slots=True)
class Joint:
    """Three springs and dampers at a point between two bodies.

    Parameters
    ----------
    group
        Joints of one group (``guide``, ``mount``, ``isolator``) act together.
    lower, upper
        Indices of the joined bodies, or `GROUND`.
    point
        Where the springs act, m.
    stiffness
        Along x, y, z, N/m.
    loss_time
        Viscous coefficient over stiffness along x, y, z, s.
    """

    group: str
    lower: int
    upper: int
    point: tuple[float, float, float]
    stiffness: tuple[float, float, float]
    loss_time: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Structure:
    """Assembled bodies and joints; the matrices have shape (dof, dof), SI."""

    bodies: tuple[Body, ...]
    joints: tuple[Joint, ...]
    mass: Array
    damping: Array
    stiffness: Array

    @property
    def size(self) -> int:
        """Count of degrees of freedom."""
        return len(self.mass)

    @property
    def elastic(self) -> tuple[ElasticMode, ...]:
        """The elastic modes in the order of their coordinates, the last of the structure."""
        return tuple(mode for body in self.bodies for mode in body.elastic)


@dataclass(frozen=True, slots=True)
class NamedShapes:
    """Undamped modes: names, natural frequencies (rad/s), shapes (dof, mode) with unit mass."""

    names: tuple[str, ...]
    omega: Array
    shapes: Array


def point_motion(point: Sequence[float], centre: Sequence[float]) -> Array:
    """Return the (3, 6) matrix from a body's motion to the displacement of one of its points."""
    x, y, z = (p - c for p, c in zip(point, centre, strict=True))
    # u = t + θ × r, written out column by column.
    return np.array(
        [[1.0, 0, 0, 0, z, -y], [0, 1.0, 0, -z, 0, x], [0, 0, 1.0, y, -x, 0]], dtype=float
    )


def degrees_of_freedom(bodies: Sequence[Body]) -> int:
    """Return the count of coordinates of bodies: six each, and one per elastic mode."""
    return 6 * len(bodies) + sum(len(body.elastic) for body in bodies)


def displacement_rows(bodies: Sequence[Body], body: int, point: Sequence[float]) -> Array:
    """Return (3, dof) rows that read the displacement of a point of a body (ground: zeros)."""
    rows = np.zeros((3, degrees_of_freedom(bodies)))
    if body != GROUND:
        rows[:, 6 * body : 6 * body + 6] = point_motion(point, bodies[body].centre)
        arm = np.subtract(point, bodies[body].centre)
        first = degrees_of_freedom(bodies[:body]) + 6 * len(bodies[body:])
        for i, mode in enumerate(bodies[body].elastic):
            rows[:, first + i] = mode.shape(arm)
    return rows


def stretch_rows(bodies: Sequence[Body], joint: Joint) -> Array:
    """Return (3, dof) rows that read the stretch of a joint, upper minus lower body."""
    return displacement_rows(bodies, joint.upper, joint.point) - displacement_rows(
        bodies, joint.lower, joint.point
    )


def assemble(bodies: Sequence[Body], joints: Sequence[Joint]) -> Structure:
    """Assemble mass, damping and stiffness matrices of joined bodies.

    Raises
    ------
    BadParameter
        If the elastic modes of a body move more mass than it has.
    """
    size = degrees_of_freedom(bodies)
    mass, damping, stiffness = (np.zeros((size, size)) for _ in range(3))
    elastic = 6 * len(bodies)
    for i, body in enumerate(bodies):
        inertia = [body.mass] * 3 + [body.mass * r**2 for r in body.radii]
        rigid = slice(6 * i, 6 * i + 6)
        mass[rigid, rigid] = np.diag(inertia)
        for mode in body.elastic:
            mass[rigid, elastic] = mass[elastic, rigid] = mode.momentum
            mass[elastic, elastic] = 1.0
            damping[elastic, elastic] = 2 * mode.damping_ratio * mode.omega
            stiffness[elastic, elastic] = mode.omega**2
            elastic += 1
        moved = sum(np.outer(mode.momentum, mode.momentum) for mode in body.elastic)
        rest = float(np.linalg.eigvalsh(np.diag(inertia) - moved)[0])
        if not rest > 0:
            needed = "elastic modes that move less than its mass and inertia"
            raise BadParameter(f"body {body.name}", f"{rest:.3g} without them", needed)
    for joint in joints:
        rows = stretch_rows(bodies, joint)
        k = np.array(joint.stiffness)
        stiffness += rows.T @ (k[:, None] * rows)
        damping += rows.T @ ((k * np.array(joint.loss_time))[:, None] * rows)
    for matrix in (mass, damping, stiffness):
        matrix.setflags(write=False)
    return Structure(tuple(bodies), tuple(joints), mass, damping, stiffness)


def rigid_translation(structure: Structure) -> Array:
    """Return the (dof, 3) motion of all bodies together along x, y and z."""
    rigid = np.tile(np.vstack([np.eye(3), np.zeros((3, 3))]), (len(structure.bodies), 1))
    return np.vstack([rigid, np.zeros((structure.size - len(rigid), 3))])


def _group_energy(structure: Structure, group: str, shapes: Array) -> Array:
    """Return twice the strain energy of a group, split by direction: (6, mode).

    Its joints sit symmetrically and are equal, so that the six motions of one body against the
    other at the group's centre do not couple: the energy is a plain sum over directions.
    """
    joints = [j for j in structure.joints if j.group == group]
    centre = np.mean([j.point for j in joints], axis=0)
    rigid = 6 * len(structure.bodies)
    motion = np.zeros((6, structure.size))
    for body, sign in ((joints[0].upper, 1.0), (joints[0].lower, -1.0)):
        if body == GROUND:
            continue
        block = np.eye(6)
        block[:3] = point_motion(tuple(centre), structure.bodies[body].centre)
        motion[:, 6 * body : 6 * body + 6] += sign * block
    # Of an elastic mode the motion that fits the stretch of all joints best.
    points = np.vstack([point_motion(j.point, tuple(centre)) for j in joints])
    stretch = np.vstack([stretch_rows(structure.bodies, j)[:, rigid:] for j in joints])
    motion[:, rigid:] = np.linalg.pinv(points) @ stretch
    stiffness = np.zeros(6)
    for joint in joints:
        rows = point_motion(joint.point, tuple(centre))
        stiffness += np.einsum("i,ij,ij->j", np.array(joint.stiffness), rows, rows)
    return np.asarray(stiffness[:, None] * (motion @ shapes) ** 2)


def energy_shares(structure: Structure, group: str, shapes: Array, omega: Array) -> Array:
    """Return each direction's share of a mode's strain energy in one joint group, (6, mode).

    Half of the sum over directions is d ln f / d ln k of the group.
    """
    return _group_energy(structure, group, shapes) / omega**2


def undamped_modes(structure: Structure) -> tuple[Array, Array]:
    """Return natural frequencies (rad/s) and unit-mass shapes without damping, free ones left out.

    Returns
    -------
    omega : (mode,) rad/s, ascending
    shapes : (dof, mode)
    """
    squares, shapes = eigh(structure.stiffness, structure.mass)
    omega = np.sqrt(np.maximum(squares, 0.0))
    keep = omega > _FREE_BELOW_RAD_S
    return omega[keep], shapes[:, keep]


def named_modes(structure: Structure) -> NamedShapes:
    """Name the undamped modes by where their strain energy sits.

    Isolator modes are ``granite_<direction>``.  Guide and mount act in series, hence share a
    direction's energy: of its two modes the lower is the platform's on the guide
    (``<direction>``), the upper the housing's on the mount (``housing_<direction>``).  An elastic
    mode of a body is named by itself.
    """
    omega, shapes = undamped_modes(structure)
    granite = energy_shares(structure, "isolator", shapes, omega)
    guide = energy_shares(structure, "guide", shapes, omega)
    mount = energy_shares(structure, "mount", shapes, omega)
    slots = [(f"granite_{d}", granite[i]) for i, d in enumerate(DIRECTIONS)]
    for i, direction in enumerate(DIRECTIONS):
        slots += [(direction, guide[i] + mount[i])] * (1 if direction == "feed" else 2)
    for i, mode in enumerate(structure.elastic, 6 * len(structure.bodies)):
        slots.append((mode.name, (mode.omega * shapes[i] / omega) ** 2))
    score = np.array([share for _, share in slots])
    if score.shape[0] != omega.size:
        raise BadParameter("structure", f"{omega.size} modes", f"{score.shape[0]} elastic modes")
    rows, columns = linear_sum_assignment(-score)
    names = [""] * omega.size
    taken: set[str] = set()
    for row, column in sorted(zip(rows, columns, strict=True), key=lambda pair: pair[1]):
        name = slots[row][0]
        # The guide is free along the feed: its only stage mode there is the housing's.
        upper = name in taken or name == "feed"
        names[column] = f"housing_{name}" if upper else name
        taken.add(name)
    return NamedShapes(tuple(names), omega, shapes)
