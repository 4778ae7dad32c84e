"""Maintenance records: what is read, what is refused, where a life starts anew."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

import pytest

from lmshealth.errors import BadTable
from lmshealth.maintenance import RESETS, Action, after_last_reset, read_maintenance
from tests.lives import START, make_reading

HEAD = "stage,recorded_at,action\n"


def logs(n: int = 4) -> list:
    """Make readings one day apart from the start."""
    return [make_reading(str(k), k, 1e5 * k, {"roll": 4.8}) for k in range(n)]


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
    """Logs before the work are left out, the log at its very moment is kept, and a note says so."""
    kept, notes = after_last_reset(logs(), [done(action, 2)])
    assert [r.log for r in kept] == ["2", "3"]
    assert len(notes) == 1
    assert action in notes[0]
    assert "2 earlier logs" in notes[0]


def test_the_last_reset_counts() -> None:
    """Of several resets the last one opens the life."""
    kept, _ = after_last_reset(logs(), [done("guide-replaced", 0.5), done("mount-tightened", 2.5)])
    assert [r.log for r in kept] == ["3"]


def test_a_reset_without_later_logs_keeps_all_and_says_so() -> None:
    """Nothing is known after the last work, which the reader is told."""
    kept, notes = after_last_reset(logs(), [done("preload-adjust", 9)])
    assert len(kept) == 4
    assert "no log since" in notes[0]


def test_a_regreasing_changes_nothing() -> None:
    """Work that moves dampings alone leaves logs and notes as they are."""
    kept, notes = after_last_reset(logs(), [done("regrease", 2)])
    assert len(kept) == 4
    assert notes == []


def test_a_retuning_inside_the_life_is_told() -> None:
    """A servo or sensor change after the first kept log is noted, one before it is not."""
    actions = [done("servo", 0.5), done("mount-tightened", 1.5), done("sensor", 2.5)]
    kept, notes = after_last_reset(logs(), actions)
    assert [r.log for r in kept] == ["2", "3"]
    assert len(notes) == 2
    assert "sensor" in notes[1]
