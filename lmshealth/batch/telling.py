"""Telling what is known of machines: a page and rows of tables for each, one at a time.

Only rows of the index and what is on its way are held in memory, however many machines there are.
"""

from __future__ import annotations

import csv
import threading
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from tempfile import TemporaryFile
from types import TracebackType
from typing import IO, Self

from lmshealth._files import replacing
from lmshealth.batch.assess import unpacked
from lmshealth.batch.store import read
from lmshealth.io.log import Refusal
from lmshealth.report.assessment import Assessment
from lmshealth.report.changes import Reported
from lmshealth.report.machine_page import Page, make_page
from lmshealth.report.tables import COLUMNS, Row, frame, machine_tables, refused_rows
from lmshealth.tracking.history import sort_by_time

# Threads of one worker share the settings of the library that draws.
_DRAWING = threading.Lock()


@dataclass(frozen=True, slots=True, eq=False)
class Content:
    """All that a page and the rows of a machine are made of, packed.

    Attributes
    ----------
    machine, file : str
        Its identity, and the name of its page.
    assessment : bytes or None
        The present one; None where there is none.
    logs : tuple of (str, bytes)
        Names and readings of its logs; empty where no tables are asked for.
    before : Reported or None
        What its last report said.
    """

    machine: str
    file: str
    assessment: bytes | None
    logs: tuple[tuple[str, bytes], ...]
    before: Reported | None


@dataclass(frozen=True, slots=True, eq=False)
class Telling:
    """A page, and rows by table.

    ``contradicted`` names logs that were left out of the life as a whole.
    """

    page: Page
    tables: dict[str, Part]
    contradicted: tuple[str, ...]


def tell(content: Content) -> Telling | None:
    """Make the page and the rows of a machine; None where there is nothing that can be read."""
    found = content.assessment
    assessment: Assessment | None = None if found is None else read(found, Assessment)
    if assessment is None:
        return None
    with _DRAWING:
        page = make_page(assessment, content.file, before=content.before)
    readings = sort_by_time(unpacked(content.logs))
    rows = machine_tables(readings, assessment) if readings else {}
    return Telling(
        page=page,
        tables={name: Part.of(name, own) for name, own in rows.items() if own},
        contradicted=tuple(r.log for r in assessment.refused if r.reason == "odometer"),
    )


@dataclass(frozen=True, slots=True)
class Part:
    """Rows of a table as CSV without a header, and the columns they have."""

    columns: tuple[str, ...]
    n_rows: int
    text: str

    @classmethod
    def of(cls, name: str, rows: Sequence[Row]) -> Self:
        """Write rows of a table."""
        table = frame(COLUMNS[name], rows)
        # With this end of lines both of its signs are quoted where a cell holds them.
        text = table.to_csv(index=False, header=False, lineterminator="\r\n")
        return cls(tuple(table.columns), len(rows), text)


class Tables:
    """The tables of a run, each written in parts whose columns may differ.

    They take their places when everything is told: an interrupted run leaves those of before.

    Parameters
    ----------
    folder : Path
        Where they go.
    machines : sequence of str
        The order in which rows stand, whatever the order in which they come.
    """

    def __init__(self, folder: Path, machines: Sequence[str]) -> None:
        self._folder = folder
        self._turns = deque(machines)
        self._early: dict[str, Mapping[str, Part]] = {}
        self._stack = ExitStack()
        self._files: dict[str, IO[str]] = {}
        self._columns = {name: dict.fromkeys(text.split()) for name, text in COLUMNS.items()}

    def __enter__(self) -> Self:
        for name in COLUMNS:
            file = TemporaryFile("w+", encoding="utf-8", newline="", dir=self._folder)
            self._files[name] = self._stack.enter_context(file)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stack.close()

    def add(self, machine: str, parts: Mapping[str, Part]) -> None:
        """Add the rows of a machine."""
        self._early[machine] = parts
        while self._turns and self._turns[0] in self._early:
            self._append(self._early.pop(self._turns.popleft()))

    def _append(self, parts: Mapping[str, Part]) -> None:
        for name, part in parts.items():
            self._columns[name] |= dict.fromkeys(part.columns)
            csv.writer(self._files[name]).writerow([part.n_rows, *part.columns])
            self._files[name].write(part.text)

    def add_refused(self, refused: Iterable[Refusal]) -> None:
        """Append what belongs to no machine."""
        self._append({"refused": Part.of("refused", refused_rows(refused))})

    def write(self) -> None:
        """Put every table in its place."""
        for machine in self._turns:  # after one that never came
            self._append(self._early.pop(machine, {}))
        for name, file in self._files.items():
            file.seek(0)
            with replacing(self._folder / f"{name}.csv") as target:
                columns = list(self._columns[name])
                writer = csv.DictWriter(target, columns, restval="", lineterminator="\n")
                writer.writeheader()
                writer.writerows(_rows(file))


def _rows(file: IO[str]) -> Iterator[dict[str, str]]:
    """Read back the rows of all parts."""
    reader = csv.reader(file)
    for n_rows, *columns in reader:
        for row in islice(reader, int(n_rows)):
            yield dict(zip(columns, row, strict=True))
