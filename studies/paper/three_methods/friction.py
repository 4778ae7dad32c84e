"""Where does friction part the frequency response from following error and accelerometers?

Method
    The full stage Y with all effects (friction with presliding, cable, gusts, hits, orders) moves
    at 10 and at 1 mm/s. Its pitch is identified as in `run.py`: from the frequency response to a
    sweep of 0.4 A, from the following error, and from the accelerometers of an undisturbed move,
    with logs of their own. At 10 mm/s the platform never turns back: the methods must agree, and
    the response may be off the eigenvalue by a hundredth of a percent. At 1 mm/s the sweep turns
    it back, friction then holds it on springs, and the response must have pitch too high; the
    methods without excitation must keep it. Control: without friction the response at 1 mm/s has
    it right.
Run time
    Seven minutes on one busy processor.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
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

# The description of the rigid stage: its guide modes are those of the full one within 0.03 %.
STAGE, DESCRIBED, MODE = "lms-y-full", "lms-y", "pitch"
FRICTION = {
    "with": FULL,
    "without": replace(FULL, friction=FrictionParameters(scale=0.0, viscous=0.0, cable_drag=0.0)),
}
FAST, SLOW, CONTROL = (0.010, "with"), (0.001, "with"), (0.001, "without")
# Of the frequency, that the response may be off where the platform never turns back.
CLOSE = 1e-4


def main() -> None:
    """Run the study; ``--quick`` does one seed in this process, and records nothing."""
    study = Study(__file__, __doc__, seeds=8)
    seeds = range(1 if study.quick else study.options.seeds)
    os.environ.update(one_thread())
    with study.pool(1) as pool:
        tasks = [(*case, seed) for case in (FAST, SLOW, CONTROL) for seed in seeds]
        rows = study.trials.collect(one_seed, tasks, pool=pool)
    study.conclude({"n_seeds": len(seeds), **judge(rows)}, details={"rows": rows})


def one_seed(velocity: float, friction: str, seed: int) -> Row:
    """Return f and its standard deviation (Hz) of the mode by every method; none: the reason."""
    stage, effects = stage_named(STAGE), FRICTION[friction]
    row: Row = {"velocity": velocity, "friction": friction, "seed": seed}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        rng = generator(STAGE, seed, f"sweep {velocity}")
        swept = record_sweep(
            stage, SWEEPS[DESCRIBED], seconds=SWEEP_SECONDS, velocity=velocity, rng=rng,
            effects=effects,
        )  # fmt: skip
        row["frf"] = by_response(DESCRIBED, logged(swept, folder), "current_excitation")[MODE]
        if (velocity, friction) == CONTROL:
            return row
        for method, channels in CHANNELS.items():
            rng = generator(STAGE, seed, f"{method} {velocity}")
            move = record(stage, seconds=SECONDS, velocity=velocity, rng=rng, effects=effects)
            row[method] = by_channels(DESCRIBED, logged(move, folder), channels)[MODE]
    return row


def judge(rows: list[Row]) -> Row:
    """Compare the methods with the eigenvalue and with each other."""
    modes = {mode.name: mode.frequency_hz for mode in closed_loop_modes(stage_named(STAGE))}
    truth = modes[MODE]
    cases = {
        name: {
            method: offset([row[method] for row in rows if key(row) == case], truth)
            for method in (METHODS if case != CONTROL else ("frf",))
        }
        for name, case in {"moving": FAST, "turning back": SLOW, "control": CONTROL}.items()
    }
    moving, turning, control = cases.values()
    return {
        "mode": MODE,
        "truth_hz": truth,
        "cases": cases,
        "passed": {
            "moving: the response is right": abs(moving["frf"]["mean_hz"]) < CLOSE * truth,
            "moving: methods agree": min(moving[m]["p"] for m in CHANNELS) > LEVEL,
            "turning back: the response is too high": turning["frf"]["mean_hz"]
            > 20 * CLOSE * truth,
            "turning back: other methods keep it": min(turning[m]["p"] for m in CHANNELS) > LEVEL,
            "control: without friction it is right": abs(control["frf"]["mean_hz"]) < CLOSE * truth,
        },
    }


def key(row: Row) -> tuple[float, str]:
    """Return the case of a row."""
    return row["velocity"], row["friction"]


def offset(found: list[list[float] | str], truth: float) -> Row:
    """Return the mean offset from the truth (Hz), its error, and the chance of all offsets."""
    seen = np.array([pair for pair in found if not isinstance(pair, str)], dtype=float)
    if not len(seen):
        return {"n": 0, "mean_hz": float("inf"), "error_hz": 0.0, "p": 0.0}
    off, std = seen[:, 0] - truth, seen[:, 1]
    scatter = float(off.std(ddof=1)) if len(off) > 1 else float(std[0])
    return {
        "n": len(seen),
        "mean_hz": float(off.mean()),
        "error_hz": scatter / len(off) ** 0.5,
        "median_std_hz": float(np.median(std)),
        "p": float(chi2.sf(np.sum((off / std) ** 2), len(off))),
    }


def scores(answer: Row, case: tuple[float, str], method: str) -> NDArray[np.float64]:
    """Return the offset of every log from the truth over its stated standard deviation."""
    found = [row[method] for row in answer["rows"] if key(row) == case]
    seen = np.array([pair for pair in found if not isinstance(pair, str)], dtype=float)
    return np.asarray((seen[:, 0] - answer["truth_hz"]) / seen[:, 1])


def claims(answer: Row) -> Iterator[Claim]:
    """Claim where the methods agree, where friction parts them, and what intervals then hold."""
    passed, cases = answer["passed"], answer["cases"]
    for name, text in (("moving", "at 10 mm/s"), ("turning back", "at 1 mm/s")):
        rows = cases[name]
        least = min(rows[method]["p"] for method in CHANNELS)
        beside = f"the others: smallest p {number(least)}"
        if name == "turning back":
            beside += f"; without friction {number(cases['control']['frf']['mean_hz'])} Hz"
        yield Claim(
            f"lms-y-full with friction: pitch of the response off its eigenvalue, {text}",
            f"{number(rows['frf']['mean_hz'])} Hz",
            f"± {number(rows['frf']['error_hz'])} Hz, {answer['n_seeds']} logs",
            beside,
            all(held for what, held in passed.items() if what.startswith((name, "control"))),
        )
    for case, text in ((FAST, "at 10 mm/s"), (SLOW, "at 1 mm/s"), (CONTROL, "control")):
        for method in METHODS if case != CONTROL else ("frf",):
            z = scores(answer, case, method)
            hits, mean = int(np.sum(np.abs(z) < norm.ppf(0.975))), z.sum() / len(z) ** 0.5
            yield counted(
                f"lms-y-full: 95 % intervals of pitch that hold the eigenvalue, {method}, {text}",
                hits,
                len(z),
                f"mean offset {mean:+.1f} of its stated standard errors",
                # Right intervals miss either bound in at most 1 of 400 sets of logs.
                met=hits >= binom.ppf(0.0025, len(z), 0.95) and abs(mean) < norm.ppf(0.99875),
            )


if __name__ == "__main__":
    main()
