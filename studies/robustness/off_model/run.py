"""Does the tracker stay honest where machines and logs are not as its model assumes?

Method
    Lives of 40 logs of worlds that `worlds.py` draws without the estimator's laws: wander of
    the modes between logs, stated errors that are wrong, outliers, a structure that lags behind
    its temperature sensor, covariates that are not logged or drift, logs of two machines,
    running-in, shocks, late acceleration. Frequencies follow the true preload by the shipped
    map. Judged are alarms, undeclared steps, 90 % intervals of the drifts of all modes after
    the last log, their median width, and the log of the first alarm where 5 % of preload is
    lost. Control, which must fail: lives of some worlds without wander, outliers, running-in, lag
    and wide scales, as the tracker was before these were added.
Run time
    Twenty-five minutes on one processor.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from functools import cache
from unittest.mock import patch

import numpy as np

from lmshealth.calibration.ranks import share_row
from lmshealth.stage.description import Stage, load_stage
from lmshealth.tracking import constants
from lmshealth.tracking.track import track
from studies.harness.claims import Claim, counted, number
from studies.harness.study import Row, Study
from studies.robustness.off_model.worlds import COURSES, DISTURBANCES, MODES, life_of

LIVES, QUICK_LIVES = 100, 2
LOSING = ", losing 5 %"
# Worlds that lose 5 % of preload: what detection costs, and whether drifts are held.
LOSERS = tuple(
    name + LOSING for name in ("control", "wander 0.5 sd, 5 logs", "scatter 4", "lag 8 h")
)
# Worlds of the control: what the tracker allows for was added for them.
CONTROLS = (
    "wander 3 sd, 5 logs", "scatter 4", "outliers 5 %, 10 sd", "lag 24 h", "running-in",
    "control" + LOSING,
)  # fmt: skip
QUICK = ("control", "wander 3 sd, 5 logs", "outliers 5 %, 10 sd", "control" + LOSING)
_DRIFT = "a drift of the sensor is a change of ln f like any other"
_SLOW = "a wander that is slow, or moves all modes alike, is taken for a change of the machine"
_SEVERAL = (
    "2 of 100 were allowed; a rate of 2 % gives 5 or more in one of twenty samples, and all stable "
    "worlds together have fewer"
)
_NO_DRIFT = ("sensor drifts by 5 K", "two machines mixed")  # not separable from damage
NOT_MET = {
    **{f"alarms: {name}": _SEVERAL for name in ("lag 24 h", "amplitude", "running-in")},
    "alarms: wander 3 sd, 5 logs, in common": _SEVERAL,
    "alarms: outliers 5 %, 10 sd": _SEVERAL,
    "held: wander 3 sd, 12 logs": _SLOW,
    "held: wander 3 sd, 5 logs, in common": _SLOW,
    "alarms: sensor drifts by 5 K": _DRIFT,
    "held: sensor drifts by 5 K": _DRIFT,
    "alarms: two machines mixed": (
        "two populations 1 % apart that alternate at random look as a step does; a mixture of two "
        "levels as a regime of its own is the best idea left"
    ),
}
# Lives that alarm and drifts that are held, asked for in stable worlds; detection and width asked
# for where the model is right, over those of the control.
MOST_ALARMS, LEAST_HELD, MOST_LATER, MOST_WIDER = 0.02, 0.85, 1.3, 1.25
_REACH = 1.6448536  # standard deviations of a 90 % interval
_BEFORE = {
    "WANDERS": ((0.0, 0.0, 1.0),),
    "RUNNING_IN_LOGS": (),
    "OUTLIER_GATE": np.inf,
    "LEAST_CYCLE": np.inf,
    "RATE_COMMON": 0.0,
    "SOURCE_NOISE_SCALES": (
        (0.5, 0.02), (0.7, 0.05), (1.0, 0.8), (1.5, 0.08), (2.25, 0.03), (4.0, 0.02),
    ),
}  # fmt: skip


def main() -> None:
    """Run the study; ``--quick`` does two lives of some worlds and records nothing."""
    study = Study(__file__, __doc__)
    names = QUICK if study.quick else (*DISTURBANCES, *COURSES, *LOSERS)
    n = QUICK_LIVES if study.quick else LIVES
    rows = study.trials.collect(of_world, [(name, n, False) for name in names])
    controls = [(name, n, True) for name in names if name in CONTROLS]
    before = study.trials.collect(of_world, controls)
    answer: Row = {"worlds": rows, "control": before}
    answer["passed"] = verdicts(rows, before)
    study.conclude(answer, not_met=NOT_MET, quick_may_fail=True)


@cache
def machine() -> Stage:
    """Load the description once."""
    return load_stage("lms-y")


def of_world(name: str, n: int, before: bool) -> Row:
    """Draw, track and judge so many lives of a world, by the tracker or by the control."""
    drift_held = alarms = steps = 0
    widths, firsts = [], []
    with ExitStack() as stack:
        for key, value in _BEFORE.items() if before else ():
            stack.enter_context(patch.object(constants, key, value))
        for seed in range(n):
            life = life_of(name, seed, machine())
            found = track(life.history, machine())
            std = np.sqrt(np.einsum("ii->i", found.drift_cov[-1]))
            off = np.abs(found.drift[-1] - life.drift[-1])
            drift_held += int(np.sum(off < _REACH * std))
            widths.append(float(std.mean()))
            alarms += bool(found.alarms)
            firsts.append(found.alarms[0].epoch if found.alarms else len(found.logs))
            steps += any(e.kind == "step" and not e.declared for e in found.events)
    return {
        "name": name,
        "alarms": share_row(alarms, n),
        "steps": share_row(steps, n),
        "drift_held": drift_held / (n * len(MODES)),
        "drift_std": float(np.median(widths)),
        "logs_until_alarm": float(np.mean(firsts)),
    }


def verdicts(rows: list[Row], before: list[Row]) -> dict[str, bool]:
    """Return what was asked: of every stable world, of the cost, and of the control."""
    by_name, old = ({row["name"]: row for row in part} for part in (rows, before))
    checks: dict[str, bool] = {}
    for name in (*DISTURBANCES, "running-in"):
        if name in by_name:
            checks[f"alarms: {name}"] = by_name[name]["alarms"]["share"] <= MOST_ALARMS
            checks[f"held: {name}"] = by_name[name]["drift_held"] >= LEAST_HELD
    losing = "control" + LOSING
    later, wider = costs(rows, before)
    checks["a loss of 5 % is found hardly later"] = later <= MOST_LATER
    checks["drifts are hardly wider"] = wider <= MOST_WIDER
    checks["a loss of 5 % is found"] = by_name[losing]["alarms"]["share"] >= 0.95
    wander = old["wander 3 sd, 5 logs"]
    checks["without wander healthy lives alarm (control)"] = wander["alarms"]["share"] > 0.5
    return checks


def costs(rows: list[Row], before: list[Row]) -> tuple[float, float]:
    """Return logs until the alarm and widths of drifts, over those of the control."""
    by_name, old = ({row["name"]: row for row in part} for part in (rows, before))
    losing = "control" + LOSING
    ratio = {key: by_name[losing][key] / old[losing][key]
             for key in ("logs_until_alarm", "drift_std")}  # fmt: skip
    return ratio["logs_until_alarm"], ratio["drift_std"]


def claims(answer: Row) -> Iterator[Claim]:
    """Claim alarms and coverage of every world, beside those of the control."""
    old = {row["name"]: row for row in answer["control"]}
    passed = answer["passed"]
    for row in answer["worlds"]:
        name, beside = row["name"], ""
        if name in old:
            alarm, held = (100 * x for x in (old[name]["alarms"]["share"], old[name]["drift_held"]))
            beside = f"; control: {alarm:.0f} % alarm, {held:.0f} % are held"
        yield counted(
            f"lives that alarm: {name}",
            row["alarms"]["hits"],
            row["alarms"]["n"],
            f"{100 * row['drift_held']:.0f} % of drifts are held (90 % intervals){beside}",
            met=passed.get(f"alarms: {name}", True) and passed.get(f"held: {name}", True),
        )
    calm = [row for row in answer["worlds"] if row["name"] in DISTURBANCES]
    calm = [row for row in calm if row["name"] not in _NO_DRIFT]
    yield counted(
        f"lives that alarm in {len(calm)} stable worlds together",
        sum(row["alarms"]["hits"] for row in calm),
        sum(row["alarms"]["n"] for row in calm),
        "without the drifting sensor and the two machines mixed",
    )
    later, wider = costs(answer["worlds"], answer["control"])
    yield Claim(
        "logs until 5 % of preload lost is found, over the control",
        number(later),
        f"drifts {number(wider)} times as wide",
        "1.3 and 1.25 asked",
    )


if __name__ == "__main__":
    main()
