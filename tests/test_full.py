"""All studies are recorded by one command: those that fail stop no other, fresh ones are kept."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from studies.harness import full, provenance
from tests.test_resume import forget

STUDY = '''"""Is this fake study run?"""

from pathlib import Path

from studies.harness.study import Study


FACTOR = 1


def main() -> None:
    study = Study(__file__, __doc__)
    with Path("runs.txt").open("a") as file:
        print("{name}", file=file)
    study.conclude({{"value": FACTOR, "passed": {{"asked": {passed}}}}})


if __name__ == "__main__":
    main()
'''


@pytest.fixture
def fake(tmp_path: Path, root: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write a group of studies: one fails a check, one has an error, two are fine."""
    monkeypatch.setenv("PYTHONPATH", str(root))
    group = tmp_path / "fakes" / "group"
    for name, passed in (("first", True), ("second", False), ("third", True)):
        (group / name).mkdir(parents=True)
        text = STUDY.format(name=name, passed=passed)
        (group / name / "run.py").write_text(text)
    (group / "broken.py").write_text("Study(__file__")
    (group / "helpers.py").write_text("raise SystemExit('this is no study')\n")
    return tmp_path / "fakes"


def runs(fake: Path) -> list[str]:
    """Return which studies ran, in order."""
    return (fake.parent / "runs.txt").read_text().split()


@pytest.mark.slow
def test_all_are_recorded_and_failures_are_named(
    fake: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What fails stops no other; a second run does only that which has no fresh record."""
    kept = fake.parent / "kept"
    failed = full.run_all(fake, ("group",), kept)
    assert failed == ["fakes.group.broken", "fakes.group.second.run"]
    assert runs(fake) == ["first", "second", "third"]
    assert "SyntaxError" in (kept / "fakes.group.broken.txt").read_text()
    assert "not as asked" in (kept / "fakes.group.second.run.txt").read_text()
    out = capsys.readouterr().out
    assert "fakes.group.first.run: done" in out
    assert "fakes.group.second.run: FAILED, see" in out
    made = {
        name: json.loads((fake / "group" / name / "result.json").read_text())["recorded"]
        for name in ("first", "second", "third")
    }
    assert made["first"]["failed"] == []
    assert made["second"]["failed"] == ["asked"]
    assert str(os.cpu_count()) in made["first"]["machine"]
    assert full.run_all(fake, ("group",), kept) == failed
    assert runs(fake) == ["first", "second", "third", "second"]
    # Text of no effect on the code leaves a record fresh; another constant does not.
    for name, old, new in (("first", "1\n\n", "1  # of no unit\n\n"), ("third", "= 1", "= 2")):
        script = fake / "group" / name / "run.py"
        script.write_text(script.read_text().replace(old, new, 1))
    forget()
    assert full.run_all(fake, ("group",), kept) == failed
    assert runs(fake)[4:] == ["second", "third"]


def test_records_of_other_code_are_not_fresh(tmp_path: Path) -> None:
    """Nor those of failed checks, of other programs that they start, of earlier versions."""
    script, record = tmp_path / "run.py", tmp_path / "result.json"
    script.write_text("def main() -> None:\n    print(1)\n")
    forget()
    code, of_program = (provenance.code_of_script(script, also) for also in ((), ("lmshealth",)))
    assert code != of_program
    assert not full.is_fresh(script)
    for made, fresh in (
        ({"code": code, "also": [], "failed": []}, True),
        ({"code": of_program, "also": ["lmshealth"], "failed": []}, True),
        ({"code": of_program, "also": [], "failed": []}, False),
        ({"code": code, "also": [], "failed": ["asked"]}, False),
        ({"commit": "abc", "failed": []}, False),
    ):
        record.write_text(json.dumps({"recorded": made}))
        assert full.is_fresh(script) == fresh
    script.write_text("def main() -> None:\n    print(2)\n")
    record.write_text(json.dumps({"recorded": {"code": code, "also": [], "failed": []}}))
    forget()
    assert not full.is_fresh(script)


def test_a_failed_check_with_a_reason_is_fresh(tmp_path: Path) -> None:
    """The reason may be found after the record; a check without one is recorded again."""
    script, record = tmp_path / "run.py", tmp_path / "result.json"
    script.write_text("NOT_MET = {'asked': 'why'}\n\n\ndef main() -> None:\n    print(1)\n")
    forget()
    code = provenance.code_of_script(script, ())
    for failed, fresh in ((["asked"], True), (["asked", "other"], False)):
        made = {"code": code, "also": [], "failed": failed}
        record.write_text(json.dumps({"recorded": made}))
        assert full.is_fresh(script) == fresh


def test_every_study_is_among_them(root: Path) -> None:
    """Every script that has claims is recorded by the command."""
    found = [path for path, _ in full.scripts(root / "studies", full.GROUPS)]
    claiming = {
        path
        for path in (root / "studies").rglob("*.py")
        if "\ndef claims(" in path.read_text(encoding="utf-8")
    }
    assert claiming <= set(found)
    # Their code is that of this function.
    assert all("\ndef main(" in path.read_text(encoding="utf-8") for path in found)
    assert len(found) == len(set(found)) >= 40


@pytest.mark.parametrize(("failed", "pages", "status"), [([], 0, 0), (["x"], 0, 1), ([], 1, 1)])
def test_the_exit_status_says_whether_all_is_recorded(
    failed: list[str], pages: int, status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A study that fails, or pages that cannot be written, are status 1."""

    class Done:
        returncode = pages

    monkeypatch.setattr(full, "run_all", lambda *_: failed)
    monkeypatch.setattr(full.subprocess, "run", lambda *_, **__: Done)
    assert full.main() == status
