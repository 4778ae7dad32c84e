"""Simulated impact tests with known modes: force and acceleration, exact before sampling noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]

RATE = 2000.0
DELAY = (0.008, 0.12)  # of a second hit, in s


@dataclass(frozen=True)
class Hammer:
    """A machine that is struck, and how."""

    # Natural frequency in Hz, damping ratio, participation
    modes: tuple[tuple[float, float, float], ...]
    blows: int = 4
    seconds: float = 2.0  # from a blow to the next, and after the last
    gap: float = 0.0  # longer waits before every second blow, in s
    tip: float = 0.002  # duration of a pulse in s: half a cosine wave above zero
    white: float = 0.01  # noise of the sensor over the largest acceleration
    force_noise: float = 0.001  # of the force over the mean peak
    double: tuple[int, ...] = ()  # blows with a second hit
    share: tuple[float, float] = (0.1, 0.7)  # its peak over that of the first


def strike(rng: np.random.Generator, hammer: Hammer) -> tuple[Array, Array]:
    """Return force and acceleration, ``(time,)`` each."""
    waits = hammer.seconds + rng.uniform(0, 0.1, hammer.blows)
    waits[1::2] += hammer.gap
    at = 0.3 + np.concatenate([[0.0], np.cumsum(waits[:-1])])
    size = int((at[-1] + waits[-1]) * RATE)
    force = np.zeros(size)
    for k, start in enumerate(at):
        peak = rng.uniform(0.5, 1.5)
        force += _pulse(size, start, peak, hammer.tip)
        if k in hammer.double:
            again = start + rng.uniform(*DELAY)
            force += _pulse(size, again, peak * rng.uniform(*hammer.share), hammer.tip)
    answer = respond(hammer.modes, force)
    answer += hammer.white * np.abs(answer).max() * rng.standard_normal(size)
    return force + hammer.force_noise * rng.standard_normal(size), answer


def _pulse(size: int, start: float, peak: float, tip: float) -> Array:
    """Return a pulse of sin², whose spectrum above the Nyquist frequency is negligible."""
    t = np.arange(size) / RATE - start
    return np.where((t > 0) & (t < tip), peak * np.sin(np.pi * t / tip) ** 2, 0.0)


def respond(modes: tuple[tuple[float, float, float], ...], force: Array) -> Array:
    """Return the acceleration of a machine that is at rest before the force, ``(time,)``."""
    slowest = min(zeta * 2 * np.pi * f for f, zeta, _ in modes)
    size = 2 ** int(np.ceil(np.log2(force.size + 25 / slowest * RATE)))
    w = 2 * np.pi * np.fft.rfftfreq(size, 1 / RATE)
    response = sum(
        -(w**2) * p / ((2 * np.pi * f) ** 2 - w**2 + 2j * zeta * 2 * np.pi * f * w)
        for f, zeta, p in modes
    )
    return np.asarray(np.fft.irfft(np.fft.rfft(force, size) * response, size)[: force.size])
