"""How much faster do two workers, or two computers, identify an archive than one worker?

Method
    An archive of short logs, each case with an empty store: workers in processes, on a Dask
    cluster, and two runs of one worker each that share a PostgreSQL store, as two computers do.
    Rate is that between the first log identified and the last. The bound is measured in the same
    turn: bare processes identify the same logs, because the processors of a shared machine are
    seldom whole. What the main process does serially is its processor time per log.
Run time
    Five minutes of two processors.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import numpy as np

from lmshealth import Settings, identify, load_stage, read_log, run
from studies.cost.archive import make_archive
from studies.harness.claims import Claim
from studies.harness.command_line import no_pictures
from studies.harness.servers import dask_cluster, postgres
from studies.harness.study import Row, Study, spawn_pool

NOT_MET = {
    "local: at most 1 ms per log": (
        "a time on a shared machine: the day before it was 0.82 ms, and that of Dask 1.7 times less"
    ),
    "dask: at most 1 ms per log": "most of it is the client's work on each task",
}

N_LOGS, QUICK_LOGS, TURNS, N = 160, 4, 2, 2
# Of the bound that the machine gives in the same turn; most processor time of the main process in
# ms per log.
OF_BOUND, SERIAL_MS = 0.9, 1.0
_BARE, _QUICK_BARE = 80, 2  # identifications of all processes of the bound
_KINDS = {"local": "two processes", "dask": "two workers of Dask", "runs": "two runs on one server"}


class Clock:
    """Measures rate (logs per s) and processor time (s) by the steps of a run."""

    def __init__(self) -> None:
        self.moments: dict[str, list[tuple[float, float, int]]] = {}

    def __call__(self, what: str, done: int, total: int) -> None:
        """Keep the moment of a report of progress."""
        moment = time.perf_counter(), time.process_time(), done
        self.moments.setdefault(what, []).append(moment)

    def rate(self) -> float:
        """Return logs per s, from the first that is identified to the last."""
        after_start = [moment for moment in self.moments["identifying"] if moment[-1]]
        wall, _, n = np.subtract(after_start[-1], after_start[0])
        return float(n / wall)

    def serial_ms(self, *steps: str) -> float:
        """Return the processor time of this process per log, over some steps."""
        spent = [np.subtract(self.moments[step][-1], self.moments[step][0]) for step in steps]
        return float(1e3 * sum(cpu / n for _, cpu, n in spent))


def identified(folder: Path, settings: Settings) -> Clock:
    """Analyse an archive with an empty store."""
    clock = Clock()
    with tempfile.TemporaryDirectory(dir=folder) as out:
        run(folder / "logs", [load_stage(str(folder / "stage.toml"))], Path(out), settings, clock)
    return clock


def _again_and_again(folder: Path, n: int) -> float:
    """Read and identify so many of a few logs without anything around it; logs per second."""
    stage = load_stage(str(folder / "stage.toml"))
    logs = sorted((folder / "logs").rglob("*.h5"))[:8]
    begin = time.perf_counter()
    for k in range(n):
        identify(read_log(logs[k % len(logs)]), stage)
    return n / (time.perf_counter() - begin)


def bare(folder: Path, n: int, each: int) -> float:
    """Return what one or two processes identify in a second by themselves, each so many logs."""
    if n == 1:  # this one, which nothing else keeps busy
        return _again_and_again(folder, each)
    with spawn_pool(n) as pool:
        list(pool.map(_again_and_again, [folder] * n, [1] * n))  # imports before the clock runs
        return sum(pool.map(_again_and_again, [folder] * n, [each] * n))


def _one_run(folder: Path, store: str) -> tuple[float, float, int]:
    """Do one of several runs on a store; return begin and end (s) and its number of new logs."""
    clock, stage = Clock(), load_stage(str(folder / "stage.toml"))
    with tempfile.TemporaryDirectory() as out:
        result = run(folder / "logs", [stage], Path(out), Settings(store=store), clock)
    moments = clock.moments["identifying"]
    return moments[0][0], moments[-1][0], result.n_logs - result.n_remembered


def two_runs(folder: Path) -> tuple[float, int]:
    """Start two runs on one server; return their rate in logs per s, and the logs identified."""
    with postgres() as server, server.database() as store, spawn_pool(2) as pool:
        list(pool.map(_again_and_again, [folder] * 2, [1] * 2))
        begins, ends, new = zip(*pool.map(_one_run, [folder] * 2, [store] * 2), strict=True)
    return sum(new) / (max(ends) - min(begins)), sum(new)


def one_turn(folder: Path, kinds: tuple[str, ...], each: int, _: int) -> Row:
    """Measure everything once: rates of one and of two, the bound by so many identifications."""
    found: Row = {"bound": [bare(folder, n, max(each // n, 2)) for n in (1, N)], "serial_ms": {}}
    clocks = {"local": [identified(folder, Settings(workers=n)) for n in (1, N)]}
    if "dask" in kinds:
        clocks["dask"] = []
        for n in (1, N):
            with dask_cluster(n) as cluster:
                clocks["dask"].append(identified(folder, Settings(scheduler=cluster.address)))
    for kind, own in clocks.items():
        found[kind] = [clock.rate() for clock in own]
        found["serial_ms"][kind] = own[-1].serial_ms("reading", "identifying")
    if "runs" in kinds:
        rate, found["identified"] = two_runs(folder)
        found["runs"] = [found["local"][0], rate]
    return found


def main() -> None:
    """Run the study; ``--quick`` does a small archive and records nothing."""
    study = Study(__file__, __doc__)
    quick = study.quick
    # Batches on Dask have tests of their own.
    kinds = ("local",) if quick else tuple(_KINDS)
    n_logs = QUICK_LOGS if quick else N_LOGS
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_archive(folder, n_logs)
        work = partial(one_turn, folder, kinds, _QUICK_BARE if quick else _BARE)
        with no_pictures() if quick else nullcontext():
            turns = study.trials.collect(work, [(k,) for k in range(1 if quick else TURNS)])
    answer = judged(turns, kinds)
    answer |= {"logs": n_logs, "turns": len(turns), "processors": os.cpu_count()}
    answer["passed"] |= {
        "no log is identified twice": all(t.get("identified", n_logs) == n_logs for t in turns)
    }
    # Of a small archive the start of the second worker is most of the time.
    study.conclude(answer, not_met=NOT_MET, quick_may_fail=True)


def _range(values: list[float]) -> list[float]:
    return [round(float(value), 3) for value in np.quantile(values, (0, 0.5, 1))]


def judged(turns: list[Row], kinds: tuple[str, ...]) -> Row:
    """Return gains over one worker and over the bound (least, median, most), and checks."""
    gains = {kind: [t[kind][1] / t[kind][0] for t in turns] for kind in ("bound", *kinds)}
    # More than the processors is the clock's noise.
    bound = [min(gain, N, os.cpu_count() or 1) for gain in gains.pop("bound")]
    answer: Row = {
        "bound": _range(bound),
        "gain": {kind: _range(own) for kind, own in gains.items()},
        "of the bound": {
            kind: _range([gain / most for gain, most in zip(own, bound, strict=True)])
            for kind, own in gains.items()
        },
        "serial_ms": {
            kind: _range([t["serial_ms"][kind] for t in turns]) for kind in turns[0]["serial_ms"]
        },
    }
    passed = {f"{kind}: {OF_BOUND:g} of the bound": own[1] >= OF_BOUND
              for kind, own in answer["of the bound"].items()}  # fmt: skip
    passed |= {f"{kind}: at most 1 ms per log": own[1] <= SERIAL_MS
               for kind, own in answer["serial_ms"].items()}  # fmt: skip
    return answer | {"passed": passed}


def claims(answer: Row) -> Iterator[Claim]:
    """Claim how much faster workers and runs are than one."""
    passed = answer["passed"]
    low, middle, high = answer["bound"]
    for kind, (least, median, most) in answer["gain"].items():
        yield Claim(
            f"{_KINDS[kind]} identify an archive, over one",
            f"{median:.2f} times",
            f"{least:.2f} to {most:.2f} in {answer['turns']} turns",
            f"two bare processes {middle:.2f} ({low:.2f} to {high:.2f}) on "
            f"{answer['processors']} processors; {answer['of the bound'][kind][1]:.2f} of the "
            f"bound, {OF_BOUND:g} required",
            passed[f"{kind}: {OF_BOUND:g} of the bound"],
        )
    for kind, (least, median, most) in answer["serial_ms"].items():
        yield Claim(
            f"processor time of the main process per log, {_KINDS[kind]}",
            f"{median:.2f} ms",
            f"{least:.2f} to {most:.2f}",
            f"at most {SERIAL_MS:g} ms required",
            passed[f"{kind}: at most 1 ms per log"],
        )
    if "runs" in answer["gain"]:
        yield Claim(
            "logs that two runs on one server both identify",
            "0" if passed["no log is identified twice"] else "some",
            f"of {answer['logs']} in {answer['turns']} turns",
            met=passed["no log is identified twice"],
        )


if __name__ == "__main__":
    main()
