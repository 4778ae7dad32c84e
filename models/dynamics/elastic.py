"""Elastic modes of bodies in closed form: free beams, overhanging beams, masses on springs.

A free beam has free-interface modes: orthogonal to the rigid motions of its body, seen at every
point of it.  An overhanging beam and an attached mass have fixed-interface modes: they move
against the rigid motions of their body, whose inertia includes them, and no point of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.dynamics.quantities import Number, Point

Array = NDArray[np.float64]

# First solutions of cos(β) cosh(β) = 1, free-free, and of cos(β) cosh(β) = −1, clamped-free.
FREE_ROOT = 4.730040744862704
CLAMPED_ROOT = 1.8751040687119611
# Nodes and weights on −1..1: exact to rounding for the shapes below.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_UNIT = np.eye(3)


@dataclass(frozen=True, slots=True)
class ElasticMode:
    """An elastic mode of a body, its shape scaled to a modal mass of 1 kg.

    Parameters
    ----------
    name
        Unique in a structure.
    omega
        With the interface of its kind (free or fixed), rad/s.
    damping_ratio
        Fraction of critical.
    momentum : (6,)
        Of the body's rigid motions per modal velocity, √kg and √kg m; zero with free interface.
    shape
        From a point relative to the body's centre (m) to its displacement (3,) per modal
        displacement, 1/√kg.
    encoder
        Displacement of the encoder's head along the feed against its body per modal displacement,
        1/√kg.
    """

    name: str
    omega: float
    damping_ratio: float
    momentum: Array
    shape: Callable[[Array], Array]
    encoder: float = 0.0


@dataclass(frozen=True, slots=True)
class FreeBeam:
    """A body as a free beam along the feed, first bending mode in the vertical plane.

    Parameters
    ----------
    name, body
        Name of the mode; index of the body, whose mass is the beam's.
    stiffness
        Bending E I, N m².
    """

    name: str
    body: int
    length: Number
    stiffness: Number
    damping: Number


@dataclass(frozen=True, slots=True)
class Overhang:
    """Two equal beams that overhang from a point of a body to both sides, first bending mode.

    Parameters
    ----------
    along, bends
        Axes (0 feed, 1 lateral, 2 vertical) of the beams and of their deflection.
    parity
        1 if both sides deflect alike, −1 if oppositely.
    reach
        Length of one side.
    mass
        Of both sides; it grows with what the platform carries.
    stiffness
        Bending E I, N m².
    """

    name: str
    body: int
    along: int
    bends: int
    parity: int
    root: Point
    reach: Number
    mass: Number
    stiffness: Number
    damping: Number


@dataclass(frozen=True, slots=True)
class Attachment:
    """A mass on a spring at a point of a body, along one axis: a loop of cables, a cover.

    Parameters
    ----------
    encoder
        Whether the mass holds the head of the encoder.
    loosening
        Relative fall of its stiffness per m of travel from the middle.
    """

    name: str
    body: int
    moves: int
    point: Point
    mass: Number
    stiffness: Number
    loosening: Number
    damping: Number
    encoder: bool = False


Part = FreeBeam | Overhang | Attachment


def free_bending(position: Array | float) -> tuple[Array, Array]:
    """Return deflection and slope of a free beam of length 1 at −0.5..0.5, mean square 1."""
    at = FREE_ROOT * (np.asarray(position) + 0.5)
    ratio = (math.cosh(FREE_ROOT) - math.cos(FREE_ROOT)) / (
        math.sinh(FREE_ROOT) - math.sin(FREE_ROOT)
    )
    deflection = np.cosh(at) + np.cos(at) - ratio * (np.sinh(at) + np.sin(at))
    slope = FREE_ROOT * (np.sinh(at) - np.sin(at) - ratio * (np.cosh(at) + np.cos(at)))
    return deflection, slope


def clamped_bending(position: Array | float) -> Array:
    """Return the first deflection of a beam of length 1 clamped at 0, mean square 1."""
    at = CLAMPED_ROOT * np.asarray(position)
    root = CLAMPED_ROOT
    ratio = (math.cosh(root) + math.cos(root)) / (math.sinh(root) + math.sin(root))
    return np.asarray(np.cosh(at) - np.cos(at) - ratio * (np.sinh(at) - np.sin(at)))


def _nowhere(point: Array) -> Array:
    """Return no displacement: the interface is fixed."""
    return np.zeros(3)


def beam_mode(part: FreeBeam, mass: float) -> ElasticMode:
    """Return the mode of a free beam of a mass, kg."""
    length = part.length.value
    omega = FREE_ROOT**2 * math.sqrt(part.stiffness.value / (mass * length**3))

    def shape(point: Array) -> Array:
        deflection, slope = free_bending(point[0] / length)
        # Cross-sections stay plane: they turn about the neutral axis.
        moved = deflection * _UNIT[2] - point[2] * slope / length * _UNIT[0]
        return np.asarray(moved / math.sqrt(mass))

    return ElasticMode(part.name, omega, part.damping.value, np.zeros(6), shape)


def _momentum(arm: Array, unit: Array) -> Array:
    """Return the momentum (6,) of rigid motions for a unit momentum at an arm (m)."""
    return np.concatenate([unit, np.cross(arm, unit)])


def overhang_mode(part: Overhang, centre: Array, carried: float) -> ElasticMode:
    """Return the mode of an overhang of a body with a centre (m), its mass times a factor."""
    reach, mass = part.reach.value, part.mass.value * carried
    momentum = np.zeros(6)
    for at, weight in zip((_NODES + 1) / 2, _WEIGHTS / 2, strict=True):
        part_of = 0.5 * math.sqrt(mass) * weight * float(clamped_bending(at))
        for side in (1, -1):
            arm = np.array(part.root.value) + side * at * reach * _UNIT[part.along] - centre
            sign = part.parity if side < 0 else 1
            momentum += part_of * sign * _momentum(arm, _UNIT[part.bends])
    omega = CLAMPED_ROOT**2 * math.sqrt(part.stiffness.value / (0.5 * mass * reach**3))
    return ElasticMode(part.name, omega, part.damping.value, momentum, _nowhere)


def attached_mode(part: Attachment, centre: Array, travel: float) -> ElasticMode:
    """Return the mode of an attached mass of a body with a centre (m), at a travel (m)."""
    mass = part.mass.value
    arm = np.array(part.point.value) - centre
    momentum = math.sqrt(mass) * _momentum(arm, _UNIT[part.moves])
    stiffness = part.stiffness.value * (1 - part.loosening.value * travel)
    omega = math.sqrt(stiffness / mass)
    head = part.encoder / math.sqrt(mass)
    return ElasticMode(part.name, omega, part.damping.value, momentum, _nowhere, head)
