"""Are all modes of a machine that nobody described found, and none that is not there?

Method
    Records with known truth of three families (`worlds`): four modes in three channels of 20 s;
    two to five modes, one pair in two down to one half-power bandwidth, in one to eight channels
    of 20 to 120 s; eight modes in six channels of 150 to 600 s, with a close pair, one 20 dB below
    its neighbours, two steady harmonics and one that wanders by 1 %. The band is one that a user
    would choose. A mode is found if an estimate lies within its half-power bandwidth of it; every
    other estimate is false. Control: intervals two thirds as wide must not cover.
Run time
    About ten minutes on one processor.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from lmshealth import identify
from studies.blind_modes.worlds import FAMILIES, World, log_of
from studies.common.metrics import clopper_pearson
from studies.harness.claims import Claim
from studies.harness.study import Study, spawn_pool

STEP = "identify"
SEEDS = {"four modes": 64, "varied": 64, "eight modes": 40}
QUICK_SEEDS = 2
RECALL = {"four modes": 0.99, "varied": 0.99, "eight modes": 0.97}
MOST_FALSE = 0.05
COVERED = 0.93, 0.97
FAR_OFF = 5.0
WANDERED = 0.03
NARROWER = 1.5


def main() -> None:
    """Run the study; ``--quick`` does two records of each family and records nothing."""
    study = Study(__file__, __doc__)
    seeds = {name: QUICK_SEEDS if study.quick else n for name, n in SEEDS.items()}
    tasks = [(name, seed) for name, n in seeds.items() for seed in range(n)]
    with spawn_pool(1) as pool:
        records = study.trials.collect(examine, tasks, pool=pool)
    families = {name: summarise([r for r in records if r["family"] == name]) for name in seeds}
    study.conclude({"families": families, "passed": verdicts(families)}, quick_may_fail=True)


def examine(family: str, seed: int) -> dict[str, Any]:
    """Identify one record, and compare with the truth."""
    number = list(FAMILIES).index(family)
    world = FAMILIES[family](np.random.default_rng([231, number, seed]))
    log = log_of(world)
    start = time.process_time()
    found = identify(log, band=world.band)
    seconds = time.process_time() - start
    pairs, false = match(world, found.frequency)
    wandering = [abs(found.frequency[j] / h - 1) < WANDERED for j in false for h in world.wandering]
    mode, estimate = (list(side) for side in zip(*pairs, strict=True)) if pairs else ([], [])
    ln_f = np.log(found.frequency[estimate] / world.frequency[mode])
    ln_zeta = np.log(found.damping_ratio[estimate] / world.damping_ratio[mode])
    std = np.sqrt(np.diag(found.cov)).reshape(2, -1)[:, estimate]
    return {
        "family": family,
        "seed": seed,
        "channels": world.samples.shape[1],
        "there": world.frequency.size,
        "found": len(pairs),
        "false": len(false),
        "wandering_called_modes": int(sum(wandering)),
        "wandering": len(world.wandering),
        "scores_f": (ln_f / std[0]).tolist(),
        "scores_zeta": (ln_zeta / std[1]).tolist(),
        "seconds": seconds,
    }


def match(world: World, f: np.ndarray) -> tuple[list[tuple[int, int]], list[int]]:
    """Pair modes with estimates within a half-power bandwidth, the nearest first."""
    width = 2 * world.damping_ratio * world.frequency
    apart = np.abs(f[None] - world.frequency[:, None]) / width[:, None]
    modes, estimates = set(range(world.frequency.size)), set(range(f.size))
    pairs = []
    for k in np.argsort(apart, axis=None):
        i, j = (int(x) for x in np.unravel_index(k, apart.shape))
        if apart[i, j] < 1 and i in modes and j in estimates:
            modes.remove(i)
            estimates.remove(j)
            pairs.append((i, j))
    return pairs, sorted(estimates)


def summarise(records: list[Mapping[str, Any]]) -> dict[str, Any]:
    """Summarise the records of a family."""
    total = {
        name: int(sum(r[name] for r in records))
        for name in ("there", "found", "false", "wandering", "wandering_called_modes")
    }
    scores = {q: np.concatenate([r[f"scores_{q}"] for r in records]) for q in ("f", "zeta")}
    return {
        "records": len(records),
        **total,
        "recall": total["found"] / total["there"],
        "false_per_log": total["false"] / len(records),
        "coverage": {q: float(np.mean(np.abs(z) < 1.96)) for q, z in scores.items()},
        "control_narrower": {
            q: float(np.mean(NARROWER * np.abs(z) < 1.96)) for q, z in scores.items()
        },
        "largest_score_f": float(np.abs(scores["f"]).max()),
        "seconds": float(np.median([r["seconds"] for r in records])),
    }


def verdicts(families: Mapping[str, Mapping[str, Any]]) -> dict[str, bool]:
    """Return what is asked, by name."""
    every = list(families.values())
    low, high = COVERED
    return {
        **{f"recall, {name}": one["recall"] >= RECALL[name] for name, one in families.items()},
        "false modes": all(one["false_per_log"] <= MOST_FALSE for one in every),
        "no wandering harmonic is a mode": not any(one["wandering_called_modes"] for one in every),
        "intervals of f cover": all(low <= one["coverage"]["f"] <= high for one in every),
        "no frequency beyond five sigma": all(one["largest_score_f"] < FAR_OFF for one in every),
        "narrower intervals do not cover": all(one["control_narrower"]["f"] < low for one in every),
    }


def claims(record: Mapping[str, Any]) -> list[Claim]:
    """Return the claims of the record."""
    return [
        Claim(
            f"modes found without a description, {name}",
            f"{100 * one['recall']:.1f} %",
            "{:.3f} to {:.3f}".format(*clopper_pearson(one["found"], one["there"])),
            f"{one['false_per_log']:.2f} false modes a log",
            record["passed"][f"recall, {name}"],
        )
        for name, one in record["families"].items()
    ]


if __name__ == "__main__":
    main()
