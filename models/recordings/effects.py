"""What stages have beyond a linear loop under steady noise: friction, drive limit, floor, blows.

The parameters are plain numbers, so that a machine that differs replaces them.  Without a source in
its docstring a number is our choice; `LINEAR` leaves all effects out, `FULL` has all of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from models.dynamics.plant import NOISE_INPUTS
from models.dynamics.stages import Condition, Stage, corners
from models.errors import BadParameter

Array = NDArray[np.float64]

_BLOCKS = 4


@dataclass(frozen=True, slots=True)
class FrictionParameters:
    """Rolling friction of four guide blocks, and drag of the cable.

    Parameters
    ----------
    scale
        Of the stage's friction (`Stage.friction`), at commissioning.
    stiction
        Friction at vanishing velocity over that at high velocity.
    stribeck_velocity
        m/s, in which the excess falls to 1/e.
    first_slip, last_slip
        Displacements (m) at which the first and the last element slip: ball guides slide fully
        after some 10 µm to 100 µm [Futami1990, AlBenderSymens2005].
    elements
        Of each block.
    lag
        s, in which the force follows a fall of friction.
    viscous
        Of all blocks at 21 °C and commissioning's grease, N s/m; falls by `thinning` (1/K).
    seals
        Part of the friction that does not depend on the preload; the rest grows with its power
        `load_exponent`, 4/3 of elastic hysteresis of balls [Harris2006].
    cable_drag, cable_slip, cable_spring
        Friction (N) of the chain of cables, the displacement (m) at which it slides, its stiffness
        (N/m) over the travel; it acts at the motor.
    """

    scale: float = 1.0
    stiction: float = 1.3
    stribeck_velocity: float = 2e-3
    first_slip: float = 2e-6
    last_slip: float = 40e-6
    elements: int = 8
    lag: float = 1e-3
    viscous: float = 2.0
    thinning: float = 0.03
    seals: float = 0.4
    load_exponent: float = 4 / 3
    cable_drag: float = 0.4
    cable_slip: float = 2e-3
    cable_spring: float = 0.3

    def __post_init__(self) -> None:
        """Reject numbers that no friction has."""
        _refuse_negative(self)
        if not 0 < self.first_slip <= self.last_slip:
            raise BadParameter("first_slip", self.first_slip, "above 0, at most last_slip")
        if self.stiction < 1 or self.elements < 1 or self.seals > 1:
            got = (self.stiction, self.elements, self.seals)
            raise BadParameter("stiction, elements, seals", got, "at least 1, 1; at most 1")
        for name in ("stribeck_velocity", "lag", "cable_slip"):
            if not getattr(self, name) > 0:
                raise BadParameter(name, getattr(self, name), "a positive number")


@dataclass(frozen=True, slots=True)
class Floor:
    """How the vibration of the ground changes in time; its mean square stays.

    Parameters
    ----------
    wander
        Standard deviation of the logarithm of its level, with `wander_s` as correlation time, s.
    gusts_per_s
        Rate at which gusts begin.
    gust_level, gust_s
        Factor on the level in the middle of a gust, median; and its duration, s.
    """

    wander: float = 0.25
    wander_s: float = 15.0
    gusts_per_s: float = 0.03
    gust_level: float = 3.0
    gust_s: float = 1.5

    def __post_init__(self) -> None:
        """Reject negative numbers."""
        _refuse_negative(self)


@dataclass(frozen=True, slots=True)
class Blows:
    """Bumps of the rails, which return at the same place, and hits at random.

    Parameters
    ----------
    bumps
        Rail (0 at positive y, 1), place (m from the middle of the travel) and vertical force (N)
        on a block that passes.
    bump_length
        Length of a bump along the rail, m.
    hits_per_s
        Rate of hits on the floor.
    hit_level, hit_s
        Acceleration (m/s²) of the ground at a hit, median; and its duration, s.
    spread
        Standard deviation of the logarithm of a hit's level.
    """

    bumps: tuple[tuple[int, float, float], ...] = (
        (0, -0.083, 0.6), (1, 0.012, 0.4), (1, 0.061, 0.9)
    )  # fmt: skip
    bump_length: float = 5e-4
    hits_per_s: float = 0.03
    hit_level: float = 0.02
    hit_s: float = 0.006
    spread: float = 0.5

    def __post_init__(self) -> None:
        """Reject negative numbers, and rails that are not there."""
        _refuse_negative(self)
        if any(rail not in (0, 1) for rail, _, _ in self.bumps):
            raise BadParameter("bumps", self.bumps, "rail 0 or 1")


@dataclass(frozen=True, slots=True)
class Effects:
    """What a recording has beyond the linear loop; None leaves a part out.

    Parameters
    ----------
    peak_current
        Of the drive, A: the force does not follow beyond it.  The controller's integrator goes on.
    at_place
        Whether cogging and encoder error follow the place of the platform instead of its reference.
    floor, blows
        Of the ground and of the rails.
    entry, cage
        Amplitude (N) along the feed and upright, per block, of balls that enter the load, once in
        two pitches of the balls as these roll at half of the velocity (what unlike rows leave of
        it; even harmonics are the orders "ball pass" of every recording), and of the whole chain
        of balls in a block, once in twice its length: the cage order [Ohta2000].
    chain
        Length of the chain of balls, m.
    """

    friction: FrictionParameters | None = None
    peak_current: float = math.inf
    at_place: bool = False
    floor: Floor | None = None
    blows: Blows | None = None
    entry: tuple[float, float] = (0.0, 0.0)
    cage: tuple[float, float] = (0.0, 0.0)
    chain: float = 0.13

    @property
    def nonlinear(self) -> bool:
        """Whether any of them makes the loop nonlinear."""
        return self.friction is not None or self.at_place or math.isfinite(self.peak_current)


def _refuse_negative(owner: object) -> None:
    """Raise if a number of a dataclass is negative or not finite."""
    for name in owner.__dataclass_fields__:  # type: ignore[attr-defined]
        value = getattr(owner, name)
        if isinstance(value, int | float) and not (math.isfinite(value) and value >= 0):
            raise BadParameter(name, value, "0 or more, finite")


LINEAR = Effects()
FULL = Effects(
    friction=FrictionParameters(),
    peak_current=20.0,
    at_place=True,
    floor=Floor(),
    blows=Blows(),
    entry=(0.02, 0.10),
    cage=(0.05, 0.10),
)
EFFECTS = {
    "linear": LINEAR,
    "disturbed": replace(FULL, friction=None, peak_current=math.inf, at_place=False),
    "full": FULL,
}


def effects_named(name: str) -> Effects:
    """Return effects by their name.

    Raises
    ------
    BadParameter
        If there are none of that name.
    """
    if name not in EFFECTS:
        raise BadParameter("effects", name, " or ".join(EFFECTS))
    return EFFECTS[name]


# Changes white sequences (noise input, time) in place, given the index of their first sample.
Change = Callable[[int, Array], None]


def level_of_floor(floor: Floor, seconds: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return times (s) and the level of the floor's vibration at them, mean square 1 expected."""
    step = 0.05
    time = np.arange(0.0, seconds + step, step)
    keep = math.exp(-step / max(floor.wander_s, step))
    white = rng.standard_normal(time.size)
    wander = np.empty(time.size)
    wander[0] = white[0]
    for i in range(1, time.size):
        wander[i] = keep * wander[i - 1] + math.sqrt(1 - keep**2) * white[i]
    level = np.exp(floor.wander * wander)
    # A gust may have begun before the log.
    begun = rng.poisson(floor.gusts_per_s * (seconds + floor.gust_s))
    for at in rng.uniform(-floor.gust_s, seconds, begun):
        inside = np.clip((time - at) / max(floor.gust_s, step), 0.0, 1.0)
        top = floor.gust_level * math.exp(0.5 * rng.standard_normal())
        level *= 1 + max(top - 1, 0.0) * np.sin(math.pi * inside) ** 2
    share = floor.gusts_per_s * floor.gust_s
    # Expected square: of the wander, and of a gust, whose sin² has mean 1/2 and mean square 3/8.
    rise = max(floor.gust_level - 1, 0.0)
    square = math.exp(2 * floor.wander**2) * (1 + share * (rise + 3 / 8 * rise**2))
    return time, level / math.sqrt(square)


def changes(
    stage: Stage,
    effects: Effects,
    position: Array,
    rng: np.random.Generator,
    sample_rate_hz: float,
) -> Change | None:
    """Return how floor and blows change the noise of a log, or None where they do not.

    Parameters
    ----------
    position : (time,) m
        Of the whole log.
    """
    parts: list[Change] = []
    seconds = position.size / sample_rate_hz
    ground = slice(NOISE_INPUTS.index("ground_x"), NOISE_INPUTS.index("ground_z") + 1)
    if effects.floor is not None:
        time, level = level_of_floor(effects.floor, seconds, rng)

        def waver(start: int, white: Array) -> None:
            at = (start + np.arange(white.shape[1])) / sample_rate_hz
            white[ground] *= np.interp(at, time, level)

        parts.append(waver)
    if effects.blows is not None:
        parts += [_hits(effects.blows, position.size, rng, sample_rate_hz, ground)]
        parts += [_bumps(stage, effects.blows, position)]
    if not parts:
        return None

    def change(start: int, white: Array) -> None:
        for part in parts:
            part(start, white)

    return change


def _hits(
    blows: Blows, samples: int, rng: np.random.Generator, sample_rate_hz: float, ground: slice
) -> Change:
    """Return a change that adds hits, half sines from random directions."""
    size = max(2, round(blows.hit_s * sample_rate_hz))
    wave = np.sin(np.pi * (np.arange(size) + 0.5) / size)
    count = rng.poisson(blows.hits_per_s * samples / sample_rate_hz)
    at = rng.integers(0, samples, count)
    way = rng.standard_normal((count, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    way *= blows.hit_level * np.exp(blows.spread * rng.standard_normal((count, 1)))

    def hit(start: int, white: Array) -> None:
        end = start + white.shape[1]
        for first, push in zip(at.tolist(), way, strict=True):
            low, high = max(first, start), min(first + size, end)
            if low < high:
                part = wave[low - first : high - first]
                white[ground, low - start : high - start] += push[:, None] * part

    return hit


def _bumps(stage: Stage, blows: Blows, position: Array) -> Change:
    """Return a change that adds a vertical force where a block passes a bump."""
    places = corners(stage.block_half_spacing)

    def bump(start: int, white: Array) -> None:
        here = position[start : start + white.shape[1]]
        for i, (x, y, _) in enumerate(places):
            for rail, place, force in blows.bumps:
                if (y > 0) == (rail == 0):
                    inside = (here + x - place) / blows.bump_length
                    (passing,) = np.nonzero(np.abs(inside) < 0.5)
                    row = NOISE_INPUTS.index(f"block{i + 1}_z")
                    white[row, passing] += force * np.cos(np.pi * inside[passing]) ** 2

    return bump


def friction_of(
    stage: Stage, condition: Condition, friction: FrictionParameters
) -> tuple[float, float]:
    """Return Coulomb friction (N) and viscous part (N s/m) of a block in a condition."""
    balls = condition.guide_preload**friction.load_exponent
    load = friction.seals + (1 - friction.seals) * balls
    warm = condition.temperature_c - stage.temperature_reference.value
    thin = math.exp(-friction.thinning * warm) * condition.guide_damping
    return friction.scale * stage.friction.value * load / _BLOCKS, friction.viscous * thin / _BLOCKS
