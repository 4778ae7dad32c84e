"""What identification claims."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from studies.claims import Claim, Row, covered, number, percents, span

STEP = "identify"
HEADLINE = 2000  # records of each headline kind


def result(answer: Row) -> Iterator[Claim]:
    """Claim coverages, and errors beside the Cramér-Rao bound."""
    rows = answer["cases"]
    kinds = dict.fromkeys(row["case"] for row in rows)
    short = {row["case"] for row in rows if not row["coverage"]["holds"]}
    yield Claim(
        "kinds of records whose 95 % intervals of f and ζ cover",
        f"{len(kinds) - len(short)} of {len(kinds)}",
        "99.9 %",
        met=not short,
    )
    head = [row for row in rows if row["n"] + row["refused"] == HEADLINE]
    yield covered(
        "coverage of 95 % intervals in the headline kinds",
        [row["coverage"] for row in head],
        f"half as wide again {percents(row['too_wide']['share'] for row in head)}, "
        f"a third less wide {percents(row['too_narrow']['share'] for row in head)}",
    )
    fused = [row["as_if_independent"] for row in rows if "as_if_independent" in row]
    yield Claim(
        "the same where sources are averaged as if independent (control)",
        percents(row["share"] for row in fused),
    )
    bounded = [row for row in rows if "rmse_over_bound" in row]
    single = [row for row in bounded if "one channel" in row["case"]]
    sizes = Counter(row["case"] for row in rows)  # f and ζ of each mode
    several = [row for row in bounded if sizes[row["case"]] > 2]
    others = [row for row in bounded if row not in single and row not in several]
    for what, own in (
        ("one mode in three channels", others),
        ("several modes", several),
        ("one mode in a single channel", single),
    ):
        asked = [row["asked"] for row in own if row["asked"] is not None]
        yield Claim(
            f"root mean square errors over the Cramér-Rao bound, {what}",
            span(row["rmse_over_bound"] for row in own),
            f"± {number(max(row['its_error'] for row in own))} at most",
            f"{span(asked)} asked" if asked else "",
            not any(
                row["asked"] and row["rmse_over_bound"] - 2 * row["its_error"] > row["asked"]
                for row in own
            ),
        )
