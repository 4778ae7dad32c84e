"""Tests of what acts on logs besides wear."""

from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pytest

from models.dynamics.plant import GUIDE_MODES, closed_loop_modes
from models.dynamics.stages import stage_named
from models.lives.circumstances import (
    IDEAL,
    Circumstances,
    Contact,
    circumstances_of,
    stage_at,
    wander_of,
)
from models.lives.degradation import HALL, Climate
from models.lives.drawing import draw_machine

SOFTENING = 0.01


def ln_f(stage):
    """Return ln f of roll, pitch and yaw."""
    found = {m.name: m.frequency_hz for m in closed_loop_modes(stage)}
    return np.log([found[name] for name in GUIDE_MODES])


def test_wander_has_its_size_and_correlation():
    """Standard deviations and the correlation over the stated travel are those asked for (5 σ)."""
    asked = Circumstances(wander_common=2e-3, wander_mode=5e-4, wander_km=100.0)
    travel = np.cumsum(np.random.default_rng(0).uniform(10.0, 90.0, 40000))
    common, own = wander_of(asked, travel, np.random.default_rng(1))
    assert common.std() == pytest.approx(2e-3, rel=0.05)
    np.testing.assert_allclose(own.std(axis=0), 5e-4, rtol=0.05)
    kept = np.exp(-np.diff(travel) / 100.0)
    # With irregular steps the product of neighbours over what is kept is one in the mean.
    assert np.mean(common[1:] * common[:-1]) / np.mean(kept * 4e-6) == pytest.approx(1, rel=0.06)
    assert abs(np.corrcoef(np.column_stack([common, own]).T) - np.eye(4)).max() < 0.06


def test_no_wander_is_none():
    """Ideal circumstances leave every log where it is."""
    common, own = wander_of(IDEAL, np.array([0.0, 5.0, 90.0]), np.random.default_rng(1))
    assert not common.any() and not own.any()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lms-x", "lms-y", "lms-y-full"])
def test_wander_moves_frequencies_by_itself(name):
    """Frequencies of the wandering stage are those of the other, times what was drawn."""
    stage = draw_machine(name, 5).stage
    wander = Contact(wander_common=8e-4, wander=(1e-3, -2e-3, 1.5e-3))
    moved = ln_f(stage_at(stage, wander, SOFTENING)) - ln_f(stage)
    # Compliance in series that does not wander takes a part of the common one in full stages.
    np.testing.assert_allclose(moved, 8e-4 + np.array(wander.wander), atol=4e-4)
    own = Contact(wander=wander.wander)
    moved = ln_f(stage_at(stage, own, SOFTENING)) - ln_f(stage)
    np.testing.assert_allclose(moved, wander.wander, atol=2e-5)


def test_level_softens_the_guide():
    """Twice the level costs the stated part of the stiffness, at every level; no other joint."""
    stage = stage_named("lms-y")
    for level in (0.5, 2.0, 4.0):
        own = stage_at(stage, Contact(level=level), SOFTENING)
        ratio = own.block_stiffness.value / stage.block_stiffness.value
        assert ratio == pytest.approx((1 - SOFTENING) ** np.log2(level), rel=1e-12)
        assert own.mount_stiffness.value == stage.mount_stiffness.value
    assert stage_at(stage, Contact(), SOFTENING) is stage


@pytest.mark.parametrize("lag_h", [0.5, 3.0, 8.0])
def test_structure_lags_by_first_order(lag_h):
    """The closed form is the solution of the equation of first order, integrated."""
    climate = Climate(21.5, 6.0, 3.0, 0.0)
    rng = np.random.default_rng(0)
    start, step_h = datetime(2026, 4, 1, tzinfo=UTC), 0.05
    structure = climate.mean_c
    apart = []
    for k in range(int(30 * 24 / step_h)):
        moment = start + timedelta(hours=k * step_h)
        structure += step_h / lag_h * (climate.at(moment, rng) - structure)
        if k * step_h > 10 * 24:
            later = moment + timedelta(hours=step_h)
            apart.append(structure - climate.behind(later, lag_h))
    # The season of `Climate` goes in whole days.
    assert np.abs(apart).max() < 0.12
    noiseless: Any = _NoNoise()
    assert HALL.behind(start, 1e-9) == pytest.approx(HALL.at(start, noiseless), abs=1e-6)


class _NoNoise:
    """A generator whose normal numbers are zero."""

    def standard_normal(self):
        """Return zero."""
        return 0.0


def test_own_circumstances_stand_above_those_of_the_machine():
    """What a life is about stays, the rest is the machine's."""
    life = Circumstances(closed_months=(1,), lag_h=5.0)
    machine = circumstances_of({"lag_h": 2.0, "wander_km": 30.0, "something else": 1.0})
    both = life.above(machine)
    assert (both.lag_h, both.wander_km, both.closed_months) == (5.0, 30.0, (1,))
