"""What depends on the motion itself, in compiled code: friction, drive limit, orders of the place.

The loop is linear but for forces at few points.  Its response is the linear one, computed without
them, and the response to these forces: that part is stepped here, in modal coordinates, which makes
it exact but for how the forces run within a sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from models.dynamics.modal_coordinates import Diagonal, diagonalise, half_poles, held_gain
from models.dynamics.plant import CONTACTS, INPUTS, OUTPUTS, contact_loop
from models.dynamics.stages import Condition, Stage, tuning_named
from models.recordings.disturbances import Drawn
from models.recordings.effects import Effects
from models.recordings.friction import Contacts, compiled, contacts_of, rub

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# What fits into a processor's cache.
_CHUNK = 1 << 12
_WATCHED = [
    *range(len(OUTPUTS), len(OUTPUTS) + len(CONTACTS)),
    OUTPUTS.index("current"),
    OUTPUTS.index("delta_e"),
]
# Inputs that depend on the motion: forces at the contacts, and where the encoder reads.
_DRIVEN = (*CONTACTS, "encoder_error")


def _turn(grown: Array, gain: Array, force: Array, z: Array) -> None:
    """Step modal states (2, mode) by a sample: poles (2, mode), gain (force, 2, mode)."""
    for k in range(grown.shape[1]):
        real = grown[0, k] * z[0, k] - grown[1, k] * z[1, k]
        z[1, k] = grown[0, k] * z[1, k] + grown[1, k] * z[0, k]
        z[0, k] = real
    for j in range(force.size):
        for k in range(z.shape[1]):
            z[0, k] += gain[j, 0, k] * force[j]
            z[1, k] += gain[j, 1, k] * force[j]


def _look(read: Array, through: Array, z: Array, force: Array, row: Array) -> None:
    """Add to values (row,) what rows (row, 2, mode) read, and forces feed through (row, force)."""
    for i in range(row.size):
        total = row[i]
        for j in range(force.size):
            total += through[i, j] * force[j]
        for k in range(z.shape[1]):
            total += read[i, 0, k] * z[0, k] - read[i, 1, k] * z[1, k]
        row[i] = total


def _displace(
    orders: tuple[Array, Array, NDArray[np.intp]],
    passed: Array,
    place: float,
    error: float,
    new: Array,
) -> None:
    """Add to forces (force,) what orders of the place (m) change by an error (m) of it."""
    cycles, amplitude, target = orders
    for i in range(cycles.size):
        if passed[i] != 0.0:
            at, off = 2 * math.pi * cycles[i] * place, 2 * math.pi * cycles[i] * error
            # Sine of the offset, and its cosine less 1: small offsets by their series.
            if abs(off) < 0.03:
                sine, less = off - off**3 / 6 + off**5 / 120, -(off**2) / 2 + off**4 / 24
            else:
                sine, less = math.sin(off), math.cos(off) - 1
            cos, sin = math.cos(at), math.sin(at)
            wave = amplitude[0, i] * (cos * less - sin * sine)
            wave -= amplitude[1, i] * (sin * less + cos * sine)
            new[target[i]] += passed[i] * wave


def _march(grown: Array, z: Array, drive: Array) -> None:
    """Step modal states (2, mode) along a drive (time, 2 * mode), which the states replace."""
    half = grown.shape[1]
    for n in range(drive.shape[0]):
        for k in range(half):
            real, imag = z[0, k], z[1, k]
            z[0, k] = grown[0, k] * real - grown[1, k] * imag + drive[n, k]
            z[1, k] = grown[0, k] * imag + grown[1, k] * real + drive[n, half + k]
            drive[n, k], drive[n, half + k] = real, imag


march = compiled(_march)
turn = compiled(_turn)
look = compiled(_look)
displace = compiled(_displace)


def _advance(
    modal: tuple[Array, Array, Array, Array],
    state: tuple[Array, Array, Array, Array],
    free: Array,
    reference: Array,
    contact: tuple[Array, Array, Array],
    numbers: tuple[float, float, float, float],
    orders: tuple[Array, Array, NDArray[np.intp]],
    passed: Array,
    states: Array,
    forces: Array,
) -> None:
    """Step the part of the response that the forces of the motion cause; fill states and forces.

    Forces run linearly from sample to sample.  A force at the end of a step is that of the
    displacement that the forces at its beginning would cause if they stayed.  The states are the
    modal ones less the ramps' part of the last forces, so that each sample adds the forces once.

    Parameters
    ----------
    modal
        Discrete poles (2, mode), gain (force, 2, mode), and of the contacts' displacements, current
        and Δe what they read (row, 2, mode) and what forces feed through (row, force).
    state
        States (2, mode), forces (force,), elements (contact, element), and the last displacements
        (contact,) with the last reference; all changed in place.
    free : (row, time)
        The same rows without these forces.
    reference : (time,) m
    contact
        Stiffness and share of the elements, packed numbers.
    numbers
        Part of a force that is kept above the limit, step (s), peak current, force per current.
    orders
        Cycles per m, amplitudes (2, order), index of the force.
    passed : (order, time)
    states : (time, 2 * mode)
    forces : (time, force)
    """
    grown, gain, read, through = modal
    z, force, element, last = state
    stiffness, share, packed = contact
    keep, step, peak, constant = numbers
    n_modes, n_contacts = grown.shape[1], packed.shape[0]
    row, new = np.empty(n_contacts + 2), np.empty(force.size)
    for n in range(reference.size):
        turn(grown, gain, force, z)
        row[:] = free[:, n]
        look(read, through, z, force, row)
        shift = reference[n] - last[n_contacts]
        last[n_contacts] = reference[n]
        for i in range(n_contacts):
            moved = row[i] - last[i] + shift
            new[i] = -rub(element[i], stiffness[i], share[i], packed[i], keep, moved, step)
            new[i] -= packed[i, 4] * (reference[n] + row[i])
            last[i] = row[i]
        new[n_contacts:] = 0.0
        # The drive's current acts at the motor: the last of the contacts.
        current = row[n_contacts]
        new[n_contacts - 1] += constant * (min(max(current, -peak), peak) - current)
        displace(orders, passed[:, n], reference[n], row[n_contacts + 1], new)
        force[:] = new
        forces[n] = new
        states[n, :n_modes] = z[0]
        states[n, n_modes:] = z[1]


advance = compiled(_advance)


def propagate_compiled(
    diagonal: Diagonal, state: ComplexArray, inputs: Array, sample_rate_hz: float
) -> tuple[Array, ComplexArray]:
    """Run held inputs through the system as `propagate` does, in a third of its time."""
    keep, weight = half_poles(diagonal)
    grown, push = (part[keep] for part in held_gain(diagonal, sample_rate_hz))
    gain, poles = np.hstack([push.real.T, push.imag.T]), _parts(grown[None])[0]
    read = diagonal.c[:, keep] * weight
    seen = np.hstack([read.real, -read.imag])
    z = _parts(state[keep][None])[0]
    outputs = diagonal.d @ inputs
    for begin in range(0, inputs.shape[1], _CHUNK):
        now = slice(begin, begin + _CHUNK)
        drive = inputs[:, now].T @ gain
        march(poles, z, drive)
        outputs[:, now] += seen @ drive.T
    last = np.zeros(diagonal.poles.size, dtype=complex)
    last[keep] = z[0] + 1j * z[1]
    return outputs, last


def ramp_gain(diagonal: Diagonal, sample_rate_hz: float) -> ComplexArray:
    """Return what inputs (n, input) that rise from 0 to 1 within a sample add to the states."""
    step = 1.0 / sample_rate_hz
    x = diagonal.poles * step
    near = np.abs(x) < 1e-2
    series = 0.5 + x / 6 + x**2 / 24 + x**3 / 120 + x**4 / 720
    safe = np.where(near, 1.0, x)
    share = np.where(near, series, (np.expm1(safe) - safe) / safe**2)
    return np.asarray(step * share[:, None] * diagonal.b)


@dataclass(frozen=True, slots=True)
class Drive:
    """What limits the drive: peak current (A), force per current (N/A)."""

    peak_current: float = math.inf
    force_constant: float = 1.0


@dataclass(frozen=True, slots=True)
class PlacedOrders:
    """Sinusoids of the place: the linear part has them at the reference.

    Parameters
    ----------
    cycles_per_m : (order,)
    amplitudes : (order,)
        Complex, with the phase at position 0.
    forces : (order,)
        Index of the driven force.
    """

    cycles_per_m: Array
    amplitudes: ComplexArray
    forces: NDArray[np.intp]


NO_ORDERS = PlacedOrders(np.zeros(0), np.zeros(0, complex), np.zeros(0, np.intp))


class Feedback:
    """The part of a loop's response that forces of the motion cause, chunk by chunk.

    Parameters
    ----------
    diagonal
        Its inputs: one force per contact, the last of them at the motor, then any others.  Its
        outputs: any, then displacements of the contacts, current and Δe.
    start
        Position (m) and velocity (m/s) of the steady sliding before the first sample.
    """

    def __init__(
        self,
        diagonal: Diagonal,
        contacts: Contacts,
        *,
        sample_rate_hz: float,
        start: tuple[float, float],
        drive: Drive | None = None,
        orders: PlacedOrders = NO_ORDERS,
    ) -> None:
        drive = Drive() if drive is None else drive
        n, step = contacts.coulomb.size, 1.0 / sample_rate_hz
        keep, weight = half_poles(diagonal)
        grown, held = (part[keep] for part in held_gain(diagonal, sample_rate_hz))
        ramp = ramp_gain(diagonal, sample_rate_hz)[keep]
        read = diagonal.c[:, keep] * weight
        through = diagonal.d + (read @ ramp).real
        self._read, self._through = read[: -n - 2], through[: -n - 2]
        self._modal = (
            _parts(grown[None])[0],
            _parts((held + (grown[:, None] - 1) * ramp).T),
            _parts(read[-n - 2 :]),
            np.ascontiguousarray(through[-n - 2 :]),
        )
        position, velocity = start
        element = contacts.sliding(velocity)
        force = np.zeros(diagonal.b.shape[1])
        force[:n] = -element.sum(axis=1) - contacts.viscous * velocity - contacts.spring * position
        steady = -(diagonal.b[keep] @ force) / diagonal.poles[keep]
        last = np.append((read[-n - 2 : -2] @ steady).real, position - velocity * step)
        self._state = (_parts((steady - ramp @ force)[None])[0], force, element, last)
        self._begun = False
        self._contact = (contacts.stiffness, contacts.share, contacts.packed())
        self._numbers = (
            math.exp(-step / contacts.lag), step, drive.peak_current, drive.force_constant,
        )  # fmt: skip
        self._orders = (orders.cycles_per_m, _parts(orders.amplitudes[None])[0], orders.forces)

    def add_to(self, outputs: Array, watched: Array, reference: Array, passed: Array) -> Array:
        """Add the part to outputs (output, time) in place; return forces (time, force).

        Parameters
        ----------
        watched : (contact + 2, time)
            The contacts' displacements (m), current and Δe of the linear part.
        reference : (time,) m
        passed : (order, time)
            Which part of each order acts.
        """
        last = self._state[3]
        if not self._begun:
            last[:-1] += watched[: last.size - 1, 0]
            self._begun = True
        states = np.empty((reference.size, 2 * self._modal[0].shape[1]))
        forces = np.empty((reference.size, self._state[1].size))
        advance(
            self._modal, self._state, np.ascontiguousarray(watched), reference, self._contact,
            self._numbers, self._orders, np.ascontiguousarray(passed), states, forces,
        )  # fmt: skip
        outputs += np.hstack([self._read.real, -self._read.imag]) @ states.T
        outputs += self._through @ forces.T
        return forces


def _parts(values: ComplexArray) -> Array:
    """Return (row, 2, mode) real and imaginary parts of (row, mode)."""
    return np.ascontiguousarray(np.stack([values.real, values.imag], axis=1))


def follow(
    stage: Stage,
    condition: Condition,
    effects: Effects,
    outputs: Array,
    moves: Array,
    drawn: Drawn,
    moving: float | Array,
    sample_rate_hz: float,
) -> Array:
    """Add the part to outputs; see `models.recordings.recording.add_nonlinear`.

    Returns
    -------
    forces : (time, 6)
        At `CONTACTS`, N, and the change of the encoder's error, m.
    """
    position, velocity = moves
    system = contact_loop(stage, condition)
    rows = [*range(len(OUTPUTS)), *_WATCHED]
    columns = [INPUTS.index(name) for name in _DRIVEN]
    c, d = system.c[rows], system.d[np.ix_(rows, columns)]
    cycles, inputs, amplitudes = drawn
    placed = np.flatnonzero(np.isin(inputs, columns[len(CONTACTS) - 1 :]) & effects.at_place)
    targets = np.searchsorted(columns, inputs[placed])
    part = Feedback(
        diagonalise(replace(system, b=system.b[:, columns], c=c, d=d)),
        contacts_of(stage, condition, effects.friction),
        sample_rate_hz=sample_rate_hz,
        start=(float(position[0]), float(velocity[0])),
        drive=Drive(
            effects.peak_current, tuning_named(stage.name, condition.servo_id).force_constant
        ),
        orders=PlacedOrders(cycles[placed], amplitudes[placed], targets),
    )
    gate = np.broadcast_to(moving, position.shape)
    forces = []
    for begin in range(0, position.size, _CHUNK):
        now = slice(begin, begin + _CHUNK)
        own, rates = outputs[:, now], np.abs(np.outer(cycles[placed], velocity[now]))
        # The drive's anti-alias filter removes frequencies above half the sample rate.
        passed = gate[now] * (rates < sample_rate_hz / 2)
        linear = own[_WATCHED]
        forces.append(part.add_to(own[: len(OUTPUTS)], linear, position[now], passed))
    return np.concatenate(forces)
