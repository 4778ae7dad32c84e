"""Times as ratios to a peer in the same turn, and the test whether a figure is missed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import binom

from studies.harness.study import Row

# Largest probability that a figure exactly on its bound counts as missed.
FALSE_ALARM = 0.01


@dataclass(frozen=True)
class Figure:
    """A figure that is held, and what was measured of it."""

    name: str  # What is timed, and its peer
    peer: str
    at_most: float  # The largest ratio of both times with which the figure is met
    ratios: tuple[float, ...]  # One per turn

    def __post_init__(self) -> None:
        if binom.sf(len(self.ratios) - 1, len(self.ratios), 0.5) > FALSE_ALARM:
            raise ValueError(f"{len(self.ratios)} turns can miss nothing; needed are more")

    @property
    def median(self) -> float:
        """Row of the table."""
        return float(np.median(self.ratios))

    @property
    def missed(self) -> bool:
        """Whether more turns are above the bound than chance allows if the median were on it."""
        above = sum(ratio > self.at_most for ratio in self.ratios)
        return bool(binom.sf(above - 1, len(self.ratios), 0.5) < FALSE_ALARM)

    def row(self) -> Row:
        """Write it down."""
        return {
            "peer": self.peer,
            "ratio": round(self.median, 5),
            "least": round(min(self.ratios), 5),
            "largest": round(max(self.ratios), 5),
            "turns": len(self.ratios),
            "at_most": round(self.at_most, 5),
            "missed": self.missed,
        }


def table(rows: Mapping[str, Mapping[str, Any]]) -> Iterable[str]:
    """Lay rows out in lines for a terminal."""
    yield f"{'figure':<58}{'ratio':>10}{'least':>10}{'largest':>10}{'at most':>10}{'turns':>7}"
    for name, row in rows.items():
        numbers = "".join(f"{row[key]:>10.4g}" for key in ("ratio", "least", "largest", "at_most"))
        yield f"{name:<58}{numbers}{row['turns']:>7}{'  MISSED' if row['missed'] else ''}"
        yield f"    beside {row['peer']}"
