"""Fit of neighbouring modes to free decays: poles, ambient responses, covariance.

Poles are added by an information criterion (`fit_decays`); the ambient response of each mode, which
few ordinates constrain, is averaged over (`estimate`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc, softmax

from lmshealth._private.arrays import FloatArray, stack
from lmshealth.modal import constants
from lmshealth.modal.credibility import Credibility, widened
from lmshealth.modal.deterministic.likelihood import (
    BandSpectra,
    IntArray,
    ModalLikelihood,
    pole_terms,
    unit_level,
)
from lmshealth.modal.deterministic.poles import (
    PoleFit,
    best_pole,
    evidence_needed,
    maximise,
)
from lmshealth.modal.modes import paired

# Levels of the ambient response: start where none is found, least level, and the log posterior
# below the largest from which on they are left out.
_FIRST_AVERAGE_LEVEL, _LEAST_LEVEL, _UNLIKELY = 0.5, 0.1, 6.0
# Largest step of the logarithm of a level, and its step in standard deviations where the level is
# well known: a sum over a normal density in such steps is exact to 1e-5.
_COARSE, _SPREADS = 0.6, 1.3
# Poles tried per Fourier frequency, and their dampings.
_TRIALS, _DAMPINGS = 4.0, np.geomspace(2e-4, 0.1, 10)
_FIRST_LEVEL = 0.3  # of the ambient response
# Least start value of the noise as a share of the mean power: rounding.
_LEAST_NOISE = 1e-12
# Tolerance in log likelihood while poles are counted.
_ROUGH = 0.02


def white_level(found: PoleFit) -> FloatArray:
    """Return the density of the white noise in mid-band, shape ``(n_channels,)``."""
    m, n = found.likelihood.n_modes, found.likelihood.n_channels
    return np.exp(found.p[3 * m : 3 * m + n])


def peak_snr(found: PoleFit, mode: int) -> FloatArray:
    """Return the largest mean ordinate of a mode's decays over the noise, ``(n_channels,)``.

    It corresponds to S / (4 ζ² S_e) of an ambient response.
    """
    block, size = found.likelihood.blocks[0], found.sizes(mode)[0]
    own = slice(mode, mode + 1)
    (up, _), _ = pole_terms(block, found.frequency[own], found.damping_ratio[own])
    mean = np.mean(np.abs(size) ** 2, axis=1) * np.abs(up).max() ** 2
    return np.asarray(mean / white_level(found))


def _excitation(found: PoleFit, mode: int, level: float) -> float:
    """Return the mean square of a vibration at the stops over that of the ambient response.

    ``level`` is the ambient response h of the mode.
    """
    f, zeta = float(found.frequency[mode]), float(found.damping_ratio[mode])
    exponent = 2 * np.pi * f * (-zeta + 1j * np.sqrt(1 - zeta**2))
    shape, noise = found.likelihood.shapes[mode], white_level(found)
    squares = []
    for block, size in zip(found.likelihood.blocks, found.sizes(mode), strict=True):
        start = size * np.sqrt(2 / block.duration) / (1 - np.exp(exponent * block.duration))
        # Projection on the mode's shape, every channel in units of its noise.
        along = (shape / noise) @ start / (shape**2 / noise).sum()
        squares.append(np.abs(along) ** 2)
    # Twice the variance π f S / (4 ζ) of the response to a force of density S.
    ambient = np.pi * f / (2 * zeta) * level**2 / found.likelihood.units[mode]
    return float(np.mean(np.concatenate(squares)) / ambient)


def average_ambient(
    likelihood: ModalLikelihood, p: FloatArray, mode: int, free: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Average the posterior over the ambient response of a mode; ``free`` are the other parameters.

    A stop shows it at two or three Fourier frequencies near the resonance, and the most probable
    level is often far below the true one. Intervals at that level cover two times out of three;
    averaged over all levels under Jeffreys' prior they cover as stated. Returns mean and covariance
    of all parameters, zero where held.
    """
    place = 2 * likelihood.n_modes + mode
    start = p.copy()
    start[place] = max(abs(p[place]), _FIRST_AVERAGE_LEVEL)
    metric = likelihood.metric(likelihood.evaluate(start))
    spread = float(np.sqrt(np.linalg.inv(metric)[place, place])) / start[place]
    step = min(_COARSE, _SPREADS * spread)
    weight, levels = _average_levels(likelihood, start, place, free, step)
    weights = softmax(weight)
    where = np.array([level.p for level in levels])
    mean = weights @ where
    cov = (where - mean).T @ (weights[:, None] * (where - mean))
    inverses = np.array([np.linalg.inv(level.at.fisher[np.ix_(free, free)]) for level in levels])
    cov[np.ix_(free, free)] += np.tensordot(weights, inverses, 1)
    return mean, cov


def _average_levels(
    likelihood: ModalLikelihood, p: FloatArray, place: int, free: IntArray, step: float
) -> tuple[FloatArray, list[PoleFit]]:
    """Maximise at levels in both directions from a first one, until they are unlikely.

    Returns the log posterior of each level on a log grid, the other parameters integrated, and the
    maximum at each level.
    """
    found: list[tuple[float, PoleFit]] = []
    for way in (1, -1):
        at = p.copy()
        if way < 0:
            at[place] *= np.exp(-step)
        while at[place] > _LEAST_LEVEL:
            level = maximise(likelihood, at, free)
            fisher = level.at.fisher
            log_det = np.linalg.slogdet(fisher[np.ix_(free, free)])[1]
            prior = 0.5 * np.log(fisher[place, place]) + np.log(at[place])
            found.append((float(prior - level.at.value - log_det / 2), level))
            if found[-1][0] < max(weight for weight, _ in found) - _UNLIKELY:
                break
            at = level.p.copy()
            at[place] *= np.exp(way * step)
    best = max(weight for weight, _ in found)
    kept = [item for item in found if item[0] > best - _UNLIKELY]
    return np.array([weight for weight, _ in kept]), [level for _, level in kept]


@dataclass(frozen=True, slots=True, eq=False)
class DecayEstimate:
    """Modes of a band with their joint covariance."""

    mean: FloatArray  # [ln f, ln ζ], (2 n_modes,)
    cov: FloatArray  # (2 n_modes, 2 n_modes)
    credibility: tuple[Credibility, ...]  # factors of it, (n_modes,)
    # mean square of each vibration at the stops over the ambient one, (n_modes,)
    excitation: FloatArray


def fit_decays(blocks: tuple[BandSpectra, ...], *, displacement: bool = False) -> PoleFit:
    """Add poles while the Bayesian information criterion improves.

    The result has no modes where the band holds only noise.
    """
    n = blocks[0].ordinates.shape[2]
    # The level of the noise between the peaks of each channel; most ordinates of one that is
    # constant in most segments are zero.
    powers = [np.abs(block.ordinates) ** 2 for block in blocks]
    medians = np.mean([np.median(power, axis=(0, 1)) for power in powers], axis=0)
    means = np.mean([np.mean(power, axis=(0, 1)) for power in powers], axis=0)
    medians = np.maximum(medians, _LEAST_NOISE * means).clip(np.finfo(float).tiny)
    levels = np.log(medians / np.log(2))
    likelihood = ModalLikelihood(blocks, np.empty((0, n)), np.empty(0), levels, displacement)
    start = np.concatenate([levels, np.zeros(n)])
    found = maximise(likelihood, start, np.arange(2 * n))
    while found.likelihood.n_modes < constants.DECAY_MOST_POLES:
        more = _add_pole(found, *_best_pole(found))
        gain = found.at.profile - more.at.profile
        if gain < evidence_needed(found.likelihood):
            break
        found = more
    return found


def _best_pole(found: PoleFit) -> tuple[float, float]:
    """Return frequency and damping of the pole that explains most of the residual."""
    longest = max(found.likelihood.blocks, key=lambda block: block.duration)
    step = 1 / (_TRIALS * longest.duration)
    grid = np.arange(longest.frequency[0] + 2 * step, longest.frequency[-1] - step, step)
    f, zeta = (values.ravel() for values in np.meshgrid(grid, _DAMPINGS))
    return best_pole(found, f, zeta)[:2]


def _add_pole(found: PoleFit, f: float, zeta: float) -> PoleFit:
    """Fit one more pole, first without its ambient response, then with the shape of its decays."""
    before, m = found.likelihood, found.likelihood.n_modes
    start = np.insert(found.p, [m, 2 * m, 3 * m], [np.log(f), np.log(zeta), 0.0])
    size = max(block.duration for block in before.blocks)
    unit = unit_level(f, zeta, size, displacement=before.displacement)
    shapes, units = np.vstack([before.shapes, np.ones(before.n_channels)]), [*before.units, unit]
    likelihood = replace(before, shapes=shapes, units=np.array(units))
    without, start = np.delete(np.arange(start.size), 3 * m + 2), likelihood.clip(start)
    first = maximise(likelihood, start, without, tolerance=_ROUGH)
    # The real shape that its decays have in common.
    scale, sizes = np.sqrt(white_level(first)), np.concatenate(first.sizes(m), axis=1)
    seen = np.concatenate([sizes.real, sizes.imag], axis=1) / scale[:, None]
    shape = np.linalg.svd(seen, full_matrices=False)[0][:, 0] * scale
    likelihood = replace(likelihood, shapes=np.vstack([before.shapes, shape]))
    start = first.p + 0.0
    start[3 * m + 2] = _FIRST_LEVEL
    free = np.arange(start.size)
    return maximise(likelihood, start, free, tolerance=_ROUGH)


def estimate(found: PoleFit, modes: Sequence[int] | None = None) -> DecayEstimate:
    """Estimate modes of a band, by default all, averaged over their ambient responses."""
    likelihood, m = found.likelihood, found.likelihood.n_modes
    modes = range(m) if modes is None else modes
    p = found.p.copy()
    at_bound = m + np.flatnonzero(found.is_line())
    free = np.setdiff1d(np.arange(p.size), [*range(2 * m, 3 * m), *at_bound])
    averages = []
    # The ambient response of one mode hardly affects another: each is averaged over in turn.
    for i in modes:
        averages.append(average_ambient(likelihood, p, i, free))
        p[2 * m + i] = averages[-1][0][2 * m + i]
    own = paired(modes, m)
    n = len(modes)
    inverse = np.zeros((p.size, p.size))
    fisher = maximise(likelihood, p, free).at.fisher
    inverse[np.ix_(free, free)] = np.linalg.inv(fisher[np.ix_(free, free)])
    joint = inverse[np.ix_(own, own)]
    mean, scales = np.empty(2 * n), np.zeros((2 * n, 2 * n))
    for k, (average, cov) in enumerate(averages):
        pair = np.array([k, n + k])
        mean[pair] = average[own[pair]]
        # The joint covariance is scaled until each mode has that of its average.
        wide = np.linalg.cholesky(cov[np.ix_(own[pair], own[pair])])
        narrow = np.linalg.cholesky(joint[np.ix_(pair, pair)])
        scales[np.ix_(pair, pair)] = wide @ np.linalg.inv(narrow)
    cov = scales @ joint @ scales.T
    credibility = widened((Credibility(),) * n, "ambient-level", joint, cov)
    excitation = [_excitation(found, i, float(p[2 * m + i])) for i in modes]
    return DecayEstimate(mean, cov, credibility, np.array(excitation))


def stationarity(found: PoleFit) -> float:
    """Return the p value of a test whether the residual is stationary over the record.

    Noise whose power varies over the record correlates neighbouring ordinates. The lag-one products
    of the whitened residual are compared with those of white noise after the same fit.
    """
    n = found.likelihood.n_channels
    seen, expected, variance = np.zeros((3, 2))  # of the products, real and imaginary
    for fit in found.at.fits:
        n_rows, n_segments = fit.residual.shape
        for k, turn in enumerate((1.0, -1j)):
            moved = _neighbours(fit.removed, n, turn)
            inner = fit.removed.T @ moved
            seen[k] += np.sum(fit.residual * _neighbours(fit.residual, n, turn))
            expected[k] += -0.5 * n_segments * np.trace(inner)
            # tr(A²) of the symmetric shift: half of the ordinates that have a neighbour, twice.
            spread = n_rows / 2 - n - 2 * np.sum(moved**2) + np.sum(inner * inner.T)
            variance[k] += 0.5 * n_segments * spread
    return float(chdtrc(2, np.sum((seen - expected) ** 2 / variance)))


def _neighbours(rows: FloatArray, n: int, turn: complex) -> FloatArray:
    """Apply the quadratic form's matrix of Re(turn Σ z_k z*_{k+1}) to stacked ordinates."""
    halves = rows.reshape(2, -1, n, rows.shape[1])
    z = halves[0] + 1j * halves[1]
    moved = np.zeros_like(z)
    moved[:-1] += turn * z[1:] / 2
    moved[1:] += np.conj(turn) * z[:-1] / 2
    return stack(moved).reshape(rows.shape)
