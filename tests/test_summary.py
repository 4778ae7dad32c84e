"""The pages of claims are computed from the records, and have all of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from studies.harness import front_page, summary
from studies.harness.claims import Claim, counted, covered
from studies.harness.figures import draw, shown
from studies.harness.study import Study
from studies.track import drift


@pytest.fixture
def copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Copy scripts, records and pages to a folder that the pages are then of."""
    for path in summary.HERE.rglob("*"):
        if path.suffix in (".py", ".json", ".md"):
            there = tmp_path / path.relative_to(summary.HERE)
            there.parent.mkdir(parents=True, exist_ok=True)
            there.write_bytes(path.read_bytes())
    monkeypatch.setattr(summary, "HERE", tmp_path)
    return tmp_path


def test_pages_are_up_to_date() -> None:
    """The pages of the studies are those that `python -m studies.harness.summary` writes."""
    pages = {
        "README.md": summary.overview,
        "FRONT_PAGE.md": summary.statements,
        "PEERS.md": summary.other_programs,
    }
    for name, page_of in pages.items():
        assert (summary.HERE / name).read_text(encoding="utf-8") == page_of(), name
    for group in summary.GROUPS:
        page = (summary.HERE / group / "README.md").read_text(encoding="utf-8")
        assert page == summary.group_page(group), group


def test_the_first_page_takes_two_screens() -> None:
    """The page of all studies has at most 90 lines, and the folder eight groups."""
    assert len(summary.overview().splitlines()) <= 90
    folders = {path.relative_to(summary.HERE).parts[0] for path in summary.HERE.rglob("*.py")}
    assert folders - {"harness", "notebooks"} == set(summary.GROUPS)


def test_every_record_claims_something() -> None:
    """Every record of a study is on the page of its group, with a claim, its date and links."""
    found = [record for group in summary.GROUPS for record in summary.records(group)]
    recorded = {p for group in summary.GROUPS for p in (summary.HERE / group).rglob("*.json")}
    assert recorded == {record.path for record in found if record.content is not None}
    for group in summary.GROUPS:
        text, folder = summary.group_page(group), summary.HERE / group
        for record in summary.records(group):
            assert f"({record.script.relative_to(folder).as_posix()})" in text
            if record.content is not None:
                assert record.claims
                assert f"({record.path.relative_to(folder).as_posix()})" in text
                assert record.content["recorded"]["date"] in text


def test_every_study_has_claims() -> None:
    """Every program that can record something has a place on the page of its group."""
    stated = {record.script for group in summary.GROUPS for record in summary.records(group)}
    programs = {
        path
        for path in summary.HERE.rglob("*.py")
        if "study.conclude(" in path.read_text(encoding="utf-8")
    }
    assert programs == stated


def test_every_figure_is_of_a_record() -> None:
    """There is a figure of each record with some shares, and no other."""
    found = [record for group in summary.GROUPS for record in summary.records(group)]
    drawn = {p for group in summary.GROUPS for p in (summary.HERE / group).rglob("*.svg")}
    assert drawn == {record.figure for record in found if shown(record.claims)}


def test_figures_follow_the_record(copied: Path) -> None:
    """Another record gives other figures, in the table of claims and in the overview."""
    path = copied / "inputs" / "damaged" / "result.json"
    record = json.loads(path.read_text())
    assert record["damaged_told_right"] == 329
    claim = "damaged logs of 73 kinds refused with the right reason"
    assert f"| {claim} | 329 of 329 |" in summary.group_page("inputs")
    record["damaged_told_right"] = 211
    path.write_text(json.dumps(record))
    assert f"| {claim} | 211 of 329 |" in summary.group_page("inputs")
    assert f"{claim}: 211 of 329" in summary.overview()


def test_a_missing_record_is_reported(copied: Path) -> None:
    """A study without a record is named as such, and claims nothing."""
    (copied / "track" / "drift.json").unlink()
    part = summary.group_page("track").split("### drift")[1].split("###")[0]
    assert "**Not recorded**" in part
    assert "|" not in part
    (line,) = [one for one in summary.overview().splitlines() if "[track/drift]" in one]
    assert line.endswith("|  |  |  | no |")


def test_what_failed_is_reported(copied: Path) -> None:
    """A check that a record has as not met stands on the page, with its reason."""
    path = copied / "modes" / "frf" / "responses.json"
    record: dict[str, Any] = json.loads(path.read_text())
    assert "Check not met: *coverage*" not in summary.group_page("modes")
    record["passed"]["coverage"] = False
    record["not_met"]["coverage"] = "the noise was another one"
    path.write_text(json.dumps(record))
    expected = "Check not met: *coverage*: the noise was another one."
    assert expected in summary.group_page("modes")


def test_a_reason_may_be_found_after_the_record(
    copied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The reasons that a study has now complete those of its record."""
    path = copied / "track" / "drift.json"
    record: dict[str, Any] = json.loads(path.read_text())
    record["passed"][drift.FASTLY] = False
    path.write_text(json.dumps(record))
    assert f"Check not met: *{drift.FASTLY}*." in summary.group_page("track")
    monkeypatch.setattr(drift, "NOT_MET", {drift.FASTLY: "errors are larger"}, raising=False)
    assert f"Check not met: *{drift.FASTLY}*: errors are larger." in summary.group_page("track")


def test_claims_are_judged() -> None:
    """A coverage outside its interval is not met, and a count has its Clopper-Pearson interval."""
    row = {"share": 0.8, "n": 100, "low": 0.7, "high": 0.88, "holds": False}
    assert not covered("90 %", [row, row | {"holds": True}]).met
    assert covered("90 %", [row | {"holds": True}]).met
    assert counted("of", 10, 10) == Claim("of", "10 of 10", "69.2 to 100.0 % (95 %)")


def test_a_pool_is_no_kind() -> None:
    """A share of kinds together is beside their range, and required where it is named."""
    claims = [counted(f"held: {kind}", 5 + k, 20) for k, kind in enumerate("abcdefghi")]
    pooled = counted("held: all kinds", 0, 180, met=False)
    text = front_page.figure([*claims, pooled], "held: ", pool="all kinds")
    assert text == (
        "held: 25.0 to 65.0 % of 9 kinds, least a: 5 of 20, 8.7 to 49.1 % (95 %); 0 not met; "
        "all kinds, together: 0 of 180, 0.0 to 2.0 % (95 %) **not met**"
    )
    with pytest.raises(ValueError, match="all kinds"):
        front_page.figure(claims, "held: ", pool="all kinds")


def test_shares_are_drawn(tmp_path: Path) -> None:
    """A figure names every claim of a share; two shares are left to the table."""
    claims = [counted(f"what is counted {k}", k, 10) for k in range(3)]
    assert shown([*claims, Claim("a time", "3 s")]) == claims
    assert shown(claims[:2]) == []
    draw(claims, tmp_path / "figure.svg")
    text = (tmp_path / "figure.svg").read_text()
    assert all(claim.what in text for claim in claims)


def test_interrupted_time_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A record has the run time, and that of trials that were done before an interruption."""
    monkeypatch.setattr("sys.argv", ["run.py"])
    (tmp_path / "run.py").write_text("def main() -> None:\n    pass\n")
    study = Study(str(tmp_path / "run.py"), "Is it so?\n\nMore.")
    study.trials.kept_s = 200.0
    study.conclude({"passed": {"it is": True}})
    record = json.loads((tmp_path / "result.json").read_text())
    assert record["question"] == "Is it so?"
    assert summary._duration(record["recorded"]) == "0 s and 3 min of kept trials"


def test_quick_form_records_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The quick form keeps and records nothing, and fails where a check fails."""
    monkeypatch.setattr("sys.argv", ["run.py", "--quick"])
    study = Study(str(tmp_path / "run.py"), "Is it so?")
    study.trials.once(abs, -1)
    with pytest.raises(SystemExit, match="it is"):
        study.conclude({"passed": {"it is": False}})
    study.conclude({"passed": {"it is": False}}, not_met=["it is"])
    study.conclude({"passed": {"it is": False}}, quick_may_fail=True)
    assert not list(tmp_path.iterdir())
