"""Maintenance records: what is read, what is refused, where a life starts anew."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

import pytest

from lmshealth.errors import BadTable
from lmshealth.maintenance import RESETS, STEPS, Action, maintenance_notes, read_maintenance
from tests.lives import START

HEAD = "stage,recorded_at,action\n"


MOMENTS = [START + timedelta(days=k) for k in range(4)]


def done(action: str, day: float) -> Action:
    """Give one action so many days after the start."""
    return Action("AX-1", START + timedelta(days=day), action)


def test_all_files_below_a_folder_are_read_in_the_order_of_time(tmp_path: Path) -> None:
    """Actions of several files come out sorted by their moment, zones respected."""
    (tmp_path / "deep").mkdir()
    (tmp_path / "maintenance.csv").write_text(HEAD + "A,2026-05-01T10:00:00+02:00,regrease\n")
    (tmp_path / "deep" / "maintenance.csv").write_text(HEAD + "B,2026-05-01T09:00:00Z,servo\n")
    found = read_maintenance(tmp_path)
    assert [(a.stage, a.action) for a in found] == [("A", "regrease"), ("B", "servo")]


def test_no_file_is_no_maintenance(tmp_path: Path) -> None:
    """A folder without records gives nothing."""
    assert read_maintenance(tmp_path) == ()


@pytest.mark.parametrize(
    ("text", "needle"),
    [
        ("stage,action\nA,servo\n", "recorded_at"),
        (HEAD + "A,2026-05-01T09:00:00Z,repainted\n", "line 2.*repainted.*known are"),
        (HEAD + "A,yesterday,servo\n", "line 2.*no ISO date"),
        (HEAD + "A,2026-05-01T09:00:00Z,servo\nA,2026-05-01T09:00:00,servo\n", "line 3.*time zone"),
        ("", "cannot be read"),
        (HEAD + "A,2026-05-01T09:00:00Z\n", "line 2"),
    ],
)
def test_a_record_that_breaks_its_contract_is_refused(
    tmp_path: Path, text: str, needle: str
) -> None:
    """The error names the file, the line and what is wrong."""
    (tmp_path / "maintenance.csv").write_text(text)
    with pytest.raises(BadTable, match=needle) as caught:
        read_maintenance(tmp_path)
    assert "maintenance.csv" in str(caught.value)


@pytest.mark.parametrize("action", RESETS)
def test_work_on_guide_or_mount_opens_a_new_baseline(action: str) -> None:
    """The reader is told what earlier logs are still good for; a log at that moment is later."""
    notes = maintenance_notes([done(action, 2)], MOMENTS)
    assert len(notes) == 1
    assert action in notes[0]
    assert "2 earlier logs" in notes[0]


def test_a_reset_without_later_logs_says_so() -> None:
    """Nothing is known after the last work, which the reader is told."""
    assert "no log since" in maintenance_notes([done("preload-adjust", 9)], MOMENTS)[0]


def test_a_reset_before_the_first_log_needs_no_word() -> None:
    """The life that the logs show begins after it."""
    assert maintenance_notes([done("guide-replaced", -1)], MOMENTS) == []


@pytest.mark.parametrize("action", STEPS)
def test_work_that_leaves_guide_and_mount_needs_no_word(action: str) -> None:
    """What it did stands among the events."""
    assert maintenance_notes([done(action, 2)], MOMENTS) == []
