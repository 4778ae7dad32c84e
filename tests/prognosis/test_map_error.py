"""Errors of the modal map that a life shows."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from lmshealth.prognosis import constants
from lmshealth.prognosis.life_posterior import LifePosterior, fit_life
from lmshealth.prognosis.map_error import map_doubt, modes_off_map
from lmshealth.stage.description import Stage
from tests.lives import FREQUENCY, MODES, PRELOAD, make_history, make_stage, true_drift

TRAVEL = np.linspace(0.0, 2.5e6, 12)
SEED = np.random.SeedSequence(3)


@pytest.fixture(scope="module", autouse=True)
def small_grid() -> Iterator[None]:
    """Average over one walk, noise scale and deviation."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (("WALK_STDS", 1e-5), ("NOISE_SCALES", 1.0), ("DEVIATION_STDS", 0.0)):
            patch.setattr(constants, name, (value,))
        for name in ("NOISE_SCALE_PRIOR", "DEVIATION_PRIOR"):
            patch.setattr(constants, name, (1.0,))
        yield


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Wear of the preload, seen by three modes."""
    return make_stage(tmp_path_factory.mktemp("stage"), (PRELOAD,), n_modes=3)


def lived(stage: Stage, *, off: dict[int, float], life_m: float = 1.2e7) -> LifePosterior:
    """Fit a life in which modes drift by more than the map predicts, with errors of 3e-4."""
    x = 1.5 * np.log(1 - TRAVEL / life_m)[:, None]
    drift = true_drift(("guide_preload",), x)
    for k, size in off.items():
        drift[:, k] *= 1 + size
    noise = 3e-4 * np.random.default_rng(4).standard_normal(drift.shape)
    history = make_history(np.log(FREQUENCY) + drift + noise, travel=TRAVEL, std=3e-4)
    return fit_life(history, stage, 5, chains=False, n_draws=800)


@pytest.mark.parametrize(("k", "size"), [(0, 0.6), (1, -0.5), (2, 0.6)])
def test_the_mode_that_disagrees_is_named_with_its_size(stage: Stage, k: int, size: float) -> None:
    """One of three modes drifts by more, or less, than the others let the map predict."""
    first, *others = modes_off_map(lived(stage, off={k: size}), SEED)
    assert first.mode == MODES[k]
    assert first.probability > 0.9
    assert abs(first.size - size) < 3 * first.std
    assert 0.01 < first.std < 0.15
    assert len(others) == 2
    assert first.probability + sum(one.probability for one in others) == pytest.approx(1.0)


def test_an_exact_map_and_an_error_that_no_drift_shows_name_no_mode(stage: Stage) -> None:
    """Neither a right map, nor a wrong one of a machine that hardly wears, is doubted."""
    right = lived(stage, off={})
    assert map_doubt(right) < 0.25
    assert modes_off_map(right, SEED) == ()
    unseen = lived(stage, off={1: 0.5}, life_m=1e9)
    assert modes_off_map(unseen, SEED) == ()
    assert map_doubt(unseen) == pytest.approx(0.25, abs=0.1)
