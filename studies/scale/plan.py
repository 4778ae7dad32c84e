"""What would a million logs of ten thousand stages cost on a Dask cluster?

Method
    One stage of 40 logs of a simulated life, 20 s of four channels at 20 kHz, is analysed by one
    worker: processor time of each step by the progress of `run`, health at 40 epochs by itself, and
    bytes in store and pages. The main process's time per log and per stage is measured on two such
    stages with two workers of Dask. By the model of `speedup`, whose predictions for 2, 4 and 8
    workers are compared with measurements there, n workers share W = logs times identification +
    stages times (health, life, page) at the efficiency of a worker in `speedup.json`; each main
    process works serially, S = logs times its time per log + stages times that per stage, and runs
    on one server share S. The time is the longer of W / n and S / runs: a plan, no measurement.
Answer
    156 h of one worker, a third of what it was; 1.2 h of 128 workers, and half an hour of 512, for
    which the main process is the limit unless two runs share the store.
Run time
    Six minutes of two processors.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

import msgspec

from lmshealth import Settings, load_stage, run
from lmshealth.stage.description import Stage
from models.lives.simulation import Plan, simulate_life
from studies.harness.claims import Claim, number
from studies.harness.servers import dask_cluster
from studies.harness.study import Row, Study, read_record
from studies.scale.archive import Steps, size_mb
from studies.scale.speedup import Clock

STEP = "batch"

N_LOGS, N_STAGES = 1_000_000, 10_000
# Workers, and runs on one server that have them.
PLANS = ((1, 1), (8, 1), (32, 1), (128, 1), (512, 1), (512, 2))
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


def main_process(folder: Path, quick: bool) -> Row:
    """Analyse two lives with two workers of Dask; return the main process's time (s) of each."""
    plans = [QUICK] if quick else [FULL, replace(FULL, seed=FULL.seed + 1)]
    for k, plan in enumerate(plans):
        simulate_life(plan, folder / "both" / str(k), workers=2 - quick)
    stage, clock = load_stage(plans[0].stage), Clock()
    with nullcontext() if quick else dask_cluster(2) as cluster:
        settings = Settings(
            scheduler=cluster.address if cluster else None, epochs=1 if quick else 40
        )
        run(folder / "both", [stage], folder / "both" / "out", settings, clock)
    log_s = clock.serial_s("reading", "identifying")
    return {"log_s": log_s, "stage_s": clock.serial_s("assessing", "reporting")}


def main() -> None:
    """Run the study; ``--quick`` does a short life without health and records nothing."""
    study = Study(__file__, __doc__)
    with tempfile.TemporaryDirectory() as name:
        stage = study.trials.once(partial(staged, Path(name)), study.quick)
        serial = study.trials.once(partial(main_process, Path(name)), study.quick)
    measured = read_record(__file__, "speedup")
    efficiency = measured["efficiency"]["dask"]
    whole = stage["health_s"] + stage["life_s"] + stage["page_s"]
    shared = N_LOGS * stage["log_s"] + N_STAGES * whole
    alone = N_LOGS * serial["log_s"] + N_STAGES * serial["stage_s"]
    plans = []
    for n, runs in PLANS:
        parallel = shared / (n * (efficiency if n > 1 else 1.0))
        waits_for = "workers" if parallel >= alone / runs else "main process"
        hours = round(max(parallel, alone / runs) / 3600, 1)
        plans.append({"workers": n, "runs": runs, "hours": hours, "waits_for": waits_for})
    answer: Row = {
        "stage": {name: round(float(value), 3) for name, value in stage.items()},
        "main_process_ms": {name: round(1e3 * value, 3) for name, value in serial.items()},
        "efficiency": efficiency,
        "plans": plans,
        "workers_kept_busy": int(shared / efficiency / alone),
        "store_gb": round(1e-3 * N_STAGES * stage["store_mb"], 1),
        "pages_gb": round(1e-3 * N_STAGES * stage["page_mb"], 1),
        "passed": {"more workers take less": plans[0]["hours"] > plans[-1]["hours"]},
    }
    study.conclude(answer)


def claims(answer: Row) -> Iterator[Claim]:
    """Claim, by what one stage costs, how long a million logs take."""
    for row in answer["plans"]:
        yield Claim(
            f"a million logs of ten thousand stages, {row['workers']:,} workers"
            + (f" of {row['runs']} runs" if row["runs"] > 1 else "")
            + ", reckoned",
            f"{number(row['hours'])} h",
            beside=f"waits for {row['waits_for']}",
        )


if __name__ == "__main__":
    main()
