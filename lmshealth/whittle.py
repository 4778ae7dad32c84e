"""Whittle likelihood of one channel that sees one or several modes, with exact derivatives.

The acceleration of mode i under a white modal force is h_i(f) = 1 / (1 - β² + 2iζβ), β = f_i/f.
Modes of one structure are driven by partly common forces, so their responses interfere. With m
modes the spectrum of one channel can tell 2m - 1 numbers of the modal force matrix: neighbours
share a force. Writing q_k for the response to the k-th independent force,

    S(f) = Σ_k |q_k(f)|² + S_e(f),   q_k = a_kk h_k + a_(k+1)k h_(k+1),   S_e = exp(e_0 + e_1 u),

with u = -1 … 1 over the band. Unknowns, in this order: ln f (m), ln ζ (m), a_kk (m),
a_(k+1)k (m - 1), e_0, e_1. The amplitudes are signed and in units of a start value, so that
zero coupling is an inner point, not a boundary.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from lmshealth.arrays import BoolArray, FloatArray
from lmshealth.spectra import Kernel, Spectrum, make_kernel

# Below this many half-power bandwidths times duration the expected periodogram replaces the
# density: the record no longer resolves the resonance. A mean over parts is surer than a part, and
# its bias shows the more: it needs as many times more.
_RESOLVED = 20.0
# The density is sampled this finely per half-power bandwidth; the kernel itself asks for two
# samples per Fourier bin, and its tails end this many bins outside the band.
_SAMPLES_PER_BANDWIDTH = 12
_MARGIN_BINS = 20
# Where a half-power bandwidth holds so many times more ordinates than that, their means over
# neighbours tell where the maximum is; all of them tell the maximum.
_MEANS_PER_BANDWIDTH, _MANY = 64, 16

Complex = np.ndarray[tuple[int, ...], np.dtype[np.complex128]]

# Standard deviations of the weak normal priors about the start, which only keep directions
# that the data do not see from running away: of ln f and ln ζ, amplitudes, e_0 and e_1.
WEAK = (0.2, 2.0)
_PRIOR_AMPLITUDE = 30.0
_PRIOR_NOISE = (5.0, 2.0)


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Ordinates of one spectrum within the band.

    Attributes
    ----------
    frequency : ndarray
        Where the density is evaluated, in Hz, shape ``(n_grid,)``.
    periodogram : ndarray
        Shape ``(n,)``.
    kernel : Kernel or None
        Density to expected periodogram; None where they are the same.
    count : ndarray
        Of how many exponential variables each ordinate is the mean, shape ``(n,)``.
    alike : int
        Over so many neighbours the density hardly changes.
    """

    frequency: FloatArray
    periodogram: FloatArray
    kernel: Kernel | None
    count: FloatArray
    alike: int = 1

    def thinned(self) -> Block:
        """Replace neighbours that are alike by their means."""
        if self.kernel is not None or self.alike < _MANY:
            return self
        first = np.arange(0, self.count.size, self.alike)
        count = np.add.reduceat(self.count, first)
        frequency, ordinates = (
            np.add.reduceat(self.count * values, first) / count
            for values in (self.frequency, self.periodogram)
        )
        return Block(frequency, ordinates, None, count)


def make_block(spectra: Sequence[Spectrum], keep: Sequence[BoolArray], bandwidth: float) -> Block:
    """Prepare the ordinates of spectra of the same frequencies for the likelihood.

    It needs of each frequency the mean over the spectra that are kept there, and their number.

    Parameters
    ----------
    spectra : sequence of Spectrum
        Cut to the band.
    keep : sequence of ndarray of bool
        Ordinates of each that hold no line, shape ``(n_ordinates,)``.
    bandwidth : float
        Smallest half-power bandwidth 2ζf expected, in Hz: decides whether the record resolves it.
    """
    first = spectra[0]
    count, total = np.zeros(first.frequency.size), np.zeros(first.frequency.size)
    for spectrum, mask in zip(spectra, keep, strict=True):
        count += spectrum.count * mask
        total += spectrum.count * mask * spectrum.periodogram
    kept: BoolArray = count > 0
    ordinates, count = total[kept] / count[kept], count[kept]
    resolution = bandwidth * first.duration
    if resolution >= _RESOLVED * max(s.count for s in spectra):
        alike = int(resolution / _MEANS_PER_BANDWIDTH)
        return Block(first.frequency[kept], ordinates, None, count, alike)
    finer = int(np.clip(np.ceil(_SAMPLES_PER_BANDWIDTH / resolution), 2, 12))
    kernel = make_kernel(first, kept, finer, _MARGIN_BINS)
    return Block(kernel.grid, ordinates, kernel, count)


@dataclass(frozen=True, slots=True, eq=False)
class Likelihood:
    """Negative log posterior of a band of one channel with priors about a start.

    Attributes
    ----------
    blocks : tuple of Block
        One per length of segments.
    start : ndarray
        Start value and centre of the priors, shape ``(n_unknowns,)``.
    belief : ndarray
        Standard deviations of the priors of ln f and of ln ζ, shape ``(2 n_modes,)``.
    scale : ndarray
        Unit of the amplitudes of each mode, shape ``(n_modes,)``.
    centre : float
        Geometric centre of the band in Hz.
    spread : float
        Half width of the band in ln f.
    """

    blocks: tuple[Block, ...]
    start: FloatArray
    belief: FloatArray
    scale: FloatArray
    centre: float
    spread: float

    @property
    def n_modes(self) -> int:
        """Number of modes."""
        return self.scale.size

    @property
    def prior_std(self) -> FloatArray:
        """Standard deviations of the weak priors, shape ``(n_unknowns,)``."""
        m = self.n_modes
        return np.concatenate(
            [
                self.belief,
                np.full(max(2 * m - 1, 0), _PRIOR_AMPLITUDE),
                _PRIOR_NOISE,
            ]
        )

    def value(self, p: FloatArray) -> float:
        """Negative log posterior up to a constant."""
        total = 0.5 * float(np.sum(((p - self.start) / self.prior_std) ** 2))
        with np.errstate(over="ignore", invalid="ignore"):
            for block in self.blocks:
                total += _misfit(block, self._density(p, block.frequency))
        return total if np.isfinite(total) else np.inf

    def data_value(self, p: FloatArray) -> float:
        """Negative log likelihood without the priors."""
        return sum(_misfit(block, self._density(p, block.frequency)) for block in self.blocks)

    def expected(self, p: FloatArray) -> list[FloatArray]:
        """Compute the expected periodogram of each block."""
        return [_expect(block, self._density(p, block.frequency)) for block in self.blocks]

    def minimise(self, start: FloatArray) -> FloatArray:
        """Find the posterior mode by Newton's method in a trust region.

        Parameters
        ----------
        start : ndarray
            Shape ``(n_unknowns,)``.

        Returns
        -------
        ndarray
            Where the search ended; the caller judges it by its Newton decrement.
        """
        thinned = tuple(block.thinned() for block in self.blocks)
        if sum(b.count.size for b in thinned) < sum(b.count.size for b in self.blocks):
            start = replace(self, blocks=thinned).minimise(start)
        last: list[FloatArray] = []

        def gradient(p: FloatArray) -> FloatArray:
            last[:] = [p.copy(), *self.derivatives(p)]
            return last[1]

        def hessian(p: FloatArray) -> FloatArray:
            # The optimiser asks for the gradient at a point before it asks for the Hessian there.
            return last[2] if np.array_equal(p, last[0]) else self.derivatives(p)[1]

        found = minimize(
            self.value,
            start,
            jac=gradient,
            hess=hessian,
            method="trust-exact",
            options={"gtol": 1e-3, "maxiter": 100, "initial_trust_radius": 0.1},
        )
        return np.asarray(found.x)

    def derivatives(self, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Exact gradient and Hessian of `value`, shapes ``(n_unknowns,)`` and square."""
        gradient = (p - self.start) / self.prior_std**2
        hessian = np.diag(1 / self.prior_std**2)
        for block in self.blocks:
            noise, u = self._noise(p, block.frequency)
            forces = self._forces(p, block.frequency)
            density, first = noise, np.zeros((p.size, noise.size))
            first[-2], first[-1] = noise, noise * u
            for force in forces:
                density = density + force.q.real**2 + force.q.imag**2
                first[force.index] += 2 * (force.q.conj() * force.first).real
            expected = _expect(block, density)
            ratio = block.periodogram / expected
            slope = block.count * (1 - ratio) / expected
            if block.kernel is not None:
                first_expected = block.kernel.expect(first)
                slope_grid = block.kernel.spread(slope)
            else:
                first_expected, slope_grid = first, slope
            gradient = gradient + first @ slope_grid
            curvature = block.count * (2 * ratio - 1) / expected**2
            hessian = hessian + (first_expected * curvature) @ first_expected.T
            powers = np.array([np.ones_like(u), u])
            hessian[-2:, -2:] += (powers * (noise * slope_grid)) @ powers.T
            for force in forces:
                hessian[np.ix_(force.index, force.index)] += force.curvature(slope_grid)
        return gradient, hessian

    def _noise(self, p: FloatArray, frequency: FloatArray) -> tuple[FloatArray, FloatArray]:
        u = np.log(frequency / self.centre) / self.spread
        return np.exp(p[-2] + p[-1] * u), u

    def _density(self, p: FloatArray, frequency: FloatArray) -> FloatArray:
        m = self.n_modes
        noise, _ = self._noise(p, frequency)
        total = noise
        h = [self.scale[i] * _response(np.exp(p[i]), np.exp(p[m + i]), frequency) for i in range(m)]
        for k in range(m):
            q = p[2 * m + k] * h[k]
            if k + 1 < m:
                q = q + p[3 * m + k] * h[k + 1]
            total = total + q.real**2 + q.imag**2
        return total

    def _forces(self, p: FloatArray, frequency: FloatArray) -> list[_Force]:
        """Responses to the forces, each with the unknowns of the two modes that it drives."""
        m = self.n_modes
        shapes = [
            self.scale[i] * _receptance(np.exp(p[i]), np.exp(p[m + i]), frequency) for i in range(m)
        ]
        forces = []
        for k in range(m):
            driven = [(k, 2 * m + k)] + ([(k + 1, 3 * m + k)] if k + 1 < m else [])
            index = [unknown for mode, a in driven for unknown in (mode, m + mode, a)]
            forces.append(_Force(np.array(index), [(p[a], shapes[mode]) for mode, a in driven]))
        return forces


class _Force:
    """Response q to one force, with its derivatives; q is linear in its amplitudes.

    From S = |q|²: S_a = 2 Re q* q_a and S_ab = 2 Re (q_a* q_b + q* q_ab).

    Parameters
    ----------
    index : ndarray of int
        Of ln f, ln ζ and the amplitude of each mode it drives, shape ``(3 n_driven,)``.
    driven : list of (float, ndarray)
        Amplitude and `_receptance` of each.
    """

    def __init__(
        self, index: np.ndarray[tuple[int], np.dtype[np.intp]], driven: list[tuple[float, Complex]]
    ) -> None:
        self.index = index
        self._driven = driven
        self.q = np.asarray(sum(a * shape[0] for a, shape in driven))
        self.first = np.empty((index.size, self.q.size), dtype=np.complex128)
        for k, (a, shape) in enumerate(driven):
            np.multiply(a, shape[1:3], out=self.first[3 * k : 3 * k + 2])
            self.first[3 * k + 2] = shape[0]

    def curvature(self, weight: FloatArray) -> FloatArray:
        """Sum of the second derivatives of S, each frequency with a weight, square."""
        parts = self.first.view(np.float64)
        total = (parts * np.repeat(weight, 2)) @ parts.T
        turned = weight * self.q.conj()
        for k, (a, shape) in enumerate(self._driven):
            x, z, amplitude = 3 * k, 3 * k + 1, 3 * k + 2
            h_x, h_z, h_xx, h_xz, h_zz = (shape[1:] @ turned).real
            total[x, x] += a * h_xx
            total[z, z] += a * h_zz
            for i, j, value in ((x, z, a * h_xz), (x, amplitude, h_x), (z, amplitude, h_z)):
                total[i, j] += value
                total[j, i] += value
        return np.asarray(2 * total)


def _misfit(block: Block, density: FloatArray) -> float:
    expected = _expect(block, density)
    return float(np.sum(block.count * (np.log(expected) + block.periodogram / expected)))


def _expect(block: Block, density: FloatArray) -> FloatArray:
    return density if block.kernel is None else block.kernel.expect(density)


def _response(f: float, zeta: float, frequency: FloatArray) -> Complex:
    """Acceleration response h of a mode, shape ``(n,)``."""
    beta = f / frequency
    return np.asarray(1 / (1 - beta**2 + 2j * zeta * beta))


def _receptance(f: float, zeta: float, frequency: FloatArray) -> Complex:
    """Acceleration response h of a mode and its derivatives by x = ln f and z = ln ζ.

    Returns an array of shape ``(6, n)``: h, h_x, h_z, h_xx, h_xz, h_zz. With d = 1/h,
    h_a = -d_a h² and h_ab = (2 d_a d_b h - d_ab) h².
    """
    beta = f / frequency
    damping = 2j * zeta * beta
    d_x = damping - 2 * beta**2
    result = np.empty((6, frequency.size), dtype=np.complex128)
    result[0] = 1 / (1 - beta**2 + damping)
    h = result[0]
    square = h * h
    twice = 2 * h
    result[1] = -d_x * square
    result[2] = -damping * square
    result[3] = (twice * d_x * d_x - (damping - 4 * beta**2)) * square
    result[4] = (twice * d_x - 1) * damping * square
    result[5] = (twice * damping - 1) * damping * square
    return result
