"""Does the chain stay honest on raw logs of machines that differ from the shipped map?

Method
    Machines of lms-y are drawn by plant seeds: geometry, joints, contact exponent, thermal lag,
    self-heating, sensor, wander, amplitude dependence and running-in (models/lives, "Machines that
    differ"). Each has 16 logs of 20 s at 20 kHz in the closed loop. Five worlds: machines without
    wear; the same with a structure far behind its sensor, with a payload that no log states, and
    with an amplitude dependence that grows; machines that wear by laws of their own. The
    description has the frequencies of the new machine, as its user would enter them, and the
    shipped map and laws. Logs are identified and assessed as by `lmshealth run`.
    A machine that keeps 99 % of all health is unchanged, and an alarm on it is false; a verdict of
    wear is wrong if it names a part that is not degraded. Judged besides: 90 % intervals of the
    drifts of all modes after the last log, and of the health that is published. Controls: nominal
    machines without wear, which must be calm and held; intervals a third as wide, which must not
    hold.
Run time
    Some hours on one processor; a life with a step takes minutes.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import msgspec
import numpy as np

from lmshealth import LogEstimates, assess, identify, load_stage, read_log
from lmshealth.calibration.ranks import share_row
from lmshealth.io.constants import LAST_MOMENT
from lmshealth.io.manifest import find_logs, read_manifest
from lmshealth.life.verdict import degraded_below, verdict_of
from lmshealth.signal.readings import loop_error
from lmshealth.stage.description import Stage
from models.dynamics.plant import GUIDE_MODES, closed_loop_modes
from models.lives.simulation import Plan, simulate_life
from studies.harness.claims import Claim, counted
from studies.harness.data.lives import SECONDS, life_of
from studies.harness.study import Row, Study
from studies.robustness.drawn_machines.machines import InService

STAGE, FIRST_SEED, LIVES, LOGS = "lms-y", 2000, 12, 16
DRAWN = ("healthy", "thermal-lag", "payload-not-logged", "amplitude-growth", "drawn")
NOMINAL = "nominal machines"
UNCHANGED, SURE = 0.99, 0.95
# Asked for: false alarms and wrong sure verdicts, intervals of 90 % that hold.
MOST_ALARMS, MOST_WRONG, LEAST_HELD = 0.02, 0.02, 0.85
_PAYLOAD = (
    "a payload that is carried for many logs and stated in none moves all modes as a step does; "
    "16 logs do not show that it returns"
)
_GROWTH = "an amplitude dependence that grows lowers ln f as wear does, at every amplitude"
NOT_MET = {
    **dict.fromkeys((f"{what}: payload-not-logged" for what in ("false alarms", "health held")),
                    _PAYLOAD),
    **dict.fromkeys((f"{what}: amplitude-growth" for what in ("wrong and sure", "drifts held")),
                    _GROWTH),
}  # fmt: skip
_LEVELS, _REACH, _NARROWER = (0.05, 0.5, 0.95), 1.6448536, 3.0


def main() -> None:
    """Run the study; ``--quick`` takes one short life of two worlds and records nothing."""
    study = Study(__file__, __doc__)
    lives, logs, seconds = (1, 6, 6.0) if study.quick else (LIVES, LOGS, SECONDS)
    worlds = (NOMINAL, "drawn") if study.quick else (NOMINAL, *DRAWN)
    tasks = [(world, FIRST_SEED + k) for world in worlds for k in range(lives)]
    with study.pool() as pool:
        rows = study.trials.collect(partial(one, logs=logs, seconds=seconds), tasks, pool=pool)
    answer: Row = {
        "worlds": {name: summary([row for row in rows if row["world"] == name]) for name in worlds},
        "drawn machines": summary([row for row in rows if row["world"] != NOMINAL]),
    }
    answer["passed"] = verdicts(answer)
    study.conclude(answer, details={"rows": rows}, not_met=NOT_MET, quick_may_fail=True)


def plan_of(world: str, seed: int, logs: int, seconds: float) -> Plan:
    """Plan a life of a world, which is looked at before its first limit."""
    kind, plant_seed = ("healthy", None) if world == NOMINAL else (world, seed)
    return InService(STAGE, kind, logs, seconds, seed, plant_seed=plant_seed)


def described(plan: Plan) -> Stage:
    """Return the shipped description with the frequencies and dampings of the new machine."""
    stage = load_stage(plan.stage)
    new = {mode.name: mode for mode in closed_loop_modes(plan.machine().stage)}
    own = [
        msgspec.structs.replace(
            spec,
            frequency_hz=new[spec.name].frequency_hz,
            damping_ratio=new[spec.name].damping_ratio,
        )
        for spec in stage.modes
    ]
    return replace(stage, description=msgspec.structs.replace(stage.description, mode=tuple(own)))


def one(world: str, seed: int, logs: int, seconds: float) -> Row:
    """Simulate, identify and assess one life, and compare with its truth."""
    plan = plan_of(world, seed, logs, seconds)
    life, stage = life_of(plan), described(plan)
    made = assess(read(plan, stage), stage, seed=seed)
    truth = life.health[-1] / life.health[0]
    row: Row = {
        "world": world,
        "seed": seed,
        "least_health": float((life.health.min(axis=0) / life.health[0]).min()),
        "verdict": made.judgement.verdict,
        "surely_wrong": bool(made.judgement.probability > SURE)
        and names_sound_part(stage, made.judgement.verdict, truth),
        "alarm": made.track is not None and bool(made.track.alarms),
        "doubt": bool(made.doubt),
        "drifts": [],
        "health": {},
    }
    found, present = made.track, made.health
    if found is not None and len(found.logs) == logs:
        std = np.sqrt(np.einsum("ii->i", found.drift_cov[-1]))
        true = [life.drift[-1, GUIDE_MODES.index(mode)] for mode in found.modes]
        row["drifts"] = (np.abs(found.drift[-1] - true) / std).tolist()
    if present is not None:
        for j in np.flatnonzero(present.publishable_parameters()).tolist():
            cuts = np.quantile(present.samples[-1, :, j], _LEVELS).tolist()
            row["health"][present.parameters[j]] = [*cuts, float(truth[j])]
    return row


def read(plan: Plan, stage: Stage) -> list[LogEstimates]:
    """Simulate the logs of a life and identify them."""
    readings = []
    with tempfile.TemporaryDirectory() as folder:
        simulate_life(plan, Path(folder))
        manifest = read_manifest(Path(folder))
        for path in find_logs(Path(folder)).logs:
            log = read_log(
                path, overrides=manifest.overrides(path), name=path.name, latest=LAST_MOMENT
            )
            modes = identify(log, stage)
            readings.append(
                LogEstimates(log.name, log.digest, log.metadata, modes, loop_error(log))
            )
    return readings


def names_sound_part(stage: Stage, verdict: str, truth: np.ndarray) -> bool:
    """Return whether a verdict names a part that is not degraded."""
    sound = {p.word for p, x in zip(stage.parameters, truth, strict=True) if x >= degraded_below(p)}
    return any(verdict in (verdict_of((word,)), "both") for word in sound)


def summary(rows: list[Row]) -> Row:
    """Count what lives of a world raise, and what their intervals hold."""
    calm = [row for row in rows if row["least_health"] > UNCHANGED]
    scores = np.array([z for row in rows for z in row["drifts"]])
    health = [cuts for row in rows for cuts in row["health"].values()]
    result: Row = {
        "n": len(rows),
        "alarms": sum(row["alarm"] for row in rows),
        "false_alarms": share_row(sum(row["alarm"] for row in calm), len(calm)) if calm else None,
        "wrong_sure": share_row(sum(row["surely_wrong"] for row in rows), len(rows)),
        "with_health": sum(bool(row["health"]) for row in rows),
    }
    for key, reach in (("", 1.0), ("_narrow", _NARROWER)):
        drifts, held = int((scores < _REACH / reach).sum()), sum(holds(c, reach) for c in health)
        result["drift_held" + key] = share_row(drifts, scores.size) if scores.size else None
        result["health_held" + key] = share_row(held, len(health)) if health else None
    return result


def holds(cuts: list[float], narrower: float) -> bool:
    """Return whether an interval, so many times as narrow about its median, holds the truth."""
    low, middle, high, true = cuts
    return middle - (middle - low) / narrower <= true <= middle + (high - middle) / narrower


def verdicts(answer: Row) -> dict[str, bool]:
    """Return what was asked of every world, and of the controls."""
    checks: dict[str, bool] = {}
    for name, row in answer["worlds"].items():
        false, held, drift = row["false_alarms"], row["health_held"], row["drift_held"]
        checks[f"false alarms: {name}"] = false is None or false["share"] <= MOST_ALARMS
        checks[f"wrong and sure: {name}"] = row["wrong_sure"]["share"] <= MOST_WRONG
        checks[f"health held: {name}"] = held is not None and held["share"] >= LEAST_HELD
        checks[f"drifts held: {name}"] = drift is not None and drift["share"] >= LEAST_HELD
    narrow = answer["drawn machines"]["drift_held_narrow"]
    checks["a third as wide does not hold (control)"] = (
        narrow is not None and narrow["high"] < LEAST_HELD
    )
    return checks


def claims(answer: Row) -> Iterator[Claim]:
    """Claim alarms, verdicts and intervals of every world."""
    passed, narrow = answer["passed"], answer["drawn machines"]["drift_held_narrow"]
    for name, row in answer["worlds"].items():
        false, wrong = row["false_alarms"], row["wrong_sure"]
        beside = f"{wrong['hits']} of {wrong['n']} surely worn and wrong; "
        beside += f"{row['alarms']} of {row['n']} alarm, "
        beside += f"false {false['hits']} of {false['n']}" if false else "none is unchanged"
        held = row["health_held"] or {"hits": 0, "n": 0}
        beside += f"; {row['with_health']} with health, {held['hits']} of {held['n']} held"
        met = all(fine for check, fine in passed.items() if check.endswith(f": {name}"))
        drift = row["drift_held"]
        yield counted(
            f"raw logs, {name}: drifts held at 90 %", drift["hits"], drift["n"], beside, met=met
        )
    yield counted(
        "raw logs, drawn machines: drifts held by intervals a third as wide (control)",
        narrow["hits"],
        narrow["n"],
        met=passed["a third as wide does not hold (control)"],
    )


if __name__ == "__main__":
    main()
