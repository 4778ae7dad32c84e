"""Candidate modes of all channels at once, by covariance-driven subspace identification."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import squareform

from lmshealth._private.arrays import BoolArray, ComplexArray, FloatArray
from lmshealth.modal import constants
from lmshealth.signal.spectra import CrossSpectrum, LogSpectra

# Orders of the subspace model, and most block rows of its Hankel matrix.
_ORDERS, _MOST_ROWS = range(2, 31), 60
# Ordinates whose correlations are summed at a time.
_BLOCK = 4096
# The band is widened by this share to either side, and tapered there.
_MARGIN = 0.1
# Distance at which poles are of different clusters: in half-power bandwidths, half the logarithm of
# the dampings' ratio, and the shapes' lack of correlation together.
_APART = 0.8
_LEAST_DAMPING = 2e-4
# Poles of shapes this alike within so many half-power bandwidths are one that noise split.
_SPLIT_ALIKE, _SPLIT = 0.7, 1.2
# Ordinates to either side whose mean replaces a masked one.
_NEAR_LINE = 4


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A pole that many orders of the model have."""

    frequency: float  # in Hz
    damping_ratio: float
    shape: ComplexArray  # relative accelerations, (n_channels,)
    stability: float  # share of the orders


@dataclass(frozen=True, slots=True, eq=False)
class Poles:
    """Poles of all orders, shape ``(n_poles,)`` each."""

    order: FloatArray
    frequency: FloatArray
    damping_ratio: FloatArray
    shape: ComplexArray  # of unit norm in whitened channels, (n_poles, n_channels)
    stable: BoolArray  # whether many orders have it


def find_candidates(spectra: LogSpectra, low: float, high: float) -> tuple[list[Candidate], Poles]:
    """Return the stable poles of a band in Hz, ascending in frequency, and the poles of all orders.

    Correlations at the rate of the band come from the cross spectra, so that lines are masked and
    other bands cost nothing; they are complex. Channels are scaled by their smooth level, as a
    strong floor would hide modes that other channels show.
    """
    margin = _MARGIN * (high - low)
    bottom = max(low - margin, min(float(s.frequency[0]) for s in spectra.spectra))
    top = min(high + margin, min(float(s.frequency[-1]) for s in spectra.spectra))
    poles = _solve(_correlate(spectra, bottom, top), bottom, top - bottom)
    longest = max(spectra.spectra, key=lambda s: s.observed).band(bottom, top)
    candidates, poles = _cluster(poles)
    stable = [one for one in _merge(candidates) if low <= one.frequency <= high]
    place = np.searchsorted(longest.frequency[:-1], [one.frequency for one in stable])
    levels = _smooth_level(longest.powers())[place]
    # From whitened to physical channels.
    rows = zip(stable, levels, strict=True)
    return [replace(one, shape=one.shape * level) for one, level in rows], poles


def _correlate(spectra: LogSpectra, low: float, high: float) -> ComplexArray:
    """Return the correlations of the channels at the rate of a band, (n_lags, n, n)."""
    n, width = len(spectra.channels), high - low
    rows = int(min(_MOST_ROWS, width * spectra.duration / 10))
    lags = np.arange(2 * rows + 2)
    total = np.zeros((lags.size, n, n), dtype=complex)
    for spectrum in spectra.spectra:
        cut = spectrum.band(low, high)
        if (size := cut.frequency.size) < _NEAR_LINE:
            continue
        from_end = np.minimum(np.arange(size), np.arange(size)[::-1]) / (_MARGIN * (size - 1))
        taper = np.sin(np.pi / 2 * np.minimum(from_end, 1.0)) ** 2
        turn = 2j * np.pi / (cut.duration * width) * lags
        phase = np.exp(turn[:, None] * np.arange(min(size, _BLOCK)))
        first = np.exp(2j * np.pi * (cut.frequency[0] - low) / width * lags)
        # Row by row: transforms of all at once would take several times the memory of the spectra.
        for i, row in enumerate(_whitened(cut)):
            for start in range(0, size, _BLOCK):
                some = row[start : start + _BLOCK] * taper[start : start + _BLOCK, None]
                before = spectrum.count * first * np.exp(turn * start)
                total[:, i] += before[:, None] * (phase[:, : len(some)] @ some)
    return total


def _whitened(spectrum: CrossSpectrum) -> Iterator[ComplexArray]:
    """Yield rows of the matrices, ``(n_ordinates, n_channels)``, of channels of one smooth level.

    Masked ordinates are replaced by their surroundings.
    """
    transforms = _project(spectrum)
    masked, free = np.flatnonzero(~spectrum.free), np.flatnonzero(spectrum.free)
    near: np.ndarray | None = None
    if masked.size and free.size > 2 * _NEAR_LINE:
        place = np.searchsorted(free, masked)
        reach = range(-_NEAR_LINE, _NEAR_LINE)
        near = np.stack([free[np.clip(place + k, 0, free.size - 1)] for k in reach])

    def repaired(part: ComplexArray) -> ComplexArray:
        if near is not None:
            part[masked] = part[near].mean(axis=0)
        return part

    powers = np.mean(np.abs(transforms) ** 2, axis=0)
    level = _smooth_level(repaired(powers.astype(np.complex128)).real)
    for i in range(level.shape[1]):
        row = np.mean(transforms[:, :, i, None] * transforms.conj(), axis=0)
        yield repaired(row) / (level[:, [i]] * level)


def _project(spectrum: CrossSpectrum) -> ComplexArray:
    """Return the transforms without the directions of what no mode causes."""
    if spectrum.foreign is None:
        return spectrum.transforms
    shown: BoolArray = np.abs(spectrum.foreign).sum(axis=1) > 0
    within = np.flatnonzero(shown.sum(axis=1))
    root = np.sqrt(spectrum.powers()[within].mean(axis=0).clip(1e-300))
    transforms = spectrum.transforms.copy()
    patterns, place = np.unique(shown[within], axis=0, return_inverse=True)
    for k, pattern in enumerate(patterns):
        at = within[place.ravel() == k]
        # A direction does not change within the band of what causes it.
        foreign = spectrum.foreign[at[0]][:, pattern] / root[:, None]
        u, s, _ = np.linalg.svd(foreign, full_matrices=False)
        u = u[:, s > 1e-3 * s[0]]
        rest = transforms[:, at] / root
        transforms[:, at] = (rest - rest @ u.conj() @ u.T) * root
    return transforms


def _smooth_level(power: FloatArray) -> FloatArray:
    """Smooth root of the densities of channels, shape ``(n_ordinates, n_channels)``."""
    u = np.linspace(-1, 1, len(power))
    fit = np.polynomial.polynomial.polyfit(u, np.log(power.clip(1e-300)), 2)
    return np.asarray(np.exp(np.polynomial.polynomial.polyval(u, fit) / 2).T)


def _solve(lags: ComplexArray, low: float, rate: float) -> Poles:
    """Realise models of all orders from one decomposition of the Hankel matrix."""
    n, rows = lags.shape[1], len(lags) // 2 - 1
    blocks = np.stack([lags[1 + i : 2 + i + rows] for i in range(rows)])  # (rows, rows + 1, n, n)
    hankel = blocks.transpose(0, 2, 1, 3).reshape(rows * n, (rows + 1) * n)
    u, s, vh = np.linalg.svd(hankel[:, :-n], full_matrices=False)
    most = min(_ORDERS.stop - 1, int((s > 1e-12 * s[0]).sum()))
    if most < _ORDERS.start:  # silent channels
        nothing = np.empty(0)
        return Poles(nothing, nothing, nothing, np.empty((0, n), dtype=complex), nothing > 0)
    u, s, vh = u[:, :most], s[:most], vh[:most]
    transition = (u.conj().T @ hankel[:, n:] @ vh.conj().T) / np.sqrt(s[:, None] * s)
    output = u[:n] * np.sqrt(s)
    orders = np.arange(_ORDERS.start, most + 1)
    values, shapes = [], []
    for order in orders:
        value, vector = np.linalg.eig(transition[:order, :order])
        values.append(value)
        shapes.append((output[:, :order] @ vector).T)
    exponent, shape = np.log(np.concatenate(values)) * rate, np.concatenate(shapes)
    pole = exponent.real + 1j * (2 * np.pi * low + exponent.imag % (2 * np.pi * rate))
    zeta = -pole.real / np.abs(pole)
    kept = (zeta > _LEAST_DAMPING) & (zeta < constants.MOST_DAMPING)
    shape = shape / np.linalg.norm(shape, axis=1, keepdims=True)
    order = np.repeat(orders, orders).astype(float)[kept]
    frequency = np.abs(pole[kept]) / (2 * np.pi)
    return Poles(order, frequency, zeta[kept], shape[kept], np.zeros(order.size, dtype=bool))


def _cluster(poles: Poles) -> tuple[list[Candidate], Poles]:
    """Cluster the poles of all orders; keep clusters that many orders have, mark their poles."""
    f, zeta, shape = poles.frequency, poles.damping_ratio, poles.shape
    if f.size < 2:
        return [], poles
    distance = np.abs(np.log(f[:, None] / f)) / (zeta[:, None] + zeta)
    distance += 1 - np.abs(shape @ shape.conj().T) ** 2
    distance += np.abs(np.log(zeta[:, None] / zeta)) / 2
    np.fill_diagonal(distance, 0)
    label = fcluster(linkage(squareform(distance, checks=False), "average"), _APART, "distance")
    n_orders = np.unique(poles.order).size
    found, stable = [], poles.stable.copy()
    for number in np.unique(label):
        members = np.flatnonzero(label == number)
        stability = np.unique(poles.order[members]).size / n_orders
        if stability >= constants.STABLE:
            stable[members] = True
            centre = members[distance[np.ix_(members, members)].sum(axis=1).argmin()]
            pole = float(np.median(f[members])), float(np.median(zeta[members]))
            found.append(Candidate(*pole, shape[centre], stability))
    return found, replace(poles, stable=stable)


def _merge(candidates: list[Candidate]) -> list[Candidate]:
    """Merge poles that noise split, the most stable first; ascending in frequency."""
    rest = sorted(candidates, key=lambda c: -c.stability)
    merged = []
    while rest:
        first = rest[0]
        group = [c for c in rest if _is_split(c, first)]
        rest = [c for c in rest if c not in group]
        f, zeta, stability = np.array(
            [(c.frequency, c.damping_ratio, c.stability) for c in group]
        ).T
        weight = stability**4 / np.sum(stability**4)
        mean = float(weight @ f)
        damping = float(np.sqrt(weight @ (zeta**2 + (f / mean - 1) ** 2)))
        merged.append(replace(first, frequency=mean, damping_ratio=damping))
    return sorted(merged, key=lambda c: c.frequency)


def _is_split(one: Candidate, other: Candidate) -> bool:
    """Return whether noise may have split one pole into two."""
    width = one.frequency * one.damping_ratio + other.frequency * other.damping_ratio
    alike = abs(one.shape.conj() @ other.shape) ** 2 > _SPLIT_ALIKE
    return bool(alike and abs(one.frequency - other.frequency) < _SPLIT * width)
