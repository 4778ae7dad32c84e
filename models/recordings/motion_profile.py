"""Reference profiles of the motion controller: strokes of limited velocity, acceleration, jerk."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PPoly

from models.errors import BadParameter

Array = NDArray[np.float64]

# The paper: constant acceleration of 5000 mm/s² and constant jerk without a number; this one (our
# choice) lets a move to 100 mm/s just reach that acceleration.
ACCELERATION = 5.0
JERK = 250.0
# Of a move: a day, and more strokes than the longest log shows.
LONGEST_S = 86400.0
MOST_STROKES = 1000


@dataclass(frozen=True, slots=True)
class Profile:
    """Strokes out and back about the middle of the travel, with a dwell after each.

    Parameters
    ----------
    velocity
        Set velocity, m/s.
    stroke
        Length of one stroke, m.
    dwell
        Standstill after each stroke, s.
    strokes
        Count; every second one goes back.
    acceleration, jerk
        Limits, m/s² and m/s³.
    """

    velocity: float
    stroke: float
    dwell: float = 0.5
    strokes: int = 1
    acceleration: float = ACCELERATION
    jerk: float = JERK

    def __post_init__(self) -> None:
        """Reject a move without end, or a stroke on which the set velocity is never reached."""
        for name in ("velocity", "stroke", "acceleration", "jerk"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise BadParameter(name, value, "a positive number")
        if not (math.isfinite(self.dwell) and self.dwell >= 0):
            raise BadParameter("dwell", self.dwell, "0 s or more, finite")
        if not 1 <= self.strokes <= MOST_STROKES:
            raise BadParameter("strokes", self.strokes, f"1 to {MOST_STROKES}")
        # Without the ramps, which are shorter than the strokes.
        least_s = self.strokes * (self.stroke / self.velocity + self.dwell)
        if least_s > LONGEST_S:
            raise BadParameter(
                "duration of all strokes", f"{least_s:.4g} s", f"at most {LONGEST_S:g} s"
            )
        if self.constant_s <= 0:
            least = self.velocity * self.ramp_s
            raise BadParameter(
                "stroke", f"{self.stroke} m", f"more than {least:.4g} m to reach the set velocity"
            )

    @property
    def _jerk_s(self) -> float:
        """Duration of one jerk phase: the acceleration's limit need not be reached."""
        return min(self.acceleration / self.jerk, math.sqrt(self.velocity / self.jerk))

    @property
    def ramp_s(self) -> float:
        """Duration from standstill to the set velocity, s."""
        return self._jerk_s + self.velocity / (self.jerk * self._jerk_s)

    @property
    def constant_s(self) -> float:
        """Duration of one stroke's constant velocity, s."""
        return self.stroke / self.velocity - self.ramp_s

    @property
    def seconds(self) -> float:
        """Duration of all strokes with their dwells, s."""
        return self.strokes * (2 * self.ramp_s + self.constant_s + self.dwell)

    def _phases(self) -> Iterator[tuple[float, float]]:
        """Yield (duration s, jerk m/s³) of every phase."""
        short, held = self._jerk_s, self.ramp_s - 2 * self._jerk_s
        for i in range(self.strokes):
            push = self.jerk if i % 2 == 0 else -self.jerk
            yield from ((short, push), (held, 0.0), (short, -push))
            yield self.constant_s, 0.0
            yield from ((short, -push), (held, 0.0), (short, push))
            yield self.dwell, 0.0

    def position(self) -> PPoly:
        """Return position (m) over time (s) as a piecewise cubic; its derivatives are exact."""
        phases = [phase for phase in self._phases() if phase[0] > 0]
        spans = np.array([duration for duration, _ in phases])
        jerks = np.array([jerk for _, jerk in phases])
        accelerations = np.concatenate([[0.0], np.cumsum(jerks * spans)])[:-1]
        gains = accelerations * spans + jerks * spans**2 / 2
        velocities = np.concatenate([[0.0], np.cumsum(gains)])[:-1]
        ways = velocities * spans + accelerations * spans**2 / 2 + jerks * spans**3 / 6
        places = -self.stroke / 2 + np.concatenate([[0.0], np.cumsum(ways)])[:-1]
        times = np.concatenate([[0.0], np.cumsum(spans)])
        return PPoly(np.vstack([jerks / 6, accelerations / 2, velocities, places]), times)

    def sampled(self, time: Array) -> Array:
        """Return position, velocity, acceleration and jerk (4, time) at times (s), SI.

        Before the first stroke and after the last dwell the reference is constant.
        """
        path = self.position()
        moving = (time >= path.x[0]) & (time < path.x[-1])
        inside = np.clip(time, path.x[0], path.x[-1])
        derivatives = [path.derivative(order)(inside) * moving for order in (1, 2, 3)]
        return np.vstack([path(inside), *derivatives])
