"""Maintenance: rows read, rows refused, new baselines."""

from __future__ import annotations

import os
from datetime import timedelta
from pathlib import Path

import pytest

from lmshealth.errors import BadTable
from lmshealth.tracking.maintenance import (
    RESETS,
    STEPS,
    Action,
    Maintenance,
    maintenance_notices,
    read_maintenance,
    read_work,
)
from tests.lives import START

HEAD = "stage,recorded_at,action\n"


MOMENTS = [START + timedelta(days=k) for k in range(4)]


def done(action: str, day: float) -> Action:
    """Return an action some days after the start."""
    return Action("AX-1", START + timedelta(days=day), action)


def test_all_files_below_a_folder_are_read_in_the_order_of_time(tmp_path: Path) -> None:
    """Actions of several files are sorted by moment, with time zones."""
    (tmp_path / "deep").mkdir()
    (tmp_path / "maintenance.csv").write_text(HEAD + "A,2026-05-01T10:00:00+02:00,regrease\n")
    (tmp_path / "deep" / "maintenance.csv").write_text(HEAD + "B,2026-05-01T09:00:00Z,servo\n")
    found = read_maintenance(tmp_path)
    assert [(a.stage, a.action) for a in found.actions] == [("A", "regrease"), ("B", "servo")]


def test_rows_of_a_table_are_put_in_the_order_of_time(tmp_path: Path) -> None:
    """Rows in any order are read in the order of time, with time zones."""
    path = tmp_path / "maintenance.csv"
    rows = ["A,2026-05-02T09:00:00Z,servo", "B,2026-05-01T09:00:00Z,regrease"]
    path.write_text(HEAD + "\n".join([*rows, "A,2026-05-01T10:00:00+02:00,servo\n"]))
    found = [(action.stage, action.recorded_at.day) for action in read_work(path).actions]
    assert found == [("A", 1), ("B", 1), ("A", 2)]


def test_no_file_is_no_maintenance(tmp_path: Path) -> None:
    """A folder without tables has no actions."""
    assert read_maintenance(tmp_path) == Maintenance()


@pytest.mark.parametrize(
    ("text", "needle"),
    [
        ("stage,action\nA,servo\n", "recorded_at"),
        (HEAD + "A,2026-05-01T09:00:00Z,repainted\n", "line 2.*repainted.*known are"),
        (HEAD + "A,yesterday,servo\n", "line 2.*recorded_at is .yesterday., needed ISO"),
        (HEAD + "A,2026-05-01T09:00:00Z,servo\nA,2026-05-01T09:00:00,servo\n", "line 3.*time zone"),
        ("", "no header line"),
        (HEAD + "A,2026-05-01T09:00:00Z\n", "line 2"),
    ],
)
def test_a_table_that_is_named_is_refused_for_any_row(
    tmp_path: Path, text: str, needle: str
) -> None:
    """The error names the file, the line and what is wrong; below a folder it is a refusal."""
    path = tmp_path / "maintenance.csv"
    path.write_text(text)
    with pytest.raises(BadTable, match=needle) as caught:
        read_work(path)
    assert "maintenance.csv" in str(caught.value)
    (one,) = read_maintenance(tmp_path).unread
    assert one.refusal.log == "maintenance.csv"
    assert f"{path}, {one.refusal.detail}" == str(caught.value)


def test_a_bad_row_below_a_folder_costs_no_other_row(tmp_path: Path) -> None:
    """The rows around a bad row are read, also after an open quote; its machine is kept."""
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "maintenance.csv").write_text(
        "stage,recorded_at,travel_km,action,remark\n"
        "A,2026-05-01T09:00:00Z,many,servo,what is not used is not judged\n"
        'B,2026-05-02T09:00:00Z,1,"regrease,\n'
        "A,2026-05-03T09:00:00Z,1,repainted,\n"
        ",2026-05-03T09:00:00Z,1,sensor,\n"
        'A,2026-05-04T09:00:00Z,1,sensor,"two\nlines"\n'
        "A,2026-05-05T09:00:00Z,1,servo,,,more\n"
        "A\u202e,2026-05-05T09:00:00Z,1,servo,\n"
        "C,2026-05-06T09:00:00Z,1,guide-replaced,,\n"
    )
    found = read_maintenance(tmp_path)
    assert [(a.stage, a.action) for a in found.actions] == [
        ("A", "servo"),
        ("A", "sensor"),
        ("C", "guide-replaced"),
    ]
    told = [(u.stage, u.refusal.reason, u.refusal.detail.split(":")[0]) for u in found.unread]
    assert told == [
        ("B", "bad-row", "line 3"),
        ("A", "bad-row", "line 4"),
        ("", "bad-row", "line 5"),
        ("A", "bad-row", "line 8"),
        ("", "bad-row", "line 9"),
    ]
    assert {u.refusal.log for u in found.unread} == {"deep/maintenance.csv"}


def test_a_table_with_semicolons_is_read(tmp_path: Path) -> None:
    """As spreadsheets write it where the decimal mark is a comma."""
    text = (HEAD + "A,2026-05-01T09:00:00Z,servo\n").replace(",", ";")
    (tmp_path / "maintenance.csv").write_text(text, encoding="utf-16")
    (action,) = read_maintenance(tmp_path).actions
    assert (action.stage, action.action) == ("A", "servo")


def test_what_is_not_understood_is_told_to_the_machine_it_names(tmp_path: Path) -> None:
    """The note is for the machine of the row, and for all machines if a table is unreadable."""
    (tmp_path / "maintenance.csv").write_text(HEAD + "A,2026-05-01T09:00:00Z,repainted\n")
    work = read_maintenance(tmp_path)
    (note,) = maintenance_notices(work.of("A"), MOMENTS)
    assert "line 2: action 'repainted' is unknown" in note.what
    assert work.of("B") == Maintenance()
    (tmp_path / "maintenance.csv").write_text("stage|recorded_at|action\n")
    for machine in ("A", "B"):
        (note,) = maintenance_notices(read_maintenance(tmp_path).of(machine), MOMENTS)
        assert "columns are stage|recorded_at|action" in note.what


def test_maintenance_out_of_the_folder_is_not_read(tmp_path: Path) -> None:
    """Links out of the folder, and what is no file, are refused without being opened."""
    (tmp_path / "outside.csv").write_text(HEAD + "A,2026-05-01T09:00:00Z,servo\n")
    (tmp_path / "in" / "deep").mkdir(parents=True)
    (tmp_path / "in" / "maintenance.csv").symlink_to(tmp_path / "outside.csv")
    os.mkfifo(tmp_path / "in" / "deep" / "maintenance.csv")
    found = read_maintenance(tmp_path / "in")
    assert found.actions == ()
    assert [u.refusal.reason for u in found.unread] == ["escapes", "missing-file"]


@pytest.mark.parametrize("action", RESETS)
def test_work_on_guide_or_mount_opens_a_new_baseline(action: str) -> None:
    """The note states the use of earlier logs; a log at that moment is later."""
    notes = maintenance_notices(Maintenance((done(action, 2),)), MOMENTS)
    assert len(notes) == 1
    assert action in notes[0].what
    assert "Earlier logs (2)" in notes[0].what


def test_a_reset_without_later_logs_says_so() -> None:
    """The note states that no log follows the last work."""
    assert (
        "no log since"
        in maintenance_notices(Maintenance((done("preload-adjust", 9),)), MOMENTS)[0].what
    )


def test_a_reset_before_the_first_log_needs_no_word() -> None:
    """An action before the first log has no note."""
    assert maintenance_notices(Maintenance((done("guide-replaced", -1),)), MOMENTS) == []


@pytest.mark.parametrize("action", STEPS)
def test_work_that_leaves_guide_and_mount_needs_no_word(action: str) -> None:
    """An action without a reset has no note; its step is an event."""
    assert maintenance_notices(Maintenance((done(action, 2),)), MOMENTS) == []
