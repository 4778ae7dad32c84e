"""Columns of modes, and the restricted likelihood of decays and of responses to a force."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lmshealth._private.arrays import stack
from lmshealth.modal.deterministic.likelihood import (
    BandSpectra,
    ModalLikelihood,
    pole_columns,
    pole_terms,
    transform_decays,
    unit_level,
)
from tests.stops import ring

RATE = 400.0


def two_modes(rng: np.random.Generator, n_segments: int, n: int) -> np.ndarray:
    """Decays of two modes in two channels with white noise, ``(n_segments, n, 2)``."""
    shapes = np.array([[1.0, 0.6], [1.0, -0.6]])
    x = 0.02 * rng.standard_normal((n_segments, n, 2))
    for s in range(n_segments):
        for shape, f, zeta in zip(shapes, (60.0, 67.3), (0.01, 0.02), strict=True):
            x[s] += np.outer(ring(f, zeta, 1.0, rng.uniform(0, 2 * np.pi), n, RATE), shape)
    return x


def likelihood_of(
    blocks: tuple[BandSpectra, ...], *, displacement: bool = False
) -> ModalLikelihood:
    """Make the likelihood of two modes in two channels."""
    levels = np.full(2, np.log(0.02**2 * 2 / RATE))
    units = np.array([unit_level(f, z, 1.0) for f, z in ((60.0, 0.01), (67.3, 0.02))])
    shapes = np.exp(levels[0] / 2) * np.array([[1.0, 0.6], [1.0, -0.6]])
    return ModalLikelihood(blocks, shapes, units, levels, displacement)


@pytest.mark.parametrize("displacement", [False, True])
def test_gradient_and_fisher_information_are_those_of_the_value(displacement: bool) -> None:
    """The gradient agrees with differences of the value, blocks of two lengths together."""
    rng = np.random.default_rng(5)
    blocks = (
        transform_decays(two_modes(rng, 3, 400), RATE, 40, 90),
        transform_decays(two_modes(rng, 1, 330), RATE, 40, 90),
    )
    likelihood = likelihood_of(blocks, displacement=displacement)
    p = np.concatenate(
        [np.log([60.02, 67.2]), np.log([0.011, 0.018]), [0.5, 1.5], likelihood.levels + 0.2,
         [0.1, -0.2]]
    )  # fmt: skip
    at = likelihood.evaluate(p)
    for j in range(p.size):
        step = np.zeros(p.size)
        step[j] = 1e-6
        slope = (likelihood.evaluate(p + step).value - likelihood.evaluate(p - step).value) / 2e-6
        assert at.gradient[j] == pytest.approx(slope, rel=1e-5, abs=1e-4)
    assert np.linalg.eigvalsh(at.fisher).min() > 0


def test_the_restricted_likelihood_does_not_depend_on_the_unit_of_the_sizes() -> None:
    """Signals a thousand times larger, and noise with them, move the likelihood by a constant."""
    x = two_modes(np.random.default_rng(6), 2, 400)
    values = []
    for scale in (1.0, 1e3):
        likelihood = likelihood_of((transform_decays(scale * x, RATE, 40, 90),))
        shift = 2 * np.log(scale)
        likelihood = ModalLikelihood(
            likelihood.blocks,
            likelihood.shapes * scale,
            likelihood.units,
            likelihood.levels + shift,
        )
        at = [
            likelihood.evaluate(
                np.concatenate([np.log([60, 67.3, 0.01, z]), [1, 1], likelihood.levels, [0, 0]])
            ).value
            for z in (0.02, 0.03)
        ]
        values.append(at[1] - at[0])
    assert values[1] == pytest.approx(values[0], rel=1e-8)


def test_a_decay_of_any_length_is_its_transient_and_nothing_else() -> None:
    """A decay that neither fits the record nor fades in it leaves nothing: there is no leakage."""
    n = 333
    x = ring(61.37, 0.004, 2.0, 0.7, n, RATE)[None, :, None]
    block = transform_decays(x, RATE, 30, 120)
    columns, _ = pole_columns(block, np.array([61.37]), np.array([0.004]))
    y = stack(block.ordinates[0, :, 0])
    size, *_ = np.linalg.lstsq(columns[0], y)
    assert np.abs(y - columns[0] @ size).max() < 1e-10 * np.abs(y).max()
    pole = np.exp(2 * np.pi * 61.37 / RATE * (-0.004 + 1j * np.sqrt(1 - 0.004**2)))
    amplitude = 2 * (size[0] + 1j * size[1]) / (1 - pole**n) / np.sqrt(2 * block.duration)
    assert amplitude == pytest.approx(2.0 * np.exp(0.7j))


@pytest.mark.parametrize("rate", [RATE, np.inf])
@pytest.mark.parametrize("forced", [False, True])
def test_derivatives_of_columns_are_differences_of_them(rate: float, forced: bool) -> None:
    """Derivatives by ln f and ln ζ agree with differences: transients, responses, with aliases."""
    block = replace(transform_decays(np.zeros((1, 400, 1)), RATE, 40, 90), sample_rate=rate)
    if forced:
        force = np.random.default_rng(3).standard_normal((2, block.frequency.size))
        block = replace(block, force=force[0] + 1j * force[1])
    f, zeta = np.array([60.3, 71.0]), np.array([0.01, 0.002])
    columns, slopes = pole_columns(block, f, zeta)
    assert columns.shape == (2, 2 * block.frequency.size, 4 if forced else 2)
    step = np.exp(1e-6)
    by_f = pole_columns(block, f * step, zeta)[0] - pole_columns(block, f / step, zeta)[0]
    by_zeta = pole_columns(block, f, zeta * step)[0] - pole_columns(block, f, zeta / step)[0]
    for slope, change in zip(slopes, (by_f, by_zeta), strict=True):
        np.testing.assert_allclose(slope, change / 2e-6, atol=1e-5 * np.abs(slope).max())


def test_a_linear_trend_lies_in_the_base() -> None:
    """What drifts and what is constant is taken out exactly."""
    x = (3.0 + 0.01 * np.arange(300.0))[None, :, None]
    block = transform_decays(x, RATE, 5, 40)
    y = stack(block.ordinates[0, :, 0])
    assert np.abs(y - block.base @ (block.base.T @ y)).max() < 1e-4 * np.abs(y).max()


def test_what_a_record_cuts_off_an_ambient_response_lies_along_its_transients() -> None:
    """Apart from transients the ordinates of a stationary response are exactly uncorrelated.

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
    block = BandSpectra(
        k * RATE / n,
        np.empty((1, k.size, 1), complex),
        n / RATE,
        RATE,
        np.empty((2 * k.size, 0)),
    )
    pole = np.exp(omega / RATE * (-zeta + 1j * root))
    back = np.exp(-2j * np.pi * k / n)
    both = np.stack([1 / (1 - pole * back), 1 / (1 - pole.conj() * back)], axis=1)
    (up, _), (down, _) = pole_terms(block, np.array([f]), np.array([zeta]))
    np.testing.assert_allclose(n * np.concatenate([up, down]).T, both)
    q, _ = np.linalg.qr(both)
    keep = np.eye(k.size) - q @ q.conj().T
    assert np.abs(found - np.diag(density)).max() > 0.1 * density.max()
    assert np.abs(keep @ (found - np.diag(density)) @ keep).max() < 1e-9 * density.max()
