"""How good is the remaining life, beside a straight line, progpy and the Cramér-Rao bound?

Method
    Lives of `models` that wear, loosen, or do both (LMS-Y, 60 logs up to past their end), cut at
    30, 50, 70 and 90 % of their length; estimates of roll and pitch are drawn about the truth with
    the covariance of identified logs of 20 s. Remaining life is the travel to 60 % of preload or 70
    % of mount stiffness, whichever comes first, scored (CRPS) up to the horizon of the description.
    Line: least squares through the health of single epochs, with its prediction interval. Ours:
    importance sampling in the place of chains. progpy: 1,000 of our draws of the laws' parameters
    as states of the same laws, in steps of 10 km; it leaves out runs that do not end, so that it
    is given with all runs too, and all ways answer for six healthy lives. Bound: Fisher's
    information of the laws' parameters (see `lives.bound`), once with the map known to be right,
    as it is here, and once to 5 %, as all estimators assume. Prognostic horizon: the life left
    when half of the draws lie within a tenth of the whole life, and stay there. A cut at a share of
    the true life is not observable and biases a perfect posterior too: calibration is judged on
    other lives, in sbc_life. Control: draws with a tenth of the spread must not cover.
Answer
    See the claims. The prognostic horizon is 51 % of life in the median, that of the line 32 %
    where it is ever good (39 of 48). Of services at a risk of 5 % none comes too late, of the
    line's four to seven of 48. No better than others at 30 % of life, where a twentieth of the
    draws never end; intervals near the end are too wide (1.7 times the life left at 90 %), because
    the map is exact and assumed right to 5 % only.
Run time
    Half an hour on one processor. progpy comes with the extra ``peers``; without it its rows are
    missing.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec

import numpy as np

from lmshealth.stage.description import Stage, load_stage
from studies.common import metrics
from studies.common.lives import Array, recorded, rng_of
from studies.harness.claims import Claim, Older, counted, measured, number
from studies.harness.study import Row, Study, judge_places
from studies.rul_metrics import lives
from studies.rul_metrics.forecasts import CONTROL, LINE, MISSING, OURS, PROGPY, WAYS, all_ways

STEP = "prognose, compared with others"
OLDER = {"result": Older("1939acb4ecd7", "lives could end by more than their laws")}

SEED = 20261124
LIVES, UNENDING = 16, 6  # of each kind, and healthy ones
ALPHA, RISK = 0.2, 0.05
NEAR, MASS = 0.1, 0.5  # of the prognostic horizon
BOUNDS = {"map right": 0.0, "map to 5 %": 0.05}
MAIN_CUT, FUTURES_S = 0.7, 0.1
_KM = 1000.0


def main() -> None:
    """Run the study; ``--quick`` predicts once in one life and records nothing."""
    study = Study(__file__, __doc__)
    tasks = [(kind, number, False) for number in range(LIVES) for kind in lives.KINDS]
    tasks += [(lives.HEALTHY, number, False) for number in range(UNENDING)]
    if study.quick:
        tasks = [(lives.KINDS[-1], 0, True)]
    rows = study.trials.collect(one, tasks)
    ending = [row for row, (kind, *_) in zip(rows, tasks, strict=True) if kind != lives.HEALTHY]
    answer: Row = {
        "seed": SEED,
        "lives": len(ending),
        "alpha": ALPHA,
        "risk": RISK,
        "cuts": [summed(cuts) for cuts in zip(*(row["cuts"] for row in ending), strict=True)],
        "whole_lives": whole(ending),
        "seconds": seconds(ending),
        "healthy": healthy([row for row in rows if row not in ending]),
        "missing": [] if find_spec("progpy") else [MISSING],
    }
    answer["passed"] = verdicts(answer, quick=study.quick)
    study.conclude(answer)


@cache
def machine() -> Stage:
    """Load the stage that all lives are of."""
    return load_stage(lives.STAGE)


def horizon() -> float:
    """Return the travel in m beyond which nothing is claimed."""
    return machine().description.usage.horizon_km * _KM


def one(kind: str, number: int, quick: bool) -> Row:
    """Follow a life and predict at every cut, or at the last log of a healthy one.

    The quick form takes the recorded covariances of estimates, and predicts at one cut.
    """
    case = lives.case_of(kind, number, recorded(lives.STAGE) if quick else None)
    if kind == lives.HEALTHY:
        return unending(case, number)
    cuts = (MAIN_CUT,) if quick else lives.CUTS
    return {"end_km": case.end / _KM, "cuts": [ahead(case, kind, number, k) for k in cuts]}


def ahead(case: lives.Case, kind: str, number: int, share: float) -> Row:
    """Predict in all ways from one cut."""
    history, stage = lives.cut(case, share), machine()
    key = [lives.KINDS.index(kind), number, round(100 * share)]
    rng, left = rng_of(32, *key), case.end - float(history.travel[-1])
    draws, seconds = all_ways(history, stage, [SEED, *key], rng)
    return {
        "share": share,
        "left_km": left / _KM,
        "bound_km": {k: lives.bound(case, history, stage, std) / _KM for k, std in BOUNDS.items()},
        "ways": {name: scored(own, left, case.end, rng) for name, own in draws.items()},
        "seconds": seconds,
    }


def unending(case: lives.Case, number: int) -> Row:
    """Predict where no limit is ever reached."""
    draws, _ = all_ways(case.history, machine(), [SEED, number], rng_of(33, number))
    far, score = horizon(), metrics.crps
    return {
        name: {
            "beyond": float(np.mean(own > far)),
            "median_km": float(np.median(np.minimum(own, far))) / _KM,
            "crps_km": score(own[:, None], [np.inf], horizon=far).item() / _KM,
        }
        for name, own in draws.items()
    }


def scored(draws: Array, left: float, end: float, rng: np.random.Generator) -> Row:
    """Score draws of the remaining life."""
    x, far = draws[:, None], horizon()
    service = metrics.service_at(x, RISK, horizon=far)
    low, high = np.quantile(np.minimum(draws, far), [0.05, 0.95])
    values = {
        "width_over_left": (high - low) / left,
        "accurate": metrics.alpha_lambda(x, [left], ALPHA)[0],
        "mass": metrics.mass_within(x, [left], ALPHA * left)[0],
        "near": metrics.within(x, [left], NEAR * end, mass=MASS)[0],
        "accuracy": metrics.relative_accuracy(np.minimum(x, far), [left])[0],
        "crps_km": metrics.crps(x, [left], horizon=far)[0] / _KM,
        "place": metrics.place(x, [left], rng, horizon=far)[0],
        "beyond": np.mean(draws > far),
        "broken": metrics.unexpected_breaks(service, [left])[0],
        "unexploited_km": metrics.unexploited_life(service, [left], horizon=far)[0] / _KM,
    }
    return {name: value.item() for name, value in values.items()}


def summed(cuts: tuple[Row, ...]) -> Row:
    """Summarise one cut of several lives."""
    left = np.array([row["left_km"] for row in cuts])
    bounds = {}
    for name in BOUNDS:
        std = np.array([row["bound_km"][name] for row in cuts])
        inside = [lives.share_within(*pair) for pair in zip(std, ALPHA * left, strict=True)]
        bounds[name] = {
            "accurate": float(np.mean(inside)),
            "relative_std": float(np.median(std / left)),
        }
    told = [name for name in WAYS if any(name in row["ways"] for row in cuts)]
    return {
        "share": cuts[0]["share"],
        "n": len(cuts),
        "mean_left_km": float(left.mean()),
        "bound": bounds,
        "ways": {name: way(cuts, name, bounds) for name in told},
    }


def way(cuts: tuple[Row, ...], name: str, bounds: Row) -> Row:
    """Summarise what one way predicts at one cut; where it predicts nothing it is not accurate."""
    rows = [row["ways"][name] for row in cuts if name in row["ways"]]
    column = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    hits, n = int(column["accurate"].sum()), len(cuts)
    shares = [hits / n, *metrics.clopper_pearson(hits, n)]
    both = [row["ways"] for row in cuts if {name, OURS} <= set(row["ways"])]
    more = np.array([ways[name]["crps_km"] - ways[OURS]["crps_km"] for ways in both])
    error = float(more.std(ddof=1) / np.sqrt(more.size)) if more.size > 1 else None
    return {
        "accurate": dict(
            zip(("hits", "n", "share", "low", "high"), (hits, n, *shares), strict=True)
        ),
        "over_bound": {
            what: [share / own["accurate"] for share in shares] for what, own in bounds.items()
        },
        "said_nothing": n - len(rows),
        "mass": float(column["mass"].mean()),
        "median_accuracy": float(np.median(column["accuracy"])),
        "crps_km": float(column["crps_km"].mean()),
        "crps_more_than_ours_km": {"mean": float(more.mean()) if more.size else None, "se": error},
        "coverage": [judge_places(column["place"], p) for p in (0.5, 0.9)],
        "places": np.sort(column["place"]).round(4).tolist(),
        "beyond": float(column["beyond"].mean()),
        "width_over_left": float(np.median(column["width_over_left"])),
        "broken": int(column["broken"].sum()),
        "unexploited_km": float(column["unexploited_km"].mean()),
    }


def whole(rows: list[Row]) -> Row:
    """Summarise whole lives: the prognostic horizon, and the mean accuracy."""
    left = np.array([[one["left_km"] for one in row["cuts"]] for row in rows]).T
    end = np.array([row["end_km"] for row in rows])
    found = {}
    for name in WAYS:
        own = [[one["ways"].get(name, {}) for one in row["cuts"]] for row in rows]
        if not any(one for row in own for one in row):
            continue
        near = np.array([[bool(one.get("near")) for one in row] for row in own]).T
        accuracy = np.array([[one.get("accuracy", np.nan) for one in row] for row in own]).T
        share = metrics.prognostic_horizon(near, left) / end
        found[name] = {
            "horizon_share_of_life": float(np.median(share)),
            "never_good": int(np.sum(share == 0)),
            "cumulative_accuracy": float(
                np.nanmedian(metrics.cumulative_relative_accuracy(accuracy))
            ),
        }
    return found


def healthy(rows: list[Row]) -> Row:
    """Average what is predicted of lives without an end."""
    found = {}
    for name in WAYS:
        if own := [row[name] for row in rows if name in row]:
            means = {key: float(np.mean([one[key] for one in own])) for key in own[0]}
            found[name] = {"n": len(own)} | means
    return found


def seconds(rows: list[Row]) -> Row:
    """Return median and largest processor times over all cuts."""
    cuts = [one["seconds"] for row in rows for one in row["cuts"]]
    own = {name: [one[name] for one in cuts if name in one] for name in {**cuts[0], **cuts[-1]}}
    return {
        name: {"median": float(np.median(values)), "largest": max(values)}
        for name, values in own.items()
    }


def verdicts(answer: Row, *, quick: bool) -> dict[str, bool]:
    """Return the checks; times are judged in the recorded run alone."""
    (main,) = (row["ways"] for row in answer["cuts"] if row["share"] == MAIN_CUT)
    times = {name: row["median"] for name, row in answer["seconds"].items()}
    ours = [row["ways"].get(OURS) for row in answer["cuts"]]
    checks = {"every life is told": all(row and row["said_nothing"] == 0 for row in ours)}
    if PROGPY in times:
        checks["10,000 draws in less time than 1,000 of progpy"] = times[OURS] < times[PROGPY]
    if quick:
        return checks
    line = main[LINE]["crps_more_than_ours_km"]
    checks |= {
        "10,000 draws in 0.1 s after the posterior": times[OURS] < FUTURES_S,
        "a better score than the line's at 70 % of life": line["mean"] > 2 * line["se"],
        "control: a tenth of the spread does not cover": not any(
            row["ways"][CONTROL]["coverage"][1]["holds"] for row in answer["cuts"]
        ),
    }
    if PROGPY in main:
        peer = main[PROGPY]["crps_more_than_ours_km"]
        checks["no worse a score than progpy's at 70 % of life"] = peer["mean"] > -2 * peer["se"]
    return checks


def claims(answer: Row) -> Iterator[Claim]:
    """Claim accuracy and score beside a line, progpy and the Cramér-Rao bound."""
    for moment in answer["cuts"]:
        ways, share = moment["ways"], f"{100 * moment['share']:.0f} % of life"
        ours, line = ways[OURS], ways[LINE]
        right, low, high = ours["over_bound"]["map right"]
        yield counted(
            f"median within a fifth of the truth at {share}",
            ours["accurate"]["hits"],
            ours["accurate"]["n"],
            f"{right:.2f} times ({low:.2f} to {high:.2f}) as often as at the Cramér-Rao bound; "
            f"a line {line['accurate']['hits']}",
        )
        others, better = [], False
        for name in (LINE, PROGPY):
            if name in ways:
                apart = ways[name]["crps_more_than_ours_km"]
                better |= apart["mean"] < -2 * apart["se"]
                more = " ".join(measured(apart.values(), "km"))
                others.append(f"{name} {number(ways[name]['crps_km'])} km ({more} more)")
        met = ours["crps_km"] <= line["crps_km"] and not better
        score = f"{number(ours['crps_km'])} km"
        yield Claim(f"score (CRPS) at {share}", score, "", "; ".join(others), met)
        for inside, wrong in zip(ours["coverage"], line["coverage"], strict=True):
            yield counted(
                f"{100 * inside['nominal']:.0f} % intervals hold the truth at {share}",
                inside["hits"],
                inside["n"],
                f"a line's {wrong['hits']}" + ("" if inside["holds"] else "; ours are too wide"),
                met=inside["holds"],
            )
    times = answer["seconds"]
    yield Claim(
        "10,000 draws after the posterior",
        f"{1e3 * times[OURS]['median']:.0f} ms",
        f"{1e3 * times[OURS]['largest']:.0f} ms at most",
        f"1,000 of progpy: {number(times[PROGPY]['median'])} s" if PROGPY in times else "",
        answer["passed"]["10,000 draws in 0.1 s after the posterior"],
    )
    ours, peer = answer["healthy"][OURS], answer["healthy"].get(PROGPY)
    yield Claim(
        "remaining life of healthy lives: probability past the horizon",
        number(ours["beyond"]),
        f"{ours['n']} lives",
        f"progpy: median {number(peer['median_km'])} km in {peer['n']}" if peer else "",
    )


if __name__ == "__main__":
    main()
