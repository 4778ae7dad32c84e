"""Run over an archive, once or whenever logs arrive: from logs to tables and a report.

Memory holds the packed tables of all machines, and besides them only the machines in progress.
"""

import os
import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, date, datetime
from functools import partial
from pathlib import Path, PurePosixPath
from tempfile import TemporaryFile
from typing import Any
from unicodedata import normalize

import msgspec

from lmshealth._private.files import remove_abandoned, replacing, write_text
from lmshealth._private.serialize import VERSION, fingerprint, pack, unpack
from lmshealth._private.tables import RUN_TABLES, Row
from lmshealth.batch import constants
from lmshealth.batch.alerts import FILE as STATUSES
from lmshealth.batch.alerts import Scope, announce, deliver, last_number, write_statuses
from lmshealth.batch.assess import Machine, apply_fleet_priors, assess_all, reason_if_failed
from lmshealth.batch.ingest import Ingested, Settings, ingest
from lmshealth.batch.store import (
    PackedLogs,
    Published,
    Resources,
    Store,
    cached,
    default_url,
    unpack_logs,
    unpack_or_none,
)
from lmshealth.batch.workers import Progress
from lmshealth.errors import LmshealthError, NothingUsable
from lmshealth.io.log import Refusal
from lmshealth.io.manifest import MANIFEST, MISSPELT, NOT_LOGS
from lmshealth.io.refusal import listed, shown, visible
from lmshealth.machine.assessment import Assessment
from lmshealth.machine.status import Change, Status, judge_on, make_status, on_day
from lmshealth.machine.summary import Summary, summarise
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.report.language import Language, in_language
from lmshealth.report.pages import by_urgency, date_page, file_names, make_page, write_index
from lmshealth.report.tables import csv_text, join_csv, log_tables, machine_tables, refused_rows
from lmshealth.stage.description import Stage, expect_stages
from lmshealth.tracking.contradictions import LEFT_OUT, sort_by_time
from lmshealth.tracking.maintenance import baseline_notices, read_maintenance, without_logs

# Output of one machine

# matplotlib's settings are shared by the threads of a Dask worker.
_DRAWING = threading.Lock()


@dataclass(frozen=True, slots=True, eq=False)
class MachineRecord:
    """Packed results of a machine, from which its page (a file) and its rows are made.

    ``logs`` is None where no tables are needed; ``before`` is its previous report, ``lost`` are its
    logs that were refused as a whole.
    """

    machine: str
    file: str
    assessment: bytes | None
    logs: PackedLogs | None
    before: Summary | None
    lost: tuple[Refusal, ...] = ()
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
    instead = baseline_notices(record.lost, found.history.logs[found.history.baseline])
    found = replace(found, lost=record.lost, notices=(*found.notices, *instead))
    summary = summarise(found, found.service(), record.file)
    status = make_status(found, summary)
    with _DRAWING, in_language(record.language):
        page = make_page(found, summary, before=record.before)
    return MachineOutput(
        page=page,
        summary=summary,
        tables=_packed(machine_tables(found, summary) if logs else {}, logs),
        excluded=tuple(r.log for r in found.refused if r.reason in LEFT_OUT),
        status=status,
    )


def _packed(rows: dict[str, list[Row]], logs: Sequence[LogEstimates] = ()) -> dict[str, bytes]:
    """Return tables as packed CSV, by name: of rows, and those of logs."""
    of_logs = [log_tables(one) for one in sort_by_time(logs)]
    names = of_logs[0] if of_logs else ()
    tables = {name: csv_text(name, own) for name, own in rows.items()}
    tables |= {name: "".join(join_csv([one[name] for one in of_logs])) for name in names}
    return {name: pack(text) for name, text in tables.items()}


@dataclass(frozen=True, slots=True)
class Judging:
    """The day on which statuses are judged, and the days without a log that are a silence."""

    today: date
    silent_days: float | None
    language: Language = "en"  # of the pages
    # Status of the last run, by machine: pages that are written without a run have its silences.
    before: Mapping[str, Status] = field(default_factory=dict)

    def write(self, output: MachineOutput, path: Path) -> Summary:
        """Write the page of a machine as of the day; return its summary of that day."""
        before = self.before.get(output.status.stage)
        after = before.silent_after_days if before else self.silent_days
        status = judge_on(output.status, self.today, after)
        summary = on_day(output.summary, status, self.today)
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

    ``tables`` are packed, by machine and name; those of no machine (``""``) come first. `BadTable`
    if one cannot be written.
    """
    parts = [tables[machine] for machine in ("", *machines) if machine in tables]
    with ExitStack() as stack:
        for name in RUN_TABLES:
            target = stack.enter_context(replacing(folder / f"{name}.csv"))
            own = [pack(csv_text(name, [])), *(part[name] for part in parts if name in part)]
            target.writelines(join_csv(own, partial(unpack, kind=str)))


# Run


@dataclass(frozen=True, slots=True, eq=False)
class RunResult:
    """Result of a run; in a report counts are 0, and status, changes and alerts empty."""

    index: Path  # front page of the report
    rows: tuple[Summary, ...]  # one per machine, most urgent first
    failed: dict[str, str]  # machines that could not be assessed or reported, and why
    n_logs: int = 0  # distinct logs found
    n_refused: int = 0  # of them, refused as a whole
    n_remembered: int = 0  # of them, taken from the store
    n_unlisted: int = 0  # of them, omitted by the manifest of their folder
    n_unread: int = 0  # unreadable rows of ``manifest.csv`` and ``maintenance.csv``, or tables
    # Status of all machines, those of earlier runs with it, and changes since the run before.
    statuses: tuple[Status, ...] = ()
    changes: tuple[Change, ...] = ()
    unsent: dict[str, str] = field(default_factory=dict)  # options whose alerts failed, and why
    notes: tuple[str, ...] = ()  # damage that was found, and what became of it

    @property
    def pages(self) -> tuple[Path, ...]:
        """Pages of the machines, in the folder of the index."""
        return tuple(self.index.with_name(row.file) for row in self.rows)


def run(
    folder: str | Path,
    stages: Sequence[Stage],
    out: str | Path,
    settings: Settings = Settings(),
    progress: Progress = lambda step, done, total: None,
) -> RunResult:
    """Analyse a folder of logs and write tables and report.

    Parameters
    ----------
    folder : str or Path
        Read recursively, with its ``manifest.csv`` and ``maintenance.csv``.
    stages : sequence of Stage
        Each log is read with the first description that matches it.
    out : str or Path
        Folder of the output, created if needed.
    settings : Settings
        Store, workers, seed and how logs are read.
    progress : callable
        Called as the run proceeds.

    Raises
    ------
    BadStage
        If the stages are no results of `load_stage`.
    NothingUsable
        If there is no log, or every log was refused; tables and ``index.html`` are written
        nevertheless.

    Examples
    --------
    A folder of one log that contains only noise: no mode is excited.

    >>> from pathlib import Path
    >>> import numpy as np
    >>> import pandas as pd
    >>> import lmshealth
    >>> Path("logs").mkdir()
    >>> head = ["# sample_rate_hz: 1000", "# stage: AX-3-Y", "# travel_km: 12.5"]
    >>> head += ["# recorded_at: 2026-07-12T06:00:00Z", "acc_pitch_m_s2"]
    >>> noise = np.random.default_rng(1).standard_normal(20_000)
    >>> np.savetxt("logs/one.csv", noise, header=chr(10).join(head), comments="")
    >>> stage = lmshealth.load_stage("lms-y")
    >>> result = lmshealth.run("logs", [stage], "result")
    >>> result.n_logs, result.n_refused, result.index.name
    (1, 0, 'index.html')
    >>> refused = pd.read_csv("result/refused.csv")
    >>> dict(zip(refused["mode"], refused["reason"]))
    {'roll': 'not-excited', 'pitch': 'not-excited', 'yaw': 'not-excited'}
    """
    folder, out = Path(folder), Path(out)
    if folder.resolve().is_relative_to(out.resolve()):
        why = "contains the logs, and no file of the output is a log"
        raise LmshealthError(f"{out}: {why}; name another folder, which may be inside of it")
    expect_stages(stages)
    _prepare(out)
    work = read_maintenance(folder, follow_links=settings.follow_links, latest=settings.latest)
    with settings.pool() as pool, closing(Store(settings.store or default_url(out))) as store:
        place = shown(os.path.abspath(folder))
        scope = Scope(place, out, last_number(store.announced().values()))
        resources = Resources(store, pool, progress)
        ingested = ingest(folder, stages, resources, out=out, settings=settings)
        refused = (*ingested.refused, *(one.refusal for one in work.unread))
        machines = [
            Machine(name, logs, stage, work.of(name), settings.epochs, settings.seed)
            for name, (stage, logs) in ingested.machines.items()
        ]
        failed = assess_all(machines, resources)
        usable = [machine for machine in machines if machine.name not in failed]
        judging = _judging(settings)
        rows, lacking, made = _report(usable, refused, resources, out, judging, place)
        present = {name: output.status for name, output in made.items()}
        tables = _tables(machines, made, store)
        with store.alone():  # a run that ends before its tables are written has announced nothing
            found = announce(store, present, judging.today, settings.alerts, scope)
            statuses, changes, notes = found
            of_run = {"refused": refused_rows(refused), "changes": msgspec.to_builtins(changes)}
            tables[""] = _packed(of_run)
            write_tables(out, [machine.name for machine in machines], tables)
        with in_language(settings.language):
            gone = [one for one in statuses if one.stage not in ingested.machines]
            write_index(out, rows, refused, today=judging.today, gone=gone)
        unsent = deliver(store, statuses, settings.alerts, out)
        write_statuses(statuses, made, out)
        notes += [*store.notes, *without_logs(work.actions, ingested.machines)]
        notes += _of_names(ingested.machines, [one.stage for one in statuses])
    counts, lost = _count(ingested, refused, made)
    if not machines:
        why = _none_usable(folder, ingested.logs, refused, lost)
        failed_alerts = "".join(f"; {name}: {reason}" for name, reason in unsent.items())
        raise NothingUsable(f"{why}; {out / 'refused.csv'} lists all{failed_alerts}")
    misspelt = tuple(f"{one.log}: {one.detail}" for one in refused if one.reason == MISSPELT)
    return RunResult(
        index=out / "index.html",
        rows=rows,
        failed=failed | lacking,
        statuses=statuses,
        changes=tuple(changes),
        unsent=unsent,
        notes=(*misspelt, *notes),
        **counts,
    )


def _count(
    ingested: Ingested, refused: Sequence[Refusal], made: Mapping[str, MachineOutput]
) -> tuple[dict[str, int], set[str]]:
    """Count the logs of a run, by field of `RunResult`; return also which were refused whole."""
    excluded = {log for output in made.values() for log in output.excluded}
    copies, unlisted = (
        {one.log for one in refused if one.reason == reason} for reason in constants.NO_LOSS
    )
    others = {refusal.log for refusal in refused if refusal.reason not in constants.NO_LOSS}
    lost = (others - copies | excluded) & ingested.logs
    misspelt = sum(one.reason == MISSPELT for one in refused)
    counts = {
        "n_logs": len(ingested.logs - copies),
        "n_refused": len(lost),
        "n_remembered": ingested.n_cached,
        "n_unlisted": len(unlisted),
        "n_unread": sum(PurePosixPath(one.log).name in NOT_LOGS for one in refused) - misspelt,
    }
    return counts, lost


def report(
    store: Store,
    out: str | Path,
    settings: Settings = Settings(),
    progress: Progress = lambda step, done, total: None,
) -> RunResult:
    """Write the pages of all machines in a store that `run` has filled, without their logs.

    `StoreError` if there is no assessment that this version can decode.
    """
    out = Path(out)
    _prepare(out)
    announced = store.announced()
    present = _present(store, announced)
    files = file_names([one.machine for one in present])
    rows, failed = dict[str, Summary](), dict[str, str]()
    progress("reporting", 0, len(present))
    before = {stage: one.status for stage, one in announced.items()}
    judging = replace(_judging(settings), before=before)
    refused = store.refused(one.refused for one in present)
    record = _records(store, refused, settings.language)
    # A process takes longer to start than a page to write.
    few = replace(settings, workers=max(1, min(settings.workers, len(present))))
    with few.pool() as pool:
        records = (record(one.machine, one.key, files[one.machine]) for one in present)
        made: Iterator[tuple[MachineRecord, list[MachineOutput | str | None]]]
        made = pool.map_unordered(output_or_reason, records, lambda _, why: [why])
        for drawn, [output] in made:
            if isinstance(output, str):
                failed[drawn.machine] = output
            elif output is not None:
                rows[drawn.machine] = judging.write(output, out / drawn.file)
            progress("reporting", len(rows) + len(failed), len(present))
    if not rows and not failed:
        raise store.unfilled("no assessment that this version of lmshealth can read")
    ranked = tuple(by_urgency(rows.values()))
    unread = "not readable for this version of lmshealth; run its logs again"
    with in_language(settings.language):
        index = write_index(out, ranked, refused, today=judging.today)
    return RunResult(
        index=index,
        rows=ranked,
        failed={one.machine: unread for one in present if one.machine not in rows} | failed,
        notes=tuple(store.notes),
    )


def _present(store: Store, announced: Container[str]) -> list[Published]:
    """List the published assessments without those of machines that are retired.

    The row of what was announced of such a machine was deleted; other machines of its folder, which
    have one list of refused logs with it, have theirs.
    """
    published = store.published()
    if store.damaged["announced"]:  # it is not known of which machines
        return list(published)
    folders = {one.refused for one in published if one.machine in announced}
    return [one for one in published if one.machine in announced or one.refused not in folders]


def _judging(settings: Settings = Settings()) -> Judging:
    """Return on which day pages and statuses are judged, by default today (UTC)."""
    today = settings.today or datetime.now(UTC).date()
    return Judging(today, settings.alerts.silent_days, settings.language)


def _prepare(out: Path) -> None:
    """Create the folder of the output, check that it is writable, and tidy up after killed runs."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        TemporaryFile(dir=out).close()
        remove_abandoned(out)
    except OSError as error:
        raise LmshealthError(f"{out}: cannot be written to: {error.strerror}") from error


def _others(folder: Path, logs: frozenset[str]) -> str:
    """Return the suffixes of the files of a folder without logs."""
    if logs:
        return ""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name not in NOT_LOGS)
    counts = Counter(path.suffix for path in files if path.name[0] != ".")
    found = ", ".join(f"{n} {visible(suffix)}" for suffix, n in counts.most_common(3))
    if not found:
        return " (the folder has no files; name the one that has the logs)"
    return f" (files: {found}; `lmshealth init FILE` tries one)"


def _of_names(machines: Iterable[str], announced: Iterable[str]) -> Iterator[str]:
    """Yield sentences on machines with names that are almost the same, and on those without logs.

    Each may be a machine whose name was misspelt, or is written in another way now.
    """
    groups: dict[str, list[str]] = {}
    for name in machines:
        groups.setdefault(_bare(name), []).append(name)
    for alike in groups.values():
        if len(alike) > 1:
            yield (
                "machines whose names differ only in case, spaces or punctuation: "
                f"{listed(alike)}; if they are one machine, use one name for it"
            )
    present = {name for alike in groups.values() for name in alike}
    if gone := [name for name in announced if name not in present]:
        yield (
            f"{STATUSES} keeps the last status of machines without a usable log in this run: "
            f"{listed(gone)}; see Retention in OPERATING.md to remove one"
        )


def _bare(name: str) -> str:
    """Return a name without case, spaces and punctuation, but between digits and a last sign."""
    plain = normalize("NFKC", name).casefold()
    between = re.sub(r"(?<=\d)[\W_]+(?=\d)", "|", plain)
    return re.sub(r"[^\w|]|_", "", between) + (plain[-1] if plain[-1:] in ("+", "-") else "")


def _none_usable(
    folder: Path, logs: frozenset[str], refused: Sequence[Refusal], lost: set[str]
) -> str:
    """Return why no log is usable; first of a manifest that cannot be read, if there is one."""
    tables = (one for one in refused if PurePosixPath(one.log).name == MANIFEST)
    first = next((one for one in tables if one.reason not in (MISSPELT, "bad-row")), None)
    manifest = "" if first is None else f"{first.log}: {first.detail}; "
    found = f"{len(logs)} found{_others(folder, logs)}"
    why = f"{len(lost)} refused{_commonest(refused, lost)}"
    return f"{folder}: no usable log: {manifest}{found}, {why}"


def _commonest(refused: Iterable[Refusal], lost: Container[str]) -> str:
    """Return the most frequent reason of refused logs, and the detail of the first of them."""
    why: dict[str, dict[str, str]] = {}
    for refusal in refused:
        if refusal.log in lost:
            why.setdefault(refusal.reason, {}).setdefault(refusal.log, refusal.detail)
    if not why:
        return ""
    reason, details = max(why.items(), key=lambda item: len(item[1]))
    log, detail = min(details.items())
    return f": {len(details)} as {reason}, such as {log}: {detail}"


def _report(
    machines: Sequence[Machine],
    refused: Sequence[Refusal],
    resources: Resources,
    out: Path,
    judging: Judging,
    folder: str = "",
) -> tuple[tuple[Summary, ...], dict[str, str], dict[str, MachineOutput]]:
    """Write pages; return summaries, why machines have none, and all outputs without their pages.

    ``folder`` is that of the refused logs. Machines whose assessment is missing, or cannot be
    decoded, are assessed once more.
    """
    store, names = resources.store, [machine.name for machine in machines]
    files, own_keys = file_names(names), {machine.name: machine.key for machine in machines}
    refused_key = store.put_refused(tuple(refused), folder)
    record = _records(store, refused, judging.language)
    rows, made = dict[str, Summary](), dict[str, MachineOutput]()
    failed, not_updated = dict[str, str](), dict[str, str]()
    resources.progress("reporting", 0, len(machines))
    left = list(machines)
    for attempt in range(constants.ASSESSMENT_ATTEMPTS):
        if attempt:
            failed |= assess_all(left, resources, force=True)
        force = {machine.name for machine in left} if attempt else ()
        keys, not_recomputed = apply_fleet_priors(machines, resources, force=force)
        not_updated |= not_recomputed
        records = {name: partial(record, name, keys[name], files[name]) for name in names}
        for name, output in _outputs(left, records, resources):
            if isinstance(output, str):
                failed[name] = output
                continue
            store.publish(name, (keys[name], own_keys[name]), output.summary, refused_key)
            made[name] = replace(output, page="")
            rows[name] = judging.write(output, out / files[name])
            resources.progress("reporting", len(rows), len(machines))
        left = [m for m in left if m.name not in rows and m.name not in failed]
        if not left:
            break
    unread = {machine.name: "its assessment cannot be read back from the store" for machine in left}
    return tuple(by_urgency(rows.values())), not_updated | unread | failed, made


def _tables(
    machines: Sequence[Machine], made: Mapping[str, MachineOutput], store: Store
) -> dict[str, dict[str, bytes]]:
    """Return the packed tables of machines; of those without an output, what their logs give."""
    tables = {name: output.tables for name, output in made.items()}

    def of_logs(machine: Machine) -> dict[str, bytes]:
        logs = unpack_logs(store.packed_logs(machine.logs))
        refused = [own for one in logs for own in one.modes.refused]
        return _packed({"refused": refused_rows(refused)}, logs)

    for machine in machines:
        if machine.name not in made:
            found = reason_if_failed(partial(of_logs, machine), machine.name)
            tables[machine.name] = {} if isinstance(found, str) else found
    return tables


def _outputs(
    machines: Sequence[Machine],
    records: Mapping[str, Callable[..., MachineRecord]],
    resources: Resources,
) -> Iterator[tuple[str, MachineOutput | str]]:
    """Yield the outputs of machines; those of unchanged results are taken from the store.

    A machine whose assessment is missing, or cannot be decoded, is left out.
    """
    store = resources.store
    # Its logs, which are large, follow from their names and keys.
    own = {one.name: fingerprint(VERSION, records[one.name](), one.logs) for one in machines}

    def fetch(part: Sequence[Machine]) -> Iterator[tuple[Machine, MachineOutput]]:
        for machine in part:
            content = store.get("pages", own[machine.name], machine.name)
            if (found := unpack_or_none(content, MachineOutput)) is not None:
                yield machine, found

    def job(part: Sequence[Machine]) -> MachineRecord:
        [machine] = part
        return records[machine.name](store.packed_logs(machine.logs))

    how: Any = {"key": lambda machine: own[machine.name], "fetch": fetch, "job": job}
    for [(machine, drawn)], is_new in cached(output_or_reason, machines, resources, **how):
        name = machine.name
        if is_new and isinstance(drawn, MachineOutput):
            store.put_only("pages", {own[name]: pack(drawn)}, name)
        if drawn is not None:
            yield name, drawn


def _records(
    store: Store, refused: Iterable[Refusal], language: Language
) -> Callable[..., MachineRecord]:
    """Return what fetches the results of a machine, of which some logs were refused as a whole."""
    lost: dict[str, list[Refusal]] = {}
    for one in refused:
        if one.reason not in constants.NO_LOSS:
            lost.setdefault(one.machine, []).append(one)

    def record(name: str, key: str, file: str, logs: PackedLogs | None = None) -> MachineRecord:
        assessment, before = store.get("assessed", key, name), store.previous_summary(name, key)
        own = tuple(lost.get(name, ()))
        return MachineRecord(name, file, assessment, logs, before, own, language)

    return record


# Watch

_Files = dict[Path, tuple[int, int]]


def watch(
    folder: Path,
    stages: Sequence[Stage],
    out: Path,
    settings: Settings,
    *,
    interval: float,
    progress: Progress = lambda step, done, total: None,
) -> Iterator[RunResult | LmshealthError]:
    """Yield the result of `run`, or its error, whenever it has something to do; never end.

    Logs whose size or time differ from the poll before, ``interval`` seconds earlier, are left to
    a later run; there is none while ``manifest.csv`` or ``maintenance.csv`` differ. The folder is
    polled, because network shares report no changes. There is a run on every new day (UTC) too:
    services fall due, and machines fall silent, without a new log. A run that fails is repeated at
    the next poll, unless no log was usable.
    """
    before, done, day = _files(folder, out), _Files(), None
    while True:
        time.sleep(interval)
        now, today = _files(folder, out), datetime.now(UTC).date()
        settled = {path: seen for path, seen in now.items() if before.get(path) == seen}
        before = now
        new = settled.items() - done.items() or done.keys() - now.keys()
        growing = frozenset(now.keys() - settled.keys())
        # Half a manifest would give other machines, and half a history of maintenance other lives.
        is_half = any(path.name in NOT_LOGS for path in growing)
        # A folder without files may be a share that is not mounted now: tables stay as they are.
        if settled and not is_half and (new or today != day):
            result: RunResult | LmshealthError
            try:
                result = run(folder, stages, out, replace(settings, growing=growing), progress)
            except LmshealthError as error:
                result = error
            # A store that is away may be back at the next poll; without new logs none is usable.
            if isinstance(result, RunResult | NothingUsable):
                done, day = settled, today
            yield result


def _files(folder: Path, out: Path) -> _Files:
    """Return size in bytes and time of change in ns of all files outside of the output."""
    found: _Files = {}
    inside = out.resolve()
    for parent, folders, files in os.walk(folder.absolute()):
        here = Path(parent)
        visited = [name for name in folders if name[0] != "."]
        folders[:] = [name for name in visited if (here / name).resolve() != inside]
        for path in (here / name for name in files if name[0] != "."):
            with suppress(OSError):  # removed meanwhile
                seen = path.stat()
                found[path] = seen.st_size, seen.st_mtime_ns
    return found
