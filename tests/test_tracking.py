"""The tracker against textbook filters, and the lives that mislead others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.special import softmax

from lmshealth import tracking
from lmshealth.errors import NotEnoughData
from lmshealth.stage import Stage
from lmshealth.tracking import track
from lmshealth.tracks import History, Track
from tests.lives import DAMPING, FREQUENCY, make_history, make_stage, rough_history
from tests.oracles import Wander, batch, kalman

SETTINGS = [Wander(1e-3, 0.1), Wander(1e-5, 0.3, 2.25), Wander(1e-2, 1e-3, 1.5)]


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Two modes and temperature as covariate."""
    return make_stage(tmp_path_factory.mktemp("stage"))


@pytest.fixture
def one_setting(monkeypatch: pytest.MonkeyPatch):
    """Shrink the tracker's grid to one setting."""

    def choose(wander: Wander) -> None:
        monkeypatch.setattr(tracking, "_LEVEL_WALKS", (wander.level,))
        monkeypatch.setattr(tracking, "_RATE_WALKS", (wander.rate,))
        monkeypatch.setattr(tracking, "_NOISE_SCALES", (wander.scale,))
        monkeypatch.setattr(tracking, "_NOISE_SCALE_PRIOR", (1.0,))

    return choose


def flat_life(rng: np.random.Generator, n: int = 30, std: float = 5e-4) -> np.ndarray:
    """Ln frequencies of two modes that do not change."""
    return np.log(FREQUENCY[:2]) + std * rng.standard_normal((n, 2))


@pytest.mark.parametrize("wander", SETTINGS)
@pytest.mark.parametrize("baseline", [0, 3])
def test_one_setting_is_the_textbook_filter(
    stage: Stage, one_setting, wander: Wander, baseline: int
) -> None:
    """For one setting the tracker is the Kalman filter of the joint state, to 1e-10."""
    history = rough_history(np.random.default_rng(1), baseline=baseline)
    one_setting(wander)
    found, book = track(history, stage), kalman(history, wander)
    np.testing.assert_allclose(found.ln_frequency, book.ln_frequency, rtol=0, atol=1e-10)
    np.testing.assert_allclose(found.ln_frequency_std, book.ln_frequency_std, rtol=0, atol=1e-10)
    np.testing.assert_allclose(found.drift[baseline:], book.drift[baseline:], rtol=0, atol=1e-10)
    np.testing.assert_allclose(
        found.drift_cov[baseline:], book.drift_cov[baseline:], rtol=1e-8, atol=1e-14
    )
    np.testing.assert_allclose(found.nis, book.nis, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("wander", SETTINGS)
def test_log_evidence_is_that_of_the_textbook_filter(stage: Stage, wander: Wander) -> None:
    """The evidence that weighs the settings is the filter's log likelihood, to 1e-10 of itself."""
    history = rough_history(np.random.default_rng(2), baseline=2)
    problem = tracking._Problem(history, stage.description.covariate)
    run = problem.run(tracking._Setting(wander.level, wander.rate, wander.scale, 0.0))
    np.testing.assert_allclose(run.log_evidence, kalman(history, wander).log_evidence, rtol=1e-10)


@pytest.mark.parametrize("wander", SETTINGS)
@pytest.mark.parametrize("baseline", [0, 3])
def test_drift_is_that_of_the_whole_joint_gaussian(
    stage: Stage, one_setting, wander: Wander, baseline: int
) -> None:
    """Drift, variance and evidence equal conditioning of all levels and data at once."""
    history = rough_history(np.random.default_rng(3), baseline=baseline)
    one_setting(wander)
    found, joint = track(history, stage), batch(history, wander)
    run = tracking._Problem(history, stage.description.covariate).run(
        tracking._Setting(wander.level, wander.rate, wander.scale, 0.0)
    )
    later = slice(baseline, None)
    np.testing.assert_allclose(found.drift[later], joint.drift[later], rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        found.drift_cov[later], joint.drift_cov[later], rtol=1e-6, atol=1e-12
    )
    np.testing.assert_allclose(run.log_evidence, joint.log_evidence, rtol=1e-8)


def test_averaging_keeps_the_law_of_total_variance(stage: Stage) -> None:
    """Mean and variance over the grid are those of the mixture weighted by evidence so far."""
    history = rough_history(np.random.default_rng(4))
    found = track(history, stage)
    runs, weights = [], []
    for level in (1e-5, 3e-4, 1e-3, 3e-3, 1e-2):
        for rate in (1e-3, 3e-2, 1e-1, 3e-1):
            for scale, prior in ((1.0, 0.9), (1.5, 0.07), (2.25, 0.03)):
                run = kalman(history, Wander(level, rate, scale))
                runs.append(run)
                weights.append(run.log_evidence + np.log(prior))
    weight = softmax(np.array(weights), axis=0)
    drifts = np.array([run.drift for run in runs])
    mean = np.einsum("gk,gki->ki", weight, drifts)
    within = np.einsum("gk,gkij->kij", weight, np.array([run.drift_cov for run in runs]))
    off = drifts - mean
    between = np.einsum("gk,gki,gkj->kij", weight, off, off)
    np.testing.assert_allclose(found.drift, mean, rtol=0, atol=1e-10)
    np.testing.assert_allclose(found.drift_cov, within + between, rtol=1e-7, atol=1e-13)
    assert np.abs(between).max() > 1e-8  # the settings do differ


@pytest.mark.parametrize("baseline", [0, 4])
def test_drift_and_its_variance_vanish_at_the_baseline(stage: Stage, baseline: int) -> None:
    """The copy is exact: at the baseline drift and covariance are 0, not nearly so."""
    history = rough_history(np.random.default_rng(5), baseline=baseline)
    found = track(history, stage)
    assert (found.drift[baseline] == 0).all()
    assert (found.drift_cov[baseline] == 0).all()


def test_logs_on_the_spot_of_the_baseline_have_no_drift(stage: Stage) -> None:
    """Where the odometer has not moved since the baseline there is nothing to infer."""
    history = rough_history(np.random.default_rng(6))
    travel = np.r_[np.full(4, 1e5), np.linspace(2e5, 1e6, 6)]
    found = track(replace(history, travel=travel), stage)
    assert (found.drift[:4] == 0).all()
    assert (found.drift_cov[:4] == 0).all()


def test_nothing_is_said_before_the_baseline(stage: Stage) -> None:
    """With the baseline in the middle earlier drifts are NaN, and later ones are not."""
    found = track(rough_history(np.random.default_rng(7), baseline=3), stage)
    assert np.isnan(found.drift[:3]).all()
    assert np.isnan(found.drift_cov[:3]).all()
    assert np.isfinite(found.drift[3:]).all()
    assert np.isfinite(found.ln_frequency).all()


def test_variance_of_the_drift_keeps_the_error_of_the_baseline(stage: Stage) -> None:
    """However many logs follow, one poor baseline log leaves its own error in every drift."""
    ln_f = flat_life(np.random.default_rng(8), 40, 1e-4)
    cov = np.tile(np.diag([1e-8, 1e-8, 1e-3, 1e-3]), (40, 1, 1))
    cov[0] *= 1e4  # a baseline of standard deviation 0.01
    # A mode that hardly moves gives no other way to the baseline than its first logs.
    wide = track(make_history(ln_f, cov=cov), stage)
    cov[0] /= 1e4
    sharp = track(make_history(ln_f, cov=cov), stage)
    assert (np.einsum("kii->ki", wide.drift_cov)[1:] > 0).all()
    assert wide.drift_cov[1, 0, 0] > 2 * sharp.drift_cov[1, 0, 0]


def test_a_wholly_missing_log_changes_nothing(stage: Stage) -> None:
    """A log without any mode leaves all other epochs as if it did not exist."""
    rough = rough_history(np.random.default_rng(9))
    temperature = np.nan_to_num(rough.covariates["temperature_c"], nan=21.0)
    history = replace(rough, covariates={"temperature_c": temperature})
    keep = np.arange(len(history.logs)) != 4  # the builder's empty log
    without = make_history(
        history.ln_frequency[keep],
        travel=history.travel[keep],
        cov=history.cov[keep],
        ln_damping=history.ln_damping[keep],
        temperature=temperature[keep],
    )
    with_all, alone = track(history, stage), track(without, stage)
    np.testing.assert_allclose(with_all.drift[keep], alone.drift, atol=1e-12)
    np.testing.assert_allclose(with_all.drift_cov[keep], alone.drift_cov, rtol=1e-9, atol=1e-15)
    assert with_all.nis[4] == 0
    assert with_all.nis_dof[4] == 0


def test_a_missing_mode_never_poisons_the_others(stage: Stage, one_setting) -> None:
    """With independent errors a mode is followed as if the half-missing one did not exist."""
    rng = np.random.default_rng(10)
    ln_f = flat_life(rng, 12)
    temperature = 21 + rng.standard_normal(12)
    holes = ln_f.copy()
    holes[[0, 3, 4, 11], 1] = np.nan
    one_setting(SETTINGS[0])
    both = track(make_history(holes, temperature=temperature), stage)
    alone = track(make_history(ln_f[:, :1], temperature=temperature), stage)
    for name in ("ln_frequency", "ln_frequency_std", "ln_damping", "drift"):
        np.testing.assert_allclose(getattr(both, name)[:, :1], getattr(alone, name), atol=1e-12)
    assert np.isfinite(both.drift).all()
    assert np.isfinite(both.drift_cov).all()


def test_a_missing_baseline_log_is_bridged(stage: Stage) -> None:
    """A baseline log without any mode leaves finite, wide drifts."""
    ln_f = flat_life(np.random.default_rng(11), 10)
    ln_f[0] = np.nan
    found = track(make_history(ln_f), stage)
    assert np.isfinite(found.drift).all()
    assert (np.einsum("kii->ki", found.drift_cov)[1:] > 0).all()


def test_covariances_stay_positive_and_symmetric(stage: Stage) -> None:
    """Drift covariances are symmetric with no negative eigenvalue over a long awkward life."""
    found = track(rough_history(np.random.default_rng(12), n=40), stage)
    np.testing.assert_allclose(found.drift_cov, np.swapaxes(found.drift_cov, 1, 2), atol=1e-18)
    assert np.linalg.eigvalsh(found.drift_cov).min() > -1e-18


def test_no_epoch_knows_of_later_logs(stage: Stage) -> None:
    """Changing what later logs say leaves earlier epochs to the bit."""
    history = rough_history(np.random.default_rng(13))
    ln_f = history.ln_frequency.copy()
    ln_f[7:] += 0.05
    before, after = track(history, stage), track(replace(history, ln_frequency=ln_f), stage)
    np.testing.assert_array_equal(before.drift[:7], after.drift[:7])
    np.testing.assert_array_equal(before.drift_cov[:7], after.drift_cov[:7])
    assert (before.drift[8] != after.drift[8]).all()


def temperature_life(seed: int) -> History:
    """Make a life in which only the temperature moves the modes, by 2 % between its ends."""
    rng = np.random.default_rng(seed)
    temperature = 21 + 12 * np.sin(np.arange(40) / 5) + rng.standard_normal(40)
    ln_f = flat_life(rng, 40) - 8e-4 * (temperature[:, None] - 21)
    return make_history(ln_f, std=5e-4, temperature=temperature)


def worst_drift(found: Track) -> float:
    """Largest drift in units of its own standard deviation."""
    std = np.sqrt(np.einsum("kii->ki", found.drift_cov[1:]))
    return float(np.abs(found.drift[1:] / std).max())


def test_temperature_alone_raises_no_drift(stage: Stage) -> None:
    """A life of temperature alone keeps its drifts within their standard deviations."""
    found = track(temperature_life(14), stage)
    assert worst_drift(found) < 3
    for effect in found.effects:
        assert abs(effect.coefficient + 8e-4) < 4 * effect.std
        assert effect.std < 1e-4


def test_temperature_that_is_not_recorded_reads_as_drift(stage: Stage) -> None:
    """Negative control: the same life without its temperatures drifts far beyond its std."""
    assert worst_drift(track(replace(temperature_life(14), covariates={}), stage)) > 6


def test_a_log_without_temperature_counts_less(stage: Stage) -> None:
    """A log whose temperature is unknown moves the track less than one whose is known."""
    rng = np.random.default_rng(15)
    temperature = 21 + 5 * rng.standard_normal(12)
    ln_f = flat_life(rng, 12)
    unknown = temperature.copy()
    unknown[-1] = np.nan
    known = track(make_history(ln_f, temperature=temperature), stage)
    less = track(make_history(ln_f, temperature=unknown), stage)
    assert (less.ln_frequency_std[-1] > known.ln_frequency_std[-1]).all()
    assert np.isfinite(less.drift).all()


def test_without_a_stage_covariates_are_taken_about_their_median() -> None:
    """Without a description every covariate is regressed out about its median."""
    history = temperature_life(16)
    found = track(history)
    median = float(np.median(history.covariates["temperature_c"]))
    book = [kalman(history, w, reference=median) for w in SETTINGS[:1]]
    assert {effect.covariate for effect in found.effects} == {"temperature_c"}
    assert worst_drift(found) < 3
    assert np.abs(found.drift - book[0].drift).max() < 3e-3


def test_a_step_is_followed_and_shows_in_the_innovations(stage: Stage) -> None:
    """A 5 % step is taken up within its own uncertainty and is seen in NIS."""
    ln_f = flat_life(np.random.default_rng(17), 30)
    ln_f[15:] -= 0.05
    found = track(make_history(ln_f, std=5e-4), stage)
    std = np.sqrt(np.diag(found.drift_cov[-1]))
    assert (np.abs(found.drift[-1] + 0.05) < 4 * std).all()
    assert found.nis[15] > 10 * found.nis_dof[15]
    assert found.nis[10] < 5 * found.nis_dof[10]


def test_estimates_that_scatter_more_than_they_say_raise_the_noise_scale(stage: Stage) -> None:
    """Reported errors that are half the true ones are found out; honest ones are left alone."""
    ln_f = flat_life(np.random.default_rng(18), 60, 1e-3)
    ln_z = np.log(DAMPING[:2]) + 0.1 * np.random.default_rng(19).standard_normal((60, 2))
    cov = np.tile(np.diag([1e-6, 1e-6, 0.01, 0.01]), (60, 1, 1))
    honest = track(make_history(ln_f, cov=cov, ln_damping=ln_z), stage)
    boastful = track(make_history(ln_f, cov=cov / 4, ln_damping=ln_z), stage)
    assert honest.noise_scale[-1] < 1.1
    assert boastful.noise_scale[-1] > 1.5


def test_a_machine_that_never_moved_is_tracked_without_drift(stage: Stage) -> None:
    """Logs at one odometer reading are averaged, not divided by their span of 0."""
    ln_f = flat_life(np.random.default_rng(20), 6)
    found = track(make_history(ln_f, travel=np.full(6, 1e5)), stage)
    np.testing.assert_allclose(found.drift, 0, atol=1e-12)
    np.testing.assert_allclose(found.ln_frequency[-1], ln_f.mean(axis=0), atol=1e-5)


def test_a_history_without_estimates_is_refused(stage: Stage) -> None:
    """No estimate in any log: the error counts the logs."""
    with pytest.raises(NotEnoughData, match="no modal estimate in 5 logs"):
        track(make_history(np.full((5, 2), np.nan)), stage)


def test_results_cannot_be_written_to(stage: Stage, tmp_path: Path) -> None:
    """Arrays of a track are read-only."""
    found = track(rough_history(np.random.default_rng(21)), stage)
    with pytest.raises(ValueError, match="read-only"):
        found.drift[0] = 1.0
