"""Claims of ranks: whether the truth is one more draw of the posterior."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from studies.claims import Claim, Row, at_level, covered, percents


def ranked(kind: str, rows: Iterable[Row], *, control: bool = False) -> Iterator[Claim]:
    """Claim that ranks are uniform, or of a control that some are not, with the coverages."""
    found = list(rows)
    levels = [row for own in found for row in own["coverage"]]
    inside = sum(row["inside_band"] for row in found)
    name = f"{kind} (control)" if control else kind
    half, most = at_level(levels, 0.5), at_level(levels, 0.9)
    fine = all(row["holds"] for row in levels) and inside == len(found)
    yield covered(
        f"90 % intervals hold the truth: {name}",
        most,
        f"50 %: {percents(row['share'] for row in half)}; ranks inside their 99.9 % band in "
        f"{inside} of {len(found)}",
        met=inside < len(found) if control else fine,
    )
