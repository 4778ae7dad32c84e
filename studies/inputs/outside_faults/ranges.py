"""Dates, numbers and types that no machine has: in logs, tables, descriptions and options.

The faulty input has one date or number out of its range (or all dates in one offset, which pandas
makes Timestamps of); its control has a usual one in the same place.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from studies.inputs.outside_faults.case import Case, Program, Seen, is_traceback, last_line

KIND = "ranges"
START = datetime(2024, 3, 1, 6, tzinfo=UTC)
ROOT = Path(__file__).parents[3]
SHIPPED = ROOT / "lmshealth" / "stage" / "descriptions"

Change = Callable[[pd.DataFrame], None]
Ask = Callable[[Program, Path], Seen]


def estimates(folder: Path, n: int, change: Change = lambda table: None) -> Path:
    """Write modal estimates of a machine of lms-y that loses preload, a log a day and 12 km."""
    rng = np.random.default_rng(42)
    rows = []
    for k in range(n):
        moment = (START + timedelta(days=k)).isoformat()
        loss = 1 - 0.05 * k / n
        for mode, frequency, weight in (("roll", 126.4, 1), ("pitch", 136.6, 1.2), ("yaw", 155, 1)):
            f = frequency * loss**weight * (1 + 3e-4 * rng.standard_normal())
            rows.append([f"{k:03d}", moment, 12 * k, 21, mode, f, 3e-4 * frequency, 0.015, 0.0005])
    names = ["log", "recorded_at", "travel_km", "temperature_c", "mode", "frequency_hz"]
    names += ["frequency_std_hz", "damping_ratio", "damping_ratio_std"]
    table = pd.DataFrame(rows, columns=names)
    table.insert(0, "stage", "LMS-1-Y")
    change(table)
    path = folder / "modes.csv"
    table.to_csv(path, index=False)
    return path


def put(column: str, value: float | str, log: int = 3) -> Change:
    """Put a value into the rows of one log of a table."""

    def change(table: pd.DataFrame) -> None:
        table[column] = table[column].astype(object)
        table.loc[table["log"] == f"{log:03d}", column] = value

    return change


def answered(done: subprocess.CompletedProcess[str], *words: str) -> Seen:
    """Judge a refusal: no traceback, no request for a report, and the words in one message."""
    text = done.stdout + done.stderr
    right = done.returncode in (1, 2, 3) and not is_traceback(done)
    return Seen(right and all(word in text for word in words), last_line(text))


def accepted(done: subprocess.CompletedProcess[str]) -> Seen:
    """Judge a result without refusal."""
    return Seen(done.returncode == 0, last_line(done.stderr or done.stdout))


def track(program: Program, folder: Path, *, n: int = 8, change: Change | None = None) -> Seen:
    """Track a table, and accept it; with a change of one value, refuse that."""
    table = estimates(folder, n, change or (lambda table: None))
    done = program("track", table, "--stage", "lms-y", "--out", folder / "track.csv")
    return accepted(done) if change is None else answered(done, "modes.csv, line 11", "needed")


def unset(program: Program, folder: Path, *, log: int, moment: str) -> Seen:
    """Track forty logs, of which one has a date of its own, and list the logs of the track."""
    change = put("recorded_at", moment, log) if moment else lambda table: None
    table, out = estimates(folder, 40, change), folder / "track.csv"
    done = program("track", table, "--stage", "lms-y", "--out", out)
    days = pd.to_datetime(pd.read_csv(out)["recorded_at"], utc=True, format="ISO8601")
    span = int((days.max() - days.min()).days)
    right = span < 40 and ("1 date" in done.stderr) == bool(moment)
    return Seen(right, f"logs of {span} days; {last_line(done.stderr)[:80]}")


def offset(program: Program, folder: Path, *, dates: str) -> Seen:
    """Track 140 logs whose dates have one offset, or two."""

    def change(table: pd.DataFrame) -> None:
        if dates == "two":
            table["recorded_at"] = [
                moment
                if k % 2
                else datetime.fromisoformat(moment).isoformat().replace("+00", "-00")
                for k, moment in enumerate(table["recorded_at"])
            ]

    table = estimates(folder, 140, change)
    return accepted(program("track", table, "--stage", "lms-y", "--out", folder / "track.csv"))


def log(folder: Path, name: str, **metadata: object) -> Path:
    """Write ten seconds of noise of two channels, with metadata."""
    given = {"sample_rate_hz": 1000, "stage": "LMS-1-Y", "travel_km": 12.5}
    given |= {"recorded_at": START.isoformat(), **metadata}
    values = np.random.default_rng(3).standard_normal((10_000, 2))
    head = [f"# {key}: {value}" for key, value in given.items()]
    head += ["acc_roll_m_s2,acc_pitch_m_s2"]
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, values, fmt="%.6g", delimiter=",", header="\n".join(head), comments="")
    return path


def run(program: Program, folder: Path, *, given: dict[str, object], where: str) -> Seen:
    """Run over two logs: the one with a value out of range is refused, the other one is used."""
    logs, out = folder / "logs", folder / "out"
    log(logs, "good.csv")
    log(logs, "other.csv", **({"travel_km": 20} | (given if where == "file" else {})))
    if where == "manifest":
        row = ",".join(map(str, given.values()))
        (logs / "manifest.csv").write_text(f"file,{','.join(given)}\nother.csv,{row}\n")
    done = program("run", logs, "--stage", "lms-y", "--out", out, "--workers", "1")
    refused = pd.read_csv(out / "refused.csv", keep_default_na=False)
    whole = refused[(refused["mode"] == "") & (refused["channel"] == "")]
    reasons = dict(zip(whole["log"], whole["reason"], strict=True))
    if any(str(value) in ("21", "2024-03-02T06:00:00Z") for value in given.values()):
        return Seen(done.returncode == 0 and not reasons, str(reasons or "no refusal"))
    right = done.returncode == 3 and set(reasons) == {"other.csv"} and not is_traceback(done)
    return Seen(right, str(reasons) if reasons else last_line(done.stdout + done.stderr))


def described(program: Program, folder: Path, *, old: str, new: str) -> Seen:
    """Check a description in which a number is replaced; an empty one keeps the number."""
    shutil.copy(SHIPPED / "lms-y.map.csv", folder)
    text = (SHIPPED / "lms-y.toml").read_text()
    path = folder / "own.toml"
    path.write_text(text.replace(old, new or old, 1))
    done = program("stage", path, timeout=60)
    return answered(done, new.split()[0], "needed") if new else accepted(done)


def mapped(program: Program, folder: Path, *, value: str) -> Seen:
    """Check a description whose map has another frequency in its first row."""
    shutil.copy(SHIPPED / "lms-y.toml", folder / "own.toml")
    lines = (SHIPPED / "lms-y.map.csv").read_text().splitlines()
    if value:
        lines[1] = ",".join([*lines[1].split(",")[:-1], value])
    (folder / "lms-y.map.csv").write_text("\n".join(lines))
    done = program("stage", folder / "own.toml", timeout=60)
    return answered(done, "line 2", "needed") if value else accepted(done)


def option(program: Program, folder: Path, *, words: Sequence[str], right: bool) -> Seen:
    """Call a command with a number of an option."""
    done = program(*words, cwd=folder, timeout=60)
    return accepted(done) if right else answered(done)


def _cases(name: str, right: str, fault: Ask, control: Ask) -> Case:
    return Case(KIND, name, right, fault, control)


def _tables() -> list[Case]:
    control = partial(track)
    found = [
        _cases(
            f"table: {column} {value}", "refused by row and value",
            partial(track, change=put(column, value)), control,
        )
        for column, value in (
            ("recorded_at", "0001-01-01T00:00:00+00:00"),
            ("recorded_at", "1969-07-20T20:17:00+00:00"),
            ("recorded_at", "9999-12-31T23:59:59+00:00"),
            ("travel_km", "1e300"),
            ("temperature_c", "1e300"),
        )
    ]  # fmt: skip
    found.append(
        _cases(
            "table: 140 logs of one offset from UTC", "tracked",
            partial(offset, dates="one"), partial(offset, dates="two"),
        )
    )  # fmt: skip
    found += [
        _cases(
            f"table: the first of forty logs is dated {moment[:10]}",
            "refused: the other logs are of 39 days",
            partial(unset, log=0, moment=moment),
            partial(unset, log=0, moment=""),
        )
        for moment in ("1970-01-01T00:00:10+00:00", "2000-01-01T00:01:00+00:00")
    ]
    return found


def _logs() -> list[Case]:
    usual: dict[str, object] = {"temperature_c": 21}
    values: list[tuple[dict[str, object], str]] = [
        ({"recorded_at": "0001-01-01T00:00:00Z", "travel_km": 5}, "file"),
        ({"recorded_at": "9999-12-31T00:00:00Z"}, "manifest"),
        ({"recorded_at": "2062-03-01T06:00:00Z"}, "file"),
        ({"recorded_at": "2062-03-01T06:00:00Z"}, "manifest"),
        ({"travel_km": "1e300"}, "manifest"),
        ({"temperature_c": "1e300"}, "file"),
    ]
    return [
        _cases(
            f"{where}: {next(iter(given))} {next(iter(given.values()))}",
            "this log is refused, the other one used",
            partial(run, given=given, where=where),
            partial(run, given=usual, where=where),
        )
        for given, where in values
    ]


def _descriptions() -> list[Case]:
    changes = [
        ("frequency_hz = 126.4", "frequency_hz = 1e300"),
        ("sigma = 0.3", "sigma = 1e-300"),
        ("reference = 21.0", "reference = nan"),
        ("reference = 21.0", "reference = inf"),
        ("horizon_km = 20000", "horizon_km = 1e300"),
        ("median = 8000", "median = 1e300"),
    ]
    found = [
        _cases(
            f"description: {new}", "refused by key, value and range",
            partial(described, old=old, new=new), partial(described, old=old, new=""),
        )
        for old, new in changes
    ]  # fmt: skip
    found += [
        _cases(
            f"modal map: {value} Hz", "refused by line and value",
            partial(mapped, value=value), partial(mapped, value=""),
        )
        for value in ("1e300", "1e-300", "nan")
    ]  # fmt: skip
    plan = ["plan", "--stage", "lms-y", "--detect", "guide_preload=0.05"]
    watch = ["watch", ".", "--stage", "lms-y", "--out", "out"]
    for words, usual in (
        ([*plan, "--seconds", "inf"], [*plan, "--seconds", "20"]),
        ([*plan, "--seconds", "1e300"], [*plan, "--seconds", "20"]),
        ([*watch, "--interval", "1e300"], [*plan, "--power", "0.9"]),
    ):
        found.append(
            _cases(
                f"option: {words[0]} {' '.join(words[-2:])}", "wrong usage",
                partial(option, words=words, right=False), partial(option, words=usual, right=True),
            )
        )  # fmt: skip
    return found


CASES: tuple[Case, ...] = (*_tables(), *_logs(), *_descriptions())
