"""Periodic excitation: how long its period is, and a record cut into whole periods."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import fft

from lmshealth._arrays import ComplexArray, FloatArray

# A signal that correlates with itself by this much after a lag, and after all its multiples, has
# at least as much of it in common as is noise.
_ALIKE = 0.5
# Of several such lags the first that comes so close to the best is the period.
_NEAR_BEST = 0.95
# A stated period is taken to be right within this share: clocks and tables differ.
_STATED_WITHIN = 0.01
# Tracking a peak of the correlation from lag to double lag, it moves by no more samples than this.
_REACH = 3
# Periods that slip by less than this many samples over the record are whole numbers of samples.
_SLIP = 0.1
# Samples to either side of the interpolating kernel, and its shape: below 0.45 of the sample rate
# what it leaves wrong is some 1e-4 of the signal.
_HALF_WIDTH, _KAISER = 32, 8.0
_BLOCK = 1 << 14


def find_period(values: FloatArray, stated: float | None = None) -> float | None:
    """Find after how many samples a signal repeats itself.

    The correlation of the record with itself has a peak at the period and at each of its
    multiples. The last one tells the period to a small fraction of a sample.

    Parameters
    ----------
    values : ndarray
        Shape ``(n_samples,)``.
    stated : float, optional
        Samples in a period as far as known, at most half the record: the peak is sought within
        1 % of it, and where there is none the stated value stands.

    Returns
    -------
    float or None
        Samples in a period, in general no whole number; None for a signal that does not repeat.
    """
    alike = _self_correlation(values)
    n = values.size
    if stated is None:
        first = _first_repeat(alike, n // 2)
        if first is None:
            return None
        period = _refine(alike, first)
        # A narrow band of noise repeats itself too, but not for long.
        multiples = np.round(np.arange(1, int(n / 2 / period) + 1) * period).astype(int)
        return period if bool((alike[multiples] > 0.9 * _ALIKE).all()) else None
    reach = max(_REACH, int(_STATED_WITHIN * stated))
    low, high = max(1, round(stated) - reach), min(n - 2, round(stated) + reach)
    first = low + int(np.argmax(alike[low : high + 1]))
    if first in (low, high) or alike[first] < _ALIKE:
        return stated
    return _refine(alike, first)


def _self_correlation(values: FloatArray) -> FloatArray:
    """Correlate a record with itself at every lag, over what overlaps, shape ``(n_samples,)``."""
    x = values - values.mean()
    n = x.size
    size = fft.next_fast_len(2 * n, real=True)
    transform = fft.rfft(x, size)
    product = fft.irfft(transform.real**2 + transform.imag**2, size)[:n]
    energy = np.concatenate([[0.0], np.cumsum(x**2)])
    both = energy[n:0:-1] + energy[n] - energy[:n]
    return np.asarray(2 * product / np.maximum(both, np.finfo(float).tiny))


def _first_repeat(alike: FloatArray, longest: int) -> int | None:
    apart = np.flatnonzero(alike[: longest + 1] < _ALIKE)
    if apart.size == 0:
        return None
    rest = alike[apart[0] : longest + 1]
    best = float(rest.max())
    if best < _ALIKE:
        return None
    first = int(np.argmax(rest >= _NEAR_BEST * best))
    # Up the slope on which that lag lies.
    falls = np.flatnonzero(np.diff(rest[first:]) < 0)
    return int(apart[0]) + first + (int(falls[0]) if falls.size else rest.size - 1 - first)


def _refine(alike: FloatArray, period: int) -> float:
    """Follow the peak to later and later multiples of the period."""
    estimate, multiple = float(period), 1
    # Towards the end little overlaps.
    while multiple * estimate < 0.9 * alike.size - _REACH:
        centre = round(multiple * estimate)
        low = max(1, centre - _REACH)
        near = alike[low : centre + _REACH + 1]
        top = int(np.argmax(near))
        if not 0 < top < near.size - 1:
            break
        before, at, after = near[top - 1 : top + 2].tolist()
        vertex = 0.5 * (before - after) / (before - 2 * at + after)
        estimate = (low + top + vertex) / multiple
        multiple *= 2
    return estimate


def cut_periods(signals: Sequence[FloatArray], period: float) -> tuple[ComplexArray, float]:
    """Transform a record period by period.

    The last period ends where the record does. A drift is taken out first: the mean of a period
    holds nothing of what repeats, so that the slope from each mean to the next is that of the
    drift alone; a straight line fitted to a period would take some of every harmonic along.

    Where the period is no whole number of samples they are interpolated onto a grid that has a
    whole number per period: cut at the nearest sample, every period would leak into its
    harmonics in another way.

    Parameters
    ----------
    signals : sequence of ndarray
        Of the same length, shape ``(n_samples,)`` each.
    period : float
        In samples; the record holds at least two.

    Returns
    -------
    spectra : ndarray of complex
        Amplitudes of the harmonics 0, 1, … of every signal and period: a sine of amplitude A has
        modulus A, shape ``(n_signals, n_periods, n_harmonics)``.
    period : float
        In samples, as it was cut.
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
        n_periods = int((n - 2 * _HALF_WIDTH) / period)
        at = (n - _HALF_WIDTH) - n_periods * period + np.arange(n_periods * whole) * period / whole
        cut = [_interpolate(x, at).reshape(n_periods, whole) for x in signals]
    spectra = [fft.rfft(_without_drift(x), axis=1) * (2 / whole) for x in cut]
    return np.array(spectra), period


def _without_drift(periods: FloatArray) -> FloatArray:
    n_periods, size = periods.shape
    mean = periods.mean(axis=1)
    slope = np.gradient(mean) if n_periods > 1 else np.zeros(1)
    ramp = (np.arange(size) - (size - 1) / 2) / size
    return np.asarray(periods - mean[:, None] - slope[:, None] * ramp)


def _interpolate(values: FloatArray, at: FloatArray) -> FloatArray:
    """Interpolate between samples by a sinc under a Kaiser window, at places within the record."""
    offsets = np.arange(1 - _HALF_WIDTH, _HALF_WIDTH + 1)
    found = np.empty(at.size)
    for first in range(0, at.size, _BLOCK):
        place = at[first : first + _BLOCK]
        floor = np.floor(place).astype(int)
        distance = (place - floor)[:, None] - offsets
        window = np.i0(_KAISER * np.sqrt(np.maximum(0.0, 1 - (distance / _HALF_WIDTH) ** 2)))
        kernel = np.sinc(distance) * window / np.i0(_KAISER)
        index = np.clip(floor[:, None] + offsets, 0, values.size - 1)
        found[first : first + _BLOCK] = np.sum(kernel * values[index], axis=1)
    return found
