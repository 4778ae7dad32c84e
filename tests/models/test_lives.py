"""Tests of simulated lives and their files."""

import itertools

import h5py
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from models.degradation import LIVES
from models.errors import BadParameter, UnknownFormat, UnknownLife
from models.lives import Plan, schedule, simulate_life
from models.plant import closed_loop_modes
from models.recording import COLUMNS
from models.stages import STAGES, Condition

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


@pytest.fixture(scope="module")
def life(tmp_path_factory):
    """Return the folder of a life of three short HDF5 logs."""
    folder = tmp_path_factory.mktemp("life")
    simulate_life(Plan("lms-y", "both", 3, 1.0, 4), folder)
    return folder


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
        modes = {m.name: m for m in closed_loop_modes(STAGES["lms-y"], condition)}
        for name in ("roll", "pitch", "yaw"):
            assert row[f"{name}_hz"] == pytest.approx(modes[name].frequency_hz, rel=1e-9)
            assert row[f"{name}_damping"] == pytest.approx(modes[name].damping_ratio, rel=1e-7)


def test_limits_in_truth(life):
    """Both limits of a life with both causes are finite and the same in every row."""
    truth = pd.read_csv(life / "truth.csv")
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


def test_now_does_not_tell_the_life():
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
    ],
)
def test_impossible_plan_is_refused(error, arguments):
    """A plan that cannot be simulated raises before a file is written."""
    with pytest.raises(error):
        Plan(*arguments)
