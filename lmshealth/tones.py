"""Tones: sinusoids far above what is beside them, taken out of the transforms of a segment.

Without a window a strong line leaks into hundreds of ordinates, and masking its peak alone leaves
a hump that a mode beside it takes for its own. Amplitude and phase of a tone wander slowly (mains
by some 10 mHz): over a segment they are a polynomial of low degree. The transform of a Legendre
polynomial times a sinusoid is a spherical Bessel function of the distance from it in ordinates.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import spherical_jn

from lmshealth.arrays import BoolArray, ComplexArray, FloatArray

# An ordinate this many times the median of those beside it is suspected of being a tone.
_TOWERING = 60.0
_BESIDE = (3, 4, 5, 6, 7, 8)
# Numbers of polynomials of the wandering amplitude, tried one after the other, and ordinates to
# either side that they are fitted to.
_TERMS = (4, 8, 12)
_REACH = 400
# A resonance towers, too, but no polynomial explains its surroundings: of a tone they come down to
# this many times what is further away.
_LEFT_OVER = 4.0
_NEAR, _FAR = 10, 40
_MOST_TONES = 200


class Tone(NamedTuple):
    """A tone: index of its channel, its ordinate (a fraction between two) and its mean power.

    The power is the one-sided periodogram that it has in its ordinates together.
    """

    channel: int
    ordinate: float
    power: float


def remove_tones(transforms: ComplexArray) -> tuple[ComplexArray, BoolArray, tuple[Tone, ...]]:
    """Take out the tones of a segment.

    Parameters
    ----------
    transforms : ndarray
        Of all channels at consecutive Fourier frequencies, shape ``(n_ordinates, n_channels)``.

    Returns
    -------
    rest : ndarray
        Without the tones, same shape; where they stood too little is left.
    free : ndarray of bool
        Ordinates at which no tone stands, shape ``(n_ordinates,)``.
    tones : tuple of Tone
        Each in the channel that shows it most clearly.
    """
    power = transforms.real**2 + transforms.imag**2
    free = np.ones(len(transforms), dtype=bool)
    if len(transforms) < 3 * _FAR:
        return transforms, free, ()
    contrast = _contrast(power)
    # With time counted from the middle of the segment every other ordinate changes its sign.
    turn = np.where(np.arange(len(transforms)) % 2, -1.0, 1.0)[:, None]
    rest = transforms * turn
    tones: list[Tone] = []
    suspects = np.flatnonzero(contrast.max(axis=1) > _TOWERING)
    for at in suspects[np.argsort(-contrast[suspects].max(axis=1))][:_MOST_TONES].tolist():
        if not free[at]:
            continue
        channel = int(contrast[at].argmax())
        near = slice(max(0, at - _REACH), at + _REACH + 1)
        found = _without_tone(rest[near], at - near.start, channel)
        if found is None:
            continue
        cleaned, off, foot = found
        lost = rest[near, channel] - cleaned[:, channel]
        tones.append(Tone(channel, at + off, float(np.sum(np.abs(lost) ** 2))))
        rest[near] = cleaned
        free[max(0, at - foot) : at + foot + 1] = False
    return rest * turn, free, tuple(tones)


def _contrast(power: FloatArray) -> FloatArray:
    """Ratio of each ordinate to the median of those three to eight beside it."""
    widest, n = _BESIDE[-1], len(power)
    padded = np.pad(power, ((widest, widest), (0, 0)), mode="reflect")
    beside = [padded[widest + k : widest + k + n] for b in _BESIDE for k in (-b, b)]
    return np.asarray(power / np.median(beside, axis=0).clip(1e-300))


def _without_tone(
    rest: ComplexArray, at: int, channel: int
) -> tuple[ComplexArray, float, int] | None:
    """Take a tone out of all channels about an ordinate.

    Returns what is left, how far the tone stands off that ordinate, and to how many ordinates the
    fit takes the noise out as well; None where no polynomial explains it.
    """
    first = max(0, at - 1)
    power = np.abs(rest[first : at + 2, channel]) ** 2
    place = first + float(np.arange(power.size) @ power / power.sum())
    off = np.arange(len(rest)) - place
    distance = np.abs(off)
    for terms in _TERMS:
        basis = spherical_jn(np.arange(terms), np.pi * distance[:, None])
        basis[:, 1::2] *= np.sign(off)[:, None]
        cleaned = rest - basis @ np.linalg.lstsq(basis, rest, rcond=None)[0]
        foot = terms // 2 + 1
        around = np.abs(cleaned[:, channel]) ** 2
        close = around[(distance > foot) & (distance <= foot + _NEAR)]
        far = around[(distance > foot + _NEAR) & (distance <= foot + _FAR)]
        if close.mean() <= _LEFT_OVER * far.mean():
            return cleaned, place - at, foot
    return None
