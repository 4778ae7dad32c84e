"""What one_guide claims."""

from __future__ import annotations

from collections.abc import Iterator

from studies.claims import Claim, Row, at_level, covered, percents

STEP = "infer"


def result(answer: Row) -> Iterator[Claim]:
    """Claim what is gained where one guide serves X and Y, and what is never claimed."""
    ways = answer["ways"]
    width = {way: percents([own["guide_preload"]["median_width"]]) for way, own in ways.items()}
    yield Claim(
        "preload is known from both to (median width of the 90 % interval)",
        width["together"],
        f"{answer['pairs']} pairs",
        f"{width['Y alone']} from Y, {width['X alone']} from X",
        answer["preload_narrower_than_y_alone"] > 1,
    )
    rows = [row for way in ways.values() for own in way.values() for row in own["coverage"]]
    for nominal in (0.5, 0.9):
        controls = [row for own in answer["controls"].values() for row in at_level(own, nominal)]
        yield covered(
            f"intervals of {100 * nominal:.0f} % cover",
            at_level(rows, nominal),
            "two guides taken for one, and half the width: "
            + percents(row["share"] for row in controls),
        )
    told = [
        own["told"]
        for way in ways.values()
        for name, own in way.items()
        if name in ("lms-x:mount_stiffness",)
        or (way is ways["X alone"] and name == "mount_stiffness")
    ]
    yield Claim("how often the mount of X is claimed", percents(told), "", "", not any(told))
