"""What bench claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, number

STEP = "batch"


def result(answer: Row) -> Iterator[Claim]:
    """Claim the cost of every step in times of a peer."""
    for name, row in answer["figures"].items():
        yield Claim(
            name,
            f"{number(row['ratio'])} times",
            f"{number(row['least'])} to {number(row['largest'])} in {row['turns']} turns",
            f"{row['peer']}; at most {number(row['at_most'])}",
            not row["missed"],
        )
