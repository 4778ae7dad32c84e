"""What does a log cost, and does that stay so from 100 logs to 10,000?

Method
    Archives of 100, 1,000 and 10,000 logs of 10 s at 2 kHz, three channels, a hundred to a machine
    and no parameter to infer, each analysed by one worker in a process of its own, and once more
    with everything in the store. Processor time is divided among the steps by the progress of
    `run`. Because machines get faster and slower, every 21st log is read and analysed once more by
    itself, and costs are expressed in this yardstick. Reading, hashing, store and bookkeeping are
    compared with the identification on 1,000 logs; following error and spectra for the page, which
    are analysis, are subtracted. Control: where logs get three times as long on the way, the cost
    must not look constant.
Answer
    Yes. Memory grows from 310 to 317 MB. In the runs of 10,000, recorded while every log still read
    the version of the package five times, reading, store and bookkeeping were 15.6 %. From the
    store 10,000 logs take two minutes, most of it drawing a hundred pages.
Run time
    Half an hour of one core; the recorded time is that after an interruption.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np

from lmshealth import Settings, identify, load_stage, read_log, run
from lmshealth.signal.following_error import loop_error
from lmshealth.stage.description import Stage
from studies.common.cost import cpu_s, in_own_process
from studies.harness.claims import Claim
from studies.harness.command_line import no_pictures
from studies.harness.study import Row, Study
from studies.scale.archive import Steps, make_archive, size_mb

STEP = "batch"

SIZES, QUICK_SIZES = (100, 1_000, 10_000), (2, 4, 8)
LONGER = "longer and longer"
EVERY = 21  # so that every recording that the logs are made of is among them
# Of the cost of one more log, of what is added to the identification, and of memory.
FLAT, OVERHEAD, MEMORY = 0.10, 0.15, 1.10
# A few logs of the quick form are not enough for more than that it works.
QUICK = 10.0


class Meter(Steps):
    """Divides processor time among the steps of a run, and measures the yardstick in between."""

    def __init__(self, logs: list[Path], stage: Stage) -> None:
        super().__init__()
        self._logs, self._stage = logs, stage
        self._every = min(EVERY, max(len(logs) // 2, 1))
        self.yardstick: list[tuple[float, float, float]] = []

    def __call__(self, what: str, done: int, total: int) -> None:
        """Measure the step that was reported last, and of some logs the yardstick."""
        super().__call__(what, done, total)
        if what == "identifying" and done and done % self._every == self._every // 2:
            self.yardstick.append(self._by_itself(self._logs[done - 1]))
            self._since = time.process_time()

    def _by_itself(self, path: Path) -> tuple[float, float, float]:
        """Return the times in s of reading a log, identification, and other analyses."""
        start = time.process_time()
        log = read_log(path)
        read = time.process_time()
        identified = cpu_s(lambda: identify(log, self._stage))
        other = cpu_s(lambda: loop_error(log))
        return read - start, identified, other


def one_run(folder: Path) -> Row:
    """Analyse an archive in this process and return the costs."""
    import resource  # POSIX

    stage = load_stage(str(folder / "stage.toml"))
    meter = Meter(sorted((folder / "logs").rglob("*.h5")), stage)
    out = folder / "out"
    result = run(folder / "logs", [stage], out, Settings(workers=1), meter)
    meter("ended", 0, 0)
    return {
        "logs": result.n_logs,
        "remembered": result.n_remembered,
        "seconds": {name: round(spent, 3) for name, spent in meter.seconds.items()},
        "yardstick_ms": np.round(1e3 * np.mean(meter.yardstick or [[0.0] * 3], axis=0), 2).tolist(),
        "memory_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1),
        "store_mb": round(size_mb(out, "*.sqlite*"), 2),
        "pages_mb": round(size_mb(out, "*.html"), 2),
    }


def alone(folder: Path) -> Row:
    """Do `one_run` in a process of its own, so that memory is its own."""
    found: Row = in_own_process("studies.scale.cost", "--one", folder)
    return found


def sized(what: str, n_logs: int) -> tuple[Row, Row]:
    """Analyse an archive of a size, and again with everything in the store."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_archive(folder, n_logs, longer=what == LONGER)
        return alone(folder), alone(folder)


def here(n_logs: int) -> tuple[Row, Row]:
    """Do as `sized` in this process and without pictures, but for one run of the smallest."""
    again = alone if n_logs == QUICK_SIZES[0] else one_run
    with tempfile.TemporaryDirectory() as name, no_pictures():
        make_archive(Path(name), n_logs)
        return one_run(Path(name)), again(Path(name))


def marginal(less: Row, more: Row, *, by: Row | None = None) -> float:
    """Return the cost of one more log, in yardsticks of the larger archive or of another one."""
    costs = [sum(row["seconds"].values()) - row["seconds"]["starting"] for row in (less, more)]
    yardstick = 1e-3 * sum((by or more)["yardstick_ms"])
    return (costs[1] - costs[0]) / (more["logs"] - less["logs"]) / yardstick


def main() -> None:
    """Run the study; ``--quick`` does small archives and records nothing."""
    study = Study(__file__, __doc__, one="")
    if study.options.one:
        print(json.dumps(one_run(Path(study.options.one))))
        return
    quick, once = study.quick, study.trials.once
    sizes = QUICK_SIZES if quick else SIZES
    pairs = [once(here, n) if quick else once(sized, "evenly", n) for n in sizes]
    first, again = zip(*pairs, strict=True)
    uneven = first[0] if quick else once(sized, LONGER, 4 * sizes[0])[0]
    beside = first[1] if quick else once(sized, "beside", sizes[1])[0]
    slopes = [marginal(*pair) for pair in pairwise(first)]
    _, identified, other = beside["yardstick_ms"]
    per_log = (
        1e3 * (beside["seconds"]["reading"] + beside["seconds"]["identifying"]) / beside["logs"]
    )
    answer = {
        "sizes": list(first),
        "from the store": list(again),
        "marginal_cost": [round(slope, 3) for slope in slopes],
        "marginal_ratio": round(slopes[1] / slopes[0], 3),
        "beside": beside,
        "overhead": round((per_log - other) / identified - 1, 3),
        "memory_ratio": round(first[-1]["memory_mb"] / first[1]["memory_mb"], 3),
        "control_ratio": None if quick else round(marginal(first[0], uneven, by=first[1]), 3),
    }
    loose = QUICK if quick else 1.0
    flat = min(slopes) > 0 and abs(np.log(slopes[1] / slopes[0])) <= loose * np.log1p(FLAT)
    answer["passed"] = {
        "flat": bool(flat),
        "little beside identification": answer["overhead"] <= loose * OVERHEAD,
        "memory stays": answer["memory_ratio"] <= (loose if quick else MEMORY),
        "all remembered": all(row["remembered"] == row["logs"] for row in again),
        "control is seen": quick or answer["control_ratio"] > (1 + 2 * FLAT) * slopes[0],
    }
    # What is imported late makes the first of a few logs dear.
    study.conclude(answer, quick_may_fail=True)


def claims(answer: Row) -> Iterator[Claim]:
    """Claim that a log costs the same in archives of any size."""
    passed = answer["passed"]
    sizes = [row["logs"] for row in answer["sizes"]]
    yield Claim(
        f"cost of one more log between {sizes[1]:,} and {sizes[2]:,}, over that from {sizes[0]:,}",
        f"{answer['marginal_ratio']:.3f}",
        "",
        f"0.9 to 1.1 required; where logs get longer {answer['control_ratio']:.2f} of a log",
        passed["flat"] and passed["control is seen"],
    )
    least, *_, most = (f"{row['memory_mb']:.0f}" for row in answer["sizes"])
    yield Claim("largest memory", f"{least} to {most} MB", met=passed["memory stays"])
    yield Claim(
        "reading, store and bookkeeping over the identification",
        f"{100 * answer['overhead']:.1f} %",
        beside="15 % required",
        met=passed["little beside identification"],
    )


if __name__ == "__main__":
    main()
