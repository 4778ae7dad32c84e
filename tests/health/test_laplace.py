"""Laplace's approximation: exact for normal densities, refused where none is like the density."""

from __future__ import annotations

import numpy as np
import pytest

from lmshealth._private.arrays import FloatArray
from lmshealth.health.laplace import approximate

MEAN = np.array([0.3, -1.2, 0.05])
COV = np.array([[0.04, 0.018, 0.0], [0.018, 0.01, 1e-4], [0.0, 1e-4, 1e-4]])
LOW, HIGH = np.full(3, -3.0), np.full(3, 3.0)
BEGIN = np.random.default_rng(1).uniform(-2.5, 2.5, (50, 3))


def gaussian(x: FloatArray) -> FloatArray:
    """Log density of a correlated Gaussian, cut to the box."""
    off = x - MEAN
    value = -0.5 * np.einsum("ni,ij,nj->n", off, np.linalg.inv(COV), off)
    return np.where(np.all((x > LOW) & (x < HIGH), axis=1), value, -np.inf)


def test_a_gaussian_is_its_own_approximation() -> None:
    """Mode, covariance and standard deviations are those of the density."""
    found = approximate(gaussian, BEGIN, LOW, HIGH)
    assert found is not None
    np.testing.assert_allclose(found.mode, MEAN, atol=1e-5)
    np.testing.assert_allclose(found.cov, COV, rtol=1e-4, atol=1e-8)
    np.testing.assert_allclose(found.std, np.sqrt(np.diag(COV)), rtol=1e-4)


def test_a_skew_density_has_its_curvature() -> None:
    """Of a gamma density in the logarithm, mode and curvature are ln k and 1/k."""
    k = 12.0

    def gamma(x: FloatArray) -> FloatArray:
        return k * x[:, 0] - np.exp(x[:, 0])

    found = approximate(gamma, np.zeros((1, 1)), np.array([-5.0]), np.array([8.0]))
    assert found is not None
    np.testing.assert_allclose(found.mode, np.log(k), atol=1e-5)

    np.testing.assert_allclose(found.cov[0, 0], 1 / k, rtol=1e-3)


def test_the_higher_of_two_modes_is_found() -> None:
    """Of two modes the higher one is taken, wherever the search begins."""

    def two(x: FloatArray) -> FloatArray:
        one, other = (-0.5 * ((x[:, 0] - c) / 0.1) ** 2 for c in (-1.0, 1.0))
        return np.logaddexp(one - 1.0, other)

    found = approximate(two, np.linspace(-2, 2, 41)[:, None], np.array([-3.0]), np.array([3.0]))
    assert found is not None
    np.testing.assert_allclose(found.mode, 1.0, atol=1e-5)


@pytest.mark.parametrize("slope", [1.0, -1.0])
def test_a_density_that_is_highest_at_an_edge_has_none(slope: float) -> None:
    """Exponential towards either edge of the box: no normal distribution is like it."""

    def edge(x: FloatArray) -> FloatArray:
        return slope * x.sum(axis=1)

    assert approximate(edge, BEGIN, LOW, HIGH) is None


def test_a_flat_density_has_none() -> None:
    """Without a maximum there is no curvature to invert."""
    assert approximate(lambda x: np.zeros(x.shape[0]), BEGIN, LOW, HIGH) is None
