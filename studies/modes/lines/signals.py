"""Noise of known density, lines, logs of them, and the test on a whole record."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from lmshealth.calibration.ranks import clopper_pearson
from lmshealth.io.log import Channel, Log, Metadata
from lmshealth.signal.segments import Segment
from lmshealth.signal.spectral_lines import find_lines
from studies.harness.study import Row

Array = NDArray[np.float64]
Density = Callable[[Array], Array]
RATE, BAND = 1000.0, (10.0, 450.0)
SHORT, LONG = 3.0, 30.0
# One-sided density of the noise under all else, in (m/s²)²/Hz.
FLOOR = 0.01
# Where resonances stand, in Hz: none at a round number of ordinates, one or two per octave.
PLACES = (25.3, 61.7, 121.4, 239.8, 388.1)
USUAL, LEVEL = 0.01, 0.99
_CIRCLE = 3  # lengths of the record on the circle that it is cut from


def rng_of(*key: int) -> np.random.Generator:
    """Return the generator of a part."""
    return np.random.default_rng([20261121, *key])


def flat(f: Array) -> Array:
    """Return the density of white noise."""
    return np.full(f.shape, FLOOR)


def coloured(f: Array) -> Array:
    """Return a density that falls by 30 dB from the bottom of the band, to a floor."""
    return flat(f) * (1 + (300 / np.maximum(f, 1.0)) ** 2)


def resonances(damping: float, height_db: float, places: tuple[float, ...] = PLACES) -> Density:
    """Return the density of white noise with resonances, whose peaks are so far above the floor."""
    peak = FLOOR * 10 ** (height_db / 10) * 4 * damping**2

    def density(f: Array) -> Array:
        x = f / np.reshape(places, (-1,) + (1,) * np.ndim(f))
        return flat(f) + peak * np.sum(x**4 / ((1 - x**2) ** 2 + (2 * damping * x) ** 2), axis=0)

    return density


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
    """Return the amplitude of a line whose ordinate A² T / 2 S is so far above the density."""
    return float(np.sqrt(2 * density / seconds * 10 ** (ratio_db / 10)))


def sine(seconds: float, frequency: float, size: float, phase: float) -> Array:
    """Make a line."""
    time = np.arange(round(seconds * RATE)) / RATE
    return size * np.sin(2 * np.pi * frequency * time + phase)


def channel_of(values: Array) -> Channel:
    """Make an accelerometer's channel."""
    return Channel("acc", "acceleration", values)


def make_log(values: Array, velocity: Array | None = None) -> Log:
    """Make a log of one accelerometer."""
    pieces = ((0, values.size),)
    return Log("made", "0" * 64, Metadata(), RATE, (channel_of(values),), velocity, pieces, ())


def tested(values: Array, declared: float) -> Array:
    """Find lines in a whole record: frequencies and amplitudes."""
    whole = (Segment(0, values.size, np.nan),)
    return find_lines(channel_of(values), whole, RATE, BAND, declared)


def highest_ordinate(values: Array) -> bool:
    """Test the highest ordinate against an exponential about the median of its neighbours.

    This usual test is right in white noise, and takes a resonance for a line.
    """
    f = np.fft.rfftfreq(values.size, 1 / RATE)
    inside = (f >= BAND[0]) & (f < BAND[1])
    ordinates = np.abs(np.fft.rfft(values - values.mean())) ** 2
    level = median_filter(ordinates, 65) / np.log(2)
    return bool((ordinates[inside] / level[inside]).max() > np.log(inside.sum() / USUAL))


def rated(hits: int, n: int, declared: float) -> Row:
    """Compare a rate with the declared one."""
    low, high = clopper_pearson(hits, n, LEVEL)
    return {"declared": declared, "hits": hits, "n": n, "low": low, "high": high,
            "raised": bool(low > declared)}  # fmt: skip
