"""The main job: a folder of logs to tables and a report."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from contextlib import closing
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from numpy.linalg import LinAlgError

from lmshealth.errors import LmshealthError, NothingUsable
from lmshealth.history import Reading, believed, build_history, doubted, lost_notes
from lmshealth.inference import epochs_to_infer, infer
from lmshealth.intake import Intake, Progress, processes, take_in
from lmshealth.maintenance import Action, maintenance_notes, read_maintenance
from lmshealth.packing import fingerprint
from lmshealth.prognosis import prognose
from lmshealth.report import write_report
from lmshealth.results import Health, Prognosis
from lmshealth.sampling import seed_of
from lmshealth.stage import Stage
from lmshealth.store import Fleet, Store, beside
from lmshealth.summary import Assessment
from lmshealth.tables import all_tables
from lmshealth.tracking import track
from lmshealth.tracks import History, Track
from lmshealth.verdict import judge
from lmshealth.waterfall import Waterfall


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
    actions = read_maintenance(folder)
    with closing(Store(settings.store or beside(out))) as store:
        taken = take_in(folder, stages, store, out=out, workers=settings.workers, progress=progress)
        fleet = _assess_all(taken, stages, actions, store, settings, progress)
        _write_tables(out, taken, fleet)
        if not taken.readings:
            raise NothingUsable(
                f"{folder}: no usable log: {len(taken.logs)} found, {_n_lost(taken, fleet)} "
                f"refused; {out / 'refused.csv'} says why"
            )
        store.keep_refused((a.history.stage for a in fleet.assessments), fleet.refused)
    pages = write_report(out, fleet.assessments, fleet.refused, earlier=fleet.earlier)
    n_copies = len({r.log for r in fleet.refused if r.reason == "duplicate"})
    return RunResult(
        index=out / "index.html",
        pages=tuple(page for page in pages if page.name != "index.html"),
        assessments=fleet.assessments,
        n_logs=len(taken.logs) - n_copies,
        n_refused=_n_lost(taken, fleet),
        n_remembered=taken.n_remembered,
    )


def _n_lost(taken: Intake, fleet: Fleet) -> int:
    """Count the logs that are refused as a whole.

    A row of a manifest that names no log is listed, but no log is lost by it; nor by a copy.
    """
    lost = {r.log for r in fleet.refused if r.reason != "duplicate"}
    return len(lost & taken.logs)


def _write_tables(out: Path, taken: Intake, fleet: Fleet) -> None:
    partial = [r for reading in taken.readings for r in reading.modes.refused]
    jumps = [r for a in fleet.assessments for r in a.refused if r.reason == "jump"]
    refused = [*fleet.refused, *partial, *jumps]
    for name, table in all_tables(taken.readings, fleet.assessments, refused).items():
        _write_table(out / f"{name}.csv", table.to_csv(index=False))


def _write_table(path: Path, text: str) -> None:
    """Replace a file in one step, so that an interrupted run leaves no half table."""
    part = path.with_suffix(".part")
    part.write_text(text, encoding="utf-8")
    part.replace(path)


def _assess_all(
    taken: Intake,
    stages: Sequence[Stage],
    actions: Sequence[Action],
    store: Store,
    settings: Settings,
    progress: Progress,
) -> Fleet:
    """Assess every machine of which anything has changed; the store remembers the others."""
    machines: dict[str, list[Reading]] = {}
    for reading in taken.readings:
        machines.setdefault(str(reading.metadata.stage), []).append(reading)
    assessments: list[Assessment] = []
    earlier = {}
    with processes(settings.workers) as pool:
        for k, (name, own) in enumerate(sorted(machines.items())):
            progress("assessing", k, len(machines))
            stage = next(stage for stage in stages if stage.takes(own[0].metadata))
            relevant = [action for action in actions if action.stage == name]
            given = (own, stage.digest, relevant, settings.epochs, settings.seed)
            key = fingerprint(version("lmshealth"), *given)
            known = store.recall(name, key)
            if known is None:
                known = store.keep(name, key, assess(own, stage, relevant, settings, pool))
            assessments.append(known)
            if (said := store.earlier(name, key)) is not None:
                earlier[name] = said
    progress("assessing", len(machines), len(machines))
    contradicted = [r for a in assessments for r in a.refused if r.reason == "odometer"]
    return Fleet(tuple(assessments), (*taken.refused, *contradicted), earlier)


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
    except LinAlgError as error:  # one machine must not end the run
        notes.append(
            f"{history.stage}: its logs lead to a matrix without an inverse ({error}); please "
            "report this with modes.csv"
        )
    return followed, health, None
