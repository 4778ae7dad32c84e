"""Rolling friction with presliding hysteresis, Stribeck curve and lag, in compiled code.

Generalized Maxwell-slip model [AlBender2005]: parallel springs that slip.  The force of a contact
is the sum over its elements, and a part that grows with velocity and one with position.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.dynamics.stages import Condition, Stage
from models.errors import MissingLibrary
from models.recordings.effects import FrictionParameters, friction_of

try:
    import numba
except ImportError as error:
    raise MissingLibrary("numba", "models") from error

Array = NDArray[np.float64]

# Sums in any order, so that they are vectorised; kept compiled beside the sources.
compiled = numba.njit(cache=True, fastmath={"nsz", "arcp", "contract", "reassoc"})


@dataclass(frozen=True, slots=True)
class Contacts:
    """Sliding contacts of elements that stick, each as a spring, until they slip.

    Parameters
    ----------
    stiffness : (contact, element) N/m
    share : (contact, element)
        Part of the contact's friction that an element bears; the shares of a contact sum to 1.
    coulomb, stiction : (contact,) N
        Friction at high velocity, and at vanishing velocity.
    stribeck_velocity
        Where the one has fallen towards the other by 1/e, m/s.
    lag
        Time (s) in which the force of a slipping element follows a fall of friction.
    viscous : (contact,) N s/m
    spring : (contact,) N/m
        Acts on the whole displacement, the reference's included.
    """

    stiffness: Array
    share: Array
    coulomb: Array
    stiction: Array
    stribeck_velocity: float
    lag: float
    viscous: Array
    spring: Array

    def limit(self, velocity: float) -> Array:
        """Return the friction (contact,) of sliding at a velocity (m/s), N, nothing viscous."""
        fallen = math.exp(-abs(velocity) / self.stribeck_velocity)
        return np.asarray(self.coulomb + (self.stiction - self.coulomb) * fallen)

    def sliding(self, velocity: float) -> Array:
        """Return the elements' forces (contact, element) after long sliding, N; 0 at standstill."""
        return np.asarray(np.sign(velocity) * self.share * self.limit(velocity)[:, None])

    def packed(self) -> Array:
        """Return the numbers of each contact as (contact, 5)."""
        columns = (self.coulomb, self.stiction, np.full(self.coulomb.size, self.stribeck_velocity),
                   self.viscous, self.spring)  # fmt: skip
        return np.ascontiguousarray(np.column_stack(columns))


def elements(
    count: int, first_slip: float, last_slip: float, friction: float
) -> tuple[Array, Array]:
    """Return stiffness (N/m) and share of elements that bear alike and slip one after another.

    Parameters
    ----------
    first_slip, last_slip
        Displacements (m) at which the first and the last slip, geometrically spaced between.
    friction
        Of all, N.
    """
    share = np.full(count, 1.0 / count)
    return share * friction / np.geomspace(first_slip, last_slip, count), share


def _rub(
    force: Array,
    stiffness: Array,
    share: Array,
    numbers: Array,
    keep: float,
    moved: float,
    step: float,
) -> float:
    """Move one contact and return its force against the motion, N.

    Parameters
    ----------
    force : (element,) N
        Changed in place.
    numbers : (5,)
        Row of `Contacts.packed`.
    keep
        What is left after a step of a force above the limit, exp(-step / lag).
    moved
        Displacement of the step, m, within `step` s.
    """
    speed = moved / step
    limit = numbers[0] + (numbers[1] - numbers[0]) * math.exp(-abs(speed) / numbers[2])
    total = numbers[3] * speed
    for i in range(force.size):
        bound = share[i] * limit
        trial = force[i] + stiffness[i] * moved
        if trial > bound:
            trial = bound + max(0.0, force[i] - bound) * keep
        elif trial < -bound:
            trial = -bound + min(0.0, force[i] + bound) * keep
        force[i] = trial
        total += trial
    return float(total)


rub = compiled(_rub)


def _drag(
    displacement: Array,
    before: float,
    force: Array,
    stiffness: Array,
    share: Array,
    numbers: Array,
    keep: float,
    step: float,
    found: Array,
) -> None:
    """Add the force (time,) of one contact along a displacement (time,) to what is found."""
    for n in range(displacement.size):
        found[n] += rub(force, stiffness, share, numbers, keep, displacement[n] - before, step)
        found[n] += numbers[4] * displacement[n]
        before = displacement[n]


drag = compiled(_drag)


def force_along(
    contacts: Contacts, displacement: Array, step: float, *, velocity: float = 0.0
) -> Array:
    """Return the force (time,) of all contacts against a displacement of all of them, N.

    Parameters
    ----------
    displacement : (time,) m
        Every `step` s, after long sliding at a velocity (m/s).
    """
    along = np.ascontiguousarray(displacement, dtype=float)
    before, keep = float(along[0]) - velocity * step, math.exp(-step / contacts.lag)
    found = np.zeros(along.size)
    rows = (contacts.sliding(velocity), contacts.stiffness, contacts.share, contacts.packed())
    for force, stiffness, share, numbers in zip(*rows, strict=True):
        drag(along, before, force, stiffness, share, numbers, keep, step, found)
    return found


def contacts_of(
    stage: Stage, condition: Condition, friction: FrictionParameters | None
) -> Contacts:
    """Return the contacts of a stage at `CONTACTS`: four blocks, and the cable at the motor."""
    chosen = friction or FrictionParameters(
        scale=0.0, viscous=0.0, cable_drag=0.0, cable_spring=0.0
    )
    coulomb, viscous = friction_of(stage, condition, chosen)
    n = chosen.elements
    rolling = elements(n, chosen.first_slip, chosen.last_slip, coulomb)
    cable = elements(n, chosen.cable_slip / 10, chosen.cable_slip, chosen.cable_drag)
    return Contacts(
        stiffness=np.array([rolling[0]] * 4 + [cable[0]]),
        share=np.array([rolling[1]] * 4 + [cable[1]]),
        coulomb=np.array([coulomb] * 4 + [chosen.cable_drag]),
        # Cables rub dry: without Stribeck curve.
        stiction=np.array([chosen.stiction * coulomb] * 4 + [chosen.cable_drag]),
        stribeck_velocity=chosen.stribeck_velocity,
        lag=chosen.lag,
        viscous=np.array([viscous] * 4 + [0.0]),
        spring=np.array([0.0] * 4 + [chosen.cable_spring]),
    )
