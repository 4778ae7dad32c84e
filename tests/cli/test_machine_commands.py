"""Commands on tables and descriptions: files, output, errors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray
from click.testing import CliRunner, Result

from lmshealth._private.serialize import seed_of
from lmshealth._private.tables import TABLES
from lmshealth.cli.main import main
from lmshealth.life import health as api
from lmshealth.tracking.read_tables import read_machines
from lmshealth.tracking.track import accepted_estimates, track
from tests.lives import FADING, FOOT, MOUNT, make_stage, true_drift

N = 30


@pytest.fixture
def estimates(tmp_path: Path) -> Path:
    """Write estimates of two modes of a machine whose roll jumps by -3 % at log 20."""
    rng = np.random.default_rng(4)
    rows = []
    for k in range(N):
        for mode, f in (("roll", 126.4), ("pitch", 136.6)):
            jump = 0.97 if mode == "roll" and k >= 20 else 1.0
            rows.append(
                {
                    "stage": "AX-1",
                    "log": f"{k:03d}",
                    "recorded_at": f"2026-03-{k + 1:02d}T06:00:00+00:00",
                    "travel_km": 100.0 * k,
                    "temperature_c": 21 + rng.standard_normal(),
                    "mode": mode,
                    "source": "acc",
                    "frequency_hz": f * jump * (1 + 1e-3 * rng.standard_normal()),
                    "frequency_std_hz": 1e-3 * f,
                    "damping_ratio": 0.015 * np.exp(0.05 * rng.standard_normal()),
                    "damping_ratio_std": 0.015 * 0.05,
                }
            )
    table = pd.DataFrame(rows)
    table["temperature_c"] = table.groupby("log")["temperature_c"].transform("first")
    path = tmp_path / "modes.csv"
    table.to_csv(path, index=False)
    return path


def run(*words: object) -> Result:
    """Run the command line."""
    return CliRunner().invoke(main, ["track", *map(str, words)])


def test_a_table_becomes_track_effects_and_events(estimates: Path, tmp_path: Path) -> None:
    """Every file that is asked for is written; the jump is an event and an alarm."""
    stage = make_stage(tmp_path / "stage", (FADING,))
    assert stage.modes
    out = {name: tmp_path / f"{name}.csv" for name in ("track", "effects", "events", "track_cov")}
    result = run(
        estimates, "--stage", tmp_path / "stage" / "small.toml", "--out", out["track"],
        "--effects", out["effects"], "--events", out["events"], "--track-cov", out["track_cov"],
        "--smooth",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    track = pd.read_csv(out["track"])
    assert len(track) == 2 * N
    last = track[(track["mode"] == "roll")].iloc[-1]
    assert abs(last["drift"] - np.log(0.97)) < 3 * last["drift_std"]
    assert abs(last["drift_smoothed"] - last["drift"]) < 0.3 * last["drift_std"]
    events = pd.read_csv(out["events"])
    steps = events[events["kind"] == "step"]
    assert set(steps["recorded_at"]) == {"2026-03-21T06:00:00+00:00"}
    assert "alarm" in set(events["kind"])
    assert set(pd.read_csv(out["effects"])["covariate"]) == {"temperature_c", "scale:acc"}
    assert len(pd.read_csv(out["track_cov"])) == N
    assert "Events" in result.output


def test_no_output_replaces_an_input_or_another_output(estimates: Path, tmp_path: Path) -> None:
    """Wrong usage before anything is read."""
    before, link = estimates.read_bytes(), tmp_path / "link.csv"
    link.symlink_to(estimates)
    for path in (estimates, tmp_path / "." / "modes.csv", link):
        result = run(estimates, "--out", path)
        assert (
            result.exit_code == 2 and "is also the input; needed is another file" in result.stderr
        )
    make_stage(tmp_path / "stage", (FADING,))
    toml = tmp_path / "stage" / "small.toml"
    result = run(estimates, "--stage", toml, "--out", toml)
    assert result.exit_code == 2 and "is also the input" in result.stderr
    both = tmp_path / "both.csv"
    result = run(estimates, "--out", both, "--events", both)
    assert result.exit_code == 2 and "is also --out; needed is another file" in result.stderr
    assert estimates.read_bytes() == before and not both.exists()


def test_a_track_is_not_tracked_again(estimates: Path, tmp_path: Path) -> None:
    """Filtered rows are no independent estimates: the message names what is needed."""
    out = tmp_path / "track.csv"
    assert run(estimates, "--out", out).exit_code == 0
    result = run(out, "--out", tmp_path / "again.csv")
    assert result.exit_code == 1 and not (tmp_path / "again.csv").exists()
    assert "has a column drift, so it is a track" in result.stderr and "modes.csv" in result.stderr


def test_without_stage_and_names_modes_are_born(estimates: Path, tmp_path: Path) -> None:
    """Unnamed estimates make two modes, named by their frequency."""
    table = pd.read_csv(estimates).drop(columns=["mode", "source", "stage", "travel_km"])
    bare = tmp_path / "other.csv"
    table[table["recorded_at"] < "2026-03-21"].to_csv(bare, index=False)
    result = run(bare, "--out", tmp_path / "track.csv")
    assert result.exit_code == 0, result.output
    names = sorted(set(pd.read_csv(tmp_path / "track.csv")["mode"]))
    assert [name[:2] + name[-3:] for name in names] == ["12_hz", "13_hz"]
    assert "all rows are taken for one machine, other" in result.stderr
    assert "the clock is the time" in result.stderr


def test_one_log_is_the_baseline(estimates: Path, tmp_path: Path) -> None:
    """One epoch is no failure; a note explains that there is no drift."""
    single = tmp_path / "single.csv"
    pd.read_csv(estimates).iloc[:2].to_csv(single, index=False)
    result = run(single, "--out", tmp_path / "track.csv")
    assert result.exit_code == 0, result.output
    track = pd.read_csv(tmp_path / "track.csv")
    assert (track["drift"] == 0).all()
    assert "a single log is the baseline" in result.stderr


def test_bad_tables_are_one_line_and_status_1(estimates: Path, tmp_path: Path) -> None:
    """The line names the file, the line of it and what is wrong."""
    table = pd.read_csv(estimates)
    table.loc[3, "frequency_std_hz"] = -1.0
    bad = tmp_path / "bad.csv"
    table.to_csv(bad, index=False)
    result = run(bad, "--out", tmp_path / "track.csv")
    assert result.exit_code == 1
    assert result.stderr.count("\n") == 1
    assert "line 5: frequency_std_hz is -1" in result.stderr
    assert not (tmp_path / "track.csv").exists()


def test_an_output_that_cannot_be_written_is_reported(estimates: Path, tmp_path: Path) -> None:
    """A file stands where a folder is needed: status 1 and the reason. Folders are made."""
    result = run(estimates, "--out", estimates / "track.csv")
    assert result.exit_code == 1
    assert "cannot be written" in result.stderr
    assert run(estimates, "--out", tmp_path / "new" / "track.csv").exit_code == 0
    assert (tmp_path / "new" / "track.csv").exists()


def test_maintenance_of_other_machines_is_noted(estimates: Path, tmp_path: Path) -> None:
    """A name that the table does not have may be a slip of the pen."""
    actions = tmp_path / "maintenance.csv"
    actions.write_text("stage,recorded_at,action\nAX-9,2026-03-02T00:00:00Z,servo\n")
    result = run(estimates, "--out", tmp_path / "track.csv", "--maintenance", actions)
    assert result.exit_code == 0, result.output
    assert "work on AX-9 is not used" in result.stderr


def test_too_few_logs_for_track_initiation_are_noted(estimates: Path, tmp_path: Path) -> None:
    """Two logs without names know no mode yet: status 1 and what is needed."""
    table = pd.read_csv(estimates)
    two = table[table["recorded_at"].isin(table["recorded_at"].unique()[:2])]
    two.drop(columns="mode").to_csv(tmp_path / "two.csv", index=False)
    result = run(tmp_path / "two.csv", "--out", tmp_path / "track.csv")
    assert result.exit_code == 1
    assert "known once three logs show it" in result.stderr


# infer


@pytest.fixture
def drifts(tmp_path: Path) -> Path:
    """Write drifts of two machines, the second one's preload lower, with their cross terms."""
    rows, terms = [], []
    for stage, preload in (("AX-1", 0.9), ("AX-2", 0.7)):
        make_stage(tmp_path / "stage")
        for k, share in enumerate((0.0, 0.5, 1.0)):
            moment = f"2026-03-{k + 1:02d}T06:00:00+00:00"
            drift = true_drift(("guide_preload", "mount_stiffness"), share * np.log([preload, 0.9]))
            for mode, size in zip(("roll", "pitch"), drift, strict=False):
                rows.append((stage, moment, 100.0 * k, mode, size, 1e-3 * (k > 0)))
            terms.append((stage, moment, "roll", "pitch", 3e-7 * (k > 0)))
    columns = ["stage", "recorded_at", "travel_km", "mode", "drift", "drift_std"]
    path = tmp_path / "track.csv"
    pd.DataFrame(rows, columns=columns).to_csv(path, index=False)
    columns = ["stage", "recorded_at", "mode_a", "mode_b", "cov_drift"]
    pd.DataFrame(terms, columns=columns).to_csv(tmp_path / "track_cov.csv", index=False)
    return path


def infer(*words: object) -> Result:
    """Run the command on drifts."""
    return CliRunner().invoke(main, ["infer", *map(str, words)])


@pytest.mark.slow
def test_drifts_become_health(drifts: Path, tmp_path: Path) -> None:
    """Every machine has its epochs in the table and its draws in the file; the truth is inside."""
    toml = tmp_path / "stage" / "small.toml"
    out, draws = tmp_path / "new" / "health.csv", tmp_path / "health.nc"
    result = infer(drifts, "--stage", toml, "--out", out, "--posterior", draws)
    assert result.exit_code == 0, result.output
    table = pd.read_csv(out)
    assert tuple(table.columns[:11]) == TABLES["health"].names[:11]
    sampler = table.groupby("recorded_at")["sampler"].unique()
    assert [list(one) for one in sampler] == [["importance"], ["importance"]]
    last = table[table["recorded_at"].str.startswith("2026-03-03")].set_index(
        ["stage", "parameter"]
    )
    for stage, preload in (("AX-1", 0.9), ("AX-2", 0.7)):
        row: Any = last.loc[stage, "guide_preload"]
        assert row["q05"] < preload < row["q95"]
        assert f"{stage}: health at 2026-03-03" in result.stdout
    tree = xarray.open_datatree(draws, engine="h5netcdf")
    median = np.median(tree["AX-2/posterior"].to_dataset()["guide_preload"][..., -1])
    assert median == pytest.approx(row["median"])


@pytest.mark.slow
def test_the_seed_alone_decides(drifts: Path, tmp_path: Path) -> None:
    """The same seed gives the same file to the byte, another one another file."""
    toml = tmp_path / "stage" / "small.toml"
    outs = [tmp_path / f"{k}.csv" for k in range(3)]
    for out, seed in zip(outs, (0, 0, 1), strict=True):
        result = infer(drifts, "--stage", toml, "--out", out, "--seed", seed, "--epochs", 1)
        assert result.exit_code == 0
    assert outs[0].read_bytes() == outs[1].read_bytes() != outs[2].read_bytes()


@pytest.mark.slow
def test_estimates_become_the_health_of_their_lives(estimates: Path, tmp_path: Path) -> None:
    """A table of estimates is tracked, and health is that of `infer` on what was accepted."""
    stage = make_stage(tmp_path / "stage", (FADING,))
    toml, out = tmp_path / "stage" / "small.toml", tmp_path / "health.csv"
    table = pd.read_csv(estimates)
    table[table["recorded_at"] < "2026-03-21"].to_csv(estimates, index=False)
    result = infer(estimates, "--stage", toml, "--out", out, "--epochs", 5, "--seed", 3)
    assert result.exit_code == 0, result.output
    found = pd.read_csv(out)
    assert found["recorded_at"].iloc[-1] == "2026-03-20T06:00:00+00:00"
    assert len(found) == 5
    assert set(found["sampler"]) == {"emcee"}
    ((history, _),), _ = read_machines(estimates, stage)
    accepted = accepted_estimates(history, track(history, stage))
    known = api.infer(accepted, stage, seed_of(3, "AX-1", stage.digest), epochs=5)
    assert found["median"].iloc[-1] == pytest.approx(known.latest(0.5)[0], rel=1e-5)
    assert found["q05"].iloc[-1] < 1 < found["q95"].iloc[-1]
    assert "AX-1: health at 2026-03-20" in result.stdout


def test_maintenance_is_no_part_of_drifts(drifts: Path, tmp_path: Path) -> None:
    """Drifts are since a baseline that their table knows: status 2."""
    actions = tmp_path / "maintenance.csv"
    actions.write_text("stage,recorded_at,action\nAX-1,2026-03-02T00:00:00Z,servo\n")
    toml = tmp_path / "stage" / "small.toml"
    words = ("--stage", toml, "--out", tmp_path / "h.csv", "--maintenance", actions)
    result = infer(drifts, *words)
    assert result.exit_code == 2
    assert "--maintenance belongs to a table of estimates" in result.stderr


@pytest.mark.slow
def test_a_machine_without_drifts_is_reported_and_the_others_are_inferred(
    drifts: Path, tmp_path: Path
) -> None:
    """Status 3 where one of two machines has nothing to infer from, 1 where none has."""
    toml = tmp_path / "stage" / "small.toml"
    table = pd.read_csv(drifts)
    table.loc[table["stage"] == "AX-2", "mode"] += "2"
    table.to_csv(drifts, index=False)
    out = tmp_path / "health.csv"
    result = infer(drifts, "--stage", toml, "--out", out)
    assert result.exit_code == 3
    assert "AX-2: no epoch has a drift of any of the modes ['roll', 'pitch']" in result.stderr
    assert set(pd.read_csv(out)["stage"]) == {"AX-1"}
    table[table["stage"] == "AX-2"].to_csv(drifts, index=False)
    result = infer(drifts, "--stage", toml, "--out", tmp_path / "none.csv")
    assert result.exit_code == 1
    # One misspelt mode would be left out without a word.
    table[table["stage"] == "AX-2"].replace("pitch2", "pitch").to_csv(drifts, index=False)
    result = infer(drifts, "--stage", toml, "--out", tmp_path / "none.csv")
    assert result.exit_code == 1
    assert "AX-2: modes ['roll2'] are none of" in result.stderr
    assert not (tmp_path / "none.csv").exists()


# stage


def check(*words: object) -> Result:
    """Check a stage description on the command line."""
    return CliRunner().invoke(main, ["stage", *map(str, words)])


def test_a_valid_description_gives_tables_and_sentences(tmp_path: Path) -> None:
    """Status 0, nothing on standard error; what the X stage cannot see is no failure."""
    make_stage(tmp_path)
    for reference in (tmp_path / "small.toml", "lms-x"):
        result = check(reference)
        assert (result.exit_code, result.stderr) == (0, "")
        assert "Sensitivity" in result.stdout
    assert "mount_stiffness is not identifiable" in result.stdout


@pytest.mark.parametrize("parameters", [(), (FADING,), (FADING, FOOT, MOUNT)])
def test_as_json_it_has_numbers_and_null(tmp_path: Path, parameters: tuple[str, ...]) -> None:
    """Rows for as many parameters as there are; what is missing is null, never NaN."""
    make_stage(tmp_path, parameters)

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    result = check(tmp_path / "small.toml", "--format", "json")
    content = json.loads(result.stdout, parse_constant=refuse)
    n = len(parameters)
    assert [len(content[key]) for key in ("stage", "modes", "parameters")] == [1, 2, n]
    assert [len(content[key]) for key in ("sensitivities", "correlations")] == [
        2 * n,
        n * (n - 1) / 2,
    ]
    assert {row["verdict"] for row in content["parameters"]} <= {"identifiable", "not-identifiable"}
    assert content["schema"] == 2 and (content["stage"][0]["model_std"] is None) == (n == 0)
    assert content["findings"][0]["topic"] == "parameters"


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("damping_ratio = 0.018", "damping_ratio = 1.8", "mode[0].damping_ratio: "),
        ("limit =", "limits =", "parameter[0].limits: unknown key; known are name, prior"),
        ('"map.csv"', '"gone.csv"', "map.file: there is no file "),
        ("[map]", "[map", "no TOML: "),
    ],
)
def test_a_slip_is_one_line_and_status_1(tmp_path: Path, old: str, new: str, expected: str) -> None:
    """The line names file, line, key, and what is needed."""
    make_stage(tmp_path)
    path = tmp_path / "small.toml"
    path.write_text(path.read_text().replace(old, new, 1))
    result = check(path)
    assert (result.exit_code, result.stdout) == (1, "")
    assert result.stderr.startswith(f"lmshealth: {path}: {expected}")
    assert result.stderr.count("\n") == 1


def test_a_map_that_is_none_and_names_nobody_knows(tmp_path: Path) -> None:
    """Invalid cells are reported with their line, unknown names with the known ones."""
    make_stage(tmp_path)
    table = tmp_path / "map.csv"
    table.write_text(table.read_text().replace("\n0.2", "\na", 1))
    result = check(tmp_path / "small.toml")
    assert result.exit_code == 1
    assert "map.csv: line 2: guide_preload is a" in result.stderr
    assert "needed is a positive number" in result.stderr
    assert "lms-x, lms-y" in check("lms-z").stderr
    for path in (tmp_path / "gone.toml", tmp_path / "folder.toml"):
        (tmp_path / "folder.toml").mkdir(exist_ok=True)
        result = check(path)
        assert result.exit_code == 1
        assert f"{path}: cannot read the stage description: " in result.stderr
