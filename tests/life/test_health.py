"""Health at the epochs of a life: one posterior for all of them, drifts alone, tables, refusals."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray
from arviz_stats.base.array import array_stats
from scipy import stats

import lmshealth
from lmshealth import examples
from lmshealth._private.arrays import FloatArray
from lmshealth.errors import BadQuestion, BadStage, NotEnoughData
from lmshealth.life import constants
from lmshealth.life.health import Health, epochs_to_publish, health_of, infer, infer_drifts
from lmshealth.life.posterior.fit import LifePosterior, fit_life
from lmshealth.life.posterior.likelihood import NO_MODE
from lmshealth.life.prognosis import prognosis_of
from lmshealth.stage.description import Stage, load_stage
from lmshealth.tracking.history import History
from lmshealth.tracking.read_tables import Drifts
from lmshealth.tracking.track import Track
from tests.lives import (
    AXES,
    FADING,
    FREQUENCY,
    LAWS_ALONE,
    PRELOAD,
    SEEN_BY_NONE,
    four_settings,
    make_history,
    make_stage,
    make_track,
    stage_text,
    true_drift,
)

NAMES = ("guide_preload", "mount_stiffness")
TRAVEL = np.linspace(0.0, 2.5e6, 12)
COV = np.array([[1e-6, 4e-7], [4e-7, 2e-6]])
FADING_FOOT = SEEN_BY_NONE + (
    'law = { kind = "linear", rate_per_km = { kind = "normal", mean = 0.0, std = 2e-4 } }\n'
)


@pytest.fixture(scope="module", autouse=True)
def small_grid() -> Iterator[None]:
    """Average over two walks and two deviations: checks hold for any of them."""
    with four_settings():
        yield


@pytest.fixture(scope="module")
def stage(small_grid: None, tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Wear of the preload and loosening of the mount, or other changes, seen by three modes."""
    return make_stage(tmp_path_factory.mktemp("stage"), n_modes=3, tail="")


@pytest.fixture(scope="module")
def fading(small_grid: None, tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Make a preload that fades or gains, with an exact map."""
    folder = tmp_path_factory.mktemp("fading")
    return make_stage(folder, (FADING,), model_std=0.0, tail=LAWS_ALONE)


def lived(preload: FloatArray, mount: FloatArray, *, scatter: float = 5e-4) -> History:
    """Make the life of a preload and a mount, with errors of 5e-4 in ln f."""
    drift = true_drift(NAMES, np.log([preload, mount]).T)
    noise = scatter * np.random.default_rng(1).standard_normal((TRAVEL.size, 3))
    return make_history(np.log(FREQUENCY) + drift + noise, travel=TRAVEL, std=5e-4)


@pytest.fixture(scope="module")
def history() -> History:
    """Make a life of 12 logs: preload for 8,000 km, the mount settling to 0.8."""
    return lived((1 - TRAVEL / 8e6) ** 1.5, 0.8 + 0.2 * np.exp(-TRAVEL / 1.5e6))


@pytest.fixture(scope="module")
def life(stage: Stage, history: History) -> LifePosterior:
    """Its posterior."""
    return fit_life(history, stage, 5, chains=False)


@pytest.fixture(scope="module")
def health(stage: Stage, history: History) -> Health:
    """Its health at all epochs."""
    return infer(history, stage, 5, chains=False)


def read(track: Track) -> Drifts:
    """Read the drifts of a track."""
    values = track.travel, track.modes, track.drift, track.drift_cov
    return Drifts(track.stage, track.recorded_at, *values)


def table(drifts: list[FloatArray], cov: FloatArray = COV) -> Drifts:
    """Make a table of a baseline and the given drifts, at even distances up to 1,000 km."""
    m = cov.shape[0]
    drift = np.vstack([np.zeros(m), *drifts])
    return read(make_track(drift, np.stack([np.zeros((m, m)), *[cov] * len(drifts)])))


def single_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take one point of the grid: next to no walk, and exact laws."""
    monkeypatch.setattr(constants, "WALK_STDS", (1e-6,))
    monkeypatch.setattr(constants, "WALK_PRIOR", (1.0,))
    monkeypatch.setattr(constants, "DEVIATION_STDS", (0.0,))
    monkeypatch.setattr(constants, "DEVIATION_PRIOR", (1.0,))


# One posterior


def test_the_last_epoch_is_the_posterior_of_the_life(
    health: Health, life: LifePosterior, history: History, stage: Stage
) -> None:
    """Health now, of `infer`, of the life and of the prognosis are the same draws."""
    np.testing.assert_array_equal(health.chains[-1], life.health)
    prognosis = prognosis_of(life, history, stage)
    np.testing.assert_array_equal(health.samples[-1], prognosis.health)
    below = np.mean(health.samples[-1] < prognosis.limits[:2], axis=0)
    np.testing.assert_array_equal(below, prognosis.already_past()[:2])
    np.testing.assert_array_equal(health.lone, life.lone)
    assert health.lone_modes == life.lone_modes == prognosis.modes_off
    assert health.fit[-1] == life.fit
    # Of the chains of scenarios: draws of the mixture are in their order.
    assert (health.r_hat == life.worst_r_hat).all()
    assert health.modes == life.modes == ("roll", "pitch", "yaw")
    assert health.sampler == ("importance",) * 11


def test_epochs_end_with_the_last_log() -> None:
    """Health of an earlier log would else be that of now, with another date."""
    stage, history = lmshealth.load_stage("lms-y"), examples.history()
    last = len(history.logs) - 1
    two = lmshealth.infer(history, stage, 1, chains=False, epochs=[8, last])
    assert two.recorded_at == (history.recorded_at[8], history.recorded_at[last])
    for epochs in ([], [8], [last, 8], [8, 8, last], [-1], [last + 1]):
        with pytest.raises(BadQuestion, match="numbers of logs from 0 to 23"):
            lmshealth.infer(history, stage, 1, chains=False, epochs=epochs)


def test_past_epochs_are_of_the_same_draws(
    history: History, fading: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By an exact line, health at every epoch follows from that at the last, draw by draw."""
    single_grid(monkeypatch)
    found = infer(history, fading, 3, chains=False)
    loss = 1 - found.samples[..., 0]
    np.testing.assert_allclose(loss, loss[-1] * (TRAVEL[1:, None] / TRAVEL[-1]), atol=1e-12)
    # Negative control: draws of another order do not.
    assert np.abs(loss[3] - loss[-1][::-1] * TRAVEL[4] / TRAVEL[-1]).max() > 1e-4


def test_health_holds_the_truth_at_every_epoch(health: Health) -> None:
    """Truth of preload and mount lie in the central 99 % of draws, and of most in 50 %."""
    truth = np.column_stack([(1 - TRAVEL / 8e6) ** 1.5, 0.8 + 0.2 * np.exp(-TRAVEL / 1.5e6)])[1:]
    low, high = health.quantile(np.array([0.005, 0.995]))
    assert ((low < truth) & (truth < high)).all()
    assert (health.informed[-1] > 0.5).all()
    assert health.identifiable.all()
    assert health.explained
    assert health.publishable_parameters().all()
    assert (health.correlation[-1, 0, 1] < 0) and (np.diag(health.correlation[-1]) > 1 - 1e-9).all()
    # Negative control: an epoch later.
    assert not ((low[:, 0] < truth[-1, 0]) & (truth[-1, 0] < high[:, 0])).all()


def test_epochs_are_chosen_by_their_logs(
    life: LifePosterior, history: History, stage: Stage, health: Health
) -> None:
    """Health at some logs is that of these logs among all."""
    some = health_of(life, history, stage, (3, 11))
    assert some.recorded_at == (history.recorded_at[3], history.recorded_at[11])
    np.testing.assert_array_equal(some.travel, TRAVEL[[3, 11]])
    np.testing.assert_array_equal(some.chains[-1], health.chains[-1])
    np.testing.assert_allclose(some.latest(0.5), health.latest(0.5))
    # Deviations from the laws are drawn anew.
    std = health.samples[2].std(axis=0)
    assert (np.abs(some.quantile(0.5)[0] - health.quantile(0.5)[2]) < 0.1 * std).all()


def test_the_seed_alone_decides(history: History, stage: Stage, health: Health) -> None:
    """The same seed gives the same draws, another one others."""
    same, other = (infer(history, stage, seed, chains=False) for seed in (5, 6))
    np.testing.assert_array_equal(same.chains, health.chains)
    assert not np.array_equal(other.chains, health.chains)


@pytest.mark.slow
def test_chains_are_judged_by_importance_sampling(
    history: History, stage: Stage, health: Health
) -> None:
    """Emcee has the health of importance sampling, and how far both differ is in the result."""
    found = infer(history, stage, 5)
    assert found.sampler == ("emcee",) * 11
    assert (found.r_hat < constants.MAX_R_HAT).all()
    assert (found.ess > 400).all()
    assert (np.abs(found.judge_shift) < 0.25).all()
    assert (np.abs(found.judge_ratio - 1) < 0.2).all()
    assert np.isnan(health.judge_shift).all()
    std = found.samples[-1].std(axis=0)
    assert (np.abs(found.latest(0.5) - health.latest(0.5)) < 0.25 * std).all()


# Epochs


def still(n: int, baseline: int = 0) -> History:
    """Make a life of so many logs, of which some lack all modes."""
    return make_history(np.tile(np.log(FREQUENCY[:2]), (n, 1)), baseline=baseline)


def test_epochs_are_spread_and_end_with_the_last(stage: Stage) -> None:
    """At most so many epochs, in order, the last among them, and never the baseline."""
    history = still(50, baseline=3)
    found = epochs_to_publish(history, stage, 7)
    assert len(found) == 7
    assert list(found) == sorted(set(found))
    assert found[0] == 4
    assert found[-1] == 49
    assert epochs_to_publish(history, stage, 100) == tuple(range(4, 50))
    assert epochs_to_publish(history, stage, 1) == (49,)
    for most in (0, -1):
        with pytest.raises(BadQuestion, match="needed at least 1"):
            epochs_to_publish(history, stage, most)


def test_epochs_are_nested_as_logs_are_added(stage: Stage) -> None:
    """After one more log only the last epoch is new, and no gap is much longer than another."""
    before = set(epochs_to_publish(still(20), stage, 9))
    for n in range(21, 91):
        found = epochs_to_publish(still(n), stage, 9)
        assert len(found) == 9
        assert set(found) - before == {n - 1}
        assert np.diff(found).max() <= 2 * (n - 1) / 8 + 1
        before = set(found)


def test_logs_without_a_mode_of_the_map_are_no_epochs(stage: Stage) -> None:
    """A log in the middle without any mode is none; the last one is, as it is now."""
    history = still(8)
    ln_f = history.ln_frequency.copy()
    ln_f[[4, 7]] = np.nan
    assert epochs_to_publish(replace(history, ln_frequency=ln_f), stage, 100) == (1, 2, 3, 5, 6, 7)


# Drifts alone


@pytest.fixture
def unchained(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw the last epoch of drifts by importance sampling too."""

    def fit(*given, chains: bool, **options) -> LifePosterior:
        return fit_life(*given, chains=False, **options)

    monkeypatch.setattr("lmshealth.life.health.fit_life", fit)


@pytest.mark.slow
def test_an_epoch_of_drifts_is_that_of_a_grid(
    fading: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Quantiles of health by one table of drifts have the right probability on a 1-D grid."""
    single_grid(monkeypatch)
    drift = true_drift(("guide_preload",), np.log([0.75]))[:2] + np.array([5e-4, -5e-4])
    cov = 9 * COV
    found = infer_drifts(table([drift / 3, drift], cov), fading, 5)
    travel_km = found.travel[-1] / 1000
    assert travel_km == 1000
    loss = np.linspace(-0.3, 0.6, 3001)
    x = np.log(1 - loss)[:, None]
    known = stats.multivariate_normal.logpdf(
        drift - true_drift(("guide_preload",), x)[:, :2], cov=cov
    ) + stats.norm.logpdf(loss, scale=2e-4 * travel_km)
    density = np.exp(known - known.max())
    cdf = (np.cumsum(density) - 0.5 * density) / density.sum()
    errors = []
    for level in (0.05, 0.25, 0.5, 0.75, 0.95):
        value = found.latest(level)[0]
        n = min(found.ess[-1, 0], 4000)
        for factor in (1.0, 0.99):
            share = 1 - np.interp(1 - factor * value, loss, cdf)
            errors.append(abs(share - level) / np.sqrt(level * (1 - level) / n))
    assert max(errors[::2]) < 5
    assert max(errors[1::2]) > 5  # negative control
    assert found.sampler == ("importance", "importance")


@pytest.mark.usefixtures("unchained")
def test_an_epoch_of_drifts_does_not_depend_on_others(fading: Stage) -> None:
    """An epoch has the same draws among others; its own drift and seed decide."""
    drift = true_drift(("guide_preload",), np.log([0.8]))[:2]
    three = infer_drifts(table([drift / 3, drift / 2, drift]), fading, 5)
    moved = infer_drifts(table([drift / 3, 0.9 * drift, drift]), fading, 5)
    np.testing.assert_array_equal(three.samples[[0, 2]], moved.samples[[0, 2]])
    assert not np.array_equal(three.samples[1], moved.samples[1])
    assert (np.diff(np.median(three.samples, axis=1), axis=0) < 0).all()
    fewer = infer_drifts(table([drift / 3, drift / 2, drift]), fading, 5, epochs=1)
    np.testing.assert_array_equal(fewer.samples[0], three.samples[2])


@pytest.mark.usefixtures("unchained")
def test_a_mode_that_is_missing_at_an_epoch_is_done_without(tmp_path: Path) -> None:
    """An epoch of one of two modes is of that one, which identifies less; of none is no epoch."""
    stage = make_stage(tmp_path, tail=LAWS_ALONE)
    own = true_drift(NAMES, np.log([0.75, 0.85]))[:2]
    drift = np.vstack([np.zeros(2), np.tile(own, (3, 1))])
    cov = np.stack([np.zeros((2, 2)), COV, COV, COV])
    drift[1, 1], cov[1, 1], cov[1, :, 1] = np.nan, np.nan, np.nan
    drift[2], cov[2] = np.nan, np.nan
    track = make_track(drift, cov)
    found = infer_drifts(read(track), stage, 3)
    assert found.recorded_at == (track.recorded_at[1], track.recorded_at[3])
    assert found.identifiable.tolist() == [[False, True], [True, True]]
    assert (found.informed[0] < found.informed[1]).all()
    # The epoch without any is no baseline either: the travel counts from the first one.
    kept = [0, 1, 3]
    three = Drifts(
        track.stage,
        tuple(track.recorded_at[k] for k in kept),
        track.travel[kept],
        track.modes,
        drift[kept],
        cov[kept],
    )
    width = infer_drifts(three, stage, 3).prior_width[1]
    assert found.prior_width[1] == pytest.approx(width, rel=0.2)


@pytest.mark.usefixtures("unchained")
def test_drifts_that_are_not_enough_are_refused(stage: Stage, tmp_path: Path) -> None:
    """Without parameters, without modes of the map, or of the baseline alone."""
    drift = true_drift(NAMES, np.log([0.8, 0.9]))[:2]
    with pytest.raises(BadStage, match=r"no \[\[parameter\]\]"):
        infer_drifts(table([drift]), make_stage(tmp_path, ()), 1)
    with pytest.raises(NotEnoughData, match=r"roll.*pitch"):
        infer_drifts(read(make_track(np.zeros((3, 0)), np.zeros((3, 0, 0)))), stage, 1)
    with pytest.raises(NotEnoughData, match="no epoch has a drift of any"):
        infer_drifts(table([]), stage, 1)


@pytest.mark.usefixtures("unchained")
def test_drifts_without_an_odometer_may_be_of_any_change(fading: Stage) -> None:
    """Health is that of the drift, whatever travel the laws would need; no travel is claimed."""
    drift = true_drift(("guide_preload",), np.log([0.9]))[:2]
    bare = replace(table([drift]), travel=np.full(2, np.nan))
    found = infer_drifts(bare, fading, 1)
    low, high = found.latest(0.005)[0], found.latest(0.995)[0]
    assert low < 0.9 < high < low + 0.1
    assert np.isnan(found.travel).all()


# What is published


def test_without_parameters_there_is_nothing_to_infer(history: History, tmp_path: Path) -> None:
    """A description without parameters is refused."""
    with pytest.raises(BadStage, match=r"no \[\[parameter\]\]"):
        infer(history, make_stage(tmp_path, (), n_modes=3), 1)


def test_a_parameter_no_mode_sees_keeps_its_prior(tmp_path: Path) -> None:
    """Without sensitivity a parameter is uninformed, has its prior, and is not published."""
    stage = make_stage(tmp_path, (PRELOAD, FADING_FOOT), n_modes=3, tail=LAWS_ALONE)
    found = infer(lived((1 - TRAVEL / 8e6) ** 1.5, np.ones(12)), stage, 9, chains=False)
    assert found.identifiable[-1].tolist() == [True, False]
    assert found.publishable_parameters().tolist() == [True, False]
    assert (found.informed[:, 1] < 0.2).all()
    # A rate of N(0, 2e-4) per km over 2,500 km, within the map: health from 0.4 to 2.5.
    prior = stats.truncnorm(-1.5 / 0.5, 0.6 / 0.5, scale=0.5)
    for level in (0.05, 0.5, 0.95):
        error = 5 * np.sqrt(level * (1 - level) / min(found.ess[-1, 1], 4000))
        share = prior.cdf(1 - found.latest(1 - level)[1])
        assert abs(share - level) < error + 0.01
    width = np.ptp(1 - prior.ppf([0.05, 0.95]))
    assert found.prior_width[-1, 1] == pytest.approx(width, rel=0.08)


def test_the_prior_is_cut_at_the_map(stage: Stage) -> None:
    """Prior draws are lognormal between the edges of the grid, each parameter by itself."""
    x = stage.prior.draw(np.random.default_rng(12), 20_000)
    assert x.shape == (20_000, 2)
    for j, name in enumerate(NAMES):
        low, high = np.log(AXES[name][[0, -1]])
        cut = stats.truncnorm(low / 0.3, high / 0.3, scale=0.3)
        assert stats.kstest(x[:, j], cut.cdf).pvalue > 1e-4
    assert stats.kstest(x[:, 0], stats.norm(0, 0.25).cdf).pvalue < 1e-4  # negative control


def test_logs_that_no_life_explains_inform_no_parameter(stage: Stage, health: Health) -> None:
    """Estimates that scatter by twenty times their errors: p below 1e-3, and nothing published."""
    assert health.fit[-1] > 0.01
    found = infer(lived(np.ones(12), np.ones(12), scatter=0.01), stage, 1, chains=False)
    assert found.fit[-1] < 1e-6
    assert not found.explained
    assert not found.publishable_parameters().any()


def test_a_state_beyond_the_map_is_not_published(stage: Stage) -> None:
    """The modes of a preload below the grid leave no value: it would be an extrapolation."""
    for share, published in ((1.3, True), (0.4, False)):
        end = share * AXES["guide_preload"][0]
        found = infer(lived(np.linspace(1, end, 12), np.ones(12)), stage, 1, chains=False)
        assert found.publishable_parameters()[0] == published


@pytest.mark.usefixtures("unchained")
def test_a_posterior_at_the_edge_of_the_map_is_a_bound(tmp_path: Path) -> None:
    """Drifts further than the map reaches pile up at its end, reported by parameter."""
    stage = make_stage(tmp_path, model_std=0.0, tail=LAWS_ALONE)
    edge = np.log([AXES["guide_preload"][0], 0.9])
    inside = np.log([0.75, 0.85])
    for x, expected in ((edge * [1.02, 1.0], [True, False]), (inside, [False, False])):
        found = infer_drifts(table([true_drift(NAMES, x)[:2]]), stage, 1)
        assert found.at_edge[-1].tolist() == expected


def test_no_mode_moves_alone_where_all_follow_the_map(health: Health) -> None:
    """Of a life of the map most draws are without a mode that moves alone."""
    assert np.mean(health.lone == NO_MODE) > 0.7
    total = sum(one.probability for one in health.lone_modes)
    assert total == pytest.approx(np.mean(health.lone != NO_MODE))


def test_health_relative_to_its_baseline(health: Health) -> None:
    """Draws and widths of priors are divided by the baselines."""
    own = health.relative_to(np.array([2.0, 0.5]))
    np.testing.assert_allclose(own.chains * [2.0, 0.5], health.chains)
    np.testing.assert_allclose(own.prior_width * [2.0, 0.5], health.prior_width)


def test_health_is_a_table(health: Health) -> None:
    """One row per epoch and parameter, with quantiles, sampler, checks and correlations."""
    table = health.to_frame()
    assert len(table) == 22
    last = table.iloc[-1]
    assert last["parameter"] == "mount_stiffness"
    assert last["q05"] < last["median"] < last["q95"]
    assert last["median"] == np.quantile(health.samples[-1, :, 1], 0.5)
    assert last["correlation_mount_stiffness"] == pytest.approx(1)
    assert last["correlation_guide_preload"] == health.correlation[-1, 1, 0]
    assert last["ess"] == min(last["ess_bulk"], last["ess_tail"])
    assert set(table["sampler"]) == {"importance"}
    assert table["converged"].all()


def test_health_goes_to_arviz_and_back(health: Health, tmp_path: Path) -> None:
    """NetCDF keeps draws by ensemble and epoch, and arviz finds its R-hat in them."""
    health.to_arviz().to_netcdf(tmp_path / "health.nc", engine="h5netcdf")
    tree = xarray.open_datatree(tmp_path / "health.nc", engine="h5netcdf")
    draws = tree["posterior/guide_preload"]
    assert draws.dims == ("chain", "draw", "epoch")
    np.testing.assert_array_equal(draws.to_numpy(), np.moveaxis(health.chains[..., 0], 0, 2))
    np.testing.assert_array_equal(tree["checks_data/r_hat_guide_preload"], health.r_hat[:, 0])
    np.testing.assert_array_equal(tree["checks_data/fit"], health.fit)
    assert tree.attrs["seed"] == "5"
    assert float(array_stats.rhat(draws.to_numpy()[..., 1])) < 1.05


# A clock of days


DAYS = '[life]\nfree = 0\nlone_mode = 0\ncommon_wander = 0\nclock = "days"\n'


def test_a_machine_without_an_odometer_has_a_life_by_days(tmp_path: Path, history: History) -> None:
    """Twelve weekly logs at 32.5 km a day have the life of an odometer that says so."""
    per_day = 2500 / 77
    usage = f"[usage]\nkm_per_day = {per_day}\n"
    by_days = make_stage(tmp_path / "days", n_modes=3, tail=usage + DAYS)
    by_odometer = make_stage(tmp_path / "odometer", n_modes=3, tail=usage + LAWS_ALONE)
    bare = replace(history, travel=np.full(12, np.nan))
    with pytest.raises(NotEnoughData, match=r'odometer.*clock = "days"'):
        infer(bare, by_odometer, 1, chains=False)
    timed, known = (
        infer(bare, by_days, 1, chains=False),
        infer(history, by_odometer, 1, chains=False),
    )
    np.testing.assert_allclose(timed.samples, known.samples, rtol=1e-5)
    prognosis = prognosis_of(fit_life(bare, by_days, 1, chains=False), bare, by_days)
    np.testing.assert_array_equal(prognosis.health, timed.samples[-1])
    assert prognosis.usage == pytest.approx(per_day * 1000)
    assert np.isfinite(prognosis.remaining).any()


@pytest.mark.usefixtures("unchained")
def test_drifts_of_a_machine_without_an_odometer_have_a_life_by_days(tmp_path: Path) -> None:
    """Two drifts a week apart: the second is that of an odometer with so many km a week."""
    usage = "[usage]\nkm_per_day = 100\n"
    by_days = make_stage(tmp_path / "days", (FADING,), tail=usage + DAYS)
    by_odometer = make_stage(tmp_path / "odometer", (FADING,), tail=usage + LAWS_ALONE)
    drift = true_drift(("guide_preload",), np.log([0.8]))[:2]
    made = make_track(np.array([drift / 2, drift]), np.array([COV, COV]))
    bare = read(made)
    timed = infer_drifts(replace(bare, travel=np.full(2, np.nan)), by_days, 5)
    (days,) = [one.total_seconds() / 86400 for one in np.diff(np.array(bare.recorded_at))]
    known = infer_drifts(replace(bare, travel=np.array([0.0, 1e5 * days])), by_odometer, 5)
    assert timed.recorded_at == known.recorded_at == bare.recorded_at[1:]
    np.testing.assert_allclose(timed.samples, known.samples, rtol=1e-5)
    np.testing.assert_allclose(timed.travel, known.travel)


def test_a_clock_of_days_needs_the_travel_of_a_day(tmp_path: Path) -> None:
    """Without km_per_day the description is refused, with the key to state."""
    path = tmp_path / "small.toml"
    path.write_text(stage_text(tail='[life]\nclock = "days"\n'))
    with pytest.raises(BadStage, match=r"clock = \"days\".*\[usage\] km_per_day"):
        load_stage(str(path))
    path.write_text(stage_text(tail='[life]\nclock = "hours"\n'))
    with pytest.raises(BadStage, match="clock"):
        load_stage(str(path))


@pytest.mark.parametrize("wrong", ["free = 1.0", "free = -0.1", "lone_mode = 0.5", "other = 1"])
def test_weights_of_what_laws_do_not_have_are_checked(tmp_path: Path, wrong: str) -> None:
    """Shares outside of their ranges and unknown keys are refused by their name."""
    path = tmp_path / "small.toml"
    path.write_text(stage_text(tail=f"[life]\n{wrong}\n"))
    with pytest.raises(BadStage, match=wrong.split()[0]):
        load_stage(str(path))
