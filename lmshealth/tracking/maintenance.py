"""Maintenance: what was done to a machine, and where its life starts anew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from lmshealth.errors import BadTable
from lmshealth.io.log import Refusal
from lmshealth.io.manifest import find_sheets, name_of
from lmshealth.io.metadata import parse_moment, parse_name
from lmshealth.io.refusal import Unusable, shown
from lmshealth.io.tables import Row, read_sheet

_FILE = "maintenance.csv"
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


@dataclass(frozen=True, slots=True)
class Unread:
    """Something of ``maintenance.csv`` that is not understood.

    Attributes
    ----------
    refusal : Refusal
        What and why, under the name of the table.
    stage : str or None
        The machine that a row names, empty where it names none; None for a whole table.
    """

    refusal: Refusal
    stage: str | None


@dataclass(frozen=True, slots=True)
class Maintenance:
    """What was done, as far as it is understood.

    Attributes
    ----------
    actions : tuple of Action
        In the order of time.
    unread : tuple of Unread
        What may have been done besides.
    """

    actions: tuple[Action, ...] = ()
    unread: tuple[Unread, ...] = ()

    @property
    def refused(self) -> tuple[Refusal, ...]:
        """What is not understood, for ``refused.csv``."""
        return tuple(one.refusal for one in self.unread)

    def of(self, machine: str) -> Maintenance:
        """Give what concerns one machine; what names none may concern any."""
        return Maintenance(
            tuple(action for action in self.actions if action.stage == machine),
            tuple(one for one in self.unread if one.stage in (machine, "", None)),
        )


NO_MAINTENANCE = Maintenance()
"""What is known where there is no table."""


def read_maintenance(folder: Path) -> Maintenance:
    """Read every ``maintenance.csv`` below a folder.

    Raises
    ------
    BadTable
        If it is no folder.
    """
    found = find_sheets(folder, _FILE)
    actions: list[Action] = []
    unread = [Unread(refusal, None) for refusal in found.refused]
    for path in found.logs:
        _read(path, name_of(path, folder), actions, unread)
    return Maintenance(tuple(sorted(actions, key=lambda a: a.recorded_at)), tuple(unread))


def read_actions(path: Path) -> tuple[Action, ...]:
    """Read one table of maintenance, in the order of time.

    Raises
    ------
    BadTable
        If anything in it is not understood: who names one table can mend it.
    """
    actions: list[Action] = []
    unread: list[Unread] = []
    _read(path, shown(path), actions, unread)
    for one in unread:
        raise BadTable(f"{one.refusal.log}, {one.refusal.detail}")
    return tuple(sorted(actions, key=lambda a: a.recorded_at))


def _read(path: Path, name: str, actions: list[Action], unread: list[Unread]) -> None:
    try:
        for row in read_sheet(path, _NEEDED):
            try:
                actions.append(_action(row))
            except Unusable as error:
                refusal = Refusal(name, "bad-row", f"{row.where}: {error.detail}")
                unread.append(Unread(refusal, _machine(row)))
    except Unusable as error:
        unread.append(Unread(Refusal(name, error.reason, error.detail), None))


def _action(row: Row) -> Action:
    """Read a row; what is not used of it is not judged."""
    if row.trouble:
        raise Unusable("bad-row", row.trouble)
    if row.cells["action"] not in (known := (*RESETS, *STEPS)):
        raise Unusable(
            "bad-row", f"action {row.cells['action'][:80]!r} is unknown; known are {list(known)}"
        )
    stage, moment = parse_name(row.cells, "stage"), parse_moment(row.cells)
    if stage is None or moment is None:
        raise Unusable("bad-row", "stage and recorded_at are needed")
    return Action(stage, moment, row.cells["action"])


def _machine(row: Row) -> str:
    """Name the machine of a row that is not understood, as well as can be."""
    try:
        return parse_name(row.cells, "stage") or ""
    except Unusable:
        return ""


def maintenance_notes(work: Maintenance, moments: Sequence[datetime | None]) -> list[str]:
    """Say what the reader of a report must know of the work on a machine.

    Parameters
    ----------
    work : Maintenance
        What was done to it.
    moments : sequence of datetime or None
        When its logs were recorded.
    """
    notes = [
        f"{one.refusal.log} is not fully understood ({one.refusal.detail}): if it tells of work on "
        "this machine, nothing here knows of it."
        for one in work.unread
    ]
    resets = [action for action in work.actions if action.action in RESETS]
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
