"""Effects of covariates agree with the state space and with known truths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lmshealth.stage.description import Stage
from lmshealth.tracking.filters.state_space import StateSpace
from lmshealth.tracking.history import History
from lmshealth.tracking.track import (
    accepted_estimates,
    covariate_shifts,
    find_covariate_effects,
    smooth,
    track,
)
from tests.lives import FREQUENCY, PRELOAD, TWO, awkward_history, make_history, make_stage, since

SLOPE = np.array([-8e-4, 5e-4])


@pytest.fixture(scope="module")
def straight(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Two modes and temperature."""
    return make_stage(tmp_path_factory.mktemp("straight"), (PRELOAD,))


@pytest.fixture(scope="module")
def bent(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Two modes, temperature with a curvature, and payload."""
    return make_stage(tmp_path_factory.mktemp("bent"), (PRELOAD,), tail=TWO)


def warm(slope: np.ndarray = SLOPE, n: int = 60) -> History:
    """Make a life of two wearing modes that temperature moves by a slope."""
    rng = np.random.default_rng(7)
    temperature = 21 + 4 * rng.standard_normal(n)
    level = np.log(FREQUENCY[:2]) - 0.02 * np.linspace(0, 1, n)[:, None]
    ln_f = level + slope * (temperature[:, None] - 21) + 5e-4 * rng.standard_normal((n, 2))
    return make_history(ln_f, temperature=temperature, std=5e-4)


@pytest.mark.slow
def test_what_is_left_is_what_the_state_space_leaves(bent: Stage) -> None:
    """With two sources, two covariates and all steps, the residual is ln f - H x, exactly."""
    history = awkward_history(np.random.default_rng(3))
    followed = track(history, bent)
    taken = accepted_estimates(history, followed)
    space = StateSpace(taken, bent, taken.steps)
    state = np.zeros((len(history.logs), space.size))
    state[:, space.level] = smooth(taken, followed, bent).ln_frequency
    effects = {(e.mode, e.covariate): e.coefficient for e in followed.effects}
    for m, mode in enumerate(history.modes):
        for j, one in enumerate(space.regressed):
            state[:, space.regressor(j).start + m] = effects[mode, one.name]
        for j, step in enumerate(space.steps):
            if not step.changes_modes:
                name = f"{step.kind}:{step.name or step.source}"
                state[:, space.jump(j).start + m] = effects[mode, name]
    for j, i in enumerate(space.biased):
        series = history.series[i]
        state[:, space.first_bias + 2 * j] = effects[series.mode, f"bias:{series.source}"]
    r = len(history.series)
    seen = np.array([space.matrix(k)[:r] @ x for k, x in enumerate(state)])
    left = taken.ln_frequency - seen
    found = find_covariate_effects(history, followed, bent)
    assert [(one.covariate, one.mode) for one in found] == [
        (covariate, mode) for covariate in ("temperature_c", "payload_kg") for mode in history.modes
    ]
    for effect in found:
        at, covariate = history.columns(effect.mode), history.covariates[effect.covariate]
        there = np.isfinite(left[:, at]) & np.isfinite(covariate)[:, None]
        np.testing.assert_allclose(effect.corrected, left[:, at][there], atol=1e-12)
        np.testing.assert_array_equal(effect.epochs, np.nonzero(there)[0])


def test_a_known_slope_is_found_and_taken_out(straight: Stage) -> None:
    """Effects are within four standard deviations of the truth; residuals are noise only.

    The slopes scatter the logs by 3.2 and 2.0 per mille, noise by 0.5, of which the level takes
    its part.
    """
    history = warm()
    for one, slope in zip(
        find_covariate_effects(history, track(history, straight), straight), SLOPE, strict=True
    ):
        effect = one.effects[0]
        assert abs(effect.coefficient - slope) < 4 * effect.std
        assert one.seen
        assert one.measured.std() > 3 * one.corrected.std()
        assert one.corrected.std() < 5e-4


def test_a_covariate_that_does_nothing_takes_nothing_out(straight: Stage) -> None:
    """Without an effect, coefficients are about zero and no scatter is removed."""
    history = warm(np.zeros(2))
    for one in find_covariate_effects(history, track(history, straight), straight):
        assert abs(one.effects[0].coefficient) < 4 * one.effects[0].std
        assert one.explained(one.values).std() < 2e-4


def test_two_retunings_of_one_name_have_a_size_each(straight: Stage) -> None:
    """Residuals are free of both, as they are with two names."""
    history, scatter = warm(), []
    n, at = len(history.logs), (10, 20)
    jumps = 0.01 * (np.arange(n) >= at[0]) - 0.015 * (np.arange(n) >= at[1])
    moved = replace(history, ln_frequency=history.ln_frequency + jumps[:, None])
    for names in (("a", "b"), ("a", "a")):
        steps = tuple(since("servo", k, n, name=own) for k, own in zip(at, names, strict=True))
        own = replace(moved, steps=steps)
        one = find_covariate_effects(own, track(own, straight), straight)[0]
        scatter.append(one.corrected.std())
    assert scatter[1] == pytest.approx(scatter[0])


def test_an_effect_is_seen_beyond_two_standard_deviations(straight: Stage) -> None:
    """One significant coefficient of two is sufficient."""
    one = find_covariate_effects(warm(), track(warm(), straight), straight)[0]
    faint, clear = (replace(one.effects[0], coefficient=c, std=1.0) for c in (-1.9, -2.1))
    assert not replace(one, effects=(faint, faint)).seen
    assert replace(one, effects=(faint, clear)).seen


def test_line_and_band_are_those_of_the_effects(straight: Stage, bent: Stage) -> None:
    """The change is zero at the reference; it has a band if linear, none with a curvature."""
    history = warm()
    values = np.array([19.0, 21.0, 25.0])
    one = find_covariate_effects(history, track(history, straight), straight)[0]
    effect = one.effects[0]
    np.testing.assert_allclose(one.explained(values), effect.coefficient * (values - 21))
    std = one.explained_std(values)
    assert std is not None
    np.testing.assert_allclose(std, effect.std * np.array([2.0, 0.0, 4.0]))
    one = find_covariate_effects(history, track(history, bent), bent)[0]
    linear, square = (e.coefficient for e in one.effects)
    np.testing.assert_allclose(
        one.explained(values), linear * (values - 21) + square * (values - 21) ** 2
    )
    assert one.explained_std(values) is None


@pytest.mark.slow
def test_shifts_are_the_sum_of_what_covariates_explain(bent: Stage) -> None:
    """The sum of all covariates is the change of ln f, where they are known."""
    history = awkward_history(np.random.default_rng(4))
    followed = track(history, bent)
    moved = covariate_shifts(history, followed, bent)
    total = np.zeros_like(moved)
    for one in find_covariate_effects(history, followed, bent):
        values = history.covariates[one.covariate]
        total[:, history.modes.index(one.mode)] += one.explained(values)
    known = np.isfinite(total)
    assert known.sum() > 20
    np.testing.assert_allclose(moved[known], total[known], atol=1e-15)


def test_without_covariates_there_is_nothing_to_take_out(straight: Stage) -> None:
    """A covariate that is unknown, or never leaves its reference, has no effect."""
    history = warm()
    still = replace(history, covariates={"temperature_c": np.full(len(history.logs), 21.0)})
    for quiet in (replace(history, covariates={}), still):
        followed = track(quiet, straight)
        assert find_covariate_effects(quiet, followed, straight) == ()
        assert not covariate_shifts(quiet, followed, straight).any()
