"""Kalman filters of single modes, one per mode and hypothesis, all advanced in one call.

The state of one mode is ``[ln f, rate, b₁ … b_c]``: ln frequency at the covariates' reference, its
rate and one coefficient per covariate. ln ζ is a random walk. An innovation comes from the filter's
Gaussian or, with a small probability, from a wider one (a small step, or scatter that the stated
covariance does not include), so that no single estimate has unlimited weight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from lmshealth._private.arrays import BoolArray, FloatArray, Rows
from lmshealth.tracking import constants

IntArray = NDArray[np.intp]

# Variance of a rate while the length of a life is not known yet: practically flat.
_FLAT_VARIANCE = 1e100


@dataclass(frozen=True, slots=True, eq=False)
class Measurements(Rows):
    """Estimates of one log."""

    ln_f: FloatArray  # of Hz, ``(n,)``
    var_f: FloatArray
    ln_zeta: FloatArray  # ``(n,)``; 0 with infinite variance where unknown
    var_zeta: FloatArray
    shapes: FloatArray  # of unit length, ``(n, n_channels)``; NaN where a channel is absent


def _log_densities(x: FloatArray, var: FloatArray, std: float) -> tuple[FloatArray, FloatArray]:
    """Return the weighted log densities of regular and of stray innovations."""
    wide = var + std**2
    share = constants.STRAY_PROBABILITY
    regular = np.log(1 - share) - 0.5 * (x**2 / var + np.log(2 * np.pi * var))
    stray = np.log(share) - 0.5 * (x**2 / wide + np.log(2 * np.pi * wide))
    return regular, stray


def _is_stray(x: FloatArray, var: FloatArray, std: float) -> BoolArray:
    regular, stray = _log_densities(x, var, std)
    return np.asarray(stray > regular)


@dataclass(frozen=True, slots=True, eq=False)
class ModeFilters(Rows):
    """Filters of m modes under h hypotheses."""

    mean: FloatArray  # states, ``(h, m, d)``
    cov: FloatArray  # their covariances, ``(h, m, d, d)``
    ln_zeta: FloatArray  # ``(h, m)``
    var_zeta: FloatArray
    shapes: FloatArray  # mean mode shapes, ``(h, m, n_channels)``; NaN where unknown
    n_shapes: FloatArray  # number of shapes in it, ``(h, m)``

    @classmethod
    def empty(cls, n_covariates: int, n_channels: int) -> Self:
        """Return one hypothesis without modes."""
        d = 2 + n_covariates
        sizes: list[tuple[int, ...]] = [(d,), (d, d), (), (), (n_channels,), ()]
        return cls(*(np.empty((1, 0, *size)) for size in sizes))

    @property
    def n_modes(self) -> int:
        """Number of modes."""
        return int(self.mean.shape[1])

    def keep(self, modes: IntArray) -> Self:
        """Return copies of some modes, in any order."""
        return self.with_each(lambda own: own[:, modes])

    def join(self, other: ModeFilters) -> Self:
        """Append the modes of other filters that have one hypothesis."""
        return self.append(other[np.zeros(len(self.mean), dtype=int)], axis=1)

    def append(self, other: ModeFilters, *, axis: int) -> Self:
        """Append the hypotheses (axis 0) or the modes (axis 1) of other filters."""
        return self.with_each(lambda *both: np.concatenate(both, axis), other)

    def start(
        self, first: Measurements, row: FloatArray, prior_std: FloatArray, life: float
    ) -> Self:
        """Append modes, each started from its first estimate.

        `row` is the observation row ``[1, 0, covariates]``, ``(d,)``; `prior_std` that of a
        `State`, ``(d - 2,)``; `life` the length of a life on the clock, 0 while unknown.
        """
        n, d = first.ln_f.size, row.size
        rate = (constants.RATE_STD / life) ** 2 if life else _FLAT_VARIANCE
        cov = np.tile(np.diag(np.concatenate([[0.0, rate], prior_std**2])), (n, 1, 1))
        # A diffuse level updated by y = ℓ + bᵀx + ε: ℓ = y - bᵀx - ε has the errors of both.
        x = row[2:]
        cov[:, 0, 0] = first.var_f + np.sum((x * prior_std) ** 2)
        cov[:, 0, 2:] = cov[:, 2:, 0] = -x * prior_std**2
        mean = np.zeros((n, d))
        mean[:, 0] = first.ln_f
        known = np.isfinite(first.shapes).any(-1).astype(float)
        new = (mean, cov, first.ln_zeta, first.var_zeta, first.shapes, known)
        return self.join(ModeFilters(*(part[None] for part in new)))

    def predicted(self, row: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the predicted ln f and its variance, each ``(h, m)``."""
        return self.mean @ row, self.cov @ row @ row

    def log_density(self, new: Measurements, row: FloatArray) -> FloatArray:
        """Return the log density of every estimate under every mode, shape ``(h, n, m)``.

        An unknown ln ζ contributes nothing.
        """
        at, var = self.predicted(row)
        off, total = new.ln_f[:, None] - at[:, None], new.var_f[:, None] + var[:, None]
        density = np.logaddexp(*_log_densities(off, total, constants.STRAY_LN_F_STD))
        off = new.ln_zeta[:, None] - self.ln_zeta[:, None]
        total = new.var_zeta[:, None] + self.var_zeta[:, None]
        known = np.isfinite(total)
        total = np.where(known, total, 1.0)
        damping = np.logaddexp(*_log_densities(off, total, constants.STRAY_LN_ZETA_STD))
        return np.asarray(density + np.where(known, damping, 0.0))


def predict(filters: ModeFilters, step: float, life: float, *, opened: bool = False) -> ModeFilters:
    """Predict all filters over a step of the clock; `opened` is whether levels may step here.

    With a `life` of 0, of unknown length, there is no drift.
    """
    mean, cov, var_zeta = filters.mean.copy(), filters.cov.copy(), filters.var_zeta.copy()
    if life:
        # The longer a life turns out to be, the lower are its rates per unit of the clock.
        shrink = np.sqrt(np.minimum(1.0, (constants.RATE_STD / life) ** 2 / cov[..., 1, 1]))
        mean[..., 1] *= shrink
        cov[..., 1, :] *= shrink[..., None]
        cov[..., :, 1] *= shrink[..., None]
        share = step / life
        mean[..., 0] += step * mean[..., 1]
        cov[..., 0, :] += step * cov[..., 1, :]
        cov[..., :, 0] += step * cov[..., :, 1]
        drive = constants.RATE_WALK**2 * share
        cov[..., 0, 0] += constants.LEVEL_WALK**2 * share + drive * share**2 / 3
        cov[..., 0, 1] += drive * share / (2 * life)
        cov[..., 1, 0] += drive * share / (2 * life)
        cov[..., 1, 1] += drive / life**2
        var_zeta += constants.LN_ZETA_WALK**2 * share
    if opened:
        cov[..., 0, 0] += constants.DECLARED_STEP_STD**2
        var_zeta += constants.LN_ZETA_STD**2
    return replace(filters, mean=mean, cov=cov, var_zeta=var_zeta)


def update(
    filters: ModeFilters, at: tuple[IntArray, IntArray], new: Measurements, row: FloatArray
) -> ModeFilters:
    """Update some filters, each with its own estimate.

    `at` has the hypothesis and the mode of each filter, none twice.
    """
    mean, cov = filters.mean[at], filters.cov[at]
    side = cov @ row
    var = side @ row + new.var_f
    innovation = new.ln_f - mean @ row
    stray = _is_stray(innovation, var, constants.STRAY_LN_F_STD)
    if stray.any():
        extra = np.where(stray, constants.STRAY_LN_F_STD**2, 0.0)
        cov[:, 0, 0] += extra
        side[:, 0] += extra
        var = var + extra
    gain = side / var[:, None]
    all_mean, all_cov = filters.mean.copy(), filters.cov.copy()
    all_mean[at] = mean + gain * innovation[:, None]
    all_cov[at] = cov - gain[:, :, None] * side[:, None, :]
    ln_zeta, var_zeta = _updated_damping(filters, at, new)
    shapes, n_shapes = filters.shapes, filters.n_shapes
    if new.shapes.shape[1]:
        shapes, n_shapes = _updated_shapes(filters, at, new.shapes)
    return ModeFilters(all_mean, all_cov, ln_zeta, var_zeta, shapes, n_shapes)


def _updated_damping(
    filters: ModeFilters, at: tuple[IntArray, IntArray], new: Measurements
) -> tuple[FloatArray, FloatArray]:
    before, var = filters.ln_zeta[at], filters.var_zeta[at]
    noise, innovation = new.var_zeta, new.ln_zeta - before
    known, first = np.isfinite(noise), np.isinf(var)
    var = np.where(first, 1.0, var)
    total = var + np.where(known, noise, 1.0)
    stray = known & _is_stray(innovation, total, constants.STRAY_LN_ZETA_STD)
    var = var + np.where(stray, constants.STRAY_LN_ZETA_STD**2, 0.0)
    gain = np.where(known, np.where(first, 1.0, var / (var + noise)), 0.0)
    ln_zeta, var_zeta = filters.ln_zeta.copy(), filters.var_zeta.copy()
    ln_zeta[at] = before + gain * innovation
    # A first damping has the variance of its estimate, others (1 - gain) of their own.
    own = np.where(first, np.inf, var * (1 - gain))
    var_zeta[at] = np.where(first & known, noise, own)
    return ln_zeta, var_zeta


def _updated_shapes(
    filters: ModeFilters, at: tuple[IntArray, IntArray], shapes: FloatArray
) -> tuple[FloatArray, FloatArray]:
    known = np.isfinite(shapes)
    before, count = filters.shapes[at], filters.n_shapes[at] + known.any(-1)
    sign = np.sign(np.nansum(before * shapes, axis=-1))
    turned = np.where(sign == 0, 1.0, sign)[:, None] * shapes
    gain = np.where(count <= constants.N_MEAN_SHAPES, 1 / np.maximum(count, 1.0), 0.0)
    mean = np.where(np.isfinite(before), before, turned)
    mean = np.where(known, mean + gain[:, None] * (turned - mean), mean)
    norm = np.sqrt(np.nansum(mean**2, axis=-1))
    all_shapes, n_shapes = filters.shapes.copy(), filters.n_shapes.copy()
    all_shapes[at] = mean / np.where(norm > 0, norm, 1.0)[:, None]
    n_shapes[at] = count
    return all_shapes, n_shapes
