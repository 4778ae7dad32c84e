"""Analysis of one machine in one call: a folder, files and logs that are read give the same."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lmshealth
from lmshealth import examples
from lmshealth.errors import BadQuestion, BadStage, BadTable, NotEnoughData
from lmshealth.io.column_map import column_map

EXPORT = {"columns": {"acc_pitch_m_s2": "a2"}}


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write two logs of noise, which excite no mode, with a column of another name."""
    folder = tmp_path_factory.mktemp("logs")
    for k in range(2):
        head = ["# sample_rate_hz: 1000", "# stage: AX-3-Y", f"# travel_km: {k}"]
        head += [f"# recorded_at: 2026-07-1{k}T06:00:00Z", "a2"]
        noise = np.random.default_rng(k).standard_normal(20_000)
        np.savetxt(folder / f"{k}.csv", noise, header="\n".join(head), comments="")
    return folder


def test_a_folder_files_and_logs_give_the_same(logs: Path) -> None:
    """Paths may be texts; a log that was read is not read again."""
    stage = lmshealth.load_stage("lms-y")
    paths = sorted(logs.glob("*.csv"))
    read = [lmshealth.read_log(path, columns=EXPORT) for path in paths]
    given: list[Any] = [str(logs), logs, paths, [str(path) for path in paths], read]
    found = [lmshealth.analyse(one, stage, columns=EXPORT) for one in given]
    assert {one.judgement.verdict for one in found} == {"not-enough-data"}
    assert {len(one.refused) for one in found} == {6}  # three modes of two logs
    refused = {(Path(row.log).name, row.mode) for one in found for row in one.refused}
    assert len(refused) == 6


def test_a_copy_of_a_log_is_refused(logs: Path, tmp_path: Path) -> None:
    """It would count as another log."""
    folder = tmp_path / "logs"
    shutil.copytree(logs, folder)
    shutil.copy(folder / "0.csv", folder / "copy.csv")
    found = lmshealth.analyse(folder, lmshealth.load_stage("lms-y"), columns=EXPORT)
    assert [Path(log).name for log in found.history.logs] == ["0.csv", "1.csv"]
    (row,) = (one for one in found.refused if one.reason == "duplicate")
    assert (Path(row.log).name, row.detail[:15]) == ("copy.csv", "same content as")
    (folder / "manifest.csv").write_text("file,travel_km\n0.csv,5\ncopy.csv,7\n")
    found = lmshealth.analyse(folder, lmshealth.load_stage("lms-y"), columns=EXPORT)
    (row,) = (one for one in found.refused if one.reason == "bad-row")
    assert "travel_km 7 (there 5)" in row.detail


def test_of_two_copies_the_one_in_the_manifest_is_analysed(logs: Path, tmp_path: Path) -> None:
    """Only that one has its metadata; also where another name comes first."""
    folder = tmp_path / "logs"
    shutil.copytree(logs, folder)
    shutil.copy(folder / "1.csv", folder / "0-copy.csv")
    (folder / "manifest.csv").write_text("file,travel_km\n0.csv,0\n1.csv,7\n")
    for given in (folder, sorted(folder.glob("[01]*.csv"))):
        found = lmshealth.analyse(given, lmshealth.load_stage("lms-y"), columns=EXPORT)
        assert [Path(log).name for log in found.history.logs] == ["0.csv", "1.csv"]
        assert found.history.travel.tolist() == [0.0, 7000.0]


def test_a_log_of_another_machine_is_refused(logs: Path) -> None:
    """As in a run: its modes are not those of the description."""
    with pytest.raises(NotEnoughData, match=r"no description matches stage 'AX-3-Y'"):
        lmshealth.analyse(logs, lmshealth.load_stage("lms-x"), columns=EXPORT)


def test_notices_are_of_the_machine(logs: Path, tmp_path: Path) -> None:
    """A refused baseline of another machine, and a bad column, are no logs that it has lost."""
    folder = tmp_path / "logs"
    shutil.copytree(logs, folder)
    other = (folder / "0.csv").read_text().replace("AX-3-Y", "AX-3-X").replace("km: 0", "km: 5")
    (folder / "x.csv").write_text(other)
    (folder / "torn.csv").write_text("# stage: AX-3-Y\nno log\n")
    rows = "0.csv,,false\n1.csv,,false\nx.csv,,true\ntorn.csv,AX-3-Y,\n"
    (folder / "manifest.csv").write_text(f"file,stage,baseline,travel_kms\n{rows}")
    found = lmshealth.analyse(folder, lmshealth.load_stage("lms-y"), columns=EXPORT)
    assert {one.reason for one in found.refused} >= {"no-stage", "unlike-key"}
    assert [Path(one.log).name for one in found.lost] == ["torn.csv"]
    assert [one.where for one in found.notices if one.code == "baseline-refused"] == []


def test_questions_out_of_range_are_refused_before_a_log_is_read(tmp_path: Path) -> None:
    """No epoch, no such seed, and a log that is there twice."""
    stage = lmshealth.load_stage("lms-y")
    for epochs, seed in ((0, 0), (1, -1)):
        with pytest.raises(BadQuestion, match="needed are at least 1 and at least 0"):
            lmshealth.analyse(tmp_path / "none", stage, epochs=epochs, seed=seed)
    readings = examples.readings()[:2]
    with pytest.raises(BadQuestion, match=r"log-0001.h5, log-0001.h5 are one log; needed is each"):
        lmshealth.assess([*readings, readings[0]], stage)


def test_files_are_analysed_with_the_maintenance_beside_them(logs: Path, tmp_path: Path) -> None:
    """It opens the same baseline as that of the folder."""
    folder = tmp_path / "logs"
    shutil.copytree(logs, folder)
    (folder / "maintenance.csv").write_text(
        "stage,recorded_at,action\nAX-3-Y,2026-07-10T12:00:00Z,preload-adjust\n,,\n"
    )
    stage = lmshealth.load_stage("lms-y")
    for given in (folder, sorted(folder.glob("[01].csv"))):
        found = lmshealth.analyse(given, stage, columns=EXPORT)
        assert found.history.baseline == 1
        assert [one.code for one in found.notices].count("new-baseline") == 1


def test_a_refused_log_that_was_declared_as_baseline_is_named(logs: Path, tmp_path: Path) -> None:
    """A log that cannot be read, and one that is not there: what is used instead is stated."""
    folder = tmp_path / "logs"
    shutil.copytree(logs, folder)
    (folder / "a.csv").write_text("no log\n")
    rows = "a.csv,true\ngone.csv,TRUE\n0.csv,false\n"
    (folder / "manifest.csv").write_text(f"file,baseline\n{rows}")
    found = lmshealth.analyse(folder, lmshealth.load_stage("lms-y"), columns=EXPORT)
    named = [one for one in found.notices if one.code == "baseline-refused"]
    assert sorted(Path(one.where).name for one in named) == ["a.csv", "gone.csv"]
    assert all(one.what.endswith("0.csv.") for one in named)


def test_a_map_is_a_mapping_or_a_file(logs: Path, tmp_path: Path) -> None:
    """Both read the same channels; a mapping with unknown keys is refused as a file is."""
    path = tmp_path / "map.toml"
    path.write_text('[columns]\nacc_pitch_m_s2 = "a2"\n')
    for columns in (EXPORT, path, str(path), column_map(EXPORT)):
        (channel,) = lmshealth.read_log(logs / "0.csv", columns=columns).channels
        assert channel.name == "acc_pitch"
    with pytest.raises(BadTable, match=r"column map: .*collumns"):
        lmshealth.read_log(logs / "0.csv", columns={"collumns": {}})
    with pytest.raises(BadTable, match=r"column map: .*one column twice"):
        twice = {"acc_pitch_m_s2": "a2", "acc_roll_m_s2": "a2"}
        lmshealth.read_log(logs / "0.csv", columns={"columns": twice})


def test_without_a_usable_log_the_reason_is_named(logs: Path) -> None:
    """Each log that was refused is in the error, by the name that was given."""
    with pytest.raises(NotEnoughData, match=r"0\.csv: "):
        lmshealth.analyse([logs / "0.csv"], lmshealth.load_stage("lms-y"))


def test_a_name_is_no_stage(logs: Path, tmp_path: Path) -> None:
    """The error names what loads one; a run asks for several."""
    name: Any = "lms-y"
    stage = lmshealth.load_stage(name)
    log = lmshealth.read_log(logs / "0.csv", columns=EXPORT)
    for call in (
        lambda: lmshealth.analyse(logs, name),
        lambda: lmshealth.assess([], name),
        lambda: lmshealth.identify(log, name),
        lambda: lmshealth.run(logs, [name], tmp_path / "out"),
    ):
        with pytest.raises(BadStage, match=r"'lms-y' of type str; needed load_stage\('lms-y'\)"):
            call()
    lone: Any = stage
    for one in (name, lone):
        with pytest.raises(BadStage, match="needed a list of results of load_stage"):
            lmshealth.run(logs, one, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_work_on_a_machine_without_logs_is_noticed(logs: Path, tmp_path: Path) -> None:
    """Its name may be misspelt: the command notes it, too."""
    folder = tmp_path / "logs"
    shutil.copytree(logs, folder)
    (folder / "maintenance.csv").write_text(
        "stage,recorded_at,action\nAX-3Y,2026-07-10T12:00:00Z,regrease\n"
    )
    found = lmshealth.analyse(folder, lmshealth.load_stage("lms-y"), columns=EXPORT)
    (notice,) = (one for one in found.notices if one.code == "maintenance-unused")
    assert "work on AX-3Y is not used" in notice.what and "is it AX-3-Y?" in notice.what
