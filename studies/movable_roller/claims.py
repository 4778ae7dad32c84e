"""What movable_roller claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, counted, number

STEP = "infer"


def result(answer: Row) -> Iterator[Claim]:
    """Claim where a roller under a real beam stands."""
    inside, passed = answer["inside"], answer["passed"]
    controls = "; ".join(
        f"{name}: {row['inside']} of {row['inferred']}" for name, row in answer["controls"].items()
    )
    yield counted(
        "positions inside their 90 % intervals",
        inside["inside"],
        inside["inferred"],
        controls,
        met=all(passed.values()),
    )
    ends = [row["roller_v"] for row in answer["dwells"]]
    width = [row["q95"] - row["q05"] for row in answer["dwells"] if row["q95"] is not None]
    share = [100 * value / (max(ends) - min(ends)) for value in width]
    yield Claim(
        "width of the intervals, of the travel",
        f"{number(min(share))} to {number(max(share))} %",
        "",
        "3 % asked",
        passed["no interval is wider than 3 % of the travel"],
    )
    apart = max(abs(row["difference_v"]) / row["half_interval_v"] for row in answer["up_and_down"])
    yield Claim(
        "up and down differ, over half their interval, at most",
        number(apart),
        met=passed["up and down agree within their intervals"],
    )
