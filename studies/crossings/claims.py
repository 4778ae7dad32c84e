"""What crossings claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, counted, percents

STEP = "track"


def result(answer: Row) -> Iterator[Claim]:
    """Claim that nothing is swapped silently, and what is said to be ambiguous."""
    kinds, passed = answer["kinds"], answer["passed"]
    swapped = [row["lives_swapped"] for row in kinds.values()]
    nearest = [
        row["nearest_lives_swapped"]
        for name, row in kinds.items()
        if name not in ("merging", "well apart")
    ]
    yield counted(
        f"lives swapped silently, {len(kinds)} kinds",
        sum(row["hits"] for row in swapped),
        sum(row["n"] for row in swapped),
        f"the nearest frequency swaps {sum(row['hits'] for row in nearest)} of "
        f"{sum(row['n'] for row in nearest)} where modes cross or turn",
        met=passed["no life is swapped silently"],
    )
    turning = [row for name, row in kinds.items() if name not in ("merging", "well apart")]
    yield Claim(
        "estimates labelled after modes have crossed or turned",
        percents(row["labelled_after"] for row in turning),
        met=passed["most labels are recovered"],
    )
    merging, guess = kinds["merging"], answer["best_guess_where_nothing_tells"]
    yield Claim(
        "the same where nothing tells modes apart",
        percents([merging["labelled_after"]]),
        "",
        f"a best guess swaps {guess['hits']} of {guess['n']} lives",
        passed["what nothing tells is ambiguous"],
    )
