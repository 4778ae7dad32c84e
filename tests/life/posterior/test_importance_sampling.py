"""Importance sampling: evidences within their stated error, draws that follow, and refusals."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from arviz_stats.base.array import array_stats
from scipy import stats

from lmshealth._private.arrays import FloatArray
from lmshealth.errors import NotConverged
from lmshealth.life import constants
from lmshealth.life.posterior.sampling import (
    Proposal,
    WeightedDraws,
    draw_to_ess,
    importance_sample,
)

Density = Callable[[FloatArray], FloatArray]
LN_SCALE = 12.3  # of densities that are not normalised


def start(n_dim: int, seed: int = 1) -> FloatArray:
    """Draw points much wider than the densities here."""
    return 5 * np.random.default_rng(seed).standard_normal((600, n_dim))


def gaussian(n_dim: int) -> Density:
    """Return a correlated Gaussian off the origin, far narrower than the start."""
    rng = np.random.default_rng(n_dim)
    root = 0.2 * rng.standard_normal((n_dim, n_dim)) + 0.1 * np.eye(n_dim)
    book = stats.multivariate_normal(np.linspace(-1, 2, n_dim), root @ root.T)
    return lambda x: LN_SCALE + np.reshape(book.logpdf(x), x.shape[0])


def two_peaks(x: FloatArray) -> FloatArray:
    """Return 30 % about (-3, -3) and 70 % about (3, 3), twelve standard deviations apart."""
    parts = [
        np.log(share) + stats.multivariate_normal(np.full(2, centre), 0.5**2).logpdf(x)
        for share, centre in ((0.3, -3.0), (0.7, 3.0))
    ]
    return LN_SCALE + np.logaddexp(*parts)


def half(x: FloatArray) -> FloatArray:
    """Return a Gaussian without its left half."""
    return np.where(x[:, 0] > 0, LN_SCALE + stats.norm.logpdf(x).sum(axis=1), -np.inf)


def banana(x: FloatArray) -> FloatArray:
    """Return y about 0.3 x²."""
    y = stats.norm(0.3 * x[:, 0] ** 2, 0.5)
    return LN_SCALE + stats.norm.logpdf(x[:, 0]) + y.logpdf(x[:, 1])


def sample_to_ess(
    density: Density, points: FloatArray, rng: np.random.Generator, n: int
) -> WeightedDraws:
    """Draw from a density until enough of the draws are effective."""
    return draw_to_ess(density, importance_sample(density, points, rng, n), rng)


def agrees(found: WeightedDraws, known: float) -> bool:
    """Whether an evidence is the known one within 4.5 of its stated standard deviations."""
    return bool(abs(found.log_evidence - known) < 4.5 / np.sqrt(found.ess))


CASES = [
    *[(gaussian(n), n, LN_SCALE) for n in (1, 2, 4, 6)],
    (two_peaks, 2, LN_SCALE),
    (half, 3, LN_SCALE + np.log(0.5)),
    (banana, 2, LN_SCALE),
]
IDS = ["1", "2", "4", "6", "two-peaks", "half", "banana"]


@pytest.mark.parametrize(("density", "n_dim", "known"), CASES, ids=IDS)
def test_evidences_are_right_within_their_error(density: Density, n_dim: int, known: float) -> None:
    """Integrals of known densities are found, and a fifth more or less would be noticed."""
    found = sample_to_ess(density, start(n_dim), np.random.default_rng(2), 4000)
    assert found.ess > 900
    assert agrees(found, known)
    assert not agrees(found, known + np.log(1.2))
    assert not agrees(found, known - np.log(1.2))
    assert found.weight.sum() == pytest.approx(1, abs=1e-12)


@pytest.mark.slow
def test_the_stated_error_is_that_of_many_evidences() -> None:
    """Evidences of 40 seeds scatter by no more than for their effective sample sizes."""
    scores = []
    for seed in range(40):
        found = importance_sample(
            two_peaks, start(2, seed), np.random.default_rng(100 + seed), 1500
        )
        scores.append((found.log_evidence - LN_SCALE) * np.sqrt(found.ess))
    total = np.sum(np.square(scores))
    assert total < stats.chi2(40).ppf(0.9995)
    # An effective size counts what draws of the density itself would scatter too.
    assert total > 0.05 * 40
    # Negative control: errors of a fifth of their size.
    assert 25 * total > stats.chi2(40).ppf(0.9995)


def test_peaks_far_apart_have_their_share() -> None:
    """Draws are on both peaks by their integrals, weighted and resampled."""
    rng = np.random.default_rng(3)
    found = sample_to_ess(two_peaks, start(2), rng, 4000)
    right = found.points[:, 0] > 0
    error = np.sqrt(0.3 * 0.7 / found.ess)
    assert abs(found.weight[right].sum() - 0.7) < 4.5 * error
    assert abs(right.mean() - 0.5) < 0.5  # both have points
    drawn = found.resampled(rng, 5000)
    assert drawn.shape == (5000, 2)
    share = np.mean(drawn[:, 0] > 0)
    assert abs(share - 0.7) < 4.5 * np.sqrt(error**2 + 0.3 * 0.7 / 5000)
    assert abs(share - 0.5) > 4.5 * np.sqrt(error**2 + 0.3 * 0.7 / 5000)  # negative control


def test_draws_of_equal_weight_have_the_moments() -> None:
    """Of a banana: means of x, y and x² are 0, 0.3 and 1, within the error of the draws."""
    rng = np.random.default_rng(4)
    found = sample_to_ess(banana, start(2), rng, 4000)
    drawn = found.resampled(rng, 4000)
    ess = 1 / (1 / found.ess + 1 / 4000)
    for values, known in ((drawn[:, 0], 0.0), (drawn[:, 1], 0.3), (drawn[:, 0] ** 2, 1.0)):
        assert abs(values.mean() - known) < 4.5 * values.std() / np.sqrt(ess)


def test_points_are_resampled_by_their_weight() -> None:
    """Counts of resampled points follow the weights; one without weight never comes."""
    weight = np.array([0.5, 0.3, 0.2, 0.0])
    draws = WeightedDraws(np.arange(4.0)[:, None], weight, 0.0)
    found = draws.resampled(np.random.default_rng(5), 10_000)
    count = np.bincount(found[:, 0].astype(int), minlength=4)
    assert count[3] == 0
    assert stats.chisquare(count[:3], 10_000 * weight[:3]).pvalue > 1e-4
    assert draws.ess == pytest.approx(1 / 0.38)


def test_the_generator_alone_decides() -> None:
    """One seed has the same draws, another one others."""
    one, two, other = (
        importance_sample(two_peaks, start(2), np.random.default_rng(seed), 500)
        for seed in (6, 6, 7)
    )
    np.testing.assert_array_equal(one.points, two.points)
    assert one.log_evidence == two.log_evidence
    assert not np.array_equal(one.points, other.points)


def test_points_outside_of_the_support_are_left_out_but_count() -> None:
    """Draws without a density are none, yet the evidence is of all that were drawn."""
    found = importance_sample(half, np.abs(start(1)), np.random.default_rng(8), 20_000)
    assert (found.points > 0).all()
    assert found.weight.size < 20_000
    assert agrees(found, LN_SCALE + np.log(0.5))
    # Negative control: had only those inside been counted.
    wrong = LN_SCALE + np.log(0.5) - np.log(found.weight.size / 20_000)
    assert not agrees(found, wrong)


def test_too_few_draws_are_repeated() -> None:
    """Draws worth less than 400 are drawn again, twice to three times as many."""
    found = sample_to_ess(gaussian(2), start(2), np.random.default_rng(9), 300)
    assert found.points.shape[0] == 600
    assert found.ess >= constants.MIN_ESS


def test_what_stays_too_little_is_refused_with_its_points() -> None:
    """After four more times less than 400 effective draws are an error with their number."""
    with pytest.raises(NotConverged, match=r"of 324 by importance.*needed are 400") as caught:
        sample_to_ess(gaussian(2), start(2), np.random.default_rng(10), 4)
    assert np.asarray(caught.value.chains).shape == (324, 2)


def test_a_start_outside_of_the_support_is_refused() -> None:
    """Where no point has a density the error names what to widen, with the points."""
    with pytest.raises(NotConverged, match="widen the map or the prior") as caught:
        importance_sample(half, -np.abs(start(2)), np.random.default_rng(11), 500)
    assert np.asarray(caught.value.chains).shape == (600, 2)


@pytest.mark.parametrize("inside", [1, 2, 4])
def test_a_start_that_spans_fewer_dimensions_than_the_density(inside: int) -> None:
    """Few points of the start inside the support still lead to the whole density."""
    points = start(6, seed=inside)
    known = stats.multivariate_normal(np.zeros(6))
    reached = np.zeros(points.shape[0], bool)
    reached[np.argsort((points**2).sum(axis=1))[:inside]] = True

    def density(x: FloatArray) -> FloatArray:
        value = LN_SCALE + np.reshape(known.logpdf(x), x.shape[0])
        return np.where(reached, value, -np.inf) if x is points else value

    found = sample_to_ess(density, points, np.random.default_rng(2), 2000)
    assert agrees(found, LN_SCALE)


# Proposals


def proposal(n_dim: int) -> Proposal:
    """Make a proposal near draws of a correlated Gaussian."""
    rng = np.random.default_rng(1)
    root = 0.2 * np.random.default_rng(n_dim).standard_normal((n_dim, n_dim)) + 0.1 * np.eye(n_dim)
    points = rng.standard_normal((500, n_dim)) @ root.T + np.linspace(-1, 2, n_dim)
    return Proposal.near(WeightedDraws(points, np.full(500, 1 / 500), 0.0), rng)


def test_the_density_of_a_proposal_integrates_to_one() -> None:
    """In one dimension on a grid with its tails, in two over a wide one."""
    one = proposal(1)
    x = one.mean + one.factor[0] * np.sinh(np.linspace(-9, 9, 20_001))[:, None]
    assert np.trapezoid(np.exp(one.log_density(x)), x[:, 0]) == pytest.approx(1, abs=1e-4)
    two = proposal(2)
    axis = np.linspace(-14, 14, 561)
    unit = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    cell = (axis[1] - axis[0]) ** 2 * np.prod(np.diag(two.factor))
    total = np.exp(two.log_density(two.mean + unit @ two.factor.T)).sum() * cell
    assert total == pytest.approx(1, abs=3e-3)


@pytest.mark.parametrize("n_dim", [1, 2, 5])
def test_draws_of_a_proposal_follow_its_density(n_dim: int) -> None:
    """A Gaussian integrated by the proposal's draws is 1, as with the generator of emcee."""
    own = proposal(n_dim)
    book = stats.multivariate_normal(own.mean, 1.3 * own.factor @ own.factor.T)
    for rng in (np.random.default_rng(2), np.random.RandomState(3)):
        x = own.draw(rng, 20_000)
        ratio = np.exp(np.reshape(book.logpdf(x), -1) - own.log_density(x))
        error = ratio.std() / np.sqrt(20_000)
        assert abs(ratio.mean() - 1) < 4.5 * error
        assert error < 0.02
        assert abs(1.1 * ratio.mean() - 1) > 4.5 * error  # negative control
    in_one = own.draw(np.random.default_rng(4), 20_000)[:, 0]
    if n_dim == 1:
        grid = np.sort(in_one)
        fine = own.mean[0] + own.factor[0, 0] * np.sinh(np.linspace(-9, 9, 40_001))
        cdf = np.cumsum(np.exp(own.log_density(fine[:, None])) * np.gradient(fine))
        assert stats.kstest(grid, lambda v: np.interp(v, fine, cdf)).pvalue > 1e-4


@pytest.mark.parametrize("n", [60, 226, 3000])
@pytest.mark.parametrize("scale", [0.3, 1.0, 3.0])
def test_pareto_k_is_that_of_arviz(n: int, scale: float) -> None:
    """Few and many weights, whose tail is light or so heavy that they fail."""
    weight = np.exp(scale * np.random.default_rng(n).standard_t(4, n))
    found = WeightedDraws(np.zeros((n, 1)), weight / weight.sum(), 0.0).pareto_k
    assert found == pytest.approx(float(array_stats.psislw(-np.log(weight))[1]), abs=1e-10)


def test_pareto_k_of_few_weights_is_unknown() -> None:
    """Of 24 weights the tail would have four."""
    assert np.isnan(WeightedDraws(np.zeros((24, 1)), np.full(24, 1 / 24), 0.0).pareto_k)
