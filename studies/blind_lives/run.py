"""Raw logs of lives drawn blind: is the report right, and as sure as it may be?

Question
    Of an archive of raw logs, whose machines live any of ten kinds of lives that the analysis does
    not know, is the verdict of every machine right, and as often as its probability says? Do the
    intervals of preload, mount and remaining life hold the truth?
Method
    A generator draws the kind of every life (all of `models.lives`), its stage, its seed, how many
    logs it has and how long they are, and where it is cut; a tenth have fewer logs than make a
    baseline. They are written at 20 kHz, in archives of ten machines whose names tell nothing; the
    truth is moved to another folder. Then `lmshealth run` is called as a user calls it, with both
    shipped descriptions and their priors, and health at three epochs. What it says is read from its
    tables and its front page.

    What verdict is right at the last log follows from the truth alone, by the words of the README:
    a part counts as degraded once a quarter of what it may lose is gone, in X the mount moves no
    mode, a step of what the modes tell has no other verdict, nor has a machine of fewer than five
    logs. Lives near a border (a part within 0.02 of where it counts as degraded, or a step that
    only one log has seen) are told beside the others; of all, as many verdicts must be right as
    their probabilities promise (99.9 %).

    Intervals of 50 and 90 % of what is claimed must hold the truth at least as often as they say
    (99.9 % Clopper-Pearson): the map's error of 5 % is in them, and this map has none. Travel that
    is left is censored at the horizon, and told once more of those that reach a limit; a crash or a
    loosened bolt to come is in no law, and the truth of such a life is that of a machine to which
    none happens. Controls that must fail: every answer with the truth of another life of its stage,
    and intervals shrunk to a third.
Answer
    Yes. 99 of 100 verdicts are right, 87.3 of the 88 that have a probability were promised to be
    and 87 are; the one that is wrong is told with 58 %, of a machine whose mount stands 0.009 above
    where it counts as degraded. All steps that a log has seen, all young machines and all losses
    are told as such, and none of 56 machines of sound kinds is called worn or raises an alarm. The
    intervals hold more than they promise, those of 90 % in 99 of 100 (preload), 52 of 52 (mount)
    and 96 of 96 (remaining life), since the error of the map that they allow for is not there. Of
    59 machines that reach no limit none is told an end within the horizon in the median, and of 37
    that do all are.
Run time
    An hour and twenty minutes of one processor; archives done before are not done again, and
    ``--again`` judges the recorded lives anew.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import pandas as pd

from models.lives.simulation import simulate_life
from studies.blind_lives import judging
from studies.blind_lives.answers import agrees, analyse
from studies.blind_lives.lives import SEED, BlindPlan, plan_of, truth_of
from studies.common.lives import HEALTHY
from studies.common.metrics import clopper_pearson
from studies.harness.claims import Claim, counted, number
from studies.harness.study import LEVEL, Row, Study

STEP = "all of it, from raw logs to the report"
NAMES = {
    "guide_preload": "preload",
    "mount_stiffness": "mount stiffness",
    "any": "the first of all limits",
}


N_LIVES, IN_ARCHIVE = 100, 10
RECORD = Path(__file__).with_name("result.json")
# A sound one, and one with too few logs.
QUICK = (
    BlindPlan("lms-x", "temperature-only", 5, 3.0, 61),
    BlindPlan("lms-x", "preload-wear", 2, 3.0, 63, until="failure"),
)
PROGRAMS = ("lmshealth.__main__",)
PARTS = ("guide_preload", "mount_stiffness")
LIMITS = (*PARTS, "any")
# Of a machine that the report does not name.
SILENT = {"verdict": "not-enough-data", "probability": None, "shown": None, "health": {},
          "left": {}, "events": {}, "refused": {}}  # fmt: skip
OTHERS = "truth of another life"


def main() -> None:
    """Run the study; ``--quick`` does one small archive without chains, and records nothing."""
    study = Study(__file__, __doc__, again=False)
    if study.quick:
        rows = archive_of(QUICK, quick=True)
    elif study.options.again:
        record = json.loads(RECORD.read_text(encoding="utf-8"))
        rows, took = record["rows"], record["recorded"]
        study.trials.kept_s = took["wall_s"] + took["kept_s"]
    else:
        tasks = [(first, IN_ARCHIVE) for first in range(1, N_LIVES, IN_ARCHIVE)]
        done = study.trials.collect(one_archive, tasks, also=PROGRAMS)
        rows = [row for archive in done for row in archive]
    answer = judged(rows)
    answer["passed"] = verdicts(answer)
    study.conclude(answer, details={"rows": rows})


def one_archive(first: int, n: int) -> list[Row]:
    """Draw some lives, and take them from raw logs to the report."""
    return archive_of([plan_of(number) for number in range(first, first + n)])


def archive_of(
    plans: Sequence[BlindPlan], keep: Path | None = None, *, quick: bool = False
) -> list[Row]:
    """Simulate an archive, have it analysed without its truth, and put both side by side.

    Parameters
    ----------
    plans : sequence of BlindPlan
        The lives.
    keep : Path, optional
        Folder that gets pages and tables.
    quick : bool
        As in `analyse`.
    """
    with tempfile.TemporaryDirectory() as folder:
        logs, truths, out = (Path(folder) / name for name in ("logs", "truth", "out"))
        truths.mkdir()
        for plan in plans:
            simulate_life(plan, logs / plan.identity)
            shutil.move(logs / plan.identity / "truth.csv", truths / f"{plan.identity}.csv")
        told = analyse(logs, keep or out, quick=quick)
        return [
            {
                "stage": plan.stage,
                "kind": plan.life,
                "logs": plan.logs,
                "truth": truth_of(plan, pd.read_csv(truths / f"{plan.identity}.csv")),
                "told": told.get(plan.identity, SILENT),
            }
            for plan in plans
        ]


def judged(rows: Sequence[Row]) -> Row:
    """Judge what was said of all machines, and the same beside the truth of others."""
    clear = [row for row in rows if row["truth"]["clear"]]
    others = judging.of_others(rows)
    sound = [row for row in rows if row["kind"] in HEALTHY]
    ending = [row for row in rows if row["truth"]["left"]["any"] is not None]
    return {
        "seed": SEED,
        "lives": len(rows),
        "verdicts": {
            name: {"right": judging.share(_right(row) for row in own),
                   "told_of_true": judging.confusion(own)}
            for name, own in (("all", rows), ("clear of borders", clear), (OTHERS, others))
        },
        "sureness": {"all": judging.sureness(rows), OTHERS: judging.sureness(others)},
        "health": judging.coverages(rows, "health", PARTS),
        "left": judging.coverages(rows, "left", LIMITS),
        "left, ending": judging.coverages(ending, "left", LIMITS),
        OTHERS: {
            "health": judging.coverages(others, "health", PARTS),
            "left": judging.coverages(others, "left", LIMITS),
        },
        "sound_kinds": {
            "called worn or stepped": judging.share(
                row["told"]["verdict"] not in ("healthy", "not-enough-data") for row in sound
            ),
            "alarms": judging.share("alarm" in row["told"]["events"] for row in sound),
        },
        "steps_to_come": sum(row["truth"]["to_come"] for row in rows),
        "ends_beyond_horizon": _beyond(rows),
        "refused": _refused(rows),
        "front_page": judging.share(agrees(row["told"]) for row in rows),
    }  # fmt: skip


def _right(row: Row) -> bool:
    return bool(row["told"]["verdict"] == row["truth"]["verdict"])


def _beyond(rows: Iterable[Row]) -> dict[str, Row]:
    """Count machines that reach no limit, and those that do, of which no end is told to be near.

    The median of what is left until any limit lies past the horizon.
    """
    pairs = [(row["truth"]["left"]["any"], row["told"]["left"]["any"]) for row in rows
             if "any" in row["told"]["left"]]  # fmt: skip
    return {
        name: judging.share(told["q50"] is None for true, told in pairs if (true is None) is never)
        for name, never in (("reach no limit", True), ("reach a limit", False))
    }


def _refused(rows: Iterable[Row]) -> dict[str, int]:
    """Count what was refused by reason, and logs that exist."""
    found: Counter[str] = Counter()
    for row in rows:
        found.update(row["told"]["refused"])
    return {"logs": sum(row["logs"] for row in rows), **dict(sorted(found.items()))}


def verdicts(answer: Row) -> dict[str, bool]:
    """Say what was asked and whether it is so; controls only where there are lives enough."""
    page, sure = answer["front_page"], answer["sureness"]
    checks = {
        "the front page shows every machine with its verdict": page["hits"] == page["n"],
        "verdicts are right as often as they say": sure["all"].get("holds", True),
    }
    for what in ("health", "left", "left, ending"):
        checks[f"intervals hold the truth: {what}"] = all(_held(answer[what], ""))
    for name, row in answer["sound_kinds"].items():
        low = clopper_pearson(row["hits"], row["n"], LEVEL)[0]
        checks[f"at most 1 in 100 of sound kinds: {name}"] = low <= 0.01
    if answer["lives"] == N_LIVES:
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
        yield counted(
            f"machines of sound kinds: {name}", row["hits"], row["n"], "1 in 100 asked", met=fine
        )
    for what, of in (("health", ""), ("left", "what is left until ")):
        for name, found in answer[what].items():
            yield from _covered(of + NAMES.get(name, name), found, answer[OTHERS][what][name])
    found = answer["left, ending"]["any"]["90"], answer["left, ending"]["any"]["90 shrunk"]
    yield counted(
        "intervals of 90 % that hold the truth: what is left of those that reach a limit",
        found[0]["hits"],
        found[0]["n"],
        f"{found[1]['hits']} shrunk to a third",
        met=found[0]["holds"],
    )
    page = answer["front_page"]
    yield counted(
        "rows of the front page that say what the table of verdicts says",
        page["hits"],
        page["n"],
        met=page["hits"] == page["n"],
    )


def _verdicts(answer: Row) -> Iterator[Claim]:
    found, sure = answer["verdicts"], answer["sureness"]["all"]
    wrong = found[OTHERS]["right"]
    for name in ("all", "clear of borders"):
        row = found[name]["right"]
        yield counted(
            f"verdicts of blind lives that are right, {name}",
            row["hits"],
            row["n"],
            f"{wrong['hits']} of {wrong['n']} with the {OTHERS}" if name == "all" else "",
        )
    yield Claim(
        "verdicts with a probability that are right, beside what the probabilities promise",
        f"{sure['right']} of {sure['n']}",
        f"{number(sure['z'])} standard deviations from it",
        f"{number(sure['promised'])} promised",
        met=sure["holds"],
    )
    own, base = sure["brier"]
    yield Claim(
        "Brier score of the verdicts' probabilities",
        number(own),
        "",
        f"{number(base)} of who tells the share of rights of all",
        met=own <= base,
    )


def _covered(name: str, found: Row, others: Row) -> Iterator[Claim]:
    for level in ("90", "50"):
        row, narrow, mixed = found[level], found[f"{level} shrunk"], others[level]
        if row["n"]:
            yield counted(
                f"intervals of {level} % that hold the truth: {name}",
                row["hits"],
                row["n"],
                f"{narrow['hits']} shrunk to a third, {mixed['hits']} with the {OTHERS}",
                met=row["holds"],
            )


if __name__ == "__main__":
    main()
