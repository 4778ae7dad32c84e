"""What lifetimes_raw claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, counted
from studies.ranked import ranked

STEP = "prognose"
CONTROL, STATED = "draws pulled to half their distance", "map error of 5 %"


def result(answer: Row) -> Iterator[Claim]:
    """Claim the remaining life from raw samples on, and of machines that keep their health."""
    for kind, rows in answer["ranks"].items():
        if kind != STATED:
            yield from ranked(f"from raw logs, {kind}", rows.values(), control=kind == CONTROL)
    kept, lost = answer["no_limit_within_horizon"], answer["limit_within_horizon"]
    yield counted(
        "lives that reach no limit within the horizon are told that no end is visible",
        kept["no_end_visible"],
        kept["n"],
    )
    yield counted(
        "lives that do reach one are told the same",
        lost["no_end_visible"],
        lost["n"],
        met=lost["no_end_visible"] == 0,
    )
