"""Prior distributions of a stage description."""

from __future__ import annotations

import msgspec
import numpy as np
from scipy.special import ndtri

from lmshealth.arrays import FloatArray


class Lognormal(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="lognormal", tag_field="kind"
):
    """Lognormal distribution by its median and the standard deviation of the logarithm."""

    median: float
    sigma: float

    def __post_init__(self) -> None:
        if not (self.median > 0 and self.sigma > 0):
            raise ValueError(f"lognormal needs median and sigma above 0, got {self}")

    def log_density(self, x: FloatArray) -> FloatArray:
        """Log density at x > 0 up to a constant; -inf elsewhere."""
        with np.errstate(invalid="ignore", divide="ignore"):
            log_x = np.log(x)
            value = -0.5 * ((log_x - np.log(self.median)) / self.sigma) ** 2 - log_x
        return np.where(x > 0, value, -np.inf)

    def quantile(self, level: FloatArray) -> FloatArray:
        """Quantile function, elementwise."""
        return self.median * np.exp(self.sigma * ndtri(level))


class Normal(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="normal", tag_field="kind"
):
    """Normal distribution."""

    mean: float
    std: float

    def __post_init__(self) -> None:
        if not self.std > 0:
            raise ValueError(f"normal needs std above 0, got {self}")

    def log_density(self, x: FloatArray) -> FloatArray:
        """Log density up to a constant."""
        return -0.5 * ((x - self.mean) / self.std) ** 2

    def quantile(self, level: FloatArray) -> FloatArray:
        """Quantile function, elementwise."""
        return self.mean + self.std * ndtri(level)


class Uniform(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="uniform", tag_field="kind"
):
    """Uniform distribution between low and high."""

    low: float
    high: float

    def __post_init__(self) -> None:
        if not self.high > self.low:
            raise ValueError(f"uniform needs high above low, got {self}")

    def log_density(self, x: FloatArray) -> FloatArray:
        """Zero inside, -inf outside (a constant is left out)."""
        return np.where((x > self.low) & (x < self.high), 0.0, -np.inf)

    def quantile(self, level: FloatArray) -> FloatArray:
        """Quantile function, elementwise."""
        return self.low + (self.high - self.low) * np.asarray(level)


Prior = Lognormal | Normal | Uniform
