"""What sbc_epoch claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row
from studies.ranked import ranked

STEP = "infer"
CONTROLS = ("all covariances halved", "map taken as exact")
UNSEEN = "covariance of the drifts halved"


def result(answer: Row) -> Iterator[Claim]:
    """Claim uniform ranks of the truth, and controls that are found out."""
    for kind, rows in answer["ranks"].items():
        if kind == UNSEEN:
            yield from ranked(f"{kind}, which is not seen", rows.values())
        else:
            yield from ranked(kind, rows.values(), control=kind in CONTROLS)
