"""Records of machines that nobody described: modes, harmonics and floors with known truth.

The response of every mode is the exact solution of its equation of motion between samples, driven
by white forces that modes share in part: neither the response nor the floors have the form that
the likelihood of `lmshealth` assumes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.signal import cont2discrete, lfilter, ss2tf

from lmshealth.io.log import Channel, Log, Metadata

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """A record and the truth about it."""

    family: str
    sample_rate: float  # in Hz
    samples: Array  # in m/s², of displacements in m, (n_samples, n_channels)
    n_displacements: int  # these are the first channels
    band: tuple[float, float]  # in which a user would search, in Hz
    frequency: Array  # of the modes, in Hz, ascending, (n_modes,)
    damping_ratio: Array  # (n_modes,)
    steady: tuple[float, ...] = ()  # frequencies of sines in Hz
    wandering: tuple[float, ...] = ()  # mean frequencies of harmonics that wander, in Hz


@dataclass(frozen=True, slots=True)
class Machine:
    """What is drawn of a machine before it is recorded."""

    frequency: Array
    damping_ratio: Array
    strength: Array  # PSD of the response at each resonance over the floor, (n_modes,)
    shapes: Array  # (n_channels, n_modes), largest component of each one
    steady: tuple[float, ...] = ()
    wandering: tuple[float, ...] = ()
    displacements: int = 0
    floor_slope: float = 0.0  # exponent of the PSD of the floors, f ** -slope
    shared: float = 0.5  # share of the modal forces that all modes have in common
    harmonic_level: float = 1.0  # power of a harmonic over that of a mode within its bandwidth
    band: tuple[float, float] = field(default=(0.0, np.inf))


def four_modes(rng: np.random.Generator) -> World:
    """Draw a stage: four modes about 117 to 148 Hz, two accelerometers and a following error."""
    f = np.array([117.0, 126.0, 137.0, 148.0]) * (1 + 0.015 * rng.uniform(-1, 1, 4))
    zeta = rng.uniform(0.006, 0.02, 4)
    machine = Machine(
        f, zeta, np.full(4, 1e4) * 10 ** rng.uniform(-0.5, 0.5, 4), shapes_of(rng, 3, 4),
        displacements=1, band=(100.0, 170.0),
    )  # fmt: skip
    return record(rng, "four modes", machine, 1000.0, 20.0)


def varied(rng: np.random.Generator) -> World:
    """Draw two to five modes, one to eight channels, 20 to 120 s, pairs down to one bandwidth."""
    n_channels = int(rng.integers(1, 9))
    n_modes = int(rng.integers(2, 6))
    zeta = np.exp(rng.uniform(np.log(0.005), np.log(0.025), n_modes))
    close = int(rng.integers(0, n_modes - 1)) if n_channels > 1 and rng.random() < 0.5 else None
    f = [float(rng.uniform(60.0, 90.0))]
    for k in range(1, n_modes):
        mean_width = (zeta[k - 1] + zeta[k]) * f[-1]
        apart = rng.uniform(1.0, 2.0) if close == k - 1 else rng.uniform(4.0, 10.0)
        f.append(f[-1] + apart * mean_width)
    shapes = shapes_of(rng, n_channels, n_modes)
    if close is not None:
        shapes[:, close + 1] = shapes_apart(rng, shapes[:, close])
    machine = Machine(
        np.array(f), zeta, 10 ** rng.uniform(2.5, 4.5, n_modes), shapes,
        floor_slope=float(rng.uniform(0, 2)), shared=float(rng.uniform(0, 0.7)),
        steady=(50.0, 100.0) if rng.random() < 0.5 else (),
        displacements=int(n_channels > 1 and rng.random() < 0.3),
        band=(f[0] / 1.25, 1.2 * f[-1]),
    )  # fmt: skip
    return record(rng, "varied", machine, 1000.0, float(np.exp(rng.uniform(*np.log([20, 120])))))


def eight_modes(rng: np.random.Generator) -> World:
    """Draw a structure: eight modes from 5 to 45 Hz, a close pair, a weak one, harmonics."""
    zeta = np.exp(rng.uniform(np.log(0.004), np.log(0.015), 8))
    f = np.array([6.2, 9.5, 13.8, 18.5, 24.0, 30.5, 35.5, 41.5]) * (
        1 + 0.04 * rng.uniform(-1, 1, 8)
    )
    pair = int(rng.integers(1, 6))
    f[pair + 1] = f[pair] * (1 + 1.5 * (zeta[pair] + zeta[pair + 1]))
    strength = 10 ** rng.uniform(2.5, 4.0, 8)
    weak = int(rng.choice([k for k in range(1, 7) if k not in (pair, pair + 1)]))
    strength[weak] = 0.01 * np.sqrt(strength[weak - 1] * strength[weak + 1])
    shapes = shapes_of(rng, 6, 8)
    shapes[:, pair + 1] = shapes_apart(rng, shapes[:, pair])
    base = free_place(rng, f, zeta, 10.0, 40.0)
    machine = Machine(
        f, zeta, strength.clip(30.0), shapes, floor_slope=float(rng.uniform(0, 2)),
        steady=(free_place(rng, f, zeta, 8.0, 20.0), free_place(rng, f, zeta, 20.0, 44.0)),
        wandering=(base,), band=(4.0, 48.0), harmonic_level=float(10 ** rng.uniform(-1, 0.5)),
    )  # fmt: skip
    return record(
        rng, "eight modes", machine, 128.0, float(np.exp(rng.uniform(*np.log([150, 600]))))
    )


def turbine(rng: np.random.Generator) -> World:
    """Draw the first mode of a tower at low frequency, and a rotor harmonic that wanders."""
    shapes = shapes_of(rng, 8, 1)
    shapes[6:] *= 0.03
    machine = Machine(
        np.array([rng.uniform(0.35, 0.4)]), rng.uniform(0.008, 0.02, 1),
        10 ** rng.uniform(2.3, 2.6, 1), shapes, floor_slope=1.0, band=(0.2, 1.5),
        wandering=(float(rng.uniform(0.75, 0.85)),), harmonic_level=float(rng.uniform(0.3, 3.0)),
    )  # fmt: skip
    return record(rng, "turbine", machine, 30.0, 600.0)


FAMILIES: dict[str, Callable[[np.random.Generator], World]] = {
    "four modes": four_modes, "varied": varied, "eight modes": eight_modes, "turbine": turbine
}  # fmt: skip


def shapes_of(rng: np.random.Generator, n_channels: int, n_modes: int) -> Array:
    """Draw shapes, ``(n_channels, n_modes)``, with a largest component of one."""
    shapes = rng.choice([-1.0, 1.0], (n_channels, n_modes))
    shapes *= 10 ** rng.uniform(-1, 0, (n_channels, n_modes))
    return np.asarray(shapes / np.abs(shapes).max(axis=0))


def shapes_apart(rng: np.random.Generator, shape: Array) -> Array:
    """Draw a shape whose modal assurance criterion with another one is below 0.3."""
    while True:
        other = shapes_of(rng, shape.size, 1)[:, 0]
        if (shape @ other) ** 2 < 0.3 * (shape @ shape) * (other @ other):
            return other


def free_place(rng: np.random.Generator, f: Array, zeta: Array, low: float, high: float) -> float:
    """Draw a frequency at least four half-power bandwidths and 4 % from all modes."""
    while True:
        place = float(rng.uniform(low, high))
        if (np.abs(place / f - 1) > np.maximum(8 * zeta, 0.04)).all():
            return place


def record(
    rng: np.random.Generator, family: str, machine: Machine, rate: float, seconds: float
) -> World:
    """Record a machine with floors of unit PSD in the middle of its band (accelerations)."""
    n = round(seconds * rate)
    omega = 2 * np.pi * machine.frequency
    n_channels, m = machine.shapes.shape
    centre = float(np.sqrt(machine.frequency[0] * machine.frequency[-1]))
    # Absolute acceleration per unit PSD of the force: 1 / (4 ζ²) at resonance.
    level = np.sqrt(machine.strength * 4 * machine.damping_ratio**2 * rate / 2)
    common = rng.standard_normal(n + n // 4)
    force = np.sqrt(machine.shared) * common + np.sqrt(1 - machine.shared) * rng.standard_normal(
        (m, n + n // 4)
    )
    response = [_oscillate(w, z, a * u, rate)[:, n // 4 :] for w, z, a, u in
                zip(omega, machine.damping_ratio, level, force, strict=True)]  # fmt: skip
    displacement, acceleration = np.stack(response, axis=1)
    samples = machine.shapes @ acceleration
    for c in range(n_channels):
        samples[c] += coloured(rng, n, rate, centre, machine.floor_slope)
    for c in range(machine.displacements):
        noise = rng.standard_normal(n) * np.sqrt(rate / 2)
        samples[c] = machine.shapes[c] @ displacement + noise / (2 * np.pi * centre) ** 2
    t = np.arange(n) / rate
    typical = np.median(machine.strength * machine.damping_ratio * machine.frequency)
    amplitude = np.sqrt(np.pi * typical * machine.harmonic_level)
    for f0 in (*machine.steady, *machine.wandering):
        phase = 2 * np.pi * f0 * t + rng.uniform(0, 2 * np.pi)
        if f0 in machine.wandering:
            phase = 2 * np.pi * f0 * np.cumsum(1 + 0.01 * _slow(rng, n, rate)) / rate
        sine = amplitude * np.cos(phase)
        for c in range(n_channels):
            gain = float(rng.uniform(0.2, 1.0) * rng.choice([-1, 1]))
            displaced = c < machine.displacements
            samples[c] += gain * sine * (-((2 * np.pi * f0) ** -2) if displaced else 1.0)
    return World(
        family, rate, samples.T.copy(), machine.displacements, machine.band,
        machine.frequency, machine.damping_ratio, machine.steady, machine.wandering,
    )  # fmt: skip


def _oscillate(omega: float, zeta: float, force: Array, rate: float) -> Array:
    """Return displacement and absolute acceleration of a mode, shape ``(2, n)``.

    x'' = -ω² x - 2ζω x' + u with a force u that is constant between samples: the poles are exact.
    """
    rate_of_speed = [-(omega**2), -2 * zeta * omega]
    motion = np.array([[0.0, 1.0], rate_of_speed])
    seen = np.array([[1.0, 0.0], rate_of_speed])
    system = motion, np.array([[0.0], [1.0]]), seen, np.zeros((2, 1))
    numerators, denominator = ss2tf(*cont2discrete(system, 1 / rate)[:4])
    return np.stack([lfilter(numerator, denominator, force) for numerator in numerators])


def coloured(rng: np.random.Generator, n: int, rate: float, centre: float, slope: float) -> Array:
    """Draw a floor of unit one-sided PSD at a frequency, f ** -slope above a twentieth of it."""
    spectrum = np.fft.rfft(rng.standard_normal(2 * n) * np.sqrt(rate / 2))
    frequency = np.fft.rfftfreq(2 * n, 1 / rate).clip(centre / 20)
    return np.fft.irfft(spectrum * (frequency / centre) ** (-slope / 2))[:n]


def _slow(rng: np.random.Generator, n: int, rate: float) -> Array:
    """Draw a velocity that wanders about its mean: unit variance, correlated over 5 s."""
    pole = np.exp(-1 / (5.0 * rate))
    drive = rng.standard_normal(n + round(25 * rate)) * np.sqrt(1 - pole**2)
    return np.asarray(lfilter([1.0], [1.0, -pole], drive)[-n:])


def log_of(world: World) -> Log:
    """Return the record as a log."""
    n, n_channels = world.samples.shape
    channels = tuple(
        Channel("delta_e" if c < world.n_displacements else f"acc_{c}",
                "displacement" if c < world.n_displacements else "acceleration",
                world.samples[:, c].copy())
        for c in range(n_channels)
    )  # fmt: skip
    return Log(world.family, "0" * 64, Metadata(), world.sample_rate, channels, None, ((0, n),), ())
