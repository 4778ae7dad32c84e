"""Maintenance: what was done to a machine, and where its life starts anew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import pandas as pd

from lmshealth.errors import BadTable

_NEEDED = ("stage", "recorded_at", "action")
# Work on guide or mount changes what "the state at baseline" means.
RESETS = ("preload-adjust", "guide-replaced", "mount-tightened")
# These move dampings, closed loop and readings at once, without wear.
STEPS = ("regrease", "servo", "sensor")


@dataclass(frozen=True, slots=True)
class Action:
    """One row of ``maintenance.csv``."""

    stage: str
    recorded_at: datetime
    action: str


def read_maintenance(folder: Path) -> tuple[Action, ...]:
    """Read every ``maintenance.csv`` below a folder, in the order of time.

    Raises
    ------
    BadTable
        If a column is missing, an action is unknown, or a moment has no time zone.
    """
    actions: list[Action] = []
    for path in sorted(folder.rglob("maintenance.csv")):
        actions += read_actions(path)
    return tuple(sorted(actions, key=lambda action: action.recorded_at))


def read_actions(path: Path) -> list[Action]:
    """Read one table of maintenance, as `read_maintenance` does."""
    try:
        table = pd.read_csv(path, dtype=str, keep_default_na=False)
    except (OSError, ValueError) as error:
        raise BadTable(f"{path}: cannot be read: {error}") from error
    missing = [name for name in _NEEDED if name not in table.columns]
    if missing:
        raise BadTable(f"{path}: no column {missing}; there are {list(table.columns)}")
    known = (*RESETS, *STEPS)
    actions = []
    for number, row in enumerate(table.itertuples(index=False), start=2):
        where = f"{path}, line {number}"
        if str(row.action) not in known:
            raise BadTable(f"{where}: action {row.action!r} is unknown; known are {list(known)}")
        try:
            moment = datetime.fromisoformat(str(row.recorded_at))
        except ValueError as error:
            raise BadTable(f"{where}: recorded_at {row.recorded_at!r} is no ISO date") from error
        if moment.tzinfo is None:
            raise BadTable(f"{where}: recorded_at {row.recorded_at!r} needs a time zone")
        actions.append(Action(str(row.stage), moment, str(row.action)))
    return actions


def maintenance_notes(actions: Sequence[Action], moments: Sequence[datetime | None]) -> list[str]:
    """Say what the reader of a report must know of the work on a machine.

    Parameters
    ----------
    actions : sequence of Action
        Its maintenance, in the order of time.
    moments : sequence of datetime or None
        When its logs were recorded.
    """
    notes = []
    resets = [action for action in actions if action.action in RESETS]
    for action in resets:
        before = sum(moment is not None and moment < action.recorded_at for moment in moments)
        told = f"{action.action} on {action.recorded_at.date().isoformat()}"
        if before == len(moments):
            notes.append(f"{told}: no log since, so nothing is known after it.")
        elif before:
            notes.append(
                f"{told} opened a new baseline: fractions are relative to the state after it, and "
                f"{before} earlier logs only tell what temperature, load and loop do."
            )
    return notes
