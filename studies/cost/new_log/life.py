"""Run a machine after one new log, and from nothing, in a process of its own.

The argument is a file with its estimates: what draws them does not count.
"""

from __future__ import annotations

import json
import pickle
import sys
import tempfile
from collections.abc import Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np

from lmshealth._private.serialize import fingerprint, pack
from lmshealth.batch import run as running
from lmshealth.batch.assess import Machine, assess_all
from lmshealth.batch.store import Identified, Resources, Store, unpack_or_none
from lmshealth.batch.workers import Progress, processes
from lmshealth.life.health import Health
from lmshealth.life.prognosis import Prognosis
from lmshealth.machine.assessment import Assessment, assess
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.stage.description import Stage, load_stage
from lmshealth.tracking.maintenance import NO_MAINTENANCE
from studies.harness.cost import cpu_s, memory_bytes
from studies.harness.study import Row

NAME, EPOCHS, SEED = "AX-1", 40, 0


def machine_of(
    name: str,
    logs: Sequence[LogEstimates],
    stored: int,
    stage: Stage,
    store: Store,
    epochs: int = EPOCHS,
) -> Machine:
    """Return a machine with these logs, of which so many are in the store already; add the rest."""
    keys = [(log.log, fingerprint("key", log.digest)) for log in logs]
    new = zip(keys[stored:], logs[stored:], strict=True)
    packed = {key: pack(Identified(log, stage.digest, name)) for (_, key), log in new}
    store.put("identified", packed)
    return Machine(name, tuple(keys), stage, NO_MAINTENANCE, epochs, SEED)


def assess_and_report(
    machines: Sequence[Machine],
    store: Store,
    out: Path,
    workers: int = 1,
    progress: Progress = lambda step, done, total: None,
) -> None:
    """Assess machines and write their pages, as a run does; all must succeed."""
    with processes(workers) as pool:
        resources = Resources(store, pool, progress)
        assert not assess_all(machines, resources)
        _, failed, _ = running._report(machines, (), resources, out, running._judging())
    assert not failed


def run_with(
    logs: list[LogEstimates], stored: int, stage: Stage, store: Store, out: Path
) -> Assessment:
    """Assess the machine with some of its logs, and write its page."""
    machine = machine_of(NAME, logs, stored, stage, store)
    assess_and_report([machine], store, out)
    found = unpack_or_none(store.get("assessed", machine.key, NAME), Assessment)
    assert found is not None and found.prognosis is not None
    return found


def main() -> None:
    """Print costs, and what differs from a run from nothing, as JSON."""
    logs, stage = pickle.loads(Path(sys.argv[1]).read_bytes()), load_stage("lms-y")
    n = len(logs)
    kept: list[Assessment] = []
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        with closing(Store(f"sqlite:///{out / 'store.sqlite'}")) as store:
            parts = {"first": (logs[:-1], 0), "new": (logs, n - 1), "unchanged": (logs, n)}

            def update(own: list[LogEstimates], stored: int) -> None:
                kept.append(run_with(own, stored, stage, store, out))

            cost = {name: cpu_s(partial(update, *part)) for name, part in parts.items()}
    peak = memory_bytes() / 2**20
    fresh = assess(logs, stage, epochs=EPOCHS, seed=SEED)
    short = assess(logs[: 2 * n // 3], stage, epochs=EPOCHS, seed=SEED)
    print(json.dumps({"cpu_s": cost, "peak_mb": peak, **compared(kept[1], fresh, short)}))


def compared(updated: Assessment, fresh: Assessment, short: Assessment) -> Row:
    """Compare the answers after a new log with those from nothing, and with another life's."""
    return {
        "apart": apart(updated.prognosis, fresh.prognosis),
        "control_apart": apart(updated.prognosis, short.prognosis),
        "health_apart": health_apart(updated.health, fresh.health),
    }


def apart(one: Prognosis | None, other: Prognosis | None) -> float:
    """Return how far means of the remaining travel, up to the horizon, are apart in std errors."""
    assert one is not None and other is not None
    means, errors = [], []
    for found in (one, other):
        travel = np.minimum(found.remaining[:, -1], found.horizon)
        means.append(travel.mean())
        n = min(found.ess, travel.size)  # without wear the size of the sample has no bound
        # What no draw shows may have a probability of one effective draw.
        errors.append(max(travel.std() / np.sqrt(n), found.horizon / n))
    return float(abs(means[0] - means[1]) / np.hypot(*errors))


def health_apart(one: Health | None, other: Health | None) -> float:
    """Return how far means of any health parameter now are apart in standard errors."""
    assert one is not None and other is not None
    means = [found.samples[-1].mean(axis=0) for found in (one, other)]
    variances = [
        found.samples[-1].var(axis=0) / np.minimum(found.ess[-1], found.samples.shape[1])
        for found in (one, other)
    ]
    return float(np.max(np.abs(means[0] - means[1]) / np.sqrt(np.sum(variances, axis=0))))


if __name__ == "__main__":
    main()
