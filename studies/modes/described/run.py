"""Are modes of described machines identified as well as the data allow?

Method
    Records of machines of which a description states frequencies with an error of 1 % in common and
    0.4 % each, and a damping of 1.2 % for all (`worlds`): white floors in one to eight channels;
    eight channels with floors that are unequal, sloped and coherent; two modes 1 % apart; a mode
    that nobody described; mains in the band of a mode; six modes with a steady and a wandering
    harmonic in 8 and 16 channels (with the bound of the first eight); one force that moves all
    modes, 25 dB above the floors in four channels, and 40 dB in three with stronger modes outside
    the band. Errors of ln f are compared with the Cramér-Rao bound of all channels with unknown
    shapes, forces and white noise, over a band 25 % beyond the outer modes (of sloped and coherent
    floors it is that of white ones of the same level at 130 Hz), and with the standard deviations
    that are published. A mode is wrong if another one is nearer. Controls: intervals two thirds as
    wide, which must not cover; the first half of records of 2 and 4 channels, whose errors must
    miss the bound of whole ones.
Run time
    Ten minutes on one processor.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from lmshealth import identify
from lmshealth.calibration.ranks import share_row
from lmshealth.stage.description import Description, ModeSpec, Stage
from studies.harness.claims import Claim, counted, number
from studies.harness.data.logs import make_log
from studies.harness.study import Row, Study
from studies.modes.described.worlds import SEED, WORLDS, case

QUICK = {"4 channels": 2, "mains in the band of a mode": 2}
HALVES = ("2 channels", "4 channels")
# Most errors over the bound, and ranges of errors over what is published.
_FLOORS = "8 channels, unequal, sloped, coherent floors"
_OUTSIDE = "one force moves all modes, strong ones outside the band"
OVER_BOUND = {_FLOORS: 1.3} | {f"{n} channels, 6 modes, two harmonics": 1.25 for n in (8, 16)}
MOST_OVER_BOUND, SCORES, NARROWER = 1.15, (0.85, 1.15), 1.5
NOT_MET = {
    "none missing or wrong: pair 1 % apart": "the description is off by 0.4 % for each mode, with "
    "which the order of two that are 1 % apart is not always that of the description; where the "
    "data do not separate them both are refused",
    f"bounded time: {_FLOORS}": "in one record a false narrow pole makes all bins of the search as "
    "fine as it is",
    **dict.fromkeys(
        (f"{what}: {_OUTSIDE}" for what in ("near the bound", "none missing or wrong")),
        "responses of stronger modes outside the band are described by broad poles and floors, "
        "with which most of the information of a common force about its modes is lost; of 96 modes "
        "5 are refused, none is wrong, and 90 % intervals contain 89 of 91",
    ),
}


def main() -> None:
    """Run the study; ``--quick`` does two records of two kinds and records nothing."""
    study = Study(__file__, __doc__)
    plan = QUICK if study.quick else {kind: row[-1] for kind, row in WORLDS.items()}
    tasks = [(kind, k) for kind, n in plan.items() for k in range(n)]
    found = study.trials.collect(errors_of, tasks)
    rows = {kind: summarised(kind, tasks, found) for kind in plan}
    halves = [task for task in tasks if task[0] in HALVES and not study.quick]
    control = study.trials.collect(partial(errors_of, share=0.5), halves)
    result: Row = {
        "seed": SEED,
        "kinds": rows,
        "first halves": {kind: summarised(kind, halves, control) for kind in HALVES if halves},
    }
    result["passed"] = verdicts(result)
    study.conclude(result, not_met=NOT_MET, quick_may_fail=True)


def errors_of(kind: str, number_: int, share: float = 1.0) -> Row:
    """Identify a share of a record.

    Returns errors of ln f over the bound of the whole and over what is published, what is missing,
    and the processor time in s.
    """
    one = case(kind, number_)
    samples = one.samples[: round(share * len(one.samples))]
    log = make_log({f"acc_{c}": row.copy() for c, row in enumerate(samples.T)}, one.sample_rate)
    specs = tuple(
        ModeSpec(f"m{k}", f, 0.012) for k, f in zip(one.described, one.declared, strict=True)
    )
    stage = Stage(Description(name="machine", mode=specs), None, "0" * 64)
    start = time.process_time()
    modes = identify(log, stage)
    cpu = time.process_time() - start
    errors, scores, wrong = [], [], 0
    stds = np.sqrt(np.diag(modes.cov))[: len(modes.names)]
    for name, ln_f, std in zip(modes.names, modes.ln_frequency, stds, strict=True):
        mode = int(name[1:])
        off = ln_f - np.log(one.frequency)
        if int(np.abs(off).argmin()) != mode:
            wrong += 1
            continue
        errors.append(float(off[mode] / one.bound[mode]))
        scores.append(float(off[mode] / std))
    return {
        "errors": errors,
        "scores": scores,
        "wrong": wrong,
        "modes": len(one.described),
        "cpu_s": cpu,
    }


def summarised(kind: str, tasks: list[tuple[str, int]], found: list[Row]) -> Row:
    """Summarise the records of a kind."""
    rows = [row for task, row in zip(tasks, found, strict=True) if task[0] == kind]
    errors, scores = (
        np.array([x for row in rows for x in row[key]]) for key in ("errors", "scores")
    )
    cpu = np.array([row["cpu_s"] for row in rows])
    held = {f"held_{level}": share_row(int(np.sum(np.abs(scores) < z)), scores.size, 0.95)
            for level, z in ((90, 1.645), (50, 0.674))}  # fmt: skip
    return {
        "records": len(rows),
        "modes": sum(row["modes"] for row in rows),
        "named": errors.size,
        "wrong": sum(row["wrong"] for row in rows),
        # A root mean square of n normal errors is known to one part in √(2n).
        "over_bound": [_rms(errors), _rms(errors) / np.sqrt(2 * errors.size)],
        "scores": [_rms(scores), _rms(scores) / np.sqrt(2 * scores.size)],
        **held,
        "held_90_if_narrower": float(np.mean(np.abs(scores) * NARROWER < 1.645)),
        "cpu_s": [float(np.median(cpu)), float(cpu.max())],
    }


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def verdicts(result: Row) -> dict[str, bool]:
    """Return what was asked of every kind, two Monte-Carlo errors allowed, and the controls."""
    checks: dict[str, Any] = {}
    for kind, row in result["kinds"].items():
        (over, error), (z, z_error) = row["over_bound"], row["scores"]
        checks[f"near the bound: {kind}"] = over - 2 * error <= OVER_BOUND.get(
            kind, MOST_OVER_BOUND
        )
        checks[f"as published: {kind}"] = (
            z - 2 * z_error <= SCORES[1] and z + 2 * z_error >= SCORES[0]
        )
        checks[f"bounded time: {kind}"] = row["cpu_s"][1] < 5 * row["cpu_s"][0]
        checks[f"none missing or wrong: {kind}"] = row["named"] == row["modes"] and not row["wrong"]
    if result["first halves"]:
        checks["intervals two thirds as wide do not cover (control)"] = all(
            row["held_90_if_narrower"] < 0.9 for row in result["kinds"].values()
        )
        checks["first halves miss the bound of whole records (control)"] = all(
            row["over_bound"][0] - 2 * row["over_bound"][1] > MOST_OVER_BOUND
            for row in result["first halves"].values()
        )
    return {name: bool(fine) for name, fine in checks.items()}


def claims(result: Row) -> Iterator[Claim]:
    """Claim errors over the bound, coverage, and names of every kind."""
    passed = result["passed"]
    for kind, row in result["kinds"].items():
        (over, error), (z, z_error) = row["over_bound"], row["scores"]
        half = result["first halves"].get(kind)
        control = f"first halves {number(half['over_bound'][0])} (control); " if half else ""
        yield Claim(
            f"root mean square error of ln f over the Cramér-Rao bound: {kind}",
            number(over),
            f"± {number(error)}",
            f"{control}processor time at most {number(row['cpu_s'][1] / row['cpu_s'][0])} times "
            "the median",
            passed[f"near the bound: {kind}"],
        )
        yield counted(
            f"90 % intervals of f hold: {kind}",
            row["held_90"]["hits"],
            row["held_90"]["n"],
            f"errors over what is published {number(z)} ± {number(z_error)}; "
            f"50 %: {row['held_50']['hits']}",
            met=passed[f"as published: {kind}"],
        )
        yield counted(
            f"described modes named: {kind}",
            row["named"],
            row["modes"],
            f"{row['wrong']} wrong",
            met=passed[f"none missing or wrong: {kind}"],
        )


if __name__ == "__main__":
    main()
