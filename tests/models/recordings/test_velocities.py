"""Tests of the paper's velocity experiment."""

import h5py
import numpy as np
import pandas as pd
import pytest

from models.dynamics.stages import STAGES
from models.errors import BadParameter, OccupiedFolder
from models.recordings.strokes import VELOCITIES
from models.recordings.velocities import Experiment, drive_velocities

EXPERIMENT = Experiment(STAGES["lms-x"], seconds=0.5, seed=5)


@pytest.mark.slow
def test_every_velocity_of_the_paper_gets_a_log(tmp_path):
    """Seven logs, their velocities in the manifest, in the metadata and in the set point."""
    drive_velocities(EXPERIMENT, tmp_path, "hdf5")
    manifest = pd.read_csv(tmp_path / "manifest.csv")
    np.testing.assert_allclose(manifest["velocity_mm_s"], 1e3 * np.array(VELOCITIES))
    assert manifest["travel_km"].is_monotonic_increasing
    for row in manifest.itertuples():
        with h5py.File(tmp_path / row.file) as file:
            assert file.attrs["velocity_mm_s"] == row.velocity_mm_s
            assert file.attrs["stage"] == row.stage == "LMS-5-X"
            highest = np.max(file["reference_velocity_mm_s"])
            assert highest == pytest.approx(row.velocity_mm_s, rel=1e-6)


def test_a_log_does_not_depend_on_its_neighbours(tmp_path):
    """Driven alone or with others, a velocity gives the same signals."""
    both = tmp_path / "both"
    drive_velocities(EXPERIMENT, both, "hdf5", velocities=(0.005, 0.1))
    drive_velocities(EXPERIMENT, tmp_path / "alone", "hdf5", velocities=(0.1,))
    name = "velocity-0100.000.h5"
    with h5py.File(both / name) as first, h5py.File(tmp_path / "alone" / name) as second:
        np.testing.assert_array_equal(first["delta_e_um"], second["delta_e_um"])


def test_several_strokes_go_there_and_back(tmp_path):
    """Two strokes within the window show both directions."""
    experiment = Experiment(STAGES["lms-x"], strokes=2, seconds=2.5)
    drive_velocities(experiment, tmp_path, "hdf5", velocities=(0.4,))
    with h5py.File(tmp_path / "velocity-0400.000.h5") as file:
        speed = file["reference_velocity_mm_s"][:]
    assert speed.max() == pytest.approx(400) and speed.min() == pytest.approx(-400)


def test_impossible_velocities_are_refused_before_any_file(tmp_path):
    """A velocity that the stroke cannot reach names itself and leaves no folder."""
    with pytest.raises(BadParameter, match="stroke"):
        drive_velocities(EXPERIMENT, tmp_path / "out", "hdf5", velocities=(0.1, 2.0))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("seconds", [0.0, 0.0099, 600.1, float("nan"), float("inf")])
def test_windows_that_no_log_can_have_are_refused(seconds):
    """Nothing, ever, and what is no number are refused with the experiment."""
    with pytest.raises(BadParameter, match=r"seconds is .*; needed: 0\.01 to 600 s"):
        Experiment(STAGES["lms-x"], seconds=seconds)


@pytest.mark.parametrize("second", [0.01, 0.0100004])
def test_velocities_that_would_share_a_file_are_refused(tmp_path, second):
    """Twice the same, or the same to the file name's digits, leaves no folder."""
    with pytest.raises(BadParameter, match="10 mm/s, more than once"):
        drive_velocities(EXPERIMENT, tmp_path / "out", "hdf5", velocities=(0.01, 0.1, second))
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_logs_of_other_velocities_are_not_left_behind(tmp_path):
    """Fewer velocities in the same folder are refused, the same ones are driven again."""
    drive_velocities(EXPERIMENT, tmp_path, "hdf5", velocities=(0.01, 0.1))
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(OccupiedFolder, match=r"velocity-0010\.000\.h5"):
        drive_velocities(EXPERIMENT, tmp_path, "hdf5", velocities=(0.1,))
    drive_velocities(EXPERIMENT, tmp_path, "hdf5", velocities=(0.01, 0.1))
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
