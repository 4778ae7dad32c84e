"""Prior distributions: density and quantile belong together."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from lmshealth.priors import Lognormal, Normal, Prior, Uniform

PAIRS = [
    (Lognormal(2.0, 0.4), stats.lognorm(0.4, scale=2.0)),
    (Normal(-1.0, 3.0), stats.norm(-1.0, 3.0)),
    (Uniform(0.5, 2.5), stats.uniform(0.5, 2.0)),
]


@pytest.mark.parametrize(("prior", "book"), PAIRS)
def test_density_is_that_of_scipy_up_to_a_constant(prior: Prior, book: object) -> None:
    """Differences of log densities are those of the textbook distribution."""
    x = np.array([0.6, 1.1, 1.9, 2.4])
    found, known = prior.log_density(x), book.logpdf(x)
    np.testing.assert_allclose(found - found[0], known - known[0], atol=1e-12)


@pytest.mark.parametrize(("prior", "book"), PAIRS)
def test_quantiles_are_those_of_scipy(prior: Prior, book: object) -> None:
    """Quantiles, far tails included, are those of the textbook distribution."""
    level = np.array([1e-9, 0.05, 0.5, 0.95, 1 - 1e-9])
    np.testing.assert_allclose(prior.quantile(level), book.ppf(level), rtol=1e-7)


def test_outside_the_support_is_minus_infinity() -> None:
    """Nothing outside a support has a density, and no warning is raised there."""
    assert np.isneginf(Lognormal(1.0, 0.3).log_density(np.array([0.0, -1.0]))).all()
    assert np.isneginf(Uniform(0.0, 1.0).log_density(np.array([-0.1, 1.1]))).all()


@pytest.mark.parametrize(
    ("kind", "arguments"),
    [(Lognormal, (0.0, 1.0)), (Lognormal, (1.0, 0.0)), (Normal, (0.0, 0.0)), (Uniform, (1.0, 1.0))],
)
def test_an_impossible_prior_is_refused(kind: type, arguments: tuple[float, float]) -> None:
    """Widths of 0 and medians of 0 are no distributions."""
    with pytest.raises(ValueError, match="needs"):
        kind(*arguments)
