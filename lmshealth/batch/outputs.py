"""Output of a run: a page and rows of tables for each machine, one machine at a time.

Memory holds the packed tables of all machines, and besides them only the machines in progress.
"""

import threading
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path

from lmshealth._private.files import replacing, write_text
from lmshealth._private.serialize import pack, unpack
from lmshealth._private.tables import RUN_TABLES
from lmshealth.batch.assess import PackedLogs, reason_if_failed, unpack_logs
from lmshealth.batch.store import unpack_or_none
from lmshealth.machine.assessment import Assessment
from lmshealth.machine.status import Status, judge_at, make_status, on_day
from lmshealth.machine.summary import Summary, summarise
from lmshealth.report.language import Language, in_language
from lmshealth.report.pages import date_page, make_page
from lmshealth.report.tables import csv_text, join_csv, log_tables, machine_tables
from lmshealth.tracking.contradictions import LEFT_OUT, sort_by_time

# matplotlib's settings are shared by the threads of a Dask worker.
_DRAWING = threading.Lock()


@dataclass(frozen=True, slots=True, eq=False)
class MachineRecord:
    """Packed results of a machine, from which its page (a file) and its rows are made.

    ``logs`` is None where no tables are needed; ``before`` is its previous report.
    """

    machine: str
    file: str
    assessment: bytes | None
    logs: PackedLogs | None
    before: Summary | None
    language: Language = "en"  # of its page


@dataclass(frozen=True, slots=True, eq=False)
class MachineOutput:
    """Page, tables (packed CSV) and status of a machine, and logs that its life excludes."""

    page: str  # HTML, to be completed on each day: `Judging.write`
    summary: Summary
    tables: dict[str, bytes]
    excluded: tuple[str, ...]
    status: Status


def machine_output(record: MachineRecord) -> MachineOutput | None:
    """Make the page and the rows of a machine; None where this version cannot decode them."""
    found: Assessment | None = unpack_or_none(record.assessment, Assessment)
    logs = unpack_logs(record.logs or ())
    if found is None or (record.logs is not None and not logs):
        return None
    summary = summarise(found, found.service(), record.file)
    status = make_status(found, summary)
    with _DRAWING, in_language(record.language):
        page = make_page(found, summary, before=record.before)
    rows = machine_tables(found) if logs else {}
    tables = {name: csv_text(name, own) for name, own in rows.items()}
    of_logs = [log_tables(one) for one in sort_by_time(logs)]
    for name in of_logs[0] if of_logs else ():
        tables[name] = "".join(join_csv([one[name] for one in of_logs]))
    return MachineOutput(
        page=page,
        summary=summary,
        tables={name: pack(text) for name, text in tables.items()},
        excluded=tuple(r.log for r in found.refused if r.reason in LEFT_OUT),
        status=status,
    )


@dataclass(frozen=True, slots=True)
class Judging:
    """When statuses are judged, and beside which of the run before."""

    moment: datetime
    silent_days: float | None
    before: Mapping[str, Status]  # by machine
    language: Language = "en"  # of the pages

    def write(self, output: MachineOutput, path: Path) -> Summary:
        """Write the page of a machine as of the day; return its summary of that day."""
        before = self.before.get(output.status.stage)
        today = self.moment.date()
        status = judge_at(before, output.status, self.moment, self.silent_days)
        summary = on_day(output.summary, status, today)
        with in_language(self.language):
            write_text(path, date_page(output.page, summary, status))
        return summary


def output_or_reason(record: MachineRecord) -> list[MachineOutput | str | None]:
    """Return the output of a machine, why it fails, or None where `machine_output` does."""
    return [reason_if_failed(lambda: machine_output(record), record.machine)]


def write_tables(
    folder: Path, machines: Sequence[str], tables: Mapping[str, Mapping[str, bytes]]
) -> None:
    """Replace the tables of a run, all at its end: an interrupted run leaves those before.

    Of some machines there are packed tables by name; those of no machine (``""``) come first.
    """
    parts = [tables[machine] for machine in ("", *machines) if machine in tables]
    with ExitStack() as stack:
        for name in RUN_TABLES:
            target = stack.enter_context(replacing(folder / f"{name}.csv"))
            own = [pack(csv_text(name, [])), *(part[name] for part in parts if name in part)]
            target.writelines(join_csv(own, partial(unpack, kind=str)))
