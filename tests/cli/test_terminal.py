"""Terminal: JSON without NaN, prose and tables that fit, no bars in a pipe."""

from __future__ import annotations

import io
import json
import logging
import math
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.cells import cell_len

from lmshealth.cli import options, terminal
from lmshealth.cli.terminal import print_json, print_refused, print_text, progress_bars

NAN = float("nan")


def test_json_has_null_for_what_is_no_number(capsys: pytest.CaptureFixture[str]) -> None:
    """NaN and infinity at any depth become null."""
    print_json({"rows": [{"a": NAN, "b": [math.inf, 1.0], "c": "x"}]})
    assert json.loads(capsys.readouterr().out) == {
        "rows": [{"a": None, "b": [None, 1.0], "c": "x"}]
    }


def test_there_is_no_bar_where_there_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing is written to a pipe."""
    with progress_bars() as report:
        report("logs", 1, 2)
        report("logs", 2, 2)
    captured = capsys.readouterr()
    assert captured.err == captured.out == ""


@pytest.mark.parametrize(("delay", "shown"), [(0.0, True), (60.0, False)])
def test_a_bar_appears_on_a_terminal_after_its_delay(
    monkeypatch: pytest.MonkeyPatch, delay: float, shown: bool
) -> None:
    """Short work shows none."""
    terminal = io.StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(sys, "stderr", terminal)
    with progress_bars(delay) as report:
        report("fitting", 1, 3)
    assert ("fitting" in terminal.getvalue()) == shown


def test_a_bar_appears_while_nothing_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """Work that is silent after its first report is shown all the same."""
    terminal = io.StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(sys, "stderr", terminal)
    with progress_bars(0.3) as report:
        report("logs", 0, 1)
        assert "logs" not in terminal.getvalue()
        end = time.monotonic() + 20
        while "logs" not in terminal.getvalue() and time.monotonic() < end:
            time.sleep(0.05)
        assert "logs" in terminal.getvalue()


def test_prose_is_wrapped_between_words(capsys: pytest.CaptureFixture[str]) -> None:
    """Lines fit a terminal; names, dates and numbers with a sign stay whole; lines are kept."""
    name = "some/folder-of-logs/" + 8 * "velocity-0001" + ".h5"
    print_text("so it is " * 20 + name + " since 2026-03-01\nsecond", "! ")
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("! so it is") and lines[-1] == "second"
    assert any(line.strip() == name for line in lines)
    assert all(len(line) <= 78 for line in lines if name not in line)
    assert any("2026-03-01" in line for line in lines)


def test_names_in_a_wide_table_are_not_torn(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last column gives way; folders are left out unless two logs have one name."""
    monkeypatch.setattr(terminal, "_width", lambda stream: 80)
    row = {"log": "far/away/on/a/disk/log-0001.h5", "channel": "acc_pitch", "mode": "roll",
           "reason": "not-excited", "detail": "no " * 40}  # fmt: skip
    print_refused([row])
    out = capsys.readouterr().out
    assert max(len(line) for line in out.splitlines()) <= 80
    assert any(
        line.split()[:4] == ["log-0001.h5", "acc_pitch", "roll", "not-excited"]
        for line in out.splitlines()
    )
    print_refused([row | {"log": f"{k}/log.h5"} for k in "ab"])
    out = capsys.readouterr().out
    assert "a/log.h5" in out and "b/log.h5" in out


@pytest.mark.parametrize("columns", [None, 12, 80, 200])
def test_a_table_is_as_wide_as_its_terminal_and_never_cut(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, columns: int | None
) -> None:
    """In a pipe every row is one line; on a terminal only texts are wrapped, numbers stay whole."""
    monkeypatch.setattr(terminal, "_width", lambda stream: columns)
    row = {"mode": "roll", "detail": "no resonance " * 30, "loss, 5 logs": "1 234 567.8"}
    terminal.print_table("Title", [row, row | {"mode": "pitch"}], 2)
    out = capsys.readouterr().out
    assert "…" not in out and out.count("1 234 567.8") == 2
    lines = [line for line in out.splitlines() if "resonance" in line]
    assert len(lines) == 2 if columns is None else len(lines) > 2
    if columns in (80, 200):
        assert columns - 20 < max(map(len, out.splitlines())) <= columns


LONG = "a-name-without-blanks-" * 4
WIDE = {
    "log": LONG, "mode": "mode_1", "channel": "加速度計_左", "frequency Hz": "12 126.649 ± 0.262",
    "damping %": "1.55 ± 0.21", "SNR": "1 770", "flags": "resolution-limited unsteady loose-fit",
}  # fmt: skip
MANY = {f"column {k}": f"{k}.25 ± 0.5" for k in range(30)}


@pytest.mark.parametrize("columns", [12, 40, 60, 80, 100, 200])
@pytest.mark.parametrize(("row", "n_texts"), [(WIDE, 3), (MANY, 0), ({"a": LONG, "b": LONG}, 2)])
def test_nothing_is_wider_than_the_terminal(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    columns: int,
    row: dict[str, str],
    n_texts: int,
) -> None:
    """Texts are wrapped, or a row has a line for each cell; numbers are whole, nothing is cut."""
    monkeypatch.setattr(terminal, "_width", lambda stream: columns)
    terminal.print_table(f"Title of {LONG}", [row, row], n_texts)
    print_text(f"Text about {LONG} and 加速度計 " * 3, "! ")
    terminal.print_line(f"Report: {LONG}")
    out = capsys.readouterr().out
    assert max(map(cell_len, out.splitlines())) <= columns
    assert "…" not in out
    letters = "".join(out.split())
    for name, cell in row.items():
        fits = name not in ("log", "a", "b") and cell_len(cell) <= columns - 1
        if fits and name != "flags":
            assert out.count(cell) >= 2, cell
        assert letters.count(cell.replace(" ", "")[:8]) >= 2 or not fits


def test_a_log_file_has_events_notes_and_errors_and_ends_with_its_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Events carry their time; what is printed anyway is not printed twice; quiet hides notes."""

    @options.command("none")
    def talk() -> None:
        with progress_bars() as report:
            for k in range(101):
                report("fitting", k, 100)
        terminal.print_notes(["beware"])
        terminal.print_errors(["it failed"])

    file = tmp_path / "log.txt"
    talk(["-v", "--log-file", str(file)], standalone_mode=False)
    shown, text = capsys.readouterr().err, file.read_text(encoding="utf-8")
    assert text.count("fitting: ") == shown.count("fitting: ") == 11
    assert text.count("beware") == text.count("it failed") == 1
    assert shown.count("beware") == shown.count("it failed") == 1
    assert all(line[:2] == "20" for line in text.splitlines())
    talk(["--quiet"], standalone_mode=False)
    assert capsys.readouterr().err == "lmshealth: it failed\n"
    assert file.read_text(encoding="utf-8") == text
    assert logging.getLogger("lmshealth").handlers == []


@pytest.mark.slow
def test_a_closed_pipe_ends_without_a_word() -> None:
    """As `| head` closes it."""
    words = [sys.executable, "-m", "lmshealth", "stage", "lms-y", "--format", "json"]
    pipe = subprocess.PIPE
    with subprocess.Popen(words, stdout=pipe, stderr=pipe) as started:
        assert started.stdout is not None and started.stderr is not None
        started.stdout.close()
        assert started.stderr.read() == b""
    assert started.returncode == 1
