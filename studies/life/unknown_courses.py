"""Does the remaining life hold where wear takes a course that no law of the description has?

Method
    Preloads that lose 40 % over a life of about 2,500 km (lognormal, 0.4) in courses drawn without
    the laws of the estimator: late acceleration (10 to 30 % of the loss even, the rest with a power
    of 5 to 9), bathtub (running-in of 2 to 5 %, as much even, the rest with a power of 7 to 11),
    onset (nothing, then even from 15 to 60 % of the life on), and as controls an even loss and a
    power of 0.8 to 1.3. 40 logs from the start to 50, 70 or 90 % of the life, with errors of roll,
    pitch and yaw as identified, and a temperature of the seasons. Beside each prognosis the one of
    the named laws alone, with their rates for ever, as it was before. A service is too late if the
    limit is reached before the travel at which the risk is 5 %; a log announces the end if one of
    the interval advised falls between the loss of half of the margin and the end.
Answer
    Yes: 173 of 180 intervals hold in courses that no law has (before 41), 177 of 180 services are
    in time (before 43). Where a law is right widths of health are those of before, and scores at
    70 % of life 0.94 (linear) and 1.18 times (power) those of before, from 20 lives each.
Run time
    Half an hour of one processor.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from unittest.mock import patch

import msgspec
import numpy as np
from lmshealth.prognosis import constants
from lmshealth.prognosis.maintenance_decision import decide
from lmshealth.prognosis.remaining_life import prognose
from lmshealth.prognosis.results import Prognosis

from lmshealth.stage.description import Stage, load_stage
from lmshealth.tracking.history import History
from studies.harness.claims import Claim, counted, number
from studies.harness.data.histories import make_history
from studies.harness.metrics import crps
from studies.harness.study import Row, Study
from studies.robustness.off_model.worlds import (
    LN_F,
    LN_ZETA,
    LOST_AT_LIMIT,
    MODES,
    STD_F,
    STD_ZETA,
    Array,
)

SEED, N_LIVES, N_LOGS = 20261123, 60, 40
SHARES, MAIN = (0.5, 0.7, 0.9), 0.7
BROKEN, RIGHT = ("late", "bathtub", "onset"), ("linear", "power")
LIFE_KM, RISK = (2500.0, 0.4), 0.05
HELD, LATE, MORE_CRPS, WIDER = 0.8, 0.1, 1.2, 1.25  # required
NEW, BEFORE = "now", "named laws alone"
_KM = 1000.0


def main() -> None:
    """Run the study; ``--quick`` takes two lives that accelerate and records nothing."""
    study = Study(__file__, __doc__)
    tasks = [(kind, k) for k in range(N_LIVES) for kind in (*BROKEN, *RIGHT)]
    if study.quick:
        tasks = [("late", k) for k in range(2)]
    rows = study.trials.collect(one, tasks)
    kinds = dict.fromkeys(kind for kind, _ in tasks)
    answer: Row = {
        "seed": SEED,
        "courses": {kind: summed([row for row in rows if row["kind"] == kind]) for kind in kinds},
    }
    answer["passed"] = {} if study.quick else verdicts(answer["courses"])
    study.conclude(answer)


@cache
def machine() -> Stage:
    """Load the stage that all lives are of."""
    return load_stage("lms-y")


@cache
def as_before() -> Stage:
    """Return the stage with the laws that it had before, at equal weights."""
    preload, *others = machine().parameters
    laws = [law for law in preload.laws if law.kind != "accelerating"]
    equal = tuple(msgspec.structs.replace(law, weight=1.0) for law in laws)
    parameters = (msgspec.structs.replace(preload, law=equal), *others)
    description = msgspec.structs.replace(machine().description, parameter=parameters)
    return replace(machine(), description=description)


def course(rng: np.random.Generator, kind: str) -> Callable[[Array], Array]:
    """Draw the lost share of the preload over the share of the life, which ends at 1."""
    full = LOST_AT_LIMIT
    if kind == "late":
        slow, power = rng.uniform(0.1, 0.3), rng.uniform(5, 9)
        return lambda u: full * (slow * u + (1 - slow) * u**power)
    if kind == "bathtub":
        early, even, power = *rng.uniform(0.02, 0.05, 2), rng.uniform(7, 11)
        rest = full - early - even
        return lambda u: early * -np.expm1(-u / 0.03) + even * u + rest * u**power
    if kind == "onset":
        onset = rng.uniform(0.15, 0.6)
        return lambda u: full * np.maximum(u - onset, 0.0) / (1 - onset)
    power = rng.uniform(0.8, 1.3) if kind == "power" else 1.0
    return lambda u: full * u**power


def life_of(kind: str, number_: int) -> tuple[History, float, float]:
    """Draw a life: its logs, what is left of it in m, and until half of the margin is lost."""
    rng = np.random.default_rng([SEED, number_, zlib.crc32(kind.encode())])
    share, lost = SHARES[number_ % len(SHARES)], course(rng, kind)
    length = _KM * LIFE_KM[0] * np.exp(LIFE_KM[1] * rng.standard_normal())
    u = share * np.r_[0.0, np.sort(rng.uniform(size=N_LOGS - 2)), 1.0]
    x = np.tile(machine().baseline_point, (N_LOGS, 1))
    x[:, 0] += np.log1p(-lost(u))
    temperature = 21 + 6 * np.sin(np.linspace(0, 6.6, N_LOGS) + rng.uniform(0, 2 * np.pi))
    temperature += 3 * rng.standard_normal(N_LOGS)
    per_kelvin = -5e-4 * np.exp(0.4 * rng.standard_normal(len(MODES)))
    std = np.r_[STD_F, STD_ZETA] * np.exp(0.15 * rng.standard_normal((N_LOGS, 2 * len(MODES))))
    ln_f = LN_F + machine().drift(x, MODES) + np.outer(temperature - 21, per_kelvin)
    values = np.hstack([ln_f, np.tile(LN_ZETA, (N_LOGS, 1))])
    values += std * rng.standard_normal(std.shape)
    estimates = *np.hsplit(values, 2), std[:, :, None] ** 2 * np.eye(std.shape[1])
    history = make_history(MODES, length * u, estimates, covariates={"temperature_c": temperature})
    ahead = np.linspace(share, 1.0, 2001)
    margin = np.log1p(-lost(ahead)) - np.log1p(-LOST_AT_LIMIT)
    half = ahead[np.argmax(margin <= margin[0] / 2)]
    return history, length * (1 - share), length * (half - share)


def one(kind: str, number_: int) -> Row:
    """Predict one life, now and as before."""
    history, left, half = life_of(kind, number_)
    seed = [SEED, number_]
    found = prognose(history, machine(), seed, chains=False)
    with patch.multiple(constants, RATE_STD=0.0, UNSEEN_ONSETS=1e-9):
        before = prognose(history, as_before(), seed, chains=False)
    every = decide(found, machine().description.decision).inspect_every
    return {
        "kind": kind,
        "share": SHARES[number_ % len(SHARES)],
        "announced": bool(np.ceil(half / every) * every < left),
        "every_over_left": min(every, found.horizon) / left,
        NEW: scored(found, left),
        BEFORE: scored(before, left),
    }


def scored(found: Prognosis, left: float) -> Row:
    """Score the remaining life in m to any limit, and the width of the preload's interval."""
    draws = np.minimum(found.remaining[:, -1], found.horizon)
    low, high = np.quantile(draws, [0.05, 0.95])
    health = np.quantile(found.health[:, 0], [0.05, 0.95])
    service = np.quantile(draws, RISK, method="inverted_cdf")
    return {
        "held": bool(low <= left <= high),
        "late": bool(left < service),
        "service_over_left": float(service / left),
        "crps_km": float(crps(draws[:, None], [left])[0]) / _KM,
        "width": float(health[1] - health[0]),
    }


def summed(rows: list[Row]) -> Row:
    """Summarise a course, and each share of the life."""
    found: Row = {}
    for share in (*SHARES, None):
        own = [row for row in rows if share in (None, row["share"])]
        part: Row = {"n": len(own), "announced": sum(row["announced"] for row in own)}
        part["every_over_left"] = float(np.median([row["every_over_left"] for row in own] or [0]))
        for name in (NEW, BEFORE):
            values = {key: np.array([row[name][key] for row in own]) for key in rows[0][name]}
            counts = {key: int(values[key].sum()) for key in ("held", "late")}
            means = {key: float(values[key].mean()) for key in ("crps_km", "width") if own}
            middle = float(np.median(values["service_over_left"])) if own else None
            part[name] = counts | means | {"service_over_left": middle}
        found["all" if share is None else f"{share:g}"] = part
    return found


def verdicts(courses: Row) -> dict[str, bool]:
    """Return the checks; the control is the prognosis as before."""
    checks = {}
    for kind in BROKEN:
        row = courses[kind]["all"]
        checks[f"{kind}: intervals hold"] = row[NEW]["held"] >= HELD * row["n"]
        checks[f"{kind}: services in time"] = row[NEW]["late"] <= LATE * row["n"]
        checks[f"{kind}: those before do not hold"] = row[BEFORE]["held"] < HELD * row["n"]
    for kind in RIGHT:
        row, whole = courses[kind][f"{MAIN:g}"], courses[kind]["all"]
        checks[f"{kind}: score"] = row[NEW]["crps_km"] <= MORE_CRPS * row[BEFORE]["crps_km"]
        checks[f"{kind}: width"] = whole[NEW]["width"] <= WIDER * whole[BEFORE]["width"]
        checks[f"{kind}: services in time"] = whole[NEW]["late"] <= LATE * whole["n"]
    return checks


def claims(answer: Row) -> Iterator[Claim]:
    """Claim intervals and services in courses of no law, and the price where a law holds."""
    passed = answer["passed"]
    for kind, found in answer["courses"].items():
        row = found["all"]
        new, before = row[NEW], row[BEFORE]
        yield counted(
            f"90 % intervals of the remaining life hold: {kind}",
            new["held"],
            row["n"],
            f"named laws alone {before['held']}",
            met=passed.get(f"{kind}: intervals hold", True),
        )
        yield counted(
            f"services at a risk of 5 % too late: {kind}",
            new["late"],
            row["n"],
            f"named laws alone {before['late']}; median at {new['service_over_left']:.2f} and "
            f"{before['service_over_left']:.2f} of the life left",
            met=passed[f"{kind}: services in time"],
        )
        yield counted(
            f"ends that a log at the advised interval announces: {kind}",
            row["announced"],
            row["n"],
            f"median interval {row['every_over_left']:.2f} of the life left",
        )
        if kind in RIGHT:
            main = found[f"{MAIN:g}"]
            ratio = main[NEW]["crps_km"] / main[BEFORE]["crps_km"]
            yield Claim(
                f"score (CRPS) at 70 % of life over that of the named laws: {kind}",
                number(ratio),
                f"{main['n']} lives",
                f"{MORE_CRPS} required; widths of health {new['width'] / before['width']:.2f}",
                passed[f"{kind}: score"] and passed[f"{kind}: width"],
            )


if __name__ == "__main__":
    main()
