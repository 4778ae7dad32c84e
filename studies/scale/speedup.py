"""How much faster do two workers identify an archive than one, and what would a cluster take?

Method
    An archive of short logs, each number of workers with an empty store, in turns. Time runs from
    the first log identified to the last, without the start. The bound is measured in the same turn:
    as many processes as workers identify the same logs without `lmshealth run`, because two cores
    of a shared machine are seldom twice one. Serial is the processor time per log that the main
    process takes while others work.
Answer
    Yes; scheduler and main process share the two processors with the workers. The main process
    takes 3.3 ms per log, with Dask 6.8 ms: short logs keep some 60 and 30 such workers busy.
Run time
    Nine minutes of both processors.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import numpy as np

from lmshealth import Settings, identify, load_stage, read_log, run
from studies.harness.claims import Claim
from studies.harness.command_line import no_pictures
from studies.harness.servers import dask_cluster
from studies.harness.study import Row, Study, spawn_pool
from studies.scale.archive import make_archive

STEP = "batch"

N_LOGS, QUICK_LOGS, TURNS = 200, 4, 3
# Of the bound that the machine gives in the same turn, and against one worker.
SPEEDUP = 1.8
_BARE, _QUICK_BARE = 40, 1  # identifications in each process of the bound


class Clock:
    """Measures rate (logs per s) and serial processor time (s per log) between first and last."""

    def __init__(self) -> None:
        self._moments: list[tuple[float, float, int]] = []

    def __call__(self, what: str, done: int, total: int) -> None:
        """Keep the moment of a report of progress."""
        if what == "identifying" and done:
            self._moments.append((time.perf_counter(), time.process_time(), done))

    def rates(self) -> tuple[float, float]:
        """Return logs per s, and processor time of this process in s per log."""
        wall, cpu, n = np.subtract(self._moments[-1], self._moments[0])
        return float(n / wall), float(cpu / n)


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
    """Return what n processes identify in a second by themselves, each so many logs.

    One of them is this one, which nothing else keeps busy.
    """
    if n == 1:
        return _again_and_again(folder, each)
    with spawn_pool(n) as pool:
        list(pool.map(_again_and_again, [folder] * n, [1] * n))  # imports before the clock runs
        return sum(pool.map(_again_and_again, [folder] * n, [each] * n))


def one_turn(folder: Path, kinds: tuple[str, ...], each: int, _: int) -> Row:
    """Measure everything once, the bound by so many logs in each process."""
    bound = [bare(folder, n, each) for n in (1, 2)]
    rates = {}
    for n in (1, 2):
        if "dask" in kinds:
            with dask_cluster(n) as cluster:
                settings = Settings(scheduler=cluster.address)
                rates["dask", n] = identified(folder, settings).rates()
        rates["local", n] = identified(folder, Settings(workers=n)).rates()
    found: Row = {"bound": bound[1] / bound[0]}
    for kind in kinds:
        rate, serial = rates[kind, 2]
        found[kind] = rate / rates[kind, 1][0]
        found |= {f"{kind}_serial_ms": 1e3 * serial, f"{kind}_rate": rate}
    return found


def main() -> None:
    """Run the study; ``--quick`` does a small archive and records nothing."""
    study = Study(__file__, __doc__)
    quick = study.quick
    # Batches on Dask are in the quick form of `faults.workers`.
    kinds = ("local",) if quick else ("local", "dask")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_archive(folder, QUICK_LOGS if quick else N_LOGS)
        each = _QUICK_BARE if quick else _BARE
        tasks = [(each, k) for k in range(1 if quick else TURNS)]
        with no_pictures() if quick else nullcontext():
            turns = study.trials.collect(partial(one_turn, folder, kinds), tasks)
    answer: Row = {
        name: [round(float(v), 3) for v in np.quantile([t[name] for t in turns], (0, 0.5, 1))]
        for name in turns[0]
    }
    answer |= {"logs": QUICK_LOGS if quick else N_LOGS, "turns": len(turns)}
    # Two processes at twice the rate of one are all that there is: more is the clock's noise.
    bound = min(answer["bound"][1], 2.0)
    answer["of the bound"] = {kind: round(answer[kind][1] / bound, 3) for kind in kinds}
    answer["workers kept busy"] = {
        kind: int(2e3 / answer[f"{kind}_rate"][1] / answer[f"{kind}_serial_ms"][1])
        for kind in kinds
    }
    answer["passed"] = {
        f"{kind}: 1.8 of 2": answer["of the bound"][kind] >= SPEEDUP / 2 for kind in kinds
    }
    # Of a small archive the start of the second worker is most of the time.
    study.conclude(answer, quick_may_fail=True)


def claims(answer: Row) -> Iterator[Claim]:
    """Claim how much faster two workers are than one."""
    low, middle, high = answer["bound"]
    for kind, what in (("local", "two processes"), ("dask", "two workers of Dask")):
        least, median, most = answer[kind]
        yield Claim(
            f"{what} identify an archive, over one",
            f"{median:.2f} times",
            f"{least:.2f} to {most:.2f} in {answer['turns']} turns",
            f"the machine gives two bare processes {middle:.2f} ({low:.2f} to {high:.2f}); "
            f"{answer['of the bound'][kind]:.2f} of it, 0.9 required",
            answer["passed"][f"{kind}: 1.8 of 2"],
        )


if __name__ == "__main__":
    main()
