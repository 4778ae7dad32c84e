"""What a page says of a prior that was learned from other machines."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from lmshealth.prognosis.fleet_prior import FleetPrior, LawPrior, Pace
from lmshealth.prognosis.life_likelihood import expected_scatter, scatter_prior
from lmshealth.report.text import GAP, LEVELS, km, law_words, number, percent, spell
from lmshealth.stage.description import ScatterPrior, Stage

_KM = 1000.0


@dataclass(frozen=True, slots=True)
class Taught:
    """Of how many machines, and what was believed before and after, each with its name.

    ``laws`` are by parameter and law.
    """

    n_machines: int
    laws: tuple[tuple[str, str, str], ...]
    scatter: tuple[tuple[str, str, str], ...]


def taught(learned: FleetPrior | None, stage: Stage) -> Taught | None:
    """Put a learned prior in words; None where nothing was learned."""
    if learned is None:
        return None
    return Taught(
        learned.n_machines,
        tuple(_row(law) for law in learned.laws),
        tuple(_scatter(scatter_prior(stage), learned.scatter)),
    )


def _scatter(before: ScatterPrior, after: ScatterPrior) -> Iterator[tuple[str, str, str]]:
    names = ("random walk of ln frequency", "factor on reported errors", "health about its law")
    pairs = zip(expected_scatter(before), expected_scatter(after), strict=True)
    for name, pair in zip(names, pairs, strict=True):
        one, two = (f"{v:.2f}" if "factor" in name else f"{100 * v:.2f}{GAP}%" for v in pair)
        yield name, one, two


def _row(law: LawPrior) -> tuple[str, str, str]:
    words = [percent(share) for share in law.share]
    if law.pace is not None:
        words = [f"{w}; {_pace(law, p)}" for w, p in zip(words, law.pace, strict=True)]
    return f"{spell(law.parameter)}, {law_words(law.kind)}", words[0], words[1]


def _pace(law: LawPrior, pace: Pace) -> str:
    low, middle, high = (float(q) for q in pace.quantile(LEVELS))
    if law.field == "life_km":
        return f"life {km(middle * _KM)} ({number(low)} to {km(high * _KM)})"
    low, middle, high = (100 * _KM * rate for rate in (low, middle, high))
    return f"{number(middle)}{GAP}% per {km(_KM * _KM)} ({number(low)} to {number(high)}{GAP}%)"
