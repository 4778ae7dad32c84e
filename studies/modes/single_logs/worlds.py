"""Logs of machines whose excitation is not steady, not flat, or moves their frequencies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lmshealth.io.log import Log
from lmshealth.stage.description import Description, ModeSpec, Stage
from studies.harness.data.logs import make_log

Array = NDArray[np.float64]

RATE, N_CHANNELS = 1000.0, 3
LOGS_OF_MACHINE = 15
# Relative loss of frequency where the level doubles.
SOFTENING = 0.0045
WORLDS = ("steady", "bursts", "log-normal", "ramp", "hump", "softening", "out of phase", "delayed")
# Most phase of a channel in a mode, and delay of the force of a mode in s.
PHASE, DELAY = np.radians(10.0), 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Machine:
    """Modes of a machine and how it is recorded."""

    frequency: Array  # in Hz, ascending, (n_modes,)
    damping_ratio: Array
    shapes: Array  # (n_channels, n_modes)
    snr: Array  # peak of the response of each mode over the noise, (n_modes,)
    seconds: float

    @property
    def stage(self) -> Stage:
        """Its description."""
        values = zip(self.frequency.tolist(), self.damping_ratio.tolist(), strict=True)
        modes = tuple(ModeSpec(f"mode_{k}", f, zeta) for k, (f, zeta) in enumerate(values))
        return Stage(Description(name="simulated", mode=modes), None, "0" * 64)


def draw_machine(rng: np.random.Generator) -> Machine:
    """Draw one to three modes from 95 Hz, ζ 0.8 to 3 %, in three accelerometers of 20 to 60 s."""
    n = int(rng.integers(1, 4))
    zeta = np.exp(rng.uniform(np.log(0.008), np.log(0.03), n))
    f = [float(rng.uniform(95.0, 110.0))]
    for k in range(1, n):
        f.append(f[-1] * (1 + rng.uniform(4, 8) * (zeta[k] + zeta[k - 1])))
    shapes = rng.choice([-1.0, 1.0], (N_CHANNELS, n)) * 10 ** rng.uniform(-0.7, 0, (N_CHANNELS, n))
    return Machine(
        np.array(f), zeta, shapes / np.abs(shapes).max(axis=0), 10 ** rng.uniform(1.5, 3.5, n),
        float(np.exp(rng.uniform(*np.log([20.0, 60.0])))),
    )  # fmt: skip


def record(world: str, machine: Machine, rng: np.random.Generator) -> tuple[Log, Array]:
    """Record a machine in a world; return the log and its natural frequencies then."""
    n, f = round(machine.seconds * RATE), machine.frequency
    size = fft.next_fast_len(2 * n, real=True)
    frequency = np.arange(size // 2 + 1) * RATE / size
    level, gain = 1.0, np.ones(frequency.size)
    if world == "softening":
        level = 2 ** float(rng.uniform(0, 2))
        f = f * (1 - SOFTENING * np.log2(level))
    if world == "hump":
        i = int(rng.integers(f.size))
        width = 2 * machine.damping_ratio[i] * f[i]
        place = f[i] + rng.choice([-1, 1]) * rng.uniform(1, 4) * width
        hump = np.exp(-0.5 * ((frequency - place) / (rng.uniform(1, 3) * width)) ** 2)
        gain = np.sqrt(1 + (rng.uniform(2, 4) - 1) * hump)
    turned = np.ones((N_CHANNELS, f.size, 1))
    if world == "out of phase":
        turned = np.exp(1j * rng.uniform(-PHASE, PHASE, turned.shape))
    if world == "delayed":
        turned = np.exp(-2j * np.pi * rng.uniform(0, DELAY, (1, f.size, 1)) * frequency)
    own = envelope(world, rng, n)
    # The second half of the circle, mirrored, precedes the record.
    amplitude = np.concatenate([own, own[::-1], np.ones(size - 2 * n)])
    amplitude *= level / np.sqrt(np.mean(own**2))
    common = rng.standard_normal(size)
    values = rng.standard_normal((N_CHANNELS, n))
    for i, (centre, zeta) in enumerate(zip(f, machine.damping_ratio, strict=True)):
        force = np.sqrt(0.5) * (common + rng.standard_normal(size)) * amplitude
        beta = frequency / centre
        moved = fft.rfft(force) * gain * -(beta**2) / (1 - beta**2 + 2j * zeta * beta)
        strength = np.sqrt(machine.snr[i]) * 2 * zeta
        parts = machine.shapes[:, [i]] * fft.irfft(turned[:, i] * moved, size)[:, :n]
        values += strength * parts
    values *= np.sqrt(RATE / 2)
    return make_log({f"acc_{c}": row for c, row in enumerate(values)}, RATE), f


def envelope(world: str, rng: np.random.Generator, n: int) -> Array:
    """Draw the amplitude of the force over time, shape ``(n,)``."""
    if world == "bursts":  # 30 % of the time, of 1 to 10 % of the record, 26 dB above the rest
        mean = n * 10 ** rng.uniform(-2, -1)
        own, start, is_on = np.full(n, 0.05), 0, bool(rng.random() < 0.3)
        while start < n:
            stop = start + 1 + int(rng.exponential(mean if is_on else mean * 7 / 3))
            if is_on:
                own[start:stop] = 1.0
            start, is_on = stop, not is_on
        return own
    if world == "log-normal":  # ln intensity of standard deviation 1, over 3 to 20 % of the record
        width = n * 10 ** rng.uniform(-1.5, -0.7)
        smooth = np.exp(-0.5 * ((np.arange(n) - n / 2) / width) ** 2)
        log = fft.irfft(fft.rfft(rng.standard_normal(n)) * fft.rfft(smooth), n)
        return np.asarray(np.exp(0.5 * log / log.std()))
    return np.asarray(10 ** (np.arange(n) / n)) if world == "ramp" else np.ones(n)
