"""Truth laws of a life: what preload, mount and temperature do over travel and time.

Laws are functions of the odometer s (km).  Every life draws the same parameters from the seed and
uses the ones it needs, so that lives of one seed differ in nothing but the damage.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from models.errors import UnknownLife

GUIDE_PRELOAD_LIMIT = 0.6
MOUNT_STIFFNESS_LIMIT = 0.7
# A contact never loses all of its preload in these lives: the law ends here.
_LEAST_PRELOAD = 0.05


@dataclass(frozen=True, slots=True)
class HertzWear:
    """Preload loss by wear: P(s) = (1 − (s/s_w)^n)^1.5, as Hertz gives for lost interference.

    Parameters
    ----------
    life_km
        s_w, km: interference is used up.
    exponent
        n.
    """

    life_km: float
    exponent: float

    def at(self, travel_km: float) -> float:
        """Return the preload as a fraction of commissioning."""
        left = 1.0 - (max(travel_km, 0.0) / self.life_km) ** self.exponent
        return float(max(max(left, 0.0) ** 1.5, _LEAST_PRELOAD))

    def reaches_km(self, limit: float) -> float | None:
        """Return the odometer (km) at which the law falls to the limit, in closed form."""
        used = 1.0 - limit ** (2.0 / 3.0)
        return float(self.life_km * used ** (1.0 / self.exponent))


@dataclass(frozen=True, slots=True)
class Loosening:
    """Mount loosening towards a floor: k(s) = k_f + (1 − k_f) exp(−s/s_m)."""

    scale_km: float
    floor: float

    def at(self, travel_km: float) -> float:
        """Return the mount stiffness as a fraction of commissioning."""
        return float(self.floor + (1.0 - self.floor) * math.exp(-travel_km / self.scale_km))

    def reaches_km(self, limit: float) -> float | None:
        """Return the odometer (km) at which the law falls to the limit; None if never."""
        if limit <= self.floor:
            return None
        return float(-self.scale_km * math.log((limit - self.floor) / (1.0 - self.floor)))


@dataclass(frozen=True, slots=True)
class Steady:
    """No change."""

    def at(self, travel_km: float) -> float:
        """Return 1 whatever the odometer (km)."""
        return 1.0

    def reaches_km(self, limit: float) -> float | None:
        """Return None: a steady parameter crosses no limit."""
        return None


Law = HertzWear | Loosening | Steady


@dataclass(frozen=True, slots=True)
class Climate:
    """Temperature at the stage: mean (°C), seasonal and daily amplitude, scatter (K)."""

    mean_c: float
    seasonal_k: float
    daily_k: float
    scatter_k: float

    def at(self, moment: datetime, rng: np.random.Generator) -> float:
        """Return the temperature (°C) at a moment; warmest in July and in mid-afternoon."""
        day = moment.timetuple().tm_yday
        hour = moment.hour + moment.minute / 60
        season = math.cos(2 * math.pi * (day - 200) / 365.25)
        daily = math.cos(2 * math.pi * (hour - 15) / 24)
        noise = self.scatter_k * float(np.clip(rng.standard_normal(), -2.0, 2.0))
        return self.mean_c + self.seasonal_k * season + self.daily_k * daily + noise


ROOM = Climate(mean_c=21.5, seasonal_k=1.6, daily_k=0.8, scatter_k=0.3)
HALL = Climate(mean_c=21.5, seasonal_k=6.0, daily_k=3.0, scatter_k=0.5)


@dataclass(frozen=True, slots=True)
class Life:
    """What one stage goes through."""

    name: str
    preload: Law
    mount: Law
    climate: Climate


@dataclass(frozen=True, slots=True)
class Draws:
    """The parameters that a seed gives to any life."""

    wear: HertzWear
    loosening: Loosening


def draw_laws(rng: np.random.Generator) -> Draws:
    """Draw the parameters of all laws, always all and in this order."""
    life_km = float(8000.0 * np.exp(0.25 * rng.standard_normal()))
    exponent = float(rng.uniform(0.9, 1.3))
    floor = float(rng.uniform(0.5, 0.65))
    scale_km = float(3000.0 * np.exp(0.25 * rng.standard_normal()))
    return Draws(HertzWear(life_km, exponent), Loosening(scale_km, floor))


LIVES: dict[str, Callable[[Draws], Life]] = {
    "healthy": lambda draws: Life("healthy", Steady(), Steady(), ROOM),
    "preload-wear": lambda draws: Life("preload-wear", draws.wear, Steady(), ROOM),
    "mount-loosening": lambda draws: Life("mount-loosening", Steady(), draws.loosening, ROOM),
    "both": lambda draws: Life("both", draws.wear, draws.loosening, ROOM),
    "temperature-only": lambda draws: Life("temperature-only", Steady(), Steady(), HALL),
}


def life_named(name: str, rng: np.random.Generator) -> Life:
    """Return a life with its laws drawn.

    Raises
    ------
    UnknownLife
        If the name is not registered in `LIVES`.
    """
    if name not in LIVES:
        raise UnknownLife(name, LIVES)
    return LIVES[name](draw_laws(rng))
