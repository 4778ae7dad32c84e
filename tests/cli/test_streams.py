"""Standard streams: closed, full, or of an encoding without some characters; and signals."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from lmshealth.cli import interrupts, terminal
from lmshealth.io.formats.isolation import INTERRUPTS
from tests.signals import write_archive_stage, write_log


def text_stream(encoding: str) -> terminal._Stream:
    """Open a stream of an encoding that writes into memory."""
    return terminal._Stream(io.TextIOWrapper(io.BytesIO(), encoding))


def written(stream: terminal._Stream) -> bytes:
    """Return the bytes that a stream of `text_stream` wrote."""
    buffer = stream.buffer
    assert isinstance(buffer, io.BytesIO)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("encoding", "text", "shown"),
    [
        ("ascii", "1 ± 2 µm, Δe, ζ → −3 °C × ½ é", "1 +/- 2 um, deltae, zeta -> -3 degC x 1/2 e"),
        ("latin-1", "1.5 ± 0.2 µm, Δe, é", "1.5 ± 0.2 µm, deltae, é"),
        ("cp1252", "– ≥ 日", "– >= ?"),
        ("utf-8", "± Δ 日", "± Δ 日"),
        ("utf-8", "a\udcffb", "a?b"),
    ],
)  # fmt: skip
def test_characters_that_a_stream_lacks_are_spelled(
    monkeypatch: pytest.MonkeyPatch, encoding: str, text: str, shown: str
) -> None:
    """By the stream itself, and before a table is laid out."""
    stream = text_stream(encoding)
    monkeypatch.setattr(sys, "stdout", stream)
    assert terminal.readable(text) == shown
    print(text, end="", flush=True)
    assert written(stream).decode(encoding) == shown


def test_json_keeps_all_characters_in_ascii(monkeypatch: pytest.MonkeyPatch) -> None:
    """As escapes, which every reader of JSON decodes; a name is the same for a program."""
    stream = text_stream("ascii")
    monkeypatch.setattr(sys, "stdout", stream)
    terminal.print_json({"a": "µ 😀"}, indent=-1)
    assert written(stream) == b'{"a":"\\u00b5 \\ud83d\\ude00"}\n'


def test_a_stream_that_fails_is_noted_and_goes_on(tmp_path: Path) -> None:
    """Work goes on, and what follows is written nowhere."""
    if not Path("/dev/full").exists():
        pytest.skip("there is no /dev/full: only Linux has it")
    with open("/dev/full", "w", encoding="utf-8") as full:
        stream = terminal._Stream(full)
        print("lost", file=stream, flush=True)
        assert isinstance(stream.lost, OSError) and stream.lost.strerror
        print("nothing", file=stream, flush=True)
        assert stream.lost.errno


def test_signals_are_interrupts_while_a_command_runs() -> None:
    """A second one is ignored; what is ignored before (`nohup`) or handled by others stays so."""
    asked = sorted(INTERRUPTS - {signal.SIGINT})
    before = {one: signal.signal(one, signal.SIG_DFL) for one in asked}
    try:
        signal.signal(asked[0], signal.SIG_IGN)
        with pytest.raises(KeyboardInterrupt), interrupts.ended_by_signals():
            assert signal.getsignal(asked[0]) is signal.SIG_IGN
            signal.raise_signal(asked[-1])
        assert {signal.getsignal(one) for one in asked} == {signal.SIG_IGN}
        signal.signal(asked[-1], signal.SIG_DFL)
        with interrupts.ended_by_signals():
            assert signal.getsignal(asked[-1]) is interrupts._end
        assert signal.getsignal(asked[-1]) is signal.SIG_DFL
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), interrupts.Interrupted(signal.SIGTERM)])
def test_an_interrupt_while_modules_load_is_one_line(
    error: KeyboardInterrupt, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before there is a command the exit status is that of shells, too, without a traceback."""
    with pytest.raises(SystemExit) as end, interrupts.loading():
        raise error
    number = error.args[0] if error.args else signal.SIGINT
    assert end.value.code == 128 + number
    assert capsys.readouterr().err == "lmshealth: interrupted\n"


REDIRECTIONS = [
    (">&-", 0, "closed"),
    ("2>&-", 0, ""),
    (">/dev/full", 1, "No space"),
    ("<&-", 0, ""),
]


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="a shell of POSIX redirects")
@pytest.mark.parametrize(("redirection", "status", "message"), REDIRECTIONS)
@pytest.mark.parametrize("program", ["lmshealth", "models"])
def test_a_stream_that_is_closed_or_full(
    program: str, redirection: str, status: int, message: str
) -> None:
    """No traceback, and a status that states whether output was lost."""
    words = [sys.executable, "-m", program, *(["stage"] if program == "lmshealth" else ["modes"])]
    script = ["sh", "-c", f'"$@" {redirection}', "sh", *words, "lms-y"]
    done = subprocess.run(script, capture_output=True, text=True, check=False)
    assert done.returncode == status
    assert len(done.stderr.splitlines()) <= 1
    if program == "lmshealth":
        assert message in done.stderr


@pytest.fixture
def archive(tmp_path: Path) -> list[str]:
    """Make an archive of some logs; return the words of a run over it."""
    (tmp_path / "logs").mkdir()
    for k in range(40):
        write_log(tmp_path / "logs" / f"{k}.h5", float(k), k)
    stage = write_archive_stage(tmp_path / "stage", health=False)
    words = ["run", tmp_path / "logs", "--stage", stage, "--out", tmp_path / "out"]
    return [sys.executable, "-m", "lmshealth", *map(str, words)]


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="Windows has no groups of processes")
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
@pytest.mark.parametrize("workers", [1, 2])
def test_a_run_ends_by_a_signal_in_one_line(
    archive: list[str], tmp_path: Path, name: str, workers: int
) -> None:
    """Workers and trackers of resources get it too, and write nothing; none is left."""
    with subprocess.Popen(
        [*archive, "--workers", str(workers)], stderr=subprocess.PIPE, text=True,
        stdout=subprocess.DEVNULL, start_new_session=True,
        # What `nohup` starts ignores SIGHUP.
        preexec_fn=lambda: signal.signal(getattr(signal, name), signal.SIG_DFL),
    ) as process:  # fmt: skip
        rng = np.random.default_rng(workers)
        while not (tmp_path / "out" / "lmshealth.sqlite").exists() and process.poll() is None:
            time.sleep(0.05)
        time.sleep(rng.uniform(0.2, 1.0))
        number = getattr(signal, name)
        for _ in range(2):  # as `timeout` sends it
            os.killpg(process.pid, number)
        # The pipe is closed when the last process that inherited it has ended.
        errors = process.communicate(timeout=60)[1]
    assert errors == f"lmshealth: interrupted by {name}; run again to continue\n"
    assert process.returncode == 128 + number
