"""Tests of ``python -m models``."""

import json
import subprocess
import sys

import pandas as pd
import pytest
from click.testing import CliRunner

from models.__main__ import cli
from models.plant import GUIDE_MODES


def run(*arguments):
    """Return the finished process of a command line."""
    command = [sys.executable, "-m", "models", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_modes_as_json():
    """The JSON has the contract's keys and the calibrated roll frequency."""
    result = CliRunner().invoke(cli, ["modes", "lms-y", "--format", "json"])
    modes = {m["mode"]: m for m in json.loads(result.output)["modes"]}
    assert set(GUIDE_MODES) <= set(modes)
    assert modes["roll"]["frequency_hz"] == pytest.approx(126.4, abs=0.1)
    assert set(modes["roll"]) == {
        "mode",
        "frequency_hz",
        "damping_ratio",
        "direction",
        "participation",
        "strain_energy",
        "snr",
        "shape",
    }
    assert modes["granite_feed"]["snr"] is None
    assert modes["roll"]["snr"]["acc_pitch"] > 30
    assert set(modes["roll"]["participation"]) == {"delta_e", "acc_feed", "acc_pitch"}


def test_modes_agree_with_the_truth(tmp_path):
    """Asking `modes` for a log's true condition gives the frequencies of truth.csv."""
    arguments = ["simulate", "lms-y", "--life", "both", "--logs", "2", "--seconds", "0.2"]
    result = CliRunner().invoke(cli, [*arguments, "--out", str(tmp_path), "--workers", "1"])
    assert result.exit_code == 0
    row = pd.read_csv(tmp_path / "truth.csv").iloc[-1]
    arguments = ["modes", "lms-y", "--preload", str(row["guide_preload"]), "--format", "json"]
    arguments += ["--mount", str(row["mount_stiffness"])]
    result = CliRunner().invoke(cli, [*arguments, "--temperature", str(row["temperature_c"])])
    modes = {m["mode"]: m["frequency_hz"] for m in json.loads(result.output)["modes"]}
    for name in GUIDE_MODES:
        assert modes[name] == pytest.approx(row[f"{name}_hz"], rel=1e-9)


def test_map_has_its_columns(tmp_path):
    """The map holds the three guide modes over the grid."""
    out = tmp_path / "map.csv"
    assert CliRunner().invoke(cli, ["map", "lms-x", "--out", str(out)]).exit_code == 0
    table = pd.read_csv(out)
    assert list(table.columns) == ["guide_preload", "mount_stiffness", "mode", "frequency_hz"]
    assert set(table["mode"]) == set(GUIDE_MODES)


@pytest.mark.parametrize("command", ["modes", "map", "simulate"])
def test_help_has_an_example(command):
    """Each command's help ends with an example."""
    assert "Example: python -m models" in CliRunner().invoke(cli, [command, "--help"]).output


def test_errors_are_one_line_and_status_1():
    """A named error is one line on standard error."""
    done = run("modes", "lms-z")
    assert done.returncode == 1
    assert done.stderr == "error: unknown stage 'lms-z'; known: lms-x, lms-y\n"


def test_wrong_usage_is_status_2():
    """A missing option is wrong usage."""
    assert run("simulate", "lms-y").returncode == 2


def test_until_failure_needs_a_life_that_fails(tmp_path):
    """Following a healthy life to its failure is refused in one line before anything is made."""
    out = tmp_path / "life"
    arguments = ["simulate", "lms-y", "--life", "healthy", "--logs", "2", "--until", "failure"]
    done = run(*arguments, "--out", str(out))
    assert done.returncode == 1
    assert done.stderr == "error: until is failure; needed: now, as healthy crosses no limit\n"
    assert not out.exists()
