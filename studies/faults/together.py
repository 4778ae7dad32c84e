"""Do two simultaneous runs on one store disturb each other?

Method
    Two command lines with output folders of their own on one SQLite file or PostgreSQL database,
    started together or one at a random moment after the other: on the same logs, on those of other
    machines, on the same and some more; and again with one killed by `kill -9`. Each must give the
    tables and pages that it gives alone, and every log must be stored once. With different numbers
    of logs pages are left out, because their changes depend on which run ends first. Control: see
    `kills`.
Answer
    No. All 36 pairs, 18 on either store, end as each run alone; in 18 of them one was killed.
Run time
    Half an hour on one processor.
"""

from __future__ import annotations

import random
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from studies.faults import driving
from studies.faults.driving import SOME_REFUSED, Reference, Stores
from studies.harness.claims import Claim
from studies.harness.study import Row, Study

STEP = "batch"

SEED = 20261122
# Logs of the first run, of other machines, and some more of the same machines.
FIRST = {"WORN-A": 12, "WATCHED-A": 28}
BATCHES = (FIRST, {"WORN-B": 12, "WATCHED-B": 28}, {"WORN-A": 14, "WATCHED-A": 30})
N_PAIRS = 3

# The second run of a pair is the first once more, or one of the others.
OTHERS, KILLED = ("same", "other", "more"), ", one killed"
WAYS = tuple(f"{logs} logs{kill}" for logs in OTHERS for kill in ("", KILLED))
QUICK_WAYS = {"sqlite": (f"same logs{KILLED}",)}  # the other kind is in that of `kills`


def main() -> None:
    """Run the study; ``--quick`` does a small part and records nothing."""
    study = Study(__file__, __doc__)
    quick, once = study.quick, partial(study.trials.once, also=driving.PROGRAM)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        alone = [
            driving.reference_of(folder / str(k), machines, quick=quick)
            for k, machines in enumerate([{"WATCHED-A": 6}] if quick else BATCHES)
        ]
        answer: Row = {"seed": SEED, "pairs": {}}
        with driving.backends(folder) as kinds:
            for kind, new_store in kinds.items():
                ways = QUICK_WAYS.get(kind, ()) if quick else WAYS
                of_kind = partial(pairs, alone, new_store, quick)
                answer["pairs"][kind] = {
                    way: once(of_kind, kind, way, 1 if quick else N_PAIRS) for way in ways
                }
                print(kind, answer["pairs"][kind], file=sys.stderr, flush=True)
    answer["passed"] = {
        f"{what}, {kind}": not found["wrong"]
        for kind, cases in answer["pairs"].items()
        for what, found in cases.items()
    }
    study.conclude(answer)


@dataclass(frozen=True)
class Pair:
    """Two runs and what each makes alone; the logs of the second are the same, other, or more."""

    first: Reference
    second: Reference
    logs: str

    def rows(self) -> dict[str, int]:
        """Count what a store holds after both; of more logs, the tables whose size is known."""
        one, two = self.first.rows, self.second.rows
        if self.logs == "other":
            return {name: one[name] + two[name] for name in one}
        known = two if self.logs == "same" else ("identified", "present")
        return {name: two[name] for name in known}

    def wrong(self, store: str, outs: Sequence[Path]) -> list[str]:
        """List what is not as in a run alone."""
        found = []
        for reference, out in zip((self.first, self.second), outs, strict=True):
            lines = driving.differences(reference.out, out)
            found += [line for line in lines if self.logs != "more" or ".csv:" in line]
        full, now = self.rows(), driving.rows(store)
        if any(now.get(name) != n for name, n in full.items()):
            found.append(f"store: {now} rows, not {full}")
        return found


def pairs(
    alone: list[Reference], new_store: Stores, quick: bool, kind: str, way: str, n: int
) -> Row:
    """Run two at once, n times in a way."""
    rng = random.Random(f"{SEED} {kind} {way}")
    logs = way.split()[0]
    pair = Pair(alone[0], alone[OTHERS.index(logs)], logs)
    # Every second pair is started together, the others one after the other.
    gaps = [rng.uniform(0, pair.first.seconds) if k % 2 else 0.0 for k in range(n)]
    kill = way.endswith(KILLED)
    wrong = [
        line for gap in gaps for line in one_pair(pair, new_store, gap, kill, rng, quick=quick)
    ]
    return {"n": n, "wrong": wrong}


def one_pair(
    pair: Pair, new_store: Stores, gap: float, kill: bool, rng: random.Random, *, quick: bool
) -> list[str]:
    """Run two at once, the second a gap (s) later; list what is not as in a run alone."""
    found: list[str] = []
    with new_store() as store, tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        outs = [Path(name) / "first", Path(name) / "second"]
        commands = [
            reference.command(out, store)
            for reference, out in zip((pair.first, pair.second), outs, strict=True)
        ]
        first = stack.enter_context(driving.running(commands[0]))
        first.status(gap)
        second = stack.enter_context(driving.running(commands[1]))
        if kill:
            second.status(rng.uniform(0.2, 1.0) * pair.second.seconds)
            second.kill("main", rng)
        ends = [first.status(), second.status()]
        if ends[0] != SOME_REFUSED or (ends[1] != SOME_REFUSED and not kill):
            found.append(f"ended with {ends}: {first.messages()[-3:]}, {second.messages()[-3:]}")
        if kill:
            driving.completed(commands[1], quick=quick)
        return found + pair.wrong(store, outs)


def claims(answer: Row) -> Iterator[Claim]:
    """Claim that two runs at once leave what they leave alone."""
    for kind, ways in answer["pairs"].items():
        wrong = sum(bool(row["wrong"]) for row in ways.values())
        yield Claim(
            f"ways of running two at once that leave what each leaves alone ({kind})",
            f"{len(ways) - wrong} of {len(ways)}",
            f"{min(row['n'] for row in ways.values())} pairs each",
            "half of them with one killed",
            wrong == 0,
        )


if __name__ == "__main__":
    main()
