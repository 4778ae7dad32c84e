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


@pytest.mark.study
def test_the_tutorial_is_right(tmp_path: Path, needs: Callable[[str], None]) -> None:
    """All commands print what is shown; the machine made to lose stiffness has the true loss.

    The other one, which keeps it, is sound. Half of the loss is outside the interval (control).
    """
    needs("data")
    (tmp_path / "studies").symlink_to(TUTORIAL.parents[1])
    for step in steps():
        assert follow(step, tmp_path) == []
    bench = tmp_path / "bench"
    for made, name in (("bench.map.csv", "bench.map.csv"), ("logs/manifest.csv", "manifest.csv")):
        assert (bench / made).read_bytes() == (TUTORIAL / name).read_bytes()
    health = pd.read_csv(bench / "health.csv")
    falling = (1 - SLOWER * (health["travel_km"] / APART_H).round()) ** 2
    truth = falling.where(health["stage"] == "bench-B", 1.0)
    assert health["converged"].all()
    assert truth.between(health["q05"], health["q95"]).all()
    half = ((1 + truth) / 2).between(health["q05"], health["q95"])
    assert not half[health["stage"] == "bench-B"].iloc[-1]
    events = pd.read_csv(bench / "events.csv")
    assert events.loc[events["kind"] == "alarm", "stage"].tolist() == ["bench-B"]
    prognosis = pd.read_csv(bench / "prognosis.csv")
    left = prognosis[prognosis["parameter"] == "coupling_stiffness"].set_index("stage")
    assert left.loc["bench-A", "probability_beyond_horizon"] > 0.9
    last = float(pd.read_csv(bench / "modes.csv")["travel_km"].max())
    end = (1 - float(np.sqrt(LIMIT))) / SLOWER * APART_H - last
    assert left.loc["bench-B", "rul_km_q05"] <= end <= left.loc["bench-B", "rul_km_q95"]


def test_a_line_of_the_tutorial_that_is_not_printed_is_seen(tmp_path: Path) -> None:
    """Digits may differ, words may not; a command that fails fails the test with its error."""
    shown = "one 1.25 of 3\ntwo 2.5\nthree words\n"
    step = Step("echo 'one 1.26   of 3'\necho 'three  words'\n", shown)
    assert follow(step, tmp_path) == ["two 2.5"]
    with pytest.raises(AssertionError, match=r"(?s)ended with 2: .*no-such-command"):
        follow(Step("lmshealth no-such-command\n", ""), tmp_path)
