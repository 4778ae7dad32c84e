"""A program that answers requests, one JSON object a line, with the code of some revision."""

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


class Program:
    """A script that runs on an earlier revision while a block does; started when first asked."""

    def __init__(self, script: Path, revision: str) -> None:
        self._script, self._revision = script, revision
        self._stack = ExitStack()
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def ask(self, request: dict[str, Any]) -> Any:
        """Return the answer to a request."""
        self._process = self._process or self._started()
        assert self._process.stdin and self._process.stdout
        print(json.dumps(request), file=self._process.stdin, flush=True)
        return json.loads(self._process.stdout.readline())

    def _started(self) -> subprocess.Popen[str]:
        folder = Path(self._stack.enter_context(TemporaryDirectory())) / "code"
        code = self._stack.enter_context(checkout(self._revision, folder))
        environment = os.environ | {"PYTHONPATH": str(code)}
        # At the end its input is closed, which ends it.
        return self._stack.enter_context(
            subprocess.Popen(
                [sys.executable, self._script],
                env=environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
        )
