"""The tracker equals textbook filters; steps, outliers and covariates are no false drift."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import inf
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy import stats

from lmshealth._private.arrays import BoolArray, FloatArray
from lmshealth.errors import NotEnoughData
from lmshealth.stage.description import Stage, Usage
from lmshealth.tracking import constants
from lmshealth.tracking.constants import JUMP_STD
from lmshealth.tracking.filters import state_space, track_state
from lmshealth.tracking.filters.state_space import StateSpace
from lmshealth.tracking.filters.track_state import Event, loop_evidence
from lmshealth.tracking.history import History, Step, StepKind
from lmshealth.tracking.track import (
    Consistency,
    Track,
    accepted_estimates,
    consistency,
    outlier_refusals,
    smooth,
    track,
)
from studies.robustness.off_model.run import of_world
from tests.lives import (
    DAMPING,
    FREQUENCY,
    TWO,
    awkward_history,
    cut,
    make_history,
    make_stage,
    make_track,
    rough_history,
    seen_by,
    since,
)
from tests.oracles import JUMPS, Known, Wander, binomial_band, filterpy_loop
from tests.tracking.filters.test_kalman_filters import KNOWN, SETTINGS, few, one

__all__ = ["few"]  # a fixture

PUBLISHED = (
    "ln_frequency",
    "ln_frequency_std",
    "ln_damping",
    "ln_damping_std",
    "drift",
    "drift_cov",
    "noise_scale",
    "widening",
)


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Two modes and temperature as covariate, a horizon of 20,000 km."""
    return make_stage(tmp_path_factory.mktemp("stage"))


@pytest.fixture
def plain(monkeypatch: pytest.MonkeyPatch) -> Callable[[Wander], None]:
    """Reduce the grid to one setting, and disable outliers and events."""

    def choose(wander: Wander) -> None:
        sources = tuple(wander.scales)
        monkeypatch.setattr(state_space, "hyperparameter_grid", lambda n: one(wander, sources[:n]))
        monkeypatch.setattr(constants, "OUTLIER_GATE", inf)
        monkeypatch.setattr(constants, "SUSPICION_GATE", inf)
        monkeypatch.setattr(constants, "BEGUN_GATE", inf)

    return choose


def shown(wander: Wander) -> Wander:
    """Return the setting of the published filter: that of the bank, with a weak prior of rates."""
    return replace(wander, rate=constants.PUBLISHED_RATE_STD)


def still(rng: np.random.Generator, n: int = 40) -> tuple[FloatArray, FloatArray]:
    """Return ln f and ln ζ of two modes that do not change, with errors of 5e-4 and 0.05."""
    ln_f = np.log(FREQUENCY[:2]) + 5e-4 * rng.standard_normal((n, 2))
    return ln_f, np.log(DAMPING[:2]) + 0.05 * rng.standard_normal((n, 2))


def quiet(rng: np.random.Generator, n: int = 40) -> History:
    """Make a life without changes."""
    ln_f, ln_zeta = still(rng, n)
    return make_history(ln_f, ln_damping=ln_zeta, std=5e-4)


def std_of(found: Track) -> FloatArray:
    """Return the standard deviations of the drifts, ``(n_epochs, n_modes)``."""
    return np.sqrt(np.einsum("kii->ki", found.drift_cov))


@pytest.mark.parametrize("wander", SETTINGS)
def test_one_setting_is_a_filterpy_loop(
    tmp_path_factory: pytest.TempPathFactory, plain: Callable[[Wander], None], wander: Wander
) -> None:
    """A track with one setting equals filterpy's to 1e-10 of the std, after resets too.

    Innovations are those of the bank. Running-in is noise of the published filter, not a rate.
    """
    stage = make_stage(tmp_path_factory.mktemp("two"), tail=TWO)
    history = awkward_history(np.random.default_rng(1))
    plain(wander)
    found = track(history, stage)
    # At a baseline, as after work on the machine, its rates are unknown anew.
    known = replace(KNOWN, reopened=(1, 9))
    bank_book = filterpy_loop(history, wander, known)
    np.testing.assert_allclose(found.nis, bank_book.nis, rtol=1e-9, atol=1e-10)
    if wander.decay:
        return
    book = filterpy_loop(history, shown(wander), known)
    # At a baseline the variance of the drift is 0, which filterpy misses by rounding either way.
    std = np.sqrt(np.maximum(np.einsum("kpipi->kpi", book.cov), 0.0))
    widening = found.widening[:, None]
    for part, name in enumerate(("ln_frequency", "ln_damping")):
        own = getattr(found, name)
        assert np.abs((own - book.mean[:, part]) / std[:, part]).max() < 1e-10
        own_std = getattr(found, f"{name}_std")
        np.testing.assert_allclose(own_std, std[:, part] * widening, rtol=1e-10)
    judged = np.setdiff1d(np.arange(1, 16), history.baselines)
    # A machine that hardly wanders has drifts of next to no std, but of numbers of ln f.
    drift_std = np.maximum(std[judged, 2], 0.1 * std[judged, 0])
    assert np.abs((found.drift[judged] - book.mean[judged, 2]) / drift_std).max() < 1e-10
    cov = found.drift_cov[judged] / widening[judged, :, None] ** 2
    scale = drift_std[:, :, None] * drift_std[:, None]
    assert np.abs((cov - book.cov[judged, 2, :, 2]) / scale).max() < 1e-10


@pytest.mark.parametrize("baseline", [0, 4])
def test_drift_and_its_variance_vanish_at_the_baseline(stage: Stage, baseline: int) -> None:
    """Drift and covariance are exactly 0 at the baseline."""
    found = track(rough_history(np.random.default_rng(5), baseline=baseline), stage)
    assert (found.drift[baseline] == 0).all()
    assert (found.drift_cov[baseline] == 0).all()
    assert (std_of(found)[baseline + 1 :] > 0).any()


def test_logs_on_the_spot_of_the_baseline_have_no_drift(stage: Stage) -> None:
    """Logs with the odometer of the baseline have no drift."""
    history = rough_history(np.random.default_rng(6))
    travel = np.r_[np.full(4, 1e5), np.linspace(2e5, 1e6, 6)]
    found = track(replace(history, travel=travel), stage)
    assert (found.drift[:4] == 0).all()
    assert (found.drift_cov[:4] == 0).all()


def test_a_step_where_the_machine_stands_is_a_drift(stage: Stage) -> None:
    """A step may occur where the odometer stands still: events and drift agree."""
    ln_f, ln_zeta = still(np.random.default_rng(7), 12)
    ln_f[6:] -= 0.02
    parked = replace(make_history(ln_f, ln_damping=ln_zeta, std=5e-4), travel=np.full(12, 1e5))
    found = track(parked, stage)
    assert {(event.kind, event.epoch) for event in found.events} >= {("step", 6)}
    assert (found.drift[:6] == 0).all()
    assert (np.abs(found.drift[7:] + 0.02) < 5 * std_of(found)[7:]).all()
    assert (std_of(found)[6:] > 0).all()


def test_damping_that_no_log_tells_is_unknown(stage: Stage) -> None:
    """A mode without damping estimates has no damping; the others keep theirs."""
    ln_f, ln_zeta = still(np.random.default_rng(8), 6)
    ln_zeta[:, 0] = np.nan
    found = track(make_history(ln_f, ln_damping=ln_zeta), stage)
    assert np.isnan(found.ln_damping[:, 0]).all()
    assert np.isnan(found.ln_damping_std[:, 0]).all()
    assert np.isfinite(found.ln_damping[:, 1]).all()
    assert np.isfinite(found.ln_frequency).all()


def test_nothing_is_said_before_the_baseline(stage: Stage) -> None:
    """Drifts are NaN before a baseline in the middle, and finite after it."""
    found = track(rough_history(np.random.default_rng(7), baseline=3), stage)
    assert np.isnan(found.drift[:3]).all()
    assert np.isnan(found.drift_cov[:3]).all()
    assert np.isfinite(found.drift[3:]).all()
    assert np.isfinite(found.ln_frequency).all()


def test_work_on_the_machine_opens_a_new_baseline(stage: Stage) -> None:
    """Drift refers to the last reset, by whatever step it changed the modes."""
    ln_f, ln_zeta = still(np.random.default_rng(8))
    ln_f += 0.05 * (np.arange(40) >= 20)[:, None]
    history = make_history(ln_f, ln_damping=ln_zeta, std=5e-4)
    history = replace(history, baselines=(0, 20), steps=(since("reset", 20, 40),))
    found = track(history, stage)
    assert (found.drift[20] == 0).all()
    assert np.abs(found.drift).max() < 5e-3
    assert found.events == ()
    assert np.abs(found.ln_frequency[-1] - found.ln_frequency[19] - 0.05).max() < 2e-3


def test_variance_of_the_drift_keeps_the_error_of_the_baseline(stage: Stage) -> None:
    """The error of one poor baseline log remains in every drift, after any number of logs."""
    ln_f, _ = still(np.random.default_rng(8))
    cov = np.tile(np.diag([1e-8, 1e-8, 1e-3, 1e-3]), (40, 1, 1))
    sharp = track(make_history(ln_f, cov=cov), stage)
    cov[0] *= 1e4  # a baseline of standard deviation 0.01
    wide = track(make_history(ln_f, cov=cov), stage)
    assert (std_of(wide)[1:] > 0).all()
    assert wide.drift_cov[1, 0, 0] > 2 * sharp.drift_cov[1, 0, 0]


def test_a_wholly_missing_log_changes_nothing(stage: Stage) -> None:
    """A log without any mode leaves all other epochs unchanged."""
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


def test_a_missing_mode_never_poisons_the_others(
    stage: Stage, plain: Callable[[Wander], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """With independent errors and rates, no mode depends on another one that is partly missing."""
    monkeypatch.setattr(constants, "RATE_COMMON", 0.0)
    rng = np.random.default_rng(10)
    ln_f, _ = still(rng, 12)
    temperature = 21 + rng.standard_normal(12)
    holes = ln_f.copy()
    holes[[0, 3, 4, 11], 1] = np.nan
    plain(SETTINGS[0])
    both = track(make_history(holes, temperature=temperature), stage)
    alone = track(make_history(ln_f[:, :1], temperature=temperature), stage)
    for name in ("ln_frequency", "ln_damping", "drift"):
        np.testing.assert_allclose(getattr(both, name)[:, :1], getattr(alone, name), atol=1e-12)
    assert np.isfinite(both.drift).all()
    assert np.isfinite(both.drift_cov).all()


def test_a_mode_that_is_not_seen_yet_has_no_frequency(stage: Stage) -> None:
    """A mode has no frequency or damping, and a wide drift, before its first estimate."""
    ln_f, ln_zeta = still(np.random.default_rng(11), 10)
    ln_f[:3, 1] = np.nan
    found = track(make_history(ln_f, ln_damping=ln_zeta), stage)
    for name in ("ln_frequency", "ln_frequency_std", "ln_damping", "ln_damping_std"):
        assert np.isnan(getattr(found, name)[:3, 1]).all()
        assert np.isfinite(getattr(found, name)[3:]).all()
        assert np.isfinite(getattr(found, name)[:, 0]).all()
    assert np.isfinite(found.drift).all()
    assert (std_of(found)[1:] > 0).all()
    assert found.nis_dof.tolist() == [0, 2, 2, 2, 4, 4, 4, 4, 4, 4]


def test_a_missing_baseline_log_is_bridged(stage: Stage) -> None:
    """A baseline log without any mode leaves finite, wide drifts."""
    ln_f, _ = still(np.random.default_rng(11), 10)
    ln_f[0] = np.nan
    found = track(make_history(ln_f), stage)
    assert np.isfinite(found.drift).all()
    assert (std_of(found)[1:] > 0).all()


def test_covariances_stay_positive_and_symmetric(stage: Stage) -> None:
    """Drift covariances of a long awkward life are symmetric without negative eigenvalues."""
    found = track(rough_history(np.random.default_rng(12), n=40), stage)
    np.testing.assert_allclose(found.drift_cov, np.swapaxes(found.drift_cov, 1, 2), atol=1e-18)
    assert np.linalg.eigvalsh(found.drift_cov).min() > -1e-16


def eventful(seed: int) -> History:
    """Make a life with a late mode, an outlier and two events, which later logs could change."""
    rng = np.random.default_rng(seed)
    n = 36
    level, damping = np.tile(np.log(FREQUENCY[:2]), (n, 1)), np.tile(np.log(DAMPING[:2]), (n, 1))
    level[14:] -= 0.03
    level[24:] += 0.01
    damping[24:] += 0.3
    history = seen_by(rng, level, damping)
    ln_f = np.array(history.ln_frequency)
    ln_f[7, [0, 2]] += 0.04
    gone = np.zeros((n, 8), dtype=bool)
    gone[:3, [1, 3, 5, 7]] = gone[::3, [2, 3, 6, 7]] = True
    temperature = 21 + rng.standard_normal(n)
    temperature[[5, 11]] = np.nan
    loop = 1e-6 * np.exp(0.05 * rng.standard_normal(n))
    loop[24:] *= 1.5
    cov = np.where(gone[:, :, None] | gone[:, None, :], np.nan, history.cov)
    return replace(
        history,
        ln_frequency=np.where(gone[:, :4], np.nan, ln_f),
        ln_damping=np.where(gone[:, 4:], np.nan, history.ln_damping),
        cov=cov,
        covariates={"temperature_c": temperature},
        loop_error=loop,
    )


@pytest.mark.slow
def test_no_epoch_knows_of_later_logs(stage: Stage) -> None:
    """Appended logs change nothing published: events, outliers and uncertain states included."""
    history = eventful(13)
    whole = track(history, stage)
    assert {(e.kind, e.epoch) for e in whole.events if not e.declared} >= {("step", 14)}
    assert whole.outliers[0] == (7, "roll")
    for n in (5, 8, 9, 12, 15, 16, 17, 25, 26, 27, 35):
        part = track(cut(history, n), stage)
        for name in PUBLISHED:
            np.testing.assert_allclose(
                getattr(part, name),
                getattr(whole, name)[:n],
                rtol=1e-9,
                atol=1e-12,
                err_msg=f"{name} of {n} logs",
            )
        # Sizes are of the last log; that something happened, and when it was known, is not.
        for kept, all_found in ((part.events, whole.events),):
            known = [(e.kind, e.epoch, e.mode, e.source, e.found_at) for e in kept]
            later = [
                (e.kind, e.epoch, e.mode, e.source, e.found_at) for e in all_found if e.found_at < n
            ]
            assert known == later


def test_neither_horizon_nor_unit_of_the_clock_count(tmp_path: Path) -> None:
    """The same logs give the same track for any horizon; an odometer in other units as well."""
    history = rough_history(np.random.default_rng(14), n=20)
    far = make_stage(tmp_path, tail="")
    usage = Usage(horizon_km=10)
    near = replace(far, description=msgspec.structs.replace(far.description, usage=usage))
    scaled = replace(history, travel=1e3 * history.travel)
    reference = track(history, far)
    assert np.array_equal(track(history, near).drift, reference.drift)
    np.testing.assert_allclose(track(scaled, far).drift, reference.drift, atol=1e-9)
    # Negative control: other distances between the logs do count.
    bent = replace(history, travel=history.travel**2)
    assert np.abs(std_of(track(bent, far)) - std_of(reference)).max() > 1e-6


def temperature_life(seed: int) -> History:
    """Make a life in which only temperature moves the modes, by 2 % between its extremes."""
    rng = np.random.default_rng(seed)
    temperature = 21 + 12 * np.sin(np.arange(40) / 5) + rng.standard_normal(40)
    ln_f, _ = still(rng)
    return make_history(
        ln_f - 8e-4 * (temperature[:, None] - 21), std=5e-4, temperature=temperature
    )


def worst_drift(found: Track) -> float:
    """Return the largest drift in its own standard deviations."""
    return float(np.abs(found.drift[1:] / std_of(found)[1:]).max())


def test_temperature_alone_raises_no_drift(stage: Stage) -> None:
    """Drifts of a life with temperature changes alone are within their standard deviations."""
    found = track(temperature_life(14), stage)
    assert worst_drift(found) < 3
    assert found.events == ()
    effects = [effect for effect in found.effects if effect.covariate == "temperature_c"]
    assert [effect.mode for effect in effects] == ["roll", "pitch"]
    for effect in effects:
        assert abs(effect.coefficient + 8e-4) < 4 * effect.std
        assert effect.std < 1e-4


def test_an_alarm_is_of_the_drift_since_the_baseline(stage: Stage) -> None:
    """A loss before a baseline that is flagged later is no alarm, and leaves that after it one."""
    ln_f, ln_zeta = still(np.random.default_rng(3), 40)
    loss = 0.004 * (np.minimum(np.arange(40), 15) + np.maximum(np.arange(40) - 24, 0))[:, None]
    history = make_history(ln_f - loss, ln_damping=ln_zeta, std=5e-4)
    at_first, later = (track(replace(history, baselines=(k,)), stage) for k in (0, 20))
    assert [one.epoch < 20 for one in at_first.alarms] == [True]
    (alarm,) = later.alarms
    assert alarm.epoch > 24
    assert -0.1 < alarm.size < 0


def test_temperature_that_is_not_recorded_reads_as_drift(stage: Stage) -> None:
    """Negative control: the same life without temperatures drifts far beyond its std."""
    assert worst_drift(track(replace(temperature_life(14), covariates={}), stage)) > 6


def test_a_log_without_temperature_counts_less(stage: Stage) -> None:
    """A log whose temperature is unknown moves the track less than one whose is known."""
    rng = np.random.default_rng(15)
    temperature = 21 + 5 * rng.standard_normal(12)
    ln_f, _ = still(rng, 12)
    unknown = temperature.copy()
    unknown[-1] = np.nan
    known = track(make_history(ln_f, temperature=temperature), stage)
    less = track(make_history(ln_f, temperature=unknown), stage)
    assert (less.ln_frequency_std[-1] > known.ln_frequency_std[-1]).all()
    assert np.isfinite(less.drift).all()


def test_without_a_stage_covariates_are_taken_about_their_median(
    plain: Callable[[Wander], None],
) -> None:
    """Without a description every covariate is regressed out about its median."""
    history = temperature_life(16)
    median = float(np.median(history.covariates["temperature_c"]))
    plain(SETTINGS[0])
    found = track(history)
    known = Known((("temperature_c", median, 1e-3, 0.0),))
    book = filterpy_loop(history, shown(SETTINGS[0]), known)
    std = np.sqrt(np.einsum("kpipi->kpi", book.cov))
    assert np.abs((found.drift - book.mean[:, 2])[1:] / std[1:, 2]).max() < 1e-10


def test_a_step_is_followed_and_its_size_told(stage: Stage) -> None:
    """A step of 5 % is followed within its uncertainty, and is an event of that size."""
    history = quiet(np.random.default_rng(17))
    ln_f = np.array(history.ln_frequency)
    ln_f[15:] -= 0.05
    found = track(replace(history, ln_frequency=ln_f), stage)
    assert (np.abs(found.drift[-1] + 0.05) < 4 * std_of(found)[-1]).all()
    assert [(e.kind, e.epoch) for e in found.events if e.kind != "alarm"] == [("step", 15)] * 2
    for event in found.events:
        assert abs(event.size + 0.05) < 4 * event.std < 0.02
    assert found.steps[0].declared is False


@pytest.mark.parametrize("rows", [(0,), (0, 1), (2,)])
def test_one_log_that_is_far_off_is_an_outlier(stage: Stage, rows: tuple[int, ...]) -> None:
    """An outlier is listed and leaves the track unchanged; its epoch has a wide uncertainty."""
    history = quiet(np.random.default_rng(18))
    values = np.hstack([history.ln_frequency, history.ln_damping])
    far = 0.05 if rows[0] < 2 else 1.5
    values[20, list(rows)] += far
    history = replace(history, ln_frequency=values[:, :2], ln_damping=values[:, 2:])
    modes = sorted({row % 2 for row in rows})
    missing = np.array(history.ln_frequency)
    missing[20, modes] = np.nan
    believed = make_history(missing, ln_damping=history.ln_damping, std=5e-4)
    found, without = track(history, stage), track(believed, stage)
    assert found.outliers == tuple((20, history.modes[i]) for i in modes)
    assert found.events == ()
    assert np.abs((found.drift - without.drift)[21:] / std_of(without)[21:]).max() < 0.3
    assert np.abs(found.widening - 1).max() == 0
    # At its log the interval holds both explanations: nothing, and a step.
    for i in modes:
        name = "ln_frequency" if rows[0] < 2 else "ln_damping"
        mean, std = (getattr(found, name + end)[20, i] for end in ("", "_std"))
        before = getattr(found, name)[19, i]
        assert mean - 2 * std < before < mean + 2 * std
        assert mean - 2 * std < before + far < mean + 2 * std
        assert getattr(found, f"{name}_std")[22, i] < std / 3


def with_first_off(rng: np.random.Generator, off: float, n: int = 17, logs: int = 1) -> History:
    """Make a life without changes whose first logs are off by so much in ln f of both modes."""
    history = quiet(rng, n)
    ln_f = np.array(history.ln_frequency)
    ln_f[:logs] += off
    return replace(history, ln_frequency=ln_f)


@pytest.mark.parametrize("n", [5, 17])
@pytest.mark.parametrize("off", [0.03, -0.03])
def test_a_first_log_that_is_far_off_is_an_outlier(stage: Stage, off: float, n: int) -> None:
    """It was the reference of all drifts: running-in within one log explained it.

    It may be right, if the machine changed after it: ℓ₀ is halfway, with half of the distance as
    standard deviation.
    """
    history = with_first_off(np.random.default_rng(31), off, n)
    found = track(history, stage)
    missing = np.array(history.ln_frequency)
    missing[0] = np.nan
    without = track(make_history(missing, ln_damping=history.ln_damping, std=5e-4), stage)
    assert found.outliers == ((0, "roll"), (0, "pitch"))
    assert found.events == ()
    np.testing.assert_allclose(found.drift[-1], without.drift[-1] - off / 2, atol=1e-3)
    np.testing.assert_allclose(std_of(found)[-1], np.hypot(std_of(without)[-1], off / 2), rtol=0.05)
    smoothed = smooth(history, found, stage)
    assert np.abs(smoothed.ln_frequency[0] - history.ln_frequency[1:].mean(axis=0)).max() < 0.01
    assert np.isnan(accepted_estimates(history, found).ln_frequency[0]).all()
    doubted = accepted_estimates(history, found, doubtful=True)
    assert doubted.in_doubt == (0, 1)
    np.testing.assert_array_equal(doubted.ln_frequency, history.ln_frequency)
    assert np.isnan(doubted.ln_damping[0]).all()
    assert all("logs after" in one.detail for one in outlier_refusals(history, found))


@pytest.mark.parametrize("gaps", [(1.0, 30.0), (1.0, 7.0), (10.0, 1.0)])
def test_steady_wear_is_followed_where_the_distance_between_logs_changes(
    stage: Stage, monkeypatch: pytest.MonkeyPatch, gaps: tuple[float, float]
) -> None:
    """Logs without errors show the drift that there is, from a schedule to another one."""
    travel = 1e5 + 2e4 * np.cumsum(np.repeat([0.0, *gaps], [1, 20, 12]))
    drift = -0.03 * (travel - travel[0])[:, None] / np.ptp(travel)
    history = make_history(np.log(FREQUENCY[:2]) + drift, travel=travel, std=3e-4)
    off = []
    for known in (constants.KNOWN_RATE_LOGS, 10**6):
        monkeypatch.setattr(constants, "KNOWN_RATE_LOGS", known)
        found = track(history, stage)
        off.append(np.abs((found.drift - drift)[12:] / std_of(found)[12:]).max())
    assert off[0] < 0.05 and off[1] > 0.2  # negative control: rates keep their number per life


def test_first_logs_that_agree_or_wear_or_deviate_together_are_no_outliers(stage: Stage) -> None:
    """Negative control: neither an early wear nor a step after the second log leaves logs out."""
    rng = np.random.default_rng(32)
    early = quiet(rng, 17)
    worn = early.ln_frequency - 0.03 * (1 - np.exp(-np.arange(17) / 3))[:, None]
    for history in (
        with_first_off(rng, 0.0),
        with_first_off(rng, 0.03, logs=2),
        replace(early, ln_frequency=worn),
    ):
        assert [k for k, _ in track(history, stage).outliers if k == 0] == []


def test_the_first_log_after_work_is_judged_and_one_before_work_is_not(stage: Stage) -> None:
    """Work explains a deviation of the only log before it, and opens a baseline of its own."""
    rng, n = np.random.default_rng(33), 17
    at_once = replace(with_first_off(rng, 0.03), steps=(since("reset", 1, n),), baselines=(0, 1))
    assert track(at_once, stage).outliers == ()
    later = quiet(rng, n)
    ln_f = np.array(later.ln_frequency)
    ln_f[8:] += 0.02
    ln_f[8] -= 0.03
    worked = replace(later, ln_frequency=ln_f, steps=(since("reset", 8, n),), baselines=(0, 8))
    found = track(worked, stage)
    assert found.outliers == ((8, "roll"), (8, "pitch"))
    assert np.abs(found.drift[-1] / std_of(found)[-1]).max() < 3
    # Without two logs after it, only those before judge it.
    shortest = track(cut(worked, 9), stage)
    (refused,) = outlier_refusals(cut(worked, 9), replace(shortest, outliers=((8, "roll"),)))
    assert "logs before" in refused.detail


@pytest.mark.parametrize("first", [1, 3])
def test_the_first_log_of_a_declared_baseline_is_judged(stage: Stage, first: int) -> None:
    """No work began it: it is a log as others, and the reference of all drifts since."""
    later = quiet(np.random.default_rng(36), 17)
    ln_f = np.array(later.ln_frequency)
    ln_f[first] += 0.03
    found = track(replace(later, ln_frequency=ln_f, baselines=(first,)), stage)
    assert found.outliers == ((first, "roll"), (first, "pitch"))
    assert np.abs(found.drift[-1] / std_of(found)[-1]).max() < 3


def test_only_the_first_log_of_a_baseline_is_judged(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A step that was found begins a regime, and no baseline."""
    judge, judged, n = track_state._judged_backwards, set[str](), 24

    def noted(space: StateSpace) -> tuple[BoolArray, FloatArray]:
        judged.add(space.history.logs[-1])
        return judge(space)

    monkeypatch.setattr(track_state, "_judged_backwards", noted)
    history = quiet(np.random.default_rng(38), n)
    ln_f = history.ln_frequency - 0.03 * (np.arange(n) >= 7)[:, None]
    found = track(replace(history, ln_frequency=ln_f), stage)
    assert "step" in {one.kind for one in found.events}
    assert judged <= {history.logs[0]}
    off = ln_f + 0.03 * (np.arange(n) == 14)[:, None]
    found = track(replace(history, ln_frequency=off, baselines=(0, 14)), stage)
    assert {k for k, _ in found.outliers} == {14}
    assert history.logs[14] in judged


def test_logs_of_an_ended_retuning_do_not_judge_the_first_log(stage: Stage) -> None:
    """Back to the servo of before, the modes differ from the first log since work."""
    rng, n = np.random.default_rng(37), 17
    tuned = (np.arange(n) >= 6) & (np.arange(n) < 9)
    servo = Step("servo", 6, tuned, name="B")
    ln_f = np.array(quiet(rng, n).ln_frequency) + 0.03 * tuned[:, None]
    history = replace(
        quiet(rng, n), ln_frequency=ln_f, steps=(servo, since("reset", 8, n)), baselines=(0, 8)
    )
    assert track(history, stage).outliers == ()


def test_a_first_log_is_left_out_from_the_log_on_that_shows_it(stage: Stage) -> None:
    """Appended logs change no epoch that is published, although they judge the first log."""
    history = with_first_off(np.random.default_rng(34), 0.03)
    whole, first = track(history, stage), []
    for n in (2, 3, 4, 6, 9):
        part = track(cut(history, n), stage)
        first.append(bool(part.outliers))
        for name in PUBLISHED:
            own, all_logs = getattr(part, name), getattr(whole, name)[:n]
            np.testing.assert_allclose(own, all_logs, rtol=1e-9, atol=1e-12, err_msg=name)
    assert first[0] is False
    assert first[-1] is True


def test_a_gap_after_the_first_log_may_have_any_drift(stage: Stage) -> None:
    """A new machine that is monitored after years has worn: its first log is no outlier."""
    rng, n = np.random.default_rng(35), 13
    travel = np.r_[0.0, np.linspace(1.6e6, 2e6, n - 1)]
    history = quiet(rng, n)
    ln_f = history.ln_frequency - 0.04 * (travel / 2e6)[:, None]
    found = track(replace(history, ln_frequency=ln_f, travel=travel), stage)
    assert found.outliers == ()
    assert (np.abs(found.drift[-1] + 0.04) < 4 * std_of(found)[-1]).all()


def test_outliers_two_logs_in_a_row_are_no_step(stage: Stage) -> None:
    """Negative control: two outliers in a row that return are not adopted as a step."""
    history = quiet(np.random.default_rng(19))
    ln_f = np.array(history.ln_frequency)
    ln_f[20, 0] += 0.05
    ln_f[23, 0] -= 0.05
    found = track(replace(history, ln_frequency=ln_f), stage)
    assert found.outliers == ((20, "roll"), (23, "roll"))
    assert found.events == ()


def jumping(jumps: dict[int, float], modes: Sequence[int] = (0,)) -> History:
    """Return a life of three modes by imprecise logs; some modes are off by so much in some."""
    rng, n = np.random.default_rng(20), 14 + len(jumps)
    ln_f, ln_zeta = np.tile(np.log(FREQUENCY[:3]), (n, 1)), np.tile(np.log(DAMPING[:3]), (n, 1))
    ln_f += 1.5e-3 * rng.standard_normal((n, 3))
    for k, jump in jumps.items():
        ln_f[k, modes] += jump
    ln_zeta += 0.05 * rng.standard_normal((n, 3))
    return make_history(ln_f, ln_damping=ln_zeta, std=1.5e-3)


def test_last_logs_that_deviate_alike_are_no_outliers(stage: Stage) -> None:
    """One log of a jump is left out; with the second it is not, although no step is certain.

    Controls: deviations to both sides, and those after which the mode is back, are left out.
    """
    off = -0.02
    assert track(jumping({14: off}), stage).outliers == ((14, "roll"),)
    history = jumping({14: off, 15: off})
    found = track(history, stage)
    assert (found.outliers, found.events) == ((), ())
    assert found.suspected is not None
    assert found.suspected.first == 14
    assert found.unconfirmed == ((14, "roll"), (15, "roll"))
    assert accepted_estimates(history, found).steps == (found.suspected,)
    two = (14, "roll"), (15, "roll")
    assert track(jumping({14: off, 15: -off}), stage).outliers == two
    back = track(jumping({14: off, 15: off, 16: 0.0, 17: 0.0}), stage)
    assert (back.outliers, back.events) == (two, ())
    assert back.suspected is None


def test_sources_that_deviate_in_turn_deviate_alike(stage: Stage) -> None:
    """Which source of a mode deviates most is chance: both are off to one side."""
    rng, n = np.random.default_rng(21), 16
    ln_f, ln_zeta = (np.tile(np.log(one[:2]), (n, 1)) for one in (FREQUENCY, DAMPING))
    history = seen_by(rng, ln_f, ln_zeta, sources=("acc", "delta_e"))
    values, own = np.array(history.ln_frequency), list(history.columns("roll"))
    values[14, own] -= (0.022, 0.018)
    values[15, own] -= (0.018, 0.022)
    found = track(replace(history, ln_frequency=values), stage)
    assert found.outliers == ()
    assert found.suspected is not None or "step" in {event.kind for event in found.events}


def test_a_life_of_most_steps_has_no_suspected_one(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Health after as many steps as a life may have is not lost to two logs that deviate."""
    history = jumping({14: -0.02, 15: -0.02})
    monkeypatch.setattr(constants, "MAX_STEPS", 0)
    found = track(history, stage)
    assert found.outliers == ((14, "roll"), (15, "roll"))
    assert found.suspected is None


def test_a_jump_of_one_mode_is_an_event_of_it_alone(stage: Stage) -> None:
    """It is found at its third log, and moves no other mode; a jump of all modes is one of all."""
    for modes, names in (((0,), {"roll"}), ((0, 1, 2), {"roll", "pitch", "yaw"})):
        found = track(jumping(dict.fromkeys(range(14, 17), -0.02), modes), stage)
        steps = [event for event in found.events if event.kind == "step"]
        assert {event.mode for event in steps} == names
        for event in steps:
            assert event.epoch == 14
            assert abs(event.size + 0.02) < 4 * event.std


def test_estimates_that_scatter_more_than_they_say_raise_the_noise_scale(stage: Stage) -> None:
    """The noise scale rises where reported errors are half the true ones, and only there."""
    history = quiet(np.random.default_rng(18), 60)
    honest = track(history, stage)
    boastful = track(replace(history, cov=history.cov / 4), stage)
    assert honest.noise_scale.shape == (60, 1)
    assert honest.noise_scale[-1, 0] < 1.1
    assert boastful.noise_scale[-1, 0] > 1.5
    assert np.abs(honest.widening - 1).max() == 0


def test_a_filter_that_is_inconsistent_widens(stage: Stage) -> None:
    """Errors 120 times as large as reported are beyond the grid: intervals are widened."""
    history = quiet(np.random.default_rng(20), 60)
    found = track(replace(history, cov=history.cov / 14400), stage)
    assert found.widening[-1] > 1.2
    assert found.widening[0] == 1
    assert not found.consistency().holds
    assert track(history, stage).consistency().holds


@pytest.mark.parametrize(
    ("nis", "autocorrelation", "holds"),
    [(1.0, 0.0, True), (0.87, -0.08, True), (1.05, 0.05, True), (0.7, 0.0, False),
     (1.2, 0.0, False), (1.0, 0.2, False), (1.0, -0.2, False)],
)  # fmt: skip
def test_a_deviation_of_thousands_of_logs_must_be_large(
    nis: float, autocorrelation: float, holds: bool
) -> None:
    """Any is significant there, and those that hardly change an interval are no fault."""
    assert Consistency(nis, 1e-9, autocorrelation, 1e-9).holds == holds
    assert Consistency(nis, 0.5, autocorrelation, 0.5).holds


def test_two_sources_are_told_apart_by_their_bias(stage: Stage) -> None:
    """The bias of the second source is estimated per mode, within its standard deviation."""
    rng = np.random.default_rng(21)
    n = 40
    history = seen_by(
        rng, np.tile(np.log(FREQUENCY[:2]), (n, 1)), np.tile(np.log(DAMPING[:2]), (n, 1))
    )
    found = track(history, stage)
    biases = [effect for effect in found.effects if effect.covariate == "bias:delta_e"]
    assert [effect.mode for effect in biases] == ["roll", "pitch"]
    for effect in biases:
        # Errors that are nine tenths common tell a difference better than a level.
        assert effect.std < 5e-4 / np.sqrt(n)
        assert abs(effect.coefficient - 2e-3) < 4 * effect.std
    assert found.sources == ("acc", "delta_e")
    assert [e.covariate for e in found.effects if not e.mode] == ["scale:acc", "scale:delta_e"]


@pytest.mark.parametrize("kind", ["step", "servo", "regreasing"])
def test_evidence_of_a_declared_step_is_that_of_two_filters(
    stage: Stage, plain: Callable[[Wander], None], monkeypatch: pytest.MonkeyPatch, kind: StepKind
) -> None:
    """The density ratio at no jump equals the evidence ratio of two filters, to 1e-8."""
    n = 20
    rng = np.random.default_rng(22)
    ln_f, ln_zeta = still(rng, n)
    ln_f[8:] -= 0.001
    ln_zeta[8:] -= 0.1
    history = make_history(ln_f, ln_damping=ln_zeta, std=5e-4)
    history = replace(history, steps=(since(kind, 8, n),))
    wander = Wander(1e-3, 0.3, 0.1, {"acc": 1.0})
    plain(wander)
    events_found = track(history, stage).events
    part = 1 if kind == "regreasing" else 0
    known = Known()
    with_it = filterpy_loop(history, shown(wander), known).log_evidence[-1]
    jump = list(JUMP_STD[kind])
    jump[part] = 0.0
    monkeypatch.setitem(JUMPS, kind, tuple(jump))
    without = filterpy_loop(history, shown(wander), known).log_evidence[-1]
    assert len(events_found) == 2
    for event in events_found:
        assert event.declared
        assert event.found_at == event.epoch == 8
        assert event.evidence == pytest.approx(with_it - without, abs=1e-6)


def test_a_declared_retuning_is_no_drift(stage: Stage) -> None:
    """A retuning is an effect; an undeclared one is detected by the change of the loop."""
    n = 40
    ln_f, ln_zeta = still(np.random.default_rng(23), n)
    ln_f[20:] -= 0.015
    ln_zeta[20:] += 0.3
    history = make_history(ln_f, ln_damping=ln_zeta, std=5e-4)
    declared = replace(history, steps=(since("servo", 20, n, name="v2"),))
    found = track(declared, stage)
    assert np.abs(found.drift).max() < 4e-3
    assert {e.kind for e in found.events} == {"servo"}
    effect = next(effect for effect in found.effects if effect.covariate == "servo:v2")
    assert abs(effect.coefficient + 0.015) < 4 * effect.std
    # Nothing declared: the following error below 40 Hz tells.
    loop = 1e-6 * np.exp(0.05 * np.random.default_rng(24).standard_normal(n))
    loop[20:] *= 1.4
    by_itself = track(replace(history, loop_error=loop), stage)
    assert {(e.kind, e.epoch, e.declared) for e in by_itself.events} == {("servo", 20, False)}
    assert np.abs(by_itself.drift[22:]).max() < 4e-3
    evidence = loop_evidence(loop, 20, 30, "servo")
    assert evidence is not None and evidence > 3


def test_a_machine_that_never_moved_is_tracked_without_drift(stage: Stage) -> None:
    """Logs at one odometer reading are averaged; nothing is divided by their span of 0."""
    ln_f, ln_zeta = still(np.random.default_rng(20), 6)
    found = track(make_history(ln_f, ln_damping=ln_zeta, travel=np.full(6, 1e5)), stage)
    np.testing.assert_allclose(found.drift, 0, atol=1e-12)
    np.testing.assert_allclose(found.ln_frequency[-1], ln_f.mean(axis=0), atol=1e-5)


def test_one_log_only_is_tracked(stage: Stage) -> None:
    """A single log gives its own estimates, with nearly their std, and no drift."""
    history = cut(quiet(np.random.default_rng(25)), 1)
    for given in (stage, None):
        found = track(history, given)
        np.testing.assert_allclose(found.ln_frequency, history.ln_frequency, atol=1e-12)
        # By what factor the estimates' own std is wrong, and how far the mode has wandered, is not
        # known after one log.
        grid = state_space.hyperparameter_grid(1)
        scale, prior = grid.scales[:, 0], constants.LN_F_STD**2
        error = (5e-4 * scale) ** 2 * (1 + grid.wander**2)
        # The first estimates have the density of their prior, which is wider for large scales.
        weight = np.exp(grid.log_prior) / (error + prior)
        weight /= (0.05 * scale) ** 2 + constants.LN_ZETA_STD**2
        weight /= weight.sum()
        # The published filter has the geometric mean of the factor, and the mean wander.
        variance = 25e-8 * (
            np.exp(2 * weight @ np.log(scale)) + weight @ (grid.wander * scale) ** 2
        )
        std = np.sqrt(variance * prior / (variance + prior))
        np.testing.assert_allclose(found.ln_frequency_std, std, rtol=0.01)
        assert (found.drift == 0).all()
        assert found.events == ()
        assert found.consistency().holds


def test_a_history_without_estimates_is_refused(stage: Stage) -> None:
    """The error for a history without estimates states the number of logs."""
    with pytest.raises(NotEnoughData, match="no modal estimate in 5 logs"):
        track(make_history(np.full((5, 2), np.nan)), stage)


@pytest.mark.parametrize("field", ["drift", "drift_cov", "noise_scale", "nis", "widening"])
def test_tracks_of_wrong_shape_are_refused(field: str) -> None:
    """Every array of a track has as many epochs as there are logs."""
    followed = make_track(np.zeros((3, 2)), np.zeros((3, 2, 2)))
    with pytest.raises(ValueError, match=f"{field} has shape"):
        replace(followed, **{field: getattr(followed, field)[:2]})


def test_alarms_are_events_of_damage() -> None:
    """Only events of kind alarm are alarms."""
    followed = make_track(np.zeros((3, 1)), np.zeros((3, 1, 1)))
    events = tuple(
        Event(kind, 1, "roll", "", 0.1, 0.01, 9.0, False, 2) for kind in ("step", "alarm")
    )
    assert replace(followed, events=events).alarms == events[1:]


def white(rng: np.random.Generator, n: int = 200, rows: int = 4) -> np.ndarray:
    """Draw innovations of a consistent filter, with a few missing."""
    innovations = rng.standard_normal((n, rows))
    innovations[rng.random((n, rows)) < 0.1] = np.nan
    return innovations


def judged(innovations: np.ndarray) -> tuple[float, float]:
    """Return both p-values of independent innovations."""
    squares = np.nansum(innovations**2, axis=1)
    found = consistency(squares, np.isfinite(innovations).sum(axis=1).astype(float), innovations)
    least = [1e-3 if sign > 0 else 1e-6 for sign in (found.nis - 1, found.autocorrelation)]
    assert found.holds == (found.p_value >= least[0] and found.autocorrelation_p_value >= least[1])
    return found.p_value, found.autocorrelation_p_value


@pytest.mark.slow
def test_p_values_of_a_filter_that_is_right_are_uniform() -> None:
    """A tenth of each of the two p-values is below 0.1."""
    rng = np.random.default_rng(2)
    p = np.array([judged(white(rng)) for _ in range(1000)])
    for column in p.T:
        low, high = binomial_band(int((column < 0.1).sum()), column.size)
        assert low <= 0.1 <= high


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_innovations_of_wrong_size_are_not_consistent(factor: float) -> None:
    """Negative control: innovations that are too large or too small are rejected."""
    p, correlated = judged(factor * white(np.random.default_rng(3)))
    assert p < 1e-3 < correlated


def test_innovations_that_go_on_are_not_consistent() -> None:
    """Negative control: autocorrelated innovations are rejected."""
    innovations = white(np.random.default_rng(4))
    innovations[1:] = (innovations[1:] + 0.5 * innovations[:-1]) / np.sqrt(1.25)
    assert judged(innovations)[1] < 1e-3


def test_consistency_is_what_it_says() -> None:
    """NIS over degrees of freedom and lag-one autocorrelation equal values computed by hand."""
    innovations = np.array([[1.0, -2.0], [2.0, np.nan], [-1.0, 3.0]])
    found = consistency(np.array([5.0, 4.0, 10.0]), np.array([0.0, 1.0, 2.0]), innovations)
    assert found.nis == pytest.approx(14 / 3)
    assert found.p_value == pytest.approx(2 * stats.chi2.sf(14, 3))
    # Two products exist, 2 and -2; the third series' neighbours are missing.
    assert found.autocorrelation == 0
    assert found.autocorrelation_p_value == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("mean_square", "holds", "side"),
    [(1.0, True, "inside"), (0.57, True, "below"), (0.4, False, "below"), (1.4, True, "above"),
     (1.7, False, "above")],
)  # fmt: skip
def test_unusual_innovations_are_told_before_they_are_wrong(
    mean_square: float, holds: bool, side: str
) -> None:
    """NIS outside of its 95 % band has a side; far outside the filter is rejected."""
    n = 100
    found = consistency(np.full(n, mean_square), np.ones(n), np.full((n, 1), np.nan))
    assert (found.holds, found.side) == (holds, side)


def test_nothing_to_judge_is_consistent() -> None:
    """A filter with a single log is neither consistent nor inconsistent."""
    found = consistency(np.zeros(1), np.zeros(1), np.full((1, 2), np.nan))
    assert (found.nis, found.p_value, found.holds) == (1.0, 1.0, True)


@pytest.mark.slow
def test_a_machine_that_runs_in_and_wears_out_is_held(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither the first logs nor a rate of long ago make the last drift more certain than it is.

    Without settling, and without a rate that is new, half of the drifts are beyond 90 % intervals.
    """

    def held() -> float:
        return float(of_world("bathtub", 15, False)["drift_held"])

    now = held()
    monkeypatch.setattr(constants, "SETTLING", ((0.0, 1.0),))
    monkeypatch.setattr(constants, "BEGUN_GATE", inf)
    assert now > 0.7
    assert held() < now - 0.2
