"""Restricted likelihood of modal responses whose cause is known, in noise with the same modes.

The transform of a segment holds three responses of a mode with the pole p. That to a known force U
is U times R/(s - p), of unknown residue R. That to the states at both ends of the segment, a
transient, is the same without U: exact at Fourier frequencies, whatever is left of a decay at the
end; no window, no leakage, no correction for short records. That to an unknown, ambient force is
noise that is independent between frequencies. Sizes of the first two are linear: they are
marginalised in the restricted likelihood, which does not depend on their parametrisation and keeps
the degrees of freedom that they take.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy import fft, linalg

from lmshealth._private.arrays import ComplexArray, FloatArray, stack

# Degree of the polynomial over the band that represents leakage from outside.
_DEGREE = 2
# Relative singular value below which a direction of the leakage is dropped.
_THIN = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class BandSpectra:
    """Transforms of segments of one length in a band, and what is known of their causes."""

    frequency: FloatArray  # in Hz, (n_ordinates,)
    # of decays the root of the one-sided periodogram, (n_segments, n_ordinates, n_channels)
    ordinates: ComplexArray
    duration: float  # of each segment in s
    sample_rate: float  # in Hz; infinite where aliases of the poles are no part of the transforms
    # Real and imaginary parts of what no pole changes, (2 n_ordinates, n_base): leakage and modes
    # from outside the band
    base: FloatArray
    force: ComplexArray | None = None  # (n_ordinates,); None where none is known
    transient: bool = True  # whether modes have free states at the ends
    noise: FloatArray | None = None  # its variance, (n_ordinates,); None where it is unknown


def transform_decays(
    samples: FloatArray, sample_rate: float, low: float, high: float
) -> BandSpectra:
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
    directions, size, _ = np.linalg.svd(leaks, full_matrices=False)
    base = directions[:, size > _THIN * size[0]]
    return BandSpectra(
        frequency=frequency,
        ordinates=ordinates * np.sqrt(2 / (n * sample_rate)),
        duration=n / sample_rate,
        sample_rate=sample_rate,
        base=np.concatenate([stack(base), stack(1j * base)], axis=1),
    )


def pole_terms(
    block: BandSpectra, f: FloatArray, zeta: FloatArray
) -> tuple[tuple[ComplexArray, ComplexArray], tuple[ComplexArray, ComplexArray]]:
    """Return 1/(s - p) and 1/(s - p*) over the duration, each with its derivatives.

    Samples Re(a ρⁿ) transform to c/(1 − ρ z⁻¹) + c*/(1 − ρ* z⁻¹) with c = a (1 − ρᴺ)/2, because z⁻ᴺ
    = 1 at Fourier frequencies: with a sample rate s - p stands for its multiple 1 − ρ z⁻¹. Natural
    frequencies in Hz and damping ratios have shape ``(n_modes,)``, terms
    ``(n_modes, n_ordinates)``; derivatives are by ln f and ln ζ, ``(2, n_modes, n_ordinates)``.
    """
    s, rate = 2j * np.pi * block.frequency, block.sample_rate
    omega, root = 2 * np.pi * f, np.sqrt(1 - zeta**2)
    pole = omega * (-zeta + 1j * root)
    moves = np.array([pole, -omega * zeta * (1 + 1j * zeta / root)])

    def term(pole: ComplexArray, moves: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        rest = np.asarray(s - pole[:, None], dtype=np.complex128)
        turn = np.ones((1, 1), dtype=np.complex128)
        if np.isfinite(rate):
            turn = np.exp(-rest / rate)
            rest = np.asarray(rate * (1 - turn), dtype=np.complex128)
        value = np.reciprocal(block.duration * rest)
        return value, block.duration * value**2 * turn * moves[..., None]

    return term(pole, moves), term(pole.conj(), moves.conj())


def pole_columns(
    block: BandSpectra, f: FloatArray, zeta: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the responses of modes of unit size, with derivatives.

    Columns belong to the real and the imaginary part of the size of the transient, then of the
    residue of the response to the force: ``(n_modes, 2 n_ordinates, n)`` with two or four columns;
    the slopes are by ln f and ln ζ, ``(2, *columns.shape)``.
    """
    factors = [np.ones(1, complex)] if block.transient else []
    factors += [] if block.force is None else [block.force]

    def pairs(up: ComplexArray, down: ComplexArray) -> FloatArray:
        both = (up + down, 1j * (up - down))
        columns = np.stack([factor * one for factor in factors for one in both], axis=-1)
        return np.concatenate([columns.real, columns.imag], axis=-2)

    (up, d_up), (down, d_down) = pole_terms(block, f, zeta)
    return pairs(up, down), pairs(d_up, d_down)


IntArray = NDArray[np.intp]

# Least decay over the record, and largest damping ratio.
_LEAST_DECAY, _HEAVIEST = 0.01, 0.7
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


def least_damping(f: FloatArray, duration: float) -> FloatArray:
    """Return the damping ratio of a line: a mode in Hz that does not fade over the record in s."""
    return np.asarray(_LEAST_DECAY / (2 * np.pi * f * duration))


@dataclass(frozen=True, slots=True, eq=False)
class BlockFit:
    """Least-squares fit of a whitened block; ``n_rows`` is ``2 n_ordinates n_channels``."""

    residual: FloatArray  # white with variance one half, (n_rows, n_segments)
    sizes: FloatArray  # of each column, the base first, (n_channels, n_columns, n_segments)
    removed: FloatArray  # orthonormal basis of the fitted columns, (n_rows, n_removed)
    # Derivatives of the fit by [ln f, ln ζ], the sizes fitted, (2 n_modes, n_rows, n_segments)
    tangent: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """Restricted likelihood at one point."""

    value: float  # negative log restricted likelihood
    profile: float  # -ln L at the best sizes: comparable between numbers of modes
    gradient: FloatArray  # of value, (n_parameters,)
    fisher: FloatArray  # information at the best sizes, (n_parameters, n_parameters)
    fits: tuple[BlockFit, ...]  # one per block


@dataclass(frozen=True, eq=False)
class ModalLikelihood:
    """Restricted likelihood of the responses of some modes in white and ambient noise.

    The ``3 n_modes + 2 n_channels`` parameters are ``[ln f, ln ζ, h]`` of all modes, then the
    logarithm of the white noise's power spectral density in mid-band and its slope for each
    channel. The covariance of the noise at a frequency is diag(S_e) + Σ h² D φφᵀ [Harville1977,
    Pintelon2012]. The prior of the white noise alone constrains it where the ambient response hides
    it. Where the variance of the noise is known the parameters are ``[ln f, ln ζ]``, and the sizes
    are the best ones: then no degrees of freedom are to be kept.
    """

    blocks: tuple[BandSpectra, ...]
    shapes: FloatArray  # φ, (n_modes, n_channels)
    units: FloatArray  # divisors of D, (n_modes,)
    levels: FloatArray  # prior mean of the white noise's logarithm, (n_channels,)
    displacement: bool = False  # D is that of a displacement

    @classmethod
    def of_known_noise(cls, block: BandSpectra, n_modes: int) -> Self:
        """Make the likelihood of one channel whose noise is known."""
        return cls((block,), np.ones((n_modes, 1)), np.ones(n_modes), np.empty(0))

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
        m = self.n_modes
        return 3 * m + 2 * self.n_channels if self.levels.size else 2 * m

    def evaluate(self, p: FloatArray) -> Evaluation:
        """Evaluate the likelihood at parameters of shape ``(n_parameters,)``."""
        parts = [self._evaluate_block(block, p) for block in self.blocks]
        gradient = np.sum([part.gradient for part in parts], axis=0)
        fisher = np.sum([part.fisher for part in parts], axis=0)
        n = self.levels.size
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
        return np.log(least_damping(np.exp(p[: self.n_modes]), self._duration))

    def metric(self, at: Evaluation) -> FloatArray:
        """Regularise the Fisher information where a parameter has no effect.

        At h = 0 the curvature is the derivative by h², which noise makes of this size; dampings
        without effect must stay bounded.
        """
        m = self.n_modes
        n_segments = sum(block.ordinates.shape[0] for block in self.blocks)
        metric = at.fisher + 0.0
        metric[range(m, 2 * m), range(m, 2 * m)] += 0.5
        if self.levels.size:
            metric[range(2 * m, 3 * m), range(2 * m, 3 * m)] += 2 * np.sqrt(n_segments)
        return np.asarray(metric)

    def reach(self, p: FloatArray) -> FloatArray:
        """Return the largest step: half a Fourier frequency or bandwidth, a factor of e, twice."""
        m = self.n_modes
        reach = np.ones(p.size)
        reach[2 * m : 3 * m] += np.abs(p[2 * m : 3 * m])
        reach[:m] = 0.5 * np.maximum(1 / (self._duration * np.exp(p[:m])), np.exp(p[m : 2 * m]))
        return reach

    def movable(self, p: FloatArray, gradient: FloatArray, free: IntArray) -> IntArray:
        """Return the free parameters without those at a bound with the gradient against it."""
        poles = slice(2 * self.n_modes)
        least, most = self._bounds(p)
        down = gradient[poles] > 0
        low, high = p[poles] <= least + _AT_BOUND, p[poles] >= most - _AT_BOUND
        return np.asarray(np.setdiff1d(free, np.flatnonzero(np.where(down, low, high))))

    def density(self, block: BandSpectra, p: FloatArray) -> FloatArray:
        """Return the noise's spectral density, shape ``(n_ordinates, n_channels, n_channels)``."""
        if block.noise is not None:
            return block.noise[:, None, None]
        directions, level, _ = self._noise(block, p)
        return np.asarray(np.einsum("jk,ja,jb->kab", level, directions, directions))

    def _evaluate_block(self, block: BandSpectra, p: FloatArray) -> Evaluation:
        m, n, n_segments = self.n_modes, self.n_channels, block.ordinates.shape[0]
        if block.noise is None:
            directions, level, slopes = self._noise(block, p)
            lower = np.linalg.cholesky(np.einsum("jk,ja,jb->kab", level, directions, directions))
            inverse = np.linalg.inv(lower)
        else:
            lower = np.sqrt(block.noise)[:, None, None]
            inverse = 1 / lower
        whiten = np.concatenate([inverse, inverse])
        modal, turned = pole_columns(block, np.exp(p[:m]), np.exp(p[m : 2 * m]))
        columns = np.concatenate([block.base, *modal], axis=1)
        # Rows go through ordinates, then channels; columns through channels, then those of one.
        design = (whiten[:, :, :, None] * columns[:, None, None, :]).reshape(n * len(whiten), -1)
        stacked = stack(np.moveaxis(block.ordinates, 0, -1))
        data = (whiten @ stacked).reshape(design.shape[0], -1)
        q, r = np.linalg.qr(design)
        found = q.T @ data
        residual = data - q @ found
        sizes = linalg.solve_triangular(r, found, check_finite=False).reshape(n, -1, n_segments)

        # Derivatives of the responses at these sizes, less what other sizes can stand for.
        own = sizes[:, block.base.shape[1] :].reshape(n, m, turned.shape[3], n_segments)
        change = whiten @ np.einsum("dikp,cips->dikcs", turned, own)
        change = change.reshape(2 * m, *residual.shape)
        tangent = change - q @ (q.T @ change)
        fit = BlockFit(residual, sizes, q, tangent)
        flat = tangent.reshape(2 * m, residual.size)
        gradient, fisher = np.zeros(p.size), np.zeros((p.size, p.size))
        volume = 0.0
        if block.noise is None:
            seen = directions @ np.swapaxes(inverse, 1, 2)
            gradient, fisher = _by_noise(fit, np.moveaxis(seen, 1, 0), slopes, m)
            gradient[: 2 * m] += n_segments * _volume_slope(columns, turned, whiten, q, r)
            plain = np.linalg.slogdet(columns.T @ columns)[1]
            volume = float(np.log(np.abs(np.diag(r))).sum() - n / 2 * plain)
        gradient[: 2 * m] -= 2 * flat @ residual.ravel()
        fisher[: 2 * m, : 2 * m] += 2 * flat @ flat.T
        log_det = 2 * float(np.log(np.diagonal(lower, axis1=1, axis2=2)).sum())
        profile = n_segments * log_det + float(np.sum(residual**2))
        return Evaluation(profile + n_segments * volume, profile, gradient, fisher, (fit,))

    def _noise(
        self, block: BandSpectra, p: FloatArray
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
    n, m, each = whiten.shape[1], turned.shape[1], turned.shape[3]
    whitened = linalg.solve_triangular(r, q.T, check_finite=False)
    plain_q, plain_r = np.linalg.qr(columns)
    plain = linalg.solve_triangular(plain_r, plain_q.T, check_finite=False)
    whitened = np.reshape(whitened, (n, columns.shape[1], -1, n))
    weight = np.einsum("cpka,kac->pk", whitened, whiten) - n * plain
    weight = weight[columns.shape[1] - each * m :].reshape(m, each, columns.shape[0])
    return np.asarray(np.einsum("ipk,dikp->di", weight, turned).ravel())
