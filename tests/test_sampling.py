"""The sampler: seeds, independence of ensembles, known posteriors, refusal."""

from __future__ import annotations

import numpy as np
import pytest

from lmshealth import sampling
from lmshealth.arrays import FloatArray
from lmshealth.errors import NotConverged
from lmshealth.sampling import Sample, find_start, sample, stream

MEAN = np.array([0.3, -1.2])
COV = np.array([[0.04, 0.018], [0.018, 0.01]])


def gaussian(x: FloatArray) -> FloatArray:
    """Log density of a correlated Gaussian."""
    off = x - MEAN
    return -0.5 * np.einsum("ni,ij,nj->n", off, np.linalg.inv(COV), off)


def wide(rng: np.random.Generator, n: int) -> FloatArray:
    """Draw from a prior much wider than the posteriors here."""
    return 3 * rng.standard_normal((n, 2))


@pytest.fixture(scope="module")
def drawn() -> Sample:
    """One sample of the Gaussian."""
    return sample(gaussian, wide, stream(7, 1))


def agree(values: FloatArray, known: float, ess: float) -> None:
    """Hold a mean of draws to its own Monte-Carlo error."""
    assert abs(values.mean() - known) < 5 * values.std() / np.sqrt(ess)


def test_moments_of_a_gaussian(drawn: Sample) -> None:
    """Mean and covariance are right within the Monte-Carlo error of the stated sample size."""
    off = drawn.draws - MEAN
    ess = drawn.ess.min()
    for i in range(2):
        agree(drawn.draws[:, i], MEAN[i], ess)
        for j in range(2):
            agree(off[:, i] * off[:, j], COV[i, j], ess)


def test_a_sample_carries_its_evidence(drawn: Sample) -> None:
    """ESS is less than the number of draws and more than 1,000; R-hat is below 1.01."""
    assert drawn.draws.shape[1] == 2
    assert (drawn.ess < drawn.draws.shape[0]).all()
    assert (drawn.ess > 1000).all()
    assert (drawn.r_hat < 1.01).all()


def test_a_wrong_mean_is_noticed(drawn: Sample) -> None:
    """Negative control: a mean off by a fifth of a standard deviation fails the same check."""
    with pytest.raises(AssertionError):
        agree(drawn.draws[:, 0], MEAN[0] + 0.2 * np.sqrt(COV[0, 0]), drawn.ess.min())


def test_the_same_seed_gives_the_same_draws(drawn: Sample) -> None:
    """Two calls with one seed agree to the bit."""
    np.testing.assert_array_equal(sample(gaussian, wide, stream(7, 1)).draws, drawn.draws)


def test_another_seed_gives_other_draws(drawn: Sample) -> None:
    """Another user's seed, or another step of the computation, gives other draws."""
    for seed in (stream(8, 1), stream(7, 2)):
        other = sample(gaussian, wide, seed).draws
        n = min(other.shape[0], drawn.draws.shape[0])
        assert not np.any(np.all(other[:n] == drawn.draws[:n], axis=1))


def test_the_global_random_state_plays_no_part(drawn: Sample) -> None:
    """Draws do not depend on numpy's global state, and leave it alone."""
    np.random.seed(3)  # noqa: NPY002 - the legacy state is the point
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    np.testing.assert_array_equal(sample(gaussian, wide, stream(7, 1)).draws, drawn.draws)
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002


def test_ensembles_of_one_process_differ(drawn: Sample) -> None:
    """No two of the independent ensembles hold a draw in common."""
    n_walkers = 16
    chains = drawn.draws.reshape(-1, sampling._N_ENSEMBLES, n_walkers, 2)
    for a in range(sampling._N_ENSEMBLES):
        for b in range(a):
            one = {tuple(point) for point in chains[-50:, a].reshape(-1, 2)}
            two = {tuple(point) for point in chains[-50:, b].reshape(-1, 2)}
            assert not one & two


def test_streams_are_named_by_seed_and_step() -> None:
    """A stream is a function of its numbers, and sequences of seeds are taken as they are."""
    assert stream(1, 2).generate_state(4).tolist() == stream((1, 2)).generate_state(4).tolist()
    assert stream(1, 2).generate_state(4).tolist() != stream(2, 1).generate_state(4).tolist()


def test_moments_of_a_banana() -> None:
    """A curved posterior, y = x² + noise, has the right means of x, y and x²."""

    def banana(x: FloatArray) -> FloatArray:
        return -0.5 * x[:, 0] ** 2 - 0.5 * (x[:, 1] - x[:, 0] ** 2) ** 2

    found = sample(banana, wide, stream(11))
    ess = found.ess.min()
    agree(found.draws[:, 0], 0.0, ess)
    agree(found.draws[:, 1], 1.0, ess)
    agree(found.draws[:, 0] ** 2, 1.0, ess)
    agree((found.draws[:, 1] - found.draws[:, 0] ** 2) ** 2, 1.0, ess)


def test_more_dimensions_keep_their_width() -> None:
    """In six dimensions the mean square distance is right: moves must not shrink a posterior."""

    def ball(x: FloatArray) -> FloatArray:
        return -0.5 * np.sum(x**2, axis=1)

    found = sample(ball, lambda rng, n: 2 * rng.standard_normal((n, 6)), stream(15))
    agree(np.mean(found.draws**2, axis=1), 1.0, found.ess.min())


def test_one_dimension_with_an_edge() -> None:
    """A half normal keeps to its support and has the right mean."""

    def half(x: FloatArray) -> FloatArray:
        return np.where(x[:, 0] > 0, -0.5 * x[:, 0] ** 2, -np.inf)

    found = sample(half, lambda rng, n: 3 * rng.standard_normal((n, 1)), stream(12))
    assert (found.draws > 0).all()
    agree(found.draws[:, 0], np.sqrt(2 / np.pi), found.ess.min())


def test_modes_far_apart_are_refused_with_their_chains(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ensembles that keep to their own mixture of two far modes are told from a posterior."""
    monkeypatch.setattr(sampling, "_MOST_STEPS", 1200)

    def two(x: FloatArray) -> FloatArray:
        return np.logaddexp(*(-0.5 * np.sum(((x - c) / 0.05) ** 2, axis=1) for c in (-40.0, 40.0)))

    def prior(rng: np.random.Generator, n: int) -> FloatArray:
        side = rng.choice([-40.0, 40.0], size=(n, 1))
        return side + 0.1 * rng.standard_normal((n, 3))

    with pytest.raises(NotConverged, match=r"after 1200 steps.*several modes") as caught:
        sample(two, prior, stream(13))
    chains = np.asarray(caught.value.chains)
    assert chains.shape == (sampling._N_ENSEMBLES, 1200, 18, 3)
    assert not np.array_equal(chains[0], chains[1])


def test_too_few_steps_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer steps than 50 autocorrelation times are not enough, however good they look."""
    monkeypatch.setattr(sampling, "_FIRST_STEPS", 60)
    monkeypatch.setattr(sampling, "_MOST_STEPS", 60)
    with pytest.raises(NotConverged, match="needed are 50"):
        sample(gaussian, wide, stream(14))


@pytest.mark.parametrize("width", [1e-4, 1e-2, 1.0])
def test_starts_are_inside_the_support_and_distinct(width: float) -> None:
    """However narrow the support within the prior, every walker starts inside, alone."""

    def box(x: FloatArray) -> FloatArray:
        inside = np.all(np.abs(x - 0.1) < 2 * max(width, 0.15), axis=1)
        return np.where(inside, -0.5 * np.sum(((x - 0.1) / width) ** 2, axis=1), -np.inf)

    start = find_start(box, wide, np.random.default_rng(1))
    points = start()
    assert points.shape == (16, 2)
    assert np.isfinite(box(points)).all()
    assert np.unique(points, axis=0).shape[0] == 16
    assert not np.array_equal(points, start())


def test_starts_find_a_posterior_far_narrower_than_the_prior() -> None:
    """Walkers start at the posterior, a thousandth of the prior wide, with about its spread."""

    def narrow(x: FloatArray) -> FloatArray:
        return -0.5 * np.sum(((x - 1.0) / 3e-3) ** 2, axis=1)

    points = find_start(narrow, wide, np.random.default_rng(2))()
    assert np.abs(points - 1.0).max() < 10 * 3e-3
    assert points.std() > 3e-4


def test_a_prior_outside_the_support_is_refused() -> None:
    """Where no draw of the prior is possible the error says what to widen, with the draws."""
    with pytest.raises(NotConverged, match="widen the map or the prior") as caught:
        find_start(lambda x: np.full(x.shape[0], -np.inf), wide, np.random.default_rng(3))
    assert np.asarray(caught.value.chains).shape[-1] == 2
