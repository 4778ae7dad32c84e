"""How steady the force of a mode is over time, and how flat over frequency (README.md here)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import softmax

from lmshealth._private.arrays import BoolArray, ComplexArray, FloatArray
from lmshealth.modal import constants
from lmshealth.modal.ambient.whittle import Likelihood, Marginal, marginalise, response
from lmshealth.signal.spectra import CrossSpectrum

# Half width of the band whose envelope is read, in damping ratios. The products of its ordinates
# then count over the same lags as those of the scores of ln f and ln ζ, whose correlation falls to
# one half at a lag of the half-power bandwidth.
_BAND = 3.4
# Values of the ratio's logarithm over which its posterior is averaged.
_STEPS = 501
# Bumps to either side of a mode, their width and distance in half-power bandwidths, and least
# distance of two in widths.
_BUMPS, _WIDTH, _APART = 3, 1.5, 0.5
# Log evidence over that of a white force below which a coloured one is not fitted.
_UNLIKELY = -4.0


class Unsteadiness(NamedTuple):
    """Mean square of the intensity over the square of its mean, and the ordinates it is from.

    It is known to (r / n)^½: as many ordinates of a force of the true ratio r are independent.
    """

    ratio: float
    n: int

    @property
    def is_clear(self) -> bool:
        """Whether a steady force would not show this ratio: its standard deviation is n^-½."""
        least = 1 + constants.UNSTEADY_SIGMAS / np.sqrt(max(self.n, 1))
        return bool(self.ratio > max(constants.UNSTEADY, least))

    @property
    def expected(self) -> float:
        """Posterior mean of the ratio: of a force that is steady, or whose ratio is a power law."""
        if not self.n:
            return 1.0
        x = np.linspace(0.0, 1 + np.log(self.n), _STEPS)  # at least one is independent
        std = np.sqrt(np.exp(x) / self.n)
        # A ratio below 1 is chance: a large one, known to little, must not explain it.
        log = -0.5 * ((np.log(max(self.ratio, 1.0)) - x) / std) ** 2 - np.log(std)
        prior = np.exp(-x / constants.MEAN_LN_UNSTEADY)
        weight = np.exp(log - log.max()) * prior / prior.sum()
        weight[0] += np.exp(log[0] - log.max())
        return float(weight @ np.exp(x) / weight.sum())


def unsteadiness(
    spectra: Sequence[CrossSpectrum],
    masks: Sequence[BoolArray],
    expected: Sequence[ComplexArray],
    modes: tuple[FloatArray, FloatArray],
    forces: FloatArray | ComplexArray,
    shapes: FloatArray | ComplexArray,
    i: int,
) -> Unsteadiness:
    """Compute the unsteadiness of the force of mode i from its kurtosis; 1 for a steady force.

    ``masks`` hold the ordinates without lines, ``expected`` the expectation of each spectrum;
    ``modes`` are f in Hz and ζ of all modes of the fit, ``forces`` the covariance of their forces,
    ``(n_modes, n_modes)``, and ``shapes`` are ``(n_modes, n_channels)``.
    """
    every_f, every_zeta = modes
    f, zeta = every_f[i], every_zeta[i]
    fourth = square = total = 0.0
    n = 0
    for spectrum, mask, e in zip(spectra, masks, expected, strict=True):
        near = mask & (np.abs(spectrum.frequency - f) < _BAND * zeta * f)
        if not near.any():
            continue
        place = np.flatnonzero(near)
        # The force given all channels, Σ_j S_ij h_j* φ_jᴴ E⁻¹ F: without the other modes, which
        # forces in common move, only what these leave would remain. At twice the rate of its band.
        h = response(every_f[:, None], every_zeta[:, None], spectrum.frequency[near])
        seen = np.einsum("j,jk,jc->kc", forces[i].conj(), h, shapes)
        weight = np.linalg.solve(e[near], seen[..., None])[..., 0]
        size = 2 * (place[-1] + 1 - place[0])
        force = np.zeros((len(spectrum.transforms), size), dtype=complex)
        force[:, place - place[0]] = np.sum(spectrum.transforms[:, near] * weight.conj(), axis=2)
        intensity = np.abs(np.fft.ifft(force, axis=1) * size) ** 2 / spectrum.duration
        fourth += spectrum.observed * float(np.mean(intensity**2))
        square += spectrum.observed * float(np.mean(intensity))
        total += spectrum.observed
        n += spectrum.count * place.size
    return Unsteadiness(total * fourth / (2 * square**2) if n else 1.0, n)


class Colour(NamedTuple):
    """Posterior of ``[ln f, ln ζ]`` averaged over white and coloured forces."""

    mean: FloatArray
    cov: FloatArray  # for a white force
    more: FloatArray  # what coloured forces add to it
    probability: float  # of a coloured force


def average_colours(
    likelihood: Likelihood, p: FloatArray, white: Marginal, ratio: float = 1.0
) -> Colour:
    """Average a posterior over white forces and forces of a smooth spectrum, by their evidence.

    ``p`` is the posterior mode of white forces, ``white`` its marginal. Ordinates of forces of an
    unsteadiness ``ratio`` are correlated, and count as so many fewer. Where the search for a
    posterior mode of coloured forces fails, the posterior remains, with a probability of one.
    """
    flat = white
    if ratio > 1:
        blocks = tuple(replace(b, count=b.count / ratio) for b in likelihood.blocks)
        likelihood = replace(likelihood, blocks=blocks)
        flat = marginalise(likelihood, p)
    bumps = place_bumps(*np.exp(white.mean).reshape(2, -1))
    q = np.append(p, np.zeros(bumps.shape[1]))
    coloured = likelihood.coloured(bumps, constants.WIDTHS_COLOUR[0])
    guess = marginalise(coloured, q)
    if np.isfinite(guess.decrement) and guess.log_evidence - flat.log_evidence < _UNLIKELY:
        return Colour(white.mean, white.cov, np.zeros_like(white.cov), 0.0)
    found = [flat]
    for std in constants.WIDTHS_COLOUR:
        coloured = coloured.with_bump_std(std)
        moved = coloured.minimise(q)
        one = marginalise(coloured, moved)
        if one.decrement < constants.WORST_DECREMENT:
            q = moved
            found.append(_of_same_modes(one, flat))
            if one.log_evidence - flat.log_evidence < _UNLIKELY:
                break
    if len(found) == 1:
        return Colour(white.mean, white.cov, np.zeros_like(white.cov), 1.0)
    weight = softmax([one.log_evidence for one in found])
    mean = weight @ [one.mean for one in found]
    apart = np.array([one.mean for one in found]) - mean
    cov = np.tensordot(weight, [one.cov for one in found], axes=1)
    more = cov + (weight[:, None] * apart).T @ apart - flat.cov
    if ratio > 1:  # beside fewer ordinates than there are it may be negative in a direction
        size, vectors = np.linalg.eigh(more)
        more = (vectors * np.maximum(size, 0.0)) @ vectors.T
    return Colour(white.mean + mean - flat.mean, white.cov, more, 1.0 - float(weight[0]))


def _of_same_modes(coloured: Marginal, white: Marginal) -> Marginal:
    """Leave modes that are other resonances than for a white force where they were.

    They may be poles that described the spectrum of the force: their covariance covers both.
    """
    n = white.mean.size // 2
    most = np.append(2 * np.exp(white.mean[n:]), np.ones(n))
    same = (np.abs(coloured.mean - white.mean) < most).reshape(2, n).all(axis=0)
    kept = np.tile(same, 2)
    apart = np.where(kept, 0.0, coloured.mean - white.mean)
    cov = np.where(np.outer(~kept, ~kept), white.cov, 0.0) + np.outer(apart, apart)
    cov = np.where(np.outer(kept, kept), coloured.cov, cov)
    return coloured._replace(mean=np.where(kept, coloured.mean, white.mean), cov=cov)


def place_bumps(f: FloatArray, zeta: FloatArray) -> FloatArray:
    """Return centres and widths in Hz of bumps around modes, ``(2, n_bumps)``."""
    width = _WIDTH * 2 * zeta * f
    bumps: list[tuple[float, float]] = []
    for k in sorted(range(-_BUMPS, _BUMPS + 1), key=abs):
        for place, own in zip((f + k * width).tolist(), width.tolist(), strict=True):
            if all(abs(place - other) > _APART * max(own, wide) for other, wide in bumps):
                bumps.append((place, own))
    return np.array(bumps).T
