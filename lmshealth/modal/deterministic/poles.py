"""Poles of a modal likelihood: maximum, evidence, and the search of further ones."""

from dataclasses import dataclass

import numpy as np

from lmshealth._private.arrays import BoolArray, ComplexArray, FloatArray, stack
from lmshealth.modal import constants
from lmshealth.modal.deterministic.likelihood import (
    BandSpectra,
    Evaluation,
    IntArray,
    ModalLikelihood,
    pole_columns,
    pole_terms,
)

_MOST_STEPS, _STEP_TOLERANCE = 60, 1e-5
# A line's damping is within this share of the least one.
_AT_BOUND = 0.01
# Values of the columns of poles that are tried at once.
_AT_ONCE = 1 << 20
# Vector fitting: iterations, damping of the first poles and the least one, and the share of the
# response that an error counts as at least, so that lines without noise do not decide alone.
_RELOCATIONS, _FIRST_DAMPING, _LEAST_DAMPING, _LEAST_ERROR = 12, 0.01, 1e-5, 0.01


@dataclass(frozen=True, slots=True, eq=False)
class PoleFit:
    """Poles at the maximum of a likelihood."""

    likelihood: ModalLikelihood
    p: FloatArray  # (n_parameters,)
    at: Evaluation

    @property
    def frequency(self) -> FloatArray:
        """Natural frequencies in Hz, shape ``(n_modes,)``."""
        return np.exp(self.p[: self.likelihood.n_modes])

    @property
    def damping_ratio(self) -> FloatArray:
        """Damping ratios, shape ``(n_modes,)``."""
        m = self.likelihood.n_modes
        return np.exp(self.p[m : 2 * m])

    def is_line(self) -> BoolArray:
        """Return which modes do not decay over the record, shape ``(n_modes,)``."""
        m, p = self.likelihood.n_modes, self.p
        return np.asarray(p[m : 2 * m] < self.likelihood.least_damping(p) + _AT_BOUND)

    def sizes(self, mode: int) -> list[ComplexArray]:
        """Return the complex size of a mode's response, per block ``(n_channels, n_segments)``.

        It is that of the response to the force where there is one, else of the transient.
        """
        found = []
        for block, fit in zip(self.likelihood.blocks, self.at.fits, strict=True):
            n, first = self.likelihood.n_channels, block.base.shape[1]
            own = fit.sizes[:, first:].reshape(n, self.likelihood.n_modes, -1, fit.sizes.shape[2])
            found.append(own[:, mode, -2] + 1j * own[:, mode, -1])
        return found


def maximise(
    likelihood: ModalLikelihood,
    p: FloatArray,
    free: IntArray,
    *,
    tolerance: float = _STEP_TOLERANCE,
) -> PoleFit:
    """Maximise over the free parameters by quasi-Newton steps from the Fisher information.

    The search ends where a step gains less than ``tolerance`` in log likelihood.
    """
    at = likelihood.evaluate(p)
    metric, fresh = likelihood.metric(at), True
    for _ in range(_MOST_STEPS):
        step = _step(metric, at.gradient, likelihood.movable(p, at.gradient, free))
        if -at.gradient @ step / 2 < tolerance:
            break
        reach = likelihood.reach(p)
        moved = _shorten(likelihood, p, np.clip(step, -reach, reach), at)
        if moved is None and fresh:
            break
        if moved is None:
            metric, fresh = likelihood.metric(at), True
            continue
        step, change = moved[0] - p, moved[1].gradient - at.gradient
        along, fresh = metric @ step, False
        expected, seen = float(step @ along), float(step @ change)
        if seen >= 1e-2 * expected:  # the update of Broyden, Fletcher, Goldfarb and Shanno
            metric = metric - np.outer(along, along) / expected + np.outer(change, change) / seen
        p, at = moved
    return PoleFit(likelihood, p, at)


def _step(metric: FloatArray, gradient: FloatArray, free: IntArray) -> FloatArray:
    """Return the step of the free parameters, whose scales differ by 10⁵."""
    scale = np.sqrt(np.diag(metric)[free])
    system = metric[np.ix_(free, free)] / np.outer(scale, scale) + 1e-9 * np.eye(free.size)
    step = np.zeros(gradient.size)
    step[free] = -np.linalg.solve(system, gradient[free] / scale) / scale
    return step


def _shorten(
    likelihood: ModalLikelihood, p: FloatArray, step: FloatArray, at: Evaluation
) -> tuple[FloatArray, Evaluation] | None:
    """Shorten a step until the likelihood improves; None where it does not."""
    for share in (1.0, 0.3, 0.1, 0.03, 0.01, 1e-3):
        tried = likelihood.clip(p + share * step)
        there = likelihood.evaluate(tried)
        if there.value < at.value:
            return tried, there
    return None


def evidence_needed(likelihood: ModalLikelihood) -> float:
    """Return the gain in log likelihood that a further pole needs.

    It is that of the Bayesian information criterion, and a margin for the best of many places. All
    ordinates constrain a pole and its ambient response, those of a segment its sizes.
    """
    shared = 3 if likelihood.levels.size else 2
    total, own = 0, 0.0
    for block in likelihood.blocks:
        n_segments, n_ordinates, n = block.ordinates.shape
        each = 2 * (block.transient + (block.force is not None))
        total += 2 * block.ordinates.size
        own += each * n_segments * n * np.log(2 * n_ordinates)
    return float(shared * np.log(total) + own) / 2 + constants.POLE_EVIDENCE_MARGIN


def best_pole(found: PoleFit, f: FloatArray, zeta: FloatArray) -> tuple[float, float, float]:
    """Return the pole of those tried that explains most of the residual.

    Natural frequencies in Hz and damping ratios have shape ``(n_tried,)``; returned are those of
    the best and its gain in log likelihood, the noise of each channel by itself.
    """
    gain = np.zeros(f.size)
    for block in found.likelihood.blocks:
        density = found.likelihood.density(block, found.p)
        modal = pole_columns(block, found.frequency, found.damping_ratio)[0]
        known = np.concatenate([block.base, *modal], axis=1)
        size = max(1, _AT_ONCE // len(known))
        for c in range(density.shape[1]):
            whiten = np.tile(1 / np.sqrt(density[:, c, c]), 2)[:, None]
            basis = np.linalg.qr(whiten * known)[0]
            data = whiten * stack(block.ordinates[:, :, c].T)
            data = data - basis @ (basis.T @ data)
            for first in range(0, f.size, size):
                part = slice(first, first + size)
                (up, _), (down, _) = pole_terms(block, f[part], zeta[part])
                factor = 1.0 if block.force is None else block.force
                pair = [whiten * stack((factor * one).T) for one in (up + down, 1j * (up - down))]
                gain[part] += _explained(pair[0], pair[1], data, basis)
    best = int(np.argmax(gain))
    return float(f[best]), float(zeta[best]), float(gain[best])


def _explained(
    first: FloatArray, second: FloatArray, data: FloatArray, basis: FloatArray
) -> FloatArray:
    """Return the power of data that each pair of columns explains in addition to a basis.

    Columns have shape ``(n_rows, n_pairs)``, data ``(n_rows, n_segments)`` have no part in the
    basis; the result has shape ``(n_pairs,)``.
    """
    known_first, known_second = basis.T @ first, basis.T @ second
    a = np.sum(first**2, axis=0) - np.sum(known_first**2, axis=0)
    b = np.sum(first * second, axis=0) - np.sum(known_first * known_second, axis=0)
    c = np.sum(second**2, axis=0) - np.sum(known_second**2, axis=0)
    u, v = data.T @ first, data.T @ second
    power = np.sum(c * u**2 - 2 * b * u * v + a * v**2, axis=0)
    return np.asarray(power / np.maximum(a * c - b**2, 1e-9 * a * c))


def vector_fit(
    block: BandSpectra, background: ComplexArray, n_modes: int
) -> tuple[FloatArray, FloatArray]:
    """Return start values of poles from a frequency response alone [Gustavsen1999].

    With σ = 1 + Σ c/(s - p), the equation σ H = Σ r/(s - p) + Σ a_k B_k, with the columns B of a
    ``background``, ``(n_ordinates, n)``, is linear in c, r and a; the zeros of σ are the next poles
    p. Real poles are dropped. Returns natural frequencies in Hz and damping ratios.
    """
    assert block.force is not None and block.noise is not None
    centre = np.sqrt(block.frequency[0] * block.frequency[-1])
    s = 1j * block.frequency / centre
    measured = block.ordinates[0, :, 0] / block.force
    noise = block.noise / np.abs(block.force) ** 2
    whiten = 1 / np.sqrt(noise + (_LEAST_ERROR * np.abs(measured)) ** 2)
    pole = np.linspace(s[0], s[-1], n_modes + 2)[1:-1] * (1 + 1j * _FIRST_DAMPING)
    for _ in range(_RELOCATIONS):
        upper, lower = 1 / (s[:, None] - pole), 1 / (s[:, None] - pole.conj())
        modal = np.hstack([upper + lower, 1j * (upper - lower)])
        columns = np.hstack([modal, background, -measured[:, None] * modal])
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
    return np.abs(pole) * centre, np.maximum(-pole.real / np.abs(pole), _LEAST_DAMPING)
