"""Health of one epoch against grid integration, its diagnostics, and refusals."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import msgspec
import numpy as np
import pytest
import xarray
from arviz_stats.base.array import array_stats
from scipy import stats
from threadpoolctl import threadpool_limits

from lmshealth._private.arrays import FloatArray
from lmshealth.errors import BadStage, BadTable, NotConverged, NotEnoughData
from lmshealth.life import inference
from lmshealth.life.ensemble_sampling import Sample
from lmshealth.health.epoch_posterior import EpochPosterior
from lmshealth.life.inference import epochs_to_infer, infer, infer_together
from lmshealth.life.health import Health
from lmshealth.stage.description import Stage
from lmshealth.stage.priors import Uniform
from lmshealth.tracking.track import Track, track
from tests.health.test_epoch_posterior import book
from tests.lives import (
    AXES,
    FOOT,
    FREQUENCY,
    MOUNT,
    PRELOAD,
    make_history,
    make_stage,
    make_track,
    threads,
    true_drift,
)

NAMES = ("guide_preload", "mount_stiffness")
TRUTH = np.log([0.75, 0.85])
COV = np.array([[1e-6, 4e-7], [4e-7, 2e-6]])


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Preload and mount seen by two modes."""
    return make_stage(tmp_path_factory.mktemp("stage"))


def epochs(drifts: list[FloatArray], cov: FloatArray = COV) -> Track:
    """Track of a baseline and the given drifts."""
    m = cov.shape[0]
    drift = np.vstack([np.zeros(m), *drifts])
    return make_track(drift, np.stack([np.zeros((m, m)), *[cov] * len(drifts)]))


@pytest.fixture(scope="module")
def worn() -> Track:
    """Baseline, then two epochs: half of the loss, and all of it."""
    return epochs([true_drift(NAMES, share * TRUTH)[:2] for share in (0.5, 1.0)])


@pytest.fixture(scope="module")
def health(stage: Stage, worn: Track) -> Health:
    """Posterior of both epochs."""
    return infer(worn, stage, 5)


@pytest.mark.slow
def test_posterior_quantiles_are_those_of_a_grid(stage: Stage, health: Health) -> None:
    """Quantiles of the draws have the right probability on a 2-D grid, within Monte-Carlo error."""
    x = np.log(health.samples[-1])
    centre, width = x.mean(axis=0), 6 * x.std(axis=0)
    axes = [np.linspace(c - w, c + w, 81) for c, w in zip(centre, width, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    value = np.array([book(point) for point in grid.reshape(-1, 2)]).reshape(81, 81)
    density = np.exp(value - value.max())
    for j in range(2):
        marginal = density.sum(axis=1 - j)
        cdf = np.cumsum(marginal) - 0.5 * marginal
        for level in (0.05, 0.25, 0.5, 0.75, 0.95):
            share = np.interp(np.quantile(x[:, j], level), axes[j], cdf / marginal.sum())
            n = min(health.ess[-1, j], x.shape[0])
            assert abs(share - level) < 5 * np.sqrt(level * (1 - level) / n) + 1e-3


@pytest.mark.slow
def test_identifiable_health_is_sharp(health: Health) -> None:
    """The truth lies inside, both epochs converge, and the data and not the prior speak."""
    low, high = health.quantile(np.array([0.005, 0.995]))
    assert ((low[-1] < np.exp(TRUTH)) & (np.exp(TRUTH) < high[-1])).all()
    assert health.converged.all()
    assert (health.informed > 0.8).all()  # the map may be wrong by 15 %
    assert (health.samples[0].mean(axis=0) > health.samples[1].mean(axis=0)).all()


@pytest.mark.slow
def test_map_error_widens_the_posterior(tmp_path: Path, worn: Track, health: Health) -> None:
    """A larger model_std makes health wider, in proportion to the drift."""
    doubtful = infer(worn, make_stage(tmp_path, model_std=0.2), 5, epochs=[2])
    ratio = doubtful.samples[0].std(axis=0) / health.samples[1].std(axis=0)
    assert (ratio > 2).all()


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put draws of the seed alone in the place of the sampler, to see which seeds it is given."""

    def fake(_: object, __: object, seed: np.random.SeedSequence, ___: int) -> Sample:
        draws = 0.1 * np.random.default_rng(seed).standard_normal((4, 1000, 2))
        full = np.full(2, 4000.0)
        return Sample(draws, full, full, r_hat=np.ones(2))

    monkeypatch.setattr(inference, "sample", fake)


@pytest.mark.usefixtures("quick")
def test_an_epoch_has_its_own_stream(stage: Stage, worn: Track) -> None:
    """An epoch alone has the same draws as among others; another seed has not."""
    both, alone = infer(worn, stage, 5), infer(worn, stage, 5, epochs=[2])
    other = infer(worn, stage, 6, epochs=[2])
    np.testing.assert_array_equal(alone.samples[0], both.samples[1])
    assert not np.array_equal(other.samples, alone.samples)


@pytest.mark.usefixtures("quick")
def test_two_epochs_do_not_share_draws(stage: Stage) -> None:
    """Two epochs with the same drift get different draws: their chains are independent."""
    same = true_drift(NAMES, TRUTH)[:2]
    found = infer(epochs([same, same]), stage, 5)
    assert not np.array_equal(found.samples[0], found.samples[1])


@pytest.mark.usefixtures("quick")
def test_any_mapper_gives_the_same(stage: Stage, worn: Track) -> None:
    """The mapper decides where epochs are computed, not what comes out, and keeps their order."""

    def backwards(function, *columns):
        tasks = list(zip(*columns, strict=True))
        return [function(*task) for task in reversed(tasks)][::-1]

    found, plain = infer(worn, stage, 5, mapper=backwards), infer(worn, stage, 5)
    np.testing.assert_array_equal(found.samples, plain.samples)
    assert found.recorded_at == plain.recorded_at == worn.recorded_at[1:]


@pytest.mark.usefixtures("quick")
def test_linear_algebra_keeps_to_one_thread(stage: Stage, worn: Track) -> None:
    """On small arrays more would only wait for one another, whatever is usual around it."""

    def counting(function, *columns):
        seen.update(threads())
        return map(function, *columns)

    seen: set[int] = set()
    with threadpool_limits(2, user_api="blas"):
        infer(worn, stage, 5, epochs=[1], mapper=counting)
        assert seen == {1}
        assert threads() == {2}


@pytest.mark.slow
def test_a_parameter_no_mode_sees_keeps_its_prior(tmp_path: Path) -> None:
    """Without sensitivity a parameter is uninformed and its posterior is its prior."""
    stage = make_stage(tmp_path, (PRELOAD, FOOT))
    drift = true_drift(("guide_preload", "foot"), np.log([0.7, 1.0]))[:2]
    found = infer(epochs([drift]), stage, 9)
    assert found.informed[0, 0] > 0.9
    assert found.informed[0, 1] < 0.15
    prior = stats.norm(0, 0.2)
    x = np.log(found.samples[0, :, 1])
    for level in (0.05, 0.5, 0.95):
        error = 5 * np.sqrt(level * (1 - level) / min(found.ess[0, 1], x.size))
        assert abs(prior.cdf(np.quantile(x, level)) - level) < error


@pytest.mark.slow
def test_one_mode_does_not_identify_two_parameters(stage: Stage) -> None:
    """With one mode the posterior is a ridge: the product is sharp, the two are strongly tied."""
    drift = true_drift(NAMES, TRUTH)[:1]
    found = infer(epochs([drift], COV[:1, :1]), stage, 10)
    x = np.log(found.samples[0])
    assert found.converged.all()
    assert np.corrcoef(x.T)[0, 1] < -0.8
    assert (found.informed[0] < 0.95).all()


@pytest.mark.slow
def test_draws_never_leave_the_map(stage: Stage) -> None:
    """Drifts beyond what the map holds push draws to its edge, not over it."""
    x = np.log([AXES["guide_preload"][0], 1.0])
    found = infer(epochs([true_drift(NAMES, x)[:2] - 0.004]), stage, 11)
    for j, name in enumerate(NAMES):
        assert found.samples[..., j].min() >= AXES[name][0] * (1 - 1e-12)
        assert found.samples[..., j].max() <= AXES[name][-1] * (1 + 1e-12)


def test_the_prior_is_cut_at_the_map(stage: Stage) -> None:
    """Prior draws are lognormal between the edges of the grid, each parameter by itself."""
    x = stage.prior.draw(np.random.default_rng(12), 20_000)
    assert x.shape == (20_000, 2)
    for j, name in enumerate(NAMES):
        low, high = np.log(AXES[name][[0, -1]])
        cut = stats.truncnorm(low / 0.3, high / 0.3, scale=0.3)
        assert stats.kstest(x[:, j], cut.cdf).pvalue > 1e-4
    assert stats.kstest(x[:, 0], stats.norm(0, 0.25).cdf).pvalue < 1e-4  # negative control


def test_epochs_are_spread_and_end_with_the_last(stage: Stage) -> None:
    """At most so many epochs, in order, the last among them, and never the baseline."""
    drift = np.zeros((50, 2))
    cov = np.tile(COV, (50, 1, 1))
    drift[:3], cov[:3] = np.nan, np.nan
    cov[3] = 0.0
    found = epochs_to_infer(make_track(drift, cov), stage, 7)
    assert len(found) == 7
    assert list(found) == sorted(set(found))
    assert found[0] == 4
    assert found[-1] == 49
    assert epochs_to_infer(make_track(drift, cov), stage, 100) == tuple(range(4, 50))
    assert epochs_to_infer(make_track(drift, cov), stage, 1)[-1] == 49


def test_epochs_are_nested_as_logs_are_added(stage: Stage) -> None:
    """After one more log only the last epoch is new, and no gap is much longer than another."""
    drift, cov = np.zeros((90, 2)), np.tile(COV, (90, 1, 1))
    before = set(epochs_to_infer(make_track(drift[:20], cov[:20]), stage, 9))
    for n in range(21, 91):
        found = epochs_to_infer(make_track(drift[:n], cov[:n]), stage, 9)
        assert len(found) == 9
        assert set(found) - before == {n - 1}
        assert np.diff(found).max() <= 2 * (n - 1) / 8 + 1
        before = set(found)


@pytest.mark.usefixtures("quick")
def test_an_epoch_does_not_depend_on_later_logs(stage: Stage, worn: Track) -> None:
    """An epoch that was the last one has the same draws when another follows; its judge goes."""
    drift, cov = worn.drift, worn.drift_cov
    earlier = infer(make_track(drift[:2], cov[:2]), stage, 5)
    later = infer(worn, stage, 5)
    np.testing.assert_array_equal(earlier.chains[-1], later.chains[0])
    np.testing.assert_array_equal(earlier.fit[-1], later.fit[0])
    assert np.isfinite(earlier.judge_shift[-1]).all()
    assert np.isnan(later.judge_shift[0]).all()


def test_importance_sampling_that_fails_gives_way_to_chains(
    stage: Stage, worn: Track, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where weights are unreliable the chains are published, and nothing judges them."""
    monkeypatch.setattr("lmshealth.life.constants.MAX_PARETO_K", -9.0)
    chains = 0.01 * np.random.default_rng(3).standard_normal((4, 500, 2))
    full = np.full(2, 2000.0)
    monkeypatch.setattr(inference, "sample", lambda *_: Sample(chains, full, full, np.ones(2)))
    found = infer(worn, stage, 5, epochs=[2])
    assert found.converged.all()
    assert np.isnan(found.judge_shift).all()
    np.testing.assert_allclose(np.std(np.log(found.samples)), 0.01, rtol=0.1)


def test_the_baseline_of_a_real_track_is_no_epoch(tmp_path: Path) -> None:
    """Epochs of a track come after its baseline, whatever rounding leaves of its covariance."""
    stage = make_stage(tmp_path, n_modes=3)
    first = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        ln_f = np.log(120) + 1e-3 * rng.standard_normal((6, 3))
        history = make_history(
            ln_f, travel=np.linspace(0, 2e6, 6), std=8e-4, temperature=21 + rng.standard_normal(6)
        )
        first.append(min(epochs_to_infer(track(history, stage), stage, 100)))
    assert first == [1] * 12


def test_logs_on_the_spot_of_the_baseline_are_no_epochs(stage: Stage) -> None:
    """An epoch at the odometer of the baseline cannot have drifted and is not inferred."""
    ln_f = np.log(FREQUENCY[:2]) + 1e-3 * np.random.default_rng(2).standard_normal((8, 2))
    cov = np.zeros((8, 4, 4))
    cov[:] = np.diag([1e-6, 1e-6, 1e-3, 1e-3])
    cov[:, 0, 1] = cov[:, 1, 0] = 6e-7
    travel = np.r_[0.0, 0.0, 0.0, np.linspace(1e5, 1e6, 5)]
    followed = track(make_history(ln_f, travel=travel, cov=cov), stage)
    assert epochs_to_infer(followed, stage, 100) == (3, 4, 5, 6, 7)


def test_a_sampler_that_fails_is_reported_by_epoch(
    stage: Stage, worn: Track, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A refusal of the sampler keeps its chains but claims no convergence and no sample size."""

    def fail(*_: object) -> None:
        raise NotConverged("stuck", np.full((4, 50, 16, 2), -0.1))

    monkeypatch.setattr(inference, "sample", fail)
    monkeypatch.setattr(inference, "sample_by_importance", fail)
    found = infer(worn, stage, 1)
    assert not found.converged.any()
    assert np.isnan(found.ess).all()
    np.testing.assert_allclose(found.samples, np.exp(-0.1))


def test_without_parameters_there_is_nothing_to_infer(tmp_path: Path, worn: Track) -> None:
    """A description without parameters is refused."""
    with pytest.raises(BadStage, match=r"no \[\[parameter\]\]"):
        infer(worn, make_stage(tmp_path, ()), 1)


def test_a_track_without_modes_of_the_map_is_refused(stage: Stage) -> None:
    """The modes that would be needed are named."""
    strange = make_track(np.zeros((3, 0)), np.zeros((3, 0, 0)))
    with pytest.raises(NotEnoughData, match=r"roll.*pitch"):
        infer(strange, stage, 1)


def test_a_track_of_the_baseline_alone_is_refused(stage: Stage) -> None:
    """Nothing after the baseline is not enough."""
    with pytest.raises(NotEnoughData, match="no epoch has a drift of any"):
        infer(epochs([]), stage, 1)


@pytest.mark.slow
def test_laplace_checks_the_sampler(
    tmp_path: Path, stage: Stage, worn: Track, health: Health
) -> None:
    """Both agree where the posterior is all but normal; the difference is reported."""
    sure = infer(worn, make_stage(tmp_path, model_std=0.0), 5, epochs=[2])
    assert (np.abs(sure.laplace_shift) < 0.06).all()
    assert (np.abs(sure.laplace_ratio - 1) < 0.04).all()
    # The error of the map grows with the loss and bends the posterior.
    assert (np.abs(health.laplace_ratio[1] - 1) > 0.05).all()
    # A prior that ends inside the posterior: no normal distribution approximates it.
    cut = make_stage_with(stage, low=0.76)
    found = infer(worn, cut, 5, epochs=[2])
    assert np.isnan(found.laplace_shift).all()
    assert np.isnan(found.laplace_ratio).all()
    assert found.converged.all()
    assert found.samples[..., 0].min() > 0.76


def make_stage_with(stage: Stage, low: float, high: float = 1.2) -> Stage:
    """Return the stage with a uniform prior of the preload."""
    preload, mount = stage.parameters
    bounded = msgspec.structs.replace(preload, prior=Uniform(low, high))
    description = msgspec.structs.replace(stage.description, parameter=(bounded, mount))
    return Stage(description, stage.modal_map, stage.digest)


@pytest.mark.slow
def test_the_influence_of_the_prior_is_reported(
    tmp_path: Path, worn: Track, health: Health
) -> None:
    """Priors twice as wide hardly move informed parameters, and widen others by two.

    A doubtful map leaves more to the prior than an exact one.
    """
    assert (np.abs(health.prior_shift) < 0.2).all()
    assert (np.abs(health.prior_ratio - 1) < 0.25).all()
    exact = infer(worn, make_stage(tmp_path / "exact", model_std=0.0), 5)
    # Six seeds give 0.045 to 0.062 for the mount, the sampler before 0.049 to 0.054.
    assert (np.abs(exact.prior_shift) < 0.08).all()
    assert (np.abs(exact.prior_ratio - 1) < 0.02).all()
    assert (exact.informed > 0.9).all()
    blind = infer(worn, make_stage(tmp_path, (PRELOAD, MOUNT, FOOT)), 6, epochs=[2])
    ratio = blind.prior_ratio[0, 2]
    # The foot has no sensitivity; its doubled prior is cut a little at the map.
    assert 1.85 < ratio < 2.05
    assert abs(blind.prior_shift[0, 2]) < 0.1
    assert blind.informed[0, 2] < 0.05


@pytest.mark.slow
def test_reweighting_and_sampling_agree(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    """The wider posterior is the same by weights on the draws and by chains of its own.

    Where weights would be far from even, chains are taken: reweighting is too narrow.
    """
    cov = 60 * COV
    track = epochs([true_drift(NAMES, TRUTH)[:2]], cov)
    monkeypatch.setattr(inference, "_MIN_SHARE", 0.0)
    weighted = infer(track, stage, 9)
    monkeypatch.setattr(inference, "_MIN_SHARE", 1.1)
    sampled = infer(track, stage, 9)
    assert (weighted.prior_ratio > 1.05).any()
    np.testing.assert_array_equal(weighted.samples, sampled.samples)
    np.testing.assert_allclose(weighted.prior_ratio, sampled.prior_ratio, rtol=0.06)
    np.testing.assert_allclose(weighted.prior_shift, sampled.prior_shift, atol=0.08)


def test_the_wider_posterior_may_have_draws_of_its_own(
    stage: Stage, worn: Track, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where weights are too uneven, what wider priors do is read off chains under these."""
    first = 0.02 * np.random.default_rng(3).standard_normal((4, 500, 2))
    own = iter([first, first * [1.5, 3.0] + [0.01, -0.02]])

    def fake(*_: object) -> Sample:
        full = np.full(2, 2000.0)
        return Sample(next(own), full, full, r_hat=np.ones(2))

    def no_judge(*_: object) -> Sample:
        raise NotConverged("stuck", np.zeros((4, 50, 32, 2)))

    monkeypatch.setattr(inference, "sample_by_importance", fake)
    monkeypatch.setattr(inference, "draw", no_judge)
    monkeypatch.setattr(inference, "_MIN_SHARE", 1.1)
    found = infer(worn, stage, 5, epochs=[2])
    middle, std = np.median(first, axis=(0, 1)), np.std(first, axis=(0, 1))
    shift = (middle * [0.5, 2.0] + [0.01, -0.02]) / std
    np.testing.assert_allclose(found.prior_ratio[0], [1.5, 3.0])
    np.testing.assert_allclose(found.prior_shift[0], shift)


@pytest.mark.slow
def test_correlation_is_that_of_the_draws(health: Health) -> None:
    """The correlation is that of the draws: preload and mount trade off."""
    for k in range(2):
        known = np.corrcoef(np.log(health.samples[k]).T)
        np.testing.assert_allclose(health.correlation[k], known, atol=1e-12)
    assert (health.correlation[:, 0, 1] < -0.5).all()


@pytest.mark.slow
def test_a_mode_that_is_missing_at_an_epoch_is_done_without(stage: Stage) -> None:
    """An epoch with one of two modes is inferred from that one; one without any is no epoch."""
    drift = np.vstack([np.zeros(2), np.tile(true_drift(NAMES, TRUTH)[:2], (3, 1))])
    cov = np.stack([np.zeros((2, 2)), COV, COV, COV])
    drift[2, 1], cov[2, 1], cov[2, :, 1] = np.nan, np.nan, np.nan
    drift[3], cov[3] = np.nan, np.nan
    track = make_track(drift, cov)
    assert epochs_to_infer(track, stage, 10) == (1, 2)
    found = infer(track, stage, 3)
    assert (found.informed[1] < found.informed[0]).all()
    assert found.converged.all()


def two_machines(stage: Stage, offset: timedelta) -> list[tuple[Track, Stage]]:
    """Two machines of one description and one preload, whose mounts differ; one logs later."""
    machines = []
    for k, mount in enumerate((np.log(0.9), np.log(0.7))):
        x = np.array([TRUTH[0], mount])
        track = epochs([true_drift(NAMES, share * x)[:2] for share in (0.5, 1.0)], 100 * COV)
        moments = tuple(moment + k * offset for moment in track.recorded_at)
        machines.append((replace(track, stage=f"AX-{k}", recorded_at=moments), stage))
    return machines


@pytest.mark.slow
def test_a_shared_guide_is_better_informed(stage: Stage) -> None:
    """Two machines on one guide inform its preload better than one; mounts stay apart.

    The posterior is that of a grid over all three parameters.
    """
    machines = two_machines(stage, timedelta(0))
    alone = [infer(*machine, 4, epochs=[2]) for machine in machines]
    both = infer_together(machines, ["guide_preload"], 4, epochs=[2])
    assert both.parameters == ("guide_preload", "AX-0:mount_stiffness", "AX-1:mount_stiffness")
    assert both.stage == "AX-0 + AX-1"
    assert both.converged.all()
    std = np.log(both.samples[0]).std(axis=0)
    assert all(std[0] < np.log(one.samples[0, :, 0]).std() for one in alone)
    axis = np.linspace(-0.9, 0.35, 120)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    marginal = np.zeros(axis.size)
    for shown, own in machines:
        view = EpochPosterior.of(own, ("roll", "pitch"), shown.drift[2], shown.drift_cov[2])
        value = view.machines[0].log_likelihood(grid).reshape(120, 120) - 0.5 * (axis / 0.3) ** 2
        marginal += np.logaddexp.reduce(value, axis=1)
    marginal += -0.5 * (axis / 0.3) ** 2
    density = np.exp(marginal - marginal.max())
    levels = np.array([0.05, 0.5, 0.95])
    known = np.interp(levels, (np.cumsum(density) - 0.5 * density) / density.sum(), axis)
    found = np.log(both.quantile(levels)[:, 0, 0])
    # Standard error of a quantile: that of its level, over the density there.
    height = np.interp(known, axis, density / density.sum() / (axis[1] - axis[0]))
    error = np.sqrt(levels * (1 - levels) / both.ess[0, 0]) / height
    assert (np.abs(found - known) < 4.5 * error).all()
    assert (np.abs(found + 0.1 - known) > 4.5 * error).any()  # negative control


@pytest.mark.slow
def test_epochs_of_the_first_meet_the_last_of_the_others(stage: Stage) -> None:
    """An epoch is combined with the last one of the other machine, or left out without one."""
    later = two_machines(stage, timedelta(days=7))
    found = infer_together(later, ["guide_preload"], 4)
    assert found.recorded_at == (later[0][0].recorded_at[2],)
    too_late = two_machines(stage, timedelta(days=70))
    with pytest.raises(NotEnoughData, match="an epoch of AX-1 at or before it"):
        infer_together(too_late, ["guide_preload"], 4)


def test_what_is_not_there_cannot_be_shared(stage: Stage) -> None:
    """A shared parameter that a description lacks is refused with those that it has."""
    with pytest.raises(BadStage, match=r"no parameter \['belt'\] to share; there are"):
        infer_together(two_machines(stage, timedelta(0)), ["belt"], 4)


@pytest.mark.slow
def test_health_is_a_table(health: Health) -> None:
    """One row per epoch and parameter, with quantiles, checks and correlations."""
    table = health.to_frame()
    assert len(table) == 4
    last = table.iloc[-1]
    assert last["parameter"] == "mount_stiffness"
    assert last["q05"] < last["median"] < last["q95"]
    assert last["correlation_mount_stiffness"] == pytest.approx(1)
    assert last["correlation_guide_preload"] == health.correlation[1, 1, 0]
    assert last["ess"] == min(last["ess_bulk"], last["ess_tail"])
    assert table["converged"].all()


@pytest.mark.slow
def test_health_goes_to_arviz_and_back(health: Health, tmp_path: Path) -> None:
    """NetCDF keeps draws by ensemble and epoch, and arviz finds its R-hat in them."""
    health.to_arviz().to_netcdf(tmp_path / "health.nc", engine="h5netcdf")
    tree = xarray.open_datatree(tmp_path / "health.nc", engine="h5netcdf")
    draws = tree["posterior/guide_preload"]
    assert draws.dims == ("chain", "draw", "epoch")
    np.testing.assert_array_equal(draws.to_numpy(), np.moveaxis(health.chains[..., 0], 0, 2))
    np.testing.assert_array_equal(tree["checks_data/r_hat_guide_preload"], health.r_hat[:, 0])
    assert tree.attrs["seed"] == "5"
    assert float(array_stats.rhat(draws.to_numpy()[..., 1])) < 1.02


@pytest.mark.slow
def test_unexplained_drifts_inform_no_parameter(tmp_path: Path) -> None:
    """Drifts against the map are unexplained, and inform no parameter."""
    stage = make_stage(tmp_path, n_modes=3)
    right = true_drift(NAMES, TRUTH)
    cov = 1e-6 * np.eye(3)
    fine = infer(epochs([right], cov), stage, 1)
    assert fine.fit[-1] > 0.01
    assert fine.explained
    assert fine.publishable_parameters().all()
    wrong = infer(epochs([right * [1, -1, 1]], cov), stage, 1)
    assert wrong.fit[-1] < 1e-6
    assert not wrong.explained
    assert not wrong.publishable_parameters().any()


@pytest.mark.slow
def test_a_posterior_at_the_edge_of_the_map_is_a_bound(tmp_path: Path) -> None:
    """Drifts further than the map reaches pile up at its end, reported by parameter."""
    stage = make_stage(tmp_path, model_std=0.0)
    edge = np.log([AXES["guide_preload"][0], 0.9])
    beyond = infer(epochs([1.3 * true_drift(NAMES, edge)[:2]], COV), stage, 1)
    assert beyond.at_edge[-1].tolist() == [True, False]
    inside = infer(epochs([true_drift(NAMES, TRUTH)[:2]], COV), stage, 1)
    assert not inside.at_edge.any()


def test_machines_of_one_name_are_refused(stage: Stage) -> None:
    """Two machines of one name would have their own parameters taken for one."""
    machines = [
        (replace(track, stage="track"), own) for track, own in two_machines(stage, timedelta(0))
    ]
    with pytest.raises(BadTable, match=r"two machines are called 'track'.*column stage"):
        infer_together(machines, ["guide_preload"], 4)


def test_an_epoch_without_convergence_informs_no_parameter(
    stage: Stage, worn: Track, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An epoch without convergence informs no parameter; its edge is reported."""
    low = np.log(AXES["guide_preload"][0])

    def fail(*_: object) -> None:
        raise NotConverged("stuck", np.full((4, 50, 32, 2), [low, -0.1]))

    monkeypatch.setattr(inference, "sample", fail)
    monkeypatch.setattr(inference, "sample_by_importance", fail)
    found = infer(worn, stage, 1)
    assert (found.informed > 0.9).all()
    assert not found.publishable_parameters().any()
    assert found.at_edge[-1].tolist() == [True, False]
    assert found.fit[-1] < 1e-6


@pytest.mark.slow
def test_a_check_that_fails_leaves_the_posterior(
    stage: Stage, worn: Track, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where only the posterior under wider priors does not converge, only its check is missing."""
    right = infer(worn, stage, 5, epochs=[2])

    def fail(*_: object) -> FloatArray:
        raise NotConverged("stuck", np.zeros((4, 50, 32, 2)))

    monkeypatch.setattr(inference, "_wider_quantiles", fail)
    found = infer(worn, stage, 5, epochs=[2])
    assert found.converged.all()
    np.testing.assert_array_equal(found.samples, right.samples)
    assert np.isnan(found.prior_shift).all()
    assert np.isnan(found.prior_ratio).all()


@pytest.mark.slow
def test_a_prior_as_wide_as_the_map_has_no_check(stage: Stage, worn: Track) -> None:
    """Where the map keeps a prior from widening the check is missing."""
    found = infer(worn, make_stage_with(stage, low=0.21), 5, epochs=[2])
    assert np.isfinite(found.prior_ratio[0, 1])
    low, high = AXES["guide_preload"][[0, -1]]
    whole = make_stage_with(stage, low=float(low), high=float(high))
    found = infer(worn, whole, 5, epochs=[2])
    assert np.isnan(found.prior_ratio[0, 0])
    assert np.isfinite(found.prior_ratio[0, 1])


@pytest.mark.slow
def test_what_is_identifiable_goes_by_the_modes_of_an_epoch(tmp_path: Path) -> None:
    """One mode of two identifies the mount, but not the preload."""
    stage = make_stage(tmp_path)
    drift = np.vstack([np.zeros(2), np.tile(true_drift(NAMES, TRUTH)[:2], (2, 1))])
    cov = np.stack([np.zeros((2, 2)), COV, COV])
    drift[2, 1], cov[2, 1], cov[2, :, 1] = np.nan, np.nan, np.nan
    found = infer(make_track(drift, cov), stage, 3)
    assert found.identifiable.tolist() == [[True, True], [False, True]]
