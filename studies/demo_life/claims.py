"""What demo_life claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Older, Row, counted, percents

STEP = "infer"
OLDER = {"result": Older("b609ecec2899", "laws were weighed")}


def result(answer: Row) -> Iterator[Claim]:
    """Claim that intervals hold the truth of the demo's kind of life."""
    for name in ("guide_preload", "mount_stiffness", "remaining_km"):
        row = answer[name]
        yield counted(
            f"lives whose true {name} lies inside its 90 % interval",
            row["inside_90"],
            answer["n_lives"],
            f"{row['control_inside_when_shrunk_to_a_third']} inside a third of it",
        )
    widest = [
        answer[name]["widest_interval_over_prior"] for name in ("guide_preload", "mount_stiffness")
    ]
    yield Claim("widest interval of preload and mount, over the prior's", percents(widest))
