"""Assessments of all machines of a run, and their update by the prior of their fleet."""

from __future__ import annotations

import logging
from collections.abc import Callable, Container, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from lmshealth._private.serialize import VERSION, fingerprint, pack
from lmshealth.batch.ingest import unexpected
from lmshealth.batch.store import (
    LogKey,
    PackedAssessment,
    PackedLogs,
    Resources,
    Store,
    cached,
    unpack_logs,
    unpack_or_none,
)
from lmshealth.errors import LmshealthError
from lmshealth.life.fleet_prior import EndedLife, FleetContribution, FleetPrior, fleet_priors
from lmshealth.machine.assessment import (
    Assessment,
    LifeState,
    assess_from,
    with_calibration,
    with_fleet_prior,
)
from lmshealth.stage.description import Stage
from lmshealth.tracking.maintenance import Maintenance

_Job = tuple["Machine", PackedLogs, bytes | None]  # with a packed `LifeState`
# With the key of the result; without a prior the prognosis is calibrated by ended lives.
_Update = tuple["Machine", str, FleetPrior | None, tuple[EndedLife, ...]]
_UpdateJob = tuple[_Update, bytes | None, bytes | None]  # packed assessment and `LifeState`

Part = TypeVar("Part")

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Machine:
    """One machine of a run, and all that its assessment depends on: see `assess`."""

    name: str
    logs: tuple[LogKey, ...]
    stage: Stage
    work: Maintenance
    epochs: int
    seed: int

    @property
    def key(self) -> str:
        """Key of its assessment in a store."""
        inputs = self.logs, self.stage.digest, self.work, self.epochs, self.seed
        return fingerprint(VERSION, *inputs)

    @property
    def life_key(self) -> str:
        """Key of the part of its assessment that the next one begins with."""
        return fingerprint(VERSION, "life", self.stage.digest, self.seed)


def assess_all(
    machines: Sequence[Machine], resources: Resources, *, force: bool = False
) -> dict[str, str]:
    """Assess every machine whose assessment is not in the store; with ``force``, every machine.

    No part of an earlier assessment is used then. Return why some machines could not be assessed.
    """
    store, failed = resources.store, dict[str, str]()

    def fetch(part: Sequence[Machine]) -> Iterator[tuple[Machine, None]]:
        return ((m, None) for m in part if not force and store.has_assessment(m.name, m.key))

    def job(part: Sequence[Machine]) -> _Job:
        [one] = part
        known = None if force else store.part(one.name, one.life_key, after=one.key)
        return one, store.packed_logs(one.logs), known

    resources.progress("assessing", 0, len(machines))
    how: Any = {"key": lambda one: fingerprint(one.name, one.key), "fetch": fetch, "job": job}
    found = cached(_assess_packed, machines, resources, **how)
    for k, ([(machine, made)], _) in enumerate(found, start=1):
        if isinstance(made, PackedAssessment):
            store.put_assessment(machine.name, machine.key, made)
        elif made is not None:
            failed[machine.name] = made
        resources.progress("assessing", k, len(machines))
    return failed


def pack_assessment(assessment: Assessment) -> PackedAssessment:
    """Encode an assessment for the store."""
    evidence = pack(FleetContribution(assessment.evidence, assessment.ended))
    return PackedAssessment(pack(assessment), evidence)


def _assess_packed(job: _Job) -> list[PackedAssessment | str | None]:
    """Assess a machine, or return why it fails."""
    machine, logs, known = job

    def work() -> PackedAssessment:
        readings, before = unpack_logs(logs), unpack_or_none(known, LifeState)
        how = {"epochs": machine.epochs, "seed": machine.seed}
        found, after = assess_from(readings, machine.stage, machine.work, **how, before=before)
        parts = {} if after is None else {machine.life_key: pack(after)}
        return replace(pack_assessment(found), parts=parts)

    return [reason_if_failed(work, machine.name)]


def apply_fleet_priors(
    machines: Sequence[Machine], resources: Resources, *, force: Container[str] = ()
) -> tuple[dict[str, str], dict[str, str]]:
    """Recompute prognoses of young machines with the prior of their fleet; calibrate the others.

    A fleet is all machines of one description. The result of machines named by ``force`` is
    computed although it is in the store. Return the key of the assessment of each machine to
    publish, and why some could not be recomputed.
    """
    store, failed = resources.store, dict[str, str]()
    keys = {machine.name: machine.key for machine in machines}
    updates = [
        (machine, fingerprint(machine.key, prior, ended), prior, ended)
        for machine, prior, ended in _machines_to_update(machines, store)
    ]

    def fetch(part: Sequence[_Update]) -> Iterator[tuple[_Update, None]]:
        of_part = (one for one in part if one[0].name not in force)
        return ((one, None) for one in of_part if store.has_assessment(one[0].name, one[1]))

    def job(part: Sequence[_Update]) -> _UpdateJob:
        [update] = part
        one = update[0]
        content = store.get("assessed", one.key, one.name)
        return update, content, store.part(one.name, one.life_key)

    found = cached(_update, updates, resources, key=lambda one: one[1], fetch=fetch, job=job)
    for k, ([(one, made)], is_new) in enumerate(found, start=1):
        machine, key, *_ = one
        if isinstance(made, PackedAssessment):
            store.put_assessment(machine.name, key, made)
        if isinstance(made, str):
            failed[machine.name] = made
        elif made is not None or not is_new:
            keys[machine.name] = key
        if is_new:
            resources.progress("fleet priors", k, len(updates))
    return keys, failed


def _machines_to_update(
    machines: Sequence[Machine], store: Store
) -> Iterator[tuple[Machine, FleetPrior | None, tuple[EndedLife, ...]]]:
    """Find the machines that need a fleet prior, and their priors; the others with ended lives.

    Predictions of ended lives are by the description, as are those that they calibrate.
    """
    fleets: dict[str, dict[str, Machine]] = {}
    for machine in machines:
        fleets.setdefault(machine.stage.digest, {})[machine.name] = machine
    for fleet in fleets.values():
        evidence, ended = {}, list[EndedLife]()
        for name, machine in sorted(fleet.items()):
            content = store.get("evidence", machine.key, name)
            if (own := unpack_or_none(content, FleetContribution)) is not None:
                ended += own.ended
                if own.evidence is not None:
                    evidence[name] = own.evidence
        priors = fleet_priors(next(iter(fleet.values())).stage, evidence) if evidence else {}
        yield from ((fleet[name], prior, ()) for name, prior in priors.items())
        if ended:
            yield from ((fleet[m], None, tuple(ended)) for m in evidence if m not in priors)


def _update(job: _UpdateJob) -> list[PackedAssessment | str | None]:
    """Recompute or calibrate a prognosis; None if it cannot be decoded, else why that fails."""
    (machine, _, prior, ended), content, life = job

    def work() -> PackedAssessment | None:
        found: Assessment | None = unpack_or_none(content, Assessment)
        if found is None or found.track is None:
            return None
        if prior is None:
            is_open = found.prognosis is None
            return None if is_open else pack_assessment(with_calibration(found, ended))
        before = unpack_or_none(life, LifeState)
        made = with_fleet_prior(found, prior, epochs=machine.epochs, before=before)
        return pack_assessment(made)

    return [reason_if_failed(work, machine.name)]


def reason_if_failed(work: Callable[[], Part], machine: str) -> Part | str:
    """Return the result of work for a machine, or why it fails: one must not end the batch."""
    try:
        return work()
    except LmshealthError as error:
        return str(error).removeprefix(f"{machine}: ")  # those who list it name the machine
    except Exception as error:
        _logger.exception("%s", machine)
        return unexpected(error, "its logs")
