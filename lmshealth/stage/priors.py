"""Prior distributions of a stage description, single and joint (README.md, "Priors").

Their values are in the descriptions: ``descriptions/*.toml``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from scipy.special import ndtr, ndtri

from lmshealth._private.arrays import BoolArray, FloatArray, freeze
from lmshealth._private.toml import within
from lmshealth.errors import BadStage
from lmshealth.stage import constants

# Levels of the quantiles that approximate a variance.
_N_LEVELS = 4096
_HALF_LN_2PI = 0.5 * np.log(2 * np.pi)


class _Distribution(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A distribution; unknown keys are errors."""


class Lognormal(_Distribution, frozen=True, tag="lognormal", tag_field="kind"):
    """Lognormal distribution by its median and the standard deviation of the logarithm."""

    median: Annotated[float, within(*constants.VALUE, 1.0)]
    sigma: Annotated[float, within(*constants.SIGMA, 0.3)]

    def __post_init__(self) -> None:
        if not (0 < self.median < np.inf and 0 < self.sigma < np.inf):
            raise ValueError(f"lognormal needs finite median and sigma above 0, got {self}")

    def log_density(self, x: FloatArray) -> FloatArray:
        """Return the log density, -inf for x <= 0."""
        with np.errstate(invalid="ignore", divide="ignore"):
            log_x = np.log(x)
            value = -0.5 * ((log_x - np.log(self.median)) / self.sigma) ** 2 - log_x
        return np.where(x > 0, value - np.log(self.sigma) - _HALF_LN_2PI, -np.inf)

    def quantile(self, level: FloatArray) -> FloatArray:
        """Return quantiles, elementwise."""
        return self.median * np.exp(self.sigma * ndtri(level))

    def probability(self, x: FloatArray) -> FloatArray:
        """Return probabilities below x, elementwise."""
        with np.errstate(invalid="ignore", divide="ignore"):
            value = ndtr(np.log(np.divide(x, self.median)) / self.sigma)
        return np.where(np.asarray(x) > 0, value, 0.0)

    def standard(self, x: FloatArray) -> FloatArray:
        """Standardise: return (ln x - ln median) / sigma."""
        return np.asarray(np.log(x / self.median) / self.sigma)

    def placed(self, mean: float, std: float) -> Lognormal:
        """Return the distribution of which `standard` has this mean and standard deviation."""
        return Lognormal(self.median * float(np.exp(self.sigma * mean)), self.sigma * std)


class Normal(_Distribution, frozen=True, tag="normal", tag_field="kind"):
    """Normal distribution."""

    mean: Annotated[float, within(-constants.VALUE[1], constants.VALUE[1], 1.0)]
    std: Annotated[float, within(*constants.VALUE, 0.3)]

    def __post_init__(self) -> None:
        if not constants.LEAST_WIDTH * abs(self.mean) < self.std < np.inf:
            raise ValueError(
                f"normal needs a finite std above the rounding of its mean, got {self}"
            )

    def log_density(self, x: FloatArray) -> FloatArray:
        """Return the log density."""
        value = -0.5 * ((x - self.mean) / self.std) ** 2
        return np.asarray(value - np.log(self.std) - _HALF_LN_2PI)

    def quantile(self, level: FloatArray) -> FloatArray:
        """Return quantiles, elementwise."""
        return self.mean + self.std * ndtri(level)

    def probability(self, x: FloatArray) -> FloatArray:
        """Return probabilities below x, elementwise."""
        return np.asarray(ndtr((np.asarray(x) - self.mean) / self.std))

    def standard(self, x: FloatArray) -> FloatArray:
        """Standardise: return (x - mean) / std."""
        return np.asarray((x - self.mean) / self.std)

    def placed(self, mean: float, std: float) -> Normal:
        """Return the distribution of which `standard` has this mean and standard deviation."""
        return Normal(self.mean + self.std * mean, self.std * std)


class Uniform(_Distribution, frozen=True, tag="uniform", tag_field="kind"):
    """Uniform distribution between low and high."""

    low: Annotated[float, within(-constants.VALUE[1], constants.VALUE[1], 0.3)]
    high: Annotated[float, within(-constants.VALUE[1], constants.VALUE[1], 1.0)]

    def __post_init__(self) -> None:
        if not constants.LEAST_WIDTH * max(-self.low, self.high) < self.high - self.low < np.inf:
            raise ValueError(f"uniform needs finite ends with high well above low, got {self}")

    def log_density(self, x: FloatArray) -> FloatArray:
        """Return the log density, -inf outside."""
        inside = (x > self.low) & (x < self.high)
        return np.where(inside, -np.log(self.high - self.low), -np.inf)

    def quantile(self, level: FloatArray) -> FloatArray:
        """Return quantiles, elementwise."""
        return self.low + (self.high - self.low) * np.asarray(level)

    def probability(self, x: FloatArray) -> FloatArray:
        """Return probabilities below x, elementwise."""
        return np.clip((np.asarray(x) - self.low) / (self.high - self.low), 0.0, 1.0)


Prior = Lognormal | Normal | Uniform


@dataclass(frozen=True, slots=True, eq=False)
class JointPrior:
    """Independent priors of several parameters, truncated to a box of their logarithms.

    The box from low to high is the range of the modal map, each of shape ``(n_parameters,)``.
    """

    names: tuple[str, ...]
    priors: tuple[Prior, ...]
    low: FloatArray
    high: FloatArray

    def __post_init__(self) -> None:
        ends = zip(self.names, self.priors, self.low, self.high, strict=True)
        for name, prior, low, high in ends:
            if self._mass(prior, low, high)[1] < constants.LEAST_PRIOR_MASS:
                raise BadStage(
                    f"the prior of {name} has almost no probability inside the modal map, "
                    f"{np.exp(low):.4g} to {np.exp(high):.4g}; widen the map or move the prior"
                )
        freeze(self)

    @staticmethod
    def _mass(prior: Prior, low: float, high: float) -> tuple[float, float]:
        """Return the probability below the box and inside it."""
        below, upto = prior.probability(np.exp([low, high]))
        return float(below), float(upto - below)

    def inside(self, x: FloatArray) -> BoolArray:
        """Return which ln parameters, ``(n_points, n_parameters)``, lie in the box."""
        return np.asarray(np.all((x >= self.low) & (x <= self.high), axis=-1))

    def log_density(self, x: FloatArray) -> FloatArray:
        """Return the log density of ln parameters up to a constant, shape ``(n_points,)``."""
        total = np.where(self.inside(x), 0.0, -np.inf)
        for j, prior in enumerate(self.priors):
            # The density of a logarithm has the parameter itself as its Jacobian.
            total = total + prior.log_density(np.exp(x[:, j])) + x[:, j]
        return np.asarray(total)

    def quantile(self, level: FloatArray) -> FloatArray:
        """Return quantiles of the ln parameters at ``(n, n_parameters)`` or ``(n, 1)`` levels."""
        level = np.broadcast_to(level, (np.shape(level)[0], len(self.priors)))
        columns = []
        for j, prior in enumerate(self.priors):
            below, mass = self._mass(prior, self.low[j], self.high[j])
            value = prior.quantile(below + mass * level[:, j])
            # A narrow prior has no probability below the box: its ends are 0 or infinite.
            columns.append(np.log(np.clip(value, *np.exp([self.low[j], self.high[j]]))))
        # Rounding of quantiles must not leave the box.
        return np.asarray(np.clip(np.column_stack(columns), self.low, self.high))

    @property
    def variance(self) -> FloatArray:
        """Variances of the ln parameters, shape ``(n_parameters,)``."""
        levels = (np.arange(_N_LEVELS) + 0.5) / _N_LEVELS
        return np.asarray(self.quantile(levels[:, None]).var(axis=0))

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Draw ln parameters, shape ``(n, n_parameters)``."""
        return self.quantile(rng.uniform(1e-12, 1 - 1e-12, (n, len(self.priors))))
