"""Draw a machine: every number in which two machines of one type differ, from one table.

Each number has a random stream of its own name: a new entry of the table changes no other number.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.dynamics.elastic import Part
from models.dynamics.plant import closed_loop_modes
from models.dynamics.quantities import Number, Point
from models.dynamics.stages import Condition, Stage, stage_named
from models.errors import AmbiguousModes, BadParameter, UnstableLoop
from models.recordings.machines import stream

Array = NDArray[np.float64]
# Events of a life that come one after the other, such as shocks: more than any life has.
N_EVENTS = 160
# Conditions in which a machine must work to be delivered: new; worn, warm; worn, cold.
_ACCEPTANCE = (
    Condition(),
    Condition(0.3, 0.4, 33.0, guide_damping=0.7),
    Condition(0.3, 1.0, 8.0),
    Condition(servo_id="retuned"),
)
# Furthest from the middle of the travel that a full stage stands in the logs of a life, mm.
FURTHEST_MM = 100.0
# There, to both sides, a full stage must work too, new and worn.
_ACCEPTANCE_FULL = tuple(
    replace(condition, position_mm=place)
    for condition in _ACCEPTANCE[:2]
    for place in (-FURTHEST_MM, FURTHEST_MM)
)
_MOST_REJECTED = 50


@dataclass(frozen=True, slots=True)
class Distribution:
    """How a number differs between machines.

    Parameters
    ----------
    kind
        ``factor``: the nominal value times exp(b N); ``shift``: plus b N (each entry of a point by
        itself); ``normal``: a + b N; ``lognormal``: a exp(b N); ``uniform``, ``loguniform``: from a
        to b; ``uniforms``, ``exponentials``: `N_EVENTS` from 0 to 1, or of mean 1.
    source
        Where the size comes from: a catalogue, a standard, or our choice with its reason.
    """

    kind: str
    a: float
    b: float
    source: str

    def draw(self, rng: np.random.Generator) -> float | Array:
        """Draw a value; of a factor or a shift what it does to the nominal value."""
        match self.kind:
            case "factor":
                return float(np.exp(self.b * rng.standard_normal()))
            case "shift":
                return self.b * rng.standard_normal(3)
            case "normal":
                return float(self.a + self.b * rng.standard_normal())
            case "lognormal":
                return float(self.a * np.exp(self.b * rng.standard_normal()))
            case "uniform":
                return float(rng.uniform(self.a, self.b))
            case "loguniform":
                return float(np.exp(rng.uniform(math.log(self.a), math.log(self.b))))
            case "uniforms":
                return rng.uniform(size=N_EVENTS)
            case "exponentials":
                return rng.exponential(size=N_EVENTS)
        raise BadParameter("kind", self.kind, "a kind of distribution")


def _factor(std: float, source: str) -> Distribution:
    return Distribution("factor", 1.0, std, source)


def _shift(std_m: float, source: str) -> Distribution:
    return Distribution("shift", 0.0, std_m, source)


def _uniform(low: float, high: float, source: str) -> Distribution:
    return Distribution("uniform", low, high, source)


def _log_uniform(low: float, high: float, source: str) -> Distribution:
    return Distribution("loguniform", low, high, source)


def _log_normal(median: float, std: float, source: str) -> Distribution:
    return Distribution("lognormal", median, std, source)


_WEIGHED = "our choice: parts are made to 0.1 mm and vary in what is screwed to them"
_TOOLING = "our choice: every user's tooling on the platform is another one"
_GRANITE = "our choice: density of granite 2.6 to 3.0 g/cm3, of one quarry ±2 %"
_PRELOAD = (
    "catalogue (HIWIN, EG series): preload classes ZA 0.03 to 0.05 C and ZB 0.06 to 0.08 C, thus "
    "±25 and ±14 % within a class; stiffness goes with the cube root: ±8 and ±5 %, and "
    "our choice of 3 % for balls and grooves"
)
_CONTACT_ANGLE = "our choice: contact angle 45 ± 1.5°, of which the ratio is the squared cotangent"
_BALLS = "our choice: the loaded balls of a block have their middle within 1 mm of its middle"
_BOLTS = (
    "VDI 2230 (1986): bolt preload ±17 to ±28 % by torque wrench; stiffness of a flat contact goes "
    "with about the square root of its pressure: ±8 to ±14 %"
)
_RUBBER = "catalogue (GMT): 5 Shore A, the usual tolerance, are 20 % of stiffness: taken as 2 std"
_LOSS = "our choice: damping of joints is known to a factor"
_OUR_WEAR = "our choice: the law's limit is crossed at 1,000 to 10,000 km in most machines"

# Of the stage's own numbers.
GEOMETRY_AND_JOINTS: dict[str, Distribution] = {
    "moving_mass": _factor(0.01, _WEIGHED),
    "load_height": _factor(0.03, _TOOLING),
    "load_offset_feed": _factor(0.15, _TOOLING),
    "load_offset_lateral": _factor(0.15, _TOOLING),
    "load_spread_feed": _factor(0.03, _TOOLING),
    "load_spread_lateral": _factor(0.03, _TOOLING),
    "load_spread_vertical": _factor(0.03, _TOOLING),
    "housing_mass": _factor(0.01, _WEIGHED),
    "housing_height": _factor(0.02, _WEIGHED),
    "granite_mass": _factor(0.02, _GRANITE),
    "granite_spread_feed": _factor(0.005, _GRANITE),
    "granite_spread_lateral": _factor(0.005, _GRANITE),
    "granite_spread_vertical": _factor(0.005, _GRANITE),
    "block_stiffness": _factor(0.07, _PRELOAD),
    "block_lateral_ratio": _factor(0.10, _CONTACT_ANGLE),
    "block_half_spacing": _shift(0.5e-3, _BALLS),
    "mount_stiffness": _factor(0.11, _BOLTS),
    "mount_half_spacing": _shift(
        2e-3, "our choice: a flange touches where it is highest, 10 µm of form error in 0.1 m"
    ),
    "isolator_feed": _factor(0.10, _RUBBER),
    "isolator_lateral": _factor(0.10, _RUBBER),
    "isolator_vertical": _factor(0.10, _RUBBER),
    "guide_loss_time": _factor(0.25, _LOSS),
    "mount_loss_time": _factor(0.25, _LOSS),
    "isolator_horizontal_loss_time": _factor(0.20, _LOSS),
    "isolator_vertical_loss_time": _factor(0.20, _LOSS),
    "preload_exponent": _factor(
        0.12,
        "our choice: Hertz' point contact has 1/3; block and rail in series lower it, line "
        "contact by run-in grooves raises it",
    ),
    "temperature_softening": _factor(
        0.30, "our choice: the nominal is ours; steel alone has 0.3e-3 per K, preload does the rest"
    ),
    "friction": _factor(0.20, "our choice: seals and grease"),
    "motor_point": _shift(0.5e-3, _WEIGHED),
    "encoder_point": _shift(0.5e-3, _WEIGHED),
    "acc_feed_point": _shift(2e-3, "our choice: a sensor is stuck on by hand"),
    "acc_pitch_point": _shift(2e-3, "our choice: a sensor is stuck on by hand"),
}
# Of every elastic part of a full stage.
PART_STIFFNESS = _factor(0.05, "our choice: brackets, covers, cables and adapters vary")

# What acts on the logs of a machine besides its wear; see `circumstances`.
CIRCUMSTANCES: dict[str, Distribution] = {
    "lag_h": _log_uniform(
        0.5, 8.0, "our choice: m c / (h A) with h = 10 W/(m2 K): platform 2 h, granite 6 h"
    ),
    "self_heating_k": _uniform(0.0, 2.0, "our choice: 10 to 20 W of copper loss on 0.3 m2"),
    "sensor_offset_k": Distribution(
        "normal",
        0.0,
        0.3,
        "our choice: half of a class B Pt100's limit (IEC 60751: ±0.4 K at 21 °C) for the sensor, "
        "and as much again for where it is fixed and its leads",
    ),
    "sensor_scatter_k": _uniform(0.05, 0.3, "our choice: air moves about a sensor"),
    "wander_common": _log_uniform(2e-4, 2e-3, "our choice: from unseen to above an identification"),
    "wander_mode": _log_uniform(2e-4, 2e-3, "our choice: from unseen to above an identification"),
    "wander_km": _log_uniform(10.0, 400.0, "our choice: from one day to a month of use"),
    "amplitude_softening": _uniform(
        0.0, 0.012, "our choice: of stiffness per doubled level; f falls by up to 0.4 %"
    ),
    "level_scatter": _uniform(0.05, 0.5, "our choice: neighbours, floor and cables of the hour"),
    "running_in_depth": _uniform(-0.04, 0.10, "our choice: none, in 3 of 10, to 10 % of preload"),
    "running_in_km": _log_uniform(30.0, 200.0, "our choice: 50,000 to 300,000 double strokes"),
}

# Laws of wear and events, with the share of machines that has each of them in a drawn life.
WEAR: dict[str, Distribution] = {
    "preload_family": _uniform(0.0, 1.0, "our choice, see `PRELOAD_FAMILIES`"),
    "mount_family": _uniform(0.0, 1.0, "our choice, see `MOUNT_FAMILIES`"),
    "hertz_km": _log_normal(8000.0, 0.6, _OUR_WEAR),
    "hertz_exponent": _uniform(0.8, 1.5, _OUR_WEAR),
    "loosening_km": _log_normal(3000.0, 0.6, _OUR_WEAR),
    "loosening_floor": _uniform(0.4, 0.75, _OUR_WEAR),
    "late_km": _log_normal(3000.0, 0.6, _OUR_WEAR),
    "late_exponent": _uniform(3.0, 6.0, "our choice: pitting spreads the faster the more there is"),
    "mount_late_km": _log_normal(4000.0, 0.6, _OUR_WEAR),
    "onset_km": _log_uniform(300.0, 3000.0, "our choice: seals or the grease end"),
    "onset_linear_km": _log_normal(1500.0, 0.5, _OUR_WEAR),
    "mount_onset_km": _log_uniform(300.0, 3000.0, "our choice: a bolt has lost its preload"),
    "mount_onset_linear_km": _log_normal(2000.0, 0.5, _OUR_WEAR),
    "growth_km": _log_normal(900.0, 0.4, "our choice: a crack grows by e over that travel"),
    "growth_first": _log_uniform(0.01, 0.06, "our choice: of preload"),
    "settling_depth": _uniform(0.06, 0.12, "our choice: of preload, where a life is about it"),
    "shock_every_km": _log_uniform(
        150.0, 900.0, "our choice: a collision a fortnight to a quarter"
    ),
    "shock_loss": _uniform(0.01, 0.06, "our choice: mean of preload lost"),
    "shock_gaps": Distribution("exponentials", 0.0, 1.0, "independent events"),
    "shock_sizes": Distribution("exponentials", 0.0, 1.0, "independent events"),
    "jump_every_km": _log_uniform(200.0, 900.0, "our choice: a bolt slips a month to a quarter"),
    "jump_loss": _uniform(0.02, 0.07, "our choice: mean of stiffness lost"),
    "jump_gaps": Distribution("exponentials", 0.0, 1.0, "independent events"),
    "jump_sizes": Distribution("uniforms", 0.0, 1.0, "independent events"),
    "stick_every_km": _log_uniform(200.0, 800.0, "our choice: a chip runs into a block"),
    "stick_depth": _uniform(0.04, 0.20, "our choice: of preload, until it is rolled out"),
    "stick_back_km": _log_uniform(40.0, 300.0, "our choice"),
    "stick_gaps": Distribution("exponentials", 0.0, 1.0, "independent events"),
    "stick_sizes": Distribution("uniforms", 0.0, 1.0, "independent events"),
    "grease_every_km": _log_uniform(150.0, 900.0, "catalogues: relubricated at 100 to 1,000 km"),
    "grease_scale": _uniform(0.2, 0.8, "our choice: ages over this part of an interval"),
    "grease_damping": _uniform(0.65, 0.9, "our choice: loss of aged grease over that of fresh"),
    "grease_stiffness": _uniform(0.985, 1.01, "our choice: a film carries less than dry contact"),
    "backlash_from": _uniform(0.75, 0.95, "our choice: preload below which balls lift off"),
    "backlash_left": _uniform(0.3, 0.6, "our choice: stiffness that would be left without preload"),
    "sensor_drift_k": Distribution("normal", 0.0, 1.5, "our choice: per 1,000 km, a moved sensor"),
    "level_growth": _uniform(0.5, 2.0, "our choice: doublings per 1,000 km, a bearing nearby"),
}


@dataclass(frozen=True, slots=True)
class Machine:
    """One machine: its stage and, if it was drawn, the numbers that made it by name."""

    stage: Stage
    numbers: Mapping[str, float]
    rejected: int = 0


def draw_numbers(
    table: Mapping[str, Distribution], generator_of: Callable[[str], np.random.Generator]
) -> dict[str, Any]:
    """Draw every number of a table, each from the generator of its name."""
    return {name: entry.draw(generator_of(name)) for name, entry in table.items()}


@lru_cache(maxsize=256)
def draw_machine(stage_name: str, plant_seed: int | None) -> Machine:
    """Return the machine of a seed; without one the nominal machine.

    A machine whose position loop is unstable or whose modes cannot be named, new or worn, is drawn
    again: it would not have been delivered.

    Raises
    ------
    UnstableLoop, AmbiguousModes
        If 50 machines in turn do not work.
    """
    nominal = stage_named(stage_name)
    if plant_seed is None:
        return Machine(nominal, {})
    needed = _ACCEPTANCE + (_ACCEPTANCE_FULL if nominal.flexible else ())
    for attempt in range(_MOST_REJECTED):
        rngs = _streams(stage_name, plant_seed, attempt)
        stage, numbers = _drawn_stage(nominal, rngs)
        try:
            for condition in needed:
                closed_loop_modes(stage, condition)
        except (UnstableLoop, AmbiguousModes):
            if attempt == _MOST_REJECTED - 1:
                raise
            continue
        numbers |= draw_numbers(CIRCUMSTANCES, rngs)
        return Machine(stage, numbers, attempt)
    raise AssertionError("the last attempt returns or raises")


def _streams(stage: str, seed: int, attempt: int) -> Callable[[str], np.random.Generator]:
    """Return the generator of each number's name."""
    return lambda name: stream(stage, seed, f"plant/{name}", attempt)


def _drawn_stage(
    nominal: Stage, generator_of: Callable[[str], np.random.Generator]
) -> tuple[Stage, dict[str, float]]:
    """Return a drawn stage, and its numbers in SI (points: first and second length)."""
    changed: dict[str, Any] = {}
    numbers: dict[str, float] = {}
    for name, by in draw_numbers(GEOMETRY_AND_JOINTS, generator_of).items():
        entry = getattr(nominal, name)
        if isinstance(entry, Number):
            changed[name] = Number(entry.value * by, entry.unit, "drawn")
            numbers[name] = changed[name].value
        else:
            x, y, z = (float(old + shift) for old, shift in zip(entry.value, by, strict=True))
            changed[name] = Point((x, y, z), entry.unit, "drawn")
            numbers |= {f"{name}_x": x, f"{name}_y": y, f"{name}_z": z}
    if nominal.flexible is not None:
        parts = []
        for part in nominal.flexible.parts:
            by = float(np.asarray(PART_STIFFNESS.draw(generator_of(f"part/{part.name}"))))
            parts.append(_stiffer(part, by))
            numbers[f"{part.name}_stiffness"] = parts[-1].stiffness.value
        changed["flexible"] = replace(nominal.flexible, parts=tuple(parts))
    return replace(nominal, **changed), numbers


def _stiffer(part: Part, by: float) -> Part:
    """Return an elastic part whose stiffness is multiplied by a factor."""
    return replace(part, stiffness=Number(part.stiffness.value * by, part.stiffness.unit, "drawn"))
