"""Maintenance: what was done to a machine, and where its life starts anew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import pandas as pd

from lmshealth.errors import BadTable
from lmshealth.history import Reading

_NEEDED = ("stage", "recorded_at", "action")
# Work on guide or mount changes what "the state at baseline" means.
RESETS = ("preload-adjust", "guide-replaced", "mount-tightened")
# A regreasing moves dampings, which health is not read from.
HARMLESS = ("regrease",)
# These step frequencies or readings without wear.
STEPS = ("servo", "sensor")


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
        actions += _read(path)
    return tuple(sorted(actions, key=lambda action: action.recorded_at))


def _read(path: Path) -> list[Action]:
    try:
        table = pd.read_csv(path, dtype=str, keep_default_na=False)
    except (OSError, ValueError) as error:
        raise BadTable(f"{path}: cannot be read: {error}") from error
    missing = [name for name in _NEEDED if name not in table.columns]
    if missing:
        raise BadTable(f"{path}: no column {missing}; there are {list(table.columns)}")
    known = (*RESETS, *HARMLESS, *STEPS)
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


def after_last_reset(
    readings: Sequence[Reading], actions: Sequence[Action]
) -> tuple[list[Reading], list[str]]:
    """Keep the logs since the last work on guide or mount.

    Parameters
    ----------
    readings : sequence of Reading
        Logs of one machine.
    actions : sequence of Action
        Its maintenance, in the order of time.

    Returns
    -------
    readings : list of Reading
        Those after the last reset; all of them when there is no log after it.
    notes : list of str
        What the reader of the report must know about it.
    """
    notes = []
    kept = list(readings)
    resets = [action for action in actions if action.action in RESETS]
    if resets:
        last = resets[-1]
        later = [
            r
            for r in readings
            if r.metadata.recorded_at and (r.metadata.recorded_at >= last.recorded_at)
        ]
        moment = last.recorded_at.date().isoformat()
        if later:
            kept = later
            notes.append(
                f"{last.action} on {moment} opened a new baseline: all fractions are relative to "
                f"the state after it, and {len(readings) - len(later)} earlier logs are left out."
            )
        else:
            notes.append(f"{last.action} on {moment}: no log since, so nothing is known after it.")
    begin = min((r.metadata.recorded_at for r in kept if r.metadata.recorded_at), default=None)
    for action in actions:
        if action.action in STEPS and begin is not None and action.recorded_at > begin:
            notes.append(
                f"{action.action} on {action.recorded_at.date().isoformat()} may have stepped the "
                "frequencies; drifts across it are not corrected for that."
            )
    return kept, notes
