"""Tests of simulated lives and their files."""

import itertools
from dataclasses import replace

import h5py
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from models.dynamics.plant import closed_loop_modes
from models.dynamics.stages import STAGES, Condition
from models.errors import BadParameter, OccupiedFolder, UnknownFault, UnknownFormat, UnknownLife
from models.lives.degradation import LIVES
from models.lives.simulation import Plan, schedule, simulate_life
from models.recordings.recording import COLUMNS

KEYS = {
    "stage",
    "recorded_at",
    "travel_km",
    "sample_rate_hz",
    "temperature_c",
    "payload_kg",
    "position_mm",
    "servo_id",
}


def assert_modes(row, stage, condition):
    """Assert that a row of the truth has every closed-loop mode of a condition, and no other."""
    modes = {m.name: m for m in closed_loop_modes(stage, condition)}
    assert {key[:-3] for key in row if key.endswith("_hz")} == set(modes)
    for name, mode in modes.items():
        assert row[f"{name}_hz"] == pytest.approx(mode.frequency_hz, rel=1e-9)
        assert row[f"{name}_damping"] == pytest.approx(mode.damping_ratio, rel=1e-7)


@pytest.fixture(scope="module")
def life(tmp_path_factory):
    """Return the folder of a life of three short HDF5 logs."""
    folder = tmp_path_factory.mktemp("life")
    simulate_life(Plan("lms-y", "both", 3, 1.0, 4), folder)
    return folder


@pytest.mark.slow
def test_folder_is_complete(life):
    """Logs, manifest, maintenance and truth are there and nothing else."""
    names = sorted(p.name for p in life.iterdir())
    assert names == [
        "log-0001.h5",
        "log-0002.h5",
        "log-0003.h5",
        "maintenance.csv",
        "manifest.csv",
        "truth.csv",
    ]
    assert (life / "maintenance.csv").read_text() == "stage,recorded_at,travel_km,action\n"


def test_truth_is_what_the_plant_says(life):
    """Frequencies in truth.csv are the closed-loop modes of the stated condition."""
    truth = pd.read_csv(life / "truth.csv")
    for row in truth.to_dict("records"):
        condition = Condition(row["guide_preload"], row["mount_stiffness"], row["temperature_c"])
        assert_modes(row, STAGES["lms-y"], condition)


def test_limits_in_truth(life):
    """Both limits of a life with both causes are finite, the first of them is its failure."""
    truth = pd.read_csv(life / "truth.csv")
    limits = truth[["guide_preload_limit_km", "mount_stiffness_limit_km"]]
    assert (truth["failure_km"] == limits.min(axis=1)).all()
    for column in ("guide_preload_limit_km", "mount_stiffness_limit_km"):
        assert truth[column].nunique() == 1
        assert truth[column].iloc[0] > 100


@pytest.mark.parametrize("file_format", ["csv", "parquet", "hdf5"])
def test_formats_hold_the_same(tmp_path, file_format):
    """Every format gives back the columns and the metadata."""
    simulate_life(Plan("lms-x", "healthy", 1, 0.2, 0, file_format), tmp_path)
    path = next(tmp_path.glob("log-*"))
    if file_format == "csv":
        lines = path.read_text().splitlines()
        metadata = dict(line[2:].split(": ", 1) for line in lines if line.startswith("#"))
        table = pd.read_csv(path, comment="#", dtype="float32")
    elif file_format == "parquet":
        stored = pq.read_table(path)
        metadata = {k.decode(): v.decode() for k, v in stored.schema.metadata.items()}
        table = stored.to_pandas()
    else:
        with h5py.File(path) as file:
            metadata = dict(file.attrs)
            table = pd.DataFrame({name: file[name][:] for name in file})[list(COLUMNS)]
    assert tuple(table.columns) == COLUMNS
    assert set(metadata) == KEYS
    assert metadata["stage"] == "LMS-0-X"
    assert float(metadata["sample_rate_hz"]) == 20000.0
    reference = Plan("lms-x", "healthy", 1, 0.2, 0)
    again = tmp_path / "again"
    simulate_life(reference, again)
    with h5py.File(again / "log-0001.h5") as file:
        for name in COLUMNS:
            np.testing.assert_array_equal(table[name].to_numpy(), file[name][:])


@pytest.mark.slow
def test_files_do_not_depend_on_workers(tmp_path):
    """One process and two write the same bytes."""
    plan = Plan("lms-y", "preload-wear", 2, 0.5, 9)
    folders = [tmp_path / str(workers) for workers in (1, 2)]
    for workers, folder in zip((1, 2), folders, strict=True):
        simulate_life(plan, folder, workers=workers)
    for path in folders[0].iterdir():
        assert path.read_bytes() == (folders[1] / path.name).read_bytes()


def test_schedule_runs_forward():
    """Time and odometer rise, from nothing to 1400..2000 km."""
    for seed in range(20):
        visits = schedule(Plan("lms-y", "both", 40, 1.0, seed))
        travel = np.array([v.travel_km for v in visits])
        assert np.all(np.diff(travel) > 0)
        assert all(a.recorded_at < b.recorded_at for a, b in itertools.pairwise(visits))
        assert travel[0] < 5
        assert 1400 <= travel[-1] <= 2000


def test_many_logs_run_forward():
    """The second of thousands of logs is not before the first."""
    travel = [visit.travel_km for visit in schedule(Plan("lms-y", "both", 3000, 1.0, 0))]
    assert np.all(np.diff(travel) > 0)


def test_now_does_not_depend_on_the_life():
    """Every life of a seed has the same odometer readings."""
    readings = {
        tuple(v.travel_km for v in schedule(Plan("lms-y", name, 10, 1.0, 3))) for name in LIVES
    }
    assert len(readings) == 1


def test_healthy_life_stays_new():
    """A healthy life keeps its preload and mount, its limits are never crossed."""
    plan = Plan("lms-x", "healthy", 5, 1.0, 1)
    assert {v.condition.guide_preload for v in schedule(plan)} == {1.0}
    assert plan.draw_life().preload.reaches_km(0.6) is None


@pytest.mark.parametrize(
    ("error", "arguments"),
    [
        (UnknownLife, ("lms-y", "eternal", 1, 1.0, 0)),
        (UnknownFormat, ("lms-y", "both", 1, 1.0, 0, "docx")),
        (BadParameter, ("lms-y", "both", 0, 1.0, 0)),
        (BadParameter, ("lms-y", "both", 1, -1.0, 0)),
        (BadParameter, ("lms-y", "both", 1, 1.0, -1)),
        (BadParameter, ("lms-y", "both", 1, 1.0, 0, "csv", "tomorrow")),
        (BadParameter, ("lms-y", "servo-retuning", 2, 1.0, 0, "csv", "failure")),
        (BadParameter, ("lms-y", "both", 1, 1e-5, 0)),
        (BadParameter, ("lms-y", "both", 1, float("nan"), 0)),
    ],
)
def test_impossible_plan_is_refused(error, arguments):
    """A plan that cannot be simulated raises before a file is written."""
    with pytest.raises(error):
        Plan(*arguments)


STEPS = {"regreasing": "regrease", "servo-retuning": "servo"}


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(LIVES))
def test_every_life_is_written_with_its_truth(tmp_path, name):
    """Truth is the modes of its condition; logs, manifest and maintenance agree with it."""
    simulate_life(Plan("lms-y", name, 3, 2.0, 6), tmp_path)
    truth = pd.read_csv(tmp_path / "truth.csv")
    manifest = pd.read_csv(tmp_path / "manifest.csv")
    stage = STAGES["lms-y"]
    for row in truth.to_dict("records"):
        condition = Condition(
            guide_preload=row["guide_preload"],
            mount_stiffness=row["mount_stiffness"],
            temperature_c=row["temperature_c"],
            added_payload=row["payload_kg"] - stage.payload.value,
            guide_damping=row["guide_damping_factor"],
            servo_id=row["servo_id"],
        )
        assert_modes(row, stage, condition)
        with h5py.File(tmp_path / row["file"]) as file:
            for key in ("payload_kg", "servo_id", "temperature_c", "travel_km", "recorded_at"):
                assert file.attrs[key] == row[key]
    shared = [c for c in manifest.columns if c in truth.columns]
    assert {"file", "payload_kg", "servo_id"} <= set(shared)
    pd.testing.assert_frame_equal(manifest[shared], truth[shared])
    damaged = name in ("preload-wear", "mount-loosening", "both", "crash", "sudden-loosening")
    assert truth["failure_km"].notna().all() == damaged
    assert truth["failure_km"].isna().all() != damaged
    check_maintenance(pd.read_csv(tmp_path / "maintenance.csv"), truth, name)


def check_maintenance(work, truth, name):
    """Assert that maintenance has the life's one action, between the logs that it parts."""
    assert list(work["action"]) == ([STEPS[name]] if name in STEPS else [])
    for row in work.to_dict("records"):
        earlier = truth["travel_km"] < row["travel_km"]
        assert 0 < earlier.sum() < len(truth)
        assert truth["recorded_at"][earlier].max() < row["recorded_at"]
        assert truth["recorded_at"][~earlier].min() >= row["recorded_at"]
        if name == "servo-retuning":
            assert set(truth["servo_id"][earlier]) == {"commissioning"}
            assert set(truth["servo_id"][~earlier]) == {"retuned"}


@pytest.mark.slow
def test_conditions_reach_the_workers(tmp_path):
    """The tuning is the same whether a log is made here or in another process."""
    plan = Plan("lms-x", "servo-retuning", 3, 0.5, 2)
    folders = [tmp_path / str(workers) for workers in (1, 2)]
    for workers, folder in zip((1, 2), folders, strict=True):
        simulate_life(plan, folder, workers=workers)
    for path in folders[0].iterdir():
        assert path.read_bytes() == (folders[1] / path.name).read_bytes()


@pytest.mark.parametrize("name", ["preload-wear", "mount-loosening", "both", "crash"])
def test_a_life_followed_to_its_failure_passes_it(name):
    """The laws are those of the life until now; the last logs are past the first limit crossed."""
    now, whole = (Plan("lms-y", name, 40, 1.0, 8, until=until) for until in ("now", "failure"))
    assert whole.draw_life() == now.draw_life()
    failure = whole.draw_life().failure_km()
    assert failure is not None
    passed = [
        v.condition.guide_preload <= 0.6 or v.condition.mount_stiffness <= 0.7
        for v in schedule(whole)
    ]
    assert passed == [v.travel_km >= failure for v in schedule(whole)]
    assert passed[-1] and not passed[0]
    assert schedule(now)[-1].travel_km <= 2000


def test_a_life_until_its_failure_needs_two_logs():
    """One log alone stands at the beginning: it is refused, of two the last is past the failure."""
    with pytest.raises(BadParameter, match="logs is 1; needed: at least 2"):
        Plan("lms-y", "both", 1, 1.0, 0, until="failure")
    plan = Plan("lms-y", "both", 2, 1.0, 0, until="failure")
    failure = plan.draw_life().failure_km()
    assert failure is not None and schedule(plan)[-1].travel_km > failure


@pytest.mark.parametrize("changed", [{"logs": 1}, {"file_format": "csv"}])
def test_logs_of_another_plan_are_not_left_behind(tmp_path, changed):
    """Logs that would stay next to a new manifest are refused; the same plan runs again."""
    plan = Plan("lms-y", "healthy", 2, 0.1, 0)
    simulate_life(plan, tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(OccupiedFolder, match=r"holds log-000\d\.h5.* needed: another folder"):
        simulate_life(replace(plan, **changed), tmp_path)
    simulate_life(plan, tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_work_still_to_come_is_not_in_maintenance(tmp_path):
    """A life of one log has not been retuned yet."""
    simulate_life(Plan("lms-y", "servo-retuning", 1, 0.2, 0), tmp_path)
    assert (tmp_path / "maintenance.csv").read_text() == "stage,recorded_at,travel_km,action\n"


@pytest.mark.slow
def test_faults_strike_a_tenth_of_the_logs_and_stand_in_the_truth(tmp_path):
    """Struck logs differ from their clean twins, the others do not, and the truth lists them."""
    clean = Plan("lms-y", "healthy", 12, 0.5, 3)
    faulty = replace(clean, faults=("dead-channel", "mains-hum"))
    simulate_life(clean, tmp_path / "clean")
    simulate_life(faulty, tmp_path / "faulty")
    truth = pd.read_csv(tmp_path / "faulty" / "truth.csv", keep_default_na=False)
    assert sum("dead-channel" in names for names in truth["faults"]) == 1
    assert sum("mains-hum" in names for names in truth["faults"]) == 1
    for row in truth.itertuples():
        with (
            h5py.File(tmp_path / "clean" / row.file) as first,
            h5py.File(tmp_path / "faulty" / row.file) as second,
        ):
            same = np.array_equal(first["acc_pitch_m_s2"], second["acc_pitch_m_s2"])
        assert same == (row.faults == "")


def test_unknown_fault_is_refused_before_any_file():
    """A fault that does not exist lists those that do."""
    with pytest.raises(UnknownFault, match="mains-hum"):
        Plan("lms-y", "healthy", 2, 1.0, 0, faults=("gremlins",))
