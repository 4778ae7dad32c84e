"""Are posteriors of health at one epoch calibrated, over everything that is not known of it?

Method
    Simulation-based calibration. The covariance of the drifts is that of the real tracker, of 8 to
    80 logs whose estimates have errors of 0.02 to 0.5 %, with temperature and in half of the lives
    payload. ln parameters are drawn from the priors of the description, inside the map, and a
    relative error of the map's sensitivities per parameter and mode as the description and
    `MAP_ERRORS` have it; drifts are those of the map, with these errors, and with noise of that
    covariance: one epoch of Y, three epochs of a life that share one error of the map, one epoch of
    X. Draws of `EpochPosterior` are by importance sampling; those of `infer`, on some of the same
    lives, are its chains. Ranks among 127 draws, ties at random, are compared with the simultaneous
    band of their distribution at 99.9 %, coverages with their 99.9 % Clopper-Pearson interval.
    Controls that must fail: half of all covariances is stated, those of the drifts and of the map's
    error; a map is taken as exact that is wrong by 5 %. Beside them: half of the covariance of the
    drifts alone.
Run time
    Of one processor some 25 lives a second, and a second for each of the chains of `infer`.
    The recorded time is that after an interruption.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import numpy as np
from lmshealth.health.epoch_posterior import EpochPosterior
from lmshealth.health.importance_sampling import importance_sample_to_ess
from lmshealth.health.inference import draw as draw_chains
from lmshealth.health.inference import infer

from lmshealth._private.seeds import stream
from lmshealth.errors import NotConverged
from lmshealth.stage.description import Stage, load_stage
from studies.harness.claims import Claim, ranked
from studies.harness.ranks import N_DRAWS, Array, judge, rank, thinned, uniform
from studies.harness.study import Row, Study
from studies.health.calibration.lives import Life, assuming, draw

SEED = 20261122
EPOCHS = ("first third", "second third", "last")
ONE, SHARED, X, CHAINS = "lms-y", "lms-y, three epochs of a life", "lms-x", "lms-y, by infer"
DRIFTS, HALVED = "covariance of the drifts halved", "all covariances halved"
EXACT = "map taken as exact"
LIVES = {ONE: 4000, SHARED: 1000, X: 1000, CHAINS: 200} | dict.fromkeys(
    (DRIFTS, HALVED, EXACT), 1000
)
QUICK = {ONE: 8, SHARED: 2, X: 2, EXACT: 8}
# Lives that tell a control from what it controls.
ENOUGH = 250
# Points of the prior to begin from, and weighted ones of the posterior.
N_PRIOR, N_POINTS = 500, 2000
# Share of the map's true error that is assumed.
_LESS = {HALVED: np.sqrt(0.5), EXACT: 0.0}


def main() -> None:
    """Run the study; ``--quick`` does a few lives without chains and records nothing."""
    study = Study(__file__, __doc__)
    plan = QUICK if study.quick else LIVES
    tasks = [(kind, life) for kind, n in plan.items() for life in range(n)]
    found = study.trials.collect(one, tasks)
    rows = [{"kind": kind} | row for (kind, _), row in zip(tasks, found, strict=True)]
    answer: Row = {"seed": SEED, "lives": plan} | judged(rows)
    answer["passed"] = verdicts(answer["ranks"])
    study.conclude(answer)


@cache
def machine(kind: str) -> Stage:
    """Load the stage that lives of a kind are of."""
    return load_stage("lms-x" if kind == X else "lms-y")


def one(kind: str, life: int) -> Row:
    """Draw a life and rank its truth; chains and controls have the lives of the first kind."""
    stage = machine(kind)
    part = (SHARED, X).index(kind) + 1 if kind in (SHARED, X) else 0
    rng = np.random.default_rng([SEED, part, life])
    drawn = draw(rng, stage, len(EPOCHS) if kind == SHARED else 1)
    track = drawn.track
    if kind in (DRIFTS, HALVED):
        track = replace(track, drift_cov=track.drift_cov / 2)
    assumed = assuming(stage, _LESS[kind]) if kind in _LESS else stage
    if kind == CHAINS:
        found = infer(track, assumed, [SEED, life], epochs=drawn.epochs)
        draws = [np.log(thinned(own)) for own in found.samples]
        return {"rank": ranks(drawn.truth, draws, rng), "converged": bool(found.converged.all())}
    place, chains = ranks_of(replace(drawn, track=track), assumed, rng, [SEED, life])
    return {"rank": place, "chains": chains}


def ranks_of(
    drawn: Life, assumed: Stage, rng: np.random.Generator, key: list[int]
) -> tuple[list[list[float]], int]:
    """Rank the truth of each epoch; also return whether chains replaced importance sampling."""
    track, names = drawn.track, assumed.informative
    columns = [track.modes.index(name) for name in names]
    draws, chains = [], 0
    for k in drawn.epochs:
        cov = track.drift_cov[k][np.ix_(columns, columns)]
        posterior = EpochPosterior.of(assumed, names, track.drift[k][columns], cov)
        start = posterior.prior.draw(rng, N_PRIOR)
        try:
            found = importance_sample_to_ess(posterior.log_probability, start, rng, N_POINTS)
            draws.append(found.resampled(rng, N_DRAWS))
        except NotConverged:
            draws.append(thinned(draw_chains(posterior, stream(key, k)).flat))
            chains = 1
    return ranks(drawn.truth, draws, rng), chains


def ranks(truth: Array, draws: list[Array], rng: np.random.Generator) -> list[list[float]]:
    """Rank the parameters of each epoch."""
    return [rank(x, own, rng) for x, own in zip(truth, draws, strict=True)]


def judged(rows: list[Row]) -> Row:
    """Judge the ranks of every parameter, kind by kind and epoch by epoch."""
    names = [parameter.name for parameter in machine(ONE).parameters]
    found: dict[str, dict[str, Row]] = {}
    for kind in dict.fromkeys(row["kind"] for row in rows):
        values: Array = np.array([row["rank"] for row in rows if row["kind"] == kind])
        epochs = EPOCHS if values.shape[1] == len(EPOCHS) else ("",)
        found[kind] = {
            f"{name}, {epoch}" if epoch else name: judge(values[:, k, j])
            for k, epoch in enumerate(epochs)
            for j, name in enumerate(names)
        }
    return {
        "ranks": found,
        "chains_not_converged": sum(not row.get("converged", True) for row in rows),
        "importance_sampling_replaced_by_chains": sum(row.get("chains", 0) for row in rows),
    }


def verdicts(found: dict[str, dict[str, Row]]) -> dict[str, bool]:
    """Return the checks."""
    first = machine(ONE).parameters[0].name
    checks = {f"ranks are uniform: {kind}": uniform(found[kind]) for kind in (ONE, SHARED, X)}
    if CHAINS in found:
        checks[f"ranks are uniform: {CHAINS}"] = uniform(found[CHAINS])
    for kind in (HALVED, EXACT):
        if kind in found and found[kind][first]["n"] >= ENOUGH:  # fewer tell little
            checks[f"they are not: {kind}"] = not any(
                row["inside_band"] for row in found[kind].values()
            )
    return checks


def claims(answer: Row) -> Iterator[Claim]:
    """Claim uniform ranks of the truth, and controls that are detected."""
    for kind, rows in answer["ranks"].items():
        if kind == DRIFTS:
            yield from ranked(f"{kind}, which has no effect", rows.values())
        else:
            yield from ranked(kind, rows.values(), control=kind in (HALVED, EXACT))


if __name__ == "__main__":
    main()
