"""Output of a run: a page and rows of tables for each machine, one machine at a time.

Memory holds rows of the index and the machines in progress, however many machines there are.
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
from typing import IO, Self

from lmshealth._files import replacing, write_text
from lmshealth.batch.assess import PackedLogs, reason_if_failed, unpack_logs
from lmshealth.batch.store import unpack_or_none
from lmshealth.batch.workers import Pool
from lmshealth.io.log import Refusal
from lmshealth.report.assessment import Assessment
from lmshealth.report.changes import Reported
from lmshealth.report.machine_page import Page, make_page
from lmshealth.report.tables import COLUMNS, Row, frame, machine_tables, refused_rows
from lmshealth.tracking.history import sort_by_time

# matplotlib's settings are shared by the threads of a Dask worker.
_DRAWING = threading.Lock()


@dataclass(frozen=True, slots=True, eq=False)
class MachineRecord:
    """Packed results of a machine, from which its page (a file) and its rows are made.

    Its logs are empty where no tables are needed; ``before`` is its previous report.
    """

    machine: str
    file: str
    assessment: bytes | None
    logs: PackedLogs
    before: Reported | None


@dataclass(frozen=True, slots=True, eq=False)
class MachineOutput:
    """Page and table rows of a machine, and the logs that were excluded from its life."""

    page: Page
    tables: dict[str, CsvRows]
    excluded: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class CsvRows:
    """Rows of a table as CSV without a header, and their columns."""

    columns: tuple[str, ...]
    n_rows: int
    text: str

    @classmethod
    def of(cls, name: str, rows: Sequence[Row]) -> Self:
        """Encode rows of a table."""
        table = frame(COLUMNS[name], rows)
        # With this line terminator a cell that contains CR or LF is quoted.
        text = table.to_csv(index=False, header=False, lineterminator="\r\n")
        return cls(tuple(table.columns), len(rows), text)


def machine_output(record: MachineRecord) -> MachineOutput | None:
    """Make the page and the rows of a machine; None where this version cannot decode them."""
    found: Assessment | None = unpack_or_none(record.assessment, Assessment)
    if found is None:
        return None
    with _DRAWING:
        page = make_page(found, record.file, before=record.before)
    readings = sort_by_time(unpack_logs(record.logs))
    rows = machine_tables(readings, found) if readings else {}
    return MachineOutput(
        page=page,
        tables={name: CsvRows.of(name, own) for name, own in rows.items() if own},
        excluded=tuple(r.log for r in found.refused if r.reason == "odometer"),
    )


def write_pages(
    records: Iterable[MachineRecord], pool: Pool, out: Path
) -> Iterator[tuple[str, MachineOutput | str]]:
    """Write the pages of machines; yield each machine with its output, or why there is none.

    Machines whose assessment is missing or cannot be decoded are skipped.
    """
    for record, output in pool.map_unordered(_output_or_reason, records, lambda _, why: why):
        if isinstance(output, MachineOutput):
            write_text(out / record.file, output.page.text)
        if output is not None:
            yield record.machine, output


def _output_or_reason(record: MachineRecord) -> MachineOutput | str | None:
    return reason_if_failed(lambda: machine_output(record), record.machine)


class Tables:
    """Tables of a run, collected in parts whose columns may differ, in the order of machines.

    They replace older tables at the end: an interrupted run leaves those of the run before.
    """

    def __init__(self, folder: Path, machines: Sequence[str]) -> None:
        self._folder = folder
        self._turns = deque(machines)
        self._early: dict[str, Mapping[str, CsvRows]] = {}
        self._stack = ExitStack()
        self._files: dict[str, IO[str]] = {}
        self._columns = {name: dict.fromkeys(text.split()) for name, text in COLUMNS.items()}

    def __enter__(self) -> Self:
        for name in COLUMNS:
            file = TemporaryFile("w+", encoding="utf-8", newline="", dir=self._folder)
            self._files[name] = self._stack.enter_context(file)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def add(self, machine: str, parts: Mapping[str, CsvRows]) -> None:
        """Add the rows of a machine."""
        self._early[machine] = parts
        while self._turns and self._turns[0] in self._early:
            self._append(self._early.pop(self._turns.popleft()))

    def _append(self, parts: Mapping[str, CsvRows]) -> None:
        for name, part in parts.items():
            self._columns[name] |= dict.fromkeys(part.columns)
            csv.writer(self._files[name]).writerow([part.n_rows, *part.columns])
            self._files[name].write(part.text)

    def add_refused(self, refused: Iterable[Refusal]) -> None:
        """Add refusals that belong to no machine."""
        self._append({"refused": CsvRows.of("refused", refused_rows(refused))})

    def write(self) -> None:
        """Replace the tables in the folder."""
        for machine in self._turns:  # after a machine that was never added
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
