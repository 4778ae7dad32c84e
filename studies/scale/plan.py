"""What would a million logs of ten thousand stages cost on a Dask cluster?

Question
    From the measured cost of a log and of a stage: how long do 10^6 logs of 10^4 stages take on N
    workers, how much is kept, and what breaks first?
Method
    One stage of 40 logs of a simulated life, 20 s of four channels at 20 kHz, is analysed by one
    worker: processor time of each step as `run` tells its progress, health at 40 epochs by itself,
    and bytes in store and pages. What the main process alone does per log, and the efficiency of
    two workers, are those of `speedup.json`. Workers share what can be shared, W = logs times
    identification + stages times (health, life, page), at the measured efficiency; the main
    process is serial, S = logs times its part. The time is the longer of the two. The efficiency
    of two is taken for that of many: this is a plan, no measurement.
Answer
    A log takes 0.47 s of processor time, a stage 111 s: 89 for health at 40 epochs, 18 for its
    life, 4 for its page. One worker needs 439 hours, 8 need 60, 32 need 15, 128 need 3.7. Store
    and pages take 33 and 6 GB. What breaks first is the main process, which takes 6.8 ms per log by
    itself: 1.9 hours that no worker shortens, reached by some 230 workers.
Run time
    Three minutes.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import msgspec

from lmshealth import Settings, load_stage, run
from lmshealth.stage.description import Stage
from models.lives.simulation import Plan, simulate_life
from studies.harness.claims import Claim, number
from studies.harness.study import Row, Study

STEP = "batch"

HERE = Path(__file__).parent
N_LOGS, N_STAGES = 1_000_000, 10_000
WORKERS = (1, 8, 32, 128, 512)
FULL, QUICK = Plan("lms-y", "both", 40, 20.0, 3), Plan("lms-x", "preload-wear", 5, 5.0, 3)


class Steps:
    """Divides processor time among the steps of a run."""

    def __init__(self) -> None:
        self._step, self._since = "starting", time.process_time()
        self.seconds: dict[str, float] = {}

    def __call__(self, what: str, done: int, total: int) -> None:
        """Measure of progress, as `run` tells it."""
        now = time.process_time()
        self.seconds[self._step] = self.seconds.get(self._step, 0.0) + now - self._since
        self._step, self._since = what, now


def staged(folder: Path, quick: bool) -> Row:
    """Analyse the full life or a short one."""
    if quick:  # health and life take most of the time by far
        return one_stage(folder, QUICK, 1, without_health(load_stage(QUICK.stage)))
    return one_stage(folder, FULL, 40, load_stage(FULL.stage))


def without_health(stage: Stage) -> Stage:
    """Return the same stage with its modes alone."""
    told = msgspec.structs.replace(stage.description, parameter=(), map=None)
    return replace(stage, description=told, modal_map=None)


def one_stage(folder: Path, plan: Plan, epochs: int, stage: Stage) -> Row:
    """Analyse a simulated life by one worker, and say what each step costs and keeps.

    At one epoch the cost of epochs is not told, but counts as the life's.
    """
    simulate_life(plan, folder / "logs", workers=min(2, epochs))
    steps, out = Steps(), folder / "out"
    run(folder / "logs", [stage], out, Settings(workers=1, epochs=epochs), steps)
    steps("ended", 0, 0)
    fewer = steps
    if epochs > 1:
        # Once more at one epoch, from the same readings: the rest is what the epochs cost.
        fewer = Steps()
        run(folder / "logs", [stage], out, Settings(workers=1, epochs=1), fewer)
        fewer("ended", 0, 0)
    size = {
        "store": sum(p.stat().st_size for p in out.glob("*.sqlite*")),
        "pages": sum(p.stat().st_size for p in out.glob("*.html") if p.name != "index.html"),
    }
    spent = steps.seconds
    return {
        "log_s": (spent["reading"] + spent["identifying"]) / plan.logs,
        "epochs": epochs,
        "health_s": spent["assessing"] - fewer.seconds["assessing"],
        "life_s": fewer.seconds["assessing"],
        "page_s": spent["reporting"],
        "store_mb": size["store"] / 1e6,
        "page_mb": size["pages"] / 1e6,
    }


def plan_for(n_workers: int, stage: Row, serial_s: float, efficiency: float) -> Row:
    """Return how long the archive takes, and what it waits for."""
    whole = stage["health_s"] + stage["life_s"] + stage["page_s"]
    shared = N_LOGS * stage["log_s"] + N_STAGES * whole
    gain = n_workers * (efficiency if n_workers > 1 else 1.0)
    parallel, serial = shared / gain, N_LOGS * serial_s
    return {
        "workers": n_workers,
        "hours": round(max(parallel, serial) / 3600, 1),
        "waits_for": "workers" if parallel >= serial else "main process",
    }


def main() -> None:
    """Run the study; ``--quick`` does a short life without health and records nothing."""
    study = Study(__file__, __doc__)
    with tempfile.TemporaryDirectory() as name:
        stage = study.trials.once(partial(staged, Path(name)), study.quick)
    two = json.loads((HERE / "speedup.json").read_text(encoding="utf-8"))
    serial_s = 1e-3 * two["dask_serial_ms"][1]
    efficiency = min(two["of the bound"]["dask"], 1.0)
    plans = [plan_for(n, stage, serial_s, efficiency) for n in WORKERS]
    whole = stage["health_s"] + stage["life_s"] + stage["page_s"]
    busy = (stage["log_s"] + whole * N_STAGES / N_LOGS) / serial_s
    answer: Row = {
        "stage": {name: round(float(value), 3) for name, value in stage.items()},
        "serial_ms_per_log": round(1e3 * serial_s, 3),
        "efficiency": efficiency,
        "plans": plans,
        "workers_kept_busy": int(busy),
        "store_gb": round(1e-3 * N_STAGES * stage["store_mb"], 1),
        "pages_gb": round(1e-3 * N_STAGES * stage["page_mb"], 1),
        "passed": {"more workers take less": plans[0]["hours"] > plans[-1]["hours"]},
    }
    study.conclude(answer)


def claims(answer: Row) -> Iterator[Claim]:
    """Claim, by what one stage costs, how long a million logs take."""
    for row in answer["plans"]:
        yield Claim(
            f"a million logs of ten thousand stages, {row['workers']:,} workers, reckoned",
            f"{number(row['hours'])} h",
            "",
            f"waits for {row['waits_for']}",
        )


if __name__ == "__main__":
    main()
