"""What shakes a moving stage: friction, guide roughness, ground, orders of the velocity, mains.

All levels are our choice, set so that the following error and the accelerations have the size of
the paper's Tables 3, 6 and 7 at 10 mm/s.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from models.plant import INPUTS
from models.stages import Stage

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

REFERENCE_VELOCITY = 0.010


@dataclass(frozen=True, slots=True)
class Noise:
    """Noise of an input: density (unit/√Hz) at 10 mm/s, power of velocity, corner (Hz)."""

    density: float
    power: float
    corner_hz: float


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


FRICTION = Noise(density=0.004, power=0.5, corner_hz=10.0)
ROUGHNESS = Noise(density=0.006, power=0.75, corner_hz=1000.0)
GROUND = Noise(density=2.0e-5, power=0.0, corner_hz=80.0)
# The motor and the encoder themselves add next to nothing between their orders.
MOTOR = Noise(density=2.0e-4, power=0.0, corner_hz=1000.0)
ENCODER = Noise(density=1.0e-12, power=0.0, corner_hz=5000.0)

# One-sided density of the accelerometers' own noise, m/s²/√Hz.
ACCELEROMETER_DENSITY = 4.0e-5

MAINS = (
    Line(50.0, 3.0e-3, "acc_feed"),
    Line(50.0, 4.0e-3, "acc_pitch"),
    Line(150.0, 0.4e-3, "acc_feed"),
    Line(150.0, 0.5e-3, "acc_pitch"),
)


def _noise_of(name: str) -> Noise:
    """Return the noise of an input."""
    if name.startswith("block"):
        return FRICTION if name.endswith("x") else ROUGHNESS
    if name.startswith("ground"):
        return GROUND
    return MOTOR if name == "motor_force" else ENCODER


def noise_levels(velocity: float, sample_rate_hz: float) -> tuple[Array, Array]:
    """Return standard deviations of the white sequences and corners (Hz), each (input,).

    A one-sided density d needs white samples of standard deviation d √(fs/2).
    """
    noises = [_noise_of(name) for name in INPUTS]
    ratio = abs(velocity) / REFERENCE_VELOCITY
    density = np.array([n.density * ratio**n.power for n in noises])
    return density * np.sqrt(sample_rate_hz / 2), np.array([n.corner_hz for n in noises])


def orders(stage: Stage) -> tuple[Order, ...]:
    """Return the kinematic orders of a stage (wavelength m, amplitude in the input's unit)."""
    vertical = tuple(name for name in INPUTS if name.startswith("block") and name.endswith("z"))
    ball, magnet = stage.ball_pitch.value, stage.magnet_pitch.value
    period = stage.encoder_period.value
    return (
        Order("ball pass", ball, 1, 0.30, vertical),
        Order("ball pass", ball, 2, 0.10, vertical),
        Order("magnet pitch", magnet, 1, 0.010, ("motor_force",)),
        Order("magnet pitch", magnet, 6, 0.015, ("motor_force",)),
        Order("encoder period", period, 1, 8.0e-9, ("encoder_error",)),
        Order("encoder period", period, 2, 4.0e-9, ("encoder_error",)),
    )


def order_inputs(
    stage: Stage, velocity: float, rng: np.random.Generator
) -> tuple[Array, ComplexArray]:
    """Return frequencies (line,) in Hz and complex input amplitudes (line, input).

    Every input of an order has its own random phase: balls pass four blocks out of step.
    """
    table = orders(stage)
    amplitudes = np.zeros((len(table), len(INPUTS)), dtype=complex)
    for i, order in enumerate(table):
        for name in order.inputs:
            phase = np.exp(2j * np.pi * rng.random())
            amplitudes[i, INPUTS.index(name)] = order.amplitude * phase
    frequency = np.array([o.harmonic * abs(velocity) / o.wavelength for o in table])
    return frequency, amplitudes
