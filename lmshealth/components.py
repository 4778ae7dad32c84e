"""Responses of modes and of floors, with their derivatives."""

from __future__ import annotations

import numpy as np

from lmshealth.arrays import ComplexArray, FloatArray

# Where the second derivatives of h stand, by which first ones they are of.
SECOND = np.array([[4, 5, 6], [5, 7, 8], [6, 8, 9]])


def response(f: FloatArray, zeta: FloatArray, frequency: FloatArray) -> ComplexArray:
    """Acceleration response h of modes to a white force, frequencies in the last axis."""
    beta = f / frequency
    return np.asarray(1 / (1 - beta**2 - 2j * zeta * beta))


def floor_response(p: FloatArray, u: FloatArray) -> FloatArray:
    """Response exp((e + d u + b u²) / 2) of floors, shape ``(n_floors, n)``."""
    return np.asarray(np.exp(p @ np.stack([np.ones_like(u), u, u * u]) / 2))


def floors(p: FloatArray, u: FloatArray) -> ComplexArray:
    """`floor_response` with its derivatives, as `receptance` has them.

    Parameters
    ----------
    p : ndarray
        e, d and b of each floor, shape ``(n_floors, 3)``.
    u : ndarray
        Place in the band, shape ``(n,)``.
    """
    basis = np.stack([np.ones_like(u), u, u * u]) / 2
    h = np.exp(p @ basis)
    pairs = [basis[a] * basis[b] for a in range(3) for b in range(a, 3)]
    return np.stack([h, *(h * slope for slope in [*basis, *pairs])]).astype(complex)


def receptance(f: FloatArray, zeta: FloatArray, frequency: FloatArray) -> ComplexArray:
    """Acceleration response h of modes and its derivatives by x = ln f and z = ln ζ.

    Returns an array of shape ``(10, …, n)``: h, its first derivatives by three unknowns and its
    second ones (11, 12, 13, 22, 23, 33), of which the third does not exist here. With d = 1/h,
    h_a = -d_a h² and h_ab = (2 d_a d_b h - d_ab) h².
    """
    beta = f / frequency
    damping = -2j * zeta * beta
    h = 1 / (1 - beta**2 + damping)
    d_x, d_xx = damping - 2 * beta**2, damping - 4 * beta**2
    square = h * h
    none = np.zeros_like(h)
    return np.stack(
        [
            h,
            -d_x * square,
            -damping * square,
            none,
            (2 * d_x * d_x * h - d_xx) * square,
            (2 * d_x * damping * h - damping) * square,
            none,
            (2 * damping * damping * h - damping) * square,
            none,
            none,
        ]
    )
