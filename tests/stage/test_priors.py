"""Prior distributions: density and quantile belong together."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import trapezoid

from lmshealth.stage.priors import JointPrior, Lognormal, Normal, Prior, Uniform

PAIRS: list[tuple[Prior, Any]] = [
    (Lognormal(2.0, 0.4), stats.lognorm(0.4, scale=2.0)),
    (Normal(-1.0, 3.0), stats.norm(-1.0, 3.0)),
    (Uniform(0.5, 2.5), stats.uniform(0.5, 2.0)),
]


@pytest.mark.parametrize(("prior", "book"), PAIRS)
def test_density_is_that_of_scipy(prior: Prior, book: Any) -> None:
    """Log densities are those of the textbook distribution, whose integral is 1."""
    x = np.array([0.6, 1.1, 1.9, 2.4])
    np.testing.assert_allclose(prior.log_density(x), book.logpdf(x), atol=1e-12)


@pytest.mark.parametrize(("prior", "book"), PAIRS)
def test_densities_are_the_slope_of_probabilities(prior: Prior, book: Any) -> None:
    """What a density integrates to between two values is the probability between them."""
    x = np.linspace(0.6, 2.4, 20_001)
    mass = trapezoid(np.exp(prior.log_density(x)), x)
    below, upto = prior.probability(np.array([0.6, 2.4]))
    assert mass == pytest.approx(upto - below, rel=1e-8)


@pytest.mark.parametrize(("prior", "book"), PAIRS)
def test_quantiles_are_those_of_scipy(prior: Prior, book: Any) -> None:
    """Quantiles, far tails included, are those of the textbook distribution."""
    level = np.array([1e-9, 0.05, 0.5, 0.95, 1 - 1e-9])
    np.testing.assert_allclose(prior.quantile(level), book.ppf(level), rtol=1e-7)


def test_outside_the_support_is_minus_infinity() -> None:
    """Nothing outside a support has a density, and no warning is raised there."""
    assert np.isneginf(Lognormal(1.0, 0.3).log_density(np.array([0.0, -1.0]))).all()
    assert np.isneginf(Uniform(0.0, 1.0).log_density(np.array([-0.1, 1.1]))).all()


@pytest.mark.parametrize(
    ("kind", "arguments"),
    [
        (Lognormal, (0.0, 1.0)),
        (Lognormal, (1.0, 0.0)),
        (Lognormal, (1.0, np.inf)),
        (Normal, (0.0, 0.0)),
        (Normal, (np.nan, 1.0)),
        (Uniform, (1.0, 1.0)),
        (Uniform, (-np.inf, 1.0)),
    ],
)
def test_an_impossible_prior_is_refused(kind: type, arguments: tuple[float, float]) -> None:
    """Widths of 0 or without end, medians of 0 and numbers that are none are no distributions."""
    with pytest.raises(ValueError, match="needs"):
        kind(*arguments)


@pytest.mark.parametrize(("prior", "book"), PAIRS)
def test_probabilities_are_those_of_scipy(prior: Prior, book: Any) -> None:
    """Distribution functions are those of the textbook, far tails and impossible values too."""
    x = np.array([-1.0, 0.0, 1e-3, 0.6, 1.9, 2.4, 40.0])
    np.testing.assert_allclose(prior.probability(x), book.cdf(x), atol=1e-14)


@pytest.fixture
def joint() -> JointPrior:
    """One prior of each kind over a box that cuts the first two."""
    low, high = np.log([1.0, 0.5, 0.4]), np.log([3.0, 4.0, 3.0])
    return JointPrior(("a", "b", "c"), tuple(prior for prior, _ in PAIRS), low, high)


def test_a_joint_prior_is_cut_to_its_box(joint: JointPrior) -> None:
    """Draws have the truncated distribution, and quantiles of 0 and 1 are the ends of it."""
    x = np.exp(joint.draw(np.random.default_rng(3), 20_000))
    for j, (_, book) in enumerate(PAIRS):
        below, upto = book.cdf(np.exp([joint.low[j], joint.high[j]]))

        def cut(values: Any, book: Any = book, a: float = below, b: float = upto) -> Any:
            return np.clip((book.cdf(values) - a) / (b - a), 0, 1)

        assert stats.kstest(x[:, j], cut).pvalue > 1e-4
        assert stats.kstest(1.02 * x[:, j], cut).pvalue < 1e-4  # negative control
    low, high = joint.quantile(np.array([[0.0], [1.0]]))
    np.testing.assert_allclose(np.exp(low), [1.0, 0.5, 0.5])
    np.testing.assert_allclose(np.exp(high), [3.0, 4.0, 2.5])


@pytest.mark.parametrize(
    "prior", [Lognormal(1.0, 1e-4), Normal(1.0, 1e-3), Uniform(0.999, 1.001), Normal(1.0, 100.0)]
)
def test_a_narrow_or_wide_prior_has_finite_ends(prior: Prior) -> None:
    """Without probability below the box the lowest quantile is 0 or infinite: its end counts."""
    joint = JointPrior(("a",), (prior,), *np.log([[0.3], [1.5]]))
    low, high = joint.quantile(np.array([[0.0], [1.0]]))
    assert np.log(0.3) - 1e-12 <= low < high <= np.log(1.5) + 1e-12
    assert 0 < joint.variance < 1


def test_the_ends_of_the_box_belong_to_it(joint: JointPrior) -> None:
    """A posterior may be highest where the map ends; beyond that, however little, is nothing."""
    ends = np.array([joint.low, joint.high])
    outwards = np.array([[-1e-9], [1e-9]])
    assert joint.inside(ends).all()
    assert not joint.inside(ends + outwards).any()


def test_a_joint_density_is_that_of_the_logarithms(joint: JointPrior) -> None:
    """Differences are those of the textbook densities with the Jacobian; outside it is zero."""
    x = np.log([[1.5, 1.0, 0.6], [2.5, 3.9, 2.4], [0.9, 1.0, 0.6], [1.5, 1.0, 2.6]])
    found = joint.log_density(x)
    known = sum(b.logpdf(np.exp(x[:2, j])) + x[:2, j] for j, (_, b) in enumerate(PAIRS))
    np.testing.assert_allclose(np.diff(found[:2]), np.diff(known))
    assert np.isneginf(found[2:]).all()


@pytest.mark.parametrize("prior", [Lognormal(2.0, 0.4), Normal(-1.0, 3.0)])
def test_standard_values_are_standard_normal(prior: Lognormal | Normal) -> None:
    """Quantiles become those of the standard normal, and another mean and width can be given."""
    levels = np.array([0.01, 0.3, 0.5, 0.9])
    z = stats.norm.ppf(levels)
    np.testing.assert_allclose(prior.standard(prior.quantile(levels)), z, atol=1e-12)
    placed = prior.placed(0.7, 0.5)
    np.testing.assert_allclose(prior.standard(placed.quantile(levels)), 0.7 + 0.5 * z, atol=1e-12)
    assert prior.placed(0.0, 1.0) == prior
