"""The smoother equals the joint Gaussian of all logs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lmshealth.stage.description import Stage
from lmshealth.tracking import filter_bank as bank
from lmshealth.tracking.filter_bank import FilterModel
from lmshealth.tracking.smoother import smooth, smooth_one
from lmshealth.tracking.state_space import StateSpace
from lmshealth.tracking.track import track
from tests.lives import (
    PRELOAD,
    TWO,
    awkward_history,
    make_history,
    make_stage,
    rough_history,
    since,
)
from tests.oracles import Wander, batch
from tests.tracking.test_filter_bank import ALONE, KNOWN, SETTINGS, few, one, trusted
from tests.tracking.test_track import quiet, std_of, still

__all__ = ["few", "trusted"]  # fixtures


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Two modes, temperature with a curvature and payload as covariates."""
    return make_stage(tmp_path_factory.mktemp("stage"), (PRELOAD,), tail=TWO)


@pytest.mark.slow
@pytest.mark.parametrize("reopened", [(), (9,)])
@pytest.mark.parametrize("wander", SETTINGS)
def test_one_setting_is_the_joint_gaussian_given_all_logs(
    stage: Stage, wander: Wander, reopened: tuple[int, ...]
) -> None:
    """Means and covariances of all epochs are those of the joint Gaussian, to 1e-6 of the std.

    Rates that have decayed are nearly singular, and cost two digits.
    """
    close = 1e-4 if wander.decay else 1e-6
    history = awkward_history(np.random.default_rng(1))
    space = StateSpace(history, stage, history.steps)
    model = FilterModel(space, reopened)
    mean, cov = smooth_one(model, one(wander, model.sources), np.ones(model.values.shape))
    book = batch(history, wander, replace(KNOWN, reopened=reopened), smoothed=True)
    variance = np.einsum("kpipi->kpi", book.cov)
    std = np.sqrt(np.maximum(variance, 1e-2 * variance[:, :1]))
    for part, at in enumerate((space.level, space.damping)):
        assert np.abs((mean[:, at] - book.mean[:, part]) / std[:, part]).max() < close
        scale = std[:, part, :, None] * std[:, part, None]
        assert (np.abs(cov[:, at, at] - book.cov[:, part, :, part]) / scale).max() < close
    contrast = space.drift
    judged = np.arange(len(history.logs)) >= history.baselines[0]
    drift = mean[:, : contrast.shape[1]] @ contrast.T
    assert np.abs((drift - book.mean[:, 2]) / std[:, 2])[judged].max() < close


@pytest.mark.slow
@pytest.mark.usefixtures("trusted", "few")
def test_settings_are_averaged_by_their_evidence(stage: Stage) -> None:
    """Mean and variance are those of the mixture over settings, given all logs."""
    history = replace(rough_history(np.random.default_rng(2)), covariates={})
    found = smooth(history, track(history, stage), stage)
    grid = bank.hyperparameter_grid(1)
    books, log_weight = [], []
    for g in range(grid.rate_std.size):
        wander = Wander(
            float(grid.level_walk[g]),
            float(grid.rate_std[g]),
            float(grid.rate_walk[g]),
            {"acc": float(grid.scales[g, 0])},
            float(grid.rate_decay[g]),
            float(grid.wander[g]),
            float(grid.wander_keep[g]),
            float(grid.settling[g]),
        )
        book = batch(history, wander, replace(ALONE, covariates=()), smoothed=True)
        books.append(book)
        log_weight.append(grid.log_prior[g] + book.log_evidence[-1])
    weight = np.exp(np.array(log_weight) - np.logaddexp.reduce(log_weight))
    for part, name in enumerate(("ln_frequency", "ln_damping", "drift")):
        means = np.array([book.mean[:, part] for book in books])
        within = np.array([np.einsum("kpipi->kpi", book.cov)[:, part] for book in books])
        mean = np.einsum("g,gki->ki", weight, means)
        spread = np.einsum("g,gki->ki", weight, (means - mean) ** 2)
        variance = np.einsum("g,gki->ki", weight, within) + spread
        std = np.sqrt(variance)
        # Settings of less than a thousandth are left out.
        own, own_std = getattr(found, name), getattr(found, f"{name}_std")
        later = slice(1, None) if name == "drift" else slice(None)
        assert np.abs((own - mean)[later] / std[later]).max() < 0.02
        assert np.abs(own_std[later] / std[later] - 1).max() < 0.02


@pytest.mark.parametrize("n", [1, 2, 40])
def test_the_last_epoch_is_the_tracks(stage: Stage, n: int) -> None:
    """Filter and smoother are equal at the last log, for any number of logs."""
    history = quiet(np.random.default_rng(3), n)
    followed = track(history, stage)
    found = smooth(history, followed, stage)
    for name in ("ln_frequency", "ln_damping", "drift"):
        own = found.drift_std if name == "drift" else getattr(found, f"{name}_std")
        std = std_of(followed) if name == "drift" else getattr(followed, f"{name}_std")
        off = getattr(found, name)[-1] - getattr(followed, name)[-1]
        assert (np.abs(off) <= 0.02 * std[-1] + 1e-9).all()
        np.testing.assert_allclose(own[-1], std[-1], rtol=0.02, atol=1e-9)


def test_damping_that_no_log_tells_is_unknown(stage: Stage) -> None:
    """The smoother has no value where the filter has none."""
    quiet_life = quiet(np.random.default_rng(4), 6)
    ln_damping = np.array(quiet_life.ln_damping)
    ln_damping[:, 0] = np.nan
    history = make_history(quiet_life.ln_frequency, ln_damping=ln_damping)
    found = smooth(history, track(history, stage), stage)
    assert np.isnan(found.ln_damping[:, 0]).all()
    assert np.isnan(found.ln_damping_std[:, 0]).all()
    assert np.isfinite(found.ln_damping[:, 1]).all()


def test_later_logs_make_early_epochs_sharper(stage: Stage) -> None:
    """No smoothed std is larger than the filtered one, and early ones are much smaller."""
    history = quiet(np.random.default_rng(4))
    followed = track(history, stage)
    found = smooth(history, followed, stage)
    assert (found.ln_frequency_std < 1.02 * followed.ln_frequency_std).all()
    assert (found.ln_frequency_std[0] < 0.6 * followed.ln_frequency_std[0]).all()
    assert np.abs(found.drift[0]).max() < 1e-9


def test_a_step_that_was_found_stays_sharp(stage: Stage) -> None:
    """A step is not smoothed over the logs about it; rates have their prior again."""
    history = quiet(np.random.default_rng(5))
    ln_f = np.array(history.ln_frequency)
    ln_f[20:] -= 0.03
    history = replace(history, ln_frequency=ln_f)
    found = smooth(history, track(history, stage), stage)
    assert np.abs(found.drift[20] - found.drift[19] + 0.03).max() < 1e-3
    assert np.abs(found.drift[19]).max() < 1e-3
    # Negative control: without the step the drift creeps there.
    nothing = replace(track(history, stage), steps=())
    smeared = smooth(history, nothing, stage)
    assert np.abs(smeared.drift[20] - smeared.drift[19] + 0.03).max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("declared", [True, False])
def test_only_what_nobody_declared_opens_rates_anew(stage: Stage, declared: bool) -> None:
    """The last epoch equals the track's, for declared and detected steps, of four lives."""
    off, ratio = [], []
    for seed in range(8, 12):
        ln_f, ln_zeta = still(np.random.default_rng(seed), 24)
        ln_f -= 1e-3 * np.arange(24)[:, None] + 0.03 * (np.arange(24) >= 12)[:, None]
        history = make_history(ln_f, ln_damping=ln_zeta, std=5e-4)
        if declared:
            history = replace(history, steps=(since("step", 12, 24),))
        followed = track(history, stage)
        assert [step.declared for step in followed.steps] == [declared]
        found, std = smooth(history, followed, stage), std_of(followed)[-1]
        off.append((found.drift[-1] - followed.drift[-1]) / std)
        ratio.append(found.drift_std[-1] / std)
    assert np.sqrt(np.mean(np.square(off))) < 0.3
    np.testing.assert_allclose(ratio, 1, rtol=0.1)


def test_nothing_is_said_before_the_baseline(stage: Stage) -> None:
    """Drifts are NaN before the first baseline, and 0 at it."""
    history = rough_history(np.random.default_rng(6), baseline=3)
    found = smooth(history, track(history, stage), stage)
    assert np.isnan(found.drift[:3]).all() and np.isnan(found.drift_std[:3]).all()
    assert np.isfinite(found.drift[3:]).all()
    assert np.abs(found.drift[3]).max() < 1e-9
    assert found.drift_std[3].max() < 1e-6


@pytest.mark.slow
def test_an_inconsistent_filter_widens_the_smoother_as_well(stage: Stage) -> None:
    """Every standard deviation has the widening of its epoch."""
    ln_f, ln_zeta = still(np.random.default_rng(7))
    history = replace(quiet(np.random.default_rng(7)), ln_frequency=ln_f, ln_damping=ln_zeta)
    followed = track(history, stage)
    wider = replace(followed, widening=np.full(40, 2.0))
    one_of, two = smooth(history, followed, stage), smooth(history, wider, stage)
    np.testing.assert_allclose(two.ln_frequency_std, 2 * one_of.ln_frequency_std)
    np.testing.assert_allclose(two.drift_std, 2 * one_of.drift_std)
    np.testing.assert_allclose(two.ln_damping_std, 2 * one_of.ln_damping_std)
    np.testing.assert_array_equal(two.drift, one_of.drift)
