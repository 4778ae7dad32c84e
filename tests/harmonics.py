"""A record from some of its harmonics: what a reading of the following error explains."""

from __future__ import annotations

import numpy as np
from scipy import fft

from lmshealth._private.arrays import FloatArray
from lmshealth.signal.readings import Harmonics, Indices


def rebuild(harmonics: Harmonics, kept: Indices) -> FloatArray:
    """Return the sum of the mean and some harmonics, by index; shape ``(size,)``."""
    size = harmonics.size
    transform = np.zeros(size // 2 + 1, dtype=complex)
    transform[0] = harmonics.mean * size
    half = np.full(harmonics.frequency.size, 0.5 * size)
    if size % 2 == 0:
        half[-1] = size
    transform[kept + 1] = (half * harmonics.amplitude * np.exp(1j * harmonics.phase))[kept]
    return np.asarray(fft.irfft(transform, size))
