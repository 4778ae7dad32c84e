"""Removal of strong sinusoids from the transforms of a segment (README.md, "Tone removal")."""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import minimum_filter1d
from scipy.special import spherical_jn

from lmshealth._private.arrays import BoolArray, ComplexArray, FloatArray
from lmshealth.signal import constants

# Distances in ordinates of the surroundings whose median a peak is compared with.
_SURROUNDINGS = (3, 4, 5, 6, 7, 8)
# Numbers of Legendre polynomials of the varying amplitude. The fewest are used whose residual
# around the sinusoid is at most _FIT_RATIO times that of the most. Amplitude and phase of a line
# vary over seconds, those of a mode faster: _TERMS_PER_SECOND describe the line only.
_TERMS, _FIT_RATIO, _TERMS_PER_SECOND = (4, 8, 12, 16, 24), 1.5, 0.6
# Half-width of the fit, and distances of the near and far surroundings, in ordinates.
_REACH, _NEAR, _FAR = 400, 10, 40
_MOST_SINUSOIDS, _MOST_ROUNDS = 30, 4
# Sinusoids fitted together, strongest first; peaks this close to a stronger one belong to it.
_TOGETHER, _PEAK_WIDTH = 6, 4
# Skirt of a sinusoid relative to the level below which it is not subtracted.
_SKIRT = 0.05


class Sinusoid(NamedTuple):
    """A removed sinusoid: the channel that shows it most clearly, and its fractional ordinate.

    ``power`` is its one-sided periodogram summed over ordinates.
    """

    channel: int
    ordinate: float
    power: float


def remove_sinusoids(
    transforms: ComplexArray, duration: float, protected: BoolArray
) -> tuple[ComplexArray, BoolArray, tuple[Sinusoid, ...]]:
    """Remove the strong sinusoids of a segment from its transforms.

    Transforms are of all channels at consecutive Fourier frequencies, ``(n_ordinates,
    n_channels)``; the duration of the segment is in s; ``protected`` are ordinates of possible
    resonances as narrow as a sinusoid, ``(n_ordinates,)``. The result is the transforms without
    sinusoids (at their ordinates noise is removed as well), the ordinates without a sinusoid,
    ``(n_ordinates,)``, and the sinusoids.
    """
    free = np.ones(len(transforms), dtype=bool)
    if len(transforms) < 3 * _FAR:
        return transforms, free, ()
    # Time counted from the middle of the segment changes the sign of every other ordinate.
    sign = np.where(np.arange(len(transforms)) % 2, -1.0, 1.0)[:, None]
    rest = transforms * sign
    choice = tuple(k for k in _TERMS if k <= max(_TERMS[0], _TERMS_PER_SECOND * duration))
    removed: list[Sinusoid] = []
    for _ in range(_MOST_ROUNDS):
        peaks = [k for k in _peaks(_filled(rest, free)) if free[k] and not protected[k]]
        found = _remove(rest, free, peaks, choice)
        removed += found
        if not found:
            break
    return rest * sign, free, tuple(removed)


def _remove(
    rest: ComplexArray, free: BoolArray, peaks: list[int], choice: tuple[int, ...]
) -> list[Sinusoid]:
    """Remove the peaks that are sinusoids from ``rest`` and ``free``, in place."""
    removed = []
    for at in peaks:
        near = slice(max(0, at - _REACH), min(at + _REACH + 1, len(rest)))
        # Others within reach are fitted, too.
        others = [k for k in peaks if k != at and near.start <= k < near.stop and free[k]]
        places = np.array([_peak_ordinate(rest, k) for k in (at, *others[: _TOGETHER - 1])])
        found = _fit(rest[near], places - near.start, choice)
        if found is None:
            continue
        size, fitted, level = found
        terms = len(size)
        # Of sinusoids too close to each other, as of a comb, one may exceed the sum of all.
        if _residual_power(rest[near] - fitted, level) > _residual_power(rest[near], level):
            continue
        power = np.sum(np.abs(fitted) ** 2, axis=0)
        channel = int(np.argmax(power / level))
        # Less the expected power of the noise.
        own = max(0.0, float(power[channel] - terms * level[channel]))
        removed.append(Sinusoid(channel, float(places[0]), own))
        # Its skirt falls with the square of the distance.
        reach = max(_REACH, int(np.sqrt(np.max(power / level) / _SKIRT) / np.pi))
        if reach > _REACH:
            near = slice(max(0, at - reach), min(at + reach + 1, len(rest)))
            fitted = _basis(near, places[0], terms) @ size
        rest[near] -= fitted
        width = _half_width(terms)
        free[max(0, at - width) : at + width + 1] = False
    return removed


def _filled(rest: ComplexArray, free: BoolArray) -> FloatArray:
    """Return the power, replaced by that of the surroundings where a sinusoid was removed."""
    power = rest.real**2 + rest.imag**2
    edges = np.flatnonzero(np.diff(np.concatenate([[1], free, [1]])))
    for first, last in edges.reshape(-1, 2).tolist():
        around = np.r_[max(0, first - _NEAR) : first, last : last + _NEAR]
        power[first:last] = np.median(power[around[around < len(power)]], axis=0)
    return power


def _peaks(power: FloatArray) -> list[int]:
    """List the ordinates far above their surroundings, of neighbours the highest."""
    contrast = _contrast(power).max(axis=1)
    suspects = np.flatnonzero(contrast > constants.SINUSOID_CONTRAST)
    peaks: list[int] = []
    for at in suspects[np.argsort(-power[suspects].max(axis=1), kind="stable")].tolist():
        if all(abs(at - peak) > _PEAK_WIDTH for peak in peaks):
            peaks.append(at)
    return peaks[:_MOST_SINUSOIDS]


def _peak_ordinate(rest: ComplexArray, at: int) -> float:
    """Interpolate the ordinate of a sinusoid from three transforms.

    At δ above its highest ordinate they are proportional to 1/δ, 1/(1 - δ) and -1/(1 + δ).
    """
    below, own, above = rest[[max(0, at - 1), at, min(at + 1, len(rest) - 1)]]
    channel = int(np.argmax(np.abs(own)))
    ratio = float(((above - below) / own)[channel].real)
    return at + ratio / (1 + float(np.hypot(1, ratio)))


def _contrast(power: FloatArray) -> FloatArray:
    """Return the ratio of each ordinate to the median of its surroundings, if that is large."""
    # The minimum, which is cheaper, bounds the median from below: few ordinates need the median.
    n, first, last = len(power), _SURROUNDINGS[0], _SURROUNDINGS[-1]
    width = last - first + 1
    least = minimum_filter1d(power, width, axis=0)
    centre = first + width // 2
    place = np.arange(n)
    below, above = np.maximum(place - centre, 0), np.minimum(place + centre, n - 1)
    contrast = power / np.minimum(least[below], least[above]).clip(1e-300)
    at, channel = np.nonzero(contrast > constants.SINUSOID_CONTRAST)
    around = np.abs(at[:, None] + np.array([k for b in _SURROUNDINGS for k in (-b, b)]))
    around = np.where(around < n, around, 2 * (n - 1) - around)
    level = np.median(power[around, channel[:, None]], axis=1)
    contrast[at, channel] = power[at, channel] / level.clip(1e-300)
    return np.asarray(contrast)


def _fit(
    rest: ComplexArray, places: FloatArray, choice: tuple[int, ...]
) -> tuple[ComplexArray, ComplexArray, FloatArray] | None:
    """Fit several sinusoids by the fewest polynomials of a choice that suffice.

    Coefficients of the first one, ``(n_terms, n_channels)``, its part of ``rest``, and power of its
    surroundings, ``(n_channels,)``; None where no polynomial explains it.
    """
    apart = np.abs(np.arange(len(rest)) - places[:, None])
    widest = _half_width(choice[-1])
    # Around the other sinusoids the noise is fitted, too.
    alone = (apart[1:] > widest).all(axis=0)

    def left(after: ComplexArray, inner: int, outer: int) -> FloatArray:
        there = alone & (apart[0] > inner) & (apart[0] <= outer)
        if not there.any():
            return np.full(rest.shape[1], np.nan)
        return np.asarray(np.median(np.abs(after[there]) ** 2, axis=0) / np.log(2))

    bases = [_basis(slice(0, len(rest)), place, choice[-1]) for place in places]

    real = np.ascontiguousarray(rest).view(np.float64)

    def fit(terms: int) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        basis = np.hstack([one[:, :terms] for one in bases])
        size = np.linalg.lstsq(basis, real, rcond=None)[0]
        after = np.ascontiguousarray(real - basis @ size).view(np.complex128)
        first = np.ascontiguousarray(size[:terms]).view(np.complex128)
        return first, np.asarray(bases[0][:, :terms] @ first), after

    most, own, after = fit(choice[-1])
    level = left(after, widest, widest + _NEAR)
    far = left(after, widest + _NEAR, widest + _FAR)
    channel = int(np.argmax(np.sum(np.abs(most) ** 2, axis=0) / level))
    if not level[channel] <= constants.SINUSOID_RESIDUAL * far[channel]:
        return None
    for terms in choice[:-1]:
        fewer, part, after = fit(terms)
        width = _half_width(terms)
        if (left(after, width, width + _NEAR) <= _FIT_RATIO * level).all():
            return fewer, part, level
    return most, own, level


def _residual_power(rest: ComplexArray, level: FloatArray) -> float:
    return float(np.sum(np.abs(rest) ** 2 / level))


def _half_width(terms: int) -> int:
    return terms // 2 + 1


def _basis(ordinates: slice, place: float, terms: int) -> FloatArray:
    """Return the transforms of the Legendre polynomials, ``(n_ordinates, n_terms)``."""
    off = np.arange(ordinates.start, ordinates.stop) - place
    basis = spherical_jn(np.arange(terms), np.pi * np.abs(off)[:, None])
    basis[:, 1::2] *= np.sign(off)[:, None]
    return np.asarray(basis)
