"""The friction of the simulated stages is physical, and exact enough; each check has a control.

The full stage Y in its position loop with generalized Maxwell-slip friction at four blocks and the
cable: closed forms of Masing's rule, energy, convergence with the step, and linear limits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from models.dynamics.modal_coordinates import diagonalise, propagate
from models.dynamics.plant import CONTACTS, INPUTS, LinearSystem, contact_loop
from models.dynamics.stages import NOMINAL, build_structure, stage_named, tuning_named
from models.recordings.effects import LINEAR, Effects, FrictionParameters
from models.recordings.feedback import Feedback
from models.recordings.friction import Contacts, contacts_of, elements, force_along
from models.recordings.motion_profile import Profile
from models.recordings.recording import simulate_signals
from models.recordings.strokes import commands, expected_friction, full_stroke

pytestmark = pytest.mark.slow
Array = NDArray[np.float64]
Row = dict[str, Any]

STAGE = stage_named("lms-y-full")
RATE = 20000.0
FRICTION = FrictionParameters()
BLOCKS = [INPUTS.index(name) for name in CONTACTS]
MOTOR, ENCODER = BLOCKS[-1], INPUTS.index("encoder_error")


def plain(count: int = 8) -> Contacts:
    """Return one contact of 6 N without dependence on velocity, without lag and damping."""
    stiffness, share = elements(count, FRICTION.first_slip, FRICTION.last_slip, 6.0)
    six, none = np.array([6.0]), np.zeros(1)
    return Contacts(stiffness[None], share[None], six, six, 1.0, 1e-9, none, none)


def loop_area(contacts: Contacts, amplitude: float) -> float:
    """Return the loss of the first contact per cycle, J: each element slips twice there and back.

    An element of stiffness k that slips at a force W loses 4 W (A - W / k) in a cycle of
    amplitude A, if it slips at all [Iwan1966].
    """
    slip = contacts.share[0] * contacts.coulomb[0]
    free = np.maximum(amplitude - slip / contacts.stiffness[0], 0.0)
    return float(np.sum(4 * slip * free))


def hysteresis(samples: int) -> Row:
    """Compare the area of the loop of a contact along a sine with its closed form."""
    contacts = plain()
    time = np.arange(3 * samples + 1) / samples
    rows = {}
    for amplitude in (3e-6, 10e-6, 30e-6, 200e-6):
        path = amplitude * np.sin(2 * np.pi * time)
        force = force_along(contacts, path, 1e-3)
        area = work_along(force[-samples - 1 :], path[-samples - 1 :])
        rows[f"{1e6 * amplitude:g} µm"] = {
            "area_j": area,
            "closed_j": loop_area(contacts, amplitude),
        }
    error = max(abs(row["area_j"] / row["closed_j"] - 1) for row in rows.values())
    # Control: without slip of the last elements there is less to lose.
    fewer = loop_area(replace(contacts, coulomb=1.1 * contacts.coulomb), 200e-6)
    return {"rows": rows, "error": error, "control": abs(fewer / rows["200 µm"]["area_j"] - 1)}


def work_along(force: Array, path: Array) -> float:
    """Return the work (J) of a force (time,) along a path (time,), linear from sample to sample."""
    return float(np.sum((force[1:] + force[:-1]) / 2 * np.diff(path)))


@dataclass(frozen=True, slots=True)
class Run:
    """Motion of the stage at rest: every state and current over time, forces at the contacts.

    Parameters
    ----------
    states : (state, time)
        Displacements, then velocities.
    current : (time,) A
    contacts : (contact, time) m
    error : (time,) m
        Δe.
    forces : (time, force) N
    """

    states: Array
    current: Array
    contacts: Array
    error: Array
    forces: Array


def moved(
    inputs: Array,
    contacts: Contacts,
    rate: float,
    system: LinearSystem | None = None,
    reference: Array | None = None,
) -> Run:
    """Run held inputs (input, time) through the loop with contacts, from rest."""
    system = contact_loop(STAGE) if system is None else system
    n = build_structure(STAGE).size
    all_states = np.eye(2 * n, len(system.a))
    watched = [*range(4, 9), 1, 0]
    c = np.vstack([all_states, system.c[watched]])
    d = np.vstack([np.zeros((2 * n, len(INPUTS))), system.d[watched]])
    whole = diagonalise(replace(system, c=c, d=d))
    reference = np.zeros(inputs.shape[1]) if reference is None else reference
    rest = np.zeros(whole.poles.size, complex)
    outputs, _ = propagate(whole, rest, inputs, rate)
    columns = [*BLOCKS, ENCODER]
    # The same rows twice: to be returned, and watched.
    every = [*range(len(c)), *range(2 * n, len(c))]
    part = Feedback(
        replace(whole, b=whole.b[:, columns], c=whole.c[every], d=d[np.ix_(every, columns)]),
        contacts,
        sample_rate_hz=rate,
        start=(float(reference[0]), 0.0),
    )
    linear = outputs[2 * n :].copy()
    forces = part.add_to(outputs, linear, reference, np.zeros((0, reference.size)))
    return Run(outputs[: 2 * n], outputs[-2], outputs[2 * n : -2], outputs[-1], forces)


def losses(run: Run, rate: float) -> Array:
    """Return the power (time,) that the joints lose, W."""
    structure = build_structure(STAGE)
    speed = run.states[structure.size :]
    return np.asarray(np.einsum("it,ij,jt->t", speed, structure.damping, speed))


def energies(run: Run) -> Array:
    """Return kinetic and elastic energy (time,), J."""
    structure = build_structure(STAGE)
    place, speed = run.states[: structure.size], run.states[structure.size :]
    kinetic = np.einsum("it,ij,jt->t", speed, structure.mass, speed)
    return np.asarray((kinetic + np.einsum("it,ij,jt->t", place, structure.stiffness, place)) / 2)


def given(run: Run, inputs: Array) -> tuple[Array, Array]:
    """Return work (step,) of the held inputs at the contacts and of the drive's current, J."""
    steps = np.diff(run.contacts, axis=1)
    outside = np.sum(inputs[BLOCKS, :-1] * steps, axis=0)
    constant = tuning_named(STAGE.name, NOMINAL.servo_id).force_constant
    middle = (run.current[1:] + run.current[:-1]) / 2
    return outside, constant * middle * steps[-1]


def friction_work(rate: float, hertz: float = 5.0, force: float = 12.0) -> Row:
    """Compare three ways to the work of friction in a cycle of a motion that repeats."""
    cycles, size = 8, round(rate / hertz)
    time = np.arange(cycles * size + 1) / rate
    inputs = np.zeros((len(INPUTS), time.size))
    inputs[MOTOR] = force * np.sin(2 * np.pi * hertz * time)
    law = replace(FRICTION, stiction=1.0, viscous=0.0, cable_drag=0.0, cable_spring=0.0)
    contacts = contacts_of(STAGE, NOMINAL, law)
    run = moved(inputs, contacts, rate)
    last = slice(-size - 1, None)
    lost = np.sum((losses(run, rate)[last][1:] + losses(run, rate)[last][:-1]) / 2) / rate
    outside, drive = given(run, inputs)
    stored = energies(run)
    put_in = float(np.sum(outside[-size:] + drive[-size:]) - stored[-1] + stored[-size - 1])
    by_forces = -sum(
        work_along(run.forces[last, i], run.contacts[i, last]) for i in range(len(CONTACTS))
    )
    amplitudes = np.ptp(run.contacts[:4, last], axis=1) / 2
    closed = sum(loop_area(contacts, a) for a in amplitudes)
    return {
        "amplitude_um": [float(1e6 * a) for a in amplitudes],
        "input_less_losses_j": put_in - float(lost),
        "by_forces_j": by_forces,
        "closed_form_j": closed,
        "error": abs(by_forces / (put_in - lost) - 1),
        "closed_form_error": abs(closed / by_forces - 1),
        # Control: without the losses of the joints and the work of the drive.
        "control": abs(by_forces / float(np.sum(outside[-size:])) - 1),
    }


def blows(rate: float, seconds: float = 0.5) -> Array:
    """Return inputs (input, time) of half sines of 60 N along the feed at the first block."""
    samples = round(seconds * rate)
    inputs = np.zeros((len(INPUTS), samples))
    # The same held steps at every rate.
    coarse = np.zeros(round(seconds * RATE))
    wave = 60 * np.sin(np.pi * (np.arange(100) + 0.5) / 100)
    for start in (100, 2500, 6100):
        coarse[start : start + 100] += wave
    inputs[BLOCKS[0]] = np.repeat(coarse, round(rate / RATE))
    return inputs


def energy_balance(finer: tuple[int, ...]) -> Row:
    """Return the rest of the energy balance after blows, over the work done, per step size."""
    contacts = contacts_of(STAGE, NOMINAL, FRICTION)
    rests, control = [], 0.0
    for times in finer:
        rate = times * RATE
        inputs = blows(rate)
        run = moved(inputs, contacts, rate)
        lost = losses(run, rate)
        outside, drive = given(run, inputs)
        pairs = (run.forces[1:, :5] + run.forces[:-1, :5]).T / 2
        rubbed = np.sum(pairs * np.diff(run.contacts, axis=1), axis=0)
        total = np.cumsum(outside + drive + rubbed - (lost[1:] + lost[:-1]) / 2 / rate)
        stored = energies(run)
        scale = np.cumsum(np.abs(outside))[-1]
        rests.append(float(np.abs(stored[1:] - stored[0] - total).max() / scale))
        control = float(np.abs(np.cumsum(rubbed)).max() / scale)
    return {
        "rest": rests,
        "falls_by": (np.array(rests[:-1]) / rests[1:]).tolist(),
        "control": control,
    }


def stroke(times: int, law: FrictionParameters, profile: Profile, rate: float = RATE / 2) -> Array:
    """Return Δe (time,) of a stroke at the coarsest rate, stepped so many times finer."""
    start, seconds = -0.05, profile.seconds + 0.2
    coarse = start + np.arange(round(seconds * rate)) / rate
    effects, reference = Effects(friction=law), profile.sampled(coarse)
    expected = expected_friction(STAGE, effects, reference, rate)
    inputs = np.repeat(commands(STAGE, NOMINAL, reference, expected), times, axis=1)
    fine = start + np.arange(inputs.shape[1]) / (times * rate)
    contacts = contacts_of(STAGE, NOMINAL, law)
    path = profile.sampled(fine)[0]
    return moved(inputs, contacts, times * rate, reference=path).error[::times]


def convergence(finer: tuple[int, ...]) -> Row:
    """Return the error of the following error of a stroke per step size, over its largest."""
    profile = replace(full_stroke(STAGE, 0.05), stroke=0.012)
    found = [stroke(times, FRICTION, profile) for times in finer]
    largest = np.abs(found[-1]).max()
    errors = [float(np.abs(one - found[-1]).max() / largest) for one in found[:-1]]
    other = stroke(finer[-2], replace(FRICTION, scale=1.1), profile)
    return {
        "steps_per_s": [times * RATE / 2 for times in finer[:-1]],
        "error": errors,
        "falls_by": (np.array(errors[:-1]) / errors[1:]).tolist(),
        "control": float(np.abs(other - found[-1]).max() / largest),
    }


def stiffened(damper: float, spring: float) -> LinearSystem:
    """Return the loop with a damper (N s/m) and a spring (N/m) at each block, along the feed."""
    system, structure = contact_loop(STAGE), build_structure(STAGE)
    n, a = structure.size, system.a.copy()
    for k, column in enumerate(BLOCKS[:-1]):
        push, row = system.b[:, column], system.c[4 + k, :n]
        a[:, :n] -= spring * np.outer(push, row)
        a[:, n : 2 * n] -= damper * np.outer(push, row)
    return replace(system, a=a)


def linear_limits() -> Row:
    """Compare linear contacts with a linear loop, and a log without friction with today's."""
    inputs, none = blows(RATE), np.zeros(5)
    zero = contacts_of(STAGE, NOMINAL, None)
    blocks = np.array([1.0] * 4 + [0.0])
    # Not a friction: elements that never slip.
    stuck = replace(
        zero,
        stiffness=np.outer(blocks, np.full(8, 1e5 / 8)),
        coulomb=1e9 + none,
        stiction=1e9 + none,
    )
    damped = replace(zero, viscous=50.0 * blocks)

    def difference(contacts: Contacts, damper: float, spring: float) -> float:
        wanted = moved(inputs, zero, RATE, stiffened(damper, spring)).error
        return float(
            np.abs(moved(inputs, contacts, RATE).error - wanted).max() / np.abs(wanted).max()
        )

    return {
        "damper": difference(damped, 50.0, 0.0),
        "damper_control": difference(damped, 55.0, 0.0),
        "spring": difference(stuck, 0.0, 1e5),
        "spring_control": difference(stuck, 0.0, 1.01e5),
        "log": log_difference(0.0),
        "log_control": log_difference(1.0),
    }


def log_difference(scale: float) -> float:
    """Return how far a log with friction of a scale is from one without, over its variation."""
    law = FrictionParameters(scale=scale, viscous=0.0, cable_drag=0.0, cable_spring=0.0)
    signals = [
        simulate_signals(
            STAGE,
            NOMINAL,
            seconds=2.0,
            velocity=1e-3,
            rng=np.random.default_rng(1),
            effects=effects,
        )
        for effects in (LINEAR, Effects(friction=law))
    ]
    # Without friction none of its constant current either.
    plain, rubbed = (one - one.mean(axis=1, keepdims=True) for one in signals)
    return float(np.max(np.abs(rubbed - plain).max(axis=1) / plain.std(axis=1)))


def superposition() -> Row:
    """Compare two pushes together with each alone."""
    rate, size = RATE, round(0.4 * RATE)
    time = np.arange(size) / rate
    first, second = np.zeros((2, len(INPUTS), size))
    first[MOTOR] = 8 * np.sin(2 * np.pi * 3 * time)
    second[BLOCKS[1]] = 5 * np.sin(2 * np.pi * 17 * time)

    def missing(contacts: Contacts) -> tuple[Array, Array, Array]:
        runs = [moved(inputs, contacts, rate) for inputs in (first, second, first + second)]
        forces = runs[2].forces - runs[0].forces - runs[1].forces
        return runs[2].error - runs[0].error - runs[1].error, forces, runs[2].error

    zero = contacts_of(STAGE, NOMINAL, None)
    error, forces, whole = missing(contacts_of(STAGE, NOMINAL, FRICTION))
    # The linear response to what the forces differ by, held at the mean of each step.
    inputs = np.zeros((len(INPUTS), size))
    inputs[BLOCKS, :-1] = (forces[1:, :5] + forces[:-1, :5]).T / 2
    told = moved(inputs, zero, rate).error
    largest, (alone, _, _) = np.abs(whole).max(), missing(zero)
    return {
        "missing": float(np.abs(error).max() / largest),
        "unexplained": float(np.abs(error - told).max() / largest),
        "control": float(np.abs(alone).max() / largest),
    }


def test_the_loop_has_the_area_of_the_closed_form() -> None:
    """A contact along a sine loses what Masing's rule says; with more friction it does not."""
    loop = hysteresis(2000)
    assert loop["error"] < 1e-3 < loop["control"]


def test_friction_does_the_work_that_is_missing() -> None:
    """In a motion that repeats it is the input less other losses, and that of the closed form."""
    work = friction_work(RATE)
    assert work["error"] < 0.01 < work["control"]
    assert work["closed_form_error"] < 0.01


def test_energy_balances() -> None:
    """After blows energies, losses, friction and drive balance; half the step leaves a quarter."""
    energy = energy_balance((1, 2))
    assert energy["rest"][0] < 0.01 < energy["control"]
    assert min(energy["falls_by"]) > 3.0


def test_the_following_error_converges_with_the_step() -> None:
    """Of a stroke with start and stop, at least in proportion; 10 % more friction is seen."""
    steps = convergence((1, 2, 16))
    assert steps["error"][0] < 0.01 < steps["control"]
    assert min(steps["falls_by"]) > 1.8


def test_contacts_that_only_damp_or_stick_are_linear() -> None:
    """They are the loop with a damper or a spring; without friction a log is the linear one."""
    limits = linear_limits()
    assert limits["damper"] < 1e-3 < limits["damper_control"]
    assert limits["spring"] < 1e-4 < limits["spring_control"]
    assert limits["log"] < 1e-6 < limits["log_control"]


def test_superposition_fails_by_friction_alone() -> None:
    """Two pushes differ from each alone by the response to the difference of friction forces."""
    pushes = superposition()
    assert pushes["unexplained"] < 0.01 < pushes["missing"]
    assert pushes["control"] < 1e-9
