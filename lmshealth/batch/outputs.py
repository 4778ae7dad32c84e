"""Output of a run: a page and rows of tables for each machine, one machine at a time.

Memory holds the packed rows of all machines, and besides them only the machines in progress.
"""

import csv
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from lmshealth._files import replacing, write_text
from lmshealth._serialize import pack, unpack
from lmshealth.batch.assess import PackedLogs, reason_if_failed, unpack_logs
from lmshealth.batch.status import Status, coming_states, make_status, points
from lmshealth.batch.store import unpack_or_none
from lmshealth.batch.workers import Pool
from lmshealth.report.assessment import Assessment, Summary, summarise
from lmshealth.report.machine_page import make_page
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
    """Page, packed table rows and status of a machine, and logs that its life excludes."""

    page: str  # HTML
    summary: Summary
    tables: bytes
    excluded: tuple[str, ...]
    status: Status
    points: tuple[Row, ...]


def machine_output(record: MachineRecord) -> MachineOutput | None:
    """Make the page and the rows of a machine; None where this version cannot decode them."""
    found: Assessment | None = unpack_or_none(record.assessment, Assessment)
    if found is None:
        return None
    summary = summarise(found, found.service(), record.file)
    status = make_status(found, summary)
    with _DRAWING:
        page = make_page(found, summary, before=record.before, states=coming_states(status))
    readings = sort_by_time(unpack_logs(record.logs))
    rows = machine_tables(readings, found) if readings else {}
    return MachineOutput(
        page=page,
        summary=summary,
        tables=pack(rows),
        excluded=tuple(r.log for r in found.refused if r.reason == "odometer"),
        status=status,
        points=tuple(points(rows)),
    )


def write_pages(
    records: Iterable[MachineRecord], pool: Pool, out: Path
) -> Iterator[tuple[str, MachineOutput | str]]:
    """Write the pages of machines; yield each machine with its output, or why there is none.

    Machines whose assessment is missing or cannot be decoded are skipped.
    """
    for record, output in pool.map_unordered(_output_or_reason, records, lambda _, why: why):
        if isinstance(output, MachineOutput):
            write_text(out / record.file, output.page)
        if output is not None:
            yield record.machine, output


def _output_or_reason(record: MachineRecord) -> MachineOutput | str | None:
    return reason_if_failed(lambda: machine_output(record), record.machine)


def write_tables(folder: Path, machines: Sequence[str], packed: Mapping[str, bytes]) -> None:
    """Replace the tables of a run, all at its end: an interrupted run leaves those before.

    Of some machines there are packed rows by table; those of no machine (``""``) come first.
    """
    parts = [packed[machine] for machine in ("", *machines) if machine in packed]
    columns = {name: dict.fromkeys(text.split()) for name, text in COLUMNS.items()}
    for name, row in _rows(parts):
        columns[name] |= dict.fromkeys(row)
    with ExitStack() as stack:
        writers = {}
        for name, own in columns.items():
            target = stack.enter_context(replacing(folder / f"{name}.csv"))
            writers[name] = csv.DictWriter(target, own, lineterminator="\n")
            writers[name].writeheader()
        for name, row in _rows(parts):
            # NaN is a missing value.
            writers[name].writerow({key: cell for key, cell in row.items() if cell == cell})


def _rows(parts: Iterable[bytes]) -> Iterator[tuple[str, Row]]:
    """Yield the table and the cells of each row."""
    for part in parts:
        for name, rows in unpack(part, dict[str, list[Row]]).items():
            yield from ((name, row) for row in rows)
