"""Alerts: changes of machines since the last run, delivered to a command or a messenger.

The store holds what was announced of each machine, and which changes are to be delivered in which
way. ``status.json`` is a view of it.
"""

import os
import signal
import sys
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path, PurePath
from subprocess import PIPE, STDOUT, Popen, TimeoutExpired
from tempfile import TemporaryFile
from threading import Thread
from typing import IO, Any, NamedTuple

import msgspec

from lmshealth._private.files import read_table, write_bytes
from lmshealth._private.serialize import pack
from lmshealth.batch import constants
from lmshealth.batch.store import Announced, Store, Unsent, machine_key
from lmshealth.io.refusal import visible
from lmshealth.machine.constants import JSON_SCHEMA
from lmshealth.machine.status import Change, Fleet, Status, compare

FILE = "status.json"
"""Status of all machines in the folder of the output."""

# Not the folder of the process: it may hold a module of any name.
_NOTIFY = ("-P", "-c", "from lmshealth.batch.alerts import notify; notify()")


@dataclass(frozen=True, slots=True)
class Alerts:
    """Which changes are delivered, and how."""

    silent_days: float | None = None  # a machine without a log for longer is silent
    command: tuple[str, ...] = ()  # program and arguments, with the changes as JSON on its input
    notify: bool = False  # whether apprise sends them to the addresses in ``LMSHEALTH_NOTIFY``

    def channels(self) -> dict[str, tuple[str, ...]]:
        """Return the commands to run, by the option that asked for each."""
        asked = {"--alert-command": self.command} if self.command else {}
        return asked | ({"--notify": (sys.executable, *_NOTIFY)} if self.notify else {})


class Scope(NamedTuple):
    """Folder of the logs of a run as the store has it, that of the output, `last_number` before."""

    logs: str
    out: Path
    began: int


def last_number(announced: Iterable[Announced]) -> int:
    """Return the number of the last comparison on a store; 0 without one."""
    return max((one.number for one in announced), default=0)


def announce(
    store: Store, made: Mapping[str, Status], today: date, alerts: Alerts, scope: Scope
) -> tuple[tuple[Status, ...], list[Change], list[str]]:
    """Compare all machines of a folder of logs with what was announced, and queue their changes.

    A machine that has no result in this run keeps its last one: its logs may have been removed. A
    store without any of them takes ``status.json`` for what was announced. Only within
    `Store.alone`; return statuses, changes, and notes of damage.
    """
    unsent, everything, notes = store.unsent(), store.announced(), list[str]()
    own = {
        stage: one
        for stage, one in everything.items()
        if stage in made or PurePath(one.folder).is_relative_to(scope.logs)
    }
    known = {stage: one.status for stage, one in own.items()}
    written = Fleet()
    try:
        written = msgspec.json.decode(read_table(scope.out / FILE), type=Fleet)
    except FileNotFoundError:
        pass
    except (OSError, ValueError) as error:
        step = "written anew from the store"
        if not known:
            step = "the store has no status either: losses, alarms and silences are announced again"
        notes.append(f"{scope.out / FILE} cannot be read ({error}); {step}")
    last_run = {one.stage: one for one in written.machines}
    lost_change, lost_status = (store.damaged[name] for name in ("unsent", "announced"))
    present = ({} if known and not lost_status else last_run) | known | dict(made)
    if lost_change:  # it is not known which one: what is bad now is announced again
        known = {}
    elif not lost_status:
        known = known or last_run
    asked = set(alerts.channels())
    everywhere = asked.union(*(one.channels for one in own.values()))
    number = 1 + last_number(everything.values())
    statuses, changes = list[Status](), list[Change]()
    for stage, status in sorted(present.items()):
        last = own.get(stage)
        before = set(last.channels if last else ())
        judged, found = compare(known.get(stage), status, today, alerts.silent_days)
        if last and last.number > scope.began and status.recorded_at < last.status.recorded_at:
            # Another run, of later logs, has ended since this one began.
            judged, found = last.status, []
        channels = asked | before if last else everywhere
        waiting = dict.fromkeys(one.change for one in unsent if one.change.stage == stage)
        queued = [Unsent(one, name, number) for name in channels - before for one in waiting]
        queued += [Unsent(one, name, number) for name in channels for one in found]
        place = last.folder if last and stage not in made else scope.logs
        announced = Announced(judged, place, tuple(sorted(channels)), number)
        store.put("announced", {"": pack(announced)}, stage)
        store.put("unsent", {one.key: pack(one) for one in queued}, stage)
        statuses.append(judged)
        changes += found
    return tuple(statuses), changes, notes


def deliver(store: Store, machines: Sequence[Status], alerts: Alerts, out: Path) -> dict[str, str]:
    """Deliver the changes of machines that were not delivered yet; return why an option failed.

    One run at a time delivers. What it delivers is removed after that: a run that is killed between
    the two leaves it to the next run, which delivers it once more.
    """
    by_stage, failed = {one.stage: one for one in machines}, dict[str, str]()

    def waiting(name: str) -> list[Unsent]:
        unsent = store.unsent()
        return [one for one in unsent if one.channel == name and one.change.stage in by_stage]

    for name, command in alerts.channels().items():
        if not waiting(name):
            continue
        with store.alone():
            unsent = waiting(name)  # another run may have delivered some meanwhile
            rows = [_row(one.change, by_stage[one.change.stage], out) for one in unsent]
            content = {"schema": JSON_SCHEMA, "changes": rows}
            why = run_command(command, msgspec.json.encode(content)) if rows else ""
            if why:
                again = "are sent again by the next run with this option"
                failed[name] = f"{why}; {len(rows)} changes {again}"
                continue
            for one in unsent:
                store.remove("unsent", machine_key(one.change.stage), one.key)
    return failed


def _row(change: Change, status: Status, out: Path) -> dict[str, Any]:
    """Return a change as an alert has it."""
    row: dict[str, Any] = msgspec.to_builtins(change)
    page = str(out.absolute() / status.page)
    return row | {"text": str(change), "DeviceHealth": status.device_health, "page": page}


def write_statuses(machines: Sequence[Status], made: Container[str], out: Path) -> None:
    """Write the status of each machine and of all; those in ``made`` have a result in this run."""
    # Where the page of a machine that is gone has the name of another, that of this run is kept.
    ordered = sorted(machines, key=lambda one: (one.stage in made, one.recorded_at))
    documents: dict[str, Status | Fleet]
    documents = {f"{Path(one.page).stem}.status.json": one for one in ordered}
    documents[FILE] = Fleet(tuple(machines))
    for name, document in documents.items():
        encoded = msgspec.json.encode(document, enc_hook=lambda number: number.item())
        write_bytes(out / name, msgspec.json.format(encoded, indent=1))


def run_command(command: Sequence[str], content: bytes) -> str:
    """Run a command without a shell, with bytes on standard input; return why it failed, or "".

    It is killed with its children after `constants.ALERT_TIMEOUT_S`. Of its output, however long,
    the end is kept. A file has its input, and a thread reads its output: a child that holds a pipe
    open is not waited for.
    """
    last = bytearray()
    with TemporaryFile() as given:
        given.write(content)
        given.seek(0)
        try:
            process = Popen(
                command, stdin=given, stdout=PIPE, stderr=STDOUT, start_new_session=True
            )
        except OSError as error:
            return f"{visible(command[0])} cannot be started: {error.strerror}"

    def keep_end(stream: IO[bytes]) -> None:
        with stream:
            while block := os.read(stream.fileno(), 1 << 16):
                last[:] = (last + block)[-constants.ALERT_OUTPUT_BYTES :]

    reader = Thread(target=keep_end, args=(process.stdout,), daemon=True)
    reader.start()
    try:
        status = process.wait(constants.ALERT_TIMEOUT_S)
    except TimeoutExpired:
        return f"took longer than {constants.ALERT_TIMEOUT_S} s, and was killed"
    finally:
        if process.poll() is None:
            if hasattr(os, "killpg"):
                os.killpg(process.pid, signal.SIGKILL)
            else:  # Windows
                process.kill()
            process.wait()
    reader.join(constants.ALERT_OUTPUT_S)
    lines = bytes(last).decode(errors="replace").split("\n")
    line = next((line.strip() for line in reversed(lines) if line.strip()), "no output")
    return f"ended with status {status}: {visible(line[:200])}" if status else ""


def notify() -> None:
    """Send the changes on standard input by apprise, in a process that `run_command` bounds.

    The addresses hold passwords: no message quotes them.
    """
    import apprise  # an extra

    changes = msgspec.json.decode(sys.stdin.buffer.read())["changes"]
    messenger, addresses = apprise.Apprise(), os.environ.get(constants.NOTIFY, "").split()
    # All are tried, so that each is named.
    if not all([messenger.add(address) for address in addresses]):  # noqa: C419
        sys.exit(f"apprise does not know an address in {constants.NOTIFY}")
    body = "\n".join(f"{change['text']} ({change['severity']})" for change in changes)
    if not messenger.notify(title=f"lmshealth: {len(changes)} changes", body=body):
        sys.exit(f"apprise could not deliver to every address in {constants.NOTIFY}")
