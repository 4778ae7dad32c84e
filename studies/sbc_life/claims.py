"""What sbc_life claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Older, Row
from studies.ranked import ranked

STEP = "prognose"
OLDER = {
    "result": Older(
        "f293e059ff09",
        "jumps were parted from logs at the same odometer, which its lives have not, and a linear "
        "law could gain",
    )
}
CONTROLS = ("map taken as exact", "every part taken to lose")
NOW = ("preload now", "mount now")


def result(answer: Row) -> Iterator[Claim]:
    """Claim uniform ranks of health now and of the remaining life."""
    for kind, rows in answer["ranks"].items():
        if kind in CONTROLS:
            yield from ranked(f"health now, {kind}", [rows[name] for name in NOW], control=True)
        else:
            yield from ranked(f"health now and remaining life, {kind}", rows.values())
