"""Lives that the first ten do not have: other families of wear, and machines that only seem worn.

The first ten (`LIVES`) keep to two laws that an estimator may well assume; these do not.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from models.errors import UnknownLife
from models.lives.circumstances import Circumstances, circumstances_of
from models.lives.degradation import (
    HALL,
    LIVES,
    Draws,
    HertzWear,
    Law,
    Life,
    Loosening,
    Steady,
    Work,
    draw_laws,
)
from models.lives.drawing import CIRCUMSTANCES, WEAR, draw_numbers
from models.lives.wear_families import (
    Backlash,
    Cycles,
    Exponential,
    Growth,
    Onset,
    PowerLoss,
    Product,
    Recovering,
    Settling,
    Shocks,
)

Numbers = Mapping[str, Any]
# Loss at which the laws below state their travel: that of the limits of the truth.
_PRELOAD_LOSS, _MOUNT_LOSS = 0.4, 0.3
_MOUNT_FLOOR = 0.3
_GREASED_UNTIL_KM = 20_000.0


def _late(numbers: Numbers) -> Law:
    return PowerLoss(numbers["late_km"], numbers["late_exponent"], _PRELOAD_LOSS)


def _onset(numbers: Numbers) -> Law:
    return Onset(numbers["onset_km"], numbers["onset_linear_km"], _PRELOAD_LOSS)


def _settling(numbers: Numbers) -> Settling:
    return Settling(numbers["settling_depth"], numbers["running_in_km"])


def _shocks(numbers: Numbers) -> Law:
    at = np.cumsum(numbers["shock_every_km"] * numbers["shock_gaps"])
    left = np.exp(-numbers["shock_loss"] * numbers["shock_sizes"])
    return Shocks(tuple(at.tolist()), tuple(left.tolist()))


def _jumps(numbers: Numbers) -> Law:
    at = np.cumsum(numbers["jump_every_km"] * numbers["jump_gaps"])
    left = 1.0 - 2.0 * numbers["jump_loss"] * numbers["jump_sizes"]
    return Shocks(tuple(at.tolist()), tuple(left.tolist()), _MOUNT_FLOOR)


def _sticking(numbers: Numbers) -> Law:
    at = np.cumsum(numbers["stick_every_km"] * (0.2 + 0.8 * numbers["stick_gaps"]))
    depth = numbers["stick_depth"] * (0.25 + 0.75 * numbers["stick_sizes"])
    return Recovering(tuple(at.tolist()), tuple(depth.tolist()), numbers["stick_back_km"])


def _hertz(numbers: Numbers) -> Law:
    return HertzWear(numbers["hertz_km"], numbers["hertz_exponent"])


def _exponential(numbers: Numbers) -> Law:
    return Exponential(numbers["growth_km"], numbers["growth_first"])


def _steady(numbers: Numbers) -> Law:
    return Steady()


# Shares of machines in the life `drawn`; the first two of each are what an estimator may know.
PRELOAD_FAMILIES: tuple[tuple[float, Callable[[Numbers], Law]], ...] = (
    (0.25, _steady),
    (0.20, _hertz),
    (0.15, _late),
    (0.10, _onset),
    (0.10, _exponential),
    (0.10, _shocks),
    (0.10, _sticking),
)
MOUNT_FAMILIES: tuple[tuple[float, Callable[[Numbers], Law]], ...] = (
    (0.45, _steady),
    (0.20, lambda n: Loosening(n["loosening_km"], n["loosening_floor"])),
    (0.15, _jumps),
    (0.10, lambda n: PowerLoss(n["mount_late_km"], n["late_exponent"], _MOUNT_LOSS)),
    (0.10, lambda n: Onset(n["mount_onset_km"], n["mount_onset_linear_km"], _MOUNT_LOSS)),
)


def _chosen(
    families: tuple[tuple[float, Callable[[Numbers], Law]], ...], place: float, numbers: Numbers
) -> Law:
    """Return the law of the family at a place from 0 to 1 among their shares."""
    ends = np.cumsum([share for share, _ in families])
    return families[min(int(np.searchsorted(ends, place)), len(families) - 1)][1](numbers)


def _greased(numbers: Numbers) -> tuple[Cycles, Cycles]:
    """Return the courses of damping and of stiffness with the grease."""
    every = numbers["grease_every_km"]
    scale = numbers["grease_scale"] * every
    return (
        Cycles(every, numbers["grease_damping"], scale),
        Cycles(every, numbers["grease_stiffness"], scale),
    )


def _lubrication(name: str, numbers: Numbers, *, declared: bool) -> Life:
    """Return a healthy life whose grease is renewed again and again, declared or not."""
    damping, stiffness = _greased(numbers)
    often = int(_GREASED_UNTIL_KM // damping.every_km) if declared else 0
    work = tuple(Work(round(damping.every_km * k, 3), "regrease") for k in range(1, often + 1))
    return Life(name, grease=damping, contact=stiffness, work=work)


def _drawn(numbers: Numbers) -> Life:
    """Return the life of whichever families the machine has, greased by an automatic lubricator."""
    preload = _chosen(PRELOAD_FAMILIES, numbers["preload_family"], numbers)
    mount = _chosen(MOUNT_FAMILIES, numbers["mount_family"], numbers)
    return replace(_lubrication("drawn", numbers, declared=False), preload=preload, mount=mount)


def _only(name: str, numbers: Numbers, *acting: str, **laws: Any) -> Life:
    """Return a healthy life with some circumstances."""
    return Life(name, circumstances=circumstances_of(numbers, *acting), **laws)


def _backlash(draws: Draws, numbers: Numbers) -> Life:
    """Return the life in which a wearing guide gets play before it is worn."""
    opening = Backlash(draws.wear, numbers["backlash_from"], numbers["backlash_left"])
    return Life("backlash", preload=draws.wear, contact=opening)


FURTHER_LIVES: dict[str, Callable[[Draws, Numbers], Life]] = {
    "late-acceleration": lambda d, n: Life("late-acceleration", preload=_late(n)),
    "bathtub": lambda d, n: Life("bathtub", preload=Product(_settling(n), _late(n))),
    "onset-linear": lambda d, n: Life("onset-linear", preload=_onset(n)),
    "exponential-wear": lambda d, n: Life("exponential-wear", preload=_exponential(n)),
    "random-shocks": lambda d, n: Life("random-shocks", preload=_shocks(n)),
    "loosening-in-jumps": lambda d, n: Life("loosening-in-jumps", mount=_jumps(n)),
    "backlash": _backlash,
    # Of these two the preload does change, and comes to rest or comes back.
    "running-in": lambda d, n: Life("running-in", preload=_settling(n)),
    "stick-and-recover": lambda d, n: Life("stick-and-recover", preload=_sticking(n)),
    # The next are healthy: whatever is read from them as wear is a false alarm.
    "lubrication-cycles": lambda d, n: _lubrication("lubrication-cycles", n, declared=False),
    "periodic-regreasing": lambda d, n: _lubrication("periodic-regreasing", n, declared=True),
    "wander": lambda d, n: _only("wander", n, "wander_common", "wander_mode", "wander_km"),
    "thermal-lag": lambda d, n: _only("thermal-lag", n, "lag_h", climate=HALL),
    "amplitude-growth": lambda d, n: _only(
        "amplitude-growth",
        n,
        "amplitude_softening",
        "level_scatter",
        level=Growth(n["level_growth"]),
    ),
    "sensor-drift": lambda d, n: _only("sensor-drift", n, "sensor_drift_k", "sensor_offset_k"),
    "payload-not-logged": lambda d, n: Life(
        "payload-not-logged", jobs=d.jobs, circumstances=Circumstances(logs_payload=False)
    ),
    "missing-winters": lambda d, n: Life(
        "missing-winters",
        climate=HALL,
        circumstances=Circumstances(closed_months=(12, 1, 2), km_per_day=2.5),
    ),
    # Whatever a machine may be: families of both kinds.
    "drawn": lambda d, n: _drawn(n),
}
ALL_LIVES = (*LIVES, *FURTHER_LIVES)


def life_named(name: str, rng: np.random.Generator) -> Life:
    """Return a life with its laws drawn.

    Raises
    ------
    UnknownLife
        If the name is registered neither in `LIVES` nor in `FURTHER_LIVES`.
    """
    if name not in ALL_LIVES:
        raise UnknownLife(name, ALL_LIVES)
    draws = draw_laws(rng)
    if name in LIVES:
        return LIVES[name](draws)
    entropy = int(rng.integers(2**63))

    def generator_of(number: str) -> np.random.Generator:
        return np.random.default_rng([entropy, zlib.crc32(number.encode())])

    return FURTHER_LIVES[name](draws, draw_numbers(WEAR | CIRCUMSTANCES, generator_of))


def run_in(life: Life, numbers: Numbers) -> Life:
    """Return a life of a machine that runs in besides, unless the life is about that."""
    depth = max(float(numbers["running_in_depth"]), 0.0)
    if not depth or life.name in ("running-in", "bathtub"):
        return life
    return replace(life, preload=Product(life.preload, Settling(depth, numbers["running_in_km"])))
