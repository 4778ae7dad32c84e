"""Taking in a folder: every log in it is identified, once in the life of a store."""

from __future__ import annotations

import logging
import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from lmshealth.errors import BadLog
from lmshealth.following import loop_error
from lmshealth.history import Reading, in_order
from lmshealth.logs import Refusal
from lmshealth.modal import identify
from lmshealth.packing import fingerprint
from lmshealth.readers import content_digest, find_logs, read_log, read_manifest, require_identity
from lmshealth.stage import Stage
from lmshealth.store import Outcome, Store
from lmshealth.waterfall import read_levels

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much is done, and how much there is."""

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class Intake:
    """What a folder of logs gave.

    Attributes
    ----------
    readings : tuple of Reading
        In the order of recording.
    refused : tuple of Refusal
        Logs refused as a whole, copies, and rows of a manifest that name no log.
    logs : frozenset of str
        Names of all logs found.
    n_remembered : int
        Logs that the store knew.
    """

    readings: tuple[Reading, ...]
    refused: tuple[Refusal, ...]
    logs: frozenset[str]
    n_remembered: int


@dataclass(frozen=True, slots=True)
class _Task:
    path: Path
    name: str
    overrides: dict[str, str]
    digest: str
    key: str


def take_in(
    folder: Path,
    stages: Sequence[Stage],
    store: Store,
    *,
    out: Path,
    workers: int = 1,
    progress: Progress = lambda what, done, total: None,
) -> Intake:
    """Identify every log of a folder that the store does not know yet.

    Parameters
    ----------
    folder : Path
        Read recursively; ``manifest.csv`` is understood.
    stages : sequence of Stage
        Each log goes to the first description that takes it.
    store : Store
        Knows what was done before, and keeps what is done now.
    out : Path
        Folder of the output: nothing inside it is a log.
    workers : int
        Processes; results do not depend on it.
    progress : callable
        Told what is going on.
    """
    archive = find_logs(folder)
    inside = out.resolve()
    found = [path for path in archive.logs if inside not in path.resolve().parents]
    tasks, refused = _tasks(folder, found, stages, progress)
    outcomes, n_remembered = _identify_all(tasks, stages, store, workers, progress)
    lost = [r for outcome in outcomes if not isinstance(outcome, Reading) for r in outcome]
    names = {path.relative_to(folder).as_posix() for path in found}
    return Intake(
        readings=in_order([o for o in outcomes if isinstance(o, Reading)]),
        refused=(*archive.refused, *refused, *lost),
        logs=frozenset(names | {refusal.log for refusal in archive.refused}),
        n_remembered=n_remembered,
    )


@contextmanager
def processes(n: int) -> Iterator[Executor | None]:
    """Start worker processes, and end them whatever happens; none for one worker."""
    if n <= 1:
        yield None
        return
    # Spawned, not forked: a fork would share locks of threads that do not come along.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(n, mp_context=context, initializer=_leave_interrupts) as pool:
        try:
            yield pool
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _leave_interrupts() -> None:
    """Let Ctrl-C be the parent's alone: workers would each print where they stood."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _tasks(
    folder: Path, found: Sequence[Path], stages: Sequence[Stage], progress: Progress
) -> tuple[list[_Task], list[Refusal]]:
    """Name every log by its content; the same content twice is one log."""
    manifest = read_manifest(folder)
    tasks: list[_Task] = []
    refused: list[Refusal] = list(manifest.refused)
    seen: dict[str, str] = {}
    circumstances = [version("lmshealth"), [stage.digest for stage in stages]]
    for k, path in enumerate(found):
        progress("reading", k, len(found))
        name = path.relative_to(folder).as_posix()
        try:
            digest = content_digest(path)
        except BadLog as error:
            refused.append(Refusal(name, error.reason, error.detail))
            continue
        if digest in seen:
            detail = f"same content as {seen[digest]}, which is analysed"
            refused.append(Refusal(name, "duplicate", detail))
            continue
        seen[digest] = name
        overrides = manifest.overrides(path)
        key = fingerprint(digest, circumstances, sorted(overrides.items()))
        tasks.append(_Task(path, name, overrides, digest, key))
    progress("reading", len(found), len(found))
    return tasks, refused


def _identify_all(
    tasks: Sequence[_Task],
    stages: Sequence[Stage],
    store: Store,
    workers: int,
    progress: Progress,
) -> tuple[list[Outcome], int]:
    """Identify all logs that the store does not know; results in the order of the tasks."""
    outcomes: dict[str, Outcome] = {}
    for task in tasks:
        known = store.get(task.key, task.name)
        if known is not None:
            outcomes[task.key] = known
    n_remembered = len(outcomes)
    progress("identifying", n_remembered, len(tasks))
    open_tasks = [task for task in tasks if task.key not in outcomes]
    for task, outcome in _carry_out(open_tasks, tuple(stages), workers):
        outcomes[task.key] = store.put(task.key, outcome)
        progress("identifying", len(outcomes), len(tasks))
    return [outcomes[task.key] for task in tasks], n_remembered


def _carry_out(
    tasks: Sequence[_Task], stages: tuple[Stage, ...], workers: int
) -> Iterator[tuple[_Task, Outcome]]:
    """Identify logs in the order in which they are done.

    A library that a damaged file crashes takes its process along. The logs that were under way
    are then done again, each in a process of its own, so that only the one is lost.
    """
    if workers <= 1 or len(tasks) <= 1:
        for task in tasks:
            yield task, identify_log(task, stages)
        return
    left = list(tasks)
    while left:
        done: set[str] = set()
        try:
            with processes(workers) as pool:
                assert pool is not None  # more than one worker
                futures = {pool.submit(identify_log, task, stages): task for task in left}
                for future in as_completed(futures):
                    outcome = future.result()
                    done.add(futures[future].key)
                    yield futures[future], outcome
            return
        except BrokenExecutor:
            left = [task for task in left if task.key not in done]
            # Tasks are begun in order: the one that did it is among the first.
            suspects, left = left[: 2 * workers + 1], left[2 * workers + 1 :]
            for task in suspects:
                yield task, _alone(task, stages)


def _alone(task: _Task, stages: tuple[Stage, ...]) -> Outcome:
    """Identify one log in a process of its own, and survive that process."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        try:
            return pool.submit(identify_log, task, stages).result()
        except BrokenExecutor:
            detail = "reading it ended the process that read it: the file is damaged, or too large"
            return (Refusal(task.name, "corrupt", detail),)


def identify_log(task: _Task, stages: tuple[Stage, ...]) -> Outcome:
    """Read and identify one log; what goes wrong with it is its refusal, never an exception."""
    try:
        log = read_log(task.path, overrides=task.overrides, name=task.name)
        require_identity(log)
        stage = next((stage for stage in stages if stage.takes(log.metadata)), None)
        if stage is None:
            raise BadLog(
                task.name,
                "no-stage",
                f"stage {log.metadata.stage!r} matches none of the descriptions "
                f"{[s.description.match.stage for s in stages]}; give its description by --stage",
            )
        modes = identify(log, stage)
        return Reading(
            task.name, log.digest, log.metadata, modes, loop_error(log), read_levels(log, stage)
        )
    except BadLog as error:
        return (Refusal(task.name, error.reason, error.detail),)
    except Exception as error:  # one log must not end the batch, whatever our mistake
        _logger.exception("%s", task.name)
        detail = f"{type(error).__name__}: {error}; please report this with the log"
        return (Refusal(task.name, "internal", detail),)
