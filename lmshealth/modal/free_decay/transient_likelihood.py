"""Restricted likelihood of free decays in noise with the same modes.

After a stop a mode responds with a decay plus its ambient response. The discrete Fourier transform
of a segment of both is the mode's transient, of unknown size, plus ordinates that are independent
between frequencies with the power spectral density of the response. The transient is exact: it has
the mode's pole, and its size is the state at the beginning less that at the end; no window, no
leakage, no correction for short records. Sizes are marginalised in the restricted likelihood, which
does not depend on their parametrisation and keeps the degrees of freedom that they take.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import fft, linalg

from lmshealth._private.arrays import ComplexArray, FloatArray, stack

# Degree of the polynomial over the band that represents leakage from outside.
_DEGREE = 2
# Relative singular value below which a direction of the leakage is dropped.
_THIN = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class DecaySpectra:
    """Transforms of decays of one length in a band."""

    frequency: FloatArray  # in Hz, (n_ordinates,)
    # root of the one-sided periodogram, (n_segments, n_ordinates, n_channels)
    ordinates: ComplexArray
    duration: float  # of each decay in s
    sample_rate: float  # in Hz
    base: ComplexArray  # orthonormal, of the leakage from outside the band, (n_ordinates, n_base)


def transform_decays(
    samples: FloatArray, sample_rate: float, low: float, high: float
) -> DecaySpectra:
    """Transform decays, ``(n_segments, n_samples, n_channels)``; the band is in Hz.

    A linear trend is represented exactly by a pole at zero frequency; a constant vanishes at
    Fourier frequencies.
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
    return DecaySpectra(
        frequency=frequency,
        ordinates=ordinates * np.sqrt(2 / (n * sample_rate)),
        duration=n / sample_rate,
        sample_rate=sample_rate,
        base=base[:, size > _THIN * size[0]],
    )


def transient(block: DecaySpectra, f: FloatArray, zeta: FloatArray) -> ComplexArray:
    """Return transforms of decays at positive frequencies, up to a constant.

    Natural frequencies in Hz and damping ratios have shape ``(n,)``, the result
    ``(n_ordinates, n)``.
    """
    exponent = 2 * np.pi * f * (-zeta + 1j * np.sqrt(1 - zeta**2)) / block.sample_rate
    back = np.exp(-2j * np.pi * block.frequency / block.sample_rate)
    return np.asarray(1 / (1 - np.exp(exponent) * back[:, None]))


def pole_columns(
    block: DecaySpectra, f: FloatArray, zeta: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return transforms of decaying cosines and sines, up to a constant, with derivatives.

    Samples Re(a ρⁿ) transform to c/(1 − ρ z⁻¹) + c*/(1 − ρ* z⁻¹) with c = a (1 − ρᴺ)/2, because z⁻ᴺ
    = 1 at Fourier frequencies. The columns belong to the real and the imaginary part of each c,
    ``(n_modes, 2 n_ordinates, 2)``; the slopes are by ln f and ln ζ, ``(2, *columns.shape)``.
    """
    back = np.exp(-2j * np.pi * block.frequency / block.sample_rate)
    omega, root = 2 * np.pi * f / block.sample_rate, np.sqrt(1 - zeta**2)
    exponent = omega * (-zeta + 1j * root)
    pole = np.exp(exponent)
    turns = pole * np.array([exponent, -omega * zeta * (1 + 1j * zeta / root)])
    # Sizes are of order one for a decay as long as the record.
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

# Least decay over the record, and largest damping ratio.
_LEAST_DECAY, _HEAVIEST = 0.01, 0.5
# Factor by which a pole may lie outside the band.
_BEYOND = 2.0
# Distance of a logarithm from its bound at which it is at the bound.
_AT_BOUND = 1e-6
# Standard deviations of the prior of the white noise: its logarithm about the level between the
# peaks, and its slope over half of the band.
_LEVEL_STD, _SLOPE_STD = 3.0, 1.0


def unit_level(f: float, zeta: float, duration: float, *, displacement: bool = False) -> float:
    """Return the response to a unit white force one Fourier frequency above the resonance.

    The frequency is in Hz, the duration of the record in s; of a displacement in the unit of the
    force times 1/ω_n².
    """
    beta2 = (f / (f + 1 / duration)) ** 2
    level = 1 / ((1 - beta2) ** 2 + 4 * zeta**2 * beta2)
    return float(level * beta2**2 if displacement else level)


@dataclass(frozen=True, slots=True, eq=False)
class BlockFit:
    """Least-squares fit of a whitened block; ``n_rows`` is ``2 n_ordinates n_channels``."""

    residual: FloatArray  # white with variance one half, (n_rows, n_segments)
    sizes: FloatArray  # of each column, the base first, (n_channels, n_columns, n_segments)
    removed: FloatArray  # orthonormal basis of the fitted columns, (n_rows, n_removed)


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """Restricted likelihood at one point."""

    value: float  # negative log restricted likelihood
    profile: float  # -ln L at the best sizes: comparable between numbers of modes
    gradient: FloatArray  # of value, (n_parameters,)
    fisher: FloatArray  # information at the best sizes, (n_parameters, n_parameters)
    fits: tuple[BlockFit, ...]  # one per block


@dataclass(frozen=True, eq=False)
class TransientLikelihood:
    """Restricted likelihood of transients of some modes in white and ambient noise.

    The ``3 n_modes + 2 n_channels`` parameters are ``[ln f, ln ζ, h]`` of all modes, then the
    logarithm of the white noise's power spectral density in mid-band and its slope for each
    channel. The covariance of the noise at a frequency is diag(S_e) + Σ h² D φφᵀ [Harville1977,
    Pintelon2012]. The prior of the white noise alone constrains it where the ambient response hides
    it.
    """

    blocks: tuple[DecaySpectra, ...]
    shapes: FloatArray  # φ, (n_modes, n_channels)
    units: FloatArray  # divisors of D, (n_modes,)
    levels: FloatArray  # prior mean of the white noise's logarithm, (n_channels,)
    displacement: bool = False  # D is that of a displacement

    @property
    def n_modes(self) -> int:
        """Number of modes."""
        return int(self.shapes.shape[0])

    @property
    def n_channels(self) -> int:
        """Number of channels."""
        return int(self.blocks[0].ordinates.shape[2])

    def evaluate(self, p: FloatArray) -> Evaluation:
        """Evaluate the likelihood at parameters of shape ``(n_parameters,)``."""
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
        """Keep poles near the band, and dampings between that of a line and the heaviest."""
        m = self.n_modes
        kept = p + 0.0
        # The bound of a damping depends on its frequency.
        kept[:m] = np.clip(p[:m], *(bound[:m] for bound in self._bounds(p)))
        kept[: 2 * m] = np.clip(kept[: 2 * m], *self._bounds(kept))
        return kept

    def _bounds(self, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return lower and upper bounds of ``[ln f, ln ζ]``, shape ``(2 n_modes,)`` each."""
        low, high = self._band
        ones = np.ones(self.n_modes)
        least = np.concatenate([np.log(low / _BEYOND) * ones, self.least_damping(p)])
        return least, np.concatenate([np.log(high * _BEYOND) * ones, np.log(_HEAVIEST) * ones])

    def least_damping(self, p: FloatArray) -> FloatArray:
        """Return ln ζ of each mode below which it is a line, shape ``(n_modes,)``."""
        cycles = np.exp(p[: self.n_modes]) * self._duration
        return np.asarray(np.log(_LEAST_DECAY / (2 * np.pi * cycles)))

    def metric(self, at: Evaluation) -> FloatArray:
        """Regularise the Fisher information where a parameter has no effect.

        At h = 0 the curvature is the derivative by h², which noise makes of this size; dampings
        without effect must stay bounded.
        """
        m = self.n_modes
        n_segments = sum(block.ordinates.shape[0] for block in self.blocks)
        metric = at.fisher + 0.0
        metric[range(m, 2 * m), range(m, 2 * m)] += 0.5
        metric[range(2 * m, 3 * m), range(2 * m, 3 * m)] += 2 * np.sqrt(n_segments)
        return np.asarray(metric)

    def reach(self, p: FloatArray) -> FloatArray:
        """Return the largest step: half a Fourier frequency, a factor of e, a doubling."""
        m = self.n_modes
        reach = np.ones(p.size)
        reach[2 * m : 3 * m] += np.abs(p[2 * m : 3 * m])
        reach[:m] = 0.5 / (self._duration * np.exp(p[:m]))
        return reach

    def movable(self, p: FloatArray, gradient: FloatArray, free: IntArray) -> IntArray:
        """Return the free parameters without those at a bound with the gradient against it."""
        poles = slice(2 * self.n_modes)
        least, most = self._bounds(p)
        down = gradient[poles] > 0
        low, high = p[poles] <= least + _AT_BOUND, p[poles] >= most - _AT_BOUND
        return np.asarray(np.setdiff1d(free, np.flatnonzero(np.where(down, low, high))))

    def density(self, block: DecaySpectra, p: FloatArray) -> FloatArray:
        """Return the noise's spectral density, shape ``(n_ordinates, n_channels, n_channels)``."""
        directions, level, _ = self._noise(block, p)
        return np.asarray(np.einsum("jk,ja,jb->kab", level, directions, directions))

    def _evaluate_block(self, block: DecaySpectra, p: FloatArray) -> Evaluation:
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
        stacked = stack(np.moveaxis(block.ordinates, 0, -1))
        data = (whiten @ stacked).reshape(design.shape[0], -1)
        q, r = np.linalg.qr(design)
        found = q.T @ data
        residual = data - q @ found
        sizes = linalg.solve_triangular(r, found, check_finite=False).reshape(n, -1, n_segments)

        # Derivatives of the transients, and of the volume spanned by the columns.
        first = sizes.shape[1] - 2 * m
        own = sizes[:, first:].reshape(n, m, 2, n_segments)
        change = whiten @ np.einsum("dikp,cips->dikcs", turned, own)
        change = change.reshape(2 * m, *residual.shape)
        tangent = (change - q @ (q.T @ change)).reshape(2 * m, residual.size)
        fit = BlockFit(residual, sizes, q)

        seen = directions @ np.swapaxes(inverse, 1, 2)
        gradient, fisher = _by_noise(fit, np.moveaxis(seen, 1, 0), slopes, m)
        gradient[: 2 * m] += n_segments * _volume_slope(columns, turned, whiten, q, r)
        gradient[: 2 * m] -= 2 * np.sum(residual * change, axis=(1, 2))
        fisher[: 2 * m, : 2 * m] += 2 * tangent @ tangent.T

        log_det = 2 * float(np.log(np.diagonal(lower, axis1=1, axis2=2)).sum())
        profile = n_segments * log_det + float(np.sum(residual**2))
        volume = (
            np.log(np.abs(np.diag(r))).sum() - n / 2 * np.linalg.slogdet(columns.T @ columns)[1]
        )
        return Evaluation(profile + n_segments * float(volume), profile, gradient, fisher, (fit,))

    def _noise(
        self, block: DecaySpectra, p: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return directions, levels and slopes of the rank-one parts of the noise's covariance.

        Modes, then channels: shapes ``(n_modes + n_channels, n_channels)`` and
        ``(n_modes + n_channels, n_ordinates)``; slopes ``(n_parameters, n_ordinates)``.
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
    """Return gradient and Fisher information through the noise.

    Every part of its covariance has rank one and acts along one whitened direction of ``seen``,
    ``(n_modes + n_channels, n_ordinates, n_channels)``; ``slopes`` as in `_noise`.
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
    """Differentiate the log volume of the whitened columns less that of the plain ones.

    ``columns``, ``(2 n_ordinates, n_columns)``, end with those of the poles, whose slopes are
    ``turned``; ``q`` and ``r`` are the factors of the whitened columns.
    """
    n, m = whiten.shape[1], turned.shape[1]
    whitened = linalg.solve_triangular(r, q.T, check_finite=False)
    plain_q, plain_r = np.linalg.qr(columns)
    plain = linalg.solve_triangular(plain_r, plain_q.T, check_finite=False)
    whitened = np.reshape(whitened, (n, columns.shape[1], -1, n))
    weight = np.einsum("cpka,kac->pk", whitened, whiten) - n * plain
    weight = weight[columns.shape[1] - 2 * m :].reshape(m, 2, columns.shape[0])
    return np.asarray(np.einsum("ipk,dikp->di", weight, turned).ravel())
