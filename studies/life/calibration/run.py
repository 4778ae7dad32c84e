"""Are posteriors of whole lives calibrated, over everything that is not known of them?

Method
    Simulation-based calibration by the lives, quantities and ranks of `lmshealth
    check-calibration`. The scenario of a life (the law of each parameter, a change without a law,
    or none), its parameters, the deviation and its path are drawn from their priors, the odometer
    of now independently of the life (lognormal about 2,000 km); lives that leave the map are drawn
    again. Of 30 % of lives the tracker reports a step, which is true in one of ten; then every
    parameter jumps, and a law may begin anew there. In 6 % of lives one mode moves alone. The
    remaining life is that of the path followed on in small steps, then opened beyond the laws as
    the prognosis opens it; a life past the horizon is censored. Each of 60 logs has roll and pitch,
    in half of the lives pitch by two sources, with correlated errors of about 0.1 %; unknown are
    intercepts, coefficients of temperature and payload, the walk and the factor on the reported
    errors, the second source's bias, the size of declared steps, and relative errors of the map's
    sensitivities, of the two sizes of the description. A twentieth of estimates and temperatures
    is missing. Posteriors are drawn by importance sampling; some of the same lives by chains too.
    Lives of both shipped descriptions, all modes and without reported steps, also go through the
    tracker, as `lmshealth check-calibration` has them. Ranks among 127 draws, ties (a limit that is
    never reached, a parameter that keeps its health, a mode that moves alone or not, censored
    lives) at random, are compared with the simultaneous band of their distribution at 99.9 %,
    coverages with their 99.9 % Clopper-Pearson interval. Controls that must fail: a map taken as
    exact that is wrong by 5 or 10 %; every parameter taken to change, while half of them do not.
Run time
    Of one processor one to four seconds a life, half an hour in all. The recorded time is that
    after an interruption.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import msgspec
import numpy as np

from lmshealth.calibration.check import (
    judged_ranks,
    outcome_of,
    prognosis_or_none,
    quantities,
    ranks_of,
    true_quantities,
)
from lmshealth.calibration.lives import Life, Schedule, draw
from lmshealth.calibration.ranks import uniform
from lmshealth.errors import NotConverged
from lmshealth.life.posterior.fit import fit_life
from lmshealth.stage.description import Stage, load_stage
from studies.harness.claims import Claim, ranked
from studies.harness.study import Row, Study

SEED = 20261123
ONE, CHAINS = "posterior", "by chains"
EXACT, LOSING = "map taken as exact", "every part taken to change"
TRACKED = {f"after the tracker, {name}": name for name in ("lms-y", "lms-x")}
LIVES = {ONE: 500, CHAINS: 40, EXACT: 100, LOSING: 100} | dict.fromkeys(TRACKED, 100)
# The quick form begins where none jumps, which takes long, and some parts keep their health.
QUICK, QUICK_FIRST = {ONE: 3, LOSING: 3, next(iter(TRACKED)): 1}, 3
SCHEDULE = Schedule(logs=60, frequency_std=1e-3)
# Odometer now since the baseline in km: median, and standard deviation of its logarithm; shares of
# lives of which the tracker reports a step, and with a second source.
NOW_KM, STEPS, SECOND_SOURCE = (2000.0, 0.7), 0.3, 0.5


def main() -> None:
    """Run the study; ``--quick`` does a few lives without chains and records nothing."""
    study = Study(__file__, __doc__)
    plan, first = (QUICK, QUICK_FIRST) if study.quick else (LIVES, 0)
    tasks = [(kind, first + k) for kind, n in plan.items() for k in range(n)]
    found = study.trials.collect(one, tasks)
    rows = [{"kind": kind} | row for (kind, _), row in zip(tasks, found, strict=True)]
    answer: Row = {"seed": SEED, "lives": plan} | judged(rows)
    answer["passed"] = verdicts(answer["ranks"])
    study.conclude(answer)


@cache
def machine() -> Stage:
    """Load the stage of Y, of which yaw is not tracked."""
    stage = load_stage("lms-y")
    change = msgspec.structs.replace
    modes = tuple(change(one, tracked=one.name != "yaw") for one in stage.modes)
    return replace(stage, description=change(stage.description, mode=modes))


def drawn_life(rng: np.random.Generator) -> Life:
    """Draw a life of that stage with everything that may disturb it."""
    now = NOW_KM[0] * np.exp(NOW_KM[1] * rng.standard_normal())
    rate = float(now / (SCHEDULE.every * (SCHEDULE.logs - 1)))
    schedule = replace(SCHEDULE, km_per_day=rate)
    return draw(rng, machine(), schedule, steps=STEPS, second_source=SECOND_SOURCE)


def one(kind: str, life: int) -> Row:
    """Draw a life and rank its truth; chains and controls have the same lives."""
    if kind in TRACKED:
        stage = load_stage(TRACKED[kind])
        outcome = outcome_of(stage, Schedule().resolved(stage), SEED, (None, life))
        return {"rank": outcome.places or None}
    rng = np.random.default_rng([SEED, life])
    drawn, stage = drawn_life(rng), machine()
    truth = true_quantities(drawn, stage, rng)
    if kind == EXACT:
        stage = assuming(stage, 0.0)
    if kind == LOSING:
        stage = always_losing(stage)
    try:
        found = fit_life(drawn.history, stage, [SEED, life], chains=kind == CHAINS)
    except NotConverged:
        return {"rank": None}
    draws = quantities(found, stage, prognosis_or_none(found, drawn.history, stage))
    return {"rank": ranks_of(truth, draws, rng)}


def assuming(stage: Stage, share: float) -> Stage:
    """Return the same stage with a share of the error of its map."""
    assert stage.description.map is not None
    spec = stage.description.map
    less = {"model_std": share * spec.model_std, "common_std": share * spec.common_std}
    spec = msgspec.structs.replace(spec, **less)
    return replace(stage, description=msgspec.structs.replace(stage.description, map=spec))


def always_losing(stage: Stage) -> Stage:
    """Return the same stage without the law by which a parameter keeps its value."""
    laws = {p.name: tuple(law for law in p.laws if law.names) for p in stage.parameters}
    return stage.with_laws(laws)


def judged(rows: list[Row]) -> Row:
    """Judge the ranks of every quantity, kind by kind."""
    found = {
        kind: judged_ranks([r["rank"] for r in rows if r["kind"] == kind and r["rank"]])
        for kind in dict.fromkeys(row["kind"] for row in rows)
    }
    return {"ranks": found, "not_converged": sum(row["rank"] is None for row in rows)}


def of_health(rows: dict[str, Row]) -> dict[str, Row]:
    """Return the judgements of health now."""
    return {name: row for name, row in rows.items() if name.endswith(" now")}


def verdicts(found: dict[str, dict[str, Row]]) -> dict[str, bool]:
    """Return the checks; too few lives tell nothing of a control."""
    kinds = [kind for kind in (ONE, CHAINS, *TRACKED) if kind in found]
    checks = {f"ranks are uniform: {kind}": uniform(found[kind]) for kind in kinds}
    for kind in (EXACT, LOSING):
        rows = of_health(found.get(kind, {}))
        if rows and min(row["n"] for row in rows.values()) >= 0.9 * LIVES[kind]:
            checks[f"they are not: {kind}"] = not uniform(rows)
    return checks


def claims(answer: Row) -> Iterator[Claim]:
    """Claim uniform ranks of health now, of the remaining life, and of modes that move alone."""
    for kind, rows in answer["ranks"].items():
        if kind in (EXACT, LOSING):
            yield from ranked(f"health now, {kind}", of_health(rows).values(), control=True)
        else:
            yield from ranked(f"health now, remaining life and lone modes, {kind}", rows.values())


if __name__ == "__main__":
    main()
