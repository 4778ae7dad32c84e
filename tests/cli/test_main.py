"""The command line: exit statuses, one line of error, and the three formats of the contract."""

from __future__ import annotations

import csv
import io
import json
import math
import shutil
import sqlite3
import subprocess
import sys
import tomllib
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click import Context
from click.testing import CliRunner, Result

from lmshealth._private.tables import TABLES
from lmshealth.batch import assess as assessing
from lmshealth.batch import constants
from lmshealth.batch.assess import pack_assessment
from lmshealth.batch.store import Store, default_url
from lmshealth.cli.main import main
from lmshealth.errors import LmshealthError
from lmshealth.io.reading import read_log
from lmshealth.machine.summary import summarise
from lmshealth.stage.description import load_stage
from models.dynamics.stages import STAGES
from models.recordings.velocities import Experiment, drive_velocities
from studies.modes.frf.hammer import RATE as HAMMER_RATE
from studies.modes.frf.hammer import Hammer, strike
from studies.modes.frf.records import BAND, MODES, RATE, Machine, periodic
from tests.assessments import nothing, worn
from tests.signals import Mode, accelerations, write_archive, write_archive_stage, write_log

MODE_KEYS = set(TABLES["modes"].names)


def call(*arguments: object) -> Result:
    """Run the command line in this process."""
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def strict(text: str) -> dict[str, Any]:
    """Parse JSON and refuse NaN and infinity, which JSON does not have."""

    def refuse(name: str) -> None:
        raise ValueError(f"{name} is no JSON")

    content = json.loads(text, parse_constant=refuse)
    assert isinstance(content, dict)
    return content


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make two good logs, a broken one, one without metadata, and a description of modes."""
    root = tmp_path_factory.mktemp("cli")
    write_archive(root / "good", 2)
    write_archive_stage(root / "stage", health=False)
    (root / "bad").mkdir()
    (root / "bad" / "broken.h5").write_bytes(b"nothing")
    values = "\n".join(f"{v!r}" for v in _noise())
    (root / "bare.csv").write_text("# sample_rate_hz: 500\nacc_x_m_s2\n" + values + "\n")
    return root


def _noise() -> list[float]:
    """Give 16 s of one mode at 62 Hz."""
    rng = np.random.default_rng(5)
    return [float(v) for v in accelerations(rng, [Mode(62.0, 0.02)], 8000, 500.0, 0.5)[0]]


@pytest.fixture
def stage(folder: Path) -> Path:
    """Give the path of the description."""
    return folder / "stage" / "small.toml"


# Help and usage


def test_every_command_has_help_with_an_example() -> None:
    """``--help`` of each command shows how it is called."""
    names = main.list_commands(Context(main))
    assert set(names) >= {"run", "modes", "error", "spectrum", "frf", "plan", "stage", "report"}
    for name in names:
        result = call(name, "--help")
        assert result.exit_code == 0
        assert "Example" in result.stdout
        # One line per example, as it is typed.
        assert f"\n      lmshealth {name} " in result.stdout


def test_the_help_lists_the_exit_statuses() -> None:
    """The help of the program names its exit statuses; -h is help too."""
    result = call("-h")
    assert result.exit_code == 0
    assert "Exit status" in result.stdout


def test_the_version_is_printed() -> None:
    """``--version`` prints the version of the package."""
    from lmshealth import __version__

    assert __version__ in call("--version").stdout


@pytest.mark.parametrize(
    "arguments",
    [
        ("run",),
        ("run", "."),
        ("run", ".", "--stage", "lms-y"),
        ("run", "no-such-folder", "--stage", "lms-y", "--out", "out"),
        ("run", ".", "--stage", "lms-y", "--out", "out", "--workers", "0"),
        ("run", ".", "--stage", "lms-y", "--out", "out", "--epochs", "none"),
        ("modes",),
        ("modes", "log.h5", "--format", "yaml"),
        ("modes", "log.h5", "--band", "200", "80"),
        ("modes", "log.h5", "--band", "-5", "80"),
        ("modes", "log.h5", "--nonsense"),
        ("error",),
        ("error", "log.h5", "--count", "0"),
        ("error", "log.h5", "--floor-nm", "-1"),
        ("error", "log.h5", "--part", "ramp"),
        ("spectrum",),
        ("spectrum", "log.h5", "--band", "200", "80"),
        ("frf", "log.h5"),
        ("frf", "log.h5", "--input", "current"),
        ("frf", "log.h5", "--input", "current", "--output", "acc_x", "--period", "0"),
        ("frf", "log.h5", "--input", "current", "--output", "acc_x", "--band", "200", "80"),
        ("plan", "--stage", "lms-y"),
        ("plan", "--detect", "guide_preload=0.05"),
        ("plan", "--stage", "lms-y", "--detect", "guide_preload"),
        ("plan", "--stage", "lms-y", "--detect", "guide_preload=0.05", "--power", "1"),
        ("plan", "--stage", "lms-y", "--detect", "guide_preload=0.05", "--format", "csv"),
        ("report", "--out", "pages"),
        ("report", "--store", "sqlite:///store.sqlite"),
        ("nonsense",),
    ],
)
def test_wrong_usage_is_status_2(arguments: tuple[str, ...]) -> None:
    """Wrong usage is reported on standard error with status 2."""
    result = call(*arguments)
    assert result.exit_code == 2
    assert "Error" in result.stderr
    assert result.stdout == ""


# modes


def test_modes_as_json_have_the_keys_of_the_contract(folder: Path, stage: Path) -> None:
    """Modes, lines and refused are lists of objects with at least the contract's keys."""
    log = folder / "good" / "log-00.h5"
    result = call("modes", log, "--stage", stage, "--format", "json")
    assert result.exit_code == 0
    content = strict(result.stdout)
    assert set(content) == {"modes", "lines", "std_factors", "shapes", "mac", "refused"}
    own = [row for row in content["std_factors"] if row["mode"] == "pitch"]
    assert [row["cause"] for row in own] == ["unsteady", "coloured"]
    product = np.prod([row["std_factor"] for row in own])
    assert content["modes"][1]["std_factor"] == pytest.approx(product)
    assert [shape["mode"] for shape in content["shapes"]] == ["roll", "pitch"]
    assert {pair["mode_b"] for pair in content["mac"]} == {"pitch"}
    assert [mode["mode"] for mode in content["modes"]] == ["roll", "pitch"]
    assert all(set(mode) >= MODE_KEYS for mode in content["modes"])
    assert content["modes"][0]["frequency_hz"] == pytest.approx(62.0, rel=0.01)


def test_mode_shapes_are_printed_where_they_are_asked_for(folder: Path, stage: Path) -> None:
    """Amplitude and phase per channel, collinearity and MAC follow the modes."""
    log = folder / "good" / "log-00.h5"
    plain = call("modes", log, "--stage", stage)
    result = call("modes", log, "--stage", stage, "--shapes")
    assert result.stdout.startswith(plain.stdout.rstrip())
    assert "Mode shapes (accelerations relative to the largest)" in result.stdout
    assert "modal assurance criterion (MAC)" in result.stdout


def test_modes_of_a_bare_log_have_nulls_and_need_no_metadata(folder: Path) -> None:
    """A log with samples and a sample rate only is analysed; missing metadata are null."""
    result = call("modes", folder / "bare.csv", "--band", 30, 200, "--format", "json")
    assert result.exit_code == 0
    (mode,) = strict(result.stdout)["modes"]
    assert mode["mode"] == "mode_1"
    assert mode["stage"] is None
    assert mode["travel_km"] is None
    assert mode["frequency_hz"] == pytest.approx(62.0, rel=0.02)


def test_modes_as_csv_have_the_columns_of_the_contract(folder: Path, stage: Path) -> None:
    """One header and one row per mode and log, parsed by any reader."""
    logs = sorted((folder / "good").glob("*.h5"))
    result = call("modes", *logs, "--stage", stage, "--format", "csv")
    rows = list(csv.DictReader(io.StringIO(result.stdout)))
    assert result.exit_code == 0
    assert set(rows[0]) >= MODE_KEYS
    assert [(Path(row["log"]).name, row["mode"]) for row in rows] == [
        (name, mode) for name in ("log-00.h5", "log-01.h5") for mode in ("roll", "pitch")
    ]


def test_modes_as_a_table_name_frequency_and_damping(folder: Path, stage: Path) -> None:
    """People get a table; it is the default."""
    result = call("modes", folder / "good" / "log-00.h5", "--stage", stage)
    assert result.exit_code == 0
    assert "roll" in result.stdout
    assert "±" in result.stdout


def test_modes_of_a_log_load_no_tracker_and_no_life(folder: Path, stage: Path) -> None:
    """Who identifies one log does not wait for what judges machines and draws pages."""
    words = ["modes", str(folder / "good" / "log-00.h5"), "--stage", str(stage)]
    code = (
        "import sys\nfrom lmshealth.cli.main import main\n"
        f"main({words}, standalone_mode=False)\nprint(*sys.modules, file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = done.stderr.split()
    assert "roll" in done.stdout and "lmshealth.modal.identification" in loaded
    assert not {
        name for name in loaded
        if name.startswith(("lmshealth.tracking", "lmshealth.life", "lmshealth.report.figures"))
    }  # fmt: skip


def test_a_refused_log_is_printed_once(folder: Path, stage: Path) -> None:
    """On standard error alone; json has it too, for programs."""
    broken = folder / "bad" / "broken.h5"
    result = call("modes", broken, "--stage", stage)
    assert (result.exit_code, result.stdout) == (1, "")
    assert len(result.stderr.splitlines()) == 1 and "broken.h5" in result.stderr
    result = call("modes", broken, folder / "good" / "log-00.h5", "--stage", stage)
    assert result.exit_code == 3
    assert "roll" in result.stdout and "broken.h5" not in result.stdout
    assert result.stderr.count("broken.h5") == 1
    found = strict(call("modes", broken, "--stage", stage, "--format", "json").stdout)["refused"]
    assert [Path(row["log"]).name for row in found] == ["broken.h5"]


def test_modes_without_a_band_print_a_note(folder: Path, stage: Path) -> None:
    """The note is printed with tables only, and only without a band and a description."""
    log, expected = folder / "bare.csv", "select them with --band LOW HIGH."
    assert expected in " ".join(call("modes", log).stdout.split())
    for more in (("--band", 30, 200), ("--format", "csv"), ("--stage", stage)):
        assert "--band" not in call("modes", log, *more).stdout


def test_saved_modes_are_a_description_that_finds_them_again(folder: Path, tmp_path: Path) -> None:
    """The skeleton loads as it is, applies to the machine of the log, and names the same modes."""
    log, path = folder / "good" / "log-00.h5", tmp_path / "my.toml"
    band, style = ("--band", 30, 120), ("--format", "json")
    result = call("modes", log, *band, *style, "--save", path)
    assert result.exit_code == 0 and "my.toml" in result.stderr
    assert load_stage(str(path)).matches(read_log(log).metadata)
    found = strict(result.stdout)["modes"]
    again = strict(call("modes", log, "--stage", path, *style).stdout)["modes"]
    assert [mode["mode"] for mode in again] == [mode["mode"] for mode in found] != []
    # The band of the fit is another one, and so is what it tells of the force: damping ratios of
    # one record of 20 s differ by about a standard deviation.
    for one, other in zip(again, found, strict=True):
        for key, std in (
            ("frequency_hz", "frequency_std_hz"),
            ("damping_ratio", "damping_ratio_std"),
        ):
            assert abs(one[key] - other[key]) < 2 * max(one[std], other[std])
    written = path.read_text()
    for more in ((log, "--save", path), (log, log, "--save", tmp_path / "b.toml"),
                 (log, "--save", tmp_path / "b.txt"),
                 (log, "--save", tmp_path / "b.toml", "--stage", path)):  # fmt: skip
        assert call("modes", *more).exit_code == 2
    assert path.read_text() == written and list(tmp_path.iterdir()) == [path]
    path.write_text("edited")
    assert call("modes", log, *band, "--save", path, "--overwrite").exit_code == 0
    assert path.read_text() == written and list(tmp_path.iterdir()) == [path]


def test_set_ups_are_merged_to_one_shape(tmp_path: Path) -> None:
    """Two logs with a common sensor: one row and one saved description; one log is refused."""
    mode, rate = (0.6, 1.0, -0.8), 500.0
    for k, at in enumerate(((0, 1), (0, 2))):
        own = [Mode(40.0, 0.01, 1.0, tuple(mode[i] for i in at))]
        values = accelerations(np.random.default_rng(k), own, 30_000, rate, 1e-3)
        head = "# sample_rate_hz: 500\n" + ",".join(f"acc_{i}_m_s2" for i in at)
        np.savetxt(tmp_path / f"{k}.csv", values.T, header=head, comments="", delimiter=",")
    logs, how = [tmp_path / f"{k}.csv" for k in (0, 1)], ("--merge", "--band", 20, 80)
    save = "--save", tmp_path / "my.toml"
    result = call("modes", *logs, *how, *save, "--format", "json")
    assert result.exit_code == 0
    content = strict(result.stdout)
    (row,), (shape,) = content["modes"], content["shapes"]
    assert row["frequency_hz"] == pytest.approx(40, abs=4 * row["frequency_std_hz"])
    assert [shape[f"amplitude_acc_{i}"] for i in range(3)] == pytest.approx([0.6, 1, 0.8], abs=0.02)
    assert load_stage(str(save[1])).modes[0].name == row["mode"]
    alone = call("modes", logs[0], *how)
    assert alone.exit_code == 1 and "two or more" in alone.stderr


def test_nothing_is_saved_without_modes(tmp_path: Path) -> None:
    """A log that shows no mode gives no description, and the exit status says so."""
    noise = np.random.default_rng(1).standard_normal(8000)
    np.savetxt(tmp_path / "n.csv", noise, header="# sample_rate_hz: 500\nacc_x_m_s2", comments="")
    result = call("modes", tmp_path / "n.csv", "--band", 30, 60, "--save", tmp_path / "my.toml")
    assert result.exit_code == 1 and "none found" in result.stderr
    assert "not-excited" in result.stdout or "refused" in result.stdout
    assert not (tmp_path / "my.toml").exists()


@pytest.mark.parametrize(("suffix", "start"), [("svg", b"<?xml"), ("png", b"\x89PNG"),
                                               ("html", b"<!DOCTYPE html>")])  # fmt: skip
def test_modes_are_drawn(folder: Path, tmp_path: Path, suffix: str, start: bytes) -> None:
    """Figures of one log, beside the usual output; a page loads nothing and lists refusals."""
    path, stage = tmp_path / f"f.{suffix}", folder / "stage" / "small.toml"
    result = call("modes", folder / "bare.csv", "--stage", stage, "--plot", path)
    assert result.exit_code == 0 and "roll" in result.stdout
    content = path.read_bytes()
    assert content.lstrip().startswith(start)
    if suffix == "html":
        assert b"not-excited" in content and b"src=" not in content and b"<script" not in content


def test_wrong_figures_are_refused_before_the_log_is_read(folder: Path, tmp_path: Path) -> None:
    """Of other formats and several logs."""
    log = folder / "bare.csv"
    assert call("modes", log, "--plot", tmp_path / "f.pdf").exit_code == 2
    assert call("modes", log, log, "--plot", tmp_path / "f.svg").exit_code == 2
    names = ("--input", "a", "--output", "b")
    assert call("frf", log, log, *names, "--plot", tmp_path / "f.svg").exit_code == 2


def test_a_refused_mode_alone_is_still_status_0(folder: Path, stage: Path) -> None:
    """A mode that this log does not show is listed with its reason, and nothing failed."""
    result = call("modes", folder / "bare.csv", "--stage", stage, "--format", "json")
    content = strict(result.stdout)
    assert result.exit_code == 0
    assert [mode["mode"] for mode in content["modes"]] == ["roll"]
    (refused,) = content["refused"]
    assert refused["mode"] == "pitch"
    assert {"log", "channel", "mode", "reason"} <= set(refused)


def test_some_bad_logs_are_status_3_and_all_bad_are_1(folder: Path, stage: Path) -> None:
    """One line on standard error per bad log; standard output keeps its format."""
    good, bad = folder / "good" / "log-00.h5", folder / "bad" / "broken.h5"
    some = call("modes", good, bad, "--stage", stage, "--format", "json")
    assert some.exit_code == 3
    assert len(strict(some.stdout)["modes"]) == 2
    assert len(some.stderr.splitlines()) == 1
    assert "broken.h5" in some.stderr
    none = call("modes", bad, folder / "no-such.h5", "--stage", stage, "--format", "json")
    assert none.exit_code == 1
    assert {row["log"] for row in strict(none.stdout)["refused"]} == {
        str(bad),
        str(folder / "no-such.h5"),
    }


def test_chosen_channels_and_column_maps_reach_the_analysis(folder: Path, tmp_path: Path) -> None:
    """A foreign export is read through its map; an unknown channel is a bad log, not a crash."""
    text = (folder / "bare.csv").read_text().replace("acc_x_m_s2", "CH1")
    (tmp_path / "export.csv").write_text(text)
    (tmp_path / "map.toml").write_text('[columns]\nacc_pitch_m_s2 = "CH1"\n')
    arguments = ("--columns", tmp_path / "map.toml", "--band", 30, 200, "--format", "json")
    result = call("modes", tmp_path / "export.csv", *arguments)
    assert result.exit_code == 0
    assert strict(result.stdout)["modes"][0]["channel"] == "acc_pitch"
    unknown = call("modes", tmp_path / "export.csv", *arguments, "--channels", "acc_yaw")
    assert unknown.exit_code == 1
    assert "acc_pitch" in unknown.stderr


@pytest.mark.slow
def test_the_program_runs_as_a_process(folder: Path, stage: Path) -> None:
    """From a shell: JSON on standard output, nothing on standard error, status 0."""
    start = [sys.executable, "-c", "from lmshealth.cli.main import main; main()"]
    log = folder / "good" / "log-00.h5"
    done = subprocess.run(
        [*start, "modes", str(log), "--stage", str(stage), "--format", "json"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert len(strict(done.stdout)["modes"]) == 2


# Logs of strokes


@pytest.fixture(scope="module")
def strokes(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Drive the simulated Y at four velocities, 4 s each with acceleration and braking."""
    folder = tmp_path_factory.mktemp("strokes")
    drive_velocities(
        Experiment(STAGES["lms-y"]), folder, "hdf5", velocities=(0.005, 0.02, 0.1, 0.4)
    )
    return sorted(folder.glob("*.h5"))


@pytest.mark.slow
def test_modes_of_what_settles(strokes: list[Path]) -> None:
    """The decay after 400 mm/s identifies the modes, with and without a stage; else refused."""
    arguments = ("--part", "settling", "--format", "json")
    result = call("modes", strokes[-1], strokes[0], "--stage", "lms-y", *arguments)
    assert result.exit_code == 3
    assert "no-such-part" in result.stderr
    content = strict(result.stdout)
    assert [row["mode"] for row in content["modes"]] == ["roll", "pitch", "yaw"]
    assert all(set(row) == MODE_KEYS for row in content["modes"])
    found = [row["frequency_hz"] for row in content["modes"]]
    assert found == pytest.approx([126.4, 136.6, 155.0], rel=2e-3)
    assert [row["reason"] for row in content["refused"]] == ["no-such-part"]
    bare = strict(call("modes", strokes[-1], "--band", 110, 145, *arguments).stdout)
    numbered = [(row["mode"], row["frequency_hz"]) for row in bare["modes"]]
    assert numbered == [("mode_1", pytest.approx(126.4, rel=2e-3)),
                        ("mode_2", pytest.approx(136.6, rel=2e-3))]  # fmt: skip


@pytest.mark.slow
def test_error_as_json_lists_every_harmonic(strokes: list[Path]) -> None:
    """Rows have the columns of the table; the harmonics' cosines rebuild what they claim."""
    result = call("error", *strokes, "--count", 20, "--format", "json")
    assert (result.exit_code, result.stderr) == (0, "")
    content = strict(result.stdout)
    assert set(content) == {"error", "harmonics", "refused"}
    assert [row["velocity_mm_s"] for row in content["error"]] == pytest.approx([5, 20, 100, 400])
    for row in content["error"]:
        assert set(row) == set(TABLES["error"].names)
        own = [h for h in content["harmonics"] if h["log"] == row["log"]]
        assert len(own) == 20
        assert own[0]["amplitude_um"] == row["max_magnitude_um"]
        power = sum(h["amplitude_um"] ** 2 / 2 for h in own)
        assert power / row["std_um"] ** 2 == pytest.approx(row["share_explained"], rel=1e-6)


def test_error_as_csv_and_table(strokes: list[Path]) -> None:
    """One row per log; a floor above everything leaves cells empty, the table a dash."""
    arguments = ("error", *strokes, "--floor-nm", 1e6)
    rows = list(csv.DictReader(io.StringIO(call(*arguments, "--format", "csv").stdout)))
    assert len(rows) == 4
    assert {row["bandwidth_above_floor_hz"] for row in rows} == {""}
    shown = call(*arguments).stdout
    assert "velocity-0400.000.h5" in shown
    assert "–" in shown


def test_error_of_a_part_and_its_refusals(strokes: list[Path], folder: Path) -> None:
    """A stroke settles; a log without Δe, or that never settles, is refused: status 3, then 1."""
    result = call("error", strokes[-1], folder / "bare.csv", "--part", "settling")
    assert result.exit_code == 3
    assert "no-delta-e" in result.stderr
    result = call("error", strokes[0], "--part", "settling")
    assert result.exit_code == 1
    assert "no-such-part" in result.stderr
    assert len(result.stderr.splitlines()) == 1


@pytest.mark.slow
def test_spectrum_as_json_contains_growth(strokes: list[Path]) -> None:
    """Pitch grows with velocity and is read by both accelerometers; 50 Hz is mains."""
    result = call("spectrum", *strokes, "--stage", "lms-y", "--format", "json")
    assert (result.exit_code, result.stderr) == (0, "")
    content = strict(result.stdout)
    assert set(content) == {"magnitudes", "growth", "lines", "refused"}
    assert all(set(row) == set(TABLES["magnitudes"].names) for row in content["magnitudes"])
    assert len(content["magnitudes"]) == 4 * 2 * 7  # logs, accelerometers, bands
    pitch = [row for row in content["growth"] if row["band"] == "pitch"]
    assert [row["grows"] for row in pitch] == [True, True]
    assert {line["kind"] for line in content["lines"]} >= {"mains"}
    mains = [line["frequency_hz"] for line in content["lines"] if line["kind"] == "mains"]
    assert min(mains) == pytest.approx(50.0, abs=0.05)


def test_spectrum_without_a_stage_reads_the_papers_grid(strokes: list[Path]) -> None:
    """Every 10 Hz of the band, as CSV and as a table."""
    arguments = ("spectrum", *strokes, "--band", 100, 140)
    rows = list(csv.DictReader(io.StringIO(call(*arguments, "--format", "csv").stdout)))
    assert [row["band"] for row in rows[:5]] == [f"{f} Hz" for f in range(100, 141, 10)]
    assert len(rows) == 4 * 2 * 5
    assert "grows" in call(*arguments).stdout


def test_one_velocity_has_no_slope_and_that_is_no_failure(strokes: list[Path]) -> None:
    """A single log has no growth: null, and a dash in the table."""
    content = strict(call("spectrum", strokes[0], "--format", "json").stdout)
    assert {row["slope"] for row in content["growth"]} == {None}
    assert {row["grows"] for row in content["growth"]} == {None}
    result = call("spectrum", strokes[0])
    assert result.exit_code == 0
    assert "–" in result.stdout


def test_spectrum_refuses_what_it_cannot_read(folder: Path, tmp_path: Path) -> None:
    """No accelerometer and a record too short are named; all refused is status 1."""
    (tmp_path / "slow.csv").write_text("# sample_rate_hz: 500\ndelta_e_um\n1\n2\n3\n1\n2\n")
    (tmp_path / "short.csv").write_text(
        "# sample_rate_hz: 500\nacc_x_m_s2\n" + "".join(f"{v}\n" for v in _noise()[:100])
    )
    result = call("spectrum", tmp_path / "slow.csv", tmp_path / "short.csv", "--band", 10, 200)
    assert result.exit_code == 1
    assert "no-accelerometer" in result.stderr
    assert "too-short" in result.stderr
    assert len(result.stderr.splitlines()) == 2
    assert (
        call("spectrum", folder / "bare.csv", tmp_path / "short.csv", "--band", 10, 200).exit_code
        == 3
    )


# frf


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Drive a machine by a multisine of 4 s for 20 s; the export calls its columns otherwise."""
    folder = tmp_path_factory.mktemp("bench")
    signals = periodic(np.random.default_rng(9), Machine(), 1600, 5)
    np.savetxt(folder / "bench.csv", np.column_stack(signals), header="U,ACC", delimiter=",",
               comments="")  # fmt: skip
    (folder / "map.toml").write_text(
        f'sample_rate_hz = {RATE}\n[columns]\ncurrent_a = "U"\nacc_x_m_s2 = "ACC"\n'
    )
    return folder


def frf(bench: Path, *more: object) -> Result:
    """Ask for the response of the bench."""
    return call(
        "frf", bench / "bench.csv", "--columns", bench / "map.toml",
        "--input", "current", "--output", "acc_x", *more,
    )  # fmt: skip


def test_frf_as_json_has_the_response_and_its_modes(bench: Path) -> None:
    """Modes as everywhere, the response line by line, how it was measured and fitted."""
    result = frf(bench, "--band", *BAND, "--period", 4, "--format", "json")
    assert (result.exit_code, result.stderr) == (0, "")
    content = strict(result.stdout)
    assert set(content) == {"modes", "fit", "frf", "lines", "std_factors", "refused"}
    assert all(set(mode) >= MODE_KEYS for mode in content["modes"])
    assert [mode["source"] for mode in content["modes"]] == ["frf", "frf"]
    for mode, (f, _, _) in zip(content["modes"], MODES, strict=False):
        assert mode["frequency_hz"] == pytest.approx(f, rel=2e-3)
    (fit,) = content["fit"]
    assert set(fit) == set(TABLES["fit"].names)
    assert fit["period_s"] == pytest.approx(4)
    assert fit["n_lines"] == len(content["frf"]) == 305
    for row in content["frf"]:
        assert set(row) == set(TABLES["frf"].names)
    keys = ("gain", "fit_gain", "gain_std")
    gain, fitted, std = np.array([[row[k] for k in keys] for row in content["frf"]], dtype=float).T
    assert np.abs((gain - fitted) / std).max() < 5


def test_frf_as_csv_lists_modes_and_as_a_table_both(bench: Path) -> None:
    """CSV is a table of modes that `track` reads; people see lines of the response too."""
    rows = list(csv.DictReader(io.StringIO(frf(bench, "--format", "csv").stdout)))
    assert set(rows[0]) >= MODE_KEYS
    shown = frf(bench).stdout
    assert "Response of acc_x to current" in shown
    assert "coherence" in shown
    assert "periods of 4 s" in shown
    assert "mode_1" in shown
    assert max(len(line) for line in shown.splitlines()) <= 80


def test_frf_refuses_options_that_have_no_effect(bench: Path, tmp_path: Path) -> None:
    """Averages and window are of measured responses, period and blows of logs."""
    f = np.arange(20.0, 120.0, 0.5)
    table = np.column_stack([f, np.ones(f.size), np.ones(f.size)])
    head = "frequency_hz,real,imag"
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", header=head, comments="")
    of_log: list[list[object]] = [["--averages", 5], ["--exponential", 0.1]]
    for option in (*of_log, ["--period", 4, "--impact"]):
        result = frf(bench, *option)
        assert result.exit_code == 2 and "no effect" in result.stderr
    for others in ("--period=1", "--impact", "--no-impact"):
        result = call("frf", tmp_path / "a.csv", others)
        assert result.exit_code == 2 and "a measured response" in result.stderr


def test_frf_is_drawn(bench: Path, tmp_path: Path) -> None:
    """The page shows gain, phase and coherence, and lists the modes."""
    assert frf(bench, "--plot", tmp_path / "f.html").exit_code == 0
    assert "mode 1" in (tmp_path / "f.html").read_text(encoding="utf-8")


def test_frf_gives_the_reason_for_an_unnamed_mode(bench: Path, tmp_path: Path) -> None:
    """Where two are looked for at one place both are named, in the form that goes on to track."""
    frequency = MODES[0][0]
    (tmp_path / "two.toml").write_text(
        'name = "two"\n'
        + "".join(
            f'[[mode]]\nname = "{name}"\nfrequency_hz = {frequency}\ndamping_ratio = 0.01\n'
            for name in ("roll", "pitch")
        )
    )
    result = frf(bench, "--stage", tmp_path / "two.toml", "--format", "csv")
    assert result.exit_code == 0
    assert next(csv.DictReader(io.StringIO(result.stdout)))["mode"] == ""
    assert "has no name: roll and pitch are both searched for there; track assigns" in result.stderr


def test_frf_of_several_logs_is_a_table_for_track(bench: Path, tmp_path: Path) -> None:
    """Modes are named by the description, dated by the manifest beside the logs, and tracked."""
    for name in ("a.csv", "b.csv"):
        shutil.copy(bench / "bench.csv", tmp_path / name)
    (tmp_path / "manifest.csv").write_text(
        "file,stage,recorded_at,travel_km\na.csv,M,2026-01-01T00:00Z,1\nb.csv,M,2026-01-02T00:00Z,2\n"
    )
    modes = "".join(
        f'[[mode]]\nname = "{name}"\nfrequency_hz = {f}\ndamping_ratio = {zeta}\nsearch = 0.1\n'
        for name, (f, zeta, _) in zip(("low", "high"), MODES, strict=False)
    )
    (tmp_path / "stage.toml").write_text(f'name = "m"\n[match]\nstage = "M"\n{modes}')
    result = call(
        "frf", *sorted(tmp_path.glob("*.csv")), "--columns", bench / "map.toml",
        "--input", "current", "--output", "acc_x", "--band", *BAND,
        "--stage", tmp_path / "stage.toml", "--format", "csv",
    )  # fmt: skip
    assert (result.exit_code, result.stderr) == (0, "")
    rows = list(csv.DictReader(io.StringIO(result.stdout)))
    assert [row["mode"] for row in rows] == ["low", "high"] * 2
    assert [row["travel_km"] for row in rows] == ["1.0", "1.0", "2.0", "2.0"]
    (tmp_path / "modes.csv").write_text(result.stdout)
    track = ("--stage", tmp_path / "stage.toml", "--out", tmp_path / "track.csv")
    assert call("track", tmp_path / "modes.csv", *track).exit_code == 0


def test_a_single_log_heeds_the_manifest_beside_it(folder: Path, tmp_path: Path) -> None:
    """Its row has the last word, a bad one refuses the log, and other folders' are not read."""
    log = Path(shutil.copy(folder / "good" / "log-00.h5", tmp_path))
    manifest = tmp_path / "manifest.csv"
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "manifest.csv").write_text("file,stage\n../log-00.h5,never\n")

    def stages() -> list[str]:
        result = call("modes", log, "--stage", folder / "stage" / "small.toml", "--format", "csv")
        return [row["stage"] for row in csv.DictReader(io.StringIO(result.stdout))]

    assert set(stages()) == {"test-A"}
    manifest.write_text("file,stage\nlog-00.h5,other\n")
    assert set(stages()) == {"other"}
    manifest.write_text("file,travel_km\nlog-00.h5,1\nlog-00.h5,2\n")
    result = call("modes", log)
    assert result.exit_code == 1
    assert "bad-row" in result.stderr
    manifest.write_bytes(b"")
    result = call("modes", log, "--stage", folder / "stage" / "small.toml")
    assert result.exit_code == 0
    assert result.stderr.startswith("note: manifest.csv: ")


def test_frf_reads_measured_responses(tmp_path: Path) -> None:
    """A table of lines needs no channels; of several responses each is fitted, or one is drawn."""
    f = np.arange(20.0, 120.0, 0.5)
    h, noise = Machine().response(f), np.random.default_rng(1).standard_normal((2, f.size))
    h = h + 0.01 * np.abs(h).max() * (noise[0] + 1j * noise[1])
    path = tmp_path / "analyser.csv"
    np.savetxt(path, np.column_stack([f, h.real, h.imag, 2 * h.real, 2 * h.imag]), delimiter=",",
               header="frequency_hz,a_real,a_imag,b_real,b_imag", comments="")  # fmt: skip
    content = strict(call("frf", path, "--format", "json").stdout)
    assert [fit["method"] for fit in content["fit"]] == ["measured"] * 2
    assert {mode["channel"] for mode in content["modes"]} == {"a", "b"}
    assert content["frf"][0]["coherence"] is None
    shown = call("frf", path, "--output", "b", "--plot", tmp_path / "b.svg")
    assert shown.exit_code == 0
    assert "taken from the residual of the fit" in " ".join(shown.stdout.split())
    assert call("frf", path, "--plot", tmp_path / "c.svg").exit_code == 2
    lost = call("frf", path, "--output", "c")
    assert (lost.exit_code, "there: a to input, b to input" in lost.stderr) == (1, True)


def test_frf_shows_blows_and_refuses_double_hits(tmp_path: Path) -> None:
    """Recognised without an option; the table states how many are used, and which are not."""
    hammer = Hammer(((62.0, 0.02, 1.0),), blows=3, seconds=1.0, double=(1,))
    force, answer = strike(np.random.default_rng(1), hammer)
    np.savetxt(tmp_path / "blows.csv", np.column_stack([force, answer]), delimiter=",",
               header=f"# sample_rate_hz: {HAMMER_RATE}\ncurrent_force_a,acc_x_m_s2",
               comments="")  # fmt: skip
    names = ("--input", "current_force", "--output", "acc_x", "--band", 20, 150)
    shown = " ".join(call("frf", tmp_path / "blows.csv", *names).stdout.split())
    assert "H1 of 2 of 3 blows" in shown
    assert "double-hit" in shown
    assert "mode_1" in shown


def test_frf_that_cannot_be_read_is_status_1_with_one_line(bench: Path) -> None:
    """A missing channel is named with those that are there, in every format."""
    for style in ("table", "csv", "json"):
        result = frf(bench, "--output", "acc_y", "--format", style)
        assert result.exit_code == 1
        assert "['current', 'acc_x']" in result.stderr
        assert len(result.stderr.splitlines()) == 1
    assert "does not fit twice" in frf(bench, "--period", 11).stderr


# plan

PLAN = ("plan", "--stage", "lms-y", "--detect")


def test_plan_as_json_has_the_question_and_one_row_per_length() -> None:
    """Two losses, three lengths of which one is too short: nulls there, no NaN."""
    lengths = ("--seconds", 0.2, "--seconds", 10, "--seconds", 60)
    detect = ("guide_preload=0.05", "--detect", "mount_stiffness=0.02")
    result = call(*PLAN, *detect, *lengths, "--format", "json")
    assert (result.exit_code, result.stderr) == (0, "")
    content = strict(result.stdout)
    assert set(content) == {"detect", "plan"}
    assert all(set(row) == set(TABLES["detect"].names) for row in content["detect"])
    assert all(set(row) == set(TABLES["plan"].names) for row in content["plan"])
    assert [(row["parameter"], row["loss"], row["n_baseline"]) for row in content["detect"]] == [
        ("guide_preload", 0.05, 5), ("mount_stiffness", 0.02, 5),
    ]  # fmt: skip
    assert [row["seconds_per_log"] for row in content["plan"]] == [0.2, 10, 60] * 2
    short = content["plan"][0]
    assert (short["n_logs"], short["hindrance"], short["power_of_one_log"]) == (
        None, "too-short", None,
    )  # fmt: skip
    assert isinstance(content["plan"][2]["n_logs"], int)


def test_plan_as_a_table_follows_power_and_false_alarms() -> None:
    """People see the answer in a line; asking for less needs less."""
    shown = call(*PLAN, "guide_preload=0.05")
    assert shown.exit_code == 0
    assert "s per log" in shown.stdout
    assert "One log is enough from" in shown.stdout
    asked = (*PLAN, "guide_preload=0.05", "--format", "json")
    easy = call(*asked, "--power", 0.8, "--false-alarm", 0.05)
    needed = [
        strict(text)["detect"][0]["seconds_for_one_log"]
        for text in (call(*asked).stdout, easy.stdout)
    ]
    assert needed[1] < needed[0]


@pytest.mark.parametrize(
    ("stage", "detect", "expected"),
    [
        ("lms-x", "mount_stiffness=0.1", "do not identify mount_stiffness"),
        ("lms-y", "preload=0.1", "there are ['guide_preload', 'mount_stiffness']"),
        ("lms-y", "guide_preload=5", "between 0 and 1"),
        ("lms-z", "guide_preload=0.1", "no stage description"),
    ],
)
def test_plan_without_an_answer_is_status_1_with_one_line(
    stage: str, detect: str, expected: str
) -> None:
    """What cannot be seen, is unknown, or is no fraction."""
    result = call("plan", "--stage", stage, "--detect", detect)
    assert (result.exit_code, result.stdout) == (1, "")
    assert expected in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_plan_needs_a_map(stage: Path) -> None:
    """A description of modes alone cannot be planned with."""
    result = call("plan", "--stage", stage, "--detect", "guide_preload=0.05")
    assert result.exit_code == 1
    assert "[map]" in result.stderr


# run


def run(logs: Path, stage: Path | str, out: Path) -> Result:
    """Run the main job with one worker."""
    return call("run", logs, "--stage", stage, "--out", out, "--workers", 1)


@pytest.mark.slow
def test_a_clean_run_is_status_0_and_prints_the_path_of_its_report(
    folder: Path, stage: Path, tmp_path: Path
) -> None:
    """The count of logs, a line per stage and the front page; no bar where no terminal is."""
    result = run(folder / "good", stage, tmp_path / "out")
    assert result.exit_code == 0
    assert "2 of 2 logs analysed" in result.stdout
    assert "test-A: not-enough-data" in result.stdout
    assert str(tmp_path / "out" / "index.html") in result.stdout
    assert result.stderr == ""
    again = run(folder / "good", stage, tmp_path / "out")
    assert "results of 2 are of an earlier run" in again.stdout


@pytest.mark.slow
def test_a_run_with_a_bad_log_is_status_3(folder: Path, stage: Path, tmp_path: Path) -> None:
    """Others are analysed, and refused.csv has the reason."""
    logs = write_archive(tmp_path / "logs", 1)
    (logs / "broken.h5").write_bytes(b"nothing")
    result = run(logs, stage, tmp_path / "out")
    assert result.exit_code == 3
    assert "1 of 2 logs analysed" in result.stdout
    (row,) = csv.DictReader((tmp_path / "out" / "refused.csv").read_text().splitlines())
    assert row["log"] == "broken.h5"


def test_a_run_of_bad_logs_only_is_status_1_with_one_line(
    folder: Path, stage: Path, tmp_path: Path
) -> None:
    """One line on standard error; refused.csv is written all the same."""
    result = run(folder / "bad", stage, tmp_path / "out")
    assert result.exit_code == 1
    assert result.stdout == ""
    assert len(result.stderr.splitlines()) == 1
    assert result.stderr.startswith("lmshealth: ")
    assert "broken.h5" in (tmp_path / "out" / "refused.csv").read_text()


def test_a_run_in_which_every_machine_failed_is_status_1(
    stage: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The machine is named once, and the estimates of its logs are in the tables."""

    def fail(*_: object, **__: object) -> None:
        raise LmshealthError("test-A: cannot be assessed")

    monkeypatch.setattr(assessing, "assess_from", fail)
    result = run(write_archive(tmp_path / "logs", 1), stage, tmp_path / "out")
    assert result.exit_code == 1
    assert result.stderr == "lmshealth: test-A: cannot be assessed\n"
    rows = list(csv.DictReader((tmp_path / "out" / "modes.csv").read_text().splitlines()))
    assert [row["mode"] for row in rows] == ["roll", "pitch"]


def test_a_log_that_no_description_takes_is_refused(stage: Path, tmp_path: Path) -> None:
    """A machine without a description is ``no-stage``; the message lists the descriptions."""
    logs = tmp_path / "logs"
    write_log(logs / "foreign.h5", 1.0, 1, stage="other-Z")
    result = run(logs, stage, tmp_path / "out")
    assert result.exit_code == 1
    (row,) = csv.DictReader((tmp_path / "out" / "refused.csv").read_text().splitlines())
    assert row["reason"] == "no-stage"
    assert (
        "no description matches stage 'other-Z': [match] stage is '*-A' in small" in row["detail"]
    )
    assert "correct it there, or give by --stage" in row["detail"]
    assert len(result.stderr.splitlines()) == 1
    assert f"1 refused: 1 as no-stage, such as foreign.h5: {row['detail']}; " in result.stderr


def test_a_description_that_a_manifest_asks_for_and_nobody_gave_is_named(
    stage: Path, tmp_path: Path
) -> None:
    """It is not the stage of the log that matches nothing then."""
    logs = tmp_path / "logs"
    write_log(logs / "a.h5", 1.0, 1)
    (logs / "manifest.csv").write_text("file,description\na.h5,lms-q\n")
    result = run(logs, stage, tmp_path / "out")
    assert result.exit_code == 1
    assert "its description is to be 'lms-q', and --stage gives small" in result.stderr
    assert "column description of manifest.csv" in result.stderr


@pytest.mark.slow
def test_a_run_as_json_is_one_document(folder: Path, stage: Path, tmp_path: Path) -> None:
    """Counts, status and changes on standard output and nothing else; alerts that fail beside."""
    fails = f"{sys.executable} -c 'import sys; sys.exit(5)'"
    words = ["run", folder / "good", "--stage", stage, "--out", tmp_path / "out", "--workers", 1]
    words += ["--format", "json", "--silent-days", 7, "--alert-command", fails]
    result = call(*words)
    assert result.exit_code == 0  # a failed alert changes no exit status
    document = strict(result.stdout)
    assert (document["n_logs"], document["n_refused"], document["failed"]) == (2, 0, {})
    (machine,), (change,) = document["machines"], document["changes"]
    assert (machine["stage"], machine["DeviceHealth"]) == ("test-A", "CHECK_FUNCTION")
    assert machine["verdict"] == "not-enough-data" and machine["service_by"] is None
    assert (change["what"], change["stage"]) == ("silent", "test-A")
    assert Path(str(document["report"])).is_file()
    assert "--alert-command: ended with status 5" in result.stderr
    assert len(result.stderr.splitlines()) == 1
    again = call(*words[:-4])
    assert strict(again.stdout)["changes"] == [] and again.stderr == ""


def test_alerts_that_cannot_be_sent_are_known_before_the_run(
    stage: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No address, no program and half a quotation are wrong usage; without apprise: status 1."""
    words = ["run", tmp_path, "--stage", stage, "--out", tmp_path / "out"]
    monkeypatch.delenv("LMSHEALTH_NOTIFY", raising=False)
    for more in (["--notify"], ["--alert-command", " "], ["--alert-command", "mail 'me"]):
        assert call(*words, *more).exit_code == 2
    monkeypatch.setenv("LMSHEALTH_NOTIFY", "mailto://me:secret@host")
    monkeypatch.setattr("lmshealth.cli.options.find_spec", lambda name: None)
    result = call(*words, "--notify")
    assert result.exit_code == 1
    assert "pip install 'lmshealth[notify]'" in result.stderr and "secret" not in result.output
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("reference", ["lms-q", "nowhere/stage.toml"])
def test_an_unknown_stage_is_status_1_with_one_line(
    folder: Path, tmp_path: Path, reference: str
) -> None:
    """The line names the description that is not there."""
    for arguments in (
        ("run", folder / "good", "--stage", reference, "--out", tmp_path / "out"),
        ("modes", folder / "good" / "log-00.h5", "--stage", reference),
    ):
        result = call(*arguments)
        assert result.exit_code == 1
        assert reference in result.stderr
        assert len(result.stderr.splitlines()) == 1


def test_a_store_that_cannot_be_opened_is_status_1(
    folder: Path, stage: Path, tmp_path: Path
) -> None:
    """One line names the store without its password."""
    result = call(
        "run", folder / "good", "--stage", stage, "--out", tmp_path / "out",
        "--workers", 1, "--store", "nosuch://me:hunter2@host/db",
    )  # fmt: skip
    assert result.exit_code == 1
    assert "hunter2" not in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_a_bad_description_is_status_1_with_what_to_copy(folder: Path, tmp_path: Path) -> None:
    """A typing slip in a description is named with the key most like it and a whole table."""
    bad = tmp_path / "bad.toml"
    bad.write_text('name = "x"\n[[mode]]\nname = "roll"\nfrequenzy_hz = 3\ndamping_ratio = 0.1\n')
    result = call("modes", folder / "good" / "log-00.h5", "--stage", bad)
    assert result.exit_code == 1
    assert "frequenzy_hz" in result.stderr and "most like it is frequency_hz" in result.stderr
    _, block = result.stderr.split("To copy and edit:")
    assert set(tomllib.loads(block)["mode"][0]) == {"name", "frequency_hz", "damping_ratio"}


# report


@pytest.mark.slow
def test_report_writes_the_pages_of_run_without_its_logs(stage: Path, tmp_path: Path) -> None:
    """Logs and description gone, every page is the same to the byte."""
    logs = write_archive(tmp_path / "logs", 2)
    (logs / "broken.h5").write_bytes(b"nothing")
    own = shutil.copy(stage, tmp_path / "own.toml")
    assert run(logs, own, tmp_path / "out").exit_code == 3
    shutil.rmtree(logs)
    Path(own).unlink()
    url = f"sqlite:///{(tmp_path / 'out' / 'lmshealth.sqlite').as_posix()}"
    result = call("report", "--store", url, "--out", tmp_path / "pages")
    assert (result.exit_code, result.stderr) == (0, "")
    assert str(tmp_path / "pages" / "index.html") in result.stdout
    names = sorted(page.name for page in (tmp_path / "pages").iterdir() if page.is_file())
    assert names == ["how-to-read.html", "index.html", "test-A.html"]
    for name in names:
        assert (tmp_path / "pages" / name).read_bytes() == (tmp_path / "out" / name).read_bytes()
    assert "broken.h5" in (tmp_path / "pages" / "index.html").read_text()


@pytest.mark.parametrize(
    ("url", "expected"),
    [
        ("sqlite:///{}/nowhere.sqlite", "nowhere.sqlite"),
        ("sqlite:///{}/empty.sqlite", "no results"),
        ("sqlite:///{}/text.sqlite", "not a database"),
        ("no url at all", "no URL; a file is sqlite:///PATH"),
        ("nosuch://me:hunter2@host/db?password=hunter2", "nosuch://host/db"),
        ("postgresql+nosuch://me:hunter2@host/db", "host/db"),
    ],
)
def test_a_store_that_has_no_report_is_status_1_with_one_line(
    tmp_path: Path, url: str, expected: str
) -> None:
    """Each kind is named without its password; no file is made and no page written."""
    (tmp_path / "empty.sqlite").touch()
    (tmp_path / "text.sqlite").write_text("these are my notes\n" * 100)
    result = call("report", "--store", url.format(tmp_path.as_posix()), "--out", tmp_path / "pages")
    assert result.exit_code == 1
    assert expected in result.stderr
    assert "hunter2" not in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty.sqlite", "text.sqlite"]


def test_the_store_may_be_named_by_the_environment(tmp_path: Path) -> None:
    """An address with a password need not stand on the command line, where all can see it."""
    store = tmp_path / "none.sqlite"
    named = CliRunner().invoke(
        main, ["report", "--out", str(tmp_path)], env={"LMSHEALTH_STORE": f"sqlite:///{store}"}
    )
    assert named.exit_code == 1
    assert store.name in named.output
    assert call("report", "--out", tmp_path).exit_code == 2


@pytest.mark.slow
def test_an_unreadable_machine_is_reported_and_the_others_are_written(tmp_path: Path) -> None:
    """One line counts what is damaged, one names the machine, with status 3."""
    store = Store(default_url(tmp_path))
    for name in ("M7-Y", "M8-Y"):
        made = nothing(worn(tmp_path, name))
        store.put_assessment(name, "k1", pack_assessment(made))
        store.publish(name, ["k1"], summarise(made, made.service()), "")
    store.close()
    with closing(sqlite3.connect(tmp_path / "lmshealth.sqlite")) as file, file:
        file.execute(
            f"UPDATE values_{constants.SCHEMA} SET content = x'00' "
            "WHERE kind = 'assessed' AND name = 'M8-Y'"
        )
    url = default_url(tmp_path).render_as_string()
    result = call("report", "--store", url, "--out", tmp_path / "pages")
    assert result.exit_code == 3
    damage, machine = result.stderr.splitlines()
    assert "1 damaged rows (1 of assessed)" in damage and "M8-Y" in machine
    names = sorted(page.name for page in (tmp_path / "pages").iterdir())
    assert names == ["M7-Y.html", "how-to-read.html", "index.html"]


@pytest.mark.slow
def test_pdfs_are_written_next_to_the_pages_of_run_and_report(
    folder: Path, stage: Path, tmp_path: Path, needs: Callable[[str], None]
) -> None:
    """One per stage, under the name of its page; none without being asked for."""
    needs("pdf")
    out = tmp_path / "out"
    arguments = ("run", folder / "good", "--stage", stage, "--out", out, "--workers", 1)
    assert call(*arguments).exit_code == 0
    assert list(out.glob("*.pdf")) == []
    assert call(*arguments, "--pdf").exit_code == 0
    assert [path.name for path in out.glob("*.pdf")] == ["test-A.pdf"]
    url = default_url(out).render_as_string()
    assert call("report", "--store", url, "--out", tmp_path / "pages", "--pdf").exit_code == 0
    again = (tmp_path / "pages" / "test-A.pdf").read_bytes()
    assert again == (out / "test-A.pdf").read_bytes()


@pytest.mark.slow
def test_without_weasyprint_pages_are_written_and_the_error_names_it(
    folder: Path, stage: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Status 1 with one line that names the package; the results are kept."""
    monkeypatch.setitem(sys.modules, "weasyprint", None)
    out = tmp_path / "out"
    result = call(
        "run", folder / "good", "--stage", stage, "--out", out, "--workers", 1, "--pdf"
    )  # fmt: skip
    assert result.exit_code == 1
    assert 'pip install "lmshealth[pdf]"' in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert (out / "test-A.html").is_file() and (out / "lmshealth.sqlite").is_file()


def test_a_guessed_layout_is_reported(tmp_path: Path) -> None:
    """What neither the file nor a column map states is reported in one line on standard error."""
    rows = [f"{k / 1000:.3f};{math.sin(k):.3f}".replace(".", ",") for k in range(2000)]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["Axis 7", "time_s;acc_x_m_s2", *rows]), encoding="utf-8")
    result = call("error", path)
    found = (
        "is read with ';' between fields, decimal commas, names in line 2; [csv] of a column map"
    )
    assert result.stderr.count(found) == 1


@pytest.mark.parametrize(("command", "kept"), [("run", True), ("stage", False)])
def test_an_interrupt_has_its_status(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, command: str, kept: bool
) -> None:
    """An interrupt ends with 130; only a run is said to continue."""

    def interrupted(*arguments: object, **options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("lmshealth.batch.run.run", interrupted)
    monkeypatch.setattr("lmshealth.cli.stage_commands.check_stage", interrupted)
    words = [tmp_path, "--stage", "lms-y", "--out", tmp_path / "out"] if kept else ["lms-y"]
    result = call(command, *words)
    assert result.exit_code == 130
    assert ("run again to continue" in result.stderr) is kept


def test_bands_beyond_the_log_and_repeated_names_are_noticed(tmp_path: Path) -> None:
    """A band above what the log shows is refused, one that ends there noted; names count once."""
    noise = np.random.default_rng(0).standard_normal((4000, 2))
    head = "# sample_rate_hz: 1000\nacc_x_m_s2,acc_y_m_s2"
    np.savetxt(tmp_path / "a.csv", noise, delimiter=",", header=head, comments="")
    for command in ("modes", "spectrum"):
        lost = call(command, tmp_path / "a.csv", "--band", 600, 900)
        assert (lost.exit_code, lost.stdout) == (1, "")
        assert "1000 Hz shows nothing above 450 Hz; the band is 600 to 900 Hz" in lost.stderr
    half = call("modes", tmp_path / "a.csv", "--band", 300, 900)
    assert "300 to 900 Hz ends above 500 Hz" in half.stderr
    assert "ends above" not in call("modes", tmp_path / "a.csv", "--band", 300, 400).stderr
    words = ["modes", tmp_path / "a.csv", "--format", "json", "--band", 300, 400]
    twice = json.loads(call(*words, tmp_path / "a.csv").stdout)
    assert twice == json.loads(call(*words).stdout)
    assert len({row["log"] for row in twice["refused"]}) == 1
    both = ("--channels", "acc_x", "--channels", "acc_y, acc_x")
    assert json.loads(call(*words, *both).stdout) == twice
    assert call(*words, "--channels", "acc_x,,acc_y").exit_code == 2


# Proposals


def test_init_proposes_what_modes_needs(tmp_path: Path) -> None:
    """The three files are written, used as they are, and not overwritten unless it is asked for."""
    rows = "\n".join(f"{k / 500:.3f};{v:.6f}".replace(".", ",") for k, v in enumerate(_noise()))
    (tmp_path / "a.txt").write_text("Zeit [s];Kanal 1 [g]\n" + rows + "\n")
    (tmp_path / "b.txt").write_text("Zeit [s];Anderer\n" + rows + "\n")
    logs = [str(tmp_path / name) for name in ("a.txt", "b.txt")]
    done = call("init", *logs, "--out", str(tmp_path))
    assert done.exit_code == 3 and "the column map needs Kanal 1" in done.stderr
    assert "its unit is g" in " ".join(done.stdout.split())
    low, high = map(int, " ".join(done.stderr.split()).split("--band ")[1].split()[:2])
    assert 40 < low < 55 and 70 < high < 90
    header, row = (tmp_path / "manifest.csv").read_text().splitlines()
    assert header.startswith("file,stage")
    assert row == f"a.txt,{tmp_path.name},,,,recorded_at: not found"
    band = ["--band", str(low), str(high), "--format", "json"]
    modes = call("modes", logs[0], "--columns", str(tmp_path / "map.toml"), *band)
    assert modes.exit_code == 0
    found = [one["frequency_hz"] for one in json.loads(modes.stdout)["modes"]]
    assert any(abs(f - 62) < 1 for f in found)
    # The description has the modes that the proposed command finds.
    described = tomllib.loads((tmp_path / "my-stage.toml").read_text())["mode"]
    assert [one["frequency_hz"] for one in described] == pytest.approx(found, rel=1e-4)
    assert call("stage", str(tmp_path / "my-stage.toml")).exit_code == 0
    again = call("init", logs[0], "--out", str(tmp_path))
    assert again.exit_code == 2 and "map.toml" in again.stderr and "--overwrite" in again.stderr
    (tmp_path / "map.toml").write_text("kept = 1")
    (tmp_path / "c.txt").write_text("a;b\n1;2\n2;3\n")
    failed = call("init", str(tmp_path / "c.txt"), "--out", str(tmp_path), "--overwrite")
    assert failed.exit_code == 1 and (tmp_path / "map.toml").read_text() == "kept = 1"
    assert call("init", logs[0], "--out", str(tmp_path), "--overwrite").exit_code == 0


def test_what_init_proposes_without_an_odometer_can_be_run(tmp_path: Path) -> None:
    """Logs whose files state no travel take the time for it, and no log is refused for that."""
    logs = [tmp_path / f"2026-07-{day:02d}.txt" for day in (1, 2)]
    for day, path in enumerate(logs):
        rows = [f"{k / 500:.3f};{v + day / 1e3:.6f}" for k, v in enumerate(_noise())]
        path.write_text("\n".join(["time [s];acc [g]", *rows]) + "\n")
    assert call("init", *map(str, logs), "--out", str(tmp_path)).exit_code == 0
    sheet, stage = tmp_path / "manifest.csv", tmp_path / "my-stage.toml"
    assert all(line.split(",")[3] == "" for line in sheet.read_text().splitlines()[1:])

    def refused() -> list[str]:
        out = tmp_path / "out"
        call("run", tmp_path, "--columns", tmp_path / "map.toml", "--stage", stage, "--out", out)
        with (out / "refused.csv").open() as stream:
            return [row["detail"] for row in csv.DictReader(stream) if not row["mode"]]

    assert not [detail for detail in refused() if "travel" in detail]
    stage.write_text(stage.read_text().replace('clock = "days"', 'clock = "odometer"'))
    assert len([detail for detail in refused() if "travel" in detail]) == len(logs)


def test_init_names_no_log_out_of_the_folder(tmp_path: Path) -> None:
    """A manifest of logs that lie elsewhere is not written, with the reason."""
    rows = "\n".join(f"{v:.6f}" for v in _noise())
    (tmp_path / "a.txt").write_text("acc\n" + rows + "\n")
    out = tmp_path / "out"
    done = call("init", str(tmp_path / "a.txt"), "--out", str(out), "--sample-rate", "500")
    assert done.exit_code == 0 and "not in its folder" in done.stderr
    assert sorted(path.name for path in out.iterdir()) == ["map.toml", "my-stage.toml"]
