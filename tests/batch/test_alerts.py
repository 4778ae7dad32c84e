"""Alerts: what changed from night to night is delivered once, and nothing waits for a command."""

from __future__ import annotations

import csv
import json
import os
import sqlite3
import sys
import threading
import time
from contextlib import closing
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lmshealth.batch import alerts as alerting
from lmshealth.batch import constants, ingest
from lmshealth.batch import run as running
from lmshealth.batch.alerts import Alerts, announce, run_command
from lmshealth.batch.ingest import Settings
from lmshealth.batch.run import RunResult, run
from lmshealth.batch.store import Identified, Store
from lmshealth.errors import NothingUsable
from lmshealth.stage.description import Stage
from studies.harness.servers import wait_until
from tests.lives import FREQUENCY, MODES, START, make_reading, make_stage

N_BEFORE, N_NIGHTS = 8, 10
# Program that appends what it is given as a line to a file.
KEEP = "import sys; open(sys.argv[1], 'a').write(sys.stdin.read() + '\\n')"


class Nights:
    """An archive whose logs are estimates already, and the nights that add to it."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.logs, self.out, self.sent = (folder / name for name in ("logs", "out", "sent.jsonl"))
        self.logs.mkdir()
        self.stage = make_stage(folder / "stage", parameters=(), tail="")
        self.now = START
        self.command = (sys.executable, "-c", KEEP, str(self.sent))
        nights = self

        class Clock(datetime):
            @classmethod
            def now(cls, tz: Any = None) -> datetime:  # type: ignore[override]
                return nights.now

        monkeypatch.setattr(running, "datetime", Clock)
        monkeypatch.setattr(ingest, "identify_log", self.identify)
        monkeypatch.setattr(running, "make_page", lambda *_, **__: "")
        monkeypatch.setattr(running, "date_page", lambda *_: "")

    def identify(
        self, task: Any, stages: tuple[Stage, ...], how: dict[str, Any], limit: float
    ) -> Identified:
        """Return the estimates that a file states."""
        machine, day, drift = task.path.read_text().split(",")
        rng = np.random.default_rng([*machine.encode(), int(day)])
        values = np.log(FREQUENCY[:2]) + [float(drift), 0.0] + 5e-4 * rng.standard_normal(2)
        modes = dict(zip(MODES, values.tolist(), strict=False))
        found = make_reading(task.name, float(day), 1e5 * float(day), modes)
        cov = np.diag([2.5e-7, 2.5e-7, 1e-3, 1e-3])
        metadata = replace(found.metadata, stage=machine)
        found = replace(
            found, digest=task.digest, metadata=metadata, modes=replace(found.modes, cov=cov)
        )
        return Identified(found, self.stage.digest, machine)

    def add(self, machine: str, day: int, drift: float = 0.0) -> None:
        """Write a log of a day, with ln f of the first mode off by a drift."""
        (self.logs / f"{machine}-{day:02d}.csv").write_text(f"{machine},{day},{drift}")

    def run(self, day: int, **alerts: Any) -> RunResult:
        """Run in the evening of a day."""
        self.now = START + timedelta(days=day, hours=12)
        given = {"silent_days": 3.0, "command": self.command, **alerts}
        return run(self.logs, [self.stage], self.out, Settings(alerts=Alerts(**given)))

    def statuses(self) -> list[dict[str, Any]]:
        """Return what status.json has of each machine."""
        found: list[dict[str, Any]] = json.loads((self.out / "status.json").read_text())["machines"]
        return found

    def delivered(self) -> list[list[dict[str, str]]]:
        """Return the changes of each call of the command."""
        lines = self.sent.read_text().splitlines() if self.sent.exists() else []
        return [json.loads(line)["changes"] for line in lines]


def rows_of(path: Path) -> list[dict[str, str]]:
    """Read a table."""
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


@pytest.fixture
def nights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Nights:
    """Make an archive with some logs of four machines."""
    made = Nights(tmp_path, monkeypatch)
    for machine in "ABCD":
        for day in range(N_BEFORE):
            made.add(machine, day)
    return made


@pytest.mark.slow
def test_ten_nights_are_reported_once_each(nights: Nights) -> None:
    """Two jumps that become alarms, a silence and a recovery: one call a night, and no other."""
    changes = []
    for night in range(N_NIGHTS):
        day = N_BEFORE + night
        nights.add("A", day)
        nights.add("B", day, -0.004 * max(night - 2, 0))
        nights.add("C", day, -0.004 * max(night - 3, 0) * (night < 8))
        if night < 2:
            nights.add("D", day)
        if night == 8:  # the guide of C is replaced in the morning
            moment = (START + timedelta(days=day, hours=-3)).isoformat()
            rows = ["stage,recorded_at,travel_km,action", f"C,{moment},1550,guide-replaced"]
            (nights.logs / "maintenance.csv").write_text("\n".join(rows) + "\n")
        changes.append([str(change) for change in nights.run(day).changes])
        assert len(rows_of(nights.out / "changes.csv")) == len(changes[-1])
    expected = {
        3: ["B: unconfirmed-jump"],
        4: ["C: unconfirmed-jump"],
        5: ["B: alarm roll", "D: silent last log of 2026-03-10 → no log for 4 days"],
        6: ["C: alarm roll"],
        8: ["C: recovered alarm roll → no alarm"],
    }
    assert {night: own for night, own in enumerate(changes) if own} == expected
    told = [[row["text"] for row in call] for call in nights.delivered()]
    assert told == [*expected.values()]
    states = {one["stage"]: one["DeviceHealth"] for one in nights.statuses()}
    assert states == {"A": "NORMAL", "B": "OFF_SPEC", "C": "NORMAL", "D": "CHECK_FUNCTION"}


def test_an_archive_that_lost_all_logs_is_silent(nights: Nights) -> None:
    """Machines whose files are gone are reported as silent, although the run itself fails."""
    nights.run(N_BEFORE)
    for path in nights.logs.iterdir():
        path.unlink()
    with pytest.raises(NothingUsable):
        nights.run(N_BEFORE + 5)
    (call,) = nights.delivered()
    assert [(row["stage"], row["what"]) for row in call] == [(m, "silent") for m in "ABCD"]
    document = json.loads((nights.out / "A.status.json").read_text())
    assert document["silent"] and document["DeviceHealth"] == "CHECK_FUNCTION"
    with pytest.raises(NothingUsable):
        nights.run(N_BEFORE + 6)
    assert len(nights.delivered()) == 1


def test_what_was_not_delivered_is_sent_by_the_next_run(nights: Nights) -> None:
    """A command that fails leaves the run whole; its changes come with those of the next run."""
    fails = (sys.executable, "-c", "import sys; sys.exit('no \x1b route')")
    found = nights.run(N_BEFORE + 3, command=fails)
    (why,) = found.unsent.values()
    assert "ended with status 1: no \\x1b route" in why and "4 changes are sent again" in why
    assert (found.index.is_file(), len(found.changes)) == (True, 4)
    assert nights.run(N_BEFORE + 4).changes == ()
    (call,) = nights.delivered()
    assert [row["stage"] for row in call] == list("ABCD")
    nights.run(N_BEFORE + 4)
    assert len(nights.delivered()) == 1


def test_each_way_of_delivery_has_changes_of_its_own(
    nights: Nights, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where one of two fails, the next run sends nothing twice by the other."""
    calls: list[str] = []

    def deliver(command: tuple[str, ...], content: bytes) -> str:
        calls.append("notify" if "-P" in command else "command")
        return "" if "-P" in command or calls.count("command") > 1 else "fails"

    monkeypatch.setattr(alerting, "run_command", deliver)
    found = nights.run(N_BEFORE + 3, notify=True)
    assert list(found.unsent) == ["--alert-command"]
    assert nights.run(N_BEFORE + 3, notify=True).unsent == {}
    assert calls == ["command", "notify", "command"]


def test_growing_files_are_left_to_a_later_run(nights: Nights) -> None:
    """They are neither analysed nor refused."""
    growing = frozenset({nights.logs.absolute() / "A-07.csv"})
    nights.now = START + timedelta(days=N_BEFORE)
    found = run(nights.logs, [nights.stage], nights.out, Settings(growing=growing))
    assert (found.n_logs, found.n_refused) == (4 * N_BEFORE - 1, 0)
    assert "A-07" not in (nights.out / "modes.csv").read_text()
    assert run(nights.logs, [nights.stage], nights.out).n_logs == 4 * N_BEFORE


def test_a_command_that_hangs_is_killed_with_its_children(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither it nor a child that holds its output open is waited for."""
    monkeypatch.setattr(constants, "ALERT_TIMEOUT_S", 0.5)
    pid = tmp_path / "pid"
    child = f"import os, time; open({str(pid)!r}, 'w').write(str(os.getpid())); time.sleep(60)"
    parent = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])"
    begin = time.monotonic()
    why = run_command((sys.executable, "-c", parent), b"{}")
    assert why == "took longer than 0.5 s, and was killed"
    assert time.monotonic() - begin < 10
    if pid.exists():
        wait_until(lambda: not Path(f"/proc/{pid.read_text()}/cmdline").exists(), "its end")


def test_a_command_is_a_list_of_words_and_never_read_by_a_shell(tmp_path: Path) -> None:
    """What a shell would expand arrives as it is; large input to a program that reads none too."""
    out, word = tmp_path / "out", "$(touch bad); `id` > x *"
    write = "import sys; open(sys.argv[1], 'w').write(sys.argv[2])"
    assert run_command((sys.executable, "-c", write, str(out), word), b"x" * 10_000_000) == ""
    assert out.read_text() == word
    missing = str(tmp_path / "none")
    assert run_command((missing,), b"") == f"{missing} cannot be started: No such file or directory"


def test_messengers_get_a_line_for_each_change(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Addresses are those of the environment, and no failure quotes them."""
    code = f"""
class Apprise:
    def __init__(self):
        self.addresses = []
    def add(self, address):
        self.addresses.append(address)
        return address.startswith("mailto:")
    def notify(self, title, body):
        open({str(tmp_path / "sent")!r}, "w").write(f"{{self.addresses}} {{title}} {{body}}")
        return "refuse" not in self.addresses[0]
"""
    (tmp_path / "apprise.py").write_text(code)
    (command,) = Alerts(notify=True).channels().values()
    here = Path(alerting.__file__).parents[2]
    monkeypatch.setenv("PYTHONPATH", f"{here}{os.pathsep}{tmp_path}")
    content = b'{"changes": [{"text": "A: alarm roll", "severity": "serious"}]}'
    monkeypatch.setenv("LMSHEALTH_NOTIFY", " mailto://me:secret@host \n mailto://you ")
    assert run_command(command, content) == ""
    sent = (
        "['mailto://me:secret@host', 'mailto://you'] lmshealth: 1 changes A: alarm roll (serious)"
    )
    assert (tmp_path / "sent").read_text() == sent
    for addresses in ("mailto://refuse:secret@host", "wrong:secret"):
        monkeypatch.setenv("LMSHEALTH_NOTIFY", addresses)
        why = run_command(command, content)
        assert "LMSHEALTH_NOTIFY" in why and "secret" not in why


def test_no_module_of_the_working_folder_is_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file named apprise.py among the logs is not what sends messages."""
    (tmp_path / "apprise.py").write_text("raise SystemExit('run from the folder')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(Path(alerting.__file__).parents[2]))
    monkeypatch.setenv("LMSHEALTH_NOTIFY", "")
    (command,) = Alerts(notify=True).channels().values()
    assert "run from the folder" not in run_command(command, b'{"changes": []}')


def test_a_way_of_delivery_gets_what_runs_without_it_have_found(nights: Nights) -> None:
    """What failed, and what a run by hand found, is sent once by the next run that has the way."""
    fails = (sys.executable, "-c", "raise SystemExit(1)")
    nights.run(N_BEFORE + 3, command=fails)
    nights.add("A", N_BEFORE + 3)
    assert len(nights.run(N_BEFORE + 3, command=()).changes) == 1  # by hand: A has a log again
    nights.run(N_BEFORE + 3, command=())
    assert nights.delivered() == []
    nights.run(N_BEFORE + 3)
    (call,) = nights.delivered()
    assert [row["stage"] + row["what"] for row in call] == [f"{m}silent" for m in "ABCD"] + [
        "Arecovered"
    ]
    nights.run(N_BEFORE + 3)
    assert len(nights.delivered()) == 1


def test_what_was_found_before_any_way_of_delivery_is_not_sent(nights: Nights) -> None:
    """The first run with an option is no flood of all that earlier runs have listed."""
    assert len(nights.run(N_BEFORE + 3, command=()).changes) == 4
    nights.run(N_BEFORE + 4)
    assert nights.delivered() == []


def test_what_no_way_could_deliver_is_sent_by_another(
    nights: Nights, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A messenger that is asked for the first time gets what the command could not deliver."""
    calls = list[str]()

    def deliver(command: tuple[str, ...], content: bytes) -> str:
        calls.append("notify" if "-P" in command else "command")
        assert len(json.loads(content)["changes"]) == 4
        return "" if "-P" in command else "fails"

    monkeypatch.setattr(alerting, "run_command", deliver)
    nights.run(N_BEFORE + 3)
    nights.run(N_BEFORE + 3, command=(), notify=True)
    nights.run(N_BEFORE + 3, command=(), notify=True)
    assert calls == ["command", "notify"]


def test_two_runs_at_once_deliver_once(nights: Nights, monkeypatch: pytest.MonkeyPatch) -> None:
    """Changes that another run has found and delivers are neither found nor delivered again."""
    deliver, delivering, ends = alerting.run_command, threading.Event(), list[RunResult]()

    def slow(command: tuple[str, ...], content: bytes) -> str:
        delivering.set()
        time.sleep(0.5)
        return deliver(command, content)

    monkeypatch.setattr(alerting, "run_command", slow)
    first = threading.Thread(target=lambda: ends.append(nights.run(N_BEFORE + 3)))
    first.start()
    assert delivering.wait(60)
    second = nights.run(N_BEFORE + 3)
    first.join()
    assert (len(ends[0].changes), second.changes, len(nights.delivered())) == (4, (), 1)


def test_a_run_of_older_logs_that_ends_later_changes_nothing(
    nights: Nights, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A long run beside a short one of later logs takes back neither alarm nor status."""
    nights.run(N_BEFORE)
    for day in range(N_BEFORE, 12):
        nights.add("B", day, -0.03)
    found = nights.run(12)
    assert "B: alarm roll" in [str(one) for one in found.changes]
    before = nights.statuses()
    for path in nights.logs.glob("B-*.csv"):
        if int(path.stem[2:]) >= N_BEFORE:
            path.unlink()

    def late(*given: Any) -> object:
        *others, scope = given
        arguments = [*others, scope._replace(began=0)]
        return announce(*arguments)

    monkeypatch.setattr(running, "announce", late)
    found = nights.run(12)
    assert (found.changes, nights.statuses()) == ((), before)


def test_a_status_that_cannot_be_read_is_noted_and_repeats_nothing(nights: Nights) -> None:
    """The store has what was announced; without both, what is bad is announced again."""
    nights.run(N_BEFORE + 3)
    whole = (nights.out / "status.json").read_bytes()
    for content in (b"", whole[: len(whole) // 2], b'{"machines": 3}'):
        (nights.out / "status.json").write_bytes(content)
        found = nights.run(N_BEFORE + 3)
        assert (found.changes, len(found.notes)) == ((), 1)
        assert "status.json cannot be read" in found.notes[0]
        assert (nights.out / "status.json").read_bytes() == whole
    (nights.out / "lmshealth.sqlite").unlink()
    assert (nights.run(N_BEFORE + 3).changes, len(nights.delivered())) == ((), 1)
    (nights.out / "lmshealth.sqlite").unlink()
    (nights.out / "status.json").write_bytes(b"{")
    found = nights.run(N_BEFORE + 3)
    assert len(found.changes) == 4 and "announced again" in found.notes[0]


@pytest.mark.parametrize("table", ["announced", "unsent"])
def test_damage_of_what_was_announced_announces_it_again(nights: Nights, table: str) -> None:
    """A damaged row costs a second message about its machine, and no first one."""
    fails = (sys.executable, "-c", "raise SystemExit(1)")
    nights.run(N_BEFORE + 3, command=fails if table == "unsent" else nights.command)
    name = f"values_{constants.SCHEMA}"
    with closing(sqlite3.connect(nights.out / "lmshealth.sqlite")) as file, file:
        first = f"SELECT min(rowid) FROM {name} WHERE kind = ?"
        (rowid,) = file.execute(first, (table,)).fetchone()
        file.execute(f"UPDATE {name} SET content = x'00' WHERE rowid = ?", (rowid,))
    found = nights.run(N_BEFORE + 3)
    assert "1 damaged rows" in found.notes[0] and table in found.notes[0]
    assert {row["stage"] for call in nights.delivered() for row in call} == set("ABCD")
    assert nights.run(N_BEFORE + 3).notes == ()


def test_a_run_that_ends_while_it_delivers_delivers_again(nights: Nights) -> None:
    """A run that is killed between delivery and its record leaves the changes to the next run."""

    class Killed(BaseException):
        pass

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Store, "remove", lambda *_: (_ for _ in ()).throw(Killed()))
        with pytest.raises(Killed):
            nights.run(N_BEFORE + 3)
    nights.run(N_BEFORE + 3)
    first, second = nights.delivered()
    assert first == second and len(first) == 4


def test_a_run_whose_tables_cannot_be_written_has_announced_nothing(
    nights: Nights, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a full disk changes are not lost: the next run finds them."""

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(running, "write_tables", full)
        with pytest.raises(OSError, match="space"):
            nights.run(N_BEFORE + 3)
    assert len(nights.run(N_BEFORE + 3).changes) == 4 and len(nights.delivered()) == 1


def test_a_status_has_the_name_of_a_page_whose_machine_is_there(nights: Nights) -> None:
    """Of machines with the same name of their page, that with a result has the file."""
    names = "M-1", "M 1"
    for name, other in (names, names[::-1]):
        for day in (0, 1):
            nights.add(name, day)
            (nights.logs / f"{other}-{day:02d}.csv").unlink(missing_ok=True)
        nights.run(N_BEFORE)
        status = json.loads((nights.out / "M-1.status.json").read_text())
        assert (status["stage"], status["page"]) == (name, "M-1.html")


def test_a_limit_of_days_ends_with_the_run_that_has_it(nights: Nights) -> None:
    """A machine whose logs were removed is silent by the limit of this run, or its own."""
    nights.run(N_BEFORE + 3)
    assert all(one["silent"] for one in nights.statuses())
    for path in nights.logs.iterdir():
        path.unlink()
    for given, limit in ((None, 5.0), (30.0, 30.0), (3.0, 3.0)):
        with pytest.raises(NothingUsable):
            nights.run(N_BEFORE + 3, silent_days=given)
        found = [(one["silent"], one["silent_after_days"]) for one in nights.statuses()]
        assert found == 4 * [(limit == 3.0, limit)]


def test_a_clock_that_is_set_back_changes_nothing(nights: Nights) -> None:
    """Silence is that of the day, and is reported once until the next log."""
    nights.run(N_BEFORE + 3)
    early, late = nights.run(N_BEFORE - 1), nights.run(N_BEFORE + 4)
    assert early.changes == late.changes == ()
    assert not any(one.silent for one in early.statuses) and all(o.silent for o in late.statuses)
    assert len(nights.delivered()) == 1


def test_the_output_of_a_command_is_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """A command may print without end: its last line is a message, and memory stays as it is."""
    block = "import os\nfor _ in range({}): os.write(1, b'x' * 1_000_000)\n"
    write = block + "os.write(1, b'\\nend\\n'); {}"
    resource = pytest.importorskip("resource", reason="Windows does not report memory so")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    command = (sys.executable, "-c", write.format(200, "raise SystemExit(2)"))
    assert run_command(command, b"") == "ended with status 2: end"
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 20_000  # kB
    monkeypatch.setattr(constants, "ALERT_TIMEOUT_S", 0.5)
    command = (sys.executable, "-c", write.format(10**9, ""))
    assert "took longer" in run_command(command, b"")
