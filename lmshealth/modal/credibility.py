"""Factors on the standard deviations of modes, by cause.

A likelihood states the covariance of ``[ln f, ln ζ]`` under assumptions. Where the data of the log
show that one does not hold, a method replaces the covariance, and records by how much that has
multiplied the standard deviation of ln f (`widened`), and for which cause. README.md lists the
causes: ``unsteady``, ``coloured`` and ``cluster`` of ambient vibration, ``noise-estimate`` and
``dependent-lines`` of frequency responses, ``ambient-level`` of free decays,
``set-ups`` of merged logs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import numpy as np

from lmshealth._private.arrays import ComplexArray, FloatArray

# Standard deviations of zero correlation from which on errors of neighbours count as correlated:
# one in 700 fits with independent errors.
_CLEAR_CORRELATION = 3.0

_Number = TypeVar("_Number", float, FloatArray)


class Factor(NamedTuple):
    """A factor on the standard deviation of the natural frequency of a mode."""

    cause: str
    value: float


@dataclass(frozen=True, slots=True)
class Credibility:
    """Factors on the standard deviation of the natural frequency of a mode, as they were applied.

    Without factors it is unknown what the standard deviation allows for, as in a table of another
    program.
    """

    factors: tuple[Factor, ...] = ()

    @property
    def total(self) -> float:
        """Product of the factors; NaN where it is unknown."""
        return math.prod(one.value for one in self.factors) if self.factors else math.nan


def widened(
    credibility: Sequence[Credibility], cause: str, before: FloatArray, after: FloatArray
) -> tuple[Credibility, ...]:
    """Add the factor of a cause to each mode, from covariances of ``[ln f, ln ζ]``.

    ``before`` and ``after`` have shape ``(2 n_modes, 2 n_modes)``.
    """
    n = len(credibility)
    factors = np.sqrt(np.diag(after)[:n] / np.diag(before)[:n]).tolist()
    return tuple(
        replace(one, factors=(*one.factors, Factor(cause, value)))
        for one, value in zip(credibility, factors, strict=True)
    )


def neighbour_correlation(white: ComplexArray) -> float:
    """Return the correlation of neighbouring errors of unit variance; 0 where it is not clear."""
    n = white.size
    found = np.sum((white[1:] * white[:-1].conj()).real) / np.sum(np.abs(white) ** 2)
    return float(found) if found > _CLEAR_CORRELATION / np.sqrt(2 * n) else 0.0


def dependence(correlation: _Number) -> _Number:
    """Return how many values of an autoregressive sequence count as one independent value.

    The correlation is that of neighbours. This is the factor on the variance of a mean.
    """
    return (1 + correlation) / (1 - correlation)


def inverse_bias(freedom: float) -> float:
    """Return by how much the mean inverse of an estimated variance exceeds the inverse variance.

    ``freedom`` is its number of complex degrees of freedom.
    """
    return freedom / (freedom - 1)


def small_sample(freedom: float, *, unbiased: bool = False) -> float:
    """Return the variance of an estimate over the one stated by weights from few values.

    Weights are inverse variances of ``freedom`` complex degrees of freedom each; where they are
    ``unbiased`` these variances have been multiplied by `inverse_bias`, a part of the factor.
    """
    return (freedom - unbiased) / (freedom - 2)
