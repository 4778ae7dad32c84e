"""Do ended lives of a fleet repair remaining lives that no law of the description foresees?

Method
    Fleets of stage Y whose preload wears by a course that the description does not have: it
    accelerates late (a power of 5 to 9) or has a bathtub (running-in, quiet, a power of 7 to 11);
    power, median life and shares are those of the fleet, lives scatter by 30 % about the median.
    Each fleet has 9 ended lives of 16 logs up to the replacement of the guide, a few percent after
    the limit or, in a fifth of them, at 80 to 100 % of the life, and 8 running machines of 12 logs,
    followed to a share of their life between 0.3 and 0.9 at random. Estimates have the errors of
    the identification. The description has Hertz wear and none, not the law that accelerates; a
    change without a law has 5 %. Places of the ended lives are those of the program
    (`ended_lives`), the calibrated travel is its formula, beside the 10 % quantile of the
    prognosis. Two predictors: the program, and one without unseen onsets, whose rates drift by 40 %
    instead, which is wrong in these fleets. Coverage is the share of running machines that outlive
    the travel; nine lives promise 90 %. Machines of one fleet share its scores: binomial standard
    errors are too small by that. Control: the scores of a fleet of an even wear, which the
    description has.
Run time
    Ten minutes on one processor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, replace
from functools import cache, partial
from typing import Any, TypeVar
from unittest.mock import patch

import numpy as np

from lmshealth.calibration.lives import make_history
from lmshealth.life import constants, prognosis
from lmshealth.life.fleet_prior import ended_lives
from lmshealth.life.posterior.fit import LifePosterior, fit_life
from lmshealth.life.prognosis import prognose
from lmshealth.stage.description import Stage
from lmshealth.tracking.history import History
from studies.harness.claims import Claim, counted, number
from studies.harness.study import Row, Study
from studies.life.fleet.lives import machine
from studies.life.kinds.worlds import course
from studies.robustness.off_model.worlds import (
    LN_F,
    LN_ZETA,
    LOST_AT_LIMIT,
    MODES,
    STD_F,
    STD_ZETA,
    Array,
)

SEED = 20261125
FLEETS, N_ENDED, N_RUNNING = 2, 9, 8
LOGS_ENDED, LOGS_RUNNING = 16, 12
BROKEN, RIGHT = ("late", "bathtub"), "even"
LIFE_KM, SCATTER, AT_SERVICE = 2500.0, 0.3, 0.2
NEW, WITHOUT = "program", "without unseen onsets"
WAYS: dict[str, dict[str, float]] = {NEW: {}, WITHOUT: {"RATE_STD": 0.4, "UNSEEN_ONSETS": 1e-9}}
LEVEL = constants.CALIBRATED_RISK
_KM = 1000.0


def main() -> None:
    """Run the study; ``--quick`` does one fleet of a single life and records nothing."""
    study = Study(__file__, __doc__)
    n = 1 if study.quick else FLEETS
    size = (1, 1) if study.quick else (N_ENDED, N_RUNNING)
    tasks = [(kind, k, *size) for k in range(n) for kind in BROKEN] + [(RIGHT, 0, *size)]
    if study.quick:
        tasks = tasks[:1]
    rows = study.trials.collect(one, tasks)
    answer: Row = {"seed": SEED, "fleets": n, "ended": size[0], "running": size[1]}
    if not study.quick:
        answer["ways"] = {way: judged(rows, way) for way in WAYS}
        answer["passed"] = verdicts(answer["ways"])
    for row in rows:  # quantiles of every draw would be a record of megabytes
        row["running"] = [{"left_km": own["left_km"], **{way: own[way]["place"] for way in WAYS}}
                          for own in row["running"]]  # fmt: skip
    study.conclude(answer, details={"rows": rows})


@cache
def stage() -> Stage:
    """Load the description of all fleets."""
    return machine()


def history_of(
    rng: np.random.Generator, lost: Callable[[Array], Array], length: float, u: Array
) -> History:
    """Draw estimates of a machine after shares of its life of a length in m."""
    n, m = u.size, len(MODES)
    x = np.tile(stage().baseline_point, (n, 1))
    x[:, 0] += np.log1p(-lost(u))
    temperature = 21 + 5 * rng.standard_normal(n)
    std = np.r_[STD_F, STD_ZETA] * np.exp(0.15 * rng.standard_normal((n, 2 * m)))
    ln_f = LN_F + stage().drift(x, MODES) - 5e-4 * (temperature - 21)[:, None]
    values = np.hstack([ln_f, np.tile(LN_ZETA, (n, 1))]) + std * rng.standard_normal(std.shape)
    estimates = *np.hsplit(values, 2), std[:, :, None] ** 2 * np.eye(2 * m)
    return make_history(MODES, length * u, estimates, covariates={"temperature_c": temperature})


def spread(rng: np.random.Generator, end: float, n: int) -> Array:
    """Draw shares of a life from 0 to an end at which logs are recorded."""
    return end * np.r_[0.0, np.sort(rng.uniform(size=n - 2)), 1.0]


def one(kind: str, number_: int, n_ended: int, n_running: int) -> Row:
    """Draw a fleet; return its ended lives, and what is predicted of its running machines."""
    rng = np.random.default_rng([SEED, number_, len(kind)])
    share, row = course(rng, kind), Row(kind=kind, ended={way: [] for way in WAYS}, running=[])

    def lost(u: Array) -> Array:
        return LOST_AT_LIMIT * share(u)

    for _ in range(n_ended):
        length = _KM * LIFE_KM * np.exp(SCATTER * rng.standard_normal())
        end = rng.uniform(0.8, 1.0) if rng.random() < AT_SERVICE else rng.uniform(1.0, 1.03)
        u = spread(rng, end, LOGS_ENDED)
        # The first log after the replacement opens a new baseline.
        whole = history_of(rng, lost, length, np.append(u, end + 0.01))
        history = replace(whole, baselines=(0, LOGS_ENDED))
        for way, ended in by_way(partial(ended_lives, history, stage(), [SEED, number_])):
            row["ended"][way] += [asdict(life) for life in ended]
    for _ in range(n_running):
        length = _KM * LIFE_KM * np.exp(SCATTER * rng.standard_normal())
        seen = rng.uniform(0.3, 0.9)
        history = history_of(rng, lost, length, spread(rng, seen, LOGS_RUNNING))
        left = length * (1 - seen)
        own: Row = {"left_km": left / _KM}
        for way, found in by_way(partial(prognose, history, stage(), SEED, chains=False)):
            draws = np.minimum(found.remaining[:, -1], found.horizon)
            cuts = np.quantile(draws, np.linspace(0, 1, 1001), method="inverted_cdf")
            own[way] = {"place": float(np.mean(draws <= left)), "km": (cuts / _KM).tolist()}
        row["running"].append(own)
    return row


Found = TypeVar("Found")


def by_way(work: Callable[[], Found]) -> Iterator[tuple[str, Found]]:
    """Compute something by each predictor; a life is fitted once for both."""
    kept: dict[int, LifePosterior] = {}

    def fitted(history: History, *args: Any, **options: Any) -> LifePosterior:
        key = hash((history.ln_frequency.tobytes(), history.baselines))
        if key not in kept:
            kept[key] = fit_life(history, *args, **options)
        return kept[key]

    for way, changed in WAYS.items():
        with ExitStack() as stack:
            stack.enter_context(patch.object(prognosis, "fit_life", fitted))
            for name, value in changed.items():
                stack.enter_context(patch.object(constants, name, value))
            yield way, work()


def travel_km(lives: list[Row], cuts: list[float]) -> float:
    """Return the calibrated travel by ended lives, of a machine with 1001 quantiles in km."""
    level = sorted(life["place"] for life in lives)[int(LEVEL * (len(lives) + 1)) - 1]
    return cuts[int(np.ceil(1000 * level))] if level > 0 else 0.0


def judged(rows: list[Row], way: str) -> Row:
    """Count the running machines that outlive the travels of a predictor, by course."""
    other = next(row for row in rows if row["kind"] == RIGHT)["ended"][way]
    found: Row = {}
    for kind in (*BROKEN, RIGHT):
        fleets = [row for row in rows if row["kind"] == kind]
        kept: Row = {"before": [], "calibrated": [], "other": []}
        for row in fleets:
            for one in row["running"]:
                left, cuts = one["left_km"], one[way]["km"]
                travels = {"before": cuts[int(1000 * LEVEL)],
                           "calibrated": travel_km(row["ended"][way], cuts),
                           "other": travel_km(other, cuts)}  # fmt: skip
                for name, km in travels.items():
                    kept[name].append((left >= km, km / left))
        n = len(kept["before"])
        found[kind] = {
            "n": n,
            "reached": sum(e["reached"] for r in fleets for e in r["ended"][way]),
        }
        for name, pairs in kept.items():
            outlived, ratio = np.array(pairs, dtype=float).T
            found[kind][name] = {
                "outlive": int(outlived.sum()),
                "std": float(np.sqrt(max(outlived.mean() * (1 - outlived.mean()), 0.25 / n) / n)),
                "km_over_left": float(np.median(ratio)),
            }
    return found


def verdicts(ways: Row) -> dict[str, bool]:
    """Return the checks: calibrated travels hold within two standard errors, the control does not.

    It is the wrong predictor with the scores of a fleet that it foresees.
    """
    checks = {}
    for way, found in ways.items():
        for kind in BROKEN:
            row = found[kind]
            own = row["calibrated"]
            checks[f"{way}, {kind}: calibrated travels are outlived"] = (
                own["outlive"] / row["n"] + 2 * own["std"] >= 1 - LEVEL
            )
    wrong = ways[WITHOUT]
    checks["without unseen onsets, before: too many end early"] = any(
        wrong[kind]["before"]["outlive"] < (1 - LEVEL) * wrong[kind]["n"]
        - 3 * wrong[kind]["n"] * wrong[kind]["before"]["std"] for kind in BROKEN
    )  # fmt: skip
    checks["without unseen onsets, scores of another fleet: too many end early"] = any(
        wrong[kind]["other"]["outlive"] < (1 - LEVEL) * wrong[kind]["n"] for kind in BROKEN
    )
    return checks


def claims(answer: Row) -> Iterator[Claim]:
    """Claim how many running machines outlive the calibrated travel, before and after."""
    for way, found in answer["ways"].items():
        for kind, row in found.items():
            own, *_ = by = [row[name] for name in ("calibrated", "before", "other")]
            yield counted(
                f"running machines that outlive the calibrated travel: {kind}, {way}",
                own["outlive"],
                row["n"],
                f"{row['before']['outlive']} the 10 % quantile of the prognosis, "
                f"{row['other']['outlive']} by scores of a fleet of even wear; median travel over "
                f"the truth {' and '.join(number(one['km_over_left']) for one in by)}",
                met=answer["passed"].get(f"{way}, {kind}: calibrated travels are outlived", True),
            )


if __name__ == "__main__":
    main()
