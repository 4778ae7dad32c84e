"""Changes are detected with kind, place and size; lives without changes have none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy import integrate, stats

from lmshealth._private.arrays import FloatArray
from lmshealth.stage.description import Stage
from lmshealth.tracking import constants
from lmshealth.tracking.filters import state_space
from lmshealth.tracking.filters.kalman_filters import restart
from lmshealth.tracking.filters.state_space import StateSpace
from lmshealth.tracking.filters.track_state import (
    ChangeHypothesis,
    add_to_sums,
    loop_evidence,
    recent_loop_change,
    threshold,
    unexplained_loop_changes,
    worst_window,
)
from lmshealth.tracking.history import History, Step
from lmshealth.tracking.track import Track, track
from tests.lives import DAMPING, FREQUENCY, make_stage, rough_history, seen_by, since
from tests.tracking.filters.test_kalman_filters import SETTINGS, one, run

N_LOGS, PLACE = 40, 22


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Two modes and a horizon of 20,000 km."""
    return make_stage(tmp_path_factory.mktemp("stage"))


def life(
    seed: int,
    *,
    jump: tuple[float, float] = (0.0, 0.0),
    source: str = "",
    loop: float = 1.0,
    sources: tuple[str, ...] = ("acc", "delta_e"),
) -> History:
    """Make a life of two modes with a step of ln f and ln ζ, of all sources or of one."""
    rng = np.random.default_rng(seed)
    level, damping = np.tile(np.log(FREQUENCY[:2]), (N_LOGS, 1)), np.log(DAMPING[:2])
    damping = np.tile(damping, (N_LOGS, 1))
    after = (np.arange(N_LOGS) >= PLACE)[:, None]
    if not source:
        level, damping = level + jump[0] * after, damping + jump[1] * after
    history = seen_by(rng, level, damping, sources=sources)
    own = np.array([one.source == source for one in history.series])
    error = 1e-6 * np.exp(0.05 * rng.standard_normal(N_LOGS))
    error[PLACE:] *= loop
    return replace(
        history,
        ln_frequency=history.ln_frequency + jump[0] * (after & own),
        ln_damping=history.ln_damping + jump[1] * (after & own),
        loop_error=error,
    )


def labels_of(found: Track) -> set[tuple[str, int, str]]:
    """Return kind, place and source of the detected steps, without alarms."""
    return {(e.kind, e.epoch, e.source) for e in found.events if e.kind != "alarm"}


HAPPENINGS: dict[str, dict[str, Any]] = {
    "step": {"jump": (-0.03, 0.0)},
    "regreasing": {"jump": (0.0, -0.5)},
    "servo": {"jump": (-0.012, 0.3), "loop": 1.4},
    "sensor": {"jump": (0.006, 0.1), "source": "delta_e"},
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", HAPPENINGS)
def test_what_happened_is_found_with_its_kind_place_and_size(stage: Stage, kind: str) -> None:
    """In 8 lives of each kind the change alone is detected, its size within 4 of its std.

    The sum of squares of the standardised errors is inside its 99.9 % band.
    """
    given = HAPPENINGS[kind]
    z = []
    for seed in range(8):
        found = track(life(seed, **given), stage)
        assert labels_of(found) == {(kind, PLACE, given.get("source", ""))}
        assert bool(found.alarms) <= (kind == "step")
        assert found.outliers == ()
        size = given["jump"][1 if kind == "regreasing" else 0]
        for event in found.events:
            if event.kind == kind:
                assert not event.declared
                assert PLACE < event.found_at <= PLACE + 3
                assert event.evidence >= threshold(1)
                z.append((event.size - size) / event.std)
    assert np.abs(z).max() < 4
    # Modes of one life are independent of one another.
    assert stats.chi2.ppf(5e-4, len(z)) < np.sum(np.square(z)) < stats.chi2.isf(5e-4, len(z))


@pytest.mark.slow
def test_a_step_is_damage_and_a_retuning_is_not(stage: Stage) -> None:
    """A step of the modes raises an alarm; a retuning and a regreasing do not."""
    alarms = {
        kind: sum(bool(track(life(seed, **given), stage).alarms) for seed in range(8))
        for kind, given in HAPPENINGS.items()
    }
    assert alarms.pop("step") >= 6
    assert set(alarms.values()) == {0}


@pytest.mark.slow
def test_the_same_jumps_without_the_loop_are_damage(stage: Stage) -> None:
    """Negative control: without a change of the following error the jumps raise alarms."""
    given = HAPPENINGS["servo"] | {"loop": 1.0}
    tracks = [track(life(seed, **given), stage) for seed in range(8)]
    assert not any(("servo", PLACE, "") in labels_of(found) for found in tracks)
    assert sum(bool(found.alarms) for found in tracks) >= 6


def test_a_declared_retuning_is_not_found_again(stage: Stage) -> None:
    """A declared step explains its jumps and its following error."""
    step = Step("servo", PLACE, np.arange(N_LOGS) >= PLACE, name="second")
    found = track(replace(life(3, **HAPPENINGS["servo"]), steps=(step,)), stage)
    assert {(e.kind, e.declared) for e in found.events} == {("servo", True)}
    std = np.sqrt(np.diag(found.drift_cov[-1]))
    assert (np.abs(found.drift[-1]) < 4 * std).all()


@pytest.mark.slow
def test_nothing_is_found_in_quiet_lives(stage: Stage) -> None:
    """Nothing is detected or taken for an outlier in 40 lives of two sources without changes."""
    for seed in range(100, 140):
        found = track(life(seed), stage)
        assert found.events == ()
        assert found.outliers == ()


@pytest.mark.slow
def test_two_steps_in_a_row_are_two_steps(stage: Stage) -> None:
    """A change soon after another is weighed relative to the state after the first one.

    Two steps three logs apart are both detected; a retuning, then a sensor, raise no alarm.
    """
    for seed in range(4):
        history = life(seed, jump=(-0.03, 0.0))
        later = (np.arange(N_LOGS) >= PLACE + 3)[:, None]
        found = track(replace(history, ln_frequency=history.ln_frequency - 0.04 * later), stage)
        assert labels_of(found) == {("step", PLACE, ""), ("step", PLACE + 3, "")}
        retuned = life(seed, **HAPPENINGS["servo"])
        moved = later * np.array([0, 0, 1, 1])
        found = track(replace(retuned, ln_frequency=retuned.ln_frequency + 0.006 * moved), stage)
        assert labels_of(found) == {("servo", PLACE, ""), ("sensor", PLACE + 3, "delta_e")}
        assert found.alarms == ()


def test_a_drift_that_begins_is_an_alarm(stage: Stage) -> None:
    """A mode that is constant and then falls by 3 % raises an alarm, with the drift as size."""
    rng = np.random.default_rng(30)
    level = np.tile(np.log(FREQUENCY[:2]), (N_LOGS, 1))
    level -= 0.03 * np.maximum(np.arange(N_LOGS) - PLACE, 0)[:, None] / (N_LOGS - PLACE)
    history = seen_by(rng, level, np.tile(np.log(DAMPING[:2]), (N_LOGS, 1)), sources=("acc",))
    found = track(history, stage)
    assert len(found.alarms) == 1
    alarm = found.alarms[0]
    assert PLACE < alarm.epoch == alarm.found_at < N_LOGS
    assert alarm.evidence >= threshold()
    i = found.modes.index(alarm.mode)
    assert alarm.size == pytest.approx(found.drift[alarm.epoch, i])


def suspect(sums: FloatArray, first: int, loop_changes: Sequence[int] = ()) -> int | None:
    """Return the log since which the following error, or else innovations, differ."""
    start, size = worst_window([*sums], first)
    by_loop = recent_loop_change(loop_changes, first, len(sums) - 2)
    return (start if size > constants.SUSPICION_GATE else None) if by_loop is None else by_loop


def sums_of(innovations: FloatArray) -> FloatArray:
    """Sum innovations ``(n_logs, n_rows)`` log by log."""
    sums = [np.zeros((2, innovations.shape[1] + 2))]
    for own in innovations:
        sums.append(add_to_sums(sums[-1], np.arange(own.size), own))
    return np.array(sums)


def test_windows_of_large_mean_innovations_are_suspected() -> None:
    """The suspected log is the first of the window with the largest mean."""
    innovations = 0.5 * np.array([1.0, -1.0]) * (-1.0) ** np.arange(20)[:, None]
    sums = sums_of(np.vstack([innovations, np.tile([0.0, 2.5], (4, 1))]))
    assert [suspect(sums[: k + 2], 1) for k in range(20)] == [None] * 20
    assert suspect(sums, 1) == 20
    assert suspect(sums_of(np.vstack([innovations, np.zeros((4, 2))])), 1) is None


def test_leaps_of_the_loop_are_suspected() -> None:
    """Two following errors in a row that differ from the dozen before are, with the second log.

    One alone is not, and neither is one that a step in the model explains.
    """
    rng = np.random.default_rng(34)
    error = 1e-6 * np.exp(0.05 * rng.standard_normal(30))
    lone = error.copy()
    lone[15] *= 1.5
    error[20:] *= 1.5
    leaps, sums = unexplained_loop_changes(error, ()), np.zeros((31, 2, 4))
    assert suspect(sums[:22], 1, leaps) is None
    assert suspect(sums[:23], 1, leaps) == 20
    assert 15 not in unexplained_loop_changes(lone, ())
    assert 20 not in unexplained_loop_changes(error, (since("servo", 20, 30),))


def test_windows_do_not_reach_before_the_segment() -> None:
    """A step explains the innovations before it."""
    sums = sums_of(np.tile([4.0, 0.0], (6, 1)))
    assert suspect(sums, 1) == 2
    assert suspect(sums, 4) == 4
    assert suspect(sums, 5) is None


def test_a_change_of_all_dampings_is_suspected_before_each_of_them() -> None:
    """Two dampings with a mean of 2.2 equal one with 3.1; one of them alone is not suspected."""
    for moved, suspected in (((0, 0, 1, 1), 10), ((0, 0, 1, 0), None)):
        innovations = np.zeros((12, 4))
        innovations[10:] = 2.2 * np.array(moved)
        assert suspect(sums_of(innovations), 1) == suspected


def student_bayes_factor(before: FloatArray, after: FloatArray) -> float:
    """Integrate the noncentral t of a difference of means over its prior of variance 100."""
    n, m = before.size, after.size
    dof, effective = n + m - 2, n * m / (n + m)
    pooled = (n * before.var() + m * after.var()) / dof
    t = (before.mean() - after.mean()) * np.sqrt(effective / pooled)

    def density(size: float) -> float:
        return float(stats.nct.pdf(t, dof, size * np.sqrt(effective)) * stats.norm.pdf(size, 0, 10))

    peak = t / np.sqrt(effective)
    edges = [peak - 20, peak - 3, peak, peak + 3, peak + 20]
    total = sum(integrate.quad(density, a, b, limit=200)[0] for a, b in pairwise(edges))
    return float(total / stats.t.pdf(t, dof))


@pytest.mark.parametrize("change", [0.0, 0.05, 0.2])
@pytest.mark.parametrize("kind", ["servo", "step"])
def test_evidence_of_the_loop_is_the_integral(change: float, kind: str) -> None:
    """The closed form equals a numerical integral over the size of the change, to 1e-6."""
    rng = np.random.default_rng(31)
    log_error = np.log(1e-6) + 0.05 * rng.standard_normal(20)
    log_error[8:] += change
    chance = 0.99 if kind == "servo" else 0.02
    changed = student_bayes_factor(log_error[:8], log_error[8:14])
    expected = np.log(chance * changed + 1 - chance)
    assert loop_evidence(np.exp(log_error), 8, 13, kind) == pytest.approx(expected, abs=1e-6)


def test_evidence_of_the_loop_needs_logs_on_both_sides() -> None:
    """Unknown following errors, or too few before the step, give no evidence."""
    error = np.full(20, 1e-6)
    assert loop_evidence(np.full(20, np.nan), 8, 13, "servo") is None
    assert loop_evidence(error, 2, 13, "servo") is None
    error[8:] = np.nan
    assert loop_evidence(error, 8, 13, "servo") is None
    # A loop that has not moved speaks against a retuning.
    still = loop_evidence(np.full(20, 1e-6), 8, 13, "servo")
    assert still is not None and still < -2


def test_a_segment_keeps_the_state_and_restarts_the_process_noise(stage: Stage) -> None:
    """Means, noise scales and wander are kept; rates and weights have their priors again."""
    kept = run(rough_history(np.random.default_rng(32), n=30), stage)
    old = kept[-1][0].pruned()
    space = StateSpace(rough_history(np.random.default_rng(32), n=30), stage)
    new = restart(space, old)
    healthy = new.hyperparameters.healthy
    assert new.weight.sum() == pytest.approx(1.0)
    # No part runs in but those of a new machine or after work on it: no evidence follows from that.
    assert (new.hyperparameters.rate_decay == 0).all()
    assert new.weight[healthy].sum() == pytest.approx(constants.HEALTHY_PROBABILITY)
    assert new.log_bayes_factor() == pytest.approx(0.0, abs=1e-9)
    for scale in np.unique(new.hyperparameters.scales):
        share = new.weight[new.hyperparameters.scales[:, 0] == scale].sum()
        before = old.weight[old.hyperparameters.scales[:, 0] == scale].sum()
        assert share == pytest.approx(before, abs=1e-9)
    for still in (True, False):
        group = healthy == still
        rest = np.setdiff1d(np.arange(space.size), np.arange(space.rate.start, space.rate.stop))
        for own in np.flatnonzero(group):
            disturbance = new.hyperparameters.disturbance[own]
            same = old.hyperparameters.disturbance == disturbance
            also = same & (old.hyperparameters.healthy == still)
            mean, cov = old[also if also.any() else same].collapse()
            np.testing.assert_allclose(new.mean[own, rest], mean[rest])
            part = np.ix_(rest, rest)
            np.testing.assert_allclose(new.cov[own][part], cov[part], atol=1e-18)
    rates = np.einsum("gii->gi", new.cov[:, space.rate, space.rate])
    assert (rates[healthy] == 0).all()
    assert (rates[~healthy] >= new.hyperparameters.rate_std[~healthy, None] ** 2).all()
    # The bank it came from is untouched.
    assert old.mean.shape[0] < new.mean.shape[0]


def test_one_setting_restarts_as_it_was(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a grid of one setting only the rate has its prior again."""
    grid = one(SETTINGS[0], ("acc",))
    history = rough_history(np.random.default_rng(33))
    monkeypatch.setattr(state_space, "hyperparameter_grid", lambda n: grid)
    space = StateSpace(history, stage)
    old = run(history, stage, grid)[-1][0]
    new = restart(space, old)
    np.testing.assert_allclose(new.mean, old.mean, rtol=1e-12, atol=1e-20)
    opened = np.zeros_like(old.cov)
    rate = np.arange(space.rate.start, space.rate.stop)
    alike = constants.RATE_COMMON + (1 - constants.RATE_COMMON) * np.eye(rate.size)
    opened[np.ix_(np.array([0]), rate, rate)] = SETTINGS[0].rate ** 2 * alike
    np.testing.assert_allclose(new.cov, old.cov + opened, atol=1e-16)
    assert new.log_evidence == pytest.approx(0.0, abs=1e-12)


def test_changes_are_significant_at_the_declared_probability() -> None:
    """The bound of an event is 1 in 100; an alarm divides it among its three routes."""
    assert threshold(1) == pytest.approx(np.log(100))
    assert threshold() == pytest.approx(np.log(300))
    likely = ChangeHypothesis("step", "", 3, np.log(200), 10.0)
    assert likely.significant and not likely.damage
    assert ChangeHypothesis("step", "", 3, 10.0, 10.0).damage
    assert not ChangeHypothesis("step", "", 3, 10.0, 1.0).damage
    assert not ChangeHypothesis("servo", "", 3, 10.0, 10.0).damage
    assert constants.FALSE_ALARM_PROBABILITY == 0.01
