"""Maintenance: actions on a machine, and which of them open a new baseline."""

import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from difflib import get_close_matches
from pathlib import Path
from typing import Self

from lmshealth._private.arrays import freeze
from lmshealth._private.tables import fact
from lmshealth.errors import BadTable
from lmshealth.io.log import Notice, Refusal, expect_moment, parse_moment, parse_name
from lmshealth.io.manifest import Row, find_sheets, name_of, read_sheet
from lmshealth.io.refusal import Unusable, listed, shown

_FILE = "maintenance.csv"
_NEEDED = ("stage", "recorded_at", "action")
# Work on guide or mount opens a new baseline.
RESETS = ("preload-adjust", "guide-replaced", "mount-tightened")
# Those that restore a parameter, by its word in verdicts; of any other all may.
RESTORING = {"preload": ("preload-adjust", "guide-replaced"), "mount": ("mount-tightened",)}
# Steps without wear: of dampings, of the closed loop, of one source.
STEPS = ("regrease", "servo", "sensor")


@dataclass(frozen=True, slots=True)
class Action:
    """One row of ``maintenance.csv``."""

    stage: str
    recorded_at: datetime
    action: str

    def __post_init__(self) -> None:
        freeze(self)
        expect_moment(self.recorded_at)


@dataclass(frozen=True, slots=True)
class UnreadableRow:
    """A refused row or table of ``maintenance.csv``."""

    refusal: Refusal  # under the name of the table
    stage: str | None  # machine of the row, empty where it names none; None for a whole table


@dataclass(frozen=True, slots=True)
class Maintenance:
    """Actions, and rows that cannot be read."""

    actions: tuple[Action, ...] = ()  # in the order of time
    unread: tuple[UnreadableRow, ...] = ()  # possible further actions

    def of(self, machine: str) -> Self:
        """Return the part that concerns one machine; rows without a machine concern all."""
        actions = tuple(action for action in self.actions if action.stage == machine)
        unread = tuple(one for one in self.unread if one.stage in (machine, "", None))
        return replace(self, actions=actions, unread=unread)

    def since(self, moment: datetime) -> set[str]:
        """Return what was done after a moment, such as that of the last log."""
        return {one.action for one in self.actions if one.recorded_at > moment}


NO_MAINTENANCE = Maintenance()
"""Maintenance without a table."""


def without_logs(actions: Iterable[Action], machines: Collection[str]) -> Iterator[str]:
    """Yield a sentence on each machine of actions that is none of these: it may be misspelt."""
    written = {one.casefold(): one for one in machines}
    for name in dict.fromkeys(one.stage for one in actions if one.stage not in machines):
        near = get_close_matches(name.casefold(), written, 1)
        hint = f"; is it {written[near[0]]}?" if near else ""
        yield f"maintenance.csv: work on {name} is not used: no usable log is of it{hint}"


def restored(words: Mapping[str, str], work: Collection[str]) -> set[str]:
    """Return the parameters that work restores; ``words`` has their words in verdicts."""
    return {name for name, word in words.items() if {*work} & {*RESTORING.get(word, RESETS)}}


def read_maintenance(
    folder: Path, *, follow_links: bool = False, latest: datetime | None = None
) -> Maintenance:
    """Read every ``maintenance.csv`` below a folder, or raise `BadTable` if it is none.

    Rows after the moment `latest`, by default a day from now, cannot be read.
    """
    found = find_sheets(folder, _FILE, follow_links=follow_links)
    work = _read(((path, name_of(path, folder)) for path in found.logs), latest)
    return replace(
        work, unread=(*(UnreadableRow(one, None) for one in found.refused), *work.unread)
    )


def read_maintenance_beside(
    logs: Iterable[str | Path], latest: datetime | None = None
) -> Maintenance:
    """Read the ``maintenance.csv`` in the folder of each log, as far as there is one."""
    folders = {Path(log).parent.resolve(): Path(log).parent for log in logs}
    tables = [folders[key] / _FILE for key in sorted(folders)]
    return _read([(path, shown(path)) for path in tables if os.path.lexists(path)], latest)


def read_work(path: Path | None, latest: datetime | None = None) -> Maintenance:
    """Read one table of maintenance, if any, or raise `BadTable` if a row cannot be read."""
    work = _read([] if path is None else [(path, shown(path))], latest)
    for one in work.unread:
        raise BadTable(f"{one.refusal.log}, {one.refusal.detail}")
    return work


def _read(tables: Iterable[tuple[Path, str]], latest: datetime | None) -> Maintenance:
    """Read tables, each with the name that its refusals have."""
    actions: list[Action] = []
    unread: list[UnreadableRow] = []
    for path, name in tables:
        try:
            for row in read_sheet(path, _NEEDED):
                try:
                    actions.append(_action(row, latest))
                except Unusable as error:
                    refusal = Refusal(name, "bad-row", f"{row.where}: {error.detail}")
                    unread.append(UnreadableRow(refusal, _machine(row)))
        except Unusable as error:
            unread.append(UnreadableRow(Refusal(name, error.reason, error.detail), None))
    # A row that is there twice is one work.
    ordered = dict.fromkeys(sorted(actions, key=lambda a: a.recorded_at))
    return Maintenance(tuple(ordered), tuple(unread))


def _action(row: Row, latest: datetime | None) -> Action:
    """Read a row; other columns are ignored."""
    if row.trouble:
        raise Unusable("bad-row", row.trouble)
    if row.cells["action"] not in (known := (*RESETS, *STEPS)):
        raise Unusable(
            "bad-row", f"action {row.cells['action'][:80]!r} is unknown; known are {listed(known)}"
        )
    stage, moment = parse_name(row.cells, "stage"), parse_moment(row.cells, latest)
    if stage is None or moment is None:
        raise Unusable("bad-row", "stage and recorded_at are needed")
    return Action(stage, moment, row.cells["action"])


def _machine(row: Row) -> str:
    """Return the machine of a refused row, or an empty name."""
    try:
        return parse_name(row.cells, "stage") or ""
    except Unusable:
        return ""


def baseline_notices(refused: Iterable[Refusal], used: str) -> list[Notice]:
    """Return notices of refused logs that were declared as baseline.

    `used` is the log with which the present baseline begins. A harmless copy has no notice.
    """
    return [
        Notice(
            "baseline-refused",
            "caution",
            one.log,
            fact(
                "{log} is declared as baseline (baseline = true), and was refused ({reason}: "
                "{detail}); the present baseline begins with {used}.",
                log=one.log,
                reason=one.reason,
                detail=one.detail,
                used=used,
            ),
            fact("Correct that log or its row, or declare another one in manifest.csv."),
        )
        for one in refused
        if one.baseline and one.reason != "duplicate"
    ]


def maintenance_notices(work: Maintenance, moments: Sequence[datetime | None]) -> list[Notice]:
    """Return notices for a report: rows that cannot be read, and new baselines.

    `work` is that of one machine, `moments` are the times of recording of its logs.
    """
    notices = [
        Notice(
            "maintenance-unread",
            "caution",
            one.refusal.log,
            fact(
                "{file} cannot be read completely ({detail}): work on this machine that it lists "
                "there is not used.",
                file=one.refusal.log,
                detail=one.refusal.detail,
            ),
            fact("Correct the row and run again."),
        )
        for one in work.unread
    ]
    for action in work.actions:
        if action.action not in RESETS:
            continue
        before = sum(moment is not None and moment < action.recorded_at for moment in moments)
        done = {"work": action.action, "day": action.recorded_at.date().isoformat()}
        if before == len(moments):
            what = fact("{work} on {day}: no log since, so nothing is known after it.", **done)
            to_do = fact("Record a log.")
            notices.append(Notice("no-log-since", "caution", action.action, what, to_do))
        elif before:
            what = fact(
                "{work} on {day} opened a new baseline: fractions of what it restores are relative "
                "to the state after it, those of other parts to a baseline before. Earlier logs "
                "({n}) inform the effects of temperature, load and loop, and what other parts had "
                "lost.",
                **done,
                n=before,
            )
            notices.append(Notice("new-baseline", "note", "", what))
    return notices
