"""What new_machine claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, counted, number

STEP = "infer"


def result(answer: Row) -> Iterator[Claim]:
    """Claim that a described machine is told right, and that its tutorial does what it says."""
    rows, left, passed = answer["stiffness"], answer["remaining"], answer["passed"]
    lines = [line for step in answer["steps"] for line in step["commands"]]
    yield Claim(
        "commands of the tutorial that do what it says",
        f"{len(lines)} of {len(lines)}" if passed["what is shown comes out"] else "not all",
        met=passed["what is shown comes out"],
    )
    yield counted(
        "stiffness of a real coupling inside its 90 % intervals, sound and made to lose 7 %",
        sum(row["inside"] for row in rows),
        len(rows),
        "half the loss: outside at the end",
        met=all(row["inside"] for row in rows)
        and passed["control: half of B's fall is outside at the end"],
    )
    worn = left["bench-B"]
    yield Claim(
        "hours until the one made to lose reaches its limit",
        number(worn["rul_km_q50"]),
        f"{number(worn['rul_km_q05'])} to {number(worn['rul_km_q95'])} (90 %)",
        f"{number(left['true_of_bench-B_h'])} if it goes on",
        passed["B's end is inside its interval"],
    )
