"""Do FRF, following error and accelerometers give the same natural frequencies?

Method
    A simulated stage moves at 10 mm/s. Its modes are identified (1) from the frequency response to
    a sine of constant current amplitude that sweeps while it moves, in a band around the modes,
    without a description, each from the sensor in which it is clearest (`read_frf`); (2) from the
    following error and (3) from the accelerometers of an undisturbed move (`identify`). Every
    method has logs of its own (20 s, sweeps 28 s), so that errors are independent. Differences over
    their standard deviation (z), between methods and from the eigenvalues of the closed loop, must
    be standard normal: chi-squared, and the mean over all seeds. Controls that must disagree: a
    response on a stage of 5 % less preload; the response to the motor's whole current, which has
    the poles of the stage without its servo.
Run time
    Seven minutes of processor time on two processors for 20 seeds of both stages.
"""

from __future__ import annotations

import os
import tempfile
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from lmshealth import identify, load_stage, read_frf, read_log
from lmshealth.io.log import Log
from lmshealth.modal.deterministic.frequency_response import FrfReading
from models.dynamics.plant import GUIDE_MODES, SENSORS
from models.dynamics.stages import NOMINAL, Condition, stage_named
from models.recordings.formats import write_log
from models.recordings.recording import Recording, record
from models.recordings.sweep import Sweep, record_sweep, without_loop
from studies.harness.claims import Claim, number
from studies.harness.cost import one_thread
from studies.harness.study import Row, Study

SECONDS = 20.0
# All of the travel at 10 mm/s, four periods long, around the guide modes; the amplitude is near
# the largest at which the platform never turns back.
SWEEP_SECONDS, PERIOD = 28.0, 7.0
SWEEPS = {
    "lms-y": Sweep(90.0, 180.0, amplitude=0.4, period=PERIOD),
    "lms-x": Sweep(70.0, 330.0, amplitude=0.4, period=PERIOD),
}
# Bands in which modes are read together.
BANDS: dict[str, dict[tuple[str, ...], tuple[float, float]]] = {
    "lms-y": {("roll", "pitch", "yaw"): (95.0, 175.0)},
    "lms-x": {("roll",): (74.0, 106.0), ("yaw",): (130.0, 190.0), ("pitch",): (225.0, 320.0)},
}
CHANNELS = {"delta_e": ("delta_e",), "accelerometers": ("acc_feed", "acc_pitch")}
METHODS = ("frf", *CHANNELS)
# So far from its description, in ln f, a mode of a response is still called by it.
SEARCH = 0.04
WORN = Condition(guide_preload=0.95)
# The modes that the paper ties to guide preload.
WATCHED = ("roll", "pitch")
# Of one pair of methods in one mode, two-sided.
LEVEL = 0.001
SEEN_BY_HALF = 0.5
# Of the quick form: one in which roll shows in the response.
QUICK_SEED = 5

Estimates = dict[str, tuple[float, float] | str]


def main() -> None:
    """Run the study; ``--quick`` does one seed of stage Y in this process, and records nothing."""
    study = Study(__file__, __doc__, seeds=20)
    seeds = [QUICK_SEED] if study.quick else range(study.options.seeds)
    names = ["lms-y"] if study.quick else list(SWEEPS)
    os.environ.update(one_thread())
    with study.pool() as pool:
        tasks = [(name, seed) for name in names for seed in seeds]
        rows = study.trials.collect(one_seed, tasks, pool=pool)
    stages = {name: summarise(name, [r for r in rows if r["stage"] == name]) for name in names}
    watched = stages["lms-y"]["modes"]
    answer = {
        "n_seeds": len(seeds),
        "stages": stages,
        "passed": {
            **{f"lms-y {m}: methods agree": watched[m]["verdict"] == "agree" for m in WATCHED},
            "controls disagree": all(
                control["disagrees"] for s in stages.values() for control in s["controls"].values()
            ),
        },
    }
    study.conclude(answer, details={"rows": rows})


def logged(recording: Recording, folder: Path) -> Log:
    """Write a recording as a log and read it as a user does."""
    path = folder / "log.h5"
    write_log(recording, path, "hdf5")
    return read_log(path)


def generator(name: str, seed: int, step: str) -> np.random.Generator:
    """Return the generator of one log."""
    return np.random.default_rng([seed, zlib.crc32(f"{name}/{step}".encode())])


def swept(name: str, seed: int, folder: Path, condition: Condition = NOMINAL) -> Log:
    """Return the log of a move during which a sine sweeps."""
    rng = generator(name, seed, f"sweep {condition.guide_preload}")
    stage, sweep = stage_named(name), SWEEPS[name]
    return logged(record_sweep(stage, sweep, condition, seconds=SWEEP_SECONDS, rng=rng), folder)


def read(name: str, log: Log, source: str, sensor: str, modes: tuple[str, ...]) -> FrfReading:
    """Read the response of a sensor to a current in the band of some modes."""
    return read_frf(log, source, sensor, band=BANDS[name][modes], period=PERIOD)


def by_response(name: str, log: Log, source: str) -> Estimates:
    """Return f and its standard deviation by the frequency response to a current."""
    best: dict[str, tuple[float, float, float]] = {}
    for sensor, names in product(SENSORS, BANDS[name]):
        modes = read(name, log, source, sensor, names).modes
        sought = [mode for mode in load_stage(name).modes if mode.name in names]
        rows = np.stack([modes.frequency, modes.frequency_std, modes.snr], axis=-1)
        for f, std, snr in rows.tolist():
            off, mode = min((abs(np.log(f / m.frequency_hz)), m.name) for m in sought)
            # The clearest sensor, not the one that happens to be the most certain.
            if off < SEARCH and (mode not in best or snr > best[mode][2]):
                best[mode] = (f, std, snr)
    return {m: best[m][:2] if m in best else "not seen in the response" for m in GUIDE_MODES}


def by_channels(name: str, log: Log, channels: tuple[str, ...]) -> Estimates:
    """Return f and its standard deviation from channels of an undisturbed move."""
    modes = identify(log, load_stage(name), channels=channels)
    found: Estimates = {refusal.mode: refusal.reason for refusal in modes.refused if refusal.mode}
    rows = zip(modes.frequency.tolist(), modes.frequency_std.tolist(), strict=True)
    found |= dict(zip(modes.names, rows, strict=True))
    return {mode: found.get(mode, "not reported") for mode in GUIDE_MODES}


def one_seed(name: str, seed: int) -> Row:
    """Return the estimates of all methods and controls for one seed."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        log = swept(name, seed, folder)
        error = next(c.values[:] for c in log.channels if c.name == "delta_e")
        row: Row = {
            "stage": name,
            "seed": seed,
            "sweep_delta_e_max_um": float(1e6 * np.abs(error - error.mean()).max()),
            "frf": by_response(name, log, "current_excitation"),
            "frf_whole_current": by_response(name, log, "current"),
        }
        for method, channels in CHANNELS.items():
            rng = generator(name, seed, method)
            move = record(stage_named(name), seconds=SECONDS, rng=rng)
            row[method] = by_channels(name, logged(move, folder), channels)
        row["frf_worn"] = by_response(name, swept(name, seed, folder, WORN), "current_excitation")
    return row


def estimate(row: Row, method: str, mode: str) -> Any:
    """Return what a method has of a mode: f and its standard deviation, or why it has none."""
    return row[method][mode]


def scores(rows: list[Row], first: str, second: Callable[[Row], Any], mode: str) -> Row:
    """Test differences of two estimates of a mode over the seeds in which both have it."""
    pairs = [(row[first][mode], second(row)) for row in rows]
    both = [(a, b) for a, b in pairs if not isinstance(a, str) and not isinstance(b, str)]
    if not both:
        return {"n": 0}
    (f, std), (other, other_std) = np.moveaxis(np.array(both), 0, -1)
    z = (f - other) / np.hypot(std, other_std)
    total, n, mean = float(np.sum(z**2)), len(both), float(z.mean() * np.sqrt(len(both)))
    return {
        "n": n,
        "mean_difference_hz": float(np.mean(f - other)),
        "z_of_mean": mean,
        "z_rms": float(np.sqrt(total / n)),
        "p": float(chi2.sf(total, n)),
        "p_of_mean": float(chi2.sf(mean**2, 1)),
    }


def summarise(name: str, rows: list[Row]) -> Row:
    """Compare the methods with each other and with the eigenvalues."""
    modes, loop = {}, without_loop(stage_named(name))
    for mode in GUIDE_MODES:
        closed, alone = loop[mode]
        modes[mode] = compare(rows, mode, closed.frequency_hz) | {
            "damping_ratio": closed.damping_ratio,
            "without_servo_hz": float(abs(alone) / (2 * np.pi)),
            "without_servo_damping_ratio": float(-alone.real / abs(alone)),
        }
    largest = max(row["sweep_delta_e_max_um"] for row in rows)
    control = controls(rows, modes["pitch"])
    return {"sweep_delta_e_max_um": largest, "modes": modes, "controls": control}


def compare(rows: list[Row], mode: str, truth: float) -> Row:
    """Compare the methods in one mode, and say what follows."""
    methods: Row = {}
    for method in METHODS:
        kept = [row[method][mode] for row in rows if not isinstance(row[method][mode], str)]
        refused = sorted({row[method][mode] for row in rows if isinstance(row[method][mode], str)})
        methods[method] = {"n_seen": len(kept), "refused": refused}
        if kept:
            methods[method]["median_std_hz"] = float(np.median([std for _, std in kept]))
            methods[method]["against_truth"] = scores(rows, method, lambda row: (truth, 0.0), mode)
    seen = [m for m in METHODS if methods[m]["n_seen"] >= SEEN_BY_HALF * len(rows)]
    pairs = {
        f"{a} - {b}": scores(rows, a, partial(estimate, method=b, mode=mode), mode)
        for a, b in combinations(seen, 2)
    }
    agreed = all(pair["n"] and min(pair["p"], pair["p_of_mean"]) > LEVEL for pair in pairs.values())
    verdict = ("agree" if agreed else "disagree") if pairs else "not comparable"
    return {"truth_hz": truth, "verdict": verdict, "seen_by": seen, "methods": methods,
            "pairs": pairs}  # fmt: skip


def controls(rows: list[Row], pitch: Row) -> Row:
    """Return the comparisons that must fail, on pitch: it is seen by all and moved by the loop."""
    closed = pitch["truth_hz"]
    worn = scores(rows, "frf_worn", lambda row: row["delta_e"]["pitch"], "pitch")
    whole = scores(rows, "frf_whole_current", lambda row: (closed, 0.0), "pitch")
    whole["expected_difference_hz"] = pitch["without_servo_hz"] - closed
    found = {
        "response at preload 0.95 against delta_e at 1": worn,
        "response to the whole current against the closed loop": whole,
    }
    for control in found.values():
        control["disagrees"] = bool(control["n"] and control["p"] < LEVEL)
    return found


def claims(answer: Row) -> Iterator[Claim]:
    """Claim that three methods agree, and which mode which of them shows."""
    for name, stage in answer["stages"].items():
        controls = all(row["disagrees"] for row in stage["controls"].values())
        for mode, row in stage["modes"].items():
            seen = ", ".join(f"{method} {own['n_seen']}" for method, own in row["methods"].items())
            least = [min(pair["p"], pair["p_of_mean"]) for pair in row["pairs"].values()]
            yield Claim(
                f"{name}: methods that show {mode} agree, of {answer['n_seeds']} logs each",
                f"{row['verdict']} ({seen})",
                f"smallest p {number(min(least))}, refused below 0.001" if least else "",
                "both controls disagree" if controls else "controls are not found out",
                row["verdict"] != "disagree" and controls,
            )


if __name__ == "__main__":
    main()
