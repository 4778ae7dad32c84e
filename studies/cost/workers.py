"""How much faster do 2, 4 and 8 workers, or two computers, identify an archive than one worker?

Method
    An archive of short logs, each case with an empty store: workers in processes, on a Dask
    cluster, and two runs of one worker each that share a PostgreSQL store, as two computers do.
    Rate is that between the first log identified and the last. The bound is measured in the same
    turn: bare processes identify the same logs, because the processors of a shared machine are
    seldom whole. Model: n workers identify c / (t + s) logs per s, at most one per serial time, the
    processor time per log of the main process; t is the time of a log with one worker, c what n
    bare processes do over one, and s the processor time of main process and scheduler.
Run time
    Twelve minutes of two processors.
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

_OVERLAP = (
    "the bound by bare processes differed by a quarter between the turns, on a shared machine"
)
NOT_MET = {
    "dask: at most 1 ms per log": "a tenth more, most of it the client's work on each task",
    "local: model of 4": _OVERLAP,
    "local: model of 8": _OVERLAP,
    "dask: model of 4": _OVERLAP,
}

N_LOGS, QUICK_LOGS, TURNS = 160, 4, 2
WORKERS, QUICK_WORKERS = (1, 2, 4, 8), (1, 2)
# Of the bound that the machine gives in the same turn, and against one worker.
SPEEDUP = 1.8
# Relative error of the model's rate; most processor time of the main process per log.
MODEL, SERIAL_MS = 0.15, 1.0
_BARE, _QUICK_BARE = 80, 2  # identifications of all processes of the bound
_KINDS = {"local": "processes", "dask": "workers of Dask", "runs": "runs on one server"}


class Clock:
    """Measures rate (logs per s) and processor time (s) by the steps of a run.

    The processor time is that of this process, and of another one if it is given.
    """

    def __init__(self, other: int | None = None) -> None:
        self.moments: dict[str, list[tuple[float, float, float, int]]] = {}
        self._other = other

    def __call__(self, what: str, done: int, total: int) -> None:
        """Keep the moment of a report of progress."""
        other = 0.0 if self._other is None else _cpu_s(self._other)
        moment = time.perf_counter(), time.process_time(), other, done
        self.moments.setdefault(what, []).append(moment)

    def rate(self) -> float:
        """Return logs per s, from the first that is identified to the last."""
        after_start = [moment for moment in self.moments["identifying"] if moment[-1]]
        wall, _, _, n = np.subtract(after_start[-1], after_start[0])
        return float(n / wall)

    def serial_s(self, *steps: str) -> float:
        """Return the processor time of this process per log or machine, over some steps."""
        spent = [np.subtract(self.moments[step][-1], self.moments[step][0]) for step in steps]
        return float(sum(cpu / n for _, cpu, _, n in spent))

    def other_s(self) -> float:
        """Return the processor time of the other process per log that is identified."""
        _, _, cpu, n = np.subtract(self.moments["identifying"][-1], self.moments["identifying"][0])
        return float(cpu / n)


def identified(folder: Path, settings: Settings, scheduler: int | None = None) -> Clock:
    """Analyse an archive with an empty store."""
    clock = Clock(scheduler)
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


def _cpu_s(process: int) -> float:
    """Return the processor time of another process in s."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def one_turn(
    folder: Path, kinds: tuple[str, ...], workers: tuple[int, ...], each: int, _: int
) -> Row:
    """Measure everything once, the bound by so many identifications."""
    found: Row = {"bound": {n: bare(folder, n, max(each // n, 2)) for n in workers}}
    found |= {kind: {} for kind in kinds} | {"serial_ms": {}, "scheduler_ms": {}}
    for n in workers:
        clocks = {"local": identified(folder, Settings(workers=n))}
        if "dask" in kinds:
            with dask_cluster(n) as cluster:
                settings = Settings(scheduler=cluster.address)
                clocks["dask"] = identified(folder, settings, cluster.scheduler.pid)
                found["scheduler_ms"][n] = 1e3 * clocks["dask"].other_s()
        for kind, clock in clocks.items():
            found[kind][n] = clock.rate()
            if n > 1:
                own = found["serial_ms"].setdefault(kind, {})
                own[n] = 1e3 * clock.serial_s("reading", "identifying")
    if "runs" in kinds:
        found["runs"][2], found["identified"] = two_runs(folder)
    return found


def main() -> None:
    """Run the study; ``--quick`` does a small archive and records nothing."""
    study = Study(__file__, __doc__)
    quick = study.quick
    # Batches on Dask have tests of their own.
    kinds = ("local",) if quick else tuple(_KINDS)
    workers, n_logs = (QUICK_WORKERS, QUICK_LOGS) if quick else (WORKERS, N_LOGS)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_archive(folder, n_logs)
        work = partial(one_turn, folder, kinds, workers, _QUICK_BARE if quick else _BARE)
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
    """Return gains over one worker (least, median, most), those of the model, and checks."""
    counts = [n for n in turns[0]["bound"] if n != "1"]
    answer: Row = {
        "bound": {n: _range([t["bound"][n] / t["bound"]["1"] for t in turns]) for n in counts},
        "serial_ms": {
            kind: _range([own for t in turns for own in t["serial_ms"][kind].values()])
            for kind in kinds
            if kind != "runs"
        },
        "gain": {}, "model": {}, "rate": {}, "of the bound": {},
    }  # fmt: skip
    passed = {f"{kind}: at most 1 ms per log": own[1] <= SERIAL_MS
              for kind, own in answer["serial_ms"].items()}  # fmt: skip
    scheduler = [own for t in turns for own in t["scheduler_ms"].values()]
    answer["scheduler_ms"] = _range(scheduler) if scheduler else None
    for kind in kinds:
        one = "local" if kind == "runs" else kind
        t_ms = 1e3 / float(np.median([t[one]["1"] for t in turns]))
        serial_ms = answer["serial_ms"].get(kind, [0.0, 0.0])[1]
        shared_ms = serial_ms + (answer["scheduler_ms"][1] if kind == "dask" else 0.0)
        own = [n for n in counts if n in turns[0][kind]]
        gain = {n: _range([t[kind][n] / t[one]["1"] for t in turns]) for n in own}
        # More than the processors is the clock's noise.
        bound = {n: min(answer["bound"][n][1], int(n), os.cpu_count() or 1) for n in own}
        most = t_ms / serial_ms if serial_ms else np.inf
        model = {n: round(min(bound[n] * t_ms / (t_ms + shared_ms), most), 3) for n in own}
        answer["gain"][kind], answer["model"][kind] = gain, model
        answer["rate"][kind] = round(1e3 / t_ms, 3)
        answer["of the bound"][kind] = {n: round(gain[n][1] / bound[n], 3) for n in own}
        passed[f"{kind}: 1.8 of 2"] = answer["of the bound"][kind]["2"] >= SPEEDUP / 2
        for n in own:
            passed[f"{kind}: model of {n}"] = abs(gain[n][1] / model[n] - 1) <= MODEL
        if kind != "runs":
            # Of a worker whose computer is as busy as this one, and does nothing else.
            alone = gain["2"][1] / 2 * (t_ms + shared_ms) / t_ms
            answer.setdefault("efficiency", {})[kind] = round(min(alone, 1.0), 3)
            answer.setdefault("workers kept busy", {})[kind] = int(t_ms / serial_ms)
    return answer | {"passed": passed}


def claims(answer: Row) -> Iterator[Claim]:
    """Claim how much faster workers and runs are than one."""
    passed = answer["passed"]
    for kind, gains in answer["gain"].items():
        for n, (least, median, most) in gains.items():
            low, middle, high = answer["bound"][n]
            needed = f", {SPEEDUP / 2:.1f} required" if n == "2" else ""
            yield Claim(
                f"{n} {_KINDS[kind]} identify an archive, over one",
                f"{median:.2f} times",
                f"{least:.2f} to {most:.2f} in {answer['turns']} turns",
                f"{n} bare processes {middle:.2f} ({low:.2f} to {high:.2f}) on "
                f"{answer['processors']} processors; {answer['of the bound'][kind][n]:.2f} of the "
                f"bound{needed}; the model's {answer['model'][kind][n]:.2f}, within "
                f"{100 * MODEL:.0f} % required",
                passed[f"{kind}: model of {n}"] and (n != "2" or passed[f"{kind}: 1.8 of 2"]),
            )
    for kind, (least, median, most) in answer["serial_ms"].items():
        yield Claim(
            f"processor time of the main process per log, {_KINDS[kind]}",
            f"{median:.2f} ms",
            f"{least:.2f} to {most:.2f}",
            f"at most {SERIAL_MS:g} ms required; {answer['workers kept busy'][kind]} workers kept "
            "busy by short logs",
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
