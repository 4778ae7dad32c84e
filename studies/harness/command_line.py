"""Command lines as studies call them: as a user does, or quickly."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from importlib import import_module
from math import inf
from unittest.mock import patch

from click.testing import CliRunner

from lmshealth.life import constants
from lmshealth.life.posterior import sampling
from lmshealth.report import figures as plots
from studies.harness.checkout import ROOT

_SOME_REFUSED = 3
# Where the commands of a program are.
_GROUPS = {"lmshealth": ("lmshealth.cli.main", "main"), "models": ("models.__main__", "cli")}


def call(program: str, *arguments: object, quick: bool, some_refused: bool = False) -> str:
    """Call ``lmshealth`` or ``models``, and return what it prints; exit if it fails.

    The quick call is in this process, which has imported everything already, with lives by
    importance sampling alone, and no pictures: most of the time goes into these.
    """
    words = [str(word) for word in arguments]
    if quick:
        with quick_posteriors(), no_pictures():
            return call_here(program, words, some_refused=some_refused)
    command = [sys.executable, "-m", program, *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    _insist(done.returncode, some_refused, f"{program} {words[0]}", done.stderr)
    return done.stdout


def no_pictures() -> AbstractContextManager[object]:
    """Let pages have no pictures: drawing them is most of making them."""
    return patch.object(plots, "inline", lambda *_, **__: "")


def call_here(program: str, words: Sequence[str], *, some_refused: bool = False) -> str:
    """Call a command line in this process, and give what it prints; otherwise as `call`."""
    module, name = _GROUPS[program]
    group = getattr(import_module(module), name)
    done = CliRunner().invoke(group, list(words), prog_name=program)
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    _insist(done.exit_code, some_refused, f"{program} {words[0]}", done.stderr)
    return done.stdout


def _insist(status: int, some_refused: bool, command: str, messages: str) -> None:
    if status not in ((0, _SOME_REFUSED) if some_refused else (0,)):
        raise SystemExit(f"{command} ended with {status}: {messages}")


@contextmanager
def quick_posteriors() -> Iterator[None]:
    """Sample lives by importance sampling alone."""
    with short_chains(), patch.object(constants, "MIN_CHAIN_PROBABILITY", inf):
        yield


@contextmanager
def short_chains() -> Iterator[None]:
    """Require a fifth of the length of chains; they have to converge all the same."""
    with (
        patch.object(constants, "MIN_AUTOCORRELATION_TIMES", 10),
        patch.object(sampling, "_FIRST_STEPS", 100),
    ):
        yield
