"""Alerts: changes of machines since the last run, delivered once to a command or a messenger."""

import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryFile

import msgspec

from lmshealth._files import read_table, write_bytes
from lmshealth.batch import constants
from lmshealth.batch.status import Change, Fleet, Status, compare
from lmshealth.io.refusal import visible

FILE = "status.json"
"""Status of all machines in the folder of the output: what the next run compares with."""

# Not the folder of the process: it may hold a module of any name.
_NOTIFY = ("-P", "-c", "from lmshealth.batch.addresses import notify; notify()")


@dataclass(frozen=True, slots=True)
class Alerts:
    """Which changes are delivered, and how."""

    silent_days: float | None = None  # a machine without a log for longer is silent
    command: tuple[str, ...] = ()  # program and arguments, with the changes as JSON on its input
    notify: bool = False  # whether apprise sends them to the addresses in ``LMSHEALTH_NOTIFY``

    def channels(self) -> dict[str, tuple[str, ...]]:
        """Return the commands to run, by the option that asked for each."""
        asked = {"--alert-command": self.command}
        asked["--notify"] = (sys.executable, *_NOTIFY) if self.notify else ()
        return {name: command for name, command in asked.items() if command}


def read_fleet(folder: Path) -> Fleet:
    """Read the status of all machines after the last run; empty without one, or of other keys."""
    try:
        return msgspec.json.decode(read_table(folder / FILE), type=Fleet)
    except (OSError, ValueError):
        return Fleet()


def update_fleet(
    before: Fleet, made: Mapping[str, Status], moment: datetime, alerts: Alerts
) -> tuple[Fleet, list[Change]]:
    """Judge all machines of this run and of the last, and list their changes.

    A machine that has no result in this run keeps its last one: its logs may have been removed.
    """
    known = {one.stage: one for one in before.machines}
    machines, changes = [], list[Change]()
    for stage, status in sorted((known | dict(made)).items()):
        judged, own = compare(known.get(stage), status, moment, alerts.silent_days)
        machines.append(judged)
        changes += own
    pending = {name: (*before.pending.get(name, ()), *changes) for name in alerts.channels()}
    return Fleet(tuple(machines), {name: own for name, own in pending.items() if own}), changes


def publish(fleet: Fleet, alerts: Alerts, out: Path) -> dict[str, str]:
    """Deliver pending changes, and write the status of each machine and of all.

    Return why an option failed; its changes stay pending.
    """
    by_stage, failed = {one.stage: one for one in fleet.machines}, dict[str, str]()
    for name, changes in fleet.pending.items():
        rows = [
            msgspec.to_builtins(change)
            | {"text": str(change), "DeviceHealth": by_stage[change.stage].device_health}
            | {"page": str(out.absolute() / by_stage[change.stage].page)}
            for change in changes
        ]
        content = {"schema": constants.JSON_SCHEMA, "changes": rows}
        if why := run_command(alerts.channels()[name], msgspec.json.encode(content)):
            failed[name] = f"{why}; {len(changes)} changes are sent again by the next run"
    left = {name: fleet.pending[name] for name in failed}
    # Where the page of a machine that is gone has the name of another, the newer one is kept.
    documents: list[tuple[str, Status | Fleet]] = [
        (f"{Path(one.page).stem}.status.json", one)
        for one in sorted(fleet.machines, key=lambda one: one.recorded_at)
    ]
    for name, document in (*documents, (FILE, msgspec.structs.replace(fleet, pending=left))):
        encoded = msgspec.json.encode(document, enc_hook=lambda number: number.item())
        write_bytes(out / name, msgspec.json.format(encoded, indent=1))
    return failed


def run_command(command: Sequence[str], content: bytes) -> str:
    """Run a command without a shell, with bytes on standard input; return why it failed, or "".

    It is killed with its children after `constants.ALERT_TIMEOUT_S`. Files take its input and its
    output: a pipe that a child holds open would be waited for.
    """
    with TemporaryFile() as given, TemporaryFile() as output:
        given.write(content)
        given.seek(0)
        try:
            process = subprocess.Popen(
                command, stdin=given, stdout=output, stderr=output, start_new_session=True
            )
        except OSError as error:
            return f"{visible(command[0])} cannot be started: {error.strerror}"
        try:
            status = process.wait(constants.ALERT_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            return f"took longer than {constants.ALERT_TIMEOUT_S} s, and was killed"
        finally:
            if process.poll() is None:
                if hasattr(os, "killpg"):
                    os.killpg(process.pid, signal.SIGKILL)
                else:  # Windows
                    process.kill()
                process.wait()
        output.seek(max(output.seek(0, os.SEEK_END) - 1000, 0))
        lines = output.read().decode(errors="replace").split("\n")
    last = next((line.strip() for line in reversed(lines) if line.strip()), "no output")
    return f"ended with status {status}: {visible(last[:200])}" if status else ""
