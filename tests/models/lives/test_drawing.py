"""Tests of drawn machines."""

from dataclasses import replace

import numpy as np
import pytest

from models.dynamics.plant import GUIDE_MODES, closed_loop_modes
from models.dynamics.stages import Condition, stage_named
from models.errors import BadParameter
from models.lives import drawing
from models.lives.drawing import (
    CIRCUMSTANCES,
    GEOMETRY_AND_JOINTS,
    WEAR,
    Distribution,
    draw_machine,
    draw_numbers,
)

STAGES = ("lms-x", "lms-y", "lms-x-full", "lms-y-full")


def ln_f(stage, **condition):
    """Return ln f of roll, pitch and yaw."""
    found = {m.name: m.frequency_hz for m in closed_loop_modes(stage, Condition(**condition))}
    return np.log([found[name] for name in GUIDE_MODES])


def generator_of(seed):
    """Return generators by name, as a plant seed makes them."""
    return drawing._streams("lms-y", seed, 0)


def test_without_a_seed_the_machine_is_the_nominal_one():
    """No seed, no drawing."""
    machine = draw_machine("lms-y", None)
    assert machine.stage is stage_named("lms-y")
    assert machine.numbers == {}


@pytest.mark.slow
@pytest.mark.parametrize("name", STAGES)
def test_a_seed_makes_one_machine(name):
    """The same seed gives the same machine, another seed another one, in every drawn number."""
    first, other = (draw_machine(name, seed) for seed in (1, 2))
    draw_machine.cache_clear()
    assert draw_machine(name, 1) == first
    for number in GEOMETRY_AND_JOINTS:
        drawn = [getattr(machine.stage, number) for machine in (first, other)]
        assert drawn[0].source == drawn[1].source == "drawn"
        assert drawn[0].value != drawn[1].value
    assert first.numbers.keys() == other.numbers.keys()
    assert (first.stage.flexible is None) == ("full" not in name)
    drawn_parts, parts = first.stage.flexible, stage_named(name).flexible
    if drawn_parts is not None and parts is not None:
        stiffness, known = (
            [part.stiffness.value for part in flexible.parts] for flexible in (drawn_parts, parts)
        )
        assert not np.any(np.isclose(stiffness, known, rtol=1e-6))


def test_numbers_follow_their_distributions():
    """Over 2,000 seeds logarithms of factors have the stated spread, ranges are kept (4.5 σ)."""
    table = GEOMETRY_AND_JOINTS | CIRCUMSTANCES | WEAR
    rng = np.random.default_rng(1)
    for name, entry in table.items():
        values = np.array([entry.draw(rng) for _ in range(2000)])
        tolerance = 4.5 / np.sqrt(2 * values.size)
        if entry.kind in ("factor", "lognormal"):
            logs = np.log(values / entry.a)
            assert logs.std() == pytest.approx(entry.b, rel=tolerance), name
            assert abs(logs.mean()) < 4.5 * entry.b / np.sqrt(values.size), name
        elif entry.kind in ("uniform", "loguniform"):
            low, high = np.sort([entry.a, entry.b])
            assert low <= values.min() and values.max() <= high, name
            assert values.min() < low + 0.02 * (high - low), name
        elif entry.kind == "shift":
            assert values.std() == pytest.approx(entry.b, rel=tolerance), name


def test_every_entry_states_a_source():
    """No number of the table is without a reason."""
    for entry in (GEOMETRY_AND_JOINTS | CIRCUMSTANCES | WEAR).values():
        assert entry.source


def test_a_new_entry_changes_no_other_number():
    """Every number has a stream of its own."""
    table = {"new": Distribution("uniform", 0.0, 1.0, "a test")} | CIRCUMSTANCES
    longer = draw_numbers(table, generator_of(4))
    del longer["new"]
    assert longer == draw_numbers(CIRCUMSTANCES, generator_of(4))


def test_unknown_kind_is_refused():
    """A distribution that does not exist is named."""
    with pytest.raises(BadParameter, match="triangular"):
        Distribution("triangular", 0.0, 1.0, "a test").draw(np.random.default_rng(0))


def test_machines_that_do_not_work_are_drawn_again(monkeypatch):
    """With absurd tolerances some machines are rejected, and what is delivered is stable."""
    absurd = {
        name: replace(entry, b=8 * entry.b) if entry.kind == "factor" else entry
        for name, entry in GEOMETRY_AND_JOINTS.items()
    }
    monkeypatch.setattr(drawing, "GEOMETRY_AND_JOINTS", absurd)
    draw_machine.cache_clear()
    machines = [draw_machine("lms-y", seed) for seed in range(12)]
    draw_machine.cache_clear()
    assert sum(machine.rejected for machine in machines) > 0
    for machine in machines:
        assert min(m.damping_ratio for m in closed_loop_modes(machine.stage)) > 0


@pytest.mark.slow
def test_the_map_is_wrong_by_what_manufacturing_does():
    """Over 60 machines the nominal's frequencies are off by some percent, its sensitivities too."""
    machines = [draw_machine("lms-y", seed) for seed in range(60)]
    nominal = stage_named("lms-y")
    off = np.array([ln_f(m.stage) - ln_f(nominal) for m in machines]).std(axis=0)
    assert np.all((off > 0.02) & (off < 0.09))

    def slopes(stage):
        new = ln_f(stage)
        worn = [ln_f(stage, guide_preload=0.7), ln_f(stage, mount_stiffness=0.7)]
        return np.array([new - one for one in worn])

    apart = np.array([slopes(m.stage) / slopes(nominal) - 1 for m in machines]).std(axis=0)
    assert np.all((apart > 0.04) & (apart < 0.4))
    assert sum(m.rejected for m in machines) <= 3
