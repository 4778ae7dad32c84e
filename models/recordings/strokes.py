"""Recordings of strokes with their transients: acceleration, braking, dwell, there and back.

Table 3 of the paper jumps by six between 20 and 100 mm/s, where no law of friction does.  We read
its records as windows of one fixed length about the middle of a full stroke: a slow stroke fills
the window with constant velocity, a fast one fits into it with its transients.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.dynamics.modal_coordinates import diagonalise, propagate, stationary_state
from models.dynamics.plant import INPUTS, closed_loop
from models.dynamics.stages import NOMINAL, Condition, Stage, tuning_named
from models.errors import BadParameter
from models.recordings.disturbances import drawn_orders, noise_levels
from models.recordings.motion_profile import JERK, Profile
from models.recordings.recording import (
    SAMPLE_RATE_HZ,
    Recording,
    sample_count,
    sense,
    shaken,
    to_recording,
)

Array = NDArray[np.float64]
Orders = tuple[Array, NDArray[np.intp], NDArray[np.complex128]]

# The paper's set velocities, m/s.
VELOCITIES = (0.001, 0.005, 0.010, 0.020, 0.100, 0.200, 0.400)
# All but the room that braking needs, of the 300 mm of travel.
STROKE = 0.280
WINDOW_S = 4.0
# Friction turns round within this velocity, m/s (our choice).
_TURNING = 5e-4
_CHUNK = 1 << 15
# What a transient leaves after this long is nothing: the slowest pole decays by 0.5 1/s.
_FORGOTTEN_S = 20.0
# Orders begin within this part of a second, though the stage has moved for long.
_ORDERS_S = 2.0


def full_stroke(stage: Stage, velocity: float) -> Profile:
    """Return one full stroke at a set velocity (m/s)."""
    jerk = tuning_named(stage.name, "commissioning").jerk or JERK
    return Profile(velocity, min(STROKE, 0.95 * stage.travel.value), jerk=jerk)


def commands(stage: Stage, condition: Condition, reference: Array) -> Array:
    """Return what the move itself puts into the stage's inputs, (input, time).

    The reference's acceleration, the controller's feedforward of mass and friction, and the
    friction itself.  The feedforward leads by part of the current loop's lag.

    Parameters
    ----------
    reference : (4, time)
        Position, velocity, acceleration, jerk, SI.
    """
    _, velocity, acceleration, jerk = reference
    led = acceleration + stage.feedforward_lead.value * jerk
    friction = stage.friction.value * np.tanh(velocity / _TURNING)
    wanted = stage.moving_mass.value * led + stage.friction_compensation.value * friction
    inputs = np.zeros((len(INPUTS), velocity.size))
    blocks = [i for i, n in enumerate(INPUTS) if n.startswith("block") and n.endswith("x")]
    inputs[blocks] = -friction / len(blocks)
    inputs[INPUTS.index("reference_acceleration")] = acceleration
    constant = tuning_named(stage.name, condition.servo_id).force_constant
    inputs[INPUTS.index("feedforward_current")] = wanted / constant
    return inputs


def _add_orders(inputs: Array, drawn: Orders, reference: Array) -> None:
    """Add the kinematic orders, which follow the position, to inputs (input, time)."""
    position, velocity = reference[:2]
    moving = np.tanh(np.abs(velocity) / _TURNING)
    for cycles, index, amplitude in zip(*drawn, strict=True):
        # The drive's anti-alias filter removes frequencies above half the sample rate.
        passed = moving * (cycles * np.abs(velocity) < SAMPLE_RATE_HZ / 2)
        inputs[index] += passed * (amplitude * np.exp(2j * np.pi * cycles * position)).real


def _lead_in_s(profile: Profile, start: float) -> float:
    """Return how long before a window (its start in s) the simulation has to begin, s.

    Either the stage is at rest, or it has moved evenly until the transients of its start have
    decayed.
    """
    if start <= 0:
        return 0.0
    path = profile.position()
    ramps = np.flatnonzero((path.c[0] != 0) | (path.c[1] != 0))
    # The last moment before the window at which the reference accelerates.
    before = [min(path.x[i + 1], start) for i in ramps if path.x[i] < start]
    if start - max(before) >= _FORGOTTEN_S:
        return _ORDERS_S
    # Back to a moment that is steady itself: not within a ramp.
    # Just before 0, where the stage is at rest: at 0 the reference has its first jerk already.
    first = max(-0.01, start - _FORGOTTEN_S)
    inside = [path.x[i] for i in ramps if path.x[i] < first < path.x[i + 1]]
    return float(start - min([first, *(x - profile.ramp_s for x in inside)]))


def commanded(
    stage: Stage,
    condition: Condition,
    profile: Profile,
    time: Array,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Return what a move does to the outputs, its kinematic orders included, without noise.

    Parameters
    ----------
    time : (time,)
        Even times at the sample rate, s; 0 is the start of the first stroke.

    Returns
    -------
    outputs : (output, time)
    reference : (4, time)
        Position, velocity, acceleration, jerk, SI.
    """
    lead = round(_lead_in_s(profile, float(time[0])) * SAMPLE_RATE_HZ)
    early = time[0] - np.arange(lead, 0, -1) / SAMPLE_RATE_HZ
    reference = profile.sampled(np.concatenate([early, time]))
    direct = diagonalise(closed_loop(stage, condition))
    # The command of the first sample has been constant before.
    state = -(direct.b @ commands(stage, condition, reference[:, :1])[:, 0]) / direct.poles
    drawn = drawn_orders(stage, rng)
    outputs = np.empty((direct.c.shape[0], reference.shape[1]))
    for start in range(0, reference.shape[1], _CHUNK):
        part = slice(start, start + _CHUNK)
        inputs = commands(stage, condition, reference[:, part])
        _add_orders(inputs, drawn, reference[:, part])
        outputs[:, part], state = propagate(direct, state, inputs, SAMPLE_RATE_HZ)
    return outputs[:, lead:], reference[:, lead:]


def _noise_outputs(
    stage: Stage, condition: Condition, velocity: Array, rng: np.random.Generator
) -> Array:
    """Return the outputs (output, time) of noise that grows and falls with the velocity."""
    diagonal = shaken(stage, condition)
    state = stationary_state(
        diagonal, noise_levels(stage, velocity[0], SAMPLE_RATE_HZ), SAMPLE_RATE_HZ, rng
    )
    outputs = np.empty((diagonal.c.shape[0], velocity.size))
    for start in range(0, velocity.size, _CHUNK):
        part = slice(start, start + _CHUNK)
        level = noise_levels(stage, velocity[part], SAMPLE_RATE_HZ)
        white = rng.standard_normal(level.shape) * level
        outputs[:, part], state = propagate(diagonal, state, white, SAMPLE_RATE_HZ)
    return outputs


def record_strokes(
    stage: Stage,
    condition: Condition = NOMINAL,
    *,
    profile: Profile,
    seconds: float = WINDOW_S,
    rng: np.random.Generator,
) -> Recording:
    """Record a window about the middle of a move.

    Parameters
    ----------
    profile
        Its last dwell does not count when the middle is found.
    seconds
        Length of the window, s; longer than the move, it has standstill at both ends.

    Raises
    ------
    BadParameter
        If the window is too short or too long, or the profile leaves the travel.
    """
    samples = sample_count(seconds)
    if profile.stroke > stage.travel.value:
        raise BadParameter("stroke", f"{profile.stroke} m", f"at most {stage.travel.value} m")
    start = (profile.seconds - profile.dwell - seconds) / 2
    time = start + np.arange(samples) / SAMPLE_RATE_HZ
    outputs, reference = commanded(stage, condition, profile, time, rng)
    outputs += _noise_outputs(stage, condition, reference[1], rng)
    sense(outputs, stage, reference[1], rng)
    return to_recording(stage, condition, outputs, reference[0], reference[1])
