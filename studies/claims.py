"""What a study claims: a figure with how sure it is, and what stands beside it in the same run.

Beside its script a study has ``claims.py``: the step of the chain that it is of, and for each of
its records a function of the same name that reads nothing but the record.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from studies.metrics import clopper_pearson

Row = Mapping[str, Any]
STEPS = (
    "read",
    "spectra, following error, accelerations",
    "lines",
    "identify",
    "identify, after stops",
    "identify FRF logs",
    "track",
    "infer",
    "prognose",
    "prognose, young machines",
    "prognose, beside others",
    "health, on machines that it does not know",
    "plan",
    "batch",
    "all of it, from raw logs to the report",
    "simulated plants",
    "the tests themselves",
)


@dataclass(frozen=True, slots=True)
class Claim:
    """One claim of a study.

    Attributes
    ----------
    what : str
        Is claimed.
    figure : str
        That was measured.
    interval : str
        How sure that is: an interval or a Monte-Carlo error.
    beside : str
        A peer, a bound, what was asked, or a control, in the same run.
    met : bool
        Whether what was asked is so.
    """

    what: str
    figure: str
    interval: str = ""
    beside: str = ""
    met: bool = True


@dataclass(frozen=True, slots=True)
class Older:
    """A record that is older than a mend of what it measures.

    Attributes
    ----------
    digest : str
        Beginning of the SHA-256 of the record, so that the note ends with it.
    why : str
        What was mended since.
    """

    digest: str
    why: str


def number(value: float) -> str:
    """Write a number with three digits."""
    if value and (abs(value) < 1e-3 or abs(value) >= 1e6):
        return f"{value:.1e}"
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def span(values: Iterable[float], unit: str = "") -> str:
    """Write from which to which value numbers reach."""
    found = [float(value) for value in values]
    low, high = number(min(found)), number(max(found))
    return (low if low == high else f"{low} to {high}") + (f" {unit}" if unit else "")


def percents(shares: Iterable[float]) -> str:
    """Write shares in percent, from the lowest to the highest."""
    found = [100 * float(share) for share in shares]
    low, high = f"{min(found):.1f}", f"{max(found):.1f}"
    return (low if low == high else f"{low} to {high}") + " %"


def counted(what: str, hits: int, n: int, beside: str = "", *, met: bool = True) -> Claim:
    """Claim how many of how many, with the 95 % Clopper-Pearson interval of the share."""
    interval = f"{percents(clopper_pearson(hits, n))} (95 %)"
    return Claim(what, f"{hits:,} of {n:,}", interval, beside, met)


def covered(what: str, rows: Iterable[Row], beside: str = "", *, met: bool | None = None) -> Claim:
    """Claim the coverage of intervals, each row judged at 99.9 %."""
    found = list(rows)
    margin = max((row["high"] - row["low"]) / 2 for row in found)
    sizes = [row["n"] for row in found if "n" in row]
    return Claim(
        what,
        percents(row["share"] for row in found) + (f" ({span(sizes)} each)" if sizes else ""),
        f"± {100 * margin:.1f} % at most (99.9 %)",
        beside,
        all(row["holds"] for row in found) if met is None else met,
    )


def at_level(rows: Iterable[Row], nominal: float) -> list[Row]:
    """Pick the coverages of one level."""
    return [row for row in rows if row["nominal"] == nominal]


def measured(mean_and_error: Iterable[float], unit: str) -> tuple[str, str]:
    """Write a mean, and its standard error as an interval."""
    mean, error = mean_and_error
    return f"{number(mean)} {unit}", f"± {number(error)} {unit}"
