"""Tones: sinusoids far above what is beside them, taken out of the transforms of a segment.

Without a window a strong line leaks into hundreds of ordinates, and masking its peak alone leaves
a hump that a mode beside it takes for its own. Amplitude and phase of a tone wander slowly (mains
by some 10 mHz): over a segment they are a polynomial of low degree. The transform of a Legendre
polynomial times a sinusoid is a spherical Bessel function of the distance from it in ordinates.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import minimum_filter1d
from scipy.special import spherical_jn

from lmshealth._arrays import BoolArray, ComplexArray, FloatArray

# An ordinate this many times the median of those beside it is suspected of being a tone.
_TOWERING = 60.0
_BESIDE = (3, 4, 5, 6, 7, 8)
# Numbers of polynomials of the wandering amplitude, of which the fewest are taken that leave about
# as little in the ordinates beside the tone as the most do, and ordinates to either side that they
# are fitted to.
_TERMS = (4, 8, 12, 16, 24)
# A line's amplitude and phase change over seconds, those of a mode faster: so many polynomials per
# second describe the one and not the other.
_TERMS_PER_SECOND = 0.6
_AS_LITTLE = 1.5
_REACH = 400
# A resonance towers, too, but no polynomial explains its surroundings: of a tone they come down to
# this many times what is further away.
_LEFT_OVER = 4.0
_NEAR, _FAR = 10, 40
_MOST_TONES, _MOST_ROUNDS = 30, 4
# Tones fitted together, the strongest first; suspects this near to a stronger one are its foot.
_TOGETHER, _FOOT = 6, 4
# Share of the level that the skirt of a tone may have where it is left in.
_SKIRT = 0.05


class Sinusoid(NamedTuple):
    """A tone: index of its channel, its ordinate (a fraction between two) and its mean power.

    The power is the one-sided periodogram that it has in its ordinates together.
    """

    channel: int
    ordinate: float
    power: float


def remove_sinusoids(
    transforms: ComplexArray, duration: float, spared: BoolArray
) -> tuple[ComplexArray, BoolArray, tuple[Sinusoid, ...]]:
    """Take out the tones of a segment.

    Parameters
    ----------
    transforms : ndarray
        Of all channels at consecutive Fourier frequencies, shape ``(n_ordinates, n_channels)``.
    duration : float
        Of the segment in s.
    spared : ndarray of bool
        Ordinates at which a resonance may stand that is as narrow as a tone, shape
        ``(n_ordinates,)``.

    Returns
    -------
    rest : ndarray
        Without the tones, same shape; where they stood too little is left.
    free : ndarray of bool
        Ordinates at which no tone stands, shape ``(n_ordinates,)``.
    tones : tuple of Sinusoid
        Each in the channel that shows it most clearly.
    """
    free = np.ones(len(transforms), dtype=bool)
    if len(transforms) < 3 * _FAR:
        return transforms, free, ()
    # With time counted from the middle of the segment every other ordinate changes its sign.
    turn = np.where(np.arange(len(transforms)) % 2, -1.0, 1.0)[:, None]
    rest = transforms * turn
    choice = tuple(k for k in _TERMS if k <= max(_TERMS[0], _TERMS_PER_SECOND * duration))
    tones: list[Sinusoid] = []
    for _ in range(_MOST_ROUNDS):
        peaks = [k for k in _towering(_filled(rest, free)) if free[k] and not spared[k]]
        found = _take_out(rest, free, peaks, choice)
        tones += found
        if not found:
            break
    return rest * turn, free, tuple(tones)


def _take_out(
    rest: ComplexArray, free: BoolArray, peaks: list[int], choice: tuple[int, ...]
) -> list[Sinusoid]:
    """Take out of ``rest`` and of ``free`` what is a tone of some peaks."""
    tones = []
    for at in peaks:
        near = slice(max(0, at - _REACH), min(at + _REACH + 1, len(rest)))
        # Where others stand they are fitted, too.
        others = [k for k in peaks if k != at and near.start <= k < near.stop and free[k]]
        places = np.array([_place(rest, k) for k in (at, *others[: _TOGETHER - 1])])
        found = _fit_tone(rest[near], places - near.start, choice)
        if found is None:
            continue
        size, level = found
        terms = len(size)
        tone = _basis(near, places[0], terms) @ size
        # Of tones too near to each other, as of a comb, one alone may be larger than all together.
        if _energy(rest[near] - tone, level) > _energy(rest[near], level):
            continue
        power = np.sum(np.abs(tone) ** 2, axis=0)
        channel = int(np.argmax(power / level))
        # What the noise adds by itself is not the tone's.
        own = max(0.0, float(power[channel] - terms * level[channel]))
        tones.append(Sinusoid(channel, float(places[0]), own))
        # Its skirt falls with the square of the distance.
        reach = max(_REACH, int(np.sqrt(np.max(power / level) / _SKIRT) / np.pi))
        reached = slice(max(0, at - reach), min(at + reach + 1, len(rest)))
        rest[reached] -= _basis(reached, places[0], terms) @ size
        foot = _foot(terms)
        free[max(0, at - foot) : at + foot + 1] = False
    return tones


def _filled(rest: ComplexArray, free: BoolArray) -> FloatArray:
    """Power, where a tone stood as high as beside it."""
    power = rest.real**2 + rest.imag**2
    edges = np.flatnonzero(np.diff(np.concatenate([[1], free, [1]])))
    for first, last in edges.reshape(-1, 2).tolist():
        beside = np.r_[max(0, first - _NEAR) : first, last : last + _NEAR]
        power[first:last] = np.median(power[beside[beside < len(power)]], axis=0)
    return power


def _towering(power: FloatArray) -> list[int]:
    """List ordinates that tower over those beside them, the highest of neighbours alone."""
    contrast = _contrast(power).max(axis=1)
    suspects = np.flatnonzero(contrast > _TOWERING)
    peaks: list[int] = []
    for at in suspects[np.argsort(-power[suspects].max(axis=1), kind="stable")].tolist():
        if all(abs(at - peak) > _FOOT for peak in peaks):
            peaks.append(at)
    return peaks[:_MOST_TONES]


def _place(rest: ComplexArray, at: int) -> float:
    """Where a tone stands about its highest ordinate.

    δ above it the three have 1/δ, 1/(1 - δ) and -1/(1 + δ) times the same number.
    """
    below, own, above = rest[[max(0, at - 1), at, min(at + 1, len(rest) - 1)]]
    channel = int(np.argmax(np.abs(own)))
    ratio = float(((above - below) / own)[channel].real)
    return at + ratio / (1 + float(np.hypot(1, ratio)))


def _contrast(power: FloatArray) -> FloatArray:
    """Ratio of each ordinate to the median of those three to eight beside it, if that is large."""
    # The median is not below the least, which costs less: most ordinates do not need the median.
    n, first, last = len(power), _BESIDE[0], _BESIDE[-1]
    width = last - first + 1
    least = minimum_filter1d(power, width, axis=0)
    centre = first + width // 2
    place = np.arange(n)
    below, above = np.maximum(place - centre, 0), np.minimum(place + centre, n - 1)
    contrast = power / np.minimum(least[below], least[above]).clip(1e-300)
    at, channel = np.nonzero(contrast > _TOWERING)
    beside = np.abs(at[:, None] + np.array([k for b in _BESIDE for k in (-b, b)]))
    beside = np.where(beside < n, beside, 2 * (n - 1) - beside)
    level = np.median(power[beside, channel[:, None]], axis=1)
    contrast[at, channel] = power[at, channel] / level.clip(1e-300)
    return np.asarray(contrast)


def _fit_tone(
    rest: ComplexArray, places: FloatArray, choice: tuple[int, ...]
) -> tuple[ComplexArray, FloatArray] | None:
    """Fit the first of some tones by polynomials, as few of the choice as will do.

    Returns their sizes in each channel, shape ``(n_terms, n_channels)``, and the level of what is
    beside the tone, ``(n_channels,)``; None where no polynomial explains it.
    """
    apart = np.abs(np.arange(len(rest)) - places[:, None])
    widest = _foot(choice[-1])
    # Where other tones stand the noise is fitted, too.
    alone = (apart[1:] > widest).all(axis=0)

    def left(fit: ComplexArray, inner: int, outer: int) -> FloatArray:
        there = alone & (apart[0] > inner) & (apart[0] <= outer)
        if not there.any():
            return np.full(rest.shape[1], np.nan)
        return np.asarray(np.median(np.abs(fit[there]) ** 2, axis=0) / np.log(2))

    sizes, fits = [], []
    for terms in choice:
        basis = np.hstack([_basis(slice(0, len(rest)), place, terms) for place in places])
        size = np.linalg.lstsq(basis, rest, rcond=None)[0]
        sizes.append(np.asarray(size[:terms], dtype=np.complex128))
        fits.append(rest - basis @ size)
    level = left(fits[-1], widest, widest + _NEAR)
    far = left(fits[-1], widest + _NEAR, widest + _FAR)
    channel = int(np.argmax(np.sum(np.abs(sizes[-1]) ** 2, axis=0) / level))
    if not level[channel] <= _LEFT_OVER * far[channel]:
        return None
    for size, fit in zip(sizes, fits, strict=True):
        foot = _foot(len(size))
        if (left(fit, foot, foot + _NEAR) <= _AS_LITTLE * level).all():
            return size, level
    return sizes[-1], level


def _energy(rest: ComplexArray, level: FloatArray) -> float:
    return float(np.sum(np.abs(rest) ** 2 / level))


def _foot(terms: int) -> int:
    return terms // 2 + 1


def _basis(ordinates: slice, place: float, terms: int) -> FloatArray:
    """Transform the polynomials, shape ``(n_ordinates, n_terms)``."""
    off = np.arange(ordinates.start, ordinates.stop) - place
    basis = spherical_jn(np.arange(terms), np.pi * np.abs(off)[:, None])
    basis[:, 1::2] *= np.sign(off)[:, None]
    return np.asarray(basis)
