"""What does a new log of every machine cost, with the priors that young machines take from others?

Method
    A fleet of stages Y from estimates as identified, two of three healthy, in one store, by two
    worker processes. Four runs of what `run` does after identification: all logs but the last two,
    one more log of every machine, one more of one machine, and nothing new. The evidence of each
    moves the prior of machines whose own logs constrain their wear little, whose lives are then
    sampled again. Times are of all processes, and are reckoned for 1,000 machines. The remaining
    travel is compared with that of lives fitted from nothing under the same prior. Control, which
    must fail: the remaining travel by the description alone.
Run time
    Four minutes on two processors.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

from lmshealth import load_stage
from lmshealth._private.serialize import seed_of
from lmshealth.batch.assess import Machine
from lmshealth.batch.store import Store, unpack_or_none
from lmshealth.life.prognosis import prognose
from lmshealth.machine.assessment import Assessment
from lmshealth.modal.log_estimates import LogEstimates
from lmshealth.stage.description import Stage
from lmshealth.tracking.track import accepted_estimates
from studies.cost.archive import Steps
from studies.cost.new_log.life import EPOCHS, apart, assess_and_report, machine_of
from studies.cost.new_log.run import readings
from studies.harness.claims import Claim, number
from studies.harness.command_line import no_pictures, quick_posteriors
from studies.harness.study import Row, Study

KINDS = ("healthy", "both", "temperature-only")
MACHINES, LOGS, QUICK_MACHINES, QUICK_LOGS = 12, 60, 4, 5
WORKERS, FLEET = 2, 1000
# Machines whose lives are fitted from nothing for the comparison.
COMPARED = 4
# Asked: of a new log of every machine over the first run, and of nothing new.
MOST_NEW, MOST_UNCHANGED, MOST_APART = 0.3, 0.05, 4.0
NOT_MET = {
    "a new log of each": "half of it are the pages, all of which change and are drawn again",
}


@dataclass(frozen=True)
class Nights:
    """Runs of a fleet, one after the other, in one store."""

    fleet: Mapping[str, list[LogEstimates]]
    store: Store
    out: Path
    stage: Stage
    epochs: int
    workers: int

    def machine(self, name: str, n: int, stored: int | None = None) -> Machine:
        """Return a machine with its first logs, of which so many (or all) are stored already."""
        logs, stored = self.fleet[name][:n], n if stored is None else stored
        return machine_of(name, logs, stored, self.stage, self.store, self.epochs)

    def run(self, counts: Mapping[str, int], stored: Mapping[str, int]) -> Row:
        """Assess the fleet with some logs of each machine, of which some are stored; the costs."""
        steps, cpu = Steps(time.perf_counter), _cpu_s()
        jobs = [self.machine(name, counts[name], stored[name]) for name in self.fleet]
        assess_and_report(jobs, self.store, self.out, self.workers, steps)
        steps("ended", 0, 0)
        spent = {"wall_s": sum(steps.seconds.values()), "cpu_s": _cpu_s() - cpu}
        return {name: round(value, 2) for name, value in (spent | steps.seconds).items()}

    def compared(self, counts: Mapping[str, int], n: int) -> list[Row]:
        """Compare some lives by the prior of the fleet with those fitted from nothing under it."""
        rows: list[Row] = []
        for one in self.store.published():
            own = unpack_or_none(self.store.get("assessed", one.key, one.machine), Assessment)
            if own.fleet is None or len(rows) == n:
                continue
            key = self.machine(one.machine, counts[one.machine]).key
            alone = unpack_or_none(self.store.get("assessed", key, one.machine), Assessment)
            history = accepted_estimates(own.history, own.track)
            stage = own.fleet.apply_to(own.stage)
            fresh = prognose(history, stage, seed_of(own.seed + 1, history.stage, stage.digest))
            off, control = apart(own.prognosis, fresh), apart(own.prognosis, alone.prognosis)
            rows.append({"machine": one.machine, "apart": off, "control_apart": control})
        return rows


def _cpu_s() -> float:
    """Return the processor time of this process and of its children that ended."""
    return sum(os.times()[:4])


def nights(n_machines: int, n_logs: int, epochs: int, n_compared: int, workers: int) -> Row:
    """Run a fleet as often as the module's docstring has it."""
    fleet = {
        f"AX-{k}": [
            replace(log, metadata=replace(log.metadata, stage=f"AX-{k}"))
            for log in readings(n_logs, KINDS[k % len(KINDS)], k)
        ]
        for k in range(n_machines)
    }
    counts = [dict.fromkeys(fleet, n) for n in (0, n_logs - 2, n_logs - 1)]
    counts += [counts[-1] | {"AX-0": n_logs}] * 2
    with tempfile.TemporaryDirectory() as name:
        out = Path(name)
        with closing(Store(f"sqlite:///{out / 'store.sqlite'}")) as store:
            own = Nights(fleet, store, out, load_stage("lms-y"), epochs, workers)
            names = ("first", "a new log of each", "a new log of one", "nothing new")
            runs = {
                name: own.run(now, before)
                for name, (before, now) in zip(names, pairwise(counts), strict=True)
            }
            return {"runs": runs, "compared": own.compared(counts[-1], n_compared)}


def main() -> None:
    """Run the study; ``--quick`` takes a small fleet of short histories and records nothing."""
    study = Study(__file__, __doc__)
    also = ("studies.cost.new_log.run",)
    if study.quick:
        with quick_posteriors(), no_pictures():
            found = study.trials.once(nights, QUICK_MACHINES, QUICK_LOGS, 1, 1, 1, also=also)
    else:
        found = study.trials.once(nights, MACHINES, LOGS, EPOCHS, COMPARED, WORKERS, also=also)
    runs, compared = found["runs"], found["compared"]
    cpu = {name: row["cpu_s"] for name, row in runs.items()}
    answer = found | {
        "machines": QUICK_MACHINES if study.quick else MACHINES,
        "logs": QUICK_LOGS if study.quick else LOGS,
        "passed": {
            "a new log of each": cpu["a new log of each"] <= MOST_NEW * cpu["first"],
            "nothing new": cpu["nothing new"] <= MOST_UNCHANGED * cpu["first"],
            "some take the prior of the fleet": bool(compared),
            "lives are those from nothing": all(row["apart"] < MOST_APART for row in compared),
            "lives by the description differ": any(
                row["control_apart"] > MOST_APART for row in compared
            ),
        },
    }
    study.conclude(answer, not_met=NOT_MET, quick_may_fail=True)


def claims(record: Row) -> Iterator[Claim]:
    """Claim what a night costs, and that lives are those of a run from nothing."""
    passed = record["passed"]
    times = FLEET / record["machines"] / 3600
    first = record["runs"]["first"]
    for name, row in record["runs"].items():
        yield Claim(
            f"{FLEET:,} machines of {record['logs']} logs, {name}"
            + (f" in {record['machines']}" if name == "a new log of one" else "")
            + f", on {WORKERS} processors",
            f"{number(times * row['wall_s'])} h",
            "",
            f"reckoned from {record['machines']} machines; {number(row['cpu_s'] / first['cpu_s'])} "
            "of the processor time of the first run",
            met=passed.get(name, True),
        )
    yield Claim(
        "mean remaining travel, by the fleet's prior and from nothing, apart in standard errors",
        ", ".join(number(row["apart"]) for row in record["compared"]),
        beside="by the description alone "
        + ", ".join(number(row["control_apart"]) for row in record["compared"]),
        met=passed["lives are those from nothing"] and passed["lives by the description differ"],
    )


if __name__ == "__main__":
    main()
