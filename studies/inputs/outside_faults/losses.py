"""Nothing lost: alerts, rows of the store, incomplete files, files beside a manifest."""

from __future__ import annotations

import json
import os
import random
import shlex
import shutil
import sqlite3
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from studies.inputs.outside_faults.case import Case, Program, Seen, is_traceback, last_line

KIND = "losses"
RATE_HZ, SECONDS = 500, 4.0
UNCHANGED_S = 11.0  # the digest of a file is kept from 10 s after its last change on
TRIALS = 12  # damaged copies of a store in each of two ways
KEEP = "import sys; open(sys.argv[1], 'a').write(sys.stdin.read() + '\\n')"
LIMIT_BLOCKS = 100 << 11  # 100 MiB in blocks of 512 bytes, for the largest file of a run
PRINT = "import os\nfor _ in range(1000): os.write(1, bytes(1 << 20))"
HOLD = "import fcntl, sys, time; f = open(sys.argv[1]); fcntl.flock(f, 2); print(flush=True)"
HOLD += "; time.sleep(600)"

Done = subprocess.CompletedProcess[str]


def write_log(path: Path, number: int, *, head: bool = True) -> None:
    """Write white noise of one channel, with or without the metadata of the log."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [f"# {key}: {value}" for key, value in metadata(number).items()] if head else []
    noise = np.random.default_rng(number).standard_normal(round(RATE_HZ * SECONDS))
    rate = [f"# sample_rate_hz: {RATE_HZ}"]
    text = "\n".join([*rate, *lines, "acc_pitch_m_s2", *(f"{value:.6f}" for value in noise)])
    path.write_text(text + "\n")


def metadata(number: int) -> dict[str, str]:
    """Return what a log states of itself."""
    day = f"2026-01-{number + 1:02d}T08:00:00Z"
    return {"stage": "AX-3-Y", "recorded_at": day, "travel_km": str(10 * number)}


def write_manifest(folder: Path, names: Sequence[str]) -> None:
    """Write a manifest with a row for each name."""
    rows = [",".join(["file", *metadata(0)])]
    rows += [",".join([name, *metadata(k).values()]) for k, name in enumerate(names)]
    (folder / "manifest.csv").write_text("\n".join(rows) + "\n")


def analyse(
    program: Program, folder: Path, *more: str | Path, n: int = 1, **options: object
) -> Done:
    """Run over logs of a folder, which are written first where there are none."""
    logs = folder / "logs"
    if not logs.exists():
        for number in range(n):
            write_log(logs / f"{number}.csv", number)
    out = ("--out", folder / "out", "--workers", "1", "--epochs", "1")
    return program("run", logs, "--stage", "lms-y", *out, *more, **options)


# Alerts: a machine whose last log is old is silent


def alerts(
    folder: Path, *, fails: bool = False, days: float = 1.0, takes: float = 0.0
) -> tuple[str, ...]:
    """Return options of a run that delivers silences: each call of the command is a line."""
    program = f"import time; time.sleep({takes}); {KEEP}"
    command = shlex.join([sys.executable, "-c", program, str(folder / "sent")])
    return ("--silent-days", str(days), "--alert-command", "false" if fails else command)


def sent(folder: Path) -> int:
    """Count the changes that the command was given."""
    lines = (folder / "sent").read_text().splitlines() if (folder / "sent").exists() else []
    return sum(len(json.loads(line)["changes"]) for line in lines)


def delivered(folder: Path, extra: str = "") -> Seen:
    """Judge whether the one change was delivered once."""
    return Seen(sent(folder) == 1, f"delivered {sent(folder)} times{extra}")


def failed_alert(program: Program, folder: Path) -> Seen:
    """Fail to deliver, run without the option, and with it twice."""
    analyse(program, folder, *alerts(folder, fails=True))
    analyse(program, folder)
    for _ in range(2):
        analyse(program, folder, *alerts(folder))
    return delivered(folder)


def run_by_hand(program: Program, folder: Path) -> Seen:
    """Find a change in a run without an alert, between two with one."""
    analyse(program, folder, *alerts(folder, days=36500))
    analyse(program, folder, "--silent-days", "1")
    for _ in range(2):
        analyse(program, folder, *alerts(folder))
    return delivered(folder)


def two_alerts(program: Program, folder: Path) -> Seen:
    """Run twice with the alert."""
    for _ in range(2):
        analyse(program, folder, *alerts(folder))
    return delivered(folder)


def cut_status(program: Program, folder: Path) -> Seen:
    """Cut the status of all machines off between two runs."""
    analyse(program, folder, *alerts(folder))
    path = folder / "out" / "status.json"
    path.write_bytes(path.read_bytes()[:100])
    done = analyse(program, folder, *alerts(folder))
    noted = "status.json" in done.stderr
    return Seen(sent(folder) == 1 and noted, f"delivered {sent(folder)} times, noted: {noted}")


def at_once(program: Program, folder: Path) -> Seen:
    """Run twice at the same time."""
    write_log(folder / "logs" / "0.csv", 0)
    out = ("--out", str(folder / "out"), "--workers", "1", *alerts(folder, takes=5.0))
    command = program.command("run", folder / "logs", "--stage", "lms-y", *out)
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    both = [subprocess.Popen(command, env=program.environment(), **quiet) for _ in range(2)]  # type: ignore[call-overload]
    ends = [one.wait(600) for one in both]
    return Seen(sent(folder) == 1 and ends == [0, 0], f"delivered {sent(folder)} times, {ends}")


def long_output(program: Program, folder: Path, *, n: int = 1000) -> Seen:
    """Alert by a command that prints 1 GB, where no file may be larger than 100 MB."""
    write_log(folder / "logs" / "0.csv", 0)
    command = shlex.join([sys.executable, "-c", PRINT.replace("1000", str(n))])
    own = ("--out", str(folder / "out"), "--workers", "1", "--silent-days", "1")
    call = program.command(
        "run", folder / "logs", "--stage", "lms-y", *own, "--alert-command", command
    )
    limited = ["sh", "-c", f"ulimit -f {LIMIT_BLOCKS}; exec {shlex.join(call)}"]
    done = subprocess.run(
        limited, env=program.environment(), capture_output=True, text=True, check=False
    )
    return Seen(
        done.returncode == 0 and "alert" not in done.stderr, last_line(done.stderr) or "sent"
    )


# Store


def outputs(folder: Path) -> dict[str, bytes]:
    """Return the files of an output, without its store and its changes."""
    out = folder / "out"
    own = (path for path in out.iterdir() if not path.name.startswith("lmshealth.sqlite"))
    return {path.name: path.read_bytes() for path in own if path.name != "changes.csv"}


def rows_of(file: sqlite3.Connection, kind: str) -> str:
    """Return table and condition of the values of a kind, which had tables of their own before."""
    query = "SELECT name FROM sqlite_master WHERE type = 'table'"
    names = {name.split("_")[0]: name for (name,) in file.execute(query)}
    return names[kind] if kind in names else f"{names['values']} WHERE kind = '{kind}'"


def flip_value(store: Path, rng: random.Random) -> None:
    """Change one digit, letter or byte of a value that a run reads."""
    with closing(sqlite3.connect(store)) as file, file:
        tables = [
            name for (name,) in file.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
        ]
        cells = [
            (table, column[1])
            for table in tables
            for column in file.execute(f"PRAGMA table_info({table})")
            if table.split("_")[0] not in ("status", "points", "changes")
            and file.execute(f"SELECT count(*) FROM {table}").fetchone()[0]
        ]
        table, column = rng.choice(cells)
        found = file.execute(f"SELECT rowid, {column} FROM {table} WHERE {column} <> ''").fetchall()
        if not found:
            return
        row, value = rng.choice(found)
        if isinstance(value, bytes):
            at = rng.randrange(len(value))
            other: object = (
                value[:at] + bytes([value[at] ^ 1 << rng.randrange(8)]) + value[at + 1 :]
            )
        elif isinstance(value, str):
            at = rng.randrange(len(value))
            other = value[:at] + rng.choice("0123456789".replace(value[at], "")) + value[at + 1 :]
        else:
            other = value + 1
        file.execute(f"UPDATE {table} SET {column} = ? WHERE rowid = ?", (other, row))


def flip_page(store: Path, rng: random.Random) -> None:
    """Change one bit of the file."""
    data = bytearray(store.read_bytes())
    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    store.write_bytes(data)


def keep(store: Path, rng: random.Random) -> None:
    """Change nothing."""


def damaged(
    program: Program,
    folder: Path,
    *,
    damage: Callable[[Path, random.Random], None],
    n: int = TRIALS,
) -> Seen:
    """Damage copies of a store; each run ends as without, or names the file to delete."""
    for _ in range(2):
        analyse(program, folder, n=4)
    right, counts = outputs(folder), Counter[str]()
    shutil.copytree(folder / "out", folder / "kept")
    for trial in range(n):
        shutil.rmtree(folder / "out")
        shutil.copytree(folder / "kept", folder / "out")
        damage(folder / "out" / "lmshealth.sqlite", random.Random(f"losses {trial}"))
        done = analyse(program, folder)
        if done.returncode == 1 and not is_traceback(done):
            named = "delete" in done.stderr and "lmshealth.sqlite" in done.stderr
            counts["names the file" if named else f"refused: {last_line(done.stderr)}"] += 1
        elif is_traceback(done):
            counts["traceback"] += 1
        else:
            counts["as undamaged" if outputs(folder) == right else "differs"] += 1
    good = counts["as undamaged"] + counts["names the file"] == n
    return Seen(good, ", ".join(f"{what} {k}" for what, k in counts.most_common()))


def flipped_digest(program: Program, folder: Path, *, flips: bool = True) -> Seen:
    """Change a digit of the digest of a file, and remove the outcome of its log."""
    write_log(folder / "logs" / "0.csv", 0)
    time.sleep(UNCHANGED_S)
    analyse(program, folder)
    with closing(sqlite3.connect(folder / "out" / "lmshealth.sqlite")) as file, file:
        rows = rows_of(file, "hashed")
        table = rows.split()[0]
        *_, column = (row[1] for row in file.execute(f"PRAGMA table_info({table})"))
        (value,) = file.execute(f"SELECT {column} FROM {rows}").fetchone()
        zero, one = (b"0", b"1") if isinstance(value, bytes) else ("0", "1")
        if flips:
            other = value[:-1] + (one if value[-1:] == zero else zero)
            file.execute(rows.replace(table, f"UPDATE {table} SET {column} = ?", 1), (other,))
        file.execute(f"DELETE FROM {rows_of(file, 'identified')}")
    ends = [analyse(program, folder).returncode for _ in range(2)]
    return Seen(ends == [0, 0], f"exit {ends}")


# Incomplete files, read-only folders


def abandoned(program: Program, folder: Path, *, held: bool = False) -> Seen:
    """Leave an incomplete file of a killed run, or of one that still writes it."""
    part = folder / "out" / ".0123456789abcdef.part"
    part.parent.mkdir()
    part.write_text("incomplete")
    command = [sys.executable, "-c", HOLD, str(part)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as owner:
        if held and owner.stdout is not None:
            owner.stdout.readline()
        else:
            owner.kill()
            owner.wait()
        done = analyse(program, folder)
        owner.kill()
    return Seen(
        part.exists() == held and done.returncode == 0, "kept" if part.exists() else "removed"
    )


def read_only(
    program: Program, folder: Path, *, unwritable: bool = True, wal: bool = False
) -> Seen:
    """Report from a store in a folder that is mounted read-only."""
    analyse(program, folder)
    out, pages = folder / "out", folder / "pages"
    if wal:  # as a killed run leaves it: results that are in the file beside it alone
        with closing(sqlite3.connect(out / "lmshealth.sqlite")) as file:
            file.execute("CREATE TABLE more (x)")
            file.execute("INSERT INTO more VALUES (1)")
            file.commit()
            names = [f"lmshealth.sqlite{end}" for end in ("", "-wal")]
            copies = {name: (out / name).read_bytes() for name in names}
        for name, content in copies.items():
            (out / name).write_bytes(content)
    call = program.command(
        "report", "--store", f"sqlite:///{out}/lmshealth.sqlite", "--out", str(pages)
    )
    place = shlex.quote(str(out))
    mount = f"mount --bind {place} {place} && mount -o remount,bind,ro {place} && "
    mount = mount if unwritable else ""
    shell = ["unshare", *(["--map-root-user"] if os.geteuid() else []), "--mount", "sh", "-c"]
    done = subprocess.run(
        [*shell, f"{mount}exec {shlex.join(call)}"],
        env=program.environment(), capture_output=True, text=True, check=False,
    )  # fmt: skip
    same = done.returncode == 0 and all(
        (pages / name).read_bytes() == (out / name).read_bytes() for name in ("AX-3-Y.html",)
    )
    refused = done.returncode == 1 and "copy" in done.stderr and "-wal" in done.stderr
    return Seen(same or (wal and refused), last_line(done.stderr) or "pages written")


# Files that a manifest names or omits


def counted(
    program: Program,
    folder: Path,
    *,
    there: Sequence[str],
    listed: Sequence[str] = (),
    head: bool = True,
    notes: bool = False,
    used: str,
    status: int,
    reason: str = "",
) -> Seen:
    """Run over files, some of which a manifest lists; the summary counts all that were expected."""
    logs = folder / "logs"
    logs.mkdir()
    for number, name in enumerate(there):
        write_log(logs / name, number, head=head)
    if listed:
        write_manifest(logs, listed)
    if notes:
        (logs / "README.txt").write_text("Logs of axis 3.\n1 2 3\n" * 50)
        (logs / "limits.dat").write_text("1.0 2.0\n" * 10)
    done = analyse(program, folder)
    summary = done.stdout.split("\n")[0] if done.returncode != 1 else last_line(done.stderr)
    table = folder / "out" / "refused.csv"
    named = not reason or reason in (table.read_text() if table.exists() else "")
    answer = f"exit {done.returncode}: {summary[:80]}{'' if named else f', no {reason}'}"
    return Seen(used in summary and done.returncode == status and named, answer)


def case(name: str, right: str, fault: Callable[..., Seen], control: Callable[..., Seen]) -> Case:
    """Make a case of this kind."""
    return Case(KIND, name, right, fault, control)


TWO, TEXTS = ("0.csv", "1.csv"), ("0.txt", "1.txt")
all_used = partial(counted, there=TWO, listed=TWO, notes=True, used="2 of 2 logs", status=0)


def of_manifest(name: str, right: str, **files: Any) -> Case:
    """Make a case of files, some of which a manifest lists; in its control all are."""
    return case(name, right, partial(counted, **files), all_used)


CASES: tuple[Case, ...] = (
    case(
        "alert fails, then a run without",
        "delivered once by the next with it",
        failed_alert,
        two_alerts,
    ),
    case(
        "run by hand between two with alerts",
        "its change is delivered once",
        run_by_hand,
        two_alerts,
    ),
    case("status.json is cut off", "noted, and delivered once", cut_status, two_alerts),
    case("two runs at once", "delivered once", at_once, two_alerts),
    case(
        "alert command prints 1 GB",
        "bounded, and no failure",
        long_output,
        partial(long_output, n=1),
    ),
    case(
        "digit of a file's digest flipped",
        "analysed: exit 0, 0",
        flipped_digest,
        partial(flipped_digest, flips=False),
    ),
    case(
        "values of the store damaged",
        "as undamaged, or names the file",
        partial(damaged, damage=flip_value),
        partial(damaged, damage=keep, n=2),
    ),
    case(
        "pages of the store damaged",
        "as undamaged, or names the file",
        partial(damaged, damage=flip_page),
        partial(damaged, damage=keep, n=1),
    ),
    case(
        "incomplete file of a killed run",
        "removed; kept while a run writes it",
        abandoned,
        partial(abandoned, held=True),
    ),
    case(
        "report from a read-only folder",
        "pages as those of the run",
        read_only,
        partial(read_only, unwritable=False),
    ),
    case(
        "report from a read-only folder with -wal",
        "states what to copy",
        partial(read_only, wal=True),
        partial(read_only, wal=True, unwritable=False),
    ),
    of_manifest(
        "row of a manifest without its file", "2 of 3, exit 3, missing-file",
        there=TWO, listed=(*TWO, "2.csv"), used="2 of 3 logs", status=3, reason="missing-file",
    ),
    of_manifest(
        "no file of a manifest is there", "2 found, 2 refused, exit 1",
        there=(), listed=TWO, used="2 found, 2 refused", status=1, reason="missing-file",
    ),
    of_manifest(
        "log that the manifest omits", "analysed, exit 3, not-listed",
        there=TWO, listed=TWO[:1], used="2 of 2 logs", status=3, reason="not-listed",
    ),
    of_manifest(
        "log without metadata that the manifest omits", "1 of 2, exit 3, metadata",
        there=TWO, listed=TWO[:1], head=False, used="1 of 2 logs", status=3, reason="metadata",
    ),
    of_manifest(
        "manifest lists .txt", "2 of 2, exit 0",
        there=TEXTS, listed=TEXTS, head=False, used="2 of 2 logs", status=0,
    ),
    of_manifest(
        "folder of .txt", "2 of 2, exit 0", there=TEXTS, used="2 of 2 logs", status=0
    ),
    of_manifest(
        "log with an unread suffix", "2 of 3, exit 3, skipped",
        there=(*TWO, "2.prn"), used="2 of 3 logs", status=3, reason="skipped",
    ),
)  # fmt: skip
