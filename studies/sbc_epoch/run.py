"""Are posteriors of health at one epoch calibrated, over everything that is not known of it?

Question
    Of epochs drawn from the estimator's own model: is the rank of the true preload and mount among
    the draws of `infer` uniform, and do 50 and 90 % intervals cover as often? Also at several
    epochs of a life that share one error of the map, and in the X configuration, where the mount
    cannot be told?
Method
    Simulation-based calibration. The covariance of the drifts is that of the real tracker, of 8 to
    80 logs whose estimates are good to 0.02 to 0.5 %, with temperature and in half of the lives
    payload to be regressed. ln parameters are drawn from the priors of the description, inside the
    map, and a relative error of the map's sensitivities per parameter and mode by `model_std`;
    drifts are those of the map, with these errors, and with noise of that covariance. `infer` gets
    the track. Ranks among 127 draws, ties at random, are held to the simultaneous band of their
    distribution at 99.9 %, and coverages to their 99.9 % Clopper-Pearson interval. The last epoch
    of each life counts, for lives of three epochs each of them.
    Negative controls that must fail: `infer` is told half the covariance; it takes a map for exact
    that is wrong by 5 %.
Answer
    See the result.
Run time
    About a second of one processor per epoch.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from lmshealth.inference import infer
from lmshealth.stage import Stage, load_stage
from studies.ranks import (
    Array,
    Row,
    bands,
    collect,
    digest,
    judge,
    rank,
    thinned,
    uniform,
)
from studies.record import Stopwatch, keep
from studies.sbc_epoch.lives import believing, draw

HERE = Path(__file__).parent
SEED = 20261122
EPOCHS = ("first third", "second third", "last")
HALVED, EXACT = "covariance halved", "map taken as exact"
LIVES = {"lms-y": 2000, "lms-y, three epochs": 500, "lms-x": 500, HALVED: 500, EXACT: 500}
QUICK = {"lms-y": 60, "lms-y, three epochs": 10, "lms-x": 10, HALVED: 40, EXACT: 0}
CODE = ("inference", "sampling", "modalmap", "priors", "stage")


def main() -> None:
    """Run the study; ``--quick`` does a small part and records nothing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--lives", type=Path, help="file of lives done before, to go on with")
    options = parser.parse_args()
    watch, plan = Stopwatch(), QUICK if options.quick else LIVES
    tasks = [(kind, life) for kind, n in plan.items() for life in range(n)]
    rows = collect(options.lives, digest(*CODE), tasks, one)
    answer: dict[str, Any] = {"seed": SEED, "lives": plan} | judged(rows)
    answer["passed"] = verdicts(answer["ranks"], quick=options.quick)
    answer["bands"] = bands(row for part in answer["ranks"].values() for row in part.values())
    print(json.dumps(answer["passed"], indent=1))
    if not options.quick:
        keep(HERE / "result.json", __doc__.split("\n")[0], answer, watch)
    failed = [name for name, fine in answer["passed"].items() if not fine]
    if failed:
        raise SystemExit(f"not as asked: {failed}")


@cache
def machine(kind: str) -> Stage:
    """Load the stage that lives of a kind are of."""
    return load_stage("lms-x" if kind == "lms-x" else "lms-y")


def one(kind: str, life: int) -> Row:
    """Draw a life and rank its truth; controls are of the lives of the first kind."""
    stage = machine(kind)
    # Controls are the first lives again: only what the estimator believes differs.
    part = 0 if kind in (HALVED, EXACT) else list(LIVES).index(kind)
    rng = np.random.default_rng([SEED, part, life])
    drawn = draw(rng, stage, 3 if "three" in kind else 1)
    told = drawn.track
    if kind == HALVED:
        told = replace(told, drift_cov=told.drift_cov / 2)
    believed = believing(stage, 0.0) if kind == EXACT else stage
    found = infer(told, believed, [SEED, part, life], epochs=drawn.epochs)
    truth = np.exp(drawn.truth)
    return {
        "rank": [rank(truth[k], thinned(found.samples[k]), rng) for k in range(len(drawn.epochs))],
        "informed": found.informed[-1].round(4).tolist(),
        "converged": bool(found.converged.all()),
    }


def judged(rows: list[Row]) -> dict[str, Any]:
    """Judge the ranks of every parameter, kind by kind and epoch by epoch."""
    names = [one.name for one in machine("lms-y").parameters]
    ranks: dict[str, dict[str, Row]] = {}
    informed: dict[str, dict[str, float]] = {}
    for kind in dict.fromkeys(row["kind"] for row in rows):
        own = [row for row in rows if row["kind"] == kind]
        found: Array = np.array([row["rank"] for row in own])
        epochs = EPOCHS if found.shape[1] == 3 else ("",)
        ranks[kind] = {
            f"{name}, {epoch}" if epoch else name: judge(found[:, k, j])
            for k, epoch in enumerate(epochs)
            for j, name in enumerate(names)
        }
        median = np.median([row["informed"] for row in own], axis=0)
        informed[kind] = dict(zip(names, median.tolist(), strict=True))
    missed = sum(not row["converged"] for row in rows)
    return {"ranks": ranks, "median_informed": informed, "lives_not_converged": missed}


def verdicts(ranks: dict[str, dict[str, Row]], *, quick: bool) -> dict[str, bool]:
    """Say what was asked and whether it is so; few lives tell no control."""
    checks = {
        "ranks are uniform": uniform(ranks["lms-y"]),
        "ranks are uniform at all epochs that share an error": uniform(
            ranks["lms-y, three epochs"]
        ),
        "ranks are uniform in X, the mount's too": uniform(ranks["lms-x"]),
    }
    if not quick:
        for kind in (HALVED, EXACT):
            checks[f"{kind}: ranks are not"] = not any(
                row["inside_band"] for row in ranks[kind].values()
            )
    return checks


if __name__ == "__main__":
    main()
