"""Records with known truth: modes under white forces, sensors, lines, an encoder's steps.

Everything is made in the frequency domain on a circle several times longer than the record, of
which the record is a stretch: it is stationary, not periodic in itself, and has exactly the stated
spectrum. All power spectral densities are one-sided.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lmshealth.io.log import Log
from lmshealth.stage.description import Description, ModeSpec, Order, Stage
from studies.harness.data.logs import make_log

Array = NDArray[np.float64]

RATE = 1000.0
ENCODER_RATE, COUNT = 20_000.0, 4.8828125e-9
VELOCITY, BALL_PASS_MM = 0.48, 4.0
_CIRCLE = 3
# What makes an encoder count: slow motion of the platform, rms in m, below this frequency in Hz.
_SLOW, _SLOW_BELOW = 50e-9, 15.0


@dataclass(frozen=True)
class Truth:
    """A mode: frequency in Hz, damping ratio, PSD of its force in (m/s²)²/Hz, shape."""

    frequency: float
    damping: float
    psd: float
    shape: tuple[float, ...]

    @property
    def bandwidth(self) -> float:
        """Half-power bandwidth in Hz."""
        return 2 * self.damping * self.frequency


def describe(modes: tuple[Truth, ...]) -> Stage:
    """Describe a machine whose modes are sought within 15 %, each at its place."""
    found = tuple(
        ModeSpec(f"mode_{k}", mode.frequency, mode.damping) for k, mode in enumerate(modes)
    )
    order = (Order("ball pass", BALL_PASS_MM),)
    return Stage(Description(name="simulated", mode=found, order=order), None, "0" * 64)


def accelerations(
    rng: np.random.Generator, modes: tuple[Truth, ...], noise: float, seconds: float, moves: int
) -> Log:
    """Make moves of equal length with pauses as long between them."""
    n = round(seconds * RATE)
    total = n * (2 * moves - 1)
    moved = _moved(rng, modes, total, RATE, displacement=False)
    values = moved + rng.standard_normal(moved.shape) * np.sqrt(noise * RATE / 2)
    pieces = [(2 * k * n, 2 * k * n + n) for k in range(moves)]
    return make_log({f"acc_{c}": row for c, row in enumerate(values)}, RATE, pieces)


def fused(rng: np.random.Generator, modes: tuple[Truth, ...], noise: float, seconds: float) -> Log:
    """Make accelerometers and a following error that all see the same motion.

    The sensor of the following error is as good at 120 Hz as the accelerometers, no better at any
    other frequency.
    """
    n = round(seconds * RATE)
    # The same generator state makes the same forces.
    state = rng.bit_generator.state
    moved = _moved(rng, modes, n, RATE, displacement=False)
    rng.bit_generator.state = state
    error = _moved(rng, modes, n, RATE, displacement=True)[0]
    values = moved + rng.standard_normal(moved.shape) * np.sqrt(noise * RATE / 2)
    floor = noise / (2 * np.pi * 120.0) ** 4
    error = error + rng.standard_normal(n) * np.sqrt(floor * RATE / 2)
    named = {f"acc_{c}": row for c, row in enumerate(values[1:])}
    return make_log({"delta_e": error, **named}, RATE)


def with_lines(
    rng: np.random.Generator, modes: tuple[Truth, ...], noise: float, seconds: float
) -> Log:
    """Add mains, its harmonics and a ball pass at the foot of the resonance.

    Mains wander by some 10 mHz. Each line is as strong as the vibration of the first mode.
    """
    clean = accelerations(rng, modes, noise, seconds, 1)
    n = clean.channels[0].values.size
    time = np.arange(n) / RATE
    wander = 0.01 * np.sin(2 * np.pi * time / 37 + rng.uniform(0, 2 * np.pi))
    turns = np.cumsum(50.0 + wander) / RATE
    phase = rng.uniform(0, 2 * np.pi, 4)
    lines = sum(np.sin(2 * np.pi * k * turns + phase[k]) for k in (1, 2, 3))
    ball = 2 * np.pi * VELOCITY / (1e-3 * BALL_PASS_MM) * (1 - 0.02) * time
    lines = lines + np.sin(ball + phase[0])
    size = np.sqrt(2) * np.std(clean.channels[0].values[:])
    named = {c.name: c.values + size * lines for c in clean.channels}
    return make_log(named, RATE, velocity=0.98 * VELOCITY)


def counted(rng: np.random.Generator, modes: tuple[Truth, ...], snr: float, seconds: float) -> Log:
    """Make a following error in counts of an encoder, whose rounding is all its noise.

    ``snr`` is the modal signal-to-noise ratio of the first mode against that noise.
    """
    n = round(seconds * ENCODER_RATE)
    floor = COUNT**2 / 12 * 2 / ENCODER_RATE
    (first, *_) = modes
    wanted = 4 * first.damping**2 * snr * floor * (2 * np.pi * first.frequency) ** 4
    moved = _moved(rng, modes, n, ENCODER_RATE, displacement=True)[0]
    moved *= np.sqrt(wanted / first.psd)
    size = fft.next_fast_len(_CIRCLE * n, real=True)
    slow = rng.standard_normal(size // 2 + 1) + 1j * rng.standard_normal(size // 2 + 1)
    frequency = np.arange(slow.size) * ENCODER_RATE / size
    slow *= (frequency > 1.0) & (frequency < _SLOW_BELOW)
    motion = fft.irfft(slow, size)[:n]
    error = moved + _SLOW * motion / motion.std()
    return make_log({"delta_e": COUNT * np.round(error / COUNT)}, ENCODER_RATE)


def _moved(
    rng: np.random.Generator, modes: tuple[Truth, ...], n: int, rate: float, *, displacement: bool
) -> Array:
    """Motion of each channel under independent forces, shape ``(n_channels, n)``."""
    size = fft.next_fast_len(_CIRCLE * n, real=True)
    w = 2 * np.pi * np.arange(1, (size + 1) // 2) * rate / size
    spectrum = np.zeros((len(modes[0].shape), size // 2 + 1), dtype=complex)
    for mode in modes:
        w_n = 2 * np.pi * mode.frequency
        response = 1 / (w_n**2 - w**2 + 2j * mode.damping * w_n * w)
        force = rng.standard_normal(w.size) + 1j * rng.standard_normal(w.size)
        force *= response if displacement else -(w**2) * response
        spectrum[:, 1 : w.size + 1] += np.sqrt(mode.psd * rate * size / 4) * np.outer(
            mode.shape, force
        )
    return np.asarray(fft.irfft(spectrum, size)[:, :n])
