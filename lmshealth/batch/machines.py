"""Many machines, one after the other or many at a time: assessed, and told.

Each is done by itself, from what the store has, and given back to it.
"""

from __future__ import annotations

import logging
from collections.abc import Container, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, Executor
from pathlib import Path

from lmshealth._files import write_text
from lmshealth._serialize import fingerprint
from lmshealth.batch.assess import Machine, make, with_fleet_prior
from lmshealth.batch.ingest import Site
from lmshealth.batch.store import Made, Store, read
from lmshealth.batch.telling import Content, Telling, tell
from lmshealth.batch.workers import Pool
from lmshealth.errors import LmshealthError
from lmshealth.io.refusal import visible
from lmshealth.prognosis.fleet_prior import FleetPrior, MachineEvidence, fleet_priors

_Job = tuple[Machine, tuple[tuple[str, bytes], ...]]

_PriorUpdate = tuple[Machine, str, bytes | None, FleetPrior]

_logger = logging.getLogger(__name__)


def assess_all(machines: Sequence[Machine], site: Site, *, anew: bool = False) -> dict[str, str]:
    """Assess every machine of which anything has changed; the store remembers the others.

    Parameters
    ----------
    machines : sequence of Machine
        With all that their assessments depend on.
    site : Site
        Its store has their readings, and keeps the assessments.
    anew : bool
        Whether to do so whatever the store remembers.

    Returns
    -------
    dict of str to str
        Machines that could not be assessed, and why: one must not end the batch.
    """
    store = site.store
    left = [m for m in machines if anew or not store.has(m.name, m.key)]
    n_known, failed = len(machines) - len(left), dict[str, str]()
    site.progress("assessing", n_known, len(machines))
    for k, (machine, made) in enumerate(_assessed(left, site), start=1):
        if isinstance(made, Made):
            store.keep(machine.name, machine.key, made)
        else:
            failed[machine.name] = made
        site.progress("assessing", n_known + k, len(machines))
    return failed


def _assessed(machines: Sequence[Machine], site: Site) -> Iterator[tuple[Machine, Made | str]]:
    """Assess machines side by side; where they are fewer than workers, the parts of each."""
    pool = site.pool
    jobs = ((machine, logs_of(machine, site.store)) for machine in machines)
    if pool.executor is None or len(machines) >= pool.size:
        for (machine, _), made in pool.map_unordered(_make, jobs, _why):
            yield machine, made
        return
    for machine, logs in jobs:
        try:
            yield machine, _make((machine, logs), pool.executor, pool.crashes)
        except pool.crashes:  # a worker was killed: without them it only takes longer
            yield machine, _make((machine, logs))


def logs_of(machine: Machine, store: Store) -> tuple[tuple[str, bytes], ...]:
    """Fetch the names and the packed readings of the logs of a machine."""
    contents = dict(store.contents(key for _, key in machine.logs))
    return tuple((log, contents[key]) for log, key in machine.logs if key in contents)


def _make(
    job: _Job, executor: Executor | None = None, losses: tuple[type[Exception], ...] = ()
) -> Made | str:
    """Assess a machine; what goes wrong with it is told, what goes wrong with workers is raised."""
    machine, logs = job
    of_workers: tuple[type[BaseException], ...] = (CancelledError, *losses)
    try:
        return make(machine, logs, executor)
    except of_workers:
        raise
    except LmshealthError as error:
        return str(error)
    except Exception as error:
        _logger.exception("%s", machine.name)
        return _mistake(error)


def update_priors(
    machines: Sequence[Machine], site: Site, *, anew: Container[str] = ()
) -> tuple[dict[str, str], dict[str, str]]:
    """Let the machines of each description teach the young ones among them.

    Parameters
    ----------
    machines : sequence of Machine
        All of them, assessed.
    site : Site
        Its store has their evidence and assessments.
    anew : container of str
        Which are to be taught whatever the store remembers.

    Returns
    -------
    keys : dict of str to str
        Under which the store has the assessment of each machine that is to be told.
    failed : dict of str to str
        Machines whose prognosis could not be recomputed with the fleet prior, and why: they keep
        the prognosis from before.
    """
    store = site.store
    keys, failed = {machine.name: machine.key for machine in machines}, dict[str, str]()
    left = []
    for machine, learned in _machines_to_update(machines, store):
        key = fingerprint(machine.key, learned)
        if machine.name not in anew and store.has(machine.name, key):
            keys[machine.name] = key
        else:
            left.append((machine, learned, key))
    if left:
        site.progress("teaching", 0, len(left))
    jobs = (
        (machine, key, store.assessment(machine.name, machine.key), learned)
        for machine, learned, key in left
    )
    for k, (job, made) in enumerate(site.pool.map_unordered(_update, jobs, _why), start=1):
        name, key = job[0].name, job[1]
        if isinstance(made, Made):
            store.keep(name, key, made)
            keys[name] = key
        elif made is not None:
            failed[name] = made
        site.progress("teaching", k, len(left))
    return keys, failed


def _machines_to_update(
    machines: Sequence[Machine], store: Store
) -> Iterator[tuple[Machine, FleetPrior]]:
    """Find the young machines of each description, and what the others teach them."""
    classes: dict[str, dict[str, Machine]] = {}
    for machine in machines:
        classes.setdefault(machine.stage.digest, {})[machine.name] = machine
    for own in classes.values():
        evidence = {}
        for name, machine in own.items():
            content = store.evidence(name, machine.key)
            own_evidence = None if content is None else read(content, MachineEvidence | None)
            if own_evidence is not None:
                evidence[name] = own_evidence
        if evidence:
            stage = next(iter(own.values())).stage
            yield from ((own[name], one) for name, one in fleet_priors(stage, evidence).items())


def _update(job: _PriorUpdate) -> Made | str | None:
    """Teach a machine; whatever goes wrong with it is told, never an exception."""
    _, _, content, learned = job
    try:
        return None if content is None else with_fleet_prior(content, learned)
    except LmshealthError as error:
        return str(error)
    except Exception as error:
        _logger.exception("%s", job[0].name)
        return _mistake(error)


def _why(job: object, why: str) -> str:
    return why


def tell_all(
    contents: Iterable[Content], pool: Pool, out: Path
) -> Iterator[tuple[str, Telling | str]]:
    """Write the pages of machines; yield each machine with what else is told, or why nothing is.

    Those of which there is nothing, or nothing that this version can read, are passed over.
    """
    for content, telling in pool.map_unordered(_tell, contents, _why):
        if isinstance(telling, Telling):
            write_text(out / content.file, telling.page.text)
        if telling is not None:
            yield content.machine, telling


def _tell(content: Content) -> Telling | str | None:
    """Tell a machine; whatever goes wrong with it is told, never an exception."""
    try:
        return tell(content)
    except Exception as error:
        _logger.exception("%s", content.machine)
        return _mistake(error)


def _mistake(error: Exception) -> str:
    return visible(f"{type(error).__name__}: {error}; please report this with its logs")
