"""Watching: a run when files have stopped growing, and none without a reason."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from lmshealth.batch import run as watching
from lmshealth.batch.database import StoreError
from lmshealth.batch.ingest import Settings
from lmshealth.batch.run import RunResult, watch
from lmshealth.cli.main import main
from lmshealth.errors import BadTable, LmshealthError, NothingUsable
from lmshealth.report import rendering
from studies.harness.servers import wait_until
from tests.signals import write_archive_stage, write_log

Poll = Callable[[], object]
Seen = list[tuple[int, set[str]]]


class Ended(Exception):
    """There are no more polls."""


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Sequence[Poll]], Seen]:
    """Return a function that does something before each poll, and lists the runs.

    Of each run: the poll, and the files that were left out as still growing.
    """
    logs = tmp_path / "logs"
    logs.mkdir()

    def play(polls: Sequence[Poll]) -> Seen:
        left, seen, n = iter(polls), Seen(), 0

        def sleep(_: float) -> None:
            nonlocal n
            n += 1
            action = next(left, None)
            if action is None:
                raise Ended
            action()

        def run(
            folder: Path, stages: object, out: Path, settings: Settings, progress: object
        ) -> RunResult:
            seen.append((n, {path.name for path in settings.growing}))
            if not any(folder.glob("*.csv")):
                raise NothingUsable("no log")
            return RunResult(out / "index.html", (), {})

        monkeypatch.setattr(time, "sleep", sleep)
        monkeypatch.setattr(watching, "run", run)
        with pytest.raises(Ended):
            for _ in watch(logs, [], logs / "out", Settings(), interval=1.0):
                pass
        return seen

    return play


def nothing() -> None:
    """Do nothing before a poll."""


def test_a_log_is_analysed_when_it_is_the_same_at_two_polls(
    runs: Callable[[Sequence[Poll]], Seen], tmp_path: Path
) -> None:
    """While one grows the others are analysed without it; what is not new is not run again."""
    one, two = tmp_path / "logs" / "one.csv", tmp_path / "logs" / "two.csv"

    def grow(path: Path) -> Poll:
        def append() -> None:
            path.write_text(path.read_text() + "x" if path.exists() else "x")

        return append

    polls = [nothing, grow(one), nothing, nothing, grow(two), grow(two), nothing, nothing]
    assert runs(polls) == [(3, set()), (7, set())]
    assert runs([nothing, grow(two), grow(two), nothing, nothing]) == [(1, set()), (4, set())]
    assert runs([nothing, lambda: (grow(one)(), grow(two)()), grow(two), nothing]) == [
        (1, set()),
        (3, {"two.csv"}),
        (4, set()),
    ]
    assert runs([nothing, two.unlink, nothing]) == [(1, set()), (2, set())]


@pytest.mark.parametrize("name", ["manifest.csv", "maintenance.csv"])
def test_what_is_known_of_logs_is_not_read_while_it_is_written(
    runs: Callable[[Sequence[Poll]], Seen], tmp_path: Path, name: str
) -> None:
    """Half of it would give other machines and lives; the run waits until it has ended."""
    log, table = tmp_path / "logs" / "one.csv", tmp_path / "logs" / name
    log.write_text("x")

    def grow() -> None:
        table.write_text(table.read_text() + "x" if table.exists() else "x")

    assert runs([grow, grow, nothing, nothing, grow, nothing]) == [(3, set()), (6, set())]


def test_output_and_hidden_files_are_no_reason_to_run(
    runs: Callable[[Sequence[Poll]], Seen], tmp_path: Path
) -> None:
    """The output may lie among the logs."""
    out = tmp_path / "logs" / "out"
    out.mkdir()

    def write() -> None:
        (out / "index.html").write_text("new")
        (tmp_path / "logs" / ".part").write_text("new")

    assert runs([nothing, write, nothing, nothing]) == []
    (tmp_path / "logs" / "one.csv").write_text("x")
    assert runs([nothing, write, nothing, nothing]) == [(1, set())]


def test_tables_stay_while_a_share_is_gone_and_a_new_day_is_a_reason(
    runs: Callable[[Sequence[Poll]], Seen], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without any file nothing is run; with some there is a run on every day."""
    moment, log = datetime(2026, 11, 25, 23), tmp_path / "logs" / "one.csv"

    class Clock(datetime):
        @classmethod
        def now(cls, tz: Any = None) -> datetime:  # type: ignore[override]
            return moment

    def next_day() -> None:
        nonlocal moment
        moment += timedelta(days=1)

    monkeypatch.setattr(watching, "datetime", Clock)
    log.write_text("x")
    polls = [nothing, log.unlink, nothing, next_day, nothing, lambda: log.write_text("x"), nothing]
    assert runs([*polls, next_day, nothing]) == [(1, set()), (7, set()), (8, set())]


def test_a_run_that_failed_is_repeated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A store that cannot be reached costs no log its analysis; then there is no further run."""
    logs, n_runs, polls = tmp_path / "logs", 0, iter(range(6))
    logs.mkdir()
    (logs / "one.csv").write_text("x")

    def run(*_: object) -> RunResult:
        nonlocal n_runs
        n_runs += 1
        if n_runs < 3:
            raise StoreError("could not connect to server")
        return RunResult(tmp_path / "index.html", (), {})

    monkeypatch.setattr(time, "sleep", lambda _: next(polls))
    monkeypatch.setattr(watching, "run", run)
    results: list[RunResult | LmshealthError] = []
    with pytest.raises(RuntimeError):
        results.extend(watch(logs, [], tmp_path / "out", Settings(), interval=1.0))
    assert [type(result) for result in results] == [StoreError, StoreError, RunResult]


def test_pages_that_cannot_be_written_do_not_end_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each failure to write a PDF is a line on standard error, after the line of its run."""

    def twice(*_: object, **__: object) -> Iterator[RunResult]:
        yield from 2 * [RunResult(tmp_path / "index.html", (), {})]

    def fail(_: object) -> None:
        raise BadTable("A.pdf: cannot be written: Is a directory")

    monkeypatch.setattr(watching, "watch", twice)
    monkeypatch.setattr(rendering, "write_pdfs", fail)
    words = ["watch", str(tmp_path), "--stage", "lms-y", "--out", str(tmp_path / "out"), "--pdf"]
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 0
    assert len(result.stdout.splitlines()) == len(result.stderr.splitlines()) == 2
    assert all(line.endswith("A.pdf: cannot be written: Is a directory")
               for line in result.stderr.splitlines())  # fmt: skip


@pytest.fixture
def started(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Watch a folder of one log with the command line, and wait for its first line."""
    (tmp_path / "logs").mkdir()
    stage = write_archive_stage(tmp_path / "stage", health=False)
    words = ["watch", tmp_path / "logs", "--stage", stage, "--out", tmp_path / "out"]
    words += ["--interval", 0.2, "--workers", 1]
    process = subprocess.Popen(
        [sys.executable, "-m", "lmshealth", *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # A process that was started in the background ignores Ctrl-C, and so do its children.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        write_log(tmp_path / "logs" / "one.h5", 1.0, 1)
        yield process
    finally:
        process.kill()
        process.communicate()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sent", "status", "said"),
    [
        (signal.SIGINT, 130, "lmshealth: interrupted; run again to continue"),
        (signal.SIGTERM, 0, ""),
    ],
)
def test_the_command_ends_cleanly(
    started: subprocess.Popen[str], tmp_path: Path, sent: int, status: int, said: str
) -> None:
    """One line for a run; Ctrl-C ends it with 130, SIGTERM with 0, without a traceback."""
    wait_until((tmp_path / "out" / "status.json").exists, "the first run")
    time.sleep(0.5)
    started.send_signal(sent)
    output, errors = started.communicate(timeout=20)
    assert started.returncode == status
    lines = output.splitlines()
    assert "1 of 1 logs analysed" in lines[-1] and lines[-1].startswith("20")
    told = [line for line in errors.splitlines() if "no usable log" not in line]
    assert told == ([said] if said else [])
