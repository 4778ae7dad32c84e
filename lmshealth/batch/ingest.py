"""Ingest of an archive: every log is hashed, and identified once in the life of a store."""

import logging
import math
import os
import time
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from datetime import date, datetime
from functools import partial
from numbers import Integral, Real
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple, Self

from lmshealth._private.serialize import VERSION, fingerprint, pack
from lmshealth.batch import constants
from lmshealth.batch.alerts import Alerts
from lmshealth.batch.store import (
    Identified,
    LogKey,
    Resources,
    Store,
    cached,
    unpack_logs,
    unpack_or_none,
)
from lmshealth.batch.workers import Pool, Threads, cluster, processes
from lmshealth.errors import BadLog, LmshealthError
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.constants import MAX_MEMORY
from lmshealth.io.formats.registry import format_name
from lmshealth.io.log import SHIPPED, Metadata, Refusal, covariates, is_future
from lmshealth.io.manifest import NOT_LOGS, Manifest, copy_error, find_logs, name_of, read_manifest
from lmshealth.io.reading import content_digest, read_log, require_identity
from lmshealth.io.refusal import visible
from lmshealth.modal.log_estimates import LogEstimates, without_copies
from lmshealth.report.language import LANGUAGES, Language
from lmshealth.stage.description import Stage, why_unmatched

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of a run; an impossible one raises `LmshealthError`.

    Examples
    --------
    Two processes, and a store for a team; the password that its address may hold is not shown:

    >>> import lmshealth
    >>> settings = lmshealth.Settings(workers=2, store="postgresql://me:secret@host/fleet")
    >>> settings.workers, settings.epochs, "secret" in repr(settings)
    (2, 40, False)
    """

    # SQLAlchemy URL, which may contain a password; None for a SQLite file in the output's folder.
    store: str | None = field(default=None, repr=False)
    workers: int = 1  # processes of this machine; results do not depend on it
    scheduler: str | None = None  # address of that of Dask, whose workers replace the processes
    epochs: int = 40  # at most per machine, at which health is inferred
    seed: int = 0  # of all random numbers
    # How logs are read (`column_map`); None where their columns are those of the log contract.
    columns: ColumnMap | None = None
    max_memory: float = MAX_MEMORY  # in bytes, that reading a log may take
    seconds_per_log: float = constants.LOG_SECONDS  # of the processor, to identify it
    latest: datetime | None = None  # of logs and maintenance; None for a day from now
    follow_links: bool = False  # out of the folder of logs
    alerts: Alerts = field(default_factory=Alerts)  # which changes are delivered, and how
    # At the end of this day statuses are judged, for runs that repeat; None for the present moment.
    today: date | None = None
    language: Language = "en"  # of the pages; tables, status files and messages are English
    growing: frozenset[Path] = frozenset()  # files that are left to a later run

    def __post_init__(self) -> None:
        def check(name: str, value: object, holds: bool, needed: str) -> None:
            if not holds:
                raise LmshealthError(f"Settings: {name} is {value!r:.80}; needed {needed}")

        for name, least in (("workers", 1), ("epochs", 1), ("seed", 0)):
            value = getattr(self, name)
            is_whole = isinstance(value, Integral) and not isinstance(value, bool)
            needed = f"a whole number of at least {least}"
            check(name, value, is_whole and least <= value < 1 << 63, needed)
        positive = {"max_memory": self.max_memory, "seconds_per_log": self.seconds_per_log}
        if self.alerts.silent_days is not None:
            positive["silent_days"] = self.alerts.silent_days
        for name, value in positive.items():
            check(name, value, isinstance(value, Real) and value > 0, "a number above 0")
        latest, today = self.latest, self.today
        is_zoned = latest is None or (isinstance(latest, datetime) and latest.tzinfo is not None)
        check("latest", latest, is_zoned, "a moment with a time zone")
        is_day = isinstance(today, date | None) and not isinstance(today, datetime)
        check("today", today, is_day, "a day (datetime.date)")
        check("language", self.language, self.language in LANGUAGES, f"one of {LANGUAGES}")
        is_map = isinstance(self.columns, ColumnMap | None)
        check("columns", self.columns, is_map, "a result of column_map")

    def pool(self) -> AbstractContextManager[Pool]:
        """Open the workers."""
        return cluster(self.scheduler) if self.scheduler else processes(self.workers)


@dataclass(frozen=True, slots=True, eq=False)
class Ingested:
    """Logs of each machine that have estimates, and its description.

    Refused are logs as a whole, copies, and rows of a manifest that name no log; ``logs`` are the
    names of all logs that are there or that a manifest lists; the outcomes of ``n_cached`` logs
    were in the store.
    """

    machines: dict[str, tuple[Stage, tuple[LogKey, ...]]]
    refused: tuple[Refusal, ...]
    logs: frozenset[str]
    n_cached: int


@dataclass(frozen=True, slots=True)
class _Task:
    path: Path
    name: str
    overrides: dict[str, str]
    digest: str
    columns: ColumnMap | None

    def key(self, description: str) -> str:
        """Return the fingerprint of all that the outcome of the log depends on."""
        as_read = format_name(self.path), sorted(self.overrides.items()), self.columns
        own = [key for key in covariates() if key not in SHIPPED]  # of installed packages
        return fingerprint(VERSION, self.digest, *as_read, description, *own)


class _Outcome(NamedTuple):
    """What the main process needs of the outcome of a log."""

    key: LogKey
    description: str
    machine: str | None
    refused: tuple[Refusal, ...]  # of the log as a whole
    recording: str = ""  # fingerprint of machine, moment and odometer
    packed: bytes | None = None  # by the worker, if it is to be stored

    @classmethod
    def of(cls, task: _Task, found: Identified, *, is_new: bool = True) -> Self:
        """Make it from an outcome."""
        refused, recording = tuple[Refusal, ...](), ""
        if isinstance(found.outcome, LogEstimates):
            own = found.outcome.metadata
            recording = fingerprint(own.stage, own.recorded_at, own.travel)
        else:
            refused = found.outcome
        key = task.key(found.description)
        packed = pack(found) if is_new and found.lasting else None
        return cls((task.name, key), found.description, found.stage, refused, recording, packed)


def ingest(
    folder: Path, stages: Sequence[Stage], resources: Resources, *, out: Path, settings: Settings
) -> Ingested:
    """Identify every log of a folder whose outcome is not in the store yet.

    Each log is read with the first description that matches it. No file inside the folder of the
    output is a log.
    """
    store, progress = resources.store, resources.progress
    folder = folder.absolute()  # workers may have another working directory
    manifest = read_manifest(folder, follow_links=settings.follow_links)
    archive = find_logs(folder, manifest=manifest, follow_links=settings.follow_links)
    inside = out.resolve()
    logs = (path for path in archive.logs if path not in settings.growing)
    found = [path for path in logs if inside not in path.resolve().parents]
    tasks, refused = _tasks(folder, found, manifest, settings.columns, resources)
    usable, lost = list[_Outcome](), list[Refusal]()
    # Machine of each log, by the manifest or its own metadata.
    owners = {name_of(path, folder): row.get("stage") for path, row in manifest.rows.items()}
    declared = {name_of(path, folder) for path in manifest.rows if manifest.is_baseline(path)}

    how = {"max_memory": settings.max_memory, "latest": settings.latest}
    limit = settings.seconds_per_log
    identify = partial(_identify_logs, stages=tuple(stages), how=how, limit=limit)
    fetch = partial(_cached, stages=stages, store=store, latest=settings.latest)
    n_cached = done = 0
    progress("identifying", 0, len(tasks))
    for part, is_new in _identified(tasks, identify, resources, fetch):
        store.put("identified", {one.key[1]: one.packed for one in part if one.packed is not None})
        for one in part:
            lost += one.refused
            owners[one.key[0]] = one.machine or owners.get(one.key[0])
        # Only names and keys are kept, not the estimates.
        usable += [one._replace(packed=None) for one in part if not one.refused]
        n_cached += 0 if is_new else len(part)
        done += len(part)
        progress("identifying", done, len(tasks))
    names = {name_of(path, folder): path for path in found}
    refused += _copies(usable, {name for name in names if manifest.names(names[name])}, store)
    copies = {one.log for one in refused if one.reason == "duplicate"}
    refused += [
        Refusal(name, "not-listed", "it is read with its own metadata; add a row")
        for name, path in names.items()
        if manifest.omits(path) and name not in copies
    ]
    machines, others = _grouped([one for one in usable if one.key[0] not in copies], stages)
    lost = sorted([*lost, *others], key=lambda refusal: refusal.log)
    every = (
        replace(one, machine=owners.get(one.log) or "", baseline=one.log in declared)
        for one in (*archive.refused, *refused, *lost)
    )
    known = (*names, *(one.log for one in (*archive.refused, *manifest.refused)))
    return Ingested(
        machines=machines,
        refused=tuple(every),
        logs=frozenset(name for name in known if PurePosixPath(name).name not in NOT_LOGS),
        n_cached=n_cached,
    )


def _copies(usable: Iterable[_Outcome], listed: Container[str], store: Store) -> list[Refusal]:
    """Refuse logs that are the recording of another file; of several a listed one is analysed."""
    recordings, refused = dict[str, list[LogKey]](), list[Refusal]()
    for one in usable:
        recordings.setdefault(one.recording, []).append(one.key)
    for keys in (own for own in recordings.values() if len(own) > 1):
        order = sorted(keys, key=lambda key: (key[0] not in listed, key[0]))
        refused += without_copies(unpack_logs(store.packed_logs(order)))[1]
    return refused


def _grouped(
    usable: Iterable[_Outcome], stages: Sequence[Stage]
) -> tuple[dict[str, tuple[Stage, tuple[LogKey, ...]]], list[Refusal]]:
    """Return description and logs of each machine, and refusals of logs of its other ones."""
    found = dict[str, dict[str, list[LogKey]]]()
    for one in usable:
        own = found.setdefault(str(one.machine), {})
        own.setdefault(one.description, []).append(one.key)
    by_digest = {stage.digest: stage for stage in stages}
    order, machines, refused = [*by_digest], {}, list[Refusal]()
    for name, by in sorted(found.items()):
        most = max(by, key=lambda digest: (len(by[digest]), -order.index(digest)))
        machines[name] = by_digest[most], tuple(sorted(by[most]))
        others = [log for digest in by if digest != most for log, _ in by[digest]]
        detail = (
            f"{len(by[most])} logs of {name} belong to another stage description than this "
            "one; a machine has one: see column description of manifest.csv"
        )
        refused += [Refusal(log, "no-stage", detail) for log in others]
    return machines, refused


def _tasks(
    folder: Path,
    found: Sequence[Path],
    manifest: Manifest,
    columns: ColumnMap | None,
    resources: Resources,
) -> tuple[list[_Task], list[Refusal]]:
    """Hash every log; the same content twice is one log and its copy."""
    digests = _all_digests({path: _file_key(path, folder) for path in found}, resources)
    refused = [
        *manifest.refused,
        *(
            Refusal(name_of(path, folder), digest.reason, digest.detail)
            for path in found
            if isinstance(digest := digests[path], BadLog)
        ),
    ]
    seen: dict[tuple[str, str], _Task] = {}
    # Of several copies the one in a manifest is analysed: only that one has its metadata.
    for path in sorted(found, key=lambda path: not manifest.names(path)):
        name, digest = name_of(path, folder), digests[path]
        if isinstance(digest, BadLog):
            continue
        # A file with the suffix of another format is no copy: only one of the two can be read.
        content = digest, format_name(path)
        try:
            overrides = manifest.overrides(path)
            if content in seen:
                task = seen[content]
                raise copy_error(name, overrides, task.name, task.overrides)
        except BadLog as error:
            refused.append(Refusal(name, error.reason, error.detail))
            continue
        seen[content] = _Task(path, name, overrides, digest, columns)
    return [*seen.values()], refused


def _file_key(path: Path, folder: Path) -> tuple[str, bool]:
    """Return a key of a file by its name, size and times, and whether these prove its content.

    They do not just after a change, nor on Windows, which has no time of the last change.
    """
    name = name_of(path, folder)
    try:
        found = path.stat()
    except OSError:
        return fingerprint(name), False
    age = time.time() - max(found.st_mtime, found.st_ctime)
    key = fingerprint(name, found.st_size, found.st_mtime_ns, found.st_ctime_ns)
    return key, age > constants.SETTLED_S and os.name != "nt"


def _all_digests(
    files: Mapping[Path, tuple[str, bool]], resources: Resources
) -> dict[Path, str | BadLog]:
    """Hash the files that have changed since they were hashed last, by this run or another one."""
    store, digests = resources.store, dict[Path, str | BadLog]()

    def fetch(paths: Sequence[Path]) -> Iterator[tuple[Path, str]]:
        known = dict(store.of_keys("hashed", (files[path][0] for path in paths)))
        return ((path, known[key].decode()) for path in paths if (key := files[path][0]) in known)

    resources.progress("reading", 0, len(files))
    # Threads hash at the same time, and start at once.
    in_threads = replace(resources, pool=Threads(resources.pool.size))
    how: Any = {"key": lambda path: files[path][0], "most": constants.FILES_PER_HASH_TASK}
    for part, is_new in cached(_digests, [*files], in_threads, fetch=fetch, **how):
        digests |= part
        if is_new:
            new = {files[path]: digest for path, digest in part if isinstance(digest, str)}
            store.put("hashed", {key: one.encode() for (key, is_old), one in new.items() if is_old})
        resources.progress("reading", len(digests), len(files))
    return digests


def _digests(paths: Iterable[Path]) -> list[str | BadLog]:
    """Hash files; return the error of one that cannot be read."""
    found: list[str | BadLog] = []
    for path in paths:
        try:
            found.append(content_digest(path))
        except BadLog as error:
            found.append(error)
    return found


def _cached(
    tasks: Sequence[_Task], stages: Sequence[Stage], store: Store, latest: datetime | None
) -> Iterator[tuple[_Task, _Outcome]]:
    """Yield the stored outcomes that are still valid.

    These are the outcomes that used no description, or that used the one which matches the log now,
    and that are not later than another run allowed.
    """
    digests = ["", _none_of(stages), *(stage.digest for stage in stages)]
    own = {task.key(digest): task for task in tasks for digest in digests}
    for key, content in store.of_keys("identified", own):
        if (found := unpack_or_none(content, Identified)) is None:
            continue
        matching = _matching(stages, Metadata(stage=found.stage, description=found.asked))
        used = "" if matching is None else matching.digest
        is_late = isinstance(found.outcome, LogEstimates) and is_future(
            found.outcome.metadata.recorded_at, latest
        )
        if found.description in ("", _none_of(stages), used) and not is_late:
            task = own[key]
            yield task, _Outcome.of(task, found.renamed(task.name), is_new=False)


def _matching(stages: Sequence[Stage], metadata: Metadata) -> Stage | None:
    """Return the first description that matches a log."""
    return next((stage for stage in stages if stage.matches(metadata)), None)


def _none_of(stages: Sequence[Stage]) -> str:
    """Return a digest of all descriptions, for logs that none of them matches."""
    return fingerprint([(stage.name, stage.description.match.stage) for stage in stages])


def _identified(
    tasks: Sequence[_Task],
    identify: Callable[[Sequence[_Task]], list[_Outcome]],
    resources: Resources,
    fetch: Callable[[Sequence[_Task]], Iterable[tuple[_Task, _Outcome]]],
) -> Iterator[tuple[list[_Outcome], bool]]:
    """Identify logs, several in one task; those of a task that ended its worker one by one.

    Yield some outcomes at a time, and whether they are new.
    """
    lost: list[tuple[_Task, ...]] = []
    how: Any = {"key": lambda task: task.key(""), "most": constants.LOGS_PER_TASK}
    how |= {"on_crash": lambda part, why: [None] * len(part)}
    for part, is_new in cached(identify, tasks, resources, fetch=fetch, **how):
        lost += [(task,) for task, outcome in part if outcome is None]
        yield [outcome for _, outcome in part if outcome is not None], is_new
    for _, outcomes in resources.pool.map_unordered(identify, lost, _crashed):
        yield outcomes, True


def _crashed(tasks: Sequence[_Task], why: str) -> list[_Outcome]:
    needed = "no other log is affected; run again with fewer --workers"
    detail = f"{why} (crash or out of memory); {needed}"
    return [_Outcome.of(task, _passing(task, "crashed", detail)) for task in tasks]


def _passing(task: _Task, reason: str, detail: str) -> Identified:
    """Return a refusal that is no property of the log: the next run tries it again."""
    return Identified((Refusal(task.name, reason, detail),), lasting=False)


def _identify_logs(
    tasks: Sequence[_Task], stages: tuple[Stage, ...], how: Mapping[str, Any], limit: float
) -> list[_Outcome]:
    """Read and identify logs, and pack their outcomes where these are to be stored."""
    return [_Outcome.of(task, identify_log(task, stages, how, limit)) for task in tasks]


def _within(limit: float, name: str) -> Callable[[str, int, int], None]:
    """Return a callback of progress that refuses (``too-slow``) a log at the end of its time.

    A worker of Dask identifies several logs in threads of one process.
    """
    start = time.thread_time()

    def check(step: str, done: int, total: int) -> None:
        if (taken := time.thread_time() - start) > limit:
            found = f"{step} {done} of {total} parts of the band after {taken:.3g} s of processor "
            next_step = "record shorter or with fewer channels, or raise --seconds-per-log"
            raise BadLog(name, "too-slow", f"{found}time, allowed are {limit:.3g} s: {next_step}")

    return check


def identify_log(
    task: _Task, stages: tuple[Stage, ...], how: Mapping[str, Any], limit: float = math.inf
) -> Identified:
    """Read and identify one log; every failure becomes its refusal, never an exception.

    It is read with `max_memory` and `latest` of `read_log`; the identification may take ``limit``
    seconds of processor time.
    """
    # Late: only workers need them, and only where a log is new.
    from lmshealth.modal.identification import read_modes
    from lmshealth.modal.mode_shapes import mode_shapes
    from lmshealth.modal.spectra_summary import WATERFALL_BINS, shown_band, summarise
    from lmshealth.signal.readings import loop_error

    by, stage, asked = "", None, None
    try:
        read = partial(read_log, columns=task.columns, overrides=task.overrides)
        log = read(task.path, name=task.name, **how)
        if log.digest != task.digest:
            raise BadLog(task.name, "changed", "it is being written to; run again")
        stage, asked = log.metadata.stage, log.metadata.description
        require_identity(log, odometer=False)
        described = _matching(stages, log.metadata)
        if described is None:
            by = _none_of(stages)
            raise BadLog(task.name, "no-stage", why_unmatched(log.metadata, stages))
        by = described.digest
        require_identity(log, odometer=described.description.life.clock == "odometer")
        reading = read_modes(log, described, progress=_within(limit, task.name))
        modes, band = reading.modes, shown_band(described)
        spectra = summarise(reading.spectra, reading.fitted, modes, band, WATERFALL_BINS)
        rms, shapes = loop_error(log), mode_shapes(modes, reading.fitted)
        own = log.name, log.digest, log.metadata, modes, rms, spectra, shapes
        found = LogEstimates(*own, sample_rate=log.sample_rate)
        return Identified(found, by, stage, asked)
    except BadLog as error:
        refusal = Refusal(task.name, error.reason, error.detail)
        lasting = error.reason not in constants.RETRIED_REASONS
        return Identified((refusal,), by, stage, asked, lasting=lasting)
    except (OSError, MemoryError) as error:
        why = visible(str(error)) or type(error).__name__
        return _passing(task, "resources", f"{why}: the computer failed, not the log; run again")
    except Exception as error:  # an error of this program in one log must not end the batch
        _logger.exception("%s", task.name)
        return _passing(task, "internal", unexpected(error, "the log"))


def unexpected(error: Exception, attachment: str) -> str:
    """Describe an exception that this program should not raise, and ask for a report."""
    return visible(f"{type(error).__name__}: {error}; please report this with {attachment}")
