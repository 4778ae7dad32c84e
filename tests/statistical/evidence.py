"""P values of what statistical tests claim: how improbable the data are if the claim is true.

Each keeps the counts and places that it is of, which `tests.statistical.page` draws.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats


class Evidence(float):
    """A p value with its counts (hits, number, stated share, side), places of truths, or a text."""

    shares: tuple[tuple[int, int, float, str], ...]
    places: tuple[float, ...]
    text: str

    def __new__(
        cls, p: float, shares: Iterable[Any] = (), places: Iterable[float] = (), text: str = ""
    ) -> Evidence:
        """Keep what a p value is of."""
        made = super().__new__(cls, p)
        made.shares, made.places, made.text = tuple(shares), tuple(places), text
        return made


def _binomial(hits: int, n: int, share: float, side: str, alternative: Any) -> Evidence:
    p = stats.binomtest(int(hits), int(n), share, alternative=alternative).pvalue
    return Evidence(float(p), [(int(hits), int(n), float(share), side)])


def as_often(hits: int, n: int, share: float) -> Evidence:
    """Two-sided p value of so many hits, where each has this probability."""
    return _binomial(hits, n, share, "as", "two-sided")


def at_most(hits: int, n: int, share: float) -> Evidence:
    """P value of so many hits or more, where each has at most this probability."""
    return _binomial(hits, n, share, "most", "greater")


def at_least(hits: int, n: int, share: float) -> Evidence:
    """P value of so few hits or fewer, where each has at least this probability."""
    return _binomial(hits, n, share, "least", "less")


def all_of(p: Iterable[float]) -> Evidence:
    """P value of several claims made as one: the least of theirs, times their number."""
    values = list(p)
    shares = (share for one in values for share in getattr(one, "shares", ()))
    return Evidence(min(1.0, len(values) * min(values)), shares)


def covered(off: ArrayLike, factor: float = 1.0, share: float = 0.95) -> Evidence:
    """P value of the coverage of 95 % intervals, of errors in standard deviations.

    The control is a ``factor`` on the width of the intervals. ``share`` is what they state: where
    they are too wide those of 95 % hold hardly more, those of 80 % clearly more than that.
    """
    inside = np.abs(np.asarray(off)) < factor * float(stats.norm.isf((1 - share) / 2))
    return as_often(int(np.count_nonzero(inside)), inside.size, share)


def uniform(places: ArrayLike) -> Evidence:
    """P value of places of the truth in posteriors, which are uniform from 0 to 1.

    Their distribution by Kolmogorov and Smirnov, which sees a bias, and the coverages of central
    50 and 90 % intervals, which see what is too narrow or too wide.
    """
    places = np.ravel(places)
    levels = [
        as_often(int(np.count_nonzero(np.abs(places - 0.5) < share / 2)), places.size, share)
        for share in (0.5, 0.9)
    ]
    found = all_of([*levels, float(stats.kstest(places, "uniform").pvalue)])
    return Evidence(found, found.shares, places.round(4).tolist())


def sum_of_squares(total: float, dof: float) -> Evidence:
    """Two-sided p value of a sum of squares that has the χ² distribution."""
    p = float(2 * min(stats.chi2.cdf(total, dof), stats.chi2.sf(total, dof)))
    low, high = total / np.asarray(stats.chi2.ppf((0.975, 0.025), dof))
    return Evidence(p, text=f"mean square {total / dof:.3g} ({low:.3g} to {high:.3g}), stated 1")
