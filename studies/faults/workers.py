"""Does a batch on a Dask cluster survive the death of its workers?

Method
    A scheduler and two workers without nannies, and the command line with ``--scheduler``. A
    random worker is killed by `kill -9` at random moments (a Poisson process) and replaced, until
    ten were killed during batches; each batch begins with an empty store. Then the scheduler is
    killed during a run, and the next run uses a new cluster. Tables, pages and store must equal
    those of a run in one process. Control: see `kills`.
Answer
    Yes. Ten workers were killed in five batches, with 86 to all 195 logs stored: no line or row
    differs. A lost scheduler is reported in one line with status 1; the next run completes.
Run time
    Four to fifteen minutes.
"""

from __future__ import annotations

import random
import signal
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from studies.faults import driving
from studies.faults.driving import SOME_REFUSED, Reference
from studies.harness.claims import Claim, controls_seen
from studies.harness.servers import Cluster, dask_cluster, missing_distributed
from studies.harness.study import Row, Study

STEP = "batch"

SEED = 20261122
# Number of kills, and mean number in the time that a run takes.
WANTED, QUICK_WANTED = (10, 3.0), (1, 20.0)


def main() -> None:
    """Run the study; ``--quick`` does a small part and records nothing."""
    study = Study(__file__, __doc__)
    quick, once = study.quick, partial(study.trials.once, also=driving.PROGRAM)
    if why := missing_distributed():
        sys.exit(why)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        machines = {"WATCHED-A": 10} if quick else driving.MACHINES
        reference = driving.reference_of(folder, machines, quick=quick)
        with dask_cluster(1 if quick else 2) as cluster:
            work = partial(workers_killed, reference, cluster)
            killed = once(work, *(QUICK_WANTED if quick else WANTED))
        answer: Row = {
            "seed": SEED,
            "uninterrupted": {"seconds": round(reference.seconds, 1), "rows": reference.rows},
            "workers killed": killed,
            # A client waits long for its scheduler to come again.
            "scheduler lost": None if quick else once(partial(scheduler_lost, reference)),
            "control": driving.control(reference, folder),
        }
    answer["passed"] = {
        "as uninterrupted, workers killed": not killed["differences"],
        "no other end, workers killed": not killed["other_ends"],
        "the comparison sees what is wrong": all(answer["control"].values()),
    }
    if lost := answer["scheduler lost"]:
        reported = lost["status"] == 1 and driving.one_line(lost["messages"])
        answer["passed"] |= {
            "as uninterrupted, scheduler lost": not lost["differences"],
            "told in one line, scheduler lost": reported,
        }
    study.conclude(answer)


def workers_killed(reference: Reference, cluster: Cluster, n_kills: int, per_run: float) -> Row:
    """Kill workers of one batch after another until there were enough kills."""
    rng = random.Random(SEED)
    known: list[int] = []  # logs in the store at every kill
    found: Row = {"batches": 0, "differences": [], "other_ends": []}
    while len(known) < n_kills:
        with tempfile.TemporaryDirectory() as name:
            store, out = f"sqlite:///{name}/store.sqlite", Path(name) / "out"
            command = reference.command(out, store, "--scheduler", cluster.address)
            with driving.running(command) as run:
                run.begun(store)
                while len(known) < n_kills:
                    wait_s = rng.expovariate(per_run / reference.seconds)
                    if run.status(wait_s) is not None:
                        break
                    cluster.replace_worker(rng)
                    known.append(driving.rows(store).get("identified", 0))
                if (status := run.status()) != SOME_REFUSED:
                    found["other_ends"].append(f"{status}: {run.messages()[-3:]}")
                    driving.completed(command)
            found["differences"] += reference.judge(out, store)
            found["batches"] += 1
    return found | {"n": n_kills, "logs_known_at_kill": known}


def scheduler_lost(reference: Reference) -> Row:
    """Kill the scheduler in the middle of a run, and go on with another."""
    rng = random.Random(SEED)
    with tempfile.TemporaryDirectory() as name:
        store, out = f"sqlite:///{name}/store.sqlite", Path(name) / "out"
        with (
            dask_cluster() as cluster,
            driving.running(reference.command(out, store, "--scheduler", cluster.address)) as run,
        ):
            run.begun(store)
            run.status(rng.uniform(0, 0.5) * reference.seconds)
            cluster.scheduler.send_signal(signal.SIGKILL)
            status, messages = run.status(), run.messages()
        with dask_cluster() as cluster:
            driving.completed(reference.command(out, store, "--scheduler", cluster.address))
        return {"status": status, "messages": messages, "differences": reference.judge(out, store)}


def claims(answer: Row) -> Iterator[Claim]:
    """Claim the same of workers of a cluster, and of its scheduler."""
    row, passed = answer["workers killed"], answer["passed"]
    wrong = len(row["differences"]) + len(row["other_ends"])
    yield Claim(
        "differences from an uninterrupted run after workers were killed",
        f"{wrong} in {row['n']} kills, {row['batches']} batches",
        "",
        controls_seen(answer["control"]),
        wrong == 0,
    )
    if lost := answer["scheduler lost"]:
        fine = all(
            passed[f"{what}, scheduler lost"] for what in ("as uninterrupted", "told in one line")
        )
        yield Claim(
            "the same after the scheduler was lost",
            str(len(lost["differences"])),
            "",
            "reported in one line" if fine else "not reported in one line",
            fine,
        )


if __name__ == "__main__":
    main()
