"""Recordings of strokes with their transients: acceleration, braking, dwell, there and back.

Table 3 of the paper jumps by six between 20 and 100 mm/s, where no law of friction does.  We read
its records as windows of one fixed length about the middle of a full stroke: a slow stroke fills
the window with constant velocity, a fast one fits into it with its transients.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.dynamics.modal_coordinates import diagonalise, propagate, stationary_state
from models.dynamics.plant import INPUTS, OUTPUTS
from models.dynamics.stages import NOMINAL, Condition, Stage, tuning_named
from models.errors import BadParameter
from models.recordings.disturbances import Drawn, drawn_orders, noise_levels
from models.recordings.effects import LINEAR, Effects, changes
from models.recordings.motion_profile import JERK, Profile
from models.recordings.recording import (
    SAMPLE_RATE_HZ,
    Recording,
    add_nonlinear,
    loop_of,
    sample_count,
    sense,
    shaken,
    to_recording,
)

Array = NDArray[np.float64]

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


def commands(
    stage: Stage, condition: Condition, reference: Array, expected: Array | None = None
) -> Array:
    """Return what the move itself puts into the stage's inputs, (input, time).

    The reference's acceleration, the controller's feedforward of mass and friction, and the
    friction itself.  The feedforward leads by part of the current loop's lag.

    Parameters
    ----------
    reference : (4, time)
        Position, velocity, acceleration, jerk, SI.
    expected : (time,)
        Friction that the controller expects, N, where the friction itself depends on the motion;
        without it both turn round with the reference.
    """
    _, velocity, acceleration, jerk = reference
    led = acceleration + stage.feedforward_lead.value * jerk
    turned = stage.friction.value * np.tanh(velocity / _TURNING)
    met = turned if expected is None else expected
    wanted = stage.moving_mass.value * led + stage.friction_compensation.value * met
    inputs = np.zeros((len(INPUTS), velocity.size))
    if expected is None:
        blocks = [i for i, n in enumerate(INPUTS) if n.startswith("block") and n.endswith("x")]
        inputs[blocks] = -turned / len(blocks)
    inputs[INPUTS.index("reference_acceleration")] = acceleration
    constant = tuning_named(stage.name, condition.servo_id).force_constant
    inputs[INPUTS.index("feedforward_current")] = wanted / constant
    return inputs


def _add_orders(inputs: Array, drawn: Drawn, reference: Array) -> None:
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
    reference: Array,
    drawn: Drawn,
    effects: Effects = LINEAR,
) -> Array:
    """Return what a move does to the outputs, its kinematic orders included, without noise.

    Parameters
    ----------
    reference : (4, time)
        Position, velocity, acceleration, jerk, SI, at the sample rate.

    Returns
    -------
    outputs : (output, time)
        Of `loop_of`.
    """
    direct = diagonalise(loop_of(stage, condition, effects))
    expected = expected_friction(stage, effects, reference, SAMPLE_RATE_HZ)
    # The command of the first sample has been constant before.
    held = None if expected is None else expected[:1]
    first = commands(stage, condition, reference[:, :1], held)[:, 0]
    state = -(direct.b @ first) / direct.poles
    outputs = np.empty((direct.c.shape[0], reference.shape[1]))
    for start in range(0, reference.shape[1], _CHUNK):
        part = slice(start, start + _CHUNK)
        held = None if expected is None else expected[part]
        inputs = commands(stage, condition, reference[:, part], held)
        _add_orders(inputs, drawn, reference[:, part])
        outputs[:, part], state = propagate(direct, state, inputs, SAMPLE_RATE_HZ)
    return outputs


def expected_friction(
    stage: Stage, effects: Effects, reference: Array, sample_rate_hz: float
) -> Array | None:
    """Return the friction (time,) that a drive computes along its reference, N.

    A drive of a nanometre stage has the law of friction, presliding included, of its commissioning:
    without it a stop would rest some 40 µm off, where friction holds it [Lampaert2004].
    """
    if effects.friction is None:
        return None
    # Needs numba: imported where friction is asked for.
    from models.recordings.friction import contacts_of, force_along

    contacts = contacts_of(stage, NOMINAL, effects.friction)
    step, velocity = 1 / sample_rate_hz, float(reference[1, 0])
    return force_along(contacts, reference[0], step, velocity=velocity)


def _noise_outputs(
    stage: Stage,
    condition: Condition,
    reference: Array,
    rng: np.random.Generator,
    effects: Effects,
) -> Array:
    """Return the outputs (output, time) of noise that grows and falls with the velocity."""
    position, velocity = reference[:2]
    change = changes(stage, effects, position, rng.spawn(1)[0], SAMPLE_RATE_HZ)
    diagonal = shaken(stage, condition, effects)
    state = stationary_state(
        diagonal, noise_levels(stage, velocity[0], SAMPLE_RATE_HZ), SAMPLE_RATE_HZ, rng
    )
    outputs = np.empty((diagonal.c.shape[0], velocity.size))
    for start in range(0, velocity.size, _CHUNK):
        part = slice(start, start + _CHUNK)
        level = noise_levels(stage, velocity[part], SAMPLE_RATE_HZ)
        white = rng.standard_normal(level.shape) * level
        if change is not None:
            change(start, white)
        outputs[:, part], state = propagate(diagonal, state, white, SAMPLE_RATE_HZ)
    return outputs


def record_strokes(
    stage: Stage,
    condition: Condition = NOMINAL,
    *,
    profile: Profile,
    seconds: float = WINDOW_S,
    rng: np.random.Generator,
    effects: Effects = LINEAR,
) -> Recording:
    """Record a window about the middle of a move.

    Parameters
    ----------
    profile
        Its last dwell does not count when the middle is found.
    seconds
        Length of the window, s; longer than the move, it has standstill at both ends.
    effects
        What the stage has beyond a linear loop.

    Raises
    ------
    BadParameter
        If the window is too short or too long, or the profile leaves the travel.
    """
    samples = sample_count(seconds)
    if profile.stroke > stage.travel.value:
        raise BadParameter("stroke", f"{profile.stroke} m", f"at most {stage.travel.value} m")
    start = (profile.seconds - profile.dwell - seconds) / 2
    lead = round(_lead_in_s(profile, start) * SAMPLE_RATE_HZ)
    reference = profile.sampled(start + np.arange(-lead, samples) / SAMPLE_RATE_HZ)
    drawn = drawn_orders(stage, rng, effects)
    outputs = commanded(stage, condition, reference, drawn, effects)
    # Only friction remembers the noise before the window.
    noisy = 0 if effects.nonlinear else lead
    outputs[:, noisy:] += _noise_outputs(stage, condition, reference[:, noisy:], rng, effects)
    if effects.nonlinear:
        moving = np.tanh(np.abs(reference[1]) / _TURNING)
        add_nonlinear(stage, condition, effects, outputs, reference[:2], drawn, moving)
    outputs, reference = outputs[: len(OUTPUTS), lead:].copy(), reference[:, lead:]
    sense(outputs, stage, reference[1], rng)
    return to_recording(stage, condition, outputs, reference[0], reference[1])
