"""The tutorial: its commands print what it shows, and its results agree with the truth."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import pytest

from studies.notebooks.new_machine.cut import APART_H, SLOWER

ROOT = Path(__file__).parents[1]
TUTORIAL = ROOT / "studies" / "notebooks" / "new_machine"
LIMIT = 0.8  # of the stiffness
_BLOCK = re.compile(r"^```(sh|text)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_DIGITS = re.compile(r"[-+]?\d[\d.,]*(e[-+]?\d+)?")


class Step(NamedTuple):
    """Commands of the tutorial, and the lines of output that it shows."""

    commands: str
    shown: str


def steps() -> list[Step]:
    """Read the blocks of commands of the tutorial, each with the output shown after it."""
    found: list[Step] = []
    for kind, text in _BLOCK.findall((TUTORIAL / "README.md").read_text(encoding="utf-8")):
        if kind == "sh":
            found.append(Step(text, ""))
        else:
            found[-1] = found[-1]._replace(shown=found[-1].shown + text)
    return found


def follow(step: Step, folder: Path) -> list[str]:
    """Run a step in a shell; return the lines that the tutorial shows and that are not printed."""
    python = f"'{sys.executable}'"
    tools = f'lmshealth() {{ {python} -m lmshealth "$@"; }}\npython() {{ {python} "$@"; }}\n'
    done = subprocess.run(
        ["sh", "-e", "-c", tools + step.commands],
        capture_output=True, text=True, check=False, cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "80"},
    )  # fmt: skip
    assert done.returncode == 0, f"{step.commands}ended with {done.returncode}: {done.stderr}"
    came = {plain(line) for line in (done.stdout + done.stderr).splitlines()}
    return [line for line in step.shown.splitlines() if plain(line) not in came]


def plain(line: str) -> str:
    """Normalise a line: replace numbers by 0, as last digits may differ, and collapse blanks."""
    return " ".join(_DIGITS.sub("0", line).split())


class Followed(NamedTuple):
    """The folder of results of the tutorial, and what it shows and does not print, by commands."""

    folder: Path
    not_printed: dict[str, list[str]]


@pytest.fixture(scope="module")
def followed(tmp_path_factory: pytest.TempPathFactory, needs: Callable[[str], None]) -> Followed:
    """Follow the tutorial to its end."""
    needs("data")
    folder = tmp_path_factory.mktemp("tutorial")
    (folder / "studies").symlink_to(TUTORIAL.parents[1])
    missing = {step.commands: follow(step, folder) for step in steps()}
    return Followed(folder / "bench", {own: lines for own, lines in missing.items() if lines})


def stiffness(bench: Path, machine: str) -> pd.DataFrame:
    """Read the inferred stiffness of a machine, and add the true one: it follows from the dates."""
    health = pd.read_csv(bench / "health.csv")
    own = health[health["stage"] == machine]
    logs = (own["travel_km"] / APART_H).round()
    return own.assign(truth=(1 - SLOWER * logs) ** 2 if machine == "bench-B" else 1.0)


@pytest.mark.study
def test_the_tutorial_prints_what_it_shows(followed: Followed) -> None:
    """All commands print what is shown, and write the files that stand beside the tutorial."""
    assert followed.not_printed == {}
    for made, name in (("bench.map.csv", "bench.map.csv"), ("logs/manifest.csv", "manifest.csv")):
        assert (followed.folder / made).read_bytes() == (TUTORIAL / name).read_bytes()


@pytest.mark.study
def test_the_machine_that_loses_stiffness_is_found(followed: Followed) -> None:
    """It alone alarms; its stiffness and its end are inside their 90 % intervals.

    Half of its loss is outside of that of the last log (control).
    """
    own = stiffness(followed.folder, "bench-B")
    assert own["converged"].all()
    assert own["truth"].between(own["q05"], own["q95"]).all()
    assert not ((1 + own["truth"]) / 2).between(own["q05"], own["q95"]).iloc[-1]
    events = pd.read_csv(followed.folder / "events.csv")
    assert events.loc[events["kind"] == "alarm", "stage"].tolist() == ["bench-B"]
    prognosis = pd.read_csv(followed.folder / "prognosis.csv")
    left = prognosis[prognosis["parameter"] == "coupling_stiffness"].set_index("stage")
    assert left["probability_beyond_horizon"]["bench-A"] > 0.9
    last = float(pd.read_csv(followed.folder / "modes.csv")["travel_km"].max())
    end = (1 - float(np.sqrt(LIMIT))) / SLOWER * APART_H - last
    assert left["rul_km_q05"]["bench-B"] <= end <= left["rul_km_q95"]["bench-B"]


@pytest.mark.study
def test_the_other_machine_keeps_its_stiffness(followed: Followed) -> None:
    """It is 1 within 0.2 % at every log."""
    own = stiffness(followed.folder, "bench-A")
    assert own["converged"].all()
    assert np.abs(own["median"] - 1).max() < 0.002


@pytest.mark.study
def test_the_other_machine_is_inside_its_intervals(followed: Followed) -> None:
    """The 90 % intervals of the stiffness that it keeps hold 1 at every log."""
    own = stiffness(followed.folder, "bench-A")
    assert own["truth"].between(own["q05"], own["q95"]).all()


def test_a_line_of_the_tutorial_that_is_not_printed_is_seen(tmp_path: Path) -> None:
    """Digits may differ, words may not; a command that fails fails the test with its error."""
    shown = "one 1.25 of 3\ntwo 2.5\nthree words\n"
    step = Step("echo 'one 1.26   of 3'\necho 'three  words'\n", shown)
    assert follow(step, tmp_path) == ["two 2.5"]
    with pytest.raises(AssertionError, match=r"(?s)ended with 2: .*no-such-command"):
        follow(Step("lmshealth no-such-command\n", ""), tmp_path)
