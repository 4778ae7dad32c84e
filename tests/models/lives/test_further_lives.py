"""Tests of lives beyond the first ten, and of lives of drawn machines."""

import re
from dataclasses import asdict, replace

import h5py
import numpy as np
import pandas as pd
import pytest
from scipy.stats import kstest

from models.dynamics.plant import closed_loop_modes
from models.dynamics.stages import Condition
from models.errors import BadParameter
from models.lives.degradation import LIVES, Steady
from models.lives.drawing import CIRCUMSTANCES, draw_machine
from models.lives.further_lives import (
    ALL_LIVES,
    FURTHER_LIVES,
    MOUNT_FAMILIES,
    PRELOAD_FAMILIES,
    life_named,
)
from models.lives.simulation import Plan, _positions, _text_of, schedule, simulate_life
from models.lives.wear_families import Cycles, PowerLoss, Product, Settling, Shocks

# What of the condition each life changes, at the end of 8,000 km at the latest.
CHANGES = {
    "late-acceleration": {"guide_preload"},
    "bathtub": {"guide_preload"},
    "onset-linear": {"guide_preload"},
    "exponential-wear": {"guide_preload"},
    "random-shocks": {"guide_preload"},
    "loosening-in-jumps": {"mount_stiffness"},
    "backlash": {"guide_preload"},
    "running-in": {"guide_preload"},
    "stick-and-recover": {"guide_preload"},
    "lubrication-cycles": {"guide_damping"},
    "periodic-regreasing": {"guide_damping"},
    "wander": set(),
    "thermal-lag": set(),
    "amplitude-growth": set(),
    "sensor-drift": set(),
    "payload-not-logged": {"added_payload"},
    "missing-winters": set(),
}
HEALTHY = [
    name for name, changed in CHANGES.items() if not changed & {"guide_preload", "mount_stiffness"}
]
FAILING = ("late-acceleration", "bathtub", "onset-linear", "exponential-wear", "random-shocks")


def life(name, seed):
    """Return a life as the seed draws it."""
    return life_named(name, np.random.default_rng(seed))


def visits(name, logs=30, seed=3, **plan):
    """Return the schedule of a life of Y."""
    return schedule(Plan("lms-y", name, logs, 1.0, seed, **plan))


def test_names():
    """Fifteen lives and more are there besides the first ten, under their own names."""
    assert set(FURTHER_LIVES) == {*CHANGES, "drawn"}
    assert len(FURTHER_LIVES) >= 15
    assert not set(LIVES) & set(FURTHER_LIVES)
    assert all(life(name, 1).name == name for name in ALL_LIVES)


@pytest.mark.parametrize("name", sorted(CHANGES))
def test_a_life_changes_what_it_says_and_nothing_else(name):
    """Over 8,000 km exactly the stated parts of the condition leave commissioning."""
    new = asdict(Condition())
    for seed in range(5):
        own = life(name, seed)
        rows = [asdict(own.condition(s, 21.0)) for s in np.linspace(0.0, 8000.0, 161)]
        moved = {key for row in rows for key in row if row[key] != new[key]}
        assert moved == CHANGES[name]


@pytest.mark.parametrize("name", HEALTHY)
def test_healthy_lives_never_fail(name):
    """What only seems worn has no limit to cross."""
    assert life(name, 2).failure_km() is None


@pytest.mark.parametrize("name", FAILING)
def test_failing_lives_fail_at_their_limit(name):
    """At the failure the preload is at its limit, before it above."""
    for seed in range(5):
        own = life(name, seed)
        failure = own.failure_km()
        assert own.preload.at(failure) <= 0.6 < own.preload.at(0.999 * failure)


def test_shares_of_families():
    """Shares sum to one, and 2,000 drawn lives have them (4.5 σ)."""
    for families in (PRELOAD_FAMILIES, MOUNT_FAMILIES):
        assert sum(share for share, _ in families) == pytest.approx(1.0)
    drawn = [life("drawn", seed) for seed in range(2000)]
    for part, families in (("preload", PRELOAD_FAMILIES), ("mount", MOUNT_FAMILIES)):
        steady = np.mean([isinstance(getattr(own, part), Steady) for own in drawn])
        share = families[0][0]
        assert abs(steady - share) < 4.5 * np.sqrt(share * (1 - share) / len(drawn))
    # Control: not one family alone.
    assert len({type(own.preload) for own in drawn}) == 7


def test_winters_are_missing():
    """No log from December to February, though the life goes over two winters."""
    moments = [visit.recorded_at for visit in visits("missing-winters")]
    assert not {moment.month for moment in moments} & {12, 1, 2}
    assert (moments[-1] - moments[0]).days > 500
    assert moments == sorted(moments)


def test_greasings_are_declared_or_not(tmp_path):
    """Of the two lives one has its greasings in maintenance.csv; both have the same course."""
    plans = [Plan("lms-y", n, 2, 0.1, 3) for n in ("periodic-regreasing", "lubrication-cycles")]
    work = []
    for plan in plans:
        simulate_life(plan, tmp_path / plan.life)
        work.append(pd.read_csv(tmp_path / plan.life / "maintenance.csv"))
    lives = [plan.draw_life() for plan in plans]
    grease = lives[0].grease
    assert isinstance(grease, Cycles) and grease == lives[1].grease
    every, last = grease.every_km, schedule(plans[0])[-1].travel_km
    assert set(work[0]["action"]) == {"regrease"} and len(work[0]) == last // every
    assert work[1].empty


def test_the_payload_is_not_logged(tmp_path):
    """The platform carries other loads, and neither log nor manifest states it; truth does."""
    simulate_life(Plan("lms-y", "payload-not-logged", 3, 0.1, 3), tmp_path)
    truth = pd.read_csv(tmp_path / "truth.csv")
    assert truth["payload_kg"].nunique() > 1
    assert pd.read_csv(tmp_path / "manifest.csv")["payload_kg"].isna().all()
    with h5py.File(tmp_path / "log-0002.h5") as file:
        assert "payload_kg" not in file.attrs


def test_the_log_states_the_sensor(tmp_path):
    """A drifting sensor is in log and manifest, the truth beside it has the structure."""
    plan = Plan("lms-y", "sensor-drift", 3, 0.1, 3)
    simulate_life(plan, tmp_path)
    truth, manifest = (pd.read_csv(tmp_path / f"{n}.csv") for n in ("truth", "manifest"))
    drift = plan.draw_life().circumstances
    off = manifest["temperature_c"] - truth["temperature_c"]
    expected = drift.sensor_offset_k + drift.sensor_drift_k * truth["travel_km"] / 1000
    np.testing.assert_allclose(off, expected, atol=0.011)
    assert (truth["logged_temperature_c"] == manifest["temperature_c"]).all()
    with h5py.File(tmp_path / "log-0003.h5") as file:
        assert file.attrs["temperature_c"] == manifest["temperature_c"][2]


def test_the_level_grows_and_softens():
    """Levels scatter about a rising course, and the guide is softer where they are higher."""
    own = Plan("lms-y", "amplitude-growth", 200, 1.0, 3).draw_life()
    seen = visits("amplitude-growth", 200)
    levels = np.array([visit.contact.level for visit in seen])
    course = np.array([own.level.at(visit.travel_km) for visit in seen])
    assert course[0] < 1.01 and course[-1] > 1.5
    scatter = np.log(levels / course)
    assert scatter.std() == pytest.approx(own.circumstances.level_scatter, rel=0.25)
    assert abs(scatter.mean()) < 4.5 * scatter.std() / np.sqrt(200)
    stiffness = [visit.stage.block_stiffness.value for visit in seen]
    assert np.array_equal(np.argsort(levels), np.argsort(stiffness)[::-1])


@pytest.mark.slow
def test_a_higher_level_is_a_stronger_record(tmp_path):
    """Accelerations of a log follow the level that the truth states."""
    plan = Plan("lms-y", "amplitude-growth", 5, 2.0, 3)
    simulate_life(plan, tmp_path)
    truth = pd.read_csv(tmp_path / "truth.csv")
    rms = []
    for name in truth["file"]:
        with h5py.File(tmp_path / name) as file:
            rms.append(float(np.std(file["acc_pitch_m_s2"][:])))
    assert np.corrcoef(truth["excitation_level"], rms)[0, 1] > 0.95


def test_seed_and_plant_seed_are_independent():
    """A plant keeps its laws under another seed, which draws other logs; another plant does not."""
    first, again, other = (
        Plan("lms-y", "drawn", 5, 1.0, seed, plant_seed=plant)
        for seed, plant in ((1, 7), (2, 7), (1, 8))
    )
    assert first.draw_life() == again.draw_life() != other.draw_life()
    assert first.machine() is again.machine()
    assert [v.travel_km for v in schedule(first)] != [v.travel_km for v in schedule(again)]
    assert [v.travel_km for v in schedule(first)] == [v.travel_km for v in schedule(other)]
    assert schedule(first)[0].identity == "LMS-P7-Y"


def test_a_drawn_machine_has_all_circumstances():
    """Its life has every drawn circumstance; a nominal one of the same life has none."""
    plan = Plan("lms-y", "preload-wear", 5, 1.0, 1, plant_seed=9)
    drawn, numbers = plan.draw_life().circumstances, plan.machine().numbers
    for name in CIRCUMSTANCES:
        if not name.startswith("running_in"):
            assert getattr(drawn, name) == numbers[name]
    nominal = replace(plan, plant_seed=None)
    assert nominal.draw_life().circumstances == life("preload-wear", 1).circumstances
    assert nominal.machine().numbers == {}


def test_machines_run_in_unless_made_so():
    """About three in ten machines have no running-in, the others that of their numbers."""
    plans = [Plan("lms-y", "healthy", 5, 1.0, 1, plant_seed=seed) for seed in range(30)]
    for plan in plans:
        depth, law = plan.machine().numbers["running_in_depth"], plan.draw_life().preload
        if depth > 0:
            assert law == Product(
                Steady(), Settling(depth, plan.machine().numbers["running_in_km"])
            )
        else:
            assert isinstance(law, Steady)
    assert 3 <= sum(isinstance(plan.draw_life().preload, Steady) for plan in plans) <= 16


def test_truth_of_a_drawn_machine(tmp_path):
    """Frequencies are those of the drawn stage in its condition; all drawn numbers are stated."""
    plan = Plan("lms-y", "drawn", 3, 0.1, 4, plant_seed=11)
    simulate_life(plan, tmp_path)
    truth = pd.read_csv(tmp_path / "truth.csv")
    seen = schedule(plan)
    for row, visit in zip(truth.to_dict("records"), seen, strict=True):
        for mode in closed_loop_modes(visit.stage, visit.condition):
            assert row[f"{mode.name}_hz"] == pytest.approx(mode.frequency_hz, rel=1e-9)
        assert row["excitation_level"] == visit.contact.level
        assert row["wander_yaw"] == visit.contact.wander[2]
    for name, value in draw_machine("lms-y", 11).numbers.items():
        np.testing.assert_allclose(truth[f"plant_{name}"], value, rtol=1e-12)
    assert (truth["plant_seed"] == 11).all()
    own = plan.draw_life()
    for name in ("preload", "mount", "grease", "contact", "level"):
        assert re.fullmatch(r"[a-z][^'\"\[\]]*", truth[f"{name}_law"][0]), name
    cycles = own.grease
    assert isinstance(cycles, Cycles)
    assert truth["grease_law"][0] == (
        f"cycles(every_km={cycles.every_km:.6g}, aged={cycles.aged:.6g}, "
        f"scale_km={cycles.scale_km:.6g})"
    )


@pytest.mark.parametrize("effects", ["linear", "disturbed"])
def test_truth_states_the_effects(tmp_path, effects):
    """Of logs with and without effects the truth has the name."""
    simulate_life(Plan("lms-y", "healthy", 2, 0.1, 4, effects=effects), tmp_path)
    assert (pd.read_csv(tmp_path / "truth.csv")["effects"] == effects).all()


def test_text_of_laws():
    """A law reads as its family with its parameters; a product as both, events as a list."""
    law = Product(Shocks((1.0, 2.5), (0.9, 0.8)), Settling(0.05, 80.0))
    text = "shocks(at_km=1 2.5, left=0.9 0.8, floor=0.05) * settling(depth=0.05, scale_km=80)"
    assert _text_of(law) == text
    assert (
        _text_of(PowerLoss(3000.0, 4.0, 0.4)) == "power-loss(limit_km=3000, exponent=4, loss=0.4)"
    )
    assert _text_of(Steady()) == "steady"
    many = Shocks(tuple(np.arange(30.0)), (0.9,) * 30)
    assert "18 19 ..., left" in _text_of(many)


@pytest.mark.parametrize("plant_seed", [None, 3])
def test_full_stages_stand_anywhere_on_their_travel(tmp_path, plant_seed):
    """Positions are uniform within what the move leaves; log and truth have them, modes follow."""
    plan = Plan("lms-y-full", "healthy", 200, 20.0, 3, plant_seed=plant_seed)
    places = np.array(_positions(plan))
    assert np.abs(places).max() <= 42.5
    # Kolmogorov's distance that 1 of 100,000 samples of 200 exceeds.
    assert kstest(places, "uniform", (-42.5, 85.0)).pvalue > 1e-5
    assert np.abs(_positions(replace(plan, seconds=1.0))).max() > 90.0
    assert _positions(replace(plan, seconds=60.0)) == [0.0] * 200
    short = replace(plan, logs=2, seconds=0.1)
    simulate_life(short, tmp_path)
    truth = pd.read_csv(tmp_path / "truth.csv")
    assert truth["position_mm"].nunique() == 2
    for row, visit in zip(truth.to_dict("records"), schedule(short), strict=True):
        with h5py.File(tmp_path / row["file"]) as file:
            assert file.attrs["position_mm"] == row["position_mm"] == visit.condition.position_mm
        modes = closed_loop_modes(visit.stage, visit.condition)
        middle = closed_loop_modes(visit.stage, replace(visit.condition, position_mm=0.0))
        found, still = ({m.name: m.frequency_hz for m in own} for own in (modes, middle))
        assert row["pitch_hz"] == pytest.approx(found["pitch"], rel=1e-9)
        assert row["pitch_hz"] < still["pitch"]


def test_rigid_stages_stay_in_the_middle():
    """They are alike everywhere: their logs stay what they were, of drawn machines too."""
    for seed in (None, 3):
        seen = schedule(Plan("lms-y", "healthy", 5, 1.0, 3, plant_seed=seed))
        assert all(visit.condition.position_mm == 0.0 for visit in seen)


def test_negative_plant_seed_is_refused():
    """A seed is a count."""
    with pytest.raises(BadParameter, match="plant seed"):
        Plan("lms-y", "drawn", 3, 0.1, 4, plant_seed=-1)


@pytest.mark.slow
def test_drawn_machines_work_to_their_end():
    """Of 20 machines of either stage every mode has a name and decays, new, now and at the end."""
    for stage in ("lms-x", "lms-y"):
        for seed in range(20):
            plan = Plan(stage, "drawn", 3, 1.0, seed, plant_seed=seed)
            plan = replace(plan, until="failure") if plan.draw_life().failure_km() else plan
            for visit in schedule(plan):
                modes = closed_loop_modes(visit.stage, visit.condition)
                assert len({mode.name for mode in modes}) == 17
                assert min(mode.damping_ratio for mode in modes) > 0.004
