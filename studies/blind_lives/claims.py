"""What blind_lives claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, counted, number

STEP = "all of it, from raw logs to the report"
OTHERS = "truth of another life"
NAMES = {
    "guide_preload": "preload",
    "mount_stiffness": "mount stiffness",
    "any": "the first of all limits",
}


def result(answer: Row) -> Iterator[Claim]:
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
