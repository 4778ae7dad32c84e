"""The command `check-calibration`: tables, files, exit status, interruption, bad input."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result

from lmshealth.calibration import check, page
from tests.cli.test_main import call
from tests.lives import FADING, four_settings, make_stage

FAST = ("--logs", 12, "--lives", 2, "--workers", 1, "--seed", 2, "--km-per-day", 10)


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a description with one parameter that fades."""
    folder = tmp_path_factory.mktemp("described")
    make_stage(folder, (FADING,))
    return folder / "small.toml"


def checked(*words: object) -> Result:
    """Call the command, with few settings of the nuisances."""
    with four_settings():
        return call("check-calibration", *words)


def test_results_are_printed_and_written(stage: Path, tmp_path: Path) -> None:
    """The tables by kind of life, the verdict, and the page that has them."""
    result = checked(stage, *FAST, "--out", tmp_path / "out")
    assert (result.exit_code, result.stderr) == (0, "")
    for words in ("as described", "healthy", "foreign change", "guide preload now",
                  "date of the first limit", "alarm of the tracker (false)",
                  "No fault found"):  # fmt: skip
        assert words in result.stdout
    names = {path.name for path in (tmp_path / "out").iterdir()}
    tables = {"coverage.csv", "rates.csv", "lives.csv"}
    assert names == {*tables, "calibration.json", "calibration.html"}


def test_json_is_that_of_the_file(stage: Path, tmp_path: Path) -> None:
    """One strict document, the same on standard output as in the folder."""
    result = checked(stage, *FAST, "--out", tmp_path, "--format", "json")
    content = json.loads(result.stdout, parse_constant=pytest.fail)
    assert content["state"] == "open"
    assert content == json.loads((tmp_path / "calibration.json").read_text())


def test_what_is_not_as_stated_is_status_1(stage: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With one line on standard error, after the tables."""
    monkeypatch.setattr(page, "verdict_of", lambda _: ("bad", "Not as stated", ["why"]))
    result = checked(stage, *FAST)
    assert result.exit_code == 1
    assert "Not as stated. why" in result.stdout
    assert len(result.stderr.splitlines()) == 1


def test_an_interruption_leaves_what_is_done(
    stage: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lives that are done are in the tables, and the status is that of an interruption."""
    whole = check.draw_outcomes

    def interrupted(*words: Any, **options: Any) -> Iterator[Any]:
        yield next(whole(*words, **options))
        raise KeyboardInterrupt

    monkeypatch.setattr(check, "draw_outcomes", interrupted)
    result = checked(stage, *FAST, "--out", tmp_path)
    assert result.exit_code == 130
    assert "1 of 4 lives are done" in result.stderr
    assert json.loads((tmp_path / "calibration.json").read_text())["coverage"][0]["n"] == 1


@pytest.mark.parametrize(
    ("words", "status", "why"),
    [
        (("lms-z",), 1, "no stage description"),
        (("lms-y", "--logs", 5), 2, "12<=x<=200"),
        (("lms-y", "--every", 0), 2, "--every"),
        (("lms-y", "--seconds", 0.1, "--workers", 1, "--lives", 1), 1, "too short to identify"),
        (("lms-y", "--km-per-day", 1e6, "--workers", 1, "--lives", 1), 1, "inside the modal map"),
        (("lms-y", "--lives", 0), 2, "--lives"),
        ((), 2, "STAGE"),
    ],
)
def test_bad_input_is_named(words: tuple[object, ...], status: int, why: str) -> None:
    """In one line, which says what is needed."""
    result = checked(*words)
    assert result.exit_code == status
    assert why in result.stderr


def test_a_description_without_parameters_cannot_be_checked(tmp_path: Path) -> None:
    """Nothing links health to its frequencies."""
    make_stage(tmp_path, ())
    result = checked(tmp_path / "small.toml", *FAST)
    assert result.exit_code == 1
    assert "no [map]" in result.stderr
