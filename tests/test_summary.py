"""The page of claims is what the records say, and has them all."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from studies.harness import summary
from studies.harness.claims import STEPS, Claim, counted, covered
from studies.harness.study import Study


@pytest.fixture
def copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Copy scripts and records to a folder that the page is then of."""
    for path in summary.HERE.glob("*/*"):
        if path.suffix in (".py", ".json"):
            there = tmp_path / path.parent.name / path.name
            there.parent.mkdir(exist_ok=True)
            there.write_bytes(path.read_bytes())
    monkeypatch.setattr(summary, "HERE", tmp_path)
    return tmp_path


def test_page_is_up_to_date() -> None:
    """The page beside the studies is what `python -m studies.harness.summary` writes."""
    assert summary.PAGE.read_text(encoding="utf-8") == summary.page()


def test_every_record_claims_something() -> None:
    """Every record of a study is on the page, with a claim of a known step, its date and links."""
    found = {(record.study, record.name): record for record in summary.records()}
    recorded = {(path.parent.name, path.stem) for path in summary.HERE.glob("*/*.json")}
    assert recorded == {key for key, record in found.items() if record.content is not None}
    text = summary.page()
    for (study, name), record in found.items():
        assert record.step in STEPS
        assert f"({study}/{record.script})" in text
        if record.content is not None:
            assert record.claims
            assert f"({study}/{name}.json)" in text
            assert record.content["recorded"]["date"] in text


def test_every_study_has_claims() -> None:
    """Every program that can record something has a place on the page."""
    told = {(record.study, record.script) for record in summary.records()}
    programs = {
        (path.parent.name, path.name)
        for path in summary.HERE.glob("*/*.py")
        if "study.conclude(" in path.read_text(encoding="utf-8")
    }
    assert programs == told


def test_figures_follow_the_record(copied: Path) -> None:
    """Another record gives other figures, ends the note that it is older, and may not be met."""
    path = copied / "demo_life" / "result.json"
    before = summary.page()
    record = json.loads(path.read_text())
    assert record["n_lives"] == record["remaining_km"]["inside_90"] == 10
    assert "Recorded before laws were weighed" in before.split("### demo_life")[1].split("###")[0]
    record["remaining_km"]["inside_90"] = 7
    path.write_text(json.dumps(record))
    part = summary.page().split("### demo_life")[1].split("###")[0]
    assert "7 of 10" in part
    assert "7 of 10" not in before.split("### demo_life")[1].split("###")[0]
    assert "Recorded before" not in part


def test_missing_record_is_told(copied: Path) -> None:
    """What is not recorded is told, and claims nothing."""
    (copied / "crossings" / "result.json").unlink()
    text = summary.page()
    part = text.split("### crossings")[1].split("###")[0]
    assert "**Not recorded**" in part
    assert "crossings/result" in text.split("Not recorded: ")[1].split("\n")[0]
    assert "|" not in part


def test_what_failed_is_told(copied: Path) -> None:
    """What a record says not to be so stands on the page, with its reason."""
    path = copied / "frf_modes" / "result.json"
    record: dict[str, Any] = json.loads(path.read_text())
    assert "Check not met: *coverage*" not in summary.page()
    record["passed"]["coverage"] = False
    record["not_met"]["coverage"] = "the noise was another one"
    path.write_text(json.dumps(record))
    assert "Check not met: *coverage*: the noise was another one." in summary.page()


def test_claims_are_judged() -> None:
    """A coverage outside its interval is not met, and a count has its Clopper-Pearson interval."""
    row = {"share": 0.8, "n": 100, "low": 0.7, "high": 0.88, "holds": False}
    assert not covered("90 %", [row, row | {"holds": True}]).met
    assert covered("90 %", [row | {"holds": True}]).met
    assert counted("of", 10, 10) == Claim("of", "10 of 10", "69.2 to 100.0 % (95 %)")


def test_interrupted_time_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A record has the run time, and that of trials that were done before an interruption."""
    monkeypatch.setattr("sys.argv", ["run.py"])
    study = Study(str(tmp_path / "run.py"), "Is it so?\n\nMore.")
    study.trials.kept_s = 200.0
    study.conclude({"passed": {"it is": True}})
    record = json.loads((tmp_path / "result.json").read_text())
    assert record["question"] == "Is it so?"
    assert summary._duration(record["recorded"]) == "0 s, after 3 min before an interruption"


def test_quick_form_records_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The quick form keeps and records nothing, and fails where it is not as asked."""
    monkeypatch.setattr("sys.argv", ["run.py", "--quick"])
    study = Study(str(tmp_path / "run.py"), "Is it so?")
    assert study.kept("anything") is None
    with pytest.raises(SystemExit, match="it is"):
        study.conclude({"passed": {"it is": False}})
    study.conclude({"passed": {"it is": False}}, not_met=["it is"])
    study.conclude({"passed": {"it is": False}}, quick_may_fail=True)
    assert not list(tmp_path.iterdir())
