"""Do the intervals of preload and mount contain the truth on lives such as that of the demo?

Method
    Preload wears while the mount loosens (LMS-Y, 40 logs of 20 s): `python -m models simulate` and
    `lmshealth run` as in `make demo`, once per seed, which draws wear, loosening, odometer and
    temperature. Counted are 90 % intervals of final preload, mount stiffness and remaining life
    that contain the truth, and their width relative to the prior's. Control: intervals shrunk to a
    third about the median. At the end `make demo` is timed.
Run time
    A minute and a half per seed on two processors.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from studies.common.cost import wall_s
from studies.common.metrics import clopper_pearson
from studies.harness.claims import Claim, Older, counted, percents
from studies.harness.command_line import ROOT, call
from studies.harness.study import Row, Study

STEP = "infer"
OLDER = {"result": Older("b609ecec2899", "laws were weighed")}

PARAMETERS = ("guide_preload", "mount_stiffness")
PROGRAMS = ("models.__main__", "lmshealth.__main__")
PRIOR_WIDTH = float(np.diff(np.exp(0.3 * np.array([-1.6449, 1.6449])))[0])


def main() -> None:
    """Run the study; ``--quick`` does one life of short logs, without chains, records nothing."""
    study = Study(__file__, __doc__, seeds=10)
    seeds = [1] if study.quick else list(range(1, study.options.seeds + 1))
    size = (8, 5, 1) if study.quick else (40, 20, 40)
    work = partial(one_life, quick=study.quick)
    lives = study.trials.collect(work, [(seed, *size) for seed in seeds], also=PROGRAMS)
    answer = {"seeds": seeds} | summarise(lives)
    answer |= {"lives": lives} if study.quick else {"make_demo": time_demo()}
    study.conclude(answer, details={"lives": lives})


def one_life(seed: int, n_logs: int, seconds: int, epochs: int, *, quick: bool) -> Row:
    """Simulate and analyse one life; compare with its truth."""
    with tempfile.TemporaryDirectory() as folder:
        logs, out = Path(folder) / "logs", Path(folder) / "out"
        workers = ("--workers", 1) if quick else ()
        begin = time.perf_counter()
        call("models", "simulate", "lms-y", "--life", "both", "--logs", n_logs,
             "--seconds", seconds, "--seed", seed, "--out", logs, *workers,
             quick=quick)  # fmt: skip
        simulated = time.perf_counter()
        call("lmshealth", "run", logs, "--stage", "lms-y", "--out", out,
             "--epochs", epochs, *workers, quick=quick)  # fmt: skip
        done = time.perf_counter()
        truth = pd.read_csv(logs / "truth.csv").iloc[-1]
        health = pd.read_csv(out / "health.csv")
        prognosis = pd.read_csv(out / "prognosis.csv").set_index("parameter")
        verdict = pd.read_csv(out / "verdict.csv").iloc[0]
    row: Row = {"seed": seed, "verdict": str(verdict["verdict"]),
                "simulate_s": round(simulated - begin, 1),
                "run_s": round(done - simulated, 1)}  # fmt: skip
    for name in PARAMETERS:
        last = health[health["parameter"] == name].iloc[-1]
        row[name] = {"truth": float(truth[name])} | {
            key: float(last[key]) for key in ("q05", "q25", "median", "q75", "q95")
        }
    end = min(float(truth[f"{name}_limit_km"]) for name in PARAMETERS)
    left = prognosis.loc["any"]
    row["remaining_km"] = {
        "truth": end - float(truth["travel_km"]),
        **{key: float(left[f"rul_km_{key}"]) for key in ("q05", "q25", "q50", "q75", "q95")},
    }
    return row


def time_demo() -> dict[str, float]:
    """Time `make demo`; a first call makes sure that everything is installed."""
    make = partial(subprocess.run, cwd=ROOT, check=True, capture_output=True)
    make(["make", ".venv/installed"])
    seconds = wall_s(lambda: make(["make", "demo"]))
    return {"wall_s": round(seconds, 1), "processors": len(os.sched_getaffinity(0))}


def summarise(lives: list[Row]) -> Row:
    """Count how often the intervals hold the truth."""
    answer: Row = {"n_lives": len(lives)}
    for name in PARAMETERS:
        answer[name] = coverage([life[name] for life in lives], "median")
        widths = [life[name]["q95"] - life[name]["q05"] for life in lives]
        answer[name]["widest_interval_over_prior"] = max(widths) / PRIOR_WIDTH
    # A truth that lies in the past is as good as now.
    remaining = [
        {k: max(v, 0.0) if k == "truth" else v for k, v in life["remaining_km"].items()}
        for life in lives
    ]
    answer["remaining_km"] = coverage(remaining, "q50")
    answer["wall_s_median"] = {
        key: float(np.median([life[key] for life in lives])) for key in ("simulate_s", "run_s")
    }
    return answer


def coverage(rows: list[dict[str, float]], middle: str) -> Row:
    """Count intervals that hold the truth, and those shrunk to a third that do."""
    inside = sum(row["q05"] <= row["truth"] <= row["q95"] for row in rows)
    shrunk = sum(
        (row["q05"] - row[middle]) / 3 <= row["truth"] - row[middle] <= (
            row["q95"] - row[middle]) / 3
        for row in rows
    )  # fmt: skip
    return {
        "inside_90": inside,
        "share": inside / len(rows),
        "share_interval_95": clopper_pearson(inside, len(rows)),
        "inside_50": sum(row["q25"] <= row["truth"] <= row["q75"] for row in rows),
        "control_inside_when_shrunk_to_a_third": shrunk,
    }


def claims(answer: Row) -> Iterator[Claim]:
    """Claim that intervals hold the truth of the demo's kind of life."""
    for name in (*PARAMETERS, "remaining_km"):
        row = answer[name]
        yield counted(
            f"lives whose true {name} lies inside its 90 % interval",
            row["inside_90"],
            answer["n_lives"],
            f"{row['control_inside_when_shrunk_to_a_third']} inside a third of it",
        )
    widest = [answer[name]["widest_interval_over_prior"] for name in PARAMETERS]
    yield Claim("widest interval of preload and mount, over the prior's", percents(widest))


if __name__ == "__main__":
    main()
