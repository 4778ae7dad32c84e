"""Transforms of decays: exact for any length, with derivatives, and all that a record cuts off."""

from __future__ import annotations

import numpy as np
import pytest

from lmshealth.modal.free_decay.transient_likelihood import (
    Block,
    make_block,
    pole_columns,
    stack,
    transient,
)
from tests.stops import ring

RATE = 400.0


def test_a_decay_of_any_length_is_its_transient_and_nothing_else() -> None:
    """A decay that neither fits the record nor fades in it leaves nothing: there is no leakage."""
    n = 333
    x = ring(61.37, 0.004, 2.0, 0.7, n, RATE)[None, :, None]
    block = make_block(x, RATE, 30, 120)
    columns, _ = pole_columns(block, np.array([61.37]), np.array([0.004]))
    y = stack(block.ordinates[0, :, 0])
    size, *_ = np.linalg.lstsq(columns[0], y)
    assert np.abs(y - columns[0] @ size).max() < 1e-10 * np.abs(y).max()
    pole = np.exp(2 * np.pi * 61.37 / RATE * (-0.004 + 1j * np.sqrt(1 - 0.004**2)))
    amplitude = 2 * (size[0] + 1j * size[1]) / (1 - pole**n) / np.sqrt(2 * block.duration)
    assert amplitude == pytest.approx(2.0 * np.exp(0.7j))


def test_derivatives_of_a_transient_are_differences_of_it() -> None:
    """Changes of ln f and ln ζ do to the columns what their derivatives say."""
    block = make_block(np.zeros((1, 400, 1)), RATE, 40, 90)
    f, zeta = np.array([60.3, 71.0]), np.array([0.01, 0.002])
    _, slopes = pole_columns(block, f, zeta)
    step = np.exp(1e-6)
    by_f = pole_columns(block, f * step, zeta)[0] - pole_columns(block, f / step, zeta)[0]
    by_zeta = pole_columns(block, f, zeta * step)[0] - pole_columns(block, f, zeta / step)[0]
    for slope, change in zip(slopes, (by_f, by_zeta), strict=True):
        np.testing.assert_allclose(slope, change / 2e-6, atol=1e-5 * np.abs(slope).max())


def test_a_linear_trend_lies_in_the_base() -> None:
    """What drifts and what is constant is taken out exactly."""
    x = (3.0 + 0.01 * np.arange(300))[None, :, None]
    block = make_block(x, RATE, 5, 40)
    y = block.ordinates[0, :, 0]
    assert np.abs(y - block.base @ (block.base.conj().T @ y)).max() < 1e-4 * np.abs(y).max()


def test_what_a_record_cuts_off_an_ambient_response_lies_along_its_transients() -> None:
    """Beside the transients the ordinates of a stationary response are exactly uncorrelated.

    The autocovariance of a mode under white force is known, and with it the covariance of the
    transform of a stretch far shorter than the mode's memory: nothing off its diagonal, and on it
    the power spectral density, once the span of the transients is taken out.
    """
    n, f, zeta = 60, 40.0, 0.004
    lag = np.arange(16000) / RATE
    omega, root = 2 * np.pi * f, np.sqrt(1 - zeta**2)
    covariance = np.exp(-zeta * omega * lag) * (
        np.cos(omega * root * lag) + zeta / root * np.sin(omega * root * lag)
    )
    index = np.arange(n)
    matrix = covariance[np.abs(index[:, None] - index)]
    k = np.arange(1, n // 2)
    rows = np.exp(-2j * np.pi * np.outer(k, index) / n) / np.sqrt(n)
    found = rows @ matrix @ rows.conj().T
    density = (
        covariance[0]
        + 2 * np.cos(2 * np.pi * np.outer(k / n, np.arange(1, 16000))) @ covariance[1:]
    )
    block = Block(k * RATE / n, np.empty((1, k.size, 1)), n / RATE, RATE, np.empty((k.size, 0)))
    pole = np.exp(omega / RATE * (-zeta + 1j * root))
    back = np.exp(-2j * np.pi * k / n)
    both = np.stack([1 / (1 - pole * back), 1 / (1 - pole.conj() * back)], axis=1)
    np.testing.assert_allclose(transient(block, np.array([f]), np.array([zeta])), both[:, :1])
    q, _ = np.linalg.qr(both)
    keep = np.eye(k.size) - q @ q.conj().T
    assert np.abs(found - np.diag(density)).max() > 0.1 * density.max()
    assert np.abs(keep @ (found - np.diag(density)) @ keep).max() < 1e-9 * density.max()
