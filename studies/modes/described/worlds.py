"""Records of described machines: what their modes, lines and floors are, and the bound on errors.

Responses and floors are those of `studies.modes.without_description`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from studies.harness.data.cramer_rao import Recording, Vibration, joint_bound
from studies.modes.without_description.worlds import (
    Array,
    Machine,
    coloured,
    free_place,
    record,
    shapes_apart,
    shapes_of,
)

SEED = 20261128


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """A record with its truth and its description."""

    samples: Array  # in m/s², (n_samples, n_channels)
    sample_rate: float  # in Hz
    frequency: Array  # true, in Hz, ascending
    described: tuple[int, ...]  # modes of the description
    declared: Array  # their declared frequencies in Hz
    bound: Array  # least standard deviations of ln f, (n_modes,)


def _stage(rng: np.random.Generator, n_channels: int, n_modes: int, strength: Array) -> Machine:
    places = {1: [105.0], 3: [117.0, 131.0, 148.0], 4: [117.0, 126.0, 137.0, 150.0]}[n_modes]
    f = np.array(places) * (1 + 0.01 * rng.uniform(-1, 1, n_modes))
    zeta = rng.uniform(0.008, 0.02, n_modes)
    shapes = shapes_of(rng, n_channels, n_modes)
    return Machine(f, zeta, strength, shapes, shared=0.0, band=(0.75 * f[0], 1.25 * f[-1]))


def _white(rng: np.random.Generator, n_channels: int) -> Machine:
    return _stage(rng, n_channels, 3, np.array([1e4, 3e3, 1e4]))


def _single(rng: np.random.Generator) -> Machine:
    return _stage(rng, 1, 1, 1e4 * 10 ** rng.uniform(-1, 1, 1))


def _pair(rng: np.random.Generator) -> Machine:
    machine = _stage(rng, 4, 4, np.full(4, 1e4))
    f, shapes = machine.frequency.copy(), machine.shapes.copy()
    f[2], shapes[:, 2] = 1.01 * f[1], shapes_apart(rng, shapes[:, 1])
    return replace(machine, frequency=f, shapes=shapes, damping_ratio=rng.uniform(0.006, 0.012, 4))


def _undescribed(rng: np.random.Generator) -> Machine:
    return _stage(rng, 4, 4, np.full(4, 5e3))


def _one_force(rng: np.random.Generator) -> Machine:
    return replace(_white(rng, 4), shared=1.0, strength=np.full(3, 300.0))


def _beside(rng: np.random.Generator) -> Machine:
    """Draw a stage that one force moves, with strong modes below and above the described band."""
    inner = _white(rng, 3)
    return replace(
        inner,
        frequency=np.array([62.0, *inner.frequency, 310.0]),
        damping_ratio=np.array([0.012, *inner.damping_ratio, 0.012]),
        strength=np.array([1e5, 1e4, 1e4, 1e4, 1e4]),
        shapes=shapes_of(rng, 3, 5),
        shared=1.0,
    )


def _mains(rng: np.random.Generator) -> Machine:
    machine = _stage(rng, 3, 3, np.full(3, 5e3))
    level = float(10 ** rng.uniform(-1, 1))
    return replace(machine, steady=(150.0,), harmonic_level=level)


def _many(rng: np.random.Generator, n_channels: int = 8) -> Machine:
    f = np.array([12.0, 17, 24, 31, 40, 52]) * (1 + 0.02 * rng.uniform(-1, 1, 6))
    zeta = rng.uniform(0.006, 0.015, 6)
    steady, wandering = (free_place(rng, f, zeta, 14.0, 50.0) for _ in range(2))
    return Machine(
        f,
        zeta,
        10 ** rng.uniform(2.5, 4, 6),
        shapes_of(rng, n_channels, 6),
        shared=0.0,
        steady=(steady,),
        wandering=(wandering,),
        band=(9.0, 60.0),
    )


# Machine, rate in Hz, seconds, and records.
WORLDS: dict[str, tuple[Callable[[np.random.Generator], Machine], float, float, int]] = {
    "one channel": (_single, 1000.0, 60.0, 48),
    "2 channels": (lambda rng: _white(rng, 2), 1000.0, 20.0, 32),
    "4 channels": (lambda rng: _white(rng, 4), 1000.0, 20.0, 32),
    "8 channels": (lambda rng: _white(rng, 8), 1000.0, 20.0, 16),
    "8 channels, unequal, sloped, coherent floors": (
        lambda rng: _white(rng, 8), 1000.0, 20.0, 16
    ),
    "pair 1 % apart": (_pair, 1000.0, 60.0, 16),
    "a mode is not described": (_undescribed, 1000.0, 20.0, 32),
    "mains in the band of a mode": (_mains, 1000.0, 20.0, 32),
    "8 channels, 6 modes, two harmonics": (_many, 200.0, 300.0, 24),
    "16 channels, 6 modes, two harmonics": (lambda rng: _many(rng, 16), 200.0, 300.0, 12),
    "one force moves all modes": (_one_force, 1000.0, 20.0, 32),
    "one force moves all modes, strong ones outside the band": (_beside, 1000.0, 20.0, 32),
}  # fmt: skip


def case(kind: str, number: int) -> Case:
    """Draw a record of a kind, and a description that is off by 1 % in common and .4 % each."""
    make, rate, seconds, _ = WORLDS[kind]
    rng = np.random.default_rng([SEED, list(WORLDS).index(kind), number])
    machine = make(rng)
    samples = record(rng, kind, machine, rate, seconds).samples
    noise = np.ones(len(machine.shapes))
    if "unequal" in kind:
        samples, noise = _with_more_noise(rng, samples, rate)
    n = machine.frequency.size
    left_out = int(rng.integers(1, n - 1)) if kind == "a mode is not described" else -1
    low, high = machine.band
    described = tuple(k for k in range(n) if k != left_out and low < machine.frequency[k] < high)
    off = 0.01 * rng.uniform(-1, 1) + 0.004 * rng.standard_normal(n)
    force = machine.strength * 4 * machine.damping_ratio**2
    common = machine.shared * np.sqrt(np.outer(force, force))
    # Of more channels than eight the bound takes hours, and is hardly less.
    modes = Vibration(machine.frequency, machine.damping_ratio, machine.shapes[:8])
    matrix = common + (1 - machine.shared) * np.diag(force)
    cov = joint_bound(modes, matrix, Recording(noise[:8], seconds, machine.band))
    return Case(
        samples,
        rate,
        machine.frequency,
        described,
        (machine.frequency * (1 + off))[list(described)],
        np.sqrt(np.diag(cov))[:n],
    )


def _with_more_noise(rng: np.random.Generator, samples: Array, rate: float) -> tuple[Array, Array]:
    """Add floors of other levels and slopes, and one that all channels share; return levels, too.

    The level is that at 130 Hz, the bound that of white independent noise of this level.
    """
    n, n_channels = samples.shape
    shared = coloured(rng, n, rate, 130.0, 2.0)
    levels = np.power(10.0, rng.uniform(-0.5, 0.5, n_channels))
    own = [x * coloured(rng, n, rate, 130.0, rng.uniform(0, 3)) for x in levels.tolist()]
    gains = 0.7 * rng.choice([-1.0, 1.0], n_channels)
    return samples + np.stack(own, axis=1) + np.outer(shared, gains), 1 + levels**2 + gains**2
