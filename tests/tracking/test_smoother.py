"""The smoother equals the joint Gaussian of all logs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lmshealth.stage.description import Stage
from lmshealth.tracking import constants
from lmshealth.tracking.filters import state_space
from lmshealth.tracking.track import smooth, track
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
from tests.tracking.filters.test_kalman_filters import KNOWN, SETTINGS, one, trusted
from tests.tracking.test_track import quiet, shown, std_of, still

__all__ = ["trusted"]  # a fixture


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Two modes, temperature with a curvature and payload as covariates."""
    return make_stage(tmp_path_factory.mktemp("stage"), (PRELOAD,), tail=TWO)


@pytest.mark.slow
@pytest.mark.usefixtures("trusted")
@pytest.mark.parametrize("wander", [one for one in SETTINGS if not one.decay])
def test_the_published_filter_is_the_joint_gaussian_given_all_logs(
    stage: Stage, monkeypatch: pytest.MonkeyPatch, wander: Wander
) -> None:
    """Means and variances of all epochs are those of the joint Gaussian, to 1e-6 of the std.

    The rates have a weak prior, again after the reset before log 9: it costs a digit.
    """
    monkeypatch.setattr(
        state_space, "hyperparameter_grid", lambda n: one(wander, ("acc", "delta_e")[:n])
    )
    for gate in ("SUSPICION_GATE", "BEGUN_GATE"):
        monkeypatch.setattr(constants, gate, np.inf)
    history = awkward_history(np.random.default_rng(1))
    followed = track(history, stage)
    found = smooth(history, followed, stage)
    book = batch(history, shown(wander), replace(KNOWN, reopened=(1, 9)), smoothed=True)
    variance = np.einsum("kpipi->kpi", book.cov)
    std = np.sqrt(np.maximum(variance, 1e-2 * variance[:, :1]))
    judged = np.arange(len(history.logs)) >= history.baselines[0]
    for part, name in enumerate(("ln_frequency", "ln_damping", "drift")):
        off = (getattr(found, name) - book.mean[:, part]) / std[:, part]
        assert np.abs(off[judged]).max() < 1e-6
        own = (getattr(found, f"{name}_std") / followed.widening[:, None]) ** 2
        assert np.abs((own - variance[:, part]) / std[:, part] ** 2)[judged].max() < 1e-5


@pytest.mark.parametrize("n", [1, 2, 40])
def test_the_last_epoch_is_the_tracks(stage: Stage, n: int) -> None:
    """Filter and smoother are equal at the last log, for any number of logs, to rounding."""
    history = quiet(np.random.default_rng(3), n)
    followed = track(history, stage)
    found = smooth(history, followed, stage)
    for name in ("ln_frequency", "ln_damping", "drift"):
        own = found.drift_std if name == "drift" else getattr(found, f"{name}_std")
        std = std_of(followed) if name == "drift" else getattr(followed, f"{name}_std")
        off = getattr(found, name)[-1] - getattr(followed, name)[-1]
        assert (np.abs(off) <= 1e-6 * std[-1] + 1e-9).all()
        np.testing.assert_allclose(own[-1], std[-1], rtol=1e-6, atol=1e-9)


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
