"""The terminal's view of a stage description fits the terminal, whatever the description has."""

from __future__ import annotations

from pathlib import Path

import pytest

from lmshealth.cli.stageview import print_stage
from lmshealth.report.tables import stage_rows
from lmshealth.stage.check import check_stage, diagnose
from lmshealth.stage.description import Stage, load_stage
from tests.lives import FOOT, MOUNT, PRELOAD, make_stage


def shown(stage: Stage, capsys: pytest.CaptureFixture[str]) -> str:
    """Examine and print."""
    examined = check_stage(stage)
    print_stage(stage_rows(examined, diagnose(examined)))
    return capsys.readouterr().out


@pytest.mark.parametrize("name", ["lms-x", "lms-y"])
def test_the_shipped_descriptions_fit_eighty_columns(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Modes, parameters, what is known, sensitivities, correlation, diagnose: no line breaks."""
    out = shown(load_stage(name), capsys)
    assert max(len(line) for line in out.splitlines()) <= 80
    assert all(out.count(word) >= 4 for word in ("guide_preload", "mount_stiffness"))
    heads = ("map error", "prior beyond", "endless logs", "Sensitivity", "Correlation")
    assert all(head in out for head in heads)
    assert "+ guide_preload is identifiable" in out
    assert ("! mount_stiffness is not identifiable" in out) == (name == "lms-x")


def test_what_is_missing_is_a_dash(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Three parameters, one without a limit whose map ends above another's limit."""
    low = PRELOAD.replace("below = 0.6", "below = 0.1")
    out = shown(make_stage(tmp_path, (low, MOUNT, FOOT)), capsys)
    assert "→ –" in out
    assert out.count("Correlation of") == 3
    assert "nan" not in out


def test_without_health_only_modes_are_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One table and one sentence."""
    out = shown(make_stage(tmp_path, ()), capsys)
    assert "roll" in out
    assert "Sensitivity" not in out
    assert "nan" not in out
    assert "No [[parameter]]" in out
