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

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from lmshealth.arrays import FloatArray
from lmshealth.spectra import Spectrum, periodogram_kernel

# Below this many half-power bandwidths times duration the expected periodogram replaces the
# density: the record no longer resolves the resonance.
_RESOLVED = 20.0
# The density is sampled this finely per half-power bandwidth; the kernel itself asks for two
# samples per Fourier bin, and its tails end this many bins outside the band.
_SAMPLES_PER_BANDWIDTH = 12
_MARGIN_BINS = 20

# Standard deviations of the weak normal priors about the start, which only keep directions
# that the data do not see from running away: of ln f and ln ζ, amplitudes, e_0 and e_1.
WEAK = (0.2, 2.0)
_PRIOR_AMPLITUDE = 30.0
_PRIOR_NOISE = (5.0, 2.0)


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Ordinates of one segment within the band.

    Attributes
    ----------
    frequency : ndarray
        Where the density is evaluated, in Hz, shape ``(n_grid,)``.
    periodogram : ndarray
        Shape ``(n,)``.
    kernel : ndarray or None
        Density to expected periodogram, shape ``(n, n_grid)``; None where they are the same.
    """

    frequency: FloatArray
    periodogram: FloatArray
    kernel: FloatArray | None


def make_block(spectrum: Spectrum, keep: np.ndarray, bandwidth: float) -> Block:
    """Prepare the ordinates of a segment for the likelihood.

    Parameters
    ----------
    spectrum : Spectrum
        Cut to the band.
    keep : ndarray of bool
        Ordinates that hold no line, shape ``(n_ordinates,)``.
    bandwidth : float
        Smallest half-power bandwidth 2ζf expected, in Hz: decides whether the record resolves it.
    """
    frequency, ordinates = spectrum.frequency[keep], spectrum.periodogram[keep]
    if bandwidth * spectrum.duration >= _RESOLVED:
        return Block(frequency, ordinates, None)
    finer = int(np.clip(np.ceil(_SAMPLES_PER_BANDWIDTH / (bandwidth * spectrum.duration)), 2, 12))
    step = 1 / (finer * spectrum.duration)
    margin = _MARGIN_BINS / spectrum.duration
    low = max(spectrum.frequency[0] - margin, step)
    fine = np.arange(low, spectrum.frequency[-1] + margin, step)
    return Block(fine, ordinates, periodogram_kernel(frequency, spectrum.duration, fine))


@dataclass(frozen=True, slots=True, eq=False)
class Likelihood:
    """Negative log posterior of a band of one channel with priors about a start.

    Attributes
    ----------
    blocks : tuple of Block
        One per segment.
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
            density, first, second = self._expansion(p, block.frequency)
            expected = _expect(block, density)
            ratio = block.periodogram / expected
            slope = (1 - ratio) / expected
            if block.kernel is not None:
                first_expected = first @ block.kernel.T
                slope_grid = slope @ block.kernel
            else:
                first_expected, slope_grid = first, slope
            gradient = gradient + first @ slope_grid
            curvature = (2 * ratio - 1) / expected**2
            hessian = hessian + (first_expected * curvature) @ first_expected.T
            for (a, b), values in second.items():
                term = float(values @ slope_grid)
                hessian[a, b] += term
                if a != b:
                    hessian[b, a] += term
        return gradient, hessian

    def _noise(self, p: FloatArray, frequency: FloatArray) -> tuple[FloatArray, FloatArray]:
        u = np.log(frequency / self.centre) / self.spread
        return np.exp(p[-2] + p[-1] * u), u

    def _density(self, p: FloatArray, frequency: FloatArray) -> FloatArray:
        m = self.n_modes
        noise, _ = self._noise(p, frequency)
        total = noise
        h = [
            self.scale[i] * _receptance(np.exp(p[i]), np.exp(p[m + i]), frequency)[0]
            for i in range(m)
        ]
        for k in range(m):
            q = p[2 * m + k] * h[k]
            if k + 1 < m:
                q = q + p[3 * m + k] * h[k + 1]
            total = total + q.real**2 + q.imag**2
        return total

    def _expansion(
        self, p: FloatArray, frequency: FloatArray
    ) -> tuple[FloatArray, FloatArray, dict[tuple[int, int], FloatArray]]:
        """Density with its first and its non-zero second derivatives on the grid.

        From S = Σ |q_k|²: S_a = 2 Re Σ q_k* q_ka and S_ab = 2 Re Σ (q_ka* q_kb + q_k* q_kab);
        q_k depends on the two modes it drives and is linear in its amplitudes.
        """
        m, n = self.n_modes, p.size
        density, u = self._noise(p, frequency)
        first = np.zeros((n, frequency.size))
        first[n - 2], first[n - 1] = density, density * u
        second = {
            (n - 2, n - 2): density,
            (n - 2, n - 1): density * u,
            (n - 1, n - 1): density * u * u,
        }
        shapes = [
            self.scale[i] * _receptance(np.exp(p[i]), np.exp(p[m + i]), frequency) for i in range(m)
        ]
        for k in range(m):
            q, q_first, q_second = _force_response(p, shapes, k)
            density = density + q.real**2 + q.imag**2
            for a, value in q_first.items():
                first[a] += 2 * (q.conj() * value).real
            order = sorted(q_first)
            for i, a in enumerate(order):
                for b in order[i:]:
                    term = q_first[a].conj() * q_first[b]
                    if (a, b) in q_second:
                        term = term + q.conj() * q_second[a, b]
                    second[a, b] = second.get((a, b), 0.0) + 2 * term.real
        return density, first, second


def _misfit(block: Block, density: FloatArray) -> float:
    expected = _expect(block, density)
    return float(np.sum(np.log(expected) + block.periodogram / expected))


def _expect(block: Block, density: FloatArray) -> FloatArray:
    return density if block.kernel is None else np.asarray(block.kernel @ density)


def _receptance(f: float, zeta: float, frequency: FloatArray) -> np.ndarray:
    """Acceleration response h of a mode and its derivatives by x = ln f and z = ln ζ.

    Returns an array of shape ``(6, n)``: h, h_x, h_z, h_xx, h_xz, h_zz. With d = 1/h,
    h_a = -d_a h² and h_ab = (2 d_a d_b h - d_ab) h².
    """
    beta = f / frequency
    damping = 2j * zeta * beta
    h = 1 / (1 - beta**2 + damping)
    d_x, d_xx = damping - 2 * beta**2, damping - 4 * beta**2
    square = h * h
    return np.stack(
        [
            h,
            -d_x * square,
            -damping * square,
            (2 * d_x * d_x * h - d_xx) * square,
            (2 * d_x * damping * h - damping) * square,
            (2 * damping * damping * h - damping) * square,
        ]
    )


def _force_response(
    p: FloatArray, shapes: list[np.ndarray], k: int
) -> tuple[np.ndarray, dict[int, np.ndarray], dict[tuple[int, int], np.ndarray]]:
    """Response q_k to the k-th force with its derivatives by the unknowns it depends on."""
    m = len(shapes)
    driven = [(k, 2 * m + k)] + ([(k + 1, 3 * m + k)] if k + 1 < m else [])
    q = sum(p[amplitude] * shapes[mode][0] for mode, amplitude in driven)
    first: dict[int, np.ndarray] = {}
    second: dict[tuple[int, int], np.ndarray] = {}
    for mode, amplitude in driven:
        h, h_x, h_z, h_xx, h_xz, h_zz = shapes[mode]
        a = p[amplitude]
        x, z = mode, m + mode
        first |= {x: a * h_x, z: a * h_z, amplitude: h}
        second |= {
            (x, x): a * h_xx,
            (x, z): a * h_xz,
            (z, z): a * h_zz,
            (x, amplitude): h_x,
            (z, amplitude): h_z,
        }
    return np.asarray(q), first, second
