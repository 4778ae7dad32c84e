"""The main job: a folder of logs to tables and a report."""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, closing
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from tempfile import TemporaryFile

from lmshealth.batch.assess import Machine
from lmshealth.batch.database import StoreError
from lmshealth.batch.ingest import Intake, Progress, Site, take_in
from lmshealth.batch.machines import assess_all, logs_of, tell_all, update_priors
from lmshealth.batch.store import Store, beside
from lmshealth.batch.telling import Content, Tables, Telling
from lmshealth.batch.workers import Pool, cluster, processes
from lmshealth.errors import LmshealthError, NothingUsable
from lmshealth.io.column_map import ColumnMap
from lmshealth.io.constants import MAX_MEMORY
from lmshealth.io.log import Refusal
from lmshealth.io.manifest import NOT_LOGS
from lmshealth.report.assessment import Summary
from lmshealth.report.fleet_page import by_urgency, file_names, write_index
from lmshealth.stage.description import Stage
from lmshealth.tracking.maintenance import Maintenance, read_maintenance


@dataclass(frozen=True, slots=True)
class Settings:
    """How a run is carried out.

    Attributes
    ----------
    store : str or None
        SQLAlchemy URL; None for a SQLite file beside the output.
    workers : int
        Processes of this machine; results do not depend on it.
    scheduler : str or None
        Address of a Dask scheduler, whose workers then take the place of processes.
    epochs : int
        Health is inferred at no more than this many epochs per stage.
    seed : int
        Of all randomness.
    columns : ColumnMap or None
        How logs are read; None where their columns are those of the log contract.
    max_memory : float
        Most memory in bytes that reading a log may take.

    Examples
    --------
    Two processes, and a store for a team; the password that its address may hold is not shown:

    >>> import lmshealth
    >>> lmshealth.Settings(workers=2, store="postgresql://me:secret@host/fleet")
    Settings(workers=2, scheduler=None, epochs=40, seed=0, columns=None, max_memory=2000000000.0)
    """

    store: str | None = field(default=None, repr=False)  # it may hold a password
    workers: int = 1
    scheduler: str | None = None
    epochs: int = 40
    seed: int = 0
    columns: ColumnMap | None = None
    max_memory: float = MAX_MEMORY

    def pool(self) -> AbstractContextManager[Pool]:
        """Open what does the work."""
        return cluster(self.scheduler) if self.scheduler else processes(self.workers)


@dataclass(frozen=True, slots=True, eq=False)
class RunResult:
    """What a run did.

    Attributes
    ----------
    index : Path
        The front page of the report.
    rows : tuple of Summary
        One per machine, worst first.
    n_logs, n_refused, n_remembered : int
        Different logs found, refused as a whole, and taken from the store.
    n_unread : int
        Rows of manifests and of maintenance that are not understood, or whole such tables.
    failed : dict of str to str
        Machines that could not be assessed, or told, and why.
    """

    index: Path
    rows: tuple[Summary, ...]
    n_logs: int
    n_refused: int
    n_remembered: int
    n_unread: int
    failed: dict[str, str]

    @property
    def pages(self) -> tuple[Path, ...]:
        """Pages of the machines, which lie beside the index."""
        return tuple(self.index.with_name(row.file) for row in self.rows)


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

    Examples
    --------
    A folder of one log, of noise alone: no mode is made up, and the pages say so.

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
    >>> result = lmshealth.run(Path("logs"), [stage], Path("result"))
    >>> result.n_logs, result.n_refused, result.index.name
    (1, 0, 'index.html')
    >>> refused = pd.read_csv("result/refused.csv")
    >>> dict(zip(refused["mode"], refused["reason"]))
    {'roll': 'not-excited', 'pitch': 'not-excited', 'yaw': 'not-excited'}
    """
    _prepare(out)
    work = read_maintenance(folder)
    with settings.pool() as pool, closing(Store(settings.store or beside(out))) as store:
        site = Site(store, pool, progress)
        taken = take_in(
            folder,
            stages,
            site,
            out=out,
            columns=settings.columns,
            max_memory=settings.max_memory,
        )
        refused = (*taken.refused, *work.refused)
        machines = _machines(taken, stages, work, settings)
        failed = assess_all(machines, site)
        usable = [machine for machine in machines if machine.name not in failed]
        rows, contradicted = _report(usable, refused, site, out, failed)
    copies = {refusal.log for refusal in refused if refusal.reason == "duplicate"}
    lost = ({refusal.log for refusal in refused} - copies | contradicted) & taken.logs
    if not machines:
        raise NothingUsable(
            f"{folder}: no usable log: {len(taken.logs)} found, {len(lost)} refused"
            f"{_commonest(refused, lost)}; {out / 'refused.csv'} lists all"
        )
    return RunResult(
        index=write_index(out, rows, refused),
        rows=rows,
        n_logs=len(taken.logs - copies),
        n_refused=len(lost),
        n_remembered=taken.n_remembered,
        n_unread=sum(PurePosixPath(refusal.log).name in NOT_LOGS for refusal in refused),
        failed=failed,
    )


def report(
    store: Store,
    out: Path,
    settings: Settings = Settings(),
    progress: Progress = lambda what, done, total: None,
) -> RunResult:
    """Write the pages of all machines in a store, without their logs.

    Parameters
    ----------
    store : Store
        Filled by `run`.
    out : Path
        Folder of the pages, made if needed.
    settings : Settings
        Who does the work.
    progress : callable
        Told what is going on.

    Raises
    ------
    StoreError
        If there is no assessment that this version can read.
    """
    _prepare(out)
    told = store.told()
    files = file_names([one.machine for one in told])
    rows, failed = dict[str, Summary](), dict[str, str]()
    progress("reporting", 0, len(told))
    # A process takes longer to start than a page to write.
    few = replace(settings, workers=min(settings.workers, len(told)))
    with few.pool() as pool:
        contents = (
            Content(
                machine=one.machine,
                file=files[one.machine],
                assessment=store.assessment(one.machine, one.key),
                logs=(),
                before=store.earlier(one.machine, one.key),
            )
            for one in told
        )
        for name, telling in tell_all(contents, pool, out):
            if isinstance(telling, str):
                failed[name] = telling
            else:
                rows[name] = telling.page.summary
            progress("reporting", len(rows) + len(failed), len(told))
    if not rows and not failed:
        raise StoreError(
            "the store holds only what another version of lmshealth kept; `lmshealth run LOGS "
            "--store URL` fills it anew"
        )
    ranked = tuple(by_urgency(rows.values()))
    unread = "not readable for this version of lmshealth; run its logs again"
    return RunResult(
        index=write_index(out, ranked, store.refused(one.refused for one in told)),
        rows=ranked,
        n_logs=0,
        n_refused=0,
        n_remembered=0,
        n_unread=0,
        failed={one.machine: unread for one in told if one.machine not in rows} | failed,
    )


def _prepare(out: Path) -> None:
    """Make the folder of the output, and see whether it can be written to."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        TemporaryFile(dir=out).close()
    except OSError as error:
        raise LmshealthError(f"{out}: cannot be written to: {error.strerror}") from error


def _commonest(refused: Iterable[Refusal], lost: Container[str]) -> str:
    """Say why most of the lost logs were refused, in the words of the first of them."""
    why: dict[str, dict[str, str]] = {}
    for refusal in refused:
        if refusal.log in lost:
            why.setdefault(refusal.reason, {}).setdefault(refusal.log, refusal.detail)
    if not why:
        return ""
    reason, details = max(why.items(), key=lambda item: len(item[1]))
    log, detail = min(details.items())
    return f": {len(details)} as {reason}, such as {log}: {detail}"


def _machines(
    taken: Intake, stages: Sequence[Stage], work: Maintenance, settings: Settings
) -> list[Machine]:
    """Put together what the assessment of each machine depends on."""
    by_digest = {stage.digest: stage for stage in stages}
    return [
        Machine(
            name=name,
            logs=tuple((entry.log, entry.key) for entry in entries),
            stage=by_digest[taken.descriptions[name]],
            work=work.of(name),
            epochs=settings.epochs,
            seed=settings.seed,
        )
        for name, entries in taken.machines.items()
    ]


def _report(
    machines: Sequence[Machine],
    refused: Sequence[Refusal],
    site: Site,
    out: Path,
    failed: dict[str, str],
) -> tuple[tuple[Summary, ...], set[str]]:
    """Write pages and tables; give the rows of the index, and logs left out of a life."""
    key = site.store.keep_refused(tuple(refused))
    rows, contradicted = dict[str, Summary](), set[str]()
    site.progress("reporting", 0, len(machines))
    with Tables(out, [machine.name for machine in machines]) as tables:
        tables.add_refused(refused)
        for name, keys, telling in _told(machines, site, out, failed):
            if telling is None:
                tables.add(name, {})
                continue
            site.store.tell(name, keys[0], key, beside=keys)
            tables.add(name, telling.tables)
            contradicted |= set(telling.contradicted)
            rows[name] = telling.page.summary
            site.progress("reporting", len(rows), len(machines))
        tables.write()
    return tuple(by_urgency(rows.values())), contradicted


def _told(
    machines: Sequence[Machine], site: Site, out: Path, failed: dict[str, str]
) -> Iterator[tuple[str, tuple[str, str], Telling | None]]:
    """Tell machines, and yield the keys of what is told and of what that comes from.

    One whose assessment has gone, or cannot be read, is assessed once more.
    """
    files = file_names([machine.name for machine in machines])
    left, anew = {machine.name: machine for machine in machines}, frozenset[str]()
    for _ in range(2):
        keys, untaught = update_priors(machines, site, anew=anew)
        failed |= untaught
        contents = (_content(m, keys[m.name], files, site.store) for m in list(left.values()))
        for name, telling in tell_all(contents, site.pool, out):
            both = keys[name], left.pop(name).key
            if isinstance(telling, str):
                failed[name] = telling
                yield name, both, None
            else:
                yield name, both, telling
        if not left:
            return
        failed |= assess_all(list(left.values()), site, anew=True)
        anew = frozenset(left)
    for name in left:
        failed.setdefault(name, "its assessment cannot be read back from the store")


def _content(machine: Machine, key: str, files: dict[str, str], store: Store) -> Content:
    """Fetch what is to be told of a machine."""
    return Content(
        machine=machine.name,
        file=files[machine.name],
        assessment=store.assessment(machine.name, key),
        logs=logs_of(machine, store),
        before=store.earlier(machine.name, key),
    )
