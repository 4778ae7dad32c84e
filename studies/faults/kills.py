"""Does a batch that is killed repeatedly end as if it had not been interrupted?

Method
    The command line over 200 logs with two worker processes, on SQLite and on PostgreSQL. Kills
    come by a Poisson process: `kill -9` of the main process or of a worker, SIGINT or SIGTERM to
    the group. A completed run is compared with an uninterrupted one: tables and pages row by row,
    every log once in the store, no remaining process, one line per interrupt. The next run begins
    with an empty store, up to 100 kills. Control: the comparison must detect a row doubled, lost
    or moved, a digit changed, a page changed or lost.
Answer
    Yes. After 100 kills on either store (101 of the main process, 33 of a worker, 35 SIGINT, 31
    SIGTERM, in all phases) fifteen batches ended without a different line or row; the last process
    of a killed run ended within 5.3 s. All 35 interrupts were reported in one line; during the
    first half second, while Python imports, its own message is possible.
Run time
    Half an hour.
"""

from __future__ import annotations

import random
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from studies.faults.driving import (
    ENDED_S,
    MACHINES,
    PROGRAM,
    SOME_REFUSED,
    Reference,
    Stores,
    backends,
    control,
    make_batch,
    one_line,
    reference_of,
    rows,
    running,
)
from studies.harness.claims import Claim
from studies.harness.study import Row, Study, Trials

STEP = "batch"

SEED = 20261122
QUICK_MACHINES = {"WATCHED-A": 4}
N_KILLS, QUICK_KILLS = 100, 1
HOWS = {"main": 0.5, "worker": 0.2, "SIGINT": 0.15, "SIGTERM": 0.15}
QUICK_HOWS = {"main": 1.0}
ENDS = {"main": -signal.SIGKILL, "SIGTERM": -signal.SIGTERM}
IMPORTED_S = 2.0  # by then Python has imported what a run needs; before, it interrupts its own way
MOST_OTHER = 20  # runs that end otherwise, before it is of no use to go on
PER_RUN, QUICK_PER_RUN = 5.0, 10.0  # kills in the mean, over the time that a run takes


def main() -> None:
    """Run the study; ``--quick`` kills one small run, in PostgreSQL if it is there; no record."""
    study = Study(__file__, __doc__)
    quick = study.quick
    wanted = (QUICK_KILLS, QUICK_PER_RUN, QUICK_HOWS) if quick else (N_KILLS, PER_RUN, HOWS)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        batch = make_batch(folder, *((QUICK_MACHINES, 1) if quick else (MACHINES, 2)))
        reference = reference_of(batch, folder / "reference", quick=quick)
        answer: Row = {
            "seed": SEED,
            "logs": len(list(batch.logs.rglob("*.h5"))),
            "uninterrupted": {"seconds": round(reference.seconds, 1), "rows": reference.rows},
            "kills": {},
        }
        with backends(folder) as kinds:
            # Both kinds are in the quick form of `together`.
            for kind, new_store in list(kinds.items())[-1 if quick else 0 :]:
                work = partial(killed, reference, new_store, *wanted[1:])
                answer["kills"][kind] = until_enough(study.trials, work, kind, wanted[0])
                print(kind, answer["kills"][kind], file=sys.stderr, flush=True)
        answer["control"] = control(reference, folder)
    answer["passed"] = verdicts(answer)
    study.conclude(answer)


def verdicts(answer: Row) -> dict[str, bool]:
    """Return the checks."""
    passed = {"the comparison sees what is wrong": all(answer["control"].values())}
    for kind, found in answer["kills"].items():
        passed[f"as uninterrupted, {kind}"] = not found["differences"]
        passed[f"no process left, {kind}"] = found["slowest_end_s"] <= ENDED_S
        passed[f"no other end, {kind}"] = not found["other_ends"]
        passed[f"interrupts told in one line, {kind}"] = all(
            other["after_s"] <= IMPORTED_S for other in found["interrupts"]["others"]
        )
    return passed


# Kills


def until_enough(trials: Trials, work: Callable[..., Row], kind: str, n: int) -> Row:
    """Kill runs of one batch after another until there were enough kills."""
    batches: list[Row] = []
    while (left := n - sum(len(own["kills"]) for own in batches)) > 0:
        batches.append(trials.once(work, kind, len(batches), left, also=PROGRAM))
    kills = [kill for own in batches for kill in own["kills"]]
    interrupts = [kill for kill in kills if kill["how"] == "SIGINT"]
    return {
        "batches": len(batches),
        "differences": [line for own in batches for line in own["differences"]],
        "other_ends": [line for own in batches for line in own["other_ends"]],
        "n": n,
        "how": dict(Counter(kill["how"] for kill in kills)),
        "when": dict(Counter(kill["when"] for kill in kills)),
        "interrupts": {
            "told_in_one_line": sum(kill["told"] for kill in interrupts),
            "others": [kill for kill in interrupts if not kill["told"]],
        },
        "slowest_end_s": max(kill["gone_s"] for kill in kills),
    }


def killed(
    reference: Reference,
    new_store: Stores,
    per_run: float,
    hows: dict[str, float],
    kind: str,
    number: int,
    n: int,
) -> Row:
    """Kill runs of a batch, at most so many, until it has come to its end."""
    kills = Kills([], n, per_run, hows, random.Random(f"{SEED} {kind} {number}"))
    other_ends: list[str] = []
    with new_store() as store, tempfile.TemporaryDirectory() as name:
        out = Path(name) / "out"
        while not run_killed(reference, store, out, kills, other_ends):
            pass
        differences = reference.judge(out, store)
    return {"kills": kills.done, "differences": differences, "other_ends": other_ends}


@dataclass(frozen=True)
class Kills:
    """Kills that were; how many there shall be, how many per run, and in which ways."""

    done: list[Row]
    n: int
    per_run: float
    hows: dict[str, float]
    rng: random.Random

    def next(self, seconds: float) -> tuple[float, str]:
        """Draw how long (s) to wait for the next, in a run that takes so long, and its way."""
        wait_s = self.rng.expovariate(self.per_run / seconds)
        return wait_s, self.rng.choices(list(self.hows), list(self.hows.values()))[0]


def run_killed(
    reference: Reference, store: str, out: Path, kills: Kills, other_ends: list[str]
) -> bool:
    """Start a run and kill it when the time comes; return whether it completed."""
    how = ""
    begun = time.monotonic()
    with running(reference.batch.command(out, store)) as run:
        while len(kills.done) < kills.n:
            wait_s, wish = kills.next(reference.seconds)
            if run.status(wait_s) is not None:
                break
            if not run.kill(wish, kills.rng):
                continue
            how = wish
            after_s = round(time.monotonic() - begun, 2)
            kill = {"how": how, "after_s": after_s, "when": when(reference, store, out),
                    "gone_s": 0.0}  # fmt: skip
            kills.done.append(kill)
            if how != "worker":  # a run may survive the loss of a worker
                kill["gone_s"] = round(run.gone_after(), 2)
                break
        status, messages = run.status(), run.messages()
    if how == "SIGINT":
        kills.done[-1] |= {
            "told": one_line(messages),
            "lines": len(messages),
            "last": messages[-1:],
        }
    elif status != SOME_REFUSED and status != ENDS.get(how) and not (how and one_line(messages)):
        other_ends.append(f"{how or 'not killed'}: {status}: {messages[-3:]}")
        if len(other_ends) > MOST_OTHER:
            raise RuntimeError(f"the batch does not come to its end: {other_ends}")
    return status == SOME_REFUSED


def when(reference: Reference, store: str, out: Path) -> str:
    """Say from the store how far a run was."""
    now, full = rows(store), reference.rows
    if not now.get("identified"):
        return "before the first log was kept"
    if now["identified"] < full["identified"]:
        return "among the logs"
    if now["assessed"] < full["assessed"]:
        return "among the machines"
    return "among the tables" if not (out / "index.html").exists() else "at the end"


def claims(answer: Row) -> Iterator[Claim]:
    """Claim that batches whose runs are killed end as if nothing had happened."""
    for kind, row in answer["kills"].items():
        wrong = len(row["differences"]) + len(row["other_ends"])
        yield Claim(
            f"what is not as uninterrupted after kills at random moments ({kind})",
            f"{wrong} in {row['n']} kills, {row['batches']} batches",
            f"slowest end {row['slowest_end_s']:.0f} s",
            _control(answer),
            wrong == 0,
        )


def _control(answer: Row, name: str = "control") -> str:
    found = answer[name].values()
    return f"{sum(map(bool, found))} of {len(found)} controls are seen"


if __name__ == "__main__":
    main()
