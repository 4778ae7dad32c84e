"""Output of a run: a page and rows of tables for each machine, one machine at a time.

Memory holds rows of the index and the machines in progress, however many machines there are.
"""

from __future__ import annotations

import csv
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import Self

from lmshealth._files import replacing, write_text
from lmshealth._serialize import pack, unpack
from lmshealth.batch.assess import PackedLogs, reason_if_failed, unpack_logs
from lmshealth.batch.store import unpack_or_none
from lmshealth.batch.workers import Pool
from lmshealth.report.assessment import Assessment, Summary
from lmshealth.report.machine_page import Page, make_page
from lmshealth.report.tables import COLUMNS, Row, machine_tables
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
    before: Summary | None


@dataclass(frozen=True, slots=True, eq=False)
class MachineOutput:
    """Page and packed table rows of a machine, and the logs that were excluded from its life."""

    page: Page
    tables: bytes
    excluded: tuple[str, ...]


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
        tables=pack(rows),
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
    """Tables of a run, whose rows are kept in a file until all machines are done.

    They replace older tables at the end: an interrupted run leaves those of the run before.
    """

    def __init__(self, folder: Path, machines: Sequence[str]) -> None:
        self._folder = folder
        self._order = ("", *machines)  # what belongs to no machine comes first
        self._places: dict[str, tuple[int, int]] = {}

    def __enter__(self) -> Self:
        self._file = TemporaryFile(dir=self._folder)
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def add(self, machine: str, tables: bytes) -> None:
        """Add the packed rows of a machine by table, or those of none, whose name is empty."""
        self._places[machine] = self._file.tell(), len(tables)
        self._file.write(tables)

    def _rows(self) -> Iterator[tuple[str, Row]]:
        """Read the table and the cells of each row, in the order of the machines."""
        for machine in self._order:
            if machine in self._places:
                place, size = self._places[machine]
                self._file.seek(place)
                for name, rows in unpack(self._file.read(size), dict[str, list[Row]]).items():
                    yield from ((name, row) for row in rows)

    def write(self) -> None:
        """Replace the tables in the folder."""
        columns = {name: dict.fromkeys(text.split()) for name, text in COLUMNS.items()}
        for name, row in self._rows():
            columns[name] |= dict.fromkeys(row)
        with ExitStack() as stack:
            writers = {}
            for name, own in columns.items():
                target = stack.enter_context(replacing(self._folder / f"{name}.csv"))
                writers[name] = csv.DictWriter(target, own, lineterminator="\n")
                writers[name].writeheader()
            for name, row in self._rows():
                # NaN is a missing value.
                writers[name].writerow({key: cell for key, cell in row.items() if cell == cell})
