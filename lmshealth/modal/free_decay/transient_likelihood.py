"""Likelihood of decays in noise that holds the same modes.

What a lightly damped mode does after a stop is a decay plus the response to whatever still shakes
it. A stretch of both transforms to the mode's transient, of unknown size, plus ordinates that are
independent from frequency to frequency with the power spectral density of the response. Sizes are
marginalised in the restricted likelihood, which does not depend on how they are parametrised and
does not lose the degrees of freedom that they take.

Free vibration in the frequency domain: what a stretch of it transforms to.

The discrete Fourier transform of a stretch of a decaying mode is exactly a transient that has the
mode's pole, its size given by the state at the beginning less the state at the end: no window, no
leakage, no correction for short records.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import fft, linalg

from lmshealth._arrays import ComplexArray, FloatArray

# Degree of the polynomial, over the band, of what leaks into it from outside.
_DEGREE = 2
# Directions in which the base of that leakage is thinner than this are dropped.
_THIN = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Stretches of one length in a band of the frequency domain.

    Attributes
    ----------
    frequency : ndarray
        Fourier frequencies in Hz, shape ``(n_ordinates,)``.
    ordinates : ndarray of complex
        Transform, scaled so that its squared magnitude is the one-sided periodogram, shape
        ``(n_segments, n_ordinates, n_channels)``.
    duration : float
        Length of each stretch in s.
    sample_rate : float
        In Hz.
    base : ndarray of complex
        Orthonormal base of what leaks into the band from outside, ``(n_ordinates, n_base)``.
    """

    frequency: FloatArray
    ordinates: np.ndarray
    duration: float
    sample_rate: float
    base: np.ndarray

    @property
    def stacked(self) -> FloatArray:
        """Real above imaginary parts, shape ``(2 n_ordinates, n_channels, n_segments)``."""
        y = np.concatenate([self.ordinates.real, self.ordinates.imag], axis=1)
        return np.asarray(np.moveaxis(y, 0, -1))


def make_block(samples: FloatArray, sample_rate: float, low: float, high: float) -> Block:
    """Transform stretches of one length.

    A linear trend is taken out exactly: over a record it has a pole at zero frequency. A constant
    is nothing at Fourier frequencies.

    Parameters
    ----------
    samples : ndarray
        Shape ``(n_segments, n_samples, n_channels)``.
    sample_rate : float
        In Hz.
    low, high : float
        Band in Hz.
    """
    n = samples.shape[1]
    frequency = np.arange(1, (n + 1) // 2) * (sample_rate / n)
    band = (frequency >= low) & (frequency <= high)
    ordinates = fft.rfft(samples, axis=1)[:, 1 : (n + 1) // 2][:, band]
    frequency = frequency[band]
    place = np.linspace(-1, 1, frequency.size)
    leaks = np.polynomial.legendre.legvander(place, _DEGREE).astype(complex)
    trend = 1 / (1 - np.exp(-2j * np.pi * frequency / sample_rate))
    leaks = np.concatenate([leaks, trend[:, None]], axis=1)
    leaks /= np.linalg.norm(leaks, axis=0)
    base, size, _ = np.linalg.svd(leaks, full_matrices=False)
    return Block(
        frequency=frequency,
        ordinates=ordinates * np.sqrt(2 / (n * sample_rate)),
        duration=n / sample_rate,
        sample_rate=sample_rate,
        base=base[:, size > _THIN * size[0]],
    )


def stack(values: np.ndarray) -> FloatArray:
    """Put real above imaginary parts."""
    return np.concatenate([values.real, values.imag], axis=0)


def transient(block: Block, f: FloatArray, zeta: FloatArray) -> np.ndarray:
    """Transform decays at positive frequencies, up to a constant, without derivatives.

    Parameters
    ----------
    block : Block
        Where.
    f, zeta : ndarray
        Natural frequencies in Hz and damping ratios, shape ``(n,)``.

    Returns
    -------
    ndarray of complex
        Shape ``(n_ordinates, n)``.
    """
    exponent = 2 * np.pi * f * (-zeta + 1j * np.sqrt(1 - zeta**2)) / block.sample_rate
    back = np.exp(-2j * np.pi * block.frequency / block.sample_rate)
    return np.asarray(1 / (1 - np.exp(exponent) * back[:, None]))


def pole_columns(block: Block, f: FloatArray, zeta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Transform decaying cosines and sines, up to a constant, with derivatives.

    Samples Re(a ρⁿ) transform to c/(1 − ρ z⁻¹) + c*/(1 − ρ* z⁻¹) with c = a (1 − ρᴺ)/2, because
    z⁻ᴺ = 1 at Fourier frequencies.

    Parameters
    ----------
    block : Block
        Where.
    f, zeta : ndarray
        Natural frequencies in Hz and damping ratios, shape ``(n_modes,)``.

    Returns
    -------
    columns : ndarray
        Of the real and the imaginary part of each c, shape ``(n_modes, 2 n_ordinates, 2)``.
    slopes : ndarray
        Their derivatives by ln f and ln ζ, shape ``(2, n_modes, 2 n_ordinates, 2)``.
    """
    back = np.exp(-2j * np.pi * block.frequency / block.sample_rate)
    omega, root = 2 * np.pi * f / block.sample_rate, np.sqrt(1 - zeta**2)
    exponent = omega * (-zeta + 1j * root)
    pole = np.exp(exponent)
    turns = pole * np.array([exponent, -omega * zeta * (1 + 1j * zeta / root)])
    # This scale makes sizes of order one for a decay as long as the record.
    scale = 1 / (block.sample_rate * block.duration)
    up = scale / (1 - pole[:, None] * back)
    down = scale / (1 - pole.conj()[:, None] * back)
    d_up = back * up**2 / scale * turns[..., None]
    d_down = back * down**2 / scale * turns.conj()[..., None]

    def pair(up: ComplexArray, down: ComplexArray) -> FloatArray:
        both = np.stack([up + down, 1j * (up - down)], axis=-1)
        return np.concatenate([both.real, both.imag], axis=-2)

    return pair(up, down), pair(d_up, d_down)


IntArray = NDArray[np.intp]

# A decay of less than this share over the record is none, and damping cannot be that heavy.
_LEAST_DECAY, _HEAVIEST = 0.01, 0.5
# A pole further off the band than this factor only runs away.
_BEYOND = 2.0
# Of the logarithm of a frequency or damping: this near to its bound it stands there.
_AT_BOUND = 1e-6
# Standard deviations of the logarithm of the white noise about what is seen between the peaks, and
# of its slope over half of the band.
_LEVEL_STD, _SLOPE_STD = 3.0, 1.0


def unit_level(f: float, zeta: float, duration: float, *, displacement: bool = False) -> float:
    """Response to a white force of density one at one Fourier frequency above the resonance.

    Parameters
    ----------
    f, zeta : float
        Natural frequency in Hz and damping ratio.
    duration : float
        Of the record in s.
    displacement : bool
        Of a displacement, in the unit of the force times 1/ω_n², and not of an acceleration.
    """
    beta2 = (f / (f + 1 / duration)) ** 2
    level = 1 / ((1 - beta2) ** 2 + 4 * zeta**2 * beta2)
    return float(level * beta2**2 if displacement else level)


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """The restricted likelihood of one or more blocks at one point.

    Attributes
    ----------
    value : float
        Negative log restricted likelihood.
    profile : float
        Negative log likelihood at the best sizes: this, unlike the former, can be compared
        between different numbers of modes.
    gradient : ndarray
        Of ``value``, shape ``(n_parameters,)``.
    fisher : ndarray
        Fisher information of the likelihood at the best sizes, shape
        ``(n_parameters, n_parameters)``.
    fits : tuple of BlockFit
        What is left of each block.
    """

    value: float
    profile: float
    gradient: FloatArray
    fisher: FloatArray
    fits: tuple[BlockFit, ...]


@dataclass(frozen=True, slots=True, eq=False)
class BlockFit:
    """A block whitened by its noise, and what the columns leave of it.

    Attributes
    ----------
    residual : ndarray
        White with variance one half, shape ``(2 n_ordinates n_channels, n_segments)``.
    sizes : ndarray
        Of each column, those of the base first, shape ``(n_channels, n_columns, n_segments)``.
    removed : ndarray
        Orthonormal base of what was fitted away from the whitened data, shape
        ``(2 n_ordinates n_channels, n_removed)``.
    tangent : ndarray
        Change of the whitened transients by ln f and ln ζ of each mode as far as the sizes cannot
        undo it, shape ``(2 n_modes, 2 n_ordinates n_channels, n_segments)``.
    """

    residual: FloatArray
    sizes: FloatArray
    removed: FloatArray
    tangent: FloatArray


@dataclass(frozen=True, eq=False)
class TransientLikelihood:
    """Restricted likelihood of transients of some modes in white and ambient noise.

    The parameters are ``[ln f, ln ζ, h]`` of all modes, then the logarithm of the white noise's
    power spectral density in the middle of the band and its slope for each channel. The noise's
    covariance at a frequency is diag(S_e) + Σ h² D φφᵀ.

    Attributes
    ----------
    blocks : tuple of Block
        Data.
    shapes : ndarray
        φ, the mode's part in each channel, shape ``(n_modes, n_channels)``.
    units : ndarray
        What D is divided by, shape ``(n_modes,)``.
    levels : ndarray
        Where the white noise's logarithm is expected, shape ``(n_channels,)``: all that tells it
        where the ambient response hides it.
    displacement : bool
        D is that of a displacement, not of an acceleration.

    References
    ----------
    Harville1977, Pintelon2012
    """

    blocks: tuple[Block, ...]
    shapes: FloatArray
    units: FloatArray
    levels: FloatArray
    displacement: bool = False

    @property
    def n_modes(self) -> int:
        """Number of modes."""
        return int(self.shapes.shape[0])

    @property
    def n_channels(self) -> int:
        """Number of channels."""
        return int(self.blocks[0].ordinates.shape[2])

    @property
    def n_parameters(self) -> int:
        """Number of parameters."""
        return 3 * self.n_modes + 2 * self.n_channels

    def evaluate(self, p: FloatArray) -> Evaluation:
        """Evaluate the likelihood, its gradient and its Fisher information.

        Parameters
        ----------
        p : ndarray
            Shape ``(n_parameters,)``.
        """
        parts = [self._evaluate_block(block, p) for block in self.blocks]
        gradient = np.sum([part.gradient for part in parts], axis=0)
        fisher = np.sum([part.fisher for part in parts], axis=0)
        n = self.n_channels
        white = np.arange(p.size - 2 * n, p.size)
        std = np.repeat([_LEVEL_STD, _SLOPE_STD], n)
        off = (p[white] - np.concatenate([self.levels, np.zeros(n)])) / std
        gradient[white] += off / std
        fisher[white, white] += std**-2
        prior = 0.5 * float(off @ off)
        return Evaluation(
            value=prior + sum(part.value for part in parts),
            profile=prior + sum(part.profile for part in parts),
            gradient=gradient,
            fisher=fisher,
            fits=tuple(part.fits[0] for part in parts),
        )

    def clip(self, p: FloatArray) -> FloatArray:
        """Keep poles about the band, and dampings where they are no line's and not nothing's."""
        m = self.n_modes
        kept = p + 0.0
        # The bound of a damping goes with its frequency.
        kept[:m] = np.clip(p[:m], *(bound[:m] for bound in self._bounds(p)))
        kept[: 2 * m] = np.clip(kept[: 2 * m], *self._bounds(kept))
        return kept

    def _bounds(self, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Give the least and the most of ln f and ln ζ of each mode, both ``(2 n_modes,)``."""
        low, high = self._band
        ones = np.ones(self.n_modes)
        least = np.concatenate([np.log(low / _BEYOND) * ones, self.least_damping(p)])
        return least, np.concatenate([np.log(high * _BEYOND) * ones, np.log(_HEAVIEST) * ones])

    def least_damping(self, p: FloatArray) -> FloatArray:
        """Give ln ζ of each mode below which it is a line, shape ``(n_modes,)``."""
        cycles = np.exp(p[: self.n_modes]) * self._duration
        return np.asarray(np.log(_LEAST_DECAY / (2 * np.pi * cycles)))

    def metric(self, at: Evaluation) -> FloatArray:
        """Lend the Fisher information what it lacks where a parameter loses its effect.

        At h = 0 the curvature is the derivative by h², which noise makes of this size; and dampings
        that do nothing any more must not run away.
        """
        m = self.n_modes
        n_segments = sum(block.ordinates.shape[0] for block in self.blocks)
        metric = at.fisher + 0.0
        metric[range(m, 2 * m), range(m, 2 * m)] += 0.5
        metric[range(2 * m, 3 * m), range(2 * m, 3 * m)] += 2 * np.sqrt(n_segments)
        return np.asarray(metric)

    def reach(self, p: FloatArray) -> FloatArray:
        """Say how far one step may go: half a Fourier frequency, a factor of e, a doubling."""
        m = self.n_modes
        reach = np.ones(p.size)
        reach[2 * m : 3 * m] += np.abs(p[2 * m : 3 * m])
        reach[:m] = 0.5 / (self._duration * np.exp(p[:m]))
        return reach

    def movable(self, p: FloatArray, gradient: FloatArray, free: IntArray) -> IntArray:
        """Leave out frequencies and dampings that stand at their bound and press against it."""
        poles = slice(2 * self.n_modes)
        least, most = self._bounds(p)
        down = gradient[poles] > 0
        low, high = p[poles] <= least + _AT_BOUND, p[poles] >= most - _AT_BOUND
        return np.asarray(np.setdiff1d(free, np.flatnonzero(np.where(down, low, high))))

    def density(self, block: Block, p: FloatArray) -> FloatArray:
        """Give the noise's power spectral density, ``(n_ordinates, n_channels, n_channels)``."""
        directions, level, _ = self._noise(block, p)
        return np.asarray(np.einsum("jk,ja,jb->kab", level, directions, directions))

    def _evaluate_block(self, block: Block, p: FloatArray) -> Evaluation:
        m, n, n_segments = self.n_modes, self.n_channels, block.ordinates.shape[0]
        directions, level, slopes = self._noise(block, p)
        lower = np.linalg.cholesky(np.einsum("jk,ja,jb->kab", level, directions, directions))
        inverse = np.linalg.inv(lower)
        whiten = np.concatenate([inverse, inverse])
        modal, turned = pole_columns(block, np.exp(p[:m]), np.exp(p[m : 2 * m]))
        columns = np.concatenate([stack(block.base), stack(1j * block.base), *modal], axis=1)
        # Rows go through ordinates, then channels; columns through channels, then those of one.
        design = (whiten[:, :, :, None] * columns[:, None, None, :]).reshape(
            2 * n * slopes.shape[1], -1
        )
        data = (whiten @ block.stacked).reshape(design.shape[0], -1)
        q, r = np.linalg.qr(design)
        found = q.T @ data
        residual = data - q @ found
        sizes = linalg.solve_triangular(r, found, check_finite=False).reshape(n, -1, n_segments)

        # Change of the transients by each pole, and of the volume that the columns span.
        first = sizes.shape[1] - 2 * m
        own = sizes[:, first:].reshape(n, m, 2, n_segments)
        change = whiten @ np.einsum("dikp,cips->dikcs", turned, own)
        change = change.reshape(2 * m, *residual.shape)
        tangent = change - q @ (q.T @ change)
        fit = BlockFit(residual, sizes, q, tangent)

        seen = directions @ np.swapaxes(inverse, 1, 2)
        gradient, fisher = _by_noise(fit, np.moveaxis(seen, 1, 0), slopes, m)
        gradient[: 2 * m] += n_segments * _volume_slope(columns, turned, whiten, q, r)
        gradient[: 2 * m] -= 2 * np.sum(residual * change, axis=(1, 2))
        flat = tangent.reshape(2 * m, residual.size)
        fisher[: 2 * m, : 2 * m] += 2 * flat @ flat.T

        log_det = 2 * float(np.log(np.diagonal(lower, axis1=1, axis2=2)).sum())
        profile = n_segments * log_det + float(np.sum(residual**2))
        volume = (
            np.log(np.abs(np.diag(r))).sum() - n / 2 * np.linalg.slogdet(columns.T @ columns)[1]
        )
        return Evaluation(profile + n_segments * float(volume), profile, gradient, fisher, (fit,))

    def _noise(self, block: Block, p: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Give the parts of the noise's covariance, each of rank one.

        Returns
        -------
        directions : ndarray
            Modes, then channels, shape ``(n_modes + n_channels, n_channels)``.
        level : ndarray
            Power spectral density of each, shape ``(n_modes + n_channels, n_ordinates)``.
        slopes : ndarray
            Derivative of its part's level by each parameter, shape
            ``(n_parameters, n_ordinates)``.
        """
        m, n = self.n_modes, self.n_channels
        low, high = self._band
        place = 2 * np.log(block.frequency / low) / np.log(high / low) - 1
        white = np.exp(p[3 * m : 3 * m + n, None] + p[3 * m + n :, None] * place)
        beta2 = (np.exp(p[:m, None]) / block.frequency) ** 2
        damped = 4 * np.exp(2 * p[m : 2 * m, None]) * beta2
        under = (1 - beta2) ** 2 + damped
        shape = (beta2**2 if self.displacement else 1.0) / under / self.units[:, None]
        h = p[2 * m : 3 * m, None]
        modal = h**2 * shape
        by_f = (4 * beta2 * (1 - beta2) - 2 * damped) / under + 4 * self.displacement
        slopes = [modal * by_f, -2 * modal * damped / under, 2 * h * shape, white, white * place]
        directions = np.concatenate([self.shapes, np.eye(n)])
        return directions, np.concatenate([modal, white]), np.concatenate(slopes)

    @cached_property
    def _duration(self) -> float:
        return max(block.duration for block in self.blocks)

    @cached_property
    def _band(self) -> tuple[float, float]:
        low = min(block.frequency[0] for block in self.blocks)
        return float(low), float(max(block.frequency[-1] for block in self.blocks))


def _by_noise(
    fit: BlockFit, seen: FloatArray, slopes: FloatArray, m: int
) -> tuple[FloatArray, FloatArray]:
    """Differentiate by what the parameters do to the noise.

    Every part of its covariance has rank one, so that it acts along one whitened direction.

    Parameters
    ----------
    fit : BlockFit
        The block.
    seen : ndarray
        Whitened directions, shape ``(n_modes + n_channels, n_ordinates, n_channels)``.
    slopes : ndarray
        As of `TransientLikelihood._noise`.
    m : int
        Number of modes.
    """
    n = seen.shape[2]
    n_segments = fit.residual.shape[1]
    part = np.concatenate([np.tile(np.arange(m), 3), m + np.tile(np.arange(n), 2)])

    def along(values: FloatArray) -> FloatArray:
        halves = values.reshape(2, -1, n, values.shape[1])
        return np.asarray(np.sum(np.einsum("jka,hkas->hjks", seen, halves) ** 2, axis=(0, 3)))

    expected = n_segments * (np.sum(seen**2, axis=2) - along(fit.removed) / 2)
    gradient = np.sum(slopes * (expected - along(fit.residual))[part], axis=1)
    overlap = np.einsum("ika,jka->ijk", seen, seen) ** 2
    fisher = n_segments * np.einsum("qk,rk,qrk->qr", slopes, slopes, overlap[np.ix_(part, part)])
    return gradient, fisher


def _volume_slope(
    columns: FloatArray, turned: FloatArray, whiten: FloatArray, q: FloatArray, r: FloatArray
) -> FloatArray:
    """Differentiate ln of the volume of the whitened columns over that of the plain ones.

    Parameters
    ----------
    columns : ndarray
        Shape ``(2 n_ordinates, n_columns)``, those of the poles last.
    turned : ndarray
        As of `pole_columns`.
    whiten : ndarray
        Shape ``(2 n_ordinates, n_channels, n_channels)``.
    q, r : ndarray
        Factors of the whitened columns.

    Returns
    -------
    ndarray
        By ln f and ln ζ of each mode, shape ``(2 n_modes,)``.
    """
    n, m = whiten.shape[1], turned.shape[1]
    whitened = linalg.solve_triangular(r, q.T, check_finite=False)
    plain_q, plain_r = np.linalg.qr(columns)
    plain = linalg.solve_triangular(plain_r, plain_q.T, check_finite=False)
    whitened = np.reshape(whitened, (n, columns.shape[1], -1, n))
    weight = np.einsum("cpka,kac->pk", whitened, whiten) - n * plain
    weight = weight[columns.shape[1] - 2 * m :].reshape(m, 2, columns.shape[0])
    return np.asarray(np.einsum("ipk,dikp->di", weight, turned).ravel())
