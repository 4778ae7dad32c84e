"""Claims of a study: a figure, its interval, and its comparison in the same run.

The function ``claims`` of a script computes the claims from its record alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from lmshealth.calibration.ranks import clopper_pearson

Row = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Claim:
    """One claim of a study."""

    what: str  # quantity that is claimed
    figure: str  # measured value
    interval: str = ""  # uncertainty: an interval or a Monte-Carlo error
    beside: str = ""  # peer, bound, requirement or control in the same run
    met: bool = True  # the requirement
    # Shares with the ends of their intervals, which the figure of the record shows.
    shares: tuple[tuple[float, float, float], ...] = field(default=(), compare=False)


def number(value: float) -> str:
    """Format a number with three digits."""
    if value and (abs(value) < 1e-3 or abs(value) >= 1e6):
        return f"{value:.1e}"
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def span(values: Iterable[float], unit: str = "") -> str:
    """Format the range of numbers."""
    found = [float(value) for value in values]
    low, high = number(min(found)), number(max(found))
    return (low if low == high else f"{low} to {high}") + (f" {unit}" if unit else "")


def percents(shares: Iterable[float]) -> str:
    """Format the range of shares in percent."""
    found = [100 * float(share) for share in shares]
    low, high = f"{min(found):.1f}", f"{max(found):.1f}"
    return (low if low == high else f"{low} to {high}") + " %"


def counted(what: str, hits: int, n: int, beside: str = "", *, met: bool = True) -> Claim:
    """Claim a count, with the 95 % Clopper-Pearson interval of the share."""
    ends = clopper_pearson(hits, n)
    figure, interval = f"{hits:,} of {n:,}", f"{percents(ends)} (95 %)"
    return Claim(what, figure, interval, beside, met, ((hits / n, *ends),))


def share(what: str, row: Row, beside: str = "", *, met: bool = True) -> Claim:
    """Claim a share that a study judged, as `counted`."""
    return counted(what, row["hits"], row["n"], beside, met=met)


def controls_seen(found: Mapping[str, bool]) -> str:
    """Format how many negative controls were detected."""
    return f"{sum(map(bool, found.values()))} of {len(found)} controls are detected"


def covered(what: str, rows: Iterable[Row], beside: str = "", *, met: bool | None = None) -> Claim:
    """Claim the coverage of intervals; each row is judged at 99.9 %."""
    found = list(rows)
    margin = max((row["high"] - row["low"]) / 2 for row in found)
    sizes = [row["n"] for row in found if "n" in row]
    return Claim(
        what,
        percents(row["share"] for row in found) + (f" ({span(sizes)} each)" if sizes else ""),
        f"± {100 * margin:.1f} % at most (99.9 %)",
        beside,
        all(row["holds"] for row in found) if met is None else met,
        tuple((row["share"], row["low"], row["high"]) for row in found),
    )


def at_level(rows: Iterable[Row], nominal: float) -> list[Row]:
    """Return the coverages of one level."""
    return [row for row in rows if row["nominal"] == nominal]


def measured(mean_and_error: Iterable[float], unit: str) -> tuple[str, str]:
    """Format a mean and its standard error."""
    mean, error = mean_and_error
    return f"{number(mean)} {unit}", f"± {number(error)} {unit}"


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
