"""Scenarios of a life: the law of each health parameter, its begin, and the steps.

README.md has the model.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np

from lmshealth._private.arrays import FloatArray
from lmshealth.life import constants
from lmshealth.stage.degradation_laws import AnyLaw, Free
from lmshealth.stage.description import ParameterSpec


@dataclass(frozen=True, slots=True)
class DegradationPath:
    """Degradation of one health parameter: its law, and the begin of the law and the steps.

    Both are in m since the baseline. Coordinates are those of the law, then the ln factor at each
    step.
    """

    law: AnyLaw
    begin: float
    steps: tuple[float, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the natural parameters: those of the law, then the factor at each step."""
        return (*self.law.names, *(f"jump_{k + 1}" for k in range(len(self.steps))))

    def _split(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Split coordinates or natural parameters into those of the law and of the steps."""
        n = len(self.law.names)
        return values[:, :n], values[:, n:]

    def natural(self, y: FloatArray, now: float) -> FloatArray:
        """Convert coordinates to natural parameters, both ``(n, k)``."""
        own, jumps = self._split(y)
        # A jump beyond the range of floats has the prior 0 anyway.
        jump = np.exp(np.clip(jumps, -300, 300))
        return np.hstack([self.law.natural(own, now - self.begin), jump])

    def log_prior(self, y: FloatArray, now: float) -> FloatArray:
        """Return the log prior density of coordinates, shape ``(n,)``."""
        own, jumps = self._split(y)
        total = self.law.log_prior(own, now - self.begin)
        return np.asarray(total + constants.STEP_PRIOR.log_density(jumps).sum(axis=1))

    def draw(self, rng: np.random.Generator, n: int, now: float) -> FloatArray:
        """Draw coordinates from the prior, shape ``(n, k)``."""
        jumps = constants.STEP_PRIOR.quantile(rng.uniform(1e-9, 1 - 1e-9, (n, len(self.steps))))
        return np.hstack([self.law.draw(rng, n, now - self.begin), jumps])

    def health(self, theta: FloatArray, travel: FloatArray) -> FloatArray:
        """Return health as a fraction of baseline, ``(n, n_travel)``.

        Travel in m since the baseline, of shape ``(n_travel,)`` or ``(n, n_travel)``.
        """
        own, jumps = self._split(theta)
        health = self.law.health(own, travel - self.begin)
        for step, jump in zip(self.steps, jumps.T, strict=True):
            health = health * np.where(travel >= step, jump[:, None], 1.0)
        return health

    def passage(self, theta: FloatArray, limit: float | FloatArray) -> FloatArray:
        """Return the travel in m since the baseline at which a limit is reached, shape ``(n,)``.

        Extrapolated from after the last step: a limit passed by a step was reached where the law,
        times the factors of all steps, reaches it.
        """
        own, jumps = self._split(theta)
        left = np.broadcast_to(limit, own.shape[:1]) / jumps.prod(axis=1)
        return np.asarray(self.begin + self.law.passage(own, left))


@dataclass(frozen=True)
class Scenario:
    """Degradation of all health parameters, its prior probability, and the travel now.

    `now` is in m since the baseline at the last log.
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

    @property
    def step_columns(self) -> np.ndarray:
        """Indices of the coordinates that are ln factors at steps, parameter after parameter."""
        ends, n = np.cumsum(self.sizes), len(self.steps)
        return np.asarray((ends[:, None] + np.arange(-n, 0)).ravel())

    @property
    def steps(self) -> tuple[float, ...]:
        """Steps of the modes, in m since the baseline."""
        return self.paths[0].steps

    @property
    def name(self) -> str:
        """Name by the kind and the begin of each law, and the steps, in m."""
        laws = " ".join(f"{path.law.kind}@{path.begin:.0f}" for path in self.paths)
        return " ".join([laws, *(f"{step:.0f}" for step in self.steps)])

    @property
    def restarts(self) -> bool:
        """Whether a law begins at a step."""
        return any(path.begin > 0 for path in self.paths)

    def from_start(self) -> str:
        """Return the name of the scenario whose laws all begin at the baseline."""
        return replace(self, paths=tuple(replace(path, begin=0.0) for path in self.paths)).name

    def split(self, y: FloatArray) -> list[FloatArray]:
        """Split coordinates or natural parameters by health parameter."""
        return np.split(y, np.cumsum(self.sizes)[:-1], axis=-1)

    def _parts(self, y: FloatArray) -> Iterator[tuple[DegradationPath, FloatArray]]:
        """Yield each path with its own coordinates or natural parameters."""
        return zip(self.paths, self.split(y), strict=True)

    def natural(self, y: FloatArray) -> FloatArray:
        """Convert coordinates to natural parameters, both ``(n, n_dim)``."""
        return np.hstack([path.natural(part, self.now) for path, part in self._parts(y)])

    def log_prior(self, y: FloatArray) -> FloatArray:
        """Return the log prior density of coordinates, shape ``(n,)``."""
        each = (path.log_prior(part, self.now) for path, part in self._parts(y))
        total = sum(each, np.zeros(len(y)))
        return np.where(np.isnan(total), -np.inf, total)

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Draw coordinates from the prior, shape ``(n, n_dim)``."""
        return np.hstack([path.draw(rng, n, self.now) for path in self.paths])

    def health(self, theta: FloatArray, travel: FloatArray) -> FloatArray:
        """Return health as fractions of baseline, shape ``(n, n_travel, n_parameters)``.

        Natural parameters ``(n, n_dim)``; travel ``(n_travel,)`` in m since the baseline.
        """
        return np.stack([path.health(own, travel) for path, own in self._parts(theta)], axis=-1)


def laws_of(parameter: ParameterSpec, free: float) -> list[tuple[AnyLaw, float]]:
    """List the laws of a health parameter with their prior probabilities.

    A change without a law has the share `free` of them, unless the description has that law itself
    or lets the parameter never change.
    """
    laws = parameter.laws
    total = sum(law.weight for law in laws)
    if not free or any(isinstance(law, Free) for law in laws) or not any(x.names for x in laws):
        return [(law, law.weight / total) for law in laws]
    return [*((law, law.weight / total * (1 - free)) for law in laws), (Free(), free)]


def list_scenarios(
    parameters: Sequence[ParameterSpec], steps: Sequence[float], now: float, free: float
) -> tuple[Scenario, ...]:
    """List the scenarios of a life with their prior probabilities.

    Steps, ascending, and the last log by their travel in m since the baseline. The tracker found
    the steps in the same logs: that there are none competes with them. `free` as in `laws_of`.
    """
    found: list[Scenario] = []
    certain = constants.STEP_PROBABILITY if steps else 1.0
    for taken, probability in ((tuple(steps), certain), ((), 1 - certain)):
        if probability:
            choices = [_paths(parameter, taken, now, free) for parameter in parameters]
            for one in product(*choices):
                paths, shares = zip(*one, strict=True)
                found.append(Scenario(paths, now, probability * float(np.prod(shares))))
    return tuple(found)


def _paths(
    parameter: ParameterSpec, steps: tuple[float, ...], now: float, free: float
) -> list[tuple[DegradationPath, float]]:
    """List the paths of a health parameter with their prior probabilities."""
    found: list[tuple[DegradationPath, float]] = []
    for law, probability in laws_of(parameter, free):
        # A law with parameters may restart at the last step if travel follows it.
        restarts = law.names and steps and 0 < steps[-1] < now
        begins = (0.0, steps[-1]) if restarts else (0.0,)
        share = probability / len(begins)
        found += [(DegradationPath(law, begin, steps), share) for begin in begins]
    return found
