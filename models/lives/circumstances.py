"""What acts on the logs of a machine besides its wear: temperature lag, wander, level, sensors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.dynamics.plant import GUIDE_MODES, closed_loop_modes
from models.dynamics.quantities import Number, Point
from models.dynamics.stages import Stage

Array = NDArray[np.float64]

KM_PER_DAY = 12.0
# Step of the finite differences of ln f, in the logarithm of a length or ratio.
_STEP = 1e-3


@dataclass(frozen=True, slots=True)
class Circumstances:
    """How the surroundings, the sensors and the schedule act; by default not at all.

    Parameters
    ----------
    lag_h
        Time constant (h) by which the structure follows the temperature of the sensor.
    self_heating_k
        By how much (K) the structure is warmer than the sensor after full duty.
    sensor_offset_k, sensor_scatter_k, sensor_drift_k
        Of the temperature sensor: constant, per log (std), and per 1,000 km, K.
    wander_common, wander_mode
        Stationary standard deviation of ln f that all modes have alike, and each by itself.
    wander_km
        Travel (km) over which the correlation of wander falls to 1/e.
    amplitude_softening
        Part of the guide's stiffness that is lost when the level of vibration doubles.
    level_scatter
        Standard deviation of the logarithm of the level from log to log.
    logs_payload
        Whether the logs state the payload.
    closed_months
        Months without logs.
    km_per_day
        Daily use.
    """

    lag_h: float = 0.0
    self_heating_k: float = 0.0
    sensor_offset_k: float = 0.0
    sensor_scatter_k: float = 0.0
    sensor_drift_k: float = 0.0
    wander_common: float = 0.0
    wander_mode: float = 0.0
    wander_km: float = 1.0
    amplitude_softening: float = 0.0
    level_scatter: float = 0.0
    logs_payload: bool = True
    closed_months: tuple[int, ...] = ()
    km_per_day: float = KM_PER_DAY

    def above(self, others: Circumstances) -> Circumstances:
        """Return these circumstances, and the others' wherever these are the default."""
        own = {f.name: getattr(self, f.name) for f in fields(self)}
        kept = {name: value for name, value in own.items() if value != getattr(IDEAL, name)}
        return replace(others, **kept)


IDEAL = Circumstances()


def circumstances_of(numbers: Mapping[str, Any], *names: str) -> Circumstances:
    """Return circumstances of drawn numbers: those named, or all that they have."""
    known = {field.name for field in fields(Circumstances)}
    return Circumstances(**{n: numbers[n] for n in (names or known & numbers.keys())})


@dataclass(frozen=True, slots=True)
class Contact:
    """State of the contacts at one log, besides the condition.

    Parameters
    ----------
    stiffness
        Factor of the guide's stiffness that is not due to preload.
    level
        Level of all that excites the stage, over the nominal one.
    wander_common, wander
        Of ln f, in all modes and in roll, pitch and yaw.
    """

    stiffness: float = 1.0
    level: float = 1.0
    wander_common: float = 0.0
    wander: tuple[float, float, float] = (0.0, 0.0, 0.0)


NO_CONTACT_CHANGE = Contact()


def wander_of(
    circumstances: Circumstances, travel_km: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Draw first-order autoregressive wander at odometers, stationary from the first on.

    Returns
    -------
    common : (n,)
    own : (n, 3)
        Of ln f of roll, pitch and yaw.
    """
    noise = rng.standard_normal((travel_km.size, 4))
    kept = np.exp(-np.diff(travel_km) / circumstances.wander_km)
    for k, share in enumerate(kept, 1):
        noise[k] = share * noise[k - 1] + math.sqrt(1 - share**2) * noise[k]
    # Adding zero makes positive zeros of negative ones.
    common, own = circumstances.wander_common, circumstances.wander_mode
    return common * noise[:, 0] + 0.0, own * noise[:, 1:] + 0.0


@lru_cache(maxsize=256)
def _load_path_sensitivity(stage: Stage) -> tuple[tuple[float, ...], ...]:
    """Return d ln f of roll, pitch, yaw per ln of lateral spacing, feed spacing, lateral ratio."""

    def ln_f(shift: tuple[float, float, float]) -> Array:
        own = _with_load_path(stage, shift)
        found = {mode.name: mode.frequency_hz for mode in closed_loop_modes(own)}
        return np.log([found[name] for name in GUIDE_MODES])

    steps = np.eye(3) * _STEP
    columns = [(ln_f(tuple(s)) - ln_f(tuple(-s))) / (2 * _STEP) for s in steps]
    return tuple(tuple(map(float, row)) for row in np.array(columns).T)


def _with_load_path(stage: Stage, shift: tuple[float, ...]) -> Stage:
    """Return the stage with other effective spacings and ratio of its blocks, in logarithms."""
    x, y, z = stage.block_half_spacing.value
    ratio = stage.block_lateral_ratio.value
    lateral, feed, own = (math.exp(value) for value in shift)
    return replace(
        stage,
        block_half_spacing=Point((x * feed, y * lateral, z), "m", "drawn"),
        block_lateral_ratio=Number(ratio * own, "1", "drawn"),
    )


def stage_at(stage: Stage, contact: Contact, softening: float) -> Stage:
    """Return the stage of one log.

    Common wander is one of all contacts, guide and mount; a mode's own wander is one of the load
    path: which balls of a block carry decides the effective spacing of the blocks, which roll and
    pitch see, and the ratio of lateral to vertical stiffness, which yaw sees.  They are solved
    from the wander of ln f to first order.
    """
    if contact == NO_CONTACT_CHANGE:
        return stage
    common = math.exp(2.0 * contact.wander_common)
    block = contact.stiffness * common * contact.level ** math.log2(1.0 - softening)
    own = replace(
        stage,
        block_stiffness=Number(stage.block_stiffness.value * block, "N/m", "drawn"),
        mount_stiffness=Number(stage.mount_stiffness.value * common, "N/m", "drawn"),
    )
    if any(contact.wander):
        shift = np.linalg.solve(_load_path_sensitivity(stage), contact.wander)
        own = _with_load_path(own, tuple(map(float, shift)))
    return own
