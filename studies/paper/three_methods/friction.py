"""Where does friction part the frequency response from following error and accelerometers?

Method
    The full stages Y and X with all effects (friction with presliding, cable, gusts, hits, orders)
    move at 10 and at 1 mm/s. Their pitch is identified as in `run.py`: from the frequency response
    to a sweep of 0.4 A, from the following error, and from the accelerometers of an undisturbed
    move, with logs of their own. At 10 mm/s the platform never turns back: the methods must agree,
    and the response may be off the eigenvalue by a hundredth of a percent. At 1 mm/s the sweep
    turns it back, friction then holds it on springs, and the response must have pitch too high; the
    methods without excitation must keep it. Controls: without friction the response at 1 mm/s has
    it right; with friction that is alike at all velocities the response at 10 mm/s has it.
Run time
    Fifteen minutes on two processors: 8 seeds of Y, 4 of X.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import binom, chi2, norm

from models.dynamics.plant import closed_loop_modes
from models.dynamics.stages import stage_named
from models.recordings.effects import FULL, FrictionParameters
from models.recordings.recording import record
from models.recordings.sweep import record_sweep
from studies.harness.claims import Claim, counted, number
from studies.harness.cost import one_thread
from studies.harness.study import Row, Study
from studies.paper.three_methods.run import (
    CHANNELS,
    LEVEL,
    METHODS,
    SECONDS,
    SWEEP_SECONDS,
    SWEEPS,
    by_channels,
    by_response,
    generator,
    logged,
)

# Full stages with the description of their rigid form: guide modes are alike within 0.03 %.
STAGES, MODE = {"lms-y-full": "lms-y", "lms-x-full": "lms-x"}, "pitch"
FRICTION = {
    "with": FULL,
    "without": replace(FULL, friction=FrictionParameters(scale=0.0, viscous=0.0, cable_drag=0.0)),
    "constant": replace(FULL, friction=FrictionParameters(stiction=1.0)),
}
# Velocity (m/s) and friction of each case, and how claims name it.
CASES = {
    "moving": (0.010, "with", "at 10 mm/s"),
    "turning back": (0.001, "with", "at 1 mm/s"),
    "control": (0.001, "without", "at 1 mm/s without friction"),
    "constant friction": (0.010, "constant", "at 10 mm/s with constant friction"),
}
# Why intervals of the response miss the eigenvalue, and the control that shows it.
WHY = {
    "moving": ("by friction that falls with velocity: constant, it leaves", "constant friction"),
    "turning back": ("by friction, which holds it on springs: without, there is", "control"),
}
# Of the frequency, that the response may be off where the platform never turns back.
CLOSE = 1e-4


def main() -> None:
    """Run the study; ``--quick`` does one seed of Y without the last case, and records nothing."""
    study = Study(__file__, __doc__, seeds=8)
    os.environ.update(one_thread())
    tasks = [(name, case, seed) for name, seeds in zip(STAGES, (8, 4), strict=True)
             for seed in range(study.options.seeds * seeds // 8) for case in CASES]  # fmt: skip
    with study.pool() as pool:
        rows = study.trials.collect(one_seed, tasks[:3] if study.quick else tasks, pool=pool)
    stages = {name: judge(name, [row for row in rows if row["stage"] == name])
              for name in dict.fromkeys(row["stage"] for row in rows)}  # fmt: skip
    passed = {
        f"{name}, {k}": v for name, one in stages.items() for k, v in one.pop("passed").items()
    }
    study.conclude({"mode": MODE, "stages": stages, "passed": passed}, details={"rows": rows})


def one_seed(name: str, case: str, seed: int) -> Row:
    """Return f and its standard deviation (Hz) of the mode by every method; none: the reason."""
    stage, described, (velocity, friction, _) = stage_named(name), STAGES[name], CASES[case]
    row: Row = {"stage": name, "case": case, "seed": seed}
    options: Row = {"velocity": velocity, "effects": FRICTION[friction]}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        rng = generator(name, seed, f"sweep {velocity}")
        swept = record_sweep(stage, SWEEPS[described], seconds=SWEEP_SECONDS, rng=rng, **options)
        row["frf"] = by_response(described, logged(swept, folder), "current_excitation")[MODE]
        for method, channels in CHANNELS.items() if friction == "with" else ():
            rng = generator(name, seed, f"{method} {velocity}")
            move = record(stage, seconds=SECONDS, rng=rng, **options)
            row[method] = by_channels(described, logged(move, folder), channels)[MODE]
    return row


def judge(name: str, rows: list[Row]) -> Row:
    """Compare the methods with the eigenvalue of a stage and with each other."""
    truth = {m.name: m.frequency_hz for m in closed_loop_modes(stage_named(name))}[MODE]
    by = {case: [row for row in rows if row["case"] == case] for case in CASES}
    cases = {case: {method: offset([row[method] for row in own], truth)
                    for method in METHODS if method in own[0]}
             for case, own in by.items() if own}  # fmt: skip
    passed = {}
    for case, found in cases.items():
        off = found["frf"]["mean_hz"] / truth
        if case == "turning back":
            passed[f"{case}: the response is too high"] = off > 20 * CLOSE
        else:
            passed[f"{case}: the response is right"] = abs(off) < CLOSE
        if case in WHY:
            passed[f"{case}: other methods keep it"] = min(found[m]["p"] for m in CHANNELS) > LEVEL
        if case == "constant friction":
            passed[f"{case}: nothing is off"] = found["frf"]["p"] > LEVEL
    return {"truth_hz": truth, "cases": cases, "passed": passed}


def offset(found: list[list[float] | str], truth: float) -> Row:
    """Return the mean offset from the truth (Hz), its error, its p, and intervals that hold."""
    seen = np.array([pair for pair in found if not isinstance(pair, str)], dtype=float)
    if not len(seen):
        return {"n": 0, "mean_hz": float("inf"), "error_hz": 0.0, "p": 0.0, "held": 0, "z": 0.0}
    off, std = seen[:, 0] - truth, seen[:, 1]
    scatter = float(off.std(ddof=1)) if len(off) > 1 else float(std[0])
    return {
        "n": len(seen),
        "mean_hz": float(off.mean()),
        "error_hz": scatter / len(off) ** 0.5,
        "median_std_hz": float(np.median(std)),
        "p": float(chi2.sf(np.sum((off / std) ** 2), len(off))),
        "held": int(np.sum(np.abs(off / std) < norm.ppf(0.975))),
        "z": float(np.sum(off / std) / len(off) ** 0.5),
    }


def claims(answer: Row) -> Iterator[Claim]:
    """Claim where the methods agree, where friction parts them, and what intervals then hold."""
    for name, stage in answer["stages"].items():
        cases, why = stage["cases"], dict[str, str]()
        for case, (text, control) in WHY.items():
            frf, least = cases[case]["frf"], min(cases[case][m]["p"] for m in CHANNELS)
            why[case] = f"; {text} {number(cases[control]['frf']['mean_hz'])} Hz"
            yield Claim(
                f"{name}: {MODE} of the response off the eigenvalue, {CASES[case][2]}",
                f"{number(frf['mean_hz'])} Hz",
                f"± {number(frf['error_hz'])} Hz, {frf['n']} logs",
                f"the others: smallest p {number(least)}{why[case]}",
                all(held for what, held in answer["passed"].items()
                    if what.startswith((f"{name}, {case}", f"{name}, {control}"))),
            )  # fmt: skip
        for case, method in [(case, method) for case, rows in cases.items() for method in rows]:
            row = cases[case][method]
            yield counted(
                f"{name}: 95 % intervals of {MODE} that hold the eigenvalue, {method}, "
                f"{CASES[case][2]}",
                row["held"],
                row["n"],
                f"mean offset {row['z']:+.1f} of its stated standard errors"
                + (why.get(case, "") if method == "frf" else ""),
                # Right intervals miss either bound in at most 1 of 400 sets of logs.
                met=row["held"] >= binom.ppf(0.0025, row["n"], 0.95)
                and abs(row["z"]) < norm.ppf(0.99875),
            )


if __name__ == "__main__":
    main()
