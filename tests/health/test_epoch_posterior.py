"""The density of one epoch's posterior against the formula behind the map, and its fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lmshealth._private.arrays import FloatArray
from lmshealth.health.epoch_posterior import EpochPosterior
from lmshealth.stage.constants import MAP_ERRORS
from lmshealth.stage.description import Stage
from tests.lives import AXES, make_stage, true_drift
from tests.oracles import epoch_log_posterior

NAMES = ("guide_preload", "mount_stiffness")
TRUTH = np.log([0.75, 0.85])
COV = np.array([[1e-6, 4e-7], [4e-7, 2e-6]])


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Preload and mount seen by two modes."""
    return make_stage(tmp_path_factory.mktemp("stage"))


def book(x: FloatArray, stage_std: float = 0.05, drift: FloatArray | None = None) -> float:
    """Log posterior at one point by the formula behind the map, over the errors of the map."""
    alone = np.array([true_drift(NAMES, np.where(np.arange(2) == j, x, 0.0)) for j in range(2)])
    terms = [
        np.log(weight)
        + epoch_log_posterior(
            x,
            true_drift(NAMES, TRUTH)[:2] if drift is None else drift,
            COV,
            predicted=true_drift(NAMES, x)[:2],
            alone=alone[:, :2],
            model_std=scale * stage_std,
            medians=(1.0, 1.0),
            sigmas=(0.3, 0.3),
        )
        for scale, weight in MAP_ERRORS
    ]
    return float(np.logaddexp.reduce(terms))


def inside(n: int, seed: int = 1) -> FloatArray:
    """Draw ln parameters all over the map."""
    low, high = (np.log([AXES[name][k] for name in NAMES]) for k in (0, -1))
    return np.random.default_rng(seed).uniform(low, high, (n, 2))


@pytest.mark.parametrize("model_std", [0.0, 0.05, 0.2])
def test_log_posterior_is_the_textbook_one(tmp_path: Path, model_std: float) -> None:
    """Many points in one call equal one point at a time by the formula, map error included."""
    stage = make_stage(tmp_path, model_std=model_std)
    posterior = EpochPosterior.of(stage, ("roll", "pitch"), true_drift(NAMES, TRUTH)[:2], COV)
    x = inside(60)
    found = posterior.log_probability(x)
    known = np.array([book(point, model_std) for point in x])
    np.testing.assert_allclose(found - found[0], known - known[0], rtol=1e-9, atol=1e-7)


def test_outside_the_map_is_impossible_and_raises_nothing(stage: Stage) -> None:
    """Points outside have log probability minus infinity, points inside a finite one."""
    posterior = EpochPosterior.of(stage, ("roll", "pitch"), true_drift(NAMES, TRUTH)[:2], COV)
    x = np.array([[0.0, 0.0], [-9.0, 0.0], [0.0, 9.0], [-0.1, -0.1]])
    found = posterior.log_probability(x)
    assert np.isfinite(found).tolist() == [True, False, False, True]
    assert np.isneginf(found[1:3]).all()
    assert np.isneginf(posterior.log_probability(x[1:3])).all()


def test_drifts_of_one_parameter_alone(stage: Stage) -> None:
    """Drifts along points come first, then of each parameter with the other at baseline."""
    x = np.array([[-0.1, -0.2], [-0.3, -0.4]])
    stacked = [x, x * [1, 0], x * [0, 1]]
    known = [stage.drift(points, ("roll", "pitch")) for points in stacked]
    np.testing.assert_allclose(stage.drifts(x, ("roll", "pitch")), known, rtol=0, atol=1e-13)
    assert stage.drifts(x[:0], ("roll", "pitch")).shape == (3, 0, 2)
