"""What mutants claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, counted

STEP = "the tests themselves"


def result(answer: Row) -> Iterator[Claim]:
    """Claim which small changes of the science make a test fail."""
    controls, passed = answer["controls"], answer["passed"]
    found = answer["mutants"]
    planted = controls["planted"]
    yield counted(
        "small changes of the science that make a test fail, or never end",
        found["killed"] + found["timed_out"],
        found["n"],
        f"85 % asked; errors planted in one function of each module: "
        f"{planted.get('killed', 0)} of {sum(planted.values())} found",
        met=all(passed.values()),
    )
    for link, row in answer["links"].items():
        yield counted(f"the same in {link}", row["killed"] + row["timed_out"], row["n"])
    numbers = [answer["kinds"][kind] for kind in ("number", "swap op") if kind in answer["kinds"]]
    yield counted(
        "the same where a number, an operation or a comparison is another",
        sum(row["killed"] + row["timed_out"] for row in numbers),
        sum(row["n"] for row in numbers),
    )
