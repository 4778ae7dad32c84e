"""Laws of wear beyond those of `degradation`: acceleration, onset, events, recovery, cycles.

They have no closed form of their first passage in common: it is searched.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.lives.degradation import Course, Law

# A joint that has lost more than this has come apart, which no law describes.
LEAST = 0.05
_FURTHEST_KM = 100_000.0
_SEARCHED_KM = np.geomspace(1.0, _FURTHEST_KM, 4000)
_BISECTIONS = 60


def first_passage_km(law: Course, limit: float, breaks_km: Sequence[float] = ()) -> float | None:
    """Return the first odometer (km) at which a law is at a limit or below, by search.

    ``breaks_km`` are the odometers at which it may fall suddenly.  None if it is never below within
    100,000 km, at any of 4,000 odometers and the breaks.
    """
    odometers = np.union1d(_SEARCHED_KM, [km for km in breaks_km if km < _FURTHEST_KM])
    above = 0.0
    for km in odometers:
        if law.at(float(km)) <= limit:
            low, high = above, float(km)
            for _ in range(_BISECTIONS):
                middle = (low + high) / 2
                low, high = (low, middle) if law.at(middle) <= limit else (middle, high)
            return high
        above = float(km)
    return None


class _Searched:
    """A law whose first passage is searched."""

    __slots__ = ()

    def at(self, travel_km: float) -> float:
        """Return the fraction at an odometer (km)."""
        raise NotImplementedError

    @property
    def breaks_km(self) -> tuple[float, ...]:
        """Odometers (km) at which the law may fall suddenly."""
        return ()

    def reaches_km(self, limit: float) -> float | None:
        """Return the first odometer (km) at which the law is at the limit or below, or None."""
        return first_passage_km(self, limit, self.breaks_km)


@dataclass(frozen=True, slots=True)
class PowerLoss(_Searched):
    """Loss with a power of the travel: 1 − l (s/s_l)^n; accelerating for n above 1."""

    limit_km: float
    exponent: float
    loss: float

    def at(self, travel_km: float) -> float:
        """Return the fraction of commissioning."""
        share = max(travel_km, 0.0) / self.limit_km
        return max(1.0 - self.loss * math.pow(share, self.exponent), LEAST)


@dataclass(frozen=True, slots=True)
class Onset(_Searched):
    """Nothing until a start, then a linear loss: 1 − l (s − s_0)/s_l."""

    start_km: float
    linear_km: float
    loss: float

    def at(self, travel_km: float) -> float:
        """Return the fraction of commissioning."""
        return max(1.0 - self.loss * max(travel_km - self.start_km, 0.0) / self.linear_km, LEAST)


@dataclass(frozen=True, slots=True)
class Exponential(_Searched):
    """Loss that grows in proportion to itself, as a crack: 1 − a (exp(s/s_e) − 1)."""

    scale_km: float
    first: float

    def at(self, travel_km: float) -> float:
        """Return the fraction of commissioning."""
        grown = math.expm1(min(travel_km / self.scale_km, 700.0))
        return max(1.0 - self.first * grown, LEAST)


@dataclass(frozen=True, slots=True)
class Settling(_Searched):
    """Running-in: 1 − d (1 − exp(−s/s_r)), stable after some s_r."""

    depth: float
    scale_km: float

    def at(self, travel_km: float) -> float:
        """Return the fraction of commissioning."""
        return 1.0 + self.depth * math.expm1(-max(travel_km, 0.0) / self.scale_km)


@dataclass(frozen=True, slots=True)
class Shocks(_Searched):
    """Sudden losses at odometers (km), each leaving a part; none below a floor."""

    at_km: tuple[float, ...]
    left: tuple[float, ...]
    floor: float = LEAST

    def at(self, travel_km: float) -> float:
        """Return the fraction of commissioning."""
        count = int(np.searchsorted(self.at_km, travel_km, side="right"))
        return max(math.prod(self.left[:count]), self.floor)

    @property
    def breaks_km(self) -> tuple[float, ...]:
        """Odometers (km) of the events."""
        return self.at_km


@dataclass(frozen=True, slots=True)
class Recovering(_Searched):
    """Sudden losses from which a joint recovers: 1 − Σ d_i exp(−(s − s_i)/s_b)."""

    at_km: tuple[float, ...]
    depth: tuple[float, ...]
    back_km: float

    def at(self, travel_km: float) -> float:
        """Return the fraction of commissioning."""
        count = int(np.searchsorted(self.at_km, travel_km, side="right"))
        since = travel_km - np.array(self.at_km[:count])
        return max(1.0 - float(np.dot(self.depth[:count], np.exp(-since / self.back_km))), LEAST)

    @property
    def breaks_km(self) -> tuple[float, ...]:
        """Odometers (km) of the events."""
        return self.at_km


@dataclass(frozen=True, slots=True)
class Product(_Searched):
    """Two laws that act together."""

    first: Law
    second: Law

    def at(self, travel_km: float) -> float:
        """Return the fraction of commissioning."""
        return max(self.first.at(travel_km) * self.second.at(travel_km), LEAST)

    @property
    def breaks_km(self) -> tuple[float, ...]:
        """Odometers (km) at which one of them may fall suddenly."""
        return (*getattr(self.first, "breaks_km", ()), *getattr(self.second, "breaks_km", ()))


@dataclass(frozen=True, slots=True)
class Cycles:
    """What ages with the grease and is renewed at every greasing: 1 at first, then towards aged."""

    every_km: float
    aged: float
    scale_km: float

    def at(self, travel_km: float) -> float:
        """Return the fraction of that with fresh grease."""
        since = max(travel_km, 0.0) % self.every_km
        return self.aged + (1.0 - self.aged) * math.exp(-since / self.scale_km)


@dataclass(frozen=True, slots=True)
class Backlash:
    """Stiffness of contacts that lift off for a part of each cycle, below a preload.

    From preload p_0 down the secant stiffness falls linearly towards ``left`` at no preload.
    """

    preload: Law
    opens_at: float
    left: float

    def at(self, travel_km: float) -> float:
        """Return the factor of the stiffness, beyond what the preload does to it."""
        open_part = max(self.opens_at - self.preload.at(travel_km), 0.0) / self.opens_at
        return 1.0 - (1.0 - self.left) * open_part


@dataclass(frozen=True, slots=True)
class Growth:
    """A level that doubles so many times per 1,000 km, at most three times."""

    doublings: float

    def at(self, travel_km: float) -> float:
        """Return the level over that at commissioning."""
        return float(2.0 ** min(self.doublings * max(travel_km, 0.0) / 1000.0, 3.0))
