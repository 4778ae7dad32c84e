"""Output of a run: a page and rows of tables for each machine, one machine at a time.

Memory holds rows of the index and the machines in progress, however many machines there are.
"""

from __future__ import annotations

import pickle
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import Self

import pandas as pd

from lmshealth._files import replacing, write_text
from lmshealth.batch.assess import PackedLogs, reason_if_failed, unpack_logs
from lmshealth.batch.store import unpack_or_none
from lmshealth.batch.workers import Pool
from lmshealth.report.assessment import Assessment
from lmshealth.report.changes import Reported
from lmshealth.report.machine_page import Page, make_page
from lmshealth.report.tables import COLUMNS, frame, machine_tables
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
    """Page and tables of a machine, and the logs that were excluded from its life."""

    page: Page
    tables: dict[str, pd.DataFrame]  # those with rows, by their names
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
        tables={name: frame(COLUMNS[name], own) for name, own in rows.items() if own},
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
        self._order = (None, *machines)  # what belongs to no machine comes first
        self._places: dict[str | None, int] = {}

    def __enter__(self) -> Self:
        self._file = TemporaryFile(dir=self._folder)
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def add(self, machine: str | None, tables: Mapping[str, pd.DataFrame]) -> None:
        """Add rows of a machine, or of none, once."""
        self._places[machine] = self._file.tell()
        pickle.dump(tables, self._file)

    def _parts(self) -> Iterator[dict[str, pd.DataFrame]]:
        """Read back the tables of all machines."""
        for machine in self._order:
            if machine in self._places:
                self._file.seek(self._places[machine])
                yield pickle.load(self._file)

    def write(self) -> None:
        """Replace the tables in the folder."""
        columns = {name: dict.fromkeys(text.split()) for name, text in COLUMNS.items()}
        for part in self._parts():
            for name, table in part.items():
                columns[name] |= dict.fromkeys(table.columns)
        with ExitStack() as stack:
            files = {}
            for name, own in columns.items():
                files[name] = stack.enter_context(replacing(self._folder / f"{name}.csv"))
                pd.DataFrame(columns=list(own)).to_csv(files[name], index=False)
            for part in self._parts():
                for name, table in part.items():
                    rows = table.reindex(columns=list(columns[name]))
                    rows.to_csv(files[name], index=False, header=False)
