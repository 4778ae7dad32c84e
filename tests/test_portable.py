"""Tests and modules of this project are imported where POSIX and the extras are not there."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


def ends(root: Path, folder: Path) -> tuple[int, str]:
    """Collect the tests of a folder without POSIX; return exit status and output."""
    words = [sys.executable, "-m", "tests.portable", str(folder)]
    done = subprocess.run(words, cwd=root, capture_output=True, text=True, check=False)
    return done.returncode, (done.stdout + done.stderr)[-3000:]


@pytest.mark.slow
def test_all_tests_are_collected_without_posix(root: Path) -> None:
    """As on Windows, with the extras of the workflow `compat`; studies are imported as well."""
    status, output = ends(root, root)
    assert status == 0, output


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "passes"),
    [
        ("import resource", False),
        ("from os import fork", False),
        ("import signal; NUMBER = signal.SIGKILL", False),
        ("import weasyprint", False),
        ("import os, signal; NUMBERS = os.getpid, signal.SIGTERM", True),
    ],
)
def test_a_posix_import_is_noticed(root: Path, tmp_path: Path, line: str, passes: bool) -> None:
    """Control: one line at the top of a test."""
    (tmp_path / "test_one.py").write_text(f"{line}\n\n\ndef test_nothing() -> None:\n    pass\n")
    assert (ends(root, tmp_path)[0] == 0) == passes
