"""Noise of a stated spectrum, lines, and what else is tested on them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from lmshealth.io.log import Channel, Log, Metadata

Array = NDArray[np.float64]
Density = Callable[[Array], Array]

RATE = 1000.0
BAND = (10.0, 450.0)
# One-sided density of the noise under all else, in (m/s²)²/Hz.
FLOOR = 0.01
# Where resonances stand, in Hz: none at a round number of ordinates, one or two per octave.
PLACES = (25.3, 61.7, 121.4, 239.8, 388.1)
_CIRCLE = 3  # lengths of the record on the circle that it is cut from


def resonance(f: Array, place: float, damping: float, height_db: float) -> Array:
    """Density of a resonance whose peak stands so far above the floor."""
    x = f / place
    gain = x**4 / ((1 - x**2) ** 2 + (2 * damping * x) ** 2)
    return np.asarray(FLOOR * 10 ** (height_db / 10) * 4 * damping**2 * gain)


def flat(f: Array) -> Array:
    """Density of white noise."""
    return np.full(f.shape, FLOOR)


def coloured(f: Array) -> Array:
    """Density that falls by 30 dB from the bottom of the band, to a floor."""
    return flat(f) * (1 + (300 / np.maximum(f, 1.0)) ** 2)


def resonant(
    f: Array, damping: float, height_db: float, places: tuple[float, ...] = PLACES
) -> Array:
    """Density of white noise with resonances."""
    return flat(f) + sum(resonance(f, place, damping, height_db) for place in places)


def resonances(damping: float, height_db: float, places: tuple[float, ...] = PLACES) -> Density:
    """Return `resonant` as a function of frequency alone."""
    return partial(resonant, damping=damping, height_db=height_db, places=places)


def noise(rng: np.random.Generator, density: Density, seconds: float) -> Array:
    """Make stationary noise: a stretch of a circle on which its spectrum is exact."""
    n = round(seconds * RATE)
    size = 1 << int(np.ceil(np.log2(_CIRCLE * n)))
    f = np.arange(1, size // 2) * RATE / size
    draws = rng.standard_normal((2, f.size))
    spectrum = np.zeros(size // 2 + 1, dtype=complex)
    spectrum[1:-1] = (draws[0] + 1j * draws[1]) * np.sqrt(density(f) * RATE * size / 4)
    return np.asarray(np.fft.irfft(spectrum, size)[:n])


def amplitude(ratio_db: float, density: float, seconds: float) -> float:
    """Amplitude of a line whose ordinate stands so far above the density: A² T / 2 S."""
    return float(np.sqrt(2 * density / seconds * 10 ** (ratio_db / 10)))


def sine(seconds: float, frequency: float, size: float, phase: float) -> Array:
    """Make a line."""
    time = np.arange(round(seconds * RATE)) / RATE
    return size * np.sin(2 * np.pi * frequency * time + phase)


def make_log(values: Array, velocity: Array | None = None) -> Log:
    """Make a log of one accelerometer."""
    return Log(
        name="made",
        digest="0" * 64,
        metadata=Metadata(),
        sample_rate=RATE,
        channels=(Channel("acc", "acceleration", values),),
        reference_velocity=velocity,
        pieces=((0, values.size),),
        refused=(),
    )


def highest_ordinate(values: Array, declared: float) -> bool:
    """Test the highest ordinate against an exponential about the median of its neighbours.

    What is commonly done; right in white noise, and blind to what a resonance is.
    """
    f = np.fft.rfftfreq(values.size, 1 / RATE)
    inside = (f >= BAND[0]) & (f < BAND[1])
    ordinates = np.abs(np.fft.rfft(values - values.mean())) ** 2
    level = median_filter(ordinates, 65) / np.log(2)
    return bool((ordinates[inside] / level[inside]).max() > np.log(inside.sum() / declared))
