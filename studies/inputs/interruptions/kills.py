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
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from studies.harness.claims import Claim, controls_seen
from studies.harness.study import Row, Study
from studies.inputs.interruptions import driving
from studies.inputs.interruptions.driving import Reference, Stores, one_line

SEED = 20261122
HOWS = {"main": 0.5, "worker": 0.2, "SIGINT": 0.15, "SIGTERM": 0.15}
# Number of kills, mean number in the time that a run takes, and shares of their kinds.
WANTED, QUICK_WANTED = (100, 5.0, HOWS), (1, 10.0, {"main": 1.0})
ENDS = {"main": -signal.SIGKILL, "SIGTERM": -signal.SIGTERM}
IMPORTED_S = 2.0  # before, while Python imports, it reports an interrupt in its own way
MOST_OTHER = 20  # other ends of runs before the study is given up


def main() -> None:
    """Run the study; ``--quick`` kills one small run, in PostgreSQL if it is there; no record."""
    study = Study(__file__, __doc__)
    quick = study.quick
    n, per_run, hows = QUICK_WANTED if quick else WANTED
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        machines = {"WATCHED-A": 4} if quick else driving.MACHINES
        reference = driving.reference_of(folder, machines, quick=quick)
        answer: Row = {
            "seed": SEED,
            "logs": sum(machines.values()),
            "uninterrupted": {"seconds": round(reference.seconds, 1), "rows": reference.rows},
            "kills": {},
        }
        with driving.backends(folder) as kinds:
            # The quick form takes one of them, PostgreSQL where it is there.
            for kind, new_store in list(kinds.items())[-1 if quick else 0 :]:
                work = partial(killed, reference, new_store, per_run, hows)
                batches: list[Row] = []
                while (left := n - sum(len(own["kills"]) for own in batches)) > 0:
                    task = (kind, len(batches), left)
                    batches.append(study.trials.once(work, *task, also=driving.PROGRAM))
                answer["kills"][kind] = summary(batches, n)
                print(kind, answer["kills"][kind], file=sys.stderr, flush=True)
        answer["control"] = driving.control(reference, folder)
    answer["passed"] = verdicts(answer)
    study.conclude(answer)


def verdicts(answer: Row) -> dict[str, bool]:
    """Return the checks."""
    passed = {"the comparison sees what is wrong": all(answer["control"].values())}
    for kind, found in answer["kills"].items():
        passed[f"as uninterrupted, {kind}"] = not found["differences"]
        passed[f"no process left, {kind}"] = found["slowest_end_s"] <= driving.ENDED_S
        passed[f"no other end, {kind}"] = not found["other_ends"]
        passed[f"interrupts told in one line, {kind}"] = all(
            other["after_s"] <= IMPORTED_S for other in found["interrupts"]["others"]
        )
    return passed


def summary(batches: list[Row], n: int) -> Row:
    """Summarise the kills of all batches."""
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
    reference: Reference, new_store: Stores, per_run: float, hows: dict[str, float],
    kind: str, number: int, n: int,
) -> Row:  # fmt: skip
    """Kill runs of a batch, at most so many, until it is completed."""
    rng = random.Random(f"{SEED} {kind} {number}")

    def draw() -> tuple[float, str] | None:
        """Draw the time in s to the next kill, and its kind; None if there were enough."""
        if len(kills) == n:
            return None
        wait_s = rng.expovariate(per_run / reference.seconds)
        return wait_s, rng.choices(list(hows), list(hows.values()))[0]

    kills: list[Row] = []
    other_ends: list[str] = []
    with new_store() as store, tempfile.TemporaryDirectory() as name:
        out, status = Path(name) / "out", None
        while status != driving.SOME_REFUSED:
            begun = time.monotonic()
            with driving.running(reference.command(out, store)) as run:
                how = ""
                # A run may survive the loss of a worker.
                while how in ("", "worker") and (drawn := draw()) and run.status(drawn[0]) is None:
                    if not run.kill(drawn[1], rng):
                        continue
                    how, after_s = drawn[1], round(time.monotonic() - begun, 2)
                    kills.append({"how": how, "after_s": after_s,
                                  "when": when(reference, store, out),
                                  "gone_s": 0.0 if how == "worker"
                                  else round(run.gone_after(), 2)})  # fmt: skip
                status, messages = run.status(), run.messages()
            if how == "SIGINT":
                kills[-1] |= {
                    "told": one_line(messages),
                    "lines": len(messages),
                    "last": messages[-1:],
                }
            elif not (
                status in (driving.SOME_REFUSED, ENDS.get(how)) or (how and one_line(messages))
            ):
                other_ends.append(f"{how or 'not killed'}: {status}: {messages[-3:]}")
                if len(other_ends) > MOST_OTHER:
                    raise RuntimeError(f"the batch does not come to its end: {other_ends}")
        differences = reference.judge(out, store)
    return {"kills": kills, "differences": differences, "other_ends": other_ends}


def when(reference: Reference, store: str, out: Path) -> str:
    """Return the phase of a run from its store."""
    now, full = driving.rows(store), reference.rows
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
            f"differences from an uninterrupted run after kills at random moments ({kind})",
            f"{wrong} in {row['n']} kills, {row['batches']} batches",
            f"slowest end {row['slowest_end_s']:.0f} s",
            controls_seen(answer["control"]),
            wrong == 0,
        )


if __name__ == "__main__":
    main()
