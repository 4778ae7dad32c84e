"""Does a prior estimated from a fleet improve prognoses of young machines, and is it calibrated?

Method
    Fleets are drawn from the model by which they are estimated: median and scatter of wear lives,
    share of machines that wear, scatter of their logs; stage Y with a constant mount. 16 machines
    with 24 logs each (odometers lognormal about 2,000 km; out of the map they leave the fleet) give
    the prior of four young ones (8 logs, about 200 km, `needs_fleet_prior`). Logs have errors of
    0.03 to 0.2 %, unknown intercepts, covariate effects, a random walk, a factor on the errors, a
    deviation from the law and a wrong map. Posteriors are drawn by importance sampling. The
    remaining life, cut at the horizon, is computed with the prior of the description, with the
    estimated one, with estimated laws but described scatter, and with the true parameters of the
    fleet, which is the optimum. Compared are the CRPS and its expected loss against the optimum
    (integral of the squared difference of the distributions), with standard errors over fleets;
    coverages at 99.9 %. Controls that must be worse: the prior from worn machines only; that from a
    fleet with five times the life.
Run time
    Ten minutes on one processor.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from lmshealth.calibration.ranks import judge_places, place
from lmshealth.life.fleet_prior import (
    FleetPrior,
    MachineEvidence,
    fleet_priors,
    machine_evidence,
    needs_fleet_prior,
)
from lmshealth.life.posterior.fit import LifePosterior, fit_life
from lmshealth.life.prognosis import passages
from lmshealth.stage.degradation_laws import HertzWear
from lmshealth.stage.description import Stage
from lmshealth.stage.priors import Lognormal, Prior
from studies.harness.claims import Claim, covered, measured, percents
from studies.harness.metrics import crps, mean
from studies.harness.study import Row, Study
from studies.life.fleet.lives import MATURE, YOUNG, Life, draw, draw_fleet, longer_lived, machine

Array = NDArray[np.float64]
SEED = 20261122
FLEETS, QUICK = 40, 1
# Numbers of mature and young machines of a fleet, by its kind.
FLEET, SMALL, LEAST = "fleet", "small fleet", "fleet of the quick form"
N_TEACHERS = {FLEET: 16, SMALL: 8, LEAST: 4}
N_YOUNG, MOST_DRAWN = {FLEET: 4, SMALL: 4, LEAST: 2}, 12
# Fleets with a prior from another fleet too.
FOREIGN_FLEETS, TIMES = 40, 5.0
ENOUGH = 5  # fleets, of which a mean has a standard error
DESCRIPTION, LEARNED, LAWS, KNOWN = "description", "learned", "learned, laws alone", "known"
WORN, FOREIGN = "only the worn teach", "another fleet teaches"
WAYS = (DESCRIPTION, LEARNED, LAWS, KNOWN, WORN, FOREIGN)
SEEN_TO_WEAR = 0.95
SURE = 3.0  # standard errors


def main() -> None:
    """Run the study; ``--quick`` does one small fleet and records nothing."""
    study = Study(__file__, __doc__)
    kind, n = (LEAST, QUICK) if study.quick else (FLEET, FLEETS)
    rows = study.trials.collect(one, [(kind, number) for number in range(n)])
    answer: Row = {
        "seed": SEED, "fleets": n, "teachers": N_TEACHERS[kind],
        "young": sum(len(row["young"]) for row in rows),
        # A small fleet may have too few worn machines.
        "ways": {way: judged(rows, way) for way in WAYS
                 if any(way in young for row in rows for young in row["young"])},
        "priors": [{"true": row["true"]} | young["priors"]
                   for row in rows for young in row["young"][:1]],
    }  # fmt: skip
    answer["passed"] = verdicts(answer["ways"], n)
    study.conclude(answer)


@cache
def described() -> Stage:
    """Return the description without a fleet prior."""
    return machine()


def horizon() -> float:
    """Travel in m past which nothing is claimed."""
    return 1000 * described().description.usage.horizon_km


def one(kind: str, number: int) -> Row:
    """Draw a fleet, learn its prior, and score prognoses of its young machines."""
    rng = np.random.default_rng([SEED, number])
    fleet = draw_fleet(rng, described())
    mature = evidence_of(rng, fleet, kind, number)
    worn = {
        k: evidence for k, evidence in mature.items()
        if evidence.laws["guide_preload"]["none"].posterior <= 1 - SEEN_TO_WEAR
    }  # fmt: skip
    sources = {LEARNED: mature, WORN: worn}
    if number < FOREIGN_FLEETS:
        other = np.random.default_rng([SEED, number, 1])
        sources[FOREIGN] = evidence_of(other, longer_lived(fleet, TIMES), kind, number)
    wear = fleet.parameters[0].laws[0]
    assert isinstance(wear, HertzWear)
    row: Row = {"true": numbers(wear.life_km, wear.weight), "young": []}
    for _ in range(MOST_DRAWN):
        drawn = draw(rng, fleet, YOUNG)
        own = posterior(drawn, described(), number)
        evidence = machine_evidence(described(), own)
        if needs_fleet_prior(evidence):
            row["young"].append(young_machine(drawn, own, evidence, fleet, sources, number))
        if len(row["young"]) == N_YOUNG[kind]:
            break
    return row


def evidence_of(
    rng: np.random.Generator, fleet: Stage, kind: str, number: int
) -> dict[str, MachineEvidence]:
    """Draw the mature machines of a fleet, and the evidence of each."""
    found = {}
    for k in range(N_TEACHERS[kind]):
        life = posterior(draw(rng, fleet, MATURE), described(), number)
        found[f"grown-{k:02d}"] = machine_evidence(described(), life)
    return found


def posterior(drawn: Life, stage: Stage, number: int) -> LifePosterior:
    """Fit a life under a prior."""
    return fit_life(drawn.history, stage, [SEED, number], chains=False)


def learned_prior(
    evidence: MachineEvidence, mature: Mapping[str, MachineEvidence]
) -> FleetPrior | None:
    """Return the fleet prior for a young machine; None with too few machines."""
    return fleet_priors(described(), dict(mature) | {"young": evidence}).get("young")


def young_machine(
    drawn: Life, own: LifePosterior, evidence: MachineEvidence, fleet: Stage,
    sources: Mapping[str, Mapping[str, MachineEvidence]], number: int,
) -> Row:  # fmt: skip
    """Score the prognoses of a young machine with every prior."""
    rng = np.random.default_rng([SEED, number, 2])
    limit = described().parameters[0].limit
    assert limit is not None
    truth = drawn.part.left(rng, drawn.now, limit.below, horizon())
    predicted = {DESCRIPTION: left(own, drawn.now),
                 KNOWN: left(posterior(drawn, fleet, number), drawn.now)}  # fmt: skip
    priors = {}
    for way, mature in sources.items():
        if (prior := learned_prior(evidence, mature)) is None:
            continue
        stage = prior.apply_to(described())
        predicted[way] = left(posterior(drawn, stage, number), drawn.now)
        law = prior.laws[0]
        assert law.pace is not None
        priors[way] = numbers(law.pace[1], law.share[1])
        if way == LEARNED:
            laws = replace(stage, scatter=None)
            predicted[LAWS] = left(posterior(drawn, laws, number), drawn.now)
    return {
        "priors": priors,
        "km": round(drawn.now / 1000),
        "truth_km": None if truth > horizon() else round(truth / 1000),
        **{way: scored(draws, truth, predicted[KNOWN], rng) for way, draws in predicted.items()},
    }


def numbers(prior: Prior, share: float) -> list[float]:
    """Return median (km) and sigma of a prior of wear lives, and the share that wears."""
    assert isinstance(prior, Lognormal)
    return [round(prior.median), round(prior.sigma, 3), round(share, 3)]


def left(life: LifePosterior, now: float) -> Array:
    """Draw the remaining life, in m."""
    part = [(0, described().parameters[0])]
    rng = np.random.default_rng(SEED)
    return passages(life, part, rng, now=now, horizon=horizon())[0][:, 0]


def scored(draws: Array, truth: float, known: Array, rng: np.random.Generator) -> Row:
    """Return the place of the truth among draws, the score, and its loss to the known fleet."""
    column, y = draws[:, None], np.array([truth])
    travel = np.linspace(0, horizon(), 4001)[:-1]
    off = below(draws, travel) - below(known, travel)
    return {
        "place": float(place(column, y, rng, horizon=horizon())[0]),
        "crps_km": float(crps(column, y, horizon=horizon())[0]) / 1000,
        "lost_km": float(np.mean(off**2)) * horizon() / 1000,
        "width_km": float(np.ptp(np.quantile(np.minimum(draws, horizon()), (0.05, 0.95)))) / 1000,
    }


def below(draws: Array, travel: Array) -> Array:
    """Return the distribution of draws at some travels."""
    return np.asarray(np.searchsorted(np.sort(draws), travel, side="right") / draws.size)


def judged(rows: list[Row], way: str) -> Row:
    """Judge the prognoses of one way, with standard errors over fleets."""
    fleets = [[one for one in row["young"] if way in one] for row in rows]
    fleets = [young for young in fleets if young]
    places = np.array([one[way]["place"] for young in fleets for one in young])
    answer: Row = {
        "lives": len(places),
        "mean_place": round(float(places.mean()), 3),
        "coverage": [judge_places(places, nominal) for nominal in (0.5, 0.9)],
    }
    for what in ("crps_km", "lost_km", "width_km"):
        answer[what] = mean([np.mean([one[way][what] for one in young]) for young in fleets])
        for other in (DESCRIPTION, LEARNED):
            answer[f"{what}_over_{other}"] = mean([
                np.mean([one[way][what] - one[other][what] for one in young if other in one])
                for young in fleets
            ])  # fmt: skip
    return answer


def verdicts(ways: Mapping[str, Row], n: int) -> dict[str, bool]:
    """Return the checks."""

    def surely(value: list[float], sign: int) -> bool:
        return sign * value[0] > SURE * value[1]

    found = {
        f"intervals hold: {way}": all(c["holds"] for c in ways[way]["coverage"])
        for way in (DESCRIPTION, LEARNED, LAWS, KNOWN)
    }
    if n < ENOUGH:
        return found
    gain = ways[LEARNED]
    found["learned loses less than the description"] = surely(gain["lost_km_over_description"], -1)
    found |= {f"loses more: {way}": surely(ways[way]["lost_km_over_learned"], 1)
              for way in (WORN, FOREIGN)}  # fmt: skip
    return found


def claims(answer: Row) -> Iterator[Claim]:
    """Claim the gain by a fleet prior."""
    own, learned = (answer["ways"][way] for way in (DESCRIPTION, LEARNED))
    what = (f"score (CRPS) of the remaining life of {answer['young']} young machines of fleets "
            "drawn from the estimator's own model")  # fmt: skip
    gain, described = own["crps_km_over_learned"], measured(own["crps_km"], "km")[0]
    beside = f"{described} by the description, {' '.join(measured(gain, 'km'))} more"
    yield Claim(what, *measured(learned["crps_km"], "km"), beside, gain[0] > 0)
    lost, by_description = learned["lost_km"], own["lost_km"]
    beside = f"{' '.join(measured(by_description, 'km'))} by the description"
    what, fine = "of it lost against the known fleet", lost[0] < by_description[0]
    yield Claim(what, *measured(lost, "km"), beside, fine)
    half, most = learned["coverage"]
    beside = f"50 %: {percents([half['share']])}"
    yield covered("intervals of 90 % cover, by the estimated prior", [most], beside)
    for way, source in ((WORN, "worn machines only"), (FOREIGN, "another fleet")):
        wrong = answer["ways"][way]
        what = f"lost with the prior from {source} (control)"
        beside = f"90 % intervals cover {percents([wrong['coverage'][1]['share']])}"
        fine = wrong["lost_km"][0] > lost[0]
        yield Claim(what, *measured(wrong["lost_km"], "km"), beside, fine)


if __name__ == "__main__":
    main()
