"""Are posteriors of whole lives calibrated, over everything that is not known of them?

Method
    Simulation-based calibration of `fit_life` and `passages`. The scenario of a life (the law of
    each parameter, a change without a law, or none), its parameters, the deviation and its path are
    drawn from their priors, the odometer of now independently of the life (lognormal about 2,000
    km); lives that leave the map are drawn again. Of 30 % of lives the tracker reports a step,
    which is true in one of ten; then every parameter jumps, and a law may begin anew there. In 6 %
    of lives one mode moves alone. The remaining life is that of the path followed on in steps of 2
    km, then opened beyond the laws as the prognosis opens it; a life past the horizon is censored.
    Each of 60 logs has roll and pitch, in half of the lives pitch by two sources, with correlated
    errors of 0.03 to 0.2 %; unknown are intercepts, coefficients of temperature and payload, the
    walk and the factor on the reported errors, the second source's bias, the size of declared
    steps, and relative errors of the map's sensitivities, of the two sizes of the description. A
    twentieth of estimates and temperatures is missing. Posteriors are drawn by importance sampling;
    some of the same lives by chains too. Ranks among 127 draws, ties (a limit that is never
    reached, a parameter that keeps its health, a mode that moves alone or not, censored lives) at
    random, are compared with the simultaneous band of their distribution at 99.9 %, coverages with
    their 99.9 % Clopper-Pearson interval. Controls that must fail: a map taken as exact that is
    wrong by 5 or 10 %; every parameter taken to change, while half of them do not.
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

from lmshealth.errors import NotConverged
from lmshealth.life.posterior.fit import LifePosterior, fit_life
from lmshealth.life.prognosis import parameters_with_limit, passages
from lmshealth.stage.description import Stage, load_stage
from studies.harness.claims import Claim, ranked
from studies.harness.ranks import N_DRAWS, Array, judge, rank, uniform
from studies.harness.study import Row, Study
from studies.life.calibration.lives import Life, draw

SEED = 20261123
ONE, CHAINS = "posterior", "by chains"
EXACT, LOSING = "map taken as exact", "every part taken to change"
LIVES = {ONE: 500, CHAINS: 40, EXACT: 100, LOSING: 100}
# The quick form begins where none jumps, which takes long, and some parts keep their health.
QUICK, QUICK_FIRST = {ONE: 3, LOSING: 3}, 3
CHANGES = ("preload changes", "mount changes")
ALONE = ("roll moves alone", "pitch moves alone")
HEALTH = ("preload now", "mount now")
REMAINING = ("remaining, preload", "remaining, mount", "remaining, first of both")
QUANTITIES = (*CHANGES, *HEALTH, "preload off its law", *REMAINING)


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
    """Load the stage that all lives are of."""
    return load_stage("lms-y")


def one(kind: str, life: int) -> Row:
    """Draw a life and rank its truth; chains and controls have the same lives."""
    rng = np.random.default_rng([SEED, life])
    drawn = draw(rng, machine())
    modes = np.arange(len(ALONE))
    truth = np.append(true_quantities(drawn, rng), drawn.lone == modes)
    stage = machine()
    if kind == EXACT:
        stage = assuming(stage, 0.0)
    if kind == LOSING:
        stage = always_losing(stage)
    seed, chains = [SEED, life], kind == CHAINS
    try:
        found = fit_life(drawn.history, stage, seed, chains=chains)
    except NotConverged:
        return {"rank": None}
    draws = quantities(found, drawn.now, np.random.default_rng([SEED, life, 1]))
    draws = np.hstack([draws, found.lone.reshape(-1, 1) == modes])
    return {"rank": rank(truth, draws[rng.permutation(len(draws))[:N_DRAWS]], rng)}


def assuming(stage: Stage, share: float) -> Stage:
    """Return the same stage with a share of the error of its map."""
    assert stage.description.map is not None
    less = share * stage.description.map.model_std
    spec = msgspec.structs.replace(stage.description.map, model_std=less)
    return replace(stage, description=msgspec.structs.replace(stage.description, map=spec))


def always_losing(stage: Stage) -> Stage:
    """Return the same stage without the law by which a parameter keeps its value."""
    change = msgspec.structs.replace
    parameters = tuple(
        change(p, law=tuple(law for law in p.laws if law.names)) for p in stage.parameters
    )
    return replace(stage, description=change(stage.description, parameter=parameters))


def true_quantities(drawn: Life, rng: np.random.Generator) -> Array:
    """Return what is true of a life, in the order of `QUANTITIES`."""
    now = np.array([drawn.now])
    horizon = 1000 * machine().description.usage.horizon_km
    changes = [part.changes for part in drawn.parts]
    health = [part.by_law(now)[0] * np.exp(part.off[-1]) for part in drawn.parts]
    left = [
        part.left(rng, drawn.now, p.limit.below / p.baseline, horizon)
        for p, part in zip(machine().parameters, drawn.parts, strict=True)
        if p.limit is not None
    ]
    return np.array([*changes, *health, drawn.parts[0].off[-1], *left, min(left)])


def quantities(found: LifePosterior, now: float, rng: np.random.Generator) -> Array:
    """Return what a posterior states of the same, ``(n_draws, n)``."""
    horizon = 1000 * machine().description.usage.horizon_km
    limited = parameters_with_limit(machine())
    left, _ = passages(found, limited, rng, now=now, horizon=horizon)
    left[left > horizon] = np.inf
    n = found.rate.shape[0]
    paths = [
        np.tile([bool(path.law.names) for path in way.scenario.paths], (n, way.n_mixture_draws, 1))
        for way in found.scenarios
    ]
    changes = np.concatenate(paths, axis=1)
    now_parts = [changes, found.health, found.off[..., :1]]
    return np.hstack([*(part.reshape(left.shape[0], -1) for part in now_parts), left])


def judged(rows: list[Row]) -> Row:
    """Judge the ranks of every quantity, kind by kind."""
    found: dict[str, dict[str, Row]] = {}
    for kind in dict.fromkeys(row["kind"] for row in rows):
        own = [row["rank"] for row in rows if row["kind"] == kind and row["rank"] is not None]
        found[kind] = dict(zip((*QUANTITIES, *ALONE), map(judge, np.array(own).T), strict=True))
    return {"ranks": found, "not_converged": sum(row["rank"] is None for row in rows)}


def verdicts(found: dict[str, dict[str, Row]]) -> dict[str, bool]:
    """Return the checks; too few lives tell nothing of a control."""
    kinds = [kind for kind in (ONE, CHAINS) if kind in found]
    checks = {f"ranks are uniform: {kind}": uniform(found[kind]) for kind in kinds}
    for kind, names in {EXACT: HEALTH, LOSING: (*HEALTH, REMAINING[0])}.items():
        if kind in found and found[kind][HEALTH[0]]["n"] >= 0.9 * LIVES[kind]:
            checks[f"they are not: {kind}"] = not uniform({n: found[kind][n] for n in names})
    return checks


def claims(answer: Row) -> Iterator[Claim]:
    """Claim uniform ranks of health now, of the remaining life, and of modes that move alone."""
    for kind, rows in answer["ranks"].items():
        if kind in (EXACT, LOSING):
            yield from ranked(f"health now, {kind}", [rows[name] for name in HEALTH], control=True)
        else:
            yield from ranked(f"health now, remaining life and lone modes, {kind}", rows.values())


if __name__ == "__main__":
    main()
