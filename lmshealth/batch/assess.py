"""Assessing one machine: from its readings to its verdict, wherever the work is done."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

from numpy.linalg import LinAlgError

from lmshealth._serialize import VERSION, fingerprint, pack
from lmshealth.batch.store import Identified, Made, read
from lmshealth.errors import LmshealthError
from lmshealth.health.ensemble_sampling import seed_of
from lmshealth.health.inference import epochs_to_infer, infer
from lmshealth.health.results import Health
from lmshealth.health.verdict import judge
from lmshealth.prognosis.fleet_prior import FleetPrior, MachineEvidence, machine_evidence
from lmshealth.prognosis.remaining_life import prognose, prognose_with_posterior
from lmshealth.prognosis.results import Prognosis
from lmshealth.report.assessment import Assessment
from lmshealth.report.changes import reported
from lmshealth.signal.waterfall import Waterfall
from lmshealth.stage.description import Stage
from lmshealth.tracking.history import History, LogEstimates, build_history, missing_mode_notes
from lmshealth.tracking.maintenance import NO_MAINTENANCE, Maintenance, maintenance_notes
from lmshealth.tracking.track import Track, accepted_estimates, outlier_refusals, track

Part = TypeVar("Part")

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Machine:
    """One machine of a run, and all that its assessment depends on.

    Attributes
    ----------
    name : str
        Its identity.
    logs : tuple of (str, str)
        Names of its logs, and the keys of their readings.
    stage : Stage
        Its description.
    work : Maintenance
        What was done to it.
    epochs : int
        Health is inferred at no more than this many.
    seed : int
        Of all randomness.
    """

    name: str
    logs: tuple[tuple[str, str], ...]
    stage: Stage
    work: Maintenance
    epochs: int
    seed: int

    @property
    def key(self) -> str:
        """Name of its assessment."""
        given = self.logs, self.stage.digest, self.work, self.epochs, self.seed
        return fingerprint(VERSION, *given)


def unpacked(logs: Sequence[tuple[str, bytes]]) -> list[LogEstimates]:
    """Rebuild readings from what a store has of them, under the present names of their logs."""
    found = [(log, read(content, Identified)) for log, content in logs]
    named = [own.named(log).outcome for log, own in found if own is not None]
    return [reading for reading in named if isinstance(reading, LogEstimates)]


def make(
    machine: Machine, logs: Sequence[tuple[str, bytes]], executor: Executor | None = None
) -> Made:
    """Assess a machine from its packed readings, and pack what comes of it."""
    options = {"epochs": machine.epochs, "seed": machine.seed}
    readings = unpacked(logs)
    return packed(assess(readings, machine.stage, machine.work, **options, executor=executor))


def packed(assessment: Assessment) -> Made:
    """Pack an assessment for the store."""
    return Made(pack(assessment), pack(assessment.evidence), pack(reported(assessment)))


def with_fleet_prior(content: bytes, learned: FleetPrior) -> Made | None:
    """Foretell a machine anew, from its packed assessment, with what its fleet has taught it.

    Returns
    -------
    Made or None
        None where this version cannot read the assessment.

    Raises
    ------
    LmshealthError
        If its life cannot be fitted with that prior.
    """
    found: Assessment | None = read(content, Assessment)
    if found is None or found.track is None:
        return None
    history, stage = accepted_estimates(found.history, found.track), learned.apply_to(found.stage)
    prognosis = prognose(history, stage, seed_of(found.seed, history.stage, stage.digest))
    return packed(replace(found, prognosis=prognosis, fleet=learned))


def assess(
    readings: Sequence[LogEstimates],
    stage: Stage,
    work: Maintenance = NO_MAINTENANCE,
    *,
    epochs: int = 40,
    seed: int = 0,
    executor: Executor | None = None,
) -> Assessment:
    """Take the readings of one machine through tracking, health, prognosis and verdict.

    Parameters
    ----------
    readings : sequence of LogEstimates
        Logs of one machine, at least one.
    stage : Stage
        Its description.
    work : Maintenance
        What was done to it.
    epochs : int
        Health is inferred at no more than this many.
    seed : int
        Of all randomness.
    executor : Executor, optional
        Epochs are spread over it.

    Returns
    -------
    Assessment
        What the data do not carry is None, with the reason among the notes.

    Examples
    --------
    Two logs are not enough for a baseline, and that is what is said:

    >>> import lmshealth
    >>> from lmshealth import examples
    >>> stage = lmshealth.load_stage("lms-y")
    >>> found = lmshealth.assess(examples.readings()[:2], stage, epochs=1)
    >>> found.judgement.verdict, found.judgement.why
    ('not-enough-data', '2 usable logs since the baseline began; it needs 5.')
    >>> found.notes[0].split("; ")[1]
    'a life needs at least 3 logs and some travel'
    """
    history, refused = build_history(readings, stage, work.actions)
    notes = maintenance_notes(work, [reading.metadata.recorded_at for reading in readings])
    notes += missing_mode_notes(history, refused)
    partial = [refusal for reading in readings for refusal in reading.modes.refused]
    own_seed = seed_of(seed, history.stage, stage.digest)
    found = _results(history, stage, epochs, own_seed, executor, notes)
    followed, health, prognosis, evidence = found
    if followed is not None:
        refused += outlier_refusals(history, followed)
    by_log = {reading.log: reading for reading in readings}
    used = [by_log[log] for log in history.logs]
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
        seed=seed,
        waterfall=Waterfall.stack([(reading.levels, reading.modes.lines) for reading in used]),
        evidence=evidence,
    )


def _results(
    history: History,
    stage: Stage,
    most_epochs: int,
    seed: tuple[int, int],
    executor: Executor | None,
    notes: list[str],
) -> tuple[Track | None, Health | None, Prognosis | None, MachineEvidence | None]:
    """Go as far as the data carry; what stops it becomes a note."""
    followed: Track | None = None
    health: Health | None = None
    try:
        followed = track(history, stage)
        history = accepted_estimates(history, followed)
        if not stage.parameters:
            return followed, None, None, None
        # The life needs the longest of all: it is begun before the epochs and fetched after them.
        has_limit = any(parameter.limit for parameter in stage.parameters)
        mapper = map if executor is None else partial(map_parts, executor)
        life = mapper(_foretold, [history], [stage], [seed]) if has_limit else None
        epochs = epochs_to_infer(followed, stage, most_epochs)
        health = infer(followed, stage, seed, epochs=epochs, mapper=mapper)
        if life is None:
            return followed, health, None, None
        return followed, health, *next(iter(life))
    except LmshealthError as error:
        notes.append(str(error))
    except LinAlgError as error:  # one machine must not end the run
        notes.append(
            f"{history.stage}: its logs lead to a matrix without an inverse ({error}); please "
            "report this with modes.csv"
        )
    return followed, health, None, None


def map_parts(
    executor: Executor, function: Callable[..., Part], *columns: Iterable[Any]
) -> Iterator[Part]:
    """Apply a function to columns of arguments side by side; yield the results in their order.

    Other than ``Executor.map`` it cancels nothing, which loky does not expect of one that ends.
    """
    futures = [executor.submit(function, *row) for row in zip(*columns, strict=True)]
    return (future.result() for future in futures)


def _foretold(
    history: History, stage: Stage, seed: tuple[int, int]
) -> tuple[Prognosis, MachineEvidence]:
    """Prognose, and say what the life teaches of others: less to send than the life itself."""
    prognosis, life = prognose_with_posterior(history, stage, seed)
    return prognosis, machine_evidence(stage, life)
