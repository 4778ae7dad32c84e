"""Courses of a life: which law each health parameter follows, since when, and what steps did.

A parameter with several laws follows one of them; which one, the data weigh. At a step (a crash, a
bolt that breaks) every parameter jumps by an unknown factor, and a law may begin anew there:

    h(s) = law(s - s_0) · Π jumps before s,   s_0 = 0 or the last step, law(s < 0) = 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np

from lmshealth._arrays import FloatArray
from lmshealth.stage.degradation_laws import Law
from lmshealth.stage.description import ParameterSpec
from lmshealth.stage.priors import Normal

# Of the logarithm of a health parameter at a step.
_JUMP = Normal(0.0, 0.3)


@dataclass(frozen=True, slots=True)
class DegradationPath:
    """What one health parameter does.

    Coordinates are those of the law, then ln of the jump at each step.

    Attributes
    ----------
    law : Law
        How it degrades.
    begin : float
        Travel in m since the baseline at which the law begins.
    steps : tuple of float
        Travel in m since the baseline at each step.
    """

    law: Law
    begin: float
    steps: tuple[float, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the natural parameters: those of the law, then the jump at each step."""
        jumps = (f"jump_{k + 1}" for k in range(len(self.steps)))
        return (*self.law.names, *jumps)

    def _cut(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Cut coordinates, or natural parameters, into those of the law and the jumps."""
        n = len(self.law.names)
        return values[:, :n], values[:, n:]

    def natural(self, y: FloatArray, now: float) -> FloatArray:
        """Turn coordinates into natural parameters, ``(n, k)`` both; jumps are factors."""
        own, jumps = self._cut(y)
        # A far-off walker may ask for a jump beyond the range of floats; its prior is 0 anyway.
        jump = np.exp(np.clip(jumps, -300, 300))
        return np.hstack([self.law.natural(own, now - self.begin), jump])

    def log_prior(self, y: FloatArray, now: float) -> FloatArray:
        """Log prior density of the coordinates, shape ``(n,)``."""
        own, jumps = self._cut(y)
        total = self.law.log_prior(own, now - self.begin)
        return np.asarray(total + _JUMP.log_density(jumps).sum(axis=1))

    def draw(self, rng: np.random.Generator, n: int, now: float) -> FloatArray:
        """Draw coordinates from the prior, shape ``(n, k)``."""
        jumps = _JUMP.quantile(rng.uniform(1e-9, 1 - 1e-9, (n, len(self.steps))))
        return np.hstack([self.law.draw(rng, n, now - self.begin), jumps])

    def health(self, theta: FloatArray, travel: FloatArray) -> FloatArray:
        """Health as a fraction of baseline at each travel, the same for all or each one's own.

        Shape ``(n, n_travel)``.
        """
        own, jumps = self._cut(theta)
        health = self.law.health(own, travel - self.begin)
        for step, jump in zip(self.steps, jumps.T, strict=True):
            health = health * np.where(travel >= step, jump[:, None], 1.0)
        return health

    def passage(self, theta: FloatArray, limit: float | FloatArray) -> FloatArray:
        """Travel in m since the baseline at which a limit is reached for good, shape ``(n,)``.

        As the parameter goes on after the last step: a limit that a step itself has jumped over
        was reached where the law, so lowered, would have reached it, not later than at the step.
        """
        own, jumps = self._cut(theta)
        left = np.broadcast_to(limit, own.shape[:1]) / jumps.prod(axis=1)
        return np.asarray(self.begin + self.law.passage(own, left))


@dataclass(frozen=True)
class Scenario:
    """One way in which all health parameters may go.

    Attributes
    ----------
    paths : tuple of DegradationPath
        One per health parameter.
    now : float
        Travel in m since the baseline at the last log.
    weight : float
        Probability beforehand.
    """

    paths: tuple[DegradationPath, ...]
    now: float
    weight: float

    @cached_property
    def sizes(self) -> tuple[int, ...]:
        """Number of coordinates of each parameter."""
        return tuple(len(path.names) for path in self.paths)

    @property
    def n_dim(self) -> int:
        """Number of coordinates."""
        return sum(self.sizes)

    def split(self, y: FloatArray) -> list[FloatArray]:
        """Cut coordinates, or what they become, into those of each parameter."""
        return np.split(y, np.cumsum(self.sizes)[:-1], axis=-1)

    def natural(self, y: FloatArray) -> FloatArray:
        """Turn coordinates into natural parameters, ``(n, n_dim)`` both."""
        parts = zip(self.paths, self.split(y), strict=True)
        return np.hstack([path.natural(part, self.now) for path, part in parts])

    def log_prior(self, y: FloatArray) -> FloatArray:
        """Log prior density of the coordinates, shape ``(n,)``."""
        total = np.zeros(y.shape[0])
        for path, part in zip(self.paths, self.split(y), strict=True):
            total = total + path.log_prior(part, self.now)
        return np.where(np.isnan(total), -np.inf, total)

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Draw coordinates from the prior, shape ``(n, n_dim)``."""
        return np.hstack([path.draw(rng, n, self.now) for path in self.paths])

    def health(self, theta: FloatArray, travel: FloatArray) -> FloatArray:
        """Health as fractions of baseline by natural parameters, ``(n, n_travel, n_parameters)``.

        Parameters
        ----------
        theta : ndarray
            Natural parameters, shape ``(n, n_dim)``.
        travel : ndarray
            Since the baseline in m, shape ``(n_travel,)``.
        """
        parts = zip(self.paths, self.split(theta), strict=True)
        return np.stack([path.health(own, travel) for path, own in parts], axis=-1)


def list_scenarios(
    parameters: Sequence[ParameterSpec], steps: Sequence[float], now: float
) -> tuple[Scenario, ...]:
    """List every scenario that a life may have taken, with its probability beforehand.

    Parameters
    ----------
    parameters : sequence of ParameterSpec
        With their laws.
    steps : sequence of float
        Travel in m since the baseline at each step, ascending.
    now : float
        Travel in m since the baseline at the last log.
    """
    choices = []
    for parameter in parameters:
        total = sum(law.weight for law in parameter.laws)
        own: list[tuple[DegradationPath, float]] = []
        for law in parameter.laws:
            # What has no parameters, or no travel after the step, cannot begin anew.
            anew = law.names and steps and 0 < steps[-1] < now
            begins = (0.0, steps[-1]) if anew else (0.0,)
            share = law.weight / total / len(begins)
            own += [(DegradationPath(law, begin, tuple(steps)), share) for begin in begins]
        choices.append(own)
    return tuple(
        Scenario(
            paths=tuple(path for path, _ in chosen),
            now=now,
            weight=float(np.prod([share for _, share in chosen])),
        )
        for chosen in product(*choices)
    )
