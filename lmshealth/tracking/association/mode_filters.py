"""Small Kalman filters side by side: one per mode and hypothesis, all moved in one call.

The state of one mode is [ln f, rate, b₁ … b_c]: ln frequency at the covariates' reference, its rate
and one coefficient per covariate. Its ln damping wanders beside it. The noises are those of a stage
that wears quickly: who is who must not hang on a fine prediction.

An innovation is either what the filter expects or, with a small share, stray: a little step or a
scatter that the stated covariance does not know. So no single estimate counts without limit.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import NDArray

from lmshealth._arrays import BoolArray, FloatArray

IntArray = NDArray[np.intp]

# Priors and random walks over a life, in ln f and ln ζ.
_RATE_STD, _LN_ZETA_STD = 0.3, 1.0
_LEVEL_WALK, _RATE_WALK, _DAMPING_WALK = 3e-3, 0.1, 0.3
# A declared intervention may step a mode by so much.
_STEP_STD = 0.05
# Share of stray estimates, and by how much these stray in ln f and ln ζ.
STRAY = 0.05
_STRAY_F, _STRAY_ZETA = 0.01, 0.7
# No life is thought to be shorter than so many logs: early logs do not know its length.
LEAST_LOGS = 50
# A shape is the mean of the first so many: one that turns later is seen to turn, and not followed
# until it is another mode's.
_N_SHAPES = 10
_UNKNOWN_RATE = 1e100


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """Some estimates of one log.

    Attributes
    ----------
    ln_f, var_f : ndarray
        ln frequency and its variance, shape ``(n,)``.
    ln_zeta, var_zeta : ndarray
        ln damping and its variance, shape ``(n,)``; 0 and infinite where not known.
    shapes : ndarray
        Shapes, ``(n, n_channels)``; NaN where a channel is absent.
    """

    ln_f: FloatArray
    var_f: FloatArray
    ln_zeta: FloatArray
    var_zeta: FloatArray
    shapes: FloatArray

    def pick(self, rows: IntArray) -> Readings:
        """Return some of them, in any order and any number of times."""
        return Readings(
            self.ln_f[rows],
            self.var_f[rows],
            self.ln_zeta[rows],
            self.var_zeta[rows],
            self.shapes[rows],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Innovations:
    """What estimates differ by from what is predicted, all arrays ``(h, n, m)``.

    Attributes
    ----------
    ln_f, ln_zeta : ndarray
        Estimate minus prediction.
    var_f, var_zeta : ndarray
        Their variances.
    """

    ln_f: FloatArray
    var_f: FloatArray
    ln_zeta: FloatArray
    var_zeta: FloatArray

    def log_density(self) -> FloatArray:
        """Return the log density of ln f and ln ζ, shape ``(h, n, m)``; unknown ln ζ adds none."""
        known = np.isfinite(self.var_zeta)
        var = np.where(known, self.var_zeta, 1.0)
        damping = np.where(known, _mixture(self.ln_zeta, var, _STRAY_ZETA), 0.0)
        return _mixture(self.ln_f, self.var_f, _STRAY_F) + damping


def _components(x: FloatArray, var: FloatArray, reach: float) -> tuple[FloatArray, FloatArray]:
    """Log densities of what is expected and of what is stray, each with its share."""
    wide = var + reach**2
    usual = np.log(1 - STRAY) - 0.5 * (x**2 / var + np.log(2 * np.pi * var))
    stray = np.log(STRAY) - 0.5 * (x**2 / wide + np.log(2 * np.pi * wide))
    return usual, stray


def _mixture(x: FloatArray, var: FloatArray, reach: float) -> FloatArray:
    return np.asarray(np.logaddexp(*_components(x, var, reach)))


@dataclass(slots=True, eq=False)
class Bank:
    """Filters of m modes under h hypotheses; the one thing here that changes in place.

    Attributes
    ----------
    mean, cov : ndarray
        State and its covariance, shapes ``(h, m, d)`` and ``(h, m, d, d)``.
    ln_zeta, var_zeta : ndarray
        ln damping and its variance, shape ``(h, m)``.
    shapes, n_shapes : ndarray
        Mean shape, NaN where unknown, ``(h, m, n_channels)``, and of how many, ``(h, m)``.
    """

    mean: FloatArray
    cov: FloatArray
    ln_zeta: FloatArray
    var_zeta: FloatArray
    shapes: FloatArray
    n_shapes: FloatArray

    @classmethod
    def empty(cls, n_covariates: int, n_channels: int) -> Self:
        """Return one hypothesis without modes."""
        d = 2 + n_covariates
        return cls(
            np.empty((1, 0, d)),
            np.empty((1, 0, d, d)),
            np.empty((1, 0)),
            np.empty((1, 0)),
            np.empty((1, 0, n_channels)),
            np.empty((1, 0)),
        )

    @property
    def n_modes(self) -> int:
        """Number of modes."""
        return int(self.mean.shape[1])

    def take(self, hypotheses: IntArray) -> Self:
        """Return some hypotheses, in any order and any number of times."""
        return type(self)(*(getattr(self, item.name)[hypotheses] for item in fields(self)))

    def keep(self, modes: IntArray) -> Self:
        """Return some modes, in any order."""
        return type(self)(*(getattr(self, item.name)[:, modes] for item in fields(self)))

    def join(self, other: Bank) -> Self:
        """Append the modes of another bank that has one hypothesis."""
        h = len(self.mean)
        pairs = ((getattr(self, i.name), getattr(other, i.name)) for i in fields(self))
        return type(self)(*(np.concatenate([a, np.repeat(b, h, 0)], 1) for a, b in pairs))

    def stack(self, other: Bank) -> Self:
        """Append the hypotheses of another bank that has the same modes."""
        pairs = ((getattr(self, i.name), getattr(other, i.name)) for i in fields(self))
        return type(self)(*(np.concatenate([a, b]) for a, b in pairs))

    def found(self, readings: Readings, row: FloatArray, prior_std: FloatArray, scale: float
              ) -> Self:  # fmt: skip
        """Append modes whose first estimates these are.

        Parameters
        ----------
        readings : Readings
            One estimate for each.
        row : ndarray
            Observation row ``[1, 0, covariates]``, shape ``(d,)``.
        prior_std : ndarray
            Of the covariates' coefficients, shape ``(d - 2,)``.
        scale : float
            Length of a life on the clock; 0 where not known yet.
        """
        n, d = readings.ln_f.size, row.size
        rate = (_RATE_STD / scale) ** 2 if scale else _UNKNOWN_RATE
        prior = np.concatenate([[0.0, rate], prior_std**2])
        cov = np.tile(np.diag(prior), (n, 1, 1))
        # A diffuse level, updated by y = ℓ + bᵀx + ε: ℓ = y - bᵀx - ε, so that it carries both.
        x = row[2:]
        cov[:, 0, 0] = readings.var_f + np.sum((x * prior_std) ** 2)
        cov[:, 0, 2:] = cov[:, 2:, 0] = -x * prior_std**2
        mean = np.zeros((n, d))
        mean[:, 0] = readings.ln_f
        new = Bank(
            mean[None],
            cov[None],
            readings.ln_zeta[None],
            readings.var_zeta[None],
            readings.shapes[None],
            np.isfinite(readings.shapes).any(-1).astype(float)[None],
        )
        return self.join(new)

    def predict(self, step: float, scale: float, *, opened: bool = False) -> None:
        """Move all filters on by a step of the clock.

        Parameters
        ----------
        step, scale : float
            Step and length of a life on the clock; a scale of 0 moves nothing.
        opened : bool
            Whether levels may step here.
        """
        mean, cov = self.mean, self.cov
        if scale:
            # A life that proves longer than was thought has lower rates than were thought.
            most = (_RATE_STD / scale) ** 2
            shrink = np.sqrt(np.minimum(1.0, most / cov[..., 1, 1]))
            mean[..., 1] *= shrink
            cov[..., 1, :] *= shrink[..., None]
            cov[..., :, 1] *= shrink[..., None]
            share = step / scale
            mean[..., 0] += step * mean[..., 1]
            cov[..., 0, :] += step * cov[..., 1, :]
            cov[..., :, 0] += step * cov[..., :, 1]
            drive = _RATE_WALK**2 * share
            cov[..., 0, 0] += _LEVEL_WALK**2 * share + drive * share**2 / 3
            cov[..., 0, 1] += drive * share / (2 * scale)
            cov[..., 1, 0] += drive * share / (2 * scale)
            cov[..., 1, 1] += drive / scale**2
            self.var_zeta += _DAMPING_WALK**2 * share
        if opened:
            cov[..., 0, 0] += _STEP_STD**2
            self.var_zeta += _LN_ZETA_STD**2

    def seen(self, row: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return where ln f is predicted and its variance, each ``(h, m)``."""
        return self.mean @ row, self.cov @ row @ row

    def compare(self, readings: Readings, row: FloatArray) -> Innovations:
        """Return the innovations of all estimates with all modes."""
        at, var = self.seen(row)
        return Innovations(
            readings.ln_f[:, None] - at[:, None],
            readings.var_f[:, None] + var[:, None],
            readings.ln_zeta[:, None] - self.ln_zeta[:, None],
            readings.var_zeta[:, None] + self.var_zeta[:, None],
        )

    def absorb(self, at: tuple[IntArray, IntArray], readings: Readings, row: FloatArray) -> None:
        """Update filters, each with its own estimate.

        Parameters
        ----------
        at : (ndarray, ndarray)
            Hypothesis and mode of each filter, none twice.
        readings : Readings
            Their estimates.
        row : ndarray
            Observation row, shape ``(d,)``.
        """
        mean, cov = self.mean[at], self.cov[at]
        side = cov @ row
        var = side @ row + readings.var_f
        innovation = readings.ln_f - mean @ row
        stray = _is_stray(innovation, var, _STRAY_F)
        if stray.any():
            extra = np.where(stray, _STRAY_F**2, 0.0)
            cov[:, 0, 0] += extra
            side[:, 0] += extra
            var = var + extra
        gain = side / var[:, None]
        self.mean[at] = mean + gain * innovation[:, None]
        self.cov[at] = cov - gain[:, :, None] * side[:, None, :]
        self._absorb_damping(at, readings)
        if readings.shapes.shape[1]:
            self._absorb_shapes(at, readings.shapes)

    def _absorb_damping(self, at: tuple[IntArray, IntArray], readings: Readings) -> None:
        before, var = self.ln_zeta[at], self.var_zeta[at]
        noise = readings.var_zeta
        known, first = np.isfinite(noise), np.isinf(var)
        var = np.where(first, 1.0, var)
        total = var + np.where(known, noise, 1.0)
        innovation = readings.ln_zeta - before
        var = var + np.where(known & _is_stray(innovation, total, _STRAY_ZETA), _STRAY_ZETA**2, 0.0)
        gain = np.where(known, np.where(first, 1.0, var / (var + noise)), 0.0)
        self.ln_zeta[at] = before + gain * innovation
        # A first damping has the variance of its estimate, others (1 - gain) of their own.
        own = np.where(first, np.inf, var * (1 - gain))
        self.var_zeta[at] = np.where(first & known, noise, own)

    def _absorb_shapes(self, at: tuple[IntArray, IntArray], shapes: FloatArray) -> None:
        known = np.isfinite(shapes)
        there = known.any(-1)
        before, count = self.shapes[at], self.n_shapes[at] + there
        sign = np.sign(np.nansum(before * shapes, axis=-1))
        turned = np.where(sign == 0, 1.0, sign)[:, None] * shapes
        gain = np.where(count <= _N_SHAPES, 1 / np.maximum(count, 1.0), 0.0)
        mean = np.where(np.isfinite(before), before, turned)
        mean = np.where(known, mean + gain[:, None] * (turned - mean), mean)
        norm = np.sqrt(np.nansum(mean**2, axis=-1))
        self.shapes[at] = mean / np.where(norm > 0, norm, 1.0)[:, None]
        self.n_shapes[at] = count


def _is_stray(x: FloatArray, var: FloatArray, reach: float) -> BoolArray:
    # Below two standard deviations nothing is stray.
    if (x * x <= 4 * var).all():
        return np.zeros(x.shape, dtype=bool)
    usual, stray = _components(x, var, reach)
    return np.asarray(stray > usual)
