"""Tests of effects: floor, hits, bumps, orders of balls and cage, friction of a condition."""

import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from models.dynamics.plant import NOISE_INPUTS
from models.dynamics.stages import NOMINAL, Condition, stage_named
from models.errors import BadParameter
from models.recordings.disturbances import orders
from models.recordings.effects import (
    FULL,
    LINEAR,
    Blows,
    Effects,
    Floor,
    FrictionParameters,
    changes,
    effects_named,
    friction_of,
    level_of_floor,
)
from models.recordings.recording import COLUMNS, record
from models.recordings.velocities import Experiment, drive_velocities

STAGE = stage_named("lms-y-full")
GROUND = [NOISE_INPUTS.index(f"ground_{axis}") for axis in "xyz"]


def changed(effects, position, seed=0):
    """Return what effects make of noise of ones (noise input, time)."""
    white = np.ones((len(NOISE_INPUTS), position.size))
    change = changes(STAGE, effects, position, np.random.default_rng(seed), 20000.0)
    assert change is not None
    change(0, white)
    return white


@pytest.mark.parametrize("floor", [Floor(), Floor(gusts_per_s=0.0), Floor(wander=0.0)])
def test_the_floor_keeps_its_mean_square(floor):
    """Over many logs the level's mean square is 1, within what gusts of random height leave."""
    rng = np.random.default_rng(1)
    squares = [np.mean(level_of_floor(floor, 60.0, rng)[1] ** 2) for _ in range(400)]
    error = np.std(squares) / 20
    # Heights are given by their median: their mean square is a little more.
    assert -4 * error < np.mean(squares) - 1 < 4 * error + (0.2 if floor.gusts_per_s else 0.0)


def test_the_floor_wanders_slowly_and_gusts_stand_out():
    """Wander stays within a second, gusts lift the level, without both it is 1."""
    rng = np.random.default_rng(2)
    time, calm = level_of_floor(Floor(gusts_per_s=0.0), 600.0, rng)
    logs = np.log(calm)
    assert np.std(logs) == pytest.approx(0.25, rel=0.35)
    assert np.std(np.diff(logs[::20])) < 0.5 * np.std(logs)
    _, gusty = level_of_floor(Floor(wander=0.0, gusts_per_s=0.05), 600.0, rng)
    lifted = gusty > 1.1 * np.median(gusty)
    assert 0.01 < lifted.mean() < 0.2
    assert gusty.max() > 2 * np.median(gusty)
    _, steady = level_of_floor(Floor(wander=0.0, gusts_per_s=0.0), 10.0, rng)
    np.testing.assert_allclose(steady, 1.0)
    assert time[1] == pytest.approx(0.05)


def test_the_floor_changes_the_ground_only():
    """Noise of the blocks stays; all directions of the ground change alike."""
    white = changed(Effects(floor=Floor()), np.zeros(40000))
    np.testing.assert_array_equal(white[GROUND[0]], white[GROUND[2]])
    assert np.ptp(white[GROUND[0]]) > 0
    assert np.all(np.delete(white, GROUND, axis=0) == 1.0)


def test_hits_come_at_random_and_chunks_join():
    """The count of hits is Poisson; a log in chunks has the hits of the whole."""
    blows = Effects(blows=Blows(bumps=(), hits_per_s=2.0))
    position, parts = np.zeros(400000), np.ones((len(NOISE_INPUTS), 400000))
    whole = changed(blows, position, seed=3)
    change = changes(STAGE, blows, position, np.random.default_rng(3), 20000.0)
    assert change is not None
    for start in range(0, 400000, 70000):
        change(start, parts[:, start : start + 70000])
    np.testing.assert_array_equal(whole, parts)
    struck = np.any(whole[GROUND] != 1.0, axis=0)
    begun = np.count_nonzero(np.diff(struck.astype(int)) == 1)
    assert 40 - 4 * math.sqrt(40) < begun < 40 + 4 * math.sqrt(40)
    assert np.all(changed(replace(blows, blows=Blows((), hits_per_s=0.0)), position) == 1.0)


def test_a_bump_stays_where_it_is():
    """Front and rear block of its rail feel it where they pass, the same there and back."""
    bumped = Effects(blows=Blows(bumps=((1, 0.02, 0.7),), hits_per_s=0.0))
    there = np.linspace(-0.1, 0.1, 200001)
    white, back = changed(bumped, there), changed(bumped, there[::-1])
    for i, (x, y) in enumerate([(0.07, 0.05), (0.07, -0.05), (-0.07, 0.05), (-0.07, -0.05)]):
        force = white[NOISE_INPUTS.index(f"block{i + 1}_z")] - 1.0
        if y > 0:
            assert not force.any()
        else:
            assert there[np.argmax(force)] == pytest.approx(0.02 - x, abs=2e-6)
            assert force.max() == pytest.approx(0.7, rel=1e-3)
            assert np.ptp(there[force > 0]) == pytest.approx(5e-4, rel=0.02)
    np.testing.assert_allclose(white, back[:, ::-1])


def test_orders_of_balls_and_cage():
    """Balls that roll at half of the velocity enter every 8 mm, the chain turns every 0.26 m."""
    plain, added = orders(STAGE), orders(STAGE, FULL)[len(orders(STAGE)) :]
    assert orders(STAGE, LINEAR) == plain
    assert {(o.name, round(o.wavelength, 6)) for o in added} == {
        ("ball entry", 0.008), ("cage", 0.26)
    }  # fmt: skip
    assert {name[-1] for o in added for name in o.inputs} == {"x", "z"}


def test_friction_follows_preload_temperature_and_grease():
    """Half the preload leaves the seals and 2^(-4/3) of the balls' part; warm oil is thinner."""
    law = FrictionParameters()
    coulomb, viscous = friction_of(STAGE, NOMINAL, law)
    assert 4 * coulomb == pytest.approx(STAGE.friction.value)
    worn, _ = friction_of(STAGE, Condition(guide_preload=0.5), law)
    assert worn / coulomb == pytest.approx(0.4 + 0.6 * 0.5 ** (4 / 3))
    warm = friction_of(STAGE, Condition(temperature_c=31.0, guide_damping=2.0), law)
    assert warm[0] == coulomb
    assert warm[1] / viscous == pytest.approx(2 * math.exp(-0.3))


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: FrictionParameters(scale=-1.0),
        lambda: FrictionParameters(first_slip=50e-6),
        lambda: FrictionParameters(stiction=0.9),
        lambda: FrictionParameters(lag=0.0),
        lambda: Floor(wander=math.nan),
        lambda: Blows(bumps=((2, 0.0, 1.0),)),
        lambda: effects_named("rich"),
    ],
)
def test_refuses_what_no_stage_has(wrong):
    """Negative and impossible numbers, rails that are not there, unknown names."""
    with pytest.raises(BadParameter):
        wrong()


@pytest.mark.slow
def test_effects_leave_the_rest_of_a_seed_alone():
    """The noise of a seed is the same with effects: gusts and hits have a stream of their own."""
    logs = [
        record(STAGE, seconds=0.5, rng=np.random.default_rng(5), effects=effects)
        for effects in (LINEAR, Effects(floor=Floor(wander=0.0, gusts_per_s=0.0)), FULL)
    ]
    assert all(tuple(log.columns) == COLUMNS for log in logs)
    for name in COLUMNS:
        np.testing.assert_allclose(
            logs[0].columns[name], logs[1].columns[name], rtol=1e-5, atol=1e-6
        )
    assert np.any(logs[0].columns["delta_e_um"] != logs[2].columns["delta_e_um"])


@pytest.mark.slow
def test_strokes_with_all_effects_are_written(tmp_path):
    """A stroke there and back with all effects: a log as any other, and its error is bounded."""
    experiment = Experiment(STAGE, strokes=2, seconds=1.0, effects=FULL)
    drive_velocities(experiment, tmp_path, "csv", velocities=(0.4,))
    (path,) = tmp_path.glob("velocity*")
    table = pd.read_csv(path, comment="#")
    assert 1.0 < np.abs(table["delta_e_um"]).max() < 200.0
