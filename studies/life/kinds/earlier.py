"""Answers of an earlier revision to the same lives, by a program that is started when needed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Self

from studies.harness.checkout import checkout
from studies.life.kinds.plant import map_table
from studies.life.kinds.worlds import life_of

PROGRAM = Path(__file__).with_name("answers.py")
# The last with a posterior of its own at each epoch.
REVISION = "1811c297"


class Earlier:
    """The program ``answers.py`` on the code of an earlier revision."""

    def __init__(self) -> None:
        self._stack = ExitStack()
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def answer(self, kind: str, number: int, how: str) -> Any:
        """Answer a life as `answers.answer` does."""
        self._process = self._process or self._started()
        assert self._process.stdin and self._process.stdout
        request = {
            "logs": life_of(kind, number).logs(),
            "map_table": map_table(),
            "seed": number,
            "how": how,
        }
        print(json.dumps(request), file=self._process.stdin, flush=True)
        return json.loads(self._process.stdout.readline())

    def _started(self) -> subprocess.Popen[str]:
        folder = Path(self._stack.enter_context(TemporaryDirectory())) / "code"
        code = self._stack.enter_context(checkout(REVISION, folder))
        environment = os.environ | {"PYTHONPATH": str(code)}
        # At the end its input is closed, which ends it.
        return self._stack.enter_context(
            subprocess.Popen(
                [sys.executable, PROGRAM],
                env=environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
        )
