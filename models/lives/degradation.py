"""Truth laws of a life: what preload, mount, grease, payload, servo and temperature do.

Laws are functions of the odometer s (km).  Every life draws the same parameters from the seed and
uses the ones it needs, so that lives of one seed differ in nothing but what the life changes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from typing import Protocol

import numpy as np

from models.dynamics.stages import Condition
from models.lives.circumstances import IDEAL, Circumstances

GUIDE_PRELOAD_LIMIT = 0.6
MOUNT_STIFFNESS_LIMIT = 0.7
# A contact never loses all of its preload in these lives: the law ends here.
_LEAST_PRELOAD = 0.05


class Course(Protocol):
    """A fraction of commissioning over the odometer."""

    def at(self, travel_km: float) -> float:
        """Return the fraction at an odometer (km)."""


class Law(Course, Protocol):
    """A course with a first passage; those of this module never rise."""

    def reaches_km(self, limit: float) -> float | None:
        """Return the odometer (km) at which the law first is at the limit or below, or None."""


@dataclass(frozen=True, slots=True)
class HertzWear:
    """Preload loss by wear: P(s) = (1 − (s/s_w)^n)^1.5, by Hertz contact with lost interference.

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


@dataclass(frozen=True, slots=True)
class Delayed:
    """A law that begins at an odometer (km) and is 1 before."""

    law: Law
    start_km: float

    def at(self, travel_km: float) -> float:
        """Return the law's value at the odometer (km) counted from its start."""
        return self.law.at(max(travel_km - self.start_km, 0.0))

    def reaches_km(self, limit: float) -> float | None:
        """Return the odometer (km) at which the law falls to the limit; None if never."""
        reached = self.law.reaches_km(limit)
        return None if reached is None else self.start_km + reached


@dataclass(frozen=True, slots=True)
class Stepped:
    """A law of which from an odometer (km) on only a part is left."""

    law: Law
    step_km: float
    left: float

    def at(self, travel_km: float) -> float:
        """Return the law's value, times what is left after the step."""
        return self.law.at(travel_km) * (self.left if travel_km >= self.step_km else 1.0)

    def reaches_km(self, limit: float) -> float | None:
        """Return the odometer (km) of the first passage: before, at or after the step."""
        before = self.law.reaches_km(limit)
        if before is not None and before < self.step_km:
            return before
        if self.at(self.step_km) <= limit:
            return self.step_km
        return self.law.reaches_km(limit / self.left)


@dataclass(frozen=True, slots=True)
class Grease:
    """Loss of the guide's joints as grease ages: from ``start`` towards ``aged``.

    Fresh grease damps more; at ``regreased_km`` the loss steps up to ``fresh`` and ages again.
    """

    regreased_km: float
    fresh: float
    aged: float
    scale_km: float

    def at(self, travel_km: float) -> float:
        """Return the loss as a fraction of commissioning at an odometer (km)."""
        renewed = travel_km >= self.regreased_km
        start, since = (self.fresh, self.regreased_km) if renewed else (1.0, 0.0)
        decay = math.exp(-(travel_km - since) / self.scale_km)
        return self.aged + (start - self.aged) * decay


@dataclass(frozen=True, slots=True)
class Jobs:
    """Loads (kg above the nominal payload) that are taken in turn, each for so many km."""

    loads: tuple[float, ...]
    every_km: float

    def at(self, travel_km: float) -> float:
        """Return the added payload (kg) at an odometer (km)."""
        return self.loads[int(travel_km // self.every_km) % len(self.loads)]


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

    def behind(self, moment: datetime, lag_h: float) -> float:
        """Return the temperature (°C) of what follows by first order with a time constant (h).

        Season and day come through smaller and later; the scatter, of minutes, does not.
        """
        hours = moment.timetuple().tm_yday * 24.0, moment.hour + moment.minute / 60
        waves = ((self.seasonal_k, 24 * 365.25, 24 * 200.0), (self.daily_k, 24.0, 15.0))
        value = self.mean_c
        for at, (size, period, warmest) in zip(hours, waves, strict=True):
            turn = 2 * math.pi / period
            value += (
                size
                * math.cos(turn * (at - warmest) - math.atan(turn * lag_h))
                / math.hypot(1.0, turn * lag_h)
            )
        return value


ROOM = Climate(mean_c=21.5, seasonal_k=1.6, daily_k=0.8, scatter_k=0.3)
HALL = Climate(mean_c=21.5, seasonal_k=6.0, daily_k=3.0, scatter_k=0.5)
EMPTY = Jobs((0.0,), math.inf)


@dataclass(frozen=True, slots=True)
class Work:
    """Something done to the stage: odometer (km) and action as in maintenance.csv."""

    travel_km: float
    action: str


@dataclass(frozen=True, slots=True)
class Life:
    """What one stage goes through.

    Parameters
    ----------
    preload, mount
        Laws of guide preload and mount stiffness.
    climate
        Temperature.
    grease
        Law of the guide's loss.
    jobs
        Added payload.
    work
        Maintenance with its odometer; ``servo`` sets the tuning ``retuned``.
    contact
        Course of the guide's stiffness that is not due to preload.
    level
        Course of the level of all that excites the stage.
    circumstances
        What acts on the logs besides: sensors, wander, schedule.
    """

    name: str
    preload: Law = Steady()
    mount: Law = Steady()
    climate: Climate = ROOM
    grease: Course = Steady()
    jobs: Jobs = EMPTY
    work: tuple[Work, ...] = ()
    contact: Course = Steady()
    level: Course = Steady()
    circumstances: Circumstances = IDEAL

    def condition(self, travel_km: float, temperature_c: float) -> Condition:
        """Return the true condition at an odometer (km) and a temperature (°C)."""
        retuned = any(w.action == "servo" and w.travel_km <= travel_km for w in self.work)
        return Condition(
            guide_preload=self.preload.at(travel_km),
            mount_stiffness=self.mount.at(travel_km),
            temperature_c=temperature_c,
            added_payload=self.jobs.at(travel_km),
            guide_damping=self.grease.at(travel_km),
            servo_id="retuned" if retuned else "commissioning",
        )

    def limits_km(self) -> dict[str, float | None]:
        """Return per parameter the odometer (km) at which its limit is crossed; None if never."""
        return {
            "guide_preload": self.preload.reaches_km(GUIDE_PRELOAD_LIMIT),
            "mount_stiffness": self.mount.reaches_km(MOUNT_STIFFNESS_LIMIT),
        }

    def failure_km(self) -> float | None:
        """Return the odometer (km) of the first limit crossed; None if never."""
        return min((km for km in self.limits_km().values() if km is not None), default=None)


@dataclass(frozen=True, slots=True)
class Draws:
    """Parameters of a life that its seed determines; single events are at ``event_km``."""

    wear: HertzWear
    loosening: Loosening
    event_km: float
    crash_preload: float
    crash_mount: float
    bolt: float
    grease: Grease
    jobs: Jobs


def draw_laws(rng: np.random.Generator) -> Draws:
    """Draw the parameters of all laws, always all and in this order; new ones go last."""
    life_km = float(8000.0 * np.exp(0.25 * rng.standard_normal()))
    exponent = float(rng.uniform(0.9, 1.3))
    floor = float(rng.uniform(0.5, 0.65))
    scale_km = float(3000.0 * np.exp(0.25 * rng.standard_normal()))
    event_km = round(float(rng.uniform(500.0, 1100.0)), 3)
    crash_preload = float(rng.uniform(0.6, 0.85))
    # Half of the crashes leave the mount as it was.
    crash_mount = min(1.0, float(rng.uniform(0.8, 1.2)))
    bolt = float(rng.uniform(0.65, 0.9))
    fresh, aged = float(rng.uniform(1.2, 1.5)), float(rng.uniform(0.7, 0.85))
    grease = Grease(event_km, fresh, aged, float(rng.uniform(600.0, 1000.0)))
    # Weighed to 0.1 kg: the payload in the log is exact.
    heavy, light = round(float(rng.uniform(1.0, 3.0)), 1), -round(float(rng.uniform(1.0, 2.0)), 1)
    jobs = Jobs((0.0, heavy, light), float(rng.uniform(200.0, 400.0)))
    return Draws(
        HertzWear(life_km, exponent),
        Loosening(scale_km, floor),
        event_km,
        crash_preload,
        crash_mount,
        bolt,
        grease,
        jobs,
    )


def _sudden_loosening(draws: Draws) -> Life:
    """Return the life in which a bolt breaks and the others loosen from then on."""
    later = Delayed(draws.loosening, draws.event_km)
    return Life("sudden-loosening", mount=Stepped(later, draws.event_km, draws.bolt))


def _crash(draws: Draws) -> Life:
    """Return the life in which an impact brinells a wearing guide and may shift the mount."""
    return Life(
        "crash",
        preload=Stepped(draws.wear, draws.event_km, draws.crash_preload),
        mount=Stepped(Steady(), draws.event_km, draws.crash_mount),
    )


LIVES: dict[str, Callable[[Draws], Life]] = {
    "healthy": lambda draws: Life("healthy"),
    "preload-wear": lambda draws: Life("preload-wear", preload=draws.wear),
    "mount-loosening": lambda draws: Life("mount-loosening", mount=draws.loosening),
    "both": lambda draws: Life("both", preload=draws.wear, mount=draws.loosening),
    "sudden-loosening": _sudden_loosening,
    "crash": _crash,
    # The next four are healthy: whatever is read from them as wear is a false alarm.
    "regreasing": lambda draws: Life(
        "regreasing", grease=draws.grease, work=(Work(draws.event_km, "regrease"),)
    ),
    "temperature-only": lambda draws: Life("temperature-only", climate=HALL),
    "payload-change": lambda draws: Life("payload-change", jobs=draws.jobs),
    "servo-retuning": lambda draws: Life("servo-retuning", work=(Work(draws.event_km, "servo"),)),
}
