"""Runs of the command line as a user starts them, and how what they leave is compared."""

from __future__ import annotations

import os
import random
import re
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path
from typing import IO

import h5py
import numpy as np
from scipy.signal import lfilter
from sqlalchemy import create_engine, inspect, make_url, text

from studies.harness.checkout import ROOT
from studies.harness.command_line import call_here
from studies.harness.servers import MARK, Popen, marked, missing_postgres, postgres

_MODES = (("roll", 62.0, 0.02, 0.25), ("pitch", 105.0, 0.02, 0.4))
_RATE_HZ, _SECONDS = 500.0, 4.0

# 200 logs; enough for a fleet prior of three machines for a fourth, young one.
MACHINES = {"WORN-A": 50, "WORN-B": 46, "WORN-C": 46, "WORN-D": 8, "WATCHED-A": 50}
FEW = {"WATCHED-A": 4}
LONG_S = 1200.0  # no run takes as long
# `LMSHEALTH_KILLS=100` interrupts as many runs of all of them; by default one small run.
N_KILLS = int(os.environ.get("LMSHEALTH_KILLS", "1"))
ENDED_S = 60.0  # by then every process of a killed run has to be gone, on a busy machine too
_PROGRAM = (sys.executable, "-m", "lmshealth")
SOME_REFUSED = 3  # exit status of a run over the batch, which has damaged logs


class Run:
    """A run in a process group of its own; all its processes carry a mark.

    Its standard error goes into the file ``messages``.
    """

    def __init__(self, command: Sequence[str], messages: IO[bytes]) -> None:
        self.mark = secrets.token_hex()
        self._messages = messages
        # What a shell runs in the background ignores interrupts, and so do its children.
        if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        self._process: Popen = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=self._messages, start_new_session=True,
            env={**os.environ, MARK: self.mark}, cwd=ROOT,
        )  # fmt: skip

    def status(self, within_s: float = LONG_S) -> int | None:
        """Wait for the end and return its status; None if it does not end in time."""
        try:
            return self._process.wait(within_s)
        except subprocess.TimeoutExpired:
            return None

    def begun(self, store: str) -> bool:
        """Wait until the store has the first log; return False if the run ends before."""
        while not (known := rows(store).get("identified")) and self.status(0.05) is None:
            pass
        return bool(known)

    def messages(self) -> list[str]:
        """Return the lines that it wrote to standard error."""
        self._messages.seek(0)
        return self._messages.read().decode(errors="replace").splitlines()

    def kill(self, how: str, rng: random.Random) -> bool:
        """Disturb the run; return False if there is nothing to disturb.

        ``main`` kills its main process, ``worker`` one of its workers; ``SIGINT`` and ``SIGTERM``
        reach the whole group, as from a terminal.
        """
        if self._process.poll() is not None:
            return False
        if how == "main":
            self._process.kill()
        elif how == "worker":
            workers = [pid for pid, words in marked(self.mark).items() if "popen_loky" in words]
            if not workers:
                return False
            os.kill(rng.choice(workers), signal.SIGKILL)
        else:
            os.killpg(self._process.pid, getattr(signal, how))
        return True

    def gone_after(self) -> float:
        """Wait until none of its processes lives, up to `ENDED_S`; return the time in s."""
        begin = time.monotonic()
        # Its own end counts only when it is fetched: until then it is there, without a command.
        while (took := time.monotonic() - begin) <= ENDED_S:
            if self._process.poll() is not None and not marked(self.mark):
                break
            time.sleep(0.02)
        return took

    def end(self) -> None:
        """Kill whatever still lives of it."""
        for pid in (self._process.pid, *marked(self.mark)):
            if pid != self._process.pid or self._process.poll() is None:
                os.kill(pid, signal.SIGKILL)
        self._process.wait()


@contextmanager
def running(command: Sequence[str]) -> Iterator[Run]:
    """Start a run, and leave nothing of it behind."""
    with tempfile.TemporaryFile() as messages:
        run = Run(command, messages)
        try:
            yield run
        finally:
            run.end()


def completed(command: Sequence[str], *, quick: bool = False) -> float:
    """Complete a run, when quick in this process; return its time in s."""
    begin = time.monotonic()
    if quick:
        call_here("lmshealth", command[len(_PROGRAM) :], some_refused=True)
        return time.monotonic() - begin
    with running(command) as run:
        status = run.status()
        if status != SOME_REFUSED:
            raise RuntimeError(f"{command} ended with {status}: {run.messages()}")
    return time.monotonic() - begin


def one_line(messages: Sequence[str]) -> bool:
    """Return whether a failed run reported the reason in one line."""
    return len(messages) == 1 and messages[0].startswith("lmshealth: ")


# What a run leaves


def differences(reference: Path, out: Path) -> list[str]:
    """Compare two folders of output, tables row by row."""
    names = {path.name for folder in (reference, out) for path in folder.iterdir()}
    found = []
    for name in sorted(names):
        old, new = (_lines(folder / name) for folder in (reference, out))
        if old != new:
            more, less = Counter(new) - Counter(old), Counter(old) - Counter(new)
            found.append(f"{name}: {more.total()} lines more, {less.total()} less, or their order")
    return found


def _lines(path: Path) -> list[str]:
    return path.read_bytes().decode().splitlines(True) if path.is_file() else ["no such file"]


def rows(store: str) -> dict[str, int]:
    """Count the values of every kind, and the rows of the other tables of a store.

    Digests of files are left out: those of files that were written just now are not kept.
    """
    if store.startswith("sqlite") and not Path(make_url(store).database or "").exists():
        return {}  # to connect would make it
    engine = create_engine(store)
    try:
        names = inspect(engine).get_table_names()
        with engine.connect() as connection:
            found = dict[str, int]()
            for name in names:
                if name.startswith("values_"):
                    kinds = text(f'SELECT kind, count(*) FROM "{name}" GROUP BY kind')
                    found |= {kind: int(n) for kind, n in connection.execute(kinds)}
                else:
                    count = connection.execute(text(f'SELECT count(*) FROM "{name}"'))
                    found[re.sub(r"_\d+$", "", name)] = int(count.scalar_one())
            return {kind: n for kind, n in found.items() if kind != "hashed"}
    finally:
        engine.dispose()


@dataclass(frozen=True)
class Reference:
    """A batch and its uninterrupted run."""

    analyse: list[str]  # the command without its output
    workers: int
    out: Path
    rows: dict[str, int]  # of the store
    seconds: float

    def command(self, out: Path, store: str, *more: str) -> list[str]:
        """Return the command that analyses the batch, by default with its own workers."""
        workers = more or ("--workers", str(self.workers))
        return [*self.analyse, "--out", str(out), "--store", store, *workers]

    def judge(self, out: Path, store: str) -> list[str]:
        """List how output and store differ from the uninterrupted run's."""
        found = differences(self.out, out)
        if (now := rows(store)) != self.rows:
            found.append(f"store: {now} rows, not {self.rows}")
        return found


def reference_of(folder: Path, machines: Mapping[str, int], *, quick: bool) -> Reference:
    """Write so many logs of each machine, and analyse them without interruption."""
    for machine, n_logs in machines.items():
        write_machine(folder / "logs", machine, n_logs)
    stages = [word for path in write_stages(folder / "stages") for word in ("--stage", str(path))]
    # Health at one epoch: that is slow.
    analyse = [*_PROGRAM, "run", str(folder / "logs"), *stages, "--epochs", "1"]
    first = Reference(analyse, 1 if quick else 2, folder / "reference" / "out", {}, 0.0)
    first.out.parent.mkdir()
    store = f"sqlite:///{first.out.parent / 'reference.sqlite'}"
    seconds = completed(first.command(first.out, store), quick=quick)
    return replace(first, rows=rows(store), seconds=seconds)


Stores = Callable[[], AbstractContextManager[str]]  # makes an empty store; its value is the URL


@contextmanager
def backends(folder: Path) -> Iterator[dict[str, Stores]]:
    """Offer new stores of both kinds; PostgreSQL only where it can be started, when first asked."""

    @contextmanager
    def file() -> Iterator[str]:
        with tempfile.TemporaryDirectory(dir=folder) as own:
            yield f"sqlite:///{own}/store.sqlite"

    with ExitStack() as stack:
        server = cache(lambda: stack.enter_context(postgres()))
        found: dict[str, Stores] = {"sqlite": file}
        if missing_postgres() is None:
            found["postgres"] = lambda: server().database()
        yield found


def control(reference: Reference, folder: Path) -> dict[str, bool]:
    """Return for outputs that are wrong in one place each whether the comparison sees it."""
    copy = folder / "control"

    def seen(name: str, change: Callable[[list[str]], list[str]]) -> bool:
        shutil.copytree(reference.out, copy)
        lines = change(_lines(copy / name))
        (copy / name).unlink()
        if lines:
            (copy / name).write_bytes("".join(lines).encode())
        found = differences(reference.out, copy)
        shutil.rmtree(copy)
        return bool(found)

    return {
        "same": not seen("modes.csv", lambda lines: lines),
        "row doubled": seen("modes.csv", lambda lines: [*lines, lines[1]]),
        "row lost": seen("refused.csv", lambda lines: lines[:-1]),
        "rows in another order": seen("modes.csv", lambda lines: [lines[0], *lines[:0:-1]]),
        "last digit changed": seen(
            "track.csv", lambda lines: [*lines[:-1], other_digit(lines[-1])]
        ),
        "page changed": seen("index.html", lambda lines: [*lines, "<p>"]),
        "page lost": seen("index.html", lambda lines: []),
    }


def other_digit(line: str) -> str:
    """Change the last digit of a line."""
    return re.sub(r"\d(?=\D*$)", lambda digit: str((int(digit.group()) + 1) % 10), line)


def write_stages(folder: Path) -> tuple[Path, Path]:
    """Write two descriptions of the same modes: of machines with health, and to be watched only."""
    folder.mkdir(parents=True, exist_ok=True)
    grid = np.geomspace(0.2, 2.0, 12)
    lines = [
        f"{p!r},{name},{f * p**slope!r}" for p in grid.tolist() for name, f, _, slope in _MODES
    ]
    (folder / "worn.map.csv").write_text("\n".join(["guide_preload,mode,frequency_hz", *lines]))
    modes = "".join(
        f'[[mode]]\nname = "{name}"\nfrequency_hz = {f}\ndamping_ratio = {zeta}\n'
        for name, f, zeta, _ in _MODES
    )
    worn, watched = folder / "worn.toml", folder / "watched.toml"
    watched.write_text(f'name = "watched"\n[match]\nstage = "WATCHED-*"\n{modes}')
    worn.write_text(
        f"""name = "worn"
[match]
stage = "WORN-*"
{modes}[[parameter]]
name = "guide_preload"
limit = {{ below = 0.6 }}
prior = {{ kind = "lognormal", median = 1.0, sigma = 0.3 }}
law = {{ kind = "linear", rate_per_km = {{ kind = "normal", mean = 1e-4, std = 3e-5 }} }}
[map]
file = "worn.map.csv"
[decision]
max_risk = 0.05
"""
    )
    return worn, watched


def write_machine(folder: Path, machine: str, n_logs: int) -> None:
    """Write the logs of a wearing machine; one is damaged, one a copy, one of an unknown machine.

    Machines ``WORN-…`` have health, ``WATCHED-…`` modes only; there are at least four logs.
    """
    own = folder / machine
    own.mkdir(parents=True)
    for number in range(n_logs):
        stage = "UNKNOWN" if number == 1 else machine
        _write_log(own / f"log-{number:03d}.h5", stage, [*machine.encode(), number])
    first, broken, copy = (own / f"log-{number:03d}.h5" for number in (0, 2, 3))
    content = first.read_bytes()
    broken.write_bytes(content[: len(content) // 2] + machine.encode())
    copy.write_bytes(content)


def _write_log(path: Path, stage: str, seed: list[int]) -> None:
    """Write one log of a machine that loses preload: modes that white noise excites."""
    rng = np.random.default_rng([20261122, *seed])
    number, n = seed[-1], round(_RATE_HZ * _SECONDS)
    preload = 1 - 0.005 * number
    values = rng.standard_normal(n)
    for _, f, zeta, slope in _MODES:
        turn = 2 * np.pi * f * preload**slope / _RATE_HZ
        pole = np.exp(turn * (1j * np.sqrt(1 - zeta**2) - zeta))
        values += lfilter([1, -2, 1], [1, -2 * pole.real, abs(pole) ** 2], rng.standard_normal(n))
    moment = datetime(2026, 1, 1, 8, tzinfo=UTC) + timedelta(days=5 * number)
    with h5py.File(path, "w") as file:
        file["acc_feed_m_s2"] = values
        file.attrs.update(stage=stage, recorded_at=moment.isoformat(), travel_km=f"{50 * number}",
                          sample_rate_hz=f"{_RATE_HZ:g}")  # fmt: skip
