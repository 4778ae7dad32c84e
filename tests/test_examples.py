"""Every example of a public name runs as it stands, and so does the one of the README."""

from __future__ import annotations

import doctest
import importlib
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import redirect_stdout
from datetime import date
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lmshealth
from lmshealth import examples
from lmshealth.stage.description import load_stage
from tests.test_api import FUNCTIONS

# What the module of the example says of its machine: preload and mount left, and km to the limit.
LEFT, KM_LEFT = (0.72, 0.87), 2457 - 1632


def example_of(name: str) -> doctest.DocTest:
    """Find the example in the docstring of a public name."""
    found = getattr(lmshealth, name)
    home = importlib.import_module(found.__module__)
    (test,) = doctest.DocTestFinder(recurse=False).find(found, name, home, globs={})
    return test


def outcome(test: doctest.DocTest) -> str:
    """Run an example and give what was not as it says."""
    told: list[str] = []
    doctest.DocTestRunner().run(test, out=told.append)
    return "".join(told)


@pytest.mark.slow
@pytest.mark.parametrize("name", FUNCTIONS)
def test_example(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A user who pastes the example of a name, and nothing before it, sees what it says."""
    test = example_of(name)
    assert test.examples, f"{name} has no example"
    assert any(f"lmshealth.{name}" in example.source for example in test.examples)
    monkeypatch.chdir(tmp_path)
    assert outcome(test) == ""


def test_an_example_that_says_otherwise_is_found_out() -> None:
    """An example whose answer is another one does not pass."""
    test = example_of("LmshealthError")
    test.examples[-1].want = "nothing.h5: empty: 0 bytes\n"
    assert "missing-file" in outcome(test)


def test_the_example_life_is_a_table_of_a_wearing_machine() -> None:
    """Its truth is where the module says, as far as the drifts tell without priors."""
    stage, history = load_stage("lms-y"), examples.history()
    assert (len(history.logs), len(examples.readings())) == (24, 24)
    track = lmshealth.track(history, stage)
    expected = stage.drift(np.log([LEFT]), track.modes)[0]
    off = track.drift[-1] - expected
    # Two roundings of a percent move ln f by some 0.003.
    assert np.abs(off).max() < 0.003 + 4 * np.sqrt(np.diag(track.drift_cov[-1])).max()


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory, root: Path) -> Path:
    """Half a dozen short logs of a simulated stage that wears, as a user has them."""
    folder = tmp_path_factory.mktemp("readme")
    words = ["simulate", "lms-y", "--life", "both", "--logs", "6", "--seconds", "10"]
    words += ["--seed", "3", "--workers", "1"]
    command = [sys.executable, "-m", "models", *words, "--out", str(folder / "logs")]
    subprocess.run(command, check=True, cwd=root, capture_output=True)
    return folder


def python_of(readme: Path) -> Iterator[str]:
    """Find the blocks of Python in the README."""
    yield from re.findall(r"^```python\n(.*?)^```$", readme.read_text(), re.S | re.M)


@pytest.mark.slow
def test_python_of_the_readme(logs: Path, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The example of the README goes from logs to a service date, and says what it prints."""
    (program,) = python_of(root / "README.md")
    monkeypatch.chdir(logs)
    known: dict[str, Any] = {}
    with redirect_stdout(StringIO()) as shown:
        exec(compile(program, "README.md", "exec"), known)
    found = known["found"]
    assert len(found.history.logs) == 6
    assert not known["refused"]
    first, *shown_track = shown.getvalue().splitlines()
    *why, service = first.split()
    assert service == "None" or date.fromisoformat(service) > date(2026, 1, 1)
    assert " ".join(why).startswith("Guide preload is at ")
    assert 1 < len(shown_track) <= 8
    # The exports that the text names.
    health = found.health
    assert set(health.to_arviz()["posterior"].data_vars) == set(health.parameters)
    assert set(health.to_frame()["parameter"]) == set(health.parameters)
