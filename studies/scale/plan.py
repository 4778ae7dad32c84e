"""What would a million logs of ten thousand stages cost on a Dask cluster?

Method
    One stage of 40 logs of a simulated life, 20 s of four channels at 20 kHz, is analysed by one
    worker: processor time of each step by the progress of `run`, health at 40 epochs by itself, and
    bytes in store and pages. The main process's part per log, and the efficiency of two workers,
    are those of `speedup.json`. Workers share W = logs times identification + stages times (health,
    life, page) at the measured efficiency, the main process works serially, S = logs times its
    part; the time is the longer of the two. The efficiency of two is taken for that of many: this
    is a plan, no measurement.
Answer
    See the claims. A stage takes 111 s: 89 for health at 40 epochs, 18 for its life, 4 for its
    page. Store and pages take 33 and 6 GB. The main process limits first, with 6.8 ms per log: 1.9
    hours that no worker shortens, reached by some 230 workers.
Run time
    Three minutes.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import msgspec

from lmshealth import Settings, load_stage, run
from lmshealth.stage.description import Stage
from models.lives.simulation import Plan, simulate_life
from studies.harness.claims import Claim, number
from studies.harness.study import Row, Study, read_record
from studies.scale.archive import Steps, size_mb

STEP = "batch"

N_LOGS, N_STAGES = 1_000_000, 10_000
WORKERS = (1, 8, 32, 128, 512)
FULL, QUICK = Plan("lms-y", "both", 40, 20.0, 3), Plan("lms-x", "preload-wear", 5, 5.0, 3)


def staged(folder: Path, quick: bool) -> Row:
    """Analyse the full life, or a short one without health and life, which take most time."""
    plan, epochs = (QUICK, 1) if quick else (FULL, 40)
    stage = load_stage(plan.stage)
    if quick:
        modes = msgspec.structs.replace(stage.description, parameter=(), map=None)
        stage = replace(stage, description=modes, modal_map=None)
    return one_stage(folder, plan, epochs, stage)


def one_stage(folder: Path, plan: Plan, epochs: int, stage: Stage) -> Row:
    """Analyse a simulated life by one worker; return the time of each step and what is kept.

    At one epoch the cost of epochs counts as the life's.
    """
    simulate_life(plan, folder / "logs", workers=min(2, epochs))
    out = folder / "out"

    def spent(n_epochs: int) -> dict[str, float]:
        steps = Steps()
        run(folder / "logs", [stage], out, Settings(workers=1, epochs=n_epochs), steps)
        steps("ended", 0, 0)
        return steps.seconds

    seconds = spent(epochs)
    # Once more at one epoch, from the same readings: the rest is the cost of the epochs.
    life_s = (spent(1) if epochs > 1 else seconds)["assessing"]
    return {
        "log_s": (seconds["reading"] + seconds["identifying"]) / plan.logs,
        "epochs": epochs,
        "health_s": seconds["assessing"] - life_s,
        "life_s": life_s,
        "page_s": seconds["reporting"],
        "store_mb": size_mb(out, "*.sqlite*"),
        "page_mb": size_mb(out, "*.html")
        - sum(size_mb(out, name) for name in ("index.html", "how-to-read.html")),
    }


def main() -> None:
    """Run the study; ``--quick`` does a short life without health and records nothing."""
    study = Study(__file__, __doc__)
    with tempfile.TemporaryDirectory() as name:
        stage = study.trials.once(partial(staged, Path(name)), study.quick)
    two = read_record(__file__, "speedup")
    serial_s, efficiency = 1e-3 * two["dask_serial_ms"][1], min(two["of the bound"]["dask"], 1.0)
    whole = stage["health_s"] + stage["life_s"] + stage["page_s"]
    shared, serial = N_LOGS * stage["log_s"] + N_STAGES * whole, N_LOGS * serial_s
    plans = []
    for n in WORKERS:
        parallel = shared / (n * (efficiency if n > 1 else 1.0))
        waits_for = "workers" if parallel >= serial else "main process"
        hours = round(max(parallel, serial) / 3600, 1)
        plans.append({"workers": n, "hours": hours, "waits_for": waits_for})
    answer: Row = {
        "stage": {name: round(float(value), 3) for name, value in stage.items()},
        "serial_ms_per_log": round(1e3 * serial_s, 3),
        "efficiency": efficiency,
        "plans": plans,
        "workers_kept_busy": int(shared / serial),
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
            beside=f"waits for {row['waits_for']}",
        )


if __name__ == "__main__":
    main()
