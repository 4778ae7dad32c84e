"""Synthetic logs of decays after stops with ambient responses of their modes and noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lmshealth.io.log import Log
from lmshealth.signal.segments import Segment
from tests.signals import Mode, accelerations, make_log


@dataclass(frozen=True)
class Ring:
    """A mode that every stop excites.

    Attributes
    ----------
    frequency, damping : float
        Natural frequency in Hz and damping ratio.
    shape : tuple of float
        Amplitude right after a stop in each channel, m/s².
    ambient : float
        Standard deviation of its ambient response over that amplitude.
    """

    frequency: float
    damping: float
    shape: tuple[float, ...] = (1.0,)
    ambient: float = 0.0

    @property
    def mode(self) -> Mode:
        """Mode under the force that makes that response: its variance is π f S / (4 ζ)."""
        psd = self.ambient**2 * 4 * self.damping / (np.pi * self.frequency)
        return Mode(self.frequency, self.damping, psd, self.shape)


def ring(f: float, zeta: float, amplitude: float, phase: float, n: int, rate: float) -> np.ndarray:
    """Sample a decaying cosine, shape ``(n,)``."""
    t, omega = np.arange(n) / rate, 2 * np.pi * f
    fade = np.exp(-zeta * omega * t)
    return amplitude * fade * np.cos(omega * np.sqrt(1 - zeta**2) * t + phase)


def stop(
    rng: np.random.Generator, rings: Sequence[Ring], n: int, rate: float, noise: float
) -> np.ndarray:
    """Accelerations after one stop, each mode at a random phase, shape ``(n_channels, n)``.

    ``noise`` is the standard deviation of a sample.
    """
    # The circle on which ambient responses are made has to be longer than their memory.
    memory = max(1 / (r.damping * r.frequency) for r in rings)
    size = max(n, int(2 * memory * rate))
    psd = noise**2 * 2 / rate
    x = accelerations(rng, [r.mode for r in rings], size, rate, psd)[:, :n]
    for r in rings:
        wave = ring(r.frequency, r.damping, 1.0, rng.uniform(0, 2 * np.pi), n, rate)
        x = x + np.outer(r.shape, wave)
    return x


def stop_log(
    rng: np.random.Generator,
    rings: Sequence[Ring],
    seconds: float,
    rate: float,
    noise: float,
    n_stops: int = 1,
) -> Log:
    """Make a log of accelerometers ``acc_0``, ``acc_1`` … whose pieces are one decay each."""
    n = round(seconds * rate)
    x = np.concatenate([stop(rng, rings, n, rate, noise) for _ in range(n_stops)], axis=1)
    pieces = [(k * n, (k + 1) * n) for k in range(n_stops)]
    return make_log({f"acc_{k}": row for k, row in enumerate(x)}, rate, pieces=pieces)


def whole(log: Log) -> list[Segment]:
    """Make each piece of a log a segment."""
    return [Segment(start, end, 0.0) for start, end in log.pieces]
