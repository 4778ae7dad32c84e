"""Diagonal form of the closed loop: frequency responses, spectra, stationary start, recursion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from models.dynamics.plant import LinearSystem

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_CHUNK = 1 << 15


@dataclass(frozen=True, slots=True)
class Diagonal:
    """Modal form ż = λ z + b u, y = c z + d u of a system with shaped inputs.

    Parameters
    ----------
    poles : (n,) rad/s
        Closed-loop poles, then one shaping pole per input.
    b : (n, input)
    c : (output, n)
    d : (output, input)
    states : (n, n)
        Columns are the states' shapes: x = states @ z.
    """

    poles: ComplexArray
    b: ComplexArray
    c: ComplexArray
    d: Array
    states: ComplexArray


def diagonalise(system: LinearSystem, corners_hz: Array | None = None) -> Diagonal:
    """Diagonalise a system, each input first passed through a low pass of first order.

    Parameters
    ----------
    system
        With distinct poles.
    corners_hz : (input,) Hz
        Corners of the low passes; without it the inputs act directly.
    """
    poles, vectors = (part.astype(complex) for part in np.linalg.eig(system.a))
    if corners_hz is None:
        b = np.linalg.solve(vectors, system.b.astype(complex))
        read = np.asarray(system.c @ vectors, dtype=complex)
        return Diagonal(poles, b, read, system.d, vectors)
    # The shaping poles repeat; their eigenvectors are written down, not computed, because a
    # numerical basis of a repeated eigenvalue may be ill-conditioned.
    corner = 2 * np.pi * np.asarray(corners_hz)
    n, m = system.a.shape[0], corner.size
    forced = np.column_stack(
        [np.linalg.solve(-w * np.eye(n) - system.a, system.b[:, i]) for i, w in enumerate(corner)]
    )
    states = np.zeros((n + m, n + m), dtype=complex)
    states[:n, :n] = vectors
    states[:n, n:] = forced
    states[n:, n:] = np.eye(m)
    b = np.vstack([np.linalg.solve(vectors, -forced * corner), np.diag(corner)])
    c = np.asarray(np.hstack([system.c, system.d]) @ states, dtype=complex)
    everything = np.concatenate([poles, -corner.astype(complex)])
    return Diagonal(everything, b, c, np.zeros_like(system.d), states)


def frequency_response(diagonal: Diagonal, frequency_hz: Array) -> ComplexArray:
    """Return the response (frequency, output, input) at frequencies in Hz."""
    s = 2j * np.pi * np.asarray(frequency_hz)
    gain = 1.0 / (s[:, None] - diagonal.poles)
    return np.asarray(np.einsum("on,fn,ni->foi", diagonal.c, gain, diagonal.b) + diagonal.d)


def held_gain(diagonal: Diagonal, sample_rate_hz: float) -> tuple[ComplexArray, ComplexArray]:
    """Return exact discrete poles (n,) and inputs (n, input) for inputs held over each sample."""
    step = 1.0 / sample_rate_hz
    grown = np.exp(diagonal.poles * step)
    gain = np.expm1(diagonal.poles * step) / diagonal.poles
    return grown, gain[:, None] * diagonal.b


def sampled_spectrum(
    diagonal: Diagonal, std: Array, sample_rate_hz: float, frequency_hz: Array
) -> Array:
    """Return one-sided spectral densities (frequency, output) of the sampled outputs.

    Parameters
    ----------
    std : (input,)
        Standard deviation of each input's white sequence.
    """
    grown, push = held_gain(diagonal, sample_rate_hz)
    z = np.exp(2j * np.pi * np.asarray(frequency_hz) / sample_rate_hz)
    response = np.einsum("on,fn,ni->foi", diagonal.c, 1 / (z[:, None] - grown), push) + diagonal.d
    return np.asarray((np.abs(response) ** 2 @ std**2) * 2 / sample_rate_hz)


def state_covariance(diagonal: Diagonal, std: Array, sample_rate_hz: float) -> Array:
    """Return the stationary covariance (n, n) of the states under white held inputs."""
    _, push = held_gain(diagonal, sample_rate_hz)
    drive = (push * std**2) @ push.conj().T
    # 1 − λ_i λ_j* from the exponents: slow poles would cancel to rounding.
    exponent = (diagonal.poles[:, None] + diagonal.poles.conj()[None, :]) / sample_rate_hz
    modal = drive / -np.expm1(exponent)
    return np.asarray((diagonal.states @ modal @ diagonal.states.conj().T).real)


def stationary_state(
    diagonal: Diagonal, std: Array, sample_rate_hz: float, rng: np.random.Generator
) -> ComplexArray:
    """Draw modal states (n,) from the stationary distribution.

    Parameters
    ----------
    std : (input,)
        Standard deviation of each input's white sequence.
    """
    covariance = state_covariance(diagonal, std, sample_rate_hz)
    # Displacements and currents differ by 1e6: scale before the factorisation.
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    white = rng.standard_normal(scale.size)
    state = scale * (vectors @ (np.sqrt(np.maximum(values, 0.0)) * white))
    return np.asarray(np.linalg.solve(diagonal.states, state.astype(complex)))


def half_poles(diagonal: Diagonal) -> tuple[NDArray[np.intp], Array]:
    """Return one pole of each conjugate pair and its weight: 2 for pairs, 1 for real poles."""
    imag = diagonal.poles.imag
    keep = np.flatnonzero(imag >= 0)
    return keep, np.where(imag[keep] > 0, 2.0, 1.0)


def propagate(
    diagonal: Diagonal, state: ComplexArray, inputs: Array, sample_rate_hz: float
) -> tuple[Array, ComplexArray]:
    """Run held inputs through the system, exactly.

    Parameters
    ----------
    state : (n,)
        Modal states at the first sample; of a pair only the first is read.
    inputs : (input, time)

    Returns
    -------
    outputs : (output, time)
    state : (n,) at the sample after the last
    """
    keep, weight = half_poles(diagonal)
    grown, push = held_gain(diagonal, sample_rate_hz)
    half, samples = keep.size, inputs.shape[1]
    forced = np.vstack([push[keep].real, push[keep].imag]) @ inputs
    last = np.zeros(diagonal.poles.size, dtype=complex)
    # Real parts, then imaginary parts, of the states before each sample's input.
    real = np.zeros((2 * half, samples))
    for i, k in enumerate(keep):
        paired = diagonal.poles[k].imag > 0
        pole = grown[k] if paired else grown[k].real
        first = state[k] if paired else state[k].real
        drive = forced[i] + 1j * forced[half + i] if paired else forced[i]
        moved, _ = lfilter([1.0], [1.0, -pole], drive, zi=np.array([pole * first]))
        real[i, 0], real[i, 1:] = first.real, moved[:-1].real
        if paired:
            real[half + i, 0], real[half + i, 1:] = first.imag, moved[:-1].imag
        last[k] = moved[-1]
    read = diagonal.c[:, keep] * weight
    outputs = np.hstack([read.real, -read.imag]) @ real
    if diagonal.d.any():
        outputs += diagonal.d @ inputs
    return outputs, last


def simulate(
    diagonal: Diagonal,
    std: Array,
    samples: int,
    *,
    sample_rate_hz: float,
    rng: np.random.Generator,
    change: Callable[[int, Array], None] | None = None,
    step: Callable[..., tuple[Array, ComplexArray]] = propagate,
) -> Array:
    """Return a stationary record (output, time) under held white noise of std (input,).

    The first state is drawn from the stationary distribution: no samples are thrown away.

    Parameters
    ----------
    change
        Called with the index of a first sample and the noise (input, time) from there on, which it
        may change in place.
    step
        `propagate`, or what does the same.
    """
    state = stationary_state(diagonal, std, sample_rate_hz, rng)
    outputs = np.empty((diagonal.c.shape[0], samples))
    for start in range(0, samples, _CHUNK):
        size = min(_CHUNK, samples - start)
        white = rng.standard_normal((std.size, size)) * std[:, None]
        if change is not None:
            change(start, white)
        outputs[:, start : start + size], state = step(diagonal, state, white, sample_rate_hz)
    return outputs
