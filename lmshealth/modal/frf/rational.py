"""Rational transfer function with modes: likelihood at the lines of a band, and search of poles.

The model is that of the README of the folder. Residues and powers are linear and solved for; only
ln f and ln ζ are searched (variable projection).
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Self

import numpy as np
from scipy.optimize import least_squares

from lmshealth._private.arrays import BoolArray, ComplexArray, FloatArray, ReadOnly, stack
from lmshealth.modal import constants

# A transient is smooth over a band: powers of s.
_TRANSIENT_POWERS = (-1, 0, 1)
# Damping ratios at which modes are searched for, and bounds of the fit.
_TRIED_DAMPING = (0.003, 0.01, 0.03, 0.1)
LEAST_DAMPING, _MOST_DAMPING = 1e-5, 0.7
_OUTSIDE = 0.5  # share of the band's ends by which a pole may lie outside
_BLOCK = 128
# Vector fitting: iterations, and the share of the response that an error counts as at least, so
# that lines without noise do not decide alone.
_RELOCATIONS, _LEAST_ERROR = 12, 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Ordinates(ReadOnly):
    """Spectra of an input and an output at the lines of a band, arrays ``(n_lines,)``."""

    frequency: FloatArray  # in Hz, ascending
    given: ComplexArray  # amplitudes of the input
    answer: ComplexArray  # of the output
    noise: FloatArray  # variance of answer - H given by noise; without periods a start value
    freedom: float  # complex degrees of freedom of each variance; 0 where it is unknown
    periodic: bool  # means over whole periods or blows: no transient, noise from their scatter
    at_rest: bool = False  # at both ends of the record: no transient

    @property
    def transient(self) -> bool:
        """Whether the answer has a transient."""
        return not (self.periodic or self.at_rest)

    @property
    def scatter(self) -> bool:
        """Whether the noise is that of a scatter; otherwise it is that of the residual."""
        return self.periodic and self.freedom > 0

    @property
    def spacing(self) -> float:
        """Distance of neighbouring lines in Hz."""
        return float(np.median(np.diff(self.frequency)))

    def only(self, keep: BoolArray) -> Self:
        """Keep some of the lines."""
        lines = ("frequency", "given", "answer", "noise")
        return replace(self, **{name: getattr(self, name)[keep] for name in lines})


@dataclass(frozen=True, slots=True, eq=False)
class ModelOrder:
    """Order of a model, with start values of its modes."""

    theta: FloatArray  # [ln f, ln ζ] of the modes, (2 n_modes,)
    low: int  # lowest power of s
    high: int  # highest power of s

    @property
    def n_modes(self) -> int:
        """Number of modes."""
        return self.theta.size // 2

    @property
    def modes(self) -> tuple[FloatArray, FloatArray]:
        """Natural frequency in Hz and damping ratio, shape ``(n_modes,)`` each."""
        f, zeta = np.exp(np.split(self.theta, 2))
        return f, zeta

    def unknowns(self, transient: bool) -> int:
        """Count real unknowns."""
        each, powers = (6, len(_TRANSIENT_POWERS)) if transient else (4, 0)
        return each * self.n_modes + self.high - self.low + 1 + powers

    def with_mode(self, f: float, zeta: float) -> Self:
        """Add a mode at a frequency in Hz."""
        n = self.n_modes
        return replace(self, theta=np.insert(self.theta, [n, 2 * n], np.log([f, zeta])))

    def without_mode(self, i: int) -> Self:
        """Remove a mode."""
        return replace(self, theta=np.delete(self.theta, [i, i + self.n_modes]))


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """A model with its linear unknowns; ``parts`` holds the modes and the background."""

    basis: FloatArray  # orthonormal, of the whitened columns of the linear unknowns, (2 n_lines, n)
    residues: ComplexArray  # over the centre of the band in rad/s, (n_modes,)
    swing: ComplexArray  # the same of the transient
    error: ComplexArray  # measured less fitted answer, (n_lines,)
    response: ComplexArray  # the fitted H, (n_lines,)
    parts: FloatArray  # sum of the powers of the parts of H, (n_lines,)


def _poles(ordinates: Ordinates, order: ModelOrder) -> tuple[ComplexArray, ComplexArray]:
    """Return jω, shape ``(n_lines,)``, and poles, ``(n_modes,)``, over the band's centre."""
    centre = np.sqrt(ordinates.frequency[0] * ordinates.frequency[-1])
    f, zeta = order.modes
    return (1j * ordinates.frequency / centre, f / centre * (-zeta + 1j * np.sqrt(1 - zeta**2)))


def _modal(s: ComplexArray, pole: ComplexArray) -> ComplexArray:
    """Return the columns of real and imaginary parts of residues, ``(n_lines, 2 n_modes)``."""
    upper, lower = 1 / (s[:, None] - pole), 1 / (s[:, None] - pole.conj())
    return np.hstack([upper + lower, 1j * (upper - lower)])


def solve(ordinates: Ordinates, order: ModelOrder, variance: FloatArray) -> Solution:
    """Solve for the linear unknowns at given poles and variances of shape ``(n_lines,)``."""
    m = order.n_modes
    s, pole = _poles(ordinates, order)
    modal = _modal(s, pole)
    response = np.hstack([modal, s[:, None] ** np.arange(order.low, order.high + 1)])
    n = response.shape[1]
    columns = response * ordinates.given[:, None]
    if ordinates.transient:
        columns = np.hstack([columns, modal, s[:, None] ** np.array(_TRANSIENT_POWERS)])
    whiten = np.sqrt(2 / variance)
    stacked = stack(columns * whiten[:, None])
    scale = np.linalg.norm(stacked, axis=0)
    basis, triangle = np.linalg.qr(stacked / scale)
    seen = basis.T @ stack(ordinates.answer * whiten)
    weights = np.linalg.lstsq(triangle, seen, rcond=None)[0] / scale
    fitted = response @ weights[:n]
    parts = modal[:, :m] * weights[:m] + modal[:, m:] * weights[m : 2 * m]
    # Powers and poles of a background may cancel each other; modes do not.
    parts = parts[:, order.modes[1] <= constants.FRF_MOST_DAMPING]
    rest = fitted - parts.sum(axis=1)
    swing = _residues(weights[n:], m) if ordinates.transient else np.zeros(m, dtype=complex)
    power = np.sum(np.abs(parts) ** 2, axis=1) + np.abs(rest) ** 2
    error = ordinates.answer - columns @ weights
    return Solution(basis, _residues(weights, m), swing, error, fitted, power)


def _residues(weights: FloatArray, n_modes: int) -> ComplexArray:
    return np.asarray(weights[:n_modes] + 1j * weights[n_modes : 2 * n_modes])


def slopes(
    ordinates: Ordinates, order: ModelOrder, variance: FloatArray, solution: Solution
) -> FloatArray:
    """Differentiate the whitened error by ``[ln f, ln ζ]``, shape ``(2 n_lines, 2 n_modes)``.

    The linear unknowns are projected out (Kaufman's variable projection [Golub2003]): the product
    with its transpose is the Fisher information of ln f and ln ζ, all else marginalised.
    """
    s, pole = _poles(ordinates, order)
    _, zeta = order.modes
    by_zeta = np.abs(pole) * (-zeta - 1j * zeta**2 / np.sqrt(1 - zeta**2))
    given = ordinates.given[:, None]
    upper = (given * solution.residues + solution.swing) / (s[:, None] - pole) ** 2
    lower = given * solution.residues.conj() + solution.swing.conj()
    lower = lower / (s[:, None] - pole.conj()) ** 2
    moved = np.hstack([upper * move + lower * move.conj() for move in (pole, by_zeta)])
    slope = -stack(moved * np.sqrt(2 / variance)[:, None])
    return np.asarray(slope - solution.basis @ (solution.basis.T @ slope))


def refine(ordinates: Ordinates, order: ModelOrder, variance: FloatArray) -> ModelOrder:
    """Maximise the likelihood over the poles by a trust-region method."""
    if (m := order.n_modes) == 0:
        return order
    whiten = np.sqrt(2 / variance)

    @lru_cache(maxsize=1)
    def solved_at(theta: bytes) -> tuple[ModelOrder, Solution]:
        tried = replace(order, theta=np.frombuffer(theta))
        return tried, solve(ordinates, tried, variance)

    def error(theta: FloatArray) -> FloatArray:
        return stack(solved_at(theta.tobytes())[1].error * whiten)

    def derivative(theta: FloatArray) -> FloatArray:
        tried, solution = solved_at(theta.tobytes())
        return slopes(ordinates, tried, variance, solution)

    low, high = ordinates.frequency[[0, -1]]
    least = np.repeat(np.log([low * (1 - _OUTSIDE), LEAST_DAMPING]), m)
    most = np.repeat(np.log([high * (1 + _OUTSIDE), _MOST_DAMPING]), m)
    start = np.clip(order.theta, least + 1e-9, most - 1e-9)
    scale = np.concatenate([np.exp(start[m:]), np.ones(m)])
    solved = least_squares(
        error, start, derivative, bounds=(least, most), x_scale=scale, ftol=1e-6, max_nfev=40
    )
    return replace(order, theta=solved.x)


def vector_fit(ordinates: Ordinates, order: ModelOrder, n_modes: int) -> ModelOrder:
    """Return an order with start values of modes from the response alone [Gustavsen1999].

    With σ = 1 + Σ c/(s - p), the equation σ H = Σ r/(s - p) + Σ a_k s^k is linear in c, r and a;
    the zeros of σ are the next poles p. Real poles are dropped.
    """
    centre = np.sqrt(ordinates.frequency[0] * ordinates.frequency[-1])
    s = 1j * ordinates.frequency / centre
    measured = ordinates.answer / ordinates.given
    noise = ordinates.noise / np.abs(ordinates.given) ** 2
    whiten = 1 / np.sqrt(noise + (_LEAST_ERROR * np.abs(measured)) ** 2)
    powers = s[:, None] ** np.arange(order.low, order.high + 1)
    pole = np.linspace(s[0], s[-1], n_modes + 2)[1:-1] * (1 + 1j * _TRIED_DAMPING[1])
    for _ in range(_RELOCATIONS):
        modal = _modal(s, pole)
        columns = np.hstack([modal, powers, -measured[:, None] * modal])
        stacked = stack(columns * whiten[:, None])
        scale = np.linalg.norm(stacked, axis=0)
        weights = np.linalg.lstsq(stacked / scale, stack(measured * whiten), rcond=None)[0] / scale
        # The zeros of σ in state space, real and imaginary parts of the poles apart.
        real, imag = np.diag(pole.real), np.diag(pole.imag)
        entry = np.repeat([2.0, 0.0], pole.size)
        state = np.block([[real, imag], [-imag, real]])
        zeros = np.linalg.eigvals(state - np.outer(entry, weights[-2 * pole.size :]))
        zeros = zeros[zeros.imag > 0]
        pole = -np.abs(zeros.real) + 1j * zeros.imag
        if pole.size == 0:
            break
    damping = np.maximum(-pole.real / np.abs(pole), LEAST_DAMPING)
    return replace(order, theta=np.log(np.concatenate([np.abs(pole) * centre, damping])))


def best_place(
    ordinates: Ordinates, variance: FloatArray, solution: Solution
) -> tuple[float, float, float]:
    """Return frequency in Hz, damping ratio and gain in -2 ln L of the best further mode."""
    low, high = ordinates.frequency[[0, -1]].tolist()
    whiten = np.sqrt(2 / variance)
    error = stack(solution.error * whiten)
    best = (-np.inf, low, _TRIED_DAMPING[-1])
    for zeta in _TRIED_DAMPING:
        grid = np.geomspace(low, high, 2 + int(np.log(high / low) / zeta))
        for first in range(0, grid.size, _BLOCK):
            f = grid[first : first + _BLOCK]
            damping = np.clip(ordinates.spacing / f, zeta, _MOST_DAMPING)
            at = ModelOrder(np.log(np.concatenate([f, damping])), 1, 0)
            columns = _modal(*_poles(ordinates, at)) * (ordinates.given * whiten)[:, None]
            gain = _explained(stack(columns), error, solution.basis)
            k = int(np.argmax(gain))
            best = max(best, (float(gain[k]), float(f[k]), float(damping[k])))
    return best[1], best[2], best[0]


def _explained(columns: FloatArray, error: FloatArray, basis: FloatArray) -> FloatArray:
    """Return the gain in -2 ln L by each pair of columns in addition to a basis, ``(n_pairs,)``."""
    first, second = np.split(columns, 2, axis=1)
    known_first, known_second = np.split(basis.T @ columns, 2, axis=1)
    a = np.sum(first**2, axis=0) - np.sum(known_first**2, axis=0)
    b = np.sum(first * second, axis=0) - np.sum(known_first * known_second, axis=0)
    c = np.sum(second**2, axis=0) - np.sum(known_second**2, axis=0)
    u, v = error @ first, error @ second
    found = (c * u**2 - 2 * b * u * v + a * v**2) / np.maximum(a * c - b**2, 1e-9 * a * c)
    return np.asarray(found)
