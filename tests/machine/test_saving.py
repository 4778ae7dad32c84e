"""Saved results: each comes back bit for bit, and what is unknown or damaged is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import lmshealth
from lmshealth import examples
from lmshealth.errors import BadTable
from lmshealth.machine.saving import KINDS, load, save
from lmshealth.machine.summary import summarise
from lmshealth.stage.description import load_stage
from tests.assessments import leaves, worn


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Make a result of each kind, but for a frequency response."""
    stage, logs = load_stage("lms-y"), examples.readings()
    assessment = worn(tmp_path_factory.mktemp("worn"))
    service = assessment.service()
    summary = summarise(assessment, service)
    made = [
        *(assessment, assessment.health, assessment.history, assessment.track, service, summary),
        *(assessment.prognosis, assessment.judgement, stage),
        *(logs[0], logs[0].modes, lmshealth.plan(stage, "guide_preload", 0.05)),
        lmshealth.fit_life(examples.history(), stage, seed=0, chains=False),
    ]
    return {type(one).__name__: one for one in made}


@pytest.mark.parametrize("kind", sorted(set(KINDS) - {"FrfReading"}))
def test_a_result_comes_back_bit_for_bit(
    kind: str, results: dict[str, Any], tmp_path: Path
) -> None:
    """Every number, text and array is the same; the path may be a text or a Path."""
    save(results[kind], str(tmp_path / "one"))
    found = load(tmp_path / "one", KINDS[kind])
    assert type(found) is KINDS[kind]
    assert list(leaves(found)) == list(leaves(results[kind]))


def test_what_is_unknown_or_damaged_is_refused(results: dict[str, Any], tmp_path: Path) -> None:
    """Each fault is an error of one line with the path and the next step."""
    path = tmp_path / "one"
    save(results["Verdict"], path)
    line, _, content = path.read_bytes().partition(b"\n")
    head = json.loads(line)

    def refusal(**change: Any) -> str:
        path.write_bytes(json.dumps(head | change).encode() + b"\n" + content)
        with pytest.raises(BadTable) as error:
            load(path)
        assert str(error.value).startswith(f"{path}: ")
        return str(error.value)

    assert "format 2 of lmshealth" in refusal(format=2)
    assert "holds a Rumour" in refusal(lmshealth_result="Rumour")
    assert "is damaged" in refusal(sha256="0" * 64)
    assert "has other fields" in refusal(lmshealth_result="Prognosis")
    save(results["Verdict"], path)
    with pytest.raises(BadTable, match="holds a Verdict, needed a Health"):
        load(path, lmshealth.Health)
    for text in (b"", b"not a result\n", b"\x89HDF\r\n"):
        path.write_bytes(text)
        with pytest.raises(BadTable, match="no result that"):
            load(path)
    with pytest.raises(BadTable, match="cannot be read: No such file"):
        load(tmp_path / "none")


def test_only_results_can_be_saved(tmp_path: Path) -> None:
    """Another object is a TypeError that lists what can be saved, and no file is written."""
    with pytest.raises(TypeError, match="a dict cannot be saved; possible are Assessment"):
        save({}, tmp_path / "one")  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []
