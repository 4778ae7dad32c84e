"""Fit neighbouring modes to the decays of some channels, and say what they are known to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from lmshealth.arrays import BoolArray, ComplexArray, FloatArray
from lmshealth.decayfit import Optimum, average_ambient, invert, maximise
from lmshealth.restricted import BlockFit, TransientLikelihood, unit_level
from lmshealth.transient import Block, stack, transient

MOST_POLES = 6
# Log likelihood beyond the Bayesian information criterion that a further pole must bring.
_EVIDENCE_MARGIN = 5.0
# Poles tried per Fourier frequency, and their dampings.
_TRIALS, _DAMPINGS = 4.0, np.geomspace(2e-4, 0.1, 10)
_FIRST_LEVEL = 0.3  # of the ambient response
# A line's damping is within this share of the least that can be told from none.
_AT_BOUND = 0.01
# Log likelihood that is not worth a step while poles are counted.
_ROUGH = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Ringing:
    """Poles that decays in a band show, at their most probable place.

    Attributes
    ----------
    likelihood : TransientLikelihood
        Of the band.
    optimum : Optimum
        Its maximum.
    """

    likelihood: TransientLikelihood
    optimum: Optimum

    @property
    def frequency(self) -> FloatArray:
        """Natural frequencies in Hz, shape ``(n_modes,)``."""
        return np.exp(self.optimum.p[: self.likelihood.n_modes])

    @property
    def damping_ratio(self) -> FloatArray:
        """Damping ratios, shape ``(n_modes,)``."""
        m = self.likelihood.n_modes
        return np.exp(self.optimum.p[m : 2 * m])

    def is_line(self) -> BoolArray:
        """Tell which modes do not fade at all over the record, shape ``(n_modes,)``."""
        m, p = self.likelihood.n_modes, self.optimum.p
        return np.asarray(p[m : 2 * m] < self.likelihood.least_damping(p) + _AT_BOUND)

    def sizes(self, mode: int) -> list[ComplexArray]:
        """Complex size of a mode's transient, per block of ``(n_channels, n_segments)``."""
        pairs = [
            fit.sizes[:, 2 * mode - 2 * self.likelihood.n_modes :][:, :2]
            for fit in self.optimum.at.fits
        ]
        return [pair[:, 0] + 1j * pair[:, 1] for pair in pairs]

    def white_level(self) -> FloatArray:
        """Power spectral density of the white noise in mid-band, shape ``(n_channels,)``."""
        m, n = self.likelihood.n_modes, self.likelihood.n_channels
        return np.exp(self.optimum.p[3 * m : 3 * m + n])

    def snr(self, mode: int) -> FloatArray:
        """Largest mean ordinate of a mode's decays over the noise, shape ``(n_channels,)``.

        As S / (4 ζ² S_e) is of an ambient response.
        """
        block, size = self.likelihood.blocks[0], self.sizes(mode)[0]
        own = slice(mode, mode + 1)
        top = np.abs(transient(block, self.frequency[own], self.damping_ratio[own])).max()
        n_samples = block.sample_rate * block.duration
        mean = np.mean(np.abs(size) ** 2, axis=1) * (top / n_samples) ** 2
        return np.asarray(mean / self.white_level())

    def excitation(self, mode: int, level: float) -> float:
        """Mean square of a mode's vibration at the stops over that of its ambient response.

        Parameters
        ----------
        mode : int
            Which.
        level : float
            Its ambient response, h of the likelihood.
        """
        f, zeta = float(self.frequency[mode]), float(self.damping_ratio[mode])
        exponent = 2 * np.pi * f * (-zeta + 1j * np.sqrt(1 - zeta**2))
        shape = self.likelihood.shapes[mode]
        squares = []
        for block, size in zip(self.likelihood.blocks, self.sizes(mode), strict=True):
            start = size * np.sqrt(2 / block.duration) / (1 - np.exp(exponent * block.duration))
            # Seen along the mode's shape, every channel in units of its noise.
            along = (shape / self.white_level()) @ start / (shape**2 / self.white_level()).sum()
            squares.append(np.abs(along) ** 2)
        # Twice the variance π f S / (4 ζ) of the response to a force of density S.
        ambient = np.pi * f / (2 * zeta) * level**2 / self.likelihood.units[mode]
        return float(np.mean(np.concatenate(squares)) / ambient)


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Modes of a band with their joint covariance.

    Attributes
    ----------
    mean : ndarray
        ``[ln f, ln ζ]`` of n modes, shape ``(2 n,)``.
    cov : ndarray
        Shape ``(2 n, 2 n)``.
    excitation : ndarray
        Mean square of each mode's vibration at the stops over that of its ambient response,
        shape ``(n,)``.
    """

    mean: FloatArray
    cov: FloatArray
    excitation: FloatArray


def find_ringing(blocks: tuple[Block, ...], *, displacement: bool = False) -> Ringing:
    """Add poles as long as the Bayesian information criterion asks for them.

    Parameters
    ----------
    blocks : tuple of Block
        Decays in a band.
    displacement : bool
        The channels are displacements.

    Returns
    -------
    Ringing
        Without modes where the band holds noise only.
    """
    n = blocks[0].ordinates.shape[2]
    levels = np.log(_levels(blocks))
    likelihood = TransientLikelihood(blocks, np.empty((0, n)), np.empty(0), levels, displacement)
    start = np.concatenate([levels, np.zeros(n)])
    found = Ringing(likelihood, maximise(likelihood, start, np.arange(2 * n)))
    sizes = [block.ordinates.shape for block in blocks]
    # A pole and its ambient response are told by all ordinates, the sizes of a segment by its own.
    total = sum(2 * s * k * n for s, k, _ in sizes)
    own = sum(2 * s * n * np.log(2 * k) for s, k, _ in sizes)
    needed = 1.5 * np.log(total) + own / 2 + _EVIDENCE_MARGIN
    while found.likelihood.n_modes < MOST_POLES:
        more = _add_pole(found, *_best_pole(found))
        gain = found.optimum.at.profile - more.optimum.at.profile
        if gain < needed:
            break
        found = more
    return found


def _levels(blocks: tuple[Block, ...]) -> FloatArray:
    """Level of the noise between the peaks of each channel."""
    medians = [np.median(np.abs(block.ordinates) ** 2, axis=(0, 1)) for block in blocks]
    return np.asarray(np.mean(medians, axis=0) / np.log(2))


def _best_pole(found: Ringing) -> tuple[float, float]:
    """Try poles all over the band on what the fit leaves, and choose the one that gains most."""
    longest = max(found.likelihood.blocks, key=lambda block: block.duration)
    step = 1 / (_TRIALS * longest.duration)
    grid = np.arange(longest.frequency[0] + 2 * step, longest.frequency[-1] - step, step)
    f, zeta = (values.ravel() for values in np.meshgrid(grid, _DAMPINGS))
    gain = np.zeros(f.size)
    for block in found.likelihood.blocks:
        density = found.likelihood.density(block, found.optimum.p)
        known = [block.base, transient(block, found.frequency, found.damping_ratio)]
        tried = transient(block, f, zeta)
        for c in range(density.shape[1]):
            scale = 1 / np.sqrt(density[:, c, c, None])
            q, _ = np.linalg.qr(scale * np.concatenate(known, axis=1))
            data, columns = (
                x - q @ (q.conj().T @ x)
                for x in (scale * block.ordinates[:, :, c].T, scale * tried)
            )
            shown = np.sum(np.abs(columns.conj().T @ data) ** 2, axis=1)
            gain += shown / np.sum(np.abs(columns) ** 2, axis=0)
    best = int(np.argmax(gain))
    return float(f[best]), float(zeta[best])


def _add_pole(found: Ringing, f: float, zeta: float) -> Ringing:
    """Fit one pole more: first without its ambient response, then with it in the decay's shape."""
    before, m = found.likelihood, found.likelihood.n_modes
    p = found.optimum.p
    start = np.concatenate(
        [p[:m], [np.log(f)], p[m : 2 * m], [np.log(zeta)], p[2 * m : 3 * m], [0.0], p[3 * m :]]
    )
    size = max(block.duration for block in before.blocks)
    unit = unit_level(f, zeta, size, displacement=before.displacement)
    likelihood = replace(
        before,
        shapes=np.concatenate([before.shapes, np.ones((1, before.n_channels))]),
        units=np.append(before.units, unit),
    )
    without = np.delete(np.arange(start.size), 3 * m + 2)
    first = Ringing(
        likelihood, maximise(likelihood, likelihood.clip(start), without, tolerance=_ROUGH)
    )
    shape = _shape(np.concatenate(first.sizes(m), axis=1), first.white_level())
    shapes = np.concatenate([before.shapes, shape[None]])
    likelihood = replace(likelihood, shapes=shapes)
    start = first.optimum.p + 0.0
    start[3 * m + 2] = _FIRST_LEVEL
    return Ringing(likelihood, maximise(likelihood, start, np.arange(start.size), tolerance=_ROUGH))


def _shape(sizes: ComplexArray, noise: FloatArray) -> FloatArray:
    """Find the real shape that a mode's decays have in common, in units of the noise."""
    scale = np.sqrt(noise)
    seen = np.concatenate([sizes.real, sizes.imag], axis=1) / scale[:, None]
    return np.asarray(np.linalg.svd(seen, full_matrices=False)[0][:, 0] * scale)


def estimate(found: Ringing, modes: Sequence[int] | None = None) -> Estimate:
    """Average modes of a band over their ambient responses.

    Parameters
    ----------
    found : Ringing
        With at least one mode.
    modes : sequence of int, optional
        Which, at least one; by default all.
    """
    likelihood, m = found.likelihood, found.likelihood.n_modes
    modes = range(m) if modes is None else modes
    p = found.optimum.p.copy()
    at_bound = m + np.flatnonzero(found.is_line())
    free = np.setdiff1d(np.arange(p.size), [*range(2 * m, 3 * m), *at_bound])
    averages = []
    # The ambient response of one mode hardly tells on another: each is averaged over in turn.
    for i in modes:
        averages.append(average_ambient(likelihood, p, i, free))
        p[2 * m + i] = averages[-1].mean[2 * m + i]
    own = np.array([*modes, *(m + i for i in modes)])
    n = len(modes)
    inverse = np.zeros((p.size, p.size))
    inverse[np.ix_(free, free)] = invert(likelihood, maximise(likelihood, p, free), free)
    joint = inverse[np.ix_(own, own)]
    mean, scales = np.empty(2 * n), np.zeros((2 * n, 2 * n))
    for k, average in enumerate(averages):
        pair = np.array([k, n + k])
        mean[pair] = average.mean[own[pair]]
        # The joint covariance is stretched until each mode has that of its average.
        wide = np.linalg.cholesky(average.cov[np.ix_(own[pair], own[pair])])
        narrow = np.linalg.cholesky(joint[np.ix_(pair, pair)])
        scales[np.ix_(pair, pair)] = wide @ np.linalg.inv(narrow)
    excitation = [found.excitation(i, float(p[2 * m + i])) for i in modes]
    return Estimate(mean, scales @ joint @ scales.T, np.array(excitation))


def stationarity(found: Ringing) -> float:
    """Test whether what the fit leaves is the same all through the record.

    What fades with the decay or grows towards the end of a record ties ordinates to their
    neighbours. The lag-one products of the whitened residual are compared with what white noise
    would leave of itself after the same fit.

    Parameters
    ----------
    found : Ringing
        Any fit.

    Returns
    -------
    float
        Probability of at least that much correlation in stationary noise.
    """
    total = np.zeros((3, 2))
    for fit in found.optimum.at.fits:
        total += _lag_one(fit, found.likelihood.n_channels)
    return float(stats.chi2.sf(np.sum((total[0] - total[1]) ** 2 / total[2]), 2))


def _lag_one(fit: BlockFit, n: int) -> FloatArray:
    """Lag-one products, real and imaginary: found, expected and variance, shape ``(3, 2)``."""
    found = np.empty((3, 2))
    for k, turn in enumerate((1.0, -1j)):
        moved_residual = _neighbours(fit.residual, n, turn)
        moved_base = _neighbours(fit.removed, n, turn)
        n_segments = fit.residual.shape[1]
        n_rows = fit.residual.shape[0]
        inner = fit.removed.T @ moved_base
        # tr(A²) of the symmetric shift: half of the ordinates that have a neighbour, twice.
        whole = n_rows / 2 - n
        found[0, k] = np.sum(fit.residual * moved_residual)
        found[1, k] = -0.5 * n_segments * np.trace(inner)
        found[2, k] = (
            0.5 * n_segments * (whole - 2 * np.sum(moved_base**2) + np.sum(inner * inner.T))
        )
    return found


def _neighbours(rows: FloatArray, n: int, turn: complex) -> FloatArray:
    """Apply the quadratic form's matrix of Re(turn Σ z_k z*_{k+1}) to stacked ordinates."""
    halves = rows.reshape(2, -1, n, rows.shape[1])
    z = halves[0] + 1j * halves[1]
    moved = np.zeros_like(z)
    moved[:-1] += turn * z[1:] / 2
    moved[1:] += np.conj(turn) * z[:-1] / 2
    return stack(moved).reshape(rows.shape)
