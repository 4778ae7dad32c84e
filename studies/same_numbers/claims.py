"""Claims of the comparison with the code before the layout of folders."""

from __future__ import annotations

from studies.claims import Claim, Row, number

STEP = "the tests themselves"


def result(record: Row) -> list[Claim]:
    """Claim equality of all numbers."""
    return [
        Claim(
            f"cells of {record['files']} tables and answers equal to those of the code before",
            f"{record['cells'] - record['n_different']:,} of {record['cells']:,}",
            f"worst relative difference {number(record['worst_relative_difference'])}",
            "1e-9 relative",
            not record["different"],
        )
    ]
