"""Taking in a folder: every log in it is identified, once in the life of a store."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from lmshealth._serialize import VERSION, fingerprint
from lmshealth.batch.store import Identified, Store
from lmshealth.batch.workers import Pool
from lmshealth.errors import BadLog
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.constants import MAX_MEMORY
from lmshealth.io.formats.registry import format_name
from lmshealth.io.log import Log, Metadata, Refusal
from lmshealth.io.manifest import find_logs, name_of, read_manifest
from lmshealth.io.reading import content_digest, read_log, require_identity
from lmshealth.io.refusal import visible
from lmshealth.modal.identification import identify
from lmshealth.signal.following_error import loop_error
from lmshealth.signal.waterfall import relative_spectrum
from lmshealth.stage.description import Stage
from lmshealth.tracking.history import LogEstimates

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much is done, and how much there is."""

# Files hashed by one task.
_BATCH = 16
# Their refusal depends on the computer and on --max-memory, not only on the log: it is not cached.
_PASSING = ("missing-file", "changed", "too-large")

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Site:
    """Where a batch is done: what remembers, what works, and who is told how far it is."""

    store: Store
    pool: Pool
    progress: Progress = lambda what, done, total: None


@dataclass(frozen=True, slots=True, order=True)
class Entry:
    """A log of a machine: its name, and under what the store has its reading."""

    log: str
    key: str


@dataclass(frozen=True, slots=True, eq=False)
class Intake:
    """What a folder of logs gave.

    Attributes
    ----------
    machines : dict of str to tuple of Entry
        Logs of each machine that gave a reading, by its identity.
    descriptions : dict of str to str
        Digest of the stage description of each machine.
    refused : tuple of Refusal
        Logs refused as a whole, copies, and rows of a manifest that name no log.
    logs : frozenset of str
        Names of all logs found.
    n_remembered : int
        Logs that the store knew.
    """

    machines: dict[str, tuple[Entry, ...]]
    descriptions: dict[str, str]
    refused: tuple[Refusal, ...]
    logs: frozenset[str]
    n_remembered: int


@dataclass(frozen=True, slots=True)
class _Task:
    path: Path
    name: str
    overrides: dict[str, str]
    digest: str
    columns: ColumnMap | None

    def key(self, description: str) -> str:
        """Name what becomes of the log by all that it depends on."""
        as_read = format_name(self.path), sorted(self.overrides.items()), self.columns
        return fingerprint(VERSION, self.digest, *as_read, description)


def take_in(
    folder: Path,
    stages: Sequence[Stage],
    site: Site,
    *,
    out: Path,
    columns: ColumnMap | None = None,
    max_memory: float = MAX_MEMORY,
) -> Intake:
    """Identify every log of a folder that the store does not know yet.

    Parameters
    ----------
    folder : Path
        Read recursively; ``manifest.csv`` is understood.
    stages : sequence of Stage
        Each log goes to the first description that takes it.
    site : Site
        Its store knows what was done before, and keeps what is done now; results do not depend on
        its pool.
    out : Path
        Folder of the output: nothing inside it is a log.
    columns : ColumnMap, optional
        How all of them are read; by default their columns are those of the log contract.
    max_memory : float
        Most memory in bytes that reading a log may take.
    """
    folder = folder.absolute()  # workers may stand elsewhere
    archive = find_logs(folder)
    inside = out.resolve()
    found = [path for path in archive.logs if inside not in path.resolve().parents]
    tasks, refused = _tasks(folder, found, columns, site)
    sorter = _Sorter(tuple(stages))
    known = set()
    for task, outcome in _remembered(tasks, stages, site.store):
        sorter.add(task, outcome)
        known.add(task.name)
    site.progress("identifying", len(known), len(tasks))
    left = [task for task in tasks if task.name not in known]
    work = partial(identify_log, stages=tuple(stages), max_memory=max_memory)
    for k, (task, outcome) in enumerate(site.pool.map_unordered(work, left, _lost), start=1):
        if outcome.lasting:
            site.store.put(task.key(outcome.description), task.digest, outcome)
        sorter.add(task, outcome)
        site.progress("identifying", len(known) + k, len(tasks))
    names = {name_of(path, folder) for path in found}
    machines, descriptions, lost = sorter.sorted()
    return Intake(
        machines=machines,
        descriptions=descriptions,
        refused=(*archive.refused, *refused, *lost),
        logs=frozenset(names | {refusal.log for refusal in archive.refused}),
        n_remembered=len(known),
    )


class _Sorter:
    """Gives readings to machines, and keeps of each no more than its name."""

    def __init__(self, stages: tuple[Stage, ...]) -> None:
        self._order = [stage.digest for stage in stages]
        self._found: dict[str, dict[str, list[Entry]]] = {}
        self._lost: list[Refusal] = []

    def add(self, task: _Task, found: Identified) -> None:
        if isinstance(found.outcome, LogEstimates):
            own = self._found.setdefault(str(found.stage), {})
            entry = Entry(task.name, task.key(found.description))
            own.setdefault(found.description, []).append(entry)
        else:
            self._lost += found.outcome

    def sorted(self) -> tuple[dict[str, tuple[Entry, ...]], dict[str, str], list[Refusal]]:
        """Give the logs and the description of each machine, and what was refused, by name."""
        machines, descriptions, lost = {}, {}, list(self._lost)
        for name, by in sorted(self._found.items()):
            most = max(by, key=lambda digest: (len(by[digest]), -self._order.index(digest)))
            machines[name], descriptions[name] = tuple(sorted(by[most])), most
            others = [entry for digest in by if digest != most for entry in by[digest]]
            detail = (
                f"{len(by[most])} logs of {name} belong to another stage description than this "
                "one; a machine has one: see column description of manifest.csv"
            )
            lost += [Refusal(entry.log, "no-stage", detail) for entry in others]
        return machines, descriptions, sorted(lost, key=lambda refusal: refusal.log)


def _tasks(
    folder: Path, found: Sequence[Path], columns: ColumnMap | None, site: Site
) -> tuple[list[_Task], list[Refusal]]:
    """Name every log by its content; the same content twice is one log."""
    manifest = read_manifest(folder)
    tasks: list[_Task] = []
    refused: list[Refusal] = list(manifest.refused)
    digests: dict[Path, str] = {}
    site.progress("reading", 0, len(found))
    for _, part in site.pool.map_unordered(_digests, _batches(found), _no_digests):
        for path, (digest, refusal) in part.items():
            digests[path] = digest
            if refusal is not None:
                refused.append(Refusal(name_of(path, folder), *refusal))
        site.progress("reading", len(digests), len(found))
    seen: dict[tuple[str, str], str] = {}
    # Of copies the one that a manifest tells of is analysed: the others may lack what it says.
    for path in sorted(found, key=lambda path: not manifest.names(path)):
        name = name_of(path, folder)
        # Under the name of another format it is no copy: only one of the two can be read.
        content = digests[path], format_name(path)
        if not digests[path]:
            continue
        try:
            overrides = manifest.overrides(path)
        except BadLog as error:
            refused.append(Refusal(name, error.reason, error.detail))
            continue
        if content in seen:
            detail = f"same content as {seen[content]}, which stands for both"
            refused.append(Refusal(name, "duplicate", detail))
            continue
        seen[content] = name
        tasks.append(_Task(path, name, overrides, digests[path], columns))
    return tasks, refused


def _batches(found: Sequence[Path]) -> Iterator[tuple[Path, ...]]:
    for first in range(0, len(found), _BATCH):
        yield tuple(found[first : first + _BATCH])


_Digests = dict[Path, tuple[str, tuple[str, str] | None]]


def _digests(paths: Iterable[Path]) -> _Digests:
    """Hash files; one that cannot be has an empty digest, and the reason."""
    found: _Digests = {}
    for path in paths:
        try:
            found[path] = content_digest(path), None
        except BadLog as error:
            found[path] = "", (error.reason, error.detail)
    return found


def _no_digests(paths: Iterable[Path], why: str) -> _Digests:
    return {path: ("", ("missing-file", f"{why}: it cannot be read")) for path in paths}


def _remembered(
    tasks: Sequence[_Task], stages: Sequence[Stage], store: Store
) -> Iterator[tuple[_Task, Identified]]:
    """Yield what the store knows of logs and is still true.

    That is what holds without a description, or came by the description that takes the log today.
    """
    digests = ["", _none_of(stages), *(stage.digest for stage in stages)]
    own = {task.key(digest): task for task in tasks for digest in digests}
    for key, found in store.identified(own):
        metadata = Metadata(stage=found.stage, description=found.asked)
        if found.description in ("", _none_of(stages), _taker(stages, metadata)):
            yield own[key], found.named(own[key].name)


def _taker(stages: Sequence[Stage], metadata: Metadata) -> str | None:
    """Digest of the description that a log belongs to."""
    return next((stage.digest for stage in stages if stage.matches(metadata)), None)


def _none_of(stages: Sequence[Stage]) -> str:
    """Stand for all descriptions, where none of them takes a log."""
    return fingerprint([(stage.name, stage.description.match.stage) for stage in stages])


def _lost(task: _Task, why: str) -> Identified:
    refusal = Refusal(task.name, "corrupt", f"{why}: the file is damaged, or too large")
    return Identified((refusal,), lasting=False)


def identify_log(
    task: _Task, stages: tuple[Stage, ...], max_memory: float = MAX_MEMORY
) -> Identified:
    """Read and identify one log; what goes wrong with it is its refusal, never an exception."""
    by, stage, asked = "", None, None
    try:
        log = read_log(
            task.path,
            columns=task.columns,
            overrides=task.overrides,
            name=task.name,
            max_memory=max_memory,
        )
        if log.digest != task.digest:
            raise BadLog(task.name, "changed", "it is being written to; run again")
        require_identity(log)
        stage, asked = log.metadata.stage, log.metadata.description
        by = _taker(stages, log.metadata) or _none_of(stages)
        outcome = _identified(log, stages)
        return Identified(outcome, by, stage, asked)
    except BadLog as error:
        refusal = Refusal(task.name, error.reason, error.detail)
        return Identified((refusal,), by, stage, asked, lasting=error.reason not in _PASSING)
    except (OSError, MemoryError) as error:
        why = visible(str(error)) or type(error).__name__
        detail = f"{why}: the computer failed, not the log; run again"
        return Identified((Refusal(task.name, "resources", detail),), lasting=False)
    except Exception as error:  # one log must not end the batch, whatever our mistake
        _logger.exception("%s", task.name)
        detail = visible(f"{type(error).__name__}: {error}; please report this with the log")
        return Identified((Refusal(task.name, "internal", detail),), lasting=False)


def _identified(log: Log, stages: tuple[Stage, ...]) -> LogEstimates:
    """Identify a log by the description that takes it."""
    stage = next((stage for stage in stages if stage.matches(log.metadata)), None)
    if stage is None:
        raise BadLog(log.name, "no-stage", _untaken(log.metadata, stages))
    modes = identify(log, stage)
    return LogEstimates(
        log.name, log.digest, log.metadata, modes, loop_error(log), relative_spectrum(log, stage)
    )


def _untaken(metadata: Metadata, stages: Sequence[Stage]) -> str:
    """Say why no description takes a log, and the two places where that can be mended."""
    if metadata.description is not None:
        return (
            f"its description is to be {metadata.description!r}, and --stage gives "
            f"{', '.join(stage.name for stage in stages)}; give that one, or mend column "
            "description of manifest.csv"
        )
    asked = ", ".join(f"{stage.description.match.stage!r} in {stage.name}" for stage in stages)
    return (
        f"no description takes stage {metadata.stage!r}: [match] stage is {asked}; mend it there, "
        "or give by --stage the description of this machine"
    )
