"""Tests run on a copy of the project, within limits of time and memory."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import NamedTuple

from coverage import CoverageData

from studies.harness.study import Row
from studies.mutants.making import Mutants, planted
from studies.mutants.watching import WATCH

ROOT = Path(__file__).parents[2]
CUT_OFF_S = 1200.0  # of processor time, for a file of tests of the unchanged project
MEMORY = 6 << 30
_NO_TESTS = 5  # returned by pytest


class Outcome(NamedTuple):
    """What a run of tests came to."""

    code: int  # Returned by pytest, or minus the signal that ended it
    rows: list[Row]  # One for each test
    seconds: float  # Of the processor


def collect(file: str, digest: str, *, modules: tuple[str, ...]) -> Row:
    """Run a file of tests on the project as it is; give what each test runs of the modules.

    ``digest`` is that of all that this depends on, and tells trials from each other.
    """
    del digest
    with _copy() as tree:
        (tree / "coverage.ini").write_text(
            "[run]\ndisable_warnings = no-data-collected\ninclude =\n"
            + "".join(f"    lmshealth/{name}.py\n" for name in modules)
        )
        words = (file, "-m", "not statistical", "--cov", "--cov-config=coverage.ini",
                 "--cov-context=test", "--cov-report=")  # fmt: skip
        outcome = _run(tree, words, CUT_OFF_S)
        data = CoverageData(str(tree / ".coverage"))
        data.read()
        lines = _lines(data, tree)
    tests = {
        row["test"]: {"seconds": row["seconds"], "lines": lines.get(row["test"], {})}
        for row in outcome.rows
        if row["passed"]
    }
    failed = [row["test"] for row in outcome.rows if row["failed"]]
    return {"tests": tests, "failed": failed, "code": outcome.code, "cpu_s": outcome.seconds}


def _lines(data: CoverageData, tree: Path) -> dict[str, dict[str, str]]:
    """Return by test and module the lines that are run, as bits of a hexadecimal number."""
    found: dict[str, dict[str, int]] = defaultdict(lambda: defaultdict(int))
    for name in data.measured_files():
        module = Path(name).relative_to(tree.resolve() / "lmshealth").with_suffix("").as_posix()
        for line, contexts in data.contexts_by_lineno(name).items():
            for context in contexts:
                found[context.rpartition("|")[0]][module] |= 1 << line
    return {test: {k: f"{bits:x}" for k, bits in own.items()} for test, own in found.items()}


def attempt(module: str, change: str, digest: str, *, plans: Path) -> Row:
    """Run the tests of a plan on a changed module, until one fails.

    ``change`` is the number of a mutant, ``as it is``, or ``planted`` and a line.
    """
    plan = json.loads((plans / f"{digest}.json").read_text(encoding="utf-8"))
    if not plan["tests"]:
        return {"fate": "survived", "by": "", "tests": 0, "cpu_s": 0.0}
    with _copy() as tree:
        path = tree / "lmshealth" / f"{module}.py"
        path.write_text(_changed(path.read_text(encoding="utf-8"), change), encoding="utf-8")
        chosen = tree / "plan.txt"
        chosen.write_text("\n".join(plan["tests"]) + "\n", encoding="utf-8")
        outcome = _run(tree, (f"@{chosen}", "-x"), plan["limit_s"])
    assert outcome.code != _NO_TESTS
    fate = "survived" if outcome.code == 0 else "killed"
    if outcome.code in (-signal.SIGXCPU, -signal.SIGKILL):
        fate = "timed out"
    by = next((row["test"] for row in outcome.rows if row["failed"]), "")
    return {"fate": fate, "by": by, "tests": len(outcome.rows), "cpu_s": outcome.seconds}


def _changed(source: str, change: str) -> str:
    if change == "as it is":
        return source
    if change.startswith("planted"):
        return planted(source, int(change.split()[1]))
    mutant = Mutants(source).make(int(change))
    assert mutant is not None
    return mutant.code


@contextmanager
def _copy() -> Iterator[Path]:
    """Copy the project to where tests may write, with what is compiled of it."""
    leave = shutil.ignore_patterns(".[a-z]*", "demo", "build", "*.egg-info")
    with tempfile.TemporaryDirectory() as name:
        yield Path(shutil.copytree(ROOT, Path(name) / "tree", ignore=leave))


def _run(tree: Path, words: Iterable[str], limit_s: float) -> Outcome:
    """Run pytest in a tree."""
    watch = tree / "watch.jsonl"
    watch.touch()
    alone = {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1",
             WATCH: str(watch)}  # fmt: skip
    # A coverage that is measured of this study is another one.
    around = {name: value for name, value in os.environ.items() if not name.startswith("COV")}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p",
               "studies.mutants.watching", *words]  # fmt: skip
    before = _spent()
    with subprocess.Popen(
        command, cwd=tree, env=around | alone, start_new_session=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        preexec_fn=partial(_limit, limit_s),
    ) as program:  # fmt: skip
        try:
            # A program that waits for ever uses no processor.
            with suppress(subprocess.TimeoutExpired):
                program.wait(60 + 10 * limit_s)
        finally:  # all that it has started and left
            with suppress(ProcessLookupError):
                os.killpg(program.pid, signal.SIGKILL)
    rows = [json.loads(line) for line in watch.read_text(encoding="utf-8").splitlines()]
    return Outcome(program.returncode, rows, round(_spent() - before, 2))


def _limit(seconds: float) -> None:
    """Limit the program that is to be started, and what it starts."""
    import resource  # POSIX

    resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), int(seconds) + 5))
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _spent() -> float:
    import resource  # POSIX

    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def digest_of(*texts: str | bytes) -> str:
    """Digest texts, or what files hold."""
    total = hashlib.sha256()
    for text in texts:
        total.update(hashlib.sha256(text.encode() if isinstance(text, str) else text).digest())
    return total.hexdigest()[:16]
