"""Simulated logs: 20 kHz recordings of a constant-velocity move."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.dynamics.modal_coordinates import (
    Diagonal,
    diagonalise,
    frequency_response,
    propagate,
    sampled_spectrum,
    simulate,
)
from models.dynamics.plant import (
    GUIDE_MODES,
    NOISE_INPUTS,
    OUTPUTS,
    SENSORS,
    LinearSystem,
    closed_loop,
    closed_loop_modes,
    contact_loop,
    sensor_rows,
)
from models.dynamics.stages import NOMINAL, Condition, Stage, build_structure, tuning_named
from models.errors import BadParameter
from models.recordings.disturbances import (
    LEVELS,
    Drawn,
    drawn_orders,
    mains,
    noise_corners,
    noise_levels,
)
from models.recordings.effects import LINEAR, Effects, changes

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

SAMPLE_RATE_HZ = 20000.0
DEFAULT_VELOCITY = 0.010
# Of a log, s: 200 samples; and hardly more than the slowest move through the travel takes.
SHORTEST_S, LONGEST_S = 0.01, 600.0
# Room to accelerate and stop at both ends of the travel.
_USABLE_TRAVEL = 0.95
_SLOWEST = 0.5e-3
_LINE_BLOCK = 1 << 15
COLUMNS = (
    "delta_e_um",
    "current_a",
    "acc_feed_m_s2",
    "acc_pitch_m_s2",
    "reference_position_mm",
    "reference_velocity_mm_s",
)


@dataclass(frozen=True, slots=True)
class Recording:
    """Columns as they are stored (names carry the unit) and the file's metadata."""

    columns: Mapping[str, NDArray[np.floating]]
    metadata: Mapping[str, Any]

    def described(self, **metadata: Any) -> Recording:
        """Return the recording with more metadata."""
        return Recording(self.columns, {**metadata, **self.metadata})


def sample_count(seconds: float) -> int:
    """Return the count of samples in a log of some seconds.

    Raises
    ------
    BadParameter
        If that is no number, or the log would be shorter or longer than any can be.
    """
    if not SHORTEST_S <= seconds <= LONGEST_S:
        raise BadParameter("seconds", seconds, f"{SHORTEST_S:g} to {LONGEST_S:g} s")
    return round(seconds * SAMPLE_RATE_HZ)


def move_velocity(stage: Stage, seconds: float, wanted: float = DEFAULT_VELOCITY) -> float:
    """Return the wanted velocity (m/s), or the highest that the travel allows for so long.

    Raises
    ------
    BadParameter
        If the move would have to be slower than 0.5 mm/s, or no log can be as long or short.
    """
    sample_count(seconds)
    if not (math.isfinite(wanted) and wanted >= _SLOWEST):
        raise BadParameter("velocity", f"{wanted} m/s", f"at least {_SLOWEST} m/s, finite")
    usable = _USABLE_TRAVEL * stage.travel.value
    velocity = min(wanted, usable / seconds)
    if velocity < _SLOWEST:
        raise BadParameter(
            "seconds", seconds, f"at most {usable / _SLOWEST:.0f} s: travel {usable} m"
        )
    return velocity


def room_of(stage: Stage, seconds: float) -> float:
    """Return how far (m) the middle of a move may be from that of the travel, either way."""
    moved = move_velocity(stage, seconds) * seconds
    return max(0.0, (_USABLE_TRAVEL * stage.travel.value - moved) / 2)


def loop_of(stage: Stage, condition: Condition, effects: Effects) -> LinearSystem:
    """Return the closed loop; with nonlinear effects its contacts' displacements follow."""
    return (contact_loop if effects.nonlinear else closed_loop)(stage, condition)


def shaken(stage: Stage, condition: Condition, effects: Effects = LINEAR) -> Diagonal:
    """Return the closed loop behind the low passes that shape its noise."""
    system = loop_of(stage, condition, effects).driven_by(NOISE_INPUTS)
    return diagonalise(system, noise_corners(stage))


def _order_gains(system: LinearSystem, drawn: Drawn, velocity: float) -> tuple[Array, ComplexArray]:
    """Return frequencies (line,) and complex outputs (output, line) of the velocity orders."""
    cycles, inputs, amplitudes = drawn
    frequency = cycles * abs(velocity)
    response = frequency_response(diagonalise(system), frequency)
    gain = response[np.arange(frequency.size), :, inputs].T * amplitudes
    # The drive's anti-alias filter removes frequencies above half the sample rate.
    gain[:, frequency >= SAMPLE_RATE_HZ / 2] = 0.0
    return frequency, gain


def _mains_gains(stage: Stage, rng: np.random.Generator) -> tuple[Array, ComplexArray]:
    """Return frequencies (line,) and complex outputs (output, line) of the mains."""
    lines = mains(stage)
    gain = np.zeros((len(OUTPUTS), len(lines)), dtype=complex)
    for i, line in enumerate(lines):
        turned = np.exp(2j * np.pi * rng.random())
        gain[OUTPUTS.index(line.output), i] = line.amplitude * turned
    return np.array([line.frequency_hz for line in lines]), gain


def _add_lines(outputs: Array, frequency_hz: Array, gain: ComplexArray) -> None:
    """Add sinusoids of complex amplitudes (output, line) to outputs (output, time)."""
    turn = 2j * np.pi * frequency_hz / SAMPLE_RATE_HZ
    # One block of all sinusoids, turned on from block to block: no transcendental per sample.
    block = min(outputs.shape[1], _LINE_BLOCK)
    waves = np.exp(turn[:, None] * np.arange(block))
    waves_stacked = np.vstack([waves.real, waves.imag])
    for start in range(0, outputs.shape[1], block):
        turned_gain = gain * np.exp(turn * start)
        size = min(block, outputs.shape[1] - start)
        read = np.hstack([turned_gain.real, -turned_gain.imag])
        outputs[:, start : start + size] += read @ waves_stacked[:, :size]


def sense(outputs: Array, stage: Stage, velocity: Array, rng: np.random.Generator) -> None:
    """Make of what happens (output, time) what the sensors write, in place.

    Mains and noise are added to the accelerations, which end at the sensors' range; Δe is
    rounded to encoder counts.

    Parameters
    ----------
    velocity : () or (time,)
        m/s.
    """
    _add_lines(outputs, *_mains_gains(stage, rng))
    noise = LEVELS[stage.name].accelerometer.at(velocity) * np.sqrt(SAMPLE_RATE_HZ / 2)
    reach = stage.acc_range.value
    for name in ("acc_feed", "acc_pitch"):
        sensed = outputs[OUTPUTS.index(name)]
        sensed += noise * rng.standard_normal(sensed.size)
        np.clip(sensed, -reach, reach, out=sensed)
    count = stage.encoder_count.value
    outputs[0] = count * np.round(outputs[0] / count)


def simulate_signals(
    stage: Stage,
    condition: Condition,
    *,
    seconds: float,
    velocity: float,
    rng: np.random.Generator,
    level: float = 1.0,
    effects: Effects = LINEAR,
    added: Array | None = None,
) -> Array:
    """Return Δe (m), current (A) and two accelerations (m/s²) as sensed, (output, time).

    Parameters
    ----------
    level
        Factor on the random excitation.
    effects
        What the stage has beyond a linear loop.
    added : (output, time)
        What an excitation alone does to the outputs of `loop_of`.
    """
    samples = sample_count(seconds)
    std = level * noise_levels(stage, np.asarray(velocity), SAMPLE_RATE_HZ)
    position = _positions(condition, samples, velocity)
    # A stream of their own: what is drawn for the rest does not depend on them.
    change = changes(stage, effects, position, rng.spawn(1)[0], SAMPLE_RATE_HZ)
    outputs = simulate(
        shaken(stage, condition, effects), std, samples,
        sample_rate_hz=SAMPLE_RATE_HZ, rng=rng, change=change, step=_stepping(effects),
    )  # fmt: skip
    drawn = drawn_orders(stage, rng, effects)
    system = loop_of(stage, condition, effects)
    _add_lines(outputs, *_order_gains(system, drawn, velocity))
    if added is not None:
        outputs += added
    if effects.friction is None:
        # The ball guide's constant friction costs current; its slow integrator has long met it.
        constant = tuning_named(stage.name, condition.servo_id).force_constant
        outputs[OUTPUTS.index("current")] += stage.friction.value / constant
    if effects.nonlinear:
        cycles, inputs, amplitudes = drawn
        # Their phases are those of the first sample.
        turned = amplitudes * np.exp(-2j * np.pi * cycles * position[0])
        moves = np.vstack([position, np.full(samples, velocity)])
        add_nonlinear(stage, condition, effects, outputs, moves, (cycles, inputs, turned))
    sensed = outputs[: len(OUTPUTS)]
    sense(sensed, stage, np.asarray(velocity), rng)
    return sensed


def _stepping(effects: Effects) -> Callable[..., tuple[Array, ComplexArray]]:
    """Return what steps the linear part: compiled where effects need the compiler anyway."""
    if effects == LINEAR:
        return propagate
    from models.recordings.feedback import propagate_compiled

    return propagate_compiled


def _positions(condition: Condition, samples: int, velocity: float) -> Array:
    """Return the reference position (time,) of a move through the condition's, m."""
    time = (np.arange(samples) - (samples - 1) / 2) / SAMPLE_RATE_HZ
    return np.asarray(1e-3 * condition.position_mm + velocity * time)


def add_nonlinear(
    stage: Stage,
    condition: Condition,
    effects: Effects,
    outputs: Array,
    moves: Array,
    drawn: Drawn,
    moving: float | Array = 1.0,
) -> None:
    """Add what friction, cable, and the limits of drive and encoder cause to linear outputs.

    Parameters
    ----------
    outputs : (output + contact, time)
        Of `loop_of`; changed in place.
    moves : (2, time)
        Reference position (m) and velocity (m/s).
    drawn
        Orders with their phases at position 0.
    moving : () or (time,)
        Which part of the orders acts.

    Raises
    ------
    MissingLibrary
        If numba is not installed.
    """
    from models.recordings.feedback import follow

    follow(stage, condition, effects, outputs, moves, drawn, moving, SAMPLE_RATE_HZ)


def record(
    stage: Stage,
    condition: Condition = NOMINAL,
    *,
    seconds: float,
    velocity: float = DEFAULT_VELOCITY,
    rng: np.random.Generator,
    level: float = 1.0,
    effects: Effects = LINEAR,
    added: Array | None = None,
) -> Recording:
    """Record a move at constant velocity through the condition's position on the travel.

    The stage is linear about that position: its modes stay what they are there.

    Parameters
    ----------
    seconds
        Duration, s.
    velocity
        Wanted velocity, m/s; lowered where the travel is too short for the duration.
    level, effects, added
        See `simulate_signals`.
    """
    velocity = move_velocity(stage, seconds, velocity)
    signals = simulate_signals(
        stage,
        condition,
        seconds=seconds,
        velocity=velocity,
        rng=rng,
        level=level,
        effects=effects,
        added=added,
    )
    samples = signals.shape[1]
    position = _positions(condition, samples, velocity)
    return to_recording(stage, condition, signals, position, np.full(samples, velocity))


def payload_kg(stage: Stage, condition: Condition) -> float:
    """Return what the platform carries, kg, to the gram."""
    return round(stage.payload.value + condition.added_payload, 3)


def to_recording(
    stage: Stage, condition: Condition, signals: Array, position: Array, velocity: Array
) -> Recording:
    """Put sensed signals (output, time) and the reference (m, m/s) into the log's columns."""
    columns = (signals[0] * 1e6, *signals[1:], position * 1e3, velocity * 1e3)
    metadata = {
        "sample_rate_hz": SAMPLE_RATE_HZ,
        "temperature_c": round(condition.temperature_c, 2),
        "payload_kg": payload_kg(stage, condition),
        "position_mm": condition.position_mm,
    }
    stored = {n: v.astype(np.float32) for n, v in zip(COLUMNS, columns, strict=True)}
    return Recording(stored, metadata)


def spectrum(
    stage: Stage,
    frequency_hz: Array,
    condition: Condition = NOMINAL,
    *,
    velocity: float = DEFAULT_VELOCITY,
) -> Array:
    """Return one-sided densities (frequency, output) of the sensed signals between the lines."""
    std = noise_levels(stage, np.asarray(velocity), SAMPLE_RATE_HZ)
    diagonal = shaken(stage, condition)
    density = sampled_spectrum(diagonal, std, SAMPLE_RATE_HZ, frequency_hz)
    return density + _sensor_floor(stage, velocity)


def _sensor_floor(stage: Stage, velocity: float) -> Array:
    """Return the density (output,) of quantisation and accelerometer noise."""
    floor = np.zeros(len(OUTPUTS))
    floor[0] = stage.encoder_count.value**2 / 12 * 2 / SAMPLE_RATE_HZ
    floor[2:] = LEVELS[stage.name].accelerometer.at(np.asarray(velocity)) ** 2
    return floor


def signal_to_noise(
    stage: Stage, condition: Condition = NOMINAL, *, velocity: float = DEFAULT_VELOCITY
) -> dict[str, dict[str, float]]:
    """Return the modal signal-to-noise ratio S / (4 ζ² S_e) per guide mode and signal.

    The mode's part of the response at its natural frequency over everything else there, except
    the other guide modes, which a joint fit takes out.
    """
    std = noise_levels(stage, np.asarray(velocity), SAMPLE_RATE_HZ)
    diagonal = shaken(stage, condition)
    structure = build_structure(stage, condition)
    rows = np.vstack(list(sensor_rows(stage, structure).values()))
    seen = rows @ diagonal.states[: structure.size]
    outputs = [OUTPUTS.index(name) for name in SENSORS]
    modes = [m for m in closed_loop_modes(stage, condition) if m.name in GUIDE_MODES]
    ratios: dict[str, dict[str, float]] = {}
    for mode in modes:
        s = 2j * np.pi * mode.frequency_hz
        # A mode's part of an acceleration is s² times its part of the displacement; the partial
        # fractions of the acceleration itself do not vanish far below the mode.
        twice = np.array([1.0, s**2, s**2])[:, None]
        parts = {}
        for other in modes:
            pair = np.abs(np.abs(diagonal.poles) - abs(other.eigenvalue)) < 1e-9 * abs(s)
            parts[other.name] = twice * (
                (seen[:, pair] / (s - diagonal.poles[pair])) @ diagonal.b[pair]
            )
        total = frequency_response(diagonal, np.array([mode.frequency_hz]))[0, outputs]
        rest = total - sum(parts.values())
        power = [np.abs(part) ** 2 @ std**2 for part in (parts[mode.name], rest)]
        floor = _sensor_floor(stage, velocity)[outputs] * SAMPLE_RATE_HZ / 2
        ratio = power[0] / (power[1] + floor)
        ratios[mode.name] = dict(zip(SENSORS, map(float, ratio), strict=True))
    return ratios
