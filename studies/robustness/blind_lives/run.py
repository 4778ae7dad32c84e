"""Is the report right on lives drawn blind, and are its probabilities and intervals calibrated?

Method
    A generator draws for every machine the kind of life, stage, seed, number of logs, and the end
    of the record. Three quarters of the lives are of machines that differ from the shipped map
    (`simulate --plant-seed`), half have laws of wear of their own, most of which no description
    has; the description has the frequencies of the new machine, as its user would enter them. For
    most lives estimates are drawn about the true modes with the covariances of
    identified logs, and go through track, names, health at the last log, remaining life (by
    importance sampling), pool and verdict as in `assess`. A few lives of the nominal machine are
    simulated at 20 kHz, moved apart from their truth, and analysed by `lmshealth run`, of which
    tables and front page are read.
    The right verdict follows from the truth by the definitions of the README: a part is degraded
    when a quarter of the loss to its limit is gone; in X the mount moves no mode; a step that
    changes the modes has its own verdict, and so have machines with fewer than five logs. Lives
    near a border (within 0.02, or a step seen by one log only) are also counted separately.
    Calibration: the number of right verdicts against the sum of their probabilities, for all and in
    bins of probability, by lives and two-sided at 99.9 %. Intervals must cover at least as often as
    stated (99.9 %): the stated error of the map is in them. Remaining travel is censored at the
    horizon, and also judged for lives that reach a limit. Jumps after the record are in no law and
    not in the truth. Controls that must fail: the truth of another life of the stage, and intervals
    shrunk to a third.
Answer
    Yes within the resolution of 64 lives, 45 of drawn machines: 57 verdicts are right, 52 of 54
    away from borders; of 61 with a probability 54 are right where 57.6 are promised, 2.4 standard
    deviations too sure. Intervals of 90 % hold 51 of 64 preloads (80 %, 68 to 89), 27 of 29
    mounts, and 59 of 63 remaining lives, of those that reach a limit 42 of 46. Those of the
    preload are probably too narrow on drawn machines. No alarm in 12 sound lives, one of which is
    called worn.
Run time
    Fifteen minutes on one processor; ``--again`` judges the recorded lives again.
"""

from __future__ import annotations

import shutil
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import pandas as pd

from models.lives.simulation import simulate_life
from studies.harness.claims import Claim, number, share
from studies.harness.data.lives import HEALTHY
from studies.harness.metrics import clopper_pearson
from studies.harness.study import LEVEL, Row, Study, read_record
from studies.robustness.blind_lives import lives
from studies.robustness.blind_lives.estimated import blind_life
from studies.robustness.blind_lives.lives import SEED, BlindPlan, agrees, analyse, plan_of, truth_of

NAMES = {
    "guide_preload": "preload",
    "mount_stiffness": "mount stiffness",
    "any": "the first of all limits",
}

N_ESTIMATED, N_RAW, ENOUGH = 60, 4, 40
# A sound one, and one with too few logs. In X a mains line would take the name of roll.
QUICK = (
    BlindPlan("lms-y", "temperature-only", 5, 3.0, 61),
    BlindPlan("lms-x", "preload-wear", 2, 3.0, 63, until="failure"),
)
PROGRAMS = ("lmshealth.__main__",)
LIMITS = tuple(NAMES)
PARTS = LIMITS[:2]
# Of a machine that the report does not name.
SILENT: Row = {"verdict": "not-enough-data", "probability": None, "shown": None, "health": {},
          "left": {}, "events": {}, "refused": {}}  # fmt: skip
OTHERS = "truth of another life"


def main() -> None:
    """Run the study; ``--quick`` does one small archive without chains, and records nothing."""
    study = Study(__file__, __doc__, again=False)
    if study.quick:
        rows = [*archive_of(QUICK, quick=True), blind_life(0)]
    elif study.options.again:
        record = read_record(__file__)
        rows, took = record["rows"], record["recorded"]
        study.trials.kept_s = took["wall_s"] + took["kept_s"]
    else:
        rows = study.trials.collect(blind_life, [(k,) for k in range(N_ESTIMATED)])
        rows += study.trials.once(one_archive, 1, N_RAW, also=PROGRAMS)
    answer = judged(rows)
    answer["passed"] = verdicts(answer)
    study.conclude(answer, details={"rows": rows})


def one_archive(first: int, n: int) -> list[Row]:
    """Draw some lives, and take them from raw logs to the report."""
    return archive_of([plan_of(number) for number in range(first, first + n)])


def archive_of(plans: Sequence[BlindPlan], *, quick: bool = False) -> list[Row]:
    """Simulate an archive, have it analysed without its truth, and put both side by side."""
    with tempfile.TemporaryDirectory() as folder:
        logs, truths, out = (Path(folder) / name for name in ("logs", "truth", "out"))
        truths.mkdir()
        for plan in plans:
            simulate_life(plan, logs / plan.identity)
            shutil.move(logs / plan.identity / "truth.csv", truths / f"{plan.identity}.csv")
        reported = analyse(logs, out, quick=quick)
        return [
            {
                "stage": plan.stage,
                "kind": plan.life,
                "logs": plan.logs,
                "truth": truth_of(plan, pd.read_csv(truths / f"{plan.identity}.csv")),
                "reported": reported.get(plan.identity, SILENT),
            }
            for plan in plans
        ]


def judged(rows: Sequence[Row]) -> Row:
    """Judge the reports of all machines, and the same against the truth of others."""
    clear = [row for row in rows if row["truth"]["clear"]]
    others = lives.of_others(rows)
    sound = [row for row in rows if row["kind"] in HEALTHY]
    ending = [row for row in rows if row["truth"]["left"]["any"] is not None]
    refused: Counter[str] = Counter()
    for row in rows:
        refused.update(row["reported"]["refused"])
    return {
        "seed": SEED,
        "lives": len(rows),
        "verdicts": {
            name: {"right": lives.share(row["reported"]["verdict"] == row["truth"]["verdict"]
                                        for row in own),
                   "reported_of_true": lives.confusion(own)}
            for name, own in (("all", rows), ("clear of borders", clear), (OTHERS, others))
        },
        "sureness": {"all": lives.sureness(rows), OTHERS: lives.sureness(others)},
        "health": lives.coverages(rows, "health", PARTS),
        "left": lives.coverages(rows, "left", LIMITS),
        "left, ending": lives.coverages(ending, "left", LIMITS),
        OTHERS: {
            "health": lives.coverages(others, "health", PARTS),
            "left": lives.coverages(others, "left", LIMITS),
        },
        "sound_kinds": {
            "called worn or stepped": lives.share(
                row["reported"]["verdict"] not in ("healthy", "not-enough-data") for row in sound
            ),
            "alarms": lives.share("alarm" in row["reported"]["events"] for row in sound),
        },
        "steps_to_come": sum(row["truth"]["to_come"] for row in rows),
        "ends_beyond_horizon": _beyond(rows),
        "refused": {"logs": sum(row["logs"] for row in rows)} | dict(sorted(refused.items())),
        "front_page": lives.share(
            agrees(row["reported"]) for row in rows if row["reported"]["shown"] is not None
        ),
        "drawn": sum(row.get("drawn", False) for row in rows),
    }  # fmt: skip


def _beyond(rows: Iterable[Row]) -> dict[str, Row]:
    """Count machines, with and without a limit reached, whose median end is past the horizon."""
    pairs = [(row["truth"]["left"]["any"], row["reported"]["left"]["any"]) for row in rows
             if "any" in row["reported"]["left"]]  # fmt: skip
    return {
        name: lives.share(
            reported["q50"] is None for true, reported in pairs if (true is None) is never
        )
        for name, never in (("reach no limit", True), ("reach a limit", False))
    }


def verdicts(answer: Row) -> dict[str, bool]:
    """Return the checks; controls only with enough lives."""
    page, sure = answer["front_page"], answer["sureness"]
    checks = {
        "the front page shows every machine with its verdict": page["hits"] == page["n"],
        "verdicts are right at least as often as they say": sure["all"].get("holds", True),
        "verdicts are right as often as they say, in bins": all(
            one["holds"] for one in sure["all"].get("bins", ())
        ),
    }
    for what in ("health", "left", "left, ending"):
        checks[f"intervals hold the truth: {what}"] = all(_held(answer[what], ""))
    for name, row in answer["sound_kinds"].items():
        low = clopper_pearson(row["hits"], row["n"], LEVEL)[0]
        checks[f"at most 1 in 100 of sound kinds: {name}"] = low <= 0.01
    if answer["lives"] >= ENOUGH:
        checks[f"verdicts are not right: {OTHERS}"] = not sure[OTHERS]["holds"]
        for what in ("health", "left"):
            checks[f"intervals do not: {what}, {OTHERS}"] = not all(_held(answer[OTHERS][what], ""))
        # What lies past the horizon is held by any interval that does.
        for what in ("health", "left, ending"):
            checks[f"intervals do not: {what}, shrunk"] = not all(_held(answer[what], " shrunk"))
    return checks


def _held(names: dict[str, dict[str, Row]], way: str) -> list[bool]:
    return [row["holds"] for levels in names.values() for key, row in levels.items()
            if key.endswith(way) and key.endswith("shrunk") == bool(way)]  # fmt: skip


def claims(answer: Row) -> Iterator[Claim]:
    """Claim verdicts, how sure they are, what sound machines are called, and coverages."""
    yield from _verdicts(answer)
    for name, row in answer["sound_kinds"].items():
        fine = answer["passed"][f"at most 1 in 100 of sound kinds: {name}"]
        yield share(f"machines of sound kinds: {name}", row, "1 in 100 required", met=fine)
    for what, of in (("health", ""), ("left", "what is left until ")):
        for name, found in answer[what].items():
            yield from _covered(of + NAMES.get(name, name), found, answer[OTHERS][what][name])
    ending = answer["left, ending"]["any"]
    yield share(
        "intervals of 90 % that hold the truth: what is left of those that reach a limit",
        ending["90"],
        f"{ending['90 shrunk']['hits']} shrunk to a third",
        met=ending["90"]["holds"],
    )
    page = answer["front_page"]
    what = "rows of the front page that agree with the table of verdicts"
    yield share(what, page, met=page["hits"] == page["n"])


def _verdicts(answer: Row) -> Iterator[Claim]:
    found, sure = answer["verdicts"], answer["sureness"]["all"]
    wrong = found[OTHERS]["right"]
    for name in ("all", "clear of borders"):
        row = found[name]["right"]
        beside = f"{wrong['hits']} of {wrong['n']} with the {OTHERS}" if name == "all" else ""
        yield share(f"verdicts of blind lives that are right, {name}", row, beside)
    yield Claim(
        "verdicts with a probability that are right, and their number by these probabilities",
        f"{sure['right']} of {sure['n']}",
        f"{number(sure['z'])} standard deviations from it",
        f"{number(sure['promised'])} promised",
        met=sure["holds"],
    )
    for one in sure["bins"]:
        yield share(
            f"verdicts with a probability of {one['from']:g} to {one['to']:g} that are right",
            one,
            f"{100 * one['reported']:.1f} % expected",
            met=one.get("holds", True),
        )
    own, base = sure["brier"]
    yield Claim(
        "Brier score of the verdicts' probabilities",
        number(own),
        "",
        f"{number(base)} for a constant probability",
        met=own <= base,
    )


def _covered(name: str, found: Row, others: Row) -> Iterator[Claim]:
    for level in ("90", "50"):
        row, narrow, mixed = found[level], found[f"{level} shrunk"], others[level]
        if row["n"]:
            yield share(
                f"intervals of {level} % that hold the truth: {name}",
                row,
                f"{narrow['hits']} shrunk to a third, {mixed['hits']} with the {OTHERS}"
                + ("; overcoverage" if row["low"] > int(level) / 100 else ""),
                met=row["holds"],
            )


if __name__ == "__main__":
    main()
