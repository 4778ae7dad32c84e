"""What shakes a moving stage: friction, guide roughness, ground, orders of the velocity, mains.

The paper states none of these levels: they are fitted to its Tables 3, 4, 6 and 7, see the study
``paper/tables``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from models.dynamics.plant import INPUTS, NOISE_INPUTS
from models.dynamics.stages import Stage
from models.recordings.effects import LINEAR, Effects

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Cycles per m, index of the input and complex amplitude of every sinusoid.
Drawn = tuple[Array, NDArray[np.intp], ComplexArray]

REFERENCE_VELOCITY = 0.010


@dataclass(frozen=True, slots=True)
class Noise:
    """Noise of an input, grown by two powers of velocity, behind a low pass of first order.

    Parameters
    ----------
    density, power
        One-sided density (unit/√Hz) at 10 mm/s and its power of velocity.
    corner_hz
        Corner of the low pass.
    fast_density, fast_power
        The same of a part that only fast moves make; independent, so that squares add.
    """

    density: float
    power: float
    corner_hz: float
    fast_density: float = 0.0
    fast_power: float = 0.0

    def at(self, velocity: Array) -> Array:
        """Return the density (unit/√Hz) at velocities (m/s) of any shape."""
        ratio = np.abs(velocity) / REFERENCE_VELOCITY
        slow = self.density * ratio**self.power
        if not self.fast_density:
            return np.asarray(slow)
        return np.asarray(np.hypot(slow, self.fast_density * ratio**self.fast_power))


@dataclass(frozen=True, slots=True)
class Order:
    """A sinusoid whose frequency is harmonic × velocity / wavelength."""

    name: str
    wavelength: float
    harmonic: int
    amplitude: float
    inputs: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Line:
    """A sinusoid of fixed frequency added to an accelerometer: Hz, m/s², output."""

    frequency_hz: float
    amplitude: float
    output: str


@dataclass(frozen=True, slots=True)
class Levels:
    """What differs from stage to stage.

    Parameters
    ----------
    friction
        Force along the feed, one sequence per block.  X as rigid bodies needs more than Y: its
        stiffer loop would otherwise leave a fifth of Y's error where Table 3 has one half.
    roughness
        Force across the feed, lateral and vertical, one sequence per block and direction: from 1 to
        20 mm/s Table 7 hardly grows, from there to 400 mm/s a hundredfold.
    accelerometer
        An accelerometer's own noise (m/s²), and what the rolling balls make the spot under it
        tremble: bodies do not, but Tables 6 and 7 have it between all modes at high velocity.
    encoder
        Amplitude of the first two harmonics of the encoder's period, m.
    mains
        Lines at 50 Hz and its multiples that no velocity moves (Hz, m/s²).
    """

    friction: Noise
    roughness: Noise
    accelerometer: Noise
    encoder: tuple[float, float]
    mains: tuple[tuple[float, float], ...]


_X = Levels(
    friction=Noise(density=0.0105, power=0.35, corner_hz=10.0),
    roughness=Noise(0.0022, power=0.4, corner_hz=200.0, fast_density=0.0012, fast_power=1.5),
    accelerometer=Noise(4.0e-5, 0.0, math.inf, fast_density=2.0e-5, fast_power=1.8),
    encoder=(8.0e-9, 4.0e-9),
    mains=((50.0, 15.0e-3), (100.0, 2.3e-3), (150.0, 10.0e-3), (200.0, 3.2e-3), (250.0, 1.9e-3)),
)
_Y = replace(
    _X,
    friction=Noise(density=0.0034, power=0.4, corner_hz=10.0),
    mains=((50.0, 23.0e-3), (100.0, 3.9e-3), (150.0, 7.0e-3), (250.0, 1.0e-3), (350.0, 5.0e-3)),
)
# The guides of the full stages lose less (loss time): less roughness shakes them as much.  Their
# softer loops leave more friction beside the encoder's lines of Table 4.  Their accelerometers have
# the floor of the tables, and in Y, where most rows grow with velocity, more of the balls.
LEVELS = {
    "lms-x": _X,
    "lms-y": _Y,
    "lms-x-full": replace(
        _X,
        friction=Noise(density=0.0052, power=0.35, corner_hz=10.0),
        roughness=Noise(0.0014, power=0.4, corner_hz=200.0, fast_density=0.0005, fast_power=1.5),
        accelerometer=Noise(1.0e-4, 0.0, math.inf, fast_density=2.0e-5, fast_power=1.8),
        encoder=(12.0e-9, 9.0e-9),
    ),
    "lms-y-full": replace(
        _Y,
        friction=Noise(density=0.0066, power=0.61, corner_hz=10.0),
        roughness=Noise(0.0013, power=0.4, corner_hz=200.0, fast_density=0.0008, fast_power=1.5),
        accelerometer=Noise(1.0e-4, 0.0, math.inf, fast_density=4.5e-5, fast_power=1.8),
        encoder=(12.0e-9, 9.0e-9),
    ),
}
GROUND_FLAT = Noise(density=4.0e-5, power=0.0, corner_hz=80.0)
GROUND_UPRIGHT = Noise(density=1.0e-3, power=0.0, corner_hz=15.0)
# The motor and the encoder themselves add next to nothing between their orders.
MOTOR = Noise(density=2.0e-4, power=0.0, corner_hz=1000.0)
ENCODER = Noise(density=1.0e-12, power=0.0, corner_hz=5000.0)

# The cable of the accelerometer along the feed picks up less: our choice.
_MAINS_SHARE = {"acc_feed": 0.7, "acc_pitch": 1.0}


def mains(stage: Stage) -> tuple[Line, ...]:
    """Return the mains lines that the accelerometers of a stage pick up."""
    return tuple(
        Line(hertz, share * amplitude, output)
        for hertz, amplitude in LEVELS[stage.name].mains
        for output, share in _MAINS_SHARE.items()
    )


def _noise_of(stage: Stage, name: str) -> Noise:
    """Return the noise of an input."""
    if name.startswith("block"):
        levels = LEVELS[stage.name]
        return levels.friction if name.endswith("x") else levels.roughness
    if name.startswith("ground"):
        return GROUND_UPRIGHT if name.endswith("z") else GROUND_FLAT
    return MOTOR if name == "motor_force" else ENCODER


def noise_levels(stage: Stage, velocity: Array, sample_rate_hz: float) -> Array:
    """Return standard deviations of the white sequences, (noise input,) or (noise input, time).

    A one-sided density d needs white samples of standard deviation d √(fs/2).

    Parameters
    ----------
    velocity : () or (time,)
        m/s; at standstill what grows with velocity is silent.
    """
    # Most inputs share their noise, and a power of every sample is dear.
    noises = [_noise_of(stage, name) for name in NOISE_INPUTS]
    density = {noise: noise.at(velocity) for noise in set(noises)}
    return np.asarray(np.sqrt(sample_rate_hz / 2) * np.array([density[n] for n in noises]))


def noise_corners(stage: Stage) -> Array:
    """Return the corners of the low passes that shape the white sequences, (noise input,) Hz."""
    return np.array([_noise_of(stage, name).corner_hz for name in NOISE_INPUTS])


def orders(stage: Stage, effects: Effects = LINEAR) -> tuple[Order, ...]:
    """Return the kinematic orders of a stage (wavelength m, amplitude in the input's unit)."""
    feed, vertical = (
        tuple(name for name in INPUTS if name.startswith("block") and name.endswith(axis))
        for axis in "xz"
    )
    ball, magnet = stage.ball_pitch.value, stage.magnet_pitch.value
    period = stage.encoder_period.value
    first, second = LEVELS[stage.name].encoder
    # A ball enters every two pitches of travel, as balls roll at half of the velocity.  A block's
    # rows, half a pitch out of step, cancel that order: even ones are left, once per pitch.
    return (
        Order("ball pass", ball, 1, 0.30, vertical),
        Order("ball pass", ball, 2, 0.10, vertical),
        Order("magnet pitch", magnet, 1, 0.010, ("motor_force",)),
        Order("magnet pitch", magnet, 6, 0.015, ("motor_force",)),
        Order("encoder period", period, 1, first, ("encoder_error",)),
        Order("encoder period", period, 2, second, ("encoder_error",)),
        *(
            Order(name, 2 * length, 1, amplitude, inputs)
            for name, length, pair in (
                ("ball entry", ball, effects.entry),
                ("cage", effects.chain, effects.cage),
            )
            for amplitude, inputs in zip(pair, (feed, vertical), strict=True)
            if amplitude
        ),
    )


def drawn_orders(stage: Stage, rng: np.random.Generator, effects: Effects = LINEAR) -> Drawn:
    """Return every sinusoid of the orders with a phase of its own.

    Balls pass four blocks out of step: every input of an order has its own phase.

    Returns
    -------
    cycles_per_m : (sinusoid,)
        Spatial frequency, 1/m.
    inputs : (sinusoid,)
        Index of the input that it drives.
    amplitudes : (sinusoid,)
        Complex, in the input's unit.
    """
    table = [(order, name) for order in orders(stage, effects) for name in order.inputs]
    cycles = np.array([order.harmonic / order.wavelength for order, _ in table])
    inputs = np.array([INPUTS.index(name) for _, name in table])
    phases = np.exp(2j * np.pi * rng.random(len(table)))
    return cycles, inputs, np.array([order.amplitude for order, _ in table]) * phases
