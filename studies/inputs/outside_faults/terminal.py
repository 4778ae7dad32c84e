"""Standard streams, signals and widths that a terminal may have."""

from __future__ import annotations

import os
import re
import signal
import sqlite3
import struct
import subprocess
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from studies.inputs.outside_faults.case import Case, Program, Seen, is_traceback, last_line
from studies.inputs.outside_faults.losses import rows_of

KIND = "terminal"
RATE = 1000.0  # of the logs, Hz
BEGUN_S, ENDED_S = 60.0, 30.0  # longest waits for the first results of a run, and for its end
WORK = 60  # logs of a run that is ended by a signal: more than it finishes before


def write_log(path: Path, seed: int, seconds: float = 8.0) -> None:
    """Write a log with a resonance of 126 Hz and 2 % damping."""
    pole = np.exp(2 * np.pi * 126.0 / RATE * (-0.02 + 1j))
    force = np.random.default_rng(seed).standard_normal(int(seconds * RATE))
    head = f"# sample_rate_hz: {RATE:g}\n# stage: AX-1-Y\n# recorded_at: 2026-01-{seed % 28 + 1:02}"
    head += f"T00:00:00Z\n# travel_km: {seed}\nacc_0_m_s2"
    seen = lfilter([1.0], np.poly([pole, pole.conj()]).real, force)
    np.savetxt(path, seen, "%.6g", header=head, comments="")


def shell(
    program: Program, redirection: str, *words: str | Path, **env: str
) -> subprocess.CompletedProcess[str]:
    """Call the program in a shell with a redirection; a pipe gives the status of the program."""
    script = f'"$@" {redirection}'
    if redirection.startswith("|"):
        script = f'{{ "$@"; echo "status $?" >&2; }} {redirection}'
    done = subprocess.run(
        ["sh", "-c", script, "sh", *program.command(*words)], capture_output=True, check=False,
        env=program.environment() | env,
    )  # fmt: skip
    encoding = env.get("PYTHONIOENCODING", "utf-8")
    parts = (part.decode(encoding, "replace") for part in (done.stdout, done.stderr))
    return subprocess.CompletedProcess(words, done.returncode, *parts)


def encoded(program: Program, folder: Path, *, encoding: str) -> Seen:
    """Print a description, whose tables have characters that few encodings have."""
    done = shell(program, "", "stage", "lms-y", PYTHONIOENCODING=encoding)
    whole = done.returncode == 0 and "is identifiable" in done.stdout and "�" not in done.stdout
    return Seen(whole and not is_traceback(done), f"{done.returncode}: {last_line(done.stderr)}")


def redirected(program: Program, folder: Path, *, to: str) -> Seen:
    """Analyse a folder of one log without a stream."""
    (folder / "logs").mkdir()
    write_log(folder / "logs" / "a.csv", 1)
    words = ("run", folder / "logs", "--stage", "lms-y", "--out", folder / "out", "--workers", "1")
    done = shell(program, to, *words)
    return _judged(done, folder / "out" / "status.json", 0)


def full(program: Program, folder: Path, *, to: str) -> Seen:
    """Save the modes of a log, and print them to where nothing can be written."""
    write_log(folder / "a.csv", 1)
    saved = folder / "stage.toml"
    done = shell(program, to, "modes", folder / "a.csv", "--band", "90", "300", "--save", saved)
    return _judged(done, saved, 1 if to else 0)


def _judged(done: subprocess.CompletedProcess[str], file: Path, status: int) -> Seen:
    """Judge a call by its status and by a file that it writes."""
    found = int((re.findall(r"status (\d+)", done.stderr) or [done.returncode])[0])
    right = file.exists() and found == status and not is_traceback(done)
    return Seen(right, f"{found}, {file.name} is {'' if file.exists() else 'not '}written")


def ended(program: Program, folder: Path, *, name: str) -> Seen:
    """Send a signal to the processes of a run with two workers, or none."""
    (folder / "logs").mkdir()
    for seed in range(WORK if name else 1):
        write_log(folder / "logs" / f"{seed}.csv", seed, 20.0)
    words = ("run", folder / "logs", "--stage", "lms-y", "--out", folder / "out", "--workers", "2")
    with subprocess.Popen(
        program.command(*words), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        env=program.environment(), start_new_session=True,
        # What `nohup` starts ignores SIGHUP.
        preexec_fn=lambda: signal.signal(getattr(signal, name or "SIGTERM"), signal.SIG_DFL),
    ) as process:  # fmt: skip
        end = time.monotonic() + BEGUN_S
        while name and not _identified(folder / "out") and time.monotonic() < end:
            time.sleep(0.05)
        if name:
            os.killpg(process.pid, getattr(signal, name))
        messages = process.communicate(timeout=20 * ENDED_S)[1].splitlines()
    if not name:
        return Seen(process.returncode == 0, f"status {process.returncode}")
    one_line = len(messages) == 1 and f"interrupted by {name}" in messages[0]
    status = 128 + getattr(signal, name)
    return Seen(
        one_line and process.returncode == status,
        f"status {process.returncode}, {len(messages)} lines: {last_line(' '.join(messages))}",
    )


def _identified(out: Path) -> bool:
    """Return whether a run has stored its first log."""
    try:
        with sqlite3.connect(out / "lmshealth.sqlite") as store:
            return bool(store.execute(f"SELECT 1 FROM {rows_of(store, 'identified')}").fetchone())
    except (sqlite3.Error, KeyError):
        return False


def widest(program: Program, folder: Path, *, columns: int, words: tuple[str, ...]) -> Seen:
    """Print tables on a terminal of some columns; return its longest line."""
    import fcntl  # Windows has neither
    import termios

    reader, writer = os.openpty()
    fcntl.ioctl(writer, termios.TIOCSWINSZ, struct.pack("HHHH", 50, columns, 0, 0))
    env = {name: value for name, value in program.environment().items() if name != "COLUMNS"}
    with subprocess.Popen(
        program.command(*words), stdin=subprocess.DEVNULL, stdout=writer, stderr=writer,
        env=env | {"TERM": "xterm"}, cwd=folder,
    ) as process:  # fmt: skip
        os.close(writer)
        output = b""
        try:
            while part := os.read(reader, 1 << 16):
                output += part
        except OSError:  # the end of a terminal
            pass
    os.close(reader)
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", output.decode())
    longest = max(len(line.rpartition("\r")[2]) for line in text.replace("\r\n", "\n").split("\n"))
    return Seen(process.returncode == 0 and longest <= columns, f"{longest} of {columns} columns")


def _case(name: str, right: str, ask: Callable[..., Seen], key: str, *pair: object) -> Case:
    """Return a case whose fault and control differ in one argument."""
    fault, control = (partial(ask, **{key: value}) for value in pair)
    return Case(KIND, name, right, fault, control)


_NARROW = [
    _case(
        f"tables of `{words[0]}` on {columns} columns", f"no line is longer than {columns}",
        partial(widest, words=words), "columns", columns, 200,
    )
    for columns in (40, 60)
    for words in (("stage", "lms-y"), ("plan", "--stage", "lms-y", "--detect", "guide_preload=0.1"))
]  # fmt: skip
CASES: tuple[Case, ...] = (
    _case("standard output in latin-1", "readable", encoded, "encoding", "latin-1", "utf-8"),
    _case("standard output in ASCII", "readable", encoded, "encoding", "ascii", "utf-8"),
    _case("closed standard output", "status 0, all files", redirected, "to", ">&-", ""),
    _case("closed standard error", "status 0, all files", redirected, "to", "2>&-", ""),
    _case("full disk behind standard output", "status 1, files", full, "to", ">/dev/full", ""),
    _case("pipe that is closed early", "status 1, files", full, "to", "| true", ""),
    _case("SIGTERM to all processes", "status 143, one line", ended, "name", "SIGTERM", ""),
    _case("SIGHUP to all processes", "status 129, one line", ended, "name", "SIGHUP", ""),
    *_NARROW,
)  # fmt: skip
