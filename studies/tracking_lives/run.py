"""Does the tracker cover the drift of whole lives, and alarm when it should and only then?

Question
    On lives of ten kinds: do the intervals of the drift hold the truth as often as they say? How
    many healthy lives raise an alarm, where one in a hundred is declared? How soon is a loss of
    5 % of the preload told, against the best that is possible? Are events found and told apart?
Method
    Schedules and truth are those of `models`. Estimates are drawn about the truth with the
    covariance that identification really gives of logs of 20 s: that of a dozen simulated and
    identified logs of each stage, each log of a life taking one of them. The following error below
    40 Hz scatters and moves with the retuning as in these logs. The true drift is that of a mode at
    the reference temperature, the nominal payload and the tuning of commissioning. Judged is one
    interval a life, of one mode after one log, by the Clopper-Pearson interval of 99.9 %.
    Where the true drift is exactly zero, a filter that knows that machines may be healthy covers
    more than it says: of healthy lives only too low a coverage is a failure. Negative controls
    that must fail: covariances halved while the filter may not learn by how much they are wrong;
    the retuning neither declared nor to be seen; temperature unknown; payload unknown.
    The loss is spread evenly over 60 logs. Its optimum knows onset, direction and course: one knows
    also where the modes begin and what temperature does, the other learns it as a tracker must.
    With ``--raw`` lives are instead simulated at 20 kHz and identified log by log, and judged alike
    in raw.json. Of so many seeds every one
    is used of the kinds healthy, temperature, payload and retuning on LMS-Y, and every fourth of
    the others.
Answer
    Intervals of 90 and 50 % cover in all five kinds of damage; of healthy lives they hold the truth
    in 98 to 100 % and 79 to 88 %. Of 4,200 healthy tracks one alarms, all 1,500 damaged ones do.
    Temperature, payload or retuning unknown alarm in 68 to 100 of 100 lives; halved covariances
    cover 83 % of 90. The loss of 5 % is told in 300 of 300 lives, after 23 logs in the median:
    1.4 times the optimum that has to learn what a tracker must, 2.2 times the one that knows it.
    Retunings are found in all lives, crashes and broken bolts in all but one of 600, as a rule with
    their second log; regreasings in 270 of 300 on LMS-Y, where some move little, and all on LMS-X.
    Raw lives are few, and agree.
Run time
    A quarter of an hour of one processor; of raw lives half a minute each, where not kept.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np

from lmshealth.tracking import constants
from studies.common.lives import (
    DAMAGED,
    HEALTHY,
    RAW,
    Estimates,
    Life,
    drawn,
    identified,
    life_of,
    losing_life,
    measured,
    plan_of,
    recorded,
    rng_of,
)
from studies.common.metrics import clopper_pearson
from studies.harness.claims import Claim, counted, covered, number
from studies.harness.study import LEVEL, Row, Study, Trials
from studies.tracking_lives.optimum import optimum
from studies.tracking_lives.trials import (
    DECLARED_RATE,
    MOST,
    STAGES,
    Followed,
    alarmed,
    coverage,
    follow,
    summed,
)

STEP = "track"
EVENTS = ("crash", "sudden-loosening", "servo-retuning, undeclared", "regreasing, undeclared")

CASES = [("lms-y", kind) for kind in HEALTHY + DAMAGED] + [("lms-x", kind) for kind in HEALTHY]
QUICK = [
    ("lms-y", "healthy"), ("lms-y", "servo-retuning"), ("lms-y", "temperature-only"),
    ("lms-y", "payload-change"), ("lms-y", "crash"), ("lms-x", "healthy"),
]  # fmt: skip
# Kinds whose cause is declared by somebody, or not.
DECLARABLE = ("servo-retuning", "regreasing")
FIRST_SEED, RAW_SEED = 6000, 100
CONTROLS = 100  # lives at most of each negative control
# Alarms of damage, and events found, of all.
ENOUGH = 0.95
SIZED = 12  # logs of each stage that the sizes of estimates are taken from
SIZES = ("studies.common.lives",)  # where the sizes of estimates come from
Pairs = list[tuple[Life, Estimates]]
Sizes = dict[str, tuple[Estimates, Life]]


def main() -> None:
    """Run the study; ``--quick`` does one life of some kinds and records nothing."""
    study = Study(__file__, __doc__, raw=0)
    kept, seeds = study.kept(RAW), study.options.raw
    answer = raw(seeds, kept) if seeds else drawn_lives(study.trials, study.quick, kept)
    study.conclude(answer, name="raw" if seeds else "", quick_may_fail=True)


def drawn_lives(trials: Trials, quick: bool, kept: Path | None) -> Row:
    """Draw, track and judge lives of each kind: 300, or one with the sizes on record."""
    n = 1 if quick else 300
    sizes = {s: recorded(s) if quick else measured(s, SIZED, kept) for s in STAGES}
    cases = [i for i, case in enumerate(CASES) if not quick or case in QUICK]
    found = trials.collect(partial(of_kind, sizes), [(i, n) for i in cases], also=SIZES)
    answer = {
        "sizes": {stage: described(*pair) for stage, pair in sizes.items()},
        "lives": [row for one in found for row in one["lives"]],
        "controls": [row for one in found for row in one["controls"]],
        "halved": None if quick else trials.once(partial(halved, sizes), n, also=SIZES),
        "power": trials.once(partial(power, sizes["lms-y"]), n, also=SIZES),
    }
    return answer | {"passed": verdicts(answer, quick=quick)}


def of_kind(sizes: Sizes, i: int, n: int) -> Row:
    """Draw, track and judge so many lives of one kind."""
    pairs = pairs_of(sizes, i, n)
    return {"lives": judged(pairs), "controls": controls(pairs[:CONTROLS])}


def pairs_of(sizes: Sizes, i: int, n: int) -> Pairs:
    """Draw so many lives of one kind."""
    stage, kind = CASES[i]
    return [
        (life, drawn(life, *sizes[stage], rng_of(1, i, life.seed)))
        for life in lives(stage, kind, n)
    ]


def described(sizes: Estimates, life: Life) -> Row:
    """Tell the sizes that lives are drawn with."""
    std = np.sqrt(np.einsum("kii->ki", sizes.cov))
    loop, m = np.log(sizes.loop_error), life.drift.shape[1]
    first = life.servo == "commissioning"
    scatter = np.concatenate([part - part.mean() for part in (loop[first], loop[~first])])
    return {
        "logs": len(std),
        "median_std_ln_frequency": np.median(std[:, :m], axis=0).tolist(),
        "median_std_ln_damping": np.median(std[:, m:], axis=0).tolist(),
        "ln_loop_error_scatter": float(np.sqrt(np.sum(scatter**2) / (scatter.size - 2))),
        "ln_loop_error_jump": float(loop[~first].mean() - loop[first].mean()),
    }


def lives(stage: str, kind: str, n: int) -> Iterator[Life]:
    """Take lives of one kind."""
    return (life_of(plan_of(stage, kind, FIRST_SEED + i)) for i in range(n))


def judged(pairs: Pairs) -> list[Row]:
    """Track lives of one kind, with their cause declared and, where it can be, not."""
    kind = pairs[0][0].kind
    rows = [summed(follow(pairs), kind)]
    if kind in DECLARABLE:
        rows.append(summed(follow(pairs, declared=False), f"{kind}, undeclared"))
    return rows


def controls(pairs: Pairs) -> list[Row]:
    """Track lives of which the tracker does not know what it must."""
    unknown: dict[str, tuple[str, Row]] = {
        "servo-retuning": ("retuning unseen", {"declared": False, "loop_error": False}),
        "temperature-only": ("temperature unknown", {"covariates": ("payload_kg",)}),
        "payload-change": ("payload unknown", {"covariates": ("temperature_c",)}),
    }
    life = pairs[0][0]
    if life.kind not in unknown:
        return []
    name, known = unknown[life.kind]
    return [{"name": name, "stage": life.stage, "alarms": alarmed(follow(pairs, **known))}]


def halved(sizes: Sizes, n: int) -> Row:
    """Judge lives whose covariances are stated half as large, by a filter that cannot learn it."""
    found: list[Followed] = []
    for i, (_, kind) in enumerate(CASES):
        if kind in DAMAGED:
            pairs = pairs_of(sizes, i, n)
            small = [(life, replace(one, cov=one.cov / 2)) for life, one in pairs]
            with patch.object(constants, "NOISE_SCALES", ((1.0, 1.0),)):
                found += follow(small)
    return coverage(found)


def power(sizes: tuple[Estimates, Life], n: int) -> Row:
    """Return how soon a loss of preload is found, beside the best that is possible."""
    rows: list[dict[str, float]] = []
    false = {"knows": 0, "learns": 0}
    found = []
    for i in range(n):
        plan = plan_of("lms-y", "healthy", FIRST_SEED + i, 60)
        life, calm = losing_life(plan), life_of(plan)
        estimates, idle = (drawn(one, *sizes, rng_of(3, plan.seed)) for one in (life, calm))
        (followed,) = follow([(life, estimates)])
        found.append(followed)
        alarms = followed.track.alarms
        row: Row = {"tracker": alarms[0].epoch if alarms else None}
        for name in false:
            best = optimum(life, estimates, life.drift, learns=name == "learns")
            row |= {name: best.told, f"bound_{name}": best.bound}
            calmly = optimum(calm, idle, life.drift, learns=name == "learns")
            false[name] += calmly.told is not None
        # What is never told is told after the last log.
        logs = {who: 60 if at is None else at for who, at in row.items()}
        km = np.append(life.travel, life.travel[-1]) / 1000.0
        rows.append(logs | {f"{who}_km": float(km[at]) for who, at in logs.items()})
    columns = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    return {
        "alarms": alarmed(found),
        "coverage": coverage(found),
        "delays": {key: {"mean": float(v.mean()), **{f"q{q}": float(np.percentile(v, q))
                   for q in (5, 50, 95)}} for key, v in columns.items()},
        "over_best_that_learns": float(columns["tracker"].mean() / columns["learns"].mean()),
        "over_best_that_knows": float(columns["tracker"].mean() / columns["knows"].mean()),
        "false_alarms_of_best": {name: {"hits": hits, "n": n} for name, hits in false.items()},
    }  # fmt: skip


def raw(seeds: int, cache: Path | None) -> Row:
    """Track and judge lives that were simulated and identified."""
    rows = []
    for stage, kind in CASES:
        often = stage == "lms-y" and kind in HEALTHY and kind != "regreasing"
        plans = [plan_of(stage, kind, RAW_SEED + i) for i in range(0, seeds, 1 if often else 4)]
        rows += judged([(life_of(plan), identified(plan, cache)) for plan in plans])
    return {"lives": rows, "passed": verdicts_of_lives(rows)}


def verdicts(answer: Row, *, quick: bool) -> dict[str, bool]:
    """Return the checks; one life of a kind tells no rate of alarms."""
    checks = verdicts_of_lives(answer["lives"])
    if not quick:
        checks["halved covariances do not cover"] = not answer["halved"]["90"]["holds"]
    return checks | {
        "what is unknown alarms": all(
            row["alarms"]["low"] > DECLARED_RATE for row in answer["controls"]
        ),
        "a loss of 5 % is told": answer["power"]["alarms"]["share"] >= ENOUGH,
    }


def verdicts_of_lives(rows: list[Row]) -> dict[str, bool]:
    """Return what was asked of alarms, intervals and events."""
    healthy = [row for row in rows if row["kind"] in HEALTHY]
    damaged = [row for row in rows if row["kind"] in DAMAGED]
    retuned = [row for row in rows if row["name"] == "servo-retuning, undeclared"]
    total = sum(row["alarms"]["hits"] for row in healthy)
    low = clopper_pearson(total, sum(row["n"] for row in healthy), LEVEL)[0]
    return {
        "healthy lives alarm as declared": low <= DECLARED_RATE
        and all(row["alarms"]["low"] <= DECLARED_RATE for row in healthy),
        "at most 5 of 100 alarm": all(row["alarms"]["share"] <= MOST for row in healthy),
        "damage alarms": all(row["alarms"]["share"] >= ENOUGH for row in damaged),
        "intervals of damaged lives cover": all(
            row["coverage"][nominal]["holds"] for row in damaged for nominal in ("90", "50")
        ),
        "intervals of healthy lives cover at least": all(
            row["coverage"][nominal]["high"] >= float(nominal) / 100
            for row in healthy
            for nominal in ("90", "50")
        ),
        "crashes, loosenings and retunings are found": all(
            row["events"]["found_right"]["share"] >= ENOUGH
            for row in damaged + retuned
            if "found_right" in row["events"]
        ),
    }


def claims(answer: Row) -> Iterator[Claim]:
    """Claim coverage, alarms, delays and events of drawn lives."""
    yield from _lives(answer)
    yield covered(
        "the same, 90 %, where covariances are halved (control)",
        [answer["halved"]["90"]],
        met=not answer["halved"]["90"]["holds"],
    )
    power = answer["power"]
    alarms, learns = power["alarms"], number(power["over_best_that_learns"])
    yield counted(
        "5 % of preload lost over 60 logs is told",
        alarms["hits"],
        alarms["n"],
        "95 % required",
        met=alarms["share"] >= 0.95,
    )
    delays = power["delays"]
    spread = [delays["tracker"][q] for q in ("q5", "q95")]
    yield Claim(
        "logs until it is told, over those of the best that must learn as much",
        learns,
        f"{number(delays['tracker']['mean'])} logs in the mean, 90 % of lives "
        f"{number(spread[0])} to {number(spread[1])}",
        f"{number(power['over_best_that_knows'])} times those of who knows all",
    )
    hits = [row["alarms"] for row in answer["controls"]]
    yield counted(
        "lives alarm of which temperature, payload or a retuning is hidden (control)",
        sum(row["hits"] for row in hits),
        sum(row["n"] for row in hits),
    )


def claims_raw(answer: Row) -> Iterator[Claim]:
    """Claim the same of lives that were simulated and identified."""
    yield from _lives(answer)


def _lives(answer: Row) -> Iterator[Claim]:
    rows, passed = answer["lives"], answer["passed"]
    damaged = [row for row in rows if row["kind"] in DAMAGED]
    healthy = [row for row in rows if row not in damaged]
    for nominal in ("90", "50"):
        yield covered(
            f"intervals of {nominal} % hold the drift of damaged lives",
            [row["coverage"][nominal] for row in damaged],
        )
    yield covered(
        "intervals of 90 % hold the drift of healthy lives",
        [row["coverage"]["90"] for row in healthy],
        "wider than asked" if any(not r["coverage"]["90"]["holds"] for r in healthy) else "",
        met=passed["intervals of healthy lives cover at least"],
    )
    for what, own, asked in (
        ("healthy lives that alarm", healthy, "healthy lives alarm as declared"),
        ("damaged lives that alarm", damaged, "damage alarms"),
    ):
        hits = sum(row["alarms"]["hits"] for row in own)
        n = sum(row["n"] for row in own)
        yield counted(what, hits, n, "1 % declared" if own is healthy else "", met=passed[asked])
    for name in EVENTS:
        own = [row["events"]["found_right"] for row in rows if row["name"] == name]
        each = " (" + ", ".join(f"{row['hits']} of {row['n']}" for row in own) + ")"
        yield counted(
            f"told for what it is: {name}",
            sum(row["hits"] for row in own),
            sum(row["n"] for row in own),
            each.strip(" ()") if len(own) > 1 else "",
        )


if __name__ == "__main__":
    main()
