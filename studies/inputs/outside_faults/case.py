"""A faulty input, what is right for it, and the same input without the fault."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

# Longer than any case takes on a busy machine: a program that hangs is a result, too.
SECONDS = 300.0


class Seen(NamedTuple):
    """Whether an answer is the right one, and the answer in a few words for the table."""

    right: bool
    answer: str


@dataclass(frozen=True, slots=True)
class Program:
    """The program of one revision, called as a process of its own."""

    code: Path  # folder of the checkout

    def environment(self) -> dict[str, str]:
        """Return the environment of this process, with the modules of the revision in front."""
        own = {"PYTHONPATH": str(self.code), "COLUMNS": "100", "OPENBLAS_NUM_THREADS": "1"}
        own["PYTHONSAFEPATH"] = "1"  # else the working directory is in front of it
        return {**os.environ, **own}

    def command(self, *arguments: str | Path) -> list[str]:
        """Return the command line of a call."""
        return [sys.executable, "-m", "lmshealth", *map(str, arguments)]

    def __call__(self, *arguments: str | Path, **options: Any) -> subprocess.CompletedProcess[str]:
        """Call the command line of the program and wait for its end.

        Options are those of `subprocess.run`; ``env`` is added to the environment.
        """
        env = self.environment() | options.pop("env", {})
        defaults: dict[str, Any] = {"capture_output": True, "text": True, "timeout": SECONDS}
        return subprocess.run(
            self.command(*arguments), check=False, env=env, **(defaults | options)
        )

    def json(self, *arguments: str | Path) -> dict[str, Any]:
        """Return the JSON answer of a call; empty where it fails."""
        done = self(*arguments, "--format", "json")
        found: dict[str, Any] = json.loads(done.stdout) if done.stdout.strip() else {}
        return found


@dataclass(frozen=True, slots=True)
class Case:
    """A fault of one kind.

    ``fault`` and ``control`` call a program in an empty folder: with the faulty input, and with the
    same input without the fault, which must be answered without refusal and without flag.
    """

    kind: str
    name: str
    right: str
    fault: Callable[[Program, Path], Seen]
    control: Callable[[Program, Path], Seen]


def last_line(text: str) -> str:
    """Return the last line of an output, cut to the width of a table."""
    return (text.strip().splitlines() or [""])[-1][:160]


def is_traceback(done: subprocess.CompletedProcess[str]) -> bool:
    """Return whether a call ended with a traceback or with a request to report an error."""
    return "Traceback" in done.stderr or "please report" in done.stdout + done.stderr
