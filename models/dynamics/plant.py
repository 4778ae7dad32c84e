"""The stage inside its position loop: state space and closed-loop modes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from models.dynamics.quantities import Point
from models.dynamics.servo import Tuning, servo_matrices
from models.dynamics.stages import (
    HOUSING,
    NOMINAL,
    PLATFORM,
    Condition,
    Stage,
    build_structure,
    corners,
    tuning_named,
)
from models.dynamics.structure import Structure, displacement_rows, named_modes, rigid_translation
from models.errors import AmbiguousModes, UnstableLoop

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

OUTPUTS = ("delta_e", "current", "acc_feed", "acc_pitch")
SENSORS = ("delta_e", "acc_feed", "acc_pitch")
NOISE_INPUTS = (
    *(f"block{i}_{axis}" for i in range(1, 5) for axis in "xyz"),
    "ground_x",
    "ground_y",
    "ground_z",
    "motor_force",
    "encoder_error",
)
# Signals that the motion controller has in advance.
COMMAND_INPUTS = ("reference_acceleration", "feedforward_current")
INPUTS = (*NOISE_INPUTS, *COMMAND_INPUTS)
# Where forces depend on the motion along the feed: of the platform against the housing.
CONTACTS = (*(f"block{i}_x" for i in range(1, 5)), "motor_force")
GUIDE_MODES = ("roll", "pitch", "yaw")

# Continuation: largest step in the logarithm of a parameter, and the modal assurance below which
# a step is halved, and below which the identity counts as lost.
_LARGEST_STEP = 0.3
_TRUSTED_ASSURANCE = 0.9
_LOST_ASSURANCE = 0.5
_HALVINGS = 8
# Travel that changes a stage about as much as a factor e in stiffness.
_MM_PER_UNIT = 150.0


@dataclass(frozen=True, slots=True)
class LinearSystem:
    """ẋ = a x + b u, y = c x + d u, with inputs `INPUTS` and outputs `OUTPUTS` (SI)."""

    a: Array
    b: Array
    c: Array
    d: Array

    def driven_by(self, inputs: Sequence[str]) -> LinearSystem:
        """Return the system with some of its inputs only, in the order of the argument."""
        chosen = [INPUTS.index(name) for name in inputs]
        return LinearSystem(self.a, self.b[:, chosen], self.c, self.d[:, chosen])


@dataclass(frozen=True, slots=True)
class Mode:
    """A closed-loop mode.

    Parameters
    ----------
    name, direction
        Unique name and main direction of motion.
    frequency_hz
        Natural frequency |λ| / 2π.
    damping_ratio
        −Re λ / |λ|.
    eigenvalue
        λ, rad/s.
    shape
        (dof,) complex displacement of the bodies.
    """

    name: str
    direction: str
    frequency_hz: float
    damping_ratio: float
    eigenvalue: complex
    shape: ComplexArray


def sensor_rows(stage: Stage, structure: Structure) -> dict[str, Array]:
    """Return for each sensor the (dof,) row that reads the displacement it sees, m."""
    bodies = structure.bodies

    def moved(body: int, point: Point) -> Array:
        return displacement_rows(bodies, body, point.value)

    encoder = moved(PLATFORM, stage.encoder_point) - moved(HOUSING, stage.encoder_point)
    encoder[0, 6 * len(bodies) :] += [mode.encoder for mode in structure.elastic]
    return {
        "delta_e": encoder[0],
        "acc_feed": moved(PLATFORM, stage.acc_feed_point)[0],
        "acc_pitch": moved(PLATFORM, stage.acc_pitch_point)[2],
    }


def _force_columns(stage: Stage, structure: Structure) -> tuple[Array, Array]:
    """Return generalised forces (dof, 12) per unit block force and (dof,) per unit motor force."""
    bodies = structure.bodies

    def between(point: tuple[float, float, float]) -> Array:
        return displacement_rows(bodies, PLATFORM, point) - displacement_rows(
            bodies, HOUSING, point
        )

    blocks = np.vstack([between(p) for p in corners(stage.block_half_spacing)]).T
    return blocks, between(stage.motor_point.value)[0]


def structure_state(stage: Stage, structure: Structure) -> tuple[Array, Array]:
    """Return the flexible structure of a stage in state space, its servo left out.

    Returns
    -------
    a : (2 dof, 2 dof)
        States are displacements and velocities.
    b : (2 dof, 13)
        Per unit of the 12 block forces, then of the motor force.
    """
    n = structure.size
    solved = np.linalg.solve(
        structure.mass,
        np.column_stack(
            [-structure.stiffness, -structure.damping, *_force_columns(stage, structure)]
        ),
    )
    a = np.vstack([np.eye(n, 2 * n, k=n), solved[:, : 2 * n]])
    return a, np.vstack([np.zeros((n, 13)), solved[:, 2 * n :]])


def closed_loop(
    stage: Stage, condition: Condition = NOMINAL, *, tuning: Tuning | None = None
) -> LinearSystem:
    """Close the position loop around the flexible structure.

    States are displacements, velocities and the servo's.  The platform's displacement counts from
    its reference, the others' from the ground: of the reference only the acceleration then acts,
    as an inertial force on the platform.

    Raises
    ------
    UnstableLoop
        If a pole of the loop does not decay.
    """
    system = _loop(stage, condition, tuning)
    _refuse_unstable(stage.name, np.linalg.eigvals(system.a).astype(complex))
    return system


def contact_loop(stage: Stage, condition: Condition = NOMINAL) -> LinearSystem:
    """Return the closed loop with the displacements at `CONTACTS` (m) as further outputs.

    What pushes platform and housing apart reads their displacement by the same numbers; the
    reference's own comes on top.
    """
    system, structure = closed_loop(stage, condition), build_structure(stage, condition)
    n, chosen = structure.size, [INPUTS.index(name) for name in CONTACTS]
    rows = np.zeros((len(chosen), len(system.a)))
    rows[:, :n] = (structure.mass @ system.b[n : 2 * n, chosen]).T
    c = np.vstack([system.c, rows])
    return replace(system, c=c, d=np.vstack([system.d, np.zeros((len(chosen), len(INPUTS)))]))


def _loop(stage: Stage, condition: Condition, tuning: Tuning | None = None) -> LinearSystem:
    """Close the loop, stable or not."""
    tuning = tuning_named(stage.name, condition.servo_id) if tuning is None else tuning
    structure = build_structure(stage, condition)
    servo = servo_matrices(tuning)
    n, m = structure.size, servo.b.size
    sensors = sensor_rows(stage, structure)
    moved, forced = structure_state(stage, structure)
    push = forced[:, 12]
    encoder = sensors["delta_e"]
    translation = rigid_translation(structure)

    a = np.zeros((2 * n + m, 2 * n + m))
    a[: 2 * n, : 2 * n] = moved
    a[: 2 * n, 2 * n :] = tuning.force_constant * np.outer(push, servo.c)
    # Negative feedback: the error drives the current that pushes against it.
    a[2 * n :, :n] = -np.outer(servo.b, encoder)
    a[2 * n :, 2 * n :] = servo.a
    b = np.zeros((2 * n + m, len(INPUTS)))
    b[: 2 * n, :12] = forced[:, :12]
    b[n : 2 * n, 12:15] = -translation
    b[: 2 * n, 15] = push
    b[2 * n :, 16] = -servo.b
    carried = translation[:, 0].copy()
    carried[: 6 * PLATFORM] = 0.0
    b[n : 2 * n, 17] = -carried
    b[2 * n :, 18] = servo.feedforward

    c = np.zeros((len(OUTPUTS), 2 * n + m))
    d = np.zeros((len(OUTPUTS), len(INPUTS)))
    c[0, :n] = encoder
    d[0, 16] = 1.0
    c[1, 2 * n :] = servo.c
    for row, name in ((2, "acc_feed"), (3, "acc_pitch")):
        c[row] = sensors[name] @ a[n : 2 * n]
        d[row] = sensors[name] @ b[n : 2 * n]
        # Back from the ground's frame to absolute acceleration.
        d[row, 12:15] += sensors[name] @ translation
        d[row, 17] += sensors[name] @ carried
    return LinearSystem(a, b, c, d)


def _refuse_unstable(stage: str, poles: ComplexArray) -> None:
    """Raise if a pole does not decay."""
    worst = poles[np.argmax(poles.real)]
    if worst.real >= 0:
        raise UnstableLoop(stage, float(worst.real), float(abs(worst) / (2 * np.pi)))


def _oscillations(stage: Stage, condition: Condition) -> tuple[ComplexArray, ComplexArray]:
    """Return eigenvalues (pair,) with positive frequency and displacement shapes (dof, pair)."""
    values, vectors = np.linalg.eig(_loop(stage, condition).a)
    _refuse_unstable(stage.name, values)
    keep = values.imag > 1e-6 * np.abs(values)
    size = build_structure(stage, condition).size
    order = np.argsort(np.abs(values[keep]))
    return values[keep][order], vectors[:size, keep][:, order]


def assurance(mass: Array, first: ComplexArray, second: ComplexArray) -> Array:
    """Return the mass-weighted modal assurance (i, j) of shapes (dof, i) and (dof, j)."""
    cross = np.abs(first.conj().T @ mass @ second) ** 2
    norm = [np.einsum("di,de,ei->i", s.conj(), mass, s).real for s in (first, second)]
    return np.asarray(cross / np.outer(*norm))


def _match(
    mass: Array,
    reference: tuple[ComplexArray, ComplexArray],
    found: tuple[ComplexArray, ComplexArray],
) -> tuple[NDArray[np.intp], Array]:
    """Match reference modes (eigenvalues, shapes) to found ones; return indices, assurance."""
    similar = assurance(mass, reference[1], found[1])
    apart = np.log(np.abs(found[0])[None, :] / np.abs(reference[0])[:, None])
    # Shapes of the same kind (platform and housing in pitch) differ little: frequency decides.
    rows, columns = linear_sum_assignment(-similar + np.minimum((apart / 0.3) ** 2, 4.0))
    return columns, similar[rows, columns]


@lru_cache(maxsize=32)
def _nominal(stage: Stage, servo_id: str) -> tuple[tuple[str, ...], ComplexArray, ComplexArray]:
    """Return names, eigenvalues and shapes of the closed-loop modes of the new stage.

    A tuning has no way along which it could be followed: names come from the structure without
    its servo, whatever the tuning.
    """
    structure = build_structure(stage)
    named = named_modes(structure)
    values, shapes = _oscillations(stage, Condition(servo_id=servo_id))
    reference = (named.omega.astype(complex), named.shapes.astype(complex))
    columns, similar = _match(structure.mass, reference, (values, shapes))
    if similar.min() < _LOST_ASSURANCE:
        lost = named.names[int(np.argmin(similar))]
        where = f"{stage.name}, nominal condition, servo {servo_id}, {lost}"
        raise AmbiguousModes(where, float(similar.min()))
    return named.names, values[columns], shapes[:, columns]


def _on_the_way(condition: Condition, part: float) -> Condition:
    """Return the condition a part of the way from the nominal: stiffness and loss in logarithms."""
    return replace(
        condition,
        guide_preload=condition.guide_preload**part,
        mount_stiffness=condition.mount_stiffness**part,
        temperature_c=NOMINAL.temperature_c * (1 - part) + condition.temperature_c * part,
        added_payload=condition.added_payload * part,
        guide_damping=condition.guide_damping**part,
        position_mm=condition.position_mm * part,
    )


def _distance(stage: Stage, condition: Condition) -> float:
    """Return how far a condition is from the nominal, in the logarithm of stiffness or mass.

    A flexible stage also along its travel.
    """
    warmer = condition.temperature_c - NOMINAL.temperature_c
    moving = build_structure(stage, condition).bodies[PLATFORM].mass
    return max(
        abs(math.log(condition.guide_preload)) * stage.preload_exponent.value,
        abs(math.log(condition.mount_stiffness)),
        abs(warmer) * stage.temperature_softening.value,
        abs(math.log(moving / stage.moving_mass.value)),
        abs(math.log(condition.guide_damping)),
        abs(condition.position_mm) / _MM_PER_UNIT if stage.flexible else 0.0,
    )


def closed_loop_modes(stage: Stage, condition: Condition = NOMINAL) -> list[Mode]:
    """Return the named closed-loop modes, ascending in frequency.

    Identities are followed from the nominal condition in steps small enough for each shape to
    stay alike, so that a mode keeps its name where frequencies cross.

    Raises
    ------
    AmbiguousModes
        If a shape changes too much even over the smallest step.
    UnstableLoop
        If the loop is unstable on the way.
    """
    names, values, shapes = _nominal(stage, condition.servo_id)
    mass = build_structure(stage).mass
    done = 0.0
    step = 1.0 / max(1, math.ceil(_distance(stage, condition) / _LARGEST_STEP))
    smallest = step / 2**_HALVINGS
    while done < 1.0:
        target = condition if done + step >= 1.0 else _on_the_way(condition, done + step)
        found = _oscillations(stage, target)
        columns, similar = _match(mass, (values, shapes), found)
        if similar.min() < _TRUSTED_ASSURANCE and step > smallest:
            step /= 2
            continue
        if similar.min() < _LOST_ASSURANCE:
            raise AmbiguousModes(f"{stage.name}, {target}", float(similar.min()))
        values, shapes = found[0][columns], found[1][:, columns]
        done += step
    modes = [_mode(n, v, shapes[:, i]) for i, (n, v) in enumerate(zip(names, values, strict=True))]
    return sorted(modes, key=lambda mode: mode.frequency_hz)


def _mode(name: str, value: complex, shape: ComplexArray) -> Mode:
    """Make a mode of its eigenvalue and shape."""
    return Mode(
        name=name,
        direction=name.rsplit("_", maxsplit=1)[-1],
        frequency_hz=float(abs(value) / (2 * np.pi)),
        damping_ratio=float(-value.real / abs(value)),
        eigenvalue=complex(value),
        shape=shape,
    )
