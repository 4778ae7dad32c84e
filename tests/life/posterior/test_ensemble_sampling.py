"""The sampler: seeds, independence of ensembles, known posteriors, refusal."""

from __future__ import annotations

import numpy as np
import pytest
from arviz_stats.base.array import array_stats
from emcee import autocorr
from emcee.autocorr import integrated_time
from scipy import stats

from lmshealth._private.arrays import FloatArray
from lmshealth._private.serialize import stream
from lmshealth.errors import NotConverged
from lmshealth.life import constants
from lmshealth.life.posterior import sampling
from lmshealth.life.posterior.sampling import Sample, WeightedDraws, _start, sample

MEAN = np.array([0.3, -1.2])
WALKERS = 16
COV = np.array([[0.04, 0.018], [0.018, 0.01]])


def gaussian(x: FloatArray) -> FloatArray:
    """Log density of a correlated Gaussian."""
    off = x - MEAN
    return -0.5 * np.einsum("ni,ij,nj->n", off, np.linalg.inv(COV), off)


def even(points: FloatArray) -> WeightedDraws:
    """Make draws of equal weight."""
    n = points.shape[0]
    return WeightedDraws(points, np.full(n, 1 / n), 0.0)


def wide(n_dim: int = 2, *, scale: float = 3.0) -> WeightedDraws:
    """Draw from a prior much wider than the posteriors here."""
    return even(scale * np.random.default_rng(0).standard_normal((800, n_dim)))


BEGIN = wide()
# Draws about the Gaussian, twice to four times as wide. Chains from there are a fifth as long as
# from `BEGIN`, and of twelve draws of them one is effective.
NEAR = even(MEAN + 0.4 * np.random.default_rng(0).standard_normal((800, 2)))


@pytest.fixture(scope="module")
def drawn() -> Sample:
    """One sample of the Gaussian."""
    return sample(gaussian, NEAR, stream(7, 1))


def flat(found: Sample) -> FloatArray:
    """Return the draws of the ensembles in turn."""
    return np.swapaxes(found.draws, 0, 1).reshape(-1, found.draws.shape[-1])


def agree(values: FloatArray, known: float, ess: float) -> None:
    """Hold a mean of draws to its own Monte-Carlo error."""
    assert abs(values.mean() - known) < 5 * values.std() / np.sqrt(ess)


@pytest.mark.slow
@pytest.mark.parametrize("begin", [BEGIN, NEAR], ids=["wide", "near"])
def test_moments_of_a_gaussian(begin: WeightedDraws) -> None:
    """Mean and covariance are right within the Monte-Carlo error of the stated sample size.

    Sample sizes lie between 1,000 and the number of draws; R-hat is below 1.01.
    """
    found = sample(gaussian, begin, stream(7, 1))
    off = flat(found) - MEAN
    smallest = found.ess_bulk.min()
    for i in range(2):
        agree(flat(found)[:, i], MEAN[i], smallest)
        for j in range(2):
            agree(off[:, i] * off[:, j], COV[i, j], smallest)
    assert found.draws.shape[::2] == (constants.N_ENSEMBLES, 2)
    for ess in (found.ess_bulk, found.ess_tail):
        assert (ess < flat(found).shape[0]).all()
        assert (ess > 1000).all()
    assert (found.r_hat < 1.01).all()


def test_a_wrong_mean_is_noticed(drawn: Sample) -> None:
    """Negative control: a mean off by a fifth of a standard deviation fails the same check."""
    with pytest.raises(AssertionError):
        agree(flat(drawn)[:, 0], MEAN[0] + 0.2 * np.sqrt(COV[0, 0]), drawn.ess_bulk.min())


@pytest.mark.slow
def test_another_seed_gives_other_draws(drawn: Sample) -> None:
    """Another user's seed, or another step of the computation, gives other draws."""
    for seed in (stream(8, 1), stream(7, 2)):
        other = sample(gaussian, NEAR, seed).draws
        n = min(other.shape[1], drawn.draws.shape[1])
        assert not np.any(np.all(other[:, :n] == drawn.draws[:, :n], axis=2))


@pytest.mark.slow
def test_the_same_seed_gives_the_same_draws(drawn: Sample) -> None:
    """Two calls with one seed agree to the bit, whatever numpy's global state; they leave it."""
    np.random.seed(3)  # noqa: NPY002 - the legacy state is the point
    before = np.random.get_state(legacy=False)["state"]["key"].copy()  # noqa: NPY002
    np.testing.assert_array_equal(sample(gaussian, NEAR, stream(7, 1)).draws, drawn.draws)
    after = np.random.get_state(legacy=False)["state"]["key"]  # noqa: NPY002
    np.testing.assert_array_equal(after, before)


def test_ensembles_of_one_process_differ(drawn: Sample) -> None:
    """No two of the independent ensembles hold a draw in common."""
    for a in range(constants.N_ENSEMBLES):
        for b in range(a):
            one = {tuple(point) for point in drawn.draws[a, -800:]}
            two = {tuple(point) for point in drawn.draws[b, -800:]}
            assert not one & two


@pytest.mark.slow
def test_sample_sizes_are_honest() -> None:
    """Means of independent samples scatter by as much as for their effective sample size."""
    found = [sample(gaussian, NEAR, stream(7, 20 + k)) for k in range(24)]
    means = np.array([flat(one).mean(axis=0) for one in found])
    ess = np.mean([one.ess_bulk for one in found], axis=0)
    # Draws depend on each other: their number would be a size that the control below notices.
    assert (8 * ess < min(flat(one).shape[0] for one in found)).all()
    ratio = np.var(means, axis=0, ddof=1) / (np.diag(COV) / ess)
    low, high = np.asarray(stats.chi2.ppf([5e-4, 1 - 5e-4], 23)) / 23
    assert ((low < ratio) & (ratio < high)).all(), ratio
    assert (8 * ratio > high).all()  # negative control: sizes eight times too large


def test_streams_are_named_by_seed_and_step() -> None:
    """A stream is a function of its numbers, and sequences of seeds are taken as they are."""
    assert stream(1, 2).generate_state(4).tolist() == stream((1, 2)).generate_state(4).tolist()
    assert stream(1, 2).generate_state(4).tolist() != stream(2, 1).generate_state(4).tolist()


@pytest.mark.slow
def test_moments_of_a_banana() -> None:
    """A curved posterior, y = x² + noise, has the right means of x, y and x²."""

    def banana(x: FloatArray) -> FloatArray:
        return -0.5 * x[:, 0] ** 2 - 0.5 * (x[:, 1] - x[:, 0] ** 2) ** 2

    found = sample(banana, BEGIN, stream(11))
    x, y = flat(found).T
    ess = found.ess_bulk.min()
    agree(x, 0.0, ess)
    agree(y, 1.0, ess)
    agree(x**2, 1.0, ess)
    agree((y - x**2) ** 2, 1.0, ess)


@pytest.mark.slow
def test_more_dimensions_keep_their_width() -> None:
    """In six dimensions the mean square distance is right: moves must not shrink a posterior."""

    def ball(x: FloatArray) -> FloatArray:
        return -0.5 * np.sum(x**2, axis=1)

    found = sample(ball, wide(6, scale=2.0), stream(15))
    agree(np.mean(flat(found) ** 2, axis=1), 1.0, found.ess_bulk.min())


@pytest.mark.slow
def test_one_dimension_with_an_edge() -> None:
    """A half normal keeps to its support and has the right mean."""

    def half(x: FloatArray) -> FloatArray:
        return np.where(x[:, 0] > 0, -0.5 * x[:, 0] ** 2, -np.inf)

    found = sample(half, even(np.abs(wide(1).points)), stream(12))
    assert (found.draws > 0).all()
    agree(flat(found)[:, 0], np.sqrt(2 / np.pi), found.ess_bulk.min())


@pytest.mark.slow
def test_modes_far_apart_have_their_share() -> None:
    """Independent proposals reach both of two far modes, by their integrals."""

    def two(x: FloatArray) -> FloatArray:
        parts = [np.log(p) - 0.5 * np.sum(((x - c) / 0.4) ** 2, axis=1)
                 for p, c in ((0.3, -3.0), (0.7, 3.0))]  # fmt: skip
        return np.logaddexp(*parts)

    side = np.random.default_rng(13).choice([-3.0, 3.0], size=(800, 1))
    start = even(side + 0.4 * np.random.default_rng(14).standard_normal((800, 2)))
    found = sample(two, start, stream(13))
    right = (flat(found)[:, 0] > 0).astype(float)
    agree(right, 0.7, found.ess_bulk.min())
    with pytest.raises(AssertionError):
        agree(right, 0.5, found.ess_bulk.min())


@pytest.mark.slow
def test_modes_that_no_proposal_joins_are_refused_with_their_chains(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Ensembles of which each begins in its own mode do not converge."""
    monkeypatch.setattr(constants, "MAX_CHAIN_STEPS", 1200)

    def two(x: FloatArray) -> FloatArray:
        return np.logaddexp(*(-0.5 * np.sum(((x - c) / 0.05) ** 2, axis=1) for c in (-40.0, 40.0)))

    sides = iter((-40.0, 40.0, -40.0, 40.0))

    def near(_: WeightedDraws, rng: np.random.Generator) -> FloatArray:
        return next(sides) + 0.1 * rng.standard_normal((WALKERS, 3))

    class Local:
        """Proposes points about a mode only."""

        def near(self, _: WeightedDraws, __: np.random.Generator) -> Local:
            return self

        def draw(self, rng: np.random.RandomState, n: int) -> FloatArray:
            return rng.standard_normal((n, 3))

        def log_density(self, points: FloatArray) -> FloatArray:
            return np.zeros(points.shape[0])

    monkeypatch.setattr(sampling, "_start", near)
    monkeypatch.setattr(sampling, "Proposal", Local())
    with pytest.raises(NotConverged, match=r"after 1200 steps.*several modes") as caught:
        sample(two, wide(3), stream(13))
    chains = np.asarray(caught.value.chains)
    assert chains.shape == (constants.N_ENSEMBLES, 1200, WALKERS, 3)
    assert not np.array_equal(chains[0], chains[1])


def test_too_few_steps_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer steps than 50 autocorrelation times are not enough, whatever R-hat is."""
    monkeypatch.setattr(sampling, "_FIRST_STEPS", 60)
    monkeypatch.setattr(constants, "MAX_CHAIN_STEPS", 60)
    with pytest.raises(NotConverged, match="needed are 50"):
        sample(gaussian, BEGIN, stream(14))


def test_chains_grow_by_half_at_least(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that does not converge is looked at few times, and the last time at its full length."""
    first, most, lengths = 16, 50, list[int]()

    arrived = even(np.random.default_rng(1).multivariate_normal(MEAN, COV, size=500))

    def doubtful(chains: FloatArray) -> FloatArray:
        return np.full(chains.shape[-1], 2.0)

    def counted(chain: FloatArray, **options: object) -> FloatArray:
        lengths.append(chain.shape[0])
        return integrated_time(chain, **options)

    monkeypatch.setattr(sampling, "_FIRST_STEPS", first)
    monkeypatch.setattr(sampling, "rank_r_hat", doubtful)
    monkeypatch.setattr(constants, "MAX_CHAIN_STEPS", most)
    monkeypatch.setattr(constants, "MIN_AUTOCORRELATION_TIMES", 0)
    monkeypatch.setattr(autocorr, "integrated_time", counted)
    with pytest.raises(NotConverged, match=r"after 50 steps .* R-hat 2\.000"):
        sample(gaussian, arrived, stream(15))
    lengths_seen = np.unique(lengths)
    assert lengths_seen[0] == first
    assert lengths_seen[-1] == most
    assert lengths_seen.size > 2
    assert (lengths_seen[1:] >= np.minimum(1.5 * lengths_seen[:-1], most)).all()


def test_a_walker_that_never_moves_is_no_convergence(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that begins on a needle stays there: refused with the chains, not with a broken sum."""
    monkeypatch.setattr(sampling, "_FIRST_STEPS", 30)
    monkeypatch.setattr(constants, "MAX_CHAIN_STEPS", 40)

    def needle(x: FloatArray) -> FloatArray:
        return gaussian(x) + 30 * np.exp(-0.5 * np.sum(((x - MEAN) / 1e-5) ** 2, axis=1))

    def one_on_it(draws: WeightedDraws, rng: np.random.Generator) -> FloatArray:
        return np.vstack([MEAN, _start(draws, rng)[1:]])

    monkeypatch.setattr(sampling, "_start", one_on_it)
    with pytest.raises(
        NotConverged, match="after 40 steps the autocorrelation time is 40"
    ) as caught:
        sample(needle, BEGIN, stream(16))
    assert (np.asarray(caught.value.chains)[:, :, 0] == MEAN).all()


@pytest.mark.parametrize(("n_dim", "walkers"), [(1, 16), (2, 16), (10, 20)])
def test_starts_among_draws_are_some_of_them(n_dim: int, walkers: int) -> None:
    """So many walkers as the dimensions ask for begin at draws, no two at the same."""
    rng = np.random.default_rng(5)
    points = rng.standard_normal((500, n_dim))
    found = _start(even(points), rng)
    assert found.shape == (walkers, n_dim)
    assert {tuple(point) for point in found} <= {tuple(point) for point in points}
    assert np.unique(found, axis=0).shape[0] == walkers
    assert not np.array_equal(found, _start(even(points), rng))


def test_starts_among_draws_follow_their_weight() -> None:
    """Draws a little more probable are taken as much more often; those without weight never."""
    points = np.arange(4000.0)[:, None]
    weight = np.where(points[:, 0] < 2000, 3.0, 1.0) * (points[:, 0] % 2 == 0)
    draws, rng = WeightedDraws(points, weight / weight.sum(), 0.0), np.random.default_rng(6)
    found = np.concatenate([_start(draws, rng)[:, 0] for _ in range(120)])
    assert (found % 2 == 0).all()
    error = np.sqrt(0.75 * 0.25 / found.size)
    assert abs(np.mean(found < 2000) - 0.75) < 4.5 * error
    # Negative control: taken alike.
    found = np.concatenate([_start(even(points), rng)[:, 0] for _ in range(120)])
    assert abs(np.mean(found < 2000) - 0.75) > 4.5 * error


def test_starts_among_few_draws_of_weight_spread_out() -> None:
    """Where one draw has all the weight the walkers still begin apart, the best ones first."""
    points = np.linspace(0, 1, 400)[:, None]
    log_weight = -0.5 * ((points[:, 0] - 0.5) / 1e-2) ** 2
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    assert 1 / np.sum(weight**2) < 20
    found = _start(WeightedDraws(points, weight, 0.0), np.random.default_rng(7))
    assert np.unique(found).size == WALKERS
    assert np.median(np.abs(found - 0.5)) < 0.1


def test_too_few_draws_are_refused() -> None:
    """Where there are fewer draws than an ensemble has walkers the error gives both numbers."""
    with pytest.raises(NotConverged, match=r"7 draws lie inside .* 16 are needed.*widen") as caught:
        sample(gaussian, even(BEGIN.points[:7]), stream(3))
    assert np.asarray(caught.value.chains).shape == (7, 2)


def test_r_hat_is_that_of_arviz() -> None:
    """Of draws that differ between ensembles in mean or spread, have ties, or are all equal."""
    draws = np.random.default_rng(5).standard_normal((4, 501, 4))
    draws[1, :, 0] += 0.3
    draws[2, :, 1] *= 1.5
    draws[..., 2] = draws[..., 2].round(1)
    draws[..., 3] = 7.0
    found = sampling.rank_r_hat(draws)
    known = [array_stats.rhat(draws[..., j], chain_axis=0, draw_axis=1) for j in range(3)]
    np.testing.assert_allclose(found, [*known, 1.0], rtol=1e-12)
    assert found[0] > 1.005 and found[1] > 1.005
