"""Periodic excitation: estimation of the period, and spectra of whole periods."""

from collections.abc import Sequence

import numpy as np
from scipy import fft

from lmshealth._private.arrays import ComplexArray, FloatArray
from lmshealth.io.time_axis import ZEROS, sinc_weights

# Correlation of a signal with itself at a period and its multiples: half of it is no noise.
_REPEATS = 0.5
# The first lag whose correlation is this share of the largest is tried as the period.
_NEAR_BEST = 0.95
# Tolerance of a stated period: clocks and tables differ.
_STATED_WITHIN = 0.01
# Samples by which a peak of the correlation moves at most from a lag to its double.
_REACH = 3
# Periods that slip by less than this many samples over the record are whole numbers of samples.
_SLIP = 0.1
# Samples that are interpolated at once.
_BLOCK = 1 << 14


def find_period(values: FloatArray, stated: float | None = None) -> float | None:
    """Estimate the period of a signal in samples, in general no whole number; None without one.

    The last peak of the autocorrelation determines it to a small fraction of a sample. The peak is
    searched for within 1 % of a stated period, at most half the record; where there is none this is
    returned.
    """
    x, n = values - values.mean(), values.size
    size = fft.next_fast_len(2 * n, real=True)
    transform = fft.rfft(x, size)
    product = fft.irfft(transform.real**2 + transform.imag**2, size)[:n]
    energy = np.concatenate([[0.0], np.cumsum(x**2)])
    both = energy[n:0:-1] + energy[n] - energy[:n]
    # Of the overlap at every lag.
    correlation: FloatArray = 2 * product / np.maximum(both, np.finfo(float).tiny)
    if stated is None:
        for share in (_NEAR_BEST, 1.0):
            first = _first_repeat(correlation, n // 2, share)
            if first is None:
                break
            period = _refine(correlation, first)
            # Narrow-band noise, and lines whose distance nearly divides them, repeat for a while.
            multiples = np.round(np.arange(1, int(n / 2 / period) + 1) * period).astype(int)
            if bool((correlation[multiples] > 0.9 * _REPEATS).all()):
                return period
        return None
    reach = max(_REACH, int(_STATED_WITHIN * stated))
    low, high = max(1, round(stated) - reach), min(n - 2, round(stated) + reach)
    first = low + int(np.argmax(correlation[low : high + 1]))
    if first in (low, high) or correlation[first] < _REPEATS:
        return stated
    return _refine(correlation, first)


def _first_repeat(correlation: FloatArray, longest: int, share: float) -> int | None:
    """Return the first lag whose correlation is this share of the largest."""
    apart = np.flatnonzero(correlation[: longest + 1] < _REPEATS)
    if apart.size == 0:
        return None
    rest = correlation[apart[0] : longest + 1]
    best = float(rest.max())
    if best < _REPEATS:
        return None
    first = int(np.argmax(rest >= share * best))
    # To the top of the peak.
    falls = np.flatnonzero(np.diff(rest[first:]) < 0)
    return int(apart[0]) + first + (int(falls[0]) if falls.size else rest.size - 1 - first)


def _refine(correlation: FloatArray, period: int) -> float:
    """Follow the peak to ever later multiples of the period."""
    estimate, multiple = float(period), 1
    # The peaks of a shorter period are not apart, and the overlap at the end is too short.
    while period > _REACH and multiple * estimate < 0.9 * correlation.size - _REACH:
        centre = round(multiple * estimate)
        low = max(1, centre - _REACH)
        near = correlation[low : centre + _REACH + 1]
        top = int(np.argmax(near))
        if not 0 < top < near.size - 1:
            break
        before, at, after = near[top - 1 : top + 2].tolist()
        vertex = 0.5 * (before - after) / (before - 2 * at + after)
        estimate = (low + top + vertex) / multiple
        multiple *= 2
    return estimate


def cut_periods(signals: Sequence[FloatArray], period: float) -> tuple[ComplexArray, float]:
    """Transform a record period by period; return harmonics and the period as used, in samples.

    The last period ends with the record. A period that is no whole number of samples is
    interpolated onto a grid with a whole number. Amplitudes of the harmonics 0, 1, … have shape
    ``(n_signals, n_periods, n_harmonics)``: a sine of amplitude A has modulus A.
    """
    n = signals[0].size
    whole = round(period)
    n_periods = int(n / period)
    if abs(period - whole) * n_periods <= _SLIP:
        n_periods = n // whole
        start = n - n_periods * whole
        cut = [x[start:].reshape(n_periods, whole) for x in signals]
        period = float(whole)
    else:
        n_periods = int((n - 2 * ZEROS) / period)
        at = (n - ZEROS) - n_periods * period + np.arange(n_periods * whole) * period / whole
        cut = [_interpolate(x, at).reshape(n_periods, whole) for x in signals]
    ramp = (np.arange(whole) - (whole - 1) / 2) / whole
    spectra = []
    for x in cut:
        # A line fitted to a period would remove part of every harmonic; their means hold none.
        mean = x.mean(axis=1)
        slope = np.gradient(mean) if n_periods > 1 else np.zeros(1)
        rest = x - mean[:, None] - slope[:, None] * ramp
        spectra.append(fft.rfft(rest, axis=1) * (2 / whole))
    return np.array(spectra), period


def _interpolate(values: FloatArray, at: FloatArray) -> FloatArray:
    """Interpolate between samples by a windowed sinc."""
    found = np.empty(at.size)
    for first in range(0, at.size, _BLOCK):
        place = at[first : first + _BLOCK]
        weights, index = sinc_weights(place, np.ones(place.size), ZEROS)
        near = values[np.clip(index, 0, values.size - 1)]
        found[first : first + _BLOCK] = np.einsum("ij,ij->i", weights, near)
    return found
