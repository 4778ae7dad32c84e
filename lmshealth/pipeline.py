"""The main job: a folder of logs to tables and a report."""

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

from lmshealth.errors import BadLog, LmshealthError, NothingUsable
from lmshealth.following import loop_error
from lmshealth.history import Reading, believed, build_history, doubted, in_order, lost_notes
from lmshealth.inference import epochs_to_infer, infer
from lmshealth.logs import Refusal
from lmshealth.maintenance import Action, maintenance_notes, read_maintenance
from lmshealth.modal import identify
from lmshealth.prognosis import prognose
from lmshealth.readers import content_digest, find_logs, read_log, read_manifest, require_identity
from lmshealth.report import write_report
from lmshealth.results import Health, Prognosis
from lmshealth.sampling import seed_of
from lmshealth.stage import Stage
from lmshealth.store import Store, beside, result_key
from lmshealth.summary import Assessment, judge
from lmshealth.tables import all_tables
from lmshealth.tracking import track
from lmshealth.tracks import History, Track
from lmshealth.waterfall import Waterfall, read_levels

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much is done, and how much there is."""

_logger = logging.getLogger(__name__)

Outcome = Reading | tuple[Refusal, ...]


@dataclass(frozen=True, slots=True)
class Settings:
    """How a run is carried out.

    Attributes
    ----------
    store : str or None
        SQLAlchemy URL; None for a SQLite file beside the output.
    workers : int
        Processes; results do not depend on it.
    epochs : int
        Health is inferred at no more than this many epochs per stage.
    seed : int
        Of all randomness.
    """

    store: str | None = None
    workers: int = 1
    epochs: int = 40
    seed: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class RunResult:
    """What a run did.

    Attributes
    ----------
    index : Path
        The front page of the report.
    pages : tuple of Path
        The page of each stage, in the order of `assessments`.
    assessments : tuple of Assessment
        One per stage.
    n_logs, n_refused, n_remembered : int
        Different logs found, refused as a whole, and taken from the store.
    """

    index: Path
    pages: tuple[Path, ...]
    assessments: tuple[Assessment, ...]
    n_logs: int
    n_refused: int
    n_remembered: int


@dataclass(frozen=True, slots=True)
class _Task:
    path: Path
    name: str
    overrides: dict[str, str]
    digest: str
    key: str


def run(
    folder: Path,
    stages: Sequence[Stage],
    out: Path,
    settings: Settings = Settings(),
    progress: Progress = lambda what, done, total: None,
) -> RunResult:
    """Analyse a folder of logs and write tables and report.

    Parameters
    ----------
    folder : Path
        Read recursively; ``manifest.csv`` and ``maintenance.csv`` are understood.
    stages : sequence of Stage
        Each log goes to the first description that takes it.
    out : Path
        Folder of the output, made if needed.
    settings : Settings
        How to do it.
    progress : callable
        Told what is going on.

    Raises
    ------
    NothingUsable
        If there is no log, or every log was refused; ``refused.csv`` is written all the same.
    """
    out.mkdir(parents=True, exist_ok=True)
    archive = find_logs(folder)
    # Output inside the folder of logs is no log.
    inside = out.resolve()
    found = [path for path in archive.logs if inside not in path.resolve().parents]
    store = Store(settings.store or beside(out))
    try:
        actions = read_maintenance(folder)
        tasks, refused = _tasks(folder, found, stages, progress)
        outcomes, n_remembered = _identify_all(tasks, stages, store, settings.workers, progress)
        readings = in_order([o for o in outcomes if isinstance(o, Reading)])
        with _workers(settings.workers) as pool:
            assessments = _assess_all(readings, stages, actions, settings, pool, progress)
    finally:
        store.close()
    lost = [r for outcome in outcomes if not isinstance(outcome, Reading) for r in outcome]
    contradicted = [r for a in assessments for r in a.refused if r.reason == "odometer"]
    jumps = [r for a in assessments for r in a.refused if r.reason == "jump"]
    whole = [*archive.refused, *refused, *lost, *contradicted]
    partial = [*(r for reading in readings for r in reading.modes.refused), *jumps]
    tables = all_tables(readings, assessments, [*whole, *partial])
    for name, table in tables.items():
        _write_table(out / f"{name}.csv", table.to_csv(index=False))
    n_logs = len(found) + len(archive.refused)
    # A row of a manifest that names no log is listed, but no log is lost by it; nor by a copy.
    names = {path.relative_to(folder).as_posix() for path in found}
    names |= {refusal.log for refusal in archive.refused}
    n_refused = len({r.log for r in whole if r.log in names and r.reason != "duplicate"})
    n_copies = len({r.log for r in whole if r.reason == "duplicate"})
    if not readings:
        raise NothingUsable(
            f"{folder}: no usable log: {n_logs} found, {n_refused} refused; "
            f"{out / 'refused.csv'} says why"
        )
    pages = write_report(out, assessments, whole)
    return RunResult(
        index=out / "index.html",
        pages=tuple(page for page in pages if page.name != "index.html"),
        assessments=assessments,
        n_logs=n_logs - n_copies,
        n_refused=n_refused,
        n_remembered=n_remembered,
    )


def _write_table(path: Path, text: str) -> None:
    """Replace a file in one step, so that an interrupted run leaves no half table."""
    part = path.with_suffix(".part")
    part.write_text(text, encoding="utf-8")
    part.replace(path)


@contextmanager
def _workers(n: int) -> Iterator[Executor | None]:
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
    circumstances = [version("lmshealth"), *(stage.digest for stage in stages)]
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
        key = result_key(digest, *circumstances, repr(sorted(overrides.items())))
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
        store.put(task.key, task.name, outcome)
        outcomes[task.key] = outcome
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
            with _workers(workers) as pool:
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


def _assess_all(
    readings: Sequence[Reading],
    stages: Sequence[Stage],
    actions: Sequence[Action],
    settings: Settings,
    pool: Executor | None,
    progress: Progress,
) -> tuple[Assessment, ...]:
    machines: dict[str, list[Reading]] = {}
    for reading in readings:
        machines.setdefault(str(reading.metadata.stage), []).append(reading)
    assessments = []
    for k, (name, own) in enumerate(sorted(machines.items())):
        progress("assessing", k, len(machines))
        stage = next(stage for stage in stages if stage.takes(own[0].metadata))
        relevant = [action for action in actions if action.stage == name]
        assessments.append(assess(own, stage, relevant, settings, pool))
    progress("assessing", len(machines), len(machines))
    return tuple(assessments)


def assess(
    readings: Sequence[Reading],
    stage: Stage,
    actions: Sequence[Action] = (),
    settings: Settings = Settings(),
    pool: Executor | None = None,
) -> Assessment:
    """Take the readings of one machine through tracking, health, prognosis and verdict.

    Parameters
    ----------
    readings : sequence of Reading
        Logs of one machine, at least one.
    stage : Stage
        Its description.
    actions : sequence of Action
        Its maintenance.
    settings : Settings
        Number of epochs and seed.
    pool : Executor, optional
        Epochs are spread over it.

    Returns
    -------
    Assessment
        What the data do not carry is None, with the reason among the notes.
    """
    history, refused = build_history(readings, stage, actions)
    notes = maintenance_notes(actions, [reading.metadata.recorded_at for reading in readings])
    notes += lost_notes(history, refused)
    partial = [refusal for reading in readings for refusal in reading.modes.refused]
    seed = seed_of(settings.seed, history.stage, stage.digest)
    followed, health, prognosis = _results(history, stage, settings.epochs, seed, pool, notes)
    if followed is not None:
        refused += doubted(history, followed)
    own = {reading.log: reading for reading in readings}
    used = [own[log] for log in history.logs]
    return Assessment(
        stage=stage,
        history=history,
        digests=tuple(reading.digest for reading in used),
        track=followed,
        health=health,
        prognosis=prognosis,
        judgement=judge(stage, history, health, followed),
        refused=tuple([*partial, *refused]),
        notes=tuple(notes),
        seed=settings.seed,
        waterfall=Waterfall.stack([(reading.levels, reading.modes.lines) for reading in used]),
    )


def _results(
    history: History,
    stage: Stage,
    most_epochs: int,
    seed: tuple[int, int],
    pool: Executor | None,
    notes: list[str],
) -> tuple[Track | None, Health | None, Prognosis | None]:
    """Go as far as the data carry; what stops it becomes a note."""
    followed: Track | None = None
    health: Health | None = None
    try:
        followed = track(history, stage)
        history = believed(history, followed)
        if not stage.parameters:
            return followed, None, None
        # The life needs the longest of all: it is begun before the epochs and fetched after them.
        has_limit = any(parameter.limit for parameter in stage.parameters)
        life = pool.submit(prognose, history, stage, seed) if pool and has_limit else None
        epochs = epochs_to_infer(followed, stage, most_epochs)
        health = infer(followed, stage, seed, epochs=epochs, mapper=pool.map if pool else map)
        if not has_limit:
            return followed, health, None
        return followed, health, life.result() if life else prognose(history, stage, seed)
    except LmshealthError as error:
        notes.append(str(error))
        return followed, health, None
