"""Tests of ``python -m models``."""

import json
import subprocess
import sys

import pandas as pd
import pytest
from click.testing import CliRunner

from models.__main__ import cli, main
from models.dynamics.plant import GUIDE_MODES


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


def test_a_plant_seed_draws_the_machine(tmp_path):
    """Truth names the seed; two seeds are two machines, without one there are no drawn columns."""
    common = ["simulate", "lms-y", "--life", "drawn", "--logs", "2", "--seconds", "0.1"]
    tables = []
    for name, more in (("1", ["--plant-seed", "1"]), ("2", ["--plant-seed", "2"]), ("none", [])):
        out = tmp_path / name
        result = CliRunner().invoke(cli, [*common, *more, "--out", str(out), "--workers", "1"])
        assert result.exit_code == 0
        tables.append(pd.read_csv(out / "truth.csv"))
    first, second, nominal = tables
    assert set(first["plant_seed"]) == {1} and set(second["plant_seed"]) == {2}
    assert first["plant_block_stiffness"][0] != second["plant_block_stiffness"][0]
    assert not [column for column in nominal if str(column).startswith("plant_")]
    for option in ("--plant-seed", "--seed"):
        wrong = CliRunner().invoke(cli, [*common, option, "-1", "--out", str(tmp_path / "x")])
        assert wrong.exit_code == 2


def test_a_drawn_machine_has_a_drawn_life(tmp_path):
    """With a plant seed the life is `drawn` by default; without one it has to be named."""
    common = ["simulate", "lms-y", "--logs", "2", "--seconds", "0.1", "--workers", "1"]
    tables = []
    for name, more in (("default", []), ("named", ["--life", "drawn"])):
        folder = ["--plant-seed", "4", "--out", str(tmp_path / name)]
        assert CliRunner().invoke(cli, [*common, *more, *folder]).exit_code == 0
        tables.append(pd.read_csv(tmp_path / name / "truth.csv"))
    one, other = tables
    pd.testing.assert_frame_equal(one, other)
    wrong = CliRunner().invoke(cli, [*common, "--out", str(tmp_path / "x")])
    assert wrong.exit_code == 2
    assert "--life is missing" in wrong.output and "--plant-seed" in wrong.output
    assert not (tmp_path / "x").exists()


@pytest.mark.slow
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


@pytest.mark.slow
def test_errors_are_one_line_and_status_1():
    """A named error is one line on standard error."""
    done = run("modes", "lms-z")
    assert done.returncode == 1
    known = "lms-x, lms-y, lms-x-full, lms-y-full"
    assert done.stderr == f"error: unknown stage 'lms-z'; known: {known}\n"


@pytest.mark.slow
def test_wrong_usage_is_status_2():
    """A missing option is wrong usage."""
    assert run("simulate", "lms-y").returncode == 2


LIFE = ["simulate", "lms-y", "--life", "healthy", "--logs", "1", "--workers", "1"]
STROKES = ["velocities", "lms-x", "--velocity", "400"]
SWEEP = ["sweep", "lms-x", "--low", "100", "--period", "0.1", "--seconds", "1"]
BOUNDS = "needed: 0.01 to 600 s"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        ([*LIFE, "--seconds", "0.00001"], f"seconds is 1e-05; {BOUNDS}"),
        ([*LIFE, "--seconds", "nan"], f"seconds is nan; {BOUNDS}"),
        ([*LIFE, "--seconds", "1e5"], f"seconds is 100000.0; {BOUNDS}"),
        ([*STROKES, "--seconds", "nan"], f"seconds is nan; {BOUNDS}"),
        ([*STROKES, "--seconds", "inf"], f"seconds is inf; {BOUNDS}"),
        ([*STROKES, "--seconds", "1e9"], f"seconds is 1000000000.0; {BOUNDS}"),
        ([*STROKES, "--seconds", "1e5"], f"seconds is 100000.0; {BOUNDS}"),
        ([*STROKES, "--strokes", "100000000"], "strokes is 100000000; needed: 1 to 1000"),
        ([*STROKES, "--dwell", "inf"], "dwell is inf; needed: 0 s or more, finite"),
        (
            [*STROKES, "--velocity", "400"],
            "velocity is 400 mm/s, more than once; needed: "
            "velocities that differ by 0.001 mm/s or more",
        ),
        ([*SWEEP, "--seconds", "inf"], f"seconds is inf; {BOUNDS}"),
        ([*SWEEP, "--period", "inf"], "period is inf; needed: 0.01 s, one cycle, to 600 s"),
        ([*SWEEP, "--velocity", "inf"], "velocity is inf m/s; needed: at least 0.0005 m/s, finite"),
    ],
)
def test_numbers_without_meaning_are_one_line_and_no_file(
    tmp_path, monkeypatch, capsys, arguments, error
):
    """Status 1, one line with what was found and is needed, no traceback, nothing written."""
    out = tmp_path / ("out.h5" if arguments[0] == "sweep" else "out")
    # In this process: that errors end one of their own is tested above.
    monkeypatch.setattr(sys, "argv", ["models", *arguments, "--out", str(out)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert (ended.value.code, capsys.readouterr().err) == (1, f"error: {error}\n")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_stale_logs_are_one_line(tmp_path):
    """A folder with two logs is refused to a plan of one, with the way out of it."""
    folder = ["--seconds", "0.1", "--out", str(tmp_path)]
    assert run(*LIFE, "--logs", "2", *folder).returncode == 0
    done = run(*LIFE, *folder)
    assert done.returncode == 1
    assert done.stderr == (
        f"error: {tmp_path} holds log-0002.h5: "
        "logs that this run would not write again (1) would stay; "
        "needed: another folder (or remove them)\n"
    )


def test_help_says_that_the_velocity_is_lowered():
    """The help of `sweep` explains a velocity that the travel does not allow."""
    output = CliRunner().invoke(cli, ["sweep", "--help"]).output
    assert "lowered to what the travel" in " ".join(output.split())


@pytest.mark.slow
def test_until_failure_needs_a_life_that_fails(tmp_path):
    """Following a healthy life to its failure is refused in one line before anything is made."""
    out = tmp_path / "life"
    arguments = ["simulate", "lms-y", "--life", "healthy", "--logs", "2", "--until", "failure"]
    done = run(*arguments, "--out", str(out))
    assert done.returncode == 1
    assert done.stderr == "error: until is failure; needed: now, as healthy crosses no limit\n"
    assert not out.exists()
